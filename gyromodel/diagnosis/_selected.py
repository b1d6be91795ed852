"""The interval of a size that is told because it was large: noise has helped those that only just were."""

from __future__ import annotations

import numpy as np
from scipy.optimize import brentq
from scipy.special import log_ndtr

from gyromodel.diagnosis._evidence import explained_for

# Ends of a 95 % interval, in standard deviations, and how far beyond zero none reaches.
HALF, FAR = 1.96, 12.0


def after_selection(z: float, least: float) -> tuple[float, float]:
    """95 % interval of μ from z, drawn from N(μ, 1) and seen only where |z| ≥ `least`; it covers no μ less often.

    The end towards zero is that of the truncated law, which just above `least` lies beyond zero and far above it at
    1.96; the other end is what it would be without selection.
    """
    size, cut = abs(z), min(least, abs(z))

    def above(mean: float) -> float:
        """P(Z ≥ size | |Z| ≥ cut) over what the end leaves (ln)."""
        seen = np.logaddexp(log_ndtr(mean - cut), log_ndtr(-mean - cut))
        return float(log_ndtr(mean - size) - seen - log_ndtr(-HALF))

    ends = np.copysign(1.0, z) * np.array([brentq(above, -FAR, size), size + HALF])
    return float(ends.min()), float(ends.max())


def least_told(statistic: float, threshold: float, price: float, nu: int) -> float:
    """Part of its size at which one column with so much evidence (ln B) would just have reached the threshold.

    Args:
        statistic: of the column, over its shapes and the noise.
        threshold: least that is told.
        price: what of it the search over shapes has cost (nats), less what prior odds have added.
        nu: degrees of freedom.
    """
    needed, reached = (explained_for(max(s + price, 0.0), nu, 1) for s in (threshold, statistic))
    return float(np.sqrt(min(needed / reached, 1.0)))
