"""Least-squares fit of any differentiable function, with what earlier fits found and how uncertain it is.

Values taken from earlier fits are fitted along, each of their independent errors held to zero by one more observation
of unit variance. In a linear problem that is the joint fit of all stages, one stage at a time.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Int
from scipy.stats import chi2

from gyromodel.estimate._estimate import EstimateError
from gyromodel.numerics.least_squares import FIRST_DAMPING, Normal, Solution, levenberg_marquardt
from gyromodel.numerics.uncertain import Source, Uncertain

# Relative size of a singular value of the column-scaled Jacobian below which a direction is not determined.
SINGULAR = 1e-11
# A standard uncertainty this many times the larger of a parameter's value and its start.
RUNAWAY = 1e8
# Gauss-Newton steps by QR after the normal equations, which have lost half of the digits.
POLISH = 20
MAXIMUM_ITERATIONS = 500
# Without scaling more are needed, and cheap: they are compiled in one loop.
UNSCALED_ITERATIONS = 10_000
# Rounds of fit and scatter of groups, of the scatter in one linearised fit, and the relative change that ends both.
SCALE_ROUNDS, LINEAR_ROUNDS, SCALE_CLOSE = 20, 500, 1e-6
# Observations that the parameters leave a group; with fewer its scatter is rounding.
LEAST_FREEDOM = 1e-6
# Least scatter of a group, as a part of what the errors of the given values do to its observations.
HIDDEN = 1e-3
# A minimum whose sum of squares is this improbable, the errors being known, is a false one until other starts agree.
IMPROBABLE = 1e-6


@dataclass(frozen=True, eq=False)
class FunctionFit:
    """The minimum of a sum of squares.

    Attributes:
        parameters: the fitted tree, with the sources of its error: the scatter of each group of these data, and every
            source of what was given.
        scatter: standard deviation of an observation of unit `std`, one a group; 1 where `std` is known.
        residual: measured minus predicted.
        degrees_of_freedom: observations less parameters.
        sum_of_squares: of the residuals over `std` and scatter.
        iterations: of all solvers tried.
    """

    parameters: Uncertain
    scatter: Float[np.ndarray, " group"]
    residual: Float[np.ndarray, " observation"] = field(repr=False)
    degrees_of_freedom: int
    sum_of_squares: float
    iterations: int

    @property
    def value(self) -> Any:
        """The fitted tree."""
        return self.parameters.value


def fit_function(
    function: Callable[..., Float[Array, ...]],
    start: Any,
    measured: Float[Array | np.ndarray, " observation"],
    data: Any = None,
    *,
    given: Uncertain | None = None,
    std: Float[Array | np.ndarray, "*observation"] | float | None = None,
    groups: Int[np.ndarray, " observation"] | None = None,
    name: str | Sequence[str] = "measurement",
) -> FunctionFit:
    """Fit the parameters of a function by least squares.

    Args:
        function: `function(parameters, data)`, or `function(parameters, data, given)` with the given value; returns the
            predictions. Defined once at module level it is compiled once.
        start: where the parameters begin, a tree of floats or arrays.
        measured: what the predictions are held against.
        data: arrays the function needs besides.
        given: what earlier fits found; several through `together`.
        std: standard deviation of each observation: known, unless `groups` makes it relative.
        groups: numbers from 0; observations of one group share an unknown factor of their `std`. Without `std` and
            groups all observations have one unknown standard deviation.
        name: what this measurement is called in budgets; a sequence names its groups.

    Raises:
        EstimateError: the data do not determine the parameters, or no solver converged.
    """
    y = np.asarray(measured, float)
    sizes = np.broadcast_to(1.0 if std is None else np.asarray(std, float), y.shape)
    known = std is not None and groups is None
    groups = np.zeros(len(y), int) if groups is None else np.asarray(groups)
    names = [name] * (int(groups.max(initial=0)) + 1) if isinstance(name, str) else list(name)
    name = " and ".join(dict.fromkeys(names))
    problem = _Problem(function, start, y, data, given, groups)
    if not (np.isfinite(y).all() and np.isfinite(sizes).all() and (sizes > 0).all()):
        raise EstimateError(f"{name}: observations must be finite, and their standard deviations finite and positive")
    if len(y) < problem.width or (len(y) == problem.width and not known):
        raise EstimateError(
            f"{name}: {len(y)} observations are too few for {problem.width} parameters and their scatter"
        )
    if groups.shape != y.shape or set(groups) != set(range(len(names))):
        raise EstimateError(f"{name}: groups are numbered from 0, one number an observation and one name a group")
    # One scatter, and nothing given that it competes with, leaves the solution as it is.
    alone = given is None and len(names) == 1
    scatter, iterations, start = np.ones(len(names)), 0, problem.begin
    for _ in range(SCALE_ROUNDS):
        solution = _solve(problem, 1.0 / (sizes * scatter[groups]), known, name, start)
        iterations, start = iterations + solution.iterations, solution.x
        if known:
            break
        before, scatter = scatter, _scatter(problem, solution.x, sizes, scatter, names)
        if alone or _close(scatter, before, y):
            break
    else:
        raise EstimateError(f"{name}: the scatter of its groups does not settle: state their standard deviations")
    weight = 1.0 / (sizes * scatter[groups])
    return _finished(problem, solution._replace(iterations=iterations), weight, scatter, names, known)


@dataclass(frozen=True, eq=False)
class _Problem:
    """Residuals and Jacobian over the parameters, followed by the unit errors of what was given."""

    function: Callable[..., Any]
    start: Any
    measured: np.ndarray
    data: Any
    given: Uncertain | None
    groups: np.ndarray

    @cached_property
    def begin(self) -> np.ndarray:
        return np.concatenate([np.asarray(ravel_pytree(self.start)[0], float), np.zeros(self.errors.shape[1])])

    @cached_property
    def width(self) -> int:
        return len(self.begin) - self.errors.shape[1]

    @cached_property
    def errors(self) -> np.ndarray:
        """Change of the given entries by a unit of each of their independent errors."""
        if self.given is None:
            return np.zeros((0, 0))
        return np.concatenate([np.zeros((len(self.given.vector), 0)), *self.given.sources.values()], axis=1)

    @cached_property
    def arguments(self) -> tuple[Any, ...]:
        """What `_predict` takes besides the point."""
        given = () if self.given is None else (self.given.build, self.given.vector, self.errors)
        return self.function, ravel_pytree(self.start)[1], self.width, self.data, *given

    def linearise(self, x: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Weighted residual (measured minus predicted) and the derivative of the weighted prediction."""
        predicted, jacobian = _linearise(jnp.asarray(x), *self.arguments)
        residual = (self.measured - np.asarray(predicted)) * weight
        jacobian = np.asarray(jacobian) * weight[:, None]
        errors = len(x) - self.width
        more = np.concatenate([np.zeros((errors, self.width)), np.eye(errors)], axis=1)
        return np.concatenate([residual, -x[self.width :]]), np.concatenate([jacobian, more])


def _predict(x, function, build, width, data, build_given=None, given=None, errors=None):
    if build_given is None:
        return jnp.ravel(function(build(x), data))
    return jnp.ravel(function(build(x[:width]), data, build_given(given - errors @ x[width:])))


@eqx.filter_jit
def _linearise(x, *arguments):
    return _predict(x, *arguments), jax.jacfwd(_predict)(x, *arguments)


def _solve(problem: _Problem, weight: np.ndarray, known: bool, name: str, start: np.ndarray) -> Solution:
    """The least of the minima that several solvers find; the first will do where nothing speaks against it."""
    best, tried, reason = None, 0, "no solver converged: give start values nearer to the solution"
    for solution in _attempts(problem, weight, start):
        tried += solution.iterations
        if not (solution.converged and np.isfinite(solution.x).all()):
            continue
        solution = _polished(problem, solution, weight)
        weak = _undetermined(problem, solution.x, weight, known)
        if weak:
            reason = f"the data do not determine {weak}: fix some parameters, or measure where they differ"
            continue
        if best is None or solution.cost < best.cost:
            best = solution
        freedom = len(problem.measured) - problem.width
        if not known or best.cost <= chi2.isf(IMPROBABLE, max(freedom, 1)):
            break
    if best is None:
        raise EstimateError(f"{name}: {reason}")
    return best._replace(iterations=tried)


def _attempts(problem: _Problem, weight: np.ndarray, start: np.ndarray) -> Iterator[Solution]:
    """Scaled Levenberg-Marquardt from a full and from a damped step, then optimistix's, which is not scaled."""

    def normal(x: np.ndarray) -> Normal:
        residual, jacobian = problem.linearise(x, weight)
        return jacobian.T @ jacobian, -jacobian.T @ residual, float(residual @ residual)

    with np.errstate(over="ignore", invalid="ignore"):
        yield levenberg_marquardt(normal, start, 1e-13, MAXIMUM_ITERATIONS)
        yield levenberg_marquardt(normal, start, 1e-13, MAXIMUM_ITERATIONS, FIRST_DAMPING)
    x, steps, done = _unscaled(jnp.asarray(start), problem.measured, weight, *problem.arguments)
    residual = problem.linearise(np.asarray(x), weight)[0]
    yield Solution(np.asarray(x), float(residual @ residual), int(steps), bool(done))


@eqx.filter_jit
def _unscaled(start, measured, weight, *arguments):
    width = arguments[2]

    def residual(x, _):
        return jnp.concatenate([(_predict(x, *arguments) - measured) * weight, x[width:]])

    solver = optx.LevenbergMarquardt(rtol=1e-10, atol=1e-10)
    found = optx.least_squares(residual, solver, start, max_steps=UNSCALED_ITERATIONS, throw=False)
    return found.value, found.stats["num_steps"], found.result == optx.RESULTS.successful


def _polished(problem: _Problem, solution: Solution, weight: np.ndarray) -> Solution:
    """Gauss-Newton steps by QR from a minimum, as long as they get smaller."""
    x, cost, last = solution.x, solution.cost, np.inf
    residual, jacobian = problem.linearise(x, weight)
    for _ in range(POLISH):
        norm = np.linalg.norm(jacobian, axis=0)
        if not (np.isfinite(jacobian).all() and (norm > 0).all()):
            break
        step = np.linalg.lstsq(jacobian / norm, residual, rcond=None)[0]
        size, moved = float(np.linalg.norm(step)), x + step / norm
        residual, jacobian = problem.linearise(moved, weight)
        # At the minimum rounding decides about the cost: there the step alone says whether it is nearer.
        if not size < last or not residual @ residual <= cost * (1 + 1e-6):
            break
        x, cost, last = moved, float(residual @ residual), size
    return solution._replace(x=x, cost=cost)


def _undetermined(problem: _Problem, x: np.ndarray, weight: np.ndarray, known: bool) -> str:
    """The parameters along which the sum of squares does not change; empty where there are none."""
    residual, jacobian = problem.linearise(x, weight)
    norm = np.linalg.norm(jacobian, axis=0)
    # Data that happen to fit exactly determine no more than their stated errors allow.
    scatter = max(np.linalg.norm(residual) / np.sqrt(len(residual)), float(known))
    names = _names(problem.start) + ["what was given"] * (len(x) - problem.width)
    # A parameter that ran away to where nothing depends on it.
    begin = np.abs(problem.begin)
    size = np.where(begin > 0, np.maximum(np.abs(x), begin), np.inf)
    lost = ~np.isfinite(norm) | (norm * RUNAWAY * size < scatter)
    if (norm == 0).any() or lost.any():
        return ", ".join(dict.fromkeys(n for n, bad in zip(names, lost | (norm == 0), strict=True) if bad))
    _, singular, directions = np.linalg.svd(np.linalg.qr(jacobian / norm, mode="r"))
    weak = directions[singular < SINGULAR * singular[0]]
    return ", ".join(dict.fromkeys(names[i] for d in weak for i in np.flatnonzero(np.abs(d) > 0.1)))


def _names(tree: Any) -> list[str]:
    """One name an entry: its path in the tree."""
    found = []
    for path, leaf in jax.tree_util.tree_leaves_with_path(tree):
        where = jax.tree_util.keystr(path, simple=True, separator=".") or "parameter"
        found += [where] if np.ndim(leaf) == 0 else [f"{where}[{i}]" for i in range(np.size(leaf))]
    return found


def _scatter(problem: _Problem, x: np.ndarray, sizes: np.ndarray, scatter: np.ndarray, names: list[str]) -> np.ndarray:
    """Scatter of each group in the linearised fit: squares of its residual over its redundancy (Förstner 1979)."""
    residual, jacobian = problem.linearise(x, np.ones(len(sizes)))
    # Data without any scatter are held to their last digit, and not divided by zero.
    least = np.finfo(float).eps * max(float(np.abs(problem.measured / sizes).max()), 1e-100)
    # Beside the errors of what was given a scatter can vanish by chance; far below them its size no longer matters.
    moved = np.sum(jacobian[: len(sizes), problem.width :] ** 2, axis=1) / sizes**2
    counts = np.bincount(problem.groups)
    least = np.maximum(least, HIDDEN * np.sqrt(np.bincount(problem.groups, moved) / counts))
    for _ in range(LINEAR_ROUNDS):
        weight = np.ones(len(residual))
        weight[: len(sizes)] = 1.0 / (sizes * scatter[problem.groups])
        basis, expected = _redundancy(problem, jacobian * weight[:, None])
        if expected.min() < LEAST_FREEDOM:
            group = int(np.argmin(expected))
            raise EstimateError(
                f"{names[group]}: the parameters take up all {np.sum(problem.groups == group)} observations of one "
                "scatter, and leave none to tell it from: measure more, or state standard deviations"
            )
        left = residual * weight
        left -= basis @ (basis.T @ left)
        squares = np.bincount(problem.groups, left[: len(sizes)] ** 2)
        before, scatter = scatter, np.maximum(scatter * np.sqrt(squares / np.maximum(expected, 1e-3)), least)
        if _close(scatter, before, problem.measured):
            break
    return scatter


def _close(scatter: np.ndarray, before: np.ndarray, measured: np.ndarray) -> bool:
    # Scatter as small as rounding has no size to converge to.
    return bool(np.all(np.abs(scatter - before) <= SCALE_CLOSE * before + 1e-15 * np.abs(measured).max()))


def _redundancy(problem: _Problem, jacobian: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Orthonormal basis of the weighted columns; each group's observations less what the fit takes of them."""
    norm = np.linalg.norm(jacobian, axis=0)
    basis = np.linalg.qr(jacobian / np.where(norm > 0, norm, 1.0))[0]
    return basis, np.bincount(problem.groups, 1 - np.sum(basis[: len(problem.measured)] ** 2, axis=1))


def _finished(
    problem: _Problem, solution: Solution, weight: np.ndarray, scatter: np.ndarray, names: list[str], known: bool
) -> FunctionFit:
    x, p, rows = solution.x, problem.width, len(problem.measured)
    residual, jacobian = problem.linearise(x, weight)
    norm = np.linalg.norm(jacobian, axis=0)
    q, r = np.linalg.qr(jacobian / norm)
    inverse = np.linalg.inv(r) / norm[:, None]
    # Change of the parameters by a unit error of each observation, and of each error of what was given.
    response = (inverse @ q.T)[:p]
    sources = {}
    for group, freedom in enumerate(_redundancy(problem, jacobian)[1]):
        own = Source(names[group], np.inf if known else max(float(freedom), 1e-3))
        sources[own] = np.asarray(np.linalg.qr(response[:, :rows][:, problem.groups == group].T, mode="r")).T
    first = rows
    for source, a in (problem.given.sources if problem.given is not None else {}).items():
        # The observation of an error is zero, the error itself away from its true value.
        sources[source] = -response[:, first : first + a.shape[1]]
        first += a.shape[1]
    return FunctionFit(
        parameters=Uncertain(x[:p], ravel_pytree(problem.start)[1], sources),
        scatter=scatter,
        residual=residual[:rows] / weight,
        degrees_of_freedom=rows - p,
        sum_of_squares=float(residual @ residual),
        iterations=solution.iterations,
    )
