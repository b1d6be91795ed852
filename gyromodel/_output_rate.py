"""The output of a campaign as a rate: what increments and angles count, and where they start anew."""

from __future__ import annotations

import numpy as np

from gyromodel._checks import MISSING_STEP, CampaignError
from gyromodel.campaign import Campaign
from gyromodel.units import UnitError, convertible, factor, internal_unit, quantity

# A clock is regular if most steps differ by less than this part of the median one; the others are gaps.
IRREGULAR, MOST_REGULAR = 0.01, 0.9
# Bits of counters that start anew. Of the rows with an output, the share that may follow one without where an output
# counts from the row before.
COUNTERS, MOST_ALONE = (8, 10, 12, 14, 16, 18, 20, 24, 32), 0.5
# How much faster than elsewhere an angle may turn where it starts anew.
AS_BEFORE = 2.0


def rate_output(campaign: Campaign) -> tuple[np.ndarray, str]:
    """The output as a rate and its internal unit, whatever the campaign recorded."""
    if not campaign.outputs:
        raise CampaignError(f"{campaign.name}: is of a platform: `diagnose` and `platform.fit_vibration` take it")
    if "output" not in campaign.columns:
        axes = ", ".join(campaign.outputs)
        raise CampaignError(f"{campaign.name}: has outputs {axes}; choose one axis (--axis x, y or z)")
    output, unit = campaign.si("output"), internal_unit(campaign.units["output"])
    kind = campaign.metadata["kind"]
    if kind == "rate":
        return output, unit
    known = np.isfinite(output)
    if np.sum(known[1:] & ~known[:-1]) > MOST_ALONE * np.sum(known[1:]):
        raise CampaignError(
            f"{campaign.name}: most rows with an output follow one without, and an {kind} counts from the row before: "
            "leave out the rows between"
        )
    interval = np.diff(campaign.si("time"), prepend=np.nan)
    typical = np.median(interval[1:])
    if kind == "angle":
        turned = np.diff(output)[interval[1:] <= MISSING_STEP * typical]
        if (turn := _wraps_within(output, turned, unit)) is not None:
            raise CampaignError(f"{campaign.name}: the angle in 'output' wraps round within {turn}; unwrap it")
        output = np.diff(output, prepend=np.nan)
    # How long the first increment took is known only from a regular clock.
    if np.mean(np.abs(interval[1:] - typical) < IRREGULAR * typical) > MOST_REGULAR:
        interval[0] = typical
    # What was turned through during a gap is not known: the first increment behind one is missing.
    return np.where(interval > MISSING_STEP * typical, np.nan, output / interval), f"{unit}/s"


def _wraps_within(angle: np.ndarray, turned: np.ndarray, unit: str) -> str | None:
    """What an angle starts anew after, in words; None where it does not.

    Args:
        angle: where it is known, and not finite elsewhere.
        turned: by how much it changes from sample to sample.
        unit: of both.
    """
    turns = {"one turn": 2 * np.pi} if unit == "rad" else {f"2^{bits} {unit}s": 2.0**bits for bits in COUNTERS}
    known, size = angle[np.isfinite(angle)], np.abs(turned[np.isfinite(turned)])
    reach = np.ptp(known) if len(known) else 0.0
    words, turn = next(((w, t) for w, t in turns.items() if reach <= t), ("", np.inf))
    jumps, others = size[size > 0.5 * turn], size[size <= 0.5 * turn]
    # A counter that starts anew has been through all that it can show, and went on as it did before.
    passed = unit == "rad" or reach > 0.9 * turn
    on = np.abs(turn - jumps) <= AS_BEFORE * others.max(initial=0.0)
    return words if passed and on.any() else None


def rate_scale(stated: str, unit: str) -> float:
    """A nominal scale factor as output per rad/s; counts may leave out "per second" on either side.

    Raises:
        UnitError: it is zero, or no output over an angular rate.
    """
    value, own = quantity(stated)
    raw = unit.removesuffix("/s")
    for form in (unit, raw, f"{raw}/s") if raw in ("count", "bit") else (unit,):
        if value and convertible(f"({own})*rad/s", form):
            return value * factor(f"({own})*rad/s", form)
    raise UnitError(f"it is in [{own}]" if value else "it is zero")
