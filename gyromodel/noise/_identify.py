"""Which kinds of noise a record holds, how large each is, and what the record cannot show.

The kinds are white N, quantisation Q, flicker B, random walk K and one Markov process (q, Tc), by their restricted
likelihood with the bias, a trend and steady lines as regressors. A kind counts as found only if no mixture of the
others explains the record as well.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.stats import chi2, gamma, norm
from threadpoolctl import threadpool_limits

from gyromodel._checks import MISSING_STEP
from gyromodel.noise._deviation import Deviation, deviation, usual_interval, with_gaps
from gyromodel.noise._fits import FLICKER, LARGEST, MARKOV, SMALLEST, TIME_CONSTANT, WHITE, Fits, Model
from gyromodel.noise._lines import (
    HANN,
    MOST_LINES,
    Spectrum,
    background,
    find_lines,
    line_columns,
    refined_within,
    spectrum,
)
from gyromodel.noise._reduced import MOST_ROWS, Mixture, reduced
from gyromodel.noise._terms import KINDS, TWO_SIDED, NoiseTerm, noise_terms

# The same for a trend, which a random walk imitates: in 150 records each without a trend, at five sizes of the walk, it
# exceeded 12 once.
TREND = 12.0
# Frequencies per bin of the whitened spectrum, and bins. All bins together contradict the model this seldom by chance;
# those are named that miss it by this factor and this many standard deviations.
FEWEST_IN_BIN, BINS, BY_CHANCE, MISFIT, APART = 24, 40, 1e-4, 1.25, 2.6
FIRST_IN_BIN = 4
FEWEST = 64
# Lines slower than this many cycles a sample stay regressors where rows are grouped, up to so many columns.
SLOW_LINE, MOST_WAVES = 1e-2, 2 * MOST_LINES
# Averaging times below this part of a time constant are short.
SHORT = 1e-3
# Averaging lengths whose deviation has fewer degrees of freedom give no first guess.
FEWEST_FREE = 2.0
# Allan variance times averaging length over its least so far, from which on the noise is redder than white.
REDDER = 1.5
# A kind whose absence costs this much needs no search without it.
CERTAIN = 50.0
# All kinds but Markov noise; the same but white noise; the same but flicker.
BROWN, NOT_WHITE = (True, True, True, True, False), (False, True, True, True, False)
UNFLICKERING = (True, True, False, True, False)


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
    if_short = q**2 * tau / 3.0 * (1.0 - 0.75 * x)
    whole = (q * constant) ** 2 / tau * (1.0 - (3.0 - 4.0 * np.exp(-x) + np.exp(-2.0 * x)) / (2.0 * x))
    return np.where(x < SHORT, if_short, whole)  # the whole loses its digits there


def identify_noise(
    rate: Float[np.ndarray, " sample"],
    time: Float[np.ndarray, " sample"],
    progress: Callable[[str, float], None] | None = None,
) -> IdentifiedNoise:
    """Identify the noise of a record at rest.

    Args:
        rate: in any unit, which is then that of the results; NaN where a sample is missing.
        time: of each sample (s), increasing; gaps are allowed.
        progress: called with a line and the fraction done.

    Returns:
        Terms with 95 % profile likelihood intervals, lines, and what the model does not explain.

    Raises:
        ValueError: there are fewer than 64 samples, or they do not vary.

    Source: IEEE Std 952-1997, annex C, for the kinds of noise.
    """
    rate, time = np.asarray(rate, float), np.asarray(time, float)
    present = np.isfinite(rate)
    rate, time = rate[present], time[present]
    if len(rate) < FEWEST or not np.ptp(rate) > 0:
        raise ValueError(
            f"{len(rate)} samples{'' if len(rate) < FEWEST else ' of one value'} show no noise: at least {FEWEST} that "
            "vary are needed"
        )
    tell = progress or (lambda text, share: None)
    with threadpool_limits(1, "blas"):
        return _identify(rate, time, tell)


def _identify(rate: np.ndarray, time: np.ndarray, tell: Callable[[str, float], None]) -> IdentifiedNoise:
    interval, span = usual_interval(time), float(time[-1] - time[0])
    scale = float(rate.std())
    y = (rate - rate.mean()) / scale
    clean = _longest(time, MISSING_STEP * interval)
    tell("lines", 0.0)
    frequencies = np.asarray(find_lines(y[clean], time[clean], interval))
    more, frequencies = len(frequencies) > MOST_LINES, frequencies[:MOST_LINES]
    # Across a gap half as long as what shows a line, its phase is lost.
    pieces = _pieces(time, 0.5 * float(time[clean][-1] - time[clean][0]))
    main = next(p for p in pieces if p.start <= clean.start < p.stop)
    frequencies = refined_within(y, time, frequencies, clean, main)
    waves, amplitudes = np.zeros((len(y), 2 * len(frequencies) * len(pieces))), np.zeros(len(frequencies))
    for k, piece in enumerate(pieces if len(frequencies) else ()):
        columns = waves[piece, 2 * len(frequencies) * k :][:, : 2 * len(frequencies)]
        columns[:] = line_columns(frequencies, time[piece])
        sizes = np.linalg.lstsq(np.column_stack([columns, np.ones(len(columns))]), y[piece], rcond=None)[0][:-1]
        y[piece] -= columns @ sizes
        if piece == main:
            amplitudes = np.hypot(*sizes.reshape(-1, 2).T)
    slow = len(y) <= MOST_ROWS or frequencies < SLOW_LINE / interval  # means of groups hold nothing of fast lines
    waves = waves[:, np.resize(np.repeat(np.broadcast_to(slow, len(frequencies)), 2), waves.shape[1])]
    if waves.shape[1] > MOST_WAVES:
        waves = waves[:, :0]
    seen = deviation(with_gaps(y, time, interval), interval)
    seen = Deviation(*(v[(seen.deviation > 0) & (seen.degrees_of_freedom >= FEWEST_FREE)] for v in seen))
    start, longest = _start(seen), _white_until(seen)
    tell("trend", 0.1)
    trend = (time - time.mean()) / span
    columns = np.column_stack([np.ones(len(y)), waves])
    level, tilted = (
        Fits(reduced(time, y, x, interval, longest), interval, span, start)
        for x in (columns, np.column_stack([columns, trend]))
    )
    ramp, slope = _ramp(level, tilted)
    fits, y = (tilted, y - slope * trend) if ramp.verdict == "found" else (level, y)
    tell("kinds of noise", 0.3)
    chosen = _choose(fits)
    tell("intervals", 0.6)
    units = (interval**0.5, interval, 1.0, 1.0, 1.0)
    terms = {KINDS[k]: t.scaled(scale * units[k]) for k, t in noise_terms(fits, chosen).items()}
    terms["noise_rate_ramp"] = ramp.scaled(scale / span)
    power, noise = spectrum(y[clean], interval), fits.mixture(fits.found[chosen][0][None])
    misfits = _misfits(noise, power, interval)
    if misfits or more:
        terms = {k: t if t.verdict == "not identifiable" else t._replace(verdict="doubtful") for k, t in terms.items()}
    density = _density(noise, frequencies, interval)
    if misfits and len(frequencies):
        density = np.interp(frequencies, power.frequency, background(power.power))
    errors = np.sqrt(2.0 * density / (len(time[main]) * interval))
    shifts = errors / (amplitudes * 2.0 * np.pi * time[main].std())
    lines = zip(frequencies, amplitudes * scale, errors * scale, shifts, strict=True)
    tell("identified", 1.0)
    order = (*KINDS, "noise_rate_ramp")
    return IdentifiedNoise(
        {k: terms[k] for k in order}, tuple(Line(*map(float, x)) for x in lines), more, misfits, fits.record.approximate
    )


def _pieces(time: np.ndarray, most: float) -> list[slice]:
    """Rows between steps of time that are longer than `most`."""
    ends = [0, *np.flatnonzero(np.diff(time) > most) + 1, len(time)]
    return [slice(int(a), int(b)) for a, b in itertools.pairwise(ends)]


def _longest(time: np.ndarray, most: float) -> slice:
    """The piece with most rows."""
    return max(_pieces(time, most), key=lambda piece: piece.stop - piece.start)


def _white_until(seen: Deviation) -> int:
    """The averaging length up to which the noise is no redder than white."""
    level = seen.deviation**2 * seen.length
    redder = level > REDDER * np.minimum.accumulate(level)
    return int(seen.length[np.argmax(redder)]) // 2 if redder.any() else int(seen.length[-1])


def _start(seen: Deviation) -> np.ndarray:
    """Parameters at which each kind by itself would reach half of the Allan variance where it comes nearest to it."""
    variance, m = seen.deviation**2, seen.length
    largest = [variance * m, variance * m**2 / 3.0, variance * np.pi / (2.0 * np.log(2.0)), 3.0 * variance / seen.tau]
    start = np.log(0.5 * np.array([*(x.min() for x in largest), largest[3].min(), 1.0]))
    return np.clip(start, SMALLEST, LARGEST)


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
    subsets = [(*m, False) for m in itertools.product((False, True), repeat=4) if any(m)]
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
