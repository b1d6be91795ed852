"""Effects hidden at ten times their detectable size, alone and by threes, that no other test hides; and that each is.

A single verdict is an example, of a fixed seed; the study counts how often they are right.
"""

from __future__ import annotations

import ast
from pathlib import Path

import numpy as np
import pytest

import gyromodel as gm
from gyromodel.declarations import declarations
from gyromodel.effects.drivers import BiasPeriodic
from tests.truth import study
from tests.truth.campaigns import HOMES, TESTABLE, UNCATALOGUED
from tests.truth.designs import DESIGNS
from tests.truth.memory import on_a_case, two_nodes

EXAMPLE = 1
TESTS = Path(__file__).parent
ALONE = (
    ("tumble", "bias_acceleration_input"),
    ("tumble", "bias_acceleration_spin"),
    ("tumble", "bias_acceleration_output"),
    ("dynamic_rates", "bias_vibration"),
    ("dynamic_rates", "bias_anisoinertia"),
    ("dynamic_rates", "output_axis_acceleration"),
    ("turntable", "table_harmonic"),
    ("turntable", "bias_magnetic"),
    ("rate_temperature", "scale_drift"),
)
PLATFORM = (
    "sync_delay", "loop_resonance", "shaft_friction", "gimbal_nonorthogonality", "encoder_harmonic", "platform_drift",
)  # fmt: skip
MOVED = ("bias_acceleration_squared", "table_tilt", "misalignment")
THREE = (
    ("static_cycle", "bias_supply_voltage+bias_pressure+bias_temperature_rate"),
    ("rate_temperature", "scale_temperature+bias_temperature+scale_asymmetry"),
    ("tumble", "bias_acceleration_input+bias_acceleration_spin+misalignment"),
)


# Where those are hidden that the study's draws do not hide.
HIDDEN_BY = {
    "bias_column": "test_honesty.py::test_what_others_make_needless_is_dropped",
    "bias_backscatter": "test_monitors.py::test_backscatter_slows_a_turning_ring_laser_in_proportion_to_its_monitor",
    "bias_null_shift": "test_monitors.py::test_unequal_beams_shift_the_null_in_proportion_to_their_difference",
    "torquer_scale": "test_monitors.py::test_a_torquer_that_errs_is_named",
    "lock_in": "test_ring_laser.py::test_diagnosis_names_lock_in_and_nothing_without_it",
    # It is fitted and not searched, as no column tells the dither.
    "lock_in_dithered": "test_ring_laser.py::test_fit_finds_the_lock_in_rate_behind_a_dither",
    "quantisation": "test_quantisation.py::test_coarse_steps_are_named_and_nothing_else",
    "saturation": "test_memory_effects.py::test_a_clipped_output_is_saturation",
    "temperature_lag": "test_memory_effects.py::test_a_late_thermometer_under_a_curved_bias_is_named_with_its_delay",
    "thermometer_error": "test_temperature_curves.py::test_the_same_ripple_in_bias_and_scale_factor_is_the_thermistor",
    "bias_temperature_gradient": "test_fiber_optic.py::test_a_hidden_gradient_is_named",
    "bias_temperature_gradient_rate": "test_thermometer_noise.py::test_large_errors_of_a_changing_coil_are_named",
    "scale_spline": "test_hidden_effects.py::test_a_wave_of_the_curve_over_rate_is_a_spline",
    "loop_dynamics": "test_platform_diagnosis.py::test_another_loop_is_named_where_the_friction_is_known",
}
HIDDEN_BY |= {effect: "test_hidden_effects.py::test_what_is_hidden_is_named_and_nothing_else" for _, effect in ALONE}
HIDDEN_BY |= dict.fromkeys(PLATFORM, "test_platform_diagnosis.py::test_each_effect_is_named_with_its_size")
HIDDEN_BY |= dict.fromkeys(MOVED, "test_motion_effects.py::test_hidden_effects_of_motion_are_named")
HIDDEN_BY |= dict.fromkeys(
    ("time_delay", "bandwidth"),
    "test_motion_effects.py::test_what_is_late_by_many_samples_is_found_beside_a_gain_of_the_wrong_sign",
)


def test_every_effect_of_the_catalogue_is_hidden_by_some_test():
    """In each run the study hides every effect of its homes; all others have a test of their own, which is there."""
    drawn = {e for design in HOMES for e in TESTABLE[design]}
    assert {case.effect for case in study.effect_cases(len(drawn), 0, 3.0)} == drawn
    # Linear drivers are one entry: bias_<column>.
    assert set(declarations()) - drawn == set(HIDDEN_BY) - drawn
    for effect, place in HIDDEN_BY.items():
        file, name = place.split("::")
        text = (TESTS / file).read_text(encoding="utf-8")
        functions = {node.name for node in ast.parse(text).body if isinstance(node, ast.FunctionDef)}
        assert name in functions, f"there is no {name} that hides {effect}"
        assert effect in text


def test_every_uncatalogued_shape_is_in_a_campaign():
    hidden = {c.effect for c in [*study.unknown_cases(8, 0, 3.0), *study.moving_unknown_cases(24, 0, 3.0)]}
    assert hidden == {e for names in UNCATALOGUED.values() for e in names}


@pytest.mark.long
@pytest.mark.parametrize(("design", "effect"), [*ALONE, *THREE])
def test_what_is_hidden_is_named_and_nothing_else(design: str, effect: str):
    answer = study.run_case(study.Case(EXAMPLE, design, "white", effect, 10.0)).answer
    assert answer is not None
    assert (answer.verdict, set(answer.causes)) == ("named", set(effect.split("+")))


@pytest.mark.long
@pytest.mark.parametrize(
    ("seed", "design", "noise", "effect", "times"),
    [
        (3006073748926428, "rate_steps", "white", "rate_hysteresis", 100.0),
        (2393908075183046, "rate_temperature", "random_walk", "scale_nonlinearity", 30.0),
    ],
)
def test_what_a_form_leaves_of_a_large_error_is_no_firm_name(
    seed: int, design: str, noise: str, effect: str, times: float
):
    """Of 460 and 150 standard deviations: anomalous dwells beside a relay, a sine of the rate beside a cubic."""
    record = study.run_case(study.Case(seed, design, noise, effect, times))
    assert record.answer is not None
    assert record.score is not None
    assert record.answer.verdict in ("named", "ambiguous")
    assert effect in record.answer.credible
    assert not record.score.firm_and_wrong


@pytest.mark.long
def test_a_wave_of_the_curve_over_rate_is_a_spline():
    """1.8 periods on a curve over 61 rates, each visited three times: no polynomial of the fifth order has them."""
    rng = np.random.default_rng(EXAMPLE)
    x = np.concatenate([rng.permutation(np.linspace(-1, 1, 61)) for _ in range(3)])
    output = 100 * x + 0.02 * np.sin(2 * np.pi * 0.9 * x + 0.5) + 0.01 * rng.standard_normal(len(x))
    columns = {"time": 10.0 * np.arange(len(x)), "rate": 100 * x, "output": output}
    campaign = gm.Campaign(columns, {"time": "s", "rate": "deg/s", "output": "deg/s"}, {"kind": "rate"})
    found = gm.diagnose(campaign, gm.model_from_effects(["scale_factor", "bias"]), hold_out=False)
    assert (found.verdict, [c.effect for c in found.causes]) == ("named", ["scale_spline"])


@pytest.mark.long
@pytest.mark.parametrize(
    ("seed", "noise"),
    [(3665187077640349, "random_walk"), (3500658684857208, "flicker_and_walk"), (2543575628860855, "flicker_and_walk")],
)
def test_a_spline_whose_knots_are_not_even_has_its_name(seed: int, noise: str):
    """Of ten times the detectable size; with even knots alone each of them was "unknown, follows rate"."""
    answer = study.run_case(study.Case(seed, "many_rates", noise, "scale_spline", 10.0)).answer
    assert answer is not None
    assert (answer.verdict, answer.causes) == ("named", ("scale_spline",))


def test_a_sensor_holds_its_case_back():
    """Heat is kept: in a closed box, case and sensor end at their common temperature; on a ramp the sensor lags."""
    time = np.arange(0.0, 6000.0, 2.0)
    case, sensor = two_nodes(time, 0.01 * time, (300.0, 200.0), 0.3)
    assert (case - sensor)[-1] == pytest.approx(2.0, rel=1e-3)
    # What the chamber leads by drives both.
    assert (0.01 * time - case)[-1] == pytest.approx(0.01 * 300 * 1.3, rel=1e-3)


@pytest.mark.long
@pytest.mark.parametrize("curved", [True, False])
def test_a_late_sensor_on_a_case_that_it_holds_back(curved: bool):
    rng = np.random.default_rng(EXAMPLE)
    design = on_a_case(DESIGNS["static_cycle"](rng), 220.0, rng)
    coil = design.true["coil"] - np.quantile(design.true["coil"], 0.25)
    output = (coil**2 / 20 if curved else coil) + rng.standard_normal(len(coil))
    campaign = gm.Campaign(design.columns | {"output": output}, design.units | {"output": "deg/h"}, design.metadata)
    known = "bias_temperature_curve" if curved else "bias_temperature"
    found = gm.diagnose(campaign, gm.model_from_effects(["bias", known]), hold_out=False)
    if curved:
        assert found.causes[0].effect == "temperature_lag"
        assert set(found.credible_set) <= {"temperature_lag", "bias_temperature_product"}
        delay = next(p for p in found.causes[0].parameters if p.name == "time_constant")
        assert delay.value == pytest.approx(220.0, abs=5 * delay.std)
    else:
        assert (found.verdict, set(found.credible_set)) == ("ambiguous", {"bias_temperature_rate", "temperature_lag"})


@pytest.mark.long
@pytest.mark.parametrize("kind", ["rate", "increment"])
def test_dither_beyond_half_the_sample_rate_is_found_at_its_alias(kind: str):
    """423.7 Hz, turned through in whole samples at 64 Hz: what is left of it oscillates at 7 × 64 − 423.7 Hz."""
    rng, dither, rate, size = np.random.default_rng(EXAMPLE), 423.7, 64.0, 400.0
    ends = np.arange(2001) / rate
    angle = size / (2 * np.pi * dither) * np.sin(2 * np.pi * dither * ends + 0.7)
    means = np.diff(angle) * rate + rng.standard_normal(2000)
    output, unit = (means, "deg/h") if kind == "rate" else (means / rate, "arcsec")
    campaign = gm.Campaign({"time": ends[1:], "output": output}, {"time": "s", "output": unit}, {"kind": kind})
    found = gm.diagnose(campaign, gm.model_from_effects(["bias"]), hold_out=False)
    assert (found.verdict, [c.effect for c in found.causes]) == ("named", ["bias_periodic"])
    line = found.extended.model.effects[-1]
    assert isinstance(line, BiasPeriodic)
    assert float(line.frequency[0]) == pytest.approx(24.3, abs=0.01)
    told = np.hypot(*(next(p.value for p in found.causes[0].parameters if p.name == n) for n in ("cosine", "sine")))
    assert told == pytest.approx(size * abs(np.sinc(dither / rate)), abs=0.2)
