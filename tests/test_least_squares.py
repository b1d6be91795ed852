"""The Levenberg-Marquardt driver against the certified values of NIST's nonlinear reference problems
(itl.nist.gov/div898/strd), and against closed forms where a problem misbehaves."""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import Array

from gyromodel.numerics.least_squares import Normal, Solution, levenberg_marquardt

DIGITS = 4


def _lanczos(x, b):
    return b[0] * jnp.exp(-b[1] * x) + b[2] * jnp.exp(-b[3] * x) + b[4] * jnp.exp(-b[5] * x)


def _gauss(x, b):
    peaks = b[2] * jnp.exp(-(((x - b[3]) / b[4]) ** 2)) + b[5] * jnp.exp(-(((x - b[6]) / b[7]) ** 2))
    return b[0] * jnp.exp(-b[1] * x) + peaks


def _cubic_ratio(x, b):
    above = b[0] + x * (b[1] + x * (b[2] + x * b[3]))
    return above / (1 + x * (b[4] + x * (b[5] + x * b[6])))


def _enso(x, b):
    def wave(period, cosine, sine):
        angle = 2 * jnp.pi * x / period
        return cosine * jnp.cos(angle) + sine * jnp.sin(angle)

    return b[0] + wave(12.0, b[1], b[2]) + wave(b[3], b[4], b[5]) + wave(b[6], b[7], b[8])


MODELS: dict[str, Callable[[Array, Array], Array]] = {
    "Bennett5": lambda x, b: b[0] * (b[1] + x) ** (-1 / b[2]),
    "BoxBOD": lambda x, b: b[0] * (1 - jnp.exp(-b[1] * x)),
    "Chwirut1": lambda x, b: jnp.exp(-b[0] * x) / (b[1] + b[2] * x),
    "Chwirut2": lambda x, b: jnp.exp(-b[0] * x) / (b[1] + b[2] * x),
    "DanWood": lambda x, b: b[0] * x ** b[1],
    "ENSO": _enso,
    "Eckerle4": lambda x, b: b[0] / b[1] * jnp.exp(-0.5 * ((x - b[2]) / b[1]) ** 2),
    "Gauss1": _gauss,
    "Gauss2": _gauss,
    "Gauss3": _gauss,
    "Hahn1": _cubic_ratio,
    "Kirby2": lambda x, b: (b[0] + x * (b[1] + x * b[2])) / (1 + x * (b[3] + x * b[4])),
    "Lanczos1": _lanczos,
    "Lanczos2": _lanczos,
    "Lanczos3": _lanczos,
    "MGH09": lambda x, b: b[0] * (x**2 + x * b[1]) / (x**2 + x * b[2] + b[3]),
    "MGH10": lambda x, b: b[0] * jnp.exp(b[1] / (x + b[2])),
    "MGH17": lambda x, b: b[0] + b[1] * jnp.exp(-x * b[3]) + b[2] * jnp.exp(-x * b[4]),
    "Misra1a": lambda x, b: b[0] * (1 - jnp.exp(-b[1] * x)),
    "Misra1b": lambda x, b: b[0] * (1 - (1 + b[1] * x / 2) ** -2),
    "Misra1c": lambda x, b: b[0] * (1 - (1 + 2 * b[1] * x) ** -0.5),
    "Misra1d": lambda x, b: b[0] * b[1] * x / (1 + b[1] * x),
    "Nelson": lambda x, b: b[0] - b[1] * x[0] * jnp.exp(-b[2] * x[1]),
    "Rat42": lambda x, b: b[0] / (1 + jnp.exp(b[1] - b[2] * x)),
    "Rat43": lambda x, b: b[0] / (1 + jnp.exp(b[1] - b[2] * x)) ** (1 / b[3]),
    "Roszman1": lambda x, b: b[0] - b[1] * x - jnp.arctan(b[2] / (x - b[3])) / jnp.pi,
    "Thurber": _cubic_ratio,
}
# From the first, far start these two have no descent path for a damped step in the metric of the columns' norms.
FAR = {"BoxBOD", "MGH10"}


class Problem(NamedTuple):
    """A reference problem: starts, certified values and standard deviations, and the driver's view of the residual."""

    starts: np.ndarray
    certified: np.ndarray
    std: np.ndarray
    sum_of_squares: float
    freedom: int
    normal: Callable[[np.ndarray], Normal]
    traced: Callable[[Array], tuple[Array, Array, Array]]


@lru_cache
def load(folder: Path, name: str) -> Problem:
    text = (folder / f"{name}.dat").read_text(encoding="ascii")
    rows = np.array(
        [re.findall(r"[-+.\dEe]+", line.split("=")[1]) for line in re.findall(r"(?m)^ *b\d+ *=.*$", text)], float
    )
    data = np.array([line.split() for line in text[text.rindex("Data:") :].splitlines()[1:] if line.strip()], float)
    y = jnp.asarray(np.log(data[:, 0]) if name == "Nelson" else data[:, 0])
    x = jnp.asarray(data[:, 1:].T if name == "Nelson" else data[:, 1])
    total = float(re.findall(r"Residual Sum of Squares: +(\S+)", text)[0])
    model = MODELS[name]

    @jax.jit
    def parts(b):
        residual = model(x, b) - y
        jacobian = jax.jacfwd(lambda v: model(x, v))(b)
        return jacobian.T @ jacobian, jacobian.T @ residual, residual @ residual

    def normal(b: np.ndarray) -> Normal:
        a, g, cost = parts(jnp.asarray(b))
        return np.asarray(a), np.asarray(g), float(cost)

    return Problem(rows[:, :2].T, rows[:, 2], rows[:, 3], total, len(y) - len(rows), normal, parts)


def right_digits(found: np.ndarray, certified: np.ndarray) -> float:
    """Decimal digits right in the worst parameter."""
    error = np.max(np.abs(found - certified) / np.abs(certified))
    return -np.log10(max(error, 1e-16)) if np.isfinite(error) else 0.0


def solve(problem: Problem, start: int, **options: float) -> Solution:
    return levenberg_marquardt(
        problem.normal, problem.starts[start], tolerance=1e-14, maximum_iterations=1000, **options
    )


def test_every_problem_of_the_collection_is_here(measured_data):
    assert {p.stem for p in measured_data("nist_strd").glob("*.dat")} == set(MODELS)


@pytest.mark.parametrize("name", MODELS)
def test_certified_values_from_the_near_start(name: str, measured_data):
    problem = load(measured_data("nist_strd"), name)
    found = solve(problem, 1)
    assert found.converged
    assert right_digits(found.x, problem.certified) >= DIGITS
    a, _, cost = problem.normal(found.x)
    norm = np.sqrt(np.diag(a))
    std = np.sqrt(np.diag(np.linalg.inv(a / np.outer(norm, norm))) * cost / problem.freedom) / norm
    if problem.sum_of_squares > 1e-20:  # Lanczos1 fits its data to their last digit
        assert cost == pytest.approx(problem.sum_of_squares, rel=1e-6)
        assert std == pytest.approx(problem.std, rel=1e-4)


@pytest.mark.parametrize("name", sorted(set(MODELS) - FAR))
def test_certified_values_from_the_far_start(name: str, measured_data):
    problem = load(measured_data("nist_strd"), name)
    found = solve(problem, 0, damping=1e-3)
    assert found.converged
    assert right_digits(found.x, problem.certified) >= DIGITS


def linear(matrix: np.ndarray, data: np.ndarray) -> Callable[[np.ndarray], Normal]:
    def normal(x: np.ndarray) -> Normal:
        r = matrix @ x - data
        return matrix.T @ matrix, matrix.T @ r, float(r @ r)

    return normal


def test_linear_problem_takes_one_step(rng: np.random.Generator):
    matrix, data = rng.standard_normal((40, 5)) * np.geomspace(1e-9, 1e9, 5), rng.standard_normal(40)
    calls: list[np.ndarray] = []
    normal = linear(matrix, data)

    def counted(x: np.ndarray) -> Normal:
        calls.append(x)
        return normal(x)

    found = levenberg_marquardt(counted, np.zeros(5))
    expected = np.linalg.lstsq(matrix / np.geomspace(1e-9, 1e9, 5), data)[0] / np.geomspace(1e-9, 1e9, 5)
    assert found.converged
    assert len(calls) <= 3
    assert found.x == pytest.approx(expected, rel=1e-10)
    assert found.cost == pytest.approx(np.sum((matrix @ expected - data) ** 2), rel=1e-12)


def test_non_finite_trial_is_a_rejected_one():
    """r = ln x − 1 is undefined where the full step from x = 3·e² lands."""

    def normal(x: np.ndarray) -> Normal:
        with np.errstate(all="ignore"):
            r = np.log(x[0]) - 1.0
        return np.array([[x[0] ** -2]]), np.array([r / x[0]]), float(r**2)

    start = 3 * np.e**2
    assert np.isnan(normal(np.array([start - start * (np.log(start) - 1.0)]))[2])
    found = levenberg_marquardt(normal, np.array([start]))
    assert found.converged
    assert found.x[0] == pytest.approx(np.e, rel=1e-6)


@pytest.mark.parametrize("bad", ["matrix", "gradient", "cost"])
def test_start_without_a_value_does_not_converge(bad: str):
    def normal(x: np.ndarray) -> Normal:
        nan = {name: np.nan if name == bad else 1.0 for name in ("matrix", "gradient", "cost")}
        return np.full((1, 1), nan["matrix"]), np.full(1, nan["gradient"]), nan["cost"]

    found = levenberg_marquardt(normal, np.array([2.0]))
    assert not found.converged
    assert found.x == [2.0]


def test_where_no_trial_has_a_value_nothing_converged():
    """The slope points where the function has no value, from the first step to the shortest."""

    def normal(x: np.ndarray) -> Normal:
        return np.eye(1), np.array([-1.0]), 10.0 if x[0] == 0.0 else np.nan

    assert not levenberg_marquardt(normal, np.zeros(1)).converged


def test_the_bottom_of_a_kink_is_a_minimum():
    """r = (1 + |x|, x/10): every step from zero, where the derivative is that of the right side, leads up."""

    def normal(x: np.ndarray) -> Normal:
        slope = 1.0 if x[0] >= 0 else -1.0
        r = np.array([1.0 + abs(x[0]), x[0] / 10.0])
        j = np.array([[slope], [0.1]])
        return j.T @ j, j.T @ r, float(r @ r)

    found = levenberg_marquardt(normal, np.array([0.7]))
    assert found.converged
    assert found.x == pytest.approx([0.0], abs=1e-6)


def test_the_place_of_a_hinge_is_found_between_samples_that_are_kinks_of_the_cost(rng: np.random.Generator):
    """Steep on one side of a sample and nearly flat on the other, where the least cost often is."""
    x = np.linspace(0.0, 1.0, 300)
    columns = np.column_stack([np.ones(300), x, np.maximum(x - 0.5, 0.0)])
    for _ in range(300):
        data = 2.0 * columns[:, 2] + 0.02 * rng.standard_normal(300)

        def normal(v: np.ndarray, data: np.ndarray = data) -> Normal:
            j = np.column_stack([np.ones(300), x, np.maximum(x - v[3], 0.0), -v[2] * (x > v[3])])
            r = j[:, :3] @ v[:3] - data
            return j.T @ j, j.T @ r, float(r @ r)

        found = levenberg_marquardt(normal, np.array([0.0, 0.0, 1.0, 0.45]), 1e-8)
        assert found.converged
        # There is a minimum between most samples: any near the truth will do.
        assert found.cost <= np.linalg.lstsq(columns, data)[1][0] * 1.01


def test_singular_problem_ends_at_the_least_cost_without_moving_far(rng: np.random.Generator):
    """Two equal columns and one of zeros: the cost has a least value, the parameters have none."""
    column = rng.standard_normal(30)
    matrix, data = np.column_stack([column, column, np.zeros(30)]), rng.standard_normal(30)
    found = levenberg_marquardt(linear(matrix, data), np.zeros(3))
    slope = column @ data / (column @ column)
    assert found.cost == pytest.approx(np.sum((slope * column - data) ** 2), rel=1e-10)
    assert found.x[0] + found.x[1] == pytest.approx(slope)
    assert np.abs(found.x).max() < 1e3
    assert found.x[2] == 0.0


def test_iterations_are_limited_and_a_start_given_up_says_so(measured_data):
    problem = load(measured_data("nist_strd"), "MGH10")
    found = levenberg_marquardt(problem.normal, problem.starts[0], maximum_iterations=7)
    assert (found.iterations, found.converged) == (7, False)
