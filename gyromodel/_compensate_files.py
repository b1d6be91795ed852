"""What the command `compensate` reads and writes: a campaign in memory, or a large file in parts."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from gyromodel._checks import CampaignError
from gyromodel._console import make_folder, read_campaigns
from gyromodel.compensation import ErrorAgainstReference, compensate, reference_error
from gyromodel.files import write_campaign
from gyromodel.streaming import Streamed, compensate_file

if TYPE_CHECKING:
    from gyromodel.estimate import Calibration

# Bytes of a file from which it is compensated in parts, which takes reading it twice.
LARGE = 64 << 20


def compensate_to(
    campaign: Path, output: Path, model: Path, calibration: Calibration, axis: str | None, force: bool
) -> tuple[Streamed, str]:
    """What was written, and how it compares with the reference rate, in words."""
    held = ""

    def accept(error: ErrorAgainstReference | None) -> None:
        nonlocal held
        if error:
            after, before = f"{error.compensated:.4g}", f"{error.as_measured:.4g}"
            held = f"rms error against its reference rate is {after} deg/s, and {before} as"
            if error.worse and not force:
                raise CampaignError(
                    f"{campaign}: {model} makes it worse: the {held} measured; --force writes it anyway"
                )

    if campaign.is_file() and campaign.stat().st_size > LARGE:
        make_folder(output.parent)
        if streamed := compensate_file(campaign, output, calibration, axis, accept):
            return streamed, held
    compensated = compensate(read_campaigns([campaign], axis)[0], calibration)
    error = reference_error(compensated)
    accept(error)
    make_folder(output.parent)
    write_campaign(compensated, output)
    note = str(compensated.metadata.get("rate_estimated_note", ""))
    return Streamed(len(compensated), note, error, compensated.digest()), held
