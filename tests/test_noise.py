"""The noise family against its definitions (PSDs and Allan variances of the noise table), the restricted likelihood
against its dense formula, and estimates against simulators that share no code with it (tests/truth/noise.py)."""

from __future__ import annotations

from collections import Counter, defaultdict

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import binom, norm

from gyromodel.campaign import Campaign
from gyromodel.estimate import _noise, fit_record, with_noise_intervals
from gyromodel.model import model_from_effects
from gyromodel.noise import (
    NoiseRatios,
    coefficients,
    markov_sum,
    noise_grid,
    restricted_likelihood,
    stated_ratios,
)
from gyromodel.numerics.state_space import Sampling
from gyromodel.signals import Record, read_signals
from tests.test_state_space import covariance
from tests.truth import noise as truth
from tests.truth.designs import Design

ROWS, STEP = 256, 20.0
RARE = 1e-5  # chance that right code fails one statistical check
SEEDS = 40


def sampling(rows: int, step: float = 1.0) -> Sampling:
    return Sampling(jnp.full(rows, step), jnp.arange(rows) == 0, jnp.ones(rows, bool), jnp.ones(rows))


def allan_variance(matrix: np.ndarray, m: int) -> float:
    """Of samples averaged over m, from their covariance, at the middle of the record."""
    start = len(matrix) // 2 - m
    weights = np.zeros(len(matrix))
    weights[start : start + m], weights[start + m : start + 2 * m] = -1 / m, 1 / m
    return float(0.5 * weights @ matrix @ weights)


@pytest.mark.parametrize("samples", [100, 1000, 10**4, 10**6])
def test_flicker_spectrum_is_one_over_f_within_its_ripple(samples: int):
    """Terms of time constants at ratio ρ ripple by ±2 sech(π²/ln ρ); at the ends of the band terms are missing."""
    interval, span, flicker = 0.5, 0.5 * samples, 3.0
    noise = markov_sum(NoiseRatios(jnp.asarray(flicker), jnp.asarray(0.0)), interval, span)
    decay, variance = (np.asarray(x)[1:] for x in noise[:2])
    omega = np.geomspace(1 / span, 1 / interval, 500)
    spectrum = (2 * variance / decay / (1 + (omega[:, None] / decay) ** 2)).sum(axis=1)
    ratio = spectrum * omega / flicker
    ripple = 2 / np.cosh(np.pi**2 * (len(decay) - 1) / np.log(samples))
    assert ratio.max() < 1 + 1.05 * ripple
    assert ratio.min() > 0.6
    inside = (omega > 10 / span) & (omega < 0.1 / interval)
    missing = 2 * (2 / np.pi) * np.arctan(0.1)
    assert ratio[inside] == pytest.approx(1.0, abs=1.05 * ripple + missing)


def test_state_space_noise_has_the_allan_variances_of_the_table():
    rows, step, q = 512, 0.5, 2.0
    steps = np.array([4, 8, 16, 32, 64])
    white = np.eye(rows) * q**2
    N = float(coefficients(NoiseRatios(np.zeros(()), np.zeros(())), q**2, step)["noise_white"])
    assert [allan_variance(white, m) for m in steps] == pytest.approx(N**2 / (steps * step))

    def coloured(flicker: float, walk: float) -> np.ndarray:
        ratios = NoiseRatios(jnp.asarray(flicker), jnp.asarray(walk))
        return (covariance(markov_sum(ratios, step, rows * step), sampling(rows, step)) - np.eye(rows)) * q**2

    K = float(coefficients(NoiseRatios(np.zeros(()), np.asarray(0.3)), q**2, step)["noise_random_walk"])
    expected = K**2 * steps * step / 3 * (1 + 0.5 / steps**2)  # of samples, not of means
    assert [allan_variance(coloured(0.0, 0.3), m) for m in steps] == pytest.approx(expected)
    B = float(coefficients(NoiseRatios(np.asarray(0.3), np.zeros(())), q**2, step)["noise_flicker"])
    found = np.array([allan_variance(coloured(0.3, 0.0), m) for m in steps])
    assert found == pytest.approx(2 * np.log(2) / np.pi * B**2, rel=0.1)


def markov(q: float, constant: float) -> NoiseRatios:
    """Markov noise beside white noise of unit variance."""
    return NoiseRatios(*(jnp.asarray(r) for r in (0.0, 0.0, q**2 * constant / 2, constant)))


def design(rows: int) -> Design:
    index = np.arange(rows)
    return Design("static", STEP, index, {}, {}, {}, {}, (index, index))


def test_state_space_noise_has_the_allan_variances_of_the_independent_one():
    """Exact for a walk; flicker from a fractional integrator there and from Markov terms here."""
    B, K, steps = 3.0, 0.2, (4, 8, 16, 32, 64)
    for law, ratios, close in (
        (truth.Noise("walk", 0.0, {2.0: K}), NoiseRatios(jnp.asarray(0.0), jnp.asarray(K**2 * STEP)), 1e-9),
        (truth.Noise("flicker", 0.0, {1.0: B}), NoiseRatios(jnp.asarray(B**2), jnp.asarray(0.0)), 0.2),
    ):
        other = law.covariance(design(ROWS))
        own = covariance(markov_sum(ratios, STEP, ROWS * STEP), sampling(ROWS, STEP)) - np.eye(ROWS)
        expected = [allan_variance(other, m) for m in steps]
        assert [allan_variance(own, m) for m in steps] == pytest.approx(expected, rel=close)


def test_markov_noise_is_the_independent_one(rng: np.random.Generator):
    q, constant = 10.0 ** rng.uniform(-2, 2), STEP * 10.0 ** rng.uniform(0.5, 1.5)
    other = truth.Noise("markov", 0.0, markov=(q, constant)).covariance(design(ROWS))
    own = covariance(markov_sum(markov(q, constant), STEP, constant), sampling(ROWS, STEP)) - np.eye(ROWS)
    np.testing.assert_allclose(own, other, rtol=1e-9, atol=1e-9 * other[0, 0])


def test_stated_coefficients_are_the_ratios_they_came_from(rng: np.random.Generator):
    for ratios in (NoiseRatios(*(jnp.asarray(10.0 ** rng.uniform(-3, 1)) for _ in range(2))), markov(0.3, 70.0)):
        again = stated_ratios(coefficients(ratios, 4.0, STEP), STEP)
        assert [float(r) for r in again.each()] == pytest.approx([float(r) for r in ratios.each()], rel=1e-9)


@pytest.mark.long
def test_strong_markov_noise_is_found_with_its_size_and_time(rng: np.random.Generator):
    """White noise that a process of 20 to 40 samples exceeds 14-fold at its time constant, in 3072 samples."""
    rows, model, N = 3072, model_from_effects(["bias"]), 1e-6
    laid = with_rows(rows)
    found, inside = 0, []
    for _ in range(8):
        constant = STEP * rng.uniform(20.0, 40.0)
        q = 20.0 * N / constant
        output = truth.white(rows, STEP, N, rng) + truth.markov(rows, STEP, q, constant, rng)
        estimate = fit_record(with_output(laid, output), model)
        found += "noise_markov" in estimate.model.noise
        if "noise_markov" in estimate.model.noise:
            spans = with_noise_intervals(estimate).noise_interval
            truths = {"noise_markov": q, "noise_markov_time": constant, "noise_white": N}
            inside += [spans[name][0] <= value <= spans[name][1] for name, value in truths.items()]
    assert binom.cdf(found, 8, 0.9) > RARE
    assert binom.cdf(sum(inside), len(inside), 0.95) > RARE


def test_coefficients_are_input_rates():
    """One sample of variance 4 (rad/s)² each 25 s; ratios 0.09 and 0.01."""
    found = coefficients(NoiseRatios(np.asarray(0.09), np.asarray(0.01)), 4.0, 25.0)
    assert found == pytest.approx({"noise_white": 10.0, "noise_flicker": 0.6, "noise_random_walk": 0.04})


@pytest.mark.parametrize("samples", [41, 256, 3000])
def test_noise_cells_reach_from_invisible_to_dominant(samples: int):
    grid = noise_grid(samples, 0.5, 0.5 * samples)
    prior = np.exp(grid.log_prior)
    flicker, walk = (np.asarray(r) for r in grid.ratios[:2])
    assert prior.sum() == pytest.approx(1.0)
    assert prior[flicker == 0].sum() == pytest.approx(0.5)
    assert prior[walk == 0].sum() == pytest.approx(0.5)
    # At the record's length: white variance 1/n against B² and K²·n steps/3.
    assert flicker[flicker > 0].min() < 1 / samples
    assert walk[walk > 0].min() * samples / 3 < 2 / samples
    assert flicker.max() >= 10
    assert walk.max() >= 3
    for levels in (np.unique(flicker)[1:], np.unique(walk)[1:]):
        assert (levels[1:] / levels[:-1]).max() < 10.0  # half a decade of amplitude


def test_few_samples_have_white_noise():
    grid = noise_grid(30, 1.0, 30.0)
    assert np.array_equal(grid.ratios.flicker, [0.0])
    assert np.array_equal(grid.ratios.walk, [0.0])


@pytest.mark.parametrize("parameters", [0, 1, 3])
def test_restricted_likelihood_is_the_dense_formula(parameters: int, rng: np.random.Generator):
    rows, cells, span = 80, 37, 90.0
    present = rng.random(rows) < 0.8
    restart = np.isin(np.arange(rows), [0, 50])
    laid = Sampling(
        *(jnp.asarray(x) for x in (rng.uniform(0.5, 2.0, rows), restart, present, rng.uniform(0.5, 2, rows)))
    )
    ratios = NoiseRatios(*(jnp.asarray(10.0 ** rng.uniform(-3, 1, cells)) for _ in range(2)))
    matrix = rng.standard_normal((rows, parameters)) * np.geomspace(1e-6, 1e3, parameters or 1)[:parameters]
    residual = rng.standard_normal(rows)
    result = restricted_likelihood(ratios, 1.0, span, laid, jnp.asarray(matrix), jnp.asarray(residual))
    x, r = matrix[present], residual[present]
    for k in range(cells):
        cell = NoiseRatios(ratios.flicker[k], ratios.walk[k])
        total = covariance(markov_sum(cell, 1.0, span), laid)[np.ix_(present, present)]
        weight = np.linalg.inv(total)
        scale = np.abs(x).max(axis=0, initial=1e-300)
        information = (x / scale).T @ weight @ (x / scale)
        fitted = (x / scale) @ np.linalg.solve(information, (x / scale).T @ weight @ r)
        rss = (r - fitted) @ weight @ (r - fitted)
        nu = len(r) - parameters
        log_information = np.linalg.slogdet(information)[1] + 2 * np.log(scale).sum()
        expected = -0.5 * np.linalg.slogdet(total)[1] - 0.5 * log_information - 0.5 * nu * np.log(rss)
        assert result.log_likelihood[k] == pytest.approx(expected, rel=1e-9)
        assert result.residual_sum[k] == pytest.approx(rss, rel=1e-9)
    assert result.degrees_of_freedom == nu


def with_output(record: Record, values: np.ndarray) -> Record:
    return record._replace(signals=record.signals | {"output": jnp.asarray(values)})


def with_rows(rows: int) -> Record:
    columns = {"time": np.arange(rows) * STEP, "output": np.arange(rows) % 2.0}
    return read_signals(Campaign(columns, {"time": "s", "output": "rad/s"}, {"kind": "rate"}))


@pytest.mark.long
def test_intervals_cover_independently_simulated_noise(rng: np.random.Generator):
    """N, B and K of white, flicker, random walk and both, levels as in a real gyro: 95 % by the binomial law."""
    record, model = with_rows(ROWS), model_from_effects(["bias"])
    ids = {"noise_white": None, "noise_flicker": 1.0, "noise_random_walk": 2.0}
    inside: dict[str, list[bool]] = defaultdict(list)
    ratio: dict[str, list[float]] = defaultdict(list)
    reach: dict[str, list[float]] = defaultdict(list)
    for seed in range(SEEDS):
        law = truth.draw(truth.FAMILY[seed % 4], design(ROWS), rng)
        estimate = fit_record(with_output(record, law.sample(design(ROWS), rng)), model, markov=False)
        estimate = with_noise_intervals(estimate)
        for name, alpha in ids.items():
            level = law.white if alpha is None else law.fractional.get(alpha, 0.0)
            low, high = estimate.noise_interval[name]
            value = float(estimate.model.noise[name])
            assert low * (1 - 1e-9) <= value <= high * (1 + 1e-9)
            inside[name].append(low <= level <= high)
            if level:
                ratio[name].append(value / level)
                reach[name].append(high / level)
    for name, hits in inside.items():
        assert binom.cdf(sum(hits), len(hits), 0.95) > RARE, (name, sum(hits))
    assert np.median(ratio["noise_white"]) == pytest.approx(1.0, abs=0.1)
    # Of 800 draws each: below a tenth 15 and 27 %, above 1.7 1 and 7 %, reach beyond four times 0 and 9 %.
    for name in ("noise_flicker", "noise_random_walk"):
        value, high = np.array(ratio[name]), np.array(reach[name])
        for outside, share in ((value < 0.1, 0.3), (value > 1.7, 0.1), (high > 4.0, 0.1)):
            assert binom.sf(outside.sum() - 1, len(outside), share) > RARE, (name, value, high)


@pytest.mark.parametrize("N", [0.0, 4e-5])
def test_intervals_of_markov_noise_hold_what_was_fitted_and_what_is_true(N: float, rng: np.random.Generator):
    """With white noise beside it, and with none, when all ratios above some are as likely."""
    record, model = with_rows(ROWS), model_from_effects(["bias"])
    truths = {"noise_markov": 3e-6, "noise_markov_time": 80.0} | ({"noise_white": N} if N else {})
    inside = Counter[str]()
    for _ in range(8):
        noise = truth.white(ROWS, STEP, N, rng) + truth.markov(ROWS, STEP, 3e-6, 80.0, rng)
        estimate = with_noise_intervals(fit_record(with_output(record, noise), model, markov=True))
        for name, true in truths.items():
            low, high = estimate.noise_interval[name]
            assert low * (1 - 1e-9) <= float(estimate.model.noise[name]) <= high * (1 + 1e-9), name
            inside[name] += low <= true <= high
    for name, hits in inside.items():
        assert binom.cdf(hits, 8, 0.93) > 1e-4, (name, hits)


@pytest.mark.parametrize("walk", [0.0, 0.002, 0.05])
def test_intervals_are_those_of_many_levels(walk: float, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch):
    """White noise with none, little and much of a walk beside it: the best ratio is often a small part of its bound."""
    record, model = with_rows(1024), model_from_effects(["bias"])
    for _ in range(5):
        output = rng.standard_normal(1024) + walk * np.cumsum(rng.standard_normal(1024))
        estimate = fit_record(with_output(record, output), model, markov=False)
        few = with_noise_intervals(estimate).noise_interval
        with monkeypatch.context() as patched:
            patched.setattr(_noise, "INTERVAL_LEVELS", 36)
            patched.setattr(_noise, "FINER_LEVELS", 181)
            many = with_noise_intervals(estimate).noise_interval
        for name, (low, high) in few.items():
            assert high == pytest.approx(many[name][1], rel=0.1), name
            assert low == pytest.approx(many[name][0], abs=0.1 * high), name


def test_white_noise_shows_no_other(rng: np.random.Generator):
    """The interval of what is absent begins at zero and ends below what a record of this length would show."""
    record, model = with_rows(ROWS), model_from_effects(["bias"])
    N = 1e-6
    shown = 0
    for _ in range(12):
        output = truth.white(ROWS, STEP, N, rng)
        estimate = with_noise_intervals(fit_record(with_output(record, output), model))
        low = [estimate.noise_interval[name][0] for name in ("noise_flicker", "noise_random_walk")]
        shown += max(low) > 0
        assert estimate.noise_interval["noise_flicker"][1] < N / np.sqrt(STEP)
        assert float(estimate.model.noise["noise_white"]) == pytest.approx(
            N, rel=norm.isf(RARE) / np.sqrt(2 * ROWS) + 0.1
        )
    assert binom.sf(shown - 1, 12, 0.05) > RARE


@pytest.mark.parametrize(
    ("kind", "other"),
    [pytest.param("flicker", "noise_random_walk", marks=pytest.mark.long), ("random_walk", "noise_flicker")],
)
def test_strong_noise_is_told_by_its_colour(kind: str, other: str, rng: np.random.Generator):
    """One hundred times the white variance at the record's length: of 200 draws 90 % (flicker) and 97 % (walk) are."""
    record, model = with_rows(ROWS), model_from_effects(["bias"])
    N, told = 1e-6, []
    for _ in range(SEEDS):
        coloured = truth.flicker(ROWS, STEP, 2 * N / np.sqrt(STEP), rng)
        if kind == "random_walk":
            coloured = truth.random_walk(ROWS, STEP, 0.5 * N / STEP, rng)
        estimate = fit_record(with_output(record, coloured + truth.white(ROWS, STEP, N, rng)), model)
        at_length = {  # Allan deviations at a quarter of the record
            "noise_flicker": 0.664 * float(estimate.model.noise.get("noise_flicker", 0.0)),
            "noise_random_walk": float(estimate.model.noise.get("noise_random_walk", 0.0)) * np.sqrt(ROWS * STEP / 12),
        }
        told.append(at_length[f"noise_{kind}"] > at_length[other])
    assert binom.cdf(sum(told), SEEDS, 0.85) > RARE, sum(told)
