"""What candidates look like on a campaign: what a driver leaves, which sizes could have been seen."""

from __future__ import annotations

import numpy as np

from gyromodel.diagnosis._apart import columns_of_best
from gyromodel.diagnosis._bank import PART_OF
from gyromodel.diagnosis._drivers import driver_unit, smooth_columns
from gyromodel.diagnosis._evidence import explained_for
from gyromodel.diagnosis._forms import form_effect
from gyromodel.diagnosis._ranking import Ranking, ease, is_driver, is_noise, skipped
from gyromodel.diagnosis._result import Driver
from gyromodel.diagnosis._scan import Scanner
from gyromodel.diagnosis._search import Selection
from gyromodel.effects import Effect
from gyromodel.estimate import Estimate
from gyromodel.model import GyroModel, parameter_unit
from gyromodel.units import factor, from_internal, internal_unit


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
        marks = np.zeros((len(scanner.present), 0))
        rows = [r for f in selection.found for r in f.rows]
        if rows:
            marks = np.zeros((len(scanner.present), len(rows)))
            marks[rows, np.arange(len(rows))] = 1.0
        w = scanner.cells.whiten(g, np.column_stack([jacobian, marks, y]))
        base = w[:, :-1] / np.maximum(np.linalg.norm(w[:, :-1], axis=0), 1e-300)
        residuals.append(float(np.sum((w[:, -1] - base @ np.linalg.lstsq(base, w[:, -1], rcond=1e-10)[0]) ** 2)))
    named = max(residuals[0] - residuals[1], 0.0)
    return driver, left / (left + named)


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
    w = scanner.cells.whiten(g, np.column_stack([jacobian / gain, columns, y]))
    p = jacobian.shape[1]
    norm = np.maximum(np.linalg.norm(w[:, :-1], axis=0), 1e-300)
    u, s, vt = np.linalg.svd(w[:, :-1] / norm, full_matrices=False)
    keep = s > 1e-5 * s[0]
    inverse = vt[keep].T / s[keep]
    solution = inverse @ (u[:, keep].T @ w[:, -1])
    variance = float(np.sum((w[:, -1] - w[:, :-1] @ (solution / norm)) ** 2)) / max(scanner.degrees_of_freedom - p, 1)
    covariance = inverse @ inverse.T * variance
    shape = columns[: record.rows] / norm[p:]
    shape = shape - shape.mean(0)
    value = shape @ solution[p:]
    std = np.sqrt(np.maximum(np.einsum("ij,jk,ik->i", shape, covariance[p:, p:], shape), 0.0))
    form, explained, _ = ranking.best_form(name)
    along = scanner.bank.blocks[int(np.asarray(form))].along
    assert along is not None
    file_unit, x = driver_unit(record, smooth_columns(name)[0]), along[: record.rows]
    order = np.argsort(x)[:: max(1, record.rows // 300)]
    scale = factor(record.input_unit, unit)
    label = " and ".join(smooth_columns(name))
    found = from_internal(x[order], file_unit), value[order] * scale, std[order] * scale
    return Driver(label, file_unit, *found, unit, *_nearest(ranking, name, explained))


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


def minimum_detectable(scanner: Scanner, ranking: Ranking, threshold: float, unit: str) -> dict[str, tuple[float, str]]:
    """Size of each searched effect that would have been found with 80 % probability, at the noise of the final fit."""
    g = ranking.best_cell()
    result = ranking.results[g]
    nu = scanner.degrees_of_freedom - ranking.baseline_columns.shape[1]
    sigma = np.sqrt(result.rss / nu)
    sizes: dict[str, tuple[float, str]] = {}
    widths = {b.name: b for b in reversed(scanner.bank.blocks)}
    for name, energy in result.energy.items():
        energy = energy[energy > 0]
        if is_driver(name) or name == "outliers" or not len(energy):
            continue
        q = widths[name].width if name in widths else (2 if name == "bias_periodic" else 1)
        least = threshold - ease(name, ranking.walks[g]) + np.log(len(energy))
        needed = np.sqrt(explained_for(least, nu, q)) + 0.84
        size = float(needed * sigma / np.sqrt(np.median(energy)))
        if name in ranking.tangents:
            kind = ranking.tangents[name].effect
            unit_of = [p.unit for p in kind.declared().values() if not p.linear][-1]
            size = float(needed * sigma / np.sqrt(energy[0]))
            sizes[name] = size * factor(internal_unit(unit_of), unit_of), unit_of
            continue
        sizes[name] = _in_unit(scanner, name, widths[name].effect if name in widths else None, q, size, unit)
    return sizes


def _in_unit(scanner: Scanner, name: str, effect: Effect | None, q: int, size: float, unit: str) -> tuple[float, str]:
    effect = effect if effect is not None else form_effect(scanner, name, 1)
    assert effect is not None
    if effect.site == "gain":
        return size / factor("ppm", "1"), "ppm"
    declared = parameter_unit(effect, effect.leading(), scanner.record.output_unit, scanner.record.units)
    return size * factor(internal_unit(declared), declared), declared


def not_testable(scanner: Scanner, ranking: Ranking, model: GyroModel) -> dict[str, str]:
    """Candidates that a campaign cannot show, wholly or in part, and those that vanish beside a model, with reasons."""
    result = ranking.results[ranking.best_cell()]
    tried = {b.name for b in scanner.bank.blocks if b.kind == "effect"} | set(ranking.tangents)
    known = (*tried, *model.labels)
    reasons = {k.removeprefix(PART_OF): v for k, v in scanner.bank.not_testable.items() if k not in known}
    return reasons | {
        name: "cannot be told from what the model already has on this campaign"
        for name in tried - skipped(model, scanner.record.signals)
        if name not in result.evidence and not (result.energy.get(name, np.zeros(1)) > 0).any()
    }
