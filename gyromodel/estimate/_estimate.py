"""`Estimate`: a fitted model with its covariance, noise, residuals and identifiability."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from gyromodel._checks import thermometers
from gyromodel._model_units import parameter_unit
from gyromodel.estimate._calibration import Calibration, ParameterTable
from gyromodel.model import GyroModel
from gyromodel.noise import NoiseRatios, coefficients, noise_units
from gyromodel.numerics.uncertain import Source, Uncertain, factor_of
from gyromodel.signals import Record
from gyromodel.units import factor, internal_unit


class EstimateError(ValueError):
    """The data cannot determine what was asked; the message names the effects and what to do."""


@dataclass(frozen=True)
class Estimate:
    """A fitted model; there is none of a fit that did not converge.

    Attributes:
        model: at the estimate; its noise coefficients are filled in.
        covariance: of the free parameters in the order of `model.slots()`, internal units; of `fit` and `diagnose` with
            what noise that was estimated leaves open.
        degrees_of_freedom: samples present less free parameters.
        residual: measured minus predicted output, internal output unit; NaN where missing.
        whitened: residual whitened to unit variance; NaN where missing.
        ratios: flicker, walk and Markov noise relative to the white variance.
        white_variance: variance of the white noise of one sample, output unit squared.
        noise_interval: 95 % interval of each noise coefficient, internal rate units.
        log_likelihood: restricted, at the estimate.
        noise_given: whether the model stated its noise.
        source: the scatter of this fit's own data, as a source of error.
        inherited: what earlier fits' errors change in the parameters, by source (see `two_stage`).
        ordinary: whether the parameters weigh all samples alike (see `fit_record`).
    """

    model: GyroModel
    covariance: np.ndarray = field(repr=False)
    degrees_of_freedom: int
    residual: np.ndarray = field(repr=False)
    whitened: np.ndarray = field(repr=False)
    ratios: NoiseRatios = field(repr=False)
    white_variance: float
    log_likelihood: float
    iterations: int
    record: Record = field(repr=False)
    noise_given: bool = False
    ordinary: bool = False
    noise_interval: Mapping[str, tuple[float, float]] = field(default_factory=dict, repr=False)
    source: Source = field(default_factory=lambda: Source("campaign"), repr=False)
    inherited: Mapping[Source, np.ndarray] = field(default_factory=dict, repr=False)

    @property
    def std(self) -> np.ndarray:
        """Standard uncertainties, in the order of `model.slots()`, internal units."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def own_covariance(self) -> np.ndarray:
        """The part of the covariance that the scatter of this fit's own data causes."""
        return self.covariance - sum((a @ a.T for a in self.inherited.values()), np.zeros_like(self.covariance))

    @property
    def parameters(self) -> Uncertain:
        """The fitted model as an uncertain value, with the sources of its error."""
        sources = {self.source: factor_of(self.own_covariance), **self.inherited}
        return Uncertain(np.asarray(self.model.vector()), self.model.with_vector, sources)

    def model_as_given(self) -> GyroModel:
        """The fitted model with its noise to be estimated again, unless it was stated."""
        return self.model if self.noise_given else replace(self.model, noise={})

    def calibration(self) -> Calibration:
        """What it takes to use the fit elsewhere: the model with its units, the covariance, and the ranges it has seen.

        `write_model` keeps it in the model file, and `read_calibration` reads it.
        """
        return calibration_of(self.model, self.covariance, self.record, self.degrees_of_freedom)

    def table(self) -> ParameterTable:
        """Every parameter in its reporting unit; those held fixed have standard uncertainty zero."""
        return self.calibration().table()

    def noise_table(self) -> dict[str, dict[str, float | str]]:
        """Noise coefficients with their 95 % intervals, in reporting units."""
        return noise_table(self.model, self.noise_interval)

    def propagate(self, function: Callable[[GyroModel], Any]) -> Uncertain:
        """A differentiable function of the model (to any tree of arrays) with its uncertainty, to first order."""
        return self.parameters.propagate(function)

    def to_dict(self) -> dict[str, Any]:
        """JSON-ready summary."""
        return {
            "parameters": [row._asdict() for row in self.table()],
            "noise": self.noise_table(),
            "degrees_of_freedom": self.degrees_of_freedom,
            "iterations": self.iterations,
            "samples": int(self.record.present.sum()),
            "missing": int(self.record.rows - self.record.present.sum()),
        }


def calibration_of(model: GyroModel, covariance: np.ndarray, record: Record, degrees_of_freedom: int) -> Calibration:
    """A model fitted to a record: with its units, and the ranges that it has seen."""
    effects, validity = [], {}
    for effect in model.effects:
        if hasattr(effect, "unit"):
            unit = parameter_unit(effect, next(iter(effect.declared())), record.output_unit, record.units)
            effect = replace(effect, unit=unit)  # pyright: ignore[reportCallIssue]
        effects.append(effect)
    needed = (n for effect in model.effects for n in effect.columns_needed)
    for name in dict.fromkeys(["rate", "temperature", *thermometers(needed)]):
        values = np.ravel(record.signals.get(name, np.nan))[: record.rows]
        if np.isfinite(values).any():
            validity[name] = (float(np.nanmin(values)), float(np.nanmax(values)))
    model = replace(model, effects=tuple(effects))
    return Calibration(model, covariance, validity, degrees_of_freedom, record.data_hash)


def noise_table(model: GyroModel, intervals: Mapping[str, tuple[float, float]]) -> dict[str, dict[str, float | str]]:
    """A model's noise coefficients with their intervals, in reporting units; a stated one is its own interval.

    The likeliest noise may lie beyond what most cells around it have: an interval then ends there.
    """
    rows: dict[str, dict[str, float | str]] = {}
    for name, coefficient in model.noise.items():
        value = float(coefficient)
        unit = noise_units(model.noise_of)[name]
        scale = factor(internal_unit(unit), unit)
        low, high = intervals.get(name, (value, value))
        low, high = min(low, value), max(high, value)
        rows[name] = {"value": value * scale, "lo": low * scale, "hi": high * scale, "unit": unit}
    if (level := model.level) is not None:
        low, high = intervals.get("noise_heteroscedastic", (level.ratio, level.ratio))
        rows["noise_heteroscedastic"] = {"value": level.ratio, "lo": low, "hi": high, "unit": "1"}
    return rows


def noise_coefficients(ratios: NoiseRatios, white_variance: Any, record: Record, gain: float) -> dict[str, Any]:
    """Noise coefficients as input rates, of one noise cell or of arrays of them."""
    return coefficients(ratios, white_variance / gain**2, record.interval)
