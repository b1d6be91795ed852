"""Whitening in O(n) against the dense Cholesky factor of the covariance written down from its definition."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import solve_triangular

from gyromodel.numerics.state_space import (
    Filter,
    MarkovSum,
    Sampling,
    build_filter,
    colour,
    step_and_pulse_energy,
    whiten,
    whiten_transposed,
)

ROWS, STATES = 60, 4
CLOSE = 1e-10

traces: list[str] = []


@jax.jit
def run(noise: MarkovSum, sampling: Sampling, columns, draws):
    """Everything the filter does, compiled together."""
    traces.append("run")
    filter = build_filter(noise, sampling)
    return (
        whiten(filter, columns),
        whiten_transposed(filter, columns),
        colour(filter, draws),
        filter.log_determinant,
        step_and_pulse_energy(filter),
    )


class Case(NamedTuple):
    """A sampling with the dense Cholesky factor of the rows present."""

    noise: MarkovSum
    sampling: Sampling
    present: np.ndarray
    factor: np.ndarray


def covariance(noise: MarkovSum, sampling: Sampling) -> np.ndarray:
    """Covariance of all rows: exp(−|t − s|/τ) for a decaying process, min(t, s) for a walk, zero between records.

    Of white noise of the integral a sample is the change over its own time, the usual one where it follows on none.
    """
    interval, restart = np.asarray(sampling.interval), np.asarray(sampling.restart)
    record = np.cumsum(restart)
    time = np.zeros(len(interval))
    for number in np.unique(record):
        rows = record == number
        time[rows] = np.cumsum(np.where(restart[rows], 0.0, interval[rows]))
    total = np.diag(np.asarray(sampling.white))
    if noise.integral is not None:
        rows, usual = np.arange(len(interval)), float(noise.interval)
        follows = ~restart & (interval <= 1.5 * usual)
        own = np.where(follows, interval, usual)
        # Of each sample's errors at its start (in column 0 on) and its end.
        change = np.zeros((len(rows), 2 * len(rows)))
        change[rows, len(rows) + rows] = 1.0 / own
        change[rows, np.where(follows, len(rows) + rows - 1, rows)] = -1.0 / own
        total = total + float(noise.integral) * change @ change.T
    for decay, variance in zip(np.asarray(noise.decay), np.asarray(noise.variance), strict=True):
        if decay > 0:
            part = variance * np.exp(-decay * np.abs(time[:, None] - time))
        else:
            part = variance * np.minimum(time[:, None], time)
        total = total + part * (record[:, None] == record)
    return total


def draw(rng: np.random.Generator, kind: str, integral: bool = False) -> Case:
    """Random processes, with white noise of the integral or without, and a random sampling of one kind."""
    decay = np.concatenate([[0.0], 10.0 ** rng.uniform(-3, 0.5, STATES - 1)])
    noise = MarkovSum(jnp.asarray(decay), jnp.asarray(10.0 ** rng.uniform(-3, 1.5, STATES)))
    if integral:
        noise = noise._replace(integral=jnp.asarray(10.0 ** rng.uniform(-2, 2)), interval=jnp.asarray(1.0))
    interval, white = np.ones(ROWS), np.ones(ROWS)
    restart, present = np.arange(ROWS) == 0, np.ones(ROWS, bool)
    if kind in ("unequal steps", "everything"):
        interval = rng.uniform(0.1, 3.0, ROWS) * np.where(rng.random(ROWS) < 0.1, 50.0, 1.0)
    if kind in ("missing samples", "everything"):
        present = rng.random(ROWS) < 0.7
    if kind in ("restarts", "everything"):
        restart[rng.choice(np.arange(1, ROWS), 3, replace=False)] = True
    if kind in ("relative white variances", "everything"):
        white = rng.uniform(0.2, 5.0, ROWS)
    sampling = Sampling(*(jnp.asarray(x) for x in (interval, restart, present, white)))
    dense = covariance(noise, sampling)[np.ix_(present, present)]
    return Case(noise, sampling, present, np.linalg.cholesky(dense))


KINDS = ("even", "unequal steps", "missing samples", "restarts", "relative white variances", "everything")


@pytest.mark.parametrize("integral", [False, True])
@pytest.mark.parametrize("kind", KINDS)
def test_filter_is_the_dense_cholesky_factor(kind: str, integral: bool, rng: np.random.Generator):
    for _ in range(5):
        case = draw(rng, kind, integral)
        columns, draws = rng.standard_normal((ROWS, 3)), rng.standard_normal(ROWS)
        white, transposed, coloured, log_determinant, (steps, pulses) = (
            jax.tree.map(np.asarray, x)
            for x in run(case.noise, case.sampling, jnp.asarray(columns), jnp.asarray(draws))
        )
        here = case.present
        lower = case.factor
        assert white[here] == pytest.approx(solve_triangular(lower, columns[here], lower=True), rel=CLOSE, abs=CLOSE)
        expected = solve_triangular(lower.T, columns[here], lower=False)
        assert transposed[here] == pytest.approx(expected, rel=CLOSE, abs=CLOSE)
        assert coloured[here] == pytest.approx(lower @ draws[here], rel=CLOSE, abs=CLOSE)
        assert not white[~here].any()
        assert not transposed[~here].any()
        assert not coloured[~here].any()
        assert log_determinant == pytest.approx(2 * np.log(np.diag(lower)).sum(), rel=CLOSE, abs=CLOSE)

        inverse = solve_triangular(lower, np.eye(here.sum()), lower=True)
        step_shapes = np.tril(np.ones((ROWS, ROWS)))[here]  # column k: a step from row k on
        assert steps == pytest.approx(((inverse @ step_shapes) ** 2).sum(0), rel=CLOSE, abs=CLOSE)
        assert pulses[here] == pytest.approx((inverse**2).sum(0), rel=CLOSE, abs=CLOSE)
        assert not pulses[~here].any()


def test_values_of_missing_samples_do_not_matter(rng: np.random.Generator):
    case = draw(rng, "everything")
    columns, draws = rng.standard_normal((ROWS, 3)), jnp.asarray(rng.standard_normal(ROWS))
    holes = np.where(case.present[:, None], columns, np.nan)
    plain = run(case.noise, case.sampling, jnp.asarray(columns), draws)
    pierced = run(case.noise, case.sampling, jnp.asarray(holes), draws)
    assert np.array_equal(plain[0], pierced[0])
    assert np.array_equal(plain[1], pierced[1])


def test_white_noise_alone_divides_by_its_standard_deviation(rng: np.random.Generator):
    case = draw(rng, "relative white variances")
    silent = MarkovSum(case.noise.decay, jnp.zeros(STATES))
    columns = rng.standard_normal((ROWS, 3))
    white = run(silent, case.sampling, jnp.asarray(columns), jnp.zeros(ROWS))[0]
    assert white == pytest.approx(columns / np.sqrt(np.asarray(case.sampling.white))[:, None], rel=1e-14)


def test_compiled_once_whatever_the_values(rng: np.random.Generator):
    case = draw(rng, "even")
    run(case.noise, case.sampling, jnp.zeros((ROWS, 3)), jnp.zeros(ROWS))
    before = len(traces)
    for kind in KINDS:
        case = draw(rng, kind)
        run(case.noise, case.sampling, jnp.ones((ROWS, 3)), jnp.ones(ROWS))
    assert len(traces) == before


def test_cells_side_by_side_are_each_alone(rng: np.random.Generator):
    """V⁻¹x of several noises of the same decays at once."""
    rows = 50
    decay, variance = jnp.array([0.0, 0.2]), jnp.asarray(rng.uniform(0.0, 2.0, (2, 3)))
    even = Sampling(jnp.ones(rows), jnp.arange(rows) == 0, jnp.asarray(rng.random(rows) < 0.8), jnp.ones(rows))
    columns = jnp.asarray(rng.standard_normal((rows, 4)))

    def precision(variance: jax.Array) -> np.ndarray:
        filter = build_filter(MarkovSum(decay, variance), even)
        return np.asarray(whiten_transposed(filter, whiten(filter, columns)))

    together = precision(variance)
    for cell in range(3):
        assert together[..., cell] == pytest.approx(precision(variance[:, cell]), rel=1e-12, abs=1e-14)


def test_long_record_keeps_its_precision(rng: np.random.Generator):
    """A process 10⁸ times the white variance, sampled 10⁴ times within its correlation time."""
    rows = 2000
    noise = MarkovSum(jnp.asarray([0.0, 1e-4]), jnp.asarray([1e-2, 1e8]))
    sampling = Sampling(jnp.ones(rows), jnp.arange(rows) == 0, jnp.ones(rows, bool), jnp.ones(rows))
    filter = jax.jit(build_filter)(noise, sampling)
    assert isinstance(filter, Filter)
    lower = np.linalg.cholesky(covariance(noise, sampling))
    columns = rng.standard_normal((rows, 1))
    expected = solve_triangular(lower, columns, lower=True)
    assert np.asarray(whiten(filter, jnp.asarray(columns))) == pytest.approx(expected, abs=1e-6)
    assert float(filter.log_determinant) == pytest.approx(2 * np.log(np.diag(lower)).sum(), rel=1e-8)


def test_a_constant_of_its_own_takes_away_the_mean(rng: np.random.Generator):
    """Whitened beside a constant of large variance, data and data plus a constant of each record are the same."""
    rows = 60
    restart = np.arange(rows) % 30 == 0
    sampling = Sampling(
        jnp.full(rows, 0.5), jnp.asarray(restart), jnp.ones(rows, bool), jnp.ones(rows), jnp.full(rows, 1e6)
    )
    noise = MarkovSum(jnp.array([0.0, 0.3]), jnp.array([0.2, 0.5]))
    dense = covariance(noise, sampling._replace(start=None))
    dense += 1e6 * (np.cumsum(restart)[:, None] == np.cumsum(restart))
    x = rng.standard_normal((rows, 1))
    filter = build_filter(noise, sampling)
    w = np.asarray(whiten(filter, jnp.asarray(x)))
    assert (w.T @ w).item() == pytest.approx((x.T @ np.linalg.solve(dense, x)).item(), rel=1e-6)
    assert float(filter.log_determinant) == pytest.approx(np.linalg.slogdet(dense)[1], rel=1e-8)
    moved = whiten(filter, jnp.asarray(x + np.cumsum(restart)[:, None]))
    # Of a constant of 2, the prior of 1000 leaves 2e-3 in the first sample.
    assert np.asarray(moved) == pytest.approx(w, abs=2.1e-3)
