"""What a simulation has and the data do not show: held in fits, so that a search goes on beside it, and told of."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.stats import chi2

from gyromodel._checks import listed
from gyromodel.estimate import Estimate, EstimateError, filter_of, fit_record, pad_columns, whiten_columns
from gyromodel.model import GyroModel
from gyromodel.noise import NoiseRatios
from gyromodel.signals import Record

# What every gyro has: what shows as these alone does is held at the stated value.
FIRST = ("bias", "scale_factor")
# Part of a column that others do not make, up to which they stand for it.
ALIKE = 1e-6
# Probability of sizes as large by chance above which an effect does not show.
UNSEEN = 0.01


def fitted(record: Record, model: GyroModel, start: NoiseRatios | None = None) -> Estimate:
    """The fit of a simulation; where that fails, with what the data do not show held as stated.

    Raises:
        EstimateError: there is no such fit either, or what would have to be held is not stated.
    """
    try:
        return fit_record(record, model, start=start)
    except EstimateError:
        fewer = _determined(record, model)
        if fewer.fixed != model.fixed:
            return fitted(record, fewer, start)
        found = beside_unseen(record, model, model.labels, start=start)
        if found is None:
            raise
        return found


def beside_unseen(record: Record, model: GyroModel, labels: Collection[str], **how: Any) -> Estimate | None:
    """The fit with the shapes held of those among some effects that do not show, or not in what shape; else None."""
    try:
        held = fit_record(record, model.with_shapes_held(labels), **how)
        shown = {label for label in labels if _shows(held, label) and _in_shape(held, model, label)}
        fewer = model.with_shapes_held([label for label in labels if label not in shown])
        return fit_record(record, fewer, **how) if fewer.fixed != model.fixed else None
    except EstimateError:
        return None


def held_back(estimate: Estimate, model: GyroModel) -> list[str]:
    """What is said of parameters of the simulation that a fit holds and the simulation leaves free."""
    held = [f"{label} ({name})" for label, name in sorted(estimate.model.fixed - model.fixed) if label in model.labels]
    said = f"These data do not determine {listed(held)} of the simulation: held, and all else holds beside just that."
    return [said] if held else []


def _determined(record: Record, model: GyroModel) -> GyroModel:
    """The model with sizes fixed that the data do not excite, or that show as the bias and the scale factor do.

    Parameters of one field are fixed together. Where one would have to be that is not stated, nothing is. Beside sizes
    of zero the scale factor is told by rates alone, not by the stated size of another error.
    """
    ready = model.prepared(record.signals)
    added = np.array([slot.linear and ready.effects[slot.effect].site != "gain" for slot in ready.slots()], bool)
    ready = ready.with_vector(np.where(added, 0.0, np.asarray(ready.vector())))
    columns = np.asarray(ready.linearise(record.signals)[1])[: record.rows][record.present]
    fields: dict[tuple[str, str], list[int]] = {}
    for i, slot in enumerate(ready.slots()):
        if slot.linear:
            fields.setdefault((ready.labels[slot.effect], slot.field), []).append(i)
    unstated = {(e.label, n) for e in model.effects for n in e.declared() if not np.isfinite(getattr(e, n)).all()}
    known, held = np.zeros((len(columns), 0)), set()
    for key in sorted(fields, key=lambda key: FIRST.index(key[0]) if key[0] in FIRST else len(FIRST)):
        own = columns[:, fields[key]]
        left = own - known @ (known.T @ own)
        if (np.linalg.norm(left, axis=0) <= ALIKE * np.linalg.norm(own, axis=0)).any():
            held.add(key)
        elif key[0] in FIRST:
            known = np.column_stack([known, np.linalg.qr(left)[0]])
    if held & unstated:
        return model
    # Without a size to be told, no shape is.
    shapeless = {label for label, _ in held} - {label for label, _ in fields.keys() - held}
    return replace(model, fixed=model.fixed | held).with_shapes_held(shapeless)


def _shows(estimate: Estimate, label: str) -> bool:
    """Whether an effect's free sizes differ from nothing; of one without, whether what it adds does."""
    model, signals = estimate.model, estimate.record.signals
    of = model.labels.index(label)
    own = [i for i, slot in enumerate(model.slots()) if slot.linear and slot.effect == of]
    if own:
        values = np.asarray(model.vector())[own]
        energy = float(values @ np.linalg.solve(estimate.covariance[np.ix_(own, own)], values))
    else:
        added = np.asarray(model.predict(signals) - model.without(label).predict(signals))
        energy = float(np.sum(_whitened(estimate, added[:, None]) ** 2)) / estimate.white_variance
    return bool(chi2.sf(energy, max(len(own), 1)) < UNSEEN)


def _in_shape(estimate: Estimate, model: GyroModel, label: str) -> bool:
    """Whether each shape that a model leaves free of an effect would show beside all else if it changed by itself."""
    fitted = estimate.model
    freed = replace(fitted, fixed=fitted.fixed - {key for key in fitted.fixed - model.fixed if key[0] == label})
    own = [i for i, s in enumerate(freed.slots()) if not s.linear and freed.labels[s.effect] == label]
    columns = _whitened(estimate, np.asarray(freed.linearise(estimate.record.signals)[1]))
    length = np.linalg.norm(columns, axis=0)
    columns = columns / np.where(length > 0.0, length, 1.0)
    for i in own:
        others = np.delete(columns, i, axis=1)
        left = columns[:, i] - others @ np.linalg.lstsq(others, columns[:, i])[0]
        change = float(left @ left) * (length[i] * float(freed.vector()[i])) ** 2 / estimate.white_variance
        if not chi2.sf(change, 1) < UNSEEN:
            return False
    return True


def _whitened(estimate: Estimate, columns: np.ndarray) -> np.ndarray:
    """Columns beside the noise of a fit."""
    record = estimate.record
    present = np.where(record.sampling.present[:, None], columns, 0.0)
    return np.asarray(whiten_columns(filter_of(record, estimate.ratios), pad_columns(present)))[:, : columns.shape[1]]
