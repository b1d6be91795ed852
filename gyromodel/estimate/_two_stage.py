"""Two-stage fits: the uncertainty of what an earlier fit found, carried into a later one that took it as known."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from gyromodel._checks import thermometers
from gyromodel.estimate._estimate import Estimate, EstimateError
from gyromodel.estimate._optimistix import response_to_changes
from gyromodel.estimate._whitening import filter_of
from gyromodel.model import GyroModel
from gyromodel.noise import NoiseRatios
from gyromodel.numerics.uncertain import Uncertain
from gyromodel.signals import Record, thermometer_rate

Columns = Callable[[Any], Mapping[str, Float[Array, " sample"]]]

# Largest difference between a column that was fitted with and the one the first stage gives, of the column's range.
SAME_COLUMN = 1e-6
# Largest difference of a parameter held from the one found, of its value or its standard uncertainty.
SAME_VALUE = 1e-6


def two_stage(first: Estimate | Uncertain, second: Estimate, columns: Columns | None = None) -> Estimate:
    """The second fit with its covariance widened by that of what it took from the first.

    Args:
        first: a fit of other data, independent of those of the second, or any uncertain value.
        second: a fit whose model holds some parameters of the first fixed, at the values found there; or, with
            `columns`, one whose campaign has columns that were computed from the first.
        columns: those columns (internal units, one entry a row) as a differentiable function of the first's value.

    Returns:
        The second fit; its covariance is C₂ + J C₁ Jᵀ, J the derivative of its parameters by what was taken (implicit
        function theorem at the minimum), C₁ the covariance of that. The sources of error of the first are kept apart,
        so that the result may be the first stage of another fit.

    Raises:
        EstimateError: the second fit took nothing from the first, or other columns.
    """
    given = first.parameters if isinstance(first, Estimate) else first
    factors = list(given.sources.values())
    errors = np.concatenate(factors, axis=1)
    if columns is not None:
        held, changes = None, np.zeros((0, errors.shape[1]))
        signals = _changes_of_columns(second.record, given, columns, errors)
    elif isinstance(first, Estimate):
        held, order = _held(first, second)
        changes, signals = errors[order], {}
    else:
        raise EstimateError("say which columns of the second fit's campaign come from the first: give `columns`")
    white = NoiseRatios(jnp.zeros(()), jnp.zeros(()))
    filter = filter_of(second.record, white if second.ordinary else second.ratios)
    response = response_to_changes(second.model, held, changes, second.record.signals, signals, filter)
    inherited, start = dict(second.inherited), 0
    for source, factor in given.sources.items():
        more = response[:, start : start + factor.shape[1]]
        inherited[source] = inherited[source] + more if source in inherited else more
        start += factor.shape[1]
    covariance = second.own_covariance + sum(a @ a.T for a in inherited.values())
    return replace(second, covariance=covariance, inherited=inherited)


def _held(first: Estimate, second: Estimate) -> tuple[GyroModel, list[int]]:
    """The second model with exactly those parameters free that the first fitted, and their places in the first."""
    of_first = [(first.model.labels[s.effect], s.field, s.index) for s in first.model.slots()]
    taken = {(label, field) for label, field, _ in of_first} & second.model.fixed
    others = frozenset((e.label, name) for e in second.model.effects for name in e.declared()) - taken
    held = replace(second.model, fixed=others)
    of_held = [(held.labels[s.effect], s.field, s.index) for s in held.slots()]
    if not of_held:
        raise EstimateError("the second fit holds no parameter that the first one fitted: fix it in the second model")
    order = [of_first.index(slot) for slot in of_held]
    found, held_at = np.asarray(first.model.vector())[order], np.asarray(held.vector())
    for slot, there, here, std in zip(of_held, found, held_at, first.std[order], strict=True):
        if abs(here - there) > SAME_VALUE * max(abs(there), std):
            raise EstimateError(
                f"the second fit holds {slot[1]} of {slot[0]} at another value than the first one found: fix it there"
            )
    return held, order


def _changes_of_columns(
    record: Record, given: Uncertain, columns: Columns, errors: np.ndarray
) -> dict[str, Float[np.ndarray, "sample error"]]:
    """What a unit of each error changes in the signals, padded as they are."""

    def of(vector: Array) -> dict[str, Array]:
        return dict(columns(given.build(vector)))

    found = {}
    for name, values in of(jnp.asarray(given.vector)).items():
        if name not in record.signals or np.shape(values) != (record.rows,):
            raise EstimateError(f"the second fit's campaign has no column {name} of {np.size(values)} rows")
        used = np.asarray(record.signals[name])[: record.rows][record.present]
        apart = np.abs(used - np.asarray(values)[record.present]).max()
        if not apart <= SAME_COLUMN * max(np.ptp(used), np.abs(used).max()):
            raise EstimateError(f"the second fit saw another {name} than the first stage gives: fit it again")
        slope = jax.jacfwd(lambda v, name=name: of(v)[name])(jnp.asarray(given.vector))
        found[name] = np.asarray(slope) @ errors
    for name in thermometers(found):
        base = np.asarray(record.signals[name])[: record.rows]
        # The smoothing adapts to the data: a difference over one standard error each way is its derivative.
        ends = [np.stack([thermometer_rate(record, base + s * d) for d in found[name].T]) for s in (1.0, -1.0)]
        found[f"{name}_rate"] = (ends[0] - ends[1]).T / 2
    extra = len(record.signals["time"]) - record.rows
    return {name: np.pad(change, ((0, extra), (0, 0)), mode="edge") for name, change in found.items()}
