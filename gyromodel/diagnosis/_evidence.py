"""Evidence ratios of added columns, and what they sum to over shapes, sizes and noise.

Prior on the added coefficients: N(0, t²σ²(AᵀA)⁻¹), σ profiled out, averaged over t² (so that small and large effects
are ranked alike) and over the candidate's shapes (which is the price of the search).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

SIZES = np.array([1e1, 1e2, 1e3, 1e4])
# ln of the evidence ratio that noise alone exceeds in 0.8 % of campaigns of the demo's design (flicker, and no bias
# simulated: 2.7 %); see benchmarks/threshold.py.
# With ν degrees of freedom it is FEW/ν more: noise that by chance leaves next to nothing of few residuals.
SAFE_THRESHOLD, FEW = 3.0, 8.0
# Data sets whose evidence is worked out at once: as many as stay in the processor's cache. Of more than these B is
# read from so many nodes, whose error is below 1e-4 while ln B stays this small.
SETS_TOGETHER, NODES, SMALL = 8, 4096, 100.0


def safe_threshold(nu: int) -> float:
    """The safe threshold of a campaign with ν degrees of freedom."""
    return SAFE_THRESHOLD + FEW / max(nu, 1)


def log_evidence_ratio(t: np.ndarray, rss: np.ndarray | float, nu: int, q: np.ndarray | int) -> np.ndarray:
    """ln B of adding q columns that explain `t` of the residual sum `rss` with ν degrees of freedom."""
    each = log_evidence_at_sizes(t, rss, nu, q)
    top = np.maximum.reduce(each)
    return np.asarray(top + np.log(sum(np.exp(e - top) for e in each) / len(SIZES)))


def log_evidence_at_sizes(
    t: np.ndarray | float, rss: np.ndarray | float, nu: int, q: np.ndarray | float | int
) -> list[Any]:
    """As `log_evidence_ratio`, at each of the prior's sizes t²."""
    part = np.clip(t / rss, 0.0, 1.0)
    half = 0.5 * np.asarray(q, float)
    # Plain log and exp, which processors vectorise; 1 − part loses nothing that matters times ν.
    return [-0.5 * nu * np.log(1.0 - size / (1.0 + size) * part) - half * np.log1p(size) for size in SIZES]


def log_mean_evidence(t: np.ndarray, rss: np.ndarray, nu: int, q: int) -> np.ndarray:
    """ln of the mean B over where q columns may stand: one row a place, one column a data set."""
    part, found = np.clip(t / rss, 0.0, 1.0), np.zeros(t.shape[1])
    most = max(float(part.max()), 1e-12)
    nodes = np.linspace(0.0, most, NODES + 1)
    few = t.shape[1] <= SETS_TOGETHER or log_evidence_ratio(nodes[-1:], 1.0, nu, q)[0] > SMALL
    b = np.zeros(0) if few else np.exp(log_evidence_ratio(nodes, 1.0, nu, q))
    rise = np.diff(b, append=b[-1:])
    for i in range(0, t.shape[1], SETS_TOGETHER):
        here = slice(i, i + SETS_TOGETHER)
        if few:
            found[here] = log_mean(log_evidence_ratio(part[:, here], 1.0, nu, q))
            continue
        x = part[:, here] * (NODES / most)
        k = x.astype(int)
        found[here] = np.log(np.mean(b[k] + (x - k) * rise[k], axis=0))
    return found


def explained_for(log_ratio: float, nu: int, q: int) -> float:
    """The χ²-like statistic ν·t/rss at which ln B reaches a value."""
    low, high = 0.0, float(nu)
    for _ in range(60):
        middle = 0.5 * (low + high)
        if log_evidence_ratio(np.array(middle), float(nu), nu, q) < log_ratio:
            low = middle
        else:
            high = middle
    return high


def log_sum(values: np.ndarray | Sequence[float]) -> float:
    """ln of the sum of exponentials."""
    each = np.asarray(values, float)
    top = float(each.max()) if each.size else -np.inf
    return top + float(np.log(np.exp(each - top).sum())) if np.isfinite(top) else top


def log_mean(values: np.ndarray) -> np.ndarray:
    """ln of the mean of exponentials over the first axis."""
    top = values.max(axis=0)
    return np.asarray(top + np.log(np.mean(np.exp(values - top), axis=0)))


def log_mean_of_parts(values: np.ndarray, starts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """`log_mean` of each part of the first axis, entries of −inf not counted, and where its largest value stands.

    Args:
        values: one row an entry, one column a data set.
        starts: first row of each part.

    Returns:
        The means, −inf where a part has no finite entry, and the row of each largest value.
    """
    lengths = np.diff(np.append(starts, len(values)))
    top = np.maximum.reduceat(values, starts, axis=0)
    spread = np.repeat(top, lengths, axis=0)
    rows = np.where(values == spread, np.arange(len(values))[:, None], len(values))
    finite = np.isfinite(values)
    total = np.add.reduceat(np.exp(np.where(finite, values - np.where(finite, spread, 0.0), -np.inf)), starts, axis=0)
    count = np.add.reduceat(finite.astype(int), starts, axis=0)
    mean = np.where(count > 0, top + np.log(np.maximum(total, 1e-300) / np.maximum(count, 1)), -np.inf)
    return mean, np.minimum.reduceat(rows, starts, axis=0)
