"""Confidence interval of a ratio of two normal variables (Fieller 1954, J. R. Stat. Soc. B 16, 175)."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.stats import t as student


def fieller_interval(
    numerator: float,
    denominator: float,
    covariance: Float[np.ndarray, "2 2"],
    level: float = 0.95,
    degrees_of_freedom: float = np.inf,
) -> tuple[float, float]:
    """Ends of the exact confidence interval of numerator over denominator.

    Args:
        numerator: normal, measured.
        denominator: likewise.
        covariance: of the two.
        level: of confidence.
        degrees_of_freedom: behind the covariance.

    Returns:
        Lower and upper end; infinite ones where the denominator is not significantly away from zero, since the ratio
        then has no finite bound.
    """
    square = float(student.ppf(0.5 + level / 2, degrees_of_freedom)) ** 2
    # All ρ with (a − ρ b)² ≤ t² Var(a − ρ b): p ρ² − 2 q ρ + r ≤ 0.
    p = denominator**2 - square * covariance[1, 1]
    q = numerator * denominator - square * covariance[0, 1]
    r = numerator**2 - square * covariance[0, 0]
    if p <= 0:
        return -np.inf, np.inf
    half = np.sqrt(max(q**2 - p * r, 0.0))
    return float((q - half) / p), float((q + half) / p)
