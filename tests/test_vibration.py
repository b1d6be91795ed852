"""Amplitude and phase of two sines. Expected: closed forms, the likelihood by brute force, the Cramér-Rao bound from a
Fisher matrix of differences, the χ² and binomial laws over fresh draws."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize_scalar
from scipy.stats import binom, chi2

from gyromodel.platform import SineFit, fit_sines, published_response
from gyromodel.platform._responses import _published

# One shape for all fits: samples of a record, records at once, drift and sines fitted.
SAMPLES, DRAWS, DEGREE, HARMONICS = 128, 1200, 1, 2
NOISE = np.array([4e-4, 1e-3])
# Of a true test that chance alone would fail.
CHANCE = 1e-6
# ω, ln A, ln B, θ, φ, drifts of base and table, sine and cosine of the overtones; deg, rad/s.
TRUE = np.array([10.0, np.log(0.15), np.log(0.16), 0.7, -0.02, 0.05, 0.02, -0.03, 0.01, 1e-3, -2e-3, 5e-4, 1e-3])


def signals(p: np.ndarray, time: np.ndarray) -> np.ndarray:
    """Base and table angle, in front of any noise."""
    both = []
    for k, phase in ((0, p[3] + p[4]), (1, p[3])):
        drift, overtone = p[5 + 2 * k : 7 + 2 * k], p[9 + 2 * k : 11 + 2 * k]
        fundamental = np.exp(p[1 + k]) * np.sin(p[0] * time + phase)
        second = overtone[0] * np.sin(2 * p[0] * time) + overtone[1] * np.cos(2 * p[0] * time)
        both.append(fundamental + drift[0] + drift[1] * time + second)
    return np.stack(both)


def grid(periods: float) -> np.ndarray:
    return np.arange(SAMPLES) * periods * 2 * np.pi / TRUE[0] / SAMPLES


def bound(time: np.ndarray, known: bool) -> np.ndarray:
    """Standard deviation of gain (dB) and phase (deg) that no unbiased estimate undercuts."""
    return np.linalg.norm(least_errors(time, known), axis=1)


def least_errors(time: np.ndarray, known: bool) -> np.ndarray:
    """Errors of gain (dB) and phase (deg) by the unit noises of base and table in the estimate that meets the bound."""
    steps = 1e-6 * np.eye(len(TRUE))
    columns = [(signals(TRUE + d, time) - signals(TRUE - d, time)) / 2e-6 for d in steps[1 if known else 0 :]]
    weighted = np.stack([(c / NOISE[:, None]).ravel() for c in columns], 1)
    errors = np.linalg.pinv(weighted)
    first = 0 if known else 1
    gain, phase = errors[first] - errors[first + 1], errors[first + 3]
    return np.stack([20 / np.log(10) * gain, np.rad2deg(phase)])


@partial(jax.jit, static_argnames="known")
def many(time: jax.Array, base: jax.Array, table: jax.Array, frequency: jax.Array, known: bool) -> SineFit:
    one = partial(fit_sines, known=known, degree=DEGREE, harmonics=HARMONICS)
    return jax.vmap(one, (None, 0, 0, None))(time, base, table, frequency)


def drawn(time: np.ndarray, noise: np.ndarray, known: bool) -> SineFit:
    base, table = signals(TRUE, time)[:, None] + NOISE[:, None, None] * noise
    frequency = jnp.asarray(float(TRUE[0]) * (1.0 if known else 1.03))
    return many(jnp.asarray(time), jnp.asarray(base), jnp.asarray(table), frequency, known)


@pytest.mark.parametrize("known", [True, False])
@pytest.mark.parametrize("periods", [2.0, 7.3])
def test_efficiency_and_coverage(periods: float, known: bool, rng: np.random.Generator):
    """At least 0.999 of the Cramér-Rao bound, and no more than 1; intervals that hold as often as they say.

    An unbiased estimate errs by what the best one does on the same noise and, uncorrelated with that, by an excess
    whose variance is all that it lacks: 1200 draws tell more of it than a hundred thousand do of the variance itself.
    """
    time, noise = grid(periods), rng.standard_normal((2, DRAWS, SAMPLES))
    found, least = drawn(time, noise, known), bound(time, known)
    best = least_errors(time, known) @ noise.transpose(0, 2, 1).reshape(2 * SAMPLES, DRAWS)
    true = np.array([20 / np.log(10) * (TRUE[1] - TRUE[2]), np.rad2deg(TRUE[4])])
    low, high = chi2.ppf([CHANCE, 1 - CHANCE], DRAWS - 1) / (DRAWS - 1)
    half = binom.ppf([CHANCE, 1 - CHANCE], DRAWS, 0.95)
    for k, (values, std) in enumerate(((found.gain, found.gain_std), (found.phase, found.phase_std))):
        error, std = np.asarray(values) - true[k], np.asarray(std)
        excess = error - best[k]
        assert 1 / (1 + excess.var(ddof=1) / low / least[k] ** 2) > 0.999
        # The excess is of second order in the noise, so that its products with the best error have long tails.
        product = (excess - excess.mean()) * best[k]
        assert abs(product.mean()) < 5 * product.std() / np.sqrt(DRAWS)
        assert 1 / high < least[k] ** 2 / error.var(ddof=1) < 1 / low
        assert abs(error.mean()) < 5 * least[k] / np.sqrt(DRAWS)
        # 1.979 is Student's t of 120 degrees of freedom, and those here have as many.
        assert half[0] <= np.sum(np.abs(error) < 1.979 * std) <= half[1]
    if not known:
        error = np.asarray(found.frequency) - TRUE[0]
        assert half[0] <= np.sum(np.abs(error) < 1.979 * np.asarray(found.frequency_std)) <= half[1]


@pytest.mark.parametrize("known", [True, False])
def test_exact_signals_are_met_exactly(known: bool):
    """The phase with its sign, also where θ + φ passes half a turn; uneven times and a frequency 3 % off."""
    phases = np.linspace(-3.14, 3.14, DRAWS)
    time = np.sort(np.random.default_rng(3).uniform(0.0, 2.0, SAMPLES))
    both = np.stack([signals(np.concatenate([TRUE[:4], [phase], TRUE[5:]]), time) for phase in phases], 1)
    found = many(jnp.asarray(time), *(jnp.asarray(x) for x in both), jnp.asarray(10.0 if known else 10.3), known)
    assert np.asarray(found.frequency) == pytest.approx(10.0, rel=1e-9)
    assert np.asarray(found.gain) == pytest.approx(20 * np.log10(0.15 / 0.16), abs=1e-9)
    assert np.asarray(found.phase) == pytest.approx(np.rad2deg(phases), abs=1e-8)
    assert np.asarray(found.amplitude) == pytest.approx(np.tile([0.15, 0.16], (DRAWS, 1)), rel=1e-9)


def test_the_frequency_is_the_likeliest(rng: np.random.Generator):
    """The same minimum of ln Σ residual² of both signals as a search over one least-squares fit after another."""
    time = np.sort(rng.uniform(0.0, 2.0, SAMPLES))
    both = signals(TRUE, time) + NOISE[:, None] * rng.standard_normal((2, SAMPLES))

    def cost(w: float) -> float:
        columns = np.stack([f(k * w * time) for k in (1, 2) for f in (np.sin, np.cos)] + [time**0, time], 1)
        squares = np.linalg.lstsq(columns, both.T, rcond=None)[1]
        return float(np.log(squares).sum())

    expected = minimize_scalar(cost, bounds=(9.8, 10.2), method="bounded", options={"xatol": 1e-9}).x
    base, table = (jnp.tile(jnp.asarray(x), (DRAWS, 1)) for x in both)
    found = many(jnp.asarray(time), base, table, jnp.asarray(10.3), False)
    assert float(found.frequency[0]) == pytest.approx(expected, rel=1e-7)


def correlated(rng: np.random.Generator, phase: float, noise: float, samples: int, records: int) -> list[np.ndarray]:
    """Whole periods of unit sines with equal noise."""
    angle = 2 * np.pi * 10 * np.arange(samples) / samples + 0.4
    return [np.sin(angle + p) + noise * rng.standard_normal((records, samples)) for p in (phase, 0.0)]


def test_published_equations(rng: np.random.Generator):
    base, table = correlated(rng, -0.3, 0.1, 1000, 3)
    found = published_response(jnp.asarray(base), jnp.asarray(table), 0.01, 0.01)
    a, b = (np.sqrt(2 * ((x**2).sum(1) / 1000 - 0.01)) for x in (base, table))
    assert np.asarray(found.gain) == pytest.approx(20 * np.log10(a / b))
    cosine = 2 * (base * table).sum(1) / 1000 / (a * b)
    assert np.asarray(found.phase) == pytest.approx(np.degrees([np.arccos(c) for c in cosine]))

    late, early = (published_response(*(jnp.asarray(x) for x in correlated(rng, p, 0.0, 1000, 1))) for p in (-0.3, 0.3))
    assert float(late.phase[0]) == pytest.approx(np.rad2deg(0.3))
    assert float(early.phase[0]) == pytest.approx(np.rad2deg(0.3))
    same = jnp.asarray(table)
    assert np.asarray(published_response(same, same).phase) == pytest.approx(0.0, abs=1e-5)
    for variance, sign in ((1.0, 1), (0.01, 1), (0.01, -1)):
        assert np.isnan(float(published_response(same, sign * same, variance, variance).phase[0]))


def test_published_phase_near_zero(rng: np.random.Generator):
    """Noise not taken off lifts φ = 0 to √(2(σ_x²/A² + σ_y²/B²)), and other phases to the root sum of squares; taken
    off, half of the arccos do not exist and the others are noise of the size √(2 std cos φ)."""
    noise, samples, records = 0.004, 2000, 1500
    floor = np.rad2deg(2 * noise)
    assert floor == pytest.approx(0.458, abs=1e-3)
    for phase in (0.0, np.deg2rad(0.2), np.deg2rad(3.0)):
        base, table = (jnp.asarray(x) for x in correlated(rng, -phase, noise, samples, records))
        plain = published_response(base, table)
        assert float(plain.phase.mean()) == pytest.approx(np.hypot(floor, np.rad2deg(phase)), rel=3e-3)
        if phase == 0:
            taken = np.asarray(published_response(base, table, noise**2, noise**2).phase)
            low, high = binom.ppf([CHANCE, 1 - CHANCE], records, 0.5)
            assert low <= np.isnan(taken).sum() <= high
            # 1 − cos φ is normal with the variance of Σ(x − y)²/(2n) over A²/2: E√|z| = Γ(3/4) 2^¼/√π of its root.
            spread = np.sqrt(2 * 2 * noise**4 / samples * 2)
            assert np.nanmean(taken) == pytest.approx(np.rad2deg(np.sqrt(2 * spread) * 0.8222), rel=0.1)


@pytest.mark.parametrize("periods", [1, 2, 3])
def test_the_published_estimator_takes_every_whole_period(periods: int):
    """Its last sample is one step before the end of a period."""
    time = 0.01 * np.arange(100 * periods)
    table, base = np.sin(2 * np.pi * time), 0.9 * np.sin(2 * np.pi * time - 0.3)
    gain, phase = _published(time, base, table, 2 * np.pi)
    assert gain == pytest.approx(20 * np.log10(0.9), abs=1e-6)
    assert phase == pytest.approx(np.rad2deg(0.3), abs=1e-6)
