"""optimistix as second solver: the same whitened residual, its Levenberg-Marquardt with an SVD for any rank."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
import lineax as lx
import numpy as np
import optimistix as optx

from gyromodel.model import GyroModel
from gyromodel.numerics.least_squares import Solution
from gyromodel.numerics.state_space import Filter, whiten


def optimistix_solution(model: GyroModel, x, signals, filter: Filter) -> Solution:
    """Minimise the whitened sum of squares in coordinates scaled by the Jacobian's column norms at the start."""
    best, cost, steps, done = _solve(model, x, signals, filter)
    return Solution(np.asarray(best), float(cost), int(steps), bool(done))


@eqx.filter_jit
def _solve(model: GyroModel, x, signals, filter: Filter):
    def whitened(v):
        residual = jnp.where(filter.present, model.with_vector(v).predict(signals) - signals["output"], 0.0)
        return whiten(filter, residual[:, None])[:, 0]

    jacobian = whiten(filter, model.with_vector(x).linearise(signals)[1])
    norm = jnp.linalg.norm(jacobian, axis=0)
    scale = 1.0 / jnp.where(norm > 0, norm, 1.0)
    solver = optx.LevenbergMarquardt(rtol=1e-10, atol=1e-10, linear_solver=lx.SVD())
    found = optx.least_squares(
        lambda u, _: whitened(x + scale * u), solver, jnp.zeros_like(x), max_steps=256, throw=False
    )
    best = x + scale * found.value
    return best, jnp.sum(whitened(best) ** 2), found.stats["num_steps"], found.result == optx.RESULTS.successful
