"""Likelihood terms of many noises at once, each white + differenced white + a sum of Markov processes of its own rates.

Differenced white noise, e[t] − e[t−1], is what the rounding of an accumulated signal leaves in its increments: one more
state holds −e[t−1], known as well as sample t−1 told it. As in `state_space`, but in a single pass that keeps nothing.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float


class MarkovCells(NamedTuple):
    """Noises side by side: variances of a sample, decay rates in 1/s; for a decay of zero, variance per second.

    `white` may be negative as long as the whole is a covariance: averages of Markov processes are of that form.
    """

    white: Float[Array | np.ndarray, " cell"]
    differenced: Float[Array | np.ndarray, " cell"]
    decay: Float[Array | np.ndarray, "state cell"]
    variance: Float[Array | np.ndarray, "state cell"]


class Rows(NamedTuple):
    """When samples were taken: time since the one before (s), whether it opens a record, follows on, is there.

    `follows` says that the sample begins where the one before ends, so that their rounding errors are linked.
    """

    interval: Float[Array, " row"]
    restart: Bool[Array, " row"]
    follows: Bool[Array, " row"]
    present: Bool[Array, " row"]


@jax.jit
def log_determinant_and_gram(
    noise: MarkovCells, rows: Rows, columns: Float[Array | np.ndarray, "row column"]
) -> tuple[Float[Array, " cell"], Float[Array, "column column cell"]]:
    """ln |V| and XᵀV⁻¹X of columns X under each noise, over the rows present."""
    states, cells = noise.decay.shape
    width = columns.shape[1]
    walk = noise.decay == 0
    prior = jnp.where(walk, 0.0, noise.variance)
    eye = jnp.eye(states)[:, :, None]

    def step(carry, row):
        covariance, link, spread, mean, linked, log_determinant, gram = carry
        interval, restart, follows, present, x = row
        # Into this row: states decay, and the last rounding error enters with its sign turned.
        keep = jnp.where(restart, 0.0, jnp.exp(-noise.decay * interval))
        added = jnp.where(restart, prior, noise.variance * jnp.where(walk, interval, 1.0 - keep**2))
        covariance = keep[:, None] * keep[None] * covariance + eye * added
        follows = follows & ~restart
        link = jnp.where(follows, -keep * link, 0.0)
        spread = jnp.where(follows, spread, noise.differenced)
        mean, linked = keep[:, None] * mean, jnp.where(follows, -linked, 0.0)
        # The observation is the sum of all states, the old rounding error, the new one and white noise.
        cross = covariance.sum(1) + link
        variance = cross.sum(0) + link.sum(0) + spread + noise.differenced + noise.white
        gain = jnp.where(present, cross / variance, 0.0)
        fresh = jnp.where(present, noise.differenced / variance, 0.0)
        innovation = x[:, None] - mean.sum(0) - linked
        covariance = covariance - gain[:, None] * cross[None]
        link, spread = -gain * noise.differenced, noise.differenced * (1.0 - fresh)
        mean, linked = mean + gain[:, None] * innovation, fresh * innovation
        log_determinant = log_determinant + jnp.where(present, jnp.log(variance), 0.0)
        weighted = jnp.where(present, innovation / variance, 0.0)
        gram = gram + weighted[:, None] * innovation[None]
        return (covariance, link, spread, mean, linked, log_determinant, gram), None

    start = (
        jnp.zeros((states, states, cells)),
        jnp.zeros((states, cells)),
        noise.differenced,
        jnp.zeros((states, width, cells)),
        jnp.zeros((width, cells)),
        jnp.zeros(cells),
        jnp.zeros((width, width, cells)),
    )
    return jax.lax.scan(step, start, (*rows, columns))[0][5:]
