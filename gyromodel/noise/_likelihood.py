"""Restricted likelihood of many noise cells at once, on the same data and regressors."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from gyromodel.noise._model import NoiseRatios, markov_sum
from gyromodel.numerics.state_space import Sampling, build_filter, whiten

# Cells whitened together: enough to fill vector units, few enough for memory, and fewer for records of many samples.
CELLS_TOGETHER, FEW_CELLS = 32, 4
MANY_SAMPLES = 50_000
COLUMN_STEP = 8


class CellFit(NamedTuple):
    """Per noise cell: ln restricted likelihood (white variance profiled out) and residual sum of squares."""

    log_likelihood: np.ndarray
    residual_sum: np.ndarray
    degrees_of_freedom: int


@jax.jit
def _grams(ratios: NoiseRatios, interval, span, sampling: Sampling, columns):
    def one(flicker, walk):
        filter = build_filter(markov_sum(NoiseRatios(flicker, walk), interval, span), sampling)
        w = whiten(filter, columns)
        return filter.log_determinant, w.T @ w

    return jax.vmap(one)(*ratios)


def gram_by_cell(
    ratios: NoiseRatios, interval: float, span: float, sampling: Sampling, columns: Float[Array, "sample column"]
) -> tuple[np.ndarray, np.ndarray]:
    """ln |V| and Xᵀ V⁻¹ X of every cell, cells in groups of a fixed size and columns padded, so that shapes recur."""
    width = -(-columns.shape[1] // COLUMN_STEP) * COLUMN_STEP
    padded = jnp.pad(columns, ((0, 0), (0, width - columns.shape[1])))
    count = ratios.flicker.shape[0]
    together = CELLS_TOGETHER if count > FEW_CELLS and len(columns) <= MANY_SAMPLES else FEW_CELLS
    groups = -(-count // together)
    # In NumPy: JAX would compile the padding and slicing for every number of cells.
    fill = NoiseRatios(*(np.pad(np.asarray(x), (0, groups * together - count), mode="edge") for x in ratios))
    logs, grams = [], []
    for i in range(groups):
        part = NoiseRatios(*(x[i * together : (i + 1) * together] for x in fill))
        log, gram = _grams(part, interval, span, sampling, padded)
        logs.append(np.asarray(log))
        grams.append(np.asarray(gram)[:, : columns.shape[1], : columns.shape[1]])
    return np.concatenate(logs)[:count], np.concatenate(grams)[:count]


def restricted_likelihood(
    ratios: NoiseRatios,
    interval: float,
    span: float,
    sampling: Sampling,
    jacobian: Float[Array, "sample parameter"],
    residual: Float[Array, " sample"],
) -> CellFit:
    """−½ ln|V| − ½ ln|JᵀV⁻¹J| − (ν/2) ln RSS of every cell."""
    log_det, gram = gram_by_cell(ratios, interval, span, sampling, jnp.column_stack([jacobian, residual]))
    p = jacobian.shape[1]
    nu = int(np.asarray(sampling.present).sum()) - p
    a, b, c = gram[:, :p, :p], gram[:, :p, p], gram[:, p, p]
    norm = np.sqrt(np.maximum(np.einsum("gii->gi", a), 1e-300))
    scaled = a / (norm[:, :, None] * norm[:, None, :]) + 1e-13 * np.eye(p)
    rss = c - np.einsum("gi,gi->g", b / norm, np.linalg.solve(scaled, (b / norm)[..., None])[..., 0]) if p else c
    log_j = np.linalg.slogdet(scaled)[1] + 2 * np.log(norm).sum(1) if p else 0.0
    rss = np.maximum(rss, 1e-300)
    return CellFit(-0.5 * log_det - 0.5 * log_j - 0.5 * nu * np.log(rss), rss, nu)
