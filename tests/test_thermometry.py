"""Thermistor thermometry: oracles are the equation itself in numpy, root finding, numpy's polynomial fit, and Monte
Carlo over the independent simulator of `tests/truth/rate_integrating.py`."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.stats import chi2

from gyromodel._checks import CampaignError
from gyromodel.estimate import EstimateError
from gyromodel.thermometry import ZERO_CELSIUS, Thermistor, fit_thermistor
from tests.truth import rate_integrating as truth

# Two segments that do not meet at 10 kΩ: 0.4 K apart.
BROKEN = Thermistor(
    jnp.array([[3.3540e-3, 2.567e-4, 2.4e-6, 1.0e-7], [3.3585e-3, 2.60e-4, 2.0e-6, 0.8e-7]]), jnp.asarray(1e4)
)
RANGE = np.linspace(-60.0, 120.0, 37)


def test_temperature_is_the_equation_in_raw_coefficients():
    resistance = np.array([900.0, 5e3, 9999.0, 10001.0, 4e4, 3e5])
    raw = np.asarray(BROKEN.raw_coefficients())[[1, 1, 1, 0, 0, 0]]
    expected = 1 / np.sum(raw * np.log(resistance)[:, None] ** np.arange(4), axis=1) - 273.15
    assert np.asarray(BROKEN.temperature(resistance)) == pytest.approx(expected, abs=1e-8)


def test_resistance_inverts_temperature():
    for device in (BROKEN, Thermistor(BROKEN.coefficients[:1], BROKEN.reference)):
        t = RANGE[np.abs(RANGE - 24) > 1]
        assert np.asarray(device.temperature(device.resistance(t))) == pytest.approx(t, abs=1e-9)
    cold = float(BROKEN.resistance(jnp.asarray(-33.0)))
    assert brentq(lambda r: float(BROKEN.temperature(jnp.asarray(r))) + 33.0, 1.1e4, 1e6, rtol=1e-13) == pytest.approx(
        cold
    )


def test_derivatives_are_those_of_differences():
    step = 1e-6
    for r in (4e3, 1e4, 6e4):
        slope = float(jax.grad(BROKEN.temperature)(jnp.asarray(r)))
        side = np.array([1 - step, 1 - 3 * step]) if r <= 1e4 else np.array([1 + step, 1 - step])
        ends = np.asarray(BROKEN.temperature(jnp.asarray(r * side)))
        assert slope == pytest.approx((ends[0] - ends[1]) / (r * (side[0] - side[1])), rel=1e-5)


def test_a_fit_of_exact_readings_finds_the_coefficients_of_each_segment():
    warm = np.linspace(0.5, 60.0, 9)
    cold = np.linspace(-40.0, -0.5, 9)
    exact = Thermistor(jnp.array([[3.66e-3, 2.56e-4, 2.4e-6, 1e-7], [3.66e-3, 2.6e-4, 2e-6, 1.4e-7]]), jnp.asarray(3e4))
    t = np.concatenate([cold, warm])
    fit = fit_thermistor(exact.resistance(t), t, joint=float(1 / 3.66e-3 - ZERO_CELSIUS), std=0.01)
    assert np.asarray(fit.value.raw_coefficients()) == pytest.approx(np.asarray(exact.raw_coefficients()), rel=1e-4)
    assert np.asarray(fit.value.temperature(exact.resistance(RANGE))) == pytest.approx(RANGE, abs=1e-4)
    assert np.abs(fit.residual).max() < 1e-8


def test_segments_meet_as_far_as_they_are_asked_to(rng: np.random.Generator):
    found = truth.simulate(truth.SOURCE, rng)

    def sides(continuity: int) -> np.ndarray:
        """Value and derivatives by ln R on both sides of the joint."""
        fit = fit_thermistor(
            found.calibration_resistance, found.calibration_temperature, joint=0.0, continuity=continuity
        )
        near = fit.value.reference * np.exp(np.array([1e-9, -1e-9]))
        inverse = 1 / (np.asarray(fit.value.temperature(near)) + ZERO_CELSIUS)
        assert inverse == pytest.approx(np.asarray(fit.value.coefficients[:, 0]), rel=1e-9)
        assert near[0] == pytest.approx(truth.SOURCE.resistance(np.array(0.0)), rel=1e-3)
        return np.asarray(fit.value.coefficients)

    for continuity in (0, 1, 2):
        cold, warm = sides(continuity)
        assert (cold[:continuity] == warm[:continuity]).all()
        assert (cold[continuity:] != warm[continuity:]).all()


def test_scatter_is_that_of_two_polynomial_fits(rng: np.random.Generator):
    """In 1/T the segments are polynomials: numpy's fits, weighted to errors of T, leave the same scatter."""
    found = truth.simulate(truth.SOURCE, rng)
    r, t = found.calibration_resistance, found.calibration_temperature
    fit = fit_thermistor(r, t, joint=0.0)
    x = np.log(r / float(fit.value.reference))
    for scatter, part in zip(fit.scatter, (x > 0, x <= 0), strict=True):
        kelvin = t[part] + 273.15
        polynomial = np.polynomial.Polynomial.fit(x[part], 1 / kelvin, 3, w=kelvin**2)
        left = kelvin - 1 / polynomial(x[part])
        assert scatter == pytest.approx(np.sqrt(np.sum(left**2) / (part.sum() - 4)), rel=1e-4)


def test_stated_temperature_errors_are_the_true_ones(rng: np.random.Generator):
    """(error/std)² at four temperatures by their full covariance, over 60 calibrations with known scatter."""
    at = jnp.asarray(truth.SOURCE.resistance(np.array([-35.0, -5.0, 5.0, 50.0])))
    spread = np.where(truth.SOURCE.calibration < 0, *truth.THERMOMETRY)
    total, count = 0.0, 60
    for _ in range(count):
        found = truth.simulate(truth.SOURCE, rng)
        # A joint between calibrated points keeps the readings at 0 °C out of the colder segment.
        fit = fit_thermistor(found.calibration_resistance, found.calibration_temperature, joint=-2.5, std=spread)
        soak = fit.parameters.propagate(lambda device: device.temperature(at))
        error = soak.vector - np.array([-35.0, -5.0, 5.0, 50.0])
        total += error @ np.linalg.solve(soak.covariance, error)
    assert chi2.cdf(total, 4 * count) == pytest.approx(0.5, abs=0.499995)


def test_errors():
    t = np.linspace(-40.0, 60.0, 8)
    r = truth.SOURCE.resistance(t)
    with pytest.raises(CampaignError, match="rows 2, 3 are not"):
        BROKEN.temperature(np.array([1e3, 0.0, -5.0]))
    with pytest.raises(CampaignError, match="rows 1 are not"):
        fit_thermistor(np.append(0.0, r[1:]), t)
    with pytest.raises(EstimateError, match="bath: a segment needs 5 points or more"):
        fit_thermistor(r, t, joint=30.0, name="bath")
    with pytest.raises(EstimateError, match="continuity at the joint is 0, 1, 2 or 3, and needs a joint"):
        fit_thermistor(r, t, continuity=1)
    with pytest.raises(EstimateError, match="needs 5 points or more for its own terms and their scatter"):
        fit_thermistor(r[:4], t[:4])
    with pytest.raises(EstimateError, match="a resistance or temperature is missing"):
        fit_thermistor(np.append(np.nan, r[1:]), t)
    assert np.isnan(BROKEN.temperature(np.array([np.nan, 1e4]))).tolist() == [True, False]
