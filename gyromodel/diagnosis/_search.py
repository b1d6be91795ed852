"""Rounds of the search: rank all candidates, add the best, refit, choose the earlier ones again, until none is left."""

from __future__ import annotations

from collections.abc import Callable, Container
from dataclasses import replace

import numpy as np

from gyromodel.declarations import measured
from gyromodel.diagnosis._apart import like
from gyromodel.diagnosis._beside import beside_driver
from gyromodel.diagnosis._drivers import smooth_columns
from gyromodel.diagnosis._evidence import log_evidence_ratio, log_sum
from gyromodel.diagnosis._exchange import DOUBT, SLOW_LEAD, exchanged, steady, unresolved
from gyromodel.diagnosis._forms import MAXIMUM_LINES
from gyromodel.diagnosis._lines import lines_of
from gyromodel.diagnosis._pairs import best_pair
from gyromodel.diagnosis._ranking import SLOW_IN_TIME, Ranking, evidence_in, rank, skipped
from gyromodel.diagnosis._selection import MAXIMUM_ROUNDS, Selection, significant_driver
from gyromodel.diagnosis._steps import BETWEEN, EXCHANGE, Found, Steps, rows_of, standing
from gyromodel.estimate import Estimate

Progress = Callable[[str, float], None] | None

# Nats by which a driver leads all names together to take their place; where it leads by EXCHANGE, either may be true.
INSTEAD = 4.0
# Nats by which what begins with a bias leads what does not, to be sure of it: with the odds of a bias 19 to 1.
SURELY = 1.3
# Nats by which two that show together lead one that may stand for both.
TOGETHER = 1.0
# More steps than this are a function of time that nobody explains by naming each.
MAXIMUM_STEPS = 3


def search(steps: Steps, progress: Progress = None) -> Selection:
    """Add candidates until nothing more is significant, beside what is followed without a name too.

    Args:
        steps: the data, the simulation and the threshold.
        progress: called with a line and the fraction done.
    """
    selection = _begun_with_common(steps, progress, _rounds(steps, progress))
    return steadied(steps, beside_driver(steps, steadied(steps, selection)))


def _begun_with_common(steps: Steps, progress: Progress, selection: Selection) -> Selection:
    """The search begun with what every gyro has, where the simulation lacks it.

    A curve, or any function of a column, stands for a bias and something simpler at once. What is begun so counts
    where it leaves nothing: for a driver, or what it surely leads. Of a name that it leads by less, either is told.
    """
    bank, first = steps.scanner.bank, selection.first
    # Which points are right, and what is noise, is settled before.
    if any(f.effect is None for f in selection.found):
        return selection
    for name in (name for name in bank.names() if bank.price(name) < 0.0):
        old = [f.name for f in selection.found]
        if name in old or not (old or selection.driver) or selection.either:
            continue
        if not first.statistic.get(name, -np.inf) >= steps.least(first, name):
            continue
        other = _rounds(steps, progress, begin=name)
        found = [f.name for f in other.found]
        if other.unfinished or name not in found:
            continue
        new, gone = [k for k in found if k not in (name, *old)], [k for k in old if k not in found]
        if selection.driver or steps.fits_better(other.found, selection.found, SURELY):
            selection = other
        elif len(gone) == 1 and len(new) < 2 and steps.fits_better(other.found, selection.found):
            selection = replace(other, either=((new or [name])[0], gone[0]))
    return selection


def _rounds(steps: Steps, progress: Progress, avoid: str = "", begin: str = "") -> Selection:
    """Add candidates until nothing more is significant; `avoid` is not to be the first, and `begin` is."""
    scanner, threshold = steps.scanner, steps.threshold
    path: list[Found] = []
    lost: set[str] = set()
    estimates, remains, small = [steps.baseline], "", ""
    while True:
        estimate = estimates[-1]
        ranking = steps.rank(estimate, path)
        full = len(lines_of(estimate.model)) >= MAXIMUM_LINES * scanner.runs
        lines = ranking.statistic.get("bias_periodic", -np.inf)
        remains = "bias_periodic" if full and lines >= threshold else ""
        barred = ("bias_periodic" if full else "", "" if path else avoid, *lost)
        name, score = ranking.best(drivers=False, but=barred)
        if begin and not path and begin not in lost:
            name, score = begin, ranking.statistic[begin]
        for more in (f.name for f in path if f.grows and f.name not in lost):
            if ranking.statistic.get(more, -np.inf) > score - DOUBT:
                name, score = more, ranking.statistic[more]
        shows = name is not None and _significant(steps, ranking, name, score - steps.further(path, name))
        if not shows or not (path or begin):
            # Alone none may show, or what shows may stand for two.
            both = _together(steps, path, estimate, ranking, name if shows else None, barred)
            if both and len(path) + 2 <= MAXIMUM_ROUNDS and not any(unresolved(e, f, scanner.step) for f, e in both):
                path += [step for step, _ in both]
                estimates += [after for _, after in both]
                continue
        if name is None or not shows:
            break
        if len(path) >= MAXIMUM_ROUNDS:
            remains = name
            break
        jumps = [i for i, f in enumerate(path) if f.name == "bias_step"]
        if name == "bias_step" and len(jumps) >= MAXIMUM_STEPS:
            return _before(jumps[0], path, estimates)
        step, after = steps.add(path, steps.step(path, estimate, ranking, name))
        small = unresolved(after, step, scanner.step) if after is not None else ""
        if after is None or small:
            remains = name
            break
        if not steps.keeps(estimate, step, after):
            lost.add(name)
            continue
        step, after = steps.widened(path, step, after)
        if progress:
            progress(f"found {name}", min(0.25 + 0.06 * len(path), 0.6))
        path.append(step)
        estimates.append(after)
        lost.clear()
        if step.points and scanner.by_points:
            # Which points are right must be settled before anything is read into the rest.
            ranking = steps.rank(after, [step])
            break
    driver, score = path[0].ranking.best(drivers=True) if path else (None, -np.inf)
    lead = _lead(steps, str(driver), path, ranking) if score > threshold else -np.inf
    if lead > INSTEAD:
        # One smooth driver explains more than all the names together; names of its own columns may have had to stand
        # back behind one that follows several of them.
        own, first = {measured(column)[0] for column in smooth_columns(str(driver))}, path[0].effect
        if not (avoid or begin) and first is not None and not own >= set(first.columns_needed):
            other = steadied(steps, _rounds(steps, progress, path[0].name))
            if other.found:
                return other
        return Selection(steps.baseline, (), (), path[0].ranking, (steps.baseline,), driver)
    for i in range(1, len(path)):
        # What takes the place of an earlier name in a wider form is no further one.
        wider = len(standing(path[: i + 1])) <= len(standing(path[:i]))
        if not path[i - 1].paired and not wider and (ahead := _ahead_of(path[i:], threshold)):
            before, ranking = path[:i], path[i].ranking
            return Selection(
                estimates[i], tuple(standing(before)), tuple(before), ranking, tuple(estimates[: i + 1]), ahead
            )
    found, left_out = standing(path), {}
    if sum(f.weighed for f in found) > 1:
        before = found
        found, estimates[-1], left_out = exchanged(steps, found, estimates[-1])
        if found != before:
            ranking = steps.rank(estimates[-1], found)
            name, score = ranking.best(drivers=False, but=("bias_periodic",))
            remains = remains or (name if name and score >= steps.least(ranking, name) else "")
    # Several steps in time are what a function of something looks like that goes to and fro: they have to lead surely.
    steps_only = len(found) > 1 and all(f.name == "bias_step" for f in found)
    # What no fit holds is there all the same, unless something else took its place.
    there = {name: ranking.statistic[name] for name in lost if name in ranking.statistic}
    there = {name: score for name, score in there.items() if _significant(steps, ranking, name, score)}
    remains = remains or max(there, key=lambda name: there[name], default="")
    return Selection(
        estimates[-1],
        tuple(found),
        tuple(path),
        ranking,
        tuple(estimates),
        significant_driver(ranking, threshold, bool(found)),
        left_out,
        remains,
        small,
        rival=driver if lead > (-DOUBT if steps_only else EXCHANGE) else None,
    )


def steadied(steps: Steps, selection: Selection) -> Selection:
    """A selection less the lines that change, which are told of as what remains, or are noise of a band."""
    found, estimate, said = steady(steps, list(selection.found), selection.estimate)
    if estimate is selection.estimate:
        return selection
    ranking = steps.rank(estimate, found)
    return replace(
        selection,
        estimate=estimate,
        found=tuple(found),
        last=ranking,
        estimates=(*selection.estimates[:-1], estimate),
        driver=significant_driver(ranking, steps.threshold, bool(found)),
        left_out={},
        remains="bias_periodic" if said else selection.remains,
        unresolved=said,
    )


def _ahead_of(further: list[Found], threshold: float) -> str | None:
    """A driver that, where further names were begun with, surely explains more than all of these together."""
    driver = significant_driver(further[0].ranking, threshold, True)
    if driver is None or any(f.points or f.frees_noise for f in further):
        return None
    lead = further[0].ranking.statistic[driver] - sum(f.ranking.statistic[f.name] for f in further)
    return driver if lead > DOUBT else None


def _lead(steps: Steps, driver: str, path: list[Found], last: Ranking) -> float:
    """By how many nats a driver of the first ranking leads all that was found together.

    Names that partly stand for one another add up to more than they explain. Beside a driver that was ahead of the
    first, several are therefore also weighed as one addition, by what they have explained in the last noise cells. Low
    odds of a name are odds against other names, and no lead of a driver.
    """
    first, name = path[0].ranking, path[0].name
    lead = first.statistic[driver] - sum(f.ranking.statistic[f.name] for f in path)
    lead -= sum(max(steps.scanner.bank.price(f.name), 0.0) for f in path)
    if first.statistic[driver] < first.statistic[name] or any(f.frees_noise for f in path):
        return lead
    # On the same data: a driver may follow what a name does not know of.
    unknown = rows_of([f for f in path if not f.points])
    if not unknown and (lead > EXCHANGE or len(standing(path)) < 2):
        return lead
    scanner, baseline = steps.scanner, steps.baseline
    first = rank(scanner, list(last.results), baseline, unknown, skipped(baseline.model, scanner.record.signals))
    p, q = first.baseline_columns.shape[1], last.baseline_columns.shape[1]
    if q <= p:
        return lead
    names, alone = [], []
    for g, other in last.results.items():
        one = first.results[g]
        log, left = one.log_likelihood + first.log_prior[g], np.array(one.rss - other.rss)
        names.append(log + log_evidence_ratio(left, one.rss, first.samples - p, q - p))
        alone.append(log + one.evidence.get(driver, -np.inf))
    together = log_sum(alone) - log_sum(names)
    return together if unknown else max(lead, together)


def _together(
    steps: Steps, path: list[Found], estimate: Estimate, ranking: Ranking, alone: str | None, barred: Container[str]
) -> list[tuple[Found, Estimate]]:
    """Two candidates, none barred, that are significant together, with their fits; none: there are no such.

    Where another is significant alone, the two are to do better than it by `TOGETHER`, and by what it may lose for its
    shape.
    """
    pair, score = best_pair(steps.scanner, ranking, barred)
    if pair is None or score < max(steps.least(ranking, name) for name in pair):
        return []
    if alone and (alone in pair or score < (1.0 + BETWEEN) * ranking.statistic[alone] + TOGETHER):
        return []
    one = replace(steps.step(path, estimate, ranking, pair[0]), paired=True)
    first = steps.fit(standing([*path, one]))
    if first is None:
        return []
    ranking = steps.rank(first, [*path, one])
    if pair[1] not in ranking.statistic or ranking.statistic[pair[1]] < steps.least(ranking, pair[1]):
        return []
    other = steps.step([*path, one], first, ranking, pair[1])
    both = steps.fit(standing([*path, one, other]))
    if both is None or not steps.keeps(first, other, both):
        return []
    # Of what takes an earlier one's place, the evidence is what it explains without that.
    after, least = [*path, one, other], steps.least(ranking, other.name) + TOGETHER
    replaces = len(standing(after)) < len(after)
    if replaces and path and not steps.fits_better(standing(after), standing(path), least):
        return []
    return [(one, first), (other, both)]


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


def _significant(steps: Steps, ranking: Ranking, name: str, score: float) -> bool:
    """Whether a name is to be added."""
    slow = _slow_structure(steps, ranking, name, score) and like(steps.scanner, ranking, name, SLOW_IN_TIME)
    return slow or bool(score >= steps.least(ranking, name))


def _slow_structure(steps: Steps, ranking: Ranking, name: str, score: float) -> bool:
    """Whether a slow change in time is certain, and only a random walk keeps its cause from being so."""
    if score < SLOW_LEAD or steps.scanner.runs > 1:
        return False
    still = [g for g, walks in ranking.walks.items() if not walks]
    return bool(still) and evidence_in(ranking.results, still, ranking.log_prior, name) > steps.threshold
