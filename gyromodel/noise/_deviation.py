"""Allan, modified Allan, Hadamard and total deviation of a rate record with any gaps, with chi-squared intervals.

Sources: W. J. Riley, Handbook of Frequency Stability Analysis, NIST Special Publication 1065 (2008), for the
estimators; C. A. Greenhall and W. J. Riley, Uncertainty of Stability Variances Based on Finite Differences, 35th PTTI
(2003), for the degrees of freedom.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache, partial
from math import comb
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from scipy.stats import chi2

from gyromodel._checks import MISSING_STEP

Estimator = Literal["allan", "modified", "hadamard", "total"]

# Order of the difference of the angle, and steps of the averaging length that one term spans.
_ORDER: dict[str, int] = {"allan": 2, "modified": 2, "hadamard": 3, "total": 2}
_STEPS: dict[str, int] = {"allan": 2, "modified": 3, "hadamard": 3, "total": 2}
# Rows taken at a time, so that they stay in the nearest cache.
_BLOCK = 2048
_THREADS = 2
# Power laws S(f) ~ f^alpha that the degrees of freedom know: quantisation, white noise, flicker, random walk.
_EXPONENTS = np.array([2, 0, -1, -2])
# Slopes of the variance that separate them; the modified variance falls faster under quantisation.
_SLOPES = {False: (-1.5, -0.5, 0.5), True: (-2.0, -0.5, 0.5)}
# Of the total variance: degrees of freedom b·T/τ − c, and expectation 1 − a·τ/T of the variance. NIST SP 1065, sections
# 5.4 and 5.11; quantisation as white noise.
_TOTAL = {2: (1.5, 0.0, 0.0), 0: (1.5, 0.0, 0.0), -1: (1.17, 0.22, 0.481), -2: (0.93, 0.36, 0.750)}
# The degrees of freedom depend on the lengths by their ratio; this fine a grid, this many lengths of lag are enough.
_GRID, _REACH = 16, 16


class Deviation(NamedTuple):
    """Deviation over averaging time.

    `tau` in s; `deviation` and its confidence limits `low` and `high` in the unit of the rate; `length` in samples;
    `terms` counts the differences that went in; `exponent` is that of the dominant noise, S(f) ~ f^exponent, which the
    `degrees_of_freedom` assume.
    """

    tau: Float[np.ndarray, " length"]
    deviation: Float[np.ndarray, " length"]
    low: Float[np.ndarray, " length"]
    high: Float[np.ndarray, " length"]
    length: Int[np.ndarray, " length"]
    terms: Int[np.ndarray, " length"]
    degrees_of_freedom: Float[np.ndarray, " length"]
    exponent: Int[np.ndarray, " length"]


def deviation(
    rate: Float[np.ndarray, " sample"],
    interval: float,
    estimator: Estimator = "allan",
    lengths: Int[np.ndarray, " length"] | None = None,
    confidence: float = 0.95,
) -> Deviation:
    """Overlapping Allan, modified Allan, overlapping Hadamard or total deviation of a rate.

    Only differences whose samples are all present count. The total deviation reflects each stretch between missing
    samples at its own ends and pools the stretches of at least two averaging lengths; its limits, not its value, allow
    for what it is too low by at long ones.

    Args:
        rate: equally spaced samples; NaN where one is missing. One NaN stands for a gap of any length.
        interval: time between samples (s).
        estimator: which deviation.
        lengths: averaging lengths in whole samples; octaves by default. Lengths with no term are left out.
        confidence: of the interval. The dominant noise at each length is read off the local slope.

    Returns:
        The deviation at each averaging length.

    Raises:
        ValueError: there is no such estimator, or a length is no whole number.

    Source: NIST SP 1065, section 5.2; equation 25 for the total deviation.
    """
    rate = np.asarray(rate, np.float64)
    if estimator not in _STEPS:
        raise ValueError(f"there is no {estimator} deviation: choose {', '.join(_STEPS)}")
    if lengths is None:
        lengths = 2 ** np.arange(max(int(np.log2(max(len(rate), 1))), 1))
    lengths = np.asarray(lengths)
    if (lengths != np.round(lengths)).any():
        raise ValueError("averaging lengths are whole numbers of samples")
    lengths = lengths.astype(int)
    lengths = lengths[(lengths > 0) & (lengths * _STEPS[estimator] <= len(rate))]
    record = _summed(rate, twice=estimator == "modified")
    stretches = np.zeros((0, 2), int)
    if estimator == "total":
        angle = np.asarray(record.parts[0])[: len(rate) + 1]
        breaks = np.flatnonzero(~np.isfinite(rate))  # a missing sample i lies between the angles i and i + 1
        stretches = np.column_stack([np.concatenate([[0], breaks + 1]), np.concatenate([breaks, [len(rate)]])])
        work = partial(_total, record, angle, stretches)
    else:
        work = partial(_differences, record, order=_STEPS[estimator], overlap=int(estimator == "modified"))
    with ThreadPoolExecutor(_THREADS) as pool:
        sums = list(pool.map(lambda m: work(int(m)), lengths))
    total, terms = np.array([s[0] for s in sums]), np.array([s[1] for s in sums], int)
    kept = terms > 0
    total, terms, lengths = total[kept], terms[kept], lengths[kept]
    variance = total / (comb(2 * _ORDER[estimator] - 2, _ORDER[estimator] - 1) * lengths.astype(float) ** 2 * terms)
    if estimator == "modified":
        variance /= lengths.astype(float) ** 2
    exponent = _dominant(variance, lengths, estimator)
    if estimator == "total":
        told = [_total_freedom(int(a), int(m), stretches) for a, m in zip(exponent, lengths, strict=True)]
        freedom, share = np.reshape(told, (-1, 2)).T
    else:
        told = zip(exponent, lengths, terms, strict=True)
        freedom, share = np.array([_freedom(estimator, int(a), int(m), int(t)) for a, m, t in told]), 1.0
    tail = (1.0 - confidence) / 2.0
    low, high = (np.sqrt(variance / share * freedom / chi2.ppf(p, freedom)) for p in (1.0 - tail, tail))
    return Deviation(lengths * interval, np.sqrt(variance), low, high, lengths, terms, freedom, exponent)


def usual_interval(time: Float[np.ndarray, " sample"]) -> float:
    """The mean of the steps of time that leave out no sample, in its unit: rounded times have none that is right."""
    steps = np.diff(time)
    return float(steps[steps <= MISSING_STEP * np.median(steps)].mean())


def with_gaps(
    rate: Float[np.ndarray, " sample"], time: Float[np.ndarray, " sample"], interval: float
) -> Float[np.ndarray, " row"]:
    """The rate with one NaN where a step of time leaves out samples, as `deviation` takes it.

    Args:
        rate: in any unit.
        time: of each sample (s), increasing.
        interval: nominal time between samples (s).
    """
    return np.insert(rate, np.flatnonzero(np.diff(time) > MISSING_STEP * interval) + 1, np.nan)


class _Record(NamedTuple):
    """The rate summed once (to the angle) or twice, and how many samples before each value are missing.

    Behind the last value there is room for one block, so that every block can be read whole. What is summed twice comes
    in two parts, the first exact, since a double would keep too few digits of it.
    """

    parts: tuple[Float[Array, " row"], ...]
    missing: Int[Array, " row"] | None


def _summed(rate: np.ndarray, twice: bool) -> _Record:
    n, mean, missing = len(rate), rate.mean(), None
    angle = np.zeros(n + 1 + twice + _BLOCK)
    if np.isfinite(mean):
        np.subtract(rate, mean, out=angle[1 : n + 1])  # so that the angle stays small, and rounding errors with it
    else:
        absent = ~np.isfinite(rate)
        angle[1 : n + 1] = np.where(absent, 0.0, rate - rate[~absent].sum() / max(n - absent.sum(), 1))
        missing = np.zeros(len(angle), np.int32)
        np.cumsum(absent, out=missing[1 : n + 1])
    np.cumsum(angle[1 : n + 1], out=angle[1 : n + 1])
    if not twice:
        return _Record((jnp.asarray(angle),), None if missing is None else jnp.asarray(missing))
    # Multiples of a power of two that add up, also times 8 for a difference, without rounding.
    grid = 2.0 ** np.ceil(np.log2(8.0 * n * max(angle.max(), -angle.min(), 1e-300)) - 52)
    # In place: ten million rows take longer to find room for than to add up.
    coarse = angle / grid
    np.round(coarse, out=coarse)
    coarse *= grid
    fine = np.subtract(angle, coarse, out=angle)

    def sum_up(part: np.ndarray) -> None:
        np.cumsum(part[: n + 1], out=part[1 : n + 2])
        part[0] = 0.0

    with ThreadPoolExecutor(_THREADS) as pool:
        list(pool.map(sum_up, (coarse, fine)))
    # A term takes n + 2 sums, but the last sample it needs is one before its last angle.
    behind = None if missing is None else jnp.asarray(np.concatenate([[0], missing[:-1]]))
    return _Record((jnp.asarray(coarse), jnp.asarray(fine)), behind)


def _differences(record: _Record, m: int, order: int, overlap: int = 0) -> tuple[float, int]:
    """Sum of squared differences over steps of m, and how many there are."""
    total, terms = _sum_of_squares(record, m, order, overlap)
    return float(total), int(terms)


@partial(jax.jit, static_argnums=(2, 3))
def _sum_of_squares(record: _Record, m, order: int, overlap: int):
    count = record.parts[0].shape[0] - _BLOCK - order * m
    row = jnp.arange(_BLOCK)

    def block(i, good):
        def at(array, k, shift=0):
            return jax.lax.dynamic_slice_in_dim(array, i * _BLOCK + k * m + shift, _BLOCK)

        if record.missing is not None:
            good = good & (at(record.missing, order) == at(record.missing, 0, overlap))
        weights = [(-1) ** (order - k) * comb(order, k) for k in range(order + 1)]
        d = sum(sum(w * at(part, k) for k, w in enumerate(weights)) for part in record.parts)
        d = d if good is True else jnp.where(good, d, 0.0)
        return jnp.dot(d, d), _BLOCK if good is True else good.sum()

    def add(i, sums):
        square, terms = block(i, True)
        return sums[0] + square, sums[1] + terms

    whole = count // _BLOCK
    return jax.lax.fori_loop(0, whole, add, block(whole, row < count - whole * _BLOCK))


def _total(record: _Record, angle: np.ndarray, stretches: np.ndarray, m: int) -> tuple[float, int]:
    """Second differences about every inner angle of each stretch, reflected at its ends."""
    stretches = stretches[np.diff(stretches)[:, 0] >= 2 * m]
    total = _differences(record, m, 2)[0] if len(stretches) else 0.0
    if m > 1:
        total += sum(_reflected(angle[low : high + 1], m) for low, high in stretches)
    return total, int((np.diff(stretches)[:, 0] - 1).sum())


def _reflected(angle: np.ndarray, m: int) -> float:
    """Sum of squared second differences about the angles that are nearer than m to an end of the stretch."""
    total = 0.0
    for side in (angle, angle[::-1]):
        d = 2 * side[0] - side[m - 1 : 0 : -1] - 2 * side[1:m] + side[m + 1 : 2 * m]
        total += float(np.einsum("i,i->", d, d))
    return total


def _dominant(variance: np.ndarray, lengths: np.ndarray, estimator: Estimator) -> np.ndarray:
    """Exponent of the dominant noise at each length, from the local slope of the variance."""
    if len(lengths) < 2:
        return np.zeros(len(lengths), int)
    slope = np.gradient(np.log(np.maximum(variance, 1e-300)), np.log(lengths))
    exponent = _EXPONENTS[np.searchsorted(_SLOPES[estimator == "modified"], slope)]
    # Quantisation falls fastest: behind any other noise it cannot lead again.
    return np.where(np.logical_and.accumulate(exponent == 2), 2, np.minimum(exponent, 0))


def _total_freedom(exponent: int, length: int, stretches: np.ndarray) -> tuple[float, float]:
    """Degrees of freedom of the total variance pooled over stretches, and what part of the variance it expects."""
    rows = np.diff(stretches)[:, 0]
    rows = rows[rows >= 2 * length]
    slope, less, short = _TOTAL[exponent]
    share = np.average(1.0 - short * length / rows, weights=rows - 1)
    return max(float(np.sum(slope * rows / length - less)), 1.0), float(share)


@lru_cache
def _correlation(estimator: str, exponent: int, m: int) -> np.ndarray:
    """Autocovariance of the terms at lags of 0, 1, … up to a multiple of the length m, to a constant factor."""
    order, reach = _ORDER[estimator], _REACH * m
    lag = np.arange(-(reach + 2 * order * m), reach + 2 * order * m + 1).astype(float)
    size = np.maximum(np.abs(lag), 1e-300)
    # Generalised autocovariance of the angle (Greenhall and Riley, equation 9).
    angle = {2: (lag == 0) * 1.0, 0: -size, -1: size**2 * np.log(size), -2: size**3}[exponent]
    comb_filter = np.zeros(2 * order * m + 1)
    comb_filter[::m] = [(-1) ** k * comb(2 * order, k) for k in range(2 * order + 1)]
    terms = np.convolve(angle, comb_filter, "same")
    if estimator == "modified":
        terms = np.convolve(terms, m - np.abs(np.arange(-m + 1, m)), "same")
    middle = len(lag) // 2
    return terms[middle : middle + reach + 1] / terms[middle]


def _freedom(estimator: Estimator, exponent: int, length: int, terms: int) -> float:
    """Equivalent degrees of freedom of a mean of squares of correlated terms: terms² / Σ (terms − |k|) r_k².

    The terms are taken as one stretch: gaps only make them less dependent, so that the interval is on the safe side.
    """
    spikes = exponent == 2 and estimator != "modified"  # correlated at whole lengths only
    m = 1 if spikes else min(length, _GRID)
    squares = _correlation(estimator, exponent, m) ** 2
    pairs = np.maximum(terms - np.arange(len(squares)) * length / m, 0.0) * squares
    return max(terms**2 / (pairs[0] + 2.0 * pairs[1:].sum()) * (1.0 if spikes else m / length), 1.0)
