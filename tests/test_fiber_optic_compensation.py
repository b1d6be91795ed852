"""The published compensation of a fiber-optic gyro. Expected: the printed coefficients and what they imply (worked in
rational numbers here), scipy's filter and numpy's line fits."""

from __future__ import annotations

from fractions import Fraction

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.signal import cont2discrete, lfilter

from gyromodel.fiber_optic_compensation import (
    AVERAGING,
    BREAKPOINTS,
    DENOMINATOR,
    NUMERATOR,
    POLE,
    PRINTED_SCALE_FACTOR,
    TIME_CONSTANT,
    block_means,
    fit_three_lines,
    low_pass,
    printed_lines,
    published_chain,
)


def test_the_printed_lines_jump_where_they_meet():
    """In units of 0.01 bit: 33.86 T − 732.29, 10.45 T − 200.33 and 40.82 T − 1149.2."""
    low, middle, high = ((Fraction(k), Fraction(r)) for k, r in (
        ("33.86", "-732.29"), ("10.45", "-200.33"), ("40.82", "-1149.2"),
    ))  # fmt: skip
    at = Fraction("23.6"), Fraction(30)
    jumps = [
        float(middle[0] * at[0] + middle[1] - low[0] * at[0] - low[1]) / 100,
        float(high[0] * at[1] + high[1] - middle[0] * at[1] - middle[1]) / 100,
    ]
    crossings = [
        float((low[1] - middle[1]) / (middle[0] - low[0])),
        float((middle[1] - high[1]) / (high[0] - middle[0])),
    ]
    lines = printed_lines()
    assert np.asarray(lines.jumps) == pytest.approx(jumps, rel=1e-12)
    assert np.asarray(lines.crossings) == pytest.approx(crossings, rel=1e-12)
    assert np.abs(lines.jumps) == pytest.approx([0.205, 0.378], abs=5e-4)
    assert np.asarray(lines.crossings) == pytest.approx([22.7, 31.2], abs=0.05)
    edge = jnp.asarray([23.6, np.nextafter(23.6, 99), np.nextafter(30, 0), 30.0])
    value = np.asarray(lines(edge))
    assert [value[1] - value[0], value[3] - value[2]] == pytest.approx(jumps, rel=1e-9)
    # The larger jump alone is most of the printed residual of 5.87 deg/h peak to peak.
    assert abs(jumps[1]) / PRINTED_SCALE_FACTOR == pytest.approx(4.1, abs=0.1)


def test_the_filter_is_scipy_s_and_a_first_order_lag(rng: np.random.Generator):
    values = 3.0 + rng.standard_normal(200)
    b, a = np.array([NUMERATOR, NUMERATOR]) / DENOMINATOR, np.array([1.0, -POLE / DENOMINATOR])
    assert b.sum() / a.sum() == pytest.approx(1.0)
    bilinear = cont2discrete(([1.0], [TIME_CONSTANT, 1.0]), AVERAGING, "bilinear")
    assert np.squeeze(bilinear[0]) == pytest.approx(b)
    assert bilinear[1] == pytest.approx(a)
    steady = (b[1] - a[1] * 1.0) * values[0]  # the filter's state had the first value stood for ever
    assert np.asarray(low_pass(jnp.asarray(values))) == pytest.approx(lfilter(b, a, values, zi=[steady])[0], rel=1e-12)


def test_lines_are_numpy_s(rng: np.random.Generator):
    temperature = rng.uniform(14, 42, 300)
    output = rng.standard_normal(300) + 0.3 * temperature
    lines = fit_three_lines(jnp.asarray(temperature), jnp.asarray(output), jnp.asarray(BREAKPOINTS))
    inside = [temperature <= 23.6, (temperature > 23.6) & (temperature < 30), temperature >= 30]
    expected = np.array([np.polyfit(temperature[i], output[i], 1) for i in inside])
    assert np.asarray(lines.slopes) == pytest.approx(expected[:, 0], rel=1e-9)
    assert np.asarray(lines.intercepts) == pytest.approx(expected[:, 1], rel=1e-9)


def test_the_chain_averages_filters_and_takes_the_start_off(rng: np.random.Generator):
    output, temperature = rng.standard_normal(1003), np.linspace(14, 42, 1003)
    means = output[:1000].reshape(200, 5).mean(axis=1)
    assert np.asarray(block_means(jnp.asarray(output), 5)) == pytest.approx(means)
    chain = published_chain(jnp.asarray(output), jnp.asarray(temperature))
    filtered = np.asarray(low_pass(jnp.asarray(means)))
    assert np.asarray(chain.output) == pytest.approx(filtered - filtered[:12].mean(), abs=1e-12)
    # On a ramp the filtered thermometer lags by the time constant.
    slope = (42 - 14) / 1002
    assert np.asarray(chain.temperature)[-1] == pytest.approx(temperature[995:1000].mean() - TIME_CONSTANT * slope)
