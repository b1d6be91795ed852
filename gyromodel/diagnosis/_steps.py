"""Steps of a search: what each adds, the fit of the simulation with them, and all candidates ranked beside it."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import jax
import numpy as np

from gyromodel.diagnosis._evidence import safe_threshold
from gyromodel.diagnosis._forms import addition, not_known
from gyromodel.diagnosis._one_cell import CLEARLY
from gyromodel.diagnosis._ranking import Ranking, is_noise, rank_where_it_matters
from gyromodel.diagnosis._scan import Scanner
from gyromodel.diagnosis._unseen import beside_unseen
from gyromodel.effects import Effect
from gyromodel.estimate import Estimate, EstimateError, fit_record
from gyromodel.model import GyroModel
from gyromodel.noise import NoiseRatios
from gyromodel.signals import Record

NoisePath = Sequence[NoiseRatios]

# Part of what it explains that an effect may lose for a shape that lies between those searched.
BETWEEN = 0.05
# Evidence (nats) from which on what continues an effect is fitted to be ranked.
BY_FIT = 20.0
# Times that the uncertainty of a shape may grow by that of all others.
ENTANGLED = 300.0
# Part of its evidence (nats) by which a fit must gain with a candidate: what was searched may be no form it can have.
KEPT = 0.5
# Nats that a further cause needs more than the first, of something wrong one cause being likelier than two; and one
# that every gyro has.
FURTHER, COMMON = 2.0, 1.0
# By how many nats a candidate must beat another to take its place.
EXCHANGE = 2.0


@dataclass(frozen=True)
class Found:
    """One accepted addition and the ranking that spoke for it; `rows` are given up with it.

    `paired`: the first of two that show together and not alone; the next is the other. `beside`: the driver of which
    any function may be there besides, for which it needed so much `more` (nats).
    """

    name: str
    effect: Effect | None
    rows: tuple[int, ...]
    ranking: Ranking
    paired: bool = False
    beside: str = ""
    more: float = 0.0

    @property
    def frees_noise(self) -> bool:
        """Whether it says that the stated noise lacks something, so that the noise is estimated from here on."""
        return is_noise(self.name)

    @property
    def weighed(self) -> bool:
        """Whether it is weighed again beside all others: what gives up rows alone is not."""
        return self.effect is not None or self.frees_noise

    @property
    def follows(self) -> set[str]:
        """The columns beside time that it needs."""
        return {*self.effect.columns_needed} - {"time"} if self.effect is not None else set()

    @property
    def grows(self) -> bool:
        """Whether there may be more to it than this form; each further line is a cause of its own."""
        return self.effect is not None and self.effect.may_grow and not self.effect.scan

    @property
    def points(self) -> tuple[int, ...]:
        """The rows that are themselves what was found."""
        return self.rows if self.name == "outliers" else ()


@dataclass(frozen=True)
class Steps:
    """What stays the same while steps are tried.

    Attributes:
        scanner: the search laid out on the data.
        baseline: the fitted simulation.
        threshold: least ln evidence ratio of an addition.
        noise: ratios to hold in the fits, by the number of additions (the last for more); none: estimate them.
        fits: what has been fitted, as the choices of a search meet again.
    """

    scanner: Scanner = field(repr=False)
    baseline: Estimate
    threshold: float
    noise: NoisePath = ()
    fits: dict[Hashable, Estimate | None] = field(default_factory=dict, repr=False, compare=False)

    def fit(self, found: Sequence[Found]) -> Estimate | None:
        """The simulation with everything found; shapes that cannot be estimated stay at the searched value.

        So do those of the simulation, at the fitted value, where there is no other fit and they do not show.
        """
        ratios = self.noise[min(len(found), len(self.noise) - 1)] if self.noise else None
        model, freed = self.baseline.model, [f.name for f in found if f.frees_noise]
        given = self.baseline.noise_given and not freed
        for step in found:
            if step.effect is not None:
                model = model.with_effect(step.effect)
        rows = rows_of(found)
        data = self.scanner.record.without(np.array(rows)) if rows else self.scanner.record
        last = next((f for f in reversed(found) if f.effect is not None), None)
        start = self.scanner.grid.ratios.take(last.ranking.best_cell(last.name)) if last else None
        model = replace(model, noise=self.baseline.model.noise if given else {})
        how: dict[str, Any] = {
            "ratios": ratios,
            "start": start,
            "markov": "noise_markov" in freed if freed else None,
            # Another solver would be compiled anew for each model, and has rescued none that this one lost.
            "solver": "levenberg_marquardt",
        }
        leaves, form = jax.tree_util.tree_flatten((model, ratios, start))
        values = tuple(np.asarray(leaf).tobytes() for leaf in leaves)
        key = (form, values, rows, how["markov"], frozenset(f.name for f in found if f.effect))
        if key not in self.fits:
            self.fits[key] = self._fitted(data, model, found, how)
        return self.fits[key]

    def _fitted(self, data: Record, model: GyroModel, found: Sequence[Found], how: dict[str, Any]) -> Estimate | None:
        """See `fit`."""
        searched = _shapes_held(model, found)
        attempts = (model,) if searched.fixed == model.fixed else (model, searched)
        # What was found may have taken the place of an effect of the simulation.
        simulated = set(self.baseline.model.labels) & set(model.labels) - {f.effect.label for f in found if f.effect}
        for fitted in (_fit, partial(beside_unseen, labels=simulated)):
            entangled, lost = None, 0
            for attempt in attempts:
                after = fitted(data, attempt, **how)
                if after is None:
                    lost += 1
                elif not _negative(after, found):
                    if not _entangled(after):
                        return after
                    entangled = after
            if lost < len(attempts):
                return entangled
        return None

    def rank_beside(self, estimate: Estimate, found: Sequence[Found], columns: np.ndarray) -> Ranking:
        """All candidates beside a fit with what was found and beside further columns, which explain what they can."""
        return rank_where_it_matters(self._seen(estimate), estimate, rows_of(found), columns)

    def rank(self, estimate: Estimate, found: Sequence[Found]) -> Ranking:
        """All candidates beside a fit with what was found; by their fits where the shapes searched mislead.

        A shape between those searched loses a part of what it explains: of much evidence, more than a rival's lead.
        """
        ranking = rank_where_it_matters(self._seen(estimate), estimate, rows_of(found))
        (name, score), driver = ranking.best(drivers=False), ranking.best(drivers=True)[1]
        # What continues an effect is ranked by its slope alone, which may lose most of it.
        grown = {k for k in ranking.tangents if ranking.statistic.get(k, -np.inf) > max(self.threshold, 0.25 * score)}
        grown = grown if self.scanner.record.domain == "gyro" and max(score, driver) > BY_FIT else set()
        if not (grown or BETWEEN * score >= EXCHANGE):
            return ranking
        # Of kinds of noise, gross errors, steps and lines there are no forms to fit.
        if not name or not (name in ranking.tangents or self.scanner.bank.forms(name)):
            return ranking
        least = (1.0 - BETWEEN) * ranking.explained(name)
        near = grown | {k for k in ranking.statistic if self._has_shape(k) and ranking.explained(k) >= least}
        if not near - {name} and (name not in near or driver < score):
            return ranking
        # What needs no fit explains as much in one: evidence of a large effect is less than that of its fit.
        alike = {k for k in ranking.statistic if self.scanner.bank.forms(k) and ranking.explained(k) >= least}
        each = [self.step(found, estimate, ranking, k) for k in sorted({name, *near, *alike})]
        # Fits compare on the same data.
        given_up = Found("", None, rows_of(each), ranking)
        fits = {step.name: self.fit(standing([*found, step, given_up])) for step in each}
        bank = self.scanner.bank
        price = {k: np.log(max(bank.structures(k), 1)) + bank.price(k) for k in fits}
        held = {k: fit for k, fit in fits.items() if fit and not any(e.beyond_reach for e in fit.model.effects)}
        told = {k: quality(fit) - price[k] for k, fit in held.items()}
        before = self.fit([*found, given_up])
        if name not in told or before is None:
            return ranking
        own = max(score, told[name] - quality(before))
        told = {k: own + v - told[name] for k, v in told.items()}
        if driver < score and all(v < ranking.statistic[k] + EXCHANGE for k, v in told.items()):
            return ranking
        return replace(ranking, statistic=ranking.statistic | told, fitted=frozenset(told))

    def fits_better(
        self, found: Sequence[Found], other: Sequence[Found], by: float = 0.0, of: Steps | None = None
    ) -> bool:
        """Whether some steps fit better by so many nats than others, of this search or another, on what both keep.

        Both may be none at all.
        """
        each = [*found, *other]
        given_up = [Found("", None, rows_of(each), each[0].ranking)] if each else []
        one, two = (s.fit([*steps, *given_up]) for s, steps in ((self, found), (of or self, other)))
        return one is not None and (two is None or bool(quality(one) > quality(two) + by))

    def _has_shape(self, name: str) -> bool:
        """Whether a candidate's shape goes on between the forms searched; a fit of a platform takes too long for it."""
        forms = self.scanner.bank.forms(name) if self.scanner.record.domain == "gyro" else []
        return len(forms) > 1 and any(not declared.linear for declared in forms[0].declared().values())

    def least(self, ranking: Ranking, name: str) -> float:
        """The evidence (ln B) that a candidate of a ranking needs; of noise, which no draw has, the safe one."""
        safe = safe_threshold(self.baseline.degrees_of_freedom) if is_noise(name) else -np.inf
        return max(self.threshold, safe) + ranking.more_needed(name)

    def further(self, found: Sequence[Found], name: str) -> float:
        """The evidence (nats) that a candidate needs besides, beside what was found."""
        common = self.scanner.bank.price(name) < 0.0
        return (COMMON if common else FURTHER) if found else 0.0

    def step(self, found: Sequence[Found], estimate: Estimate, ranking: Ranking, name: str) -> Found:
        """A candidate of a ranking beside what was found, as one more step; of much evidence, in what fits best.

        A hinge between the places searched loses to two hinges around it. Nothing wider is tried: what fits better by
        more shapes than the search asked for fails on data not seen.
        """
        scanner, rows = self._seen(estimate), rows_of(found)
        forms: list[int | None] = [None]
        if BETWEEN * ranking.statistic.get(name, -np.inf) >= EXCHANGE and self._has_shape(name):
            forms = [*ranking.structures(scanner.bank, name, 1.0 - BETWEEN)] or forms
        each = [Found(name, *addition(scanner, estimate, ranking, name, rows, form), ranking) for form in forms]
        if len(each) < 2:
            return each[0]
        given_up = Found("", None, rows_of(each), ranking)
        fits = [self.fit(standing([*found, step, given_up])) for step in each]
        return max(zip(fits, each, strict=True), key=lambda pair: quality(pair[0]) if pair[0] else -np.inf)[1]

    def _seen(self, estimate: Estimate) -> Scanner:
        """The search without the samples at which the output ends: of anything more they tell nothing."""
        ended = estimate.model.ended(self.scanner.record.signals)[: self.scanner.record.rows]
        return self.scanner.without(np.flatnonzero(ended), self.scanner.only_cells) if ended.any() else self.scanner

    def add(self, found: Sequence[Found], step: Found) -> tuple[Found, Estimate | None]:
        """A further step and the fit with it, without the samples that the effect as fitted does not know."""
        after = self.fit(standing([*found, step]))
        if after is None or step.effect is None or step.effect.label not in after.model.labels:
            return step, after
        rows = not_known(self.scanner, after.model.effects[after.model.labels.index(step.effect.label)])
        if rows == step.rows:
            return step, after
        step = replace(step, rows=rows)
        return step, self.fit(standing([*found, step]))

    def keeps(self, estimate: Estimate, step: Found, after: Estimate) -> bool:
        """Whether a fit with one more step gains in its noise what the search saw in the step.

        A shape is fitted with what physics holds of it, which the search did not; with rows given up it is unknown.
        """
        if step.effect is None or step.rows or all(p.linear for p in step.effect.declared().values()):
            return True
        try:
            before = fit_record(
                estimate.record, estimate.model_as_given(), ratios=after.ratios, solver="levenberg_marquardt"
            )
        except EstimateError:
            return True
        return bool(_profiled(after) - _profiled(before) >= KEPT * step.ranking.statistic[step.name])

    def widened(self, found: Sequence[Found], step: Found, after: Estimate) -> tuple[Found, Estimate]:
        """A step that is kept and its fit, in a wider form where that fits better by more than its parameters cost."""
        wider = step.effect.wider() if step.effect is not None else None
        if wider is None:
            return step, after
        other = replace(step, effect=wider)
        fitted = self.fit(standing([*found, other]))
        return (other, fitted) if fitted is not None and quality(fitted) > quality(after) + EXCHANGE else (step, after)

    def all_but(self, found: Sequence[Found], i: int) -> tuple[Estimate, Ranking] | None:
        """The fit with everything found except item i, and all candidates beside it; none where that fit fails."""
        others = [*found[:i], *found[i + 1 :]]
        estimate = self.fit(others)
        return None if estimate is None else (estimate, self.rank(estimate, others))


def _fit(data: Record, model: GyroModel, **how: Any) -> Estimate | None:
    try:
        return fit_record(data, model, **how)
    except EstimateError:
        return None


def standing(path: Sequence[Found]) -> list[Found]:
    """The steps of a path that no later step replaced by a more general form."""
    later: set[str] = set()
    kept = []
    for step in reversed(path):
        if step.name not in later:
            kept.append(step)
        later |= set(step.effect.supersedes) if step.effect is not None else set()
    return kept[::-1]


def _profiled(estimate: Estimate) -> float:
    """ln likelihood of a fit at its parameters: from the restricted one to −½ ln |V| − ½ n ln RSS."""
    volume = np.linalg.slogdet(estimate.covariance)[1] + len(estimate.covariance) * np.log(estimate.degrees_of_freedom)
    return estimate.log_likelihood - 0.5 * float(volume)


def quality(estimate: Estimate) -> float:
    """ln likelihood of a fit, less what its parameters cost (Schwarz): by it fits of different parameters compare."""
    p, nu = len(estimate.covariance), estimate.degrees_of_freedom
    return _profiled(estimate) - 0.5 * p * float(np.log(nu + p))


def rows_of(found: Sequence[Found]) -> tuple[int, ...]:
    """The rows given up with some steps."""
    return tuple(sorted({r for f in found for r in f.rows}))


def _negative(estimate: Estimate, found: Sequence[Found]) -> bool:
    """Whether something found has a coefficient that cannot be: clearly below zero, or a part beyond its whole."""
    of, sizes = {f.effect.label: f.effect for f in found if f.effect is not None}, {}
    model = estimate.model
    for slot, value, std in zip(model.slots(), np.asarray(model.vector()), estimate.std, strict=True):
        label = model.labels[slot.effect]
        if slot.linear and label in of:
            sizes[label, slot.field, slot.index] = value, std
            if of[label].positive and value < -CLEARLY * std:
                return True
    for (label, name, _), (part, std) in sizes.items():
        whole, spread = sizes.get((label, of[label].whole, 0), (0.0, np.inf))
        share = part * np.sign(whole)
        if name == "part" and min(share, abs(whole) - share) < -CLEARLY * np.hypot(std, spread):
            return True
    return False


def _entangled(estimate: Estimate) -> bool:
    """Whether a shape is known only together with others, such as two lags that are almost the same."""
    shapes = [i for i, slot in enumerate(estimate.model.slots()) if not slot.linear]
    # Where nothing is left there is nothing to divide by.
    std = np.where(estimate.std > 0.0, estimate.std, 1.0)
    correlation = estimate.covariance / np.outer(std, std)
    return bool((np.diag(np.linalg.pinv(correlation, hermitian=True))[shapes] > ENTANGLED**2).any())


def _shapes_held(model: GyroModel, found: Sequence[Found]) -> GyroModel:
    """The model with shapes at their searched values; an effect without a free coefficient keeps its last one free."""
    held = set()
    for effect in (f.effect for f in found if f.effect is not None):
        linear = {name for name, declared in effect.declared().items() if declared.linear}
        shapes = [name for name in effect.declared() if name not in linear]
        held |= {(effect.label, name) for name in (shapes if linear - set(effect.held) else shapes[:-1])}
    return replace(model, fixed=model.fixed | frozenset(held))
