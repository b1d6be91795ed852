"""Calibrated gyros as uncertain values: from a file, a fit, or with the sources of their errors kept apart."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from gyromodel.estimate import Calibration, Estimate
from gyromodel.model import GyroModel, ModelError
from gyromodel.numerics.uncertain import Source, Uncertain, factor_of
from gyromodel.units import factor, internal_unit

Calibrated = Calibration | Estimate | Uncertain
AXES = "xyz"


class Named(NamedTuple):
    """A free parameter: what it is called, its value in field units, that unit, and the factor to it from inside."""

    name: str
    value: float
    unit: str
    scale: float


class Known(NamedTuple):
    """One gyro, or those of three axes, their errors in one vector.

    Args:
        models: at their calibrated values.
        sources: for each source of error a factor, one row a parameter of all the models (internal units).
        validity: the widest range of each column that all have been calibrated for (internal units).
        alike: whether they are three units of one kind, of which the first was calibrated: their parameters count
            together.
    """

    models: tuple[GyroModel, ...]
    sources: dict[Source, np.ndarray]
    validity: dict[str, tuple[float, float]]
    alike: bool = False

    @property
    def factor(self) -> Float[np.ndarray, "parameter error"]:
        """A with A Aᵀ the covariance of all parameters."""
        return np.concatenate(list(self.sources.values()), axis=1)

    @property
    def covariance(self) -> Float[np.ndarray, "parameter parameter"]:
        """Of all parameters."""
        return self.factor @ self.factor.T

    @property
    def vector(self) -> Float[np.ndarray, " parameter"]:
        """All parameters."""
        return np.concatenate([np.asarray(model.vector()) for model in self.models])

    def parameters(self) -> list[Named]:
        """The parameters of a budget's rows; of three units alike, those of one."""
        rows = []
        for axis, model in enumerate(self.models[: 1 if self.alike else None]):
            several = {}
            for slot in model.slots():
                several[slot.effect, slot.field] = slot.index
            for slot, value in zip(model.slots(), np.asarray(model.vector()), strict=True):
                effect = model.effects[slot.effect]
                unit = getattr(effect, "unit", "") or effect.declared()[slot.field].unit
                index = f"[{slot.index}]" if several[slot.effect, slot.field] else ""
                prefix = f"{AXES[axis]} " if len(self.models) > 1 and not self.alike else ""
                scale = factor(internal_unit(unit), unit)
                rows.append(Named(f"{prefix}{effect.label} {slot.field}{index}", float(value) * scale, unit, scale))
        return rows

    def fold(self, parts: np.ndarray) -> np.ndarray:
        """Of three units alike, the parts (last axis: parameters) of a parameter added up."""
        if not self.alike:
            return parts
        return parts.reshape(*parts.shape[:-1], len(self.models), -1).sum(axis=-2)

    def tripled(self) -> Known:
        """Three units of the one's kind, their errors independent of each other."""
        count, sources = len(self.vector), {}
        for axis in range(3):
            for source, part in self.sources.items():
                rows = np.zeros((3 * count, part.shape[1]))
                rows[axis * count : (axis + 1) * count] = part
                sources[Source(source.name, source.degrees_of_freedom)] = rows
        return self._replace(models=self.models * 3, sources=sources, alike=True)


def known(calibrated: Calibrated | Sequence[Calibrated]) -> Known:
    """Calibrated gyros with their errors.

    Args:
        calibrated: one gyro, or three for the axes x, y and z. An `Uncertain` is that of a model's free parameters, as
            `Estimate.parameters` gives it.

    Raises:
        ModelError: there are neither one nor three, or one has no covariance.
    """
    given = list(calibrated) if isinstance(calibrated, Sequence) else [calibrated]
    if len(given) not in (1, 3):
        raise ModelError(f"give one calibrated model, or three for the axes x, y and z, not {len(given)}")
    models, rows, validity = [], [], {}
    for each in given:
        model, sources, ranges = _one(each)
        models.append(model)
        rows.append(sources)
        for name, (low, high) in ranges.items():
            below, above = validity.get(name, (low, high))
            validity[name] = max(low, below), min(high, above)
    merged = {}
    for source in dict.fromkeys(s for sources in rows for s in sources):
        width = next(sources[source].shape[1] for sources in rows if source in sources)
        none = [np.zeros((len(m.slots()), width)) for m in models]
        merged[source] = np.concatenate([sources.get(source, n) for sources, n in zip(rows, none, strict=True)])
    return Known(tuple(models), merged, validity)


def _one(calibrated: Calibrated) -> tuple[GyroModel, dict[Source, np.ndarray], dict[str, tuple[float, float]]]:
    if isinstance(calibrated, Uncertain):
        model = calibrated.value
        if not isinstance(model, GyroModel) or len(model.slots()) != len(calibrated.vector):
            raise ModelError(
                "an uncertain gyro is one of a model's free parameters, such as an estimate's `parameters`"
            )
        return model, dict(calibrated.sources), {}
    if isinstance(calibrated, Estimate):
        calibration, sources = calibrated.calibration(), dict(calibrated.parameters.sources)
    else:
        calibration, sources = calibrated, dict(calibrated.sources)
    if calibration.covariance is None or not len(calibration.model.slots()):
        raise ModelError(
            "the model has no covariance of free parameters: fit it, or take the model.yaml that fit or diagnose wrote"
        )
    if not sources:
        sources = {Source("calibration", float(calibration.degrees_of_freedom)): factor_of(calibration.covariance)}
    return calibration.model, sources, dict(calibration.validity)


def models_at(models: tuple[GyroModel, ...], vector: Float[Array, " parameter"]) -> tuple[GyroModel, ...]:
    """The models at other values of all their free parameters."""
    moved, start = [], 0
    for model in models:
        count = len(model.slots())
        moved.append(model.with_vector(jnp.asarray(vector)[start : start + count]))
        start += count
    return tuple(moved)
