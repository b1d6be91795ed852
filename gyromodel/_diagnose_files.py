"""What the diagnose command writes: for one axis, and for the axes of a campaign together."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gyromodel._atomic import write_text
from gyromodel._console import json_text, prepare_folder, progress_bar

if TYPE_CHECKING:
    from gyromodel.campaign import Campaign
    from gyromodel.diagnosis import Diagnosis

REPORTS = ("report.html", "diagnosis.json", "model.yaml")


def diagnose_to(
    measured: Sequence[Campaign], model: Path, output: Path, *, calibrate: int = 0, seed: int = 0
) -> tuple[Diagnosis, str]:
    """Diagnose one axis and write the results; and the verdict in a sentence, findings in a line each."""
    prepare_folder(output, model)
    from gyromodel.diagnosis import diagnose
    from gyromodel.model_files import read_model, write_model
    from gyromodel.report import sentence, write_report

    start = read_model(model)
    with progress_bar() as progress:
        diagnosis: Diagnosis = diagnose(measured, start, calibrate=calibrate, seed=seed, progress=progress)
    write_model(diagnosis.extended, output / "model.yaml")
    write_text(output / "diagnosis.json", json_text(diagnosis.to_dict() | {"model": "model.yaml"}))
    write_report(diagnosis, output)
    return diagnosis, "\n- ".join([sentence(diagnosis), *diagnosis.findings])


def diagnose_axes(
    measured: Sequence[Campaign], model: Path, output: Path, calibrate: int, seed: int
) -> tuple[dict[str, Any], str, tuple[str, ...]]:
    """Diagnose each axis that can be, and how the axes lie together; the answer, its words, the files."""
    from gyromodel._checks import CampaignError
    from gyromodel.campaign import AXES
    from gyromodel.estimate import EstimateError
    from gyromodel.model import ModelError
    from gyromodel.three_axes import triad

    axes, not_diagnosed, said, written, extended = {}, {}, [], [], {}
    for axis in AXES:
        if not any(f"output_{axis}" in campaign.columns for campaign in measured):
            continue
        try:
            alone = [_axis(campaign, axis) for campaign in measured]
            diagnosis, verdict = diagnose_to(alone, model, output / axis, calibrate=calibrate, seed=seed)
        except (CampaignError, EstimateError, ModelError) as error:
            not_diagnosed[axis] = str(error)
            continue
        axes[axis], extended[axis] = diagnosis.to_dict() | {"model": f"{axis}/model.yaml"}, diagnosis.extended
        said.append(f"Axis {axis}: {verdict}")
        written += [f"{axis}/{report}" for report in REPORTS]
    if not axes:
        raise CampaignError(f"no axis can be diagnosed; {'; '.join(f'{a}: {why}' for a, why in not_diagnosed.items())}")
    for axis in not_diagnosed:
        _remove_results(output / axis, model)
    for axis, reason in not_diagnosed.items():
        print(f"gyromodel: axis {axis} was not diagnosed: {reason}", file=sys.stderr)
    # An error that no name explains may pass for a lean of its axis.
    unknown = [axis for axis, result in axes.items() if result["verdict"] == "unknown"]
    if unknown:
        said.append(f"How the axes lie together is not told: what axis {unknown[0]} lacks has no name.")
    lie = None
    try:
        lie = None if unknown else triad(measured, extended)
    except (CampaignError, EstimateError, ModelError) as error:
        said.append(
            "How the axes lie together is not told: an axis cannot be fitted with leans beside what it lacks: "
            + f"{str(error).rstrip('.')}."
        )
    result = {"axes": axes, "not_diagnosed": not_diagnosed, "triad": lie and lie.to_dict()}
    write_text(output / "axes.json", json_text(result))
    return result, "\n".join([*said, *([lie.sentence()] if lie else [])]), (*written, "axes.json")


def _axis(campaign: Campaign, axis: str) -> Campaign:
    """One axis of a campaign; an error names the campaign."""
    from gyromodel._checks import CampaignError

    try:
        return campaign.axis(axis)
    except CampaignError as error:
        raise CampaignError(f"{campaign.name}: {error}") from None


def _remove_results(folder: Path, model: Path) -> None:
    """Remove what an earlier run has written of an axis that has no results now; not the model that is read."""
    from gyromodel.report._figures import FIGURES

    if not (folder / "diagnosis.json").exists():
        return
    figures = [path for pattern in FIGURES for path in (folder / "figures").glob(f"{pattern}.svg")]
    for path in [*(folder / name for name in REPORTS), *figures]:
        if path.exists() and not path.samefile(model):
            path.unlink()
