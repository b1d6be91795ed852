"""optimistix as second solver: the same whitened residual, its Levenberg-Marquardt with an SVD for any rank.

Its solutions are differentiable by whatever the residual depends on (implicit function theorem), which is how the
uncertainty of parameters that were held fixed reaches the fitted ones.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import optimistix as optx
from jaxtyping import Float

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


def response_to_changes(
    model: GyroModel,
    held: GyroModel | None,
    changes: Float[np.ndarray, "held error"],
    signals,
    signal_changes: Mapping[str, Float[np.ndarray, "sample error"]],
    filter: Filter,
) -> Float[np.ndarray, "parameter error"]:
    """Change of the fitted parameters with parameters that the fit held fixed and with the signals it saw.

    Args:
        model: at the estimate.
        held: the same model with exactly those parameters free that change; None where none does.
        changes: of these parameters, one column an error.
        signals: the data.
        signal_changes: of some of the signals, one column an error.
        filter: the noise that the fit was weighted with.

    Returns:
        One row a fitted parameter, one column an error, internal units.
    """
    moved = {name: jnp.asarray(change) for name, change in signal_changes.items()}
    return np.asarray(_response(model, held, jnp.asarray(changes), signals, moved, filter))


@eqx.filter_jit
def _response(model: GyroModel, held: GyroModel | None, changes, signals, signal_changes, filter: Filter):
    x = model.vector()

    def refitted(errors):
        effects = model.effects if held is None else held.with_vector(held.vector() + changes @ errors).effects
        moved = replace(model, effects=effects)
        seen = {**signals, **{name: signals[name] + change @ errors for name, change in signal_changes.items()}}
        return _solve(moved, x, seen, filter)[0]

    return jax.jacfwd(refitted)(jnp.zeros(changes.shape[1]))


@eqx.filter_jit
def _solve(model: GyroModel, x, signals, filter: Filter):
    # A derivative through what is masked must be a number too.
    signals = {name: jnp.where(filter.present | jnp.isfinite(v), v, 0.0) for name, v in signals.items()}

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
