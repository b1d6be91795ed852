"""Effects of a stabilised platform on the angle of its base that gimbals and navigation give, less that of the table.

Each run of a vibration test is an oscillation of one frequency about each axis: what passes through a filter H(s) is
Re[H(jω) z] of an oscillation z. Signals of an underscore are made from the log by `gyromodel.platform`, means over
the samples of a row: `_real`, `_imaginary` and `_frequency` of the table's own angle, and what the base's angle about
the axis of the row changes by with each gimbal, each tilt and each turn of the platform.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Self

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from gyromodel.effects._base import Effect, Signals, parameter, stack

# Shafts that turn the platform body itself.
SHAFTS = ("gimbal_x", "gimbal_y", "gimbal_z")
# Odd harmonics that stand for a friction's change of sign.
ODD = (1, 3, 5, 7)
# Phases (rad) that a delay makes at the highest frequency, the least by a share; as parts of the lowest and times the
# highest frequency, where modes are searched; their damping; corners of loops (rad/s).
PHASES = np.concatenate([[0.03, 0.2], np.arange(0.5, 6.6, 0.3)])
LOWEST_MODE, HIGHEST_MODE, MODES, DAMPING = 0.5, 10.0, 25, (0.05, 0.2, 0.7)
CORNERS = (5.0, 15.0, 30.0, 60.0, 150.0)
# A share that is not small, and phases (rad), or frequencies over that of a mode, below which any share will do.
LEAST, SLIGHT = 0.5, 0.3
# Hz from which a mount is none.
STIFF = 1e4


class OfPlatform(Effect):
    """A term of the base's angle."""

    domain = "platform"
    site = "angle"


def _oscillation(signals: Signals) -> Complex[Array, " sample"]:
    """z of the table's angle Re z about the axis of each row."""
    return signals["_real"] + 1j * signals["_imaginary"]


def _frequencies(signals: Signals) -> Float[np.ndarray, " row"]:
    """Angular rates (rad/s) of the rows where the table oscillates."""
    frequency = np.asarray(signals["_frequency"])
    return frequency[np.hypot(np.asarray(signals["_real"]), np.asarray(signals["_imaginary"])) > 0]


class SyncDelay(OfPlatform):
    """θ += θ_t(t − δ) − θ_t(t): the clock of the platform is late against that of the table, on every axis alike.

    The search lets a share of the effect vary to have a linear coefficient; the fit holds it at one.
    """

    id = "sync_delay"
    needs = ("table_<axis>", "gimbal_<axis>")
    cause = "Records of table and platform are started or stamped at different times."
    test = "Oscillate at several frequencies about every axis: a delay turns all phases in proportion to frequency."
    held = ("share",)
    positive = True
    untested = "no run oscillates about an axis"

    share: Float[Array, ""] = parameter("1", 1.0, "part of the motion that is late", default=1.0)
    delay: Float[Array, ""] = parameter("ms", 1.0, "by how much the platform's records are late", linear=False)

    def columns(self, signals: Signals) -> Float[Array, "sample coefficient"]:
        """Re[(exp(−jωδ) − 1) z]."""
        turned = jnp.exp(-1j * signals["_frequency"] * self.delay) - 1.0
        return stack(jnp.real(turned * _oscillation(signals)))

    def least(self, signals: Signals) -> float:
        """Little of a motion that is much late would turn phases as nothing does that has one delay."""
        return LEAST if float(jnp.abs(self.delay)) * _frequencies(signals).max() > SLIGHT else 0.0

    def settled(self) -> Self:
        """All of the motion is late, by as much as has the same slope."""
        return type(self)(share=jnp.ones(()), delay=self.share * self.delay)

    @classmethod
    def candidates(cls, signals: Signals) -> list[Self]:
        """Late and early, up to more than a period of the highest frequency."""
        frequency = _frequencies(signals)
        return [cls(delay=sign * p / frequency.max()) for sign in (1, -1) for p in PHASES] if len(frequency) else []


class LoopResonance(OfPlatform):
    """θ += H θ_t − θ_t, H = (1 + 2ζs/ω_n)/(1 + 2ζs/ω_n + s²/ω_n²): the base swings on its mount.

    The search lets a share of the effect vary to have a linear coefficient, which far below the mode is −s²/ω_n²; the
    fit holds it at one.
    """

    id = "loop_resonance"
    needs = ("table_<axis>", "gimbal_<axis>")
    cause = "An isolator or a soft structure carries the base on the table."
    test = (
        "Oscillate at more frequencies, up to the mode: the response of a mode peaks there, that of a delay does not."
    )
    held = ("share",)
    positive = True
    untested = "no run oscillates about an axis"

    share: Float[Array, ""] = parameter("1", 1.0, "part of the motion that passes the mode", default=1.0)
    damping: Float[Array, ""] = parameter("1", 0.1, "ζ of the mode", linear=False, default=0.1)
    natural_frequency: Float[Array, ""] = parameter("Hz", 20.0, "ω_n/2π of the mode", linear=False, default=20.0)

    def __check_init__(self) -> None:
        if not (0 <= self.damping <= 1 and 0 < self.natural_frequency < STIFF):
            raise ValueError("a mode has a damping from zero to one and a frequency below 10 kHz")

    def columns(self, signals: Signals) -> Float[Array, "sample coefficient"]:
        """Re[(H(jω) − 1) z]."""
        s = 1j * signals["_frequency"] / (2.0 * jnp.pi * self.natural_frequency)
        carried = 1.0 + 2.0 * self.damping * s
        return stack(jnp.real((carried / (carried + s**2) - 1.0) * _oscillation(signals)))

    def least(self, signals: Signals) -> float:
        """Little of a motion that passes a mode within the band would turn phases as no mount does."""
        return LEAST if float(self.natural_frequency) * SLIGHT < _frequencies(signals).max() / (2.0 * np.pi) else 0.0

    def settled(self) -> Self:
        """All of the motion passes a mode that does as much far below it."""
        stiffer = self.natural_frequency / jnp.sqrt(jnp.maximum(self.share, 1e-6))
        return type(self)(share=jnp.ones(()), natural_frequency=stiffer, damping=self.damping)

    @classmethod
    def candidates(cls, signals: Signals) -> list[Self]:
        """Modes from below the lowest frequency to far above the highest."""
        hertz = _frequencies(signals) / (2.0 * np.pi)
        if not len(hertz):
            return []
        modes = np.geomspace(LOWEST_MODE * hertz.min(), HIGHEST_MODE * hertz.max(), MODES)
        return [cls(natural_frequency=f, damping=jnp.asarray(d)) for f in modes for d in DAMPING]


class _ThroughLoop(OfPlatform):
    """Friction of the shafts turns the body along with the base, as far as a loop lets it.

    Of a body of inertia J in a loop of damping J ω_c (1 + ω_i/s): viscous friction c turns it by
    R = c s/(J s² + J ω_c (s + ω_i)) of what the shaft turns, Coulomb friction M by M/c times what R makes of the sign
    of the shaft's rate: odd harmonics. The platform takes its body for still, so that the base's angle misses it.
    """

    viscous: Float[Array, " shaft"] = parameter("1", 0.01, "c/(J ω_c) of each shaft", default=())
    coulomb: Float[Array, " shaft"] = parameter("deg/s", 0.01, "M/(J ω_c) of each shaft", default=())
    integral: Float[Array, ""] = parameter("Hz", 5.0, "ω_i/2π of the loop's correction", linear=False, default=5.0)
    lag: Float[Array, ""] = parameter("ms", 5.0, "1/ω_c of the loop", linear=False, default=5e-3)
    shafts: tuple[str, ...] = eqx.field(static=True, default=())

    def __check_init__(self) -> None:
        if unknown := set(self.shafts) - set(SHAFTS):
            raise ValueError(f"{min(unknown)} is no shaft that turns the platform: these are {', '.join(SHAFTS)}")
        if {np.shape(v)[0] for v in (self.viscous, self.coulomb)} - {0, len(self.shafts)}:
            raise ValueError("viscous and coulomb take one number for each of the shafts, or none")
        # Far above all frequencies a corner makes a delay of friction, of more than holds any body.
        if np.any(np.asarray(self.viscous) >= 1.0):
            raise ValueError("viscous is below one: friction drags the platform less than its loop holds it")

    def turned(self, signals: Signals, gain: Float[Array, ""] | float = 1.0) -> Float[Array, "sample coefficient"]:
        """−Re[R ∂θ/∂β z] of each shaft's viscous friction, then its Coulomb friction; the loop's gain times `gain`."""
        corner, columns = 2.0 * jnp.pi * self.integral, []

        def response(s: Array) -> Array:
            return 1.0 / (gain * (s + corner) + self.lag * s**2)

        for shaft in self.shafts if self.viscous.size else ():
            s = 1j * signals[f"_{shaft}_frequency"]
            columns.append(-jnp.real(s * response(s) * _passed(signals, shaft, 1) * signals[f"_{shaft}_amplitude"]))
        for shaft in self.shafts if self.coulomb.size else ():
            total = 0.0
            for n in ODD:
                # sign(cos x) = 4/π Σ (−1)^k cos((2k + 1) x)/(2k + 1), of the shaft's rate: Re[j e^(jωt)].
                s, size = 1j * n * signals[f"_{shaft}_frequency"], 4.0 / np.pi * (-1) ** (n // 2) / n * 1j**n
                total = total - jnp.real(size * response(s) * _passed(signals, shaft, n))
            columns.append(total)
        return stack(*columns) if columns else jnp.zeros((signals["time"].shape[0], 0))


def _passed(signals: Signals, shaft: str, n: int) -> Complex[Array, " sample"]:
    """What the n-th harmonic of a shaft's oscillation, at amplitude one, makes of the base's angle."""
    return signals[f"_{shaft}_{n}_real"] + 1j * signals[f"_{shaft}_{n}_imaginary"]


class ShaftFriction(_ThroughLoop):
    """θ −= Σ R ∂θ/∂β (viscous β + coulomb ∫ sgn dβ/dt dt): friction of the shafts turns the platform with its base.

    Through a loop of damping J ω_c (1 + ω_i/s) on a body of inertia J, R = s/(s + ω_i + s²/ω_c). The platform takes its
    body for still, so that the angle of the base misses what it turns by.
    """

    id = "shaft_friction"
    needs = ("table_<axis>", "gimbal_<axis>")
    cause = "Bearings, slip rings and leads drag the platform along with its base."
    test = "Oscillate over a decade of frequency and at other amplitudes: Coulomb friction stays as it is."
    positive = True
    untested = "no run turns a shaft of the platform"

    def columns(self, signals: Signals) -> Float[Array, "sample coefficient"]:
        """Of each shaft's viscous friction, then of its Coulomb friction."""
        return self.turned(signals)

    def leaves(self, signals: Signals) -> float:
        """Twice what Coulomb friction turns the base's angle by: so far is a shaft that sticks from one that slides.

        A gimbal that hardly turns, as the redundant one, sticks for much of each period.
        """
        dry = type(self)(jnp.zeros(0), self.coulomb, self.integral, self.lag, self.shafts)
        return 2.0 * float(jnp.abs(dry.contribution(signals)).max())

    def prepared(self, signals: Signals) -> Self:
        """Both kinds of friction in every shaft that turns, unless they are set."""
        if self.shafts:
            return self
        shafts = _turning(signals)
        none = jnp.zeros(len(shafts))
        return type(self)(none, none, self.integral, self.lag, shafts)

    @classmethod
    def candidates(cls, signals: Signals) -> list[Self]:
        """Viscous friction, and Coulomb friction beside it, in all shafts that turn; loops of several corners."""
        shafts = _turning(signals)
        some, none = jnp.zeros(len(shafts)), jnp.zeros(0)
        kinds = ((some, none), (some, some)) if shafts else ()
        return [cls(v, c, jnp.asarray(w / (2.0 * np.pi)), shafts=shafts) for v, c in kinds for w in CORNERS]


def _turning(signals: Signals) -> tuple[str, ...]:
    """Shafts that oscillate in some run."""
    return tuple(s for s in SHAFTS if np.asarray(signals[f"_{s}_amplitude"]).max() > 0)


class LoopDynamics(_ThroughLoop):
    """θ −= what the friction of the shafts turns the platform by, through a loop of another gain or correction.

    As `shaft_friction` with R = s/((s + ω_i)/(1 + κ) + s²/ω_c): far below the crossover it lets 1 + κ times as much
    through, of a gain K_0 that is 1/(1 + κ) of the simulated one.
    """

    id = "loop_dynamics"
    needs = ("table_<axis>", "gimbal_<axis>")
    cause = "The stabilisation loop has another gain, correction or lag than the simulated one."
    test = "Measure the loop's step response, or oscillate at another gain of the amplifier: friction stays as it is."
    supersedes = ("shaft_friction",)
    held = ("viscous", "coulomb", "lag")
    reach = 20.0
    untested = "a loop shows only in what friction it lets through, and the model has no shaft_friction of known size"

    compliance: Float[Array, ""] = parameter("1", 0.1, "κ: what it lets through, less one", linear=False)

    def __check_init__(self) -> None:
        if self.compliance <= -1:
            raise ValueError("a loop lets something through: its compliance is above -1")

    def columns(self, signals: Signals) -> Float[Array, "sample coefficient"]:
        """Of each shaft's viscous friction, then of its Coulomb friction."""
        return self.turned(signals, 1.0 / (1.0 + self.compliance))

    @classmethod
    def candidates(cls, signals: Signals) -> list[Self]:
        """None by itself: see `continuing`."""
        return []

    @classmethod
    def continuing(cls, effects: Sequence[Effect], signals: Signals) -> Self | None:
        """The model's own friction, through the simulated loop."""
        for e in effects:
            if isinstance(e, ShaftFriction) and np.any(np.asarray(e.linear()) != 0):
                return cls(e.viscous, e.coulomb, e.integral, e.lag, e.shafts)
        return None


class PlatformDrift(OfPlatform):
    """θ −= Σ ∂θ/∂φ ω_d t, from the start of each run: the body turns slowly in inertial space."""

    id = "platform_drift"
    needs = ("table_<axis>", "gimbal_<axis>")
    cause = "Biases of the gyros that hold the platform, or a latitude and heading that are not those of the test."
    test = "Keep the table still for some minutes, at two headings: a drift of the body turns with it."

    rate: Float[Array, " axis"] = parameter("deg/h", 0.1, "ω_d about x, y, z of the body", default=(0.0, 0.0, 0.0))

    def columns(self, signals: Signals) -> Float[Array, "sample coefficient"]:
        """−∂θ/∂φ t of each axis."""
        return stack(*(signals[f"_drift_{axis}"] for axis in "xyz"))
