"""What candidates look like on a campaign: what a driver leaves, which sizes could have been seen."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace

import numpy as np

from gyromodel._model_units import parameter_unit
from gyromodel.diagnosis._apart import columns_of_best
from gyromodel.diagnosis._bank import PART_OF
from gyromodel.diagnosis._drivers import driver_unit, smooth_columns
from gyromodel.diagnosis._evidence import log_evidence_ratio, log_sum
from gyromodel.diagnosis._forms import form_effect
from gyromodel.diagnosis._ranking import Ranking, is_driver, is_noise, skipped
from gyromodel.diagnosis._result import Driver
from gyromodel.diagnosis._scan import Scanner
from gyromodel.diagnosis._selection import Selection
from gyromodel.effects import Effect
from gyromodel.estimate import Estimate
from gyromodel.model import GyroModel
from gyromodel.units import factor, from_internal, internal_unit

# Standard deviations by which a size has to exceed the least that is told to be told in 80 % of campaigns.
POWER = 0.84
# Standard deviations that no size to be told exceeds, and halvings of the interval it is looked for in.
BEYOND, HALVINGS = 1e3, 20
# Part of half the sample rate that lines are searched to where all are.
WHOLE = 0.9


def remaining(scanner: Scanner, baseline: Estimate, selection: Selection) -> tuple[str | None, float]:
    """The driver that is still significant, and its share of all the structure that names and driver explain."""
    driver = selection.driver
    if driver is None:
        return None, 0.0
    g = selection.last.best_cell(driver)
    left = selection.last.best_form(driver)[1]
    record = scanner.record
    residuals = []
    for estimate in (baseline, selection.estimate):
        predicted, jacobian = estimate.model.linearise(record.signals)
        gain = float(estimate.model.gain())
        y = np.where(scanner.present, np.asarray(record.signals["output"]) - predicted, 0.0) / gain
        w = scanner.cells.whiten(g, np.column_stack([jacobian, _given_up(scanner, selection), y]))
        base = w[:, :-1] / np.maximum(np.linalg.norm(w[:, :-1], axis=0), 1e-300)
        residuals.append(float(np.sum((w[:, -1] - base @ np.linalg.lstsq(base, w[:, -1], rcond=1e-10)[0]) ** 2)))
    named = max(residuals[0] - residuals[1], 0.0)
    return driver, left / (left + named)


def _given_up(scanner: Scanner, selection: Selection) -> np.ndarray:
    """A column for each row that was given up: one there, zero elsewhere."""
    rows = [r for f in selection.found for r in f.rows]
    marks = np.zeros((len(scanner.present), len(rows)))
    marks[rows, np.arange(len(rows))] = 1.0
    return marks


def driver_shape(scanner: Scanner, selection: Selection, name: str, unit: str) -> Driver:
    """The smooth function behind an unknown discrepancy and its band, at the measured points by its first column."""
    ranking = selection.last
    columns = columns_of_best(scanner, ranking, name)
    assert columns is not None
    record, estimate = scanner.record, selection.estimate
    predicted, jacobian = estimate.model.linearise(record.signals)
    gain = float(estimate.model.gain())
    y = np.where(scanner.present, np.asarray(record.signals["output"]) - predicted, 0.0) / gain
    g = ranking.best_cell(name)
    beside = np.column_stack([jacobian / gain, _given_up(scanner, selection)])
    w = scanner.cells.whiten(g, np.column_stack([beside, columns, y]))
    p = beside.shape[1]
    norm = np.maximum(np.linalg.norm(w[:, :-1], axis=0), 1e-300)
    u, s, vt = np.linalg.svd(w[:, :-1] / norm, full_matrices=False)
    keep = s > 1e-5 * s[0]
    inverse = vt[keep].T / s[keep]
    solution = inverse @ (u[:, keep].T @ w[:, -1])
    variance = float(np.sum((w[:, -1] - w[:, :-1] @ (solution / norm)) ** 2)) / max(scanner.degrees_of_freedom - p, 1)
    covariance = inverse @ inverse.T * variance
    shape = columns[: record.rows] / norm[p:]
    # What the model's own parameters would make as well is no part of the curve.
    own = np.column_stack([np.ones(record.rows), beside[: record.rows]])
    own = own / np.maximum(np.linalg.norm(own, axis=0), 1e-300)
    shape = shape - own @ np.linalg.lstsq(own, shape, rcond=1e-10)[0]
    value = shape @ solution[p:]
    std = np.sqrt(np.maximum(np.einsum("ij,jk,ik->i", shape, covariance[p:, p:], shape), 0.0))
    form, explained, _ = ranking.best_form(name)
    along = scanner.bank.blocks[int(np.asarray(form))].along
    assert along is not None
    first, *others = smooth_columns(name)
    file_unit, x = driver_unit(record, first), along[: record.rows]
    order = np.argsort(x)[:: max(1, record.rows // 300)]
    scale = factor(record.input_unit, unit)
    label = " and ".join((first, *others))
    found = from_internal(x[order], file_unit), value[order] * scale, std[order] * scale
    driver = Driver(label, file_unit, *found, unit, *_nearest(ranking, name, explained))
    second = next((b.along for b in scanner.bank.blocks if others and b.name == f"smooth({others[0]})"), None)
    if second is None:
        return driver
    second_unit = driver_unit(record, others[0])
    return replace(driver, second=from_internal(second[: record.rows][order], second_unit), second_unit=second_unit)


def _nearest(ranking: Ranking, driver: str, explained: float) -> tuple[str, float, float]:
    """The catalogue effect of most evidence beside a driver: its share of what the curve explains, and how far behind.

    Empty where none has any evidence, or more than the driver.
    """
    name, statistic = ranking.best(drivers=False, but=("outliers", *filter(is_noise, ranking.statistic)))
    behind = ranking.statistic[driver] - statistic
    if name is None or statistic <= 0 or behind <= 0:
        return "", 0.0, 0.0
    share = ranking.best_form(name)[1] / explained
    return name, float(min(share, 1.0)), float(behind)


def minimum_detectable(
    scanner: Scanner, last: Ranking, added: Mapping[str, Ranking], threshold: float, unit: str
) -> dict[str, tuple[float, str]]:
    """Size of each searched effect that would have been found with 80 % probability, at the noise of the final fit.

    Those are left out that too few samples show at no size.

    Args:
        scanner: of the search.
        last: beside all that was found.
        added: of what was found and what is alike, the ranking in which it was: of more of it, `last` tells.
        threshold: least ln B of an addition.
        unit: of rates.
    """
    sizes: dict[str, tuple[float, str]] = {}
    widths = {b.name: b for b in reversed(scanner.bank.blocks)}
    beside = dict.fromkeys(last.results[last.best_cell()].energy, last)
    beside |= {name: _in_noise_of(last, ranking) for name, ranking in added.items()}
    for name, ranking in beside.items():
        energy = ranking.results[ranking.best_cell()].energy.get(name, np.zeros(1))
        if not _is_sized(name, energy):
            continue
        q = widths[name].width if name in widths else (2 if name == "bias_periodic" else 1)
        # What continues an effect begins with the column that counts.
        order = np.argsort(np.where(energy > 0, energy, np.inf))
        form = 0 if name in ranking.tangents else int(order[(energy > 0).sum() // 2])
        price = np.log(np.sum(energy > 0)) + scanner.bank.price(name)
        size = _detectable(ranking, name, form, threshold + price, q)
        if size is None:
            continue
        if name in ranking.tangents:
            kind = ranking.tangents[name].effect
            unit_of = [p.unit for p in kind.declared().values() if not p.linear][-1]
            sizes[name] = size * factor(internal_unit(unit_of), unit_of), unit_of
            continue
        sizes[name] = _in_unit(scanner, name, widths[name].effect if name in widths else None, q, size, unit)
    return sizes


def _in_noise_of(last: Ranking, ranking: Ranking) -> Ranking:
    """An earlier ranking in the noise of the last one: what was missing is no noise.

    As it was where it did not look at the noise that is likeliest now.
    """
    both = last.results.keys() & ranking.results.keys()
    if last.best_cell() not in both:
        return ranking
    results = {g: replace(last.results[g], energy=ranking.results[g].energy) for g in sorted(both)}
    return replace(ranking, results=results)


def _is_sized(name: str, energy: np.ndarray) -> bool:
    """Whether a candidate has sizes, by the energy of its forms."""
    return not is_driver(name) and name != "outliers" and bool((energy > 0).any())


def _detectable(ranking: Ranking, name: str, form: int, least: float, q: int) -> float | None:
    """Size of one form at which its evidence reaches what is needed in 80 % of campaigns; None where none does.

    Of data that hold it, any noise cell leaves more unexplained: noise that imitates it gains on the others.

    Args:
        ranking: beside what was found.
        name: of the candidate.
        form: number of its form.
        least: ln B of the form that is needed, beside noise with a random walk.
        q: its columns.
    """
    # A cell that sees nothing of the form cannot tell it from nothing, however large.
    cells = [g for g in ranking.results if ranking.results[g].energy[name][form] > 0]
    logs = np.array([ranking.results[g].log_likelihood + ranking.log_prior[g] for g in cells])
    rss = np.array([ranking.results[g].rss for g in cells])
    energy = np.array([ranking.results[g].energy[name][form] for g in cells])
    walks, nu = np.array([ranking.walks[g] for g in cells]), ranking.samples - ranking.baseline_columns.shape[1]
    among = [walks] if ranking.needs_a_walk(name) and walks.any() else []

    def margin(size: float) -> tuple[float, int]:
        explained = size**2 * energy
        alone = logs - 0.5 * nu * np.log1p(explained / rss)
        beside = alone + log_evidence_ratio(explained, rss + explained, nu, q)
        ratio = min(log_sum(beside[c]) - log_sum(alone[c]) for c in (np.ones_like(walks), *among))
        return ratio - least, int(beside.argmax())

    deviation = np.sqrt(rss / nu / energy)
    low, high = 0.0, float(deviation.min())
    while margin(high)[0] < 0.0:
        if high > BEYOND * deviation.min():
            return None
        low, high = high, 2.0 * high
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if margin(middle)[0] < 0.0 else (low, middle)
    return high + POWER * float(deviation[margin(high)[1]])


def _in_unit(scanner: Scanner, name: str, effect: Effect | None, q: int, size: float, unit: str) -> tuple[float, str]:
    effect = effect if effect is not None else form_effect(scanner, name, 1)
    assert effect is not None
    if effect.site == "gain":
        return size / factor("ppm", "1"), "ppm"
    declared = parameter_unit(effect, effect.leading(), scanner.record.output_unit, scanner.record.units)
    return size * factor(internal_unit(declared), declared), declared


def not_testable(scanner: Scanner, ranking: Ranking, model: GyroModel, sized: Iterable[str]) -> dict[str, str]:
    """Candidates that a campaign cannot show, wholly or in part, and those that vanish beside a model, with reasons.

    `sized` are those of which some size would have been found.
    """
    result = ranking.results[ranking.best_cell()]
    tried = {b.name for b in scanner.bank.blocks if b.kind == "effect"} | set(ranking.tangents)
    known = (*tried, *model.labels)
    reasons = {k.removeprefix(PART_OF): v for k, v in scanner.bank.not_testable.items() if k not in known}
    seen = {name for name, energy in result.energy.items() if _is_sized(name, energy)} - set(sized)
    seen |= {name for name in scanner.bank.scans if name not in result.energy}
    reasons |= dict.fromkeys(seen, "too few samples: no size of it would be told")
    if scanner.lines and (highest := scanner.lines.frequencies[-1]) < WHOLE * 0.5 / scanner.record.interval:
        reasons["bias_periodic"] = f"above {highest:.3g} Hz: beside gaps as long as these no faster lines are searched"
    return reasons | {
        name: "cannot be told from what the model already has on this campaign"
        for name in tried - skipped(model, scanner.record.signals) - set(sized)
        if name not in result.evidence and not (result.energy.get(name, np.zeros(1)) > 0).any()
    }
