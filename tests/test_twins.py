"""Effects that have one column on a campaign are never told apart, however large they are; and what a simulation holds
fixed is no other's: what is found beside it, is found beside it."""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

import gyromodel as gm
from gyromodel.diagnosis import isolability
from gyromodel.diagnosis._bank import build_bank
from gyromodel.diagnosis._causes import _size_of
from gyromodel.diagnosis._data import MOST_ROWS, MOST_VALUES, _most_rows
from gyromodel.diagnosis._isolation import _forms
from gyromodel.diagnosis._ranking import contained_in
from gyromodel.diagnosis._session import laid_out
from gyromodel.effects.drivers import BiasPeriodic, BiasStep
from gyromodel.effects.thermal import BiasTemperature, BiasTemperatureCurve
from gyromodel.model import GyroModel, make_effect
from gyromodel.signals import read_signals

ROWS, STEP = 400, 20.0
TIME = STEP * np.arange(ROWS)
TEMPERATURE = 20.0 + 30.0 * np.arange(ROWS) / ROWS + 3.0 * np.sin(np.arange(ROWS) / 20.0)
DEG_H = np.pi / 180 / 3600


def log(error: np.ndarray, rng: np.random.Generator, **columns: np.ndarray) -> gm.Campaign:
    """A log of an error (deg/h) in white noise of 1 deg/h."""
    units = {"time": "s", "output": "deg/h"} | {k: {"rate": "deg/s", "temperature": "degC"}[k] for k in columns}
    output = 3600.0 * columns.get("rate", np.zeros(ROWS)) + 3.0 + error + rng.standard_normal(ROWS)
    return gm.Campaign({"time": TIME, "output": output} | columns, units, {"kind": "rate"})


@pytest.mark.parametrize("size", [0.1, 1.0, 10.0])
def test_at_one_rate_a_bias_over_temperature_is_a_scale_factor_over_it(size: float, rng: np.random.Generator):
    """From 18 to 1800 standard deviations; at rest it is a bias."""
    held = {"rate": np.full(ROWS, 100.0), "temperature": TEMPERATURE}
    found = gm.diagnose(log(size * (TEMPERATURE - 35.0), rng, **held), gm.model_from_effects(["bias"]), hold_out=False)
    assert found.verdict == "ambiguous"
    assert set(found.credible_set) >= {"bias_temperature", "scale_temperature"}
    assert "Positive and negative rates" in (found.next_test or "")
    still = held | {"rate": np.zeros(ROWS)}
    found = gm.diagnose(log(size * (TEMPERATURE - 35.0), rng, **still), gm.model_from_effects(["bias"]), hold_out=False)
    assert [cause.effect for cause in found.causes] == ["bias_temperature"]
    assert found.verdict == "named"


def test_a_second_step_is_found_beside_one_that_is_fixed(rng: np.random.Generator):
    model = GyroModel(
        (*gm.model_from_effects(["bias"]).effects, BiasStep(size=jnp.asarray(40.0 * DEG_H), epoch=jnp.asarray(2001.0))),
        fixed=frozenset({("bias_step", "size"), ("bias_step", "epoch")}),
    )
    found = gm.diagnose(log(40.0 * (TIME > 2001.0) + 25.0 * (TIME > 5500.0), rng), model, hold_out=False)
    assert (found.verdict, [cause.effect for cause in found.causes]) == ("named", ["bias_step"])
    steps = [e for e in found.extended.model.effects if isinstance(e, BiasStep)]
    assert [float(e.size) / DEG_H for e in steps] == pytest.approx([40.0, 25.0], abs=1.0)
    assert [float(e.epoch) for e in steps] == pytest.approx([2001.0, 5500.0], abs=STEP)
    assert any("set free beside" in line for line in found.findings)


def test_a_line_of_one_campaign_is_found_beside_a_simulated_line_of_both(rng: np.random.Generator):
    """Of the simulation's line both campaigns have the same phase; the other is in the second alone."""
    all_have = 8.0 * np.cos(2 * np.pi * 0.004 * TIME)
    second = log(all_have + 5.0 * np.cos(2 * np.pi * 0.0111 * TIME + 1.0), rng)
    found = gm.diagnose([log(all_have, rng), second], one_line(), hold_out=False)
    assert (found.verdict, [cause.effect for cause in found.causes]) == ("named", ["bias_periodic"])
    [lines] = [e for e in found.extended.model.effects if isinstance(e, BiasPeriodic)]
    assert lines.campaigns == (0, 2)
    assert np.hypot(lines.cosine, lines.sine) / DEG_H == pytest.approx([8.0, 5.0], abs=0.4)


def one_line() -> GyroModel:
    line = BiasPeriodic(
        cosine=jnp.asarray([8.0 * DEG_H]), sine=jnp.asarray([0.0]), frequency=jnp.asarray([0.004]), campaigns=()
    )
    return GyroModel((*gm.model_from_effects(["bias"]).effects, line))


def test_what_a_wider_form_sets_free_is_told(rng: np.random.Generator):
    """A line over temperature that the simulation holds, and a hinge that it lacks."""
    error = 2.0 * (TEMPERATURE - 35.0) + 4.0 * np.maximum(TEMPERATURE - 38.0, 0.0)
    line = BiasTemperature(coefficient=jnp.asarray(2.0 * DEG_H), reference=jnp.asarray(35.0))
    model = GyroModel(
        (*gm.model_from_effects(["bias"]).effects, line), fixed=frozenset({("bias_temperature", "coefficient")})
    )
    measured = log(error, rng, temperature=TEMPERATURE)
    assert contained_in(build_bank(read_signals(measured)), model)["bias_temperature_curve"] == 0
    assert contained_in(build_bank(read_signals(measured)), replace(model, fixed=frozenset()))["bias_temperature_curve"]
    found = gm.diagnose(measured, model, hold_out=False)
    assert [cause.effect for cause in found.causes] == ["bias_temperature_curve"]
    assert "bias_temperature of the simulation is fixed: as a part of bias_temperature_curve it was set free." in (
        found.findings
    )


def test_what_a_search_adds_to_a_line_is_its_hinge_or_its_square():
    """The interval that allows for the selection is that of the new coefficient."""
    square = make_effect("bias_temperature_curve")
    hinge = BiasTemperatureCurve(coefficients=jnp.zeros(1), hinges=jnp.zeros(1), breakpoints=jnp.asarray([38.0]))
    assert _size_of(square, False, 1) == "coefficients[1]"
    assert _size_of(hinge, False, 1) == "hinges"
    assert _size_of(make_effect("bias_temperature"), False, 0) == "coefficient"


def test_the_smallest_curve_that_shows_is_as_large_as_planned(rng: np.random.Generator):
    """Both tell of its first coefficient, whatever other forms are measured in."""
    model = gm.model_from_effects(["bias"])
    stated = GyroModel(model.effects, {"noise_white": jnp.asarray(DEG_H * np.sqrt(STEP))})
    measured = log(np.zeros(ROWS), rng, temperature=TEMPERATURE)
    planned = isolability(measured, stated, tests=False).detectable["bias_temperature_curve"]
    size, unit = gm.diagnose(measured, stated, hold_out=False).minimum_detectable["bias_temperature_curve"]
    assert unit == planned.unit
    assert 0.6 < size / planned.value < 1.7


def test_steps_of_a_next_test_stand_within_the_campaign(rng: np.random.Generator):
    record = read_signals([log(np.zeros(ROWS), rng), log(np.zeros(ROWS), rng)])
    steps = _forms(make_effect("bias_step"), record)
    assert {step.campaign for step in steps} == {1, 2}
    assert all(0.0 < float(step.epoch) < TIME[-1] for step in steps)


def test_what_rows_left_out_before_had_told_stays_left_out(rng: np.random.Generator):
    """A hinge over the few hot rows, which go first; those that go then say nothing of it."""
    temperature = np.where(np.arange(ROWS) < 20, 60.0 + np.arange(ROWS), 25.0 + np.arange(ROWS) / 40.0)
    scanner = laid_out(
        read_signals(log(np.zeros(ROWS), rng, temperature=temperature)), gm.model_from_effects(["bias"])
    ).scanner
    once = scanner.without(np.arange(20), None)
    assert once._lost.any()
    assert (once.without(np.arange(300, 310), None)._lost >= once._lost).all()


def test_rows_are_fewer_where_there_are_many_campaigns_or_columns(rng: np.random.Generator):
    one = log(np.zeros(ROWS), rng, temperature=TEMPERATURE)
    assert _most_rows([one, one]) == [ROWS, ROWS]

    def long(rows: int, columns: int) -> gm.Campaign:
        values = {f"c{k}": rng.standard_normal(rows) for k in range(columns)}
        units = dict.fromkeys(values, "") | {"time": "s", "output": "deg/h"}
        return gm.Campaign(
            values | {"time": np.arange(float(rows)), "output": rng.standard_normal(rows)}, units, {"kind": "rate"}
        )

    assert _most_rows([long(30_000, 1)]) == [20_000]
    assert sum(_most_rows([long(15_000, 1)] * 5)) == MOST_ROWS
    assert _most_rows([long(10_000, 64)]) == [MOST_VALUES // 64]
