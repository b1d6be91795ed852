"""Whitening and likelihood in O(n) of a signal in white noise plus a sum of scalar Markov processes.

The observation at time t is the sum of all states plus white noise; each state decays at its own rate (rate zero: a
random walk). Samples may be unequally spaced or missing, and independent records may follow one another. The filter is
the Cholesky factor of the noise covariance, V = L Lᵀ, applied without ever forming V.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

# Rows whitened at a time for a Gram matrix: they stay in cache, and the products are large enough to be fast.
GRAM_ROWS = 256
# Fewer rows than this are as fast in one piece, and compile sooner.
SHORT = 2048


class Sampling(NamedTuple):
    """When the samples were taken and how far each can be trusted.

    `interval[t]` is the time since the previous sample (s); `restart[t]` opens an independent record; `present[t]` is
    False for a missing sample; `white[t]` is the white variance relative to the unit of the noise model.
    """

    interval: Float[Array, " sample"]
    restart: Bool[Array, " sample"]
    present: Bool[Array, " sample"]
    white: Float[Array, " sample"]


class MarkovSum(NamedTuple):
    """Sum of Markov processes: decay rates (1/s); stationary variances, for a decay of zero variance per second."""

    decay: Float[Array, " state"]
    variance: Float[Array, " state"]


class Filter(NamedTuple):
    """What the whitening recursions need: transition and gain per sample, and the innovation's standard deviation."""

    transition: Float[Array, "sample state"]
    gain: Float[Array, "sample state"]
    scale: Float[Array, " sample"]
    present: Bool[Array, " sample"]

    @property
    def log_determinant(self) -> Float[Array, ""]:
        """ln |V| of the samples present."""
        return 2.0 * jnp.sum(jnp.where(self.present, jnp.log(self.scale), 0.0))


def build_filter(noise: MarkovSum, sampling: Sampling) -> Filter:
    """Run the covariance recursion once; the result whitens any number of columns."""
    decaying = noise.decay > 0
    prior = jnp.diag(jnp.where(decaying, noise.variance, 0.0))

    def step(covariance, inputs):
        interval, restart, present, white = inputs
        # Transition into this sample from the previous one.
        phi = jnp.exp(-noise.decay * interval)
        added = noise.variance * jnp.where(decaying, -jnp.expm1(-2.0 * noise.decay * interval), interval)
        covariance = jnp.where(restart, prior, jnp.outer(phi, phi) * covariance + jnp.diag(added))
        cross = covariance.sum(1)
        variance = cross.sum() + white
        gain = jnp.where(present, cross / variance, 0.0)
        covariance = covariance - jnp.outer(gain, cross)
        return covariance, (jnp.where(restart, 0.0, phi), gain, jnp.sqrt(variance))

    _, (transition, gain, scale) = jax.lax.scan(step, prior, sampling)
    return Filter(transition, gain, scale, sampling.present)


def whiten(filter: Filter, columns: Float[Array, "sample column"]) -> Float[Array, "sample column"]:
    """L⁻¹ applied to columns; rows of missing samples come out zero."""
    return _whiten_on(jnp.zeros((filter.gain.shape[1], columns.shape[1])), filter, columns)[1]


def whitened_gram(filter: Filter, columns: Float[Array, "sample column"]) -> Float[Array, "column column"]:
    """XᵀV⁻¹X of columns X; on long records a few rows at a time, so that the whitened columns are never stored."""
    rows, width = columns.shape
    if rows < SHORT:
        w = whiten(filter, columns)
        return w.T @ w

    def add(start, length, state, gram):
        here, part = jax.tree.map(lambda x: jax.lax.dynamic_slice_in_dim(x, start, length), (filter, columns))
        state, w = _whiten_on(state, here, part)
        return state, gram + w.T @ w

    last = rows % GRAM_ROWS
    carry = jnp.zeros((filter.gain.shape[1], width)), jnp.zeros((width, width))
    carry = jax.lax.fori_loop(0, rows // GRAM_ROWS, lambda i, c: add(i * GRAM_ROWS, GRAM_ROWS, *c), carry)
    return add(rows - last, last, *carry)[1] if last else carry[1]


def _whiten_on(state, filter: Filter, columns):
    """Whitened rows that follow on `state`, and the state after them."""

    def step(state, inputs):
        transition, gain, scale, present, row = inputs
        state = transition[:, None] * state
        innovation = jnp.where(present, row - state.sum(0), 0.0)
        return state + gain[:, None] * innovation, innovation / scale

    rows = jnp.where(filter.present[:, None], columns, 0.0)
    return jax.lax.scan(step, state, (*filter, rows))


def colour(filter: Filter, draws: Float[Array, " sample"]) -> Float[Array, " sample"]:
    """L applied to one column: of independent unit normal draws it makes one realisation of the noise."""

    def step(state, inputs):
        transition, gain, scale, present, draw = inputs
        innovation = scale * draw
        state = transition * state
        value = jnp.where(present, state.sum() + innovation, 0.0)
        return state + gain * innovation, value

    return jax.lax.scan(step, jnp.zeros(filter.gain.shape[1]), (*filter, draws))[1]


def whiten_transposed(filter: Filter, columns: Float[Array, "sample column"]) -> Float[Array, "sample column"]:
    """L⁻ᵀ applied to columns; after `whiten` it makes V⁻¹x."""

    def step(adjoint, inputs):
        transition, gain, scale, present, row = inputs
        out = jnp.where(present, row / scale + gain @ adjoint, 0.0)
        return transition[:, None] * (adjoint - out), out

    start = jnp.zeros((filter.gain.shape[1], columns.shape[1]))
    return jax.lax.scan(step, start, (*filter, columns), reverse=True)[1]


def step_and_pulse_energy(filter: Filter) -> tuple[Float[Array, " sample"], Float[Array, " sample"]]:
    """Squared norms of a whitened unit step from each sample on, and of a whitened unit pulse at each, in one pass."""
    states = filter.gain.shape[1]
    zero, one = jnp.zeros(1), jnp.ones(1)

    def step(weight, inputs):
        transition, gain, scale, present = inputs
        # State (1, m): m <- φm at arrival, innovation 1 - Σm, m <- m + gain·innovation. `weight` measures what follows.
        arrive = jnp.concatenate([one, transition])
        observe = jnp.where(present, jnp.concatenate([one, -jnp.ones(states)]), 0.0)
        update = jnp.eye(states + 1) + jnp.outer(jnp.concatenate([zero, gain]), observe)
        here = update.T @ weight @ update + jnp.outer(observe, observe) / scale**2
        pulse = jnp.where(present, 1.0 / scale**2 + gain @ weight[1:, 1:] @ gain, 0.0)
        return arrive[:, None] * here * arrive, (here[0, 0], pulse)

    start = jnp.zeros((states + 1, states + 1))
    return jax.lax.scan(step, start, tuple(filter), reverse=True)[1]
