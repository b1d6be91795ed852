"""The catalogue of effects and kinds of noise, as the command `effects` finds and prints it."""

from __future__ import annotations

import sys
from dataclasses import asdict
from difflib import get_close_matches
from typing import Any

import typer

from gyromodel._console import print_table
from gyromodel.declarations import NOISE, declarations


def entries(name: str | None) -> list[dict[str, Any]]:
    """The whole catalogue as plain data, or the one entry of a name; bias_<column> is that of any column."""
    every = declarations() | NOISE
    if name is None:
        return [asdict(entry) for entry in every.values()]
    if name not in every:
        close = " or ".join(get_close_matches(name, every, n=3))
        if not name.removeprefix("bias_") or not name.startswith("bias_"):
            hint = f"; did you mean {close}?" if close else "; `gyromodel effects` lists them"
            raise typer.BadParameter(f"no effect is called {name}{hint}", param_hint="ID")
        hint = f"; or did you mean {close}?" if close else ""
        print(f"gyromodel: {name} is the bias of a column {name.removeprefix('bias_')}{hint}", file=sys.stderr)
        name = "bias_column"
    return [asdict(every[name])]


def print_catalogue(found: list[dict[str, Any]]) -> None:
    """A line for each entry."""
    rows = [
        (e["id"], "noise", "–", e["meaning"])
        if e["id"] in NOISE
        else (e["id"], e["site"], ", ".join(e["needs"]) or "–", e["equation"])
        for e in found
    ]
    print_table(("effect", "acts on", "needs", "equation"), rows)


def print_entry(entry: dict[str, Any]) -> None:
    """One entry, in full."""
    if entry["id"] in NOISE:
        shown = {name: "–" if value is None else value for name, value in entry.items()}
        print("\n".join(f"{name.replace('_', ' '):<15}{value}" for name, value in shown.items()))
        return
    print("\n".join(filter(None, [entry["id"], entry["equation"], entry["details"]])))
    needs = ", ".join(entry["needs"]) or "no column"
    print(f"\nacts on  {entry['site']}\nneeds    {needs}\ncause    {entry['cause']}\ntest     {entry['test']}\n")
    rows = [(p["name"], f"{p['typical']:g}", p["unit"], p["meaning"]) for p in entry["parameters"]]
    print_table(("parameter", "typical", "unit", "meaning"), rows)
