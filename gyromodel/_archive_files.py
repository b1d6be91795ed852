"""What the commands `batch` and `units` read, write and print: an archive's table of results."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from hashlib import sha256
from pathlib import Path

from gyromodel._console import make_folder, print_table, progress_bar
from gyromodel.batch import (
    Batch,
    Parameter,
    PooledEffect,
    copies,
    pooled_effects,
    pooled_sentences,
    pooled_table,
    read_results,
    run_batch,
    unit_statistics,
    write_table,
)
from gyromodel.model_files import read_model
from gyromodel.report import number, with_uncertainty


def batch_to(archive: str, model: Path, output: Path, diagnosing: bool, workers: int, scheduler: str | None) -> Batch:
    """The archive examined, its table written."""
    start, digest = read_model(model), sha256(model.read_bytes()).hexdigest()
    make_folder(output.parent)
    with progress_bar() as progress:
        return run_batch(
            archive, start, digest, output,
            diagnosing=diagnosing, workers=workers, scheduler=scheduler, progress=progress,
        )  # fmt: skip


def units_of(results: Path, output: Path | None) -> tuple[list[Parameter], list[PooledEffect]]:
    """What a table says of each parameter and effect; the campaigns' parameters as all units tell them are written."""
    table = read_results(results)
    found = unit_statistics(table)
    if twice := copies(table):
        print(f"gyromodel: the same data as others, and counted once: {', '.join(twice)}", file=sys.stderr)
    if output:
        make_folder(output.parent)
        write_table(pooled_table(table, found), output)
    return found, pooled_effects(table)


def print_units(found: Sequence[Parameter], effects: Sequence[PooledEffect]) -> None:
    """A table, and what stands out."""
    if not found:
        print("Nothing to compare: no parameter has standard uncertainties in two campaigns.")
    rows = [
        (f"{s.parameter}{' ' * bool(s.axis)}{s.axis}", str(s.units), str(s.campaigns),
         with_uncertainty(s.mean, s.mean_std, s.unit), number(s.between.value, 3), number(s.within.value, 3))
        for s in found
    ]  # fmt: skip
    if rows:
        print_table(("parameter", "units", "campaigns", "mean", "unit to unit", "campaign to campaign"), rows)
    for line in (line for statistics in found for line in statistics.sentences()):
        print(f"- {line}")
    for line in pooled_sentences(effects):
        print(f"- {line}")
