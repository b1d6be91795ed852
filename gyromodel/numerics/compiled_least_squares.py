"""Scaled Levenberg-Marquardt inside a compiled program, one fit at a time: what `lax.map` runs over an archive.

The same search as that of `least_squares`, on normal equations alone, with no call of LAPACK: such calls, made by
several threads from compiled loops, could wait for one another for ever.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from gyromodel.numerics.least_squares import FIRST_DAMPING, KINK_TOLERANCE, LEAST_DAMPING

# What is left of a column of unit length beside those before it, squared: with less it is held in a step.
LEAST_PIVOT = 1e-14
# Relative decreases of the cost below this are lost in its rounding.
ROUNDING = 1e-13
# Part of the damping that what is linear gets: alone it would need none, and products of it need some.
LINEAR_SHARE = 1e-4
# Distance from the minimum, as a part of the cost, below which the rate of convergence is taken from the last step.
CLOSE = 0.1
# Part of the squared distance that a step leaves at least, as far as a search relies on it: those before it may have
# left less by luck, along a direction that bends little.
LEAST_LEFT = 1 / 400


class Search(NamedTuple):
    """Where a search ended: the point, `gram` there, and the decrease of the cost that its next step promises."""

    x: Float[Array, " parameter"]
    gram: Float[Array, "column column"]
    promise: Float[Array, ""]
    iterations: Int[Array, ""]
    converged: Bool[Array, ""]


class _State(NamedTuple):
    x: Float[Array, " parameter"]
    gram: Float[Array, "column column"]
    scale: Float[Array, " parameter"]
    step: Float[Array, " parameter"]
    promise: Float[Array, ""]
    distance: Float[Array, ""]
    part: Float[Array, ""]
    damping: Float[Array, ""]
    growth: Float[Array, ""]
    iteration: Int[Array, ""]
    ended: Bool[Array, ""]
    converged: Bool[Array, ""]


def search_minimum(
    gram: Callable[[Float[Array, " parameter"]], Float[Array, "column column"]],
    start: Float[Array, " parameter"],
    linear: Bool[Array | np.ndarray, " parameter"],
    tolerance: Float[Array, ""] | float,
    most: Int[Array, ""] | int,
    solved: Bool[Array, ""] | bool = False,
) -> Search:
    """Minimise |r(x)|², with one exact solve for the linear parameters at the start.

    Args:
        gram: [J, r]ᵀ[J, r] at a point, J the derivative of r; rows and columns behind are the caller's own.
        start: where to begin.
        linear: which parameters r is linear in.
        tolerance: decrease of the cost, as a part of it, that still counts.
        most: points looked at, rejected ones and the start included; with one, `promise` is what the linear solve would
            gain; with none, nothing is computed.
        solved: whether the start is so near that it needs no linear solve.

    Returns:
        The last step of a search that converged is taken without looking at where it leads.
    """
    p = start.shape[0]
    tolerance = jnp.maximum(tolerance, ROUNDING)
    held = ~jnp.asarray(linear) & jnp.any(linear) & ~jnp.asarray(solved)

    def metric(scale):
        """What the damping multiplies; a long step of what is linear is no danger."""
        return scale**2 * jnp.where(linear, LINEAR_SHARE, 1.0)

    def look(state: _State) -> _State:
        new = gram(state.x + state.step)
        before, cost = state.gram[p, p], new[p, p]
        first = state.iteration == 0
        # Comparisons with NaN are false: such a trial is rejected.
        better = jnp.isfinite(new).all() & (cost <= before)
        decrease = before - cost
        # Decrease over what the linear model promised: near one, the damping falls (Nielsen 1999, equation 2.4).
        promised = state.promise + state.damping * jnp.sum(metric(state.scale) * state.step**2)
        ratio = jnp.where(promised > 0, decrease / jnp.where(promised > 0, promised, 1.0), 1.0)
        eased = jnp.maximum(state.damping * jnp.maximum(1 / 3, 1 - (2 * ratio - 1) ** 3), LEAST_DAMPING)
        eased = jnp.where(ratio < 0.25, jnp.maximum(eased, FIRST_DAMPING), eased)
        eased = jnp.where(first, state.damping, eased)
        damping = jnp.where(better, eased, jnp.maximum(state.growth * state.damping, FIRST_DAMPING))
        growth = jnp.where(better, 2.0, 2.0 * state.growth)
        x = jnp.where(better, state.x + state.step, state.x)
        now = jnp.where(better, new, state.gram)
        a, g, cost_now = now[:p, :p], now[:p, p], now[p, p]
        scale = jnp.maximum(state.scale, jnp.sqrt(jnp.maximum(jnp.diag(a), 1e-300)))
        # The first step is the exact solve for what is linear.
        step = -solve_positive(a + jnp.diag(jnp.where(first, 0.0, damping) * metric(scale)), g, first & held)
        promise = -g @ step
        # A damped step may be short far from the minimum; what the whole one promises tells how far it is.
        whole = -solve_positive(a, g, jnp.zeros(p, bool))
        least = tolerance * cost_now
        distance = -g @ whole
        # What the next step will leave of the distance is told from what the last two left: the one before may have
        # taken away what is linear.
        part = jnp.where(better & (state.distance <= CLOSE * cost_now), distance / state.distance, 1.0)
        near = jnp.clip(jnp.sqrt(part * state.part), LEAST_LEFT, 1.0) * distance <= least
        # Where damping has made every step short: at the minimum the residual is orthogonal to every column, or the
        # last step cost or gained next to nothing, as where the cost has a kink.
        short = (promise <= least) & ~(first & held.any())
        orthogonal = jnp.all(jnp.abs(g) <= 1e-6 * scale * jnp.sqrt(cost_now))
        kink = jnp.abs(decrease) <= KINK_TOLERANCE * least
        hopeless = first & ~better
        return _State(
            x,
            now,
            scale,
            jnp.where(near, whole, step),
            promise,
            distance,
            part,
            damping,
            growth,
            state.iteration + 1,
            near | short | hopeless,
            near | (short & (orthogonal | kink)),
        )

    nothing = jnp.full(jax.eval_shape(gram, start).shape, jnp.inf)
    begin = _State(
        start,
        nothing,
        jnp.zeros(p),
        jnp.zeros(p),
        jnp.zeros(()),
        jnp.asarray(jnp.inf),
        jnp.asarray(1.0),
        jnp.asarray(LEAST_DAMPING),
        jnp.asarray(2.0),
        jnp.asarray(0),
        jnp.asarray(False),
        jnp.asarray(False),
    )
    end = jax.lax.while_loop(lambda s: ~s.ended & (s.iteration < most), look, begin)
    polished = end.converged & jnp.isfinite(end.step).all()
    x = jnp.where(polished, end.x + end.step, end.x)
    return Search(x, end.gram, end.promise, end.iteration, end.converged)


def solve_positive(
    matrix: Float[Array, "unknown unknown"], right: Float[Array, " unknown"], held: Bool[Array, " unknown"]
) -> Float[Array, " unknown"]:
    """Solve a symmetric positive definite system, some unknowns held at zero.

    The matrix is scaled to a unit diagonal and eliminated without exchanges, the Cholesky factor's pivots; an unknown
    whose pivot vanishes beside those before it is held as well.
    """
    p = right.shape[0]
    size = jnp.sqrt(jnp.maximum(jnp.diag(matrix), 0.0))
    size = jnp.where(size > 0, size, 1.0)
    system = jnp.concatenate([matrix / (size[:, None] * size), (right / size)[:, None]], axis=1)

    def eliminate(j, m):
        row = m[j]
        pivot = row[j]
        free = ~held[j] & (pivot > LEAST_PIVOT)
        row = jnp.where(free, row / jnp.where(free, pivot, 1.0), 0.0)
        return (m - m[:, j][:, None] * row).at[j].set(row)

    return jax.lax.fori_loop(0, p, eliminate, system)[:, p] / size
