"""Effects that remember which way their driver came."""

from __future__ import annotations

from typing import ClassVar, Self

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from gyromodel.effects._base import Effect, Signals, parameter, stack
from gyromodel.effects._shapes import EARTHLY, beyond_earth
from gyromodel.numerics.play import play

# Half widths searched, as parts of the driver's range: the widest loops are hardly more than a line over the driver.
WIDEST, NEXT = 0.3, 1.33
# Samples at least on either branch of a loop, and as a part of all.
FEWEST, SHARE = 3, 0.02


class _Hysteresis(Effect):
    """A loop over one signal: +height on its way up, −height on its way down, a ramp of twice the half width between.

    The friction of a part that the driver drags along: (x − P[x])/w with the play operator P of half width w. It starts
    in the middle at the start of every campaign.
    """

    remembers = True
    driver: ClassVar[str]
    narrowest: ClassVar[float] = 0.01
    height: Float[Array, ""] = parameter("deg/h", 1.0, "half of the loop's height; positive: higher on the way up")

    def columns(self, signals: Signals) -> Float[Array, "sample coefficient"]:
        """(x − P[x])/w, from −1 to 1."""
        x, time = signals[self.driver], signals["time"]
        width = self.half_width  # type: ignore[attr-defined]
        return stack((x - play(x, width, jnp.diff(time, prepend=time[:1]) < 0)) / width)

    def __check_init__(self) -> None:
        if self.half_width <= 0:  # type: ignore[attr-defined]
            raise ValueError("half a width is above zero")

    @classmethod
    def candidates(cls, signals: Signals) -> list[Self]:
        """Loops of which the campaign holds both branches."""
        x = np.asarray(signals[cls.driver])
        number = 1 + round(np.log(WIDEST / cls.narrowest) / np.log(NEXT))
        widths = np.ptp(x) * np.geomspace(cls.narrowest, WIDEST, number)
        tried = [cls(half_width=w) for w in widths]  # type: ignore[call-arg]
        # Padded rows repeat the last one, its time too.
        rows = np.diff(np.asarray(signals["time"]), prepend=-np.inf) != 0
        fewest = max(FEWEST, SHARE * rows.sum())
        branches = [np.asarray(e.columns(signals))[rows] for e in tried]
        return [e for e, b in zip(tried, branches, strict=True) if min(np.sum(b > 0.99), np.sum(b < -0.99)) >= fewest]


class BiasThermalHysteresis(_Hysteresis):
    """E += D_H (T − P[T])/w, P the play operator of half width w: a thermal loop that does not depend on ramp speed."""

    id = "bias_thermal_hysteresis"
    site = "rate"
    needs = ("temperature",)
    driver = "temperature"
    cause = "Potting or a joint of the coil slips when temperature strains it, and stays where it slipped to."
    test = "Two ramp speeds: the loop over temperature stays as it is, those of lag and Shupe effect grow with speed."
    untested = "temperature never turns back far enough to close a loop"

    half_width: Float[Array, ""] = parameter("degC", 2.0, "turn that changes sides, half", linear=False, default=2.0)


class RateHysteresis(_Hysteresis):
    """E += D_H (ω − P[ω])/w, P the play operator of half width w: the error depends on which way the rate came."""

    id = "rate_hysteresis"
    site = "rate"
    needs = ("rate",)
    driver = "rate"
    narrowest = 0.001  # a reference rate has no noise that would close such a loop
    cause = "Friction, backlash of the pick-off or magnetic remanence of the torquer keeps part of the last turn."
    test = "Oscillate at two frequencies of one rate amplitude: the loop stays as it is, that of a delay grows."
    untested = f"the rate never turns back far enough to close a loop, or {EARTHLY}"

    half_width: Float[Array, ""] = parameter("deg/s", 1.0, "turn that changes sides, half", linear=False, default=0.02)

    @classmethod
    def candidates(cls, signals: Signals) -> list[Self]:
        """Loops of which the campaign holds both branches, of more than the Earth's rate."""
        return super().candidates(signals) if beyond_earth(signals) else []
