"""What a campaign could tell apart, as rows of a table and in words."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING

from gyromodel.report._numbers import unit_text

if TYPE_CHECKING:
    from gyromodel.diagnosis import Isolability, Size

# Effects that are told of each test, and how many times smaller they must be seen than before.
TOLD, WORTHWHILE = 3, 1.5


def isolability_rows(found: Isolability) -> list[tuple[str, ...]]:
    """Rows of a table: effect, size found, closest other effect, size told apart from it, unit."""
    rows = []
    for name, size in found.detectable.items():
        rival, apart = found.closest(name) or ("–", size)
        rows.append((name, _digits(size), rival, _digits(max(apart, size)), unit_text(size.unit)))
    return rows


def parted_words(found: Isolability, after: Mapping[tuple[str, str], Size]) -> str:
    """The effects that a test helps most to tell from all others, with the sizes before and after."""
    helped = []
    for name in dict.fromkeys(effect for effect, _ in after):
        before, now = found.closest(name), found.closest(name, after)
        if not now or not math.isfinite(now[1].value):
            continue
        at, unit = f"{name} at {_digits(now[1])}", unit_text(now[1].unit)
        if name not in found.detectable:
            helped.append((1.0, f"{at} {unit}".rstrip() + ", which the campaign does not show"))
        elif before and before[1].value > WORTHWHILE * now[1].value:
            helped.append((now[1].value / before[1].value, f"{at} instead of {_digits(before[1])} {unit}".rstrip()))
    said = [text for _, text in sorted(helped)[:TOLD]]
    return f"It tells from all others {'; '.join(said)}." if said else "It helps with single pairs only."


def _digits(size: Size) -> str:
    return f"{size.value:.2g}" if math.isfinite(size.value) else "never"
