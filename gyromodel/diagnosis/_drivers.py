"""What an unknown discrepancy may follow: columns, their rates, what they were before, and time, as smooth functions.

A driver's name is "smooth(a)" or "smooth(a, b)"; d(a)/dt stands for the rate of column a, a[earlier] for its value
some time before.
"""

from __future__ import annotations

import re
from collections.abc import Container, Iterator
from itertools import combinations

import numpy as np

from gyromodel._checks import DERIVED, thermometers
from gyromodel.declarations import EARLIER, RATE_OF, measured
from gyromodel.signals import Record, thermometer_rate
from gyromodel.units import is_angle

# Length scales of the smooth functions, as parts of the driver's range; and of ripples over a measured column.
SMOOTH_SCALES, RIPPLE = (0.08, 0.2, 0.5), 0.03
PAIR_SCALES = (0.25, 0.6)
# Thresholds of a column at which something may switch: as many, with as many samples between; less those that a column
# crosses about once, of which this part of the variance or more is a step's in time.
THRESHOLDS, ONE_STEP = 63, 0.9
# Samples that something warms up in, at the least: from row to row of a table it would be a curve over the rate.
WARMING = 4
# Rates crowd where their order places one this far, of the whole range, from where its value does.
CROWDED = 0.1
# A column has a past worth looking at if its steps from row to row are this small beside its own variation; through how
# long a lag what remembers it follows, as parts of a run, and as how smooth a function.
SLOW, LAGS = 0.05, tuple(0.01 * 2.0 ** (k / 2) for k in range(9))
# Samples before and after, whose rates stand for a linear response of any form (those after for its smooth part at the
# ends of a run), and the least part of steps at which rates move.
RESPONSE, MOVING = (13, 5, 2, 1, -1, -2), 0.5
RESPONSE_DRIVER = f"smooth({RATE_OF.format('rate')})"
# A current of which this part follows the output's noise is the output, if it is so many over the root of the samples:
# four standard errors, as neighbouring second differences of noise are alike. How many times their median are no jump.
ALIKE, CERTAIN, NO_JUMP = 0.1, 5.6, 4.0
# What `compensate` adds is the output itself; every function of the ramp's code is bias_readout_code.
NOT_DRIVERS = ("time", "output", "segment", "run", "position", "feedback_ramp", "rate_estimated", "rate_estimated_std")


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


def smooths(record: Record) -> Iterator[tuple[str, np.ndarray, np.ndarray]]:
    """Name, values of the first column, and columns of each smooth function, one a length scale."""
    names = driver_names(record)
    for name in (*names, "time"):
        scales = SMOOTH_SCALES if name == "time" else (RIPPLE, *SMOOTH_SCALES)
        yield from _of_one(record, f"smooth({name})", np.asarray(record.signals[name]), scales)
        if name not in ("rate", "time", "campaign"):
            yield from _switches(record, name)
    if "rate" in names and (places := _places(record)) is not None:
        yield "smooth(rate)", np.asarray(record.signals["rate"]), _bumps(record, places, SMOOTH_SCALES[0])
    if record.domain == "gyro" and "rate" in names:
        yield from _response(record)
        yield from _heated(record)
    for name in (n for n in names if n not in ("rate", "campaign") and _slow(record, n)):
        if is_angle(record.units[name]):
            continue  # it may wrap round, which is no rate of change
        for derived, values, scales in _history(record, name):
            yield from _of_one(record, f"smooth({derived})", values, scales)
            # In proportion to it, with no more of a shape; what follows a thermometer so is in the catalogue, but for
            # scale factors.
            if _kind(record, name) != "temperature":
                yield f"smooth({derived})", values, _product(record, values)
            elif "rate" in names and derived == EARLIER.format(name):
                rate = np.asarray(record.signals["rate"])
                yield f"smooth(rate, {derived})", rate, _product(record, rate, values)
    # What repeats with an oscillation is a function of its angle and rate.
    paired = ("rate", "temperature") if record.domain == "gyro" else ("table", "table_rate")
    rate_first = sorted(names, key=lambda n: n not in paired)[: 3 if record.domain == "gyro" else 2]
    # A scale factor that changes in time.
    with_time = ["time"] if "rate" in names and record.domain == "gyro" else []
    for i, a in enumerate(rate_first):
        for b in (*rate_first[i + 1 :], *(with_time if a == "rate" else [])):
            x, y = (np.asarray(record.signals[n]) for n in (a, b))
            for scale in PAIR_SCALES:
                of_x, of_y = _bumps(record, x, scale), _bumps(record, y, scale)
                yield f"smooth({a}, {b})", x, (of_x[:, :, None] * of_y[:, None, :]).reshape(len(x), -1)
            if a == "rate":  # a scale factor that ripples, or jumps
                yield f"smooth({a}, {b})", x, x[:, None] * _bumps(record, y, SMOOTH_SCALES[0])
            if b == "time":
                yield from ((f"smooth({a}, {b})", x, _product(record, x, above)) for above in _levels(record, y))


def products(record: Record, known: Container[str]) -> Iterator[tuple[str, np.ndarray, np.ndarray]]:
    """Name, values of the first column, and product of each pair of columns, less those known.

    The rate is paired with its own rate, too. All pairs as smooth functions would be too many. A product is what an
    effect becomes whose size follows another column, such as a mass unbalance that changes with temperature. Columns of
    one kind have effects of their own.
    """
    names = [n for n in driver_names(record) if n != "campaign"] if record.domain == "gyro" else []
    names = sorted(names, key=lambda n: n not in ("rate", "temperature"))
    for a, b in combinations(names, 2):
        alike = _kind(record, a) == _kind(record, b) and {a, b} - {"rate", "rate_output"}
        if alike or (a not in ("rate", "temperature") and (is_angle(record.units[a]) or is_angle(record.units[b]))):
            continue
        if f"smooth({a}, {b})" not in known and f"smooth({b}, {a})" not in known:
            x, y = (np.asarray(record.signals[n]) for n in (a, b))
            yield f"smooth({a}, {b})", x, _product(record, x, y)
    if "rate" in names and (runs := _turning(record)):
        rate = np.asarray(record.signals["rate"])
        yield f"smooth(rate, {RATE_OF.format('rate')})", rate, _product(record, rate, _acceleration(record, runs))


def _product(record: Record, *columns: np.ndarray) -> np.ndarray:
    """Of two columns, less their means."""
    return np.prod([v - v[: record.rows].mean() for v in columns], axis=0)[:, None]


def _kind(record: Record, name: str) -> str:
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


def _of_one(
    record: Record, name: str, values: np.ndarray, scales: tuple[float, ...] = SMOOTH_SCALES
) -> Iterator[tuple[str, np.ndarray, np.ndarray]]:
    for scale in scales:
        yield name, values, _bumps(record, values, scale)


def _bumps(record: Record, values: np.ndarray, scale: float) -> np.ndarray:
    """Gaussian bumps one length scale apart over the range of a column."""
    inside = values[: record.rows]
    centres = np.linspace(0.0, 1.0, round(1.0 / scale) + 1)
    part = (values - inside.min()) / np.ptp(inside)
    return np.exp(-0.5 * ((part[:, None] - centres) / scale) ** 2)


def _switches(record: Record, name: str) -> Iterator[tuple[str, np.ndarray, np.ndarray]]:
    """Two levels, one on either side of a threshold of a column, as a laser's mode or a converter's range has them."""
    values = np.asarray(record.signals[name])
    for above in _levels(record, values):
        if _as_one_step(above[: record.rows][record.present]) < ONE_STEP:
            yield f"smooth({name})", values, above[:, None]


def _levels(record: Record, values: np.ndarray) -> Iterator[np.ndarray]:
    """Whether a column is above a threshold, for some that part its samples evenly."""
    inside = values[: record.rows][record.present]
    for threshold in np.unique(np.quantile(inside, np.arange(1, THRESHOLDS + 1) / (THRESHOLDS + 1))):
        yield (values > threshold).astype(float)


def _as_one_step(values: np.ndarray) -> float:
    """The largest part of the variance that one step explains; all of what does not vary."""
    n, rest = len(values), values - values.mean()
    before = np.arange(1, n)
    explained = np.cumsum(rest)[:-1] ** 2 * n / (before * (n - before))
    return float(explained.max() / (rest @ rest)) if rest @ rest > 0 else 1.0


def _heated(record: Record) -> Iterator[tuple[str, np.ndarray, np.ndarray]]:
    """The rate's power through lags, as a root mean square and as it is: what a torquer or a motor warms."""
    runs, extra = _runs(record), (0, len(record.signals["time"]) - record.rows)
    time, rate = (np.asarray(record.signals[n])[: record.rows] for n in ("time", "rate"))
    for lag in (lag for lag in _lags(time, runs) if lag > WARMING * record.interval):
        power = np.concatenate([_followed(time[rows], rate[rows] ** 2, lag) for rows in runs])
        power = np.pad(power, extra, mode="edge")
        yield f"smooth({EARLIER.format('rate')})", np.sqrt(power), _product(record, power)


def _lags(time: np.ndarray, runs: list[np.ndarray]) -> list[float]:
    span = max(float(np.ptp(time[rows])) for rows in runs)
    return [lag * span for lag in LAGS]


def _places(record: Record) -> np.ndarray | None:
    """Number of each rate among the different ones, scaled to 0…1, where these crowd: near rest, as a rule."""
    rate = np.asarray(record.signals["rate"])
    different, number = np.unique(rate[: record.rows], return_inverse=True)
    places = number / (len(different) - 1)
    crowded = np.abs(places - (rate[: record.rows] - different[0]) / np.ptp(different)).max() > CROWDED
    return np.pad(places, (0, len(rate) - record.rows), mode="edge") if crowded else None


def _runs(record: Record) -> list[np.ndarray]:
    number = np.cumsum(np.asarray(record.sampling.restart)[: record.rows])
    return [np.flatnonzero(number == i) for i in np.unique(number)]


def _slow(record: Record, name: str) -> bool:
    values = np.asarray(record.signals[name])[: record.rows]
    steps = np.concatenate([np.diff(values[rows]) for rows in _runs(record)])
    return bool(np.mean(steps**2) < SLOW * np.var(values))


def _response(record: Record) -> Iterator[tuple[str, np.ndarray, np.ndarray]]:
    """Any linear response to a moving rate: its values some samples before and after, over its rate of change."""
    rate, time = (np.asarray(record.signals[n])[: record.rows] for n in ("rate", "time"))
    runs, most = _turning(record), max(RESPONSE)
    if not runs:
        return
    before = np.zeros((len(record.signals["time"]), len(RESPONSE)))
    for rows in runs:
        # Beyond its ends a run goes on as it came.
        t, r = (np.pad(v[rows], most, mode="reflect", reflect_type="odd") for v in (time, rate))
        for i, k in enumerate(RESPONSE):
            before[rows, i] = np.interp(time[rows] - k * record.interval, t, r)
    # Of columns so much alike only what is left of each beside those before can be weighed.
    inside = np.column_stack([np.ones(record.rows), rate, before[: record.rows]])
    before[: record.rows] = np.linalg.qr(inside)[0][:, 2:]
    yield RESPONSE_DRIVER, _acceleration(record, runs), before


def _turning(record: Record) -> list[np.ndarray]:
    """The rows of each run that is long enough for a response to the rate, if the rate moves; else none."""
    rate = np.asarray(record.signals["rate"])[: record.rows]
    runs = [rows for rows in _runs(record) if len(rows) > max(RESPONSE)]
    moving = runs and np.mean(np.concatenate([np.diff(rate[rows]) != 0 for rows in runs])) >= MOVING
    return runs if moving else []


def _acceleration(record: Record, runs: list[np.ndarray]) -> np.ndarray:
    """The rate's own rate in some runs."""
    rate, time = (np.asarray(record.signals[n]) for n in ("rate", "time"))
    along = np.zeros(len(rate))
    for rows in runs:
        along[rows] = np.gradient(rate[rows], time[rows])
    return along


def _history(record: Record, name: str) -> Iterator[tuple[str, np.ndarray, tuple[float, ...]]]:
    """The rate of a column, what follows the column through lags, and the scales of functions of each."""
    values, time = (np.asarray(record.signals[n])[: record.rows] for n in (name, "time"))
    extra = (0, len(record.signals["time"]) - record.rows)
    rate = np.asarray(record.signals.get(f"{name}_rate", np.zeros(0)))[: record.rows]
    rate = rate if rate.size else thermometer_rate(record, values)
    if np.isfinite(rate).all() and np.ptp(rate) > 0:
        yield RATE_OF.format(name), np.pad(rate, extra, mode="edge"), SMOOTH_SCALES
    runs = _runs(record)
    for k, lag in enumerate(_lags(time, runs)):
        late = np.concatenate([_followed(time[rows], values[rows], lag) for rows in runs])
        # What varies over a large part of the range tells every second lag from the next.
        scales = SMOOTH_SCALES if k % 2 == 0 else SMOOTH_SCALES[:1]
        yield EARLIER.format(name), np.pad(late, extra, mode="edge"), scales


def _followed(time: np.ndarray, values: np.ndarray, time_constant: float) -> np.ndarray:
    """What follows a column through a first-order lag, at rest where a run begins; a line between samples."""
    steps = np.diff(time) / time_constant
    decay = np.exp(-steps)
    mean = -np.expm1(-steps) / steps
    drive = (mean - decay) * values[:-1] + (1.0 - mean) * values[1:]
    late = values.copy()
    for i, (kept, driven) in enumerate(zip(decay, drive, strict=True)):
        late[i + 1] = kept * late[i] + driven
    return late
