"""The fiber-optic output model F = S_n (I + E + D)(1 + 1e-6 ε) with all terms of E, against a simulator that lets heat
diffuse into the coil. Expected: the coefficients that the simulator was given; the model file's equation by hand."""

from __future__ import annotations

from importlib import resources
from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import gyromodel
from gyromodel.campaign import Campaign
from gyromodel.diagnosis._bank import build_bank
from gyromodel.diagnosis._ranking import skipped
from gyromodel.effects.thermal import BiasTemperatureCurve, BiasTemperatureGradient
from gyromodel.model import GyroModel, ModelError, model_from_effects
from gyromodel.model_files import read_model, write_model
from gyromodel.signals import read_signals
from tests.truth import fiber_optic as truth

LENGTH = 20
DEG_H = np.deg2rad(1 / 3600)
PLAN = """
gyro: fog
kind: rate
duration: 1 h
interval: 10 s
output: bit/s
columns:
  rate: [{for: 30 min, at: 0 deg/s}, {for: 30 min, at: 50 deg/s}]
  temperature: [{for: 10 min, at: 14 degC}, {for: 30 min, to: 42 degC}]
  temperature_coil: [{for: 15 min, at: 14 degC}, {for: 30 min, to: 40 degC}]
"""


def campaign(log: dict[str, np.ndarray], *left_out: str) -> Campaign:
    means = {k: v.reshape(-1, LENGTH).mean(axis=1) for k, v in log.items() if k not in ("error", *left_out)}
    means["output"] /= truth.SCALE_FACTOR
    units = {"time": "s", "temperature": "degC", "temperature_coil": "degC", "output": "deg/h"}
    return Campaign(means, {k: units[k] for k in means}, {"kind": "rate", "gyro": "fog"})


def bent(*more: str) -> GyroModel:
    """The bias over temperature with its bends known, and further effects."""
    curve = BiasTemperatureCurve(
        coefficients=jnp.zeros(1), hinges=jnp.zeros(2), breakpoints=jnp.asarray(truth.BREAKPOINTS)
    )
    effects = (*model_from_effects(["bias", *more]).effects, curve)
    return GyroModel(effects, fixed=frozenset({("bias_temperature_curve", "breakpoints")}))


def test_the_terms_of_the_environment_are_those_of_the_heat_in_the_coil():
    """Shupe of the coil: its rate is that of the case less that of the difference."""
    rng = np.random.default_rng(5)
    gyro = truth.Gyro(shupe=1000.0, gradient_rate=2500.0, walk=0.0, quantisation=0.2)
    model = bent("bias_temperature_rate", "bias_temperature_gradient_rate")
    estimate = gyromodel.fit(campaign(truth.log(gyro, 3.0, rng)), model)
    found = {row.effect: (row.value, row.std) for row in estimate.table()}
    assert found["bias_temperature_rate"][0] == pytest.approx(1000.0, rel=0.02)
    assert found["bias_temperature_gradient_rate"][0] == pytest.approx(1500.0, rel=0.1)


@pytest.mark.long
def test_a_hidden_gradient_is_named():
    """A third of it is 2.3 standard deviations from the rate of a coil that follows the case through one lag."""
    log = truth.log(truth.Gyro(gradient=15.0), 3.0, np.random.default_rng(2))
    found = gyromodel.diagnose(campaign(log), bent(), hold_out=False)
    assert (found.verdict, [c.effect for c in found.causes]) == ("named", ["bias_temperature_gradient"])
    value = found.causes[0].parameters[0]
    assert value.value == pytest.approx(15.0, rel=0.1)


def test_one_thermometer_shows_no_gradient(rng: np.random.Generator):
    one = campaign(truth.log(truth.Gyro(), 1.0, rng), "temperature_coil")
    bank = build_bank(read_signals(one))
    for name in ("bias_temperature_gradient", "bias_temperature_gradient_rate"):
        assert name not in bank.names()
        assert bank.not_testable[name] == "needs a column temperature_<place>"
        with pytest.raises(ModelError, match=f"{name} needs a column temperature_<place>, which the campaign lacks"):
            gyromodel.fit(one, model_from_effects([name]))


def test_a_second_thermometer_and_the_difference_are_one_candidate():
    names = ["temperature", "temperature_rate", "temperature_coil", "temperature_coil_rate"]
    assert "bias_temperature_coil" in skipped(bent(), names)
    assert "bias_temperature_gradient" not in skipped(bent(), names)
    both = model_from_effects(["bias_temperature", "bias_temperature_coil"])
    assert "bias_temperature_gradient" in skipped(both, names)
    assert "bias_temperature_coil" not in skipped(model_from_effects(["bias"]), names)


def test_every_pair_of_thermometers_is_tried_and_the_pair_is_kept(tmp_path: Path):
    signals = {n: jnp.asarray(v) for n, v in {
        "time": [0.0, 1.0], "temperature_b": [1.0, 3.0], "temperature": [0.0, 1.0], "temperature_a": [5.0, 5.5],
        "temperature_a_rate": [0.0, 0.0],
    }.items()}  # fmt: skip
    pairs = [e.between for e in BiasTemperatureGradient.candidates(signals)]
    assert pairs == [
        ("temperature", "temperature_a"),
        ("temperature", "temperature_b"),
        ("temperature_a", "temperature_b"),
    ]
    assert BiasTemperatureGradient().prepared(signals).between == pairs[0]
    chosen = BiasTemperatureGradient(coefficient=jnp.asarray(DEG_H), between=pairs[2])
    for effect in (chosen, BiasTemperatureGradient()):
        write_model(GyroModel((effect,)), tmp_path / "model.yaml")
        assert eqx.tree_equal(read_model(tmp_path / "model.yaml").effects[0], effect)
    assert chosen.columns_needed == ("temperature_a", "temperature_b")
    assert np.asarray(chosen.contribution(signals)) / DEG_H == pytest.approx([4.0, 2.5])
    with pytest.raises((ValueError, TypeError)):
        BiasTemperatureGradient(between=("temperature", "temperature"))
    (tmp_path / "same.yaml").write_text(
        "effects: [{effect: bias_temperature_gradient, between: [temperature_a, temperature_a]}]", encoding="utf-8"
    )
    with pytest.raises(ModelError, match="between takes the names of two thermometers"):
        read_model(tmp_path / "same.yaml")


def test_the_default_simulation_is_the_published_output_model(tmp_path: Path):
    (tmp_path / "plan.yaml").write_text(PLAN, encoding="utf-8")
    with resources.as_file(resources.files("gyromodel") / "data" / "fiber_optic_simulation.yaml") as path:
        model = read_model(path)
        from gyromodel.cli import main

        with pytest.raises(SystemExit) as done:
            main(["simulate", str(path), "--plan", str(tmp_path / "plan.yaml"), "-o", str(tmp_path / "log.csv")])
        assert done.value.code == 0
    log = gyromodel.read_campaign(tmp_path / "log.csv")
    signals = {k: np.asarray(v)[: len(log)] for k, v in read_signals(log).signals.items()}
    temperature, rate = signals["temperature"], np.rad2deg(signals["rate"])
    slopes = np.array([37.06 / 10, 37.06 / 10 - 2.562, 37.06 / 10 - 2.562 + 3.324])
    assert slopes * truth.SCALE_FACTOR == pytest.approx(truth.SLOPES, rel=1e-3)
    environment = (truth.bent_bias(temperature) - truth.bent_bias(np.array([22.724]))) / truth.SCALE_FACTOR
    environment += 3.706 * (22.724 - 25.0)
    environment += 1000 * signals["temperature_rate"]
    environment += 500 * (signals["temperature_rate"] - signals["temperature_coil_rate"])
    scale = 1 + 30e-6 * (rate / 100) ** 2 + 5e-6 * (temperature - 25)
    expected = 328.95 * (rate + (environment + 5) / 3600) * scale
    predicted = np.asarray(model.prepared(read_signals(log).signals).predict(read_signals(log).signals))[: len(log)]
    assert predicted == pytest.approx(expected, rel=1e-6, abs=1e-3)
    noise = log.columns["output"] - predicted
    assert noise[:60].std() == pytest.approx(328.95 * 0.018 / 60 / np.sqrt(10), rel=0.5)
