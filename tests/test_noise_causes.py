"""Noise of kinds that a fit cannot hold, each against a simulator of its own (tests/truth/noise.py)."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import binom

import gyromodel as gm
from gyromodel.diagnosis._noise_causes import quantisation, telegraph
from gyromodel.estimate import Estimate
from tests.truth import noise as truth
from tests.truth.designs import Design

ROWS, STEP = 600, 20.0
WHITE = np.deg2rad(1 / 3600) * np.sqrt(STEP)  # N of 1 deg/h in a sample
RARE = 1e-4


def log(output: np.ndarray) -> gm.Campaign:
    """A log at rest, in rad/s."""
    columns = {"time": np.arange(len(output)) * STEP, "output": output}
    return gm.Campaign(columns, {"time": "s", "output": "rad/s"}, {"kind": "rate"})


def fitted(output: np.ndarray) -> Estimate:
    return gm.fit(log(output), gm.model_from_effects(["bias"]))


def stated() -> gm.GyroModel:
    """A bias in white noise that is stated."""
    model = gm.model_from_effects(["bias"])
    return gm.GyroModel(model.effects, {"noise_white": WHITE}, model.fixed, model.gyro)


def white(rng: np.random.Generator) -> np.ndarray:
    return truth.white(ROWS, STEP, WHITE, rng)


def test_quantisation_of_the_angle_has_its_size(rng: np.random.Generator):
    """An angle counted in whole steps: its rounding errors have a variance of a twelfth of a step squared."""
    step = 2.5 * WHITE * np.sqrt(STEP)
    found = [quantisation(fitted(truth.quantised(white(rng), STEP, step)), 4.0) for _ in range(12)]
    sizes = [np.deg2rad(c.parameters[0].value / 3600) for c in found if c is not None]
    errors = [np.deg2rad(c.parameters[0].std / 3600) for c in found if c is not None]
    assert binom.cdf(len(sizes), 12, 0.97) > RARE
    inside = sum(abs(size - step / np.sqrt(12.0)) < 1.96 * e for size, e in zip(sizes, errors, strict=True))
    assert binom.cdf(inside, len(sizes), 0.93) > RARE


def test_hops_between_two_levels_have_their_size_and_times(rng: np.random.Generator):
    size, times = 3.0 * WHITE / np.sqrt(STEP), (1600.0, 1000.0)
    hits, found = [], 0
    for _ in range(8):
        estimate = fitted(white(rng) + truth.telegraph(ROWS, STEP, size, *times, rng))
        cause = telegraph(estimate, estimate, "rad/s")
        found += cause is not None
        values = cause.parameters if cause is not None else ()
        hits += [abs(p.value - true) < 2.5 * p.std for p, true in zip(values, (size, *times), strict=False)]
    assert binom.cdf(found, 8, 0.95) > RARE
    assert binom.cdf(sum(hits), len(hits), 0.93) > RARE


@pytest.mark.parametrize("kind", [*truth.FAMILY, "markov", "student_t3"])
def test_other_noise_is_neither(kind: str, rng: np.random.Generator):
    index = np.arange(ROWS)
    laid = Design("static", STEP, index, {}, {}, {}, {}, (index, index))
    false = 0
    for _ in range(5):
        estimate = fitted(truth.draw(kind, laid, rng).sample(laid, rng))
        false += quantisation(estimate, 4.0) is not None
        false += telegraph(estimate, estimate, "rad/s") is not None
    assert binom.sf(false - 1, 10, 0.01) > RARE


def test_what_looks_like_a_kind_of_noise_is_not_named_so(rng: np.random.Generator):
    """Coarse readouts, many weak lines, hops at changes of a position: none of them is noise of the gyro."""
    false = 0
    for _ in range(3):
        step = rng.uniform(3.0, 6.0) * WHITE / np.sqrt(STEP)
        coarse = fitted(np.round(white(rng) / step + rng.uniform()) * step)
        false += telegraph(coarse, coarse, "rad/s") is not None
        waves = np.cos(2 * np.pi * (rng.uniform(0.3, 0.5, 15) * np.arange(ROWS)[:, None] + rng.uniform(size=15)))
        many = fitted(white(rng) + 0.3 * WHITE / np.sqrt(STEP) * waves.sum(1))
        false += quantisation(many, 4.0) is not None
        low = truth.telegraph(ROWS, STEP, 1.0, 1600.0, 1000.0, rng)
        number = 1.0 + np.cumsum(np.diff(low, prepend=low[0]) != 0)
        poses = log(white(rng) + 3.0 * WHITE / np.sqrt(STEP) * low).with_column("position", number, "")
        estimate = gm.fit(poses, gm.model_from_effects(["bias"]))
        false += telegraph(estimate, estimate, "rad/s") is not None
    assert binom.sf(false - 1, 9, 0.02) > RARE


def test_a_regular_switch_is_no_firm_noise():
    """Examples with a fixed seed: square waves are as well something that switches near the gyro, a thermostat say."""
    rng = np.random.default_rng(2)
    size = WHITE / np.sqrt(STEP)
    ends = np.cumsum(rng.normal(40, 8, 40).astype(int))
    thermostat = 2.0 * size * (np.searchsorted(ends, np.arange(ROWS), "right") % 2)
    wave = 3.0 * size * np.sign(np.sin(2 * np.pi * np.arange(ROWS) / 75))
    for output, model in ((wave, stated()), (thermostat, gm.model_from_effects(["bias"]))):
        found = gm.diagnose(log(white(rng) + output), model, hold_out=False)
        assert found.verdict == "ambiguous"
        assert set(found.credible_set) == {"noise_telegraph", "bias_periodic"}
        assert "switches" in (found.next_test or "")


def test_less_noise_than_stated_lacks_nothing_and_more_markov_noise_is_told(rng: np.random.Generator):
    q, constant = 4.0 * WHITE / 400.0, 400.0
    markov = gm.GyroModel(stated().effects, {"noise_white": WHITE, "noise_markov": q, "noise_markov_time": constant})
    wrong, told = 0, 0
    for _ in range(3):
        wrong += gm.diagnose(log(white(rng)), markov, hold_out=False).verdict != "adequate"
        more = white(rng) + 3.0 * truth.markov(ROWS, STEP, q, constant, rng)
        told += "noise_markov" in gm.diagnose(log(more), markov, hold_out=False).credible_set
    assert binom.sf(wrong - 1, 3, 0.02) > RARE
    assert binom.cdf(told, 3, 0.9) > RARE


def test_kinds_of_noise_that_are_not_stated_are_causes():
    """Examples of a fixed seed: stated as white, and to be estimated, where only hops are no noise that a fit holds."""
    rng = np.random.default_rng(4)
    hops = white(rng) + truth.telegraph(ROWS, STEP, 4.0 * WHITE / np.sqrt(STEP), 1600.0, 1000.0, rng)
    rounded = truth.quantised(white(rng), STEP, 4.0 * WHITE * np.sqrt(STEP))
    growing = white(rng) * np.linspace(1.0, 3.0, ROWS)
    for output, name, sentence in (
        (hops, "noise_telegraph", ""),
        (rounded, "noise_quantisation", "that of quantisation"),
        (growing, "noise_heteroscedastic", "follows time"),
    ):
        found = gm.diagnose(log(output), stated(), hold_out=False)
        assert (found.verdict, [c.effect for c in found.causes]) == ("named", [name])
        assert set(found.credible_set) == {name}
        free = gm.diagnose(log(output), gm.model_from_effects(["bias"]), hold_out=False)
        assert [c.effect for c in free.causes] == ([name] if name == "noise_telegraph" else [])
        assert any(sentence in line for line in (*free.findings, ""))
