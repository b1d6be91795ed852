"""`fit_function`: oracles are scipy's curve_fit, restricted likelihood by brute force, dense generalised least squares,
and Monte Carlo."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import curve_fit, minimize

from gyromodel.estimate import EstimateError, fit_function
from gyromodel.estimate import _function as module
from gyromodel.numerics.uncertain import Uncertain, together

X = np.linspace(0.0, 4.0, 25)


def decay(p, x):
    """p = {amplitude, rate, floor}."""
    return p["amplitude"] * jnp.exp(-p["rate"] * x) + p["floor"]


def line(p, x):
    """A line through columns."""
    return x @ p


def shifted(p, x, given):
    """A line whose abscissa has an offset, and a term of its own, from an earlier stage."""
    return p[0] + p[1] * (x - given[0]) + given[1] * x**2


def linear_in_all(p, x, given):
    """Both stages linear."""
    return p[0] + p[1] * x + given[0] * jnp.cos(x) + given[1] * x**2


def plus_given(p, x, given):
    """A mean, and what came before."""
    return p + given + 0 * x


START = {"amplitude": jnp.asarray(1.0), "rate": jnp.asarray(0.5), "floor": jnp.asarray(0.0)}


@pytest.mark.parametrize("known", [True, False])
def test_a_curve_is_fitted_as_scipy_does(known: bool, rng: np.random.Generator):
    sigma = 0.02 + 0.01 * X
    y = 3 * np.exp(-1.3 * X) + 0.5 + sigma * rng.standard_normal(len(X))
    fit = fit_function(
        decay, START, y, jnp.asarray(X), std=sigma, groups=None if known else np.zeros(len(X), int), name="decay"
    )
    # The tree's entries are in the order of their names.
    expected, covariance = curve_fit(
        lambda x, a, c, b: a * np.exp(-b * x) + c, X, y, [1.0, 0.0, 0.5], sigma, absolute_sigma=known, xtol=1e-12
    )
    size = np.sqrt(np.diag(covariance))
    assert (fit.parameters.vector - expected) / size == pytest.approx(np.zeros(3), abs=1e-4)
    assert fit.parameters.covariance / np.outer(size, size) == pytest.approx(
        covariance / np.outer(size, size), abs=1e-4
    )
    assert fit.value["rate"] == pytest.approx(expected[2], rel=1e-5)
    assert fit.degrees_of_freedom == 22
    assert (fit.scatter[0] == 1) == known
    freedom = fit.parameters.degrees_of_freedom
    assert np.isinf(freedom).all() if known else freedom == pytest.approx(np.full(3, 22.0))


def restricted(log_variances, design, y, groups) -> float:
    """Minus twice the restricted log likelihood of a linear model with one variance a group."""
    weight = np.exp(-np.asarray(log_variances))[groups]
    normal = design.T @ (weight[:, None] * design)
    left = y - design @ np.linalg.solve(normal, design.T @ (weight * y))
    return float(-np.sum(np.log(weight)) + np.linalg.slogdet(normal)[1] + np.sum(weight * left**2))


def test_scatter_of_groups_is_that_of_greatest_restricted_likelihood(rng: np.random.Generator):
    groups = np.repeat([0, 1, 2], [6, 9, 20])
    design = np.column_stack([np.ones(35), rng.standard_normal((35, 3))])
    y = design @ [1, 2, -1, 0.5] + np.array([0.05, 3.0, 0.3])[groups] * rng.standard_normal(35)
    names = ("fine", "coarse", "fair")
    fit = fit_function(line, jnp.zeros(4), y, jnp.asarray(design), groups=groups, name=names)
    best = minimize(restricted, 2 * np.log(fit.scatter), (design, y, groups), "Nelder-Mead", options={"xatol": 1e-9})
    assert np.exp(best.x / 2) == pytest.approx(fit.scatter, rel=1e-4)
    weight = 1 / fit.scatter[groups] ** 2
    assert fit.parameters.covariance == pytest.approx(np.linalg.inv(design.T @ (weight[:, None] * design)), rel=1e-8)
    assert fit.scatter[0] < fit.scatter[2] < fit.scatter[1]
    assert {s.name: round(s.degrees_of_freedom) for s in fit.parameters.sources}.keys() == set(names)
    assert sum(s.degrees_of_freedom for s in fit.parameters.sources) == pytest.approx(31)
    assert sum(fit.parameters.budget().values()) == pytest.approx(np.ones(4))


def test_what_was_given_enters_as_in_dense_generalised_least_squares(rng: np.random.Generator):
    """V + G C Gᵀ as covariance of the observations, G the derivative of the predictions by what was given."""
    covariance = np.array([[0.04, 0.01], [0.01, 0.02]])
    given = Uncertain.stated(jnp.array([0.7, -0.2]), covariance, "earlier")
    sigma = np.linspace(0.1, 0.3, len(X))
    y = 1 + 2 * X + 0.6 * np.cos(X) - 0.15 * X**2 + sigma * rng.standard_normal(len(X))
    fit = fit_function(linear_in_all, jnp.zeros(2), y, jnp.asarray(X), given=given, std=sigma, name="now")
    slope = np.column_stack([np.cos(X), X**2])
    design = np.column_stack([np.ones(len(X)), X])
    inverse = np.linalg.inv(np.diag(sigma**2) + slope @ covariance @ slope.T)
    expected = np.linalg.inv(design.T @ inverse @ design)
    assert fit.parameters.covariance == pytest.approx(expected, rel=1e-9)
    assert fit.parameters.vector == pytest.approx(expected @ design.T @ inverse @ (y - slope @ [0.7, -0.2]), rel=1e-9)
    assert set(fit.parameters.budget()) == {"now", "earlier"}


def test_errors_that_were_given_keep_their_sign(rng: np.random.Generator):
    """A mean from which a known offset was taken: the offset's error enters it with the other sign, and cancels in
    their sum."""
    offset = Uncertain.stated(jnp.asarray(5.0), 0.09, "offset")
    y = 7 + 0.01 * rng.standard_normal(len(X))
    fit = fit_function(plus_given, jnp.asarray(0.0), y, jnp.asarray(X), given=offset, std=0.01)
    assert fit.parameters.sources[next(iter(offset.sources))][0, 0] == pytest.approx(
        -next(iter(offset.sources.values()))[0, 0]
    )
    total = together(fit.parameters, offset).propagate(lambda v: v[0] + v[1])
    assert total.std == pytest.approx([0.01 / 5])
    assert total.vector == pytest.approx([y.mean()])


def test_scatter_is_told_from_what_was_given(rng: np.random.Generator):
    """Errors of an earlier stage that these data show too are no scatter: restricted likelihood with V + G C Gᵀ."""
    covariance = np.diag([0.3, 0.1]) ** 2
    given = Uncertain.stated(jnp.array([0.7, -0.2]), covariance, "earlier")
    true = np.array([0.7, -0.2]) + 3 * np.array([0.3, 0.1])
    y = 1 + 2 * X + true[0] * np.cos(X) + true[1] * X**2 + 0.05 * rng.standard_normal(len(X))
    fit = fit_function(linear_in_all, jnp.zeros(2), y, jnp.asarray(X), given=given)
    slope, design = np.column_stack([np.cos(X), X**2]), np.column_stack([np.ones(len(X)), X])

    def minus_likelihood(log_variance: np.ndarray) -> float:
        v = np.exp(log_variance[0]) * np.eye(len(X)) + slope @ covariance @ slope.T
        inverse = np.linalg.inv(v)
        normal = design.T @ inverse @ design
        left = y - slope @ [0.7, -0.2]
        left = left - design @ np.linalg.solve(normal, design.T @ inverse @ left)
        return float(np.linalg.slogdet(v)[1] + np.linalg.slogdet(normal)[1] + left @ inverse @ left)

    best = minimize(minus_likelihood, [2 * np.log(0.06)], method="Nelder-Mead", options={"xatol": 1e-8})
    assert fit.scatter[0] == pytest.approx(np.exp(best.x[0] / 2), rel=1e-4)


def test_nothing_is_compiled_again_for_new_data(rng: np.random.Generator):
    def once() -> int:
        given = Uncertain.stated(jnp.asarray(rng.normal(0, 0.1, 2)), 0.01, "earlier")
        fit_function(shifted, jnp.zeros(2), 1 + X, jnp.asarray(X), given=given, std=0.1)
        return module._linearise._cached._cache_size()

    assert once() == once()


def test_a_parameter_that_the_data_do_not_determine_is_named():
    design = np.column_stack([np.ones(25), X, 2 * X])

    def grouped(p, x):
        return x @ jnp.append(p["level"], p["slopes"])

    start = {"level": jnp.asarray(0.0), "slopes": jnp.zeros(2)}
    with pytest.raises(EstimateError, match=r"rig: the data do not determine slopes\[0\], slopes\[1\]: fix some"):
        fit_function(grouped, start, X, jnp.asarray(design), std=0.1, name="rig")
    with pytest.raises(EstimateError, match="do not determine rate"):
        fit_function(decay, {**START, "amplitude": jnp.asarray(0.0)}, np.full(25, 0.5), jnp.asarray(X), std=0.1)


@pytest.mark.parametrize(
    ("y", "options", "message"),
    [
        (X[:3], {}, "rig: 3 observations are too few for 3 parameters and their scatter"),
        (X[:2], {"std": 0.1}, "rig: 2 observations are too few"),
        (np.append(X[:-1], np.nan), {"std": 0.1}, "rig: observations must be finite"),
        (X, {"std": 0.0}, "standard deviations finite and positive"),
        (X, {"groups": np.repeat([0, 2], [5, 20])}, "groups are numbered from 0"),
        (X, {"groups": np.zeros(25, int), "name": ("a", "b")}, "a and b: groups are numbered from 0"),
    ],
)
def test_what_cannot_be_fitted_is_refused(y: np.ndarray, options: dict, message: str):
    with pytest.raises(EstimateError, match=message):
        fit_function(decay, START, y, jnp.asarray(X[: len(y)]), **{"name": "rig", **options})


def test_data_without_scatter_are_fitted():
    """Zeros, and integers on a line: residuals of exactly zero, with one group and with two."""
    design = np.column_stack([np.ones(8), np.arange(8.0)])
    for y in (np.zeros(8), design @ [3.0, 2.0]):
        for groups in (None, np.repeat([0, 1], 4)):
            fit = fit_function(line, jnp.ones(2), y, jnp.asarray(design), groups=groups)
            assert np.asarray(fit.value) == pytest.approx([y[0], y[1] - y[0]], abs=1e-12)
            assert np.isfinite(fit.parameters.covariance).all()
            assert (fit.parameters.std < 1e-12).all()


def test_three_observations_of_known_error_determine_three_parameters():
    y = 3 * np.exp(-1.3 * X[:3]) + 0.5
    fit = fit_function(decay, START, y, jnp.asarray(X[:3]), std=1e-6)
    assert fit.residual == pytest.approx(np.zeros(3), abs=1e-9)
    assert fit.degrees_of_freedom == 0


def test_a_group_without_redundancy_is_refused(rng: np.random.Generator):
    design = np.column_stack([np.ones(9), np.arange(9) == 8])
    groups = np.array([0] * 8 + [1])
    with pytest.raises(EstimateError, match="alone: the parameters take up all 1 observations of one scatter"):
        fit_function(line, jnp.zeros(2), rng.normal(size=9), jnp.asarray(design), groups=groups, name=("many", "alone"))
