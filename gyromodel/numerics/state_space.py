"""Whitening and likelihood in O(n) of a signal in white noise plus a sum of scalar Markov processes.

The observation at time t is the sum of all states plus white noise; each state decays at its own rate (rate zero: a
random walk). White noise of the signal's integral may be beside: of it one more state holds what the sample before has
in common with this one. Samples may be unequally spaced or missing, and independent records may follow one another. The
filter is the Cholesky factor of the noise covariance, V = L Lᵀ, applied without ever forming V.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

# Rows whitened at a time for a Gram matrix: they stay in cache, and the products are large enough to be fast.
GRAM_ROWS = 256
# Fewer rows than this are as fast in one piece, and compile sooner.
SHORT = 2048
# A sample that comes after so many intervals does not begin where the one before ended.
GAP = 1.5


class Sampling(NamedTuple):
    """When the samples were taken and how far each can be trusted.

    `interval[t]` is the time since the previous sample (s); `restart[t]` opens an independent record; `present[t]` is
    False for a missing sample; `white[t]` is the white variance relative to the unit of the noise model; `start[t]`
    the variance, in that unit, of a constant which a record that opens there has of its own: none without it.
    """

    interval: Float[Array, " sample"]
    restart: Bool[Array, " sample"]
    present: Bool[Array, " sample"]
    white: Float[Array, " sample"]
    start: Float[Array, " sample"] | None = None


class MarkovSum(NamedTuple):
    """Sum of Markov processes: decay rates (1/s); stationary variances, for a decay of zero variance per second.

    Further axes of the variances are cells: noises of the same decays, filtered side by side. `integral` is the
    variance of white noise of the signal's integral, and `interval` how long a sample is that follows on none (s).
    """

    decay: Float[Array, " state"]
    variance: Float[Array, "state ..."]
    integral: Float[Array | np.ndarray, "*cell"] | None = None
    interval: float | Float[Array, ""] = 1.0


class Filter(NamedTuple):
    """What the whitening recursions need: transition and gain per sample, and the innovation's standard deviation.

    Where there is white noise of the integral, `lasting` marks the states that outlive a sample: all but its own.
    """

    transition: Float[Array | np.ndarray, "sample state"]
    gain: Float[Array | np.ndarray, "sample state *cell"]
    scale: Float[Array | np.ndarray, "sample ..."]
    present: Bool[Array | np.ndarray, " sample"]
    lasting: Float[Array | np.ndarray, "sample state"] | None = None

    @property
    def log_determinant(self) -> Float[Array, "*cell"]:
        """ln |V| of the samples present."""
        present = _over_cells(self.present, self.scale.ndim - 1)
        return 2.0 * jnp.sum(jnp.where(present, jnp.log(self.scale), 0.0), axis=0)


def _over_cells(x, cells: int):
    """The array with as many axes of length one at the end; cells come last so that the processor runs along them."""
    return x.reshape(*x.shape, *(1,) * cells)


def build_filter(noise: MarkovSum, sampling: Sampling) -> Filter:
    """Run the covariance recursion once; the result whitens any number of columns."""
    return _filter_on(_prior(noise), noise, sampling)[1]


def _prior(noise: MarkovSum):
    """Covariance of the states before the first sample of a record."""
    cells = noise.variance.ndim - 1
    stationary = jnp.where(_over_cells(noise.decay > 0, cells), noise.variance, 0.0)
    if noise.integral is not None:
        stationary = jnp.concatenate([stationary, noise.integral[None] / noise.interval**2])
    return _over_cells(jnp.eye(len(stationary)), cells) * stationary


def _filter_on(covariance, noise: MarkovSum, sampling: Sampling):
    """The covariance after some samples that follow on `covariance`, and their filter."""
    cells, integral = noise.variance.ndim - 1, noise.integral
    prior, states = _prior(noise), len(noise.decay)
    identity = _over_cells(jnp.eye(len(prior)), cells)
    # A constant is a state that does not decay, as a random walk is.
    constant = identity * _over_cells(jnp.pad((noise.decay == 0).astype(float), (0, len(prior) - states)), cells)
    lasting = jnp.pad(jnp.ones(states), (0, len(prior) - states))

    def step(covariance, inputs):
        interval, restart, present, white, start = inputs
        # Transition into this sample from the previous one.
        phi = jnp.exp(-noise.decay * interval)
        added = noise.variance * _over_cells(jnp.where(noise.decay > 0, 1.0 - phi**2, interval), cells)
        if integral is not None:
            # A sample is the change of the integral over its own time; at its start, turned, that of the one before.
            follows = ~restart & (interval > 0.0) & (interval <= GAP * noise.interval)  # none where rows are padded
            own = jnp.where(follows, interval, noise.interval)
            phi = jnp.append(phi, follows / own)
            added = jnp.concatenate([added, jnp.where(follows, 0.0, integral / own**2)[None]])
        moved = _over_cells(jnp.outer(phi, phi), cells) * covariance + identity * added
        covariance = jnp.where(restart, prior if start is None else prior + constant * start, moved)
        cross = covariance.sum(1)
        variance = cross.sum(0) + white
        if integral is not None:
            variance += integral / own**2
            covariance = (covariance * _over_cells(jnp.outer(lasting, lasting), cells)).at[-1, -1].set(integral)
            cross = cross.at[-1].set(-integral / own)
        gain = jnp.where(present, cross / variance, 0.0)
        covariance = covariance - gain[:, None] * cross
        return covariance, (jnp.where(restart, 0.0, phi), gain, jnp.sqrt(variance))

    covariance, (transition, gain, scale) = jax.lax.scan(step, covariance, sampling)
    each = None if integral is None else jnp.broadcast_to(lasting, transition.shape)
    return covariance, Filter(transition, gain, scale, sampling.present, each)


def whiten(filter: Filter, columns: Float[Array | np.ndarray, "sample column"]) -> Float[Array, "sample column *cell"]:
    """L⁻¹ applied to columns; rows of missing samples come out zero."""
    return whiten_on(at_rest(filter, columns.shape[1]), filter, columns)[1]


def at_rest(filter: Filter, columns: int) -> Float[Array, "state column *cell"]:
    """The state of the whitening recursion before the first sample."""
    return jnp.zeros((filter.gain.shape[1], columns, *filter.gain.shape[2:]))


def whitened_gram(filter: Filter, columns: Float[Array, "sample column"]) -> Float[Array, "column column"]:
    """XᵀV⁻¹X of columns X; on long records a few rows at a time, so that the whitened columns are never stored."""
    width = columns.shape[1]

    def add(rows, carry):
        state, gram = carry
        state, w = whiten_on(state, *rows)
        return state, gram + w.T @ w

    return _in_parts(add, (filter, columns), (at_rest(filter, width), jnp.zeros((width, width))))[1]


def log_determinant_and_gram(
    noise: MarkovSum, sampling: Sampling, columns: Float[Array, "sample column"]
) -> tuple[Float[Array, "*cell"], Float[Array, "column column *cell"]]:
    """ln |V| and XᵀV⁻¹X of columns X; on long records a few rows at a time, so that not even the filter is stored."""
    width, cells = columns.shape[1], noise.variance.shape[1:]

    def add(rows, carry):
        covariance, state, log_determinant, gram = carry
        covariance, filter = _filter_on(covariance, noise, rows[0])
        state, w = whiten_on(state, filter, rows[1])
        return (
            covariance,
            state,
            log_determinant + filter.log_determinant,
            gram + jnp.einsum("ni...,nj...->ij...", w, w),
        )

    prior = _prior(noise)
    state = jnp.zeros((len(prior), width, *cells))
    start = prior, state, jnp.zeros(cells), jnp.zeros((width, width, *cells))
    return _in_parts(add, (sampling, columns), start)[2:]


def _in_parts(add, rows, carry):
    """`add(part, carry)` over arrays of rows, GRAM_ROWS at a time where they are many."""
    count = jax.tree.leaves(rows)[0].shape[0]
    if count < SHORT:
        return add(rows, carry)

    def part(start, length):
        return jax.tree.map(lambda x: jax.lax.dynamic_slice_in_dim(x, start, length), rows)

    last = count % GRAM_ROWS
    carry = jax.lax.fori_loop(0, count // GRAM_ROWS, lambda i, c: add(part(i * GRAM_ROWS, GRAM_ROWS), c), carry)
    return add(part(count - last, last), carry) if last else carry


def whiten_on(
    state: Float[Array, "state column *cell"], filter: Filter, columns: Float[Array | np.ndarray, "sample column"]
) -> tuple[Float[Array, "state column *cell"], Float[Array, "sample column *cell"]]:
    """The state after some rows that follow on `state`, and these rows whitened."""
    cells = state.ndim - 2

    def step(state, inputs):
        transition, gain, scale, present, lasting, row = inputs
        state = _over_cells(transition[:, None], cells) * state
        innovation = jnp.where(present, _over_cells(row, cells) - state.sum(0), 0.0)
        return _lasting(lasting, state) + gain[:, None] * innovation, innovation / scale

    rows = jnp.where(filter.present[:, None], columns, 0.0)
    return jax.lax.scan(step, state, (*filter, rows))


def _lasting(lasting, state):
    """What is left of states beyond a sample."""
    return state if lasting is None else _over_cells(lasting, state.ndim - 1) * state


def colour(filter: Filter, draws: Float[Array, " sample"]) -> Float[Array, " sample"]:
    """L applied to one column: of independent unit normal draws it makes one realisation of the noise."""

    def step(state, inputs):
        transition, gain, scale, present, lasting, draw = inputs
        innovation = scale * draw
        state = transition * state
        value = jnp.where(present, state.sum() + innovation, 0.0)
        return _lasting(lasting, state) + gain * innovation, value

    return jax.lax.scan(step, jnp.zeros(filter.gain.shape[1]), (*filter, draws))[1]


def whiten_transposed(
    filter: Filter, columns: Float[Array, "sample column *cell"]
) -> Float[Array, "sample column *cell"]:
    """L⁻ᵀ applied to columns; after `whiten` it makes V⁻¹x."""
    cells = columns.ndim - 2

    def step(adjoint, inputs):
        transition, gain, scale, present, lasting, row = inputs
        out = jnp.where(present, row / scale + (gain[:, None] * adjoint).sum(0), 0.0)
        return _over_cells(transition[:, None], cells) * (_lasting(lasting, adjoint) - out), out

    return jax.lax.scan(step, at_rest(filter, columns.shape[1]), (*filter, columns), reverse=True)[1]


def step_and_pulse_energy(filter: Filter) -> tuple[Float[Array, "sample ..."], Float[Array, "sample ..."]]:
    """Squared norms of a whitened unit step from each sample on, and of a whitened unit pulse at each, in one pass."""
    states, cells = filter.gain.shape[1], filter.gain.ndim - 2
    none, one = jnp.zeros((1, *filter.gain.shape[2:])), jnp.ones(1)
    observed = _over_cells(jnp.concatenate([one, -jnp.ones(states)]), cells)

    def step(weight, inputs):
        transition, gain, scale, present, lasting = inputs
        # State (1, m): m <- φm at arrival, innovation 1 - Σm, m <- Lm + gain·innovation. `weight` measures what
        # follows: seen from before the update it is (L + g oᵀ)ᵀ W (L + g oᵀ) + o oᵀ/scale², o being what is observed.
        g = jnp.concatenate([none, gain])
        o = jnp.where(present, observed, 0.0)
        by_gain = (weight * g).sum(1)
        pulse = (g * by_gain).sum(0) + 1.0 / scale**2
        if lasting is not None:
            kept = _over_cells(jnp.concatenate([one, lasting]), cells)
            weight, by_gain = kept[:, None] * weight * kept, kept * by_gain
        cross = o[:, None] * by_gain
        here = weight + cross + cross.swapaxes(0, 1) + pulse * o[:, None] * o
        arrive = _over_cells(jnp.concatenate([one, transition]), cells)
        return arrive[:, None] * here * arrive, (here[0, 0], jnp.where(present, pulse, 0.0))

    start = jnp.zeros((states + 1, states + 1, *filter.gain.shape[2:]))
    return jax.lax.scan(step, start, tuple(filter), reverse=True)[1]
