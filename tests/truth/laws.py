"""What can be told without the levels: an oracle that knows how noise is drawn and what every effect looks like.

It knows neither the noise's levels nor whether anything is hidden, what or how large. Its evidence is exact: dense
covariances over all levels, each with the weight it is drawn with, and the prior on sizes that the engine states
(coefficients t standard errors wide, t^2 from 10 to 10^4; any white level and coefficients of the baseline).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.linalg import cholesky, solve_triangular
from scipy.special import logsumexp

from .contest import Library, orthonormal
from .designs import Design
from .noise import ANY_FLICKER, ANY_WALK, FAMILY, family

Array = np.ndarray
# Evidence (nats) from which something is said, as the engine's; sizes of the prior.
NEEDED, SIZES = 3.0, np.array([1e1, 1e2, 1e3, 1e4])


class Told(NamedTuple):
    """Shares of the posterior of each kind of noise with nothing hidden, and ln B of each signal against that.

    `anyhow` are the shares of kinds where nothing is known of levels, of some campaigns.
    """

    kinds: dict[str, float]
    evidence: dict[str, float]
    anyhow: dict[str, float] | None = None

    @property
    def said(self) -> tuple[str, ...]:
        """The smallest set of names that holds 95 % of their posterior; none where all are too weak."""
        if max(self.evidence.values(), default=-np.inf) < NEEDED:
            return ()
        order = sorted(self.evidence, key=lambda name: -self.evidence[name])
        shares = np.exp([self.evidence[name] - logsumexp(list(self.evidence.values())) for name in order])
        return tuple(order[: int(np.searchsorted(np.cumsum(shares), 0.95)) + 1])


def kinds_of_any_level(data: Array, design: Design, fixed: Array) -> dict[str, float]:
    """Shares of the posterior of each kind of noise, nothing hidden, where nothing is known of levels."""
    p, freedom = fixed.shape[1], len(data) - fixed.shape[1]
    kinds: dict[str, list[float]] = {kind: [] for kind in FAMILY}
    for kind, weight, covariance in family(design, 16, ANY_FLICKER, ANY_WALK):
        L = cholesky(covariance, lower=True, overwrite_a=True, check_finite=False)
        R = np.linalg.qr(solve_triangular(L, np.column_stack([fixed, data]), lower=True), mode="r")
        rss = R[p, p] ** 2
        plain = -np.log(np.diag(L)).sum() - np.log(np.abs(np.diag(R)[:p])).sum() - freedom / 2 * np.log(rss)
        kinds[kind].append(plain + np.log(weight))
    nothing = logsumexp([value for values in kinds.values() for value in values])
    return {kind: float(np.exp(logsumexp(values) - nothing)) for kind, values in kinds.items()}


def tell(data: Array, design: Design, fixed: Array, signals: Library) -> Told:
    """Weigh everything; kinds of noise are as likely, and so are names. `fixed`: columns of the baseline."""
    flat = [block.reshape(len(data), -1) / np.abs(block).max() for block in signals.values()]
    stacked = np.column_stack([fixed, *flat, data])
    p, freedom = fixed.shape[1], len(data) - fixed.shape[1]
    kinds: dict[str, list[float]] = {kind: [] for kind in FAMILY}
    evidence: dict[str, list[float]] = {name: [] for name in signals}
    for kind, weight, covariance in family(design):
        L = cholesky(covariance, lower=True)
        whitened = solve_triangular(L, stacked, lower=True)
        Q, R = np.linalg.qr(whitened[:, :p])
        left = whitened[:, p:] - Q @ (Q.T @ whitened[:, p:])
        residual, at = left[:, -1], 0
        rss = residual @ residual
        plain = -np.log(np.diag(L)).sum() - np.log(np.abs(np.diag(R))).sum() - freedom / 2 * np.log(rss)
        kinds[kind].append(plain + np.log(weight))
        for name, block in signals.items():
            _, shapes, columns = block.shape
            unit = orthonormal(left[:, at : at + shapes * columns].reshape(block.shape))
            part = np.sum(np.tensordot(residual, unit, 1) ** 2, axis=-1) / rss
            at += shapes * columns
            each = [-freedom / 2 * np.log1p(-t / (1 + t) * part) - columns / 2 * np.log1p(t) for t in SIZES]
            evidence[name].append(kinds[kind][-1] + logsumexp(each) - np.log(np.size(each)))
    nothing = logsumexp([value for values in kinds.values() for value in values])
    return Told(
        {kind: float(np.exp(logsumexp(values) - nothing)) for kind, values in kinds.items()},
        {name: float(logsumexp(values) - nothing) for name, values in evidence.items()},
    )
