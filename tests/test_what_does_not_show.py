"""A simulation may have what the data do not show: a search goes on beside it, and says that it was held."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import binom

import gyromodel as gm
from gyromodel.diagnosis import _steps
from gyromodel.effects.scale import ScaleFactor
from gyromodel.effects.thermal import BiasWarmup
from gyromodel.estimate import EstimateError

ROWS = 900
WARM_UP = (np.deg2rad(2.0 / 3600.0),)
HELD = "These data do not determine bias_warmup (time_constant) of the simulation: held"


def still(rng: np.random.Generator) -> gm.Campaign:
    columns = {"time": np.arange(ROWS, dtype=float), "output": 5.0 + 0.3 * rng.standard_normal(ROWS)}
    return gm.Campaign(columns, {"time": "s", "output": "deg/h"}, {"kind": "rate"})


def turning(rng: np.random.Generator) -> gm.Campaign:
    """Rates held for 300 s each, over a cycle of temperature, whose coefficient of 0.05 deg/h per degC is hidden."""
    time = 10.0 * np.arange(ROWS)
    temperature = 25.0 + 20.0 * np.sin(2.0 * np.pi * time / 6000.0)
    rate = 3600.0 * np.repeat(rng.choice([-30.0, -10.0, 0.0, 10.0, 30.0], ROWS // 30), 30)
    output = rate + 5.0 + 0.05 * (temperature - 25.0) + 0.3 * rng.standard_normal(ROWS)
    columns = {"time": time, "rate": rate, "temperature": temperature, "output": output}
    return gm.Campaign(
        columns, {"time": "s", "rate": "deg/h", "temperature": "degC", "output": "deg/h"}, {"kind": "rate"}
    )


@pytest.mark.law
def test_a_simulated_warm_up_that_is_not_there_is_adequate(rng: np.random.Generator):
    """In two of five logs no fit determines its time."""
    found = [gm.diagnose(still(rng), gm.model_from_effects(["bias", "bias_warmup"]), hold_out=False) for _ in range(12)]
    adequate = sum(diagnosis.verdict == "adequate" for diagnosis in found)
    assert binom.cdf(adequate, len(found), 0.98) > 1e-5
    held = [any(HELD in line for line in diagnosis.findings) for diagnosis in found]
    assert binom.cdf(sum(held), len(held), 0.4) > 1e-5
    assert binom.sf(sum(held) - 1, len(held), 0.4) > 1e-5
    assert held == [("bias_warmup", "time_constant") in diagnosis.extended.model.fixed for diagnosis in found]


def test_what_shows_is_not_held_beside_what_does_not():
    """A warm-up that is there, a bandwidth that is not, and a coefficient that is hidden."""
    log = turning(np.random.default_rng(1))
    log = log.with_column("output", log.columns["output"] + 4.0 * np.exp(-log.columns["time"] / 900.0), "deg/h")
    model = gm.model_from_effects(["bias", "scale_factor", "bandwidth", "bias_warmup"])
    found = gm.diagnose(log, model, hold_out=False)
    assert [cause.effect for cause in found.causes] == ["bias_temperature"]
    told = {(row.effect, row.name): row for row in found.extended.table()}
    coefficient, time = told["bias_temperature", "coefficient"], told["bias_warmup", "time_constant"]
    assert abs(coefficient.value - 0.05) < 4.0 * coefficient.std < 0.01
    assert abs(time.value - 900.0) < 4.0 * time.std < 400.0


@pytest.mark.parametrize("effect", ["time_delay", "bandwidth", "rate_hysteresis"])
def test_what_follows_a_rate_that_is_none(effect: str, rng: np.random.Generator):
    log = still(rng).with_column("rate", np.zeros(ROWS), "deg/s")
    found = gm.diagnose(log, gm.model_from_effects(["bias", effect]), hold_out=False)
    assert (found.verdict, found.causes) == ("adequate", ())
    assert any(effect in line and "do not determine" in line for line in found.findings)


def test_what_stands_for_another_effect_is_refused(rng: np.random.Generator):
    """A temperature that rises with time: which of the two has the slope is not for the order of a file to say."""
    log = still(rng).with_column("temperature", 20.0 + np.arange(ROWS) / 50.0, "degC")
    for order in (["bias_temperature", "bias_drift"], ["bias_drift", "bias_temperature"]):
        with pytest.raises(EstimateError, match="bias_drift and bias_temperature cannot be told apart"):
            gm.diagnose(log, gm.model_from_effects(["bias", *order]), hold_out=False)


def test_shapes_that_are_known_only_together_stay_as_searched(rng: np.random.Generator, monkeypatch):
    """Where all that a fit tells of a shape is what it has in common with another one."""
    held, fit_record = [], _steps.fit_record
    monkeypatch.setattr(_steps, "_entangled", lambda estimate: True)
    monkeypatch.setattr(_steps, "fit_record", lambda d, m, **how: held.append(m.fixed) or fit_record(d, m, **how))
    log = still(rng)
    log = log.with_column("output", log.columns["output"] + 3.0 * np.exp(-log.columns["time"] / 150.0), "deg/h")
    gm.diagnose(log, gm.model_from_effects(["bias"]), hold_out=False)
    assert {frozenset(), frozenset({("bias_warmup", "time_constant")})} <= set(held)


@pytest.mark.parametrize("effect", ["bandwidth", "rate_hysteresis", "bias_warmup"])
def test_what_is_hidden_is_found_beside_what_does_not_show(effect: str):
    """In two of four such logs a fit with both was lost, and what was found was not named."""
    for seed in (1, 3):
        model = gm.model_from_effects(["bias", "scale_factor", effect])
        found = gm.diagnose(turning(np.random.default_rng(seed)), model, hold_out=False)
        assert [cause.effect for cause in found.causes] == ["bias_temperature"]


def test_a_warm_up_stated_and_fixed_that_is_not_there(rng: np.random.Generator):
    """Set free it stood beside itself, which no fit tells apart: the log was "unknown"."""
    model = gm.model_from_effects(["bias"]).with_effect(BiasWarmup(amplitude=WARM_UP, time_constant=(300.0,)))
    fixed = frozenset({("bias_warmup", "amplitude"), ("bias_warmup", "time_constant")})
    found = gm.diagnose(still(rng), replace(model, fixed=fixed), hold_out=False)
    assert "bias_warmup" in {cause.effect for cause in found.causes}
    assert any("fixed in the simulation at a value that the data contradict" in line for line in found.findings)


@pytest.mark.parametrize("size", [0.0, 0.2])
def test_what_a_campaign_does_not_excite_stays_as_stated(size: float, rng: np.random.Generator):
    """A still gyro at one temperature, and the simulation of one that turns, warm and cold."""
    campaign = still(rng)
    time = campaign.columns["time"]
    campaign = campaign.with_column("rate", np.zeros(ROWS), "deg/s").with_column(
        "temperature", np.full(ROWS, 25.0), "degC"
    )
    campaign = campaign.with_column("output", campaign.columns["output"] + size * np.cos(0.3 * time), "deg/h")
    effects = ["bias", "scale_nonlinearity", "bias_temperature", "scale_temperature"]
    model = gm.model_from_effects(effects).with_effect(ScaleFactor(value=1.002))
    # Its stated size would tell a scale factor.
    model = model.with_effect(BiasWarmup(amplitude=WARM_UP, time_constant=(300.0,)))
    found = gm.diagnose(campaign, model)
    assert [cause.effect for cause in found.causes] == ["bias_periodic"] * (size > 0.0)
    assert found.verdict == ("named" if size else "adequate")
    held = ("bias_temperature (", "scale_factor (value), scale_nonlinearity (coefficients), scale_temperature (")
    assert any(all(part in line for part in held) for line in found.findings)
    assert float(found.extended.model.gain()) == pytest.approx(1.002, rel=1e-12)
    assert found.extended.table()[0].std > 0


CURVE = """effects:
- {effect: bias, value: 5 deg/h}
- effect: bias_temperature_curve
  coefficients: [37 deg/h]
  hinges: [-2.5 deg/h/degC, 3.3 deg/h/degC]
  breakpoints: [22.7 degC, 31.2 degC]
  reference: 25 degC
"""


def test_a_curve_over_a_temperature_that_stands_still(rng: np.random.Generator, tmp_path: Path):
    """Bends and slopes of the simulation stay where they are: what they add here is the bias's."""
    (tmp_path / "model.yaml").write_text(CURVE)
    log = still(rng).with_column("temperature", np.full(ROWS, 25.0), "degC")
    found = gm.diagnose(log, gm.read_model(tmp_path / "model.yaml"), hold_out=False)
    assert found.verdict == "adequate"
    assert any("bias_temperature_curve (breakpoints)" in line for line in found.findings)


@pytest.mark.parametrize("seed", [0, 6])
def test_what_one_block_alone_tells_is_not_predicted_without_it(seed: int):
    """A warm-up of 0.8 s at the start of 900 s: without the first fifth its amplitude was 1e99 deg/h.

    It is one row alone, of which every time constant far below 1 s makes the same. Where the simulation was fitted with
    one of these, in draw 6, no fit beside it converged, and the line stayed "unknown".
    """
    campaign = still(np.random.default_rng(seed))
    time = campaign.columns["time"]
    output = campaign.columns["output"] + 3.0 * np.exp(-time / 0.8) + 0.2 * np.cos(0.3 * time)
    found = gm.diagnose(campaign.with_column("output", output, "deg/h"), gm.model_from_effects(["bias", "bias_warmup"]))
    assert [cause.effect for cause in found.causes] == ["bias_periodic"]
    frequency = next(row for row in found.extended.table() if row.name == "frequency")
    assert frequency.std > 0.0
    assert abs(frequency.value - 0.3 / (2.0 * np.pi)) < 4.0 * frequency.std
    assert any("bias_warmup (time_constant)" in line for line in found.findings) == (seed == 6)
    assert "1 more could not be predicted" in found.gain.scheme
    assert 0.25 < found.gain.after < found.gain.before < 0.45


def test_a_warm_up_of_which_a_short_record_shows_the_bend_alone(rng: np.random.Generator):
    """In 10 s, beside a drift, any time constant far above that makes the same: the diagnosis ended with that."""
    time = 0.01 * np.arange(1000)
    rate = 50.0 * np.sin(2.0 * np.pi * 0.7 * time)
    output = rate + 0.1 * time - 0.015 * time**2 + 0.05 * rng.standard_normal(len(time))
    log = gm.Campaign(
        {"time": time, "rate": rate, "output": output},
        {"time": "s", "rate": "deg/s", "output": "deg/s"},
        {"kind": "rate"},
    )
    effects = ["bias", "scale_factor", "bias_warmup", "bias_drift"]
    found = gm.diagnose(log, gm.model_from_effects(effects), hold_out=False)
    assert found.verdict == "adequate"
    assert any("bias_warmup (time_constant)" in line for line in found.findings)
    assert found.residual_after.std() < 0.055
