"""Curves over temperature, and thermometers whose calibration errs: campaigns computed here, answers compared."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import gyromodel as gm
from gyromodel.campaign import Campaign
from tests.truth import study

# Standard uncertainties that no draw of a hundred thousand exceeds.
FAR = 5.0


def cycle(rows: int) -> np.ndarray:
    """Down to −30 °C, up to 60 °C and back."""
    return np.interp(np.linspace(0, 3, rows), [0, 0.75, 2.25, 3], [20.0, -30.0, 60.0, 20.0])


def at_rest(temperature: np.ndarray, output: np.ndarray, **columns: np.ndarray) -> Campaign:
    data = {"time": 60.0 * np.arange(len(output)), "temperature": temperature, "output": output, **columns}
    units = {"time": "s", "temperature": "degC", "output": "deg/h", "thermistor_resistance": "kohm"}
    return Campaign(data, {name: units[name] for name in data}, {"kind": "rate"})


@pytest.mark.long
def test_one_hinge_is_found_as_one_with_an_interval_of_its_place(rng: np.random.Generator):
    """Between the places that are searched, where two hinges around it would explain more than one of those."""
    temperature, place = cycle(600), rng.uniform(-10.0, 40.0)
    output = 0.02 * temperature + 0.05 * np.maximum(temperature - place, 0.0) + 0.02 * rng.standard_normal(600)
    found = gm.diagnose(
        at_rest(temperature, output), gm.model_from_effects(["bias", "bias_temperature"]), hold_out=False
    )
    assert (found.verdict, [c.effect for c in found.causes]) == ("named", ["bias_temperature_curve"])
    sizes = {p.name: (p.value, p.std) for p in found.causes[0].parameters}
    assert set(sizes) == {"coefficients", "hinges", "breakpoints"}
    for name, truth in (("hinges", 0.05), ("breakpoints", place)):
        value, std = sizes[name]
        assert std > 0.0
        assert value == pytest.approx(truth, abs=FAR * std)
    assert sizes["breakpoints"][1] < 1.0


@pytest.mark.long
def test_shapes_that_stay_as_searched_are_told_of(rng: np.random.Generator):
    """A jump between two soaks, gone through to and fro: where in between, nothing tells."""
    soaks = [-30.0, 30.0, -10.0, 50.0, 10.0, -30.0, 10.0, -10.0, 30.0, 50.0]
    temperature = np.repeat(soaks, 30) + 0.01 * rng.uniform(-1, 1, 300)
    output = 0.5 * (temperature > 0) + 0.01 * rng.standard_normal(300)
    found = gm.diagnose(
        at_rest(temperature, output), gm.model_from_effects(["bias", "bias_temperature"]), hold_out=False
    )
    assert ("bias_temperature_curve", "breakpoints") in found.extended.model.fixed
    assert any("stayed where the search had put them" in line for line in found.findings)


def thermistor(kelvin: np.ndarray, beta: float) -> np.ndarray:
    return 10.0 * np.exp(beta * (1.0 / kelvin - 1.0 / 298.15))


@pytest.mark.parametrize("independent", [pytest.param(False, marks=pytest.mark.long), True])
def test_a_curve_may_be_that_of_the_thermistor_its_temperature_is_computed_from(
    independent: bool, rng: np.random.Generator
):
    """A line over temperature, β of 3800 K for 3950 K; or a curve as large, over another thermometer."""
    true = cycle(600) + 273.15
    resistance = thermistor(true, 3950.0)
    told = 1.0 / (1.0 / 298.15 + np.log(resistance / 10.0) / 3800.0)
    output = 0.1 * (true - 293.15) + 0.01 * rng.standard_normal(600)
    if independent:
        resistance = resistance * np.exp(1e-3 * rng.standard_normal(600))
    campaign = at_rest(told - 273.15, output, thermistor_resistance=resistance)
    found = gm.diagnose(campaign, gm.model_from_effects(["bias", "bias_temperature"]), hold_out=False)
    if independent:
        assert set(found.credible_set) == {"bias_temperature_curve"}
        return
    assert found.verdict == "ambiguous"
    # By chance a line at the chamber's own pace explains as much.
    either = {"bias_temperature_curve", "thermometer_error"}
    assert either <= set(found.credible_set) <= either | {"bias_periodic"}
    assert "independent thermometer" in found.next_test
    if found.causes[0].effect == "thermometer_error":
        error = {p.name: p.value for p in found.causes[0].parameters}["error"]
        reference = float(found.extended.model.effects[-1].reference) + 273.15
        # Both laws agree at 25 °C, and the effect's at the reference.
        assert error == pytest.approx(reference**2 * (1 / 3800 - 1 / 3950), rel=0.2)


@pytest.mark.long
def test_the_same_ripple_in_bias_and_scale_factor_is_the_thermistor(rng: np.random.Generator):
    """So large an offset over temperature that the ripple shows in it as well as in the scale factor."""
    true = np.repeat(np.arange(-40.0, 61.0, 10.0), 40) + rng.uniform(-0.2, 0.2, 440) + 273.15
    rate = rng.permuted(np.tile([0.0, 30.0, -30.0, 100.0], (11, 10)), axis=1).ravel()
    resistance = thermistor(true, 3950.0)
    told = 1.0 / (1.0 / 298.15 + np.log(resistance / 10.0) / 3800.0)
    output = rate * (1 + 40e-6 * (true - 293.15)) + 1e-3 * (true - 293.15) + 2e-4 * rng.standard_normal(440)
    columns = {"rate": rate, "temperature": told - 273.15, "thermistor_resistance": resistance, "output": output}
    units = {"rate": "deg/s", "temperature": "degC", "thermistor_resistance": "kohm", "output": "deg/s", "time": "s"}
    campaign = Campaign({"time": 10.0 * np.arange(440), **columns}, units, {"kind": "rate"})
    model = gm.model_from_effects(["scale_factor", "bias", "bias_temperature", "scale_temperature"])
    found = gm.diagnose(campaign, model, hold_out=False)
    assert (found.verdict, [c.effect for c in found.causes]) == ("named", ["thermometer_error"])


@pytest.mark.long
def test_the_rate_of_a_place_that_lags_by_one_time_constant_is_the_difference_of_both(rng: np.random.Generator):
    """A Shupe effect of the coil, 400 s behind the case: dT/dt of the coil is the difference over 400 s."""
    case, coil = cycle(300), np.full(300, 20.0)
    for i in range(1, 300):
        kept = np.exp(-60.0 / 400.0)
        slope = (case[i] - case[i - 1]) / 60.0
        # Exact where the case goes straight from sample to sample.
        coil[i] = case[i] - 400.0 * slope + kept * (coil[i - 1] - case[i - 1] + 400.0 * slope)
    output = 0.02 * (case - 20) + 20.0 * (case - coil) / 400.0 + 0.02 * rng.standard_normal(300)
    data = {"time": 60.0 * np.arange(300), "temperature": case, "temperature_coil": coil, "output": output}
    units = {"time": "s", "temperature": "degC", "temperature_coil": "degC", "output": "deg/h"}
    campaign = Campaign(data, units, {"kind": "rate"})
    found = gm.diagnose(campaign, gm.model_from_effects(["bias", "bias_temperature"]), hold_out=False)
    assert found.verdict == "ambiguous"
    assert {"bias_temperature_rate", "bias_temperature_gradient"} <= set(found.credible_set)
    rate = gm.model_from_effects(["bias", "bias_temperature", "bias_temperature_rate"])
    place = {"thermometer": "temperature_coil"}
    rate = replace(rate, effects=(*rate.effects[:2], replace(rate.effects[2], **place)))
    estimate = gm.fit(campaign, rate)
    row = next(r for r in estimate.table() if r.effect == "bias_temperature_rate")
    assert row.value == pytest.approx(20.0, abs=FAR * row.std + 0.1)


@pytest.mark.long
def test_a_curve_that_was_found_in_slow_noise_can_be_fitted_anew():
    """From its own values; taken for white, the noise pulls a hinge beyond all temperatures."""
    case = study.Case(1322578408155778, "static_cycle", "flicker_and_walk", "bias_temperature_curve", 3.0)
    built = study.build(case)
    measured = gm.Campaign(built.columns, built.units, built.metadata)
    found = gm.diagnose(measured, gm.model_from_effects(["bias"]), hold_out=False).extended
    again = gm.fit(measured, found.model_as_given())
    assert np.asarray(again.model.vector()) == pytest.approx(np.asarray(found.model.vector()), rel=0.05)
