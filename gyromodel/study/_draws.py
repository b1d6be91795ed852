"""What the first order leaves out: outcomes of drawn parameters, and variance-based sensitivity indices.

Correlated parameters are p = p̂ + D C^½ z, D their standard uncertainties, C^½ the symmetric root of their correlation
and z independent standard normal: of all roots that one keeps each z_i nearest to its p_i.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from gyromodel.model import ModelError
from gyromodel.study._budget import Budget, derivative, entries_kept
from gyromodel.study._known import Known, models_at
from gyromodel.study._mission import Mission, Outcome
from gyromodel.units import factor, internal_unit

# Draws computed side by side.
TOGETHER = 32
# Standard errors of the draws by which their size may differ from the first order.
EXPLAINED = 4.0
# Base samples of the indices, a power of two.
BASE = 512


class Drawn(NamedTuple):
    """An outcome's size over drawn parameters, in its field unit.

    Args:
        draws: how many.
        std: root mean square of what the outcome differs from its value at the calibration; of a "peak" of its largest
            entry in each draw.
        std_error: standard error of `std`.
        linear: what `std` is to first order.
        quantile: 95 % of the draws differ by less.
        agrees: whether `std` is `linear` within what the draws explain.
    """

    draws: int
    std: float
    std_error: float
    linear: float
    quantile: float
    agrees: bool


class Indices(NamedTuple):
    """Sobol indices of one parameter: its part of a variance by itself, and with all it interacts with.

    Each with half its 95 % interval. Of correlated parameters they are those of z (see the module's text).
    """

    name: str
    first: float
    first_conf: float
    total: float
    total_conf: float


def symmetric_factor(covariance: Float[np.ndarray, "parameter parameter"]) -> Float[np.ndarray, "parameter parameter"]:
    """D C^½ of a covariance D C D."""
    std = np.sqrt(np.diag(covariance))
    scale = np.where(std > 0, std, 1.0)
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    return scale[:, None] * (vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T


@eqx.filter_jit
def _sizes(function, of, peak, models, vectors, mission, nominal, keep) -> tuple[Array, Array]:
    """Of each draw the first entry less its nominal value, and the size of all of them."""
    outcome = Outcome("", "", function, of)

    def one(vector):
        change = outcome.of_models(mission, models_at(models, vector)) - nominal
        squares = jnp.where(keep, change**2, 0.0)
        return change[0], jnp.sqrt(jnp.max(squares) if peak else jnp.sum(squares) / jnp.sum(keep))

    return jax.lax.map(one, vectors, batch_size=TOGETHER)


def _of_draws(outcome: Outcome, known: Known, mission: Mission, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    vectors = known.vector + z @ symmetric_factor(known.covariance).T
    nominal = outcome.of_models(mission, mission.models)
    keep = np.zeros(len(nominal), bool)
    keep[entries_kept(outcome, mission)] = True
    peak = outcome.size == "peak"
    found = _sizes(
        outcome.function, outcome.of, peak, mission.models, jnp.asarray(vectors), mission, nominal, jnp.asarray(keep)
    )
    first, sizes = (np.asarray(x) for x in found)
    if not np.isfinite(sizes).all():
        part = float(np.mean(~np.isfinite(sizes)))
        raise ModelError(f"the outcome {outcome.name} is not finite for {part:.2g} of the parameters' draws")
    return first, sizes


def monte_carlo(
    outcome: Outcome, first_order: Budget, known: Known, mission: Mission, draws: int, rng: np.random.Generator
) -> Drawn:
    """An outcome over normal draws of all parameters, and whether the first order is borne out."""
    unit = factor(internal_unit(outcome.unit), outcome.unit)
    z = rng.standard_normal((draws, len(known.vector)))
    sizes = _of_draws(outcome, known, mission, z)[1] * unit
    linear = first_order.std
    if outcome.size == "peak":
        # The largest of many entries has no closed form: the same draws through the derivative.
        slopes = derivative(outcome, known, mission)[1] @ symmetric_factor(known.covariance)
        linear = float(np.sqrt(np.mean([np.max(np.abs(slopes @ draw)) ** 2 for draw in z]))) * unit
    std = float(np.sqrt(np.mean(sizes**2)))
    error = float(np.std(sizes**2, ddof=1) / np.sqrt(draws) / (2.0 * std)) if std > 0 else 0.0
    quantile = float(np.quantile(sizes, 0.95))
    # Without errors, rounding is all that is drawn.
    agrees = not known.covariance.any() or abs(std - linear) <= EXPLAINED * error + 1e-9 * std
    return Drawn(draws, std, error, linear, quantile, agrees)


def sobol_indices(
    function: Callable[[Float[np.ndarray, "draw parameter"]], Float[np.ndarray, " draw"]],
    names: Sequence[str],
    base: int = BASE,
    seed: int = 0,
) -> tuple[Indices, ...]:
    """Sobol indices of a function of independent standard normal z, by SALib, with 95 % intervals.

    Args:
        function: of draws.
        names: of its arguments.
        base: samples; base × (arguments + 2) evaluations. A power of two.
        seed: of the scrambling and the intervals.
    """
    # It takes half a second to load, and few runs need it.
    from SALib.analyze import sobol as analysis
    from SALib.sample import sobol as sampling

    problem = {
        "num_vars": len(names),
        "names": list(names),
        "bounds": [[0.0, 1.0]] * len(names),
        "dists": ["norm"] * len(names),
    }
    z = sampling.sample(problem, base, calc_second_order=False, seed=seed)
    values = np.asarray(function(z), float)
    if not np.std(values) > 0:
        return tuple(Indices(name, 0.0, 0.0, 0.0, 0.0) for name in names)
    found = analysis.analyze(problem, values, calc_second_order=False, seed=seed + 1)
    keys = ("S1", "S1_conf", "ST", "ST_conf")
    return tuple(Indices(name, *(float(found[k][i]) for k in keys)) for i, name in enumerate(names))


def indices(outcome: Outcome, known: Known, mission: Mission, base: int, seed: int) -> tuple[Indices, ...]:
    """Sobol indices of an outcome: of its one entry, else of its size; the largest total first."""

    def scalar(z: np.ndarray) -> np.ndarray:
        first, sizes = _of_draws(outcome, known, mission, z)
        return first if one else sizes

    one = len(outcome.of_models(mission, mission.models)[entries_kept(outcome, mission)]) == 1
    names = [p.name for p in known.parameters()]
    if known.alike:
        names = [f"{axis} {name}" for axis in "xyz" for name in names]
    return tuple(sorted(sobol_indices(scalar, names, base, seed), key=lambda i: -i.total))
