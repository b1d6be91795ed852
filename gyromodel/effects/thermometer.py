"""Bias over a temperature that the thermometer shows late, or wrong."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Self

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from gyromodel.effects._base import Effect, Signals, parameter, setting, stack
from gyromodel.effects._shapes import POWER_SCALE, OverTemperature, check_curve, curve_columns
from gyromodel.effects.dynamics import rate_behind, remembered
from gyromodel.effects.scale import ScaleTemperature
from gyromodel.effects.thermal import BiasTemperature, BiasTemperatureCurve
from gyromodel.units import ZERO_CELSIUS


class TemperatureLag(OverTemperature):
    """E += b(T + τ dT/dt), b(u) = Σ a_i ((u − T0)/10 °C)^i + Σ h_j max(u − T_j, 0): the thermometer is late by τ.

    Where `late` says that it is the coil, E += b(U), τ dU/dt + U = T: U follows the thermometer through a lag. It
    contains the bias over temperature, b, and equals it for τ = 0. Where b is a line of slope a it is
    bias_temperature_rate with the coefficient a·τ; of a coil with −a·τ, behind the lag τ.
    """

    id = "temperature_lag"
    site = "rate"
    needs = ("temperature",)
    cause = "The thermometer follows the part that makes the bias with a delay, or that part follows the thermometer."
    test = "Ramp through temperatures where the bias rises and where it falls: this error changes sign between them."
    supersedes = ("bias_temperature", "bias_temperature_curve")
    untested = "the simulation has no bias over temperature that could come late"
    reach = 900.0

    coefficients: Float[Array, " order"] = parameter("deg/h", 1.0, "power i: bias per (10 °C)^i", default=(0.0,))
    hinges: Float[Array, " hinge"] = parameter("deg/h/degC", 1.0, "change of slope at each breakpoint", default=())
    breakpoints: Float[Array, " hinge"] = parameter("degC", 10.0, "where the slope changes", linear=False, default=())
    time_constant: Float[Array, ""] = parameter("s", 100.0, "how late it is", linear=False)
    late: str = eqx.field(static=True, default="thermometer", kw_only=True)

    def __check_init__(self) -> None:
        check_curve(self.coefficients, self.hinges, self.breakpoints)
        if self.late not in ("thermometer", "coil"):
            raise ValueError("late takes thermometer or coil")

    @property
    def remembers(self) -> bool:
        """Where the coil is late."""
        return self.late == "coil"

    def columns(self, signals: Signals) -> Float[Array, "sample coefficient"]:
        """Those of the curve, at the temperature that the thermometer will show, or that the coil has."""
        change, lag = signals["temperature_rate"], self.time_constant
        if self.remembers:
            change, lag = rate_behind(signals["time"], signals["temperature"], change, lag), -lag
        coil = signals["temperature"] + lag * change
        return curve_columns(coil, self.reference, self.coefficients.shape[0], self.breakpoints)

    def unknown(self, signals: Signals) -> Bool[Array, " sample"]:
        """The first time constants of a coil's lag."""
        return remembered(signals["time"], self.time_constant) if self.remembers else super().unknown(signals)

    def grown_by(self, amplitude: Float[Array, ""]) -> Self:
        """A delay below zero is the coil's."""
        late = "coil" if amplitude < 0 else "thermometer"
        return dataclasses.replace(self, time_constant=jnp.abs(amplitude), late=late)

    @classmethod
    def candidates(cls, signals: Signals) -> list[Self]:
        """None: it continues the bias over temperature that a model has."""
        return []

    @classmethod
    def continuing(cls, effects: Sequence[Effect], signals: Signals) -> Self | None:
        """The model's own bias over temperature, not late yet."""
        for effect in effects:
            if isinstance(effect, BiasTemperature):
                return cls(coefficients=effect.coefficient[None] * POWER_SCALE, reference=effect.reference)
            if isinstance(effect, BiasTemperatureCurve):
                return cls(
                    coefficients=effect.coefficients,
                    hinges=effect.hinges,
                    breakpoints=effect.breakpoints,
                    reference=effect.reference,
                )
        return None


class ThermometerError(OverTemperature):
    """E += (D_T + 1e-6 ε_T ω)(U − T0), 1/U = 1/T − e/T0² ln(R/R0): the law that makes T of a resistance R errs.

    It contains bias and scale factor over temperature and equals them for e = 0; reciprocals are of absolute
    temperatures, R0 is the resistance at T0. With β' in the place of a thermistor's constant β, e = T0² (1/β' − 1/β).
    The ripple is the same in bias and scale factor; where only one of them shows it, it may be a curve of that one.
    """

    id = "thermometer_error"
    site = "rate"
    needs = ("temperature", "thermistor_resistance")
    cause = "The constants that turn the thermistor's resistance into a temperature are not those of the thermistor."
    test = "An independent thermometer: a thermometer error puts the same ripple into every term."
    supersedes = ("bias_temperature", "scale_temperature")
    untested = "no straight bias or scale factor over a temperature that follows from the resistance, which could err"
    reach = 5.0

    bias: Float[Array, " bias"] = parameter("deg/h/degC", 1.0, "bias per degree", default=(0.0,))
    scale: Float[Array, " scale"] = parameter("ppm/degC", 10.0, "relative change of scale per degree", default=())
    error: Float[Array, ""] = parameter("degC", 0.1, "error per e-fold of resistance", linear=False)
    resistance: Float[Array, ""] = setting()

    @property
    def columns_needed(self) -> tuple[str, ...]:
        """The rate too, where the scale factor changes."""
        return (*self.needs, "rate") if self.scale.size else self.needs

    def __check_init__(self) -> None:
        if self.bias.ndim != 1 or self.scale.ndim != 1 or self.bias.size + self.scale.size not in (1, 2):
            raise ValueError("bias and scale are lists of one coefficient, or one of them of none")

    def prepared(self, signals: Signals) -> Self:
        """Refer to the campaign's mean temperature and to the resistance nearest to it."""
        effect = super().prepared(signals)
        if np.isfinite(float(effect.resistance)):
            return effect
        nearest = jnp.nanargmin(jnp.abs(signals["temperature"] - effect.reference))
        return eqx.tree_at(lambda e: e.resistance, effect, signals["thermistor_resistance"][nearest])

    def columns(self, signals: Signals) -> Float[Array, "sample coefficient"]:
        """U − T0, and that times the rate."""
        told, reference = signals["temperature"] + ZERO_CELSIUS, self.reference + ZERO_CELSIUS
        shift = self.error / reference**2 * jnp.log(signals["thermistor_resistance"] / self.resistance)
        right = signals["temperature"] - self.reference + told * (1.0 / (1.0 - told * shift) - 1.0)
        return stack(*([right] * self.bias.size), *([signals["rate"] * right] if self.scale.size else []))

    @classmethod
    def candidates(cls, signals: Signals) -> list[Self]:
        """None: it continues the bias and the scale factor over temperature that a model has."""
        return []

    @classmethod
    def continuing(cls, effects: Sequence[Effect], signals: Signals) -> Self | None:
        """The model's own bias and scale factor over temperature, without an error yet, where T follows from R."""
        bias, scale = ([e for e in effects if isinstance(e, kind)] for kind in (BiasTemperature, ScaleTemperature))
        if not bias + scale or not _follows(signals["temperature"], signals["thermistor_resistance"]):
            return None
        grown = cls(
            bias=jnp.asarray([e.coefficient for e in bias]),
            scale=jnp.asarray([e.coefficient for e in scale]),
            reference=(bias + scale)[0].reference,
        )
        return grown.prepared(signals)


def _follows(temperature: Float[Array, " sample"], resistance: Float[Array, " sample"]) -> bool:
    """Whether a temperature falls, or rises, with every rise of a resistance, as one computed from it does."""
    both = np.stack([np.asarray(resistance), np.asarray(temperature)])
    x, y = both[:, np.isfinite(both).all(axis=0)]
    rises = [(np.diff(sign * y[np.lexsort((sign * y, x))]) >= 0).all() for sign in (-1.0, 1.0)]
    return bool((x > 0).all() and any(rises))
