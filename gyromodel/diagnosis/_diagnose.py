"""`diagnose`: what a simulation gets wrong on measured data, why, and what is gained by mending it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from threadpoolctl import threadpool_limits

from gyromodel.campaign import Campaign
from gyromodel.diagnosis._account import as_added, evidence_at_sizes, more_needed, p_value_of, rounds_of
from gyromodel.diagnosis._conclusion import Conclusion, conclude
from gyromodel.diagnosis._data import NO_RUNS
from gyromodel.diagnosis._folds import gain_of
from gyromodel.diagnosis._gain import not_measured
from gyromodel.diagnosis._intervals import CLEARER, COUNTED, HALF, over_intervals
from gyromodel.diagnosis._ranking import noise_kinds
from gyromodel.diagnosis._result import Diagnosis, Gain
from gyromodel.diagnosis._search import Progress
from gyromodel.diagnosis._searches import Say, Searched, searched
from gyromodel.diagnosis._shapes import driver_shape, minimum_detectable, not_testable
from gyromodel.model import GyroModel
from gyromodel.units import factor, from_internal

FEWEST_DRAWS = 200
UNSEEN_OFFSETS = "No run tells another's offset: errors on data not used hold those of the runs left out."


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
    measured: list[Campaign], model: GyroModel, hold_out: bool, calibrate: int, seed: int, say: Say
) -> Diagnosis:
    """`diagnose`, of one or several campaigns."""
    found = searched(measured, model, calibrate, seed, say)
    if hold_out:
        say("judging each step on blocks left out", 0.62)
        found.selection = found.session.pruned(found.selection)
    say("judging", 0.65)
    told = conclude(found, hold_out)
    unit, gain = found.data.unit, not_measured(found.data.unit)
    if hold_out:
        scale = factor(found.record.input_unit, unit)
        of = found.session, told.baseline, found.selection, found.record
        gain = gain_of(*of, unit, scale, told.ordinary, say)
    say("done", 1.0)
    result = _result(found, told, gain, hold_out)
    if found.of_gyro and (
        counted := over_intervals(result, measured, lambda whole: diagnose(whole, model, hold_out=False))
    ):
        whole, likelier = counted
        if likelier > CLEARER:
            again = diagnose(whole, model, hold_out=hold_out, calibrate=calibrate, seed=seed)
            return replace(again, findings=(COUNTED, *again.findings))
        if likelier > -CLEARER:
            return replace(result, findings=(HALF, *result.findings))
    return result


def _result(found: Searched, told: Conclusion, gain: Gain, hold_out: bool) -> Diagnosis:
    """All that a report shows."""
    data, session, selection, readings = found.data, found.session, found.selection, found.readings
    record, scanner, judgement = session.record, session.scanner, told.judgement
    baseline, extended = told.baseline, told.extended
    unit, scale, calibrated = data.unit, factor(record.input_unit, data.unit), found.nulls.size > 0
    rankings = [*(f.ranking for f in selection.path), selection.last]
    before, after = (np.asarray(e.model.predict(record.signals))[: record.rows] for e in (baseline, extended))
    slopes = [np.asarray(e.model.slope(record.signals))[: record.rows] for e in (baseline, extended)]
    # What rounding adds is part of what is predicted.
    output, left = (np.asarray(r.signals["output"])[: record.rows] for r in (found.record, record))
    before, after = before + output - left, after + output - left
    output = np.where(record.present, output, np.nan)
    added = as_added(selection, judgement.credible_set)
    sizes = minimum_detectable(scanner, selection.last, added, session.threshold, unit)
    steps_searched = found.of_gyro and not readings.untested
    if steps_searched and not told.coarse:
        sizes["quantisation"] = readings.least(found.record, extended), readings.unit
    names = [*scanner.bank.names(), *(name for r in rankings for name in r.tangents)]
    findings = [*found.findings, *judgement.findings]
    if "bias_turn_on" not in {*extended.model.labels, *judgement.credible_set}:
        findings = [line for line in findings if line != NO_RUNS]
    elif hold_out and "fifths" not in gain.scheme and any(c.effect == "bias_turn_on" for c in judgement.causes):
        findings.append(UNSEEN_OFFSETS)
    return Diagnosis(
        verdict=judgement.verdict,
        causes=judgement.causes,
        driver=driver_shape(scanner, selection, judgement.driver, unit) if judgement.driver else None,
        gain=gain,
        next_test=judgement.next_test,
        minimum_detectable=sizes,
        not_testable=not_testable(scanner, selection.last, selection.estimate.model, sizes)
        | ({"quantisation": readings.untested} if readings.untested else {}),
        noise=extended.noise_table(),
        noise_kinds={} if baseline.noise_given else noise_kinds(scanner, selection.last),
        evidence=evidence_at_sizes(selection, judgement.credible_set),
        rounds=rounds_of(session, selection, scale, hold_out),
        credible_set=judgement.credible_set,
        unexplained=judgement.unexplained,
        findings=tuple(findings),
        threshold=session.threshold + more_needed(rankings[0], selection.path),
        threshold_kind="calibrated" if calibrated else "safe",
        p_value=p_value_of(selection, found.nulls) if calibrated else None,
        searched=tuple(dict.fromkeys([*names, *["quantisation"] * steps_searched])),
        campaign=data.whole,
        predicted_before=from_internal(before, data.output_unit),
        predicted_after=from_internal(after, data.output_unit),
        residual_before=(output - before) / slopes[0] * scale,
        residual_after=(output - after) / slopes[1] * scale,
        rate_unit=unit,
        baseline=baseline,
        extended=extended,
    )
