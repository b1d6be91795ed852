"""Deviations against allantools on the same input, against the sums written down from their definitions where samples
are missing, and against published values: the ten- and the thousand-point sets of NIST Special Publication 1065
(section 12.4, tables 31 and 32). Degrees of freedom against allantools' Greenhall algorithm and against scatter."""

from __future__ import annotations

import gzip
import inspect
import json
from collections.abc import Callable
from pathlib import Path

import allantools
import numpy as np
import pytest
from allantools import ci
from scipy.stats import binom

from gyromodel.noise import deviation
from gyromodel.noise._deviation import _freedom

PEERS = {
    "allan": allantools.oadev,
    "modified": allantools.mdev,
    "hadamard": allantools.ohdev,
    "total": allantools.totdev,
}
RARE = 1e-5
# W. J. Riley, NIST SP 1065, table 31: ten frequencies, and deviations of them at one and two samples.
TEN = np.array([892.0, 809, 823, 798, 671, 644, 883, 903, 677])


def thousand() -> np.ndarray:
    """The thousand points: n → 16807 n mod 2147483647 from 1234567890, over the modulus (NIST SP 1065, 12.4)."""
    values, n = [], 1234567890
    for _ in range(1000):
        values.append(n / 2147483647)
        n = 16807 * n % 2147483647
    return np.array(values)


@pytest.mark.parametrize(
    ("estimator", "expected"),
    [
        ("allan", [2.922319e-01, 9.159953e-02, 3.241343e-02]),
        ("modified", [2.922319e-01, 6.172376e-02, 2.170921e-02]),
        ("hadamard", [2.943883e-01, 9.581083e-02, 3.237638e-02]),
        ("total", [2.922319e-01, 9.134743e-02, 3.406530e-02]),
    ],
)
def test_thousand_published_points(estimator: str, expected: list[float]):
    """Table 32: averaging over 1, 10 and 100 samples."""
    found = deviation(thousand(), 1.0, estimator, np.array([1, 10, 100]))
    assert found.deviation == pytest.approx(expected, rel=2e-7)


def test_nine_published_points():
    """Frequencies whose overlapping Allan deviations the NBS handbook prints: 91.22945 and 85.95287."""
    found = deviation(TEN, 1.0, "allan", np.array([1, 2]))
    assert found.deviation == pytest.approx([91.22945, 85.95287], abs=1e-5)
    assert deviation(TEN, 1.0, "total", np.array([1, 2])).deviation == pytest.approx([91.22945, 93.90379], abs=1e-5)
    assert deviation(TEN, 1.0, "modified", np.array([1, 2])).deviation == pytest.approx([91.22945, 74.78849], abs=1e-5)
    assert deviation(TEN, 1.0, "hadamard", np.array([1, 2])).deviation == pytest.approx([70.80608, 85.61487], abs=1e-5)


@pytest.mark.parametrize("estimator", PEERS)
@pytest.mark.parametrize(("rows", "offset"), [(37, 0.0), (1000, 1e3), (30_001, -5.0)])
def test_equals_allantools(estimator: str, rows: int, offset: float, rng: np.random.Generator):
    rate = rng.standard_normal(rows) + offset
    own = deviation(rate, 0.25, estimator)
    tau, expected, _, terms = PEERS[estimator](rate, rate=4.0, data_type="freq", taus=own.tau)
    assert own.tau[: len(tau)] == pytest.approx(tau)
    assert own.deviation[: len(tau)] == pytest.approx(expected, rel=1e-12)
    assert np.array_equal(own.terms[: len(tau)], terms)


def by_definition(rate: np.ndarray, m: int, estimator: str) -> tuple[float, int]:
    """Mean square and number of terms, each term written down from samples: NaN where one of them is missing."""
    n = len(rate)
    means = np.array([rate[i : i + m].mean() for i in range(n - m + 1)])
    if estimator == "hadamard":
        terms = means[2 * m :] - 2 * means[m:-m] + means[: -2 * m]
        scale = 6.0
    else:
        terms, scale = means[m:] - means[:-m], 2.0
        if estimator == "modified":
            terms = np.array([terms[i : i + m].mean() for i in range(len(terms) - m + 1)])
    good = terms[np.isfinite(terms)]
    return float(np.sum(good**2) / (scale * max(len(good), 1))), len(good)


def total_by_definition(rate: np.ndarray, m: int) -> tuple[float, int]:
    """Each stretch of two lengths reflected at its ends, differences about its inner angles, all pooled."""
    squares: list[float] = []
    for run in np.split(rate, np.flatnonzero(np.isnan(rate))):
        run = run[np.isfinite(run)]
        x = np.concatenate([[0.0], np.cumsum(run)])
        n = len(x)
        if n - 1 < 2 * m:
            continue
        before, after = 2 * x[0] - x[1:][::-1], 2 * x[-1] - x[:-1][::-1]
        y = np.concatenate([before, x, after])
        squares += [(y[n - 1 + i - m] - 2 * y[n - 1 + i] + y[n - 1 + i + m]) ** 2 for i in range(1, n - 1)]
    return float(np.sum(squares) / (2.0 * m**2 * max(len(squares), 1))), len(squares)


@pytest.mark.parametrize("estimator", PEERS)
@pytest.mark.parametrize("pattern", ["single", "random", "bursts"])
def test_only_terms_whose_samples_are_all_there_count(estimator: str, pattern: str, rng: np.random.Generator):
    rows = 2200  # more than one block of the fast sum
    rate = 7.0 + rng.standard_normal(rows).cumsum()
    if pattern == "single":
        rate[1234] = np.nan
    elif pattern == "random":
        rate[rng.random(rows) < 0.05] = np.nan
    else:
        for start in rng.integers(0, rows, 8):
            rate[start : start + 60] = np.nan
    lengths = np.array([1, 2, 5, 16, 61])
    found = deviation(rate, 1.0, estimator, lengths)
    definition = total_by_definition if estimator == "total" else lambda r, m: by_definition(r, m, estimator)
    expected = [definition(rate, int(m)) for m in lengths]
    expected = [(v, count) for v, count in expected if count]
    assert found.terms.tolist() == [count for _, count in expected]
    assert found.deviation**2 == pytest.approx([v for v, _ in expected], rel=1e-9)


def test_one_missing_sample_stands_for_a_gap_of_any_length(rng: np.random.Generator):
    rate = rng.standard_normal(600)
    short, long = (np.insert(rate, [200] * k, np.nan) for k in (1, 150))
    for estimator in PEERS:
        a, b = (deviation(r, 1.0, estimator, np.array([1, 4, 32])) for r in (short, long))
        assert a.deviation == pytest.approx(b.deviation, rel=1e-12)
        assert np.array_equal(a.terms, b.terms)


def test_modified_deviation_keeps_its_digits(rng: np.random.Generator):
    """A random walk, whose double sum has ten digits more than its differences; extended precision is the judge."""
    rate = rng.standard_normal(20_000).cumsum()
    total = np.concatenate([[0], np.cumsum(np.concatenate([[0], np.cumsum(rate.astype(np.longdouble))]))])
    for m in (1, 10, 1000):
        d = total[3 * m :] - 3 * total[2 * m : -m] + 3 * total[m : -2 * m] - total[: -3 * m]
        expected = float(np.sqrt(np.mean(d**2) / (2 * np.longdouble(m) ** 4)))
        assert deviation(rate, 1.0, "modified", np.array([m])).deviation[0] == pytest.approx(expected, rel=1e-10)


@pytest.mark.parametrize(("estimator", "order"), [("allan", 2), ("modified", 2), ("hadamard", 3)])
@pytest.mark.parametrize("exponent", [2, 0, -1, -2])
@pytest.mark.parametrize("length", [8, 64])
def test_degrees_of_freedom_are_greenhalls(estimator: str, order: int, exponent: int, length: int):
    """His sums leave out the shortest scales, as ours do at lengths of 16 and more: 10 % at 8 samples."""
    angles = 2001
    modified = estimator == "modified"
    terms = angles - 3 * length + 1 if modified else angles - order * length
    expected = ci.edf_greenhall(exponent, order, length, angles, overlapping=True, modified=modified)
    assert _freedom(estimator, exponent, length, terms) == pytest.approx(expected, rel=0.12)


def test_white_noise_has_its_exact_degrees_of_freedom():
    """Squares of neighbouring differences correlate by ¼: M²/(M + (M − 1)/2)."""
    assert _freedom("allan", 0, 1, 999) == pytest.approx(999**2 / (999 + 998 / 2), rel=1e-12)


@pytest.mark.parametrize("gaps", [False, True])
def test_intervals_hold_the_true_deviation(gaps: bool, rng: np.random.Generator):
    """White noise, whose deviation at m samples is 1/√m, in 200 records."""
    lengths, inside = np.array([1, 4, 16, 64]), []
    for _ in range(200):
        rate = rng.standard_normal(512)
        if gaps:
            rate[rng.integers(0, 512, 4)] = np.nan
        found = deviation(rate, 1.0, "allan", lengths)
        truth = 1 / np.sqrt(found.length)
        inside.append(np.pad((found.low < truth) & (truth < found.high), (0, 4 - len(truth)), constant_values=True))
    for hits in np.sum(inside, axis=0):
        assert binom.cdf(hits, 200, 0.91) > RARE  # the noise is read off the slope, at times wrongly


@pytest.mark.parametrize(("every", "lengths"), [(0, [16, 64, 256]), (40, [4, 8, 19])])
def test_intervals_of_the_total_deviation_hold_under_a_random_walk(every: int, lengths: list[int], rng):
    """Whose Allan variance at m samples is (2m² + 1)/6m; in one stretch, and in stretches of 39 samples."""
    inside = np.zeros(3, int)
    for _ in range(200):
        rate = rng.standard_normal(512).cumsum()
        if every:
            rate[::every] = np.nan
        found = deviation(rate, 1.0, "total", np.array([1, 2, *lengths]))
        truth = np.sqrt((2.0 * found.length**2 + 1) / (6.0 * found.length))
        inside += ((found.low < truth) & (truth < found.high))[2:]
    for hits in inside:
        assert binom.cdf(hits, 200, 0.90) > RARE  # the noise is read off the slope, at times wrongly


def test_lengths_and_names_that_mean_nothing_are_refused():
    unchecked = inspect.unwrap(deviation)  # as users call it, without the types that the tests check
    with pytest.raises(ValueError, match="whole numbers"):
        unchecked(np.arange(9.0), 1.0, lengths=np.array([1.5]))
    with pytest.raises(ValueError, match="there is no alan deviation"):
        unchecked(np.arange(9.0), 1.0, "alan")


def test_dominant_noise_is_read_off_the_slope(rng: np.random.Generator):
    white = rng.standard_normal(20_000)
    for rate, exponent in ((np.diff(white), 2), (white, 0), (white.cumsum(), -2)):
        for estimator in PEERS:
            found = deviation(rate, 1.0, estimator)
            assert np.median(found.exponent[2:8]) == exponent


def test_too_short_or_empty_records_have_no_terms():
    assert len(deviation(np.full(50, np.nan), 1.0).tau) == 0
    assert len(deviation(np.array([1.0]), 1.0).tau) == 0


def test_intervals_are_no_wider_than_those_published_for_real_sensors(
    measured_data: Callable[[str], Path], rng: np.random.Generator
):
    """Published: two standard errors of terms that do not overlap; overlapping terms cannot know less."""
    published = json.loads(gzip.decompress(measured_data("av_published.json.gz").read_bytes()))["adis"]
    curve = {name: np.array(values) for name, values in published["avar"]["Gyro. X"].items()}
    lengths = np.rint(curve["tau"] * published["freq"]).astype(int)
    theirs = (curve["uci"] - curve["lci"]) / (2 * curve["adev"])
    assert theirs == pytest.approx(2 / np.sqrt(2 * (published["n"] / lengths - 1)), rel=1e-3)
    ours = deviation(rng.normal(size=published["n"]), 1 / published["freq"], lengths=lengths[:12])
    ratio = (ours.high - ours.low) / (2 * ours.deviation) / theirs[:12]
    assert ratio.max() < 1.0
    assert ratio.min() > 0.7
