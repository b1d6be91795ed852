"""Which kinds of noise a record holds, how large each is, and what the record cannot show.

The kinds are white N, quantisation Q, flicker B, random walk K and one Markov process (q, Tc), by their restricted
likelihood with the bias, a trend and steady lines as regressors. A kind counts as found only if no mixture of the
others explains the record as well.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import product
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.stats import chi2, gamma, norm
from threadpoolctl import threadpool_limits

from gyromodel.noise._deviation import Deviation, deviation
from gyromodel.noise._fits import (
    FLICKER,
    MARKOV,
    MARKOV_THRESHOLD,
    THRESHOLD,
    TIME_CONSTANT,
    WHITE,
    Fits,
    Model,
    Search,
)
from gyromodel.noise._lines import HANN, MOST_LINES, Spectrum, background, find_lines, line_columns, spectrum
from gyromodel.noise._reduced import MOST_ROWS, Mixture, reduced

Verdict = Literal["found", "ambiguous", "doubtful", "not identifiable"]

KINDS = ("noise_white", "noise_quantisation", "noise_flicker", "noise_random_walk", "noise_markov")
# Square root of twice the log likelihood ratio at the ends of a 95 % interval, and at a 95 % upper bound, which holds
# even where slow noise shows in a single degree of freedom: χ²₁ < r, with r − 1 − ln r = 2.13², in 5 % of records.
TWO_SIDED, BOUND = 1.960, 2.13
# The same for a trend, which a random walk imitates: in 150 records each without a trend, at five sizes of the walk, it
# exceeded 12 once.
TREND = 12.0
# Frequencies per bin of the whitened spectrum, and bins. All bins together contradict the model this seldom by chance;
# those are named that miss it by this factor and this many standard deviations.
FEWEST_IN_BIN, BINS, BY_CHANCE, MISFIT, APART = 24, 40, 1e-4, 1.25, 2.6
FIRST_IN_BIN = 4
FEWEST = 64
# A step longer than this many intervals leaves out samples.
GAP = 1.5
# Lines slower than this many cycles a sample stay regressors where rows are grouped.
SLOW_LINE = 1e-2
# Half the 95 % point of chi-squared with one degree of freedom.
BETTER = 1.92
# Allan variance times averaging length over its least so far, from which on the noise is redder than white.
REDDER = 1.5
# A kind whose absence costs this much needs no search without it.
CERTAIN = 50.0
# All kinds but Markov noise; the same but white noise; the same but flicker.
BROWN, NOT_WHITE = (True, True, True, True, False), (False, True, True, True, False)
UNFLICKERING = (True, True, False, True, False)


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


class Line(NamedTuple):
    """A steady line: frequency (Hz) and amplitude in the unit of the rate, with their standard errors.

    1.96 standard errors lead to where the likelihood, at its maximum over phase and frequency, has fallen to 95 %
    limits: it falls with the square of the amplitude's change.
    """

    frequency: float
    amplitude: float
    std: float
    frequency_std: float


class IdentifiedNoise(NamedTuple):
    """Terms by public noise id, the trend per second, steady lines, and whether the spectrum bears it all out.

    `misfits` lists frequency bands (Hz) whose power is not the model's, with the ratio of measured to fitted power.
    `approximate` says that the record was too long for the exact likelihood of noise as coloured as this: intervals are
    then too short.
    """

    terms: dict[str, NoiseTerm]
    lines: tuple[Line, ...]
    more_lines: bool
    misfits: tuple[tuple[float, float, float], ...]
    approximate: bool

    @property
    def fits(self) -> bool:
        """Whether the record is a sum of these kinds."""
        return not self.misfits and not self.more_lines

    def allan_variance(self, tau: Float[np.ndarray, " tau"]) -> dict[str, Float[np.ndarray, " tau"]]:
        """Allan variance of each term of the model, and of the lines together, over averaging time (s).

        Source: IEEE Std 952-1997, annex C.
        """
        formulas = {
            "noise_white": lambda t: t.value**2 / tau,
            "noise_quantisation": lambda t: 3.0 * t.value**2 / tau**2,
            "noise_flicker": lambda t: 2.0 * np.log(2.0) / np.pi * t.value**2 + 0.0 * tau,
            "noise_random_walk": lambda t: t.value**2 * tau / 3.0,
            "noise_markov": lambda t: _markov_variance(t.value, t.time_constant, tau),
            "noise_rate_ramp": lambda t: t.value**2 * tau**2 / 2.0,
        }
        shares = {key: formula(self.terms[key]) for key, formula in formulas.items() if self.terms[key].in_model}
        for line in self.lines:
            cycles = np.pi * line.frequency * tau
            share = (line.amplitude * np.sin(cycles) ** 2 / cycles) ** 2
            shares["lines"] = shares.get("lines", 0.0) + share
        return shares


def _markov_variance(q: float, constant: float, tau: np.ndarray) -> np.ndarray:
    x = tau / constant
    return (q * constant) ** 2 / tau * (1.0 - (3.0 - 4.0 * np.exp(-x) + np.exp(-2.0 * x)) / (2.0 * x))


def identify_noise(
    rate: Float[np.ndarray, " sample"],
    time: Float[np.ndarray, " sample"],
    restart: np.ndarray | None = None,
    progress: Callable[[str, float], None] | None = None,
) -> IdentifiedNoise:
    """Identify the noise of a record at rest.

    Args:
        rate: NaN where a sample is missing.
        time: of each sample (s), increasing within each record; gaps are allowed.
        restart: where independent records begin; the first row by default.
        progress: called with a line and the fraction done.

    Returns:
        Terms with 95 % profile likelihood intervals, lines, and what the model does not explain.

    Raises:
        ValueError: there are fewer than 64 samples, or they do not vary.
    """
    rate, time = np.asarray(rate, float), np.asarray(time, float)
    restart = np.arange(len(rate)) == 0 if restart is None else np.asarray(restart, bool)
    present = np.isfinite(rate)
    if present.sum() < FEWEST or not np.ptp(rate[present]) > 0:
        raise ValueError(
            f"{int(present.sum())} samples{'' if present.sum() < FEWEST else ' of one value'} show no noise: "
            f"at least {FEWEST} that vary are needed"
        )
    tell = progress or (lambda text, share: None)
    with threadpool_limits(1, "blas"):
        return _identify(rate, time, restart, present, tell)


def _identify(rate, time, restart, present, tell) -> IdentifiedNoise:
    steps = np.diff(time)[~restart[1:]]
    interval, span = float(np.median(steps)), float(steps.sum())
    scale = float(rate[present].std())
    y = (rate - rate[present].mean()) / scale
    clean = _longest(present & _regular(time, restart, interval))
    tell("lines", 0.0)
    frequencies = np.asarray(find_lines(y[clean], time[clean], interval))
    more, frequencies = len(frequencies) > MOST_LINES, frequencies[:MOST_LINES]
    bias = (np.cumsum(restart)[:, None] == np.arange(1, restart.sum() + 1)).astype(float)
    waves = line_columns(frequencies, time)
    sizes = np.linalg.lstsq(np.column_stack([bias, waves])[present], y[present], rcond=None)[0][bias.shape[1] :]
    y = y - waves @ sizes
    if present.sum() > MOST_ROWS:  # means of groups hold nothing of fast lines
        waves = waves[:, np.repeat(frequencies < SLOW_LINE / interval, 2)]
    seen = deviation(with_gaps(y, time, restart, interval), interval)
    start, longest = _start(seen), _white_until(seen)
    tell("trend", 0.1)
    trend = (time - time[present].mean()) / span
    columns = np.column_stack([bias, waves])
    level, tilted = (
        Fits(reduced(time, y, x, restart, interval, longest), interval, span, start)
        for x in (columns, np.column_stack([columns, trend]))
    )
    ramp, slope = _ramp(level, tilted)
    found = ramp.verdict == "found"
    fits, y = (tilted, y - slope * trend) if found else (level, y)
    tell("kinds of noise", 0.3)
    chosen = _choose(fits)
    tell("intervals", 0.6)
    units = (interval**0.5, interval, 1.0, 1.0, 1.0)
    terms = {KINDS[k]: t.scaled(scale * units[k]) for k, t in _terms(fits, chosen).items()}
    terms["noise_rate_ramp"] = ramp.scaled(scale / span)
    power, noise = spectrum(y[clean], interval), fits.mixture(fits.found[chosen][0][None])
    misfits = _misfits(noise, power, interval)
    around = np.interp(frequencies, power.frequency, background(power.power))
    density = around if misfits else _density(noise, frequencies, interval)
    amplitudes, errors = np.hypot(*sizes.reshape(-1, 2).T), np.sqrt(2.0 * density / (present.sum() * interval))
    shifts = errors / (amplitudes * 2.0 * np.pi * time[present].std())
    lines = zip(frequencies, amplitudes * scale, errors * scale, shifts, strict=True)
    if misfits or more:
        terms |= {
            k: t._replace(verdict="doubtful")
            for k, t in terms.items()
            if k in KINDS and t.verdict != "not identifiable"
        }
    tell("identified", 1.0)
    order = (*KINDS, "noise_rate_ramp")
    return IdentifiedNoise(
        {k: terms[k] for k in order}, tuple(Line(*map(float, x)) for x in lines), more, misfits, fits.record.approximate
    )


def _longest(good: np.ndarray) -> slice:
    """The longest stretch of rows that are all good."""
    ends = np.flatnonzero(np.diff(np.concatenate([[0], good.astype(int), [0]])))
    first, last = ends[::2], ends[1::2]
    k = int(np.argmax(last - first))
    return slice(int(first[k]), int(last[k]))


def _regular(time: np.ndarray, restart: np.ndarray, interval: float) -> np.ndarray:
    """Rows that follow the one before at the nominal interval."""
    return ~restart & (np.diff(time, prepend=time[0]) < GAP * interval)


def with_gaps(rate: np.ndarray, time: np.ndarray, restart: np.ndarray, interval: float) -> np.ndarray:
    """The rate with one missing sample where time leaves a gap, as `deviation` takes it."""
    return np.insert(rate, np.flatnonzero(~_regular(time, restart, interval))[1:], np.nan)


def _white_until(seen: Deviation) -> int:
    """The averaging length up to which the noise is no redder than white."""
    level = seen.deviation**2 * seen.length
    redder = level > REDDER * np.minimum.accumulate(level)
    return int(seen.length[np.argmax(redder)]) // 2 if redder.any() else int(seen.length[-1])


def _start(seen: Deviation) -> np.ndarray:
    """Parameters at which each kind by itself would reach half of the Allan variance where it comes nearest to it."""
    variance, m = seen.deviation**2, seen.length
    largest = [variance * m, variance * m**2 / 3.0, variance * np.pi / (2.0 * np.log(2.0)), 3.0 * variance / seen.tau]
    return np.log(0.5 * np.array([*(x.min() for x in largest), largest[3].min(), 1.0]))


def _ramp(level: Fits, tilted: Fits) -> tuple[NoiseTerm, float]:
    """The trend over the record beside white noise, quantisation and random walk, and its signed size."""
    gain = 0.0
    for sign, fits in ((-2.0, level), (2.0, tilted)):
        # Restricted likelihoods of different regressors do not compare.
        free = Fits(fits.record._replace(restricted=False), fits.interval, fits.span, fits.start)
        free.fit([UNFLICKERING])
        gain += sign * free.found[UNFLICKERING][1]
    tilted.fit([UNFLICKERING])
    value, covariance = tilted.record.regression(tilted.mixture(tilted.found[UNFLICKERING][0][None]))
    size, margin = abs(float(value[-1])), TWO_SIDED * float(np.sqrt(covariance[-1, -1]))
    if gain > TREND:
        return NoiseTerm(size, size - margin, size + margin, "found", True), float(value[-1])
    return NoiseTerm(size, 0.0, size + margin, "not identifiable", False), 0.0


def _choose(fits: Fits) -> Model:
    """Fit all mixtures that may matter, and take the one whose kinds are all worth their price."""
    subsets = [(*m, False) for m in product((False, True), repeat=4) if any(m)]
    fits.fit([m for m in subsets if m[WHITE]] + [NOT_WHITE])
    if fits.found[BROWN][1] - fits.found[NOT_WHITE][1] < CERTAIN:
        fits.fit(subsets)
    chosen = fits.best()
    _try_markov(fits, chosen)
    chosen = fits.best()
    if chosen[MARKOV]:  # the kinds beside it may change their places
        x = fits.found[chosen][0]
        others = [_flipped(chosen, k) for k in range(MARKOV)]
        fits.fit(others, [np.where(np.isfinite(x), x, fits.start) for _ in others])
        chosen = fits.best()
    return chosen


def _try_markov(fits: Fits, chosen: Model) -> None:
    """Add a Markov process to the chosen kinds, and in place of the slow ones, from the likeliest time constants."""
    for model in {chosen, (*chosen[:FLICKER], False, False, False)} - {(False,) * 5}:
        fits.fit([model])
        constants = np.linspace(fits.low[TIME_CONSTANT] + 1.0, fits.high[TIME_CONSTANT] - 1.0, 8)
        points = np.tile(fits.found[model][0], (len(constants), 1))
        points[:, TIME_CONSTANT] = constants
        points[:, MARKOV] = fits.markov_start(np.exp(constants))
        nearest = np.argsort(fits.log_likelihood(points))[-2:]
        fits.fit([(*model[:MARKOV], True)] * 2, list(points[nearest]))


def _flipped(model: Model, k: int) -> Model:
    return tuple(held != (i == k) for i, held in enumerate(model))


def _terms(fits: Fits, chosen: Model) -> dict[int, NoiseTerm]:
    """Value, interval and verdict of each kind, in units of the record and its sample interval."""
    best = fits.best()
    top = fits.found[best][1]
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
        near = peer is not None and 2.0 * (fits.penalised(best) - fits.penalised(peer)) < price
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


def _density(noise: Mixture, frequency: np.ndarray, interval: float) -> np.ndarray:
    """Two-sided PSD of the first mixture at some frequencies (Hz)."""
    difference = 4.0 * np.sin(np.pi * frequency * interval) ** 2
    phi, variance = noise.correlation[:, 0, None], noise.variance[:, 0, None]
    fitted = noise.white[0] + noise.differenced[0] * difference + noise.walk[0] / difference
    return (fitted + (variance * (1.0 - phi**2) / ((1.0 - phi) ** 2 + phi * difference)).sum(0)) * interval


def _misfits(noise: Mixture, seen: Spectrum, interval: float) -> tuple[tuple[float, float, float], ...]:
    """Bands where the spectrum is not the model's: from, to (Hz), measured over fitted power."""
    ratio = (seen.power / _density(noise, seen.frequency, interval))[FIRST_IN_BIN:]
    frequency = seen.frequency[FIRST_IN_BIN:]
    if len(ratio) < 2 * FEWEST_IN_BIN:
        return ()
    edges = [0]
    for edge in np.geomspace(FEWEST_IN_BIN, len(ratio), BINS).astype(int):
        if edge - edges[-1] >= FEWEST_IN_BIN:
            edges.append(int(edge))
    edges = np.array([*edges[:-1], len(ratio)])
    count = np.diff(edges)
    mean = np.add.reduceat(ratio, edges[:-1]) / count
    # Means of periodograms are gamma variables; as normal ones their squares add up to chi-squared.
    shape = count / HANN
    score = np.abs(norm.ppf(np.clip(gamma.cdf(mean * shape, shape), 1e-15, 1.0 - 1e-15)))
    contradicted = chi2.sf(np.sum(score**2), len(score)) < BY_CHANCE
    bad = contradicted & (score > APART) & (np.abs(np.log(np.maximum(mean, 1e-300))) > np.log(MISFIT))
    last = np.append(frequency, frequency[-1])[edges[1:] - 1]
    return tuple(
        (float(a), float(b), float(r)) for a, b, r in zip(frequency[edges[:-1]][bad], last[bad], mean[bad], strict=True)
    )
