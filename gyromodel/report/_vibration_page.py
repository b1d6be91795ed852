"""A vibration test as one page that needs no other file."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from gyromodel.platform import EXCLUDED, parameters
from gyromodel.report._numbers import number, with_uncertainty
from gyromodel.report._template import filled
from gyromodel.report._vibration_words import explained, notes, vibration_sentence, vibration_words

if TYPE_CHECKING:
    from gyromodel.platform import VibrationTest

# Explanations in the table.
_ROWS = 8
# What each figure shows, and what it is to be read by.
_CAPTIONS = {
    "attitude": (
        "Angle of the table and of the base over time, and their difference",
        "Of each axis the slowest run of some periods: the table's angle, the base's by navigation and gimbals, "
        "and below, on a scale of its own, what the base has more.",
    ),
    "responses": (
        "Amplitude ratio and phase over frequency with the published limits",
        "95 % intervals. Lines are the first explanation, about the axes that it explains.",
    ),
    "explanations": (
        "The first explanations over frequency, axis by axis",
        "Where curves part, a further run would tell them apart. Points without a curve are not explained by it.",
    ),
    "loop": (
        "Open loop over frequency with its margins",
        "The loop of the first explanation. What is not fitted of it is assumed.",
    ),
}


def vibration_page(test: VibrationTest, figures: Mapping[str, str], campaign: str) -> str:
    """The page: a sentence, figures (SVG by name), responses, explanations, the next test, and what was noticed."""
    words = vibration_words(test)
    verdict, badge = ("unknown", "Too few runs") if test.few else ("unknown", "Not explained")
    if test.firm:
        verdict, badge = "named", "Explained"
    elif len(test.supported) > 1 and test.scatter_stated and test.held:
        verdict, badge = "ambiguous", "Several explanations"
    told = explained(test)
    return filled(
        "vibration.html",
        {
            "badge": badge,
            "verdict": verdict,
            "sentence": vibration_sentence(test),
            "campaign": campaign,
            "facts": "rates of the platform integrated" if test.integrated else "platform taken to be still",
            "runs": words.runs,
            "notes": notes(test),
            "rows": _rows(test),
            "lead": told.lead,
            "lines": told.rest,
            "next_test": told.next,
            "findings": test.remarks,
            "figures": figures,
            "captions": _CAPTIONS,
        },
    )


def _rows(test: VibrationTest) -> list[dict[str, Any]]:
    best = min((e.criterion for e in test.explanations.values()), default=0.0)
    rest = [name for name in test.explanations if name not in test.possible]
    rows = []
    for name in [*test.possible, *rest][:_ROWS]:
        e = test.explanations[name]
        excluded = test.scatter_stated and e.probability < EXCLUDED
        verdict = "excluded" if excluded else "not needed, undetermined or less likely"
        if name in test.possible:
            verdict = "supported" if test.firm else "possible"
        rows.append(
            {
                "name": name,
                "verdict": verdict,
                "chosen": name in test.possible,
                "criterion": f"{e.criterion - best:.1f}",
                "probability": number(e.probability) if test.scatter_stated else "–",
                "numbers": [f"{row.name} {with_uncertainty(row.value, row.std, row.unit)}" for row in parameters(e)],
            }
        )
    return rows
