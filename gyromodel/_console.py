"""What every command does: read campaigns, refuse bad places, show progress, print results and refusals."""

from __future__ import annotations

import json
import math
import os
import signal
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

if TYPE_CHECKING:
    from gyromodel.campaign import Campaign

# Errors that mean "the data or the model cannot answer", by the module that defines them.
_REFUSALS = {
    "gyromodel._checks": "CampaignError",
    "gyromodel.units": "UnitError",
    "gyromodel.model": "ModelError",
    "gyromodel.estimate": "EstimateError",
}


def refusal(error: Exception) -> str:
    """An error as one sentence."""
    refusals = tuple(getattr(sys.modules[m], name) for m, name in _REFUSALS.items() if m in sys.modules)
    if isinstance(error, refusals):
        return str(error)
    if isinstance(error, OSError) and error.strerror:
        return f"{error.filename}: {error.strerror}" if error.filename else error.strerror
    found = " ".join(f"{type(error).__name__}: {error}".split())[:200]
    return f"internal error ({found}); please report it with the output under GYROMODEL_DEBUG=1"


@contextmanager
def interrupts_kept() -> Iterator[None]:
    """Repeat a Ctrl-C that is lost since it comes within a callback of the garbage collector, as JAX has."""
    before = sys.unraisablehook

    def again(lost: Any) -> None:
        if not issubclass(lost.exc_type, KeyboardInterrupt):
            before(lost)
            return
        signal.signal(signal.SIGALRM, signal.default_int_handler)
        signal.setitimer(signal.ITIMER_REAL, 0.01)

    sys.unraisablehook = again
    try:
        yield
    finally:
        sys.unraisablehook = before


def read_campaigns(paths: Sequence[Path], axis: str | None) -> list[Campaign]:
    """Campaigns, or one axis of each."""
    from gyromodel.files import read_campaign

    measured = [read_campaign(path) for path in paths]
    return [campaign.axis(axis) for campaign in measured] if axis else measured


def prepare_folder(folder: Path, model: Path) -> None:
    """Refuse or make the folder for results before the work, so that a wrong place costs no time."""
    refuse_overwriting(folder / "model.yaml", [model])
    make_folder(folder)


def make_folder(folder: Path) -> None:
    """Make the folder for results, with those above it.

    Raises:
        OSError: it cannot be made; the sentence says that it is the output's.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        why = f"no folder for the output can be made there ({os.strerror(error.errno or 0).lower()})"
        raise OSError(error.errno, why, str(folder)) from error


def refuse_suffix(target: Path, suffixes: Sequence[str]) -> None:
    """Refuse a name that says no kind of file that can be written."""
    if not target.name.lower().endswith(tuple(suffixes)):
        raise typer.BadParameter(f"{target}: its name has to end in {' or '.join(suffixes)}", param_hint="--output")


def refuse_overwriting(target: Path, inputs: Sequence[Path]) -> None:
    """Refuse to write over what is read."""
    for path in inputs:
        if target.exists() and path.exists() and target.samefile(path):
            raise typer.BadParameter(f"would overwrite {path}, which is read: name another", param_hint="--output")


@contextmanager
def progress_bar() -> Iterator[Callable[[str, float], None] | None]:
    """A callback (what is being done, share done) that draws a bar on standard error when that is a terminal."""
    if not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console
    from rich.progress import Progress

    with Progress(console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("", total=1.0)
        yield lambda text, share: bar.update(task, description=text, completed=share)


def json_text(value: Any) -> str:
    """A result as JSON."""
    return json.dumps(_plain(value), indent=2, ensure_ascii=False, allow_nan=False) + "\n"


def _plain(value: Any) -> Any:
    """The value as JSON can hold it: arrays as lists, and null where there is no finite number."""
    if hasattr(value, "tolist"):
        value = value.tolist()
    if isinstance(value, Mapping):
        return {str(key): _plain(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def print_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Columns, aligned."""
    widths = [max(len(row[i]) for row in [header, *rows]) for i in range(len(header))]
    for row in [header, *rows]:
        print("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip())


def print_paths(folder: Path, *names: str) -> None:
    """Where results lie, one a line."""
    print("\n" + "\n".join(str(folder / name) for name in names))
