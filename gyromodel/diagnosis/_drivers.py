"""What an unknown discrepancy may follow: columns, their rates, what they were before, and time; and its name.

A driver's name is "smooth(a)" or "smooth(a, b)"; d(a)/dt stands for the rate of column a, a[earlier] for what follows
it some time later: its value, or of the rate its root mean square; rate[behind] for what follows the rate itself, less
the rate.
"""

from __future__ import annotations

import re

import numpy as np

from gyromodel._checks import DERIVED, NUMBERED, thermometers
from gyromodel.declarations import BEHIND, RATE_OF, measured
from gyromodel.signals import Record

RESPONSE_DRIVER, RECOVERY_DRIVER = f"smooth({RATE_OF.format('rate')})", f"smooth({BEHIND.format('rate')})"
# A delay that grows.
CLOCK_DRIVER = f"smooth({RATE_OF.format('rate')}, time)"
# A current of which this part follows the output's noise is the output, if it is so many over the root of the samples:
# four standard errors, as neighbouring second differences of noise are alike. How many times their median are no jump.
ALIKE, CERTAIN, NO_JUMP = 0.1, 5.6, 4.0
# Two columns are one where a line leaves less than this part of the variance.
ONE_LINE = 1e-8
# What `compensate` adds is the output itself; every function of the ramp's code is bias_readout_code.
NOT_DRIVERS = ("time", "output", *NUMBERED, "feedback_ramp", "rate_estimated", "rate_estimated_std")


def is_no_driver(name: str) -> bool:
    """Whether a signal is bookkeeping, the output, or derived from others."""
    return name in NOT_DRIVERS or name.startswith("_") or bool(DERIVED.fullmatch(name))


def unusable(record: Record, name: str) -> str:
    """Why a column cannot be searched; empty where it can."""
    values = np.asarray(record.signals[name])[: record.rows][record.present]
    missing = int((~np.isfinite(values)).sum())
    if missing:
        return f"{name} is missing in {missing} of {len(values)} rows"
    if not np.ptp(values) > 0:
        return f"{name} does not vary"
    if name == "torquer_current" and _is_output(record, name):
        return f"{name} has the output's own noise: it is the output, in another unit"
    return ""


def proportion(one: np.ndarray, other: np.ndarray) -> tuple[float, float] | None:
    """Slope and offset of a column that goes with another in proportion, where both are known; none if it does not."""
    known = np.isfinite(one) & np.isfinite(other)
    x, y = one[known], other[known]
    if len(x) < 3 or not (np.ptp(x) > 0 and np.ptp(y) > 0):
        return None
    slope = float((x - x.mean()) @ y / np.sum((x - x.mean()) ** 2))
    offset = float(y.mean() - slope * x.mean())
    return (slope, offset) if np.var(y - slope * x - offset) < ONE_LINE * np.var(y) else None


def _is_output(record: Record, name: str) -> bool:
    """Whether a column has the output's noise: its second differences, free of the rate and of jumps, follow those."""
    names = [name, "output", *(n for n in ("rate",) if n in record.signals)]
    own, output, *rate = (np.diff(np.asarray(record.signals[n])[: record.rows][record.present], 2) for n in names)
    for turned in rate:
        if turned @ turned > 0:
            own, output = (v - turned * (turned @ v) / (turned @ turned) for v in (own, output))
    still = np.abs(own) <= NO_JUMP * np.median(np.abs(own))
    own, output = own[still], output[still]
    size = np.linalg.norm(own) * np.linalg.norm(output)
    least = max(ALIKE, CERTAIN / np.sqrt(max(len(own), 1)))
    return bool(size > 0 and abs(own @ output) > least * size)


def driver_names(record: Record) -> tuple[str, ...]:
    """Measured columns that vary: what an unknown discrepancy may follow, besides time."""
    return tuple(n for n in record.signals if not is_no_driver(n) and not unusable(record, n))


def kind_of(record: Record, name: str) -> str:
    """What a column measures, whatever its place or axis; a torquer's current follows the rate."""
    if name == "torquer_current":
        return "rate"
    thermal = name == "thermistor_resistance" or name in thermometers(record.signals)
    return "temperature" if thermal else re.split("_(?:input|output|spin|[xyz])$", name)[0]


def smooth_columns(name: str) -> tuple[str, ...]:
    """The columns a driver candidate's name holds: "smooth(rate, temperature)" → (rate, temperature)."""
    return tuple(part.strip() for part in name.removeprefix("smooth(").removesuffix(")").split(","))


def driver_unit(record: Record, column: str) -> str:
    """The file's unit of a driver's column."""
    base, form = measured(column)
    unit = record.units.get(base, "s")
    return f"{unit or '1'}/s" if form == RATE_OF else unit
