"""Gyros that log a cause of their errors: beam monitors of a ring laser, torquer current of a rate-integrating gyro.

Backscatter slows a beat that is integrated; two beams of unequal intensity pull their frequencies apart; a torquer of
three parts makes the torque that turns the gyro. Rates in rad/s.
"""

from __future__ import annotations

import numpy as np

from .ring_laser import counted_rate, resting_case

Array = np.ndarray
FRINGE = np.deg2rad(2.0 / 3600)


def wandering(rows: int, rng: np.random.Generator) -> Array:
    """A quantity that goes up and down over a record in its own way, between 0 and 1."""
    phase, part = rng.uniform(0, 2 * np.pi, 4), np.arange(rows) / rows
    value = sum(np.sin(2 * np.pi * (k + 1.3) * part + phase[k]) / (k + 1) for k in range(4))
    return (value - value.min()) / np.ptp(value)


def backscattered(power: Array, rate: float, lock_in_rate: float, rng: np.random.Generator) -> Array:
    """Rates that a ring laser turning steadily tells while the power scattered back goes from 0 to 1.

    Coupled amplitudes add, so that the lock-in rate goes with the root of the power; it is `lock_in_rate` at 1.
    """
    theta, step = resting_case(0.01, 3000)
    steady = np.full(len(power), rate)
    return counted_rate(steady, lock_in_rate * np.sqrt(power), FRINGE, step, theta, rng)


def unequal_beams(loss: Array, gain: float, pulling: float) -> tuple[Array, Array]:
    """Rate and monitor of a ring laser whose beams lose (1 ± loss) of what one pass does, at `gain` over that.

    Each intensity is what its gain has over its loss; each frequency is pulled in proportion to its own intensity. The
    monitor is the difference of the photocurrents over their sum.
    """
    first, second = gain - (1 + loss), gain - (1 - loss)
    return pulling * (first - second), (first - second) / (first + second)


def precession(current: Array, temperature: Array, constants: tuple[float, float, float]) -> Array:
    """Rate at which a current turns a gyro, less what it would do at 20 °C through an equal bridge (per ampere: 1).

    `constants`: nominal scale's error, difference of the bridge's two halves, reversible loss of the magnet per degree.
    """
    error, unequal, loss = constants
    through = np.where(current > 0, 1 + unequal / 2, 1 - unequal / 2) * current
    return (1 + error) * through * (1 - loss * (temperature - 20)) - current
