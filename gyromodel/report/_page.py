"""The page: tables and figures of a diagnosis, filled into the packaged template."""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gyromodel._atomic import write_text
from gyromodel.report._numbers import count, number, pair, unit_text
from gyromodel.report._sentence import confused, gave_up, held, kinds, member, sentence
from gyromodel.report._tables import (
    cause_row,
    evidence,
    gain,
    ladder,
    nearest,
    noise,
    noise_kinds,
    noise_of,
    parameters,
    rankings,
    searched_rows,
    threshold,
)
from gyromodel.report._template import filled
from gyromodel.report._words import driver_name, title

if TYPE_CHECKING:
    from gyromodel.campaign import Campaign
    from gyromodel.diagnosis._result import Diagnosis

_BADGES = {
    "adequate": "Nothing missing",
    "named": "Cause named",
    "ambiguous": "Cause ambiguous",
    "unknown": "Cause unknown",
}


def write_report(diagnosis: Diagnosis, folder: str | os.PathLike[str]) -> list[Path]:
    """Write report.html, which needs no other file, and its figures as SVG under figures/, in place of older ones.

    Args:
        diagnosis: what `gyromodel.diagnose` returned.
        folder: where; made if missing.

    Returns:
        The files written, report.html first.

    Raises:
        OSError: where the folder cannot be written.
    """
    from gyromodel.report._figures import FIGURES, figures

    folder = Path(folder)
    drawn = figures(diagnosis)
    page = rendered(diagnosis, drawn)
    (folder / "figures").mkdir(parents=True, exist_ok=True)
    written = []
    for figure in drawn.all():
        path = folder / "figures" / f"{figure.name}.svg"
        write_text(path, figure.svg)
        written.append(path)
    for pattern in FIGURES:
        for stale in set((folder / "figures").glob(f"{pattern}.svg")) - set(written):
            stale.unlink()
    write_text(folder / "report.html", page)
    return [folder / "report.html", *written]


def rendered(diagnosis: Diagnosis, drawn: Any) -> str:
    """The page as text."""
    return filled("template.html", context(diagnosis) | {"figures": drawn})


def context(diagnosis: Diagnosis) -> dict[str, Any]:
    """Everything the template prints, as text and shares of a full bar."""
    kind = kinds(diagnosis)
    return {
        "verdict": diagnosis.verdict,
        "badge": _BADGES[diagnosis.verdict],
        "sentence": sentence(diagnosis),
        "campaign": diagnosis.campaign.name,
        "facts": _facts(diagnosis),
        "tiles": _tiles(diagnosis),
        "causes": [cause_row(cause, held(diagnosis, cause.effect)) for cause in diagnosis.causes],
        "confused": [member(diagnosis, name, kind.get(name, "effect")) for name in confused(diagnosis)],
        "rankings": rankings(diagnosis),
        "ladder": ladder(diagnosis),
        "gain": gain(diagnosis),
        "nearest": nearest(diagnosis),
        "noise": noise(diagnosis.noise, noise_of(diagnosis)),
        "noise_kinds": noise_kinds(diagnosis),
        "credible": [
            {
                "title": title(name, kind.get(name, "effect")),
                "id": name if kind.get(name, "effect") in ("effect", "noise") else "",
                "share": share,
            }
            for name, share in sorted(diagnosis.credible_set.items(), key=lambda item: -item[1])
        ],
        "unexplained": [
            {"title": driver_name(name, diagnosis.campaign.columns).capitalize(), "share": share}
            for name, share in sorted(diagnosis.unexplained.items(), key=lambda item: -item[1])
        ],
        "searched": searched_rows(diagnosis),
        "not_testable": [
            {"title": title(name), "id": name, "reason": reason} for name, reason in diagnosis.not_testable.items()
        ],
        "findings": [text[:1].upper() + text[1:] for text in diagnosis.findings],
        "next_test": diagnosis.next_test,
        "parameters": parameters(diagnosis),
        "platform": _of_platform(diagnosis),
        "threshold": threshold(diagnosis),
        "rate_unit": unit_text(diagnosis.rate_unit),
    }


def _facts(diagnosis: Diagnosis) -> list[str]:
    """What was measured, in a line."""
    campaign = diagnosis.campaign
    rows = len(next(iter(campaign.columns.values())))
    said = {key: campaign.metadata[key] for key in ("gyro", "serial", "test") if key in campaign.metadata}
    # The runs of a platform's log are shown one after another, with pauses that are none of its own.
    gaps = "" if _of_platform(diagnosis) else _gaps(campaign)
    return [*(f"{key} {value}" for key, value in said.items()), f"{count(rows)} samples{gaps}"]


def _of_platform(diagnosis: Diagnosis) -> bool:
    return diagnosis.extended.model.domain == "platform"


def _gaps(campaign: Campaign) -> str:
    """How many gaps lie between the samples, of each of several campaigns, and the longest."""
    number_of = campaign.columns.get("campaign")
    each = [campaign] if number_of is None else [campaign.select(number_of == k) for k in {*number_of.tolist()}]
    lengths = [length for part in each for _, length in part.gaps()]
    if not lengths:
        return ""
    longest = max(lengths)
    size = f"{number(longest / 3600.0, 3)} h" if longest > 7200.0 else f"{number(longest, 3)} s"
    told = f"{count(len(lengths))} gaps, the longest" if len(lengths) > 1 else "a gap of"
    return f" with {told} {size}"


def _tiles(diagnosis: Diagnosis) -> list[dict[str, str]]:
    """The few numbers that carry the verdict."""
    gain = diagnosis.gain
    before, after = pair(gain.before, gain.after)
    unit = unit_text(gain.unit)
    tiles = []
    if math.isfinite(gain.before):
        changed = math.isfinite(gain.after) and before != after
        shown = _arrow(before, after) if changed else number(gain.before)
        note = "root mean square, held out"
        tiles.append({"label": "Error on data not used", "value": f"{shown} {unit}", "note": note})
    if math.isfinite(gain.ratio) and gain.after != gain.before:
        low, high = gain.ci95
        note = f"95 % interval {number(low, 3)} to {number(high, 3)}"
        tiles.append({"label": "Error before ÷ after", "value": f"{number(gain.ratio, 3)}", "note": note})
    # Gross errors that were given up say nothing of the simulation.
    aside = diagnosis.verdict == "adequate" and gave_up(diagnosis)
    best = max((r.statistic for r in diagnosis.rounds if r.added and not aside), default=None)
    # Noise needs more than a calibrated bound, which is of effects.
    ranked = [c for r in diagnosis.rounds[-1 if aside else 0 :][:1] for c in r.ranking]
    top = [c.statistic for c in ranked if c.kind != "noise" or diagnosis.threshold_kind == "safe"]
    if best is None and top:
        best = max(top)
    if best is not None:
        note = f"needed: {number(diagnosis.threshold, 2)}"
        tiles.append({"label": "Strongest evidence (ln)", "value": evidence(best), "note": note})
    return tiles


def _arrow(before: str, after: str) -> str:
    """Two numbers with an arrow between, their common power of ten taken out."""
    (first, _, power), (second, _, other) = before.partition("e"), after.partition("e")
    return f"({first} → {second})e{power}" if power and power == other else f"{before} → {after}"
