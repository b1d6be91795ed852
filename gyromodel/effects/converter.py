"""What converters add: the end of their range, its steps, and the errors of their codes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Self

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from gyromodel.effects._base import Effect, Signals, parameter, stack
from gyromodel.effects._shapes import EARTHLY, beyond_earth

# Limits searched, as parts of the largest rate, and different rates that must lie beyond one.
LOWEST, HIGHEST, LIMITS, FEWEST_BEYOND = 0.2, 0.99, 24, 2
# Series over the ramp: how many harmonics, and periods searched as parts of its span. A ramp's ends need not meet:
# twice the span leaves them free.
SERIES = (
    (1, 1.0 / np.arange(0.5, 32.5, 0.5)),
    (2, 1.0 / np.array([0.5, 0.75, 1.0, 2.0, 4.0])),
    (4, 1.0 / np.array([0.5, 0.75, 1.0, 2.0])),
    (8, 1.0 / np.array([0.5, 0.75, 1.0])),
)


class Saturation(Effect):
    """output = S₀ max(−ω_max, min(u, ω_max)), u = (I + E + D)(1 + ε): the output ends at the limits of its range.

    `lower`, where there is one, takes the place of −ω_max. The search lets a share of the effect vary to have a linear
    coefficient; the fit holds it at one.
    """

    id = "saturation"
    site = "output"
    needs = ("rate",)
    cause = "The converter, the torquer or the loop has no more range."
    test = "Leave out the largest rates: a nonlinearity bends those below as well, saturation does not."
    held = ("share",)
    positive = True
    untested = f"has fewer than two different rates beyond any limit, or {EARTHLY}"

    share: Float[Array, ""] = parameter("1", 1.0, "part of the output that saturates", default=1.0)
    limit: Float[Array, ""] = parameter("deg/s", 100.0, "largest rate that is told", linear=False, default=1.75)
    lower: Float[Array, " side"] = parameter(
        "deg/s", 100.0, "lowest rate that is told, where it is another", linear=False, default=()
    )

    def __check_init__(self) -> None:
        if self.limit <= 0:
            raise ValueError("a range ends above zero")
        if np.size(self.lower) > 1 or np.any(np.asarray(self.lower) >= 0):
            raise ValueError("lower takes one rate below zero, or none")

    def columns(self, signals: Signals) -> Float[Array, "sample coefficient"]:
        """What is told, cut at the limits, less what is told."""
        lower = self.lower[0] if self.lower.size else -self.limit
        return stack(jnp.clip(signals["rate"], lower, self.limit) - signals["rate"])

    def settled(self) -> Self:
        """All of the output saturates."""
        return type(self)(share=jnp.ones(()), limit=self.limit, lower=self.lower)

    def wider(self) -> Self | None:
        """With a limit of its own below."""
        return None if self.lower.size else replace(self, lower=-self.limit[None])

    @classmethod
    def candidates(cls, signals: Signals) -> list[Self]:
        """Limits with several rates beyond them."""
        if not beyond_earth(signals):
            return []
        levels = np.unique(np.round(np.abs(np.asarray(signals["rate"])), 9))
        limits = levels[-1] * np.linspace(LOWEST, HIGHEST, LIMITS)
        return [cls(limit=limit) for limit in limits if np.sum(levels > limit) >= FEWEST_BEYOND]


class Quantisation(Effect):
    """output = q · round(u/q), u the output with its noise: it is read in steps of q.

    A model's prediction is what is told before it is read, so that the effect has no columns. A simulation reads it in
    steps; a fit takes what rounding adds on the average from its data where the noise does not smear it, and counts the
    rest as noise. Of increments and angles it is the angle that is read, whose rounding is noise_quantisation. `unit`
    is that of the output; without a step it is that of the campaign.
    """

    id = "quantisation"
    site = "readout"
    needs = ()
    cause = "The converter or the log holds the output in steps larger than its noise."
    test = "Read the output in finer steps, or turn slowly through several: errors of rounding repeat with each step."
    held = ("step",)

    step: Float[Array, ""] = parameter("1", 1e-3, "in the unit of the output", linear=False, default=jnp.nan)
    unit: str = eqx.field(static=True, default="")

    def __check_init__(self) -> None:
        if self.step <= 0 or self.step == jnp.inf:
            raise ValueError("a step is above zero and finite")

    def columns(self, signals: Signals) -> Float[Array, "sample coefficient"]:
        """None."""
        return jnp.zeros((len(signals["time"]), 0))

    @classmethod
    def candidates(cls, signals: Signals) -> list[Self]:
        """None: the output's grid shows it."""
        return []


class BiasReadoutCode(Effect):
    """D += Σ A_k cos(2πkc/P) + B_k sin(2πkc/P), c the code of the closed loop's ramp: an error of the ramp's codes.

    A period P of twice the ramp's span serves for errors that do not meet at its ends, such as those of its flyback.
    k runs over `harmonics`, or from 1 on.
    """

    id = "bias_readout_code"
    site = "rate"
    needs = ("feedback_ramp",)
    cause = "The ramp converter is not linear, or the ramp's flyback is not 2π, and the loop takes that for a rate."
    test = (
        "Turn at a rate that makes the ramp slow: the error then follows the code sample by sample, vibration does not."
    )

    cosine: Float[Array, " harmonic"] = parameter("deg/h", 1.0, "in-phase amplitude of each harmonic", default=(0.0,))
    sine: Float[Array, " harmonic"] = parameter("deg/h", 1.0, "quadrature amplitude of each harmonic", default=(0.0,))
    period: Float[Array, ""] = parameter("1", 3e4, "in the ramp's counts, V or rad", linear=False, default=65536.0)
    harmonics: tuple[int, ...] = eqx.field(static=True, default=())

    def __check_init__(self) -> None:
        if self.harmonics and (len(self.harmonics) != self.cosine.size or min(self.harmonics) < 1):
            raise ValueError("harmonics are numbered from 1 on, one for each cosine")
        if self.cosine.shape != self.sine.shape or self.period <= 0:
            raise ValueError("every harmonic needs a cosine and a sine, and the period is above zero")

    def columns(self, signals: Signals) -> Float[Array, "sample coefficient"]:
        """The cosines, then the sines."""
        harmonic = jnp.asarray(self.harmonics or range(1, 1 + self.cosine.shape[0]), float)
        phase = 2.0 * jnp.pi * signals["feedback_ramp"][:, None] * harmonic / self.period
        return jnp.concatenate([jnp.cos(phase), jnp.sin(phase)], axis=1)

    def with_harmonics(self, numbers: Sequence[int]) -> Self:
        """The code's error in some harmonics, at zero."""
        none = jnp.zeros(len(numbers))
        return type(self)(cosine=none, sine=none, period=self.period, harmonics=tuple(numbers))

    @classmethod
    def candidates(cls, signals: Signals) -> list[Self]:
        """From one harmonic of many periods to eight of the whole ramp's."""
        span = np.ptp(np.asarray(signals["feedback_ramp"]))
        return [
            cls(cosine=jnp.zeros(count), sine=jnp.zeros(count), period=jnp.asarray(span * part))
            for count, parts in SERIES
            for part in parts
        ]
