"""A noise level that follows a column: stated, simulated, fitted, found, and told by a calibration."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import binom

import gyromodel as gm
from gyromodel._noise_level import relative_variance, with_level
from gyromodel.compensation import compensate
from gyromodel.diagnosis._variance import growing_noise
from gyromodel.estimate import fit_many, fit_record
from gyromodel.model import Level, ModelError
from gyromodel.signals import read_signals

ROWS, STEP, N = 1000, 5.0, np.deg2rad(0.3) / 60.0
FILE = """effects: [{{effect: bias}}, {{effect: scale_factor, value: 1}}]
noise:
  - {{effect: noise_white, value: 0.3 deg/sqrt(h)}}
  - {{effect: noise_heteroscedastic, {rest}}}
"""


def rates() -> np.ndarray:
    return np.deg2rad(np.tile(np.linspace(-100.0, 100.0, 20), ROWS // 20))


def relative(values: np.ndarray, ratio: float) -> np.ndarray:
    """σ at rates over that at 50 deg/s, a straight line in ln σ."""
    return np.exp(np.log(ratio) * (np.abs(values) / np.deg2rad(100.0) - 0.5))


def campaign(rng: np.random.Generator, ratio: float) -> gm.Campaign:
    """In rad/s, of a rate table, the noise drawn here."""
    rate = rates()
    noise = rng.standard_normal(ROWS) * N / np.sqrt(STEP) * relative(rate, ratio)
    columns = {"time": np.arange(ROWS) * STEP, "rate": rate, "output": 1e-5 + rate + noise}
    return gm.Campaign(columns, {"time": "s", "rate": "rad/s", "output": "rad/s"}, {"kind": "rate"})


def stated(ratio: float, *effects: str) -> gm.GyroModel:
    model = gm.model_from_effects(list(effects) or ["bias", "scale_factor"])
    return replace(model, noise={"noise_white": N}, level=Level("rate", 0.0, np.deg2rad(100.0), ratio))


def test_weights_are_those_of_least_squares_by_hand(rng: np.random.Generator):
    measured = campaign(rng, 6.0)
    estimate = gm.fit(measured, stated(6.0))
    weight = 1.0 / relative(rates(), 6.0)
    columns = np.column_stack([np.ones(ROWS), rates()]) * weight[:, None]
    by_hand, *_ = np.linalg.lstsq(columns, measured.columns["output"] * weight, rcond=None)
    # The output is scale · (rate + bias).
    bias, scale = by_hand[0] / by_hand[1], by_hand[1]
    assert np.asarray(estimate.model.vector()) == pytest.approx([bias, scale], rel=1e-6)
    left = (measured.columns["output"] * weight - columns @ by_hand) ** 2
    spread = np.sqrt(np.linalg.inv(columns.T @ columns)[1, 1] * left.sum() / (ROWS - 2))
    assert estimate.std[1] == pytest.approx(spread, rel=1e-6)
    many = fit_many([read_signals([measured])], stated(6.0))
    assert many.values[0] == pytest.approx(np.asarray(estimate.model.vector()), rel=1e-9)


def test_a_file_says_what_it_follows_and_simulates_it(tmp_path: Path, rng: np.random.Generator):
    path = tmp_path / "model.yaml"
    path.write_text(FILE.format(rest="value: 4, driver: rate, from: 0 deg/s, to: 100 deg/s"))
    model = gm.read_model(path)
    gm.write_model(model, path)
    assert gm.read_model(path).level == model.level == Level("rate", 0.0, np.deg2rad(100.0), 4.0)
    model = model.with_vector(np.array([0.0, 1.0]))
    drawn = [gm.simulate(model, campaign(rng, 1.0), seed=int(s)) for s in rng.integers(2**31, size=20)]
    error = np.concatenate([d.columns["output"] - rates() for d in drawn])
    found, expected = error / (N / np.sqrt(STEP)), np.tile(relative(rates(), 4.0), 20)
    for level in np.unique(np.round(expected, 9)):
        here = np.isclose(expected, level)
        assert np.std(found[here]) == pytest.approx(level, rel=5.0 / np.sqrt(2.0 * here.sum()))


@pytest.mark.parametrize(
    ("rest", "said"),
    [
        ("value: 4", "needs driver"),
        ("value: 4, driver: pressure, from: 0 hPa, to: 1 hPa", "follows one of rate, temperature"),
        ("value: 4, driver: rate, from: 5 deg/s, to: 5 deg/s", "to a larger one"),
        ("value: 4, driver: rate, from: 0 degC, to: 5 deg/s", "is not in deg/s"),
        ("value: 0, driver: rate, from: 0 deg/s, to: 5 deg/s", "above zero"),
    ],
)
def test_what_it_follows_must_be_said_whole(rest: str, said: str, tmp_path: Path):
    path = tmp_path / "model.yaml"
    path.write_text(FILE.format(rest=rest))
    with pytest.raises(ModelError, match=said):
        gm.read_model(path)


def test_a_campaign_without_the_column_is_refused(rng: np.random.Generator):
    measured = campaign(rng, 2.0)
    model = replace(stated(2.0), level=Level("temperature", 0.0, 40.0, 2.0))
    with pytest.raises(ModelError, match="noise_heteroscedastic follows temperature, which the campaign lacks"):
        gm.fit(measured, model)


@pytest.mark.long
@pytest.mark.law
def test_the_extended_model_states_what_was_found_and_is_adequate(tmp_path: Path, rng: np.random.Generator):
    first = gm.diagnose(campaign(rng, 4.0), gm.model_from_effects(["bias", "scale_factor"]), hold_out=False)
    assert first.verdict == "adequate"
    gm.write_model(first.extended, tmp_path / "extended.yaml")
    extended = gm.read_model(tmp_path / "extended.yaml")
    assert extended.level is not None
    assert extended.level.ratio == pytest.approx(4.0, rel=0.35)
    assert gm.diagnose(campaign(rng, 4.0), extended, hold_out=False).verdict == "adequate"
    # One that is not as in the data is told of.
    steady = replace(extended, level=None)
    assert gm.diagnose(campaign(rng, 4.0), steady, hold_out=False).causes[0].effect == "noise_heteroscedastic"


@pytest.mark.law
def test_more_than_is_stated_beside_a_walk_that_is_not_is_stated_with_it(rng: np.random.Generator):
    walk = np.cumsum(rng.standard_normal(ROWS)) * 0.3 * N / np.sqrt(STEP)
    measured = campaign(rng, 8.0)
    measured = measured.with_column("output", measured.columns["output"] + walk, "rad/s")
    found = gm.diagnose(measured, stated(2.0), hold_out=False)
    assert "noise_heteroscedastic" in {c.effect for c in found.causes}
    assert found.extended.model.level is not None
    assert found.extended.model.level.ratio == pytest.approx(8.0, rel=0.4)
    assert found.noise["noise_heteroscedastic"]["value"] == found.extended.model.level.ratio


@pytest.mark.long
@pytest.mark.law
def test_a_level_found_beside_a_walk_holds_what_was_drawn(rng: np.random.Generator):
    model, draws = replace(stated(1.0), noise={}, level=None), 60
    # |rate| of twenty rates goes from 5.3 to 100 deg/s.
    low = np.abs(rates()).min() / np.deg2rad(100.0)
    expected, off, stds = (1.0 - low) * np.log(8.0), [], []
    for _ in range(draws):
        walk = np.cumsum(rng.standard_normal(ROWS)) * 0.2 * N / np.sqrt(STEP)
        measured = campaign(rng, 8.0)
        record = read_signals([measured.with_column("output", measured.columns["output"] + walk, "rad/s")])
        grows = growing_noise(record, fit_record(record, model))
        assert grows is not None
        stds.append(grows.ratio_std / grows.ratio)
        off.append((np.log(grows.ratio) - expected) / stds[-1])
    held = int(np.sum(np.abs(off) < 1.96))
    assert held >= binom.ppf(1e-4, draws, 0.9), f"{held} of {draws}"
    assert np.median(stds) < 0.2


def test_a_level_in_a_part_of_a_range_is_joined_to_that_of_the_whole(rng: np.random.Generator):
    model = replace(stated(1.0), level=Level("temperature", 0.0, 60.0, 4.0))
    joined, more = with_level(model, Level("temperature", 10.0, 30.0, 3.0))
    at = np.linspace(10.0, 30.0, 7)
    assert model.level is not None
    assert joined.level is not None
    apart = relative_variance(model.level, at) * relative_variance(Level("temperature", 10.0, 30.0, 3.0), at)
    together = (
        relative_variance(joined.level, at) * float(joined.noise["noise_white"] / model.noise["noise_white"]) ** 2
    )
    assert together == pytest.approx(apart, rel=1e-9)
    assert more == pytest.approx(float(joined.noise["noise_white"] / model.noise["noise_white"]))
    other = Level("rate", 0.0, 1.0, 3.0)
    assert with_level(model, other)[0].level == model.level


@pytest.mark.law
def test_a_level_that_goes_on_beyond_what_is_stated_is_stated(tmp_path: Path, rng: np.random.Generator):
    model = replace(stated(1.5), level=Level("rate", 0.0, np.deg2rad(50.0), 1.5))
    found = gm.diagnose(campaign(rng, 8.0), model, hold_out=False)
    assert "noise_heteroscedastic" in {c.effect for c in found.causes}
    gm.write_model(found.extended, tmp_path / "extended.yaml")
    extended = gm.read_model(tmp_path / "extended.yaml")
    assert gm.diagnose(campaign(rng, 8.0), extended, hold_out=False).verdict == "adequate"


def test_a_level_alone_has_the_rest_estimated(tmp_path: Path, rng: np.random.Generator):
    model = replace(stated(4.0), noise={})
    gm.write_model(model, tmp_path / "model.yaml")
    again = gm.read_model(tmp_path / "model.yaml")
    assert (again.level, dict(again.noise)) == (model.level, {})
    assert float(gm.fit(campaign(rng, 4.0), again).model.noise["noise_white"]) == pytest.approx(N, rel=0.1)


def test_a_calibration_without_the_column_of_its_level_tells_rates_without_scatter(rng: np.random.Generator):
    calibration = gm.fit(campaign(rng, 5.0), stated(5.0)).calibration()
    warm = replace(calibration, model=replace(calibration.model, level=Level("temperature", 0.0, 40.0, 2.0)))
    told = compensate(campaign(rng, 5.0), warm).columns
    assert np.isfinite(told["rate_estimated"]).all()
    assert np.isnan(told["rate_estimated_std"]).all()


def test_a_calibration_tells_the_scatter_at_the_rate_it_finds(rng: np.random.Generator):
    estimate = gm.fit(campaign(rng, 5.0), stated(5.0))
    calibration = estimate.calibration()
    told = np.deg2rad(compensate(campaign(rng, 5.0).without("rate"), calibration).columns["rate_estimated_std"])
    assert told == pytest.approx(N / np.sqrt(STEP) * relative(rates(), 5.0), rel=0.02)
