"""The noise of a fit: the likeliest cell, the range that a likelihood ratio leaves, and what that adds to errors."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace

import numpy as np
from scipy.interpolate import make_interp_spline

from gyromodel.estimate._angle_noise import angle_noise
from gyromodel.estimate._estimate import Estimate, EstimateError, noise_coefficients
from gyromodel.estimate._rounding import white_before
from gyromodel.estimate._whitening import filter_of, pad_columns, whiten_columns
from gyromodel.model import GyroModel
from gyromodel.noise import NoiseRatios, from_grams, gram_by_cell, markov_cells, noise_grid, restricted_likelihood
from gyromodel.signals import Record

Likelihood = Callable[[NoiseRatios], np.ndarray]

# Factors (ln) on either side of the best noise ratios, tried one after the other: after the grid, and in later turns.
COARSE_STEPS, FINE_STEPS = (0.8, 0.4, 0.2, 0.1), (0.7, 0.35, 0.17)
# Noise is a Markov process rather than flicker and walk if it is so much likelier (nats).
MARKOV_LEAD = 5.0
# White noise of the angle is beside it from this evidence on (nats).
ANGLE_LEAD = 4.0
# Levels of each noise ratio over its likely range, for the intervals of the noise coefficients, and between them; of
# white noise of the angle, which is told from the others by its frequencies, fewer, within such factors at first.
INTERVAL_LEVELS, FINER_LEVELS = 10, 41
ANGLE_LEVELS, ANGLE_FINER, ANGLE_RANGE = 5, 11, np.geomspace(1e-4, 1e4, 17)
COUNTS, FINER_COUNTS = (*[INTERVAL_LEVELS] * 4, ANGLE_LEVELS), (*[FINER_LEVELS] * 4, ANGLE_FINER)
# A unit of so many times the largest amplitude makes a scale even in amplitude.
LINEAR = 1e3
# Half the 95 % point of chi-squared with one degree of freedom.
REJECTED = 1.92
# So many times it: no part of any interval.
HOPELESS = 6.0


def best_ratios(
    record: Record, model: GyroModel, *, coarse: bool, start: NoiseRatios, markov: bool | None
) -> NoiseRatios:
    """The noise of greatest restricted likelihood: the grids, then ever finer squares around the best cell.

    It is flicker and walk, unless a Markov process beside white noise is likelier by a margin; with white noise of the
    angle where the start has it, or where it shows in what these leave.
    """
    predicted, jacobian = model.linearise(record.signals)
    if not np.isfinite(jacobian).all():
        raise EstimateError("the fit ran to where the model has no value")
    residual = np.where(record.sampling.present, np.asarray(record.signals["output"]) - predicted, 0.0)
    if np.mean(residual[record.sampling.present] ** 2) <= record.imprecision:
        return NoiseRatios(np.zeros(()), np.zeros(()))  # rounding has no colour that matters
    span = record.span

    def likelihood(cells: NoiseRatios) -> np.ndarray:
        args = (record.interval, span, record.sampling, jacobian, residual)
        return restricted_likelihood(cells, *args).log_likelihood

    best, top = start, None
    if coarse:
        grid = noise_grid(int(record.present.sum()), record.interval, span)
        # Every other level, then the levels around the best of them.
        angle = start.each()[len(grid.ratios.each()) :]
        levels = [np.unique(r) for r in (*grid.ratios.each(), *angle)]
        best, _ = _likeliest(likelihood, _mesh(level[::2] for level in levels))
        best, top = _likeliest(likelihood, _mesh(map(_around, levels, map(float, best.each()))))
    best, top = _refined(likelihood, best, top, COARSE_STEPS if coarse else FINE_STEPS)
    if not coarse:
        return best
    cells = markov_cells(int(record.present.sum()), record.interval, span)._replace(quantisation=start.quantisation)
    if markov is not False and len(cells.flicker):
        other, likeliest = _refined(likelihood, *_likeliest(likelihood, cells), COARSE_STEPS)
        best = other if markov or likeliest > top + MARKOV_LEAD else best
    if best.quantisation is not None or record.domain != "gyro" or record.in_steps:
        return best
    columns = pad_columns(residual[:, None])
    whitened = np.where(
        record.present, np.asarray(whiten_columns(filter_of(record, best), columns))[: record.rows, 0], np.nan
    )
    found = angle_noise(whitened, record)
    if found is None or found.evidence < ANGLE_LEAD:
        return best
    # What is left for white noise is less.
    more = np.nanmean(whitened**2) / found.white
    slow = [np.asarray(r) * more for r in (best.flicker, best.walk, best.markov)]
    best = NoiseRatios(slow[0], slow[1], slow[2], best.constant, np.asarray(found.share))
    return _refined(likelihood, best, None, COARSE_STEPS)[0]


def _likeliest(likelihood: Likelihood, cells: NoiseRatios) -> tuple[NoiseRatios, float]:
    """The likeliest of some cells, and its log likelihood."""
    each = likelihood(cells)
    return cells.take(int(np.argmax(each))), float(each.max())


def _refined(
    likelihood: Likelihood, best: NoiseRatios, top: float | None, steps: Sequence[float]
) -> tuple[NoiseRatios, float]:
    """The likeliest cell around one, and its log likelihood; `top` is that of the one where it is known."""
    for width in steps:
        cells = _mesh(np.asarray(r) * np.exp(width * np.array([-1.0, 0.0, 1.0])) for r in best.each())
        if top is not None:
            # The middle one is known.
            cells = cells.take(np.delete(np.arange(len(cells.flicker)), len(cells.flicker) // 2))
        if len(cells.flicker):
            other, likelier = _likeliest(likelihood, cells)
            if top is None or likelier > top:
                best, top = other, likelier
    return best, float(-np.inf if top is None else top)


def _around(levels: np.ndarray, level: float) -> np.ndarray:
    i = int(np.searchsorted(levels, level))
    return levels[max(i - 1, 0) : i + 2]


def _mesh(levels: Iterable[np.ndarray]) -> NoiseRatios:
    """Cells at every combination of levels."""
    return NoiseRatios(*(v.ravel() for v in np.meshgrid(*map(np.unique, levels), indexing="ij")))


def settled(a: NoiseRatios, b: NoiseRatios) -> bool:
    pairs = list(zip(a.each(), b.each(), strict=False))
    alike = len(a.each()) == len(b.each())
    return alike and all(abs(np.log((float(x) + 1e-300) / (float(y) + 1e-300))) < 0.05 for x, y in pairs)


def with_noise_intervals(estimate: Estimate) -> Estimate:
    """The estimate with 95 % intervals of its noise coefficients, and with what they leave open in its covariance.

    The intervals are the coefficients' ranges over the noise cells that a likelihood ratio does not reject; of colour
    that so few samples cannot show they have no end. The variances of the parameters are means over these cells, by
    likelihood and prior (that of the search), with what the parameters differ between cells; their correlations stay
    those of the likeliest. An estimate in stated noise stays as it is.
    """
    if estimate.noise_given:
        return estimate
    record, gain = estimate.record, float(estimate.model.gain())
    predicted, jacobian = estimate.model.linearise(record.signals)
    residual = np.where(record.sampling.present, np.asarray(record.signals["output"]) - predicted, 0.0)
    columns, span = np.column_stack([jacobian, residual]), record.span
    samples = int(record.present.sum())
    grid = noise_grid(samples, record.interval, span).ratios
    bounds = [(float(np.min(r[r > 0], initial=np.inf)), float(r.max())) for r in map(np.asarray, grid.each())]
    if float(estimate.ratios.markov) > 0:
        grid = markov_cells(samples, record.interval, span)
    own = estimate.ratios.each()
    levels = [
        np.union1d(np.unique(r)[::2], float(b) * np.array([0.2, 1.0, 5.0]))
        for r, b in zip(grid.each(), own, strict=False)
    ]
    levels += [float(b) * ANGLE_RANGE for b in own[len(levels) :]]
    for turn, margin in enumerate((4.0, 2.0, 2.0, 2.0, 0.0)):
        log_determinant, gram = gram_by_cell(_mesh(levels), record.interval, span, record.sampling, columns)
        result = from_grams(log_determinant, gram, samples)
        below = result.log_likelihood.max() - result.log_likelihood
        # Only levels even on some scale are for splines.
        if not margin or (turn and np.sum(below < REJECTED) > 2 * INTERVAL_LEVELS * ANGLE_LEVELS ** (len(own) - 4)):
            break
        likely, mesh = below < margin * REJECTED, [np.asarray(r) for r in _mesh(levels).each()]
        units = [_unit(r, likely, float(b)) for r, b in zip(mesh, own, strict=True)]
        levels = [_levels(r, likely, unit, n) for r, unit, n in zip(mesh, units, COUNTS, strict=False)]
    # A likelihood that falls off steeply would make splines swing where it does not.
    hoped = np.maximum(result.log_likelihood, result.log_likelihood.max() - HOPELESS * REJECTED)
    finer, (log_likelihood, log_sum) = _finer(levels, units, hoped, np.log(result.residual_sum))
    kept = log_likelihood.max() - log_likelihood < REJECTED
    white = np.exp(log_sum[kept]) / result.degrees_of_freedom
    ratios = _mesh(finer).take(kept)
    spans = {k: (float(v.min()), float(v.max())) for k, v in noise_coefficients(ratios, white, record, gain).items()}
    low, high = spans["noise_white"]
    scatter = 1.96 / float(np.sqrt(2 * (record.present.sum() - 1)))
    spans["noise_white"] = white_before(estimate, (low * (1 - scatter), high * (1 + scatter)))
    if "noise_quantisation" in spans:
        low, high = spans["noise_quantisation"]
        spans["noise_quantisation"] = low * (1 - scatter), high * (1 + scatter)
    if len(grid.flicker) == 1:
        # So few samples show no colour: there may be any amount of it.
        spans |= {name: (0.0, np.inf) for name in spans if name != "noise_white"}
        return replace(estimate, noise_interval=spans)
    weight = result.log_likelihood
    if float(estimate.ratios.markov) == 0:
        priors = [_prior(np.unique(r), *b) for r, b in zip(levels, bounds, strict=False)]
        weight = weight + np.log(np.maximum(_outer(priors + [np.ones(len(r)) for r in levels[len(priors) :]]), 1e-300))
    _, own_gram = gram_by_cell(_mesh(np.atleast_1d(r) for r in own), record.interval, span, record.sampling, columns)
    averaged = _variances(gram, np.exp(weight - weight.max()), samples)
    likeliest = _variances(own_gram, np.ones(1), samples)
    # What leaves no residual has nothing to average.
    factor = np.sqrt(np.divide(averaged, likeliest, out=np.ones_like(averaged), where=likeliest > 0.0))
    return replace(estimate, noise_interval=spans, covariance=estimate.covariance * np.outer(factor, factor))


def _prior(levels: np.ndarray, least: float, most: float) -> np.ndarray:
    """What levels of a noise ratio stand for of a prior with half on absent, and half even in logarithm in a range."""
    if len(levels) == 1:
        return np.ones(1)
    root = np.sqrt(levels)
    edges = np.concatenate([root[:1], 0.5 * (root[1:] + root[:-1]), root[-1:]]) ** 2
    up_to = 0.5 + 0.5 * np.clip(np.log(np.maximum(edges, least) / least) / np.log(most / least), 0.0, 1.0)
    up_to[0] -= 0.5 * (levels[0] == 0.0)
    return np.diff(up_to)


def _outer(parts: Sequence[np.ndarray]) -> np.ndarray:
    """Products of one value of each part, in the order of `_mesh`."""
    return np.prod(np.meshgrid(*parts, indexing="ij"), axis=0).ravel()


def _variances(gram: np.ndarray, weight: np.ndarray, samples: int) -> np.ndarray:
    """Of the parameters, over noise cells of such weights: the mean in a cell, and of the squared change to it."""
    p = gram.shape[1] - 1
    size = np.sqrt(np.einsum("gii->gi", gram[:, :p, :p]))
    # The least that double precision leaves of directions, as the likelihood has it.
    inverse = np.linalg.inv(gram[:, :p, :p] / (size[:, :, None] * size[:, None, :]) + 1e-13 * np.eye(p))
    change = np.einsum("gij,gj->gi", inverse, gram[:, :p, p] / size)
    residual_sum = gram[:, p, p] - np.einsum("gi,gi->g", change, gram[:, :p, p] / size)
    within = np.maximum(residual_sum, 0.0)[:, None] / (samples - p) * np.einsum("gii->gi", inverse)
    return weight @ ((within + change**2) / size**2) / weight.sum()


def _unit(ratio: np.ndarray, likely: np.ndarray, best: float) -> float:
    """Amplitude up to which levels are even, beyond which they grow evenly: the best one's where none is not likely.

    A likelihood that has its say near the best may be flat far beyond, where there is next to no white noise.
    """
    least = float(ratio[likely].min())
    if least == ratio.min():
        return LINEAR * float(np.sqrt(ratio.max() or 1.0))
    return float(np.sqrt(best or least))


def _on_scale(ratio: np.ndarray, unit: float) -> np.ndarray:
    return np.arcsinh(np.sqrt(ratio) / unit)


def _ratio(place: np.ndarray, unit: float) -> np.ndarray:
    return (unit * np.sinh(place)) ** 2


def _levels(ratio: np.ndarray, likely: np.ndarray, unit: float, count: int) -> np.ndarray:
    """Levels of one noise ratio, even on the scale of a unit, from the one below its likely range to the one above."""
    levels = np.unique(ratio)
    first, last = np.searchsorted(levels, [ratio[likely].min(), ratio[likely].max()])
    low, high = _on_scale(levels[[max(first - 1, 0), min(last + 1, len(levels) - 1)]], unit)
    return np.unique(_ratio(np.linspace(low, high, count), unit))


def _finer(
    levels: Sequence[np.ndarray], units: Sequence[float], *values: np.ndarray
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Levels closer together on their scales, where there are several, and what cubic splines make of values there."""
    places = [_on_scale(r, unit) for r, unit in zip(levels, units, strict=True)]
    closer = [np.linspace(p[0], p[-1], n if len(p) > 1 else 1) for p, n in zip(places, FINER_COUNTS, strict=False)]
    made = []
    for value in values:
        grid = value.reshape([len(p) for p in places])
        for axis, (p, at) in enumerate(zip(places, closer, strict=True)):
            grid = make_interp_spline(p, grid, k=min(3, len(p) - 1), axis=axis)(at)
        made.append(grid.ravel())
    return [_ratio(p, unit) for p, unit in zip(closer, units, strict=True)], made
