"""Temperature models of scale factor and drifts: oracles are scipy's regression, hand-made tables, and known truths."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import binom, linregress

from gyromodel.estimate import EstimateError
from gyromodel.numerics.uncertain import Uncertain
from gyromodel.temperature_models import fit_temperature_model

SOAKS = np.arange(-40.0, 61.0, 10.0)
BREAK = 12.0


def bent(rng: np.random.Generator) -> dict[str, np.ndarray]:
    """A scale factor that bends at 12 °C and a drift that does not, deg/h/mA and deg/h."""
    bend = -0.0004 * np.maximum(SOAKS - BREAK, 0)
    return {
        "SF": 9.29 - 0.0002 * SOAKS + bend + 0.001 * rng.standard_normal(11),
        "Df": 0.9 + 0.01 * SOAKS + 0.02 * rng.standard_normal(11),
    }


def test_one_line_is_that_of_linear_regression(rng: np.random.Generator):
    data = bent(rng)
    for row, y in zip(fit_temperature_model(data, SOAKS).table(), data.values(), strict=True):
        expected = linregress(SOAKS, y)
        assert (row.at_zero, row.slope) == pytest.approx((expected.intercept, expected.slope), rel=1e-8)
        assert (row.at_zero_std, row.slope_std) == pytest.approx((expected.intercept_stderr, expected.stderr), rel=1e-6)
        scatter = np.sqrt(np.sum((y - expected.intercept - expected.slope * SOAKS) ** 2) / 9)
        assert (row.scatter, row.relative) == pytest.approx((scatter, scatter / expected.intercept), rel=1e-6)


def test_two_segments_are_two_regressions(rng: np.random.Generator):
    data = bent(rng)
    model = fit_temperature_model(data, SOAKS, "split")
    rows = iter(model.table())
    for y in data.values():
        for part in (SOAKS < 0, SOAKS >= 0):
            row, expected = next(rows), linregress(SOAKS[part], y[part])
            assert (row.at_zero, row.slope) == pytest.approx((expected.intercept, expected.slope), rel=1e-7)
            assert (row.at_zero_std, row.slope_std) == pytest.approx(
                (expected.intercept_stderr, expected.stderr), rel=1e-5
            )
    ends = np.asarray(model.predict(jnp.array([-1e-9, 0.0])).value)
    assert (np.abs(ends[:, 0] - ends[:, 1]) > 1e-7).all(), "two independent lines part at the joint"


def test_a_hinge_is_continuous_and_finds_the_bend():
    data = {"SF": bent(np.random.default_rng(6))["SF"]}
    model = fit_temperature_model(data, SOAKS, "hinge")
    low, high = model.breakpoint_interval[0, 0]
    assert low < BREAK < high
    assert float(model.fit.value[2][0, 0]) == pytest.approx(BREAK, abs=8)
    near = np.asarray(model.predict(jnp.array([low, low + 1e-6, high])).value)[0]
    assert near[0] == pytest.approx(near[1], abs=1e-8)
    text = str(model)
    assert "SF              slope changes by -0.000" in text
    assert f"(95 %: {low:.1f} to {high:.1f})" in text
    line = fit_temperature_model(data, SOAKS)
    assert model.fit.scatter[0] < 0.5 * line.fit.scatter[0]


@pytest.mark.long
def test_intervals_of_breakpoints_cover(rng: np.random.Generator):
    count, inside, widths = 100, 0, []
    for _ in range(count):
        low, high = fit_temperature_model({"SF": bent(rng)["SF"]}, SOAKS, "hinge").breakpoint_interval[0, 0]
        inside += low <= BREAK <= high
        widths.append(high - low)
    # The likelihood ratio is chi-squared only for many soaks: 90 % is asked for.
    assert inside >= binom.ppf(1e-5, count, 0.90)
    assert np.median(widths) < 30.0


def test_a_sharp_bend_has_a_narrow_interval_that_covers(rng: np.random.Generator):
    """Narrower than the soaks are apart by hundreds: an interval must not end with the grid that finds it."""
    count, inside, widths = 40, 0, []
    for _ in range(count):
        y = 1.0 + 0.01 * SOAKS - 0.02 * np.maximum(SOAKS - 3.7, 0.0) + 1e-3 * rng.standard_normal(11)
        model = fit_temperature_model({"SF": y}, SOAKS, "hinge")
        low, high = model.breakpoint_interval[0, 0]
        assert low < float(model.fit.value[2][0, 0]) < high
        inside += low <= 3.7 <= high
        widths.append(high - low)
    assert inside >= binom.ppf(1e-5, count, 0.90)
    assert np.median(widths) < 1.0


def test_a_soak_at_the_split_keeps_its_side(rng: np.random.Generator):
    """Its temperature is uncertain by more than its distance from the split, and the two lines part there by far."""
    t = SOAKS + np.where(SOAKS == 0, 1e-4, 0.0)
    y = np.where(t < 0, 1.0 + 0.01 * t, 2.0 - 0.05 * t) + 1e-3 * rng.standard_normal(11)
    temperature = Uncertain.stated(jnp.asarray(t), 0.01**2, "thermometer")
    rows = fit_temperature_model({"Df": y}, temperature, "split").table()
    assert [row.at_zero for row in rows] == pytest.approx([1.0, 2.0], abs=0.01)
    assert [row.slope for row in rows] == pytest.approx([0.01, -0.05], abs=5e-4)


def test_two_hinges_are_found():
    t = np.linspace(-40.0, 60.0, 41)
    y = 1 + 0.02 * np.maximum(t + 15, 0) - 0.05 * np.maximum(t - 30, 0)
    model = fit_temperature_model({"Df": y + 1e-3 * np.random.default_rng(0).standard_normal(41)}, t, "hinge", hinges=2)
    assert np.asarray(model.fit.value[2])[0] == pytest.approx([-15, 30], abs=0.5)
    assert np.asarray(model.fit.value[1])[0] == pytest.approx([0.02, -0.05], rel=0.03)


def test_one_error_of_the_thermometer_enters_all_quantities(rng: np.random.Generator):
    """A common offset of all temperatures moves each line by its slope times the offset: correlation −1."""
    offset = 0.5
    temperature = Uncertain.stated(jnp.asarray(0.0), offset**2, "thermometer").propagate(
        lambda e: jnp.asarray(SOAKS) + e
    )
    data = {"SF": 9.29 - 0.02 * SOAKS, "Df": 0.9 + 0.05 * SOAKS}
    data = {k: v + 1e-4 * rng.standard_normal(11) for k, v in data.items()}
    model = fit_temperature_model(data, temperature)
    found = model.fit.parameters
    lines = np.asarray(found.value[0])[:, 0]
    error = found.sources[next(s for s in found.sources if s.name == "thermometer")][:, 0]
    assert error == pytest.approx([-lines[0, 1] * offset, 0, -lines[1, 1] * offset, 0], abs=1e-6)
    assert found.covariance[0, 2] / (found.std[0] * found.std[2]) == pytest.approx(-1, abs=1e-3)
    # The slope knows nothing of it.
    assert found.propagate(lambda v: v[0][1, 0, 1]).budget()["thermometer"] == pytest.approx([0], abs=1e-9)


def test_too_few_soaks_are_refused():
    few = np.array([-10.0, -5.0, 5.0, 10.0, 20.0])
    with pytest.raises(EstimateError, match="soaks: split needs 3 soaks or more in each segment"):
        fit_temperature_model({"SF": few}, few, "split")
    with pytest.raises(EstimateError, match="split needs 3 soaks or more in each segment"):
        fit_temperature_model({"SF": few}, few, "split", split=80.0)
    with pytest.raises(EstimateError, match="soaks: hinge needs 7 soaks"):
        fit_temperature_model({"SF": few}, few, "hinge", hinges=2)
