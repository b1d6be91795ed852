"""`Calibration`: what it takes to use a fit elsewhere, whether the fit is at hand or was read from its file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import NamedTuple

import equinox as eqx
import numpy as np

from gyromodel.model import GyroModel, ModelError
from gyromodel.numerics.uncertain import Source
from gyromodel.units import factor, internal_unit


def validity_unit(name: str) -> str:
    """Unit in which the range of a rate or a thermometer is written."""
    return "deg/s" if name == "rate" else "degC"


class ParameterRow(NamedTuple):
    """One fitted parameter in its reporting unit."""

    effect: str
    name: str
    value: float
    std: float
    unit: str


class ParameterTable(tuple[ParameterRow, ...]):
    """Rows of parameters, which print as a table."""

    __slots__ = ()

    def __str__(self) -> str:
        """A line a parameter: its effect, its value with the standard uncertainty where it is free, and its unit."""
        rows = [(r.effect, r.name, f"{r.value:.8g}", f"± {r.std:.2g}" if r.std else "(fixed)", r.unit) for r in self]
        widths = [max(map(len, cells)) for cells in zip(*rows, strict=True)]
        lines = ("  ".join(cell.ljust(w) for cell, w in zip(row, widths, strict=True)) for row in rows)
        return "\n".join(line.rstrip() for line in lines)


@dataclass(frozen=True)
class Calibration:
    """A model with all its values, and what its fit left.

    Attributes:
        model: its scale factors and drivers know the units they are written in.
        covariance: of the free parameters in the order of `model.slots()`, internal units; None without a fit.
        validity: lowest and highest value that the fit has seen, by column, internal units.
        degrees_of_freedom: of the fit.
        data_hash: of the campaigns that were fitted.
        sources: of several that the errors come from, such as the stages of a fit, a factor each (one row a parameter,
            internal units), their squares A Aᵀ adding up to the covariance.

    Raises:
        ModelError: a parameter or a reference point has no value, or the covariance is of other parameters.
    """

    model: GyroModel
    covariance: np.ndarray | None = field(default=None, repr=False)
    validity: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    degrees_of_freedom: int = 0
    data_hash: str = ""
    sources: Mapping[Source, np.ndarray] = field(default_factory=dict, repr=False)

    def __post_init__(self) -> None:
        for effect in self.model.effects:
            for name in (f.name for f in fields(effect)):
                value = getattr(effect, name)
                if eqx.is_array(value) and not np.isfinite(np.asarray(value)).all():
                    raise ModelError(f"effect {effect.label} has no value for {name}; fit the model, or write one")
        free = len(self.model.slots())
        if self.covariance is not None and self.covariance.shape != (free, free):
            raise ModelError(f"the covariance is {self.covariance.shape}, but {free} parameters are free; fit again")

    @property
    def std(self) -> np.ndarray:
        """Standard uncertainties, in the order of `model.slots()`, internal units; NaN without a fit."""
        if self.covariance is None:
            return np.full(len(self.model.slots()), np.nan)
        return np.sqrt(np.diag(self.covariance))

    def table(self) -> ParameterTable:
        """Every parameter in its reporting unit; those held fixed have standard uncertainty zero."""
        spread = {(s.effect, s.field, s.index): sd for s, sd in zip(self.model.slots(), self.std, strict=True)}
        rows = []
        for i, effect in enumerate(self.model.effects):
            for name, declared in effect.declared().items():
                unit = getattr(effect, "unit", "") or declared.unit
                scale = factor(internal_unit(unit), unit)
                values = np.ravel(getattr(effect, name))
                for j, value in enumerate(values):
                    shown = name if len(values) == 1 else f"{name}[{j}]"
                    rows.append(
                        ParameterRow(effect.label, shown, value * scale, spread.get((i, name, j), 0.0) * scale, unit)
                    )
        return ParameterTable(rows)
