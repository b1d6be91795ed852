"""optimistix as second solver: the same whitened residual, its Levenberg-Marquardt with an SVD for any rank.

Its solutions are differentiable by whatever the residual depends on (implicit function theorem), which is how the
uncertainty of parameters that were held fixed reaches the fitted ones.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import optimistix as optx

from gyromodel.model import GyroModel
from gyromodel.numerics.least_squares import Solution
from gyromodel.numerics.state_space import Filter, whiten

# Restarts from where the last solve ended; each measures its tolerances in the residual it starts from.
RESTARTS = 5


def optimistix_solution(model: GyroModel, x, signals, filter: Filter) -> Solution:
    """Minimise the whitened sum of squares in coordinates scaled by the residual and the Jacobian's column norms."""
    steps, cost, done = 0, np.inf, False
    for _ in range(RESTARTS):
        x, now, more, done = _solve(model, x, signals, filter)
        steps += int(more)
        if not float(now) < cost * (1 - 1e-9):
            break
        cost = float(now)
    return Solution(np.asarray(x), float(now), steps, bool(done))


def response_to_held(model: GyroModel, held: GyroModel, signals, filter: Filter) -> np.ndarray:
    """Derivative of the fitted parameters by parameters that the fit held fixed.

    Args:
        model: at the estimate.
        held: the same model with exactly those parameters free that are to vary.
        signals: the data.
        filter: the noise that the fit was weighted with.

    Returns:
        One row a fitted parameter, one column a held one, internal units.
    """
    return np.asarray(_response(model, held, signals, filter))


@eqx.filter_jit
def _response(model: GyroModel, held: GyroModel, signals, filter: Filter):
    x = model.vector()

    def refitted(values):
        moved = GyroModel(held.with_vector(values).effects, model.noise, model.fixed, model.gyro)
        return _solve(moved, x, signals, filter)[0]

    return jax.jacfwd(refitted)(held.vector())


@eqx.filter_jit
def _solve(model: GyroModel, x, signals, filter: Filter):
    def whitened(v):
        residual = jnp.where(filter.present, model.with_vector(v).predict(signals) - signals["output"], 0.0)
        return whiten(filter, residual[:, None])[:, 0]

    jacobian = whiten(filter, model.with_vector(x).linearise(signals)[1])
    norm = jnp.linalg.norm(jacobian, axis=0)
    # optimistix compares with absolute tolerances too: of a residual of norm one they are relative.
    size = jnp.linalg.norm(whitened(x))
    size = jnp.where(size > 0, size, 1.0)
    scale = jax.lax.stop_gradient(size / jnp.where(norm > 0, norm, size))
    size = jax.lax.stop_gradient(size)
    solver = optx.LevenbergMarquardt(rtol=1e-10, atol=1e-10, linear_solver=lx.SVD())
    found = optx.least_squares(
        lambda u, _: whitened(x + scale * u) / size, solver, jnp.zeros_like(x), max_steps=256, throw=False
    )
    best = x + scale * found.value
    return best, jnp.sum(whitened(best) ** 2), found.stats["num_steps"], found.result == optx.RESULTS.successful
