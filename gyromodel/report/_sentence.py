"""The verdict in one sentence that a non-specialist can read."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

from gyromodel.report._numbers import number, pair, unit_text, with_uncertainty
from gyromodel.report._words import driver_name, listed, phrase, spoken

if TYPE_CHECKING:
    from gyromodel.diagnosis._result import Cause, Diagnosis


def sentence(diagnosis: Diagnosis) -> str:
    """The verdict in plain words, with sizes, uncertainties, units and the held-out gain.

    Args:
        diagnosis: what `gyromodel.diagnose` returned.
    """
    match diagnosis.verdict:
        case "adequate":
            return _adequate(diagnosis)
        case "ambiguous":
            return _ambiguous(diagnosis)
        case "unknown":
            return _unknown(diagnosis)
    return f"{_lacks(diagnosis.causes)}; {_gain(diagnosis, _pronoun(diagnosis.causes))}."


def kinds(diagnosis: Diagnosis) -> dict[str, str]:
    """Whether each ranked name is an effect, a noise term or a driver."""
    return {candidate.effect: candidate.kind for step in diagnosis.rounds for candidate in step.ranking}


def confused(diagnosis: Diagnosis) -> list[str]:
    """The members of an ambiguous verdict's set, likeliest first."""
    share = {name: p for name, p in diagnosis.credible_set.items() if math.isfinite(p)}
    if len(share) > 1:
        return sorted(share, key=lambda name: -share[name])
    return [cause.effect for cause in diagnosis.causes]


def settled(diagnosis: Diagnosis) -> list[Cause]:
    """The causes that an ambiguous verdict leaves in no doubt."""
    doubtful = confused(diagnosis)
    return [cause for cause in diagnosis.causes if cause.effect not in doubtful]


def _adequate(diagnosis: Diagnosis) -> str:
    known = {row.effect for row in diagnosis.baseline.table()}
    drivers = [name for name in diagnosis.searched if name.startswith("smooth(")]
    tried = len(set(diagnosis.searched) - known) - len(drivers)
    smooth = f" and smooth functions of {len(drivers)} drivers" if drivers else ""
    count = f": {tried} effects{smooth} were searched and none stands out from the noise" if tried else ""
    error = diagnosis.gain.before
    left = ""
    if math.isfinite(error):
        left = f"; the simulation's error on data not used is {number(error)} {unit_text(diagnosis.gain.unit)}"
    return f"Nothing is missing that this campaign could show{count}{left}."


def _ambiguous(diagnosis: Diagnosis) -> str:
    kind = kinds(diagnosis)
    firm = settled(diagnosis)
    members = listed([phrase(name, kind.get(name, "effect")) for name in confused(diagnosis)], "or")
    lead = "Something real is missing from your simulation, but this campaign cannot tell what it is"
    if firm:
        lead = f"{_lacks(firm)}, and something more is missing that this campaign cannot tell apart"
    test = (diagnosis.next_test or "").strip().rstrip(".")
    settle = f". The test that settles it: {test}" if test else ", and no single added test was found to settle it"
    return f"{lead}: {members}; {_gain(diagnosis, 'with any of these')}{settle}."


def _unknown(diagnosis: Diagnosis) -> str:
    follows = "follows no single column that was recorded"
    if diagnosis.driver is not None:
        column = diagnosis.driver.column
        follows = f"follows {driver_name(column)}"
    elif "bias_periodic" in diagnosis.credible_set:
        follows = "oscillates with a size or a frequency that changes,"
    lead = f"Something real is missing from your simulation: its error {follows} and matches nothing in the catalogue"
    if effects := [cause for cause in diagnosis.causes if cause.effect != "outliers"]:
        lead += f", though {_sized(effects)} would take up part of it"
    gain = _gain(diagnosis, "with the curve that was found" if diagnosis.driver else "with what was found")
    return f"{lead}; {gain}."


def _pronoun(causes: Sequence[Cause]) -> str:
    if all(cause.effect == "outliers" for cause in causes):
        return "with them set aside" if sum(len(cause.points) for cause in causes) != 1 else "with it set aside"
    return "with them" if len(causes) > 1 else "with it"


def _lacks(causes: Sequence[Cause]) -> str:
    """The effects that are missing, then the measured points that no effect explains."""
    effects = [cause for cause in causes if cause.effect != "outliers"]
    apart = sum(len(cause.points) for cause in causes if cause.effect == "outliers")
    what = "point, which stands" if apart == 1 else "points, which stand"
    points = f"cannot explain {apart or 'some'} measured {what} apart from all the others"
    if not causes:
        return "Something real is missing from your simulation"
    if not effects:
        return f"Your simulation {points}"
    text = _sized(effects)
    if len(effects) < len(causes):
        text += f", and {points}"
    return f"Your simulation lacks {text}"


def _sized(effects: Sequence[Cause]) -> str:
    """Effects with their sizes, in a list."""
    items = [_with_size(cause) for cause in effects]
    if len(items) > 1 and any(len(cause.parameters) > 1 for cause in effects):
        return f"{'; '.join(items[:-1])}; and {items[-1]}"
    return listed(items)


def _with_size(cause: Cause) -> str:
    """The cause with its size; of many parameters with one coefficient or delay, if there is one."""
    values = [p for p in cause.parameters if math.isfinite(p.value) and p.std != 0.0]
    if any("[" in p.name for p in values):
        values = [p for p in values if p.name in ("coefficient", "time_constant")]
    if cause.effect == "scale_factor" and len(values) == 1:
        if values[0].unit != "1":
            return f"a scale factor of {with_uncertainty(values[0].value, values[0].std, values[0].unit)}"
        error, std = 1e6 * (values[0].value - 1.0), 1e6 * values[0].std
        return f"{phrase(cause.effect)} of {with_uncertainty(error, std, 'ppm')}"
    if len(values) == 1:
        return f"{phrase(cause.effect)} of {with_uncertainty(values[0].value, values[0].std, values[0].unit)}"
    sizes = [f"{spoken(p.name)} {with_uncertainty(p.value, p.std, p.unit)}" for p in values]
    return f"{phrase(cause.effect)} with {listed(sizes)}" if sizes else phrase(cause.effect)


def _gain(diagnosis: Diagnosis, extension: str) -> str:
    """How the error on held-out data moved, and whether that is more than its own scatter."""
    gain = diagnosis.gain
    if gain.scheme == "not measured":
        return "the gain on data not used was not measured"
    if not (math.isfinite(gain.before) and math.isfinite(gain.after)):
        return "the campaign is too short to measure the gain on data not used"
    before, after = pair(gain.before, gain.after)
    unit = unit_text(gain.unit)
    if gain.before == gain.after:
        if diagnosis.causes:
            return f"the error on data not used stays at {before} {unit}"
        return f"the model is left as it is, with an error on data not used of {before} {unit}"
    low, high = gain.ci95
    if low > 1.0:
        return f"{extension} the error on data not used falls from {before} to {after} {unit}"
    if high < 1.0:
        return f"{extension} the error on data not used rises from {before} to {after} {unit}"
    if math.isfinite(gain.log_score_ci95[0]) and gain.log_score_ci95[0] > 0.0:
        moves = f"the error on data not used hardly moves ({before} to {after} {unit})"
        return f"{extension} {moves}, but the spread of those data is clearly better predicted"
    return f"{extension} the error on data not used goes from {before} to {after} {unit}, within its own scatter"
