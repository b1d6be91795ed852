"""One search after another: what the data turn out to be, or what one found, asks for the next."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from gyromodel._checks import listed
from gyromodel._noise_level import with_stated_level
from gyromodel.campaign import Campaign
from gyromodel.diagnosis._calibrate import null_scores, threshold_of
from gyromodel.diagnosis._data import Data, read
from gyromodel.diagnosis._gain import with_predictable_blocks
from gyromodel.diagnosis._misfit import unexplained_axes
from gyromodel.diagnosis._noise_causes import as_cause, quantisation, telegraph
from gyromodel.diagnosis._ranking import SLOW_IN_TIME
from gyromodel.diagnosis._readings import Readings
from gyromodel.diagnosis._result import Cause, ParameterValue
from gyromodel.diagnosis._selection import Selection
from gyromodel.diagnosis._session import (
    Session,
    laid_out,
    over_angle_noise,
    over_power_cycles,
    over_smooth_thermometers,
    over_unrounded,
    over_weighted,
    without_axis,
)
from gyromodel.diagnosis._thermometers import left_by_thermometers, smoothed, within_thermometers
from gyromodel.diagnosis._variance import Growth, follow, growing_noise
from gyromodel.diagnosis._verdict import FAINT
from gyromodel.effects.converter import Quantisation
from gyromodel.estimate import (
    Estimate,
    EstimateError,
    Unrounded,
    check_covariates,
    fit_record,
    refuse_apart,
    refuse_missing,
    unknown_rows,
)
from gyromodel.model import GyroModel
from gyromodel.signals import Record, with_columns_known

Say = Callable[[str, float], None]

# Searches beside rounding as it is at what the last has found.
ROUNDINGS = 3
SMOOTHED = (
    "Temperatures were smoothed: the error follows the smooth record better, so that the rest is noise of the "
    "thermometer, which the model adds where it is applied to temperatures as they were read."
)


@dataclass
class Searched:
    """The data, the last search of them, and what was found on the way.

    Attributes:
        data: what was read.
        given: the simulation.
        model: it without its reading, its scale factor fixed where the data have no rate.
        record: what is searched, before its noise is weighted or its thermometers are smoothed.
        readings: how the output is read.
        reading: how the simulation reads it.
        rounding: what rounding adds beside what was found.
        session: the search laid out.
        selection: what it found.
        nulls: the largest evidence of each draw with nothing hidden, if the threshold was calibrated.
        findings: what else is told, in sentences.
        noise: kinds of noise among the causes, which no search holds.
        hops: that of them which is hops of the bias.
        grows: what the noise level follows, samples being weighted so.
        following: a sentence, where what follows itself there is no noise.
        instead: what a warm-up behind gaps may be instead, if one was searched.
        left: evidence (nats) that noise of thermometers may make that were smoothed; 0 as they were read.
    """

    data: Data
    given: GyroModel
    model: GyroModel
    record: Record
    readings: Readings
    reading: Quantisation | None
    rounding: Unrounded
    session: Session
    selection: Selection
    nulls: np.ndarray
    findings: list[str]
    noise: list[Cause] = field(default_factory=list)
    hops: Cause | None = None
    grows: Growth | None = None
    following: str | None = None
    instead: str = ""
    left: float = 0.0

    @property
    def of_gyro(self) -> bool:
        """Whether a gyro was measured, and no platform."""
        return self.record.domain == "gyro"


def searched(measured: list[Campaign], given: GyroModel, calibrate: int, seed: int, say: Say) -> Searched:
    """All that is searched of campaigns; for the arguments and errors see `diagnose`."""
    found = _first(measured, given, calibrate, seed, say)
    _beside_rounding(found, say)
    of_angle = over_angle_noise(found.session, found.selection, found.model, say)
    found.session, found.selection = of_angle or (found.session, found.selection)
    time_on = found.data.time_on
    if time_on is not None and (off := over_power_cycles(found.session, found.selection, time_on, found.model, say)):
        found.session, found.selection, found.instead = off
    if found.of_gyro and (smooth := over_smooth_thermometers(found.session, found.selection, found.model, say)):
        found.session, found.selection = smooth
        found.findings.append(SMOOTHED)
    if not found.rounding.saw_tooth:
        _weighted(found, say)
    found.selection, not_named = within_thermometers(found.session.steps, found.selection, found.record)
    found.findings += [not_named] if not_named else []
    if smoothed(found.session.record, found.record):
        last = found.selection.estimate
        found.left = left_by_thermometers(last, found.record, last)
    if found.of_gyro:
        _over_hops(found)
    elif found.selection.found and (failed := unexplained_axes(found.selection.estimate)):
        _without_axes(found, measured, failed, say)
    return found


def with_noise_estimated(estimate: Estimate) -> Estimate | None:
    """The fit with its noise estimated: less than a model states would be whitened too far, and look quantised.

    None where that fit fails.
    """
    if not estimate.noise_given:
        return estimate
    free = replace(estimate.model, noise={})
    try:
        return fit_record(estimate.record, free)
    except EstimateError:
        return None


def _first(measured: list[Campaign], given: GyroModel, calibrate: int, seed: int, say: Say) -> Searched:
    """The campaigns read, the simulation fitted, and all candidates searched beside it."""
    data = read(measured)
    record, findings = data.record, list(data.findings)
    if record.domain == "gyro":
        refuse_apart(measured, given)
    check_covariates(record, given)
    _refuse_missing(measured, data, given)
    record, left_out = with_columns_known(record)
    record = with_stated_level(with_predictable_blocks(record, given), given)
    findings += left_out
    say("fitting the simulation", 0.02)
    model, reading = data.readings.bare(given, measured, record)
    session = laid_out(record, model, step=data.step)
    if record.domain == "gyro" and (rows := unknown_rows(record, session.baseline.model)):
        names = listed(session.baseline.model.unknown(record.signals))
        findings.append(
            f"Beside {names} of the simulation {len(rows)} of {record.present.sum()} samples were left out, next to "
            "gaps or the record's ends: what was not recorded still shows there."
        )
        record = record.without(np.array(rows))
        session = laid_out(record, model, step=data.step)
    model = replace(model, fixed=session.baseline.model.fixed)
    readings = data.readings
    if (
        not readings.same_as(reading)
        and readings.coarse_beside(record, session.baseline)
        and (readings.mirrors(record, session.baseline) or _quantised_angle(session.baseline))
    ):
        readings = replace(readings, step=0.0)
    rounding = readings.beside(record, session.baseline)
    session = over_unrounded(record, rounding, model) or session
    nulls = np.zeros(0)
    if calibrate:
        nulls = null_scores(session.scanner, session.baseline, calibrate, seed, say)
        session.threshold = threshold_of(nulls)
    selection = session.run(say)
    return Searched(
        data, given, model, record, readings, reading, rounding, session, selection, nulls, findings
    )  # fmt: skip


def _refuse_missing(measured: Sequence[Campaign], data: Data, model: GyroModel) -> None:
    """As `check_covariates`, of what was averaged: a mean would hide a row that lacks a value."""
    for campaign, (seen, as_given) in zip(measured, data.rows_of, strict=True):
        posed = "position" in {*seen.columns} - {*campaign.columns}
        if as_given or posed or data.record.domain != "gyro":
            continue
        for effect in model.effects:
            for name in set(model.columns_needed(effect)) & set(campaign.columns):
                refuse_missing(effect.label, name, campaign.columns[name], np.isfinite(campaign.columns["output"]))


def _quantised_angle(estimate: Estimate) -> bool:
    """Whether it is clearly the angle that is rounded, and not each rate for itself."""
    free = with_noise_estimated(estimate)
    return free is not None and quantisation(free, FAINT) is not None


def _beside_rounding(found: Searched, say: Say) -> None:
    """Rounding is another beside what was found: searched again until that stays."""
    for _ in range(ROUNDINGS if found.selection.found else 0):
        beside = found.readings.beside(found.record, found.selection.estimate)
        again = over_unrounded(found.record, beside, found.model, found.session.threshold)
        if again is None:
            break
        names = [f.name for f in found.selection.found]
        found.rounding, found.session, found.selection = beside, again, again.run(say)
        if [f.name for f in found.selection.found] == names:
            break
    left_out = int(np.sum(found.record.present & ~found.session.record.present))
    if found.rounding.changed and left_out:
        found.findings.append(f"{left_out} samples that stand apart from all others were left out beside rounding.")


def _weighted(found: Searched, say: Say) -> None:
    """Where the noise level follows a column, searched again with samples weighted so."""
    grows = growing_noise(found.session.record, found.selection.estimate)
    others = over_weighted(found.session, grows, found.model, say) if grows else None
    if grows is None or others is None:
        return
    found.grows, (found.session, found.selection) = grows, others
    found.findings.append(grows.told(found.record))
    found.following = follow(found.selection.estimate, grows)
    if found.following:
        found.findings.append(found.following)
    else:
        ratio = ParameterValue("ratio", grows.ratio, grows.ratio_std, "1")
        found.noise.append(as_cause("noise_heteroscedastic", grows.evidence, ratio))


def _without_axes(found: Searched, measured: list[Campaign], failed: Sequence[str], say: Say) -> None:
    """A platform searched again without the runs about an axis that nothing explains, if all others are explained."""
    moves = f"the base moves about {listed(failed)} as nothing in the catalogue makes it"
    others = without_axis(measured, failed[0], found.model, found.session.threshold, say)
    if others is None:
        found.findings.append(f"Values may be wrong by more than their uncertainties: {moves}.")
        return
    found.data, found.session, found.selection = others
    found.record = found.session.record
    found.findings.append(
        f"Runs about {failed[0]} were left out: with them {moves}, without them all is explained. A shaft that "
        "sticks makes such an axis."
    )


def _over_hops(found: Searched) -> None:
    """Hops of the bias in the place of all that fits take them for, where they are likelier."""
    session, selection = found.session, found.selection
    free = with_noise_estimated(selection.estimate)
    if free is None or "noise_telegraph" in found.model.noise or not _like_hops(selection, free):
        return
    hops = telegraph(session.baseline, free, found.data.unit)
    if hops is None or hops.statistic < found.left:
        return
    found.hops = hops
    found.noise.append(found.hops)
    found.findings.append("Fits take hops of the bias for noise of a like variance and correlation.")
    start = with_noise_estimated(session.baseline) or session.baseline
    found.selection = Selection(start, (), (), selection.first, (start,), None)


def _like_hops(selection: Selection, free: Estimate) -> bool:
    """Whether all that was found is what hops of the bias could be taken for; `free` has its noise estimated."""
    in_time = all(f.frees_noise or f.name in (*SLOW_IN_TIME, "bias_periodic") for f in selection.found)
    slow = any(float(r) > 0 for r in free.ratios[:3])
    return in_time and selection.driver in (None, "smooth(time)") and (slow or bool(selection.found))
