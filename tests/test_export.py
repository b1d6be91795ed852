"""Exported calibrations: the C file, compiled without a warning, against `compensate` on random campaigns for every
effect of the catalogue; JSON and CSV against the model computed again from their numbers alone."""

from __future__ import annotations

import csv
import io
import json
import re
import subprocess
from dataclasses import replace
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from gyromodel._checks import usual_unit
from gyromodel.campaign import Campaign
from gyromodel.compensation import compensate
from gyromodel.effects import CATALOGUE, Effect, Signals
from gyromodel.effects.drivers import Bias, BiasColumn, BiasStep
from gyromodel.effects.memory import BiasThermalHysteresis
from gyromodel.effects.power_cycles import BiasTurnOn
from gyromodel.effects.scale import ScaleFactor, ScaleNonlinearity, ScaleSagnacSine, ScaleSpline
from gyromodel.effects.thermal import BiasTemperature, BiasTemperatureCurve, BiasTemperatureRate
from gyromodel.estimate import Calibration, fit
from gyromodel.export import export_calibration
from gyromodel.model import GyroModel, ModelError, effect_class, make_effect
from gyromodel.signals import read_signals
from gyromodel.simulation import simulate
from gyromodel.units import factor, internal_unit
from tests.test_c_code import CC, STRICT

ROWS = 150
REMEMBERING = sorted(name for name, kind in CATALOGUE.items() if kind.remembers is True)
PLATFORM = sorted(name for name, kind in CATALOGUE.items() if kind.domain == "platform")
LABELS = [*sorted(set(CATALOGUE) - {"bias_column", "scale_factor", *REMEMBERING, *PLATFORM}), "bias_supply_voltage"]
# Biases that depend on no rate add up, and are compiled several together.
BIASES = [n for n in LABELS if n != "bias" and effect_class(n).site == "rate" and "rate" not in effect_class(n).needs]
REST = [n for n in LABELS if n not in (*BIASES, "bias")]
needs_compiler = pytest.mark.skipif(CC is None, reason="no C compiler on this machine")
SCALE = ScaleFactor(value=jnp.asarray(1500.0), unit="count/rad")


def campaign(rng: np.random.Generator, *wanted: str) -> Campaign:
    """Counts, with whatever columns effects need."""
    columns = {"time": np.arange(ROWS) * 20.0, "output": 1500 * rng.uniform(-1.2, 1.2, ROWS)}
    units = {"time": "s", "output": "count/s"}
    columns["temperature"], units["temperature"] = 25 + 15 * np.sin(columns["time"] / 300), "degC"
    # Of columns that serve alike, the first.
    names = {name.partition(" or ")[0].replace("<place>", "coil").replace("<axis>", "x") for name in wanted}
    for name in names - {"time", "rate", "temperature"}:
        columns[name], units[name] = rng.uniform(0.5, 1.5, ROWS), usual_unit(name)
    if "run" in names:
        columns["run"] = np.arange(ROWS) // 50
    return Campaign(columns, units, {"kind": "rate", "time_since_power_on": 40.0})


def filled(label: str, record_signals: Signals, rng: np.random.Generator) -> Effect:
    """The effect at random values below its typical sizes."""
    effect = make_effect(label)
    if label.endswith("_curve") or label == "temperature_lag":
        effect = type(effect)(coefficients=np.zeros(3), hinges=np.zeros(2), breakpoints=np.array([20.0, 33.0]))  # type: ignore[call-arg]
    effect = effect.prepared(record_signals)
    values = {}
    for name, declared in effect.declared().items():
        # Bands of a dithered lock-in that overlap, as at random values, leave no rate to an output.
        if (
            name not in ("breakpoints", "time_constant", "share", "runs", "limit", "period")
            and label != "lock_in_dithered"
        ):
            # 0.8 s/rad: the sine of a Sagnac phase reaches all outputs of the campaign.
            size = declared.typical * factor(declared.unit, internal_unit(declared.unit)) if declared.linear else 0.8
            values[name] = size * jnp.asarray(rng.uniform(0.3, 1.0, np.shape(getattr(effect, name))))
    return replace(effect, **values)


def run(source: str, folder: Path, rows: dict[str, np.ndarray]) -> np.ndarray:
    """Rates that a C program with this header gives for rows of samples, by member of its struct."""
    members = re.findall(r"^    double (\w+);", source.partition("typedef struct {")[2].partition("}")[0], re.M)
    (folder / "gyromodel_compensate.h").write_text(source, encoding="utf-8")
    form, places = json.dumps("%lf" * len(members)), ", ".join(f"&s.{m}" for m in members)
    program = [
        '#include "gyromodel_compensate.h"',
        '#include "gyromodel_compensate.h"',
        "#include <stdio.h>",
        "int main(void) {",
        "    gyromodel_sample s;",
        "    if (gyromodel_self_test()) return 1;",
        f"    while (scanf({form}, {places}) == {len(members)})",
        '        printf("%.17g\\n", gyromodel_rate(&s));',
        "    return 0;",
        "}",
    ]
    (folder / "main.c").write_text("\n".join(program), encoding="utf-8")
    command = [str(CC), *STRICT, "-O1", "-o", str(folder / "main"), str(folder / "main.c"), "-lm"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    text = "\n".join(" ".join(repr(float(rows[m][i])) for m in members) for i in range(len(rows[members[0]])))
    printed = subprocess.run([str(folder / "main")], input=text, capture_output=True, text=True, check=True).stdout
    return np.array([float(line) for line in printed.split()])


def members_of(measured: Campaign) -> dict[str, np.ndarray]:
    """Values by the names that the C file gives them."""
    record = read_signals(measured)
    values = {name: np.asarray(v)[: record.rows] for name, v in record.signals.items()}
    named = {
        "output_count_per_s": values["output"], "time_s": values["time"], "time_on_s": values["time_on"],
        "temperature_degC": values["temperature"],
    }  # fmt: skip
    named |= {f"{name}_degC_per_s": v for name, v in values.items() if name.endswith("_rate")}
    for name in measured.covariates:
        unit = internal_unit(measured.units[name]).replace("/", "_per_").replace("^", "_")
        named[f"{name}_{unit or 'number'}"] = values[name]
    return named


@needs_compiler
@pytest.mark.parametrize("labels", [*(BIASES[i::5] for i in range(5)), *([name] for name in REST)], ids=" ".join)
def test_c_gives_the_rates_of_compensate(labels: list[str], tmp_path: Path, rng: np.random.Generator):
    measured = campaign(rng, *(name for label in labels for name in make_effect(label).columns_needed))
    signals = read_signals(measured).signals | {"rate": jnp.asarray(rng.uniform(-1.2, 1.2, 192))}
    model = GyroModel((SCALE, Bias(value=jnp.asarray(0.1)), *(filled(label, signals, rng) for label in labels)))
    calibration = Calibration(model)
    expected = compensate(measured, calibration).si("rate_estimated")
    assert np.isfinite(expected).mean() > 0.9
    found = run(export_calibration(calibration, "c"), tmp_path, members_of(measured))
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-12)


def full_model() -> GyroModel:
    """Effects that take settings, arrays, a repeated label and columns that C cannot name."""
    return GyroModel(
        (
            replace(SCALE, value=jnp.asarray(-1500.0)),
            Bias(value=jnp.asarray(0.02)),
            BiasTemperature(coefficient=jnp.asarray(1e-4), reference=jnp.asarray(20.0)),
            BiasTemperatureRate(coefficient=jnp.asarray(0.3)),
            ScaleNonlinearity(coefficients=jnp.asarray([0.01, -0.02]), powers=(2, 3), full_rate=jnp.asarray(1.5)),
            ScaleSagnacSine(kappa=jnp.asarray(0.4)),
            BiasStep(size=jnp.asarray(0.01), epoch=jnp.asarray(1000.0)),
            BiasStep(size=jnp.asarray(-0.03), epoch=jnp.asarray(2000.0)),
            BiasColumn(
                coefficient=jnp.asarray(1e-2), column="2nd lamp µ", unit="deg/h/(mV)", reference=jnp.asarray(0.5)
            ),
        ),
        {"noise_white": jnp.asarray(1e-4)},
        frozenset({("bias_temperature", "coefficient")}),
        "fog */ /*",
    )


@needs_compiler
def test_a_whole_model_in_c(tmp_path: Path, rng: np.random.Generator):
    measured = campaign(rng).with_column("2nd lamp µ", rng.uniform(100, 900, ROWS), "mV")
    output = measured.columns["output"].copy()
    output[:4] = np.nan, 1e9, -1e9, 0.0
    measured = measured.with_column("output", output, "count/s")
    calibration = Calibration(full_model(), validity={"rate": (-1.0, 1.0)}, data_hash="abc")
    source = export_calibration(calibration, "c")
    rows = members_of(measured) | {"column_2nd_lamp_V": measured.si("2nd lamp µ")}
    expected = compensate(measured, calibration).si("rate_estimated")
    assert np.isnan(expected[:3]).all()
    np.testing.assert_allclose(run(source, tmp_path, rows), expected, rtol=1e-12, atol=1e-12)
    assert "const double bias_step_2_epoch = 2000.0; /* 2000 s */" in source
    assert "Calibrated from -57.2958 to 57.2958 deg/s of rate." in source
    assert "abc" in source


def test_members_are_what_the_model_reads():
    source = export_calibration(Calibration(GyroModel((SCALE, Bias(value=jnp.asarray(1.0))))), "c")
    assert re.findall(r"^    double (\w+);.*\n", source.partition("}")[0], re.M) == ["output_count_per_s"]


class Remembering(BiasColumn):
    """A bias that accumulates, as hysteresis does."""

    def columns(self, signals):
        return jnp.cumsum(signals[self.column])[:, None]


class Differencing(BiasColumn):
    """A bias of the change from the sample before."""

    def columns(self, signals):
        return jnp.diff(signals[self.column], prepend=0.0)[:, None]


@pytest.mark.parametrize(
    ("kind", "reason"), [(Remembering, "no short form of cumsum"), (Differencing, "other samples")]
)
def test_effects_with_memory_are_refused(kind: type[BiasColumn], reason: str):
    effect = kind(coefficient=jnp.asarray(1.0), column="pressure", reference=jnp.asarray(0.0))
    with pytest.raises(ModelError, match=f"bias_pressure cannot be exported to C.*{reason}"):
        export_calibration(Calibration(GyroModel((effect,))), "c")


@pytest.mark.parametrize("label", REMEMBERING)
def test_effects_of_neighbouring_samples_are_refused(label: str):
    effect = make_effect(label)
    with pytest.raises(ModelError, match=f"{label} cannot be exported to C: it looks at other samples"):
        export_calibration(Calibration(GyroModel((effect,))), "c")


def test_a_shupe_effect_with_a_lag_is_refused():
    lagging = GyroModel((BiasTemperatureRate(lag=(60.0,)),))
    with pytest.raises(ModelError, match="bias_temperature_rate cannot be exported to C: it looks at other samples"):
        export_calibration(Calibration(lagging), "c")


def test_columns_that_c_cannot_tell_apart_are_refused():
    effects = (BiasColumn(column=name, reference=jnp.asarray(0.0)) for name in ("lamp 1", "lamp.1"))
    with pytest.raises(ModelError, match="lamp_1_number in C"):
        export_calibration(Calibration(GyroModel(tuple(effects))), "c")


@pytest.fixture
def fitted(rng: np.random.Generator) -> Calibration:
    """A fit of scale factor, curved bias and spline over rate and temperature."""
    design = campaign(rng).with_column("rate", np.rad2deg(rng.uniform(-1.0, 1.3, ROWS)), "deg/s")
    curve = BiasTemperatureCurve(
        coefficients=jnp.asarray([2e-3, -1e-3]), hinges=jnp.asarray([5e-4]), breakpoints=jnp.asarray([33.0]),
        reference=jnp.asarray(25.0),
    )  # fmt: skip
    powers = ScaleNonlinearity(coefficients=jnp.asarray([0.01, -0.02]), powers=(2, 3), full_rate=jnp.asarray(1.3))
    model = GyroModel(
        (SCALE, curve, powers), {"noise_white": jnp.asarray(1e-3)}, frozenset({(curve.label, "breakpoints")})
    )
    return fit(simulate(model, design), model).calibration()


def test_json_holds_all_that_the_model_is(fitted: Calibration, rng: np.random.Generator):
    said = json.loads(export_calibration(fitted, "json"))
    rate, temperature = rng.uniform(-57, 74, 40), rng.uniform(10, 40, 40)
    scale, curve, powers = ({p["name"]: p["value"] for p in e["parameters"] + e["settings"]} for e in said["effects"])
    assert [p["unit"] for e in said["effects"] for p in e["parameters"]] == [
        "count/deg", "deg/h", "deg/h", "deg/h/degC", "degC", "ppm", "ppm",
    ]  # fmt: skip
    # The formula and the equations that the file states, in its units.
    u = (temperature - curve["reference"]) / 10
    bias = curve["coefficients[0]"] * u + curve["coefficients[1]"] * u**2
    bias = (bias + curve["hinges"] * np.maximum(temperature - curve["breakpoints"], 0)) / 3600
    x = rate / powers["full_rate"]
    error = 1e-6 * sum(powers[f"coefficients[{i}]"] * x ** (powers[f"powers[{i}]"] - 1) for i in range(2))
    output = scale["value"] * (rate + bias) * (1 + error)
    signals = {"rate": np.deg2rad(rate), "temperature": temperature, "time": np.zeros(40)}
    expected = fitted.model.predict({name: jnp.asarray(values) for name, values in signals.items()})
    np.testing.assert_allclose(output, expected, rtol=1e-12, atol=1e-9)
    assert said["formula"].startswith("output = ")
    assert said["degrees_of_freedom"] == ROWS - 6
    assert said["validity"]["temperature"]["unit"] == "degC"
    free = [p["std"] for e in said["effects"] for p in e["parameters"] if not p["fixed"]]
    assert np.sqrt(np.diag(said["covariance"]["matrix"])) == pytest.approx(free)
    assert said["covariance"]["units"] == ["count/deg", "deg/h", "deg/h", "deg/h/degC", "ppm", "ppm"]
    assert len(said["covariance"]["parameters"]) == 6


def test_two_numbers_of_one_name_in_c_are_refused():
    drivers = tuple(
        BiasColumn(column=name, unit=f"deg/h/{unit}", coefficient=jnp.asarray(1e-3), reference=jnp.asarray(0.0))
        for name, unit in (("coil a", "V"), ("coil_a", "Pa"))
    )
    with pytest.raises(ModelError, match="two numbers would be called bias_coil_a_coefficient in C"):
        export_calibration(Calibration(GyroModel((SCALE, *drivers))), "c")


def test_csv_has_a_row_for_each_number(fitted: Calibration):
    rows = list(csv.DictReader(io.StringIO(export_calibration(fitted, "csv"))))
    table = {(row.effect, row.name): row for row in fitted.table()}
    parameters = [row for row in rows if row["kind"] in ("parameter", "fixed")]
    assert len(parameters) == len(table)
    for row in parameters:
        expected = table[row["effect"], row["name"]]
        assert (float(row["value"]), float(row["std"]), row["unit"]) == expected[2:]
    assert {row["name"] for row in rows if row["kind"] == "setting"} == {
        "reference",
        "full_rate",
        "powers[0]",
        "powers[1]",
    }
    assert [row["name"] for row in rows if row["kind"] == "fixed"] == ["breakpoints"]
    noise = next(row for row in rows if row["kind"] == "noise")
    assert (noise["effect"], noise["unit"], noise["std"]) == ("noise_white", "deg/sqrt(h)", "")
    assert [row["name"] for row in rows if row["kind"] == "validity"] == ["lowest", "highest"] * 2


def test_a_model_that_was_not_fitted_has_no_uncertainty():
    calibration = Calibration(GyroModel((ScaleSpline(full_rate=jnp.asarray(1.0), lowest=jnp.asarray(-1.0)), SCALE)))
    said = json.loads(export_calibration(calibration, "json"))
    assert said["covariance"] is None
    assert {p["std"] for e in said["effects"] for p in e["parameters"]} == {None}
    rows = csv.DictReader(io.StringIO(export_calibration(calibration, "csv")))
    assert {row["std"] for row in rows} == {""}


def params(text: str) -> dict[str, float]:
    rows = [line.split("\t") for line in text.splitlines() if not line.startswith("#")]
    assert all(row[:2] == ["1", "1"] and row[4] == ("6" if row[2] == "TC_G_ENABLE" else "9") for row in rows)
    return {row[2]: float(row[3]) for row in rows}


def thermal(*more: Effect) -> Calibration:
    curve = BiasTemperatureCurve(
        coefficients=jnp.array([2e-5, -1e-6, 3e-8]),
        hinges=jnp.zeros(0),
        breakpoints=jnp.zeros(0),
        reference=jnp.asarray(30.0),
    )
    effects = (Bias(value=jnp.asarray(1e-3)), curve, *more)
    return Calibration(GyroModel(effects), validity={"temperature": (-10.0, 60.0)})


def px4_offset(values: dict[str, float], axis: int, temperature: np.ndarray) -> np.ndarray:
    """As the autopilot computes it: PX4-Autopilot, TemperatureCompensation.cpp."""
    delta = np.clip(temperature, values["TC_G0_TMIN"], values["TC_G0_TMAX"]) - values["TC_G0_TREF"]
    return sum(values[f"TC_G0_X{k}_{axis}"] * delta**k for k in range(4))


def test_px4_takes_off_the_offset_of_the_model():
    """A cubic of temperature is one again about another temperature."""
    values = params(export_calibration(thermal(), "px4", "y"))
    assert values["TC_G_ENABLE"] == 1
    assert (values["TC_G0_TREF"], values["TC_G0_TMIN"], values["TC_G0_TMAX"]) == (25.0, -10.0, 60.0)
    temperature = np.linspace(-10.0, 60.0, 50)
    t = (temperature - 30.0) / 10.0
    expected = 1e-3 + 2e-5 * t - 1e-6 * t**2 + 3e-8 * t**3
    assert px4_offset(values, 1, temperature) == pytest.approx(expected, abs=2e-10)
    assert not any(name.endswith("_0") for name in values)


def test_px4_of_a_bias_alone_holds_everywhere():
    text = export_calibration(Calibration(GyroModel((Bias(value=jnp.asarray(2e-3)),))), "px4", "z")
    values = params(text)
    assert values == {"TC_G_ENABLE": 1, "TC_G0_X0_2": pytest.approx(2e-3, rel=1e-7)} | {
        f"TC_G0_X{k}_2": 0.0 for k in (1, 2, 3)
    }


def test_px4_takes_a_scale_factor_that_is_known_to_be_one():
    text = export_calibration(Calibration(GyroModel((ScaleFactor(value=1.0, unit="1"), Bias(value=2e-3)))), "px4", "z")
    assert params(text)["TC_G0_X0_2"] == pytest.approx(2e-3, rel=1e-7)


@pytest.mark.parametrize(
    "more",
    [
        SCALE, BiasTemperatureRate(coefficient=jnp.asarray(1e-3)), ScaleNonlinearity(full_rate=jnp.ones(())),
        BiasStep(size=1e-3, epoch=5.0), BiasTurnOn(offsets=[5e-3], runs=[2.0]), BiasThermalHysteresis(),
    ],
)  # fmt: skip
def test_what_px4_has_no_parameter_for_is_refused(more: Effect):
    with pytest.raises(ModelError, match=f"PX4 has no parameter for (a gyro's )?{more.label}"):
        export_calibration(thermal(more), "px4", "x")


def test_px4_states_how_far_a_cubic_is_from_a_bend():
    bend = BiasTemperatureCurve(
        coefficients=jnp.zeros(3), hinges=jnp.array([1e-5]), breakpoints=jnp.array([25.0]), reference=jnp.asarray(25.0)
    )
    calibration = Calibration(GyroModel((bend,)), validity={"temperature": (-10.0, 60.0)})
    text = export_calibration(calibration, "px4", "x")
    said = np.deg2rad(float(re.search(r"single precision: (\S+) deg/s", text)[1]))
    temperature = np.linspace(-10.0, 60.0, 500)
    missed = px4_offset(params(text), 0, temperature) - 1e-5 * np.maximum(temperature - 25.0, 0.0)
    assert np.abs(missed).max() == pytest.approx(said, rel=0.1)


@needs_compiler
def test_the_self_test_fails_when_a_constant_is_wrong(tmp_path: Path):
    source = export_calibration(Calibration(GyroModel((SCALE, Bias(value=jnp.asarray(0.1))))), "c")
    wrong = source.replace("const double bias_value = 0.1", "const double bias_value = 0.1001")
    assert wrong != source
    rows = {"output_count_per_s": np.zeros(1)}
    assert run(source, tmp_path, rows) == pytest.approx([-0.1])
    with pytest.raises(subprocess.CalledProcessError):
        run(wrong, tmp_path, rows)


def test_rounding_is_stated_as_large_as_it_is():
    """Output 1500 (ω + 0.1) count: up to 1650 single precision rounds by 6e-5, fixed point below 2048 by 5e-7."""
    source = export_calibration(Calibration(GyroModel((SCALE, Bias(value=jnp.asarray(0.1))))), "c")
    single, fixed = (
        np.deg2rad(float(re.search(pattern, source)[1]))
        for pattern in (r"errors of (\S+) deg/s at most", r"binary point, of (\S+) deg/s")
    )
    assert 3e-8 < single < 1e-7
    assert 2e-10 < fixed < 8e-10
