"""The input-output curve: values, inverse and uncertainty against scipy's spline, root finding and Monte Carlo.

Expected numbers: scipy.interpolate.CubicSpline with natural ends and scipy.optimize.brentq on it; the spread of curves
through perturbed points; cubics whose slope is known in closed form.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats
from scipy.interpolate import CubicSpline
from scipy.optimize import brentq

from gyromodel.input_output import CurveError, InputOutputCurve

COUNT = 12
RATES = np.deg2rad(np.linspace(-100, 120, COUNT))


def bent(rate: np.ndarray) -> np.ndarray:
    """A scale factor of 1000 count per radian that bends by a few per cent."""
    return 1000 * rate * (1 + 0.03 * np.sin(rate)) + 2


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_inverse_is_the_root(sign: float, rng: np.random.Generator) -> None:
    output = sign * bent(RATES)
    shuffled = rng.permutation(COUNT)
    curve = InputOutputCurve.through(jnp.asarray(RATES[shuffled]), jnp.asarray(output[shuffled]))
    oracle = CubicSpline(RATES, output, bc_type="natural")
    asked = np.concatenate([rng.uniform(output.min(), output.max(), 20), output])
    found, std = curve.rate(jnp.asarray(asked))
    roots = [brentq(lambda r, y=y: oracle(r) - y, RATES[0] - 1e-3, RATES[-1] + 1e-3, xtol=1e-14) for y in asked]
    assert np.asarray(found) == pytest.approx(np.array(roots), abs=1e-13)
    assert not np.asarray(std).any()
    back, _ = curve.output(found)
    assert np.asarray(back) == pytest.approx(asked, rel=1e-13, abs=1e-10)
    slope, _ = curve.scale_factor(jnp.asarray(RATES))
    assert np.asarray(slope) == pytest.approx(oracle(RATES, 1), rel=1e-12)


def test_uncertainty_is_the_spread_of_curves_through_other_points(rng: np.random.Generator) -> None:
    """First order is exact for the output, and here nearly so for the rate; the readings' own scatter is added."""
    draws, own = 2000, 1.5
    root = rng.normal(size=(COUNT, COUNT))
    covariance = root @ root.T
    curve = InputOutputCurve.through(jnp.asarray(RATES), jnp.asarray(bent(RATES)), jnp.asarray(covariance))
    at = np.deg2rad(33.0)
    value, std = (float(v[0]) for v in curve.output(jnp.array([at])))
    slope, slope_std = (float(v[0]) for v in curve.scale_factor(jnp.array([at])))
    rate, rate_std = (float(v[0]) for v in curve.rate(jnp.array([value]), own))
    assert rate == pytest.approx(at, abs=1e-13)
    others = CubicSpline(RATES, bent(RATES)[:, None] + root @ rng.normal(size=(COUNT, draws)), bc_type="natural")
    read = value + own * rng.normal(size=draws)
    # One Newton step from the truth: curves differ from one another by a part in a thousand.
    rates = at - (others(at) - read) / others(at, 1)
    for spread, claimed in ((others(at), std), (others(at, 1), slope_std), (rates, rate_std)):
        low, high = stats.chi2.ppf([1e-5, 1 - 1e-5], draws - 1) / (draws - 1)
        assert low < np.var(spread, ddof=1) / claimed**2 < high
    assert slope == pytest.approx(float(CubicSpline(RATES, bent(RATES), bc_type="natural")(at, 1)), rel=1e-12)


@pytest.mark.parametrize("known", [True, False])
def test_smoothing_averages_the_scatter_of_the_points(known: bool, rng: np.random.Generator) -> None:
    """With the scatter known the points, eight readings each, are as good as a few more; estimated from forty rates."""
    count, draws, square = COUNT if known else 40, 60, 0.0
    rates = np.deg2rad(np.linspace(-100, 120, count))
    for _ in range(draws):
        std = 0.5 * rng.uniform(0.5, 2.0, count) ** known
        output = 1000 * rates + 2 + std * rng.normal(size=count)
        curve = InputOutputCurve.smoothed(jnp.asarray(rates), jnp.asarray(output), jnp.asarray(std) if known else None)
        error, claimed = np.asarray(curve.spline.values) - (1000 * rates + 2), np.asarray(curve.covariance)
        k = rng.integers(count)
        square += error[k] ** 2 / claimed[k, k]
        assert np.trace(claimed) < 0.7 * np.sum(std**2)
    # One point of each curve; where the scatter is estimated its own error adds a little.
    assert stats.chi2.ppf(1e-5, draws) < square < (1.0 if known else 1.3) * stats.chi2.isf(1e-5, draws)


def test_few_points_do_not_tell_their_own_scatter() -> None:
    """Beside a strong bend twelve points hide any scatter: the likeliest curve goes through them all, as if exact."""
    strongly = 1000 * RATES * (1 + 0.3 * np.sin(RATES)) + 0.01 * (-1.0) ** np.arange(COUNT)
    with pytest.raises(CurveError, match=r"leaves 0\.0 of 12 points to tell their scatter from: give output_std"):
        InputOutputCurve.smoothed(jnp.asarray(RATES), jnp.asarray(strongly))


def test_a_curve_that_turns_between_its_points_is_refused() -> None:
    """The points rise, the spline falls between 2 and 3 rad/s: the slope at the knots does not show it."""
    rate, output = jnp.arange(6.0), jnp.array([0.0, 2.0, 6.0, 6.1, 10.0, 12.0])
    curve = InputOutputCurve.through(rate, output)
    slope = CubicSpline(np.arange(6.0), np.asarray(output), bc_type="natural").derivative()
    turning = slope.derivative().roots(extrapolate=False)
    low, high = curve.slope_range()
    assert low == pytest.approx(float(slope(turning).min()), rel=1e-10)
    assert low < 0 < float(slope(np.arange(6.0)).min())
    with pytest.raises(CurveError, match=r"not monotone: its slope runs from -0\.\d+ to 4\.\d+ per rad/s"):
        curve.rate(jnp.array([3.0]))
    assert float(curve.output(jnp.array([2.0]))[0][0]) == pytest.approx(6.0)
    assert high > 4.0


def test_nothing_is_said_beyond_the_points() -> None:
    curve = InputOutputCurve.through(jnp.asarray(RATES), jnp.asarray(bent(RATES)))
    ends = jnp.asarray(np.deg2rad([-100.0, 120.0]))
    assert np.isfinite(np.asarray(curve.output(ends)[0])).all()
    with pytest.raises(CurveError, match=r"rate 120\.1 deg/s is outside .* from -100 to 120 deg/s"):
        curve.output(jnp.asarray(np.deg2rad([0.0, 120.1])))
    with pytest.raises(CurveError, match=r"rate nan deg/s is outside"):
        curve.scale_factor(jnp.array([jnp.nan]))
    with pytest.raises(CurveError, match=r"output 5000 is outside"):
        curve.rate(jnp.array([5000.0]))


@pytest.mark.parametrize(
    ("rates", "outputs", "message"),
    [
        ([0.0, 1.0, 1.0, 2.0], [0.0, 1.0, 1.1, 2.0], "4 or more different rates: average"),
        ([0.0, 1.0, 2.0], [0.0, 1.0, 2.0], "4 or more different rates"),
        ([0.0, 1.0, 2.0, 3.0], [0.0, jnp.nan, 2.0, 3.0], "not a finite number"),
    ],
)
def test_points_that_make_no_curve_are_refused(rates: list[float], outputs: list[float], message: str) -> None:
    with pytest.raises(CurveError, match=message):
        InputOutputCurve.smoothed(jnp.array(rates), jnp.array(outputs))
