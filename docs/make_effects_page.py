"""Write docs/effects.md, the catalogue page, from the effects' own declarations.

python docs/make_effects_page.py
"""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

from gyromodel.declarations import NOISE, Declaration, ParameterDeclaration, declarations

PAGE = Path(__file__).with_name("effects.md")
SITES = {
    "gain": "The gain itself",
    "scale": "Terms of the scale-factor error ε",
    "rate": "Terms added to the input rate: bias, and what drives it",
    "output": "Terms added to what all others come to",
    "readout": "How the output is read, noise and all",
    "angle": "Of a platform's vibration test: terms of the base's angle less that of the table",
}
HEAD = """# The effect catalogue

This page is generated from the code by `python docs/make_effects_page.py`. Effect names are those of model files,
reports and JSON; `gyromodel effects ID` prints one entry in the terminal.

    output = gain · (u + output terms) + noise, u = (rate + Σ rate terms) · (1 + Σ scale terms)

of a gyro, and of a stabilised platform on a vibration table

    angle of the base − angle of the table = Σ angle terms + noise

Parameters stand in the unit that files and reports use. "Typical" is a usual size; an amplitude starts at zero, which
is exactly the model without the effect. The model is linear in all parameters but those marked *nonlinear*.

A model file states, besides, what shapes an effect and is not fitted: `reference` is the T0, X0, B0 or N0 of an
equation, the campaign's mean where it is not given; others are explained with their effects.

Scale terms multiply the bias as they do the rate. Of an analog gyro whose output at rest is a null voltage, many deg/s
as a bias, a scale factor that changes with temperature therefore moves the output at rest too, and `bias_temperature`
is what that leaves, if need be of the other sign. Take the null voltage from the output first where the two are to be
told apart.
"""


def page() -> str:
    """The whole page as Markdown."""
    catalogue = declarations().values()
    parts = [HEAD, _summary(catalogue)]
    for site, title in SITES.items():
        parts.append(f"## {title}\n")
        parts += [_entry(entry) for entry in catalogue if entry.site == site]
    parts.append(_noise())
    return "\n".join(parts)


def _summary(catalogue: Collection[Declaration]) -> str:
    rows = [[f"[`{e.id}`](#{e.id})", e.site, _needs(e), e.equation] for e in catalogue]
    return _table(["effect", "acts on", "needs", "equation"], rows)


def _needs(entry: Declaration) -> str:
    return ", ".join(f"`{name}`" for name in entry.needs) or "–"


def _entry(entry: Declaration) -> str:
    text = [f"### {entry.id}\n", f"{_plain(entry.equation)}\n"]
    if entry.details:
        text.append(f"{_plain(entry.details)}\n")
    text += [f"- needs: {_needs(entry)}", f"- cause: {entry.cause}", f"- test that separates it: {entry.test}\n"]
    rows = [[f"`{p.name}`", _unit(entry, p), f"{p.typical:g}", _meaning(p)] for p in entry.parameters]
    return "\n".join([*text, _table(["parameter", "unit", "typical", "meaning"], rows)])


def _unit(entry: Declaration, parameter: ParameterDeclaration) -> str:
    if entry.site == "gain":
        return "the output's, per deg/s"
    if entry.site == "readout":
        return "the output's"
    return "–" if parameter.unit == "1" else parameter.unit


def _meaning(parameter: ParameterDeclaration) -> str:
    return parameter.meaning if parameter.linear else f"{parameter.meaning} (*nonlinear*)"


def _noise() -> str:
    rows = [
        [f"`{k.id}`", k.unit, "–" if k.typical is None else f"{k.typical:g}", k.density, k.allan_variance, k.meaning]
        for k in NOISE.values()
    ]
    table = _table(["noise", "unit", "typical", "rate PSD, two-sided", "Allan variance", "meaning"], rows)
    told = _table(
        ["noise", "cause", "test that separates it"], [[f"`{k.id}`", k.cause, k.test] for k in NOISE.values()]
    )
    return f"## Noise\n\n{table}\n{told}\nKinds that are not stated in model files are told of by `diagnose`.\n"


def _table(head: list[str], rows: list[list[str]]) -> str:
    cells = [head, ["---"] * len(head), *([_plain(cell).replace("|", "\\|") for cell in row] for row in rows)]
    return "\n".join(f"| {' | '.join(row)} |" for row in cells) + "\n"


def _plain(text: str) -> str:
    """Text whose angle brackets are no HTML; between backticks they never are."""
    return "`".join(part if i % 2 else part.replace("<", "&lt;") for i, part in enumerate(text.split("`")))


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
