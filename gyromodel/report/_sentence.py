"""The verdict in one sentence that a non-specialist can read."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import TYPE_CHECKING

from gyromodel.report._numbers import number, pair, stated, unit_text, with_uncertainty
from gyromodel.report._words import definite, driven, driver_columns, is_driver, listed, phrase, spoken

if TYPE_CHECKING:
    from gyromodel.diagnosis._result import Cause, Diagnosis, ParameterValue
    from gyromodel.estimate._calibration import ParameterRow

# Share of the posterior from which on a name has no rival (`diagnosis`).
CREDIBLE = 0.95
Held = dict[str, "ParameterRow"]


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
    return f"{_lacks(diagnosis, diagnosis.causes)}; {_gain(diagnosis, _pronoun(diagnosis))}."


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


def held(diagnosis: Diagnosis, effect: str) -> Held:
    """The parameters of an effect that the simulation has with all of them fixed, by name; none of any other.

    Of several causes of one name it is not known which of them it is.
    """
    rows = [row for row in diagnosis.baseline.table() if row.effect == effect]
    once = sum(cause.effect == effect for cause in diagnosis.causes) < 2
    return {row.name: row for row in rows} if once and all(row.std == 0.0 for row in rows) else {}


def member(diagnosis: Diagnosis, name: str, kind: str) -> str:
    """One of the names that cannot be told apart, in words."""
    return phrase(name, kind) + (" other than the simulation's" if held(diagnosis, name) else "")


def followed(diagnosis: Diagnosis) -> list[str]:
    """The columns of the driver that an unknown discrepancy follows; none without one."""
    driver = diagnosis.driver
    return [] if driver is None else driver_columns(driver.column, diagnosis.campaign.columns)


def searched(diagnosis: Diagnosis) -> list[str]:
    """What was searched, less what the simulation has already and of which no more was looked for."""
    more = {*diagnosis.minimum_detectable, *(cause.effect for cause in diagnosis.causes)}
    had = {row.effect for row in diagnosis.baseline.table()} - more
    return [name for name in dict.fromkeys([*diagnosis.searched, *diagnosis.minimum_detectable]) if name not in had]


def gave_up(diagnosis: Diagnosis) -> bool:
    """Whether single samples or dwells were given up as gross errors."""
    return any(step.added == "outliers" for step in diagnosis.rounds)


def _adequate(diagnosis: Diagnosis) -> str:
    names = searched(diagnosis)
    drivers = [name for name in names if is_driver(name)]
    tried = len(names) - len(drivers)
    smooth = f" and smooth functions of {len(drivers)} drivers" if drivers else ""
    but = "but for gross errors that were given up, none" if gave_up(diagnosis) else "none"
    count = f": {tried} effects{smooth} were searched and {but} stands out from the noise" if tried else ""
    error = diagnosis.gain.before
    left = ""
    if math.isfinite(error):
        left = f"; the simulation's error on data not used is {number(error)} {unit_text(diagnosis.gain.unit)}"
    return f"Nothing is missing that this campaign could show{count}{left}."


def _ambiguous(diagnosis: Diagnosis) -> str:
    kind = kinds(diagnosis)
    firm = settled(diagnosis)
    members = listed([member(diagnosis, name, kind.get(name, "effect")) for name in confused(diagnosis)], "or")
    lead = "Something real is missing from your simulation, but this campaign cannot tell what it is"
    if firm:
        lead = f"{_lacks(diagnosis, firm)}, and something more is missing that this campaign cannot tell apart"
    test = (diagnosis.next_test or "").strip().rstrip(".")
    settle = f". The test that settles it: {test}" if test else ", and no single added test was found to settle it"
    return f"{lead}: {members}; {_gain(diagnosis, 'with any of these')}{settle}."


def _unknown(diagnosis: Diagnosis) -> str:
    follows = "follows no single column that was recorded"
    if diagnosis.driver is not None:
        follows = f"follows {listed([driven(column) for column in followed(diagnosis)])}"
    elif "bias_periodic" in diagnosis.credible_set:
        follows = "oscillates with a size or a frequency that changes,"
    lead = f"Something real is missing from your simulation: its error {follows} and matches nothing in the catalogue"
    effects = [cause for cause in diagnosis.causes if cause.effect != "outliers"]
    # What shows beside any function of the driver is no part of it.
    shown = {after.added for step, after in pairwise(diagnosis.rounds) if step.beside}
    besides = [cause for cause in effects if cause.effect in shown]
    if apart := [cause for cause in besides if cause.posterior >= CREDIBLE]:
        lead += f"; whatever that is, there is {_sized(diagnosis, apart)} besides"
    if doubtful := [cause for cause in besides if cause not in apart]:
        lead += f"; besides there may be {_sized(diagnosis, doubtful)}, or what is much like it"
    if within := [cause for cause in effects if cause not in besides]:
        lead += f", though {_sized(diagnosis, within)} would take up part of it"
    curve = "with the curve that was found" if diagnosis.driver else "with what was found"
    return f"{lead}; {_gain(diagnosis, 'with what has a name' if besides else curve)}."


def _pronoun(diagnosis: Diagnosis) -> str:
    causes = diagnosis.causes
    if all(cause.effect == "outliers" for cause in causes):
        return "with them set aside" if sum(len(c.parameters or c.points) for c in causes) != 1 else "with it set aside"
    if all(held(diagnosis, cause.effect) for cause in causes):
        return "with these" if len(causes) > 1 else "with that"
    return "with them" if len(causes) > 1 else "with it"


def _lacks(diagnosis: Diagnosis, causes: Sequence[Cause]) -> str:
    """The effects that are missing, those held at wrong values, then the measured points that no effect explains."""
    effects = [cause for cause in causes if cause.effect != "outliers"]
    missing = [cause for cause in effects if not held(diagnosis, cause.effect)]
    wrong = [_contradicted(cause, at) for cause in effects if (at := held(diagnosis, cause.effect))]
    said = [f"lacks {_sized(diagnosis, missing)}"] if missing else []
    said += [f"holds {', and '.join(wrong)}"] if wrong else []
    if len(effects) < len(causes):
        those = [cause for cause in causes if cause.effect == "outliers"]
        rows, apart = sum(len(c.points) for c in those), sum(len(c.parameters or c.points) for c in those)
        kind = "dwell" if apart < rows else "point"
        what = f"{kind}, which stands" if apart == 1 else f"{kind}s, which stand"
        said.append(f"cannot explain {apart or 'some'} measured {what} apart from all the others")
    return f"Your simulation {', and '.join(said)}" if said else "Something real is missing from your simulation"


def _contradicted(cause: Cause, at: Held) -> str:
    """An effect that the simulation holds at other values than the data say."""
    sizes = [p for p in _sizes(cause) if p.name in at]
    if not sizes:
        return f"{definite(cause.effect)} at values that the data contradict"
    return f"{definite(cause.effect)} at {_as_held(sizes, at)}, where the data say {_values(sizes)}"


def _sized(diagnosis: Diagnosis, effects: Sequence[Cause]) -> str:
    """Effects with their sizes, in a list."""
    items = [_with_size(cause, held(diagnosis, cause.effect)) for cause in effects]
    if len(items) > 1 and any(len(cause.parameters) > 1 for cause in effects):
        return f"{'; '.join(items[:-1])}; and {items[-1]}"
    return listed(items)


def _with_size(cause: Cause, at: Held) -> str:
    """The cause with its size, in place of the one that the simulation holds it at."""
    sizes = _sizes(cause)
    if at:
        sizes = [p for p in sizes if p.name in at]
        other = f"{_values(sizes)} instead of {_as_held(sizes, at)}" if sizes else "other values"
        return f"{definite(cause.effect)} at {other}"
    if cause.effect == "quantisation" and cause.parameters:
        step = cause.parameters[0]
        return f"{phrase(cause.effect)} in steps of {stated(step.value, step.unit)}"
    if cause.effect == "scale_factor" and len(sizes) == 1:
        if sizes[0].unit != "1":
            return f"a scale factor of {_values(sizes)}"
        error, std = 1e6 * (sizes[0].value - 1.0), 1e6 * sizes[0].std
        return f"{phrase(cause.effect)} of {with_uncertainty(error, std, 'ppm')}"
    return " ".join([phrase(cause.effect), *(["of" if len(sizes) == 1 else "with", _values(sizes)] if sizes else [])])


def _sizes(cause: Cause) -> list[ParameterValue]:
    """The parameters that tell a cause's size; of many the one coefficient or delay, if there is one."""
    sizes = [p for p in cause.parameters if math.isfinite(p.value) and p.std != 0.0]
    if any("[" in p.name for p in sizes):
        return [p for p in sizes if p.name in ("coefficient", "time_constant")]
    return sizes


def _values(sizes: Sequence[ParameterValue]) -> str:
    return _each([with_uncertainty(p.value, p.std, p.unit) for p in sizes], sizes)


def _as_held(sizes: Sequence[ParameterValue], at: Held) -> str:
    return _each([stated(at[p.name].value, at[p.name].unit) for p in sizes], sizes)


def _each(values: Sequence[str], sizes: Sequence[ParameterValue]) -> str:
    """One value alone, or several with their names."""
    if len(values) == 1:
        return values[0]
    return listed([f"{spoken(p.name)} {value}" for p, value in zip(sizes, values, strict=True)])


def _gain(diagnosis: Diagnosis, extension: str) -> str:
    """How the error on held-out data moved, and whether that is more than its own scatter."""
    gain = diagnosis.gain
    if gain.scheme == "not measured":
        return "the gain on data not used was not measured"
    if not (math.isfinite(gain.before) and math.isfinite(gain.after)):
        return "the gain on data not used was not measured, as no two blocks can be left out and predicted"
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
    moves = f"the error on data not used goes from {before} to {after} {unit}, within its own scatter"
    if math.isfinite(gain.log_score_ci95[0]) and gain.log_score_ci95[0] > 0.0:
        return f"{extension} {moves}, but the spread of those data is clearly better predicted"
    return f"{extension} {moves}"
