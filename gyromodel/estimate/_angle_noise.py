"""White noise of the angle, which quantisation is, in what a fit leaves: by its falling correlation."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy import stats
from scipy.fft import dst
from scipy.special import logsumexp

from gyromodel.signals import Record

# Even stretches shorter than this show no correlation from sample to sample.
STRETCH = 16
# It is looked for where neighbours have so many standard deviations less in common than nothing.
CORRELATED = 3.0
# Quantisation variances over white ones that are tried.
SHARES = np.geomspace(1e-3, 1e7, 61)
# Times the variance that a line has at its frequency, parts of the frequencies that may be lines, turns of their fit.
LINE, LINES, TURNS = 20.0, (1e-6, 0.01, 0.03, 0.1), 20
# Where a band may begin, in the units of quantisation's spectrum (0.1 to 0.45 times the sample rate), and by how much.
EDGES, RAISED = 2.0 - 2.0 * np.cos(2.0 * np.pi * np.linspace(0.1, 0.45, 8)), np.geomspace(0.1, 300.0, 16)
CHI_MEDIAN = float(stats.chi2.median(1))


class AngleNoise(NamedTuple):
    """Evidence (nats) of white noise of the angle, the white variance of the rate that is left, Q² over that."""

    evidence: float
    white: float
    share: float


def even_stretches(record: Record) -> np.ndarray:
    """Number of the even stretch without restart or gap that each row is of."""
    sampling = record.sampling
    opens = np.asarray(sampling.restart) | (np.asarray(sampling.interval) > 1.5 * record.interval)
    return np.cumsum(opens[: record.rows])


def angle_noise(whitened: np.ndarray, record: Record) -> AngleNoise | None:
    """What whitened residuals (NaN where missing) have of it; None without a sign of it, or where a band says more.

    Its covariance over an even stretch is tridiagonal, and the sine transform diagonalises it.
    """
    known = np.isfinite(whitened)
    ends = np.flatnonzero((np.diff(even_stretches(record), prepend=0) > 0) | ~known)
    stretches = [e[np.isfinite(e)] for e in np.split(whitened, ends)]
    stretches = [e for e in stretches if len(e) >= STRETCH]
    common, square, count = (
        sum(f(e) for e in stretches) for f in (lambda e: float(e[1:] @ e[:-1]), lambda e: float(e @ e), len)
    )
    if not square or common > -CORRELATED * square / np.sqrt(count):
        return None
    power = np.concatenate([np.square(np.asarray(dst(e, type=1, norm="ortho"))) for e in stretches])
    spectrum = np.concatenate([2.0 - 2.0 * np.cos(np.pi * np.arange(1, len(e) + 1) / (len(e) + 1)) for e in stretches])
    white, likelihood = _spectral_fit(power, 1.0 + np.append(0.0, SHARES)[:, None] * spectrum)
    evidence = logsumexp(likelihood[1:]) - likelihood[0] - np.log(len(SHARES))
    # Many weak lines, or noise of a band, raise the spectrum from some frequency on.
    band = spectrum >= EDGES[:, None]
    other = _spectral_fit(power, 1.0 + (RAISED[:, None, None] * band).reshape(-1, len(power)))[1]
    if logsumexp(other) - np.log(len(other)) > likelihood[0] + evidence:
        return None
    best = int(np.argmax(likelihood[1:]))
    return AngleNoise(float(evidence), float(white[1 + best]), float(SHARES[best]))


def _spectral_fit(power: np.ndarray, variance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Level and log likelihood of each shape of a spectrum, of which a part of the frequencies are lines.

    Normal coefficients of variance level · shape, or LINE times that where there is a line; by that algorithm which
    weighs each frequency by how likely it has none (Dempster, Laird, Rubin 1977).
    """
    part = power / variance
    level, best = part.mean(1), np.full(len(part), -np.inf)
    levels = level
    for lines in LINES:
        level = np.maximum(np.median(part, axis=1) / CHI_MEDIAN, 1e-300)
        for _ in range(TURNS):
            each = part / level[:, None]
            odds = lines / (1.0 - lines) / np.sqrt(LINE) * np.exp(np.minimum(0.5 * each * (1.0 - 1.0 / LINE), 700.0))
            quiet = 1.0 / (1.0 + odds)
            level = np.maximum(np.mean(part * (quiet + (1.0 - quiet) / LINE), axis=1), 1e-300)
        each = part / level[:, None]
        odds = lines / (1.0 - lines) / np.sqrt(LINE) * np.exp(np.minimum(0.5 * each * (1.0 - 1.0 / LINE), 700.0))
        value = np.sum(np.log1p(odds) - 0.5 * each, axis=1) + len(power) * np.log(1.0 - lines)
        value -= 0.5 * (np.log(variance).sum(1) + len(power) * np.log(level))
        levels = np.where(value > best, level, levels)
        best = np.maximum(best, value)
    return levels, best
