"""A rate-integrating gyro in a chamber, in the units of its source: thermistor, rate table, six positions. Numpy alone.

Numbers of the source (Xu et al. 1999): scale factor 9.29 deg/h/mA, soaks every 10 °C from −40 to +60 °C, scatter of the
thermometry 0.015938 °C below and 0.007603 °C above 0 °C, ±30 deg/s. Ours, since it prints none: the slopes, the drifts,
the calibration points, the currents' noise, the latitude, the thermistor itself.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

SOAKS = np.arange(-40.0, 61.0, 10.0)  # °C
THERMOMETRY = (0.015938, 0.007603)  # °C, below and above 0 °C
EARTH = 15.041067  # deg/h
TABLE_RATE = 30.0 * 3600  # deg/h
# How the gyro lies in the six positions: columns north, east, up, of its input and of its spin axis.
INPUT_AXIS = np.array([[-1, 0, 0], [1, 0, 0], [0, 0, 1], [0, -1, 0], [0, 0, -1], [0, -1, 0]], float)
SPIN_AXIS = np.array([[0, -1, 0], [0, -1, 0], [1, 0, 0], [0, 0, 1], [1, 0, 0], [0, 0, -1]], float)


@dataclass(frozen=True)
class Unit:
    """One gyro with its thermistor and its instruments; drifts in deg/h and deg/h per g, each (at 0 °C, slope per °C).

    The thermistor's law: "steinhart_hart", a cubic in ln R that a calibration can meet exactly, or "beta", an
    exponential law whose β grows with temperature, which no cubic meets.
    """

    scale_factor: tuple[float, float]
    fixed: tuple[float, float]
    input_axis: tuple[float, float]
    spin_axis: tuple[float, float]
    rate_noise: float  # of a current on the table, relative
    position_noise: float  # of a current in the six positions, mA
    thermometry: tuple[float, float] = THERMOMETRY  # °C
    reading_noise: float = 2e-5  # of a resistance in a soak, relative
    latitude: float = np.radians(45.75)
    law: str = "steinhart_hart"
    calibration: np.ndarray = field(default_factory=lambda: np.repeat(np.arange(-40.0, 61.0, 5.0), 2))  # °C

    def resistance(self, celsius: np.ndarray) -> np.ndarray:
        """Resistance in ohm, a 10 kΩ thermistor."""
        kelvin = np.asarray(celsius, float) + 273.15
        if self.law == "beta":
            return 1e4 * np.exp((3900 + 0.6 * (kelvin - 298.15)) * (1 / kelvin - 1 / 298.15))
        low, high = np.full(kelvin.shape, 0.0), np.full(kelvin.shape, 20.0)
        for _ in range(60):
            middle = (low + high) / 2
            colder = 1 / (1.129e-3 + 2.34e-4 * middle + 1e-7 * middle**2 + 8.6e-8 * middle**3) > kelvin
            low, high = np.where(colder, middle, low), np.where(colder, high, middle)
        return np.exp((low + high) / 2)


# Currents with the scatter of the source's table: 0.0037 of 9.29 deg/h/mA, 0.1 deg/h.
SOURCE = Unit((9.29, -0.0019), (0.9, 0.02), (1.5, 0.01), (-2.0, 0.015), rate_noise=5.6e-4, position_noise=0.015)
# The same thermometer beside currents read to 5 ppm, and a torquer magnet without compensation (−0.11 %/°C).
PRECISE = replace(
    SOURCE,
    scale_factor=(9.29, -0.0102),
    fixed=(0.9, 0.05),
    input_axis=(1.5, 0.03),
    spin_axis=(-2.0, 0.04),
    rate_noise=5e-6,
    position_noise=5e-5,
)


@dataclass(frozen=True)
class Campaign:
    """What the laboratory wrote down: ohm, °C, mA."""

    calibration_resistance: np.ndarray
    calibration_temperature: np.ndarray
    soak_resistance: np.ndarray
    table_currents: np.ndarray  # soak × (+rate, −rate)
    position_currents: np.ndarray  # soak × 6
    soak_temperature: np.ndarray  # the true one


def simulate(unit: Unit, rng: np.random.Generator) -> Campaign:
    """One campaign: calibration, then soaks that miss their nominal temperature by some tenths of a degree."""
    spread = np.where(unit.calibration < 0, *unit.thermometry)
    reference = unit.calibration + spread * rng.standard_normal(len(spread))
    t = SOAKS + rng.uniform(-0.3, 0.3, len(SOAKS))
    readings = unit.resistance(t) * np.exp(unit.reading_noise * rng.standard_normal(len(t)))
    sf, df, di, ds = (at_zero + slope * t for at_zero, slope in unit_lines(unit))
    earth = EARTH * np.array([np.cos(unit.latitude), 0.0, np.sin(unit.latitude)])
    positions = np.empty((len(t), 6))
    for k in range(6):
        down_input, down_spin = -INPUT_AXIS[k, 2], -SPIN_AXIS[k, 2]
        positions[:, k] = (df + di * down_input + ds * down_spin + INPUT_AXIS[k] @ earth) / sf
    positions += unit.position_noise * rng.standard_normal(positions.shape)
    # The table carries the gyro with its input axis up.
    table = np.stack([(df - di + earth[2] + sign * TABLE_RATE) / sf for sign in (1, -1)], axis=1)
    table *= 1 + unit.rate_noise * rng.standard_normal(table.shape)
    return Campaign(unit.resistance(unit.calibration), reference, readings, table, positions, t)


def unit_lines(unit: Unit) -> list[tuple[float, float]]:
    """Scale factor and drifts at 0 °C and per °C, in the order of the source."""
    return [unit.scale_factor, unit.fixed, unit.input_axis, unit.spin_axis]
