"""`GyroModel`: a sum of effects and a noise model, composed in the published order."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Container, Iterable, Mapping
from dataclasses import replace
from difflib import get_close_matches
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from gyromodel.declarations import column_of
from gyromodel.effects import CATALOGUE, Effect, Signals
from gyromodel.effects._base import Domain, evaluate, lacking
from gyromodel.effects.converter import Quantisation
from gyromodel.effects.drivers import BiasColumn
from gyromodel.noise import NOISE_UNITS

# A local slope below this part of the gain is a dead band's.
DEAD = 0.05
# Sites of terms that are added to the input, and of what depends on all that other effects add up to.
ADDED = ("rate", "angle")
LATER = ("gain", "output", "readout")
OF = {"gyro": "a gyro", "platform": "a platform's base in a vibration test"}


class ModelError(ValueError):
    """A model that cannot be built or does not fit the campaign; the message says what to change."""


class Slot(NamedTuple):
    """Where one parameter sits: effect number, field, index within it, and whether the output is linear in it."""

    effect: int
    field: str
    index: int
    linear: bool


class Level(NamedTuple):
    """A noise level that follows a column: `ratio` is σ at its value `high` over σ at `low`, in internal units.

    Of rate and temperature_rate it is the size that counts.
    """

    driver: str
    low: float
    high: float
    ratio: float


# What the noise level may follow, and the units it is written in.
LEVEL_UNITS = {"rate": "deg/s", "temperature": "degC", "temperature_rate": "degC/s", "time": "s"}


class GyroModel(eqx.Module):
    """output = Π gains · (u + output terms of u) + noise, u = (rate + Σ rate terms) · (1 + Σ scale terms).

    `noise` holds coefficients in internal units by noise id, or is empty for "estimate it"; `fixed` names the
    parameters that are known, as (effect label, field); `noise_of` says whether the noise is stated as that of a gyro's
    rate or of a platform's angle, and `level` what the level of its white noise follows, stated or estimated
    (noise_heteroscedastic). A model without effects and noise is of either.
    """

    effects: tuple[Effect, ...]
    noise: Mapping[str, Float[Array, ""]] = eqx.field(
        converter=lambda given: {k: jnp.asarray(v, float) for k, v in given.items()}, default_factory=dict
    )
    fixed: frozenset[tuple[str, str]] = eqx.field(static=True, default=frozenset())
    gyro: str = eqx.field(static=True, default="")
    noise_of: Domain = eqx.field(static=True, default="gyro")
    level: Level | None = eqx.field(
        static=True, converter=lambda given: given and Level(given[0], *map(float, given[1:])), default=None
    )

    def __check_init__(self) -> None:
        labels = [e.label for e in self.effects]
        twice = {x for x in labels if labels.count(x) > 1} - {"bias_periodic", "bias_step"}
        if twice:
            raise ModelError(f"the model lists {min(twice)} twice; keep one")
        unknown = set(self.noise) - set(NOISE_UNITS)
        if unknown:
            raise ModelError(f"unknown noise {min(unknown)}; known are {', '.join(NOISE_UNITS)}")
        if (level := self.level) is not None:
            if level.driver not in LEVEL_UNITS or not level.low < level.high:
                raise ModelError("noise_heteroscedastic needs what it follows, from a value to a larger one")
            if self.noise_of != "gyro" or any(effect.domain != "gyro" for effect in self.effects):
                raise ModelError("noise_heteroscedastic is of a gyro's rate")
            if not 0.0 < level.ratio < float("inf"):
                raise ModelError("noise_heteroscedastic is a ratio of noise levels, and above zero")
        kinds: dict[str, str] = {e.domain: e.label for e in self.effects} | (
            {self.noise_of: "noise"} if self.noise else {}
        )
        if len(kinds) > 1:
            raise ModelError(
                f"{kinds['platform']} is of {OF['platform']} and {kinds['gyro']} of {OF['gyro']}: keep those of one"
            )

    @property
    def domain(self) -> Domain | None:
        """Whether it is of a gyro or of a platform; None where nothing in it says so."""
        return self.effects[0].domain if self.effects else self.noise_of if self.noise else None

    @property
    def labels(self) -> tuple[str, ...]:
        """Public ids of the effects, in order."""
        return tuple(e.label for e in self.effects)

    def with_effect(self, effect: Effect) -> GyroModel:
        """The model extended by one effect, which replaces any that it contains as a special case.

        An effect of its own label gives way, and is free from then on, if all its parameters were fixed; those of which
        there may be several stay beside it, and are free.
        """
        freed = {effect.label} & self.wholly_fixed()
        replaced = {*effect.supersedes, *(() if effect.scan else freed)}
        kept = tuple(e for e in self.effects if e.label not in replaced)
        fixed = frozenset(key for key in self.fixed if key[0] not in replaced | freed)
        return replace(self, effects=(*kept, effect), fixed=fixed)

    def wholly_fixed(self) -> set[str]:
        """Labels of the effects none of whose parameters is free."""
        free = {self.effects[slot.effect].label for slot in self.slots()}
        return set(self.labels) - free

    def without(self, label: str) -> GyroModel:
        """The model less one effect (the last of that label)."""
        where = max((i for i, name in enumerate(self.labels) if name == label), default=None)
        if where is None:
            raise ModelError(f"the model has no {label}")
        effects = self.effects[:where] + self.effects[where + 1 :]
        left = {e.label for e in effects}
        return replace(self, effects=effects, fixed=frozenset(key for key in self.fixed if key[0] in left))

    def columns_needed(self, effect: Effect) -> tuple[str, ...]:
        """The columns that one of the effects reads; a known scale factor serves without a rate, at rest."""
        return () if effect.site == "gain" and effect.label in self.wholly_fixed() else effect.columns_needed

    def check_columns(self, signals: Signals) -> None:
        """Refuse signals without a column that an effect needs."""
        for effect in self.effects:
            # Whether a scale factor is fixed takes longer to say than that nothing is lacking.
            if not lacking(effect.columns_needed, signals):
                continue
            for name in lacking(self.columns_needed(effect), signals):
                close = get_close_matches(effect.label, CATALOGUE, n=1) if isinstance(effect, BiasColumn) else []
                hint = f"; did you mean {close[0]}?" if close else ""
                raise ModelError(f"effect {effect.label} needs a column {name}, which the campaign lacks{hint}")

    def prepared(self, signals: Signals) -> GyroModel:
        """Reference points and start values that depend on the campaign filled in."""
        # Asked of the class: equinox would make an object for each method, ten times the work of most.
        GyroModel.check_columns(self, signals)
        effects = tuple(type(e).prepared(e, signals) for e in self.effects)
        if all(a is b for a, b in zip(effects, self.effects, strict=True)):
            return self
        return eqx.tree_at(lambda m: m.effects, self, effects)

    def slots(self) -> tuple[Slot, ...]:
        """The free parameters, in the order of the parameter vector."""
        found = []
        for i, effect in enumerate(self.effects):
            for name, declared in effect.declared().items():
                if (effect.label, name) in self.fixed or name in effect.held:
                    continue
                found += [Slot(i, name, j, declared.linear) for j in range(np.size(getattr(effect, name)))]
        return tuple(found)

    def with_shapes_held(self, labels: Container[str] | None = None) -> GyroModel:
        """The model with the shapes of some effects fixed at their values; of all if none are named."""
        held = {(self.labels[slot.effect], slot.field) for slot in self.slots() if not slot.linear}
        return replace(self, fixed=self.fixed | {key for key in held if labels is None or key[0] in labels})

    def _fields(self) -> list[tuple[int, str]]:
        return list(dict.fromkeys((s.effect, s.field) for s in self.slots()))

    def vector(self) -> Float[Array, " parameter"]:
        """Values of the free parameters, in internal units."""
        values = [jnp.ravel(getattr(self.effects[i], name)) for i, name in self._fields()]
        return jnp.concatenate(values) if values else jnp.zeros(0)

    def with_vector(self, vector: Float[Array | np.ndarray, " parameter"]) -> GyroModel:
        """The model at other values of its free parameters."""
        vector, effects, start = on_host(vector), list(self.effects), 0
        for i, fields in itertools.groupby(self._fields(), lambda place: place[0]):
            names, new = [name for _, name in fields], []
            for old in (getattr(effects[i], name) for name in names):
                new.append(jnp.asarray(vector[start : start + np.size(old)].reshape(np.shape(old))))
                start += np.size(old)
            effects[i] = eqx.tree_at(lambda e, names=names: [getattr(e, name) for name in names], effects[i], new)
        return eqx.tree_at(lambda m: m.effects, self, tuple(effects))

    def _sites(self, signals: Signals) -> tuple[Array, Array, Array]:
        rate = signals.get("rate", jnp.zeros_like(signals["time"]))
        gain, scale = jnp.ones(()), jnp.ones_like(rate)
        for effect in self.effects:
            if effect.site == "gain":
                gain = gain * effect.value  # type: ignore[attr-defined]
            elif effect.site in ADDED:
                rate = rate + effect.contribution(signals)
            elif effect.site == "scale":
                scale = scale + effect.contribution(signals)
        return gain, rate, scale

    def told(self, before: Float[Array | np.ndarray, " sample"], signals: Signals) -> Float[Array, " sample"]:
        """What the output tells of (rate + Σ)(1 + Σ), both in rad/s."""
        told = jnp.asarray(before)
        for effect in self.effects:
            if effect.site == "output":
                told = told + effect.contribution({**signals, "rate": told})
        return told

    def passed(self, before: Float[Array | np.ndarray, " sample"], signals: Signals) -> Float[Array, " sample"]:
        """Derivative of what is told by what would be: zero where the output ends."""
        before = jnp.asarray(before)
        return jax.jvp(lambda u: self.told(u, signals), (before,), (jnp.ones_like(before),))[1]

    def unknown(self, signals: Signals) -> dict[str, np.ndarray]:
        """By effect that follows the rate late, samples at which one before the record or in a gap still shows.

        Temperatures change slowly, and soak when a record begins: what lags behind them is known well enough.
        """
        late = [effect for effect in self.effects if effect.remembers and "rate" in effect.needs]
        found = {effect.label: np.asarray(effect.unknown(signals)) for effect in late}
        return {label: rows for label, rows in found.items() if rows.any()}

    def ended(self, signals: Signals) -> np.ndarray:
        """Samples at which the output ends and follows nothing."""
        if all(effect.site != "output" for effect in self.effects):
            return np.zeros(len(signals["time"]), bool)
        _, rate, scale = self._sites(signals)
        return np.asarray(self.passed(rate * scale, signals)) == 0.0

    @property
    def reading(self) -> Quantisation | None:
        """How the output is read; None where in steps that nobody sees."""
        return next((e for e in self.effects if isinstance(e, Quantisation)), None)

    def gain(self) -> Float[Array, ""]:
        """Output per unit of input rate."""
        values = [e.value for e in self.effects if e.site == "gain"]  # type: ignore[attr-defined]
        return jnp.prod(jnp.stack(values)) if values else jnp.ones(())

    def predict(self, signals: Signals) -> Float[Array, " sample"]:
        """The noise-free output, in the campaign's internal output unit."""
        gain, rate, scale = self._sites(signals)
        return gain * self.told(rate * scale, signals)

    def slope(self, signals: Signals) -> Float[Array, " sample"]:
        """Derivative of the output by the input rate at each sample: what turns an output error into a rate error.

        Where the output hardly follows the rate, as in a dead band, no output error is a rate error: there it is the
        gain.
        """
        if "rate" not in signals:
            return jnp.full_like(signals["time"], self.gain())
        rate = signals["rate"]
        slope = jax.jvp(lambda r: self.predict({**signals, "rate": r}), (rate,), (jnp.ones_like(rate),))[1]
        return jnp.where(jnp.abs(slope) < DEAD * jnp.abs(self.gain()), self.gain(), slope)

    def columns_at(self, signals: Signals) -> Callable[..., Float[Array | np.ndarray, "sample coefficient"]]:
        """What gives an effect's columns: the output's derivative by its linear coefficients, in this model or added.

        In NumPy where nothing is traced; of an effect that is to see only some signals, these are given beside it.
        """
        gain, rate, scale = self._sites(signals)
        before = rate * scale
        passed = gain * self.passed(before, signals)
        told, added, scaled = (on_host(x) for x in (gain * self.told(before, signals), passed * scale, passed * rate))

        def columns(effect: Effect, seen: Signals = signals) -> Float[Array | np.ndarray, "sample coefficient"]:
            if effect.site == "gain":
                return (told / on_host(effect.value))[:, None]  # type: ignore[attr-defined]
            if effect.site == "output":
                return on_host(gain) * on_host(effect.columns({**seen, "rate": before}))
            weight = added if effect.site in ADDED else scaled
            return weight[:, None] * on_host(effect.columns(seen))

        return columns

    def steady_columns(self, signals: Signals) -> dict[int, np.ndarray]:
        """Columns that no parameter changes, by the place of their effect in the model."""
        return {
            i: np.asarray(evaluate(effect, signals)[0])
            for i, effect in enumerate(self.effects)
            if effect.site not in LATER and all(each.linear for each in effect.declared().values())
        }

    def linearise(
        self, signals: Signals, steady: Mapping[int, np.ndarray] | None = None
    ) -> tuple[Float[Array | np.ndarray, " sample"], Float[Array | np.ndarray, "sample parameter"]]:
        """The prediction and its Jacobian by the free parameters: columns, and one jvp per nonlinear parameter.

        In NumPy where nothing is traced. `steady` are the signals' `steady_columns`, where they are at hand.
        """
        rate = on_host(signals.get("rate", jnp.zeros_like(signals["time"])))
        scale = 1.0 + 0.0 * rate
        pieces: dict[int, Any] = {}
        for i, effect in enumerate(self.effects):
            if effect.site in LATER:
                continue
            if steady is not None and i in steady:
                pieces[i] = [steady[i], steady[i][:, :0], steady[i] @ on_host(effect.linear())]
            else:
                pieces[i] = [on_host(x) for x in evaluate(effect, signals)]
            if effect.site in ADDED:
                rate = rate + pieces[i][2]
            else:
                scale = scale + pieces[i][2]
        gain, told, passed = on_host(self.gain()), rate * scale, 1.0
        for i, effect in enumerate(self.effects):
            if effect.site == "output":
                passed = on_host(self.passed(told, signals))
                pieces[i] = [on_host(x) for x in evaluate(effect, {**signals, "rate": jnp.asarray(told)})]
                told = told + pieces[i][2]
        prediction = gain * told
        by = {"scale": gain * rate * passed, "output": gain + 0.0 * rate}
        by |= dict.fromkeys(ADDED, gain * scale * passed)
        columns = []
        for i, name in self._fields():
            effect = self.effects[i]
            if effect.site == "gain":
                columns.append((prediction / on_host(effect.value))[:, None])  # type: ignore[attr-defined]
                continue
            linear = effect.declared()[name].linear
            alike = [k for k, declared in effect.declared().items() if declared.linear == linear]
            first = sum(np.size(getattr(effect, k)) for k in alike[: alike.index(name)])
            part = pieces[i][0 if linear else 1][:, first : first + np.size(getattr(effect, name))]
            columns.append(by[effect.site][:, None] * part)
        if not columns:
            return prediction, np.zeros((prediction.shape[0], 0))
        return prediction, (np if isinstance(prediction, np.ndarray) else jnp).concatenate(columns, axis=1)


def on_host(values: Any) -> Any:
    """Values as a NumPy array, where small steps are quick; what JAX is tracing stays as it is."""
    return values if isinstance(values, Tracer) else np.asarray(values)


def effect_class(label: str) -> type[Effect]:
    """The catalogue class of a public id; bias_<column> is a linear driver."""
    if label in CATALOGUE and label != "bias_column":
        return CATALOGUE[label]
    if label.startswith("bias_") and label not in ("bias_", "bias_column"):
        return BiasColumn
    close = get_close_matches(label, CATALOGUE.keys() - {"bias_column"}, n=3, cutoff=0.4)
    hint = f"did you mean {' or '.join(close)}? " if close else ""
    raise ModelError(
        f"unknown effect {label}; {hint}`gyromodel effects` lists the catalogue, and bias_<column> is for any column"
    )


def make_effect(label: str) -> Effect:
    """A catalogue effect at its default values."""
    kind = effect_class(label)
    return kind(column=column_of(label)) if kind is BiasColumn else kind()  # type: ignore[call-arg]


def model_from_effects(labels: Iterable[str], gyro: str = "") -> GyroModel:
    """A model of the named effects with every parameter free and the noise to be estimated.

    Args:
        labels: names of the catalogue; bias_<column> of any other column.
        gyro: what kind of gyro it is, as a word.

    Raises:
        ModelError: an effect is not known, or named twice.
    """
    return GyroModel(tuple(make_effect(label) for label in labels), gyro=gyro)
