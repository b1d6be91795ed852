"""Arguments and options that several commands have."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

Campaigns = Annotated[list[Path], typer.Argument(metavar="CAMPAIGN", help="Campaign files of one gyro unit.")]
ModelFile = Annotated[Path, typer.Option("--model", metavar="M.yaml", help="The model to start from.")]
Folder = Annotated[Path, typer.Option("--output", "-o", metavar="DIR", help="Folder for the results; made if missing.")]
Axis = Annotated[
    Literal["x", "y", "z"] | None, typer.Option("--axis", help="Axis of a three-axis campaign.", show_default=False)
]
AsJson = Annotated[bool, typer.Option("--json", help="Print the machine-readable result.")]
CampaignFile = Annotated[
    Path, typer.Option("--output", "-o", metavar="FILE", help="Campaign to write; its suffix says the kind.")
]
Seed = Annotated[int, typer.Option("--seed", min=0, help="Seed of the random draws.")]
