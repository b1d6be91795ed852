"""What is done with one campaign of an archive: read, fit or diagnose, and tell the result in rows."""

from __future__ import annotations

import math
from typing import Any

import gyromodel
from gyromodel._checks import CampaignError
from gyromodel.batch._archive import Entry
from gyromodel.campaign import Campaign
from gyromodel.diagnosis import diagnose
from gyromodel.estimate import Estimate, EstimateError, fit
from gyromodel.files import read_campaign
from gyromodel.model import GyroModel, ModelError
from gyromodel.units import UnitError

Row = dict[str, Any]
# What a campaign or a model that cannot answer raises; anything else is a fault of ours, and told as one.
REFUSALS = (CampaignError, EstimateError, ModelError, UnitError)


def read(entry: Entry) -> Campaign | Exception:
    """The campaign, or why it cannot be read."""
    try:
        return read_campaign(entry.path)
    except Exception as error:
        return error


def examine(
    entry: Entry,
    state: str,
    model: GyroModel,
    model_hash: str,
    diagnosing: bool,
    campaign: Campaign | Exception | None = None,
) -> list[Row]:
    """Rows of one campaign, which is read if need be: one for each parameter, or one that says why there is none."""
    head = {"campaign": entry.campaign, "model_hash": model_hash, "version": gyromodel.__version__, "file_state": state}
    campaign = read(entry) if campaign is None else campaign
    if isinstance(campaign, Exception):
        return [failed(head, campaign)]
    head["data_hash"] = campaign.digest()
    head |= {key: str(campaign.metadata[key]) for key in ("serial", "date") if key in campaign.metadata}
    if campaign.outputs in ((), ("output",)):
        return _rows(head, campaign, model, diagnosing)
    axes = [name.removeprefix("output_") for name in campaign.outputs]
    return [row for axis in axes for row in _axis_rows(head | {"axis": axis}, campaign, model, diagnosing)]


def _axis_rows(head: Row, campaign: Campaign, model: GyroModel, diagnosing: bool) -> list[Row]:
    try:
        alone = campaign.axis(head["axis"])
    except CampaignError as error:
        return [failed(head, error)]
    return _rows(head, alone, model, diagnosing)


def _rows(head: Row, campaign: Campaign, model: GyroModel, diagnosing: bool) -> list[Row]:
    try:
        if not diagnosing:
            estimate = fit(campaign, model)
            return _parameters(head | {"status": "fitted"}, estimate)
        diagnosis = diagnose(campaign, model)
    except Exception as error:  # one campaign must not end the run
        return [failed(head, error)]
    head = head | {
        "status": "diagnosed",
        "verdict": diagnosis.verdict,
        "causes": ", ".join(cause.effect for cause in diagnosis.causes),
        "gain_ratio": _known(diagnosis.gain.ratio),
    }
    return _parameters(head, diagnosis.extended)


def _parameters(head: Row, estimate: Estimate) -> list[Row]:
    head = head | {"samples": int(estimate.record.present.sum()), "iterations": estimate.iterations}
    rows = [
        head | {"parameter": f"{r.effect}.{r.name}", "value": float(r.value), "std": float(r.std), "unit": r.unit}
        for r in estimate.table()
    ]
    for name, noise in estimate.noise_table().items():
        ends = {"low": _known(noise["lo"]), "high": _known(noise["hi"])}
        rows.append(head | {"parameter": name, "value": float(noise["value"]), "unit": str(noise["unit"])} | ends)
    return rows


def failed(head: Row, error: Exception) -> Row:
    """The row of a campaign without a result; without its state, if another run may have one of the same data."""
    reason = " ".join(str(error).split())
    if not isinstance(error, REFUSALS):
        reason = f"internal error ({type(error).__name__}: {reason[:200]})"
    elif not isinstance(error.__cause__, OSError):
        return head | {"status": "failed", "reason": reason}
    return head | {"status": "failed", "reason": reason, "file_state": ""}


def _known(value: Any) -> float | None:
    return float(value) if math.isfinite(value) else None
