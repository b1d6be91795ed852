"""Mixtures of noise kinds fitted to one record: which models, their likelihoods, and profiles of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from gyromodel.noise._reduced import Mixture, Reduced
from gyromodel.numerics.maximise import maximise

# Parameters of a mixture: logarithms of N² and Q² as variances of a sample, B², K², q², and of the time constant.
WHITE, QUANTISATION, FLICKER, WALK, MARKOV, TIME_CONSTANT = range(6)
# Twice the log likelihood ratio that makes a kind found. A variance at its bound of zero exceeds it in half of the
# cases that chi-squared with one degree of freedom would, 0.5 %; a Markov process has a time constant to choose as well.
THRESHOLD, MARKOV_THRESHOLD = 6.63, 14.0
# Markov terms of flicker per decade of time constants.
TERMS_PER_DECADE = 1.3
SMALLEST, LARGEST = -60.0, 30.0  # logarithms of variances, in units of the record's
# Shortest time constant in samples: faster processes are white.
SHORTEST = 2.0
# What is this much below the level where the record begins to show it is out of sight.
OUT_OF_SIGHT = 12.0

# Which of white noise, quantisation, flicker, random walk and Markov noise a model holds.
Model = tuple[bool, ...]


class Fits:
    """Mixtures of kinds fitted to one reduced record; parameters are logarithms of variances, and of the time constant."""

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

    def ends(self, model: Model, which: Sequence[int], reach: float, up: Sequence[bool]) -> np.ndarray:
        """Where the profile likelihood of each parameter, upwards or downwards, has fallen by reach²/2; −inf for zero."""
        point, top = self.found[model]
        free = np.tile([*model, model[MARKOV]], (len(which), 1))
        index = np.arange(len(which))
        free[index, list(which)] = False
        origin, sign = point[list(which)], np.where(up, 1.0, -1.0)
        far = origin.copy()
        # A parameter that went out of sight starts from where the record would begin to show it.
        origin = np.where(origin < self.start[list(which)] - OUT_OF_SIGHT, self.start[list(which)] - OUT_OF_SIGHT, origin)
        distance, low, high = np.full(len(which), 0.3), np.zeros(len(which)), np.full(len(which), np.inf)
        settled, places = np.zeros(len(which), bool), np.tile(point, (len(which), 1))
        for _ in range(14):
            todo = np.flatnonzero(~settled)
            starts = places[todo].copy()
            starts[np.arange(len(todo)), np.asarray(which)[todo]] = (origin + sign * distance)[todo]
            x, value = maximise(self.log_likelihood, starts, free[todo], self.low, self.high)
            drop = np.sqrt(2.0 * np.maximum(top - value, 0.0))
            for k, point_k, d in zip(todo, x, drop, strict=True):
                places[k] = point_k
                far[k] = origin[k] + sign[k] * distance[k]
                settled[k] = abs(d - reach) < 0.03
                if settled[k]:
                    continue
                if d < reach:
                    low[k] = distance[k]
                else:
                    high[k] = distance[k]
                if not up[k] and distance[k] > 25.0 and d < reach:
                    far[k], settled[k] = -np.inf, True
                step = distance[k] * np.clip(reach / max(d, 1e-3), 0.1, 3.0)
                distance[k] = step if low[k] < step < high[k] else 0.5 * (low[k] + high[k])
                if not np.isfinite(distance[k]):
                    distance[k] = 3.0 * low[k]
            if settled.all():
                break
        return far
