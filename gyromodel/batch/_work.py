"""What is done with some campaigns of an archive: read, fit or diagnose, and tell the results in rows."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Container, Sequence
from dataclasses import fields
from typing import Any, NamedTuple

import numpy as np

import gyromodel
from gyromodel._checks import CampaignError, legible
from gyromodel.batch._archive import Entry
from gyromodel.batch._references import References, referred
from gyromodel.campaign import Campaign
from gyromodel.diagnosis import diagnose
from gyromodel.effects import Effect
from gyromodel.estimate import EstimateError, calibration_of, fit, fit_many, noise_table, read_for_fit, unknown_rows
from gyromodel.files import read_campaign
from gyromodel.model import GyroModel, ModelError
from gyromodel.platform import fit_vibration, is_platform
from gyromodel.signals import Record
from gyromodel.units import UnitError

Row = dict[str, Any]
# What a campaign or a model that cannot answer raises; anything else is a fault of ours, and told as one.
REFUSALS = (CampaignError, EstimateError, ModelError, UnitError)
# Why parameters do not compare with those of other campaigns.
OWN = "told at reference points of this campaign's own"
# Settings of effects that are told elsewhere: in names and units, or by the campaign itself.
ELSEWHERE = ("unit", "column", "campaign", "campaigns")
# Rows beyond which a campaign is fitted by itself: those fitted together are held in memory side by side.
LONGEST = 1 << 16


class Lot(NamedTuple):
    """Campaigns examined in one go, with the states in which they were found, and what is done with them."""

    entries: tuple[Entry, ...]
    states: tuple[str, ...]
    model: GyroModel
    model_hash: str
    diagnosing: bool
    references: References

    def heads(self) -> list[Row]:
        """What is known of each before it is read."""
        made_by = {"model_hash": self.model_hash, "version": gyromodel.__version__}
        both = zip(self.entries, self.states, strict=True)
        return [{"campaign": entry.campaign, "file_state": state} | made_by for entry, state in both]


class Ready(NamedTuple):
    """One axis of a campaign: what its rows begin with, its data or why there are none, and what is fitted together."""

    head: Row
    campaign: Campaign | Exception
    record: Record | None


def read(lot: Lot) -> list[Ready]:
    """Every axis of every campaign, with its signals where the fits are made together."""
    found = []
    for entry, head in zip(lot.entries, lot.heads(), strict=True):
        try:
            campaign = read_campaign(entry.path)
        except Exception as error:
            found.append(Ready(head, error, None))
            continue
        head["data_hash"] = campaign.digest()
        head |= {key: str(campaign.metadata[key]) for key in ("serial", "date") if key in campaign.metadata}
        if is_platform(campaign) or campaign.outputs in ((), ("output",)):
            found.append(_ready(head, campaign, lot))
            continue
        for axis in (name.removeprefix("output_") for name in campaign.outputs):
            try:
                found.append(_ready(head | {"axis": axis}, campaign.axis(axis), lot))
            except CampaignError as error:
                found.append(Ready(head | {"axis": axis}, error, None))
    return found


def _ready(head: Row, campaign: Campaign, lot: Lot) -> Ready:
    """Noise that is not stated takes nearly all of a fit's time, and is found one campaign at a time anyway."""
    alone = lot.diagnosing or not lot.model.noise or lot.model.reading is not None
    if alone or len(campaign) > LONGEST or is_platform(campaign):
        return Ready(head, campaign, None)
    try:
        return Ready(head, campaign, read_for_fit([campaign]))
    except Exception:  # by itself it says why
        return Ready(head, campaign, None)


def examine(lot: Lot, axes: Sequence[Ready] | None = None) -> list[Row]:
    """Rows of some campaigns, in their order: one for each parameter, or one that says why there is none.

    Args:
        lot: the campaigns.
        axes: what `read` made of them, if it has.
    """
    axes = read(lot) if axes is None else axes
    together = _together(axes, lot.model)
    return [row for i, one in enumerate(axes) for row in together.get(i) or _rows(one, lot)]


def _together(axes: Sequence[Ready], model: GyroModel) -> dict[int, list[Row]]:
    """Rows, by place, of fits that one program makes as `fit` makes each.

    One that fails, or whose misfit may be that of another minimum than `fit` would find, is left to that.
    """
    records = {i: one.record for i, one in enumerate(axes) if one.record is not None}
    if not records:
        return {}
    fits = fit_many(records.values(), model, restarts=False)
    lost = {
        i: unknown_rows(record, fits.model(k)) for k, (i, record) in enumerate(records.items()) if fits.converged[k]
    }
    if any(lost.values()):
        records = {i: records[i].without(np.array(rows, int)) for i, rows in lost.items()}
        fits = fit_many(records.values(), model, restarts=False)
    may_differ = any(not slot.linear for slot in model.slots())
    found = {}
    for k, (i, record) in enumerate(records.items()):
        if fits.converged[k] and not (may_differ and fits.bad[k]):
            found[i] = _parameters(
                axes[i].head | {"status": "fitted"}, record, fits.model(k), fits.covariance[k], int(fits.iterations[k])
            )
    return found


def _rows(one: Ready, lot: Lot) -> list[Row]:
    """Rows of one axis of a campaign that is fitted or diagnosed by itself."""
    head, campaign = one.head, one.campaign
    if isinstance(campaign, Exception):
        return [failed(head, campaign)]
    try:
        if lot.diagnosing:
            diagnosis = diagnose(campaign, lot.model)
            estimate = diagnosis.extended
            model, covariance, common = referred(estimate, lot.references)
            head = head | {
                "status": "diagnosed",
                "verdict": diagnosis.verdict,
                "causes": ", ".join(cause.effect for cause in diagnosis.causes),
                "evidence": json.dumps({k: [round(x, 3) for x in v] for k, v in diagnosis.evidence.items()}),
                "gain_ratio": _known(diagnosis.gain.ratio),
                "reason": None if common else OWN,
            }
        else:
            estimate = fit_vibration([campaign], lot.model) if is_platform(campaign) else fit(campaign, lot.model)
            model, covariance = estimate.model, estimate.covariance
            head = head | {"status": "fitted"}
        held = {key for key in model.fixed - lot.model.fixed if key[0] in lot.model.labels}
        return _parameters(head, estimate.record, model, covariance, estimate.iterations, estimate.noise_interval, held)
    except Exception as error:  # one campaign must not end the run
        return [failed(one.head, error)]


def _parameters(
    head: Row,
    record: Record,
    model: GyroModel,
    covariance: np.ndarray,
    iterations: int,
    noise: Any = None,
    held: Container[tuple[str, str]] = (),
) -> list[Row]:
    """A row for each parameter and noise coefficient, but for those that the campaign does not determine (`held`)."""
    head = head | {"samples": int(record.present.sum()), "iterations": iterations}
    of = {effect.label: _structure(effect) for effect in model.effects}
    rows, seen = [], Counter[tuple[str, str]]()
    for r in calibration_of(model, covariance, record, 0).table():
        if (r.effect, r.name) in held:
            continue
        seen[r.effect, r.name] += 1
        again = f"[{k}]" if (k := seen[r.effect, r.name]) > 1 else ""  # a second step, say
        name = f"{r.effect}{again}.{r.name}{of[r.effect]}"
        rows.append(head | {"parameter": name, "value": float(r.value), "std": float(r.std), "unit": r.unit})
    for name, found in noise_table(model, noise or {}).items():
        ends = {"low": _known(found["lo"]), "high": _known(found["hi"])}
        rows.append(head | {"parameter": name, "value": float(found["value"]), "unit": str(found["unit"])} | ends)
    return rows


def _structure(effect: Effect) -> str:
    """What an effect's parameters are of, where that is not the usual: those of another structure do not compare."""
    chosen = [f for f in fields(effect) if f.metadata.get("static") and f.name not in ELSEWHERE]
    own = [(f.name, getattr(effect, f.name)) for f in chosen if getattr(effect, f.name) != f.default]
    texts = (f"{name} {' '.join(map(str, v)) if isinstance(v, tuple) else v}" for name, v in own)
    return f"[{', '.join(texts)}]" if own else ""


def failed(head: Row, error: Exception) -> Row:
    """The row of a campaign without a result; without its state, if another run may have one of the same data."""
    reason = legible(" ".join(str(error).split()))
    if not isinstance(error, REFUSALS):
        reason = f"internal error ({type(error).__name__}: {reason[:200]})"
    elif not isinstance(error.__cause__, OSError):
        return head | {"status": "failed", "reason": reason}
    return head | {"status": "failed", "reason": reason, "file_state": ""}


def _known(value: Any) -> float | None:
    return float(value) if math.isfinite(value) else None
