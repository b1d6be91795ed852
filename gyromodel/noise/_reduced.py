"""Restricted likelihood of a noise mixture on a long record, from means of groups and moments within them.

Up to a few thousand rows the likelihood is the exact one of the state-space filter. A longer record is cut into groups
of neighbouring rows: the means of the groups follow the same kind of noise (averages of a Markov process, of a random
walk and of differenced white noise are such processes again, plus or minus white noise) and go through the filter; of
the deviations within groups the second moments are all that a Gaussian likelihood needs. What is neglected is the
correlation of deviations with those of other groups and with the means.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from gyromodel._checks import MISSING_STEP
from gyromodel.numerics.markov_cells import MarkovCells, Rows, log_determinant_and_gram

# Rows that go through the filter as they are; sizes of groups where there are more.
MOST_ROWS, SMALLEST_GROUP, LARGEST_GROUP = 2048, 16, 64
# More rows than this are grouped even where their noise is coloured.
TOO_MANY = 16_384
# Groups are whole; where gaps leave fewer rows in them than this share, the filter takes every row.
WHOLE = 0.8
# Cells filtered together.
CELLS = 32


class Mixture(NamedTuple):
    """Noises side by side on the last axis: variances of a sample of white and of differenced noise, of a step of the
    random walk, and Markov processes by the correlation of neighbouring samples and their variance.
    """

    white: np.ndarray
    differenced: np.ndarray
    walk: np.ndarray
    correlation: np.ndarray
    variance: np.ndarray

    def averaged(self, rows: int) -> Mixture:
        """The noise of means over so many rows, exactly."""
        lag = np.arange(1, rows)[:, None, None]
        phi, b = self.correlation, rows
        # cov(mean_0, mean_k) = v₁ φ^(b(k−1)) · ..., a Markov process; what the variance itself has less is white.
        sums = (phi ** np.arange(b)[:, None, None]).sum(0) / b
        after = self.variance * sums**2 * np.where(phi > 0, phi, 1.0)
        variance = self.variance * (b + 2.0 * ((b - lag) * phi**lag).sum(0)) / b**2
        slow = phi**b > 1e-8
        markov = np.where(slow, after / np.where(slow, phi, 1.0) ** b, 0.0)
        white = self.white / b + (variance - markov).sum(0) - self.walk * (b**2 - 1) / (6 * b)
        return Mixture(white, self.differenced / b**2, self.walk * b, np.where(slow, phi**b, 0.0), markov)

    def covariance(self, rows: int) -> np.ndarray:
        """Covariance of so many neighbouring samples at each lag, for contrasts that a constant does not move."""
        lag = np.arange(rows)[:, None]
        total = (self.variance * self.correlation ** lag[:, None]).sum(1) - 0.5 * self.walk * lag
        total[0] += self.white + 2.0 * self.differenced
        total[1] -= self.differenced
        return total


class Level(NamedTuple):
    """Second moments within groups of one size."""

    contrasts: np.ndarray
    groups: int
    moments: np.ndarray

    def log_likelihood(self, noise: Mixture) -> np.ndarray:
        """Of the deviations within groups, per cell."""
        rows = self.contrasts.shape[1]
        lag = np.abs(np.subtract.outer(np.arange(rows), np.arange(rows)))
        total = self.contrasts @ noise.covariance(rows).T[:, lag] @ self.contrasts.T
        sign, log_determinant = np.linalg.slogdet(total)
        good = (sign > 0) & np.isfinite(log_determinant)
        total = np.where(good[:, None, None], total, np.eye(rows - 1))
        misfit = np.trace(np.linalg.solve(total, self.moments), axis1=1, axis2=2)
        good &= misfit > 0
        return np.where(good, -0.5 * (self.groups * log_determinant + misfit), -np.inf)


class Reduced(NamedTuple):
    """A record as its likelihood needs it: levels of grouping, then rows with regressors, the data last."""

    levels: tuple[Level, ...]
    rows: Rows
    columns: np.ndarray
    interval: float
    approximate: bool
    restricted: bool = True

    def log_likelihood(self, noise: Mixture) -> np.ndarray:
        """ln likelihood of each noise, to a constant; restricted, or at its maximum over the regressors."""
        total = np.zeros(len(noise.white))
        for level in self.levels:
            total += level.log_likelihood(noise)
            noise = noise.averaged(level.contrasts.shape[1])
        return total + self._filtered(noise)

    def _filtered(self, noise: Mixture) -> np.ndarray:
        """Through the filter, cells without Markov processes apart: they need a single state."""
        markov = np.any(noise.variance > 0, axis=0)
        total = np.empty(len(markov))
        for here, states in ((markov, slice(None)), (~markov, slice(0))):
            for part in np.array_split(np.flatnonzero(here), -(-int(here.sum()) // CELLS) or 1):
                if len(part):
                    total[part] = self._together(noise, np.resize(part, CELLS), states)[: len(part)]
        return total

    def _together(self, noise: Mixture, part: np.ndarray, states: slice) -> np.ndarray:
        """One batch of cells."""
        log_v, gram = self._sums(noise, part, states)
        log_x, rss = _solved(np.moveaxis(gram, -1, 0))
        log_likelihood = -0.5 * (log_v + rss + (log_x if self.restricted else 0.0))
        return np.where(np.isfinite(log_likelihood) & (rss > 0), log_likelihood, -np.inf)

    def regression(self, noise: Mixture) -> tuple[np.ndarray, np.ndarray]:
        """Coefficients of the regressors under the first noise, and their covariance."""
        for level in self.levels:
            noise = noise.averaged(level.contrasts.shape[1])
        gram = self._sums(noise, np.zeros(1, int), slice(None))[1][..., 0]
        covariance = np.linalg.inv(gram[:-1, :-1])
        return covariance @ gram[:-1, -1], covariance

    def _sums(self, noise: Mixture, part: np.ndarray, states: slice) -> tuple[np.ndarray, np.ndarray]:
        """ln |V| and XᵀV⁻¹X of some cells with some of their Markov processes."""
        phi = np.maximum(noise.correlation[states, part], 1e-300)
        decay = np.concatenate([np.zeros((1, len(part))), -np.log(phi) / self.interval])
        variance = np.concatenate([noise.walk[None, part] / self.interval, noise.variance[states, part]])
        cells = MarkovCells(noise.white[part], noise.differenced[part], decay, variance)
        log_v, gram = log_determinant_and_gram(cells, self.rows, self.columns)
        return np.asarray(log_v), np.asarray(gram)


def _solved(gram: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """ln |XᵀV⁻¹X| and the residual sum of squares, the data being the last column."""
    a, b, c = gram[:, :-1, :-1], gram[:, :-1, -1], gram[:, -1, -1]
    with np.errstate(invalid="ignore"):  # what is no covariance comes out as no number
        sign, log_x = np.linalg.slogdet(a)
    good = (sign > 0) & np.isfinite(log_x)
    a = np.where(good[:, None, None], a, np.eye(a.shape[1]))
    rss = c - np.einsum("gi,gi->g", b, np.linalg.solve(a, b[..., None])[..., 0])
    return np.where(good, log_x, np.inf), rss


def reduced(time: np.ndarray, rate: np.ndarray, columns: np.ndarray, interval: float, longest: int) -> Reduced:
    """Group a record until few enough rows are left.

    Args:
        time: of each sample (s), increasing.
        rate: shape (sample,).
        columns: regressors, shape (sample, regressor), fitted by least squares before deviations within groups are
            taken.
        interval: nominal time between samples (s).
        longest: samples that a group may span: up to here the noise is no redder than white, and groups do not tell of
            one another. Records over TOO_MANY rows are grouped all the same, which is then an approximation.
    """
    data = np.column_stack([columns, rate])
    follows = np.diff(time, prepend=-np.inf) < MISSING_STEP * interval
    levels: list[Level] = []
    approximate = False
    while (many := len(data)) > MOST_ROWS:
        if longest < SMALLEST_GROUP and many <= TOO_MANY:
            break
        size = min(max(2 ** int(np.ceil(np.log2(many / MOST_ROWS))), SMALLEST_GROUP), LARGEST_GROUP)
        size = max(min(size, 2 ** int(np.log2(max(longest, 1)))), SMALLEST_GROUP)
        stretch = np.cumsum(~follows)
        order = np.arange(many) - np.searchsorted(stretch, stretch)
        first = np.flatnonzero(order % size == 0)
        first = first[first + size <= many]
        first = first[stretch[first + size - 1] == stretch[first]]
        if len(first) * size < WHOLE * many:
            break
        index = first[:, None] + np.arange(size)
        groups = data[index]
        contrasts = _contrasts(size)
        x, y = groups[..., :-1], groups[..., -1]
        fitted = np.linalg.lstsq(x.reshape(-1, x.shape[-1]), y.ravel(), rcond=None)[0]
        deviations = (y - x @ fitted) @ contrasts.T
        levels.append(Level(contrasts, len(first), deviations.T @ deviations))
        data, time = groups.mean(1), time[index[:, 0]]
        follows = np.concatenate([[False], (index[1:, 0] == index[:-1, -1] + 1) & follows[index[1:, 0]]])
        approximate |= size > longest
        interval, longest = interval * size, longest // size
    restart, present = np.arange(len(data)) == 0, np.ones(len(data), bool)
    rows = Rows(*(jnp.asarray(v) for v in (np.diff(time, prepend=time[0]), restart, follows, present)))
    return Reduced(tuple(levels), rows, data, interval, approximate)


def _contrasts(size: int) -> np.ndarray:
    """Orthonormal rows without their mean: cosines."""
    k = np.arange(1, size)[:, None]
    return np.sqrt(2.0 / size) * np.cos(np.pi * k * (np.arange(size) + 0.5) / size)
