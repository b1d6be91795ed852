"""Joint fit of all parameters by generalised least squares, the noise by restricted likelihood, in turns."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np

from gyromodel._checks import CampaignError, listed
from gyromodel._model_units import check_domain, check_units
from gyromodel._noise_level import with_stated_level
from gyromodel.attitude import refuse_navigated, with_reference_rates
from gyromodel.averages import MEAN_OF_ATTITUDE, average
from gyromodel.campaign import Campaign
from gyromodel.estimate._estimate import Estimate, EstimateError, noise_coefficients
from gyromodel.estimate._noise import best_ratios, settled, with_noise_intervals
from gyromodel.estimate._optimistix import optimistix_solution
from gyromodel.estimate._rounding import fit_readings, with_step_of
from gyromodel.estimate._whitening import filter_of, pad_columns, whiten_columns
from gyromodel.model import GyroModel, ModelError
from gyromodel.noise import NoiseRatios, from_grams, stated_ratios
from gyromodel.numerics.least_squares import Normal, Solution, levenberg_marquardt
from gyromodel.numerics.state_space import Filter, colour, whitened_gram
from gyromodel.numerics.uncertain import Source
from gyromodel.poses import at_rest
from gyromodel.signals import Record, read_signals

Solver = Literal["auto", "levenberg_marquardt", "optimistix"]
Progress = Callable[[str, float], None] | None

# Relative decrease of the cost that still counts: at a million samples a hundredth of a standard deviation squared.
TOLERANCE = 1e-8
# Relative size of a singular value of the whitened, column-scaled Jacobian below which a direction is not determined.
SINGULAR = 1e-7
# Part of the samples from which on none is left out for not being known to an effect.
MOST_UNKNOWN = 0.5


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
            where the reference rate comes from an attitude, means over 0.2 s. Samples at which a delay or a bandwidth
            still shows what was before the record or in a gap are left out where they are less than half.
        model: what to fit; `noise` empty estimates white noise and flicker and random walk, or a Markov process,
            alongside.
        solver: the package's own Levenberg-Marquardt, or optimistix's; "auto" is its own and, where that does not
            converge, optimistix's.
        progress: called with a line and the fraction done.
        name: what these data are called where their part in a later result's uncertainty is told.

    Raises:
        CampaignError: there is no campaign, one has several axes, or two are the same.
        EstimateError: the campaign does not determine some combination of parameters, or the fit did not converge.
        ModelError: the model needs columns the campaign lacks.
    """
    given = [campaigns] if isinstance(campaigns, Campaign) else campaigns
    record = read_for_fit(given)
    refuse_apart(given, model)
    model, record = with_step_of(model, given), with_stated_level(record, model)
    if progress:
        progress("fitting", 0.1)
    estimate = fit_record(record, model, solver=solver)
    if rows := unknown_rows(record, estimate.model):
        known = record.without(np.array(rows))
        try:
            estimate = fit_record(known, estimate.model_as_given(), start=estimate.ratios, solver=solver)
        except EstimateError as problem:
            late = listed(estimate.model.unknown(record.signals))
            lost = f"without the {len(rows)} samples whose past {late} would have to know"
            raise EstimateError(f"{lost}: {problem}") from None
    estimate = with_noise_intervals(estimate)
    estimate = replace(estimate, source=Source(name, float(estimate.degrees_of_freedom)))
    if progress:
        progress("fitted", 1.0)
    return estimate


def unknown_rows(record: Record, model: GyroModel) -> tuple[int, ...]:
    """The rows in use that an effect of a fitted model does not know, if they are few enough to be given up."""
    unknown = model.unknown(record.signals).values()
    rows = np.flatnonzero(record.present & np.logical_or.reduce([*unknown])[: record.rows]) if unknown else ()
    return tuple(map(int, rows)) if len(rows) < MOST_UNKNOWN * record.present.sum() else ()


def read_for_fit(campaigns: Sequence[Campaign]) -> Record:
    """The signals that `fit` fits to.

    Raises:
        CampaignError: there is none, they do not match, or one has no output of a gyro, or has been navigated.
    """
    if not campaigns:
        raise CampaignError("there is no campaign to fit to")
    refuse_navigated(campaigns)
    rated = [with_reference_rates(c)[0] for c in campaigns]
    means = [MEAN_OF_ATTITUDE * (r is not c) for r, c in zip(rated, campaigns, strict=True)]
    return read_signals([average(at_rest(r), len(r), s)[0] for r, s in zip(rated, means, strict=True)])


def fit_record(
    record: Record,
    model: GyroModel,
    *,
    ratios: NoiseRatios | None = None,
    start: NoiseRatios | None = None,
    markov: bool | None = None,
    solver: Solver = "auto",
    ordinary: bool = False,
) -> Estimate:
    """As `fit`, on signals already read.

    Args:
        record: the data.
        model: what to fit.
        ratios: noise ratios to hold instead of estimating them.
        start: noise ratios to begin with. If none are given: white noise, and where shapes are fitted and slow noise
            was found a second fit begins in that noise, as slow noise taken for white may pull shapes away for good;
            the likelier of the two is returned.
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
    check_enough(record, len(model.slots()))
    if model.reading is not None:
        again = partial(fit_record, start=start, markov=markov, solver=solver, ordinary=ordinary)
        return fit_readings(record, model, model.reading, ratios, again)
    given = given_ratios(record, model) if ratios is None else ratios
    white = NoiseRatios(jnp.zeros(()), jnp.zeros(()))
    shapes = not all(slot.linear for slot in model.slots())
    try:
        estimate = _in_turns(record, model, given or start or white, given is None, markov, solver)
    except EstimateError:
        if given is not None or start is not None or not shapes:
            raise
        # Slow noise taken for white may pull shapes to where nothing shows: begin in that beside shapes as they are.
        beside = _in_turns(record, model.with_shapes_held(), white, True, markov, solver)
        return fit_record(record, model, start=beside.ratios, markov=markov, solver=solver, ordinary=ordinary)
    slow = any(float(r) > 0 for r in (estimate.ratios.flicker, estimate.ratios.walk, estimate.ratios.markov))
    if given is None and start is None and shapes and slow:
        try:
            other = _in_turns(record, model, estimate.ratios, True, markov, solver)
        except EstimateError:
            other = estimate
        estimate = max(estimate, other, key=lambda e: e.log_likelihood)
    if ordinary:
        # The noise is what generalised least squares leaves: ordinary residuals are larger.
        filter = filter_of(record, white)
        solution = solve(model, np.asarray(estimate.model.vector()), record, filter, solver)
        filter = filter_of(record, estimate.ratios)
        estimate = _finish(record, model, estimate.ratios, filter, solution, variance=estimate.white_variance)
    return estimate


def _in_turns(
    record: Record, model: GyroModel, ratios: NoiseRatios, free: bool, markov: bool | None, solver: Solver
) -> Estimate:
    """Parameters in the noise to begin with, then noise and parameters in turns if it is free."""
    filter = filter_of(record, ratios)
    solution = solve(model, np.asarray(model.vector()), record, filter, solver, linear_first=True)
    for turn in range(4 if free else 0):
        before = ratios
        now = model.with_vector(jnp.asarray(solution.x))
        ratios = best_ratios(record, now, coarse=turn == 0, start=before, markov=markov)
        filter = filter_of(record, ratios)
        solution = solve(model, solution.x, record, filter, solver)
        if turn and settled(before, ratios):
            break
    return _finish(record, model, ratios, filter, solution)


def check_enough(record: Record, parameters: int) -> None:
    """Refuse a record without samples to spare."""
    samples = int(record.present.sum())
    if samples <= parameters + 1:
        raise EstimateError(f"{samples} samples cannot determine {parameters} parameters and their noise")


def check_covariates(record: Record, model: GyroModel) -> None:
    """Refuse missing values in a column that an effect needs, a missing column, and a model of another domain."""
    check_domain(model, record.domain)
    model = model.prepared(record.signals)
    for effect in model.effects:
        # Several campaigns serve as the runs that none of them has a column of.
        for name in set(model.columns_needed(effect)) & set(record.signals):
            refuse_missing(effect.label, name, np.asarray(record.signals[name])[: record.rows], record.present)


def refuse_apart(campaigns: Sequence[Campaign], model: GyroModel) -> None:
    """Refuse a campaign that lacks a column which an effect needs and another has; rates may come from an attitude."""
    for effect in model.effects:
        for name in (n for n in model.columns_needed(effect) if n.partition("_")[0] != "rate"):
            lacking = [c.name for c in campaigns if name not in c.columns]
            if 0 < len(lacking) < len(campaigns):
                raise CampaignError(f"{lacking[0]}: lacks column {name}, which effect {effect.label} needs")


def refuse_missing(label: str, name: str, values: np.ndarray, present: np.ndarray) -> None:
    """Refuse values of a column that an effect needs which are missing where there is an output."""
    bad = np.flatnonzero(~np.isfinite(values) & present)
    if len(bad):
        some = ", ".join(str(i + 1) for i in bad[:5]) + ("…" if len(bad) > 5 else "")
        raise ModelError(f"effect {label} needs column {name}, which is NaN in data rows {some}")


def given_ratios(record: Record, model: GyroModel) -> NoiseRatios | None:
    """Noise ratios of a model that states its noise; None where it is to be estimated."""
    if not model.noise:
        return None
    try:
        return stated_ratios(model.noise, record.interval)
    except ValueError as problem:
        raise ModelError(str(problem)) from None


_gram = jax.jit(whitened_gram)


def solve(
    model: GyroModel, x: np.ndarray, record: Record, filter: Filter, solver: Solver, linear_first: bool = False
) -> Solution:
    """Minimise the whitened sum of squares; with `linear_first` in the linear parameters alone, and then in all."""
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
    if linear_first:
        x = _linear_start(model, x, normal)
    if solver != "optimistix":
        solution = levenberg_marquardt(normal, np.asarray(x), TOLERANCE)
        if solver == "levenberg_marquardt" or (solution.converged and np.isfinite(solution.x).all()):
            return solution
    return optimistix_solution(model, jnp.asarray(x), record.signals, filter)


def _linear_start(model: GyroModel, x: np.ndarray, normal: Callable[[np.ndarray], Normal]) -> np.ndarray:
    """The linear parameters that fit best at the start's shapes, if there are any shapes and it is better.

    A fit without a delay may have a gain of the wrong sign, from which no step in all parameters at once leads back.
    """
    slots = model.slots()
    linear = np.array([slot.linear for slot in slots])
    if linear.all() or not linear.any():
        return x
    gram, slope, cost = normal(x)
    step = np.zeros_like(x)
    step[linear] = -np.linalg.lstsq(gram[np.ix_(linear, linear)], slope[linear], rcond=None)[0]
    # All but the gain are multiplied by it.
    others = np.array([model.effects[slot.effect].site != "gain" for slot in slots])
    ratio = float(model.with_vector(jnp.asarray(x + step)).gain() / model.with_vector(jnp.asarray(x)).gain())
    step[others] /= ratio if ratio else 1.0
    return x + step if normal(x + step)[2] < cost else x


def _finish(
    record: Record,
    model: GyroModel,
    ratios: NoiseRatios,
    filter: Filter,
    solution: Solution,
    variance: float | None = None,
) -> Estimate:
    """The estimate at a solution; `variance` is the white one where the solution is that of ordinary least squares."""
    model = checked_solution(model, solution.x, solution.converged, solution.iterations)
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
    white = max(float(w[:, p] @ w[:, p]) / nu, record.imprecision) if variance is None else variance
    gram = w.T @ w
    gram[p, p] += nu * record.imprecision
    likelihood = from_grams(np.atleast_1d(filter.log_determinant), gram[None], len(w)).log_likelihood[0]
    noise = dict(model.noise) or noise_coefficients(ratios, white, record, float(model.gain()))
    rows = record.rows
    whitened = np.full(rows, np.nan)
    whitened[record.present] = w[:, p] / np.sqrt(white)
    return Estimate(
        model=replace(model, noise=noise, noise_of=record.domain),
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


def checked_solution(model: GyroModel, x: np.ndarray, converged: bool, iterations: int) -> GyroModel:
    """The model at a solution; refuses one that did not converge, or left what an effect can be."""
    if not converged:
        raise EstimateError(
            f"the fit of {', '.join(model.labels)} did not converge in {iterations} iterations: "
            "give start values near the solution, or fix some parameters"
        )
    model = model.with_vector(jnp.asarray(x))
    for effect in model.effects:
        try:
            replace(effect)
        except ValueError as problem:
            raise EstimateError(
                f"the fit left what {effect.label} can be ({problem}): give start values nearer the solution"
            ) from None
    return model


def unit_covariance(whitened_jacobian: np.ndarray, model: GyroModel) -> np.ndarray:
    """(JᵀJ)⁻¹ from an R-only QR; refuses directions that the data do not determine, naming their effects."""
    p = whitened_jacobian.shape[1]
    if p == 0:
        return np.zeros((0, 0))
    norm = np.linalg.norm(whitened_jacobian, axis=0)
    if not np.isfinite(norm).all():
        lost = _named(model, ~np.isfinite(norm))
        raise EstimateError(f"the fit ran away in {', '.join(lost)}: give start values, or fix some parameters")
    # Of a smaller one the variance would be no number.
    silent = norm**2 < np.finfo(float).tiny
    if silent.any():
        names = ", ".join(_named(model, silent))
        raise EstimateError(f"{names} cannot be estimated: this campaign does not excite it; remove it or fix it")
    r = np.linalg.qr(whitened_jacobian / norm, mode="r")
    _, singular, directions = np.linalg.svd(r)
    weak = directions[singular < SINGULAR * singular[0]]
    if len(weak):
        names = " and ".join(_named(model, np.abs(weak).max(axis=0) > 0.1))
        raise EstimateError(
            f"{names} cannot be told apart on this campaign: fix all but one, or measure where they differ"
        )
    inverse = np.linalg.inv(r)
    return (inverse @ inverse.T) / np.outer(norm, norm)


def _named(model: GyroModel, parameters: np.ndarray) -> list[str]:
    """Labels of the effects that some of the free parameters belong to."""
    slots = model.slots()
    return sorted({model.labels[slots[i].effect] for i in np.flatnonzero(parameters)})


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
