"""Evidence of every candidate, summed over the noise cells that matter."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

from gyromodel._checks import thermometers
from gyromodel.diagnosis._bank import Bank
from gyromodel.diagnosis._batch import CellResult
from gyromodel.diagnosis._drivers import RESPONSE_DRIVER, smooth_columns
from gyromodel.diagnosis._evidence import SAFE_THRESHOLD, SIZES, log_evidence_at_sizes, log_mean, log_sum
from gyromodel.diagnosis._lines import lines_of
from gyromodel.diagnosis._scan import Scanner
from gyromodel.diagnosis._tangents import Tangent
from gyromodel.effects import CATALOGUE
from gyromodel.effects._base import evaluate
from gyromodel.effects.drivers import BiasColumn
from gyromodel.estimate import Estimate
from gyromodel.model import GyroModel, effect_class
from gyromodel.noise import markov_cells, restricted_likelihood

# Cells within this many nats of the best, for any candidate that matters, get their neighbours searched too: those
# better than nothing added and not hopelessly behind the best.
NEARBY, HOPELESS = 7.0, 30.0
# Prior odds (ln) of a Markov process against flicker and random walk of all sizes, absent ones too: as more than is
# stated, and as the name of what a campaign's noise is, where flicker passes for most of them.
MARKOV_PRIOR, MARKOV_NAMED = np.log(0.2), np.log(0.05)
# Functions of time that one run cannot tell from a random walk.
SLOW_IN_TIME = ("bias_drift", "bias_warmup", "bias_step")
# What has its own rule for a random walk, or nothing to do with one.
EXEMPT = (*SLOW_IN_TIME, "outliers")
# A function of time alone must beat a random walk by this much in one run: no real slow noise is exactly a random walk.
TIME_MARGIN = 15.0
# Nats that a function of two columns has to lead that of one of them.
ONE_WILL_DO = 2.0
# Nats by which a cause that no catalogue lists must do better: it is rarer than one that does.
UNLISTED = 1.0
# Part of the largest direction of further columns from which on another counts, beyond the baseline's.
SPANNED = 1e-4


@dataclass(frozen=True)
class Ranking:
    """Evidence of every candidate summed over noise cells, against nothing added; of those `fitted` by their fits."""

    statistic: dict[str, float]
    posterior: dict[str, float]
    results: dict[int, CellResult] = field(repr=False)
    log_prior: np.ndarray = field(repr=False)
    slow: dict[int, bool] = field(repr=False)
    walks: dict[int, bool] = field(repr=False)
    baseline_columns: np.ndarray = field(repr=False)
    residual: np.ndarray = field(repr=False)
    samples: int
    runs: int
    tangents: dict[str, Tangent] = field(default_factory=dict, repr=False)
    contained: dict[str, int] = field(default_factory=dict, repr=False)
    fitted: frozenset[str] = frozenset()

    def best(self, *, drivers: bool, but: tuple[str, ...] = ()) -> tuple[str | None, float]:
        """The best unknown driver, or the best named candidate (but some), and its evidence ratio (ln).

        Lines that a response to the motion, linear or not, explains better are the motion's own. A function of two
        columns that hardly leads that of one of them has no need of the other.
        """
        if self.statistic.get(RESPONSE_DRIVER, -np.inf) > self.statistic.get("bias_periodic", -np.inf):
            but = (*but, "bias_periodic")
        mine = {k: v for k, v in self.statistic.items() if is_driver(k) == drivers and k not in but}
        # Of names that are the same on this campaign the first, whatever the rounding.
        top = max(mine, key=lambda k: round(mine[k], 6)) if mine else None
        if drivers and top and len(columns := smooth_columns(top)) > 1:
            alone = max((f"smooth({column})" for column in columns), key=lambda k: mine.get(k, -np.inf))
            # Where it would not be told of by itself, both are.
            least = max(mine[top] - ONE_WILL_DO, SAFE_THRESHOLD + UNLISTED)
            top = alone if mine.get(alone, -np.inf) > least else top
        return top, mine[top] if top else -np.inf

    @property
    def score(self) -> float:
        """S: the best candidate's evidence ratio (ln)."""
        return max(self.statistic.values(), default=-np.inf)

    @property
    def significance(self) -> float:
        """S of the effect that a search would add, or of the best driver, less what that needs more.

        `null_scores` draws it, which does not search for noise.
        """
        noise = tuple(filter(is_noise, self.statistic))
        tops = [top for drivers in (False, True) if (top := self.best(drivers=drivers, but=noise)[0])]
        return max((self.statistic[k] - self.more_needed(k) for k in tops), default=-np.inf)

    def more_needed(self, name: str) -> float:
        """Nats that a candidate needs more: what it would lose were it known that the noise has a random walk.

        A walk too weak to show still imitates what changes slowly. A driver needs `UNLISTED` besides; one of time in a
        single run, beside slow noise, what no walk makes.
        """
        if name == "smooth(time)" and self.runs < 2 and self.slow_noise:
            return TIME_MARGIN - SAFE_THRESHOLD
        return UNLISTED * is_driver(name) + (self._lost_to_a_walk(name) if self.needs_a_walk(name) else 0.0)

    def _lost_to_a_walk(self, name: str) -> float:
        """Nats that a candidate would lose were it known that the noise has a random walk."""
        walks = [g for g, there in self.walks.items() if there]
        if not walks:
            return 0.0
        every, among = (evidence_in(self.results, cells, self.log_prior, name) for cells in (self.results, walks))
        return max(every - among, 0.0) if np.isfinite(among) else 0.0

    def needs_a_walk(self, name: str) -> bool:
        """Whether a candidate has to show beside noise with a random walk as well."""
        return any(self.walks.values()) and name not in EXEMPT and not is_noise(name)

    def at_sizes(self, name: str) -> tuple[float, ...]:
        """ln B of a candidate at each of the prior's `SIZES`, less what a random walk would take of any, slow or not.

        Shapes count at each size as they do at all; kinds of noise, whose size has no prior, are the same at each.
        """
        cells = {g: r for g, r in self.results.items() if name in r.best}
        if is_noise(name) or not cells:
            return (self.statistic[name],) * len(SIZES)
        nu, logs = self.samples - self.baseline_columns.shape[1], []
        for g, r in cells.items():
            _, explained, dimension = r.best[name]
            each = np.array(log_evidence_at_sizes(explained, r.rss, nu, dimension))
            logs.append(r.log_likelihood + self.log_prior[g] + r.evidence[name] + each - log_mean(each))
        sizes = np.array([log_sum(of_size) for of_size in np.transpose(logs)])
        return tuple(map(float, sizes - log_mean(sizes) + self.statistic[name] - self._lost_to_a_walk(name)))

    def best_cell(self, name: str | None = None) -> int:
        """The noise cell of most weight, with a candidate added or with none."""

        def weight(g: int) -> float:
            r = self.results[g]
            return r.log_likelihood + self.log_prior[g] + (r.evidence.get(name, -np.inf) if name else 0.0)

        return max(self.results, key=weight)

    @property
    def slow_noise(self) -> bool:
        """Whether, with nothing added, the noise would have to be slow."""
        return self.slow[self.best_cell()]

    def best_form(self, name: str) -> tuple[int | tuple[int, ...], float, float]:
        """Form, explained sum and dimension of a candidate where it is best."""
        return self.results[self.best_cell(name)].best[name]

    def structures(self, bank: Bank, name: str, share: float) -> list[int]:
        """The best form of each structure, no wider than the best, that explains a share of what the best does."""
        explained, (form, best, _) = self.results[self.best_cell(name)].explained, self.best_form(name)
        assert isinstance(form, int)
        widest, forms = bank.blocks[form].width, dict[str, int]()
        for i in np.argsort(explained):
            block = bank.blocks[i]
            if block.name == name and explained[i] >= share * best and block.width <= widest:
                forms[block.structure] = int(i)
        return list(forms.values())

    def explained(self, name: str) -> float:
        """Part of the residual sum of squares that a candidate's best form explains, where it is best."""
        result = self.results[self.best_cell(name)]
        return result.best[name][1] / result.rss


def evidence_in(results: dict[int, CellResult], cells: Iterable[int], log_prior: np.ndarray, name: str) -> float:
    """ln B of a candidate, summed over some noise cells."""
    cells = list(cells)
    logs = np.array([results[g].log_likelihood + log_prior[g] for g in cells])
    return log_sum(logs + [results[g].evidence.get(name, -np.inf) for g in cells]) - log_sum(logs)


def is_driver(name: str) -> bool:
    """Whether a candidate is a smooth function of measured columns, not a catalogue effect."""
    return name.startswith("smooth(")


def is_noise(name: str) -> bool:
    """Whether a candidate is a kind of noise."""
    return name.startswith("noise_")


def special_cases(name: str) -> tuple[str, ...]:
    """The special cases that a candidate contains."""
    listed = name != "outliers" and not is_driver(name) and not is_noise(name)
    return effect_class(name).supersedes if listed else ()


def rank(
    scanner: Scanner,
    cells: list[int],
    estimate: Estimate,
    pulses: tuple[int, ...],
    skip: set[str],
    known: dict[int, CellResult] | None = None,
    beside: np.ndarray | None = None,
) -> Ranking:
    """Rank every candidate against a fitted baseline.

    `pulses` are gross errors, `known` cells done before, `beside` further columns that explain what they can.
    """
    record = scanner.record
    predicted, jacobian = estimate.model.linearise(record.signals)
    gain = float(estimate.model.gain())
    residual = np.where(scanner.present, np.asarray(record.signals["output"] - predicted), 0.0) / gain
    columns = np.asarray(jacobian)
    if beside is not None:
        columns = np.column_stack([columns, beyond(beside, columns, scanner.present)])
    if pulses:
        marks = np.zeros((len(columns), len(pulses)))
        marks[list(pulses), np.arange(len(pulses))] = 1.0
        columns = np.concatenate([columns, marks], axis=1)
    contained = contained_in(scanner.bank, estimate.model)
    continued = tangents(scanner, estimate.model, skip)
    families = scanner.noise_families() if estimate.noise_given else {}
    wanted = sorted({*cells, *(g for f in families.values() for g in f)})
    everything = dict(known or {})
    everything |= scanner.run(
        [g for g in wanted if g not in everything],
        columns,
        residual,
        contained,
        lines_of(estimate.model),
        list(continued.values()),
        pulses,
    )
    results = {g: everything[g] for g in cells}
    prior = scanner.grid.log_prior
    null = log_sum([results[g].log_likelihood + prior[g] for g in cells])
    names = sorted({n for r in results.values() for n in r.evidence} - skip)
    statistic = {name: evidence_in(results, cells, prior, name) for name in names}
    # Noise beyond the statement must beat all noise within it: less than stated lacks nothing.
    within = np.array([everything[g].log_likelihood for g in families.pop("", [])])
    within_stated = max(null, log_sum(within) - np.log(len(within))) if len(within) else null
    if estimate.noise_given and not float(estimate.ratios.flicker):
        each, variance = _of_markov(scanner, estimate.ratios.walk, columns, residual)
        more = variance > float(estimate.ratios.markov) * everything[cells[0]].rss
        statistic |= {"noise_markov": log_sum(each[more]) - within_stated} if more.any() else {}
    for name, family in families.items():
        # More of it than stated, whatever the white noise turns out to be beside it.
        kind = scanner.grid.ratios.flicker if name == "noise_flicker" else scanner.grid.ratios.walk
        level = [float(kind[g]) * everything[g].rss / everything[cells[0]].rss for g in family]
        more = [everything[g].log_likelihood for g, v in zip(family, level, strict=True) if v > float(kind[0])]
        if more:
            statistic[name] = float(log_sum(more) - np.log(len(family)) - within_stated)
    total = log_sum(list(statistic.values())) if statistic else 0.0
    posterior = {k: float(np.exp(v - total)) for k, v in statistic.items()}
    each = [scanner.grid.ratios.take(g) for g in cells]
    slow = {g: max(float(r.walk), float(r.flicker), float(r.markov)) > 0 for g, r in zip(cells, each, strict=True)}
    walks = {g: float(r.walk) > 0 for g, r in zip(cells, each, strict=True)}
    samples = scanner.degrees_of_freedom
    return Ranking(
        statistic,
        posterior,
        results,
        prior,
        slow,
        walks,
        columns,
        residual,
        samples,
        scanner.runs,
        continued,
        contained,
    )


def contained_in(bank: Bank, model: GyroModel) -> dict[str, int]:
    """How many columns of each candidate a model has already: its free coefficients of what the candidate contains."""
    free = [
        (e.label, np.size(getattr(e, name)))
        for e in model.effects
        for name, declared in e.declared().items()
        if declared.linear and (e.label, name) not in model.fixed
    ]
    return {
        b.name: sum(size for label, size in free if label in b.effect.supersedes)
        for b in bank.blocks
        if b.effect is not None and b.effect.supersedes
    }


def _of_markov(scanner: Scanner, walk: Any, columns: np.ndarray, residual: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Cells of Markov noise beside white noise and a given walk: log likelihood with the prior, and Markov variance.

    The variance is in units of the residual's sum of squares.
    """
    grid = scanner.grid
    cells = markov_cells(scanner.degrees_of_freedom, grid.interval, grid.span)
    if not len(cells.markov):
        return np.zeros(0), np.zeros(0)
    angle = grid.ratios.quantisation
    angle = None if angle is None else np.ravel(angle)[0]
    cells = cells._replace(walk=cells.walk + float(walk), quantisation=angle)
    result = restricted_likelihood(cells, grid.interval, grid.span, scanner.record.sampling, columns, residual)
    return result.log_likelihood + MARKOV_PRIOR - np.log(len(cells.markov)), np.asarray(
        cells.markov
    ) * result.residual_sum


def tangents(scanner: Scanner, model: GyroModel, skip: set[str]) -> dict[str, Tangent]:
    """Candidates that continue effects of a model, where nothing but their absence keeps them from being searched."""
    found = {}
    for name, kind in CATALOGUE.items():
        if name in skip or scanner.bank.not_testable.get(name) != kind.untested:
            continue
        effect = kind.continuing(model.effects, scanner.record.signals)
        if effect is not None:
            found[name] = Tangent(effect, np.asarray(evaluate(effect, scanner.record.signals)[1][:, -1]))
    return found


def beyond(columns: np.ndarray, others: np.ndarray, present: np.ndarray) -> np.ndarray:
    """Orthonormal columns of what some columns span beyond others where samples are; zero elsewhere."""
    one, two = (x[present] / np.maximum(np.linalg.norm(x[present], axis=0), 1e-300) for x in (columns, others))
    left = one - two @ np.linalg.lstsq(two, one, rcond=1e-10)[0]
    basis, size, _ = np.linalg.svd(left, full_matrices=False)
    basis = basis[:, size > SPANNED * size.max(initial=1.0)]
    whole = np.zeros((len(columns), basis.shape[1]))
    whole[present] = basis
    return whole


def rank_where_it_matters(
    scanner: Scanner, estimate: Estimate, pulses: tuple[int, ...], beside: np.ndarray | None = None
) -> Ranking:
    """Rank over the noise cells that matter: every other level, then neighbours of those with weight for any."""
    ranked = partial(
        rank,
        scanner,
        estimate=estimate,
        pulses=pulses,
        skip=skipped(estimate.model, scanner.record.signals),
        beside=beside,
    )
    if scanner.stated:
        return ranked([0] if estimate.noise_given else scanner.only_cells or scanner.all_cells())
    if scanner.only_cells is not None:
        return ranked(scanner.only_cells)
    ranking = ranked(scanner.coarse_cells())
    near = set(cells_of_weight(ranking, NEARBY))
    return ranked(scanner.neighbours(near), known=ranking.results)


def cells_of_weight(ranking: Ranking, nats: float) -> list[int]:
    """Noise cells within some nats of the best, for nothing added or for a candidate that matters."""
    weights = {g: r.log_likelihood + ranking.log_prior[g] for g, r in ranking.results.items()}
    near: set[int] = set()
    least = min(max(ranking.score - HOPELESS, 0.0), ranking.score - nats)
    for name in [None, *(name for name, statistic in ranking.statistic.items() if statistic >= least)]:
        of = {g: w + (ranking.results[g].evidence.get(name, -np.inf) if name else 0.0) for g, w in weights.items()}
        best = max(of.values())
        near |= {g for g, v in of.items() if v > best - nats}
    return sorted(near)


def noise_kinds(scanner: Scanner, ranking: Ranking) -> dict[str, float]:
    """Posterior over what the noise is made of with nothing more added, the likeliest first."""
    logs: dict[str, list[float]] = {}
    flicker, walk = scanner.grid.ratios.flicker, scanner.grid.ratios.walk
    angle = scanner.grid.ratios.quantisation is not None
    for g, r in ranking.results.items():
        parts = (
            ("noise_white", True),
            ("noise_flicker", flicker[g] > 0),
            ("noise_random_walk", walk[g] > 0),
            ("noise_quantisation", angle),
        )
        kind = " + ".join(name for name, there in parts if there)
        logs.setdefault(kind, []).append(r.log_likelihood + ranking.log_prior[g])
    markov, _ = _of_markov(scanner, 0.0, ranking.baseline_columns, ranking.residual)
    logs["noise_white + noise_markov" + " + noise_quantisation" * angle] = list(markov + MARKOV_NAMED - MARKOV_PRIOR)
    total = log_sum([v for of_kind in logs.values() for v in of_kind])
    weight = {kind: float(np.exp(log_sum(v) - total)) for kind, v in logs.items() if v}
    return dict(sorted(weight.items(), key=lambda item: -item[1]))


def skipped(model: GyroModel, columns: Iterable[str]) -> set[str]:
    """Candidates that make no sense beside a model: what it has free, and what it has in a more general form.

    What contains its own smaller forms may grow. Beside a bias proportional to one thermometer, one of a second
    thermometer is the same as one of their difference, which keeps the name; unless the model has the second.
    """
    held = model.wholly_fixed()
    have = {name for e in model.effects for name in (e.label, *e.supersedes)}
    seconds = {BiasColumn(column=name).label for name in thermometers(columns)[1:]}
    if have & seconds:
        have.add("bias_temperature_gradient")
    elif "bias_temperature" in have:
        have |= seconds
    grows = {e.label for e in model.effects if e.may_grow}
    return have - held - grows - {"bias_step", "bias_periodic"}
