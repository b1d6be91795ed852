"""What the searches say in the end: the verdict with all that changes it, and the fits that are published."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from gyromodel.diagnosis._evidence import safe_threshold
from gyromodel.diagnosis._extended import finished, louder, stated_counts, stated_hops, stated_level
from gyromodel.diagnosis._isolation import settling_test
from gyromodel.diagnosis._judgement import Judgement, structured, undecided, with_noise, with_steps
from gyromodel.diagnosis._misfit import excess_band
from gyromodel.diagnosis._next_tests import test_of_driver
from gyromodel.diagnosis._noise_causes import quantisation
from gyromodel.diagnosis._points import dwells_apart
from gyromodel.diagnosis._searches import Searched, with_noise_estimated
from gyromodel.diagnosis._unseen import held_back
from gyromodel.diagnosis._variance import noise_level, tails
from gyromodel.diagnosis._verdict import FAINT, judge
from gyromodel.estimate import Estimate, with_reading
from gyromodel.model import effect_class

TURNED_ON = (
    "There seems to be a warm-up behind every gap, as if the gyro had been off: its time is counted from there. The "
    "model is applied to files whose column run tells power cycles apart."
)
TELL_RUNS = (
    "Number the power cycles in a column run; where the gyro was not off in the gaps, log the temperature at the coil."
)


class Conclusion(NamedTuple):
    """A judgement of some searches.

    Attributes:
        judgement: the verdict with everything that goes with it.
        baseline: the fitted simulation.
        extended: the fit with what was found.
        coarse: whether the steps in which the output is read show.
        ordinary: whether all samples count alike, in the simulation's fits and in the extended model's.
    """

    judgement: Judgement
    baseline: Estimate
    extended: Estimate
    coarse: bool
    ordinary: tuple[bool, bool]


def conclude(found: Searched, hold_out: bool) -> Conclusion:
    """Judge what was found; `hold_out` chooses the weights of samples by blocks left out."""
    session, selection, readings, rounding = found.session, found.selection, found.readings, found.rounding
    baseline, last, count = session.baseline, selection.estimate, len(session.scanner.bank.names())
    _remarks(found)
    alike = tuple(hold_out and session.ladder(e)[2] for e in (baseline, last))
    extended = finished(last, alike[1])
    ordinary = alike[0], extended.ordinary
    extended = readings.widened(found.record, extended, rounding)
    if extended.ordinary:
        found.findings.append(
            "Parameters weigh all samples alike: that predicts left-out blocks better than the fitted noise's weights "
            "do."
        )
    read_so = readings.same_as(found.reading)
    rows_of, saw_tooth = found.data.rows_of, rounding.saw_tooth
    judgement = judge(session.steps, selection, extended, count, found.nulls, rows_of, saw_tooth, read_so)
    # What follows itself at one end of a column has structure, whatever faint name takes a part of it.
    grows = found.grows
    if found.following and grows and all(c.statistic < FAINT for c in judgement.causes if c.effect != "outliers"):
        judgement = structured(judgement, selection.last, grows.column)
    counts = _counts(found)
    # Where the simulation leaves its noise to be estimated, its kinds are no discrepancy, but for what no fit holds.
    kinds = found.noise if baseline.noise_given else [c for c in found.noise if c is found.hops]
    judgement = with_noise(judgement, kinds, count)
    coarse = rounding.changed or rounding.stuck or readings.coarse_beside(found.record, extended)
    if readings.untested and saw_tooth:
        found.findings.append(
            "Campaigns are read in steps of their own: what is smaller than the coarsest may be rounding."
        )
    if found.reading and readings.unit and not readings.untested and not read_so:
        found.findings.append("The output is not read in the steps that the simulation states.")
    if coarse and not read_so:
        judgement = with_steps(judgement, readings.as_cause(int(session.record.present.sum())))
    found.findings += [readings.told(rounding)] if coarse else found.data.stepped
    if steps := readings.as_effect() if coarse else found.reading:
        extended = with_reading(extended, steps, found.given, found.record)
    if found.reading:
        baseline = with_reading(baseline, found.reading, found.given, found.record)
    if counts and last.noise_given:
        extended = stated_counts(extended, counts)
    elif times := noise_level(last):
        extended = louder(extended, times)
        found.findings.append(
            f"The noise is {times:.3g} times as large as the model states: the extended model states that."
        )
    extended = _with_noise_stated(found, extended)
    return Conclusion(_in_doubt(found, judgement, baseline, extended), baseline, extended, coarse, ordinary)


def _remarks(found: Searched) -> None:
    """What the last fit shows beside its causes."""
    selection, last, findings = found.selection, found.selection.estimate, found.findings
    findings += [selection.unresolved] if selection.unresolved else []
    findings += held_back(last, found.given)
    # What rounding leaves is larger at edges of steps, where there is much more to tell than tails.
    left = () if found.rounding.saw_tooth else (tails(last), dwells_apart(last, found.data.unit))
    findings += [line for line in left if line]
    stated, slope = float(found.model.gain()), float(last.model.gain())
    if slope * (stated if np.isfinite(stated) else 1.0) < 0:
        findings.append(
            f"The output {'falls' if slope < 0 else 'rises'} as the rate rises: an axis or a sign is reversed"
            f"{'' if np.isfinite(stated) else ', unless it is wired so'}."
        )


def _counts(found: Searched) -> Estimate | None:
    """The fit with its noise estimated, where that of quantisation is a part of it and so among the causes."""
    selection, last = found.selection, found.selection.estimate
    if not found.of_gyro or found.rounding.saw_tooth:
        return None
    free = None if selection.unfinished else with_noise_estimated(last)
    least = max(found.session.threshold, safe_threshold(last.degrees_of_freedom))
    stepped = quantisation(free, least, last if last.noise_given else None) if free else None
    band = None if selection.unresolved else excess_band(free or last)
    if band:
        found.findings.append(band.told(found.session.record))
    # Where a band of the faster half is left besides, neighbours fall apart otherwise than a count's errors do.
    apart = band and band.high > 0.25 / found.session.record.interval
    if stepped is None or stepped.statistic < found.left or apart:
        return None
    found.noise.append(stepped)
    size = stepped.parameters[0].value
    found.findings.append(
        f"The noise from sample to sample is in part that of quantisation, {size:.3g} arcsec (white noise of the angle)"
        + ("; fits in the noise that is stated take it as white noise of the rate." if last.noise_given else ".")
    )
    return free


def _with_noise_stated(found: Searched, extended: Estimate) -> Estimate:
    """The fit with the noise that was found beside it as a model states that."""
    record, grows = found.session.record, found.grows
    if grows and found.of_gyro and (level := grows.level(record)):
        extended = stated_level(extended, grows, level)
        if extended.model.level and extended.model.level.driver != level.driver:
            found.findings.append(f"A model states one column that its noise follows: not {grows.driver} besides.")
    return extended if found.hops is None else stated_hops(extended, found.hops)


def _in_doubt(found: Searched, judgement: Judgement, baseline: Estimate, extended: Estimate) -> Judgement:
    """The judgement with the test that would settle it, and what else may be true in the place of what was found."""
    if found.selection.either:
        name, rival = found.selection.either
        judgement = undecided(judgement, name, rival, effect_class(rival).test)
    if judgement.verdict == "ambiguous":
        names = list(judgement.credible_set)
        test = settling_test(found.data.searched, baseline.model, extended, names)
        judgement = replace(judgement, next_test=test or judgement.next_test)
    if found.instead and "bias_warmup" in extended.model.labels:
        found.findings.append(TURNED_ON)
        judgement = undecided(judgement, "bias_warmup", found.instead, TELL_RUNS)
    if (rival := found.selection.rival) and judgement.causes:
        strongest = max(judgement.causes, key=lambda c: (c.effect != "outliers", c.statistic))
        judgement = undecided(judgement, strongest.effect, rival, test_of_driver(rival))
    return judgement
