"""What the command `sensitivity` reads and prints."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from gyromodel._console import print_table

if TYPE_CHECKING:
    from gyromodel.study import PlanChoice, Sensitivity


def run_sensitivity(
    models: list[Path], plan: Path, design: Path | None, outcomes: list[str], candidates: Path | None,
    time: str | None, criterion: Any, rivals: list[str], sobol: bool, draws: int, seed: int,
) -> tuple[Sensitivity, dict[str, Any], PlanChoice | None]:  # fmt: skip
    """The study of the files, its result as plain data, and the best test plan where one was asked for."""
    from gyromodel._checks import CampaignError
    from gyromodel.model import ModelError, make_effect
    from gyromodel.model_files import read_calibration
    from gyromodel.plan import read_plan
    from gyromodel.study import OUTCOMES, best_plan, known, read_candidates, read_instruments, seconds, sensitivity
    from gyromodel.units import UnitError

    if strange := next((name for name in outcomes if name not in OUTCOMES), None):
        there = ", ".join(OUTCOMES)
        raise typer.BadParameter(f"no outcome is called {strange}; there are {there}", param_hint="--outcome")
    try:
        for name in rivals:
            make_effect(name)
    except ModelError as error:
        raise typer.BadParameter(str(error), param_hint="--rival") from None
    calibrated, mission = [read_calibration(path) for path in models], read_plan(plan)
    instruments = read_instruments(plan, mission)
    other = read_plan(design) if design else None
    errors = read_instruments(design, other) if design and other else {}
    # What a wrong file says comes before the work.
    parts = read_candidates(candidates) if candidates else []
    own = read_instruments(candidates, parts[0].campaign) if candidates else {}
    try:
        budget = seconds(time) if parts else 0.0
    except (CampaignError, UnitError) as error:
        raise typer.BadParameter(str(error), param_hint="--budget") from None
    found = sensitivity(
        calibrated, mission, outcomes, design=other, instruments=instruments, design_instruments=errors,
        draws=draws, sobol=sobol, seed=seed,
    )  # fmt: skip
    result = found.to_dict()
    if not parts:
        return found, result, None
    gyros, leading = known(calibrated), found.results[0].budget
    # Of three units alike, each is measured by itself.
    jacobian = leading.jacobian.reshape(-1, len(gyros.vector))
    choice = best_plan(
        gyros, parts, budget, criterion, jacobian=jacobian, rivals=rivals,
        instruments=own or (instruments if other is None else errors),
    )  # fmt: skip
    plain = {"criterion": choice.criterion, "gain": choice.gain}
    if criterion == "outcome":
        plain["outcome"] = leading.outcome
    for name, each in (("best", choice.best), ("equal", choice.equal)):
        plain[name] = {"times": each.times, "duration": each.duration, "separation": each.separation}
    return found, result | {"plan": plain}, choice


def print_sensitivity(found: Sensitivity, choice: PlanChoice | None) -> None:
    """Tables and sentences."""
    from gyromodel.report import (
        disagreements,
        outcome_rows,
        parameter_rows,
        plan_sentence,
        sobol_rows,
        test_rows,
        with_uncertainty,
    )

    for line in found.warnings:
        print(f"gyromodel: {line}", file=sys.stderr)
    leading = found.results[0].budget
    draws = found.results[0].drawn.draws
    header = ("outcome", "calibration's errors", "with noise, instruments", f"{draws} draws", "unit", "comes from")
    print_table(header, outcome_rows(found))
    for result in found.results:
        budget = result.budget
        if budget.value:
            print(f"{budget.outcome} is {with_uncertainty(budget.value, budget.std, budget.unit)}.")
    for line in disagreements(found):
        print(line)
    print(f"\n{leading.outcome}:")
    header = ("parameter", "value ± standard uncertainty", "derivative", "alone", "share of variance")
    print_table(header, parameter_rows(leading))
    if len(leading.stages) > 1:
        print("By stage: " + ", ".join(f"{name} {100 * share:.1f} %" for name, share in leading.stages.items()) + ".")
    for result in found.results:
        if result.sobol:
            print(f"\n{result.budget.outcome}, Sobol indices (correlated parameters: of their symmetric root):")
            print_table(("parameter", "alone", "with interactions"), sobol_rows(result))
    if found.tests:
        print(f"\nWhat to measure next; {leading.outcome} is {leading.std:.3g} {leading.unit} now and then:")
        print_table(("then", "test"), test_rows(found))
        print(found.instrument_to_improve() or "No instrument would buy anything.")
    if choice:
        print(f"\n{plan_sentence(choice, leading.outcome)}")
