"""`diagnose`: what a simulation gets wrong on measured data, why, and what is gained by mending it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from threadpoolctl import threadpool_limits

from gyromodel._checks import listed
from gyromodel._noise_level import with_stated_level
from gyromodel.campaign import Campaign
from gyromodel.diagnosis._account import as_added, evidence_at_sizes, more_needed, p_value_of, rounds_of
from gyromodel.diagnosis._calibrate import null_scores, threshold_of
from gyromodel.diagnosis._data import Data, read
from gyromodel.diagnosis._extended import finished, stated_counts, stated_hops, stated_level
from gyromodel.diagnosis._folds import gain_of
from gyromodel.diagnosis._gain import not_measured, with_predictable_blocks
from gyromodel.diagnosis._intervals import CLEARER, COUNTED, HALF, over_intervals
from gyromodel.diagnosis._isolation import settling_test
from gyromodel.diagnosis._judgement import structured, undecided, with_noise, with_steps
from gyromodel.diagnosis._misfit import excess_band, unexplained_axes
from gyromodel.diagnosis._noise_causes import as_cause, quantisation, telegraph
from gyromodel.diagnosis._points import dwells_apart
from gyromodel.diagnosis._ranking import SLOW_IN_TIME, noise_kinds
from gyromodel.diagnosis._result import Cause, Diagnosis, ParameterValue
from gyromodel.diagnosis._search import Progress
from gyromodel.diagnosis._selection import Selection
from gyromodel.diagnosis._session import (
    laid_out,
    over_angle_noise,
    over_power_cycles,
    over_smooth_thermometers,
    over_unrounded,
    over_weighted,
    without_axis,
)
from gyromodel.diagnosis._shapes import driver_shape, minimum_detectable, not_testable
from gyromodel.diagnosis._thermometers import within_thermometers
from gyromodel.diagnosis._unseen import held_back
from gyromodel.diagnosis._variance import follow, growing_noise, noise_level, tails
from gyromodel.diagnosis._verdict import FAINT, judge, test_of_driver
from gyromodel.estimate import (
    Estimate,
    EstimateError,
    check_covariates,
    fit_record,
    refuse_apart,
    refuse_missing,
    unknown_rows,
    with_reading,
)
from gyromodel.model import GyroModel
from gyromodel.signals import with_columns_known
from gyromodel.units import factor, from_internal

FEWEST_DRAWS = 200
# Searches beside rounding as it is at what the last has found.
ROUNDINGS = 3
TURNED_ON = (
    "There seems to be a warm-up behind every gap, as if the gyro had been off: its time is counted from there. The "
    "model is applied to files whose column run tells power cycles apart."
)
TELL_RUNS = (
    "Number the power cycles in a column run; where the gyro was not off in the gaps, log the temperature at the coil."
)
SMOOTHED = (
    "Temperatures were smoothed: the error follows the smooth record better, so that the rest is noise of the "
    "thermometer, which the model adds where it is applied to temperatures as they were read."
)


def diagnose(
    campaigns: Campaign | Sequence[Campaign],
    model: GyroModel,
    *,
    hold_out: bool = True,
    calibrate: int = 0,
    seed: int = 0,
    progress: Progress = None,
) -> Diagnosis:
    """Find what a model lacks on one unit's campaigns.

    Args:
        campaigns: measured data of one gyro, or logs of vibration tests of one platform; long ones are averaged first,
            and the findings say so.
        model: what the simulation contains.
        hold_out: whether to repeat the search without each block for the gain on data not seen; half of the work
            or more.
        calibrate: draws of simulated data with nothing hidden that set the threshold, 200 or more; 0 takes the safe
            threshold.
        seed: of those draws.
        progress: called with a line and the fraction done.

    Raises:
        CampaignError, ModelError, EstimateError: the data or the model cannot answer; the message says why.
        ValueError: too few draws are asked for.
    """
    if 0 < calibrate < FEWEST_DRAWS:
        raise ValueError(f"{calibrate} draws cannot show a 99 % point: calibrate with {FEWEST_DRAWS} or more, or 0")
    measured = [campaigns] if isinstance(campaigns, Campaign) else list(campaigns)
    # Threads of BLAS would wait for one another, and for those that search side by side.
    with threadpool_limits(1, "blas"):
        return _diagnosed(measured, model, hold_out, calibrate, seed, progress or (lambda line, done: None))


def _diagnosed(
    measured: list[Campaign],
    model: GyroModel,
    hold_out: bool,
    calibrate: int,
    seed: int,
    say: Callable[[str, float], None],
) -> Diagnosis:
    """`diagnose`, of one or several campaigns."""
    data = read(measured)
    record, findings, unit = data.record, list(data.findings), data.unit
    if record.domain == "gyro":
        refuse_apart(measured, model)
    check_covariates(record, model)
    _refuse_missing(measured, data, model)
    record, left_out = with_columns_known(record)
    record = with_predictable_blocks(record, model)
    record = with_stated_level(record, model)
    findings += left_out
    say("fitting the simulation", 0.02)
    readings, given = data.readings, model
    model, reading = readings.bare(given, measured, record)
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
        session.threshold = max(threshold_of(nulls), 0.0)
    selection = session.run(say)
    for _ in range(ROUNDINGS if selection.found else 0):
        # Rounding is another beside what was found.
        beside = readings.beside(record, selection.estimate)
        again = over_unrounded(record, beside, model, session.threshold)
        if again is None:
            break
        rounding = beside
        names, session, selection = [f.name for f in selection.found], again, again.run(say)
        if [f.name for f in selection.found] == names:
            break
    if rounding.changed and (left_out := int(np.sum(record.present & ~session.record.present))):
        findings.append(f"{left_out} samples that stand apart from all others were left out beside rounding.")
    session, selection = over_angle_noise(session, selection, model, say) or (session, selection)
    instead = ""
    if data.time_on is not None and (off := over_power_cycles(session, selection, data.time_on, model, say)):
        session, selection, instead = off
    smoothed = over_smooth_thermometers(session, selection, model, say) if record.domain == "gyro" else None
    if smoothed:
        session, selection = smoothed
        findings.append(SMOOTHED)
    beyond: list[Cause] = []
    # What rounding leaves is larger at edges of steps, where there is much more to tell than tails.
    plain = record.domain == "gyro" and not rounding.saw_tooth
    grows, following = None if rounding.saw_tooth else growing_noise(session.record, selection.estimate), None
    others = over_weighted(session, grows, model, say) if grows else None
    grows = grows if others else None
    if grows and others:
        session, selection = others
        times = max(grows.ratio, 1.0 / grows.ratio)
        findings.append(
            f"The noise level follows {grows.driver}, {times:.3g} times as large at one end as at the other; samples "
            "are weighted accordingly."
        )
        if following := follow(selection.estimate, grows):
            findings.append(following)
        else:
            ratio = ParameterValue("ratio", grows.ratio, grows.ratio_std, "1")
            beyond.append(as_cause("noise_heteroscedastic", grows.evidence, ratio))
    selection, not_named = within_thermometers(session.steps, selection, record)
    findings += [not_named] if not_named else []
    if record.domain == "platform" and selection.found and (failed := unexplained_axes(selection.estimate)):
        moves = f"the base moves about {listed(failed)} as nothing in the catalogue makes it"
        others = without_axis(measured, failed[0], model, session.threshold, say)
        if others is None:
            findings.append(f"Values may be wrong by more than their uncertainties: {moves}.")
        else:
            data, session, selection = others
            findings.append(
                f"Runs about {failed[0]} were left out: with them {moves}, without them all is explained. A shaft that "
                "sticks makes such an axis."
            )
    as_it_was, record, baseline = record, session.record, session.baseline
    free = _with_noise_estimated(selection.estimate)
    sought = record.domain == "gyro" and "noise_telegraph" not in model.noise
    hops = telegraph(baseline, free, unit) if free and sought and _like_hops(selection, free) else None
    if hops is not None:
        beyond.append(hops)
        findings.append("Fits take hops of the bias for noise of a like variance and correlation.")
        first = selection.first
        start = _with_noise_estimated(baseline) or baseline
        selection = Selection(start, (), (), first, (start,), None)
    if hold_out:
        say("judging each step on blocks left out", 0.62)
        selection = session.pruned(selection)
    findings += [selection.unresolved] if selection.unresolved else []
    findings += held_back(selection.estimate, given)
    last = selection.estimate
    left = () if rounding.saw_tooth else (tails(last), dwells_apart(last, unit))
    findings += [line for line in (*left, noise_level(last)) if line]
    stated, slope = float(model.gain()), float(last.model.gain())
    if slope * (stated if np.isfinite(stated) else 1.0) < 0:
        findings.append(
            f"The output {'falls' if slope < 0 else 'rises'} as the rate rises: an axis or a sign is reversed"
            f"{'' if np.isfinite(stated) else ', unless it is wired so'}."
        )
    say("judging", 0.65)
    names = session.scanner.bank.names()
    scale = factor(record.input_unit, unit)
    ordinary = tuple(hold_out and session.ladder(e)[2] for e in (baseline, selection.estimate))
    extended = finished(selection.estimate, ordinary[1])
    weights = ordinary[0], extended.ordinary
    extended = readings.widened(as_it_was, extended, rounding)
    if extended.ordinary:
        findings.append(
            "Parameters weigh all samples alike: that predicts left-out blocks better than the fitted noise's weights "
            "do."
        )
    read_so = readings.same_as(reading)
    judgement = judge(session.steps, selection, extended, len(names), nulls, data.rows_of, rounding.saw_tooth, read_so)
    # What follows itself at one end of a column has structure, whatever faint name takes a part of it.
    if following and grows and all(c.statistic < FAINT for c in judgement.causes if c.effect != "outliers"):
        judgement = structured(judgement, selection.last, grows.column)
    stepped = free = band = None
    if plain and not selection.unfinished and (free := _with_noise_estimated(selection.estimate)):
        stepped = quantisation(free, session.threshold, last if last.noise_given else None)
    if plain and not selection.unresolved and (band := excess_band(free or selection.estimate)):
        findings.append(band.told)
    # Where a band of the faster half is left besides, neighbours fall apart otherwise than a count's errors do.
    if stepped is not None and band is not None and band.high > 0.25 / record.interval:
        stepped = None
    if stepped is not None:
        beyond.append(stepped)
        size = stepped.parameters[0].value
        findings.append(
            f"The noise from sample to sample is in part that of quantisation, {size:.3g} arcsec (white noise of the "
            "angle)"
            + ("; fits in the noise that is stated take it as white noise of the rate." if last.noise_given else ".")
        )
    # Where the simulation leaves its noise to be estimated, its kinds are no discrepancy, but for what no fit holds.
    judgement = with_noise(
        judgement,
        beyond if baseline.noise_given else [c for c in beyond if c is hops],
        len(names),
    )
    coarse = rounding.changed or rounding.stuck or readings.coarse_beside(as_it_was, extended)
    if readings.untested and rounding.saw_tooth:
        findings.append("Campaigns are read in steps of their own: what is smaller than the coarsest may be rounding.")
    if reading and readings.unit and not readings.untested and not read_so:
        findings.append("The output is not read in the steps that the simulation states.")
    if coarse:
        if not read_so:
            judgement = with_steps(judgement, readings.as_cause(int(record.present.sum())))
        findings.append(readings.told(rounding))
    else:
        findings += data.stepped
    if coarse or reading:
        steps = readings.as_effect() if coarse else reading
        assert steps is not None
        extended = with_reading(extended, steps, given, as_it_was)
    if reading:
        baseline = with_reading(baseline, reading, given, as_it_was)
    if stepped is not None and free and last.noise_given:
        extended = stated_counts(extended, free)
    if grows and record.domain == "gyro" and (level := grows.level(record)):
        extended = stated_level(extended, grows, level)
        if extended.model.level and extended.model.level.driver != level.driver:
            findings.append(f"A model states one column that its noise follows: not {grows.driver} besides.")
    if hops is not None:
        extended = stated_hops(extended, hops)
    next_test = judgement.next_test
    if judgement.verdict == "ambiguous":
        alike = list(judgement.credible_set)
        next_test = settling_test(data.searched, baseline.model, extended, alike) or next_test
    judgement = replace(judgement, next_test=next_test)
    if instead and "bias_warmup" in extended.model.labels:
        findings.append(TURNED_ON)
        judgement = undecided(judgement, "bias_warmup", instead, TELL_RUNS)
    if selection.rival and judgement.causes:
        rival, first = selection.rival, judgement.causes[0].effect
        judgement = undecided(judgement, first, rival, test_of_driver(rival))
    gain = (
        not_measured(unit)
        if not hold_out
        else gain_of(session, baseline, selection, as_it_was, unit, scale, weights, say)
    )
    driver = driver_shape(session.scanner, selection, judgement.driver, unit) if judgement.driver else None
    say("done", 1.0)
    rankings = [*(f.ranking for f in selection.path), selection.last]
    before, after = (np.asarray(e.model.predict(record.signals))[: record.rows] for e in (baseline, extended))
    slopes = [np.asarray(e.model.slope(record.signals))[: record.rows] for e in (baseline, extended)]
    # What rounding adds is part of what is predicted.
    output, left = (np.asarray(r.signals["output"])[: record.rows] for r in (as_it_was, record))
    before, after = before + output - left, after + output - left
    output = np.where(record.present, output, np.nan)
    added = as_added(selection, judgement.credible_set)
    sizes = minimum_detectable(session.scanner, selection.last, added, session.threshold, unit)
    steps_searched = record.domain == "gyro" and not readings.untested
    if steps_searched and not coarse:
        sizes["quantisation"] = readings.least(as_it_was, extended), readings.unit
    found = Diagnosis(
        verdict=judgement.verdict,
        causes=judgement.causes,
        driver=driver,
        gain=gain,
        next_test=judgement.next_test,
        minimum_detectable=sizes,
        not_testable=not_testable(session.scanner, selection.last, selection.estimate.model, sizes)
        | ({"quantisation": readings.untested} if readings.untested else {}),
        noise=extended.noise_table(),
        noise_kinds={} if baseline.noise_given else noise_kinds(session.scanner, selection.last),
        evidence=evidence_at_sizes(selection, judgement.credible_set),
        rounds=rounds_of(session, selection, scale, hold_out),
        credible_set=judgement.credible_set,
        unexplained=judgement.unexplained,
        findings=(*findings, *judgement.findings),
        threshold=session.threshold + more_needed(rankings[0], selection.path),
        threshold_kind="calibrated" if calibrate else "safe",
        p_value=p_value_of(selection, nulls) if calibrate else None,
        searched=tuple(
            dict.fromkeys(
                [*names, *(name for r in rankings for name in r.tangents), *["quantisation"] * steps_searched]
            )
        ),
        campaign=data.whole,
        predicted_before=from_internal(before, data.output_unit),
        predicted_after=from_internal(after, data.output_unit),
        residual_before=(output - before) / slopes[0] * scale,
        residual_after=(output - after) / slopes[1] * scale,
        rate_unit=unit,
        baseline=baseline,
        extended=extended,
    )
    if record.domain == "gyro" and (
        counted := over_intervals(found, measured, lambda whole: diagnose(whole, given, hold_out=False))
    ):
        whole, likelier = counted
        if likelier > CLEARER:
            again = diagnose(whole, given, hold_out=hold_out, calibrate=calibrate, seed=seed)
            return replace(again, findings=(COUNTED, *again.findings))
        if likelier > -CLEARER:
            return replace(found, findings=(HALF, *found.findings))
    return found


def _quantised_angle(estimate: Estimate) -> bool:
    """Whether it is clearly the angle that is rounded, and not each rate for itself."""
    free = _with_noise_estimated(estimate)
    return free is not None and quantisation(free, FAINT) is not None


def _refuse_missing(measured: Sequence[Campaign], data: Data, model: GyroModel) -> None:
    """As `check_covariates`, of what was averaged: a mean would hide a row that lacks a value."""
    for campaign, (searched, as_given) in zip(measured, data.rows_of, strict=True):
        posed = "position" in {*searched.columns} - {*campaign.columns}
        if as_given or posed or data.record.domain != "gyro":
            continue
        for effect in model.effects:
            for name in set(model.columns_needed(effect)) & set(campaign.columns):
                refuse_missing(effect.label, name, campaign.columns[name], np.isfinite(campaign.columns["output"]))


def _with_noise_estimated(estimate: Estimate) -> Estimate | None:
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


def _like_hops(selection: Selection, free: Estimate) -> bool:
    """Whether all that was found is what hops of the bias could be taken for; `free` has its noise estimated."""
    in_time = all(f.frees_noise or f.name in (*SLOW_IN_TIME, "bias_periodic") for f in selection.found)
    slow = any(float(r) > 0 for r in free.ratios[:3])
    return in_time and selection.driver in (None, "smooth(time)") and (slow or bool(selection.found))
