"""Rounds of the search: rank all candidates, add the best, refit, choose the earlier ones again, until none is left."""

from __future__ import annotations

from collections.abc import Callable, Container, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.stats import rankdata

from gyromodel.declarations import measured
from gyromodel.diagnosis._apart import like
from gyromodel.diagnosis._drivers import smooth_columns
from gyromodel.diagnosis._evidence import log_evidence_ratio, log_sum
from gyromodel.diagnosis._exchange import DOUBT, SLOW_LEAD, exchanged, steady, unresolved
from gyromodel.diagnosis._forms import MAXIMUM_LINES
from gyromodel.diagnosis._lines import lines_of
from gyromodel.diagnosis._pairs import best_pair
from gyromodel.diagnosis._ranking import SLOW_IN_TIME, Ranking, evidence_in, is_noise, rank, skipped
from gyromodel.diagnosis._scan import Scanner
from gyromodel.diagnosis._steps import BETWEEN, EXCHANGE, Found, Steps, rows_of, standing
from gyromodel.estimate import Estimate

Progress = Callable[[str, float], None] | None

MAXIMUM_ROUNDS = 12
# More steps than this are a function of time that nobody explains by naming each.
MAXIMUM_STEPS = 3
# Columns of a driver's functions that are taken out beside names, as a part of the samples.
MOST_TAKEN = 0.25
# Rank correlation with time from which on a column goes one way.
ONE_WAY = 0.95
# A driver with more than this part of the strongest name's evidence makes what is wrong unknown: names that follow one
# another never end it.
UNKNOWN_EVIDENCE = 0.25
# Powers of a driver's values that are taken out beside names.
POWERS = 3
# Nats that a further cause needs more than the first: of something wrong one cause is likelier than two.
FURTHER = 1.0


@dataclass(frozen=True)
class Selection:
    """Where the rounds ended: the extended fit, what was added, and the ranking in which no more was significant.

    `left_out` holds rankings beside everything found except one, where the search has made them; `remains` names what
    was still significant and not added, `beside_it` is the fit with it where there is one, and `unresolved` says why if
    it is too small. `alone` is the ranking beside the simulation where the path begins beside a driver's function.
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
    beside_it: Estimate | None = field(default=None, repr=False)
    alone: Ranking | None = field(default=None, repr=False)

    @property
    def first(self) -> Ranking:
        """All candidates beside the simulation as it was given."""
        return self.alone or (self.path[0].ranking if self.path else self.last)

    @property
    def unfinished(self) -> bool:
        """Whether structure is left that would pass for a kind of noise."""
        return self.driver is not None or bool(self.remains)

    @property
    def followed(self) -> float:
        """The evidence (nats) of what follows the driver; none without one."""
        return self.last.statistic[self.driver] if self.driver else 0.0


def search(steps: Steps, progress: Progress = None) -> Selection:
    """Add candidates until nothing more is significant, beside what is followed without a name too.

    Args:
        steps: the data, the simulation and the threshold.
        progress: called with a line and the fraction done.
    """
    return steadied(steps, _beside_driver(steps, steadied(steps, _rounds(steps, progress))))


def _rounds(steps: Steps, progress: Progress, avoid: str = "") -> Selection:
    """Add candidates until nothing more is significant; `avoid` is not to be the first."""
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
        for more in (f.name for f in path if f.grows and f.name not in lost):
            if ranking.statistic.get(more, -np.inf) > score - DOUBT:
                name, score = more, ranking.statistic[more]
        shows = name is not None and _significant(steps, ranking, name, score - FURTHER * bool(path))
        if not shows or not path:
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
    if score > threshold and _lead(steps, str(driver), path, ranking) > EXCHANGE:
        # One smooth driver explains more than all the names together; names of its own columns may have had to stand
        # back behind one that follows several of them.
        own, first = {measured(column)[0] for column in smooth_columns(str(driver))}, path[0].effect
        if not avoid and first is not None and not own >= set(first.columns_needed):
            other = steadied(steps, _rounds(steps, progress, path[0].name))
            if other.found:
                return other
        return Selection(steps.baseline, (), (), path[0].ranking, (steps.baseline,), driver)
    for i in range(1, len(path)):
        if not path[i - 1].paired and (driver := _ahead_of(path[i:], threshold)):
            before, ranking = path[:i], path[i].ranking
            return Selection(
                estimates[i], tuple(standing(before)), tuple(before), ranking, tuple(estimates[: i + 1]), driver
            )
    found, left_out = standing(path), {}
    if sum(f.weighed for f in found) > 1:
        before = found
        found, estimates[-1], left_out = exchanged(steps, found, estimates[-1])
        if found != before:
            ranking = steps.rank(estimates[-1], found)
            name, score = ranking.best(drivers=False, but=("bias_periodic",))
            remains = remains or (name if name and score >= steps.least(ranking, name) else "")
    # What no fit holds is there all the same, unless something else took its place.
    there = {name: ranking.statistic[name] for name in lost if name in ranking.statistic}
    there = {name: score for name, score in there.items() if _significant(steps, ranking, name, score)}
    remains = remains or max(there, key=lambda name: there[name], default="")
    driver = significant_driver(ranking, threshold)
    return Selection(
        estimates[-1], tuple(found), tuple(path), ranking, tuple(estimates), driver, left_out, remains, small
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
        driver=significant_driver(ranking, steps.threshold),
        left_out={},
        remains="bias_periodic" if said else selection.remains,
        unresolved=said,
    )


def _ahead_of(further: list[Found], threshold: float) -> str | None:
    """A driver that, where further names were begun with, surely explains more than all of these together."""
    driver = significant_driver(further[0].ranking, threshold)
    if driver is None or any(f.points or f.frees_noise for f in further):
        return None
    lead = further[0].ranking.statistic[driver] - sum(f.ranking.statistic[f.name] for f in further)
    return driver if lead > DOUBT else None


def _lead(steps: Steps, driver: str, path: list[Found], last: Ranking) -> float:
    """By how many nats a driver of the first ranking leads all that was found together.

    Names that partly stand for one another add up to more than they explain. Beside a driver that was ahead of the
    first, several are therefore also weighed as one addition, by what they have explained in the last noise cells.
    """
    first, name = path[0].ranking, path[0].name
    lead = first.statistic[driver] - sum(f.ranking.statistic[f.name] for f in path)
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

    Where another is significant alone, the two are to do better than it by the odds of a further cause, and by what it
    may lose for its shape.
    """
    pair, score = best_pair(steps.scanner, ranking, barred)
    if pair is None or score < max(steps.least(ranking, name) for name in pair):
        return []
    if alone and (alone in pair or score < (1.0 + BETWEEN) * ranking.statistic[alone] + FURTHER):
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
    after, least = [*path, one, other], steps.least(ranking, other.name) + FURTHER
    replaces = len(standing(after)) < len(after)
    if replaces and path and not steps.fits_better(standing(after), standing(path), least):
        return []
    return [(one, first), (other, both)]


def significant_driver(ranking: Ranking, threshold: float) -> str | None:
    """The leading smooth driver, if it is significant."""
    driver, score = ranking.best(drivers=True)
    return driver if driver and score >= threshold + ranking.more_needed(driver) else None


def _beside_driver(steps: Steps, selection: Selection) -> Selection:
    """The search of a gyro gone on beside whatever function there is of its driver, which hides what is smaller.

    Names need as much more than else as a function may leave of what it explains, and are added once.
    """
    driver, scanner = selection.driver, steps.scanner
    if driver is None or scanner.record.domain != "gyro":
        return selection
    # Many steps are a function of time; which test points are right must be settled first.
    if selection.remains == "bias_step" or (scanner.by_points and any(f.points for f in selection.found)):
        return selection
    columns = _any_function(steps, selection.last, driver)
    if columns.shape[1] > MOST_TAKEN * scanner.degrees_of_freedom:
        return selection
    # As a further cause, and as the functions may leave.
    more = FURTHER + BETWEEN * selection.last.statistic[driver]
    # What a function leaves of what changes once is no step, nor a kind of noise.
    slow = (*SLOW_IN_TIME, "bias_periodic") if _once(scanner, driver) else ()
    # Lines that are not steady were told of.
    dropped = {f.name for f in selection.path} - {f.name for f in selection.found}
    barred = ("outliers", *slow, *dropped)
    found, path, estimates = list(selection.found), list(selection.path), list(selection.estimates)
    estimates[-1] = selection.estimate
    # What was found before is one of these where it holds beside the function too.
    strongest = max((f.ranking.statistic.get(f.name, 0.0) for f in found), default=0.0)
    unknown = selection.last.statistic[driver] > UNKNOWN_EVIDENCE * strongest
    for i, step in [(i, f) for i, f in enumerate(found) if unknown and f.effect and f.name not in barred]:
        ranking = _beside_rest(steps, found, i, columns)
        if ranking and ranking.statistic.get(step.name, -np.inf) >= steps.least(ranking, step.name) + more:
            # It needs no more than it did, and is judged by its own rankings.
            found[i] = replace(step, beside=driver)
            # As it would have been added: beside what was there by then.
            then = _beside_rest(steps, found[: i + 1], i, columns) if found[i + 1 :] else ranking
            path = [replace(found[i], ranking=then or ranking) if f is step else f for f in path]
    before = tuple(found)
    while len(path) < MAXIMUM_ROUNDS:
        ranking = steps.rank_beside(estimates[-1], found, columns)
        noises = (k for k in ranking.statistic if is_noise(k))
        name, score = ranking.best(drivers=False, but=(*barred, *noises, *(f.name for f in found)))
        if name is None or not score >= steps.least(ranking, name) + more:
            break
        step = replace(steps.step(found, estimates[-1], ranking, name), beside=driver, more=more)
        step, after = steps.add(found, step)
        if after is None or unresolved(after, step, scanner.step):
            break
        found, path, estimates = standing([*found, step]), [*path, step], [*estimates, after]
    added = path[len(selection.path) :]
    if not added and not any(f.beside for f in found):
        return selection
    last = steps.rank(estimates[-1], found)
    if significant_driver(last, steps.threshold) != driver:
        return selection
    as_before = [*map(id, found[: len(before)])] == [*map(id, before)]
    left_out = dict(selection.left_out) if as_before else {}
    for i in [i for i, f in enumerate(found) if any(f is step for step in added)]:
        left_out[i] = _beside_rest(steps, found, i, columns) or found[i].ranking
    return replace(
        selection,
        estimate=estimates[-1],
        found=tuple(found),
        path=tuple(path),
        last=last,
        estimates=tuple(estimates),
        left_out=left_out,
        remains="" if selection.remains in {f.name for f in added} else selection.remains,
        alone=selection.first,
    )


def _beside_rest(steps: Steps, found: Sequence[Found], i: int, columns: np.ndarray) -> Ranking | None:
    """All candidates beside further columns and all that was found but one; none where that has no fit."""
    rest = [*found[:i], *found[i + 1 :]]
    without = steps.fit(rest)
    return steps.rank_beside(without, rest, columns) if without else None


def _once(scanner: Scanner, driver: str) -> bool:
    """Whether one of a driver's columns is time, or goes one way in every run."""
    rows, names = slice(scanner.record.rows), smooth_columns(driver)
    time, present, run = (
        np.asarray(scanner.record.signals["time"])[rows],
        scanner.present[rows],
        scanner.record.run[rows],
    )

    def one_way(values: np.ndarray) -> bool:
        seen = present & np.isfinite(values)
        parts = [seen & (run == r) for r in np.unique(run[seen])]
        # A run in which it stands still, or of two rows, says nothing.
        told = [p for p in parts if p.sum() > 2 and np.ptp(values[p]) > 0.0]
        each = [np.corrcoef(rankdata(time[p]), rankdata(values[p]))[0, 1] for p in told]
        return bool(told) and all(abs(correlation) > ONE_WAY for correlation in each)

    alone = {f"smooth({name})" for name in names}
    values = {b.name: np.asarray(b.along)[rows] for b in scanner.bank.blocks if b.name in alone and b.along is not None}
    return "time" in names or any(map(one_way, values.values()))


def _any_function(steps: Steps, ranking: Ranking, driver: str) -> np.ndarray:
    """Columns of a driver's best form, of the finest of the same values, and the values' first powers.

    The finest leaves a part of a straight line, which large fringes would make a name.
    """
    bank = steps.scanner.bank
    form, _, _ = ranking.best_form(driver)
    assert isinstance(form, int)
    best = bank.blocks[form]
    assert best.along is not None
    own = [(b, b.along) for b in bank.blocks if b.name == driver and b.along is not None]
    finest = max((b for b, values in own if np.array_equal(values, best.along)), key=lambda b: b.width)
    blocks = {b.start: b for b in (best, finest)}
    along = np.pad(best.along, (0, len(bank.columns) - len(best.along)), mode="edge")
    known = steps.scanner.present & np.isfinite(along)
    along = np.where(known, along - along[known].mean(), 0.0)
    powers = (along / np.abs(along).max())[:, None] ** np.arange(1, POWERS + 1)
    return np.column_stack([*(bank.columns[:, b.start : b.start + b.width] for b in blocks.values()), powers])


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
