"""Bias effects of temperature."""

from __future__ import annotations

import dataclasses
import itertools
from typing import Self

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from gyromodel._checks import thermometers
from gyromodel.effects._base import Effect, Signals, parameter, stack
from gyromodel.effects._shapes import OverTemperature, check_curve, curve_columns, curve_forms
from gyromodel.effects.dynamics import interval, rate_behind, remembered, resolved

# Time constants after which nothing of a warm-up is left.
LONG_OVER = 12.0
# The longest lag of a coil that is searched, as a part of the run, and the ratio of one to the next.
LONGEST, NEXT = 0.1, 1.7


class BiasTemperature(OverTemperature):
    """E += D_T (T − T0): bias proportional to temperature."""

    id = "bias_temperature"
    site = "rate"
    needs = ("temperature",)
    cause = "Electronics offsets, torques or optical losses change with temperature."
    test = "Heat and then cool: a drift in time does not come back."

    coefficient: Float[Array, ""] = parameter("deg/h/degC", 1.0, "bias change per degree")

    def columns(self, signals: Signals) -> Float[Array, "sample coefficient"]:
        """T − T0."""
        return stack(signals["temperature"] - self.reference)


class BiasTemperatureCurve(OverTemperature):
    """E += Σ a_i ((T − T0)/10 °C)^i + Σ h_j max(T − T_j, 0): bias curved over temperature."""

    id = "bias_temperature_curve"
    site = "rate"
    needs = ("temperature",)
    cause = "Several temperature-dependent offsets add up, or one changes regime at a breakpoint."
    test = "A second start at another temperature separates warm-up; an independent thermometer separates its error."
    supersedes = ("bias_temperature",)

    coefficients: Float[Array, " order"] = parameter("deg/h", 1.0, "power i: bias per (10 °C)^i", default=(0.0, 0.0))
    hinges: Float[Array, " hinge"] = parameter("deg/h/degC", 1.0, "change of slope at each breakpoint", default=())
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


class BiasTemperatureRate(Effect):
    """E += D_Ṫ dT/dt: the Shupe effect; T of the place that `thermometer` names, else `temperature`.

    With a lag, of a coil that follows the thermometer through one. Of several lags, each delays a part of it:
    E += D_Ṫ L_0 + Σ D_k (L_k − L_0), L_k the rate dT/dt behind the lag k, so that D_Ṫ is always the bias on a steady
    ramp. A lag below zero says that the thermometer is later than the coil. Heat that diffuses into a coil makes all of
    the parts of one sign.
    """

    id = "bias_temperature_rate"
    site = "rate"
    needs = ("temperature",)
    cause = "A temperature front crossing the fiber coil shifts the two counter-propagating phases unequally."
    test = "Two ramp speeds: this error grows with the speed, thermal hysteresis does not."
    supersedes = ("bias_temperature_rate",)
    whole = "coefficient"

    coefficient: Float[Array, ""] = parameter("deg/h/(degC/s)", 1000.0, "bias per unit of temperature rate")
    part: Float[Array, " part"] = parameter("deg/h/(degC/s)", 1000.0, "what of it has each further lag", default=())
    lag: Float[Array, " lag"] = parameter("s", 60.0, "how late the coil is", linear=False, default=())
    thermometer: str = eqx.field(static=True, default="", kw_only=True)

    def __check_init__(self) -> None:
        if np.size(self.part) != max(np.size(self.lag) - 1, 0):
            raise ValueError("part takes a value for each lag after the first")
        if not thermometers((self.thermometer or "temperature",)):
            raise ValueError("thermometer takes the name of one, temperature or temperature_<place>")

    @property
    def columns_needed(self) -> tuple[str, ...]:
        """The thermometer."""
        return (self.thermometer or "temperature",)

    @property
    def remembers(self) -> bool:
        """Where it lags."""
        return np.size(self.lag) > 0

    @property
    def may_grow(self) -> bool:
        """By further lags, but not where the place was chosen."""
        return not self.thermometer

    def columns(self, signals: Signals) -> Float[Array, "sample coefficient"]:
        """dT/dt of the smoothed thermometer behind the first lag, then what each other lag changes in that."""
        name = self.thermometer or "temperature"
        rate = signals[f"{name}_rate"]
        late = [rate_behind(signals["time"], signals[name], rate, lag) for lag in self.lag] or [rate]
        return stack(late[0], *(other - late[0] for other in late[1:]))

    def unknown(self, signals: Signals) -> Bool[Array, " sample"]:
        """The first time constants of a lag, as only a steady ramp before them is allowed for."""
        return remembered(signals["time"], jnp.max(self.lag)) if self.remembers else super().unknown(signals)

    def joined(self, held: Effect) -> Self:
        """The lags of both, none being a lag of zero where the other has any; of a special case, its own."""
        if not held.remembers:
            return self
        more = () if held.label != self.label else self.lag if self.remembers else (0.0,)
        lags = (*held.lag, *more)  # type: ignore[attr-defined]
        return dataclasses.replace(self, lag=lags, part=np.zeros(len(lags) - 1))

    @classmethod
    def candidates(cls, signals: Signals) -> list[Self]:
        """Every thermometer that varies, `temperature` first; with one alone, lags of what it is not fixed to."""
        varying = [n for n in thermometers(signals) if np.ptp(np.asarray(signals[n])) > 0]
        if len(varying) > 1:
            return [cls(thermometer=n) for n in varying]
        return [cls(lag=lag) for lag in _lags(signals)]


def _lags(signals: Signals) -> list[Array]:
    """None, then each from the sample interval to a part of the run, where the rate is followed so closely."""
    shortest, longest = interval(signals), LONGEST * float(np.ptp(np.asarray(signals["time"])))
    if longest < shortest or not resolved(signals, "temperature_rate"):
        return [jnp.zeros(0)]
    number = 1 + int(np.log(longest / shortest) / np.log(NEXT))
    return [jnp.zeros(0), *jnp.geomspace(shortest, longest, number)[:, None]]


class BiasTemperatureProduct(OverTemperature, BiasTemperatureRate):
    """E += (D (T − T0) + D_0) dT/dt: a Shupe effect that changes with temperature, with lags like the Shupe effect.

    A model without D_0 has it zero at T0; the search estimates where it is zero.
    """

    id = "bias_temperature_product"
    cause = (
        "The fiber's thermal coefficients change with temperature, and its response to a temperature front with them."
    )
    test = "The same ramp at a low and at a high temperature: the Shupe effect is the same in both, this is not."
    supersedes = ("bias_temperature_rate", "bias_temperature_product")
    whole = "at_reference"

    coefficient: Float[Array, ""] = parameter("deg/h/(degC^2/s)", 30.0, "change of the Shupe coefficient per degree")
    at_reference: Float[Array, " reference"] = parameter(
        "deg/h/(degC/s)", 1000.0, "the Shupe coefficient at the reference temperature", default=()
    )

    @property
    def grown(self) -> bool:
        """With a lag: a product of two factors that both may lag imitates too much to begin with."""
        return self.remembers

    def columns(self, signals: Signals) -> Float[Array, "sample coefficient"]:
        """(T − T0) dT/dt, what each further lag changes in dT/dt, and dT/dt if it is not zero at T0."""
        late = super().columns(signals)
        product = (signals["temperature"] - self.reference) * late[:, 0]
        return jnp.column_stack([product, late[:, 1:], late[:, : np.size(self.at_reference)]])

    @classmethod
    def candidates(cls, signals: Signals) -> list[Self]:
        """Zero at the mean temperature, and at any, then with lags as the Shupe effect has them."""
        anywhere = [cls(at_reference=jnp.zeros(1), lag=lag) for lag in _lags(signals)]
        return [form.prepared(signals) for form in [cls(), *anywhere]]


class _BetweenThermometers(Effect):
    """An effect of the difference of two thermometers, of places named in `between`; the first two if empty."""

    between: tuple[str, str] = eqx.field(static=True, default=("", ""), kw_only=True)

    def __check_init__(self) -> None:
        if len(set(self.between)) != 2 and any(self.between):
            raise ValueError("between takes the names of two thermometers")

    @property
    def columns_needed(self) -> tuple[str, ...]:
        """The two thermometers."""
        return self.between if any(self.between) else self.needs

    def prepared(self, signals: Signals) -> Self:
        """Take the first two thermometers: `temperature`, then the others by name."""
        if any(self.between):
            return self
        first, second = thermometers(signals)[:2]
        return dataclasses.replace(self, between=(first, second))

    @classmethod
    def candidates(cls, signals: Signals) -> list[Self]:
        """Every pair of thermometers whose difference is known and varies."""
        pairs = itertools.combinations(thermometers(signals), 2)
        return [cls(between=(a, b)) for a, b in pairs if np.ptp(np.asarray(signals[a] - signals[b])) > 0]


class BiasTemperatureGradient(_BetweenThermometers):
    """E += D_∇T (T1 − T2): bias proportional to the temperature difference between two places."""

    id = "bias_temperature_gradient"
    site = "rate"
    needs = ("temperature", "temperature_<place>")
    cause = "A temperature difference across the coil or between coil and electronics strains them or shifts an offset."
    test = (
        "Watch a soak recover: the difference fades more slowly than the temperature rate that drives the Shupe effect."
    )

    coefficient: Float[Array, ""] = parameter("deg/h/degC", 1.0, "bias per degree of difference")

    def columns(self, signals: Signals) -> Float[Array, "sample coefficient"]:
        """T1 − T2."""
        first, second = self.between
        return stack(signals[first] - signals[second])


class BiasTemperatureGradientRate(_BetweenThermometers):
    """E += D_∇Ṫ d(T1 − T2)/dt: bias proportional to the rate of the difference between two places."""

    id = "bias_temperature_gradient_rate"
    site = "rate"
    needs = ("temperature", "temperature_<place>")
    cause = "A changing temperature gradient along the fiber unbalances the two counter-propagating phases."
    test = "Compare the edges of ramps with their plateaus: this error comes at the edges only."

    coefficient: Float[Array, ""] = parameter("deg/h/(degC/s)", 1000.0, "bias per unit of the difference's rate")

    def columns(self, signals: Signals) -> Float[Array, "sample coefficient"]:
        """Difference of dT/dt of the two smoothed thermometers."""
        first, second = self.between
        return stack(signals[f"{first}_rate"] - signals[f"{second}_rate"])


class BiasWarmup(Effect):
    """E += Σ A_i exp(−t/τ_i), t from power-on, anew in each run behind a gap; as many terms as the data ask for."""

    id = "bias_warmup"
    site = "rate"
    needs = ("time",)
    cause = "Electronics, source or coil settle after power-on."
    test = "Repeat the start: a warm-up comes back, a random walk does not."
    untested = "the run begins so long after power-on that what could be seen to decay in it has decayed before"
    supersedes = ("bias_warmup",)

    amplitude: Float[Array, " term"] = parameter("deg/h", 1.0, "bias of each term at power-on", default=(0.0,))
    time_constant: Float[Array, " term"] = parameter("s", 600.0, "their decay times", linear=False, default=(600.0,))

    def __post_init__(self) -> None:
        given = (self.amplitude, self.time_constant)
        self.amplitude, self.time_constant = (jnp.atleast_1d(jnp.asarray(v, float)) for v in given)

    def __check_init__(self) -> None:
        if self.amplitude.shape != self.time_constant.shape or not self.amplitude.size:
            raise ValueError("every amplitude has a time constant, and there is one at least")
        if (self.time_constant <= 0).any():
            raise ValueError("a time constant is above zero")

    def columns(self, signals: Signals) -> Float[Array, "sample coefficient"]:
        """The decays."""
        return jnp.exp(-signals["time_on"][:, None] / self.time_constant)

    def joined(self, held: Effect) -> Self:
        """The terms of both."""
        both = jnp.concatenate([held.time_constant, self.time_constant])  # type: ignore[attr-defined]
        return type(self)(amplitude=jnp.zeros(both.size), time_constant=both)

    @classmethod
    def candidates(cls, signals: Signals) -> list[Self]:
        """Time constants from some samples to the whole run, of which something is left when the run begins."""
        on = np.asarray(signals["time_on"])
        span = float(on.max() - on.min())
        shortest = max(span / 200.0, 2.0 * float(np.median(np.diff(on))), float(on.min()) / LONG_OVER)
        if not 0.0 < shortest <= span:
            return []
        return [cls(time_constant=tau) for tau in np.geomspace(shortest, span, 14)[:, None]]
