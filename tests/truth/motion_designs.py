"""Campaigns that move the gyro: a tumbling test, a turntable in the Earth's field, a table with changing rate.

Local level is east, north, up; the body's axes are input, output, spin. Where the motion between samples matters, it is
a sum of sines known at any time.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from .designs import Design, _build, _thermal

Array = np.ndarray
EARTH = np.deg2rad(15.041067) / 3600  # rad/s
ACCELEROMETER = 2e-5  # g
FIELD = 0.2  # gauss, horizontal
# Decades of angle random walk (deg/sqrt(h)): of a gyro that resolves the Earth's rate, and of one so noisy that a delay
# is found only where it is a part of a sample.
NAVIGATION, NOISY = (-4.2, -2.2), (1.0, 1.5)


@dataclass(frozen=True)
class Sines:
    """A rate (rad/s) as a sum of sines."""

    amplitude: Array
    frequency: Array  # rad/s
    phase: Array

    def __call__(self, time: Array) -> Array:
        """At any time."""
        return np.sin(np.outer(time, self.frequency) + self.phase) @ self.amplitude

    def derivative(self, time: Array) -> Array:
        """Angular acceleration."""
        return np.cos(np.outer(time, self.frequency) + self.phase) @ (self.amplitude * self.frequency)


def earth_and_gravity(turns: Array, latitude: float) -> tuple[Array, Array]:
    """Earth's rate and specific force (g) in the body, rows by attitude; `turns` holds body axes in local level."""
    earth = EARTH * np.array([0.0, np.cos(latitude), np.sin(latitude)])
    return turns @ earth, turns @ np.array([0.0, 0.0, 1.0])


def cube_attitudes() -> list[Array]:
    """The 24 right-handed ways to put body axes along local ones; rows are body axes."""
    found = []
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            matrix = np.diag(signs) @ np.eye(3)[list(order)]
            if np.linalg.det(matrix) > 0:
                found.append(matrix)
    return found


def _about(axis: int, angle: float) -> Array:
    """Rotation matrix about one axis."""
    i, j = (axis + 1) % 3, (axis + 2) % 3
    matrix = np.eye(3)
    matrix[i, i] = matrix[j, j] = np.cos(angle)
    matrix[i, j], matrix[j, i] = -np.sin(angle), np.sin(angle)
    return matrix


def _warm(rows: int, step: float, rng: np.random.Generator) -> tuple[Array, Array]:
    """Temperature up and down by a few degrees."""
    times = np.array([0.0, rng.uniform(0.35, 0.6), 1.0]) * rows * step
    start, rise = rng.uniform(15, 35), rng.uniform(3, 6)
    return _thermal(times, start + rise * np.array([0.0, 1.0, 0.35]), 0.1 * rows * step, 0.1, rng)


def _positions(name: str, attitudes: list[Array], hold: int, rng: np.random.Generator) -> Design:
    """Rest in one attitude after another; the laboratory knows where the axes point."""
    step, latitude = 10.0, np.deg2rad(rng.uniform(30, 60))
    turns = np.repeat(np.array(attitudes), hold, axis=0)
    earth, force = earth_and_gravity(turns, latitude)
    axes = ("input", "output", "spin")
    extra = {f"acceleration_{axis}": (force[:, i], ACCELEROMETER, "g") for i, axis in enumerate(axes)}
    extra |= {f"rate_{axis}": (np.rad2deg(earth[:, i]) * 3600, 0.0, "deg/h") for i, axis in enumerate(axes) if i}
    extra["position"] = (np.repeat(np.arange(len(attitudes), dtype=float), hold), 0.0, "")
    metadata = {"test": "multi_position", "rate_frame": "inertial", "latitude_deg": float(np.rad2deg(latitude))}
    thermal = _warm(len(turns), step, rng)
    design = _build(name, np.arange(len(turns)), step, earth[:, 0], thermal, extra, metadata, rng)
    true = {"turns": turns} | {f"rate_{axis}": earth[:, i] for i, axis in enumerate(axes) if i}
    return replace(design, true=design.true | true, white=NAVIGATION)


def tumble(rng: np.random.Generator) -> Design:
    """24 attitudes along the local axes, 8 between them, 4 repeated, in random order; 26 samples of 10 s each."""
    cube = cube_attitudes()
    tilts = np.deg2rad(rng.uniform(25, 65, (8, 2)))
    between = [cube[k] @ _about(0, a) @ _about(1, b) for k, (a, b) in zip(rng.permutation(24), tilts, strict=False)]
    repeated = [cube[k] for k in rng.permutation(24)[:4]]
    all_of_them = [*cube, *between, *repeated]
    return _positions("tumble", [all_of_them[k] for k in rng.permutation(len(all_of_them))], 26, rng)


def one_axis_tumble(rng: np.random.Generator) -> Design:
    """36 attitudes about a horizontal axis to the east: north and up turn together, and cannot be told apart."""
    level = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])  # input north, output east, spin down
    angles = 2 * np.pi * rng.permutation(36) / 36
    return _positions("one_axis_tumble", [_about(1, a) @ level for a in angles], 26, rng)


def _table(name: str, *, parted: bool, rng: np.random.Generator) -> Design:
    """A vertical table at rest in 24 angles and turning at ± 5 rates, four times.

    If `parted`, a coil reverses the field in every second quarter, and the gyro is turned on the table for two.
    """
    step, hold = 4.0, 5
    stops = np.deg2rad(rng.permutation(np.arange(24) * 15.0) + rng.uniform(0, 15))
    speeds = np.deg2rad(rng.uniform(2.0, 3.0) * np.concatenate([np.arange(1, 6), -np.arange(1, 6)]))
    rates, angles = [np.zeros(hold) for _ in stops], [np.full(hold, a) for a in stops]
    for speed in speeds:
        rates.append(np.full(2 * hold, speed))
        angles.append(rng.uniform(0, 2 * np.pi) + speed * step * np.arange(2 * hold))
    orders = [rng.permutation(len(rates)) for _ in range(4)]
    rate, angle = (np.concatenate([part[k] for order in orders for k in order]) for part in (rates, angles))
    rows = len(rate)
    quarter = np.arange(rows) * 4 // rows
    azimuth = angle + (quarter // 2 * np.deg2rad(rng.uniform(60, 120)) if parted else rng.uniform(0, 2 * np.pi))
    field = FIELD * np.cos(azimuth - rng.uniform(0, 2 * np.pi))
    extra = {n: (np.rad2deg(a) % 360.0, 0.0, "deg") for n, a in (("table_angle", angle), ("azimuth", azimuth))}
    if parted:
        field = field * (-1.0) ** quarter
        extra["magnetic_field"] = (field, 1e-4, "gauss")
    thermal = _warm(rows, step, rng)
    design = _build(name, np.arange(rows), step, rate, thermal, extra, {"test": "turntable"}, rng)
    true = design.true | {"table_angle": angle, "azimuth": azimuth, "magnetic_field": field}
    return replace(design, true=true, white=NAVIGATION)


def turntable(rng: np.random.Generator) -> Design:
    """Angles and rates of the table, with the gyro turned on it and the field reversed in between."""
    return _table("turntable", parted=True, rng=rng)


def one_field(rng: np.random.Generator) -> Design:
    """The same in one mounting and one field, which nobody measured: tilt, field and table cannot be told apart."""
    return _table("one_field", parted=False, rng=rng)


def _sines(lowest: float, highest: float, size: float, rng: np.random.Generator) -> Sines:
    """Sines spread evenly over the logarithm of frequency (Hz), each of the same rms."""
    frequency = 2 * np.pi * np.geomspace(lowest, highest, 14) * rng.uniform(0.95, 1.05, 14)
    return Sines(np.full(14, size / np.sqrt(7)), frequency, rng.uniform(0, 2 * np.pi, 14))


def dynamic_rates(rng: np.random.Generator) -> Design:
    """100 samples a second of three random rates from 0.15 to 4 Hz, and a shaker at six levels."""
    step, rows = 0.01, 960
    time = np.arange(rows) * step
    motion = {axis: _sines(0.15, 4.0, np.deg2rad(rng.uniform(20, 40)), rng) for axis in ("rate", "spin", "output")}
    level = np.repeat(rng.permutation(np.arange(6) * 0.6), rows // 6)  # g rms
    extra = {f"rate_{axis}": (np.rad2deg(motion[axis](time)), 0.0, "deg/s") for axis in ("spin", "output")}
    extra["vibration"] = (_mean_square(level, step, rng), 1e-3, "g^2")
    thermal = _warm(rows, step, rng)
    design = _build(
        "dynamic_rates", np.arange(rows), step, motion["rate"](time), thermal, extra, {"test": "rates"}, rng
    )
    true = {"level": level} | {f"rate_{axis}": motion[axis](time) for axis in ("spin", "output")}
    return replace(design, true=design.true | true, motion=motion, white=NOISY)


def _mean_square(level: Array, step: float, rng: np.random.Generator) -> Array:
    """Mean square (g²) over each sample of a sampled random acceleration of some rms level."""
    shaken = level[:, None] * rng.standard_normal((len(level), 64))
    return np.mean(shaken**2, axis=1)


MOTION_DESIGNS: dict[str, Callable[[np.random.Generator], Design]] = {
    f.__name__: f for f in (tumble, turntable, dynamic_rates, one_axis_tumble, one_field)
}
