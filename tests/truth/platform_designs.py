"""A common vibration test of the simulated platform, and each kind of discrepancy hidden in it at a given size.

Oscillations of each axis by itself from 4 to 20 rad/s at two amplitudes, and slow ones of tens of degrees, as an
acceptance programme has them. Without anything hidden the shafts have no friction: the gimbals then show all that the
base does.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline

from gyromodel.campaign import Campaign
from gyromodel.effects.platform import SHAFTS, ShaftFriction
from gyromodel.model import GyroModel
from tests.truth import platform
from tests.truth.platform import Loop, Platform, Run
from tests.truth.platform_campaign import GIMBALS, PAUSE

FREQUENCIES, SMALL, LARGE, SLOW = (4.0, 9.0, 20.0), np.deg2rad([0.5, 0.1]), np.deg2rad(30.0), 4.0
LENGTH, SKIPPED = 3.4, 0.5
# Standard deviation of an encoder's reading and root of the density of the gyros' white noise (rad, rad/s/√Hz).
NOISE, WALK = np.deg2rad(1.0 / 3600), np.deg2rad(1e-4) / 60
FREE = Platform(viscous=np.zeros(4), coulomb=np.zeros(4), step=1e-3, noise=WALK)
# Friction that a simulation knows.
COULOMB = 0.02
RUBBING = FREE._replace(viscous=np.full(4, 0.1), coulomb=np.full(4, 0.1 * COULOMB))


def common() -> tuple[np.ndarray, np.ndarray]:
    """Amplitudes (run by axis, rad) and frequencies (rad/s)."""
    small = [SMALL[0] * np.eye(3)] * len(FREQUENCIES) + [SMALL[1] * np.eye(3)]
    amplitude = np.concatenate([*small, LARGE * np.eye(3)])
    return amplitude, np.repeat([*FREQUENCIES, FREQUENCIES[1], SLOW], 3)[:, None] * np.ones(3)


def hidden(effect: str, size: float) -> Platform:
    """The platform with one effect at a size in its own unit."""
    change: dict[str, Any] = {
        "": dict,
        # s
        "sync_delay": lambda: {"offset": -size},
        # rad/s
        "loop_resonance": lambda: {"isolator": (size, 0.1)},
        # N m s/rad, and a part of it in N m: more would stick in the redundant gimbal, which hardly turns.
        "shaft_friction": lambda: {"viscous": np.full(4, size), "coulomb": np.full(4, COULOMB * size)},
        # rad
        "gimbal_nonorthogonality": lambda: {"tilts": size * np.array([[0, 0, 0], [0, 0, 0], [0, 0, 0], [1.0, 0, 0]])},
        # rad
        "encoder_harmonic": lambda: {"harmonics": size * np.array([[[0, 0]], [[0.6, 0.8]], [[0, 0]], [[0, 0.0]]])},
        # rad/s
        "platform_drift": lambda: {"drift": lambda time: np.full((len(time), 3), size * np.array([0.8, 0.0, 0.6]))},
    }.get(effect, dict)()
    return FREE._replace(**change)


def other_loop(size: float) -> Platform:
    """Known friction in a loop whose crossover is larger by a part."""
    return RUBBING._replace(loop=Loop(crossover=Loop().crossover * (1.0 + size)))


def simulation_with_friction() -> GyroModel:
    """The simulation of the platform that rubs, in the loop that it has with nothing hidden, all of it known."""
    inertia, loop, step = RUBBING.carried(), Loop(), RUBBING.step
    # What the loop's damping is over that of an inertia in a loop of its gain and corner alone.
    s = 1j * loop.crossover
    damping = loop.crossover / abs(
        (1 + loop.integral / s)
        * (1 + s / loop.lead)
        / (1 + s / loop.lag)
        / (1 + s * loop.gyro_lag)
        / (1 + s * loop.motor_lag)
    )
    lag = 1 / damping + 1 / loop.lead - 1 / loop.lag - loop.gyro_lag - loop.motor_lag - 0.5 * step
    sizes = [x[1:] / (inertia * damping) for x in (RUBBING.viscous, RUBBING.coulomb)]
    friction = ShaftFriction(sizes[0], sizes[1], loop.integral / (2 * np.pi), lag, SHAFTS)
    known = frozenset((friction.id, name) for name in friction.declared())
    return GyroModel((friction,), {}, known)


@cache
def _simulated(effect: str, size: float) -> Run:
    """The mechanics, which neither the clocks nor the encoders change."""
    design = other_loop(size) if effect == "loop_dynamics" else hidden(effect, size)
    return platform.simulate(mechanics(design), *common(), LENGTH)


def mechanics(design: Platform) -> Platform:
    """A platform with perfect clocks and encoders."""
    return design._replace(offset=0.0, harmonics=FREE.harmonics)


def vibration(effect: str = "", size: float = 0.0, seed: int = 0) -> Campaign:
    """The log of a test with an effect hidden; what moves is simulated once, the encoders' noise is drawn anew."""
    if effect in ("sync_delay", "encoder_harmonic"):
        return logged(_simulated("", 0.0), hidden(effect, size), seed)
    return logged(_simulated(effect, size), FREE, seed)


def late_and_tilted(delay: float, tilt: float, seed: int = 0) -> Campaign:
    """Two effects at once."""
    return logged(_simulated("gimbal_nonorthogonality", tilt), hidden("sync_delay", delay), seed)


def late_and_rubbing(delay: float, viscous: float, seed: int = 0) -> Campaign:
    """Records that are late, and friction."""
    return logged(_simulated("shaft_friction", viscous), hidden("sync_delay", delay), seed)


@cache
def _sticking() -> Run:
    return platform.simulate(FREE._replace(viscous=np.full(4, 0.1), coulomb=np.full(4, 0.05)), *common(), LENGTH)


def sticking(seed: int) -> Campaign:
    """Friction of which the redundant gimbal, which hardly turns, sticks for most of each period."""
    return logged(_sticking(), FREE, seed)


def in_steps(steps: int, seed: int) -> Campaign:
    """Nothing hidden, read by encoders of so many steps a turn and without noise."""
    return logged(_simulated("", 0.0), FREE._replace(quantum=2 * np.pi / steps), seed)


def logged(run: Run, design: Platform, seed: int) -> Campaign:
    """What the encoders of a platform read of some mechanics, on clocks of their own: with noise, or in steps."""
    # Behind what is left out there is room for clocks that are early or late.
    kept = (run.time >= SKIPPED) & (run.time < LENGTH - SKIPPED)
    time, table = run.time[kept], run.table[:, kept]
    angles = CubicSpline(run.time, run.angles, axis=1)(time + design.offset)
    readings = np.concatenate([table, platform._read(angles, design.harmonics)], axis=2)
    noise = NOISE * np.random.default_rng(seed).standard_normal(readings.shape)
    readings = platform._quantised(readings, design.quantum) if design.quantum else readings + noise
    runs = [np.column_stack([time + k * (LENGTH + PAUSE), np.full(len(time), k + 1.0), np.rad2deg(r)])
            for k, r in enumerate(readings)]  # fmt: skip
    names = ["time", "segment", "table_x", "table_y", "table_z", *GIMBALS]
    units = dict(zip(names, ["s", "", *["deg"] * 7], strict=True))
    columns = dict(zip(names, np.concatenate(runs).T, strict=True))
    return Campaign(columns, units, {"latitude_deg": float(np.rad2deg(design.latitude))}, "vibration")
