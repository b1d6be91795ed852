"""Which of a few test points are anomalous: the order a robust fit puts them in, and what giving some up explains."""

from __future__ import annotations

import numpy as np


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
