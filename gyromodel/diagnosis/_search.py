"""Rounds of the search: rank all candidates, add the best, refit, choose the earlier ones again, until none is left."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from gyromodel.diagnosis._drivers import smooth_columns
from gyromodel.diagnosis._evidence import log_evidence_ratio, log_sum
from gyromodel.diagnosis._forms import MAXIMUM_LINES, addition
from gyromodel.diagnosis._pairs import best_pair
from gyromodel.diagnosis._ranking import (
    Ranking,
    is_driver,
    is_noise,
    line_frequencies,
    rank,
    rank_where_it_matters,
    skipped,
)
from gyromodel.diagnosis._scan import CLEARLY, Scanner
from gyromodel.effects import Effect
from gyromodel.estimate import Estimate, EstimateError, fit_record
from gyromodel.model import GyroModel
from gyromodel.noise import NoiseRatios
from gyromodel.signals import Record

Progress = Callable[[str, float], None] | None
NoisePath = Sequence[NoiseRatios]

MAXIMUM_ROUNDS = 12
# An earlier choice is exchanged when another candidate beats it by this many nats given all the others.
EXCHANGE = 2.0
# More steps than this are a function of time that nobody explains by naming each.
MAXIMUM_STEPS = 3
# Lines that lead every other name by this much (nats) are not chosen again.
LINE_LEAD = 20.0
# Functions of time that one run cannot tell from a random walk, and the lead (nats) over it at which they are put
# beside it.
SLOW_IN_TIME = ("bias_drift", "bias_warmup", "bias_step")
SLOW_LEAD = 2.5
# A function of time alone must beat a random walk by this much in one run: no real slow noise is exactly a random walk.
TIME_MARGIN = 15.0


@dataclass(frozen=True)
class Found:
    """One accepted addition and the ranking that spoke for it.

    `paired`: the first of two that show together and not alone; the next is the other.
    """

    name: str
    effect: Effect | None
    rows: tuple[int, ...]
    ranking: Ranking
    paired: bool = False

    @property
    def frees_noise(self) -> bool:
        """Whether it says that the stated noise lacks something, so that the noise is estimated from here on."""
        return is_noise(self.name)


@dataclass(frozen=True)
class Selection:
    """Where the rounds ended: the extended fit, what was added, and the ranking in which no more was significant.

    `left_out` holds rankings beside everything found except one, where the search has made them; `remains` names what
    was still significant and not added, `unresolved` says why if it is too small.
    """

    estimate: Estimate
    found: tuple[Found, ...]
    path: tuple[Found, ...]
    last: Ranking
    estimates: tuple[Estimate, ...]
    driver: str | None
    left_out: dict[int, Ranking] = field(default_factory=dict, repr=False)
    remains: str = ""
    unresolved: str = ""


def search(
    record: Record,
    scanner: Scanner,
    baseline: Estimate,
    threshold: float,
    *,
    progress: Progress = None,
    noise: NoisePath = (),
    avoid: str = "",
) -> Selection:
    """Add candidates until nothing more is significant.

    Args:
        record: the data.
        scanner: the search laid out on it.
        baseline: the fitted simulation.
        threshold: least ln evidence ratio of an addition.
        progress: called with a line and the fraction done.
        noise: noise ratios to hold in the fits, see `refit`.
        avoid: a name that is not to be the first.
    """
    path: list[Found] = []
    estimates, remains, small = [baseline], "", ""
    while True:
        estimate = estimates[-1]
        pulses = tuple(r for f in path for r in f.rows)
        ranking = rank_where_it_matters(scanner, estimate, pulses)
        full = len(line_frequencies(estimate.model)) >= MAXIMUM_LINES
        remains = "bias_periodic" if full and ranking.statistic.get("bias_periodic", -np.inf) >= threshold else ""
        name, score = ranking.best(drivers=False, but=("bias_periodic" if full else "", "" if path else avoid))
        if name is None or (score < threshold and not _slow_structure(ranking, name, score, threshold, scanner.runs)):
            both = _together(record, scanner, baseline, path, estimate, ranking, threshold, noise)
            if not both or len(path) + 2 > MAXIMUM_ROUNDS or any(_unresolved(e, f, scanner.step) for f, e in both):
                break
            path += [step for step, _ in both]
            estimates += [after for _, after in both]
            continue
        if len(path) >= MAXIMUM_ROUNDS:
            remains = name
            break
        steps = [i for i, f in enumerate(path) if f.name == "bias_step"]
        if name == "bias_step" and len(steps) >= MAXIMUM_STEPS:
            return _before(steps[0], path, estimates)
        step, after = _added(record, scanner, baseline, path, estimate, ranking, name, noise)
        small = _unresolved(after, step, scanner.step) if after is not None else ""
        if after is None or small:
            remains = name
            break
        if progress:
            progress(f"found {name}", min(0.25 + 0.06 * len(path), 0.6))
        path.append(step)
        estimates.append(after)
        if step.rows and scanner.by_points:
            # Which points are right must be settled before anything is read into the rest.
            ranking = rank_where_it_matters(scanner, after, step.rows)
            break
    driver, score = path[0].ranking.best(drivers=True) if path else (None, -np.inf)
    if score > threshold and _lead(scanner, baseline, str(driver), path, ranking) > EXCHANGE:
        # One smooth driver explains more than all the names together; names of its own columns may have had to stand
        # back behind one that follows several of them.
        own, first = set(smooth_columns(str(driver))), path[0].effect
        if not avoid and first is not None and not own >= set(first.columns_needed):
            other = search(record, scanner, baseline, threshold, progress=progress, noise=noise, avoid=path[0].name)
            if other.found:
                return other
        return Selection(baseline, (), (), path[0].ranking, (baseline,), driver)
    found, left_out = standing(path), {}
    if sum(f.effect is not None for f in found) > 1:
        before = found
        found, estimates[-1], left_out = _exchange(record, scanner, baseline, found, estimates[-1], threshold, noise)
        if found != before:
            ranking = rank_where_it_matters(scanner, estimates[-1], tuple(r for f in found for r in f.rows))
            name, score = ranking.best(drivers=False, but=("bias_periodic",))
            remains = remains or (str(name) if score >= threshold else "")
    driver = _significant_driver(ranking, threshold, scanner.runs)
    return Selection(
        estimates[-1], tuple(found), tuple(path), ranking, tuple(estimates), driver, left_out, remains, small
    )


def _unresolved(estimate: Estimate, step: Found, reading: float) -> str:
    """Why an effect says nothing, as it is nowhere larger than what passes for it; `reading`: the step of readings.

    Readings of what moves within a step stand still, and a still reading of a moving thing is an error that follows
    the motion: it is not the noise that the evidence weighs. Nor is what another effect may leave.
    """
    model, record = estimate.model, estimate.record
    if record.domain == "gyro" or step.effect is None or step.effect.label not in model.labels:
        return ""
    effect = model.effects[model.labels.index(step.effect.label)]
    size = float(np.abs(np.asarray(effect.contribution(record.signals))[: record.rows]).max())
    left = {e.label: e.leaves(record.signals) for e in model.effects if e.label != effect.label}
    other = max(left, key=lambda label: left[label], default="")
    if reading and size < 0.5 * reading:
        within = f"half a step of the encoders ({np.rad2deg(reading):.2g} deg)"
        passes = "readings that stand still pass"
    elif other and size < left[other]:
        within = f"{np.rad2deg(left[other]):.2g} deg"
        passes = f"what sticks, which {other} leaves out, passes"
    else:
        return ""
    return f"{step.name} would be within {within} throughout, where {passes} for it: not named."


def _lead(scanner: Scanner, baseline: Estimate, driver: str, path: list[Found], last: Ranking) -> float:
    """By how many nats a driver of the first ranking leads all that was found together.

    Names that partly stand for one another add up to more than they explain. Beside a driver that was ahead of the
    first, several are therefore also weighed as one addition, by what they have explained in the last noise cells.
    """
    first, name = path[0].ranking, path[0].name
    lead = first.statistic[driver] - sum(f.ranking.statistic[f.name] for f in path)
    p, q = first.baseline_columns.shape[1], last.baseline_columns.shape[1]
    several = len(standing(path)) > 1 and q > p and not any(f.frees_noise for f in path)
    if lead > EXCHANGE or not several or first.statistic[driver] < first.statistic[name]:
        return lead
    first = rank(scanner, list(last.results), baseline, (), skipped(baseline.model, scanner.record.signals))
    names, alone = [], []
    for g, other in last.results.items():
        one = first.results[g]
        log, left = one.log_likelihood + first.log_prior[g], np.array(one.rss - other.rss)
        names.append(log + log_evidence_ratio(left, one.rss, first.samples - p, q - p))
        alone.append(log + one.evidence.get(driver, -np.inf))
    return max(lead, log_sum(alone) - log_sum(names))


def _added(
    record: Record,
    scanner: Scanner,
    baseline: Estimate,
    path: list[Found],
    estimate: Estimate,
    ranking: Ranking,
    name: str,
    noise: NoisePath,
) -> tuple[Found, Estimate | None]:
    """A candidate as the next step of a path, and the fit with it."""
    pulses = tuple(r for f in path for r in f.rows)
    step = Found(name, *addition(scanner, estimate, ranking, name, pulses), ranking)
    return step, refit(record, baseline, standing([*path, step]), noise)


def _together(
    record: Record,
    scanner: Scanner,
    baseline: Estimate,
    path: list[Found],
    estimate: Estimate,
    ranking: Ranking,
    threshold: float,
    noise: NoisePath,
) -> list[tuple[Found, Estimate]]:
    """Two candidates that are significant together where none is alone, with their fits; none: there are no such."""
    pair, score = best_pair(scanner, ranking)
    if pair is None or score < threshold:
        return []
    one, first = _added(record, scanner, baseline, path, estimate, ranking, pair[0], noise)
    if first is None:
        return []
    one = replace(one, paired=True)
    ranking = rank_where_it_matters(scanner, first, tuple(r for f in path for r in f.rows))
    if ranking.statistic.get(pair[1], -np.inf) < threshold:
        return []
    other, both = _added(record, scanner, baseline, [*path, one], first, ranking, pair[1], noise)
    return [] if both is None else [(one, first), (other, both)]


def _significant_driver(ranking: Ranking, threshold: float, runs: int) -> str | None:
    """The leading smooth driver, if it is significant; for one of time beside slow noise, over what a walk makes."""
    driver, score = ranking.best(drivers=True)
    like_a_walk = driver == "smooth(time)" and runs < 2 and ranking.slow_noise
    return driver if score >= (max(threshold, TIME_MARGIN) if like_a_walk else threshold) else None


def _before(i: int, path: list[Found], estimates: list[Estimate]) -> Selection:
    """The search as it stood before step i, from which on it followed time, or what leads the step, without a name."""
    ranking, driver = path[i].ranking, "smooth(time)"
    leading, score = ranking.best(drivers=True)
    if score > ranking.statistic[path[i].name]:
        driver = leading
    return Selection(
        estimates[i],
        tuple(standing(path[:i])),
        tuple(path[:i]),
        ranking,
        tuple(estimates[: i + 1]),
        driver if driver in ranking.statistic else None,
        remains=path[i].name,
    )


def standing(path: Sequence[Found]) -> list[Found]:
    """The steps of a path that no later step replaced by a more general form."""
    later: set[str] = set()
    kept = []
    for step in reversed(path):
        if step.name not in later:
            kept.append(step)
        later |= set(step.effect.supersedes) if step.effect is not None else set()
    return kept[::-1]


def like(ranking: Ranking, name: str, others: Sequence[str]) -> bool:
    """Whether a candidate is one of some names, or explains the same data as one of them."""
    if name in others or name == "outliers" or name not in ranking.results[ranking.best_cell(name)].best:
        return name in others
    return not ranking.twins(name).isdisjoint(others)


def _slow_structure(ranking: Ranking, name: str, score: float, threshold: float, runs: int) -> bool:
    """Whether a slow change in time is certain, and only a random walk keeps its cause from being so."""
    if score < SLOW_LEAD or runs > 1 or not like(ranking, name, SLOW_IN_TIME):
        return False
    still = [g for g, walks in ranking.walks.items() if not walks]
    logs = np.array([ranking.results[g].log_likelihood + ranking.log_prior[g] for g in still])
    each = np.array([ranking.results[g].evidence.get(name, -np.inf) for g in still])
    return bool(still) and log_sum(logs + each) - log_sum(logs) > threshold


def refit(record: Record, baseline: Estimate, found: list[Found], noise: NoisePath = ()) -> Estimate | None:
    """Fit the baseline with everything found; shape parameters that cannot be estimated stay at the searched value.

    Args:
        record: the data.
        baseline: the fitted simulation.
        found: what to add to it.
        noise: ratios to hold, by the number of additions (the last for more); none: estimate them.
    """
    ratios = noise[min(len(found), len(noise) - 1)] if noise else None
    model = baseline.model
    given = baseline.noise_given and not any(f.frees_noise for f in found)
    for step in found:
        if step.effect is not None:
            model = model.with_effect(step.effect)
    rows = [r for f in found for r in f.rows]
    data = record.without(np.array(rows)) if rows else record
    model = replace(model, noise=baseline.model.noise if given else {})
    freed = [f.name for f in found if f.frees_noise]
    for attempt in (model, _shapes_held(model, found)):
        try:
            # Another solver would be compiled anew for each model, and has rescued none that this one lost.
            after = fit_record(
                data,
                attempt,
                ratios=ratios,
                markov="noise_markov" in freed if freed else None,
                solver="levenberg_marquardt",
            )
        except EstimateError:
            continue
        if not _negative(after, found):
            return after
    return None


def _negative(estimate: Estimate, found: list[Found]) -> bool:
    """Whether something found is clearly below zero in a coefficient that cannot be."""
    of = {f.effect.label for f in found if f.effect is not None and f.effect.positive}
    std = np.sqrt(np.diag(estimate.covariance))
    return any(
        slot.linear and estimate.model.labels[slot.effect] in of and value < -CLEARLY * spread
        for slot, value, spread in zip(estimate.model.slots(), np.asarray(estimate.model.vector()), std, strict=True)
    )


def _shapes_held(model: GyroModel, found: list[Found]) -> GyroModel:
    """The model with shapes at their searched values; an effect without a free coefficient keeps its last one free."""
    held = set()
    for effect in (f.effect for f in found if f.effect is not None):
        linear = {name for name, declared in effect.declared().items() if declared.linear}
        shapes = [name for name in effect.declared() if name not in linear]
        held |= {(effect.label, name) for name in (shapes if linear - set(effect.held) else shapes[:-1])}
    return replace_fixed(model, model.fixed | frozenset(held))


def replace_fixed(model: GyroModel, fixed: frozenset[tuple[str, str]]) -> GyroModel:
    """The model with another set of fixed parameters."""
    return replace(model, fixed=fixed)


def uncontested(step: Found) -> bool:
    """Whether it is lines that led every other name by far when they were added: nothing else makes a line."""
    rivals = [v for k, v in step.ranking.statistic.items() if k not in (step.name, "outliers") and not is_driver(k)]
    own = step.ranking.statistic.get(step.name, -np.inf)
    return step.name == "bias_periodic" and own > max(rivals, default=-np.inf) + LINE_LEAD


def _has_lines(found: Sequence[Found]) -> bool:
    return any(f.name == "bias_periodic" for f in found)


def leave_one_out(
    record: Record, scanner: Scanner, baseline: Estimate, found: list[Found], i: int, noise: NoisePath = ()
) -> Ranking | None:
    """Rank all candidates beside everything found except item i."""
    others = found[:i] + found[i + 1 :]
    estimate = refit(record, baseline, others, noise)
    if estimate is None:
        return None
    pulses = tuple(r for f in others for r in f.rows)
    return rank_where_it_matters(scanner, estimate, pulses)


def _exchange(
    record: Record,
    scanner: Scanner,
    baseline: Estimate,
    found: list[Found],
    estimate: Estimate,
    threshold: float,
    noise: NoisePath,
) -> tuple[list[Found], Estimate, dict[int, Ranking]]:
    """Choose each addition again given all the others, and drop those that the others have made needless.

    Returns:
        What stands, its fit, and the rankings beside all but one that speak of it.
    """

    def chosen_again(found: list[Found], estimate: Estimate) -> tuple[list[Found], Estimate, dict[int, Ranking]]:
        """One pass: each addition exchanged for a better one given all the others."""
        rankings: dict[int, Ranking] = {}
        if len(found) < 2:
            return found, estimate, rankings
        for i in range(len(found)):
            if found[i].effect is None or uncontested(found[i]):
                continue
            ranking = leave_one_out(record, scanner, baseline, found, i, noise)
            if ranking is None:
                continue
            rankings[i] = ranking
            others = found[:i] + found[i + 1 :]
            # Further lines would come on top of the others, not in the place of this one.
            name, score = ranking.best(drivers=False, but=("bias_periodic",) if _has_lines(others) else ())
            own = ranking.statistic.get(found[i].name, -np.inf)
            if (
                name is None
                # It went with what it grew from, which the others do not hold.
                or found[i].name not in ranking.statistic
                or is_noise(name)
                or name in (found[i].name, "outliers")
                or score < max(own + EXCHANGE, threshold)
            ):
                continue
            base = refit(record, baseline, others, noise)
            if base is None:
                continue
            pulses = tuple(r for f in others for r in f.rows)
            step = Found(name, *addition(scanner, base, ranking, name, pulses), ranking)
            changed = [*others[:i], step, *others[i:]]
            if len(standing(changed)) < len(changed):
                continue
            after = refit(record, baseline, changed, noise)
            if after is not None and not _unresolved(after, step, scanner.step):
                found, estimate, rankings = changed, after, {i: ranking}
        return found, estimate, rankings

    while True:
        found, estimate, rankings = chosen_again(found, estimate)
        own = {i: r.statistic[found[i].name] for i, r in rankings.items() if found[i].name in r.statistic}
        needless = [i for i, v in own.items() if v < (SLOW_LEAD if found[i].name in SLOW_IN_TIME else threshold)]
        if not needless or len(found) < 2:
            return found, estimate, rankings
        least = min(needless, key=lambda i: own[i])
        fewer = found[:least] + found[least + 1 :]
        after = refit(record, baseline, fewer, noise)
        if after is None:
            return found, estimate, rankings
        found, estimate = fewer, after
