"""Outputs that count over the interval before each row, beside reference rates at the rows' own times."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from gyromodel._checks import CampaignError
from gyromodel.averages import with_interval_rates
from gyromodel.campaign import Campaign
from gyromodel.diagnosis._result import Diagnosis
from gyromodel.estimate import Estimate, EstimateError, filter_of, whiten_columns
from gyromodel.model import ModelError

# What outputs counted over intervals seem to have beside reference rates at the ends of these; and by how many nats
# the means of the rates must be likelier, and that for each parameter more.
LATE, CLEARER, PARAMETER = {"time_delay", "bandwidth"}, 2.0, 4.0
COUNTED = (
    "The output counts over the interval before each row, and is late by half of it beside rates at its end: the means "
    "of the reference rates over the intervals were taken, which are likelier."
)
HALF = (
    "The output may count over the interval before each row, and be late by half of it beside rates at its end: these "
    "data do not say, and what was found would hold it."
)


def over_intervals(
    found: Diagnosis, measured: Sequence[Campaign], again: Callable[[list[Campaign]], Diagnosis]
) -> tuple[list[Campaign], float] | None:
    """Increments and angles beside means of the rates over their intervals, and by how many nats they are likelier so.

    Asked where a delay or a bandwidth was found: those are what means have beside rates at the ends of intervals.
    `again` diagnoses other campaigns.
    """
    late = LATE & {c.effect for c in found.causes}
    if not late or measured[0].metadata.get("kind") == "rate" or "rate" not in measured[0].columns:
        return None
    whole = [with_interval_rates(c) for c in measured]
    try:
        other = again(whole)
    except (CampaignError, EstimateError, ModelError):
        return None
    return whole, _likelier(found.extended, other.extended)


def _likelier(one: Estimate, other: Estimate) -> float:
    """By how many nats another fit of the same outputs is likelier, less what further parameters are worth.

    Each in the noise of either, on the rows that both have.
    """
    if one.record.rows != other.record.rows:
        return -np.inf
    lacking = np.flatnonzero(~(one.record.present & other.record.present))
    best = []
    for estimate in (one, other):
        record = estimate.record.without(lacking)
        left = record.signals["output"] - estimate.model.predict(record.signals)
        each = []
        for ratios in (one.ratios, other.ratios):
            filter = filter_of(record, ratios)
            squares = float(np.sum(np.asarray(whiten_columns(filter, left[:, None])) ** 2))
            each.append(-0.5 * (record.present.sum() * np.log(squares) + float(filter.log_determinant)))
        best.append(max(each))
    more = len(other.model.slots()) - len(one.model.slots())
    return best[1] - best[0] - PARAMETER * more
