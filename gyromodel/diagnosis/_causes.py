"""A step that the search has found as a published cause: its sizes, their intervals, and its nearest rivals."""

from __future__ import annotations

from dataclasses import replace
from math import comb

import numpy as np
from scipy import stats

from gyromodel.diagnosis._apart import separation
from gyromodel.diagnosis._epochs import epoch_interval
from gyromodel.diagnosis._evidence import log_evidence_ratio
from gyromodel.diagnosis._ranking import Ranking
from gyromodel.diagnosis._result import Cause, Confuser, ParameterValue
from gyromodel.diagnosis._scan import Scanner
from gyromodel.diagnosis._selected import after_selection, least_told
from gyromodel.diagnosis._steps import Found
from gyromodel.effects import Effect
from gyromodel.effects.drivers import BiasStep
from gyromodel.estimate import Estimate, filter_of, whiten_columns
from gyromodel.units import factor


def cause_of(
    scanner: Scanner,
    estimate: Estimate,
    step: Found,
    turn: int,
    ranking: Ranking,
    members: dict[str, float],
    statistic: float,
    trials: int,
    null_scores: np.ndarray,
    least: float,
    stated: dict[str, float],
) -> Cause:
    """A step of the search as a cause: sizes with their uncertainties, probabilities, and what it may be taken for."""
    name = step.name
    if step.frees_noise:
        sizes = tuple(
            ParameterValue(part, float(row["value"]), (float(row["hi"]) - float(row["lo"])) / 3.92, str(row["unit"]))
            for part, row in estimate.noise_table().items()
            if part.startswith(name)
        )
        p = float(np.exp(-max(statistic, 0.0)))
        return Cause(name, sizes, statistic, p, min(1.0, p * trials), members.get(name, 0.0))
    g = ranking.best_cell(name)
    result = ranking.results[g]
    _, explained, q = result.best[name]
    nu = scanner.degrees_of_freedom - ranking.baseline_columns.shape[1]
    p = float(stats.beta.sf(min(explained / result.rss, 1.0), q / 2, max(nu - q, 1) / 2))
    shapes = comb(len(scanner.points), int(q)) if step.points else len(result.energy.get(name, ())) or 1
    adjusted = float(min(1.0, p * shapes * trials))
    if len(null_scores):
        adjusted = float((1 + np.sum(null_scores >= statistic - ranking.more_needed(name))) / (1 + len(null_scores)))
    rivals = sorted((k for k in ranking.statistic if k != name), key=lambda k: -ranking.statistic[k])[:4]
    confusers = tuple(Confuser(k, s) for k in rivals if (s := separation(scanner, ranking, name, k)) is not None)
    if step.points:
        parameters = _point_parameters(scanner, estimate, step.points)
        if "scale_spline" in members:
            confusers = (Confuser("scale_spline", 0.0), *confusers)
    else:
        rows = [r for r in estimate.table() if r.effect == name]
        # Of several steps, the one that stands `turn` from the last.
        each = len(rows) // estimate.model.labels.count(name)
        rows = rows[len(rows) - turn * each :][:each]
        parameters = tuple(ParameterValue(r.name, r.value, r.std, r.unit) for r in rows)
        if q == 1 and least <= statistic:
            own = float(log_evidence_ratio(np.array(explained), result.rss, nu, 1))
            price = float(np.clip(own - statistic, min(scanner.bank.price(name), 0.0), np.log(shapes)))
            part = least_told(statistic, least, price, nu)
            size = _size_of(step.effect, name in ranking.tangents, ranking.contained.get(name, 0))
            parameters = tuple(
                _told(p, step.effect, part, stated.get(p.name)) if p.name == size else p for p in parameters
            )
        if isinstance(step.effect, BiasStep):
            own = [e for e in estimate.model.effects if isinstance(e, BiasStep)][-turn]
            parameters = tuple(_dated(scanner, ranking, own, g, p) for p in parameters)
    return Cause(name, parameters, statistic, p, adjusted, members.get(name, 0.0), confusers, step.points)


def _size_of(effect: Effect | None, continues: bool, contained: int) -> str:
    """The one size that a search has told of an effect: its amplitude, or the coefficient that the model had not."""
    if effect is None or continues:
        return effect.amplitude_name() if effect is not None else ""
    if not contained:
        return effect.leading()
    sizes = {k: np.size(getattr(effect, k)) for k, declared in effect.declared().items() if declared.linear}
    names = [k if size == 1 else f"{k}[{i}]" for k, size in sizes.items() for i in range(size)]
    return names[contained] if len(names) == contained + 1 else ""


def _told(parameter: ParameterValue, effect: Effect | None, part: float, stated: float | None) -> ParameterValue:
    """The size of an effect with its interval, if at `part` of it it would not have been told.

    `stated` is what a fixed one was in the simulation.
    """
    if effect is None or not parameter.std > 0.0:
        return parameter
    nothing = stated if stated is not None else 1.0 if effect.site == "gain" else 0.0
    z = (parameter.value - nothing) / parameter.std
    low, high = (nothing + parameter.std * end for end in after_selection(z, part * abs(z)))
    return replace(parameter, ci95=(low, high))


def _dated(scanner: Scanner, ranking: Ranking, step: BiasStep, g: int, parameter: ParameterValue) -> ParameterValue:
    """The epoch of a step with its interval, beside what a ranking is beside; any other parameter as it is."""
    if parameter.name != "epoch":
        return parameter
    std, low, high = epoch_interval(scanner, ranking.baseline_columns, ranking.residual, step, g)
    scale = factor("s", parameter.unit)
    return replace(parameter, std=std * scale, ci95=(low * scale, high * scale))


def _point_parameters(scanner: Scanner, estimate: Estimate, rows: tuple[int, ...]) -> tuple[ParameterValue, ...]:
    """How far each anomalous point lies from the model, fitted beside all of them in the noise as it was fitted."""
    points, given_up = scanner.points_among(rows), scanner.present & ~np.asarray(estimate.record.sampling.present)
    others = np.setdiff1d(np.flatnonzero(given_up), rows)
    record = scanner.record.without(others) if len(others) else scanner.record
    predicted, jacobian = (np.asarray(part) for part in estimate.model.linearise(record.signals))
    marks = np.zeros((len(predicted), len(points)))
    for i, p in enumerate(points):
        marks[p, i] = np.asarray(estimate.model.slope(record.signals))[p]
    residual = np.where(record.sampling.present, np.asarray(record.signals["output"]) - predicted, 0.0)
    columns = np.column_stack([marks, jacobian, residual])
    white = np.asarray(whiten_columns(filter_of(record, estimate.ratios), columns))[: record.rows][record.present]
    norm = np.linalg.norm(white[:, :-1], axis=0)
    basis, root = np.linalg.qr(white[:, :-1] / norm)
    inverse = np.linalg.inv(root)
    shifts = inverse @ (basis.T @ white[:, -1]) / norm
    stds = np.sqrt(estimate.white_variance * np.sum(inverse**2, axis=1)) / norm
    scale = factor("rad/s", "deg/s")
    found = []
    for p, shift, std in zip(points, shifts, stds, strict=False):
        rate = float(record.signals["rate"][p[0]]) * scale if "rate" in record.signals else None
        label = f"shift at {rate:.4g} deg/s" if rate is not None else f"shift at data row {p[0] + 1}"
        found.append(ParameterValue(label, float(shift) * scale, float(std) * scale, "deg/s"))
    return tuple(found)
