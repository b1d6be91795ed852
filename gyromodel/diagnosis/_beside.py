"""Names beside whatever function there is of a driver, which hides what is smaller."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.stats import rankdata

from gyromodel.diagnosis._drivers import smooth_columns
from gyromodel.diagnosis._exchange import unresolved
from gyromodel.diagnosis._ranking import SLOW_IN_TIME, Ranking, is_noise
from gyromodel.diagnosis._scan import Scanner
from gyromodel.diagnosis._selection import MAXIMUM_ROUNDS, Selection, significant_driver
from gyromodel.diagnosis._steps import BETWEEN, FURTHER, Found, Steps, standing

# Columns of a driver's functions that are taken out beside names, as a part of the samples.
MOST_TAKEN = 0.25
# Rank correlation with time from which on a column goes one way.
ONE_WAY = 0.95
# A driver with more than this part of the strongest name's evidence makes what is wrong unknown: names that follow one
# another never end it.
UNKNOWN_EVIDENCE = 0.25
# Powers of a driver's values that are taken out beside names.
POWERS = 3


def beside_driver(steps: Steps, selection: Selection) -> Selection:
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
    if significant_driver(last, steps.threshold, bool(found)) != driver:
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
