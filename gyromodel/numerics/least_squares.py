"""Scaled Levenberg-Marquardt on accumulated normal equations: the state carries JᵀJ and Jᵀr, never J.

Marquardt's damping in the metric of the columns' norms; a non-finite trial is a rejected one. The loop runs on the host,
so that any model is fitted without compiling anything for its structure.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve

Normal = tuple[np.ndarray, np.ndarray, float]


class Solution(NamedTuple):
    """The minimum, the sum of squares there, and how the search ended."""

    x: np.ndarray
    cost: float
    iterations: int
    converged: bool


def levenberg_marquardt(
    normal: Callable[[np.ndarray], Normal],
    start: np.ndarray,
    tolerance: float = 1e-10,
    maximum_iterations: int = 60,
) -> Solution:
    """Minimise |r(x)|².

    Args:
        normal: returns (JᵀJ, Jᵀr, rᵀr) at a point, J the derivative of r.
        start: where to begin; the first step is a full Gauss-Newton step, exact for a linear problem.
        tolerance: relative decrease of the cost that still counts.
        maximum_iterations: trials allowed, rejected ones included.
    """
    x = np.array(start, float)
    a, g, cost = normal(x)
    damping = 1e-14
    for iteration in range(1, maximum_iterations + 1):
        norm = np.sqrt(np.maximum(np.diag(a), 1e-300))
        try:
            factor = cho_factor(a / np.outer(norm, norm) + damping * np.eye(len(x)))
        except (LinAlgError, ValueError):
            if damping > 1e8 or not np.isfinite(a).all():
                return Solution(x, cost, iteration, False)
            damping = max(8.0 * damping, 1e-8)
            continue
        step = -cho_solve(factor, g / norm) / norm
        promise = -float(g @ step)
        if promise <= tolerance * cost:
            return Solution(x, cost, iteration, True)
        a_new, g_new, cost_new = normal(x + step)
        finite = np.isfinite(cost_new) and np.isfinite(a_new).all() and np.isfinite(g_new).all()
        if finite and cost_new <= cost:
            decrease = cost - cost_new
            x, a, g, cost = x + step, a_new, g_new, cost_new
            damping = max(0.1 * damping, 1e-14)
            if decrease <= tolerance * cost:
                return Solution(x, cost, iteration, True)
        else:
            damping = max(8.0 * damping, 1e-4)
    return Solution(x, cost, maximum_iterations, False)
