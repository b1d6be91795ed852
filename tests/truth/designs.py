"""Campaigns without output: what the table, the chamber and the sensors did. Everything is drawn off any grid."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.signal import lfilter

Array = np.ndarray
FINE = 2.0  # s, step of the thermal history
THERMOMETER = 2e-3  # degC
RAMP_CODES = 4096  # of a closed loop's ramp converter


@dataclass(frozen=True)
class Design:
    """A campaign plan as lived: measured columns in file units, true ones in SI with degC, g and gauss."""

    name: str
    step: float  # s
    index: np.ndarray  # rows on the regular grid time = index * step
    columns: dict[str, Array]
    units: dict[str, str]
    metadata: dict[str, str | int | float]
    true: dict[str, Array]
    thermal: tuple[Array, Array]  # fine time, temperature
    white: tuple[float, float] = (-2.5, -0.5)  # decades of the gyro's angle random walk, deg/sqrt(h)
    motion: Mapping[str, Any] | None = None  # rates by axis as functions of time, where they are known between samples

    @property
    def rotates(self) -> bool:
        """Whether the input rate varies."""
        return bool(np.ptp(self.true["rate"]) > 0)


def _lag(setpoint: Array, tau: float) -> Array:
    """First-order thermal lag on the fine grid."""
    a = np.exp(-FINE / tau)
    return lfilter([1 - a], [1.0, -a], setpoint, zi=[a * setpoint[0]])[0]


def _wander(time: Array, size: float, tau: float, rng: np.random.Generator) -> Array:
    """Slowly wandering quantity of standard deviation `size`: twice-filtered white noise."""
    grid = np.arange(-10 * tau, time[-1] + tau, tau / 20)
    drive = rng.standard_normal(len(grid))
    for _ in range(2):
        drive = np.asarray(lfilter([0.05], [1.0, -0.95], drive))
    return size * np.interp(time, grid, drive / drive[grid >= 0].std())


def _build(
    name: str,
    index: np.ndarray,
    step: float,
    rate: Array,
    thermal: tuple[Array, Array],
    extra: dict[str, tuple[Array, float, str]],
    metadata: dict[str, str | int | float],
    rng: np.random.Generator,
) -> Design:
    """Attach sensor noise to the true columns; `extra` maps name to (true values, sensor noise, unit)."""
    time = index * step
    fine_time, fine_temperature = thermal
    temperature = np.interp(time, fine_time, fine_temperature)
    true = {"time": time, "rate": rate, "temperature": temperature}
    true["temperature_rate"] = np.interp(time, fine_time, np.gradient(fine_temperature, FINE))
    columns = {"time": time, "rate": np.rad2deg(rate)}
    columns["temperature"] = temperature + THERMOMETER * rng.standard_normal(len(time))
    units = {"time": "s", "rate": "deg/s", "temperature": "degC"}
    for column, (values, noise, unit) in extra.items():
        true[column] = values
        columns[column] = values + noise * rng.standard_normal(len(time))
        units[column] = unit
    base: dict[str, str | int | float] = {"kind": "rate", "gyro": "fog", "time_since_power_on": 0.0}
    return Design(name, step, index, columns, units, base | metadata, true, thermal)


def _thermal(
    times: Array, temperatures: Array, tau: float, cycling: float, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Chamber set points through the gyro's lag, with a little chamber cycling on top."""
    time = np.arange(0.0, times[-1] + FINE, FINE)
    period, phase = rng.uniform(0.06, 0.12) * times[-1], rng.uniform(0, 2 * np.pi)
    setpoint = np.interp(time, times, temperatures) + cycling * np.sin(2 * np.pi * time / period + phase)
    return time, _lag(setpoint, tau)


def rate_temperature(rng: np.random.Generator) -> Design:
    """A: 11 plateaus up and down the range, 21 rates in random order in each, 4 samples a rate, gaps between."""
    step, plateaus, levels, repeats = 20.0, 11, 21, 4
    low, high = rng.uniform(-35, -20), rng.uniform(50, 65)
    ladder = np.linspace(low, high, plateaus)
    targets = np.concatenate([ladder[::2], ladder[1::2][::-1]]) + rng.uniform(-2, 2, plateaus)
    if rng.random() < 0.5:
        targets = low + high - targets
    rows = levels * repeats
    gaps = rng.integers(45, 90, plateaus)
    starts = np.concatenate([[0], np.cumsum(rows + gaps)[:-1]])
    index = np.concatenate([s + np.arange(rows) for s in starts])
    ramp = 0.5 * gaps * step  # the chamber ramps in the first half of a gap
    ends = (starts + rows) * step
    times = np.concatenate([[0.0], np.column_stack([ends[:-1], ends[:-1] + ramp[:-1]]).ravel(), [ends[-1]]])
    set_points = np.repeat(targets, 2)
    thermal = _thermal(times, set_points, rng.uniform(240, 420), rng.uniform(0.05, 0.2), rng)
    table = np.deg2rad(rng.uniform(80, 150)) * np.linspace(-1, 1, levels)
    rate = np.concatenate([np.repeat(rng.permutation(table), repeats) for _ in range(plateaus)])
    time = index * step
    extra = {
        "segment": (np.repeat(np.arange(plateaus, dtype=float), rows), 0.0, ""),
        "supply_voltage": (5.0 + _wander(time, 0.03, 900.0, rng), 2e-4, "V"),
    }
    return _build("rate_temperature", index, step, rate, thermal, extra, {"test": "rate_table_thermal"}, rng)


def static_cycle(rng: np.random.Generator) -> Design:
    """B: five hours at rest, temperature up and down with soaks and three ramp speeds, other channels wandering."""
    step, n = 20.0, 900
    durations = np.array([20, 40, 30, 110, 30, 50, 20]) * rng.uniform(0.85, 1.15, 7)
    times = np.concatenate([[0.0], np.cumsum(durations) / durations.sum()]) * n * step
    heights = np.array([0.1, 0.1, 1.0, 1.0, 0.0, 0.0, 0.7, 0.7]) + np.repeat(rng.uniform(-0.04, 0.04, 4), 2)
    thermal = _thermal(times, rng.uniform(0, 15) + rng.uniform(30, 45) * heights, rng.uniform(400, 700), 0.1, rng)
    index = np.arange(n)
    time = index * step
    extra = {
        "supply_voltage": (5.0 + _wander(time, 0.03, 600.0, rng), 2e-4, "V"),
        "pressure": (1.01e5 + _wander(time, 300.0, 1200.0, rng), 2.0, "Pa"),
        "laser_current": (0.1 + _wander(time, 2e-3, 400.0, rng), 1e-5, "A"),
    }
    return _build("static_cycle", index, step, np.zeros(n), thermal, extra, {"test": "static_thermal"}, rng)


def rate_steps(rng: np.random.Generator) -> Design:
    """C: 25 rates (12 a sign and rest) in random order, four visits of 10 s, temperature drifting by a few degrees."""
    step, visits, hold = 1.0, 4, 10
    table = np.deg2rad(rng.uniform(70, 100)) * np.linspace(-1, 1, 25)
    rate = np.concatenate([np.repeat(rng.permutation(table), hold) for _ in range(visits)])
    index = np.arange(len(rate))
    times: Array = np.array([0.0, rng.uniform(0.35, 0.55), 1.0]) * len(rate)
    start, rise = rng.uniform(15, 35), rng.uniform(3, 6)
    thermal = _thermal(times, start + rise * np.array([0.0, 1.0, 0.35]), rng.uniform(60, 120), 0.3, rng)
    return _build("rate_steps", index, step, rate, thermal, {}, {"test": "rate_table"}, rng)


def static_ramp(rng: np.random.Generator) -> Design:
    """D: at rest through one monotone ramp: temperature, time and lag cannot be told apart."""
    step, n = 20.0, 900
    start, rise = rng.uniform(5, 15), rng.uniform(25, 40)
    thermal = _thermal(np.array([0.0, n * step]), np.array([start, start + rise]), rng.uniform(400, 700), 0.0, rng)
    return _build("static_ramp", np.arange(n), step, np.zeros(n), thermal, {}, {"test": "static_ramp"}, rng)


def one_speed_cycle(rng: np.random.Generator) -> Design:
    """E: at rest, temperature up and down at one speed without soaks: lag, Shupe and hysteresis hardly differ."""
    step, n = 20.0, 900
    low, rise, tau = rng.uniform(0, 15), rng.uniform(30, 45), rng.uniform(200, 300)
    legs = np.linspace(0.0, n * step, 5)
    thermal = _thermal(legs, low + rise * np.array([0.0, 1.0, 0.0, 1.0, 0.0]), tau, 0.0, rng)
    return _build("one_speed_cycle", np.arange(n), step, np.zeros(n), thermal, {}, {"test": "static_thermal"}, rng)


def repeated_runs(rng: np.random.Generator) -> Design:
    """F: six power cycles at rest, off between them, in a room whose temperature wanders."""
    step, runs, rows = 20.0, 6, 150
    off = rng.integers(40, 90, runs)
    index = np.concatenate([k * rows + off[:k].sum() + np.arange(rows) for k in range(runs)])
    fine = np.arange(0.0, (index[-1] + 2) * step, FINE)
    thermal = fine, rng.uniform(20, 25) + _wander(fine, 1.5, 4000.0, rng)
    extra = {
        "run": (np.repeat(np.arange(1.0, runs + 1), rows), 0.0, ""),
        "supply_voltage": (5.0 + _wander(index * step, 0.03, 900.0, rng), 2e-4, "V"),
    }
    return _build("repeated_runs", index, step, np.zeros(len(index)), thermal, extra, {"test": "static"}, rng)


def closed_loop(rng: np.random.Generator) -> Design:
    """G: at rest, the feedback ramp of a closed loop logged beside the output."""
    step, n = 0.05, 1000
    time = np.arange(n) * step
    turns = np.cumsum(rng.uniform(0.019, 0.023) * (1 + 0.01 * rng.standard_normal(n)))
    extra = {"feedback_ramp": (np.floor(RAMP_CODES * (turns % 1.0)), 0.0, "count")}
    thermal = np.arange(0.0, time[-1] + 2 * FINE, FINE), np.full(len(np.arange(0.0, time[-1] + 2 * FINE, FINE)), 25.0)
    return _build("closed_loop", np.arange(n), step, np.zeros(n), thermal, extra, {"test": "static"}, rng)


DESIGNS: dict[str, Callable[[np.random.Generator], Design]] = {
    f.__name__: f for f in (
        rate_temperature, static_cycle, rate_steps, static_ramp, one_speed_cycle, repeated_runs, closed_loop,
    )
}  # fmt: skip
