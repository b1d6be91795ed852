"""Which test points are anomalous: the rows of a short record or the dwells of a longer one, and the order that a
robust fit puts a few of them in; and which of many dwells stand apart from what was fitted.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import combinations
from math import comb

import numpy as np

from gyromodel._checks import NUMBERED
from gyromodel.estimate import Estimate
from gyromodel.signals import Record
from gyromodel.units import factor

# Records this short are test points, each of which may be anomalous, at most this part of them; longer ones are series
# with single gross errors, of dwells perhaps.
TEST_POINTS, MOST_POINTS = 40, 1 / 3
# A dwell is of so many samples, and a campaign of so many dwells, of which at most this part stands apart.
FEWEST_SAMPLES, FEWEST_DWELLS, MOST_APART = 4, 12, 0.2
# Robust standard deviations from which on the mean of a dwell stands apart, and is suspected.
APART, SUSPECT = 8.0, 4.0
DWELLS_TOLD = 6
# Fits through as few points as determine them: of so many, one is close to the good points. Of few parameters and fewer
# anomalous points fewer do.
FITS, DWELL_FITS, FEW_FITTED, FIRST_FITS, SOUND = 1000, 250, 3, 50, 1e-6


def test_points(record: Record) -> list[np.ndarray]:
    """The rows of each point that may be anomalous as a whole; none in a record that is no series of dwells."""
    rows = np.flatnonzero(record.present)
    if len(rows) <= TEST_POINTS:
        return list(rows[:, None])
    if record.domain != "gyro":
        return []
    number = _stretches(record)[rows]
    stretches = np.split(rows, np.flatnonzero(np.diff(number)) + 1)
    dwells = [d for d in stretches if len(d) >= FEWEST_SAMPLES]
    return dwells if len(dwells) >= FEWEST_DWELLS else []


def _stretches(record: Record) -> np.ndarray:
    """Each row's stretch of one commanded rate, position, segment and run, counted from 0."""
    rows = slice(record.rows)
    begins = np.array(record.sampling.restart)[rows]
    for name in record.signals.keys() & {"rate", *NUMBERED}:
        begins |= np.diff(np.asarray(record.signals[name])[rows], prepend=np.nan) != 0
    return np.cumsum(begins) - 1


def dwells_apart(estimate: Estimate, unit: str) -> str | None:
    """A sentence where the mean residuals of some dwells at a rate stand apart from all others.

    Noise that is estimated takes them for a slow process of its own, and leaves nothing to be found.

    Args:
        estimate: the last fit.
        unit: that errors are told in.
    """
    record = estimate.record
    if "rate" not in record.signals:
        return None
    rows, number = slice(record.rows), _stretches(record)
    error = estimate.residual[rows] / float(estimate.model.gain()) * factor(record.input_unit, unit)
    known = np.isfinite(error)
    count = np.bincount(number[known], minlength=number[-1] + 1)
    long = count >= FEWEST_SAMPLES
    if long.sum() < FEWEST_DWELLS:
        return None
    mean = np.bincount(number[known], error[known], len(count)) / np.maximum(count, 1)
    away = mean - np.median(mean[long])
    within = error[known] - mean[number[known]]
    white = 1.4826 * np.median(np.abs(within)) / np.sqrt(count[long])
    score = np.abs(away[long]) / np.maximum(white, 1.4826 * np.median(np.abs(away[long])))
    apart = np.flatnonzero(long)[score > APART]
    if not len(apart) or len(apart) > MOST_APART * long.sum():
        return None
    rate = np.asarray(record.signals["rate"])
    first = [(np.flatnonzero(number == k)[0], away[k]) for k in apart[:DWELLS_TOLD]]
    told = ", ".join(f"{d:+.3g} {unit} at {rate[r] * factor('rad/s', 'deg/s'):.4g} deg/s" for r, d in first)
    why = "" if estimate.noise_given else " estimated noise takes that for its own;"
    some = "The mean of one dwell stands" if len(apart) == 1 else f"The means of {len(apart)} dwells stand"
    return f"{some} apart from all others ({told}{', …' if len(apart) > DWELLS_TOLD else ''}):{why} repeat these rates."


def levels(record: Record, points: Sequence[np.ndarray]) -> np.ndarray:
    """Each point's rate, as a number that visits of one rate share."""
    if "rate" not in record.signals:
        return np.zeros(len(points), int)
    rate = np.asarray(record.signals["rate"])
    each = np.array([rate[p[0]] for p in points])
    order, found = np.argsort(each), np.zeros(len(points), int)
    found[order[1:]] = np.cumsum(np.diff(each[order]) > 1e-3 * np.ptp(rate[: record.rows]))
    return found


def suspects(
    points: Sequence[np.ndarray],
    level: np.ndarray,
    columns: np.ndarray,
    residuals: np.ndarray,
    most: int,
    least: float,
    fits: int,
) -> list[np.ndarray]:
    """Of each residual, the most anomalous points in the order of a robust fit; none where none is so by `least`.

    They end where no good visit of a rate would be left of several: what comes back is no anomaly.

    Args:
        points: the rows of each.
        level: the rate of each, by number.
        columns: what is fitted.
        residuals: one a column.
        most: how many at most.
        least: robust standard deviations of the first.
        fits: see `robust_orders`.
    """
    if most < 1:
        return [np.zeros(0, int)] * residuals.shape[1]
    fitted, data = (np.stack([x[p].mean(axis=0) for p in points]) for x in (columns, residuals))
    orders = robust_orders(fitted, data, fits)
    return [_not_returning(order[: most if score >= least else 0], level) for order, score in orders]


def _not_returning(order: np.ndarray, level: np.ndarray) -> np.ndarray:
    """The first of an order that leave a good visit of each rate visited again."""
    left = np.bincount(level)
    once = left == 1
    for i, k in enumerate(order):
        left[level[k]] -= 1
        if not left[level[k]] and not once[level[k]]:
            return order[:i]
    return order


def robust_orders(columns: np.ndarray, data: np.ndarray, fits: int) -> Iterator[tuple[np.ndarray, float]]:
    """Of each data set, points by how anomalous they are beside the fit of least median misfit; the first's misfit.

    Fits go through as few points as determine them: anomalous points cannot mask one another in one through good ones.

    Args:
        columns: what is fitted, at each point.
        data: at each point, one set a column.
        fits: at most so many, at random.

    Yields:
        The points' numbers, none where they are too few, and the first's misfit in robust standard deviations.
    """
    u, size, _ = np.linalg.svd(columns / np.maximum(np.linalg.norm(columns, axis=0), 1e-300), full_matrices=False)
    u = u[:, size > 1e-9]
    n, p = u.shape
    if n < 2 * p:
        yield from [(np.zeros(0, int), 0.0)] * data.shape[1]
        return
    if comb(n, p) <= fits:
        through = np.array(list(combinations(range(n), p)), int)
    else:
        through = np.random.default_rng(0).integers(n, size=(fits, p))
    sound = np.abs(np.linalg.det(u[through]))
    through = through[sound >= SOUND * sound.max()]
    solved, half = np.linalg.inv(u[through]), p + (n - p) // 2
    # An order needs no more than single precision.
    solved, u = solved.astype(np.float32), u.astype(np.float32)
    misfit = np.zeros((len(through), n), np.float32)
    for y in data.T.astype(np.float32):
        np.matmul(np.einsum("kij,kj->ki", solved, y[through]), u.T, out=misfit)
        np.abs(np.subtract(misfit, y, out=misfit), out=misfit)
        # Medians are sought where they may be the least: where more than half lie within the least of a few.
        least = np.partition(misfit[:FIRST_FITS], half, axis=1)[:, half].min()
        able = np.flatnonzero(np.count_nonzero(misfit <= least, axis=1) > half)
        median = np.partition(misfit[able], half, axis=1)[:, half]
        best = misfit[able[np.argmin(median)]]
        yield np.argsort(-best), float(best.max()) / max(1.4826 * float(median.min()), 1e-300)
