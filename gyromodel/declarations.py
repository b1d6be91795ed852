"""The effect catalogue as plain data, read from the source text of `gyromodel/effects` without importing JAX.

An effect declares everything a reader wants to know as literals (class attributes, the docstring, `parameter` calls),
so listing the catalogue needs a parser only. The tests hold it equal to the imported catalogue.
"""

from __future__ import annotations

import ast
import inspect
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

# What the search derives of a column: its rate of change, and its value some time before. No column bears / or [.
RATE_OF, EARLIER, BEHIND = "d({})/dt", "{}[earlier]", "{}[behind]"
_DERIVED_OF = {
    RATE_OF: re.compile(r"d\((.+)\)/dt"),
    EARLIER: re.compile(r"(.+)\[earlier\]"),
    BEHIND: re.compile(r"(.+)\[behind\]"),
}
FOLDER = Path(__file__).parent / "effects"


@dataclass(frozen=True)
class ParameterDeclaration:
    """One parameter: its unit in files, usual size in that unit, and meaning."""

    name: str
    unit: str
    typical: float
    meaning: str
    linear: bool = True


@dataclass(frozen=True)
class Declaration:
    """One catalogue entry; `equation` is the first line of the docstring and `details` the rest."""

    id: str
    site: str
    domain: str
    equation: str
    details: str
    parameters: tuple[ParameterDeclaration, ...]
    needs: tuple[str, ...]
    cause: str
    test: str


@dataclass(frozen=True)
class NoiseKind:
    """A kind of noise by its public id.

    Unit and typical size (none of what has no size), two-sided power spectral density of the rate, Allan variance,
    meaning, physical cause, and the test that tells it from what looks like it.
    """

    id: str
    unit: str
    typical: float | None
    density: str
    allan_variance: str
    meaning: str
    cause: str
    test: str


NOISE = {
    kind.id: kind
    for kind in (
        NoiseKind(
            "noise_white", "deg/sqrt(h)", 0.01, "N²", "N²/τ", "angle random walk",
            "Shot noise of the light, and noise of the detector and its electronics.",
            "Log at rest: the Allan deviation falls as 1/√τ; that of quantisation falls as 1/τ.",
        ),
        NoiseKind(
            "noise_flicker", "deg/h", 0.01, "B²/(2πf)", "(2 ln2/π) B²", "bias instability",
            "Electronics and light source fluctuate at all time scales alike.",
            "A longer log at rest: the Allan deviation stays level; that of a random walk rises.",
        ),
        NoiseKind(
            "noise_random_walk", "deg/h/sqrt(h)", 0.01, "K²/(2πf)²", "K² τ/3", "rate random walk",
            "Small lasting changes inside add up.",
            "Repeat the run: a drift, a warm-up or a step at power-on comes back, a random walk does not.",
        ),
        NoiseKind(
            "noise_markov", "deg/h/sqrt(h)", 0.1, "(q T)²/(1 + (2πf T)²)", "peak (0.437 q)² T at 1.89 T",
            "a first-order Markov process; stated with its time_constant T, and not beside noise_flicker",
            "Something that is drawn back, as a controlled temperature, fluctuates and forgets in a time T.",
            "A log of many T: the Allan deviation peaks and falls again; that of a random walk goes on rising.",
        ),
        NoiseKind(
            "noise_quantisation", "arcsec", 1.0, "(2πf)² Q² τ0", "3 Q²/τ²", "white noise of the angle",
            "The angle is counted in whole steps.",
            "Read the angle in finer steps: what falls with them is quantisation.",
        ),
        NoiseKind(
            "noise_telegraph", "deg/h", 0.1, "–", "–",
            "hops of the bias between two levels, stated with their mean times time_low and time_high",
            "A laser hops between two modes, or a component has popcorn noise.",
            "Log the laser current beside: hops of modes come with it; what switches nearby keeps a regular pace.",
        ),
        NoiseKind(
            "noise_heteroscedastic", "1", 2.0, "–", "–", "σ at one end of what it follows over σ at the other",
            "Its source grows with the rate (a table's motion) or with the temperature (less light, more current).",
            "Log at rest at several temperatures, and at several rates at one temperature.",
        ),
        NoiseKind(
            "noise_rate_ramp", "deg/h/h", 0.01, "–", "R² τ²/2",
            "a trend of a gyro at rest, as `allan` tells it; `diagnose` names it bias_drift; not stated",
            "Ageing, or a temperature that goes one way.",
            "Repeat the run: a trend comes back or goes on, a random walk does neither.",
        ),
        NoiseKind(
            "outliers", "–", None, "–", "–", "gross errors in single samples, test points or dwells; not stated",
            "A knock, a lost or late sample, or a test point that was set wrong.",
            "Repeat the point: a curve comes back, a gross error does not.",
        ),
    )
}  # fmt: skip


def declarations() -> dict[str, Declaration]:
    """The catalogue by effect id, in the order of the source files."""
    classes = {}
    for path in sorted(FOLDER.glob("*.py")):
        tree = ast.parse(path.read_text(encoding="utf-8"), str(path))
        classes |= {node.name: node for node in tree.body if isinstance(node, ast.ClassDef)}
    found = [_declaration(node, classes) for node in classes.values() if "id" in _literals(node)]
    return {entry.id: entry for entry in found}


def _declaration(node: ast.ClassDef, classes: dict[str, ast.ClassDef]) -> Declaration:
    literals: dict[str, Any] = {}
    parameters: dict[str, ParameterDeclaration] = {}
    for cls in _ancestry(node, classes):
        literals |= _literals(cls)
        parameters |= _parameters(cls)
    equation, _, details = inspect.cleandoc(ast.get_docstring(node) or "").partition("\n")
    return Declaration(
        id=literals["id"],
        site=literals["site"],
        domain=literals.get("domain", "gyro"),
        equation=equation.strip(),
        details=details.strip(),
        parameters=tuple(parameters.values()),
        needs=tuple(literals["needs"]),
        cause=literals["cause"],
        test=literals["test"],
    )


def _ancestry(node: ast.ClassDef, classes: dict[str, ast.ClassDef]) -> list[ast.ClassDef]:
    """The class and its bases within the folder, bases first, as attributes are inherited."""
    bases = [classes[base.id] for base in node.bases if isinstance(base, ast.Name) and base.id in classes]
    return [ancestor for base in bases for ancestor in _ancestry(base, classes)] + [node]


def _assignments(node: ast.ClassDef) -> dict[str, ast.expr]:
    found = {}
    for statement in node.body:
        if isinstance(statement, ast.Assign) and isinstance(statement.targets[0], ast.Name):
            found[statement.targets[0].id] = statement.value
        elif isinstance(statement, ast.AnnAssign) and isinstance(statement.target, ast.Name) and statement.value:
            found[statement.target.id] = statement.value
    return found


def _literals(node: ast.ClassDef) -> dict[str, Any]:
    wanted = {"id", "site", "domain", "needs", "cause", "test"}
    return {name: ast.literal_eval(value) for name, value in _assignments(node).items() if name in wanted}


def _parameters(node: ast.ClassDef) -> dict[str, ParameterDeclaration]:
    found = {}
    for name, value in _assignments(node).items():
        if isinstance(value, ast.Call) and isinstance(value.func, ast.Name) and value.func.id == "parameter":
            unit, typical, meaning = (ast.literal_eval(argument) for argument in value.args)
            linear = next((ast.literal_eval(k.value) for k in value.keywords if k.arg == "linear"), True)
            found[name] = ParameterDeclaration(name, unit, float(typical), meaning, linear)
    return found


def column_of(label: str) -> str:
    """The column that a linear driver's id names: bias_<column>, or bias_column_<column>."""
    return label.removeprefix("bias_").removeprefix("column_")


def measured(column: str) -> tuple[str, str]:
    """The measured column of a driver's, and what it is of it: one of `_DERIVED_OF`, or empty if the same."""
    found = ((m[1], form) for form, pattern in _DERIVED_OF.items() if (m := pattern.fullmatch(column)))
    return next(found, (column, ""))
