"""A fiber-optic gyro by the published output model F = S_n (I + E + D)(1 + 1e-6 eps_k), heat diffusing into its coil.

Written from a 2021 thesis on a line-of-sight stabilisation system, chapter 3: numbers in bits are those that it prints.
The environment term E is a bias over temperature that bends at two temperatures, the Shupe effect of the coil's own
warming, and terms of the difference between coil and case; the drift D is a start-up offset, a random walk, white noise
and the quantisation of the angle.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter

from .effects import coil_temperature_rate

Array = np.ndarray

# +-2.5 plot units (bit) = +-0.0076 deg/s: bit per deg/h of a sum over one second.
SCALE_FACTOR = 2.5 / (0.0076 * 3600)
# Slopes (bit/degC) of the three printed lines, and the temperatures (degC) at which these cross: one continuous curve.
SLOPES, BREAKPOINTS = (0.3386, 0.1045, 0.4082), (22.724, 31.244)
LOW, HIGH = 14.0, 42.0
COIL = 300.0  # s, diffusion time of the coil


@dataclass(frozen=True)
class Gyro:
    """Coefficients in deg/h and degC; noise of one-second sums in bit."""

    shupe: float = 0.0  # deg/h per degC/s of the coil
    gradient: float = 0.0  # deg/h per degC, case minus coil
    gradient_rate: float = 0.0  # deg/h per degC/s
    nonlinearity: float = 0.0  # ppm per (deg/s)^2
    quantisation: float = 0.68  # bit, a one-second sum's error from the angle at its ends
    white: float = 0.1  # bit
    walk: float = 0.0005  # bit per square root of a second


def chamber(hours: float, rng: np.random.Generator, step: float = 1.0) -> tuple[Array, Array]:
    """Time and case temperature: from 14 to 42 degC and back, with soaks; ramp speeds differ from run to run."""
    time = np.arange(0.0, 3600 * hours, step)
    parts = np.array([0.08, 0.32, 0.15, 0.22, 0.08, 0.15]) * rng.uniform(0.8, 1.2, 6)
    corners = np.concatenate([[0.0], np.cumsum(parts) / parts.sum()]) * time[-1]
    middle = rng.uniform(22, 30)
    targets = [LOW, LOW, HIGH, HIGH, middle, middle, rng.uniform(LOW + 1, 20)]
    decay = np.exp(-step / 240.0)
    setpoint = np.interp(time, corners, targets)
    return time, lfilter([1 - decay], [1.0, -decay], setpoint, zi=[decay * LOW])[0]


def bent_bias(temperature: Array) -> Array:
    """The continuous bias over temperature (bit in a second), from the printed slopes and breakpoints."""
    low, high = BREAKPOINTS
    below, middle, above = SLOPES
    return (
        below * (np.minimum(temperature, low) - low)
        + middle * np.clip(temperature - low, 0.0, high - low)
        + above * np.maximum(temperature - high, 0.0)
    )


def log(
    gyro: Gyro, hours: float, rng: np.random.Generator, rate: float | Array = 0.0, lsb: float = 0.0
) -> dict[str, Array]:
    """One-second sums of the output (bit), with the thermometers of case and coil (degC) and the truth in `error`.

    `rate` is the input in deg/s; `lsb` the thermometers' step. The start-up offset differs from log to log.
    """
    time, case = chamber(hours, rng)
    mean_rate = coil_temperature_rate(time[::4], case[::4], COIL)
    coil_rate = np.interp(time, time[::4], mean_rate)
    coil = case[0] + np.concatenate([[0.0], np.cumsum(0.5 * (coil_rate[1:] + coil_rate[:-1]))])
    difference_rate = np.gradient(case, time) - coil_rate
    environment = gyro.shupe * coil_rate + gyro.gradient * (case - coil) + gyro.gradient_rate * difference_rate
    n = len(time)
    drift = rng.uniform(-20, 20) + gyro.walk * np.cumsum(rng.standard_normal(n))
    error = bent_bias(case) + SCALE_FACTOR * environment
    nonlinear = 1 + 1e-6 * gyro.nonlinearity * np.square(rate)
    output = (SCALE_FACTOR * 3600 * rate + error + drift) * nonlinear + gyro.white * rng.standard_normal(n)
    output = output + np.diff(gyro.quantisation / np.sqrt(2) * rng.standard_normal(n + 1))
    thermometers = [t + 0.01 * rng.standard_normal(n) for t in (case, coil)]
    if lsb:
        thermometers = [np.round(t / lsb) * lsb for t in thermometers]
    return {
        "time": time, "output": output, "temperature": thermometers[0], "temperature_coil": thermometers[1],
        "error": error,
    }  # fmt: skip
