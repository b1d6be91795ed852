"""The best test plan for a time: how often to do each of some candidate parts, by exchange (Fedorov, 1972).

Parts are measured one after another with noise that starts anew in each, so that what they tell adds up; an error that
an instrument has all along is one in all of them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from gyromodel._checks import CampaignError
from gyromodel.campaign import Campaign
from gyromodel.effects import Effect
from gyromodel.model import GyroModel, ModelError, make_effect
from gyromodel.plan import planned, read_yaml, seconds
from gyromodel.signals import read_signals
from gyromodel.study._known import Known
from gyromodel.study._mission import with_known_output
from gyromodel.study._next import blocks, covariance_after, information, without_shared
from gyromodel.units import UnitError, factor, internal_unit

Criterion = Literal["parameters", "outcome", "discrimination"]
# Standard errors, relative to what all candidates together leave, of parameters that nothing is known of before.
VAGUE = 1e5
# Relative gain of a score from which an exchange counts.
LEAST_GAIN = 1e-9
# Parts of one plan: what is done more often is a longer part.
MOST_PARTS = 10_000
# What is left of an effect, squared and relative to the whole, that its rival takes to rounding.
ROUNDING = 1e-9
# Stands for zero where a logarithm is taken.
LEAST = 1e-300
# Added to a diagonal of ones: a rival that a plan shows nothing of takes nothing.
SINGULAR = 1e-12


class Part(NamedTuple):
    """A candidate part of a test plan: what it is called, how long it takes (s) with its changeover, and its course."""

    name: str
    duration: float
    campaign: Campaign


class TestPlan(NamedTuple):
    """How often to do each part.

    Args:
        times: by part; those not done are left out. Of a plan that does each as often, a part of a time is that share.
        duration: of all, s.
        covariance: of the parameters after it, internal units.
        separation: least distance between two rival effects of typical size, in standard deviations; NaN without.
    """

    times: dict[str, float]
    duration: float
    covariance: Float[np.ndarray, "parameter parameter"]
    separation: float

    __test__ = False  # pytest takes the name for that of tests


class PlanChoice(NamedTuple):
    """The best plan beside one that does each part as often.

    Args:
        criterion: what was made best.
        best: that plan.
        equal: each part as often, for as long as the best plan takes, in shares of a part.
        gain: how many times narrower intervals are by the best plan, in the sense of the criterion; of a
            discrimination how many times larger the separation is. Below one where only shares of parts do better.
    """

    criterion: Criterion
    best: TestPlan
    equal: TestPlan
    gain: float


def read_candidates(path: str | Path) -> list[Part]:
    """Candidate parts of a test plan.

    The file is a plan whose `columns` hold unless a part says otherwise, with a list `candidates` of parts, each with
    a `name`, a `duration` and its own `columns`. A `changeover` is the time that each part takes besides, each time.

    Raises:
        CampaignError: the file is none of that; the message names the part.
    """
    path = Path(path)
    plan = read_yaml(path)
    needed = {"interval", "kind", "output", "columns", "candidates"}
    missing = sorted(needed - set(plan)) if isinstance(plan, dict) else sorted(needed)
    if missing or not isinstance(plan["columns"], dict) or not isinstance(plan["candidates"], list):
        raise CampaignError(f"{path}: needs interval, kind, output, columns and a list of candidates")
    usual, parts = plan.pop("columns"), []
    try:
        changeover = seconds(plan.pop("changeover")) if "changeover" in plan else 0.0
    except (CampaignError, UnitError) as error:
        raise CampaignError(f"{path}: changeover: {error}") from None
    for number, given in enumerate(plan.pop("candidates"), 1):
        if not isinstance(given, dict) or set(given) - {"name", "columns"} != {"duration"}:
            raise CampaignError(f"{path}: candidate {number} needs a duration, and may have a name and columns")
        name, own = str(given.get("name", number)), given.get("columns") or {}
        if not isinstance(own, dict):
            raise CampaignError(f"{path}: candidate {name}: columns must map column names to a value or to segments")
        if unknown := [str(column) for column in own if column not in usual]:
            raise CampaignError(
                f"{path}: candidate {name} has a column {unknown[0]} that the others lack: state its usual value"
            )
        try:
            campaign = planned({**plan, "duration": given["duration"], "columns": {**usual, **own}}, name)
            parts.append(Part(name, seconds(given["duration"]) + changeover, campaign))
        except (CampaignError, UnitError) as error:
            raise CampaignError(f"{path}: candidate {name}: {error}") from None
    if len({part.name for part in parts}) < len(parts) or not parts:
        raise CampaignError(f"{path}: give each candidate a name of its own")
    return parts


def best_plan(
    known: Known,
    parts: Sequence[Part],
    budget: float,
    criterion: Criterion = "parameters",
    *,
    jacobian: Float[np.ndarray, "entry parameter"] | None = None,
    rivals: Sequence[str] = (),
    anew: bool = False,
    instruments: Mapping[str, Any] | None = None,
) -> PlanChoice:
    """The plan that tells most within a time, by exchange from two starts.

    Args:
        known: the calibrated gyro, whose values and noise it takes.
        parts: candidates; each may be done several times.
        budget: time for all, s.
        criterion: the least determinant of the parameters' covariance ("parameters": D-optimal), the least variance of
            an outcome ("outcome": c- or A-optimal), or the largest of the least separations of rival effects
            ("discrimination": T-optimal).
        jacobian: derivative of the outcome, for "outcome".
        rivals: effects to be told apart, for "discrimination"; at their typical sizes.
        anew: whether the calibration counts for nothing, instead of what the plan adds to.
        instruments: errors of columns.

    Raises:
        ModelError: no part fits the time, or the criterion lacks what it needs.
    """
    durations = np.array([part.duration for part in parts])
    if not (durations <= budget).any():
        raise ModelError(f"no candidate fits into {budget:g} s; the shortest takes {durations.min():g} s")
    if budget > MOST_PARTS * durations.min():
        raise ModelError(
            f"{budget:g} s hold the shortest candidate, of {durations.min():g} s, more than {MOST_PARTS} times: give "
            "longer parts, or less time"
        )
    if criterion == "outcome" and jacobian is None:
        raise ModelError("a plan for an outcome needs its derivative")
    if criterion == "discrimination" and (len({*rivals}) < 2 or len(known.models) > 1):
        raise ModelError("a plan that tells effects apart needs two rival effects or more, and one gyro")
    if already := {*rivals} & {label for model in known.models for label in model.labels}:
        raise ModelError(f"the model has {min(already)} already: rivals are effects that it lacks")
    joint = read_signals([with_known_output(part.campaign, i) for i, part in enumerate(parts)])
    models = tuple(model.prepared(joint.signals) for model in known.models)
    effects = GyroModel(tuple(map(make_effect, rivals))).prepared(joint.signals).effects
    each = [[information(m, p.campaign, instruments, rivals=effects, shared=True) for m in models] for p in parts]
    kinds = sum(len(e.all_along(np.zeros(1))) for name, e in (instruments or {}).items() if name in joint.signals)
    shared, told = kinds * len(models), np.stack([_shared_last(of_part, kinds) for of_part in each])
    count = len(known.vector)
    errors = known.factor
    if anew:
        most = without_shared(told.sum(axis=0), shared)[:count, :count].diagonal()
        if not (most > 0).all():
            raise ModelError("the candidates together tell nothing of a parameter of the model: add another part")
        errors = np.diag(VAGUE / np.sqrt(most))
    score = _score(criterion, errors, jacobian, effects, shared)
    start = _in_turn(durations, budget)
    found = [_exchanged(n, told, durations, budget, score) for n in (np.zeros(len(parts), int), start)]
    best = max(found, key=lambda n: score(np.tensordot(n, told, 1)[None])[0])
    separation = _score("discrimination", errors, None, effects, shared) if rivals else None

    def plan(n: np.ndarray) -> TestPlan:
        total = np.tensordot(n, told, 1)
        covariance = covariance_after(errors, without_shared(total, shared)[:count, :count])
        apart = float(np.exp(separation(total[None])[0] / 2)) if separation else np.nan
        times = {part.name: k.item() for part, k in zip(parts, n, strict=True) if k}
        return TestPlan(times, float(n @ durations), covariance, apart)

    equal = np.full(len(parts), best @ durations / durations.sum())
    after, before = (float(score(np.tensordot(n, told, 1)[None])[0]) for n in (best, equal))
    if criterion == "discrimination" and after <= np.log(LEAST):
        raise ModelError(f"no plan of these candidates tells {' and '.join(rivals)} apart: add another part")
    if criterion == "outcome" and after >= -np.log(LEAST):
        raise ModelError("the outcome has no uncertainty that a test could lessen")
    # Scores are ln det of the information, minus ln variance, and ln separation squared.
    gain = np.exp((after - before) / (2.0 * (count if criterion == "parameters" else 1)))
    return PlanChoice(criterion, plan(best), plan(equal), float(gain))


def _shared_last(told: Sequence[np.ndarray], kinds: int) -> np.ndarray:
    """Information of several gyros, their instruments' errors behind all parameters."""
    ends = np.cumsum([0, *map(len, told)])
    shared = np.concatenate([np.arange(end - kinds, end) for end in ends[1:]]) if kinds else np.zeros(0, int)
    order = np.append(np.setdiff1d(np.arange(ends[-1]), shared), shared)
    return blocks(told)[np.ix_(order, order)]


def _score(
    criterion: Criterion, errors: np.ndarray, jacobian: np.ndarray | None, effects: Sequence[Effect], shared: int
) -> Callable[[np.ndarray], np.ndarray]:
    """A score of stacks of information matrices whose last parameters are shared errors, the larger the better."""
    score = _score_alone(criterion, errors, jacobian, effects)
    return lambda told: score(without_shared(told, shared))


def _score_alone(
    criterion: Criterion, errors: np.ndarray, jacobian: np.ndarray | None, effects: Sequence[Effect]
) -> Callable[[np.ndarray], np.ndarray]:
    """A score of stacks of information matrices, the larger the better."""
    count = len(errors)

    def inner(told: np.ndarray) -> np.ndarray:
        return np.eye(errors.shape[1]) + errors.T @ told[:, :count, :count] @ errors

    if criterion == "parameters":
        return lambda told: np.linalg.slogdet(inner(told))[1]
    if criterion == "outcome":
        assert jacobian is not None
        seen = jacobian @ errors
        gram = seen.T @ seen / len(seen)

        def known_well(told: np.ndarray) -> np.ndarray:
            left = np.linalg.solve(inner(told), np.broadcast_to(gram, (len(told), *gram.shape)))
            return -np.log(np.maximum(np.trace(left, axis1=1, axis2=2), LEAST))

        return known_well
    sizes = [typical(effect) for effect in effects]
    ends = count + np.cumsum([0, *(len(size) for size in sizes)])
    places = [np.arange(a, b) for a, b in pairwise(ends)]

    def apart(told: np.ndarray) -> np.ndarray:
        least = np.full(len(told), np.inf)
        for a, size in zip(places, sizes, strict=True):
            for b in places:
                if b is a:
                    continue
                # What neither the parameters, as far as they are open, nor the rival take of the effect.
                rows, known = np.concatenate([np.arange(count), b]), errors.shape[1]
                span = np.zeros((len(rows), known + len(b)))
                span[:count, :known], span[count:, known:] = errors, np.eye(len(b))
                gram = span.T @ told[:, rows][:, :, rows] @ span
                gram[:, np.arange(known), np.arange(known)] += 1.0
                scale = np.sqrt(np.maximum(np.einsum("nii->ni", gram), 1e-300))
                gram = gram / (scale[:, :, None] * scale[:, None]) + SINGULAR * np.eye(len(span.T))
                seen = span.T @ told[:, rows][:, :, a] @ size / scale
                taken = np.linalg.solve(gram, seen[:, :, None])[:, :, 0]
                whole = np.einsum("i,nij,j->n", size, told[:, a][:, :, a], size)
                left = whole - np.einsum("ni,ni->n", seen, taken)
                least = np.minimum(least, np.where(left > ROUNDING * whole, left, 0.0))
        return np.log(np.maximum(least, LEAST))

    return apart


def typical(effect: Effect) -> np.ndarray:
    """Typical values of an effect's linear coefficients, internal units."""
    sizes = []
    for name, declared in effect.declared().items():
        if declared.linear:
            value = declared.typical * factor(declared.unit, internal_unit(declared.unit))
            sizes.append(np.full(jnp.size(getattr(effect, name)), value))
    return np.concatenate(sizes)


def _in_turn(durations: np.ndarray, budget: float) -> Int[np.ndarray, " part"]:
    """Each part in turn, as long as one fits."""
    times, left = np.zeros(len(durations), int), budget
    while (fits := durations <= left * (1 + 1e-12)).any():
        for i in np.flatnonzero(fits):
            if durations[i] <= left * (1 + 1e-12):
                times[i] += 1
                left -= durations[i]
    return times


def _exchanged(
    times: np.ndarray, told: np.ndarray, durations: np.ndarray, budget: float, score: Callable[[np.ndarray], np.ndarray]
) -> Int[np.ndarray, " part"]:
    """Fill up a plan and exchange its parts for others until no exchange of one helps."""

    def of(plans: list[np.ndarray]) -> np.ndarray:
        return score(np.tensordot(np.array(plans), told, 1))

    def filled(n: np.ndarray) -> np.ndarray:
        while (fits := np.flatnonzero(durations <= (budget - n @ durations) * (1 + 1e-12) + 1e-9)).size:
            more = [n + (np.arange(len(n)) == i) for i in fits]
            gained = (of(more) - of([n])[0]) / durations[fits]
            n = more[int(np.argmax(gained))]
        return n

    times = filled(times)
    now = of([times])[0]
    while True:
        tried = []
        for i in np.flatnonzero(times):
            for j in range(len(times)):
                n = times - (np.arange(len(times)) == i)
                room = int((budget - n @ durations) * (1 + 1e-12) / durations[j])
                if j != i and room:
                    tried.append(n + room * (np.arange(len(times)) == j))
        if not tried:
            return times
        other = filled(tried[int(np.argmax(of(tried)))])
        then = of([other])[0]
        if not then > now + LEAST_GAIN * max(abs(now), 1.0):
            return times
        times, now = other, then
