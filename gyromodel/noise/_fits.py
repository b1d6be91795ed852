"""Mixtures of noise kinds fitted to one record: which models, their likelihoods, and profiles of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from gyromodel.noise._reduced import Mixture, Reduced
from gyromodel.numerics.maximise import maximise

# Parameters of a mixture: logarithms of N² and Q² as variances of a sample, B², K², q², and of the time constant.
WHITE, QUANTISATION, FLICKER, WALK, MARKOV, TIME_CONSTANT = range(6)
# Twice the log likelihood ratio that makes a kind found. A variance at its bound of zero exceeds it in half of the
# cases that chi-squared with one degree of freedom would, 0.5 %; a Markov process has a time constant to choose too.
THRESHOLD, MARKOV_THRESHOLD = 6.63, 14.0
# Markov terms of flicker per decade of time constants.
TERMS_PER_DECADE = 1.3
SMALLEST, LARGEST = -60.0, 30.0  # logarithms of variances, in units of the record's
# Shortest time constant in samples: faster processes are white.
SHORTEST = 2.0
# What is this much below the level where the record begins to show it is out of sight.
OUT_OF_SIGHT = 12.0

# Steps of a search for the end of an interval, how close to its level it ends, and the logarithm that counts as zero.
SEARCH_STEPS, CLOSE, FAR = 14, 0.03, 25.0

# Which of white noise, quantisation, flicker, random walk and Markov noise a model holds.
Model = tuple[bool, ...]


class Search(NamedTuple):
    """An end of an interval: of which parameter of which model, how far below the top, and on which side.

    `reach` is the square root of twice the fall of the log likelihood.
    """

    model: Model
    parameter: int
    reach: float
    up: bool


class Fits:
    """Mixtures of kinds fitted to one reduced record; parameters are logarithms: variances, and the time constant."""

    def __init__(self, record: Reduced, interval: float, span: float, start: np.ndarray) -> None:
        self.record, self.interval, self.span, self.start = record, interval, span, start
        decades = np.log10(span / interval)
        self.constants = np.geomspace(interval, span, max(int(np.ceil(TERMS_PER_DECADE * decades)), 3) + 1)
        self.found: dict[Model, tuple[np.ndarray, float]] = {}
        self.low, self.high = np.full(6, SMALLEST), np.full(6, LARGEST)
        self.low[TIME_CONSTANT], self.high[TIME_CONSTANT] = np.log(SHORTEST * interval), np.log(span)

    def mixture(self, x: np.ndarray) -> Mixture:
        """The noises of points, shape (point, parameter)."""
        v = np.exp(x)
        spacing = np.log(self.constants[1] / self.constants[0])
        flicker = np.tile(v[:, FLICKER] * spacing / np.pi, (len(self.constants), 1))
        phi = np.concatenate([np.tile(self.constants[:, None], (1, len(v))), v[None, :, TIME_CONSTANT]])
        markov = v[None, :, MARKOV] * v[None, :, TIME_CONSTANT] / 2.0
        return Mixture(
            v[:, WHITE],
            v[:, QUANTISATION],
            v[:, WALK] * self.interval,
            np.exp(-self.interval / phi),
            np.concatenate([flicker, markov]),
        )

    def variance_at(self, tau: np.ndarray) -> np.ndarray:
        """A bound on the Allan variance at some averaging times, from what each kind may be at most."""
        n, q, b, k = np.exp(self.start[:MARKOV])
        count = tau / self.interval
        return 2.0 * (n / count + 3.0 * q / count**2 + 0.441 * b + k * tau / 3.0)

    def log_likelihood(self, x: np.ndarray) -> np.ndarray:
        """Of points, shape (point, parameter)."""
        return self.record.log_likelihood(self.mixture(x))

    def fit(self, models: Sequence[Model], starts: Sequence[np.ndarray] | None = None) -> None:
        """Fit models that are not fitted yet, or from other starts and keep the better."""
        models = [m for m in models if starts is not None or m not in self.found]
        if not models:
            return
        start = np.array([self.start] * len(models) if starts is None else starts)
        free = np.array([[*m, m[MARKOV]] for m in models])
        start = np.where(free, start, -np.inf)
        start[:, TIME_CONSTANT] = np.where(free[:, TIME_CONSTANT], start[:, TIME_CONSTANT], np.log(self.interval))
        x, value = maximise(self.log_likelihood, start, free, self.low, self.high)
        for m, point, v in zip(models, x, value, strict=True):
            if m not in self.found or v > self.found[m][1]:
                self.found[m] = point, float(v)

    def penalised(self, model: Model) -> float:
        """The log likelihood less what each kind must gain to count."""
        price = 0.5 * (THRESHOLD * sum(model[:MARKOV]) + MARKOV_THRESHOLD * model[MARKOV])
        return self.found[model][1] - price

    def best(self, within: Callable[[Model], bool] = lambda model: True) -> Model:
        """The model of greatest penalised likelihood, of those with some property."""
        return max((m for m in self.found if within(m)), key=self.penalised)

    def ends(self, searches: Sequence[Search]) -> np.ndarray:
        """Where profile likelihoods have fallen far enough, side by side; −inf for a variance of zero."""
        tops = np.array([self.found[s.model][1] for s in searches])
        places = np.array([self.found[s.model][0] for s in searches])
        free = np.array([[*s.model, s.model[MARKOV]] for s in searches])
        return self._ends(searches, places, tops, free)

    def markov_bounds(self, model: Model, constants: np.ndarray, reach: float) -> np.ndarray:
        """Upper ends for a Markov process beside the kinds of a model, one for each of some time constants."""
        search = Search((*model[:MARKOV], True), MARKOV, reach, True)
        places = np.tile(self.found[model][0], (len(constants), 1))
        places[:, TIME_CONSTANT] = np.log(constants)
        places[:, MARKOV] = self.markov_start(constants)
        free = np.tile([*search.model, False], (len(constants), 1))
        places, tops = maximise(self.log_likelihood, places, free, self.low, self.high)
        return self._ends([search] * len(constants), places, np.maximum(tops, self.found[model][1]), free)

    def markov_start(self, constants: np.ndarray) -> np.ndarray:
        """ln q² at which the Allan variance at 1.89 time constants, 0.191 q²Tc, is half of what is seen there."""
        return np.log(0.5 * self.variance_at(1.89 * constants) / (0.191 * constants))

    def _ends(self, searches: Sequence[Search], places: np.ndarray, tops: np.ndarray, free: np.ndarray) -> np.ndarray:
        """From the maxima `places` of height `tops`, over the parameters that are free."""
        index, which = np.arange(len(searches)), [s.parameter for s in searches]
        free = free.copy()
        free[index, which] = False
        sign, reach = np.array([1.0 if s.up else -1.0 for s in searches]), np.array([s.reach for s in searches])
        # A parameter that went out of sight starts from where the record would begin to show it.
        origin = np.maximum(places[index, which], self.start[which] - OUT_OF_SIGHT)
        distance, low, high = np.full(len(searches), 0.3), np.zeros(len(searches)), np.full(len(searches), np.inf)
        end, active = origin.copy(), np.ones(len(searches), bool)
        for _ in range(SEARCH_STEPS):
            todo = np.flatnonzero(active)
            places[index, which] = end = np.where(active, origin + sign * distance, end)
            places[todo], value = maximise(self.log_likelihood, places[todo], free[todo], self.low, self.high)
            fallen = np.sqrt(2.0 * np.maximum(tops[todo] - value, 0.0))
            for k, d in zip(todo, fallen, strict=True):
                if sign[k] < 0 and d < reach[k] and distance[k] > FAR:
                    end[k], active[k] = -np.inf, False
                    continue
                active[k] = abs(d - reach[k]) > CLOSE
                low[k], high[k] = (distance[k], high[k]) if d < reach[k] else (low[k], distance[k])
                step = distance[k] * np.clip(reach[k] / max(d, 1e-3), 0.1, 3.0)
                middle = 0.5 * (low[k] + high[k]) if np.isfinite(high[k]) else 3.0 * low[k]
                distance[k] = step if low[k] < step < high[k] else middle
            if not active.any():
                break
        return end
