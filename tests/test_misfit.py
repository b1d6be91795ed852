"""What oscillates and is no steady line, nor noise of a fitted kind: never named, and told of."""

from __future__ import annotations

from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.stats import binom

import gyromodel as gm
from gyromodel.diagnosis._misfit import excess_band, lines_of_noise, unsteady_lines
from gyromodel.effects.drivers import Bias, BiasPeriodic
from gyromodel.estimate import fit_record
from gyromodel.model import GyroModel
from gyromodel.noise import NoiseRatios
from gyromodel.signals import read_signals

ROWS = 1000
TIME = np.arange(ROWS, dtype=float)


def log(output: np.ndarray) -> gm.Campaign:
    units = {"time": "s", "output": "deg/h"}
    return gm.Campaign({"time": TIME, "output": output}, units, {"kind": "rate"})


def wanders(t: np.ndarray) -> np.ndarray:
    return np.sin(2 * np.pi * (0.06 * t + 1.5 * np.sin(2 * np.pi * t / 900)))


def decays(t: np.ndarray) -> np.ndarray:
    return 2.5 * np.exp(-t / 200) * np.sin(2 * np.pi * 0.042 * t)


def comes_and_goes(t: np.ndarray) -> np.ndarray:
    return 2.0 * ((t > 350) & (t < 500)) * np.sin(2 * np.pi * 0.08 * t)


@pytest.mark.parametrize(
    "wave",
    [wanders, pytest.param(decays, marks=pytest.mark.long), pytest.param(comes_and_goes, marks=pytest.mark.long)],
)
def test_what_changes_is_no_line(wave: Callable[[np.ndarray], np.ndarray], rng: np.random.Generator) -> None:
    found = gm.diagnose(log(5 + wave(TIME) + 0.5 * rng.normal(size=ROWS)), gm.model_from_effects(["bias"]))
    assert any("no steady line" in line or "is not steady" in line for line in found.findings)
    if wave is not wanders:  # which by chance may be much like several steady ones
        # Noise whose level follows time looks like what decays.
        assert found.verdict == "unknown" or (wave is decays and found.verdict == "adequate")
        assert "bias_periodic" not in [c.effect for c in found.causes]


def test_steady_lines_are_named_and_no_band_is_told_of(rng: np.random.Generator) -> None:
    square = np.sign(np.sin(2 * np.pi * 0.0213 * TIME + 1.0))
    campaign = log(5 + square + 0.5 * rng.normal(size=ROWS))
    found = gm.diagnose(campaign, gm.model_from_effects(["bias"]), hold_out=False)
    assert [c.effect for c in found.causes] == ["bias_periodic"]
    assert not any("oscillates" in line for line in found.findings)


@pytest.mark.parametrize("beat", [0.0, pytest.param(2.0, marks=pytest.mark.long)])
def test_what_alternates_and_may_change_slowly_is_no_line(beat: float, rng: np.random.Generator) -> None:
    """`beat`: cycles a record from half the sample rate. A change of any course has few of them."""
    wave = 2.0 * np.cos(2 * np.pi * (0.5 - beat / ROWS) * TIME + 0.4)
    found = gm.diagnose(log(5 + wave + 0.5 * rng.normal(size=ROWS)), gm.model_from_effects(["bias"]), hold_out=False)
    assert (found.verdict, [c.effect for c in found.causes]) == ("unknown", [])
    assert any("no steady line" in line and "half the sample rate" in line for line in found.findings)


def test_a_line_further_from_half_the_sample_rate_is_named(rng: np.random.Generator) -> None:
    wave = 2.0 * np.cos(2 * np.pi * (0.5 - 6.0 / ROWS) * TIME + 0.4)
    found = gm.diagnose(log(5 + wave + 0.5 * rng.normal(size=ROWS)), gm.model_from_effects(["bias"]), hold_out=False)
    assert (found.verdict, [c.effect for c in found.causes]) == ("named", ["bias_periodic"])


def test_a_column_that_is_shaken_as_the_gyro_is_is_told_of(rng: np.random.Generator) -> None:
    """A dither faster than the samples, whose frequency wanders, moves the output and an accelerometer."""
    phase = 2 * np.pi * (400.13 * TIME + 2.0 * np.sin(2 * np.pi * TIME / 700))
    columns = {"time": TIME, "output": 5 + np.sin(phase) + 0.5 * rng.normal(size=ROWS)}
    columns |= {"acceleration_input": 0.1 * np.cos(phase) + 0.1 * rng.normal(size=ROWS)}
    columns |= {"acceleration_output": 0.1 * rng.normal(size=ROWS)}
    units = {"time": "s", "output": "deg/h", "acceleration_input": "m/s^2", "acceleration_output": "m/s^2"}
    campaign = gm.Campaign(columns, units, {"kind": "rate"})
    found = gm.diagnose(campaign, gm.model_from_effects(["bias"]), hold_out=False)
    assert found.verdict == "unknown"
    assert any("acceleration_input oscillates there too" in line for line in found.findings)


@pytest.mark.long
@pytest.mark.parametrize("walk", [0.0, 0.1])
def test_a_steady_line_is_never_said_to_change(walk: float, rng: np.random.Generator) -> None:
    """Lines in noise of its own each; one in ten thousand may be flagged."""
    none = np.zeros(1)
    model = GyroModel((Bias(), BiasPeriodic(cosine=none, sine=none, frequency=np.array([0.0501]))), {})
    for size in rng.uniform(0.2, 3.0, 20):
        noise = rng.normal(size=ROWS) + walk * np.cumsum(rng.normal(size=ROWS))
        line = size * np.sin(2 * np.pi * 0.05 * TIME + rng.uniform(0, 6))
        assert unsteady_lines(fit_record(read_signals(log(line + noise)), model)) == [False]


@pytest.mark.parametrize("logs", [2, pytest.param(20, marks=pytest.mark.long)])
def test_the_band_of_what_sweeps_is_told_of(logs: int, rng: np.random.Generator) -> None:
    """A chirp from 0.1 to 0.14 Hz, in noise of its own in each log."""
    chirp = 0.8 * np.sin(2 * np.pi * (0.1 * TIME + 0.02 * TIME**2 / TIME[-1]))
    for _ in range(logs):
        noise = 0.7 * rng.standard_t(3, size=ROWS) / np.sqrt(3)
        band = excess_band(fit_record(read_signals(log(noise + chirp)), GyroModel((Bias(),), {})))
        assert band is not None
        assert 0.05 < band.low < 0.14
        assert 0.1 < band.high < 0.2


@pytest.mark.law
def test_noise_alone_has_no_band(rng: np.random.Generator) -> None:
    """One log in 2000 at most, of heavy tails."""
    model, white, logs = GyroModel((Bias(),), {}), NoiseRatios(jnp.zeros(()), jnp.zeros(())), 200
    noises = 0.7 * rng.standard_t(3, size=(logs, ROWS)) / np.sqrt(3)
    alone = sum(excess_band(fit_record(read_signals(log(n)), model, ratios=white)) is not None for n in noises)
    assert binom.sf(alone - 1, logs, 5e-4) > 1e-5


def test_two_errors_side_by_side_are_no_band(rng: np.random.Generator) -> None:
    """Two samples three apart, each far out in the tails, have a spectrum with a band at a third of the sample rate."""
    noise = rng.standard_normal(ROWS)
    noise[[500, 503]] = 40.0
    assert excess_band(fit_record(read_signals(log(noise)), GyroModel((Bias(),), {}))) is None


@pytest.mark.parametrize(("size", "of_noise"), [(0.0, True), (2.0, False)])
def test_a_line_is_held_against_the_band_about_it(size: float, of_noise: bool, rng: np.random.Generator) -> None:
    """In noise that turns its sign from sample to sample, the greatest of its own lines, and one far above these.

    The greatest of one in twenty draws stands out by itself.
    """
    white, told = NoiseRatios(jnp.zeros(()), jnp.zeros(())), list[bool]()
    for _ in range(5):
        output = lfilter([0.8], [1.0, 0.6], rng.standard_normal(ROWS)) + size * np.cos(2 * np.pi * 0.45 * TIME)
        greatest = 400 + np.argmax(np.abs(np.fft.rfft(output))[400 : ROWS // 2])
        line = BiasPeriodic(cosine=np.zeros(1), sine=np.zeros(1), frequency=np.array([greatest / ROWS]))
        told += lines_of_noise(fit_record(read_signals(log(output)), GyroModel((Bias(), line), {}), ratios=white))
    assert told.count(of_noise) >= (4 if of_noise else 5)


def test_a_line_at_the_end_of_frequencies_is_held_against_the_noise_there(rng: np.random.Generator) -> None:
    """Above the last ordinate, and three times as large as the mean of a band that rises to it lets it be."""
    white, outside = NoiseRatios(jnp.zeros(()), jnp.zeros(())), 0
    line = BiasPeriodic(cosine=np.zeros(1), sine=np.zeros(1), frequency=np.array([0.4993]))
    wave = np.cos(2 * np.pi * 0.4993 * TIME)
    for _ in range(5):
        noise = lfilter([0.5], [1.0, 0.85], rng.standard_normal(ROWS))
        noise -= wave * (wave @ noise) / (wave @ wave)
        fitted = fit_record(read_signals(log(noise + 0.35 * wave)), GyroModel((Bias(), line), {}), ratios=white)
        band = excess_band(fitted)
        outside += band is not None and band.high < 0.4993
        assert lines_of_noise(fitted) == [True]
    assert outside
