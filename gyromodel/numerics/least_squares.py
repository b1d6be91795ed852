"""Scaled Levenberg-Marquardt on accumulated normal equations: the state carries JᵀJ and Jᵀr, never J.

Damping in the metric of the largest column norms met so far; a non-finite trial is a rejected one. The loop runs on
the host, so that any model is fitted without compiling anything for its structure.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve

Normal = tuple[np.ndarray, np.ndarray, float]

# Damping relative to the squared column norms: what a singular matrix needs, what the first refused step gets, and
# beyond which steps are shorter than rounding.
LEAST_DAMPING, FIRST_DAMPING, MOST_DAMPING = 1e-14, 1e-3, 1e16
# Times the tolerance by which the last refused step at a kink may be above it.
KINK_TOLERANCE = 10.0


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
    maximum_iterations: int = 100,
    damping: float = LEAST_DAMPING,
) -> Solution:
    """Minimise |r(x)|².

    Args:
        normal: returns (JᵀJ, Jᵀr, rᵀr) at a point, J the derivative of r.
        start: where to begin.
        tolerance: relative decrease of the cost that still counts.
        maximum_iterations: trials allowed, rejected ones included.
        damping: of the first step; by default that is a full Gauss-Newton step, exact for a linear problem, and 1e-3 is
            safer from a far start of a strongly curved one.
    """
    x = np.array(start, float)
    a, g, cost = normal(x)
    if not _finite(a, g, cost):
        return Solution(x, cost, 0, False)
    scale, growth, worse = np.zeros(len(x)), 2.0, np.inf
    for iteration in range(1, maximum_iterations + 1):
        scale = np.maximum(scale, np.sqrt(np.maximum(np.diag(a), 1e-300)))
        try:
            factor = cho_factor(a / np.outer(scale, scale) + damping * np.eye(len(x)))
        except LinAlgError:
            damping = max(8.0 * damping, 1e-8)
            continue
        step = -cho_solve(factor, g / scale) / scale
        promise = -float(g @ step)
        if promise <= tolerance * cost:
            # Under heavy damping a small promise says nothing: then the residual must be orthogonal to every column, or
            # the last step, so short that it cost next to nothing, still led up, as where the cost has a kink. What led
            # up by more is tried shorter.
            orthogonal = np.all(np.abs(g) <= 1e-6 * scale * np.sqrt(cost))
            converged = bool(damping < 1.0 or orthogonal or worse <= KINK_TOLERANCE * tolerance * cost)
            if converged or np.isnan(worse):
                # The last step is as good as those before it, and known already.
                return Solution(x + step if converged else x, cost, iteration, converged)
        with np.errstate(over="ignore", invalid="ignore"):  # a step too far is refused below
            a_new, g_new, cost_new = normal(x + step)
        if _finite(a_new, g_new, cost_new) and cost_new <= cost:
            decrease = cost - cost_new
            # Decrease over what the linear model promised: near one, the damping falls (Nielsen 1999, equation 2.4).
            ratio = decrease / (promise + damping * float(np.sum((scale * step) ** 2)))
            x, a, g, cost = x + step, a_new, g_new, cost_new
            if decrease <= tolerance * cost < promise:
                return Solution(x, cost, iteration, True)
            damping = max(damping * max(1 / 3, 1 - (2 * ratio - 1) ** 3), LEAST_DAMPING)
            if ratio < 0.25:
                damping = max(damping, FIRST_DAMPING)
            growth, worse = 2.0, np.inf
        else:
            worse = cost_new - cost if np.isfinite(cost_new) else np.nan
            damping, growth = max(growth * damping, FIRST_DAMPING), 2.0 * growth
            if damping > MOST_DAMPING:
                break
    return Solution(x, cost, iteration, False)


def _finite(a: np.ndarray, g: np.ndarray, cost: float) -> bool:
    return bool(np.isfinite(cost) and np.isfinite(g).all() and np.isfinite(a).all())
