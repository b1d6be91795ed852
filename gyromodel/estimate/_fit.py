"""Joint fit of all parameters by generalised least squares, the noise by restricted likelihood, in turns."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np

from gyromodel.attitude import with_reference_rates
from gyromodel.averages import MEAN_OF_ATTITUDE, average
from gyromodel.campaign import Campaign
from gyromodel.estimate._estimate import Estimate, EstimateError, noise_coefficients
from gyromodel.estimate._optimistix import optimistix_solution
from gyromodel.model import GyroModel, ModelError, check_units, record_span
from gyromodel.noise import (
    NoiseRatios,
    from_grams,
    markov_cells,
    markov_sum,
    noise_grid,
    restricted_likelihood,
    stated_ratios,
)
from gyromodel.numerics.least_squares import Normal, Solution, levenberg_marquardt
from gyromodel.numerics.state_space import Filter, build_filter, colour, whiten, whitened_gram
from gyromodel.numerics.uncertain import Source
from gyromodel.poses import at_rest
from gyromodel.signals import Record, read_signals

Solver = Literal["auto", "levenberg_marquardt", "optimistix"]
Progress = Callable[[str, float], None] | None

# Relative decrease of the cost that still counts: at a million samples a hundredth of a standard deviation squared.
TOLERANCE = 1e-8
# Relative size of a singular value of the whitened, column-scaled Jacobian below which a direction is not determined.
SINGULAR = 1e-7
# Factors (ln) on either side of the best noise ratios, tried one after the other: after the grid, and in later turns.
COARSE_STEPS, FINE_STEPS = (0.8, 0.4, 0.2, 0.1), (0.7, 0.35, 0.17)
# Noise is a Markov process rather than flicker and walk if it is so much likelier (nats).
MARKOV_LEAD = 5.0
# Levels of each noise ratio over its likely range, for the intervals of the noise coefficients.
INTERVAL_LEVELS = 16
# Half the 95 % point of chi-squared with one degree of freedom.
REJECTED = 1.92


def fit(
    campaigns: Campaign | Sequence[Campaign],
    model: GyroModel,
    *,
    solver: Solver = "auto",
    progress: Progress = None,
    name: str = "campaign",
) -> Estimate:
    """Fit all free parameters of a model to one unit's campaigns together.

    Args:
        campaigns: measured data of one unit; of a multi-position test that numbers no positions, the static poses, and
            where the reference rate comes from an attitude, means over 0.2 s.
        model: what to fit; `noise` empty estimates white noise and flicker and random walk, or a Markov process,
            alongside.
        solver: the package's own Levenberg-Marquardt, or optimistix's; "auto" is its own and, where that does not
            converge, optimistix's.
        progress: called with a line and the fraction done.
        name: what these data are called where their part in a later result's uncertainty is told.

    Raises:
        EstimateError: the campaign does not determine some combination of parameters, or the fit did not converge.
        ModelError: the model needs columns the campaign lacks.
    """
    campaigns = [campaigns] if isinstance(campaigns, Campaign) else campaigns
    rated = [with_reference_rates(c)[0] for c in campaigns]
    means = [MEAN_OF_ATTITUDE * (r is not c) for r, c in zip(rated, campaigns, strict=True)]
    record = read_signals([average(at_rest(r), len(r), s)[0] for r, s in zip(rated, means, strict=True)])
    if progress:
        progress("fitting", 0.1)
    estimate = with_noise_intervals(fit_record(record, model, solver=solver))
    estimate = replace(estimate, source=Source(name, float(estimate.degrees_of_freedom)))
    if progress:
        progress("fitted", 1.0)
    return estimate


def fit_record(
    record: Record,
    model: GyroModel,
    *,
    ratios: NoiseRatios | None = None,
    markov: bool | None = None,
    solver: Solver = "auto",
    ordinary: bool = False,
) -> Estimate:
    """As `fit`, on signals already read.

    Args:
        record: the data.
        model: what to fit.
        ratios: noise ratios to hold instead of estimating them.
        markov: whether the noise beside white is a Markov process, or flicker and walk; none: these, unless a Markov
            process is likelier by a margin.
        solver: see `fit`.
        ordinary: weigh all samples alike in the parameters (the noise is still estimated, and so is the covariance that
            ordinary least squares has under it): less efficient where the noise model is right, safer where it is not.
    """
    if not jnp.zeros(()).dtype == jnp.float64:
        raise EstimateError("JAX runs in single precision; import gyromodel before using jax, or set JAX_ENABLE_X64=1")
    check_covariates(record, model)
    check_units(model, record.output_unit, record.units)
    model = model.prepared(record.signals)
    if record.present.sum() <= len(model.slots()) + 1:
        raise EstimateError(
            f"{int(record.present.sum())} samples cannot determine {len(model.slots())} parameters and their noise"
        )
    given = given_ratios(record, model) if ratios is None else ratios
    white = NoiseRatios(jnp.zeros(()), jnp.zeros(()))
    ratios = given if given is not None else white
    filter = filter_of(record, ratios)
    solution = solve(model, np.asarray(model.vector()), record, filter, solver)
    for turn in range(0 if given is not None else 4):
        before = ratios
        now = model.with_vector(jnp.asarray(solution.x))
        ratios = best_ratios(record, now, coarse=turn == 0, start=before, markov=markov)
        filter = filter_of(record, ratios)
        solution = solve(model, solution.x, record, filter, solver)
        if turn and _close(before, ratios):
            break
    estimate = _finish(record, model, ratios, filter, solution)
    if ordinary:
        # The noise is what generalised least squares leaves: ordinary residuals are larger.
        solution = solve(model, solution.x, record, filter_of(record, white), solver)
        estimate = _finish(record, model, ratios, filter, solution, variance=estimate.white_variance)
    return estimate


def check_covariates(record: Record, model: GyroModel) -> None:
    """Refuse missing values in a column that an effect needs, and a missing column."""
    model = model.prepared(record.signals)
    for effect in model.effects:
        # Several campaigns serve as the runs that none of them has a column of.
        for name in set(model.columns_needed(effect)) & set(record.signals):
            bad = np.flatnonzero(~np.isfinite(np.asarray(record.signals[name])[: record.rows]) & record.present)
            if len(bad):
                some = ", ".join(str(i + 1) for i in bad[:5]) + ("…" if len(bad) > 5 else "")
                raise ModelError(f"effect {effect.label} needs column {name}, which is NaN in data rows {some}")


def given_ratios(record: Record, model: GyroModel) -> NoiseRatios | None:
    """Noise ratios of a model that states its noise; None where it is to be estimated."""
    if not model.noise:
        return None
    try:
        return stated_ratios(model.noise, record.interval)
    except ValueError as problem:
        raise ModelError(str(problem)) from None


@jax.jit
def make_filter(ratios: NoiseRatios, interval, longest, sampling) -> Filter:
    """The whitening filter of noise cells of one longest time constant."""
    return build_filter(markov_sum(ratios, interval, longest), sampling)


def filter_of(record: Record, ratios: NoiseRatios) -> Filter:
    """The whitening filter of one noise cell on a record."""
    ratios = NoiseRatios(*(np.asarray(r, float) for r in ratios))
    return make_filter(ratios, record.interval, float(ratios.longest(record_span(record))), record.sampling)


whiten_columns = jax.jit(whiten)


_gram = jax.jit(whitened_gram)


def solve(model: GyroModel, x: np.ndarray, record: Record, filter: Filter, solver: Solver) -> Solution:
    """Minimise the whitened sum of squares."""
    output, present = np.asarray(record.signals["output"]), np.asarray(filter.present)
    steady = model.steady_columns(record.signals)

    def normal(v: np.ndarray) -> Normal:
        predicted, jacobian = model.with_vector(v).linearise(record.signals, steady)
        residual = np.where(present, predicted - output, 0.0)
        gram = np.asarray(_gram(filter, pad_columns(np.column_stack([jacobian, residual]))))
        p = len(v)
        return gram[:p, :p], gram[:p, p], float(gram[p, p])

    if not len(x):
        return Solution(x, normal(x)[2], 0, True)
    if solver != "optimistix":
        solution = levenberg_marquardt(normal, np.asarray(x), TOLERANCE)
        if solver == "levenberg_marquardt" or (solution.converged and np.isfinite(solution.x).all()):
            return solution
    return optimistix_solution(model, jnp.asarray(x), record.signals, filter)


def pad_columns(columns, step: int = 8):
    """Zero columns up to a multiple of `step`, so that compiled shapes recur."""
    return np.pad(columns, ((0, 0), (0, -columns.shape[1] % step)))


def best_ratios(
    record: Record, model: GyroModel, *, coarse: bool, start: NoiseRatios, markov: bool | None
) -> NoiseRatios:
    """The noise of greatest restricted likelihood: the grids, then ever finer squares around the best cell.

    It is flicker and walk, unless a Markov process beside white noise is likelier by a margin.
    """
    predicted, jacobian = model.linearise(record.signals)
    residual = np.where(record.sampling.present, np.asarray(record.signals["output"]) - predicted, 0.0)
    span = record_span(record)

    def likelihood(cells: NoiseRatios) -> np.ndarray:
        args = (record.interval, span, record.sampling, jacobian, residual)
        return restricted_likelihood(cells, *args).log_likelihood

    best = start
    if coarse:
        grid = noise_grid(int(record.present.sum()), record.interval, span)
        # Every other level, then the levels around the best of them.
        levels = [np.unique(r) for r in grid.ratios]
        first = _mesh(level[::2] for level in levels)
        best = first.take(int(np.argmax(likelihood(first))))
        near = _mesh(_around(level, float(r)) for level, r in zip(levels, best, strict=True))
        best = near.take(int(np.argmax(likelihood(near))))
    best, top = _refined(likelihood, best, COARSE_STEPS if coarse else FINE_STEPS)
    if not coarse or markov is False:
        return best
    cells = markov_cells(int(record.present.sum()), record.interval, span)
    if not len(cells.flicker):
        return best
    other = cells.take(int(np.argmax(likelihood(cells))))
    other, likeliest = _refined(likelihood, other, COARSE_STEPS)
    return other if markov or likeliest > top + MARKOV_LEAD else best


def _refined(
    likelihood: Callable[[NoiseRatios], np.ndarray], best: NoiseRatios, steps: Sequence[float]
) -> tuple[NoiseRatios, float]:
    """The likeliest cell around one, and its log likelihood."""
    top = -np.inf
    for width in steps:
        cells = _mesh(np.asarray(r) * np.exp(width * np.array([-1.0, 0.0, 1.0])) for r in best)
        each = likelihood(cells)
        best, top = cells.take(int(np.argmax(each))), float(each.max())
    return best, top


def _around(levels: np.ndarray, level: float) -> np.ndarray:
    i = int(np.searchsorted(levels, level))
    return levels[max(i - 1, 0) : i + 2]


def _mesh(levels: Iterable[np.ndarray]) -> NoiseRatios:
    """Cells at every combination of levels."""
    return NoiseRatios(*(v.ravel() for v in np.meshgrid(*map(np.unique, levels), indexing="ij")))


def _close(a: NoiseRatios, b: NoiseRatios) -> bool:
    return all(abs(np.log((float(x) + 1e-300) / (float(y) + 1e-300))) < 0.05 for x, y in zip(a, b, strict=True))


def _finish(
    record: Record,
    model: GyroModel,
    ratios: NoiseRatios,
    filter: Filter,
    solution: Solution,
    variance: float | None = None,
) -> Estimate:
    """The estimate at a solution; `variance` is the white one where the solution is that of ordinary least squares."""
    if not solution.converged:
        raise EstimateError(
            f"the fit of {', '.join(model.labels)} did not converge in {solution.iterations} iterations: "
            "give start values near the solution, or fix some parameters"
        )
    model = model.with_vector(jnp.asarray(solution.x))
    for effect in model.effects:
        try:
            replace(effect)
        except ValueError as problem:
            raise EstimateError(
                f"the fit left what {effect.label} can be ({problem}): give start values nearer the solution"
            ) from None
    ordinary = variance is not None
    predicted, jacobian = model.linearise(record.signals)
    output, present = record.signals["output"], record.sampling.present
    residual = np.where(present, np.asarray(output) - predicted, 0.0)
    p = jacobian.shape[1]
    w = np.asarray(whiten_columns(filter, pad_columns(np.column_stack([jacobian, residual]))))[
        np.asarray(present), : p + 1
    ]
    covariance = unit_covariance(w[:, :p], model)
    if ordinary:
        covariance = _ordinary_covariance(record, filter, jacobian, model)
    nu = len(w) - p
    white = float(w[:, p] @ w[:, p]) / nu if variance is None else variance
    likelihood = from_grams(np.atleast_1d(filter.log_determinant), (w.T @ w)[None], len(w)).log_likelihood[0]
    noise = dict(model.noise) or noise_coefficients(ratios, white, record, float(model.gain()))
    rows = record.rows
    whitened = np.full(rows, np.nan)
    whitened[record.present] = w[:, p] / np.sqrt(white)
    return Estimate(
        model=GyroModel(model.effects, noise, model.fixed, model.gyro),
        covariance=covariance * white,
        degrees_of_freedom=nu,
        residual=np.where(record.present, np.asarray(residual)[:rows], np.nan),
        whitened=whitened,
        ratios=ratios,
        white_variance=white,
        log_likelihood=float(likelihood),
        iterations=int(solution.iterations),
        record=record,
        noise_given=bool(model.noise),
        ordinary=ordinary,
    )


def unit_covariance(whitened_jacobian: np.ndarray, model: GyroModel) -> np.ndarray:
    """(JᵀJ)⁻¹ from an R-only QR; refuses directions that the data do not determine, naming their effects."""
    p = whitened_jacobian.shape[1]
    if p == 0:
        return np.zeros((0, 0))
    slots = model.slots()
    norm = np.linalg.norm(whitened_jacobian, axis=0)
    if not np.isfinite(norm).all():
        lost = sorted({model.labels[slots[i].effect] for i in np.flatnonzero(~np.isfinite(norm))})
        raise EstimateError(f"the fit ran away in {', '.join(lost)}: give start values, or fix some parameters")
    if (norm == 0).any():
        silent = sorted({model.labels[slots[i].effect] for i in np.flatnonzero(norm == 0)})
        raise EstimateError(
            f"{', '.join(silent)} cannot be estimated: this campaign does not excite it; remove it or fix it"
        )
    r = np.linalg.qr(whitened_jacobian / norm, mode="r")
    _, singular, directions = np.linalg.svd(r)
    weak = directions[singular < SINGULAR * singular[0]]
    if len(weak):
        involved = sorted({model.labels[slots[i].effect] for d in weak for i in np.flatnonzero(np.abs(d) > 0.1)})
        names = " and ".join(involved)
        raise EstimateError(
            f"{names} cannot be told apart on this campaign: fix all but one, or measure where they differ"
        )
    inverse = np.linalg.inv(r)
    return (inverse @ inverse.T) / np.outer(norm, norm)


def _ordinary_covariance(record: Record, filter: Filter, jacobian, model: GyroModel) -> np.ndarray:
    """(JᵀWJ)⁻¹ JᵀWVWJ (JᵀWJ)⁻¹ for weights W = 1/white, in units of the white variance."""
    present, white = (np.asarray(part)[:, None] for part in (record.sampling.present, record.sampling.white))
    weighted = np.where(present, jacobian / white, 0.0)
    root = np.where(present, jacobian / np.sqrt(white), 0.0)
    bread = unit_covariance(np.asarray(root), model)
    meat = np.asarray(_coloured_transposed(filter, weighted))
    return bread @ (meat.T @ meat) @ bread


@jax.jit
def _coloured_transposed(filter: Filter, columns):
    """Lᵀ applied to columns."""
    rows = columns.shape[0]
    transposed = jax.linear_transpose(lambda draws: colour(filter, draws), jnp.zeros(rows))
    return jax.vmap(lambda c: transposed(c)[0], in_axes=1, out_axes=1)(columns)


def with_noise_intervals(estimate: Estimate) -> Estimate:
    """The estimate with 95 % intervals of its noise coefficients, where the noise was estimated.

    They are the coefficients' ranges over the noise cells that a likelihood ratio does not reject.
    """
    if estimate.noise_given:
        return estimate
    record, gain = estimate.record, float(estimate.model.gain())
    predicted, jacobian = estimate.model.linearise(record.signals)
    residual = np.where(record.sampling.present, np.asarray(record.signals["output"]) - predicted, 0.0)
    span = record_span(record)
    samples = int(record.present.sum())
    grid = noise_grid(samples, record.interval, span).ratios
    if float(estimate.ratios.markov) > 0:
        grid = markov_cells(samples, record.interval, span)
    cells = _mesh(
        np.union1d(r, float(b) * np.array([0.2, 1.0, 5.0])) for r, b in zip(grid, estimate.ratios, strict=True)
    )
    for margin in (4.0, 2.0, 2.0, 2.0, 0.0):
        result = restricted_likelihood(cells, record.interval, span, record.sampling, jacobian, residual)
        below = result.log_likelihood.max() - result.log_likelihood
        kept = below < REJECTED
        if not margin or kept.sum() > 2 * INTERVAL_LEVELS:
            break
        cells = _mesh(_levels(np.asarray(ratio), below < margin * REJECTED) for ratio in np.broadcast_arrays(*cells))
    white = result.residual_sum[kept] / result.degrees_of_freedom
    ratios = cells.take(kept)
    spans = {k: (float(v.min()), float(v.max())) for k, v in noise_coefficients(ratios, white, record, gain).items()}
    low, high = spans["noise_white"]
    scatter = 1.96 / float(np.sqrt(2 * (record.present.sum() - 1)))
    spans["noise_white"] = (low * (1 - scatter), high * (1 + scatter))
    return replace(estimate, noise_interval=spans)


def _levels(ratio: np.ndarray, likely: np.ndarray) -> np.ndarray:
    """Levels of one noise ratio, even in amplitude, from the one below its likely range to the one above."""
    levels = np.unique(ratio)
    first, last = np.searchsorted(levels, [ratio[likely].min(), ratio[likely].max()])
    low, high = levels[max(first - 1, 0)], levels[min(last + 1, len(levels) - 1)]
    return np.linspace(np.sqrt(low), np.sqrt(high), INTERVAL_LEVELS) ** 2
