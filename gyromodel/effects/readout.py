"""Readout effects: the lock-in of a ring laser, bare and under dither.

Source of the beat equation: Aronowitz, *Fundamentals of the Ring Laser Gyro*, in RTO AGARDograph 339, Optical Gyros and
their Application, 1999. What follows from it is derived below, and held in the tests to its numerical integration.
"""

from __future__ import annotations

import math
from typing import Self

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from gyromodel.effects._base import Effect, Signals, parameter, stack

# A wider dead band (rad/s) is no ring laser's, and its centre is off by no more than the Earth's rate and a bias.
WIDEST, FARTHEST = np.deg2rad(1.0), np.deg2rad(20.0 / 3600.0)
# Visits of rates that must lie inside the narrowest dead band searched, or twice as far out; fewer are bad points.
FEWEST_INSIDE = 3
# How many half widths are searched, down to what part of the widest.
WIDTHS, NARROWEST = 20, 1.0 / 300.0
# Centres searched, in half widths.
CENTRES = np.array([-1.0, -0.5, 0.0, 0.5, 1.0])
# Points of the integral for Bessel functions: exact to rounding while argument plus order stay below this number.
BESSEL_POINTS = 4096


class LockIn(Effect):
    """E += B(ω − ω_c) − (ω − ω_c), with B(v) = sgn v √(v² − ω_L²), 0 inside ±ω_L: lock-in.

    Two beams that scatter into one another beat at dψ/dt = (2π/S)·(ω − ω_L sin ψ), S the angle of one fringe; B is the
    mean of that, as a rate. Far from rest it is ω, so bias and scale factor keep their meaning. The search lets a share
    of the effect vary to have a linear coefficient; the fit holds it at one.
    """

    id = "lock_in"
    site = "rate"
    needs = ("rate",)
    cause = "Backscatter couples the two beams of a ring laser, which lock together at small rates."
    test = "Sweep slowly through rest in both senses: table stiction and rate hysteresis depend on the sense."
    held = ("share",)
    positive = True
    untested = "has fewer than three visits of rates within 2 deg/s of rest, or no different ones beyond them"

    share: Float[Array, ""] = parameter("1", 1.0, "part of the output that locks", default=1.0)
    half_width: Float[Array, ""] = parameter("deg/h", 100.0, "half of the dead band", linear=False, default=5e-4)
    centre: Float[Array, ""] = parameter("deg/h", 10.0, "rate in its middle, against Earth's and bias", linear=False)

    def __check_init__(self) -> None:
        if self.half_width < 0:
            raise ValueError("half a dead band is not below zero")

    def columns(self, signals: Signals) -> Float[Array, "sample coefficient"]:
        """The beat less what it would be without lock-in."""
        return stack(lock_in_error(signals["rate"] - self.centre, self.half_width))

    def settled(self) -> Self:
        """All of the output locks, with the half width that is the same far from rest."""
        half_width = self.half_width * jnp.sqrt(jnp.clip(self.share, 0.25, 4.0))
        return type(self)(share=jnp.ones(()), half_width=half_width, centre=self.centre)

    @classmethod
    def candidates(cls, signals: Signals) -> list[Self]:
        """Dead bands near several visits of rates, with other rates beyond; rates outside tell a band by ω_L²/2ω."""
        rate = np.asarray(signals["rate"])
        levels = np.unique(np.abs(rate[rate != 0]))
        if len(levels) < 2 * FEWEST_INSIDE:
            return []
        visits = np.sort(np.abs(rate[np.append(True, np.diff(rate) != 0) & (rate != 0)]))
        widest = min(WIDEST, levels[-FEWEST_INSIDE - 1])
        narrowest = max(visits[FEWEST_INSIDE - 1] / 2, NARROWEST * widest)
        if not narrowest < widest:
            return []
        return [
            cls(half_width=half_width, centre=centre)
            for half_width in np.geomspace(narrowest, widest, WIDTHS)
            for centre in CENTRES * half_width
            if abs(centre) <= FARTHEST
        ]


class LockInDithered(Effect):
    """E += Σ_m [B_m(v_m) − v_m], v_m = ω − ω_c − m f S: dead bands left by a sinusoidal dither, at rest and harmonics.

    B_m is the B of lock_in with half width ω_L·|J_m(β)|, β = 2πθ_D/S. With the case dithered by θ_D sin 2πft and
    ψ = φ + β sin 2πft, the beat equation of lock_in becomes (Jacobi and Anger)
    dφ/dt = (2π/S)·(ω − ω_L Σ_m J_m(β) sin(φ + 2πmft)). Where ω is near −m f S, term m alone is slow, and locks as a
    bare ring laser would. First order in ω_L/(f S); `harmonics` is the largest m.
    """

    id = "lock_in_dithered"
    site = "rate"
    needs = ("rate",)
    cause = "A sinusoidal dither leaves small dead bands of the lock-in at rest and at its harmonics."
    test = "Change the dither amplitude: the bands follow the Bessel functions; random amplitude closes them."
    held = ("share", "dither_amplitude", "dither_frequency", "fringe_angle")
    positive = True
    untested = "no column tells the dither: list the effect in the model; its band at rest is searched as lock_in"

    share: Float[Array, ""] = parameter("1", 1.0, "part of the output that locks", default=1.0)
    lock_in_rate: Float[Array, ""] = parameter("deg/h", 100.0, "without dither", linear=False, default=5e-4)
    centre: Float[Array, ""] = parameter("deg/h", 10.0, "rate amid the bands, against Earth's and bias", linear=False)
    dither_amplitude: Float[Array, ""] = parameter("arcsec", 150.0, "zero to peak", linear=False, default=7.3e-4)
    dither_frequency: Float[Array, ""] = parameter("Hz", 400.0, "of the dither", linear=False, default=400.0)
    fringe_angle: Float[Array, ""] = parameter("arcsec", 2.0, "S: turn of one fringe", linear=False, default=9.7e-6)
    harmonics: int = eqx.field(static=True, default=8)

    def __check_init__(self) -> None:
        if 2 * math.pi * abs(float(self.dither_amplitude / self.fringe_angle)) + self.harmonics > BESSEL_POINTS:
            raise ValueError(f"a dither of more than {BESSEL_POINTS} / 2π fringes is not computed: check its amplitude")

    def columns(self, signals: Signals) -> Float[Array, "sample coefficient"]:
        """The errors of all bands together."""
        order = jnp.arange(-self.harmonics, self.harmonics + 1)
        depth = 2.0 * jnp.pi * self.dither_amplitude / self.fringe_angle
        half_width = self.lock_in_rate * jnp.abs(bessel(order, depth))
        places = order * self.dither_frequency * self.fringe_angle
        away = (signals["rate"] - self.centre)[:, None] - places
        return stack(lock_in_error(away, half_width).sum(axis=1))

    @classmethod
    def candidates(cls, signals: Signals) -> list[Self]:
        """None: at rest it is `lock_in`, and the other bands need the dither."""
        return []


def lock_in_error(rate: Float[Array, "*shape"], lock_in_rate: Float[Array, "*#shape"]) -> Float[Array, "*shape"]:
    """B(ω) − ω: mean beat of a ring laser, as a rate, less the rate; −ω inside the dead band."""
    excess = rate**2 - lock_in_rate**2
    free = excess > 0
    # √(ω² − ω_L²) − ω = −ω_L²/(√(ω² − ω_L²) + ω) loses no digits far from rest; the guards keep derivatives finite.
    root = jnp.sqrt(jnp.where(free, excess, 1.0))
    return jnp.where(free, -(lock_in_rate**2) / jnp.where(free, rate + jnp.sign(rate) * root, 1.0), -rate)


def bessel(order: Int[Array, " order"], argument: Float[Array, ""]) -> Float[Array, " order"]:
    """Bessel functions of the first kind and whole order, by the mean of cos(mτ − x sin τ) over a turn."""
    turn = 2.0 * jnp.pi * jnp.arange(BESSEL_POINTS) / BESSEL_POINTS
    return jnp.cos(order[:, None] * turn - argument * jnp.sin(turn)).mean(axis=1)


def dither_random_walk(lock_in_rate: float, fringe_angle: float, peak_dither_rate: float) -> float:
    """Angle random walk that lock-in leaves in a randomly dithered ring laser: ω_L √(S/(2π Ω_D)), rad/√s.

    Where the dither turns round with acceleration α = 2πf Ω_D, the beat phase stands still for a moment, and
    ∫ ω_L sin(ψ_0 + (2π/S) α t²/2) dt = ω_L √(S/α) sin(ψ_0 + π/4) of angle is lost. With ψ_0 random from one turn to the
    next, 2f turns a second add up to a variance of 2f·ω_L² S/(2α) a second.

    Args:
        lock_in_rate: ω_L, rad/s.
        fringe_angle: S, rad.
        peak_dither_rate: Ω_D = 2πf θ_D, rad/s.

    Returns:
        rad/√s; times √t the standard deviation of the angle after a time t.
    """
    return lock_in_rate * math.sqrt(fringe_angle / (2.0 * math.pi * peak_dither_rate))
