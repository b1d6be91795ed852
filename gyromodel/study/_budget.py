"""The error budget of an outcome to first order: by parameter, by stage, by noise and by instrument."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from gyromodel._noise_level import with_stated_level
from gyromodel.estimate import as_read, make_filter, step_of
from gyromodel.model import ModelError
from gyromodel.noise import NoiseRatios, markov_sum, stated_ratios
from gyromodel.numerics.state_space import colour
from gyromodel.signals import Record
from gyromodel.study._instruments import Instrument, by_column
from gyromodel.study._known import Known, models_at
from gyromodel.study._mission import Mission, Outcome, rate
from gyromodel.units import factor, internal_unit

# The kinds of noise by the field of NoiseRatios that holds them; white is what is left.
KINDS = {
    "noise_flicker": "flicker",
    "noise_random_walk": "walk",
    "noise_markov": "markov",
    "noise_quantisation": "quantisation",
}


class Row(NamedTuple):
    """One parameter in an outcome's budget.

    Args:
        name: axis, effect and field.
        value: calibrated, in `unit`.
        std: its standard uncertainty, in `unit`.
        unit: of the parameter.
        sensitivity: derivative of the outcome, in the outcome's unit per `unit`; of several entries their rms.
        alone: standard uncertainty of the outcome if only this parameter erred, in the outcome's unit.
        share: its part of the variance; all add up to one, a correlation counts half for either parameter.
    """

    name: str
    value: float
    std: float
    unit: str
    sensitivity: float
    alone: float
    share: float


class Budget(NamedTuple):
    """What an outcome's standard uncertainty is made of, to first order, in its field unit.

    Args:
        outcome: its name.
        unit: of everything here but the parameters.
        value: of the outcome at the calibration; None of several entries, and zero of an error.
        std: standard uncertainty that the parameters cause.
        rows: by parameter, the largest share first.
        stages: part of the variance that comes from each source of the calibration's errors.
        noise: standard uncertainty that each kind of the gyro's noise adds.
        instruments: standard uncertainty that each instrument adds on the mission.
        jacobian: derivative of each entry that counts by all parameters, internal units.
    """

    outcome: str
    unit: str
    value: float | None
    std: float
    rows: tuple[Row, ...]
    stages: Mapping[str, float]
    noise: Mapping[str, float]
    instruments: Mapping[str, float]
    jacobian: Float[np.ndarray, "entry parameter"]

    @property
    def total(self) -> float:
        """With noise and instruments."""
        return float(np.sqrt(sum(x**2 for x in (self.std, *self.noise.values(), *self.instruments.values()))))


@eqx.filter_jit
def _derivative(function, of, models, vector: Array, mission: Mission) -> tuple[Array, Array]:
    """The outcome's entries, and their derivative by the parameters."""
    outcome = Outcome("", "", function, of)

    def entries(v):
        return outcome.of_models(mission, models_at(models, v))

    return entries(vector), jax.jacfwd(entries)(vector)


@eqx.filter_jit
def _responses(function, mission: Mission) -> Float[Array, "entry axis sample"]:
    """Derivative of an outcome's entries by the rate errors."""
    still = jnp.zeros_like(mission.output)
    found = jax.jacrev(lambda errors: jnp.ravel(function(mission, errors)))(still)
    return jnp.where(mission.duration > 0, found, 0.0)


def responses(outcome: Outcome, mission: Mission) -> np.ndarray:
    """Derivative of the entries that count by the rate errors (entry, axis, sample)."""
    return np.asarray(_responses(outcome.function, mission))[outcome.entries]


@jax.jit
def _through_noise(ratios: NoiseRatios, interval, longest, sampling, responses: Array) -> Float[Array, " row"]:
    """rᵀ V r of rows r, V the noise's covariance in units of its white variance."""
    filter = make_filter(ratios, interval, longest, sampling)

    def square(row):
        return jnp.sum(jax.vjp(lambda draws: colour(filter, draws), row)[1](row)[0] ** 2)

    return jax.lax.map(square, responses)


def entries_kept(outcome: Outcome, mission: Mission) -> np.ndarray | slice:
    """Which entries of an outcome are no padding."""
    if not outcome.samples:
        return outcome.entries
    return np.tile(np.asarray(mission.duration) > 0, len(mission.models))


def derivative(outcome: Outcome, known: Known, mission: Mission) -> tuple[np.ndarray, np.ndarray]:
    """Entries of an outcome and their derivative by all parameters, internal units, without padding.

    Raises:
        ModelError: one is not finite.
    """
    vector = jnp.asarray(known.vector)
    if outcome.of == "errors" and not outcome.samples:
        # Through the errors: the long way from these to the outcome is then compiled and taken backwards only.
        by_parameter = np.asarray(_derivative(rate, "errors", mission.models, vector, mission)[1])
        rows = responses(outcome, mission)
        jacobian = rows.reshape(len(rows), -1) @ by_parameter
        values = np.zeros(len(rows))
    else:
        found = _derivative(outcome.function, outcome.of, mission.models, vector, mission)
        values, jacobian = (np.asarray(x)[entries_kept(outcome, mission)] for x in found)
    if not (np.isfinite(values).all() and np.isfinite(jacobian).all()):
        raise ModelError(f"the outcome {outcome.name} has no finite derivative by the parameters on this mission")
    return values, jacobian


def budget(
    outcome: Outcome, known: Known, mission: Mission, record: Record, instruments: Mapping[str, Instrument]
) -> Budget:
    """The budget of one outcome.

    Of a "peak" the entry counts whose uncertainty is largest.

    Args:
        outcome: of the mission.
        known: the calibrated gyros; those of the mission.
        mission: what they are used for.
        record: the mission's signals.
        instruments: errors of the mission's columns.
    """
    values, jacobian = derivative(outcome, known, mission)
    covariance = known.covariance
    variances = np.einsum("ij,jk,ik->i", jacobian, covariance, jacobian)
    at = np.argmax(variances, keepdims=True) if outcome.size == "peak" else np.arange(len(variances))
    jacobian = jacobian[at]
    variance = float(variances[at].mean())
    unit = factor(internal_unit(outcome.unit), outcome.unit)
    shares = known.fold((jacobian * (jacobian @ covariance)).mean(axis=0)) / (variance or 1.0)
    squares = (jacobian**2).mean(axis=0)
    stds = np.sqrt(np.diag(covariance))
    alone = np.sqrt(known.fold(squares * stds**2)) * unit
    slopes = np.sqrt(known.fold(squares)) * unit
    if len(jacobian) == 1 and not known.alike:
        slopes = jacobian[0] * unit
    rows = [
        Row(p.name, p.value, float(std) * p.scale, p.unit, float(slope) / p.scale, float(a), float(share))
        for p, std, slope, a, share in zip(known.parameters(), stds, slopes, alone, shares, strict=False)
    ]
    stages: dict[str, float] = {}
    for source, part in known.sources.items():
        caused = float(((jacobian @ part) ** 2).sum(axis=1).mean()) / (variance or 1.0)
        stages[source.name] = stages.get(source.name, 0.0) + caused
    noise, added = _of_errors(outcome, mission, record, instruments, at)
    value = float(values[0]) * unit if len(values) == 1 else None
    return Budget(
        outcome.name, outcome.unit, value, float(np.sqrt(variance)) * unit,
        tuple(sorted(rows, key=lambda r: -abs(r.share))), stages,
        {k: v * unit for k, v in noise.items()}, {k: v * unit for k, v in added.items()}, jacobian,
    )  # fmt: skip


def _of_errors(
    outcome: Outcome, mission: Mission, record: Record, instruments: Mapping[str, Instrument], at: np.ndarray
) -> tuple[dict[str, float], dict[str, float]]:
    """Standard uncertainty that each kind of noise, and each instrument, adds to an outcome; internal units."""
    if outcome.of != "errors":
        return {}, {}
    changes = {name: by_column(mission, name) for name in instruments if name in mission.signals and name != "rate"}
    added: dict[str, float] = {}
    if outcome.samples:
        for name, change in changes.items():
            values = np.asarray(mission.signals[name])
            size = (instruments[name].all_along(values) ** 2).sum(axis=0) + instruments[name].of_each(values) ** 2
            square = (change**2 * size)[:, np.asarray(mission.duration) > 0].ravel()[at]
            added[name] = float(np.sqrt(square.mean()))
        kinds = _each_axis(mission, record, None)
        if kinds is None:
            return {}, added
        each = np.concatenate(kinds[1], axis=1)[:, at].mean(axis=1)
        return {k: float(np.sqrt(v)) for k, v in zip(kinds[0], each, strict=True) if v > 0}, added
    rows = responses(outcome, mission)
    for name, change in changes.items():
        values = np.asarray(mission.signals[name])
        # All axes read one thermometer.
        together = (np.einsum("eas,as,ks->ke", rows, change, instruments[name].all_along(values)) ** 2).sum(axis=0)
        own = change * instruments[name].of_each(values)
        each = (np.einsum("eas,as->es", rows, own) ** 2).sum(axis=1) / mission.together
        added[name] = float(np.sqrt((together + each).mean()))
    kinds = _each_axis(mission, record, rows)
    if kinds is None:
        return {}, added
    noise = np.sum(kinds[1], axis=0).mean(axis=1)
    return {k: float(np.sqrt(v)) for k, v in zip(kinds[0], noise, strict=True) if v > 0}, added


def _each_axis(mission: Mission, record: Record, rows: np.ndarray | None) -> tuple[list[str], list[np.ndarray]] | None:
    """By axis, the variance that each kind of noise causes in each entry; without rows, of each sample measured.

    Rounding of an output that is read in steps counts as white noise.
    """
    found = []
    for axis, model in enumerate(mission.models):
        if not model.noise:
            return None
        model = as_read(model, record, step_of(model, record))
        sampling = with_stated_level(record, model).sampling
        try:
            ratios = stated_ratios(model.noise, record.interval)
        except ValueError as problem:
            raise ModelError(str(problem)) from None
        span = record.span
        white = float(model.noise["noise_white"]) ** 2 / record.interval
        ratios = NoiseRatios(*(np.asarray(r, float) for r in ratios.each()))
        none = NoiseRatios(np.zeros(()), np.zeros(()), np.zeros(()), ratios.constant)
        cells = [none] + [none._replace(**{field: getattr(ratios, field)}) for field in KINDS.values()]
        caused = []
        for cell in cells:
            longest = float(cell.longest(span))
            if rows is None:
                states = markov_sum(cell, record.interval, longest).variance
                walked = float(states[0]) * np.asarray(mission.signals["time"])[: record.rows]
                differences = 2.0 * float(cell.quantisation or 0.0) * mission.together**2
                level = np.asarray(sampling.white)[: record.rows]
                caused.append(white * (level * mission.together + walked + float(states[1:].sum()) + differences))
            else:
                through = _through_noise(cell, record.interval, longest, sampling, jnp.asarray(rows[:, axis]))
                caused.append(white * np.asarray(through))
        found.append(np.stack([caused[0], *(c - caused[0] for c in caused[1:])]))
    return ["noise_white", *KINDS], found
