"""What the search lays out of a campaign's columns: which names it tries, and why not the others."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

from gyromodel._checks import CampaignError
from gyromodel._model_units import check_units
from gyromodel.campaign import Campaign
from gyromodel.diagnosis import isolability
from gyromodel.diagnosis._added_tests import added_tests
from gyromodel.diagnosis._bank import build_bank
from gyromodel.diagnosis._drivers import smooth_columns
from gyromodel.effects.geometry import cross_rates
from gyromodel.model import GyroModel, model_from_effects
from gyromodel.signals import read_signals

ROWS, STEP = 200, 20.0


def log(units: dict[str, str], **columns: np.ndarray) -> Campaign:
    """A log of white noise with some columns."""
    output = np.random.default_rng(1).standard_normal(ROWS)
    values = {"time": np.arange(ROWS) * STEP, "output": output} | columns
    return Campaign(values, {"time": "s", "output": "deg/h"} | units, {"kind": "rate"})


def test_what_is_searched_in_part_is_named_as_the_effect():
    turn = np.arange(ROWS) / 9.0
    campaign = log(
        {"acceleration_input": "g", "acceleration_spin": "g", "temperature": "degC"},
        acceleration_input=np.cos(turn),
        acceleration_spin=np.sin(turn),
        temperature=np.full(ROWS, 20.0),
    )
    model = GyroModel(model_from_effects(["bias", "bias_temperature"]).effects, {"noise_white": jnp.asarray(5e-9)})
    reasons = isolability(campaign, model, tests=False).not_testable
    assert "centrifuge" in reasons["bias_acceleration_squared"]
    # The model's temperature bias does not make a constant temperature one that a late thermometer shows in.
    assert reasons["temperature_lag"] == "temperature does not vary"


def test_a_derived_driver_has_a_name_that_no_column_can_have():
    flow, other = np.arange(ROWS) / 50.0, np.cos(np.arange(ROWS) / 30.0)
    units = {"flow": "m^3/s", "flow_rate": "m^3/s^2"}
    bank = build_bank(read_signals(log(units, flow=flow + 0.1 * flow**2, flow_rate=other)))
    along = {b.name: np.asarray(b.along) for b in bank.blocks if b.kind == "driver" and "flow" in b.name}
    assert {"smooth(flow)", "smooth(flow_rate)", "smooth(d(flow)/dt)", "smooth(flow[earlier])"} <= set(along)
    assert np.corrcoef(along["smooth(flow_rate)"][:ROWS], other)[0, 1] > 0.999
    assert smooth_columns("smooth(d(flow)/dt)") == ("d(flow)/dt",)
    for name in ("d(flow)/dt", "flow[earlier]"):
        with pytest.raises(CampaignError, match="cannot name a column"):
            log({name: "s"}, **{name: flow})


def test_an_angle_that_wraps_has_no_rate():
    turn = np.arange(ROWS) * 5.0 % 360.0
    names = build_bank(read_signals(log({"azimuth": "deg"}, azimuth=turn))).names()
    assert "smooth(azimuth)" in names
    assert not {"smooth(d(azimuth)/dt)", "smooth(azimuth[earlier])"} & set(names)


def test_of_columns_that_serve_alike_the_missing_one_is_named():
    spin = np.where(np.arange(ROWS) % 5 < 2, np.nan, np.sin(np.arange(ROWS) / 7.0))
    bank = build_bank(read_signals(log({"rate_spin": "deg/s"}, rate_spin=spin)))
    assert bank.not_testable["misalignment"] == "rate_spin is missing in 80 of 200 rows"


def test_what_no_one_can_set_is_not_stepped():
    i = np.arange(ROWS)
    campaign = log(
        {"feedback_ramp": "count", "rate_estimated": "deg/s", "attitude_w": "", "supply_voltage": "V"},
        feedback_ramp=i % 16.0,
        rate_estimated=np.sin(i),
        attitude_w=np.cos(i),
        supply_voltage=i / 50.0,
    )
    stepped = [t.sentence.split()[1] for t in added_tests(campaign) if t.sentence.startswith("Step ")]
    assert stepped == ["supply_voltage"]


@pytest.mark.parametrize("unit", ["count", "bit", "V", "rad", ""])
def test_codes_of_a_ramp_are_searched_in_any_unit_it_may_have(unit: str):
    campaign = log({"feedback_ramp": unit}, feedback_ramp=np.arange(ROWS) * 7.0 % 64.0)
    record = read_signals(campaign)
    assert "bias_readout_code" in build_bank(record).names()
    check_units(model_from_effects(["bias_readout_code"]), record.output_unit, record.units)


def test_the_rate_about_the_input_axis_is_no_cross_rate():
    turns = {f"rate_{a}": np.sin(np.arange(ROWS) / (5.0 + i)) for i, a in enumerate(("input", "spin", "output"))}
    assert cross_rates(turns) == ["rate_spin", "rate_output"]
    turns = {f"rate_{a}": v for a, v in zip("xyz", turns.values(), strict=True)}
    record = read_signals(log(dict.fromkeys(turns, "deg/s"), **turns))
    assert "not known which is the input axis" in build_bank(record).not_testable["misalignment"]
    with pytest.raises(CampaignError, match=r"about: \[rate_x, rate_y\]"):
        model_from_effects(["misalignment"]).prepared(record.signals)
    del turns["rate_z"]
    record = read_signals(log(dict.fromkeys(turns, "deg/s"), **turns))
    assert "misalignment" in build_bank(record).names()


def test_padding_is_no_branch_of_a_loop():
    """The temperature turns back in the last two of 200 rows only; 24 more are padded."""
    temperature = 20.0 + np.minimum(np.arange(ROWS), 197.0 + 20.0 * (197.0 - np.arange(ROWS)))
    bank = build_bank(read_signals(log({"temperature": "degC"}, temperature=temperature)))
    assert "to close a loop" in bank.not_testable["bias_thermal_hysteresis"]
