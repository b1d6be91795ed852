"""White noise of the angle beside that of the rate, against an angle that is counted and dense covariances."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.stats import binom

import gyromodel as gm
from gyromodel.compensation import compensate
from gyromodel.estimate import fit_many
from gyromodel.model import ModelError
from gyromodel.signals import read_signals
from tests.truth import noise as truth

ROWS, STEP = 900, 10.0
N = np.deg2rad(0.002) / 60.0  # 0.002 deg/sqrt(h)
COUNT = np.deg2rad(2.0 / 3600.0)  # of an angle that is counted
Q = COUNT / np.sqrt(12.0)
RARE = 1e-4
DEG_H = np.deg2rad(1.0 / 3600.0)


def temperature() -> np.ndarray:
    """Up and down once, from 10 to 40 degC."""
    return 25.0 + 15.0 * np.interp(np.arange(ROWS) / ROWS, [0.0, 0.3, 0.7, 1.0], [-1.0, 1.0, -1.0, 0.5])


def counted(rng: np.random.Generator, slope: float = 0.0) -> gm.Campaign:
    """A log at rest of a counted angle; `slope` in deg/h per degC."""
    rate = (8.0 + slope * (temperature() - 25.0)) * DEG_H + truth.white(ROWS, STEP, N, rng)
    return log(truth.shaken(rate, STEP, COUNT, rng))


def log(output: np.ndarray) -> gm.Campaign:
    """In rad/s."""
    columns = {"time": np.arange(len(output)) * STEP, "temperature": temperature(), "output": output}
    return gm.Campaign(columns, {"time": "s", "temperature": "degC", "output": "rad/s"}, {"kind": "rate"})


def stated(*effects: str, white: float = N, angle: float = Q) -> gm.GyroModel:
    return replace(gm.model_from_effects(list(effects)), noise={"noise_white": white, "noise_quantisation": angle})


@pytest.mark.law
def test_both_kinds_have_their_size_and_fits_the_uncertainty_that_they_leave(rng: np.random.Generator):
    """Taken for white noise of the rate, the counts would make the bias eight times as uncertain."""
    draws, inside, held = 12, dict.fromkeys(("noise_white", "noise_quantisation"), 0), 0
    dense = truth.Noise("white", N).covariance(truth_design())
    change = np.eye(ROWS) - np.eye(ROWS, k=-1)
    dense += (Q / STEP) ** 2 * (change @ change.T + np.outer(np.eye(ROWS)[0], np.eye(ROWS)[0]))
    columns = np.column_stack([np.ones(ROWS), temperature() - 25.0])
    best = np.sqrt(np.diag(np.linalg.inv(columns.T @ np.linalg.solve(dense, columns))))
    ratios = []
    for _ in range(draws):
        estimate = gm.fit(counted(rng), gm.model_from_effects(["bias", "bias_temperature"]))
        for name, size in (("noise_white", N), ("noise_quantisation", Q)):
            low, high = estimate.noise_interval.get(name, (0.0, 0.0))
            inside[name] += low <= size <= high
        held += abs(float(estimate.model.vector()[1])) < 1.96 * estimate.std[1]
        ratios.append(estimate.std / best)
    assert binom.cdf(min(inside.values()), draws, 0.95) > RARE
    assert binom.cdf(held, draws, 0.93) > RARE
    # Slow noise that would not show leaves a bias less certain than the noise that there is.
    bias, coefficient = np.median(ratios, axis=0)
    assert 1.0 < bias < 2.0
    assert coefficient == pytest.approx(1.0, rel=0.25)


def truth_design():
    from tests.truth.designs import Design

    index = np.arange(ROWS)
    return Design("static", STEP, index, {}, {}, {}, {}, (index, index))


def test_what_is_stated_is_written_read_and_simulated(tmp_path: Path, rng: np.random.Generator):
    model = replace(gm.model_from_effects(["bias"]), noise={"noise_white": 1e-9, "noise_quantisation": Q})
    model = model.with_vector(np.array([8.0 * DEG_H]))
    gm.write_model(model, tmp_path / "model.yaml")
    again = gm.read_model(tmp_path / "model.yaml")
    assert float(again.noise["noise_quantisation"]) == pytest.approx(Q)
    # Of the angle what is left is white, and of variance Q².
    angle = STEP * np.cumsum(
        gm.simulate(again, log(np.arange(float(ROWS))), seed=int(rng.integers(2**31))).columns["output"]
    )
    left = angle - np.arange(1, ROWS + 1) * STEP * 8.0 * DEG_H
    assert np.var(left) == pytest.approx(Q**2, rel=5.0 * np.sqrt(2.0 / ROWS))
    correlation = np.corrcoef(left[1:], left[:-1])[0, 1]
    assert abs(correlation) < 4.0 / np.sqrt(ROWS)


def test_it_is_no_noise_of_a_platform(tmp_path: Path):
    path = tmp_path / "model.yaml"
    path.write_text("effects:\n  - effect: platform_drift\nnoise:\n  - {effect: noise_quantisation, value: 1 arcsec}\n")
    with pytest.raises(ModelError, match="is noise of a rate, and not of the angle of a platform's base"):
        gm.read_model(path)


@pytest.mark.long
@pytest.mark.law
def test_an_effect_below_what_counts_as_white_noise_is_named(rng: np.random.Generator):
    """A temperature coefficient that would be lost at a third of its uncertainty were the counts white noise."""
    found = gm.diagnose(counted(rng, 4e-3), gm.model_from_effects(["bias"]), hold_out=False)
    assert found.verdict in ("named", "ambiguous")
    assert "bias_temperature" in {c.effect for c in found.causes}
    assert "noise_quantisation" in found.noise
    first = next(iter(found.noise_kinds))
    # Flicker that is not there has the larger share in four of ten logs.
    assert first in ("noise_white + noise_quantisation", "noise_white + noise_flicker + noise_quantisation")


@pytest.mark.long
def test_an_extended_model_states_what_was_found_and_is_adequate(tmp_path: Path, rng: np.random.Generator):
    first = gm.diagnose(counted(rng, 8e-3), gm.model_from_effects(["bias"]), hold_out=False)
    gm.write_model(first.extended, tmp_path / "extended.yaml")
    extended = gm.read_model(tmp_path / "extended.yaml")
    assert "noise_quantisation" in extended.noise
    assert gm.diagnose(counted(rng, 8e-3), extended, hold_out=False).verdict == "adequate"


@pytest.mark.law
def test_stated_white_noise_alone_lacks_it(rng: np.random.Generator):
    model = replace(gm.model_from_effects(["bias"]), noise={"noise_white": np.sqrt(N**2 + 2.0 * Q**2 / STEP)})
    found = gm.diagnose(counted(rng), model, hold_out=False)
    assert "noise_quantisation" in {c.effect for c in found.causes}
    assert gm.diagnose(counted(rng), found.extended.model, hold_out=False).verdict == "adequate"


@pytest.mark.law
@pytest.mark.parametrize("kind", ["differenced twice", "alternating"])
def test_what_falls_apart_otherwise_is_no_firm_count(kind: str, rng: np.random.Generator):
    """White noise differenced twice, and noise that turns its sign from sample to sample, of a known level."""
    model, adequate = replace(gm.model_from_effects(["bias"]), noise={"noise_white": N}), 0
    for _ in range(4):
        noise = rng.standard_normal(ROWS + 200)
        twice = kind == "differenced twice"
        left = (np.diff(noise, 2) / np.sqrt(6.0) if twice else lfilter([0.8], [1.0, 0.6], noise))[-ROWS:]
        found = gm.diagnose(log(4e-5 + N / np.sqrt(STEP) * left), model, hold_out=False)
        if found.verdict == "adequate":
            adequate += 1
            assert any("does not explain what is left" in line for line in found.findings)
    # 358 of 360 draws are.
    assert adequate >= 3


def test_many_fits_are_those_of_one_by_one(rng: np.random.Generator):
    campaigns = [counted(rng, 0.01) for _ in range(3)]
    model = stated("bias", "bias_temperature")
    many = fit_many([read_signals([c]) for c in campaigns], model)
    for k, campaign in enumerate(campaigns):
        one = gm.fit(campaign, model)
        assert many.values[k] == pytest.approx(np.asarray(one.model.vector()), rel=1e-6)
        assert np.sqrt(np.diag(many.covariance[k])) == pytest.approx(one.std, rel=1e-6)


def test_a_calibration_tells_the_scatter_of_a_sample(rng: np.random.Generator):
    estimate = gm.fit(counted(rng), stated("bias"))
    told = compensate(counted(rng), estimate.calibration()).columns["rate_estimated_std"]
    expected = np.sqrt(N**2 / STEP + 2.0 * Q**2 / STEP**2 + estimate.std[0] ** 2)
    assert np.deg2rad(told) == pytest.approx(np.full(ROWS, expected), rel=1e-6)
