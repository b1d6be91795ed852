"""Which test points are anomalous: the order a robust fit puts a few in, what giving some up explains, and which of
many dwells stand apart.
"""

from __future__ import annotations

import numpy as np

from gyromodel.estimate import Estimate
from gyromodel.units import factor

# A dwell is of so many samples, and a campaign of so many dwells, of which at most this part stands apart.
FEWEST_SAMPLES, FEWEST_DWELLS, MOST_APART = 4, 12, 0.2
# Robust standard deviations from which on the mean of a dwell stands apart.
APART = 8.0
DWELLS_TOLD = 6


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
    rows = slice(record.rows)
    keys = [np.asarray(record.signals[n])[rows] for n in ("rate", "segment", "run", "position") if n in record.signals]
    begins = np.any([np.diff(k, prepend=np.nan) != 0 for k in keys], axis=0)
    number = np.cumsum(begins | np.asarray(record.sampling.restart)[rows]) - 1
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
    first = [(np.flatnonzero(number == k)[0], away[k]) for k in apart[:DWELLS_TOLD]]
    told = ", ".join(f"{d:+.3g} {unit} at {keys[0][r] * factor('rad/s', 'deg/s'):.4g} deg/s" for r, d in first)
    why = "" if estimate.noise_given else " estimated noise takes that for its own;"
    some = "The mean of one dwell stands" if len(apart) == 1 else f"The means of {len(apart)} dwells stand"
    return f"{some} apart from all others ({told}{', …' if len(apart) > DWELLS_TOLD else ''}):{why} repeat these rates."


def explained_by(left: np.ndarray, y: np.ndarray, chosen: np.ndarray) -> float:
    """Sum of squares explained by giving up the chosen points: `left` is the projected precision, y = left · data."""
    return float(y[chosen] @ np.linalg.lstsq(left[np.ix_(chosen, chosen)], y[chosen], rcond=1e-10)[0])


def robust_order(left: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Rows by how anomalous they are when that pair is held good which leaves the least median misfit.

    Every pair is tried: anomalous points cannot mask one another there.
    """
    best: tuple[float, np.ndarray] = (np.inf, np.zeros(0, int))
    for i in range(len(y)):
        for j in range(i):
            others = np.delete(np.arange(len(y)), [i, j])
            misfit = np.abs(np.linalg.lstsq(left[np.ix_(others, others)], y[others], rcond=1e-10)[0])
            median = float(np.sort(misfit)[len(others) // 2])
            if median < best[0]:
                best = (median, others[np.argsort(-misfit)])
    return best[1]
