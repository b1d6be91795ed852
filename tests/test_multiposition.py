"""Rate-table and six-position closed forms: oracles are the geometry of the simulator in `tests/truth`, numpy's least
squares, and Monte Carlo."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import binom

from gyromodel.multiposition import (
    EARTH_RATE,
    StaticModel,
    rate_table,
    scale_factor_from_rates,
    six_position,
    six_position_interval,
    six_positions,
)
from gyromodel.numerics.ratio import fieller_interval
from gyromodel.numerics.uncertain import Uncertain
from gyromodel.units import factor
from tests.truth import rate_integrating as truth

LATITUDE = truth.SOURCE.latitude
HOUR = factor("deg/h", "rad/s")
MODEL = StaticModel(*(jnp.asarray(v) for v in (9.29 * HOUR / 1e-3, 0.9 * HOUR, 1.5 * HOUR, -2.0 * HOUR)))
# Standard deviation of a current with which the drifts scatter as in the source's table, A.
NOISE = 0.015e-3
QUIET = truth.replace(truth.SOURCE, rate_noise=0.0, position_noise=0.0)


def test_the_six_positions_are_those_of_the_source():
    along, up = EARTH_RATE * np.cos(LATITUDE), EARTH_RATE * np.sin(LATITUDE)
    conditions = six_positions(LATITUDE)
    # Input axis south, north, up, level, down, level: in the north an axis that points up sees a positive Earth rate.
    assert np.asarray(conditions.rate) == pytest.approx([-along, along, up, 0, -up, 0], abs=1e-20)
    assert conditions.acceleration_input.tolist() == [0, 0, -1, 0, 1, 0]
    assert conditions.acceleration_spin.tolist() == [0, 0, 0, -1, 0, 1]


@pytest.mark.parametrize("latitude", [-1.2, 0.0, 0.3, LATITUDE, 1.4])
def test_the_closed_forms_invert_equation_1(latitude: float):
    found = six_position(MODEL.current(six_positions(latitude)), latitude)
    assert np.array(jax.tree.leaves(found)) == pytest.approx(np.array(jax.tree.leaves(MODEL)), rel=1e-12)


def test_the_closed_forms_find_the_gyro_of_the_simulator(rng: np.random.Generator):
    """Its currents come from axes turned in north, east and up, at every soak at once."""
    found = truth.simulate(QUIET, rng)
    values = jax.tree.leaves(six_position(found.position_currents / 1e3, LATITUDE))
    expected = [(a + b * found.soak_temperature) * HOUR for a, b in truth.unit_lines(QUIET)]
    expected[0] = expected[0] * 1e3
    assert np.stack(values) == pytest.approx(np.stack(expected), rel=1e-6)
    table = found.table_currents / 1e3
    at_rest = np.full(len(table), float(MODEL.current(rate_table(np.zeros(1), LATITUDE))[0]))
    rates = jnp.array([truth.TABLE_RATE * HOUR])
    scale = scale_factor_from_rates(rates, jnp.asarray(table[:, :1]), jnp.asarray(table[:, 1:]), jnp.asarray(at_rest))
    assert np.asarray(scale)[:, 0] == pytest.approx(expected[0], rel=1e-9)


def test_scale_factor_from_rates_is_blind_to_the_current_at_rest():
    """Equations (3) and (4) with numbers, and with an error δ of I₀, which changes the mean by SF (δ SF/ω)²."""
    assert scale_factor_from_rates(
        jnp.array([10.0, 20.0]), jnp.array([6.0, 11.0]), jnp.array([-3.0, -7.0]), jnp.asarray(1.0)
    ).tolist() == [2.25, 2.25]
    rates = jnp.array([0.1, 0.5])
    forward, backward = rates / 2.0 + 0.01, -rates / 2.0 + 0.01
    wrong = np.asarray(scale_factor_from_rates(rates, forward, backward, jnp.asarray(0.012)))
    assert wrong / 2.0 - 1 == pytest.approx((0.002 * 2.0 / np.asarray(rates)) ** 2, rel=1e-2)


def test_the_covariance_of_all_four_is_that_of_monte_carlo(rng: np.random.Generator):
    exact = np.asarray(MODEL.current(six_positions(LATITUDE)))
    noise = NOISE / 10
    found = Uncertain.stated(jnp.asarray(exact), noise**2, "currents").propagate(
        partial(six_position, latitude=LATITUDE)
    )
    draws = 20_000
    values = six_position(exact + noise * rng.standard_normal((draws, 6)), LATITUDE)
    sample = np.cov(np.stack(jax.tree.leaves(values)))
    size = np.sqrt(np.outer(np.diag(found.covariance), np.diag(found.covariance)))
    # An element of a sample covariance has a relative standard deviation of √(2/n) at most; the forms curve by 1e-3.
    assert sample / size == pytest.approx(found.covariance / size, abs=5 * np.sqrt(2 / draws) + 2e-3)
    correlation = found.covariance / size
    assert abs(correlation[0, 2]) > 0.2, "all four share the scale factor"


def test_least_squares_of_all_six_uses_what_the_closed_forms_leave(rng: np.random.Generator):
    """Df is in six currents and (6) takes two: variance 1/3, the scale factor being known."""
    design = np.stack([np.ones(6), *(np.asarray(c) for c in six_positions(LATITUDE)[:2])], axis=1)
    best = np.linalg.inv(design.T @ design)[0, 0]
    currents = StaticModel(*(jnp.asarray(x) for x in (2.0, 0.3, 0.1, -0.2))).current(six_positions(LATITUDE))

    def drift(i):
        """Equation (6) in currents."""
        found = six_position(i, LATITUDE)
        return found.fixed_drift / found.scale_factor

    known = Uncertain.stated(currents, 1.0, "currents").propagate(drift)
    assert best / known.covariance[0, 0] == pytest.approx(1 / 3)


def test_exact_intervals_agree_with_first_order_ones_where_noise_is_small():
    """In standard uncertainties they differ by t² times the relative noise of I2 − I1, 0.9 % at the source's noise."""
    exact = np.asarray(MODEL.current(six_positions(LATITUDE)))
    for noise, close in ((NOISE, 0.06), (NOISE / 100, 6e-4)):
        first = Uncertain.stated(jnp.asarray(exact), noise**2, "currents").propagate(
            partial(six_position, latitude=LATITUDE)
        )
        ends = six_position_interval(exact, noise**2 * np.eye(6), LATITUDE)
        for side, expected in zip(ends, first.interval(), strict=True):
            off = (np.array(jax.tree.leaves(side)) - expected) / first.std
            assert np.abs(off).max() < close
            assert np.abs(off).max() > close / 100


def coverage(noise: float, draws: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Of exact and of first-order intervals, for the four results."""
    conditions = six_positions(LATITUDE)
    exact, value = np.asarray(MODEL.current(conditions)), np.array(jax.tree.leaves(MODEL))
    inside, first = np.zeros(4), np.zeros(4)
    derivative = jax.jit(jax.jacfwd(lambda i: jnp.stack(jax.tree.leaves(six_position(i, LATITUDE)))))
    for _ in range(draws):
        measured = exact + noise * rng.standard_normal(6)
        low, high = (
            np.array(jax.tree.leaves(e)) for e in six_position_interval(measured, noise**2 * np.eye(6), LATITUDE)
        )
        inside += (low <= value) & (value <= high)
        found = np.array(jax.tree.leaves(six_position(measured, LATITUDE)))
        half = 1.96 * noise * np.linalg.norm(np.asarray(derivative(jnp.asarray(measured))), axis=1)
        first += np.abs(found - value) <= half
    return inside, first


# A third of the Earth-rate current: I2 − I1 is four standard deviations from zero.
LOUD = 0.33 * EARTH_RATE * float(np.cos(LATITUDE)) / float(MODEL.scale_factor)


def test_exact_intervals_cover_at_any_noise(rng: np.random.Generator):
    draws = 300
    inside, _ = coverage(LOUD, draws, rng)
    low, high = binom.ppf([1e-5, 1 - 1e-5], draws, 0.95)
    assert ((inside >= low) & (inside <= high)).all(), inside / draws


def test_first_order_intervals_do_not():
    """One fixed set of draws: too short for the scale factor, too long for the fixed drift."""
    inside, first = coverage(LOUD, 200, np.random.default_rng(0))
    assert first[0] < inside[0]
    assert first[1] > inside[1]


def test_fieller_by_its_definition(rng: np.random.Generator):
    """At each end of the interval the difference a − ρ b is t standard deviations from zero."""
    for _ in range(20):
        factor_ = rng.standard_normal((2, 2))
        covariance = factor_ @ factor_.T
        numerator, denominator = rng.normal(0, 5), rng.normal(0, 5)
        low, high = fieller_interval(numerator, denominator, covariance, 0.9)
        if np.isinf(low):
            assert abs(denominator) <= 1.6449 * np.sqrt(covariance[1, 1])
            continue
        assert low <= numerator / denominator <= high
        for rho in (low, high):
            line = np.array([1.0, -rho])
            assert abs(numerator - rho * denominator) == pytest.approx(1.644854 * np.sqrt(line @ covariance @ line))


def test_fieller_covers_with_few_degrees_of_freedom(rng: np.random.Generator):
    """Variances from four repeats of each."""
    draws, inside = 1000, 0
    for _ in range(draws):
        a, b = 3.0 + rng.standard_normal(4), 2.0 + rng.standard_normal(4)
        pooled = (a.var(ddof=1) + b.var(ddof=1)) / 2 / 4
        low, high = fieller_interval(a.mean(), b.mean(), pooled * np.eye(2), 0.95, 6.0)
        inside += low <= 1.5 <= high
    low, high = binom.ppf([2e-5, 1 - 2e-5], draws, 0.95)
    assert low <= inside <= high


def test_latitudes_that_no_position_works_at_are_refused():
    for latitude in (np.pi / 2, 45.75):
        with pytest.raises(ValueError, match="give radians within ±π/2"):
            six_positions(latitude)
