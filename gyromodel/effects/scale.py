"""Scale-factor effects: the gain itself and the terms of its relative error."""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from gyromodel.effects._base import EVERY_GYRO, Effect, Signals, parameter, setting, stack
from gyromodel.effects._shapes import EARTHLY, OverTemperature, beyond_earth, check_curve, curve_columns, curve_forms

# Splines are searched with even knots, and in so many ways with inner knots moved by up to so many hundredths of their
# distance.
UNEVEN, MOVED = 8, 30


class ScaleFactor(Effect):
    """output = S0 · (rate + …): the gain from input rate to output.

    `unit` is what the value was written in, "1" for a plain number; empty, it follows the campaign's output.
    """

    id = "scale_factor"
    site = "gain"
    needs = ("rate",)
    cause = "The optical or mechanical gain differs from the nominal one."
    odds = EVERY_GYRO
    test = "Calibrate the rate table against a second reference: its rate error looks the same."

    value: Float[Array, ""] = parameter("1", 1.0, "output per unit of input rate", default=jnp.nan)
    unit: str = eqx.field(static=True, default="")

    def prepared(self, signals: Signals) -> Self:
        """Start at the slope of output over rate."""
        if np.isfinite(float(self.value)):
            return self
        rate, output = (np.asarray(signals[k]) for k in ("rate", "output"))
        good = np.isfinite(output)
        centred = rate[good] - rate[good].mean()
        energy = float(centred @ centred)
        slope = float(centred @ output[good]) / energy if energy > 0 else 1.0
        return eqx.tree_at(lambda e: e.value, self, jnp.asarray(slope if slope != 0 else 1.0, float))


class ScaleAsymmetry(Effect):
    """ε += ½ ε_a sgn(rate): the scale factor differs between the two senses of rotation."""

    id = "scale_asymmetry"
    site = "scale"
    needs = ("rate",)
    cause = "The torquer or the optical path responds differently to the two senses of rotation."
    test = "More rates of each sign, and rest: an even nonlinearity bends, an asymmetry does not."

    difference: Float[Array, ""] = parameter("ppm", 100.0, "scale factor at positive minus at negative rates")

    def columns(self, signals: Signals) -> Float[Array, "sample coefficient"]:
        """Half the sign of the rate."""
        return stack(0.5 * jnp.sign(signals["rate"]))


class ScaleNonlinearity(Effect):
    """rate·ε = Σ k_i rate^i, i = 2…5: polynomial output error.

    `powers` lists other i.
    """

    id = "scale_nonlinearity"
    site = "scale"
    needs = ("rate",)
    cause = "The readout electronics, the modulation depth or the table response bends the input-output curve."
    untested = EARTHLY
    test = "Run the rates in random order: self-heating at speed follows time, a nonlinearity follows rate."

    coefficients: Float[Array, " term"] = parameter(
        "ppm", 100.0, "each power's part of the output at full_rate, of it", default=()
    )
    powers: tuple[int, ...] = eqx.field(static=True, default=(2, 3, 4, 5))
    full_rate: Float[Array, ""] = setting()

    def __post_init__(self) -> None:
        if np.size(self.coefficients) == 0:
            self.coefficients = jnp.zeros(len(self.powers))

    def __check_init__(self) -> None:
        if not self.powers or min(self.powers) < 2 or len(set(self.powers)) < len(self.powers):
            raise ValueError("powers of the rate are different whole numbers from 2 on")
        if self.coefficients.shape != (len(self.powers),):
            raise ValueError(f"{len(self.powers)} powers need as many coefficients")

    @property
    def structure(self) -> str:
        """Its powers."""
        return str(self.powers)

    def columns(self, signals: Signals) -> Float[Array, "sample coefficient"]:
        """(rate/full_rate)^(i-1): times the rate, the output error of power i."""
        x = signals["rate"] / self.full_rate
        return stack(*(x ** (i - 1) for i in self.powers))

    def prepared(self, signals: Signals) -> Self:
        """Express the coefficients at the largest rate of the campaign."""
        if np.isfinite(float(self.full_rate)):
            return self
        top = jnp.nanmax(jnp.abs(signals["rate"]))
        return eqx.tree_at(lambda e: e.full_rate, self, jnp.where(top > 0, top, 1.0))

    @classmethod
    def candidates(cls, signals: Signals) -> list[Self]:
        """Every set of powers."""
        sets = [s for r in (1, 2, 3, 4) for s in itertools.combinations((2, 3, 4, 5), r)]
        return [cls(powers=s).prepared(signals) for s in sets] if beyond_earth(signals) else []


class ScaleSagnacSine(Effect):
    """ε += a·[sin(κ·rate) − κ·rate]/(κ·rate): the sine of an open-loop interferometer, a = 1.

    The search lets a vary to have a linear coefficient; the fit holds it at one and estimates κ.
    """

    id = "scale_sagnac_sine"
    site = "scale"
    needs = ("rate",)
    cause = "An open-loop fiber-optic gyro measures the sine of the Sagnac phase, and the simulation has it linear."
    held = ("share",)
    positive = True
    untested = EARTHLY
    test = "Drive it to rates where the Sagnac phase passes 1 rad: a cubic nonlinearity parts from the sine there."

    share: Float[Array, ""] = parameter("1", 1.0, "part of the output that follows the sine", default=1.0)
    kappa: Float[Array, ""] = parameter("s/rad", 0.1, "Sagnac phase per unit rate", linear=False, default=0.1)

    def columns(self, signals: Signals) -> Float[Array, "sample coefficient"]:
        """sinc(κ·rate) − 1, by its series near zero."""
        phase = self.kappa * signals["rate"]
        small = jnp.abs(phase) < 1e-2
        safe = jnp.where(small, 1.0, phase)
        series = -(phase**2) / 6.0 + phase**4 / 120.0
        return stack(jnp.where(small, series, jnp.sin(safe) / safe - 1.0))

    def settled(self) -> Self:
        """Full sine, with the κ that has the same cubic term."""
        kappa = self.kappa * jnp.sqrt(jnp.maximum(self.share, 1e-6))
        return type(self)(share=jnp.ones(()), kappa=kappa)

    @classmethod
    def candidates(cls, signals: Signals) -> list[Self]:
        """Sagnac phases of 0.1 to 3 rad at the largest rate."""
        top = float(jnp.nanmax(jnp.abs(signals["rate"])))
        return (
            [cls(kappa=phase / top) for phase in np.geomspace(0.1, 3.0, 12)]
            if top > 0 and beyond_earth(signals)
            else []
        )


class ScaleTemperature(OverTemperature):
    """ε += ε_T (T − T0): scale factor proportional to temperature."""

    id = "scale_temperature"
    site = "scale"
    needs = ("rate", "temperature")
    cause = "Wavelength, coil area, magnet strength or electronics gain change with temperature."
    test = "Positive and negative rates at each temperature: a bias over temperature does not change sign."

    coefficient: Float[Array, ""] = parameter("ppm/degC", 10.0, "relative change per degree")

    def columns(self, signals: Signals) -> Float[Array, "sample coefficient"]:
        """T − T0."""
        return stack(signals["temperature"] - self.reference)


class TorquerScale(OverTemperature):
    """E += (S + ½ S_a sgn i + S_T (T − T0)) i: error of the rate that each unit of the torquer current i stands for.

    A rate-integrating gyro is held, or driven, by the torque of this current. Each list has one coefficient or none.
    Where the current keeps to the input rate, this is an error of the scale factor, and no size of it tells which.
    """

    id = "torquer_scale"
    site = "rate"
    needs = ("torquer_current",)
    cause = (
        "The torquer's magnet or coil gives another torque per ampere, by its sense or temperature, than is assumed."
    )
    test = "Turn the table at one torquer current, and torque at one table rate: this error follows the current alone."
    supersedes = ("torquer_scale",)

    scale: Float[Array, " scale"] = parameter(
        "deg/h/mA", 1e-3, "rate per unit of current, less the nominal one", default=()
    )
    asymmetry: Float[Array, " sense"] = parameter(
        "deg/h/mA", 1e-3, "of positive less that of negative currents", default=()
    )
    temperature: Float[Array, " slope"] = parameter("deg/h/mA/degC", 1e-4, "its change per degree", default=())

    def __post_init__(self) -> None:
        if not self._sizes().any():
            self.scale = jnp.zeros(1)

    def __check_init__(self) -> None:
        if self._sizes().max() > 1:
            raise ValueError("scale, asymmetry and temperature are lists of one coefficient or of none")

    def _sizes(self) -> np.ndarray:
        return np.array([np.size(v) for v in (self.scale, self.asymmetry, self.temperature)])

    @property
    def columns_needed(self) -> tuple[str, ...]:
        """The temperature too, where the scale changes with it."""
        return (*self.needs, "temperature") if self.temperature.size else self.needs

    def prepared(self, signals: Signals) -> Self:
        """Refer to the campaign's mean temperature, if it has any."""
        if "temperature" in signals or np.isfinite(float(self.reference)):
            return super().prepared(signals)
        return eqx.tree_at(lambda e: e.reference, self, jnp.zeros(()))

    def columns(self, signals: Signals) -> Float[Array, "sample coefficient"]:
        """i, |i|/2 and (T − T0) i, those that it has."""
        current = signals["torquer_current"]
        each = [current] * self.scale.size + [0.5 * jnp.abs(current)] * self.asymmetry.size
        return stack(*each, *([(signals["temperature"] - self.reference) * current] * self.temperature.size))

    def joined(self, held: Effect) -> Self:
        """All coefficients that either has."""
        sizes = np.maximum(self._sizes(), held._sizes())  # type: ignore[attr-defined]
        scale, asymmetry, temperature = (jnp.zeros(int(size)) for size in sizes)
        return type(self)(scale=scale, asymmetry=asymmetry, temperature=temperature, reference=self.reference)

    @classmethod
    def candidates(cls, signals: Signals) -> list[Self]:
        """One coefficient at a time, as those of the scale factor are that it may be taken for; more may be added."""
        terms = ["scale", "asymmetry"]
        if "temperature" in signals and np.ptp(np.asarray(signals["temperature"])) > 0:
            terms.append("temperature")
        return [cls(**{term: jnp.zeros(1)}).prepared(signals) for term in terms]


class ScaleDrift(Effect):
    """ε += R t: scale factor drifting in proportion to time."""

    id = "scale_drift"
    site = "scale"
    needs = ("rate", "time")
    cause = "Source wavelength, magnet or electronics gain age or settle."
    test = "Repeat the run at another temperature: what follows temperature does not keep its slope over time."

    slope: Float[Array, ""] = parameter("ppm/h", 10.0, "relative change per unit of time")

    def columns(self, signals: Signals) -> Float[Array, "sample coefficient"]:
        """Time since the start."""
        return stack(signals["time"])


class ScaleTemperatureCurve(OverTemperature):
    """ε += Σ a_i ((T − T0)/10 °C)^i + Σ h_j max(T − T_j, 0): scale factor curved over temperature."""

    id = "scale_temperature_curve"
    site = "scale"
    needs = ("rate", "temperature")
    cause = "Source wavelength, optical power or magnet strength bend over temperature or change regime."
    test = "An independent thermometer: a thermometer error puts the same ripple into every term."
    supersedes = ("scale_temperature",)

    coefficients: Float[Array, " order"] = parameter("ppm", 100.0, "power i: part per (10 °C)^i", default=(0.0, 0.0))
    hinges: Float[Array, " hinge"] = parameter("ppm/degC", 10.0, "change of slope at each breakpoint", default=())
    breakpoints: Float[Array, " hinge"] = parameter("degC", 10.0, "where the slope changes", linear=False, default=())

    def __check_init__(self) -> None:
        check_curve(self.coefficients, self.hinges, self.breakpoints)

    def columns(self, signals: Signals) -> Float[Array, "sample coefficient"]:
        """Powers of (T − T0)/10 °C, from the first on, then max(T − T_j, 0) of each breakpoint."""
        powers = self.coefficients.shape[0]
        return curve_columns(signals["temperature"], self.reference, powers, self.breakpoints)

    @classmethod
    def candidates(cls, signals: Signals) -> list[Self]:
        """Quadratic, cubic, one hinge, two hinges."""
        return [cls(**form).prepared(signals) for form in curve_forms(signals["temperature"])]


class ScaleSpline(Effect):
    """rate·ε = s(rate), a natural cubic spline with its straight line taken out.

    It has so many `knots`, evenly from `lowest` to `full_rate`, but for what inner ones are `moved` by, in hundredths
    of their distance.
    """

    id = "scale_spline"
    site = "rate"
    needs = ("rate",)
    cause = "The input-output curve bends in a way that no low power of the rate describes."
    test = (
        "Repeat the rates both ways and in random order: anomalous test points and resonances do not come back alike."
    )
    supersedes = ("scale_nonlinearity",)
    odds = 0.1  # what a low power of the rate tells as well is one
    untested = f"has fewer than ten different rates, or {EARTHLY}"

    coefficients: Float[Array, " bend"] = parameter("ppm", 100.0, "bends, as parts of the largest rate", default=())
    knots: int = eqx.field(static=True, default=6)
    moved: tuple[int, ...] = eqx.field(static=True, default=())
    full_rate: Float[Array, ""] = setting()
    lowest: Float[Array, ""] = setting()

    def __post_init__(self) -> None:
        if np.size(self.coefficients) == 0:
            self.coefficients = jnp.zeros(max(self.knots - 2, 0))

    def __check_init__(self) -> None:
        if self.knots < 3 or self.coefficients.shape != (self.knots - 2,):
            raise ValueError("a spline of n knots, three or more, has n - 2 coefficients")
        if self.moved and (len(self.moved) != self.knots - 2 or np.abs(self.moved).max() >= 50):
            raise ValueError("each knot between the outer two is moved by less than 50 hundredths of their distance")

    def columns(self, signals: Signals) -> Float[Array, "sample coefficient"]:
        """Truncated cubes that are straight outside the outer knots, less their tangent at rest.

        Knots are even from `lowest` to `full_rate`, but for what inner ones are `moved` by, in hundredths of their
        distance; with value and slope zero at rest, bias and scale factor keep their meaning.
        """
        places = np.linspace(0.0, 1.0, self.knots)
        places[1:-1] += np.divide(self.moved or 0, 100 * (self.knots - 1))
        return _bends(signals["rate"], self.full_rate, self.lowest, places)

    def prepared(self, signals: Signals) -> Self:
        """Spread the knots over the campaign's rates."""
        if np.isfinite(float(self.full_rate)) and np.isfinite(float(self.lowest)):
            return self
        low, high = jnp.nanmin(signals["rate"]), jnp.nanmax(signals["rate"])
        return eqx.tree_at(lambda e: (e.full_rate, e.lowest), self, (jnp.where(high > low, high, low + 1.0), low))

    @classmethod
    def candidates(cls, signals: Signals) -> list[Self]:
        """Smooth curves of five to seven knots, even and not, where there are rates enough."""
        if not beyond_earth(signals):
            return []
        levels = len(np.unique(np.round(np.asarray(signals["rate"]), 9)))
        able = [cls(knots=k).prepared(signals) for k in (5, 6, 7) if levels >= 2 * k]
        return [replace(e, moved=moved) for e in able for moved in ((), *_moves(e.knots - 2))]


def _moves(count: int) -> list[tuple[int, ...]]:
    """Ways of moving so many knots."""
    return [tuple(map(int, row)) for row in np.random.default_rng(0).integers(-MOVED, MOVED, (UNEVEN, count))]


@jax.jit
def _bends(rate: Array, full_rate: Array, lowest: Array, places: Array) -> Array:
    """`ScaleSpline.columns`, compiled as one."""
    width = full_rate - lowest

    def bends(u):
        cube = jnp.maximum(u[..., None] - places, 0.0) ** 3
        part = (cube[..., :-1] - cube[..., -1:]) / (1.0 - places[:-1])
        return part[..., :-1] - part[..., -1:]

    rest = -lowest / width
    value, slope = jax.jvp(bends, (rest,), (jnp.ones(()),))
    top = jnp.maximum(jnp.abs(full_rate), jnp.abs(lowest))
    return (bends((rate - lowest) / width) - value - slope * rate[:, None] / width) * top
