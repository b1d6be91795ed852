"""What a campaign can tell apart, against least squares by hand in white noise; and whether the test that `diagnose`
asks for settles what it could not, when an independent simulator carries it out."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import binomtest, norm

import gyromodel
from gyromodel.campaign import Campaign
from gyromodel.diagnosis import isolability
from gyromodel.diagnosis._added_tests import second_thermometer
from gyromodel.model import GyroModel, ModelError, model_from_effects
from tests.truth import study

N, STEP = 1e-3, 20.0  # deg/h/sqrt(Hz), s
DEG_H = np.pi / 180 / 3600
RARE = 1e-5


def log(temperature: np.ndarray, **columns: np.ndarray) -> Campaign:
    time = np.arange(len(temperature)) * STEP
    units = {"time": "s", "temperature": "degC", "output": "deg/h"} | dict.fromkeys(columns, "V")
    values = {"time": time, "temperature": temperature, "output": np.full(len(time), np.nan)} | columns
    return Campaign(values | {"output": time}, units, {"kind": "rate"})


def known_noise(*effects: str) -> GyroModel:
    return GyroModel(model_from_effects(effects).effects, {"noise_white": jnp.asarray(N * DEG_H)})


def left(columns: np.ndarray, *taken: np.ndarray) -> float:
    """Norm of a signal that other columns cannot take, in standard deviations of a sample."""
    others = np.column_stack(taken)
    rest = columns - others @ np.linalg.lstsq(others, columns, rcond=None)[0]
    return float(np.linalg.norm(rest)) / (N / np.sqrt(STEP))


def taken(size: float, cosine: float, sine: float) -> float:
    """The chance that a signal of some size (standard deviations) explains less than another: its part of the data is
    drawn, then the other's beside it."""

    def density(own: float) -> float:
        beside = norm(cosine * own, sine)
        return norm.pdf(own - size) * (beside.sf(abs(own)) + beside.cdf(-abs(own)))

    return quad(density, -9.0, size + 9.0, epsabs=1e-10, limit=200, points=[0.0])[0]


def test_sizes_are_those_of_least_squares_in_white_noise():
    """A ramp that turns: temperature against a drift and against a second voltage."""
    i = np.arange(300)
    temperature, voltage = 20 + 0.1 * np.minimum(i, 500 - i), np.sin(i / 40.0)
    found = isolability(log(temperature, supply=voltage), known_noise("bias"), tests=False)
    one, drift = np.ones(300), i * STEP / 3600
    for a, b in (
        ("bias_temperature", "bias_drift"),
        ("bias_drift", "bias_supply"),
        ("bias_supply", "bias_temperature"),
    ):
        signal = {"bias_temperature": temperature, "bias_drift": drift, "bias_supply": voltage}
        sine, size = left(signal[a], one, signal[b]) / left(signal[a], one), found.apart[a, b].value
        assert taken(size * left(signal[a], one), np.sqrt(1.0 - sine**2), sine) == pytest.approx(0.05, rel=1e-6)
        assert found.mistaken(a, b, -size) == pytest.approx(0.05)
    assert [found.detectable[k].unit for k in ("bias_temperature", "bias_drift")] == ["deg/h/degC", "deg/h/h"]
    # 4.3 standard deviations or a little more: the threshold with 80 %.
    needed = found.detectable["bias_temperature"].value * left(temperature, one)
    assert 4.0 < needed < 5.2


@pytest.mark.long
def test_what_is_one_line_is_never_told_apart():
    found = isolability(log(20 + 0.1 * np.arange(200.0)), known_noise("bias"))
    assert found.apart["bias_temperature", "bias_drift"].value > 1e3 * found.detectable["bias_temperature"].value
    assert found.mistaken("bias_temperature", "bias_drift", 5.0) == pytest.approx(0.5)
    sentence, after = found.tests[0]
    assert "temperature" in sentence
    assert after["bias_temperature", "bias_drift"].value < 2.0 * found.detectable["bias_temperature"].value
    beside = isolability(log(20 + 0.1 * np.arange(200.0)), known_noise("bias", "bias_temperature"), tests=False)
    assert "bias_drift" not in beside.detectable
    assert "cannot be told" in beside.not_testable["bias_drift"]


def test_a_second_thermometer_shows_what_lies_between_two():
    """It lags by a minute, here by an integrator; what its difference takes to be found is as least squares has it."""
    i = np.arange(300)
    temperature = 20 + 0.1 * np.abs(i % 100 - 50)
    found = isolability(log(temperature), known_noise("bias"))
    assert "bias_temperature_gradient" in found.not_testable
    [(sentence, after)] = [test for test in found.tests if "second thermometer" in test[0]]
    assert "60 s" in sentence
    fine = np.arange(0, 300 * 20, 0.05)
    held, second = np.interp(fine, i * STEP, temperature), np.empty(len(fine))
    second[0] = temperature[0]
    for k in range(1, len(fine)):
        second[k] = second[k - 1] + (held[k - 1] - second[k - 1]) * 0.05 / 60.0
    difference, one = np.interp(i * STEP, fine, second) - temperature, np.ones(300)
    [logged] = second_thermometer(log(temperature))
    assert logged.campaign.columns["temperature_second"] - temperature == pytest.approx(difference, abs=1e-3 * 0.3)
    # Across the temperature the difference is told apart as soon as it is found.
    needed = after["bias_temperature_gradient", "bias_temperature"].value * left(difference, one)
    assert 4.0 < needed < 5.2
    assert not any("second" in effect for pair in after for effect in pair)
    pair = "bias_temperature", "bias_drift"
    assert after[pair].value == pytest.approx(found.apart[pair].value, rel=1e-6)
    twice = log(temperature).with_column("temperature_case", temperature + difference, "degC")
    assert not [s for s, _ in isolability(twice, known_noise("bias")).tests if "second thermometer" in s]


def test_the_noise_and_the_scale_factor_must_be_stated():
    with pytest.raises(ModelError, match="state noise_white"):
        isolability(log(np.arange(50.0)), model_from_effects(["bias"]))


@pytest.mark.law
@pytest.mark.parametrize("standard_deviations", [0.7, 1.5, 4.0])
def test_the_predicted_chance_is_the_measured_rate_of_confusion(standard_deviations: float, rng: np.random.Generator):
    """Two effects, and how often least squares prefers the wrong one: down to sizes where its sign is in doubt."""
    i = np.arange(300)
    temperature = 20 + 0.1 * np.minimum(i, 500 - i)
    found = isolability(log(temperature), known_noise("bias"), tests=False)
    size = standard_deviations * found.std["bias_temperature"].value
    predicted = found.mistaken("bias_temperature", "bias_drift", size)
    one, drift, wrong = np.ones(300), 1.0 * i, 0
    for _ in range(400):
        y = size * temperature + N / np.sqrt(STEP) * rng.standard_normal(300)
        wrong += left(y, one, drift) < left(y, one, temperature)
    assert 0.02 < predicted < 0.49
    assert binomtest(int(wrong), 400, predicted).pvalue > RARE


@pytest.mark.long
@pytest.mark.parametrize(("seed", "effect"), [(1, "bias_temperature"), (2, "bias_drift"), (4, "bias_drift")])
def test_the_next_test_settles_what_was_ambiguous(seed: int, effect: str):
    """One ramp: a bias over temperature is a drift. The truth lives on through the test that is asked for.

    Three examples; the study counts how often it comes true. Seed 3 is not among them: there the first campaign is
    called adequate.
    """
    built = study.build(study.Case(seed, "static_ramp", "white", effect, 3.0))
    first = Campaign(built.columns, built.units, built.metadata)
    model = model_from_effects(built.truth.baseline)
    found = gyromodel.diagnose(first, model, hold_out=False)
    assert found.verdict == "ambiguous"
    assert {"bias_temperature", "bias_drift"} <= set(found.credible_set)
    settled = study.settled(built, first, model, found.next_test)
    assert settled is not None
    # A slow warm-up may still stand for a drift.
    assert {"bias_temperature", "bias_drift"} & set(settled) == {effect}


@pytest.mark.long
@pytest.mark.parametrize("hidden", ["bias_temperature", "bias_drift"])
def test_a_change_that_a_walk_could_make_is_told_under_any_name(hidden: str):
    """On one ramp temperature and time are one, and a random walk rises as they do: an example with a fixed seed."""
    built = study.build(study.Case(3, "static_ramp", "white", hidden, 3.0))
    measured = gyromodel.Campaign(columns=built.columns, units=built.units, metadata=built.metadata)
    model = gyromodel.model_from_effects(list(built.truth.baseline))
    found = gyromodel.diagnose(measured, model, hold_out=False)
    assert found.verdict == "ambiguous"
    assert {"bias_temperature", "bias_drift", "noise_random_walk"} <= set(found.credible_set)
