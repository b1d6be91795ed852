"""Restricted likelihood of many noise cells at once, on the same data and regressors."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from gyromodel.noise._model import NoiseRatios, markov_sum
from gyromodel.numerics.state_space import Sampling, log_determinant_and_gram

# Cells filtered together: whole vector units, and few sizes to compile for.
CELLS_TOGETHER, FEW_CELLS = 32, 8
THREADS = 2
COLUMN_STEP = 8


class CellFit(NamedTuple):
    """Per noise cell: ln restricted likelihood (white variance profiled out) and residual sum of squares."""

    log_likelihood: np.ndarray
    residual_sum: np.ndarray
    degrees_of_freedom: int


@jax.jit
def _grams(ratios: NoiseRatios, interval, longest, sampling: Sampling, columns):
    logs, grams = log_determinant_and_gram(markov_sum(ratios, interval, longest), sampling, columns)
    return logs, jnp.moveaxis(grams, -1, 0)


def gram_by_cell(
    ratios: NoiseRatios,
    interval: float,
    span: float,
    sampling: Sampling,
    columns: Float[Array | np.ndarray, "sample column"],
) -> tuple[np.ndarray, np.ndarray]:
    """ln |V| and Xᵀ V⁻¹ X of every cell, cells in groups of a fixed size and columns padded, so that shapes recur."""
    width = -(-columns.shape[1] // COLUMN_STEP) * COLUMN_STEP
    padded = np.pad(np.asarray(columns), ((0, 0), (0, width - columns.shape[1])))
    cells = len(ratios.flicker)
    longest = np.broadcast_to(ratios.longest(span), cells)
    parts = []
    for reach in np.unique(longest):
        here = np.flatnonzero(longest == reach)
        while len(here):
            size = CELLS_TOGETHER if len(here) > 2 * FEW_CELLS else FEW_CELLS
            parts.append((reach, here[:size], np.resize(here[:size], size)))
            here = here[size:]
    logs, grams = np.zeros(cells), np.zeros((cells, columns.shape[1], columns.shape[1]))

    def work(part: tuple[float, np.ndarray, np.ndarray]) -> None:
        reach, here, padding = part
        log, gram = _grams(ratios.take(padding), interval, reach, sampling, padded)
        logs[here] = np.asarray(log)[: len(here)]
        grams[here] = np.asarray(gram)[: len(here), : columns.shape[1], : columns.shape[1]]

    with ThreadPoolExecutor(THREADS) as pool:
        list(pool.map(work, parts))
    return logs, grams


def restricted_likelihood(
    ratios: NoiseRatios,
    interval: float,
    span: float,
    sampling: Sampling,
    jacobian: Float[Array | np.ndarray, "sample parameter"],
    residual: Float[Array | np.ndarray, " sample"],
) -> CellFit:
    """−½ ln|V| − ½ ln|JᵀV⁻¹J| − (ν/2) ln RSS of every cell."""
    log_determinant, gram = gram_by_cell(ratios, interval, span, sampling, np.column_stack([jacobian, residual]))
    return from_grams(log_determinant, gram, int(np.asarray(sampling.present).sum()))


def from_grams(log_determinant: np.ndarray, gram: np.ndarray, samples: int) -> CellFit:
    """The restricted likelihood from ln |V| and XᵀV⁻¹X of each cell, X the Jacobian with the residual last."""
    p = gram.shape[1] - 1
    nu = samples - p
    a, b, c = gram[:, :p, :p], gram[:, :p, p], gram[:, p, p]
    norm = np.sqrt(np.maximum(np.einsum("gii->gi", a), 1e-300))
    scaled = a / (norm[:, :, None] * norm[:, None, :]) + 1e-13 * np.eye(p)
    rss = c - np.einsum("gi,gi->g", b / norm, np.linalg.solve(scaled, (b / norm)[..., None])[..., 0]) if p else c
    log_j = np.linalg.slogdet(scaled)[1] + 2 * np.log(norm).sum(1) if p else 0.0
    rss = np.maximum(rss, 1e-300)
    return CellFit(-0.5 * log_determinant - 0.5 * log_j - 0.5 * nu * np.log(rss), rss, nu)
