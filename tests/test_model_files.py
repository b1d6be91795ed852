"""Model files: what is written is read back bit for bit, units come out as numbers worked by hand, and whatever is
wrong with a file is a `ModelError` that names the line."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import yaml
from hypothesis import example, given, settings
from hypothesis import strategies as st

from gyromodel import __version__
from gyromodel.campaign import Campaign
from gyromodel.effects import CATALOGUE
from gyromodel.effects.drivers import Bias, BiasColumn
from gyromodel.effects.scale import ScaleFactor, ScaleSpline
from gyromodel.effects.thermal import BiasTemperature, BiasTemperatureCurve, BiasWarmup
from gyromodel.estimate import Estimate, fit
from gyromodel.model import GyroModel, ModelError, make_effect, model_from_effects
from gyromodel.model_files import read_calibration, read_model, write_model
from gyromodel.signals import read_signals
from tests.helpers import MUTANTS, SHARED_FOLDER, mutated

# The example of the public contract.
CONTRACT = """\
gyro: fog
effects:
  - effect: scale_factor
    value: 1000 count/deg        # optional start value, with unit
    fixed: true                  # optional: known, not fitted
  - effect: bias
  - effect: bias_temperature
noise: auto                      # or a list of noise_* effects with values
"""
FULL = """\
gyro: fog
effects:
  - effect: scale_factor
    value: 1000 count/(deg/s)
  - effect: bias
    value: {value: 3.5 deg/h, std: 0.1 deg/h}
  - effect: bias_temperature_curve
    coefficients: [1 deg/h, -2 deg/h]
    hinges: [3 deg/h/degC]
    breakpoints: [300 K]
    reference: 20 degC
    fixed: [breakpoints]
  - effect: bias_warmup
    amplitude: 4 arcsec/s
    time_constant: 10 min
  - effect: bias_pressure
    value: 2 deg/h/mbar
    reference: 1000 mbar
  - effect: scale_nonlinearity
    powers: [2, 5]
    coefficients: [10 ppm, 0.1 %]
    full_rate: 100 deg/s
  - effect: bias_step
    size: 1 deg/h
    epoch: 1 h
noise:
  - {effect: noise_white, value: 0.1 deg/sqrt(h)}
  - {effect: noise_flicker, value: 0.2 deg/h}
  - {effect: noise_random_walk, value: 0.3 deg/h/sqrt(h)}
"""
DEG_H = np.pi / 180 / 3600


def noise(entry: str) -> str:
    """A model file of noise alone: white, and one entry more."""
    return f"effects: []\nnoise:\n  - {{effect: noise_white, value: 1 deg/sqrt(h)}}\n  - {entry}\n"


def read(folder: Path, text: str | bytes) -> GyroModel:
    path = folder / "model.yaml"
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    return read_model(path)


def contents(model: GyroModel) -> list:
    """Everything a model holds, as bytes where it is numbers: equal only when bit for bit."""
    effects = [(e.label, {f.name: _bytes(getattr(e, f.name)) for f in dataclasses.fields(e)}) for e in model.effects]
    return [effects, {k: _bytes(v) for k, v in model.noise.items()}, model.fixed, model.gyro]


def _bytes(value):
    return np.asarray(value).tobytes() if isinstance(value, jax.Array) else value


def test_example_of_the_contract(tmp_path: Path):
    model = read(tmp_path, CONTRACT)
    assert model.labels == ("scale_factor", "bias", "bias_temperature")
    assert float(model.gain()) == pytest.approx(1000 / np.deg2rad(1))
    assert model.fixed == {("scale_factor", "value")}
    assert [s.field for s in model.slots()] == ["value", "coefficient"]
    assert (model.gyro, dict(model.noise)) == ("fog", {})


@pytest.mark.parametrize(("output", "kind"), [("count/s", "rate"), ("count", "rate"), ("count", "increment")])
def test_example_of_the_contract_fits_counts(output: str, kind: str, tmp_path: Path, rng: np.random.Generator):
    model = read(tmp_path, CONTRACT)
    time, rate = np.arange(100.0), rng.uniform(-10, 10, 100)
    temperature = 20 + rng.standard_normal(100)
    columns = {"time": time, "rate": rate, "temperature": temperature, "output": 1000 * (rate + 0.5)}
    columns["output"] = columns["output"] + rng.standard_normal(100)
    units = {"time": "s", "rate": "deg/s", "temperature": "degC", "output": output}
    estimate = fit(Campaign(columns, units, {"kind": kind}), model)
    row = {r.effect: r for r in estimate.table()}
    assert row["bias"].value == pytest.approx(0.5 * 3600, abs=6 * row["bias"].std)
    per = "count/(deg/s)" if (output, kind) == ("count", "rate") else "count/deg"
    assert (row["scale_factor"].value, row["scale_factor"].unit) == (pytest.approx(1000.0), per)


def test_units_are_converted(tmp_path: Path):
    model = read(tmp_path, FULL)
    scale, bias, curve, warmup, pressure, nonlinearity, step = model.effects
    assert float(scale.value) == pytest.approx(1000 / np.deg2rad(1))  # type: ignore[attr-defined]
    assert float(bias.value) == pytest.approx(3.5 * DEG_H)  # type: ignore[attr-defined]
    assert np.asarray(curve.coefficients) == pytest.approx([DEG_H, -2 * DEG_H])  # type: ignore[attr-defined]
    assert np.asarray(curve.hinges) == pytest.approx([3 * DEG_H])  # type: ignore[attr-defined]
    assert np.asarray(curve.breakpoints) == pytest.approx([26.85])  # type: ignore[attr-defined]
    assert float(curve.reference) == 20.0  # type: ignore[attr-defined]
    assert warmup.amplitude.item() == pytest.approx(4 * DEG_H)  # type: ignore[attr-defined]
    assert warmup.time_constant.item() == 600.0  # type: ignore[attr-defined]
    assert float(pressure.coefficient) == pytest.approx(2 * DEG_H / 100)  # type: ignore[attr-defined]
    assert float(pressure.reference) == 1e5  # type: ignore[attr-defined]
    assert nonlinearity.powers == (2, 5)  # type: ignore[attr-defined]
    assert np.asarray(nonlinearity.coefficients) == pytest.approx([1e-5, 1e-3])  # type: ignore[attr-defined]
    assert float(nonlinearity.full_rate) == pytest.approx(np.deg2rad(100))  # type: ignore[attr-defined]
    assert float(step.epoch) == 3600.0  # type: ignore[attr-defined]
    noise = {k: float(v) for k, v in model.noise.items()}
    assert noise == pytest.approx({
        "noise_white": np.deg2rad(0.1) / 60,
        "noise_flicker": 0.2 * DEG_H,
        "noise_random_walk": 0.3 * DEG_H / 60,
    })  # fmt: skip
    assert model.fixed == {("bias_temperature_curve", "breakpoints")}


@pytest.mark.parametrize("text", [CONTRACT, FULL])
def test_read_write_read_is_exact(text: str, tmp_path: Path):
    first = read(tmp_path, text)
    write_model(first, tmp_path / "again.yaml")
    again = read_model(tmp_path / "again.yaml")
    assert contents(again) == contents(first)
    once = (tmp_path / "again.yaml").read_text(encoding="utf-8")
    write_model(again, tmp_path / "again.yaml")
    assert (tmp_path / "again.yaml").read_text(encoding="utf-8") == once


def test_numbers_are_written_as_they_were_read(tmp_path: Path):
    write_model(read(tmp_path, FULL), tmp_path / "again.yaml")
    document = yaml.safe_load((tmp_path / "again.yaml").read_text(encoding="utf-8"))
    values = {e["effect"]: e for e in document["effects"]}
    assert values["scale_factor"]["value"] == "1000 count/(deg/s)"
    assert values["bias"]["value"] == "3.5 deg/h"
    assert values["bias_temperature_curve"]["coefficients"] == ["1 deg/h", "-2 deg/h"]
    assert values["bias_temperature_curve"]["reference"] == "20 degC"
    assert values["bias_pressure"]["coefficient"] == "2 deg/h/mbar"
    assert values["scale_nonlinearity"]["coefficients"] == ["10 ppm", "1000 ppm"]
    assert document["noise"][0] == {"effect": "noise_white", "value": "0.1 deg/sqrt(h)"}


def test_markov_noise_is_stated_with_its_time_constant(tmp_path: Path):
    model = read(tmp_path, noise("{effect: noise_markov, value: 0.5 deg/h/sqrt(h), time_constant: 5 min}"))
    write_model(model, tmp_path / "again.yaml")
    written = yaml.safe_load((tmp_path / "again.yaml").read_text(encoding="utf-8"))["noise"]
    assert written[1] == {"effect": "noise_markov", "value": "0.5 deg/h/sqrt(h)", "time_constant": "300 s"}
    assert contents(read_model(tmp_path / "again.yaml")) == contents(model)


floats = st.floats(allow_nan=False, allow_infinity=False, min_value=-1e200, max_value=1e200)
sizes = st.floats(min_value=1e-200, max_value=1e200)


@settings(SHARED_FOLDER, max_examples=60)
@given(st.lists(floats, min_size=7, max_size=7), st.lists(sizes, min_size=4, max_size=4))
@example([0.1 + 0.2, -0.0, 5e-324, 1e200, -1 / 3, 2 / 3, 1e-30], [1 / 3, 1e-200, 1e200, 2 / 3])
def test_any_numbers_survive_bit_for_bit(tmp_path: Path, numbers: list[float], positive: list[float]):
    a, b, c, d, e, f, g = (jnp.asarray(v) for v in numbers)
    model = GyroModel(
        (
            ScaleFactor(value=jnp.asarray(positive[0]), unit="count/deg"),
            Bias(value=a),
            BiasTemperatureCurve(
                coefficients=jnp.stack([b, c]), hinges=jnp.stack([d]), breakpoints=jnp.stack([e]), reference=f
            ),
            ScaleSpline(coefficients=jnp.stack([a, b, c, d]), moved=(0, -12, 30, 7), full_rate=e, lowest=f),
            BiasColumn(coefficient=g, column="supply_voltage", unit="deg/h/V"),
        ),
        dict(zip(("noise_white", "noise_flicker", "noise_random_walk"), positive[1:], strict=True)),
        frozenset({("bias", "value"), ("bias_temperature_curve", "hinges")}),
        "rlg",
    )
    write_model(model, tmp_path / "any.yaml")
    assert contents(read_model(tmp_path / "any.yaml")) == contents(model)


NEEDED_BESIDES = {
    "acceleration_input", "acceleration_spin", "acceleration_output", "vibration", "rate_spin", "rate_output",
    "magnetic_field", "azimuth", "table_angle", "feedback_ramp", "torquer_current", "backscatter", "null_shift",
}  # fmt: skip


OF_GYROS = sorted(name for name, kind in CATALOGUE.items() if kind.domain == "gyro" and name != "bias_column")


@pytest.mark.parametrize("label", [*OF_GYROS, "bias_supply_voltage"])
def test_every_effect_is_written_and_read(label: str, tmp_path: Path):
    columns = {k: jnp.linspace(-1.0, 2.0, 16) for k in ("time", "time_on", "rate", "temperature", "supply_voltage")}
    signals = columns | {"output": 3.0 * columns["rate"], "temperature_rate": columns["rate"]}
    signals |= {"temperature_coil": 2.0 * columns["rate"], "temperature_coil_rate": 3.0 * columns["rate"]}
    signals |= dict.fromkeys(NEEDED_BESIDES, columns["rate"]) | {"thermistor_resistance": jnp.linspace(2e4, 1e3, 16)}
    model = GyroModel((make_effect(label).prepared(signals),), {}, frozenset(), "fog")
    write_model(model, tmp_path / "one.yaml")
    again = read_model(tmp_path / "one.yaml")
    expected, found = contents(model), contents(again)
    if label in ("scale_factor", "quantisation"):
        found[0][0][1]["unit"] = ""  # a number without unit is one of a rate output
    assert found == expected
    assert np.array_equal(again.predict(signals), model.predict(signals))


@pytest.mark.parametrize("std", [False, True])
def test_a_warm_up_of_one_number_each_is_one_of_one_term(std: bool, tmp_path: Path):
    """As files had it before a warm-up took several terms."""
    tau = "{value: 10 min, std: 3 s}" if std else "10 min"
    text = "effects:\n  - {effect: bias_warmup, amplitude: 3 deg/h, time_constant: TAU}\n".replace("TAU", tau)
    (tmp_path / "old.yaml").write_text(text, encoding="utf-8")
    (warmup,) = read_model(tmp_path / "old.yaml").effects
    assert isinstance(warmup, BiasWarmup)
    assert np.array_equal(warmup.time_constant, [600.0])
    assert warmup.contribution({"time_on": jnp.zeros(1)}) == pytest.approx(3 * np.pi / 180 / 3600)
    write_model(GyroModel((warmup.joined(warmup),)), tmp_path / "two.yaml")
    (two,) = read_model(tmp_path / "two.yaml").effects
    assert isinstance(two, BiasWarmup)
    assert np.array_equal(two.time_constant, [600.0, 600.0])


@pytest.mark.parametrize("terms", [{"time_constant": [60.0, 900.0]}, {"amplitude": [], "time_constant": []}])
def test_a_warm_up_needs_an_amplitude_for_each_time_constant(terms: dict):
    with pytest.raises(ValueError, match="every amplitude has a time constant"):
        BiasWarmup(**terms)


@pytest.fixture(scope="module")
def fitted() -> tuple[Campaign, Estimate]:
    """A fit with every kind of parameter and unit: counts, mbar, a breakpoint, and one held."""
    rng = np.random.default_rng(7)
    time = np.arange(256) * 20.0
    columns = {
        "time": time,
        "rate": np.repeat(rng.permutation(np.linspace(-50.0, 40.0, 32)), 8),
        "temperature": 68 + 27 * np.sin(time / 700),
        "pressure": 1000 + rng.standard_normal(256),
    }
    kelvin = (columns["temperature"] - 32) / 1.8
    bias = 5 + 0.2 * (kelvin - 20) + 0.3 * np.maximum(kelvin - 25, 0) + 0.1 * (columns["pressure"] - 1000)
    columns["output"] = 20 * (columns["rate"] * 3600 + bias) * (1 + 1e-5 * (columns["rate"] / 50) ** 2)
    columns["output"] += 0.5 * rng.standard_normal(256)
    units = {"time": "s", "rate": "deg/s", "temperature": "degF", "pressure": "mbar", "output": "count"}
    measured = Campaign(columns, units, {"kind": "rate"})
    curve = BiasTemperatureCurve(coefficients=jnp.zeros(1), hinges=jnp.zeros(1), breakpoints=jnp.asarray([24.0]))
    labels = ["scale_factor", "bias", "bias_pressure", "bias_temperature_case", "scale_nonlinearity"]
    measured = measured.with_column("temperature_case", 60 + rng.standard_normal(256), "degF")
    model = GyroModel((*(make_effect(n) for n in labels), curve), gyro="fog")
    return measured, fit(measured, model)


def test_a_fitted_model_reads_back_and_predicts_the_same(fitted: tuple[Campaign, Estimate], tmp_path: Path):
    measured, estimate = fitted
    write_model(estimate, tmp_path / "fitted.yaml")
    again = read_model(tmp_path / "fitted.yaml")
    assert [_bytes(getattr(e, f)) for e in again.effects for f in e.declared()] == [
        _bytes(getattr(e, f)) for e in estimate.model.effects for f in e.declared()
    ]
    assert {k: float(v) for k, v in again.noise.items()} == {k: float(v) for k, v in estimate.model.noise.items()}
    signals = read_signals(measured).signals
    assert np.array_equal(again.predict(signals), estimate.model.predict(signals))
    refitted = fit(measured, again)
    assert refitted.model.vector() == pytest.approx(np.asarray(estimate.model.vector()), rel=1e-6)


def test_a_fitted_model_carries_its_pedigree(fitted: tuple[Campaign, Estimate], tmp_path: Path):
    measured, estimate = fitted
    write_model(estimate, tmp_path / "fitted.yaml")
    document = yaml.safe_load((tmp_path / "fitted.yaml").read_text(encoding="utf-8"))
    rows = {(r.effect, r.name): r for r in estimate.table()}
    for effect, name in (("scale_factor", "value"), ("bias", "value"), ("bias_pressure", "coefficient")):
        entry = next(e for e in document["effects"] if e["effect"] == effect)[name]
        row = rows[(effect, name)]
        for shown, number in ((entry["value"], row.value), (entry["std"], row.std)):
            figure, unit = shown.split(" ")
            assert float(figure) == pytest.approx(number, rel=1e-14)
            assert unit == row.unit
    assert rows[("bias_pressure", "coefficient")].unit == "deg/h/(mbar)"
    record = document["fit"]
    assert record["degrees_of_freedom"] == estimate.degrees_of_freedom
    assert np.array(record["covariance"]["matrix"]) == pytest.approx(estimate.covariance, rel=1e-15)
    assert len(record["covariance"]["parameters"]) == len(estimate.covariance)
    assert record["data_hash"] == measured.digest()
    assert record["validity"]["rate"] == ["-50 deg/s", "40 deg/s"]
    low, high = (float(v.split()[0]) for v in record["validity"]["temperature"])
    assert (low, high) == (pytest.approx(5.0, abs=0.2), pytest.approx(35.0, abs=0.2))
    assert document["software"] == f"gyromodel {__version__}"


def test_a_write_that_fails_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    path = tmp_path / "new" / "model.yaml"
    write_model(model_from_effects(["bias"]), path)
    before = path.read_bytes()

    def broken(*args, **kwargs):
        raise OSError("disk full")

    monkeypatch.setattr("os.replace", broken)
    with pytest.raises(OSError, match="disk full"):
        write_model(model_from_effects(["bias_drift"]), path)
    assert path.read_bytes() == before
    assert list(path.parent.iterdir()) == [path]


def test_a_link_stays_one(tmp_path: Path):
    (tmp_path / "kept").mkdir()
    (tmp_path / "model.yaml").symlink_to("kept/model.yaml")
    write_model(model_from_effects(["bias"]), tmp_path / "model.yaml")
    assert (tmp_path / "model.yaml").is_symlink()
    assert read_model(tmp_path / "kept" / "model.yaml").labels == ("bias",)


def entry(text: str) -> str:
    return f"gyro: fog\neffects:\n  - effect: bias\n  - {text}\n"


BAD = [
    ("", 1, "empty"),
    ("# nothing\n", 1, "empty"),
    ("gyro: fog\n", 1, "lists no effects"),
    ("- effect: bias\n", 1, "a model as key: value pairs"),
    ("effects: bias\n", 1, "effects as a list"),
    ("gyro: fog\neffects: []\ncolour: red\n", 3, "unknown key 'colour'"),
    ("gyro: fog\ngyro: rlg\neffects: []\n", 2, "'gyro' appears twice"),
    ("gyro: [fog]\neffects: []\n", 1, "one value"),
    ("? [a, b]\n: c\n", 1, "one value"),
    ("effects:\n  - ? {a: b}\n    : c\n", 2, "needs an effect"),
    ("effects:\n  - bias\n", 2, "needs an effect"),
    ("effects:\n  - value: 3 deg/h\n", 2, "needs an effect"),
    ("gyro: fog\neffects: [\n", 3, "not valid YAML"),
    ("a: b\n---\nc: d\n", 2, "not valid YAML"),
    ("effects: &a\n  - *b\n", 2, "not valid YAML"),
    ("gyro: fog\neffects:\n\t- effect: bias\n", 3, "not valid YAML"),
    ("gyro: fog\nname: \x07\n", 2, "not allowed"),
    (b"gyro: fog\nname: \xff\n", 2, "UTF-8"),
    ('gyro: "\\UFFFFFFFF"\n', 1, "not valid YAML"),
    ("[" * 5000, 1, "not valid YAML"),
    (entry("effect: magic"), 4, "unknown effect magic"),
    (entry("effect: bias_"), 4, "unknown effect bias_"),
    (entry("effect: [bias]"), 4, "one value"),
    (entry("effect: bias"), 3, "bias twice"),
    (entry("{effect: bias_drift, colour: red}"), 4, "unknown key 'colour' in bias_drift; known are"),
    (entry("{effect: bias_drift, value: 3}"), 4, "'3' is without unit: deg/h/h"),
    (entry("{effect: bias_drift, value: 3 deg/h}"), 4, "'3 deg/h' is not in deg/h/h"),
    (entry("{effect: bias_drift, value: 3 furlong}"), 4, "unknown unit 'furlong'"),
    (entry("{effect: bias_drift, value: fast}"), 4, "is no quantity"),
    (entry("{effect: bias_drift, value: }"), 4, "is no quantity"),
    (entry("{effect: bias_drift, value: nan deg/h/h}"), 4, "is no quantity"),
    (entry("{effect: bias_drift, value: 1e999 deg/h/h}"), 4, "is no quantity"),
    (entry("{effect: bias_drift, value: 1e308 turn/s/s}"), 4, "too large"),
    (entry("{effect: bias_drift, value: [3 deg/h/h]}"), 4, "one value"),
    (entry("{effect: bias_drift, value: {std: 3 deg/h/h}}"), 4, "slope has no value"),
    (entry("{effect: bias_drift, value: {value: 3, unit: deg/h/h}}"), 4, "unknown key 'unit'"),
    (entry("{effect: bias_drift, value: 3 deg/h/h, std: 1 deg/h/h}"), 4, "unknown key 'std' in bias_drift"),
    (entry("{effect: bias_drift, value: {value: {value: 3 deg/h/h}}}"), 4, "one value"),
    (entry("{effect: bias_drift, value: 3 deg/h/h, slope: 4 deg/h/h}"), 4, "value and slope are the same"),
    (entry("{effect: bias_warmup, value: 3}"), 4, "several parameters; name them: amplitude, time_constant"),
    (entry("{effect: bias_drift, fixed: maybe}"), 4, "fixed is true, false or a list"),
    (entry("{effect: bias_drift, fixed: [pace]}"), 4, "fixed is true, false or a list"),
    (entry("{effect: scale_factor, fixed: true}"), 4, "scale_factor is fixed but has no value"),
    (entry("{effect: table_tilt, north: 1 deg/h, fixed: [east]}"), 4, "table_tilt has no east that could be fixed"),
    (entry("{effect: scale_factor, value: 0 count/deg}"), 4, "cannot be zero"),
    (entry("{effect: scale_factor, value: 3 K}"), 4, "'3 K' is not in count/deg or count/(deg/s) or"),
    (entry("{effect: scale_factor, value: 3 count}"), 4, "not in count/deg or count/(deg/s) or"),
    (entry("{effect: bias_temperature, reference: 20}"), 4, "'20' is without unit: degC"),
    (entry("{effect: bias_temperature, reference: 20 V}"), 4, "'20 V' is not in degC"),
    (entry("{effect: bias_temperature, reference: [20 degC]}"), 4, "one value"),
    (entry("{effect: bias_temperature_curve, coefficients: []}"), 4, "bias_temperature_curve: "),
    (entry("{effect: bias_temperature_curve, hinges: [3 deg/h/degC]}"), 4, "bias_temperature_curve: "),
    (entry("{effect: bias_temperature_curve, breakpoints: [3]}"), 4, "'3' is without unit: degC"),
    (entry("{effect: scale_nonlinearity, powers: [2, x]}"), 4, "whole numbers"),
    (entry("{effect: scale_nonlinearity, powers: 2}"), 4, "powers as a list"),
    (entry("{effect: scale_nonlinearity, powers: [1]}"), 4, "scale_nonlinearity: "),
    (entry("{effect: scale_nonlinearity, powers: [2, 3], coefficients: [3 ppm]}"), 4, "scale_nonlinearity: "),
    (entry("{effect: scale_spline, knots: 2}"), 4, "scale_spline: "),
    (entry("{effect: scale_spline, knots: 1000000000}"), 4, "whole numbers below 1000"),
    (entry("{effect: scale_spline, knots: 6.5}"), 4, "whole numbers"),
    (entry("{effect: scale_spline, knots: 5, moved: [60, 0, 0]}"), 4, "less than 50 hundredths"),
    ("effects:\n  - {effect: bias_step, fixed: true}\n  - effect: bias_step\n", 3, "of several bias_step all have"),
    ("effects: []\nnoise: loud\n", 2, "noise is"),
    ("effects: []\nnoise: []\n", 2, "needs a noise_white above zero"),
    ("effects: []\nnoise:\n  - {effect: noise_flicker, value: 1 deg/h}\n", 3, "needs a noise_white above zero"),
    ("effects: []\nnoise:\n  - {effect: noise_white, value: 0 deg/sqrt(h)}\n", 3, "needs a noise_white above zero"),
    ("effects: []\nnoise:\n  - {effect: noise_pink, value: 1 deg/h}\n", 3, "unknown noise noise_pink"),
    ("effects: []\nnoise:\n  - {effect: noise_white}\n", 3, "needs an effect: id and a value"),
    ("effects: []\nnoise:\n  - {effect: noise_white, value: -1 deg/sqrt(h)}\n", 3, "cannot be negative"),
    ("effects: []\nnoise:\n  - {effect: noise_white, value: 1 deg/h}\n", 3, "not in deg/sqrt(h)"),
    ("effects: []\nnoise: {effect: noise_white, value: 1 deg/h}\n", 2, "noise as a list"),
    (noise("{effect: noise_markov, value: 1 deg/h/sqrt(h)}"), 3, "needs a time_constant above zero"),
    (noise("{effect: noise_flicker, value: 1 deg/h, time_constant: 3 s}"), 4, "noise_flicker has no time_constant"),
    (
        noise("{effect: noise_markov, value: 1 deg/h/sqrt(h), time_constant: 3 s}")
        + "  - {effect: noise_flicker, value: 1 deg/h}\n",
        3,
        "cannot stand side by side",
    ),
    (
        "effects: []\nnoise:\n  - {effect: noise_white, value: 1 deg/sqrt(h)}\n"
        "  - {effect: noise_white, value: 1 deg/sqrt(h)}\n",
        4,
        "noise_white appears twice",
    ),
]


@pytest.mark.parametrize(("text", "line", "message"), BAD)
def test_mistakes_are_named_with_their_line(text: str | bytes, line: int, message: str, tmp_path: Path):
    with pytest.raises(ModelError) as caught:
        read(tmp_path, text)
    assert str(caught.value).startswith(f"model.yaml, line {line}: ")
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_file_that_cannot_be_opened_is_named(tmp_path: Path):
    with pytest.raises(ModelError, match=r"missing\.yaml: no such file"):
        read_model(tmp_path / "missing.yaml")
    with pytest.raises(ModelError, match="cannot be read"):
        read_model(tmp_path)


@settings(SHARED_FOLDER, max_examples=300)
@given(st.sampled_from([CONTRACT, FULL]), MUTANTS)
def test_a_damaged_file_is_read_or_refused(tmp_path: Path, text: str, changes: list[tuple[str, int, int, bytes]]):
    complaint = ""
    try:
        model = read(tmp_path, mutated(text.encode(), changes))
        write_model(model, tmp_path / "again.yaml")
        assert contents(read_model(tmp_path / "again.yaml")) == contents(model)
    except ModelError as problem:
        complaint = str(problem)
    assert not complaint or re.fullmatch(r"model\.yaml, line \d+: .+", complaint)


FIT = """\
effects:
  - effect: bias
    value: 3 deg/h
fit:
  degrees_of_freedom: 7
  validity: {temperature: [10 degC, 50 degC], rate: [-20 deg/s, 20 deg/s]}
  data_hash: abc
  covariance:
    parameters: ["bias.value[0]"]
    unit: internal
    matrix: [[4.0e-12]]
"""


def test_a_calibration_is_a_model_with_what_its_fit_left(tmp_path: Path):
    (tmp_path / "model.yaml").write_text(FIT, encoding="utf-8")
    calibration = read_calibration(tmp_path / "model.yaml")
    assert calibration.std == pytest.approx([2e-6])
    assert (calibration.degrees_of_freedom, calibration.data_hash) == (7, "abc")
    assert calibration.validity["temperature"] == (10.0, 50.0)
    assert calibration.validity["rate"] == pytest.approx((-np.deg2rad(20), np.deg2rad(20)))
    assert contents(calibration.model) == contents(read_model(tmp_path / "model.yaml"))


def test_a_calibration_outlives_its_file(tmp_path: Path, rng: np.random.Generator):
    rate, pressure = rng.uniform(-10, 10, 60), rng.uniform(900, 1100, 60)
    columns = {"time": np.arange(60.0), "rate": rate, "pressure": pressure, "temperature": 20 + rng.random(60)}
    columns["output"] = 1000 * (rate + 1e-4 * pressure) + rng.standard_normal(60)
    units = {"time": "s", "rate": "deg/s", "pressure": "mbar", "temperature": "degC", "output": "count/s"}
    model = GyroModel((ScaleFactor(), Bias(), BiasColumn(column="pressure")), {"noise_white": jnp.asarray(1e-3)})
    estimate = fit(Campaign(columns, units, {"kind": "rate"}), model)
    write_model(estimate, tmp_path / "fitted.yaml")
    direct, again = estimate.calibration(), read_calibration(tmp_path / "fitted.yaml")
    assert contents(again.model)[:3] == contents(direct.model)[:3]
    assert np.array_equal(again.covariance, estimate.covariance)
    assert again.table() == direct.table() == estimate.table()
    assert (again.degrees_of_freedom, again.data_hash) == (direct.degrees_of_freedom, direct.data_hash)
    assert set(again.validity) == {"rate", "temperature"}
    for name, ends in direct.validity.items():
        assert again.validity[name] == pytest.approx(ends, rel=1e-9)


def test_a_calibration_without_a_fit_has_no_covariance(tmp_path: Path):
    (tmp_path / "model.yaml").write_text(FIT.partition("fit:")[0], encoding="utf-8")
    calibration = read_calibration(tmp_path / "model.yaml")
    assert calibration.covariance is None
    assert np.isnan(calibration.std).all()
    assert not calibration.validity


@pytest.mark.parametrize(
    ("found", "put", "line", "message"),
    [
        ("  data_hash: abc\n", "", 5, "fit lacks data_hash"),
        ("    unit: internal\n", "", 9, "a covariance lacks unit"),
        ("[[4.0e-12]]", "[[4.0e-12, 0]]", 11, "1 rows of as many numbers"),
        ("[[4.0e-12]]", "[[-4.0e-12]]", 11, "a covariance is finite and symmetric"),
        (": 7", ": -3.7", 5, "a whole number, not below zero"),
        ("[[4.0e-12]]", "[4.0e-12]", 11, "a row of the matrix as a list"),
        ("[[4.0e-12]]", "[[much]]", 11, "is no quantity"),
        ("[[4.0e-12]]", "[[4 deg]]", 11, "not in a plain number"),
        ("bias.value[0]", "bias.size[0]", 9, "not that of the model's free parameters"),
        (
            "    value: 3 deg/h\n",
            "    value: 3 deg/h\n    fixed: true\n",
            10,
            "not that of the model's free parameters",
        ),
        ("[10 degC, 50 degC]", "[50 degC, 10 degC]", 6, "its lowest and its highest"),
        ("[10 degC, 50 degC]", "[10 degC]", 6, "its lowest and its highest"),
        ("temperature:", "pressure:", 6, "unknown key 'pressure' in validity"),
        ("7", "seven", 5, "is no quantity"),
    ],
)
def test_mistakes_in_a_fit_are_named_with_their_line(found: str, put: str, line: int, message: str, tmp_path: Path):
    assert found in FIT
    (tmp_path / "model.yaml").write_text(FIT.replace(found, put), encoding="utf-8")
    with pytest.raises(ModelError) as caught:
        read_calibration(tmp_path / "model.yaml")
    assert str(caught.value).startswith(f"model.yaml, line {line}: ")
    assert message in str(caught.value)


def test_one_value_stands_for_a_list_of_one(tmp_path: Path):
    effect = read(tmp_path, entry("{effect: bias_temperature_curve, coefficients: 3 deg/h}")).effects[1]
    assert np.asarray(effect.coefficients) == pytest.approx([3 * DEG_H])  # type: ignore[attr-defined]


def test_absolute_zero_and_fahrenheit_references(tmp_path: Path):
    effect = read(tmp_path, entry("{effect: bias_temperature, value: 1 deg/h/degF, reference: 212 degF}")).effects[1]
    assert isinstance(effect, BiasTemperature)
    assert float(effect.reference) == pytest.approx(100.0)
    assert float(effect.coefficient) == pytest.approx(1.8 * DEG_H)


def test_differences_of_temperature_are_none_from_absolute_zero(tmp_path: Path):
    text = "{effect: thermometer_error, bias: [3 deg/h/degC], error: 0.1 K, reference: 298.15 K, resistance: 10 kohm}"
    error = read(tmp_path, entry(text)).effects[1]
    assert float(error.error) == pytest.approx(0.1)
    assert float(error.reference) == pytest.approx(25.0)
    hysteresis = read(tmp_path, entry("{effect: bias_thermal_hysteresis, half_width: 3.6 degF}")).effects[1]
    assert float(hysteresis.half_width) == pytest.approx(2.0)
    hinge = "{effect: bias_temperature_curve, hinges: [1 deg/h/K], breakpoints: [300 K]}"
    assert float(read(tmp_path, entry(hinge)).effects[1].breakpoints[0]) == pytest.approx(26.85)


def test_a_line_beside_the_curve_that_holds_it_is_left_to_the_curve(tmp_path: Path) -> None:
    path = tmp_path / "model.yaml"
    path.write_text("effects: [{effect: bias}, {effect: bias_temperature}, {effect: bias_temperature_curve}]")
    assert read_model(path).labels == ("bias", "bias_temperature_curve")
    known = "{effect: bias_temperature, value: 3 deg/h/degC, fixed: true}"
    path.write_text(f"effects: [{known}, {{effect: bias_temperature_curve}}]")
    assert read_model(path).labels == ("bias_temperature", "bias_temperature_curve")


@pytest.mark.parametrize(
    ("text", "name", "value"),
    [
        ("{effect: bias_warmup, value: 3 deg/h}", "amplitude", 3 * np.pi / 180 / 3600),
        ("{effect: bias_warmup, value: 20 min, amplitude: 1 deg/h}", "time_constant", 1200.0),
        ("{effect: time_delay, value: 5 ms}", "delay", 0.005),
        ("{effect: time_delay, value: {value: 5 ms, std: 1 ms}}", "delay", 0.005),
        ("{effect: bias_temperature_rate, value: 3600 deg/h/(degC/s)}", "coefficient", np.pi / 180),
    ],
)
def test_a_plain_value_is_of_the_parameter_that_its_unit_suits(tmp_path: Path, text: str, name: str, value: float):
    [effect] = read(tmp_path, f"effects: [{text}]").effects
    assert np.ravel(getattr(effect, name)) == pytest.approx([value])
