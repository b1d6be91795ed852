"""What a campaign cannot tell beside what it can: doubts stay in the verdict, with the test that settles them."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.stats import binom

import gyromodel as gm
from gyromodel.effects.scale import ScaleFactor
from gyromodel.report import sentence
from gyromodel.report._tables import searched_rows

ROWS, STEP = 600, 40.0
SUPPLY, SHUPE = 1.5, 60.0  # deg/h per V, deg/h per degC/s


def chamber(rng: np.random.Generator) -> gm.Campaign:
    """Two ramps of different speed and a supply that is stepped; both make a bias, in white noise."""
    time = STEP * np.arange(ROWS)
    temperature = np.interp(time, [0, 3000, 8000, 10_000, 12_000, 20_000, 24_000], [20, 20, 50, 50, 20, 20, 45])
    supply = 5.0 + 0.2 * np.repeat(rng.standard_normal(ROWS // 30), 30)
    output = 3.0 + SUPPLY * (supply - 5.0) + SHUPE * np.gradient(temperature, time)
    output += 0.5 * (temperature - 25.0) + 0.1 * rng.standard_normal(ROWS)
    columns = {"time": time, "temperature": temperature, "supply_voltage": supply, "output": output}
    units = {"time": "s", "temperature": "degC", "supply_voltage": "V", "output": "deg/h"}
    return gm.Campaign(columns, units, {"kind": "rate"})


@pytest.mark.law
def test_a_doubt_beside_a_firm_cause_stays_one_of_the_verdict(rng: np.random.Generator):
    """A bias that follows the temperature's rate is one of a late thermometer; one of the supply voltage is neither."""
    model = gm.model_from_effects(["bias", "bias_temperature"])
    right = 0
    for _ in range(4):
        found = gm.diagnose(chamber(rng), model, hold_out=False)
        causes = [cause.effect for cause in found.causes]
        right += (
            found.verdict == "ambiguous"
            and set(found.credible_set) == {"bias_temperature_rate", "temperature_lag"}
            and set(causes[:2]) == set(found.credible_set)
            and causes[2:] == ["bias_supply_voltage"]
        )
        told = {row["id"]: row["found"] for row in searched_rows(found)}
        assert [told.get(name, "") for name in found.credible_set] == ["possible"] * len(found.credible_set)
        assert "second thermometer at the coil" in (found.next_test or "")
        assert "lacks a bias proportional to supply voltage of (1." in sentence(found)
    assert binom.cdf(right, 4, 0.97) > 1e-4


def grid(rng: np.random.Generator, null: float) -> gm.Campaign:
    """Rates of both signs at each of seven temperatures, of a gyro whose output at rest is that of some deg/s."""
    temperature = np.repeat([20.0, -20.0, 40.0, 0.0, 60.0, 10.0, 50.0], 30)
    rate = np.tile(np.repeat([-100.0, -50.0, -20.0, 0.0, 20.0, 50.0], 5), 7)
    error = 12.0 / 3600.0 * (temperature - 20.0)
    output = (rate + null + error) * (1.0 + 2e-5 * (temperature - 20.0)) + 0.03 * rng.standard_normal(len(rate))
    columns = {"time": 20.0 * np.arange(len(rate)), "rate": rate, "temperature": temperature, "output": output}
    units = {"time": "s", "rate": "deg/s", "temperature": "degC", "output": "deg/s"}
    return gm.Campaign(columns, units, {"kind": "rate"})


@pytest.mark.parametrize("null", [0.0, 250.0])
def test_a_curve_of_the_scale_factor_holds_nothing_of_a_temperature_bias(null: float, rng: np.random.Generator):
    """Beside a simulated scale factor over temperature: its column is that of rate and bias, and so are the curve's."""
    model = gm.model_from_effects(["scale_factor", "bias", "scale_temperature"])
    for _ in range(2):
        found = gm.diagnose(grid(rng, null), model, hold_out=False)
        assert "bias_temperature" in [cause.effect for cause in found.causes]
        assert not any(cause.effect.startswith("scale") for cause in found.causes)
        first = {candidate.effect: candidate.statistic for candidate in found.rounds[0].ranking}
        assert first["bias_temperature"] > first.get("scale_temperature_curve", 0.0) + 5.0


@pytest.mark.law
def test_what_a_walk_may_be_instead_is_told(rng: np.random.Generator):
    """A straight line over one ramp of temperature, ten standard deviations, in white noise and flicker."""
    time = 30.0 * np.arange(360)
    told = 0
    for _ in range(6):
        white = 0.05 * rng.standard_normal(len(time))
        flicker = sum(
            0.008 * lfilter([1.0], [1.0, -(1.0 - 1.0 / tau)], rng.standard_normal(len(time)) / np.sqrt(tau / 2.0))
            for tau in (3.0, 10.0, 30.0, 100.0)
        )
        output = 1.0 + 0.065 * time / 3600.0 + white + flicker
        columns = {"time": time, "temperature": 20.0 + time / 360.0, "output": output}
        campaign = gm.Campaign(columns, {"time": "s", "temperature": "degC", "output": "deg/h"}, {"kind": "rate"})
        found = gm.diagnose(campaign, gm.model_from_effects(["bias"]), hold_out=False)
        assert found.verdict in ("adequate", "ambiguous")
        walk = [line for line in found.findings if line.startswith("What was taken for a random walk of the bias may")]
        told += found.verdict == "ambiguous" or any("bias_temperature" in line or "bias_drift" in line for line in walk)
    assert binom.cdf(told, 6, 0.9) > 1e-4


def test_what_would_show_of_a_scale_factor_is_a_part_of_it(rng: np.random.Generator):
    """Of a fixed one in counts: some standard errors by least squares, and not of its value in counts."""
    rate = np.repeat([-20.0, -10.0, 0.0, 10.0, 20.0, 5.0, -5.0], 20)
    columns = {"time": 5.0 * np.arange(140), "rate": rate, "output": 1000.0 * rate + rng.standard_normal(140)}
    campaign = gm.Campaign(columns, {"time": "s", "rate": "deg/s", "output": "count/s"}, {"kind": "rate"})
    effects = (*gm.model_from_effects(["bias"]).effects, ScaleFactor(value=np.rad2deg(1000.0), unit="count/deg"))
    model = gm.GyroModel(effects, fixed=frozenset({("scale_factor", "value")}))
    size, unit = gm.diagnose(campaign, model, hold_out=False).minimum_detectable["scale_factor"]
    least = 1e6 / (1000.0 * np.sqrt(np.sum((rate - rate.mean()) ** 2)))
    assert unit == "ppm"
    assert 3.0 < size / least < 8.0
