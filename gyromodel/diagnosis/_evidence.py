"""Evidence ratios of added columns, and what they sum to over shapes, sizes and noise.

Prior on the added coefficients: N(0, t²σ²(AᵀA)⁻¹), σ profiled out, averaged over t² (so that small and large effects
are ranked alike) and over the candidate's shapes (which is the price of the search).
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import numpy as np

SIZES = np.array([1e1, 1e2, 1e3, 1e4])
# ln of the evidence ratio that noise alone exceeds in 0.8 % of campaigns of the demo's design (flicker, and no bias
# simulated: 2.7 %); see benchmarks/threshold.py.
# With ν degrees of freedom it is FEW/ν more: noise that by chance leaves next to nothing of few residuals.
SAFE_THRESHOLD, FEW = 3.0, 8.0
# More data sets than these are draws. Their B is the nearest of so many nodes up to where ln B is HIGHEST, and no more
# than there: ln B errs by less than 3e-3 in some hundred samples, and by 0.01 in few where a threshold lies.
FEW_SETS, NODES, HIGHEST = 8, 2**15, 80.0
# Of data sets that lie one after another so many B are worked out at once, which takes a quarter of the time.
TOGETHER = 2**15


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
    half = np.asarray(0.5 * np.asarray(q, float), part.dtype)
    # Plain log and exp, which processors vectorise; 1 − part loses nothing that matters times ν.
    return [-0.5 * nu * np.log(1.0 - s / (1.0 + s) * part) - half * float(np.log1p(s)) for s in SIZES.tolist()]


def evidence_of_draws(t: np.ndarray, rss: np.ndarray, nu: int, q: int) -> np.ndarray:
    """B of adding q columns, of many data sets: one column each."""
    nodes, per_part = _nodes(nu, q)
    # Places of another integer, or in another order, would be converted, which takes longer than all the rest.
    at = np.minimum(t * (per_part / rss).astype(t.dtype), NODES - 1).astype(np.intp)
    return nodes.take(at.T, mode="clip").T if at.flags.f_contiguous else nodes.take(at, mode="clip")


def mean_evidence_of_draws(t: np.ndarray, rss: np.ndarray, nu: int, q: int) -> np.ndarray:
    """The mean of `evidence_of_draws` over the first axis: one for each data set."""
    step = max(TOGETHER // len(t), 1) if t.flags.f_contiguous else t.shape[1]
    parts = [slice(i, i + step) for i in range(0, t.shape[1], step)]
    each = [np.mean(evidence_of_draws(t[:, part], rss[part], nu, q), axis=0, dtype=float) for part in parts]
    return np.concatenate(each)


@lru_cache(maxsize=64)
def _nodes(nu: int, q: int) -> tuple[np.ndarray, float]:
    """B in the middle of even steps of t/rss, and how many steps there are from 0 to 1."""
    step = explained_for(HIGHEST, nu, q) / nu / NODES
    nodes = np.exp(log_evidence_ratio((np.arange(NODES) + 0.5) * step, 1.0, nu, q))
    return nodes.astype(np.float32), 1.0 / step


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
    total = np.maximum(total, np.finfo(total.dtype).tiny) / np.maximum(count, 1).astype(total.dtype)
    mean = np.where(count > 0, top + np.log(total), -np.inf)
    return mean, np.minimum.reduceat(rows, starts, axis=0)
