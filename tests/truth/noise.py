"""Gyro noise by two-sided rate PSD S(f), with the exact covariance of what is drawn.

Coloured noise is white noise through a fractional integrator (Kasdin, Proc. IEEE 83(5), 1995), whose PSD is
Q dt / (2 sin(pi f dt))^alpha: alpha = 1 flicker, 1.5 between, 2 random walk. White N^2, flicker B^2/(2 pi f),
random walk K^2/(2 pi f)^2, Markov (q Tc)^2/(1 + (2 pi f Tc)^2). Every process has run for three campaign
lengths before the first sample, as in a gyro that was already on.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from scipy.signal import lfilter, oaconvolve

from .designs import Design

Array = np.ndarray
HISTORY = 3  # campaign lengths before the first sample

FAMILY = ("white", "flicker", "random_walk", "flicker_and_walk")
OUTSIDE = ("power_1.5", "markov", "student_t3", "grows_with_rate", "grows_with_temperature_rate")


def fractional_weights(n: int, alpha: float) -> Array:
    """Impulse response of (1 - z^-1)^(-alpha/2)."""
    k = np.arange(1, n)
    return np.concatenate([[1.0], np.cumprod((k - 1 + alpha / 2) / k)])


def driving_variance(coefficient: float, alpha: float, step: float) -> float:
    """Variance of the white input that gives S(f) = coefficient^2 / (2 pi f)^alpha at low frequency."""
    return coefficient**2 * step ** (alpha - 1)


def white(n: int, step: float, N: float, rng: np.random.Generator) -> Array:
    """Angle random walk N: independent samples of variance N^2/step."""
    return N / np.sqrt(step) * rng.standard_normal(n)


def fractional(n: int, step: float, coefficient: float, alpha: float, rng: np.random.Generator) -> Array:
    """Noise with S(f) = coefficient^2/(2 pi f)^alpha, after HISTORY lengths of running in."""
    total = (HISTORY + 1) * n
    drive = np.sqrt(driving_variance(coefficient, alpha, step)) * rng.standard_normal(total)
    return oaconvolve(drive, fractional_weights(total, alpha))[total - n : total]


def flicker(n: int, step: float, B: float, rng: np.random.Generator) -> Array:
    """Bias instability B: S = B^2/(2 pi f)."""
    return fractional(n, step, B, 1.0, rng)


def random_walk(n: int, step: float, K: float, rng: np.random.Generator) -> Array:
    """Rate random walk K: S = K^2/(2 pi f)^2."""
    return fractional(n, step, K, 2.0, rng)


def markov(n: int, step: float, q: float, Tc: float, rng: np.random.Generator) -> Array:
    """Stationary first-order Markov noise, variance q^2 Tc/2, correlation time Tc."""
    decay, sigma = np.exp(-step / Tc), q * np.sqrt(Tc / 2)
    drive = sigma * np.sqrt(1 - decay**2) * rng.standard_normal(n)
    start = sigma * rng.standard_normal()
    return lfilter([1.0], [1.0, -decay], drive, zi=[decay * start])[0]


def telegraph(n: int, step: float, size: float, time_low: float, time_high: float, rng: np.random.Generator) -> Array:
    """Hops between 0 and `size`, each level held for an exponential time of its mean; begins on either."""
    held, level, ends = [], bool(rng.random() < time_high / (time_low + time_high)), 0.0
    while ends < n * step:
        ends += rng.exponential(time_high if level else time_low)
        held.append((ends, level))
        level = not level
    epochs, levels = (np.array(x) for x in zip(*held, strict=True))
    return size * levels[np.searchsorted(epochs, step * np.arange(n))]


def quantised(rate: Array, step: float, lsb: float) -> Array:
    """Rate from an angle that is counted in whole steps of `lsb`."""
    angle = np.concatenate([[0.0], np.cumsum(rate * step)])
    return np.diff(np.round(angle / lsb) * lsb) / step


def shaken(rate: Array, step: float, lsb: float, rng: np.random.Generator) -> Array:
    """As `quantised`, of a gyro that is shaken by many steps, so that it is rounded at random.

    What it was shaken by is taken from the counts, as a dither's pickoff does.
    """
    angle, motion = np.cumsum(rate * step), rng.uniform(-50.0, 50.0, len(rate)) * lsb
    return np.diff(np.round((angle + motion) / lsb) * lsb - motion, prepend=0.0) / step


@dataclass(frozen=True)
class Noise:
    """One noise law: white plus coloured terms; SI units (rad/s).

    `growth` multiplies the white part's sigma by 1 + (growth - 1) |column|/max|column|.
    """

    kind: str
    white: float
    fractional: dict[float, float] = field(default_factory=dict)  # alpha -> coefficient
    markov: tuple[float, float] | None = None  # q, Tc
    student: bool = False
    growth: tuple[str, float] | None = None

    def _sigma(self, design: Design) -> Array:
        sigma = np.full(len(design.index), self.white / np.sqrt(design.step))
        if self.growth:
            column, factor = self.growth
            size = np.abs(design.true[column])
            sigma = sigma * (1 + (factor - 1) * size / size.max())
        return sigma

    def sample(self, design: Design, rng: np.random.Generator) -> Array:
        """Draw the noise at the rows of a design (its gaps are lived through, not skipped)."""
        n, rows = design.index[-1] + 1, design.index
        unit = rng.standard_t(3, len(rows)) / np.sqrt(3) if self.student else rng.standard_normal(len(rows))
        total = self._sigma(design) * unit
        for alpha, coefficient in self.fractional.items():
            total = total + fractional(n, design.step, coefficient, alpha, rng)[rows]
        if self.markov:
            total = total + markov(n, design.step, *self.markov, rng)[rows]
        return total

    def covariance(self, design: Design) -> Array:
        """Exact dense covariance of `sample`."""
        rows, step = design.index, design.step
        V = np.diag(self._sigma(design) ** 2)
        for alpha, coefficient in self.fractional.items():
            V += driving_variance(coefficient, alpha, step) * _fractional_covariance(rows, alpha)
        if self.markov:
            q, Tc = self.markov
            V += q**2 * Tc / 2 * np.exp(-np.abs(rows[:, None] - rows) * step / Tc)
        return V


def _fractional_covariance(rows: np.ndarray, alpha: float) -> Array:
    n = rows[-1] + 1
    total = (HISTORY + 1) * n
    at = rows + total - n
    if alpha == 2.0:
        return np.minimum(at[:, None], at) + 1.0
    weights = fractional_weights(total, alpha)[::-1]
    padded = np.concatenate([weights, np.zeros(total)])
    H = np.stack([padded[total - 1 - k : 2 * total - 1 - k] for k in at])  # H[i, j] = h[at_i - j], 0 for j > at_i
    return H @ H.T


# Decades of the number of samples at which the Allan curves of flicker and of random walk cross the white: 5 to 40,
# and 10 to 60.
FLICKER, WALK = (0.7, 1.6), (1.0, 1.8)
# The same for levels of which nothing is known: six decades of variance about these.
ANY_FLICKER, ANY_WALK = (-1.85, 4.15), (-0.1, 2.9)


def _flicker_level(N: float, step: float, decade: float) -> float:
    return N / (0.664 * np.sqrt(10**decade * step))


def _walk_level(N: float, step: float, decade: float) -> float:
    return np.sqrt(3) * N / (10**decade * step)


def draw(kind: str, design: Design, rng: np.random.Generator) -> Noise:
    """Draw levels: white of a real gyro, coloured terms that cross it within a small part of the campaign."""
    N = np.deg2rad(10 ** rng.uniform(*design.white)) / 60
    dt = design.step
    B = _flicker_level(N, dt, rng.uniform(*FLICKER))
    K = _walk_level(N, dt, rng.uniform(*WALK))
    match kind:
        case "white":
            return Noise(kind, N)
        case "flicker":
            return Noise(kind, N, {1.0: B})
        case "random_walk":
            return Noise(kind, N, {2.0: K})
        case "flicker_and_walk":
            return Noise(kind, N, {1.0: B, 2.0: K})
        case "power_1.5":
            return Noise(kind, N, {1.5: np.sqrt(B * K)})
        case "markov":
            Tc = rng.uniform(0.04, 0.1) * dt * design.index[-1]  # about 20 minutes of five hours
            return Noise(kind, N, markov=(4 * N / Tc, Tc))
        case "student_t3":
            return Noise(kind, N, student=True)
        case "grows_with_rate":
            return Noise(kind, N, growth=("rate", 3.0))
        case "grows_with_temperature_rate":
            return Noise(kind, N, growth=("temperature_rate", 3.0))
    raise ValueError(f"no noise kind {kind!r}")


def family(
    design: Design, points: int = 6, flicker_at: tuple[float, float] = FLICKER, walk_at: tuple[float, float] = WALK
) -> Iterator[tuple[str, float, Array]]:
    """Kinds of noise, weights and covariances, the white of unit N, as `draw` draws them: kinds are as likely.

    Gauss-Legendre nodes stand for the levels of a kind, as drawn or of other decades.
    """
    nodes, weights = np.polynomial.legendre.leggauss(points)
    nodes, weights = (nodes + 1) / 2, weights / 2
    rows, step = design.index, design.step
    white = Noise("white", 1.0).covariance(design)
    flicker, walk = (_fractional_covariance(rows, alpha) for alpha in (1.0, 2.0))
    levels = [_flicker_level(1.0, step, flicker_at[0] + np.ptp(flicker_at) * node) for node in nodes]
    flickers = [driving_variance(B, 1.0, step) * flicker for B in levels]
    levels = [_walk_level(1.0, step, walk_at[0] + np.ptp(walk_at) * node) for node in nodes]
    walks = [driving_variance(K, 2.0, step) * walk for K in levels]
    yield "white", 1.0, white
    for weight, of_flicker in zip(weights, flickers, strict=True):
        yield "flicker", weight, white + of_flicker
    for weight, of_walk in zip(weights, walks, strict=True):
        yield "random_walk", weight, white + of_walk
    for first, of_flicker in zip(weights, flickers, strict=True):
        for second, of_walk in zip(weights, walks, strict=True):
            yield "flicker_and_walk", first * second, white + of_flicker + of_walk
