"""The command line: parse, call, print. Commands import what they compute with, so that help stays fast."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from io import TextIOWrapper
from pathlib import Path
from typing import Annotated

import typer

import gyromodel
from gyromodel.__main__ import INTERRUPTED
from gyromodel._atomic import write_text
from gyromodel._compiling import keep_compiled, switch_compiler
from gyromodel._console import (
    interrupts_kept,
    json_text,
    make_folder,
    prepare_folder,
    print_paths,
    print_table,
    progress_bar,
    read_campaigns,
    refusal,
    refuse_overwriting,
    refuse_suffix,
)
from gyromodel._diagnose_files import REPORTS, diagnose_axes, diagnose_to
from gyromodel._options import AsJson, Axis, CampaignFile, Campaigns, Folder, ModelFile, Seed
from gyromodel._use_commands import batch, compensate, export, navigate, sensitivity, units

# Help without rich: it loads in half the time.
app = typer.Typer(add_completion=False, no_args_is_help=True, rich_markup_mode=None, pretty_exceptions_enable=False)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line; ends with the exit status of the contract: 0 done, 1 cannot answer, 2 wrong usage.

    Raises:
        KeyboardInterrupt: Ctrl-C, which `__main__` tells of.
    """
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="replace")  # an equation's ε must not stop a terminal that lacks it
    if not {"--help", "--version"} & {*(sys.argv[1:] if arguments is None else arguments)}:
        keep_compiled()
        switch_compiler()
    try:
        with interrupts_kept():
            typer.main.get_command(app)(args=arguments, prog_name="gyromodel")
    except SystemExit as end:
        if end.code == INTERRUPTED:
            raise KeyboardInterrupt from None
        raise
    except Exception as error:
        if os.environ.get("GYROMODEL_DEBUG") == "1":
            raise
        print(f"gyromodel: {refusal(error)}", file=sys.stderr)
        sys.exit(1)


def _print_version(wanted: bool) -> bool:
    if wanted:
        print(f"gyromodel {gyromodel.__version__}")
        raise typer.Exit
    return wanted


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """Find what a gyro simulation gets wrong, name the cause, and extend the model."""


@app.command()
def demo(as_json: AsJson = False) -> None:
    """Run the whole chain on embedded data; writes ./gyromodel-demo."""
    from gyromodel._demo import run_demo

    found = run_demo(quiet=as_json)
    if as_json:
        print(json_text(found), end="")


@app.command()
def fit(campaigns: Campaigns, model: ModelFile, output: Folder, axis: Axis = None, as_json: AsJson = False) -> None:
    """Fit a model to the campaigns of one unit, jointly."""
    prepare_folder(output, model)
    from gyromodel.attitude import with_reference_rates
    from gyromodel.estimate import fit as fit_model
    from gyromodel.model_files import read_model, write_model
    from gyromodel.platform import fit_vibration, is_platform

    start, measured = read_model(model), read_campaigns(campaigns, axis)
    of_platform = all(map(is_platform, measured))
    for line in [line for campaign in measured if (line := with_reference_rates(campaign)[1])]:
        print(f"gyromodel: {line}", file=sys.stderr)
    with progress_bar() as progress:
        estimate = fit_vibration(measured, start) if of_platform else fit_model(measured, start, progress=progress)
    result = estimate.to_dict()
    write_model(estimate, output / "model.yaml")
    write_text(output / "fit.json", json_text(result))
    if as_json:
        print(json_text(result), end="")
        return
    from gyromodel.report import with_uncertainty

    rows = [(row.effect, row.name, with_uncertainty(row.value, row.std, row.unit)) for row in estimate.table()]
    print_table(("effect", "parameter", "value ± standard uncertainty"), rows)
    shown = {float("inf"): "–"}
    noise = []
    for name, n in result["noise"].items():
        value, *ends = (shown.get(n[k], f"{n[k]:.3g}") for k in ("value", "lo", "hi"))
        noise.append((name, value, *(("stated", "") if estimate.noise_given else ends), n["unit"]))
    print()
    print_table(("noise", "value", "95 % from", "to", "unit"), noise)
    print_paths(output, "model.yaml", "fit.json")


@app.command()
def diagnose(
    campaigns: Campaigns,
    model: ModelFile,
    output: Folder,
    axis: Axis = None,
    calibrate: Annotated[
        int,
        typer.Option(
            min=0, metavar="N", help="Take the threshold from N simulated campaigns with nothing hidden (200 or more)."
        ),
    ] = 0,
    seed: Seed = 0,
    as_json: AsJson = False,
) -> None:
    """Say what the simulation gets wrong, and why.

    Writes the extended model, the gain measured on data it did not see, and a report. Of a three-axis campaign each
    axis has a folder of its own, and axes.json says how the three lie together. Logs of a platform's vibration test are
    searched for what moves its base otherwise than the table.
    """
    if 0 < calibrate < 200:
        raise typer.BadParameter("200 campaigns or more show a 99 % point; 0 takes the safe threshold", param_hint="N")
    measured = read_campaigns(campaigns, axis)
    from gyromodel.platform import is_platform

    if any(len(each.outputs) > 1 for each in measured) and not is_platform(measured[0]):
        result, verdict, written = diagnose_axes(measured, model, output, calibrate, seed)
    else:
        diagnosis, verdict = diagnose_to(measured, model, output, calibrate=calibrate, seed=seed)
        result, written = diagnosis.to_dict() | {"model": "model.yaml"}, REPORTS
    if as_json:
        print(json_text(result), end="")
    else:
        print(verdict)
        print_paths(output, *written)


@app.command()
def simulate(
    model: Annotated[Path, typer.Argument(metavar="M.yaml", help="A model with values.")],
    output: CampaignFile,
    like: Annotated[Path | None, typer.Option(metavar="CAMPAIGN", help="Take time and covariates from it.")] = None,
    plan: Annotated[Path | None, typer.Option(metavar="PLAN.yaml", help="Or from a plan.")] = None,
    axis: Axis = None,
    seed: Seed = 0,
    as_json: AsJson = False,
) -> None:
    """Compute the campaign that a model predicts, noise included."""
    pattern_file = like or plan
    if pattern_file is None or (like and plan):
        raise typer.BadParameter("give either --like CAMPAIGN or --plan PLAN.yaml", param_hint="--like")
    refuse_overwriting(output, [model, pattern_file])
    from gyromodel.files import SUFFIXES, read_campaign, write_campaign
    from gyromodel.model_files import read_model
    from gyromodel.plan import read_plan
    from gyromodel.simulation import simulate as simulate_campaign

    refuse_suffix(output, SUFFIXES)
    simulated_by = read_model(model)
    if not simulated_by.noise:
        print(f"gyromodel: {model} states no noise, and none is drawn", file=sys.stderr)
    pattern = read_plan(pattern_file) if plan else read_campaign(pattern_file, measured=False)
    simulated = simulate_campaign(simulated_by, pattern.axis(axis) if axis else pattern, seed)
    make_folder(output.parent)
    write_campaign(simulated, output)
    result = {"campaign": str(output), "rows": len(simulated), "seed": seed, "data_hash": simulated.digest()}
    print(json_text(result) if as_json else f"{len(simulated)} samples in {output}\n", end="")


@app.command()
def plan(
    design: Annotated[Path, typer.Option(metavar="PLAN.yaml", help="What every column is to do.")],
    model: Annotated[Path, typer.Option("--model", metavar="M.yaml", help="The simulation, its noise stated.")],
    as_json: AsJson = False,
) -> None:
    """Tell which effects a planned campaign could show and tell apart, and which further test would help."""
    from gyromodel.diagnosis import isolability
    from gyromodel.model_files import read_model
    from gyromodel.plan import read_plan
    from gyromodel.report import isolability_rows, parted_words

    found = isolability(read_plan(design), read_model(model))
    if as_json:
        print(json_text(found.to_dict()), end="")
        return
    header = ("effect", "found from (80 %)", "hardest to tell from", "told apart from (95 %)", "unit")
    print_table(header, isolability_rows(found))
    for name, reason in found.not_testable.items():
        print(f"Not testable: {name} ({reason}).")
    print("\nFurther tests, the most helpful first:")
    for sentence, after in found.tests[:3]:
        print(f"- {sentence} {parted_words(found, after)}")


@app.command()
def allan(
    campaign: Annotated[Path, typer.Argument(metavar="CAMPAIGN", help="Campaign file of a gyro at rest.")],
    output: Folder,
    axis: Axis = None,
    as_json: AsJson = False,
) -> None:
    """Allan deviation and noise coefficients with intervals, of a gyro at rest."""
    make_folder(output)
    from gyromodel.noise_analysis import analyse_noise
    from gyromodel.report import deviation_figure, noise_rows

    [measured] = read_campaigns([campaign], axis)
    with progress_bar() as progress:
        analysis = analyse_noise(measured, progress=progress)
    result = analysis.to_dict()
    write_text(output / "allan.json", json_text(result))
    write_text(output / "allan.svg", deviation_figure(analysis))
    if as_json:
        print(json_text(result), end="")
        return
    print_table(("noise", "", "value", "95 % from", "to", "unit", "verdict"), noise_rows(analysis))
    print("".join(f"\n{remark}\n" for remark in analysis.remarks), end="")
    print_paths(output, "allan.json", "allan.svg")


@app.command()
def vibration(
    campaign: Annotated[Path, typer.Argument(metavar="CAMPAIGN", help="Log of a platform on a vibration table.")],
    output: Folder,
    as_json: AsJson = False,
) -> None:
    """Amplitude and phase of a gyro-stabilised platform on an angular vibration table, and what explains them."""
    from gyromodel.platform import vibration_test
    from gyromodel.report import vibration_figures, vibration_page, vibration_words

    [measured] = read_campaigns([campaign], None)
    with progress_bar() as progress:
        test = vibration_test(measured, progress)
    result, figures = test.to_dict(), vibration_figures(test)
    make_folder(output)
    write_text(output / "vibration.json", json_text(result))
    for name, figure in figures.items():
        write_text(output / f"{name}.svg", figure)
    for name in {"explanations", "loop"} - set(figures):  # of an earlier run
        (output / f"{name}.svg").unlink(missing_ok=True)
    write_text(output / "report.html", vibration_page(test, figures, measured.name))
    if as_json:
        print(json_text(result), end="")
        return
    words = vibration_words(test)
    print_table(words.head, words.runs)
    print("".join(f"\n{line}" for line in words.lines))
    print_paths(output, "report.html", "vibration.json", *(f"{name}.svg" for name in figures))


@app.command()
def effects(
    effect: Annotated[str | None, typer.Argument(metavar="ID", help="One effect, in full.", show_default=False)] = None,
    as_json: AsJson = False,
) -> None:
    """Print the catalogue of effects, or one entry in full."""
    from gyromodel._catalogue_text import entries, print_catalogue, print_entry

    found = entries(effect)
    if as_json:
        print(json_text(found[0] if effect else found), end="")
    elif effect:
        print_entry(found[0])
    else:
        print_catalogue(found)


for _command in (sensitivity, compensate, navigate, batch, units, export):
    app.command()(_command)
