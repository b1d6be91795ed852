"""Splines against scipy's, and the smoothing spline against its mixed model written out densely.

Expected numbers: scipy.interpolate.CubicSpline and make_smoothing_spline on the same input; a line plus an integrated
Wiener process with its covariance min²(3 max − min)/6, its restricted likelihood maximised by scipy.optimize; draws
from that process for the coverage of intervals; finite differences.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jax.test_util import check_grads
from scipy import optimize, stats
from scipy.interpolate import CubicSpline as ScipySpline
from scipy.interpolate import make_smoothing_spline

from gyromodel.numerics.splines import (
    CubicSpline,
    cubic_spline,
    second_differences,
    slope_jumps,
    slope_range,
    smoothing_spline,
    spline_matrix,
)

ENDS = ("natural", "clamped", "not-a-knot")
COUNT = 9
POINTS = 40


def uneven(rng: np.random.Generator, count: int) -> np.ndarray:
    """Knots whose spacings differ a hundredfold."""
    return rng.uniform(-5, 5) + np.cumsum(10 ** rng.uniform(-1, 1, count))


def scipy_spline(x: np.ndarray, y: np.ndarray, ends: str, slopes: np.ndarray) -> ScipySpline:
    return ScipySpline(x, y, bc_type=((1, slopes[0]), (1, slopes[1])) if ends == "clamped" else ends)  # type: ignore[arg-type]


@pytest.mark.parametrize("ends", ENDS)
@pytest.mark.parametrize("count", [3, COUNT])
@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=15)
def test_equals_scipy_inside_and_outside(ends: str, count: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    x, y, slopes = uneven(rng, count), rng.normal(size=(2, count)), rng.normal(size=2)
    spline = cubic_spline(jnp.asarray(x), jnp.asarray(y), ends, jnp.asarray(slopes))  # type: ignore[arg-type]
    points = np.concatenate([x, rng.uniform(x[0], x[-1], POINTS - count - 2), [x[0] - 1.0, x[-1] + 1.0]])
    for values, one in zip(y, range(2), strict=True):
        oracle = scipy_spline(x, values, ends, slopes)
        for order in (0, 1, 2):
            expected = oracle(points, order)
            if ends == "natural":
                # Beyond its ends a natural spline goes on straight, which scipy's does not.
                straight = [oracle(x[0]) - oracle(x[0], 1), oracle(x[-1]) + oracle(x[-1], 1)]
                expected[-2:] = (straight, oracle(x[[0, -1]], 1), np.zeros(2))[order]
            found = np.asarray(spline(jnp.asarray(points), order))[one]  # type: ignore[arg-type]
            # What rounding of the values does to differences over the narrowest interval.
            size = np.abs(expected).max() if order == 0 else np.abs(values).max() / np.diff(x).min() ** order
            assert found == pytest.approx(expected, abs=1e-12 * size), order


@pytest.mark.parametrize("ends", ENDS)
def test_two_points_make_a_line(ends: str) -> None:
    slope = jnp.full(2, 3.0)
    spline = cubic_spline(jnp.array([1.0, 3.0]), jnp.array([2.0, 8.0]), ends, slope)  # type: ignore[arg-type]
    assert np.asarray(spline(jnp.array([0.0, 2.0, 5.0]))) == pytest.approx([-1.0, 5.0, 14.0], rel=1e-14)


@pytest.mark.parametrize("ends", ENDS)
def test_the_matrix_is_the_spline_and_its_derivative_by_the_values(ends: str, rng: np.random.Generator) -> None:
    x, y = jnp.asarray(uneven(rng, COUNT)), jnp.asarray(rng.normal(size=COUNT))
    points = jnp.asarray(rng.uniform(float(x[0]) - 2, float(x[-1]) + 2, POINTS))

    def of_values(v):
        spline = cubic_spline(x, v, ends)  # type: ignore[arg-type]
        return jnp.stack([spline(points, order) for order in (0, 1, 2)])

    value, derivative = jax.jit(lambda v: (of_values(v), jax.jacfwd(of_values)(v)))(y)
    for order, curve, by_values in zip((0, 1, 2), np.asarray(value), np.asarray(derivative), strict=True):
        matrix = np.asarray(spline_matrix(x, points, ends, order))  # type: ignore[arg-type]
        assert matrix @ np.asarray(y) == pytest.approx(curve, abs=1e-11 * np.abs(matrix).max())
        assert by_values == pytest.approx(matrix, abs=1e-12 * np.abs(matrix).max())


@pytest.mark.parametrize("ends", ENDS)
def test_derivatives_by_everything(ends: str) -> None:
    x = jnp.array([0.0, 0.7, 1.1, 2.5, 3.0])
    y, slopes = jnp.array([1.0, -0.5, 0.3, 2.0, 1.0]), jnp.array([0.4, -1.0])
    points = jnp.array([-0.4, 0.2, 0.9, 2.2, 3.3])

    @jax.jit
    def values(knots, ordinates, slopes, points):
        return cubic_spline(knots, ordinates, ends, slopes)(points)  # type: ignore[arg-type]

    check_grads(values, (x, y, slopes, points), order=1, modes=("rev",), rtol=1e-6, atol=1e-6)


def test_many_splines_at_once_compile_once(rng: np.random.Generator) -> None:
    x, y = jnp.asarray(uneven(rng, COUNT)), jnp.asarray(rng.normal(size=(7, COUNT)))
    points = jnp.linspace(x[0], x[-1], POINTS)
    whole = cubic_spline(x, y)(points)
    each = jnp.stack([cubic_spline(x, row)(points) for row in y])
    mapped = jax.vmap(lambda row: cubic_spline(x, row)(points))(y)
    assert np.asarray(whole) == pytest.approx(np.asarray(each), abs=1e-13)
    assert np.asarray(whole) == pytest.approx(np.asarray(mapped), abs=1e-13)
    before = cubic_spline._cache_size()
    for row in y:
        cubic_spline(x + row[0], 2.0 * row)
    assert cubic_spline._cache_size() == before


def test_second_differences_and_jumps_by_hand() -> None:
    x, y = jnp.array([0.0, 1.0, 3.0]), jnp.array([0.0, 2.0, -2.0])
    # First divided differences 2 and −2 over a span of 3.
    assert float(second_differences(x, y)[0]) == pytest.approx(-4 / 3, rel=1e-15)
    # A polygon has k = 0, and its slope falls by 4 at the middle knot.
    assert float(slope_jumps(CubicSpline(x, y, jnp.zeros(3)))[0]) == pytest.approx(-4.0, rel=1e-15)


def test_slope_jumps_are_those_of_the_curve(rng: np.random.Generator) -> None:
    x, y, k = uneven(rng, COUNT), rng.normal(size=COUNT), rng.normal(size=COUNT)
    spline = CubicSpline(jnp.asarray(x), jnp.asarray(y), jnp.asarray(k))
    edge = 1e-9
    left, right = (np.asarray(spline(jnp.asarray(x[1:-1] + e), 1)) for e in (-edge, edge))
    assert np.asarray(slope_jumps(spline)) == pytest.approx(right - left, abs=1e-6)
    solved = cubic_spline(spline.knots, spline.values)
    assert np.abs(np.asarray(slope_jumps(solved))).max() < 1e-12 * np.abs(np.asarray(solved(spline.knots, 1))).max()


@pytest.mark.parametrize("ends", ENDS)
def test_slope_range_is_exact(ends: str, rng: np.random.Generator) -> None:
    x, y = uneven(rng, COUNT), rng.normal(size=(3, COUNT))
    low, high = slope_range(cubic_spline(jnp.asarray(x), jnp.asarray(y), ends))  # type: ignore[arg-type]
    for values, least, most in zip(y, np.asarray(low), np.asarray(high), strict=True):
        slope = scipy_spline(x, values, ends, np.zeros(2)).derivative()
        turning = slope.derivative().roots(extrapolate=False)
        extremes = slope(np.concatenate([x, turning[np.isfinite(turning)]]))
        assert (least, most) == pytest.approx((extremes.min(), extremes.max()), rel=1e-10)


def walk_covariance(x: np.ndarray) -> np.ndarray:
    """Covariance of an integrated Wiener process started at the first point."""
    t = x - x[0]
    low, high = np.minimum(t[:, None], t), np.maximum(t[:, None], t)
    return low**2 * (3 * high - low) / 6


def dense_reml(x: np.ndarray, y: np.ndarray, w: np.ndarray, smoothness: float):
    """Log restricted likelihood with σ² profiled out, σ², and the curve's posterior, from the textbook formulas."""
    n, line = len(x), np.column_stack([np.ones_like(x), x])
    walk = walk_covariance(x) / smoothness
    v = np.diag(1 / w) + walk
    inverse = np.linalg.inv(v)
    information = line.T @ inverse @ line
    p = inverse - inverse @ line @ np.linalg.solve(information, line.T @ inverse)
    variance = y @ p @ y / (n - 2)
    dets = [np.linalg.slogdet(m)[1] for m in (v, information, line.T @ line)]
    likelihood = -0.5 * ((n - 2) * (np.log(2 * np.pi * variance) + 1) + dets[0] + dets[1] - dets[2])
    fitted = y - p @ y / w
    rest = line - walk @ inverse @ line
    covariance = walk - walk @ inverse @ walk + rest @ np.linalg.solve(information, rest.T)
    return likelihood, variance, fitted, variance * covariance


def dense_map(x: np.ndarray, w: np.ndarray, smoothness: float) -> np.ndarray:
    """The matrix that maps y to the fitted values."""
    return np.column_stack([dense_reml(x, e, w, smoothness)[2] for e in np.eye(len(x))])


@pytest.mark.parametrize("weighted", [False, True])
def test_smoothing_spline_is_the_mixed_model(weighted: bool, rng: np.random.Generator) -> None:
    n = 40
    x = uneven(rng, n) / 10
    w = rng.uniform(0.3, 3.0, n) if weighted else np.ones(n)
    y = 5 * np.sin(x / np.ptp(x) * 9) + rng.normal(size=n) / np.sqrt(w)
    fit = smoothing_spline(jnp.asarray(x), jnp.asarray(y), jnp.asarray(w) if weighted else None)
    best = optimize.minimize_scalar(
        lambda log: -dense_reml(x, y, w, np.exp(log))[0],
        bracket=(np.log(fit.smoothness) - 3, np.log(fit.smoothness) + 4),
        tol=1e-10,
    )
    likelihood, variance, fitted, covariance = dense_reml(x, y, w, float(fit.smoothness))
    assert float(fit.log_restricted_likelihood) == pytest.approx(-best.fun, abs=1e-7)
    assert np.log(float(fit.smoothness)) == pytest.approx(best.x, abs=1e-3)
    assert float(fit.log_restricted_likelihood) == pytest.approx(likelihood, abs=1e-7)
    assert float(fit.variance) == pytest.approx(variance, rel=1e-7)
    assert np.asarray(fit.spline.values) == pytest.approx(fitted, abs=1e-7)
    assert np.asarray(fit.covariance) == pytest.approx(covariance, abs=1e-7 * covariance.max())
    scipy_values = make_smoothing_spline(x, y, w=w, lam=float(fit.smoothness))(x)
    assert np.asarray(fit.spline.values) == pytest.approx(scipy_values, abs=1e-8)
    # At a given smoothness the fit is linear in y: the trace of that map.
    p = np.diag(dense_map(x, w, float(fit.smoothness)))
    assert float(fit.degrees_of_freedom) == pytest.approx(p.sum(), rel=1e-7)


def test_points_on_a_line_are_fitted_by_a_line(rng: np.random.Generator) -> None:
    x = np.linspace(0.0, 10.0, 30)
    y = 3 * x - 1 + 1e-3 * (-1.0) ** np.arange(30)
    fit = smoothing_spline(jnp.asarray(x), jnp.asarray(y))
    assert float(fit.degrees_of_freedom) == pytest.approx(2.0, abs=1e-3)
    assert np.asarray(fit.spline.values) == pytest.approx(np.polyval(np.polyfit(x, y, 1), x), abs=1e-6)


@pytest.mark.parametrize("known", [True, False])
def test_intervals_cover_the_curve(known: bool, rng: np.random.Generator) -> None:
    """Curves drawn from the process itself: with its smoothness known, Student's interval is exact at any point.

    With the smoothness estimated, intervals hold it fixed and are a little short: at least 90 % is claimed for 95 %.
    """
    draws, n, smoothness = 1000, 40, 2e-3
    x = np.sort(rng.uniform(0, 10, n))
    root = np.linalg.cholesky(walk_covariance(x)[1:, 1:] / smoothness)
    truth = rng.normal(size=(draws, 1)) + rng.normal(size=(draws, 1)) * x
    truth[:, 1:] += rng.normal(size=(draws, n - 1)) @ root.T
    y = truth + rng.normal(size=truth.shape)
    given_smoothness = jnp.asarray(smoothness) if known else None
    fits = jax.vmap(lambda v: smoothing_spline(jnp.asarray(x), v, None, given_smoothness))(jnp.asarray(y))
    at = rng.integers(n, size=draws)
    every = np.arange(draws)
    std = np.sqrt(np.asarray(fits.covariance)[every, at, at])
    error = np.abs(np.asarray(fits.spline.values) - truth)[every, at]
    covered = int((error < stats.t.ppf(0.975, n - 2) * std).sum())
    assert covered >= stats.binom.ppf(2e-5, draws, 0.95 if known else 0.90)
    assert covered <= stats.binom.ppf(1 - 2e-5, draws, 0.95)
