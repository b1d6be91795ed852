"""`Effect`: one physical error source, as columns for its linear coefficients; and the registry that finds them all."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, ClassVar, Literal, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from gyromodel._checks import accelerations, thermometers

Signals = Mapping[str, Float[Array, " sample"]]
Site = Literal["gain", "scale", "rate", "output", "readout", "angle"]
Domain = Literal["gyro", "platform"]
# In `needs`: any thermometer besides `temperature`, and any column of specific force. Columns of which one is enough
# are joined by " or ".
SECOND_THERMOMETER, ANY_ACCELERATION = "temperature_<place>", "acceleration_<axis>"
# … and the angles of a vibration test, which effects of a platform see in parts of their own.
TABLE_ANGLES, GIMBAL_ANGLES = "table_<axis>", "gimbal_<axis>"
# Prior odds on what every gyro has, against what some have.
EVERY_GYRO = 5.0


@dataclass(frozen=True)
class Parameter:
    """What a parameter field declares."""

    unit: str
    typical: float
    meaning: str
    linear: bool


def parameter(unit: str, typical: float, meaning: str, *, linear: bool = True, default: Any = 0.0) -> Any:
    """Declare a parameter field.

    Args:
        unit: unit of the value in files and reports.
        typical: usual size in that unit; scales priors and steps.
        meaning: one line.
        linear: whether the contribution is linear in it; a nonlinear one shapes the columns.
        default: start value; zero for an amplitude, so that the effect is absent until fitted.
    """
    return eqx.field(
        converter=lambda v: jnp.asarray(v, float),
        default_factory=lambda: default,
        metadata={"parameter": Parameter(unit, typical, meaning, linear)},
    )


def setting() -> Any:
    """Declare a field that shapes the columns and is not fitted; NaN until the campaign or the model file sets it."""
    return eqx.field(converter=lambda v: jnp.asarray(v, float), default_factory=lambda: jnp.nan)


CATALOGUE: dict[str, type[Effect]] = {}


class Effect(eqx.Module):
    """One additive term of the gyro model.

    `site` says where it acts in output = gain · (u + output terms), u = (rate + Σ rate terms) · (1 + Σ scale terms): to
    an output term, u is the signal "rate"; a readout effect is how the output, noise and all, is read. `domain` says
    whose output it is: that of a gyro, or the angle of a platform's base less that of its table, a sum of angle terms
    alone. Fields
    declared with `parameter` are its parameters. `columns` returns one column per linear coefficient, in field order,
    and may depend on the nonlinear ones; the contribution is columns @ coefficients, so zero coefficients are exactly
    the model without it.
    `supersedes` lists effects that this one contains as a special case; `held` the fields that physics
    or the search fixes; `positive` says that no coefficient can be negative; `whole` names the coefficient of which the
    coefficients `part` are shares, from none to all; `scan` names a fast search over
    every epoch or frequency; `untested` says why a campaign leaves it no `candidates`; `remembers` that a sample's
    contribution depends on its neighbours in time; `reach` is the largest amplitude (internal units) of an effect that
    continues others; `odds` are the prior odds on it against any other effect, and against nothing.
    """

    id: ClassVar[str]
    site: ClassVar[Site]
    domain: ClassVar[Domain] = "gyro"
    needs: ClassVar[tuple[str, ...]]
    cause: ClassVar[str]
    test: ClassVar[str]
    supersedes: ClassVar[tuple[str, ...]] = ()
    held: ClassVar[tuple[str, ...]] = ()
    positive: ClassVar[bool] = False
    whole: ClassVar[str] = ""
    scan: ClassVar[Literal["", "step", "line"]] = ""
    untested: ClassVar[str] = "its driver does not vary"
    remembers: ClassVar[bool] = False
    reach: ClassVar[float] = np.inf
    odds: ClassVar[float] = 1.0

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        if "id" in cls.__dict__:
            CATALOGUE[cls.id] = cls

    @property
    def label(self) -> str:
        """The public id of this instance."""
        return self.id

    @property
    def may_grow(self) -> bool:
        """Whether a model that has it may have more of it."""
        return self.label in self.supersedes

    @property
    def grown(self) -> bool:
        """Whether this is a form that is tried only where the model has the effect in another one."""
        return False

    @property
    def columns_needed(self) -> tuple[str, ...]:
        """The campaign columns this instance reads."""
        return self.needs

    def columns(self, signals: Signals) -> Float[Array, "sample coefficient"]:
        """Columns of the linear coefficients, each the contribution per unit coefficient in internal units."""
        raise NotImplementedError

    def prepared(self, signals: Signals) -> Self:
        """A copy with reference points and start values that depend on the campaign filled in."""
        return self

    @classmethod
    def candidates(cls, signals: Signals) -> list[Self]:
        """The forms the search tries, at zero amplitude: every variant, every grid point of nonlinear parameters."""
        return [cls().prepared(signals)]

    @classmethod
    def hidden(cls, signals: Signals) -> str:
        """What part of a searched effect a campaign cannot show, and why; empty if none."""
        return ""

    @classmethod
    def continuing(cls, effects: Sequence[Effect], signals: Signals) -> Self | None:
        """The effect grown from those of a model, whose sum it is where its last nonlinear parameter is zero.

        That parameter is then its amplitude. None where the model has nothing to grow from.
        """
        return None

    def grown_by(self, amplitude: Float[Array, ""]) -> Self:
        """This effect, which continues others, at an amplitude; ValueError beyond what it can be."""
        return replace(self, **{self.amplitude_name(): amplitude})

    def wider(self) -> Self | None:
        """The form with more parameters, if any, that is fitted once this one has been found."""
        return None

    @property
    def structure(self) -> str:
        """What sets searched forms with equally many parameters apart, as no two shapes of one form are."""
        return ""

    @property
    def beyond_reach(self) -> bool:
        """Whether this effect, if it continues others, has a larger amplitude than any that is believed."""
        return bool(np.isfinite(self.reach) and abs(getattr(self, self.amplitude_name())) > self.reach)

    def amplitude_name(self) -> str:
        """The parameter that is the amplitude of what continues others."""
        return [k for k, declared in self.declared().items() if not declared.linear][-1]

    @classmethod
    def declared(cls) -> dict[str, Parameter]:
        """Parameter declarations by field name."""
        return {f.name: f.metadata["parameter"] for f in fields(cls) if "parameter" in f.metadata}

    def leading(self) -> str:
        """The linear parameter that sizes are told of: the first, or, where that has no entries, the next."""
        linear = [name for name, declared in self.declared().items() if declared.linear]
        return next((name for name in linear if np.size(getattr(self, name))), linear[0])

    @classmethod
    def settings(cls) -> tuple[str, ...]:
        """Fields that are neither parameters nor the column and unit of a driver."""
        return tuple(f.name for f in fields(cls) if f.name not in (*cls.declared(), "column", "unit"))

    def least(self, signals: Signals) -> float:
        """The smallest coefficient with which a `positive` form means anything: a share of one, say, not of 1e-3."""
        return 0.0

    def leaves(self, signals: Signals) -> float:
        """Size (internal units) of what its columns may leave of it, for which other effects must not be taken."""
        return 0.0

    def unknown(self, signals: Signals) -> Bool[Array, " sample"]:
        """Samples at which what was before the record, or in a gap, still shows, so that its columns may err there."""
        return jnp.zeros(len(signals["time"]), bool)

    def joined(self, held: Effect) -> Self:
        """What takes the place of one that it supersedes where a model holds that, without coefficients."""
        return self

    def settled(self) -> Self:
        """The form to fit once the search has chosen this one; fields in `held` are left as they are here."""
        return self

    def linear(self) -> Float[Array, " coefficient"]:
        """Linear coefficients, flattened in field order."""
        values = [jnp.ravel(getattr(self, k)) for k, p in self.declared().items() if p.linear]
        return jnp.concatenate(values) if values else jnp.zeros(0)

    def with_linear(self, coefficients: Float[Array, " coefficient"]) -> Self:
        """The same shapes at other linear coefficients."""
        changed, start = self, 0
        for name, declared in self.declared().items():
            if declared.linear:
                old = getattr(self, name)
                new = jnp.reshape(jnp.asarray(coefficients)[start : start + jnp.size(old)], jnp.shape(old))
                changed = eqx.tree_at(lambda e, name=name: getattr(e, name), changed, new)
                start += jnp.size(old)
        return changed

    def contribution(self, signals: Signals) -> Float[Array, " sample"]:
        """The effect's term, in rad/s for sites "rate" and "output", rad for "angle", dimensionless for "scale"."""
        return self.columns(signals) @ self.linear()

    def shape_derivatives(self, signals: Signals) -> Float[Array, "sample shape"]:
        """Derivative of the contribution by each nonlinear parameter, in field order: by default one jvp for each."""
        derivatives = []
        for name, declared in self.declared().items():
            if declared.linear:
                continue
            value = getattr(self, name)

            def moved(v, name=name, value=value):
                changed = eqx.tree_at(lambda e: getattr(e, name), self, jnp.reshape(v, jnp.shape(value)))
                # Not a product of matrices, for which the compiler would put the columns together twice.
                columns = changed.columns(signals)
                return sum((a * columns[:, i] for i, a in enumerate(changed.linear())), jnp.zeros(len(columns)))

            for direction in jnp.eye(jnp.size(value)):
                derivatives.append(jax.jvp(moved, (jnp.ravel(value),), (direction,))[1])
        return jnp.stack(derivatives, axis=1) if derivatives else jnp.zeros((signals["time"].shape[0], 0))


def lacking(needed: Iterable[str], signals: Signals) -> list[str]:
    """Columns needed that the signals lack.

    temperature_<place> stands for any second thermometer; several campaigns are a run each.
    """
    needed = [each for each in needed if each not in signals]
    if not needed:
        return []
    groups = {SECOND_THERMOMETER: len(thermometers(signals)) > 1, ANY_ACCELERATION: bool(accelerations(signals))}
    groups["run"] = "run" in signals or "campaign" in signals
    groups |= dict.fromkeys((TABLE_ANGLES, GIMBAL_ANGLES), "_frequency" in signals)
    return [each for each in needed if not any(groups.get(n, n in signals) for n in each.split(" or "))]


@eqx.filter_jit
def evaluate(
    effect: Effect, signals: Signals
) -> tuple[Float[Array, "sample coefficient"], Float[Array, "sample shape"], Float[Array, " sample"]]:
    """An effect's columns, the derivative of its contribution by its nonlinear parameters, and the contribution itself.

    Compiled once per effect class and shape, whatever model the effect stands in.
    """
    columns = effect.columns(signals)
    return columns, effect.shape_derivatives(signals), columns @ effect.linear()


def stack(*columns: Float[Array, " sample"]) -> Float[Array, "sample coefficient"]:
    """Columns side by side."""
    return jnp.stack(columns, axis=1)


def round_reference(values: Float[Array, " sample"], step: float = 1.0) -> Float[Array, ""]:
    """Mean rounded to a readable reference point."""
    known = np.asarray(values)[np.isfinite(values)]
    return jnp.asarray(np.round(known.mean() / step) * step if len(known) else np.nan)
