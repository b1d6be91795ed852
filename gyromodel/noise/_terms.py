"""From fitted mixtures to one verdict for each kind of noise: found, ambiguous with others, or below a bound."""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np

from gyromodel.noise._fits import (
    MARKOV,
    MARKOV_THRESHOLD,
    THRESHOLD,
    TIME_CONSTANT,
    Fits,
    Model,
    Search,
)

Verdict = Literal["found", "ambiguous", "doubtful", "not identifiable"]

KINDS = ("noise_white", "noise_quantisation", "noise_flicker", "noise_random_walk", "noise_markov")
# Square root of twice the log likelihood ratio at the ends of a 95 % interval, and at a 95 % upper bound, which holds
# even where slow noise shows in a single degree of freedom: χ²₁ < r, with r − 1 − ln r = 2.13², in 5 % of records.
TWO_SIDED, BOUND = 1.960, 2.13
# Half the 95 % point of chi-squared with one degree of freedom.
BETTER = 1.92


class NoiseTerm(NamedTuple):
    """One kind of noise, in units of the rate and s.

    `value` with its 95 % limits where `verdict` is found; where it is ambiguous, the size if it is this kind rather
    than one of `alternatives`; where it is not identifiable, the record shows no more than the upper limit, at 95 %. Of
    kinds that stand for one another only one is `in_model`. What would be found or ambiguous is doubtful where the
    spectrum contradicts the model. A Markov process has its time constant (s) beside it; where there is none, `bounds`
    are 95 % upper limits by time constant (s), for fast ones pass for white noise and slow ones for a random walk.
    """

    value: float
    low: float
    high: float
    verdict: Verdict
    in_model: bool
    alternatives: tuple[str, ...] = ()
    time_constant: float = float("nan")
    bounds: tuple[tuple[float, float], ...] = ()

    def scaled(self, unit: float) -> NoiseTerm:
        """The same in another unit."""
        bounds = tuple((constant, bound * unit) for constant, bound in self.bounds)
        return self._replace(value=self.value * unit, low=self.low * unit, high=self.high * unit, bounds=bounds)


def noise_terms(fits: Fits, chosen: Model) -> dict[int, NoiseTerm]:
    """Value, interval and verdict of each kind, in units of the record and its sample interval."""
    top = fits.found[chosen][1]
    others: dict[int, list[Model]] = {}
    peers: dict[int, Model] = {}  # the best model without, or with, each kind
    for k in range(len(KINDS)):
        # A Markov process of long time constant is a random walk: it rivals the others only where it does better.
        rivals = [m for m, (_, value) in fits.found.items() if m[MARKOV] <= chosen[MARKOV] or value > top + BETTER]
        others[k] = [m for m in (fits.found if k == MARKOV else rivals) if m[k] != chosen[k]]
        if others[k]:
            peers[k] = max(others[k], key=fits.penalised)
    verdict: dict[int, Verdict] = {}
    alternatives: dict[int, tuple[str, ...]] = {}
    for k in range(len(KINDS)):
        price = THRESHOLD if k < MARKOV else MARKOV_THRESHOLD
        peer = peers.get(k)
        gap = top - max((fits.found[m][1] for m in others[k]), default=-np.inf)
        swapped = peer is not None and any(chosen[j] and not peer[j] for j in range(len(KINDS)))
        near = peer is not None and 2.0 * (fits.penalised(chosen) - fits.penalised(peer)) < price
        if chosen[k]:
            verdict[k] = "found" if 2.0 * gap > price else "ambiguous"
            alternatives[k] = tuple(KINDS[j] for j in range(5) if peer and peer[j] and not chosen[j])
        else:
            verdict[k] = "ambiguous" if swapped and near and k != MARKOV else "not identifiable"
            alternatives[k] = tuple(KINDS[j] for j in range(5) if peer and chosen[j] and not peer[j])
    union = tuple(verdict[k] != "not identifiable" for k in range(len(KINDS)))
    fits.fit([union], [_joined(fits, chosen, peers, union)])
    wider: dict[int, Model] = {k: tuple(u or i == k for i, u in enumerate(union)) for k in range(MARKOV)}
    added = [m for k, m in wider.items() if not union[k]]
    x = fits.found[union][0]
    fits.fit(added, [np.where(np.isfinite(x), x, fits.start - 2.0)] * len(added))
    searches = [Search(union, k, TWO_SIDED, up) for k in range(len(KINDS)) if union[k] for up in (False, True)]
    searches += [Search(m, k, BOUND, True) for k, m in wider.items() if not union[k]]
    ends = dict(zip([(s.parameter, s.up) for s in searches], fits.ends(searches), strict=True))
    out: dict[int, NoiseTerm] = {}
    for k in range(len(KINDS)):
        if (k, True) not in ends:
            constants = _time_constants(fits)
            bounds = np.exp(0.5 * fits.markov_bounds(union, constants, BOUND))
            told = tuple((float(c), float(b)) for c, b in zip(constants, bounds, strict=True))
            out[k] = NoiseTerm(0.0, 0.0, float("inf"), "not identifiable", False, bounds=told)
            continue
        model = chosen if chosen[k] else peers[k] if union[k] else wider[k]
        point = fits.found[model][0]
        logs = np.array([point[k], ends.get((k, False), -np.inf), ends[k, True]])
        value, low, high = (float(v) for v in np.exp(0.5 * logs))
        low, high = min(low, value), max(high, value)  # they may come from different models
        if verdict[k] == "found" and low == 0.0:
            verdict[k] = "ambiguous"
        said = alternatives[k] if verdict[k] == "ambiguous" else ()
        constant = float(np.exp(point[TIME_CONSTANT])) if k == MARKOV else float("nan")
        out[k] = NoiseTerm(value, low, high, verdict[k], chosen[k], said, constant)
    return out


def _time_constants(fits: Fits) -> np.ndarray:
    """Powers of ten from ten intervals to a tenth of the record, or their middle if there is none."""
    shortest, longest = 10.0 * fits.interval, 0.1 * fits.span
    powers = 10.0 ** np.arange(np.ceil(np.log10(shortest)), np.floor(np.log10(longest)) + 1)
    return powers if len(powers) else np.sqrt([shortest * longest])


def _joined(fits: Fits, chosen: Model, peers: dict[int, Model], union: Model) -> np.ndarray:
    """A start for the kinds of several models together."""
    x = fits.found[chosen][0].copy()
    for k, peer in peers.items():
        if union[k] and not chosen[k]:
            x[k] = fits.found[peer][0][k] - 1.0
            if k == MARKOV:
                x[TIME_CONSTANT] = fits.found[peer][0][TIME_CONSTANT]
    return x
