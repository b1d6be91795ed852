"""Smooth functions of what an unknown discrepancy may follow, as columns that the search weighs beside the names'."""

from __future__ import annotations

from collections.abc import Container, Iterator, Sequence
from itertools import combinations

import numpy as np

from gyromodel.declarations import EARLIER, RATE_OF
from gyromodel.diagnosis._drivers import CLOCK_DRIVER, RECOVERY_DRIVER, RESPONSE_DRIVER, driver_names, kind_of
from gyromodel.effects._shapes import beyond_earth
from gyromodel.effects.dynamics import resolved
from gyromodel.signals import Record, thermometer_rate
from gyromodel.units import is_angle

# Name of a driver, values of its first column, and columns of a function.
Smooth = tuple[str, np.ndarray, np.ndarray]
# Length scales of the smooth functions, as parts of the driver's range; and of ripples over a measured column.
SMOOTH_SCALES, RIPPLE = (0.08, 0.2, 0.5), 0.03
PAIR_SCALES = (0.25, 0.6)
# Periods over a slow column's range of what repeats along it, more often than those ripples can; of how many of the
# first columns; less those whose phase departs less (rad) from a straight line in time: they are lines.
PERIODS, SWEPT, STRAIGHT = tuple(np.arange(10.0, 60.5, 0.5)), 3, 1.0
# Thresholds of a column at which something may switch: as many, with as many samples between; less those that a column
# crosses about once, of which this part of the variance or more is a step's in time.
THRESHOLDS, ONE_STEP = 63, 0.9
# Samples in which a torquer warms up, at the least: from row to row of a table it would be a curve over the rate.
WARMING = 4
# A thermometer of which the rate's power explains this part, but for noise, measures what the rate warms, unless this
# part or more is noise.
WARMED, MOSTLY_NOISE = 0.9, 0.9
# Columns of one kind whose product no effect holds.
UNLIKE = {"rate", "rate_output"}, {"rate_output", "rate_spin"}
# Rates crowd where their order places one this far, of the whole range, from where its value does.
CROWDED = 0.1
# A column has a past worth looking at if its steps from row to row are this small beside its own variation; through how
# long a lag what remembers it follows, as parts of a run, and as how smooth a function.
SLOW, LAGS = 0.05, tuple(0.01 * 2.0 ** (k / 2) for k in range(9))
# Samples before and after, whose rates stand for a linear response of any form (those after for its smooth part at the
# ends of a run), and the least part of steps at which rates move.
RESPONSE, MOVING = (13, 5, 2, 1, -1, -2), 0.5
# A rate is held in steps if its changes from row to row have this part of its variance or less in mean square: rates
# in random order that are held for four rows each have a half. The shortest lag of what follows it, in samples, is felt
# in the first after each step alone.
HELD, SHORTEST = 0.45, 0.25


def smooths(record: Record) -> Iterator[Smooth]:
    """Name, values of the first column, and columns of each smooth function, one a length scale."""
    names = _ordered(record)
    yield from _alone(record, names)
    if record.domain == "gyro" and "rate" in names:
        yield from _response(record)
        yield from _heated(record)
        yield from ((RECOVERY_DRIVER, late, late[:, None]) for _, late in recoveries(record))
    for name in (n for n in names if n not in ("rate", "campaign") and _slow(record, n)):
        if not is_angle(record.units[name]):  # it may wrap round, which is no rate of change; its harmonics have names
            if name in names[:SWEPT]:
                yield from _periodic(record, name)
            yield from _remembered(record, name, names)
    yield from _paired(record, names)


def _ordered(record: Record) -> list[str]:
    """Measured columns that vary, those that matter most first: what repeats with an oscillation follows its angle."""
    first = ("rate", "temperature") if record.domain == "gyro" else ("table", "table_rate")
    return sorted(driver_names(record), key=lambda n: first.index(n) if n in first else len(first))


def _alone(record: Record, names: Sequence[str]) -> Iterator[Smooth]:
    """Functions of one column, and of time."""
    for name in (*names, "time"):
        scales = SMOOTH_SCALES if name == "time" else (RIPPLE, *SMOOTH_SCALES)
        yield from _of_one(record, f"smooth({name})", np.asarray(record.signals[name]), scales)
        if name not in ("rate", "time", "campaign"):
            yield from _switches(record, name)
    if "rate" in names and (places := _places(record)) is not None:
        yield "smooth(rate)", np.asarray(record.signals["rate"]), _bumps(record, places, SMOOTH_SCALES[0])


def _remembered(record: Record, name: str, names: Sequence[str]) -> Iterator[Smooth]:
    """Functions of a column's rate, and of what follows it through lags."""
    for derived, values, scales in _history(record, name):
        yield from _of_one(record, f"smooth({derived})", values, scales)
        # In proportion, with no more of a shape. A bias that follows a thermometer so is in the catalogue.
        if kind_of(record, name) != "temperature":
            yield f"smooth({derived})", values, _product(record, values)
        elif "rate" in names and derived == EARLIER.format(name):
            rate = np.asarray(record.signals["rate"])
            yield f"smooth(rate, {derived})", rate, _product(record, rate, values)


def _paired(record: Record, names: Sequence[str]) -> Iterator[Smooth]:
    """Functions of two columns, those that matter most first; of the rate and time, too."""
    gyro = record.domain == "gyro"
    few = names[: 3 if gyro else 2]
    pairs = [*combinations(few, 2), *([("rate", "time")] if gyro and "rate" in names else [])]
    for a, b in pairs:
        x, y = (np.asarray(record.signals[n]) for n in (a, b))
        for scale in PAIR_SCALES:
            of_x, of_y = _bumps(record, x, scale), _bumps(record, y, scale)
            yield f"smooth({a}, {b})", x, (of_x[:, :, None] * of_y[:, None, :]).reshape(len(x), -1)
        if a == "rate":  # a scale factor that ripples, or jumps
            yield f"smooth({a}, {b})", x, x[:, None] * _bumps(record, y, SMOOTH_SCALES[0])
        if b == "time":
            yield from ((f"smooth({a}, {b})", x, _product(record, x, above)) for above in _levels(record, y))


def products(record: Record, known: Container[str]) -> Iterator[Smooth]:
    """Name, values of the first column, and product of each pair of columns, less those known.

    The rate is paired with its own rate, too, and that with time, as clocks that run apart make a delay grow. All pairs
    as smooth functions would be too many. A product is what an effect becomes whose size follows another column, such
    as a mass unbalance that changes with temperature. Columns of one kind have effects of their own.
    """
    names = [n for n in _ordered(record) if n != "campaign"] if record.domain == "gyro" else []
    for a, b in combinations(names, 2):
        alike = kind_of(record, a) == kind_of(record, b) and {a, b} not in UNLIKE
        if alike or (a not in ("rate", "temperature") and (is_angle(record.units[a]) or is_angle(record.units[b]))):
            continue
        if f"smooth({a}, {b})" not in known and f"smooth({b}, {a})" not in known:
            x, y = (np.asarray(record.signals[n]) for n in (a, b))
            yield f"smooth({a}, {b})", x, _product(record, x, y)
    if "rate" in names and (runs := _turning(record)):
        (rate, time), along = (np.asarray(record.signals[n]) for n in ("rate", "time")), _acceleration(record, runs)
        yield f"smooth(rate, {RATE_OF.format('rate')})", rate, _product(record, rate, along)
        yield CLOCK_DRIVER, along, _product(record, along, time)


def _product(record: Record, *columns: np.ndarray) -> np.ndarray:
    """Of two columns, less their means."""
    return np.prod([v - v[: record.rows].mean() for v in columns], axis=0)[:, None]


def _of_one(
    record: Record, name: str, values: np.ndarray, scales: tuple[float, ...] = SMOOTH_SCALES
) -> Iterator[Smooth]:
    for scale in scales:
        yield name, values, _bumps(record, values, scale)


def _bumps(record: Record, values: np.ndarray, scale: float) -> np.ndarray:
    """Gaussian bumps one length scale apart over the range of a column."""
    inside = values[: record.rows]
    centres = np.linspace(0.0, 1.0, round(1.0 / scale) + 1)
    part = (values - inside.min()) / np.ptp(inside)
    return np.exp(-0.5 * ((part[:, None] - centres) / scale) ** 2)


def _periodic(record: Record, name: str) -> Iterator[Smooth]:
    """A sine along a column, as light that interferes with itself makes it; in time, it passes for lines."""
    values = np.asarray(record.signals[name])
    inside, time = values[: record.rows], np.asarray(record.signals["time"])
    trends = [(rows, np.polyfit(time[rows], inside[rows], min(1, len(rows) - 1))) for rows in _runs(record)]
    departs = np.sqrt(sum(np.sum((inside[r] - np.polyval(line, time[r])) ** 2) for r, line in trends) / record.rows)
    for turn in 2.0 * np.pi * np.array(PERIODS) / np.ptp(inside):
        if turn * departs > STRAIGHT:
            yield f"smooth({name})", values, np.column_stack([np.cos(turn * values), np.sin(turn * values)])


def _switches(record: Record, name: str) -> Iterator[Smooth]:
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


def _heated(record: Record) -> Iterator[Smooth]:
    """The rate's power through lags, as a root mean square and as it is: what a torquer or a motor warms.

    None where a thermometer measures it: beside its noise, what is computed would stand for what it shows.
    """
    runs, extra = _runs(record), (0, len(record.signals["time"]) - record.rows)
    time, rate = (np.asarray(record.signals[n])[: record.rows] for n in ("time", "rate"))
    lags = [lag for lag in _lags(time, runs) if lag > WARMING * record.interval]
    powers = [np.concatenate([_followed(time[rows], rate[rows] ** 2, lag) for rows in runs]) for lag in lags]
    if any(_measures(record, name, power) for name in driver_names(record) for power in powers):
        return
    for power in (np.pad(p, extra, mode="edge") for p in powers):
        yield f"smooth({EARLIER.format('rate')})", np.sqrt(power), _product(record, power)


def recoveries(record: Record) -> Iterator[tuple[float, np.ndarray]]:
    """Time constants, and how far what follows the rate through such a lag is behind it, where rates are held in steps.

    None where the rate is known between samples: a lag has a name there.
    """
    runs, extra = _runs(record), (0, len(record.signals["time"]) - record.rows)
    time, rate = (np.asarray(record.signals[n])[: record.rows] for n in ("time", "rate"))
    steps = np.concatenate([np.diff(rate[rows]) for rows in runs])
    held = 0.0 < np.mean(steps**2) <= HELD * np.var(rate) if len(steps) else False
    if not held or resolved(record.signals) or not beyond_earth(record.signals):
        return
    lag, longest = SHORTEST * record.interval, _lags(time, runs)[-1]
    while lag < longest:
        late = np.concatenate([_followed(time[rows], rate[rows], lag) for rows in runs])
        yield lag, np.pad(late - rate, extra, mode="edge")
        lag *= np.sqrt(2.0)


def _measures(record: Record, name: str, values: np.ndarray) -> bool:
    """Whether a thermometer shows some values and its noise, which second differences tell."""
    shown = np.asarray(record.signals[name])[: record.rows]
    noise = np.mean(np.diff(shown, 2) ** 2) / 6.0 / np.var(shown)
    if kind_of(record, name) != "temperature" or not noise < MOSTLY_NOISE or not np.ptp(values) > 0:
        return False
    return bool(np.corrcoef(shown, values)[0, 1] ** 2 > WARMED * (1.0 - noise))


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


def _response(record: Record) -> Iterator[Smooth]:
    """Responses to a moving rate over its rate of change: any linear one by values some samples before and after."""
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
    acceleration = _acceleration(record, runs)
    yield RESPONSE_DRIVER, acceleration, before
    # And what is no linear response, such as friction's sign.
    yield from _of_one(record, RESPONSE_DRIVER, acceleration)


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
