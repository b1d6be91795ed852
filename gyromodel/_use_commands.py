"""Commands beyond one gyro's model: missions and test plans, compensation, navigation, archives, export."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Literal

import typer

from gyromodel._atomic import write_text
from gyromodel._console import (
    json_text,
    make_folder,
    print_paths,
    read_campaigns,
    refuse_overwriting,
    refuse_suffix,
)
from gyromodel._options import AsJson, Axis, CampaignFile, ModelFile, Seed

SENSITIVITY = ("sensitivity.json", "tornado.svg", "budget.svg")


def sensitivity(
    models: Annotated[list[Path], typer.Argument(metavar="M.yaml", help="A fitted model; or three, of axes x, y, z.")],
    plan: Annotated[Path, typer.Option("--plan", metavar="PLAN.yaml", help="The mission: what every column does.")],
    output: Annotated[
        Path | None, typer.Option("--output", "-o", metavar="DIR", help="Folder for figures and sensitivity.json.")
    ] = None,
    design: Annotated[
        Path | None, typer.Option(metavar="PLAN2.yaml", help="The next campaign's plan; the mission's by default.")
    ] = None,
    outcome: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME",
            help="rate, angle, peak, attitude, position, bias_temperature, scale_factor, scale_temperature, "
            "scale_nonlinearity.",
        ),
    ] = None,
    candidates: Annotated[
        Path | None, typer.Option(metavar="C.yaml", help="Parts of which to make the best test plan.")
    ] = None,
    budget: Annotated[str | None, typer.Option(metavar="TIME", help='Time for that plan, such as "4 h".')] = None,
    criterion: Annotated[
        Literal["parameters", "outcome", "discrimination"] | None,
        typer.Option(
            help="What that plan is best for: telling --rival effects apart where some are given, else the first "
            "--outcome where one is, else the parameters.",
            show_default=False,
        ),
    ] = None,
    rival: Annotated[list[str] | None, typer.Option(metavar="EFFECT", help="An effect to be told from others.")] = None,
    sobol: Annotated[bool, typer.Option("--sobol", help="Sobol indices also where the outcome is linear.")] = False,
    draws: Annotated[int, typer.Option(min=1000, metavar="N", help="Draws of all parameters.")] = 2000,
    seed: Seed = 0,
    as_json: AsJson = False,
) -> None:
    """Tell what a calibration's errors do to a mission, where they come from, and what to measure next."""
    if (candidates is None) != (budget is None):
        raise typer.BadParameter("a test plan needs both --candidates and --budget", param_hint="--budget")
    if candidates is None and (criterion or rival):
        raise typer.BadParameter(
            "is for a test plan, which needs --candidates", param_hint="--rival" if rival else "--criterion"
        )
    criterion = criterion or ("discrimination" if rival else "outcome" if outcome else "parameters")
    if criterion == "discrimination" and len({*(rival or [])}) < 2:
        raise typer.BadParameter("effects are told apart where there are two or more", param_hint="--rival")
    from gyromodel._study_files import print_sensitivity, run_sensitivity

    found, result, chosen = run_sensitivity(
        models, plan, design, outcome or [], candidates, budget, criterion, rival or [], sobol, draws, seed
    )
    if output:
        from gyromodel.report import history_figure, tornado_figure

        make_folder(output)
        texts = json_text(result), tornado_figure(found), history_figure(found)
        for name, text in zip(SENSITIVITY, texts, strict=True):
            write_text(output / name, text)
    if as_json:
        print(json_text(result), end="")
        return
    print_sensitivity(found, chosen)
    if output:
        print_paths(output, *SENSITIVITY)


def compensate(
    model: Annotated[Path, typer.Argument(metavar="M.yaml", help="A fitted model.")],
    campaign: Annotated[Path, typer.Argument(metavar="CAMPAIGN", help="Its output and what the model needs besides.")],
    output: CampaignFile,
    axis: Axis = None,
    force: Annotated[bool, typer.Option("--force", help="Write also what errs more than the output as it is.")] = False,
    as_json: AsJson = False,
) -> None:
    """Apply a calibration: add the estimated rate and its standard uncertainty to a campaign.

    On a campaign with a reference rate, a calibration that makes its error larger is refused.
    """
    refuse_overwriting(output, [model, campaign])
    from gyromodel._compensate_files import compensate_to
    from gyromodel.files import SUFFIXES
    from gyromodel.model_files import read_calibration

    refuse_suffix(output, SUFFIXES)
    done, held = compensate_to(campaign, output, model, read_calibration(model), axis, force)
    if done.note:
        print(f"gyromodel: {done.note}", file=sys.stderr)
    if as_json:
        result = {"campaign": str(output), "rows": done.rows, "note": done.note, "data_hash": done.data_hash}
        print(json_text(result | {"reference_error": done.error and done.error._asdict()}), end="")
        return
    print(f"{done.rows} samples in {output}" + (f"; the {held} measured" if held else ""))


def navigate(
    campaign: Annotated[Path, typer.Argument(metavar="CAMPAIGN", help="Three gyros, accelerometers, first attitude.")],
    output: CampaignFile,
    as_json: AsJson = False,
) -> None:
    """Navigate from a start at rest: add attitude, velocity and position to a campaign."""
    refuse_overwriting(output, [campaign])
    from gyromodel.files import SUFFIXES, write_campaign
    from gyromodel.platform import navigate_campaign

    refuse_suffix(output, SUFFIXES)
    navigated = navigate_campaign(read_campaigns([campaign], None)[0])
    make_folder(output.parent)
    write_campaign(navigated, output)
    end = {name: float(navigated.columns[name][-1]) for name in ("latitude", "longitude", "height")}
    if as_json:
        print(json_text({"campaign": str(output), "rows": len(navigated), "end": end}), end="")
        return
    where = ", ".join(f"{name} {value:.6f}" for name, value in end.items())
    print(f"{len(navigated)} samples in {output}; at the end {where} (deg, m)")


def batch(
    archive: Annotated[
        str, typer.Argument(metavar="ARCHIVE", help="Folder, quoted pattern, Zarr group, or Parquet manifest.")
    ],
    model: ModelFile,
    output: Annotated[Path, typer.Option("--output", "-o", metavar="RESULTS.parquet", help="The table to write.")],
    diagnose: Annotated[bool, typer.Option("--diagnose", help="Diagnose each campaign rather than fit it.")] = False,
    workers: Annotated[int, typer.Option(min=1, metavar="N", help="Processes of a local cluster.")] = 1,
    scheduler: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="A Dask cluster, such as tcp://host:8786.", show_default=False)
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Fit every campaign of an archive into one table; killed, it goes on where it was.

    A campaign that cannot be read or fitted is a row with its reason, and the exit status is then 1.
    """
    output = output if output.suffix or not output.name else output.with_suffix(".parquet")
    refuse_suffix(output, [".parquet"])
    refuse_overwriting(output, [model, Path(archive)])
    from gyromodel._archive_files import batch_to

    done = batch_to(archive, model, output, diagnose, workers, scheduler)
    result = {"results": str(output), "campaigns": done.campaigns, "examined": done.examined, "failed": done.failed}
    if as_json:
        print(json_text(result), end="")
    else:
        print(f"{done.campaigns} campaigns, {done.examined} examined in this run; {len(done.table)} rows in {output}")
    has = {name.partition(".")[0] for name in filter(None, done.table["parameter"].unique().to_pylist())}
    points = {key: text for key, (_, text) in done.references.items() if key.partition(".")[0] in has}
    if points:
        named = ", ".join(f"{key}: {text}" for key, text in points.items())
        print(f"gyromodel: for all campaigns {named} (stated in the model, others count)", file=sys.stderr)
    if done.failed:
        print(f"gyromodel: {done.failed} of {done.campaigns} campaigns failed: see column reason", file=sys.stderr)
        sys.exit(1)


def units(
    results: Annotated[Path, typer.Argument(metavar="RESULTS.parquet", help="What batch has written.")],
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="FILE.parquet", help="Campaigns' parameters as all units tell them."),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Tell how the units of an archive spread, which stand out or drift, and what all lack together."""
    if output:
        refuse_suffix(output, [".parquet"])
        refuse_overwriting(output, [results])
    from gyromodel._archive_files import print_units, units_of

    found, effects = units_of(results, output)
    if as_json:
        parameters = [statistics.to_dict() for statistics in found]
        print(json_text({"parameters": parameters, "effects": [effect.to_dict() for effect in effects]}), end="")
    else:
        print_units(found, effects)


def export(
    model: Annotated[Path, typer.Argument(metavar="M.yaml", help="A model with values.")],
    to: Annotated[
        Literal["c", "json", "csv", "px4"], typer.Option("--to", help="C99 source, JSON, CSV, or PX4 parameters.")
    ],
    output: Annotated[
        Path | None, typer.Option("--output", "-o", metavar="FILE", help="File to write; printed without.")
    ] = None,
    axis: Annotated[
        Literal["x", "y", "z"] | None,
        typer.Option("--axis", help="Axis of the autopilot, with --to px4 only; x unless told.", show_default=False),
    ] = None,
) -> None:
    """Write a calibration for firmware and spreadsheets; to PX4, that of one axis."""
    if axis and to != "px4":
        raise typer.BadParameter("only PX4 parameters are of one axis: --to px4 --axis x", param_hint="--axis")
    if output:
        refuse_overwriting(output, [model])
    from gyromodel.export import export_calibration
    from gyromodel.model_files import read_calibration

    text = export_calibration(read_calibration(model), to, axis or "x")
    if to == "px4" and not axis:
        print("gyromodel: the parameters are those of the autopilot's axis x (--axis takes another)", file=sys.stderr)
    if output:
        write_text(output, text)
    else:
        print(text, end="")
