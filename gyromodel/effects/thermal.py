"""Bias effects of temperature."""

from __future__ import annotations

from typing import Self

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from gyromodel.effects._base import Effect, Signals, parameter, round_reference, setting, stack
from gyromodel.effects._shapes import check_curve, curve_columns, curve_forms


class BiasTemperature(Effect):
    """E += D_T (T − T0): bias proportional to temperature."""

    id = "bias_temperature"
    site = "rate"
    needs = ("temperature",)
    cause = "Electronics offsets, torques or optical losses change with temperature."
    test = "Heat and then cool: a drift in time does not come back."

    coefficient: Float[Array, ""] = parameter("deg/h/degC", 1.0, "bias change per degree")
    reference: Float[Array, ""] = setting()

    def columns(self, signals: Signals) -> Float[Array, "sample coefficient"]:
        """T − T0."""
        return stack(signals["temperature"] - self.reference)

    def prepared(self, signals: Signals) -> Self:
        """Refer to the campaign's mean temperature."""
        if np.isfinite(float(self.reference)):
            return self
        return eqx.tree_at(lambda e: e.reference, self, round_reference(signals["temperature"]))


class BiasTemperatureCurve(Effect):
    """E += Σ a_i (T − T0)^i + Σ h_j max(T − T_j, 0): bias curved over temperature."""

    id = "bias_temperature_curve"
    site = "rate"
    needs = ("temperature",)
    cause = "Several temperature-dependent offsets add up, or one changes regime at a breakpoint."
    test = "A second start at another temperature separates warm-up; an independent thermometer separates its error."
    supersedes = ("bias_temperature",)

    coefficients: Float[Array, " order"] = parameter("deg/h", 1.0, "power i: bias per (10 °C)^i", default=(0.0, 0.0))
    hinges: Float[Array, " hinge"] = parameter("deg/h/degC", 1.0, "change of slope at each breakpoint", default=())
    breakpoints: Float[Array, " hinge"] = parameter("degC", 10.0, "where the slope changes", linear=False, default=())
    reference: Float[Array, ""] = setting()

    def __check_init__(self) -> None:
        check_curve(self.coefficients, self.hinges, self.breakpoints)

    def columns(self, signals: Signals) -> Float[Array, "sample coefficient"]:
        """Powers, then hinges."""
        powers = self.coefficients.shape[0]
        return curve_columns(signals["temperature"], self.reference, powers, self.breakpoints)

    def prepared(self, signals: Signals) -> Self:
        """Refer to the campaign's mean temperature."""
        if np.isfinite(float(self.reference)):
            return self
        return eqx.tree_at(lambda e: e.reference, self, round_reference(signals["temperature"]))

    @classmethod
    def candidates(cls, signals: Signals) -> list[Self]:
        """Quadratic, cubic, one hinge, two hinges."""
        return [cls(**form).prepared(signals) for form in curve_forms(signals["temperature"])]


class BiasTemperatureRate(Effect):
    """E += D_Ṫ dT/dt: the Shupe effect."""

    id = "bias_temperature_rate"
    site = "rate"
    needs = ("temperature",)
    cause = "A temperature front crossing the fiber coil shifts the two counter-propagating phases unequally."
    test = "Two ramp speeds: this error grows with the speed, thermal hysteresis does not."

    coefficient: Float[Array, ""] = parameter("deg/h/(degC/s)", 1000.0, "bias per unit of temperature rate")

    def columns(self, signals: Signals) -> Float[Array, "sample coefficient"]:
        """dT/dt of the smoothed thermometer."""
        return stack(signals["temperature_rate"])


class BiasWarmup(Effect):
    """E += A exp(−t/τ), t from power-on."""

    id = "bias_warmup"
    site = "rate"
    needs = ("time",)
    cause = "Electronics, source or coil settle after power-on."
    test = "Repeat the start: a warm-up comes back, a random walk does not."

    amplitude: Float[Array, ""] = parameter("deg/h", 1.0, "bias at power-on")
    time_constant: Float[Array, ""] = parameter("s", 600.0, "decay time", linear=False, default=600.0)

    def __check_init__(self) -> None:
        if self.time_constant <= 0:
            raise ValueError("a time constant is above zero")

    def columns(self, signals: Signals) -> Float[Array, "sample coefficient"]:
        """The decay."""
        return stack(jnp.exp(-signals["time_on"] / self.time_constant))

    @classmethod
    def candidates(cls, signals: Signals) -> list[Self]:
        """Time constants from some samples to the whole run."""
        on = np.asarray(signals["time_on"])
        span = float(on.max() - on.min())
        shortest = max(span / 200.0, 2.0 * float(np.median(np.diff(on))))
        return [cls(time_constant=tau) for tau in np.geomspace(shortest, span, 14)]
