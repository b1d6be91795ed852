"""The threshold from simulated data with nothing hidden, through the same search over the noise cells that matter.

Draws are kept by design (what is searched, what the test sets, sampling, model and noise), so that the next campaign
of the same design waits for none.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Sequence
from contextlib import suppress
from zipfile import BadZipFile

import jax
import numpy as np
from scipy import stats

from gyromodel import __version__
from gyromodel._cache import cache_folder
from gyromodel.diagnosis._batch import Batch
from gyromodel.diagnosis._drivers import RESPONSE_DRIVER
from gyromodel.diagnosis._evidence import SAFE_THRESHOLD, log_sum
from gyromodel.diagnosis._lines import lines_of
from gyromodel.diagnosis._ranking import EXEMPT, TIME_MARGIN, UNLISTED, contained_in, is_driver, skipped, tangents
from gyromodel.diagnosis._scan import Scanner
from gyromodel.estimate import Estimate, filter_of
from gyromodel.noise import from_grams, gram_by_cell
from gyromodel.numerics.state_space import colour

# Draws searched at once: what candidates share is worked out once for them. Fewer of long records, which have so many
# values at most.
LEAST_DRAWN, MOST_DRAWN, VALUES_DRAWN = 128, 2048, 2**21
# Draws are searched in the noise cells that hold this part of the weight of the first few.
HELD, FIRST = 0.995, 32
# All draws are searched in every other cell of so many or more, and this part of them, the largest there, in all.
FEWEST_CELLS, LARGEST = 8, 0.25
# Columns that a test sets; others (a supply voltage, a pressure) wander, in each campaign of a design otherwise.
SET = ("rate", "temperature", "acceleration", "azimuth", "table", "magnetic", "vibration", "feedback", "campaign")
# Parts of a record whose means are a column's course, and how far courses (in their own spread), lengths, intervals (as
# parts) and noise (in quarters of a decade) may lie apart in one design.
COURSE, SAME = 32, 0.1

# Counts the rules by which draws have been scored: those kept by an earlier one do not serve.
RULE = 15

_draw = jax.jit(jax.vmap(colour, in_axes=(None, 0)))


def null_scores(
    scanner: Scanner, baseline: Estimate, draws: int, seed: int, say: Callable[[str, float], None]
) -> np.ndarray:
    """S of each draw of the baseline's own noise, from the cache where this design has been drawn before.

    S is the largest ln B of a name or of a driver, less what that needs more for what a random walk makes
    (`Ranking.significance`).

    Args:
        scanner: the search laid out on the record.
        baseline: the fitted simulation; its noise is what is drawn.
        draws: how many.
        seed: of the draws.
        say: progress.
    """
    columns = np.asarray(baseline.model.linearise(scanner.record.signals)[1])
    folder, (digest, course) = cache_folder("thresholds"), _design(scanner, baseline, draws, seed)
    for path in sorted(folder.glob(f"{digest}-*.npz")):
        with suppress(OSError, ValueError, EOFError, KeyError, BadZipFile), np.load(path) as kept:
            if np.abs(kept["course"] - course).max() < SAME:
                return kept["scores"]
    skip = skipped(baseline.model, scanner.record.signals)
    continued = list(tangents(scanner, baseline.model, skip).values())
    contained, lines = contained_in(scanner.bank, baseline.model), lines_of(baseline.model)
    filter = filter_of(scanner.record, baseline.ratios)
    rng, rows = np.random.default_rng(seed), len(scanner.present)

    def draw(count: int) -> np.ndarray:
        return np.asarray(_draw(filter, jax.numpy.asarray(rng.standard_normal((count, rows))))).T

    cells = [0] if scanner.stated else scanner.only_cells or _cells_of(scanner, columns, draw(FIRST))
    together = min(max(VALUES_DRAWN // rows, LEAST_DRAWN), MOST_DRAWN, -(-draws // LEAST_DRAWN) * LEAST_DRAWN)
    first = (scanner.checked(cells) if len(cells) >= FEWEST_CELLS else []) or cells
    rest, scores = [g for g in cells if g not in first], []
    for start in range(0, draws, together):
        drawn = draw(together)
        batches = scanner.run_many(first, columns, drawn, contained, lines, continued)
        found = _significance(scanner, first, batches, skip)
        if rest:
            large = np.argsort(-found)[: round(together * LARGEST)]
            both = [b.of(large) for b in batches]
            both += scanner.run_many(rest, columns, drawn[:, large], contained, lines, continued)
            found[large] = _significance(scanner, [*first, *rest], both, skip)
        scores.append(found)
        say("calibrating the threshold", 0.06 + 0.18 * min(1.0, (start + together) / draws))
    found = np.concatenate(scores)[:draws]
    with suppress(OSError):
        folder.mkdir(parents=True, exist_ok=True)
        own = hashlib.sha256(course.tobytes()).hexdigest()[:16]
        part = folder / f"{digest}-{own}.{os.getpid()}.part.npz"
        np.savez(part, course=course, scores=found)
        part.replace(folder / f"{digest}-{own}.npz")
    return found


def threshold_of(scores: np.ndarray) -> float:
    """The least draw that is beyond the 99 % point with 95 % confidence; of few, the largest."""
    beyond = int(stats.binom.ppf(0.95, len(scores), 0.99))
    return float(np.sort(scores)[min(beyond, len(scores) - 1)])


def _cells_of(scanner: Scanner, columns: np.ndarray, drawn: np.ndarray) -> list[int]:
    """The noise cells that matter to draws."""
    grid, p = scanner.grid, columns.shape[1]
    data = np.where(scanner.present[:, None], np.column_stack([columns, drawn]), 0.0)
    logs, grams = gram_by_cell(grid.ratios, grid.interval, grid.span, scanner.record.sampling, data)
    weight = np.zeros(len(logs))
    for i in range(p, data.shape[1]):
        one = np.ix_(range(len(logs)), [*range(p), i], [*range(p), i])
        each = from_grams(logs, grams[one], scanner.degrees_of_freedom).log_likelihood + grid.log_prior
        weight += np.exp(each - log_sum(each)) / FIRST
    order = np.argsort(-weight)
    return sorted(order[: int(np.searchsorted(np.cumsum(weight[order]), HELD)) + 1].tolist())


def _significance(scanner: Scanner, cells: Sequence[int], batches: Sequence[Batch], skip: set[str]) -> np.ndarray:
    """`Ranking.significance` of many data sets of one baseline."""
    grid = scanner.grid
    logs = np.stack([b.log_likelihood for b in batches]) + grid.log_prior[cells][:, None]
    walks = np.asarray(grid.ratios.walk)[cells] > 0
    slow_noise = (walks | (np.asarray(grid.ratios.flicker)[cells] > 0))[logs.argmax(axis=0)]
    names = sorted(set.intersection(*(set(b.evidence) for b in batches)) - skip)
    null, each, more = np.logaddexp.reduce(logs), [], []
    for name in names:
        beside = logs + np.stack([b.evidence[name] for b in batches])
        evidence = np.logaddexp.reduce(beside) - null
        needed = np.full(len(evidence), UNLISTED * is_driver(name))
        if walks.any() and name not in EXEMPT:
            among = np.logaddexp.reduce(beside[walks]) - np.logaddexp.reduce(logs[walks])
            needed += np.maximum(evidence - among, 0.0)
        if name == "smooth(time)" and scanner.runs < 2:
            needed = np.where(slow_noise, TIME_MARGIN - SAFE_THRESHOLD, needed)
        each.append(evidence)
        more.append(needed)
    if {"bias_periodic", RESPONSE_DRIVER} <= set(names):
        # Lines that a response to the motion explains better are not what a search would add (`Ranking.best`).
        line = names.index("bias_periodic")
        each[line] = np.where(each[names.index(RESPONSE_DRIVER)] > each[line], -np.inf, each[line])
    drivers = np.array([is_driver(name) for name in names])
    # Of the best name and of the best driver, as a search weighs no other.
    tops = [np.where(kind[:, None], each, -np.inf).argmax(axis=0) for kind in (drivers, ~drivers) if kind.any()]
    left = np.array(each) - more
    return np.max([left[top, np.arange(left.shape[1])] for top in tops], axis=0)


def _design(scanner: Scanner, baseline: Estimate, draws: int, seed: int) -> tuple[str, np.ndarray]:
    """A digest of what must be the same for draws to serve, and the course of what may differ a little."""
    record, bank = scanner.record, scanner.bank
    searched = [*((b.name, b.structure) for b in bank.blocks if b.kind == "effect"), *bank.scans]
    model = baseline.model
    same = (__version__, RULE, EXEMPT, model.labels, sorted(model.fixed), model.level, scanner.stated, draws, seed,
            searched, scanner.runs, scanner.outliers)  # fmt: skip
    columns = []
    for name in sorted(n for n in record.signals if n.startswith(SET)):
        values = np.asarray(record.signals[name])[: record.rows]
        means = np.array([part.mean() for part in np.array_split(values, min(COURSE, record.rows))])
        columns.append((means - values.mean()) / max(values.std(), 1e-300))
    sizes = np.log([record.rows, scanner.present.sum(), scanner.grid.interval, scanner.grid.span])
    noise = np.log10(np.maximum([float(r) for r in baseline.ratios.each()], 1e-12)) / 2.5
    return hashlib.sha256(repr(same).encode()).hexdigest()[:32], np.concatenate([*columns, sizes, noise])
