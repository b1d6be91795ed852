"""One model fitted to each of many campaigns by one compiled program, several threads calling it."""

from __future__ import annotations

import itertools
import os
import threading
from collections import defaultdict, deque
from collections.abc import Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from gyromodel.effects import Effect, Signals
from gyromodel.estimate._estimate import EstimateError
from gyromodel.estimate._fit import SINGULAR, check_covariates, checked_solution, unit_covariance
from gyromodel.estimate._together import (
    TOGETHER,
    Memory,
    SideBySide,
    Waiting,
    described,
    kind_of,
    ready,
    searches,
    side_by_side,
)
from gyromodel.model import GyroModel, Slot
from gyromodel.signals import Record
from gyromodel.units import factor, internal_unit

MOST_ITERATIONS = 100
# Standard deviations by which chi-squared may lie above its degrees of freedom before other starts are tried.
BAD_FIT = 5.0
# Starts looked at where a fit is bad, and how many of the best are followed to their minimum.
STARTS, FOLLOWED = 64, 4
# Starts of a nonlinear parameter without a grid of its own: the given one and so many of its typical sizes around it.
AROUND = (0.0, -4.0, -1.0, -0.25, 0.25, 1.0, 4.0)


@dataclass(frozen=True)
class ManyFits:
    """Fits of one model structure to many campaigns, in their order; a fit that failed is NaN and has its reason.

    Attributes:
        prepared: each campaign's model before the fit, what depends on the campaign filled in; `model` has the fit.
        values: of the free parameters in the order of `slots()`, internal units.
        covariance: of these.
        white_variance: variance of the white noise of one sample, output unit squared.
        reduced_chi_squared: `white_variance` over the stated one; where none is stated over half the mean square of the
            residual's successive differences, which a wrong minimum leaves small.
        iterations: points that the last search of a campaign looked at, on all samples.
        converged: whether there is an estimate.
        bad: whether chi-squared is beyond chance, or no minimum was found, from the given start.
        restarted: whether other starts of the nonlinear parameters were tried.
        reasons: why a fit failed, one sentence; empty where it did not.
    """

    prepared: Sequence[GyroModel] = field(repr=False)
    values: Float[np.ndarray, "campaign parameter"]
    covariance: Float[np.ndarray, "campaign parameter parameter"] = field(repr=False)
    white_variance: Float[np.ndarray, " campaign"]
    reduced_chi_squared: Float[np.ndarray, " campaign"]
    iterations: Int[np.ndarray, " campaign"]
    converged: Bool[np.ndarray, " campaign"]
    bad: Bool[np.ndarray, " campaign"]
    restarted: Bool[np.ndarray, " campaign"]
    reasons: Sequence[str]

    @property
    def std(self) -> Float[np.ndarray, "campaign parameter"]:
        """Standard uncertainties, internal units."""
        return np.sqrt(np.einsum("cpp->cp", self.covariance))

    def model(self, campaign: int) -> GyroModel:
        """A campaign's model at its estimate, its noise as it was given."""
        return self.prepared[campaign].with_vector(self.values[campaign])


class _Fitted(NamedTuple):
    x: np.ndarray
    covariance: np.ndarray
    white: float
    chi: float
    iterations: int
    restarted: bool
    reason: str
    lost: bool = False  # no minimum was found, or one that cannot be
    bad: bool = False
    thinned: bool = False  # the search began at the minimum of a sample of the rows


def fit_many(
    records: Iterable[Record],
    model: GyroModel,
    *,
    restarts: bool = True,
    threads: int | None = None,
) -> ManyFits:
    """Fit the free parameters of a model to each of many campaigns.

    Values are those of `fit_record` with the noise that the model states or, where it states none, with white noise of
    unknown size: all samples count, also those that an effect with memory does not know. Noise is not identified here.
    Models with `quantisation` are refused: `fit` fits them. One program is compiled for a model's structure and each
    power of two of the campaigns' lengths. Only the campaigns being fitted are held in memory, so that `records` may be
    a generator.

    Args:
        records: the campaigns' data.
        model: what to fit; where it states its reference points, parameters of different campaigns compare.
        restarts: try other starts of the nonlinear parameters where a fit is bad or found no minimum.
        threads: how many call the compiled program at once; by default one for each processor.

    Raises:
        EstimateError: JAX runs in single precision. A campaign that cannot be fitted is told of in the result.
    """
    if not jnp.zeros(()).dtype == jnp.float64:
        raise EstimateError("JAX runs in single precision; import gyromodel before using jax, or set JAX_ENABLE_X64=1")
    threads = threads or _processors()
    prepared: list[GyroModel] = []
    # Prepared for each campaign, it is asked for its numbers, which takes longer of arrays of JAX.
    model = jax.tree.map(np.asarray, model)
    given = described(model)
    done: dict[int, _Fitted] = {}
    waiting: dict[Any, list[Waiting]] = {}
    compiled: dict[Any, threading.Event] = {}
    running: deque[Future[dict[int, _Fitted]]] = deque()
    memory: defaultdict[int, Memory] = defaultdict(dict)  # of each thread

    def work(key: Any, campaigns: list[Waiting], first: bool) -> dict[int, _Fitted]:
        # The first of a kind compiles; the others wait for its program instead of compiling it too.
        if not first:
            compiled[key].wait()
        try:
            return _fit_together(campaigns, key[0], restarts, memory[threading.get_ident()])
        finally:
            compiled[key].set()

    with ThreadPoolExecutor(threads) as pool:

        def start(key: Any) -> None:
            first = key not in compiled
            compiled.setdefault(key, threading.Event())
            running.append(pool.submit(work, key, waiting.pop(key), first))
            while len(running) > 2 * threads:
                done.update(running.popleft().result())

        for place, record in enumerate(records):
            prepared.append(model)
            try:
                campaign = ready(place, record, given)
            except ValueError as problem:
                done[place] = _failed(str(problem))
                continue
            prepared[place] = campaign.model
            key = kind_of(campaign)
            waiting.setdefault(key, []).append(campaign)
            if len(waiting[key]) == TOGETHER:
                start(key)
        for key in list(waiting):
            start(key)
        for future in running:
            done.update(future.result())
    return _gathered(prepared, [done[i] for i in range(len(prepared))])


def _processors() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _fit_together(campaigns: list[Waiting], blocks: int, restarts: bool, memory: Memory) -> dict[int, _Fitted]:
    data, starts = side_by_side(campaigns, blocks, memory), [(i, c.start) for i, c in enumerate(campaigns)]
    fitted = _followed(campaigns, data, starts, thin=True)
    # The minimum of a sample of the rows can lead astray.
    again = [starts[i] for i, fit in enumerate(fitted) if fit.bad and fit.thinned]
    for (i, _), other in zip(again, _followed(campaigns, data, again), strict=True):
        fitted[i] = _better(other, fitted[i])
    bad = [i for i, fit in enumerate(fitted) if fit.bad]
    tried = [(i, x) for i in bad if restarts for x in _starts(campaigns[i].model, campaigns[i].record.signals)]
    chosen = []
    if tried:
        found, *_ = searches(data, tried, 1)
        p = found.x.shape[1]
        looked = np.asarray(found.gram[:, p, p] - found.promise)
        for i in {i for i, _ in tried}:
            own = [(cost, k) for k, cost in enumerate(looked) if tried[k][0] == i and np.isfinite(cost)]
            chosen += [tried[k] for _, k in sorted(own)[:FOLLOWED]]
    for (i, _), other in zip(chosen, _followed(campaigns, data, chosen), strict=True):
        fitted[i] = _better(other, fitted[i])._replace(restarted=True, bad=True)
    return {c.place: fit for c, fit in zip(campaigns, fitted, strict=True)}


def _better(one: _Fitted, other: _Fitted) -> _Fitted:
    return one if not one.reason and (other.reason or one.white < other.white) else other


def _failed(reason: str) -> _Fitted:
    return _Fitted(np.zeros(0), np.zeros((0, 0)), np.nan, np.nan, 0, False, reason)


def _followed(
    campaigns: list[Waiting], data: SideBySide, tasks: Sequence[tuple[int, np.ndarray]], thin: bool = False
) -> list[_Fitted]:
    """The estimates where searches end, or why there is none."""
    if not tasks:
        return []
    found, expected, thinned = searches(data, tasks, MOST_ITERATIONS, MOST_ITERATIONS * thin)
    x, gram = np.asarray(found.x), np.asarray(found.gram)
    p, freedom = x.shape[1], data.freedom[[i for i, _ in tasks]]
    white = (gram[:, p, p] - np.asarray(found.promise)) / freedom
    chi, limit = white / expected, 1.0 + BAD_FIT * np.sqrt(2.0 / freedom)
    inverse, root, whole = _inverses(gram[:, :p, :p])
    slots, fits = campaigns[0].model.slots(), []
    for k, (i, _) in enumerate(tasks):
        model, converged, iterations = campaigns[i].model, bool(found.converged[k]), int(found.iterations[k])
        lost = False
        try:
            if not np.isfinite(white[k]):
                check_covariates(campaigns[i].record, model)
                raise EstimateError("the model is not finite at its start values: give others")
            lost = not converged or not _possible(model, slots, x[k])
            if lost:
                checked_solution(model, x[k], converged, iterations)
            if not whole[k]:
                # A root of JᵀJ stands for J, and what names the effects is the same.
                unit_covariance(root[k], model)
            fit = _Fitted(x[k], inverse[k] * white[k], white[k], chi[k], iterations, False, "")
        except ValueError as problem:
            fit = _failed(str(problem))._replace(chi=chi[k], iterations=iterations, lost=lost)
        fits.append(fit._replace(bad=bool(lost or chi[k] > limit[k]), thinned=bool(thinned[k])))
    return fits


def _inverses(information: Float[np.ndarray, "task p p"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(JᵀJ)⁻¹, roots of JᵀJ, and whether the data determine all directions, as far as JᵀJ can tell in its rounding."""
    p = information.shape[1]
    finite = np.isfinite(information).all(axis=(1, 2), keepdims=True)
    information = np.where(finite, information, np.eye(p))
    size = np.sqrt(np.einsum("tpp->tp", information))[:, None]
    size[size == 0] = 1.0
    values, vectors = np.linalg.eigh(information / (size * size.swapaxes(1, 2)))
    values, rows = values[:, :, None], vectors.swapaxes(1, 2)
    known = values > max(SINGULAR**2, p * np.finfo(float).eps) * values.max(axis=1, keepdims=True, initial=0.0)
    values, scaled = np.where(known, values, 0.0), rows / size
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = scaled.swapaxes(1, 2) @ (scaled / values)
    return inverse, np.sqrt(values) * rows * size, known.all(axis=(1, 2))


def _possible(model: GyroModel, slots: Sequence[Slot], x: np.ndarray) -> bool:
    """Whether no nonlinear parameter has left what its effect can be."""
    changed: dict[int, Effect] = {}
    for slot, value in zip(slots, x, strict=True):
        if slot.linear:
            continue
        if slot.effect not in changed:
            # A new effect made as usual, with arrays of JAX, would take longer than its part of the fit.
            changed[slot.effect] = object.__new__(type(model.effects[slot.effect]))
            vars(changed[slot.effect]).update(vars(model.effects[slot.effect]))
        fields = vars(changed[slot.effect])
        fields[slot.field] = np.array(fields[slot.field])
        fields[slot.field].flat[slot.index] = value
    try:
        for effect in changed.values():
            for kind in type(effect).__mro__:
                if "__check_init__" in vars(kind):
                    kind.__check_init__(effect)  # type: ignore[attr-defined]
    except ValueError:
        return False
    return True


def _starts(model: GyroModel, signals: Signals) -> list[np.ndarray]:
    """Starts at other values of the free nonlinear parameters: all combinations of their levels, or a draw of them."""
    start, slots = np.asarray(model.vector()), model.slots()
    levels: list[list[tuple[list[int], np.ndarray]]] = []
    for i, effect in enumerate(model.effects):
        own = [k for k, slot in enumerate(slots) if slot.effect == i and not slot.linear]
        if not own:
            continue
        forms = [
            np.array([np.ravel(getattr(e, slots[k].field))[slots[k].index] for k in own])
            for e in _alike(effect, signals)
        ]
        if forms:
            levels.append([(own, values) for values in forms])
            continue
        for k in own:
            declared = effect.declared()[slots[k].field]
            size = declared.typical * factor(declared.unit, internal_unit(declared.unit))
            levels.append([([k], start[[k]] + size * times) for times in AROUND])
    if not levels:
        return []
    if np.prod([float(len(each)) for each in levels]) <= STARTS:
        chosen: Iterable[Sequence[tuple[list[int], np.ndarray]]] = itertools.product(*levels)
    else:
        rng = np.random.default_rng(0)
        chosen = [[each[rng.integers(len(each))] for each in levels] for _ in range(STARTS)]
    found = []
    for combination in chosen:
        x = start.copy()
        for places, values in combination:
            x[places] = values
        found.append(x)
    return found


def _alike(effect: Effect, signals: Signals) -> list[Effect]:
    """The forms that a search would try, of the same shapes."""
    shapes = {name: np.shape(getattr(effect, name)) for name in effect.declared()}
    forms = effect.candidates(signals)
    return [e for e in forms if all(np.shape(getattr(e, name)) == shape for name, shape in shapes.items())]


def _gathered(prepared: list[GyroModel], fits: list[_Fitted]) -> ManyFits:
    """Results as arrays; campaigns without an estimate, or of another number of parameters, are NaN."""
    p = next((len(fit.x) for fit in fits if not fit.reason), 0)
    odd = f"the model has another number of free parameters here than the {p} of the first campaign"
    fits = [fit if fit.reason or len(fit.x) == p else _failed(odd) for fit in fits]
    good = np.array([not fit.reason for fit in fits], bool)
    values, covariance = np.full((len(fits), p), np.nan), np.full((len(fits), p, p), np.nan)
    for i in np.flatnonzero(good):
        values[i], covariance[i] = fits[i].x, fits[i].covariance
    return ManyFits(
        prepared=prepared,
        values=values,
        covariance=covariance,
        white_variance=np.array([fit.white for fit in fits]),
        reduced_chi_squared=np.array([fit.chi for fit in fits]),
        iterations=np.array([fit.iterations for fit in fits], int),
        converged=good,
        bad=np.array([fit.bad for fit in fits], bool),
        restarted=np.array([fit.restarted for fit in fits], bool),
        reasons=[fit.reason for fit in fits],
    )
