"""Noise that is no colour, each against a simulator of its own (tests/truth/noise.py)."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import binom

import gyromodel as gm
from gyromodel.diagnosis import _noise_causes
from gyromodel.diagnosis._noise_causes import quantisation, telegraph
from gyromodel.estimate import Estimate
from gyromodel.model import ModelError
from tests.truth import noise as truth
from tests.truth import study
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


@pytest.mark.law
@pytest.mark.long
def test_quantisation_of_the_angle_has_its_size(rng: np.random.Generator):
    """An angle counted in whole steps: its rounding errors have a variance of a twelfth of a step squared."""
    step = 2.5 * WHITE * np.sqrt(STEP)
    found = [quantisation(fitted(truth.quantised(white(rng), STEP, step)), 4.0) for _ in range(12)]
    sizes = [np.deg2rad(c.parameters[0].value / 3600) for c in found if c is not None]
    errors = [np.deg2rad(c.parameters[0].std / 3600) for c in found if c is not None]
    assert binom.cdf(len(sizes), 12, 0.93) > RARE
    inside = sum(abs(size - step / np.sqrt(12.0)) < 1.96 * e for size, e in zip(sizes, errors, strict=True))
    assert binom.cdf(inside, len(sizes), 0.93) > RARE


@pytest.mark.law
@pytest.mark.long
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


@pytest.mark.law
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


def test_a_coarse_readout_is_no_hop(monkeypatch: pytest.MonkeyPatch):
    """A log rounded to several standard deviations, of a fixed seed where its rare codes would pass for a level."""
    rng = np.random.default_rng(51)
    step = rng.uniform(2.0, 6.0) * WHITE / np.sqrt(STEP)
    coarse = fitted(np.round(white(rng) / step + rng.uniform()) * step)
    assert telegraph(coarse, coarse, "rad/s") is None
    monkeypatch.setattr(_noise_causes, "FEWEST_STEPS", 0.0)
    assert telegraph(coarse, coarse, "rad/s") is not None


@pytest.mark.long
@pytest.mark.law
@pytest.mark.parametrize("strength", [0.3, 0.8])
def test_many_fast_lines_are_no_quantisation(strength: float, rng: np.random.Generator):
    """Fifteen lines above 0.3 times the sample rate raise half of the spectrum; 26 of 300 logs were let through."""
    false = 0
    for _ in range(16):
        waves = np.cos(2 * np.pi * (rng.uniform(0.3, 0.5, 15) * np.arange(ROWS)[:, None] + rng.uniform(size=15)))
        many = fitted(white(rng) + strength * WHITE / np.sqrt(STEP) * waves.sum(1))
        false += quantisation(many, 4.0) is not None
    assert binom.sf(false - 1, 16, 0.12) > RARE


@pytest.mark.long
@pytest.mark.law
def test_hops_at_changes_of_position_are_not_the_gyros(rng: np.random.Generator):
    """Positions that begin where the level changes, and positions of three rows that have nothing to do with it."""
    false, found = 0, 0
    for _ in range(5):
        low = truth.telegraph(ROWS, STEP, 1.0, 1600.0, 1000.0, rng)
        output = log(white(rng) + 3.0 * WHITE / np.sqrt(STEP) * low)
        number = 1.0 + np.cumsum(np.diff(low, prepend=low[0]) != 0)
        for column, count in ((number, "false"), (np.arange(ROWS) // 3 + 1.0, "found")):
            estimate = gm.fit(output.with_column("position", column, ""), gm.model_from_effects(["bias"]))
            hops = telegraph(estimate, estimate, "rad/s") is not None
            false, found = false + (hops and count == "false"), found + (hops and count == "found")
    assert binom.sf(false - 1, 5, 0.02) > RARE
    assert binom.cdf(found, 5, 0.95) > RARE


@pytest.mark.long
@pytest.mark.parametrize("seed", [106, 125])
def test_a_level_that_follows_a_column_is_no_structure(seed: int):
    """Examples where the first, unweighted search takes the scatter at high temperature rates for a function of it."""
    built = study.build(study.Case(seed, "rate_temperature", "grows_with_temperature_rate"))
    log = gm.Campaign(built.columns, built.units, built.metadata)
    found = gm.diagnose(log, gm.model_from_effects(built.truth.baseline), hold_out=False)
    assert found.verdict == "adequate"
    assert any("noise level follows" in line for line in found.findings)


@pytest.mark.long
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


@pytest.mark.long
def test_less_noise_than_stated_lacks_nothing_and_more_markov_noise_is_told():
    """Two examples of a fixed seed."""
    rng = np.random.default_rng(2)
    q, constant = 4.0 * WHITE / 400.0, 400.0
    markov = gm.GyroModel(stated().effects, {"noise_white": WHITE, "noise_markov": q, "noise_markov_time": constant})
    for _ in range(2):
        assert gm.diagnose(log(white(rng)), markov, hold_out=False).verdict == "adequate"
        more = white(rng) + 3.0 * truth.markov(ROWS, STEP, q, constant, rng)
        assert "noise_markov" in gm.diagnose(log(more), markov, hold_out=False).credible_set


@pytest.mark.long
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
        extended = found.extended.model
        assert {name} <= {*extended.noise, *(["noise_heteroscedastic"] if extended.level else [])}
        # Hops and counts are no noise of the stated kind alone: what is published weighs them.
        assert (set(extended.noise) > {"noise_white"}) == (name != "noise_heteroscedastic")
        free = gm.diagnose(log(output), gm.model_from_effects(["bias"]), hold_out=False)
        assert [c.effect for c in free.causes] == ([name] if name == "noise_telegraph" else [])
        assert any(sentence in line for line in (*free.findings, ""))


@pytest.mark.long
def test_a_ripple_at_one_end_of_a_column_is_told_beside_the_noise(rng: np.random.Generator):
    """A sine of 0.3 °C period is no function that is searched, and scatters like noise of the hot end."""
    time = STEP * np.arange(ROWS)
    temperature = 20.0 + 20.0 * np.sin(2 * np.pi * time / time[-1] * 2.1)
    level = 4.0 * WHITE / np.sqrt(STEP) * ((temperature - temperature.min()) / np.ptp(temperature)) ** 2

    def told(extra: np.ndarray) -> tuple[str, str | None, bool, bool]:
        measured = log(white(rng) + level * extra).with_column("temperature", temperature, "degC")
        found = gm.diagnose(measured, gm.model_from_effects(["bias"]), hold_out=False)
        grows, follow = (
            any(sentence in line for line in found.findings)
            for sentence in ("noise level follows temperature", "temperature follow one another")
        )
        return found.verdict, found.driver and found.driver.column, grows, follow

    ripples = [told(np.sin(2 * np.pi * temperature / 0.3 + rng.uniform(0, 6))) for _ in range(4)]
    # One in fifteen is met by a level that switches where the temperature turns, and leaves no such noise.
    assert {r[:2] for r in ripples} == {("unknown", "temperature")}
    assert all(grows == follow for *_, grows, follow in ripples)
    assert any(grows for *_, grows, _ in ripples)
    assert told(rng.standard_normal(ROWS)) == ("adequate", None, True, False)


HOPS = {"noise_telegraph": 3.0 * WHITE / np.sqrt(STEP), "noise_telegraph_low": 1600.0, "noise_telegraph_high": 1000.0}


def hopping(rng: np.random.Generator) -> gm.Campaign:
    return log(white(rng) + truth.telegraph(ROWS, STEP, *HOPS.values(), rng))


@pytest.mark.long
def test_stated_hops_are_simulated_and_fitted_as_what_has_their_correlation(tmp_path: Path, rng: np.random.Generator):
    """Variance p (1 - p) size², which decays as exp(-t/T), 1/T = 1/t_low + 1/t_high, of draws and in fits."""
    model = replace(gm.model_from_effects(["bias"]), noise={"noise_white": WHITE, **HOPS}).with_vector(np.array([1e-6]))
    gm.write_model(model, tmp_path / "model.yaml")
    again = gm.read_model(tmp_path / "model.yaml")
    assert {k: float(v) for k, v in again.noise.items()} == pytest.approx({"noise_white": WHITE, **HOPS})
    size, low, high = HOPS.values()
    variance, time = size**2 * low * high / (low + high) ** 2, low * high / (low + high)
    draws = [gm.simulate(again, hopping(rng), seed=int(s)).columns["output"] for s in rng.integers(2**31, size=400)]
    left = np.array(draws) - 1e-6
    for lag in (10, 50):
        found = np.mean(left[:, lag:] * left[:, :-lag], axis=1)
        expected = variance * np.exp(-lag * STEP / time)
        assert abs(found.mean() - expected) < 4.0 * found.std() / np.sqrt(len(found))
    apart = STEP * np.abs(np.subtract.outer(np.arange(ROWS), np.arange(ROWS)))
    dense = variance * np.exp(-apart / time) + WHITE**2 / STEP * np.eye(ROWS)
    estimate = gm.fit(log(left[0]), again)
    scale = estimate.white_variance / (WHITE**2 / STEP)
    assert estimate.std[0] == pytest.approx(np.sqrt(scale / np.linalg.inv(dense).sum()), rel=1e-6)


@pytest.mark.law
@pytest.mark.long
def test_an_extended_model_states_hops_that_were_found(tmp_path: Path, rng: np.random.Generator):
    right, tried = 0, 5
    for _ in range(tried):
        first = gm.diagnose(hopping(rng), gm.model_from_effects(["bias"]), hold_out=False)
        gm.write_model(first.extended, tmp_path / "extended.yaml")
        extended = gm.read_model(tmp_path / "extended.yaml")
        right += "noise_telegraph" in extended.noise and (
            gm.diagnose(hopping(rng), extended, hold_out=False).verdict == "adequate"
        )
    assert binom.cdf(right, tried, 0.9) > RARE


@pytest.mark.parametrize(
    ("rest", "said"),
    [
        ("value: 1 deg/h", "needs a time_low and a time_high"),
        ("value: 1 deg/h, time_low: 3 s, time_high: 4 s, time_constant: 5 s", "has no time_constant"),
        ("value: 1 deg/h, time_low: 3 s, time_high: 4 s}\n  - {effect: noise_flicker, value: 1 deg/h", "cannot stand"),
    ],
)
def test_hops_are_stated_with_their_times_and_without_flicker(rest: str, said: str, tmp_path: Path):
    path = tmp_path / "model.yaml"
    noise = f"  - {{effect: noise_white, value: 1 deg/sqrt(h)}}\n  - {{effect: noise_telegraph, {rest}}}"
    path.write_text(f"effects: [{{effect: bias}}]\nnoise:\n{noise}\n")
    with pytest.raises(ModelError, match=said):
        gm.read_model(path)
