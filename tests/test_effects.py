"""Every effect of the catalogue: its equation worked by hand, its derivatives by automatic differentiation, and what a
class declares. `linearise` is written out by hand in the package; `jacfwd` of `predict` is its oracle."""

from __future__ import annotations

import importlib.util
import re
import sys
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from gyromodel.declarations import NOISE, NoiseKind
from gyromodel.effects import CATALOGUE, Effect
from gyromodel.effects.drivers import Bias
from gyromodel.effects.scale import ScaleAsymmetry, ScaleFactor, ScaleNonlinearity, ScaleSpline
from gyromodel.effects.thermal import BiasTemperatureCurve
from gyromodel.model import GyroModel, make_effect, model_from_effects
from gyromodel.units import convertible, factor, internal_unit, parse, quantity

ROWS = 64
LABELS = [*sorted(n for n, kind in CATALOGUE.items() if kind.domain == "gyro" and n != "bias_column"), "bias_pressure"]
DEG_H = np.pi / 180 / 3600
G = 9.80665
BAND = 30 * 0.519147497289467


def signals_of(rng: np.random.Generator) -> dict[str, jax.Array]:
    """Columns with both signs of rate and a temperature that goes up and down."""
    time = np.arange(ROWS) * 20.0
    columns = {
        "time": time,
        "time_on": time + 30.0,
        "rate": rng.uniform(-1.5, 1.2, ROWS),
        "temperature": 20 + 15 * np.sin(time / 300) + rng.uniform(-1, 1, ROWS),
        "temperature_rate": 0.05 * np.cos(time / 300),
        "temperature_coil": 20 + 14 * np.sin(time / 300 - 0.2),
        "temperature_coil_rate": 0.045 * np.cos(time / 300 - 0.2),
        "thermistor_resistance": 1e4 * np.exp(-0.6 * np.sin(time / 300)),
        "feedback_ramp": np.floor(32768 * (0.021 * np.arange(ROWS) % 1.0)),
        "run": np.repeat([3.0, 1.0, 4.0], [20, 20, ROWS - 40]),
        "pressure": 1e5 + 100 * rng.standard_normal(ROWS),
        "acceleration_input": 9.8 * rng.uniform(-1, 1, ROWS),
        "acceleration_spin": 9.8 * rng.uniform(-1, 1, ROWS),
        "acceleration_output": 9.8 * rng.uniform(-1, 1, ROWS),
        "vibration": 96.0 * rng.uniform(0, 2, ROWS),
        "rate_spin": rng.uniform(-1.5, 1.2, ROWS),
        "rate_output": np.sin(time / 100),
        "azimuth": rng.uniform(0, 6, ROWS),
        "table_angle": rng.uniform(0, 60, ROWS),
        "torquer_current": 1e-2 * rng.uniform(-1, 1, ROWS),
        "backscatter": rng.uniform(0, 1, ROWS),
        "null_shift": rng.uniform(-1, 1, ROWS),
        "magnetic_field": 1e-4 * rng.uniform(-1, 1, ROWS),
        "output": rng.standard_normal(ROWS),
    }
    columns["rate"][:3] = 0.0
    return {name: jnp.asarray(values) for name, values in columns.items()}


def randomised(effect: Effect, signals: dict[str, jax.Array], rng: np.random.Generator) -> Effect:
    """Typical sizes with random factors; breakpoints inside and outside the range of temperatures met."""
    if isinstance(effect, BiasTemperatureCurve) or effect.id in ("scale_temperature_curve", "temperature_lag"):
        effect = type(effect)(coefficients=np.zeros(2), hinges=np.zeros(3), breakpoints=np.array([-60.0, 21.3, 90.0]))  # type: ignore[arg-type]
    effect = effect.prepared(signals)
    for name, declared in effect.declared().items():
        if name == "breakpoints":
            continue
        if name == "runs":
            continue
        size = (
            declared.typical * factor(declared.unit, internal_unit(declared.unit)) if declared.unit != "degC" else 1.0
        )
        old = getattr(effect, name)
        new = size * jnp.asarray(rng.uniform(0.5, 2.0, jnp.shape(old)))
        effect = eqx.tree_at(lambda e, name=name: getattr(e, name), effect, new)
    return effect


@pytest.mark.parametrize("label", LABELS)
def test_zero_amplitude_is_the_model_without_it(label: str, rng: np.random.Generator):
    signals = signals_of(rng)
    effect = randomised(make_effect(label), signals, rng)
    without = GyroModel((ScaleFactor(value=jnp.asarray(1.3)), Bias(value=jnp.asarray(1e-3))))  # type: ignore[arg-type]
    if effect.site == "gain":
        without = GyroModel((Bias(value=jnp.asarray(1e-3)),))
        absent = effect.with_linear(jnp.ones(1))
    else:
        absent = effect.with_linear(jnp.zeros(effect.linear().size))
    model = GyroModel((*without.effects, absent)) if label != "bias" else GyroModel((without.effects[0], absent))
    expected = without if label != "bias" else GyroModel(without.effects[:1])
    assert np.array_equal(model.predict(signals), expected.predict(signals))


@pytest.mark.parametrize("label", LABELS)
def test_linearise_is_the_derivative_of_predict(label: str, rng: np.random.Generator):
    signals = signals_of(rng)
    around = [make_effect(n) for n in ("scale_factor", "bias", "scale_temperature") if n != label]
    effects = tuple(randomised(e, signals, rng) for e in (*around, make_effect(label)))
    # Knots are those of another campaign: rates run beyond them on both sides.
    spread = {name: 0.4 * values if name == "rate" else values for name, values in signals.items()}
    if label in ("scale_spline", "scale_nonlinearity"):
        effects = (*effects[:-1], randomised(make_effect(label), spread, rng))
    model = GyroModel(effects)
    predicted, jacobian = model.linearise(signals)

    def of_vector(v):
        return model.with_vector(v).predict(signals)

    value, expected = (
        np.asarray(x) for x in jax.jit(lambda v: (of_vector(v), jax.jacfwd(of_vector)(v)))(model.vector())
    )
    assert np.asarray(predicted) == pytest.approx(value, rel=1e-12, abs=1e-14)
    size = np.abs(expected).max(axis=0)
    size[size == 0] = 1.0  # a hinge above every temperature, and its breakpoint
    assert (size != 1.0).sum() >= len(size) - 4
    assert np.asarray(jacobian) / size == pytest.approx(expected / size, abs=1e-12)


@pytest.mark.parametrize("label", sorted(set(LABELS) - {"scale_factor"}))
def test_columns_are_one_per_linear_coefficient(label: str, rng: np.random.Generator):
    signals = signals_of(rng)
    effect = randomised(make_effect(label), signals, rng)
    linear = effect.linear()
    columns = np.asarray(effect.columns(signals))
    assert columns.shape == (ROWS, linear.size)
    assert np.isfinite(columns).all()
    assert np.asarray(effect.contribution(signals)) == pytest.approx(columns @ np.asarray(linear), rel=1e-12)
    assert np.array_equal(effect.with_linear(linear).linear(), linear)
    for candidate in type(effect).candidates(signals) if label != "bias_pressure" else [effect]:
        assert np.isfinite(np.asarray(candidate.columns(signals))).all()
        if not candidate.held:
            assert np.all(candidate.linear() == 0) or label == "bias_pressure"


@pytest.mark.parametrize("label", LABELS)
def test_declarations_are_complete(label: str):
    effect = type(make_effect(label))
    equation = (effect.__doc__ or "").splitlines()[0]
    assert re.search(r"[=≡]", equation), "the docstring opens with the equation"
    for sentence in (effect.cause, effect.test):
        assert re.fullmatch(r"[A-Z].{15,}\.", sentence)
    assert effect.site in ("gain", "scale", "rate", "output", "readout")
    for name, declared in effect.declared().items():
        assert declared.meaning
        assert declared.typical > 0
        parse(declared.unit)
        assert convertible(declared.unit, internal_unit(declared.unit)), name
        assert factor(declared.unit, internal_unit(declared.unit)) > 0


@pytest.mark.parametrize("kind", NOISE.values(), ids=NOISE)
def test_kinds_of_noise_have_a_size_a_cause_and_a_test(kind: NoiseKind):
    for sentence in (kind.cause, kind.test):
        assert re.fullmatch(r"[A-Z].{15,}\.", sentence)
    if kind.typical is not None:
        assert kind.typical > 0
        parse(kind.unit)
    assert (kind.typical is None) == (kind.id == "outliers")


# Effect, its parameters and settings as written, signals, and the contribution expected: deg/h for the rate, ppm for
# scale.
BY_HAND = [
    ("bias", {"value": "3 deg/h"}, {}, [3.0, 3.0]),
    ("bias_drift", {"slope": "0.5 deg/h/h"}, {"time": [0.0, 7200.0]}, [0.0, 1.0]),
    ("bias_step", {"size": "2 deg/h", "epoch": "10 s"}, {"time": [9.0, 10.0, 11.0]}, [0.0, 2.0, 2.0]),
    (
        "bias_periodic",
        {"cosine": "3 deg/h", "sine": "4 deg/h", "frequency": "0.1 Hz"},
        {"time": [0.0, 2.5, 5.0, 10.0]},
        [3.0, 4.0, -3.0, 3.0],
    ),
    (
        "bias_warmup",
        {"amplitude": ["3 deg/h", "-1 deg/h"], "time_constant": ["10 min", "5 min"]},
        {"time_on": [0.0, 600.0]},
        [2.0, 3.0 * np.exp(-1) - np.exp(-2)],
    ),
    (
        "bias_temperature",
        {"coefficient": "2 deg/h/degC", "reference": "20 degC"},
        {"temperature": [20.0, 23.0]},
        [0.0, 6.0],
    ),
    (
        "bias_temperature_curve",
        {
            "coefficients": ["1 deg/h", "2 deg/h"],
            "hinges": ["3 deg/h/degC"],
            "breakpoints": ["30 degC"],
            "reference": "20 degC",
        },
        {"temperature": [20.0, 30.0, 40.0, 0.0]},
        [0.0, 3.0, 2 + 8 + 30, -2 + 8],
    ),
    (
        "bias_temperature_rate",
        {"coefficient": "1000 deg/h/(degC/s)"},
        {"temperature_rate": [0.01, -0.01]},
        [10.0, -10.0],
    ),
    (
        "bias_temperature_product",
        {"coefficient": "100 deg/h/(degC^2/s)", "reference": "20 degC"},
        {"temperature": [30.0, 15.0], "temperature_rate": [0.01, -0.02]},
        [10.0, 10.0],
    ),
    (
        "temperature_lag",
        {
            "coefficients": ["1 deg/h", "2 deg/h"],
            "hinges": ["3 deg/h/degC"],
            "breakpoints": ["30 degC"],
            "time_constant": "5 min",
            "reference": "20 degC",
        },
        # three degrees ahead: 30, 33 and 17 degC
        {"temperature": [27.0, 30.0, 20.0], "temperature_rate": [0.01, 0.01, -0.01]},
        [3.0, 1.3 + 2 * 1.69 + 9.0, -0.3 + 2 * 0.09],
    ),
    (
        # 273.15 K, 546.3 K and half of 273.15 K told; by 0.5/273.15 of 1/273.15 K less, right, and as much more.
        "thermometer_error",
        {
            "bias": ["2 deg/h/degC"],
            "scale": ["1e6 ppm/degC"],
            "error": "0.5 degC",
            "reference": "0 degC",
            "resistance": "1 kohm",
        },
        {
            "temperature": [0.0, 273.15, -273.15 / 2],
            "thermistor_resistance": [1e3 * np.e, 1e3, 1e3 / np.e],
            "rate": [0.0, 0.0, 10 * DEG_H],
        },
        [2 * 273.15 * (1 / (1 - 0.5 / 273.15) - 1), 2 * 273.15, 12 * 273.15 * (1 / (2 + 0.5 / 273.15) - 1)],
    ),
    (
        # Play of ±2: 21, 25, 22, 19 and 20 drag along 21, 23, 23, 21 and 21; a new campaign starts afresh.
        "bias_thermal_hysteresis",
        {"height": "4 deg/h", "half_width": "2 degC"},
        {"time": [0.0, 1, 2, 3, 4, 0, 1], "temperature": [21.0, 25, 22, 19, 20, 30, 29]},
        [0.0, 4.0, -2.0, -4.0, -2.0, 0.0, -2.0],
    ),
    (
        "rate_hysteresis",
        {"height": "3 deg/h", "half_width": "0.1 rad/s"},
        {"time": [0.0, 1, 2, 3], "rate": [0.5, 0.7, 0.65, 0.2]},
        [0.0, 3.0, 1.5, -3.0],
    ),
    (
        "bias_turn_on",
        {"offsets": ["2 deg/h", "-1 deg/h"], "runs": ["7", "4"]},
        {"run": [5.0, 4.0, 7.0, 7.0, 8.0]},
        [0.0, -1.0, 2.0, 2.0, 0.0],
    ),
    (
        "saturation",
        {"share": "1", "limit": "40 deg/h"},
        {"rate": [x * DEG_H for x in (-60.0, -40.0, 0.0, 39.0, 45.0)]},
        [20.0, 0.0, 0.0, 0.0, -5.0],
    ),
    (
        "saturation",
        {"share": "1", "limit": "40 deg/h", "lower": ["-50 deg/h"]},
        {"rate": [x * DEG_H for x in (-60.0, -40.0, 0.0, 39.0, 45.0)]},
        [10.0, 0.0, 0.0, 0.0, -5.0],
    ),
    (
        "bias_readout_code",
        {"cosine": ["3 deg/h", "1 deg/h"], "sine": ["4 deg/h", "2 deg/h"], "period": "80"},
        {"feedback_ramp": [0.0, 10.0, 20.0, 40.0, 80.0]},
        [4.0, 7 / np.sqrt(2) + 2.0, 4.0 - 1.0, -3.0 + 1.0, 4.0],
    ),
    ("scale_drift", {"slope": "20 ppm/h"}, {"time": [0.0, 1800.0, 7200.0]}, [0.0, 10.0, 40.0]),
    (
        "bias_temperature_gradient",
        {"coefficient": "2 deg/h/degC"},
        {"temperature": [20.0, 25.0], "temperature_coil": [20.0, 24.0]},
        [0.0, 2.0],
    ),
    (
        "bias_temperature_gradient_rate",
        {"coefficient": "1000 deg/h/(degC/s)"},
        {
            "temperature": [20.0, 20.0],
            "temperature_coil": [20.0, 20.0],
            "temperature_rate": [0.01, 0.01],
            "temperature_coil_rate": [0.0, 0.03],
        },
        [10.0, -20.0],
    ),
    (
        "bias_pressure",
        {"coefficient": "2 deg/h/mbar", "reference": "1000 mbar"},
        {"pressure": [1e5, 1.003e5]},
        [0.0, 6.0],
    ),
    ("bias_backscatter", {"coefficient": "2 deg/h/V", "reference": "1 V"}, {"backscatter": [1.0, 1.5]}, [0.0, 1.0]),
    ("bias_null_shift", {"coefficient": "2 deg/h/mA", "reference": "1 mA"}, {"null_shift": [1e-3, 4e-3]}, [0.0, 6.0]),
    (
        "torquer_scale",
        {
            "scale": ["1 deg/h/mA"],
            "asymmetry": ["2 deg/h/mA"],
            "temperature": ["0.1 deg/h/mA/degC"],
            "reference": "20 degC",
        },
        {"torquer_current": [0.0, 0.01, -0.01, 0.01], "temperature": [20.0, 20.0, 20.0, 30.0]},
        [0.0, 10.0 + 10.0, -10.0 + 10.0, 20.0 + 10.0],
    ),
    ("bias_acceleration_input", {"coefficient": "2 deg/h/g"}, {"acceleration_input": [G, -0.5 * G]}, [2.0, -1.0]),
    ("bias_acceleration_spin", {"coefficient": "2 deg/h/g"}, {"acceleration_spin": [G, -0.5 * G]}, [2.0, -1.0]),
    ("bias_acceleration_output", {"coefficient": "2 deg/h/g"}, {"acceleration_output": [G, -0.5 * G]}, [2.0, -1.0]),
    (
        "bias_acceleration_squared",
        {"coefficients": ["2 deg/h/g^2", "3 deg/h/g^2"]},
        {"acceleration_input": [G, -G, 0.5 * G], "acceleration_spin": [0.0, 2 * G, G]},
        [2.0, 2.0 - 6.0, 0.5 + 1.5],
    ),
    ("bias_vibration", {"coefficient": "2 deg/h/g^2"}, {"vibration": [0.0, 3 * G**2]}, [0.0, 6.0]),
    (
        "bias_anisoinertia",
        {"coefficient": "0.5 deg/h/(deg/s)^2"},
        {"rate": [np.deg2rad(10), np.deg2rad(-4)], "rate_spin": [np.deg2rad(2), np.deg2rad(5)]},
        [10.0, -10.0],
    ),
    (
        "misalignment",
        {"angles": ["3600 arcsec", "-3600 arcsec"]},
        {"rate_spin": [180 / np.pi * DEG_H, 0.0], "rate_output": [0.0, 360 / np.pi * DEG_H]},
        [1.0, -2.0],
    ),
    (
        "table_tilt",
        {"north": "3 deg/h", "east": "4 deg/h"},
        {"azimuth": [0.0, np.pi / 2, np.pi]},
        [3.0, 4.0, -3.0],
    ),
    (
        "table_harmonic",
        {"cosine": ["3 deg/h", "1 deg/h"], "sine": ["4 deg/h", "2 deg/h"]},
        {"table_angle": [0.0, np.pi / 2, np.pi / 4]},
        [3.0 + 1.0, 4.0 - 1.0, 3.5 * np.sqrt(2) + 2.0],
    ),
    (
        "bias_magnetic",
        {"coefficients": ["2 deg/h/gauss"], "cosine": ["3 deg/h"], "sine": ["4 deg/h"]},
        {"magnetic_field": [0.5e-4, 0.0], "table_angle": [0.0, np.pi / 2]},
        [1.0 + 3.0, 4.0],
    ),
    # t³ and its steps are within what a cubic between samples is exact for.
    (
        "time_delay",
        {"share": "1", "delay": "0.5 s"},
        {"time": np.arange(6.0), "rate": DEG_H * np.arange(6.0) ** 3},
        [(t - 0.5) ** 3 - t**3 for t in range(6)],
    ),
    # The lag of t²: d = −2τt + 2τ², and what is left of the start, where the second term has a weight of exp(−1).
    (
        "bandwidth",
        {"share": "1", "time_constant": "2 s"},
        {"time": np.arange(6.0), "rate": DEG_H * np.arange(6.0) ** 2},
        [-4.0 * t + 8.0 * (1.0 - (1.0 - np.exp(-1.0)) * np.exp(-t / 2.0)) for t in range(6)],
    ),
    (
        "output_axis_acceleration",
        {"coefficient": "0.5 s"},
        {
            "time": [0.0, 1.0, 3.0, 4.0, 100.0, 101.0],
            "rate_output": [x * DEG_H for x in (0.0, 1.0, 9.0, 16.0, 5.0, 9.0)],
        },
        [0.0, 1.0, 3.0, 4.0, 2.0, 2.0],
    ),
    ("scale_asymmetry", {"difference": "100 ppm"}, {"rate": [-2.0, 0.0, 2.0]}, [-50.0, 0.0, 50.0]),
    (
        "scale_nonlinearity",
        {"coefficients": ["100 ppm", "10 ppm", "0 ppm", "0 ppm"], "full_rate": "1 rad/s"},
        {"rate": [1.0, 0.5, -0.5]},
        # the share of the output is x + x² for powers two and three
        [110.0, 52.5, -47.5],
    ),
    (
        "scale_sagnac_sine",
        {"share": "1", "kappa": "0.5 s/rad"},
        {"rate": [2.0, 1e-4, 0.0]},
        [1e6 * (np.sin(1.0) - 1.0), -1e6 * (0.5e-4) ** 2 / 6, 0.0],
    ),
    (
        "scale_temperature",
        {"coefficient": "10 ppm/degC", "reference": "20 degC"},
        {"temperature": [25.0]},
        [50.0],
    ),
    (
        "scale_temperature_curve",
        {"coefficients": ["10 ppm", "5 ppm"], "reference": "20 degC"},
        {"temperature": [30.0, 10.0]},
        [15.0, -5.0],
    ),
    (
        "lock_in",
        {"share": "1", "half_width": "30 deg/h", "centre": "-10 deg/h"},
        {"rate": [x * DEG_H for x in (-60.0, -20.0, 0.0, 24.0)]},
        [50.0 - 40.0, 10.0, -10.0, 16.0 - 34.0],
    ),
    (
        # J_0(β) = 0 at β = 2.404825557695773, where J_1 = 0.519147497289467: nothing at rest, a half width of
        # 30 × 0.519 deg/h around ±800 deg/h; the last rate is 5/3 of it away, the far band is felt a little.
        "lock_in_dithered",
        {
            "share": "1",
            "lock_in_rate": "30 deg/h",
            "dither_amplitude": f"{2.404825557695773 / np.pi} arcsec",
            "dither_frequency": "400 Hz",
            "fringe_angle": "2 arcsec",
        },
        {"rate": [x * DEG_H for x in (0.0, 810.0, 800.0 + BAND * 5 / 3)]},
        [
            0.0,
            -10.0 + np.sqrt(1610.0**2 - BAND**2) - 1610.0,
            -BAND / 3 + np.sqrt((1600.0 + BAND * 5 / 3) ** 2 - BAND**2) - (1600.0 + BAND * 5 / 3),
        ],
    ),
]

# Settings that say which form of an effect is meant.
SETTINGS: dict[str, dict[str, object]] = {
    "bias_pressure": {"column": "pressure"},
    "lock_in_dithered": {"harmonics": 1},
    "bias_acceleration_squared": {
        "products": ("acceleration_input*acceleration_input", "acceleration_input*acceleration_spin")
    },
    "bias_magnetic": {"field": ("magnetic_field",), "angle": "table_angle"},
    "misalignment": {"about": ("rate_spin", "rate_output")},
    "table_harmonic": {"orders": (1, 2)},
    "table_tilt": {"angle": "azimuth"},
}


def internal(written: str | list[str]) -> np.ndarray:
    if isinstance(written, list):
        return np.array([internal(w) for w in written])
    value, unit = quantity(written)
    return np.asarray(value if unit == "degC" else value * factor(unit, internal_unit(unit)))


@pytest.mark.parametrize(("label", "fields", "columns", "expected"), BY_HAND, ids=[row[0] for row in BY_HAND])
def test_equation_by_hand(label: str, fields: dict[str, str], columns: dict[str, list[float]], expected: list[float]):
    effect = make_effect(label)
    effect = type(effect)(**{k: jnp.asarray(internal(v)) for k, v in fields.items()}, **SETTINGS.get(label, {}))
    signals = {"time": jnp.zeros(len(expected))} | {k: jnp.asarray(v) for k, v in columns.items()}
    effect = effect.prepared(signals) if "temperature_coil" in signals else effect
    unit = DEG_H if effect.site in ("rate", "output") else 1e-6
    assert np.asarray(effect.contribution(signals)) / unit == pytest.approx(expected, rel=1e-9, abs=1e-9)


def test_every_effect_is_worked_by_hand():
    assert {row[0] for row in BY_HAND} | {"scale_factor", "scale_spline", "quantisation"} == set(LABELS)


@eqx.filter_jit
def columns_and_slopes(effect: Effect, rates: jax.Array) -> tuple[jax.Array, jax.Array]:
    """An effect's columns at some rates, and their slopes over rate."""
    return jax.jvp(lambda r: effect.columns({"rate": r}), (rates,), (jnp.ones_like(rates),))


@pytest.mark.parametrize(("low", "high"), [(-1.5, 1.5), (-1.5, 0.0), (0.2, 2.0), (-2.0, -0.5)])
@pytest.mark.parametrize("moved", [(), (20, -45, 3), (-10, 49, -30, 0, 15)])
def test_spline_columns_are_natural_cubic_splines(
    low: float, high: float, moved: tuple[int, ...], rng: np.random.Generator
):
    """A natural spline is given by its values at the knots: scipy's through the same values is the same curve."""
    knots = len(moved or range(5)) + 2
    places = np.linspace(low, high, knots)
    places[1:-1] += np.array(moved or [0] * (knots - 2)) / 100 * (places[1] - places[0])
    inside = rng.uniform(low, high, ROWS - knots - 5)
    beyond = np.array([low - 2.0, low - 1.0, high + 1.0, high + 2.0])
    rates = jnp.asarray(np.concatenate([places, inside, beyond, [0.0]]))
    effect = ScaleSpline(knots=knots, moved=moved).prepared({"rate": jnp.asarray(places)})
    columns, slopes = (np.asarray(x) for x in columns_and_slopes(effect, rates))
    assert np.linalg.matrix_rank(np.column_stack([columns[:knots], np.ones(knots), places])) == knots
    scipy_spline = CubicSpline(places, columns[:knots], bc_type="natural")
    assert columns[knots:-5] == pytest.approx(scipy_spline(inside), abs=1e-10)
    low_slope, high_slope = scipy_spline(low, 1), scipy_spline(high, 1)
    straight = [columns[0] - 2 * low_slope, columns[0] - low_slope]
    straight += [columns[knots - 1] + high_slope, columns[knots - 1] + 2 * high_slope]
    assert columns[-5:-1] == pytest.approx(np.array(straight), abs=1e-9)
    assert columns[-1] == pytest.approx(0.0, abs=1e-12)
    assert slopes[-1] == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("label", ["scale_nonlinearity", "scale_spline", "scale_sagnac_sine", "lock_in"])
def test_gyro_at_rest_gives_finite_columns(label: str):
    still = {"rate": jnp.zeros(ROWS), "time": jnp.zeros(ROWS), "temperature": jnp.zeros(ROWS)}
    columns = np.asarray(make_effect(label).prepared(still).columns(still))
    assert np.isfinite(columns).all()
    assert not columns.any()


def test_reference_points_ignore_missing_values(rng: np.random.Generator):
    signals = signals_of(rng)
    holes = {k: v.at[5].set(jnp.nan) if k in ("rate", "temperature", "pressure") else v for k, v in signals.items()}
    for label in LABELS:
        effect = make_effect(label).prepared(holes)
        settings = [v for k, v in vars(effect).items() if k in ("reference", "full_rate", "lowest")]
        assert all(np.isfinite(v) for v in settings), label


def test_prepared_keeps_what_is_set(rng: np.random.Generator):
    signals = signals_of(rng)
    # The step of a quantisation is that of the campaign, and no signal's.
    once = [make_effect(label).prepared(signals) for label in LABELS if label != "quantisation"]
    moved = {k: 2 * v + 1 for k, v in signals.items()}
    for effect in once:
        assert eqx.tree_equal(effect.prepared(moved), effect)


@pytest.mark.parametrize(
    ("kind", "fields"),
    [
        (ScaleNonlinearity, {"powers": (1, 2)}),
        (ScaleNonlinearity, {"powers": (2, 2)}),
        (ScaleNonlinearity, {"powers": ()}),
        (ScaleNonlinearity, {"powers": (2, 3), "coefficients": jnp.zeros(3)}),
        (ScaleSpline, {"knots": 2}),
        (ScaleSpline, {"knots": 6, "coefficients": jnp.zeros(3)}),
        (ScaleSpline, {"knots": 6, "moved": (10, 20, 30)}),
        (ScaleSpline, {"knots": 5, "moved": (10, -50, 30)}),
        (BiasTemperatureCurve, {"hinges": jnp.zeros(2), "breakpoints": jnp.zeros(1)}),
        (BiasTemperatureCurve, {"coefficients": jnp.zeros(0)}),
        (BiasTemperatureCurve, {"coefficients": jnp.zeros(())}),
    ],
)
def test_shapes_that_do_not_fit_are_refused(kind: type[Effect], fields: dict):
    """By the class itself, or in the tests by the run-time shape checks before it."""
    with pytest.raises((ValueError, TypeError)):
        kind(**fields)


def test_sagnac_sine_is_smooth_where_its_series_ends():
    """The series near zero and the quotient beyond agree, and so do their derivatives by κ."""
    effect = make_effect("scale_sagnac_sine")
    edge = 1e-2 / float(effect.kappa)  # type: ignore[attr-defined]
    rates = jnp.asarray([edge * (1 - 1e-9), edge * (1 + 1e-9)])

    def of_kappa(kappa):
        return eqx.tree_at(lambda e: e.kappa, effect, kappa).contribution({"rate": rates})

    value, slope = jax.jvp(of_kappa, (effect.kappa,), (jnp.ones(()),))  # type: ignore[attr-defined]
    assert float(value[0]) == pytest.approx(float(value[1]), rel=1e-7)
    assert float(slope[0]) == pytest.approx(float(slope[1]), rel=1e-5)


def test_asymmetry_at_rest_is_neither_sign():
    assert not ScaleAsymmetry(difference=jnp.ones(())).contribution({"rate": jnp.zeros(3)}).any()


MODULE = '''
"""A family of one."""
from gyromodel.effects import Effect, parameter
from gyromodel.effects._base import stack


class BiasOfMoon(Effect):
    """D += D_M: the moon."""

    id = "bias_of_moon"
    site = "rate"
    needs = ("time",)
    cause = "The moon pulls at the gyro."
    test = "Wait for the new moon."

    pull: object = parameter("deg/h", 1.0, "its pull")

    def columns(self, signals):
        return stack(signals["time"])
'''


def test_a_class_in_a_new_module_is_in_the_catalogue(tmp_path: Path):
    (tmp_path / "lunar.py").write_text(MODULE, encoding="utf-8")
    spec = importlib.util.spec_from_file_location("lunar", tmp_path / "lunar.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    before = set(CATALOGUE)
    try:
        sys.modules["lunar"] = module
        spec.loader.exec_module(module)
        assert set(CATALOGUE) - before == {"bias_of_moon"}
        model = model_from_effects(["bias_of_moon"])
        assert model.labels == ("bias_of_moon",)
        changed = model.with_vector(jnp.asarray([2.0]))
        assert np.array_equal(changed.predict({"time": jnp.arange(3.0)}), [0.0, 2.0, 4.0])
    finally:
        CATALOGUE.pop("bias_of_moon", None)
        sys.modules.pop("lunar", None)
