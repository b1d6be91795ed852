"""`diagnose`: what a simulation gets wrong on measured data, why, and what is gained by mending it."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Literal

import numpy as np

from gyromodel._checks import CampaignError, listed, thermometers
from gyromodel.campaign import Campaign
from gyromodel.diagnosis._bank import build_bank
from gyromodel.diagnosis._calibrate import null_scores, threshold_of
from gyromodel.diagnosis._data import Data, read
from gyromodel.diagnosis._evidence import SAFE_THRESHOLD
from gyromodel.diagnosis._gain import ladder_error, nested_gain, no_gain, not_measured
from gyromodel.diagnosis._isolation import settling_test
from gyromodel.diagnosis._misfit import excess_band, unexplained_axes
from gyromodel.diagnosis._noise_causes import as_cause, quantisation, telegraph
from gyromodel.diagnosis._points import dwells_apart
from gyromodel.diagnosis._ranking import SLOW_IN_TIME, Ranking, cells_of_weight, is_driver, is_noise, noise_kinds
from gyromodel.diagnosis._result import Candidate, Cause, Diagnosis, Gain, ParameterValue, Round
from gyromodel.diagnosis._scan import Scanner
from gyromodel.diagnosis._search import Progress, Selection, search, significant_driver, steadied
from gyromodel.diagnosis._shapes import driver_shape, minimum_detectable, not_testable
from gyromodel.diagnosis._steps import EXCHANGE, Found, NoisePath, Steps, standing
from gyromodel.diagnosis._variance import follow, growing_noise, noise_level, tails, with_variance
from gyromodel.diagnosis._verdict import FAINT, judge, structured, with_noise
from gyromodel.estimate import Estimate, EstimateError, check_covariates, fit_record, with_noise_intervals
from gyromodel.model import GyroModel, record_span
from gyromodel.noise import NoiseGrid, NoiseRatios, noise_grid
from gyromodel.signals import Record, with_columns_known, with_smooth_thermometers
from gyromodel.units import factor, from_internal

FEWEST_DRAWS = 200
# Folds search the noise cells within this many nats of the best of the main pass.
FOLD_NEARBY = 3.0
# Nats that noise of thermometers may have cost from which on they are smoothed and searched again: it is an estimate.
LOST = 0.5
SMOOTHED = (
    "Temperatures were smoothed: the error follows the smooth record better, so that the rest is noise of the "
    "thermometer, which the model adds where it is applied to temperatures as they were read."
)


class _Session:
    """One record with its search laid out: what the main pass and every fold do alike."""

    def __init__(self, scanner: Scanner, threshold: float) -> None:
        self.record, self.scanner, self.threshold = scanner.record, scanner, threshold
        self._ladder: dict[int, tuple[float, float, bool]] = {}

    def ladder(self, estimate: Estimate) -> tuple[float, float, bool]:
        """Held-out rms, log score and weighting of an estimate's structure, computed once."""
        if id(estimate) not in self._ladder:
            self._ladder[id(estimate)] = ladder_error(estimate.record, estimate)
        return self._ladder[id(estimate)]

    def run(self, baseline: Estimate, progress: Progress = None, noise: NoisePath = ()) -> Selection:
        """The rounds."""
        return search(Steps(self.scanner, baseline, self.threshold, noise), progress)

    def pruned(self, selection: Selection) -> Selection:
        """The rounds, cut where (after the first step) the error on blocks left out stops falling."""
        for i in range(2, len(selection.estimates)):
            # Two that show only together are judged together.
            step, first = selection.path[i - 1], i - 1 - selection.path[i - 2].paired
            now, before = self.ladder(selection.estimates[i]), self.ladder(selection.estimates[first])
            if first and not step.paired and step.effect is not None and now[0] > before[0] and now[1] < before[1]:
                path, estimates = selection.path[:first], selection.estimates[: first + 1]
                found, ranking = tuple(standing(path)), step.ranking
                # What was cut may have stood for a driver that was ahead of it.
                driver = significant_driver(ranking, self.threshold)
                if driver and ranking.statistic[driver] < ranking.statistic[step.name] + EXCHANGE:
                    driver = None
                cut = Selection(
                    estimates[-1],
                    found,
                    path,
                    ranking,
                    estimates,
                    driver,
                    remains=step.name,
                    beside_it=selection.estimates[i],
                )
                return steadied(Steps(self.scanner, estimates[0], self.threshold), cut)
        return selection


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
    """
    if 0 < calibrate < FEWEST_DRAWS:
        raise ValueError(f"{calibrate} draws cannot show a 99 % point: calibrate with {FEWEST_DRAWS} or more, or 0")
    say = progress or (lambda line, done: None)
    measured = [campaigns] if isinstance(campaigns, Campaign) else list(campaigns)
    data = read(measured)
    record, findings, unit = data.record, list(data.findings), data.unit
    check_covariates(record, model)
    record, left_out = with_columns_known(record)
    findings += left_out
    say("fitting the simulation", 0.02)
    baseline = fit_record(record, model)
    say("laying out the search", 0.06)
    bank = build_bank(record)
    grid = _grid(record, baseline)
    scanner = Scanner(record, bank, grid, stated=baseline.noise_given, step=data.step)
    session = _Session(scanner, SAFE_THRESHOLD)
    nulls = np.zeros(0)
    if calibrate:
        nulls = null_scores(session.scanner, baseline, calibrate, seed, say)
        session.threshold = max(threshold_of(nulls), 0.0)
    selection = session.run(baseline, say)
    if others := _with_smooth_thermometers(session, baseline, selection, say):
        record, baseline, session, selection = others
        findings.append(SMOOTHED)
    beyond: list[Cause] = []
    grows, following = growing_noise(record, selection.estimate), None
    if grows is not None:
        weighted = with_variance(record, grows.white)
        try:
            alike = fit_record(weighted, model)
        except EstimateError:
            grows = None
        else:
            bank, grid = session.scanner.bank, session.scanner.grid
            scanner = Scanner(weighted, bank, grid, stated=alike.noise_given, step=data.step)
            again = _Session(scanner, session.threshold)
            other = again.run(alike, say)
            if _unfinished(other):
                # Structure that is left passes for a level that varies; without any left, the level passed for it.
                grows = None
            else:
                record, baseline, session, selection = weighted, alike, again, other
    if grows is not None:
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
    if record.domain == "platform" and selection.found and (failed := unexplained_axes(selection.estimate)):
        moves = f"the base moves about {listed(failed)} as nothing in the catalogue makes it"
        others = _without_axis(measured, failed[0], model, session.threshold, say)
        if others is None:
            findings.append(f"Values may be wrong by more than their uncertainties: {moves}.")
        else:
            data, record, baseline, session, selection = others
            findings.append(
                f"Runs about {failed[0]} were left out: with them {moves}, without them all is explained. A shaft that "
                "sticks makes such an axis."
            )
    free = _with_noise_estimated(selection.estimate)
    hops = telegraph(baseline, free, unit) if free and record.domain == "gyro" and _like_hops(selection, free) else None
    if hops is not None:
        beyond.append(hops)
        findings.append("No fit holds hops of the bias: the extended model takes them for noise of the kinds it holds.")
        first = selection.path[0].ranking if selection.path else selection.last
        start = _with_noise_estimated(baseline) or baseline
        selection = Selection(start, (), (), first, (start,), None)
    if hold_out:
        say("judging each step on blocks left out", 0.62)
        selection = session.pruned(selection)
    findings += [selection.unresolved] if selection.unresolved else []
    last = selection.estimate
    findings += [line for line in (tails(last), noise_level(last), dwells_apart(last, unit)) if line]
    stated, slope = float(model.gain()), float(last.model.gain())
    if slope * (stated if np.isfinite(stated) else 1.0) < 0:
        findings.append(
            f"The output {'falls' if slope < 0 else 'rises'} as the rate rises: an axis or a sign is reversed"
            f"{'' if np.isfinite(stated) else ', unless it is wired so'}."
        )
    say("judging", 0.65)
    scale = factor(record.input_unit, unit)
    ordinary = tuple(hold_out and session.ladder(e)[2] for e in (baseline, selection.estimate))
    extended = _finished(selection.estimate, ordinary[1])
    weights = ordinary[0], extended.ordinary
    if extended.ordinary:
        findings.append(
            "Parameters weigh all samples alike: that predicts left-out blocks better than the fitted noise's weights "
            "do."
        )
    steps = Steps(session.scanner, baseline, session.threshold)
    judgement = judge(steps, selection, extended, len(bank.names()), nulls, data.rows_of)
    # What follows itself at one end of a column has structure, whatever faint name takes a part of it.
    if following and grows and all(c.statistic < FAINT for c in judgement.causes):
        judgement = structured(judgement, selection.last, grows.column)
    stepped = None
    if record.domain == "gyro" and not _unfinished(selection) and (free := _with_noise_estimated(selection.estimate)):
        stepped = quantisation(free, session.threshold)
    if stepped is not None:
        beyond.append(stepped)
        size = stepped.parameters[0].value
        findings.append(
            f"The noise from sample to sample is in part that of quantisation, {size:.3g} arcsec (white noise of the "
            "angle); fits take it as white noise of the rate."
        )
    elif record.domain == "gyro" and not selection.unresolved and (band := excess_band(selection.estimate)):
        findings.append(band)
    # Where the simulation leaves its noise to be estimated, its kinds are no discrepancy, but for what no fit holds.
    judgement = with_noise(
        judgement, beyond if baseline.noise_given else [c for c in beyond if c is hops], len(bank.names())
    )
    next_test = judgement.next_test
    if judgement.verdict == "ambiguous":
        alike = list(judgement.credible_set)
        next_test = settling_test(data.searched, baseline.model, extended, alike) or next_test
    gain = not_measured(unit) if not hold_out else _gain(session, baseline, selection, unit, scale, weights, say)
    driver = driver_shape(session.scanner, selection, judgement.driver, unit) if judgement.driver else None
    say("done", 1.0)
    rankings = [*(f.ranking for f in selection.path), selection.last]
    before, after = (np.asarray(e.model.predict(record.signals))[: record.rows] for e in (baseline, extended))
    slopes = [np.asarray(e.model.slope(record.signals))[: record.rows] for e in (baseline, extended)]
    output = np.where(record.present, np.asarray(record.signals["output"])[: record.rows], np.nan)
    sizes = minimum_detectable(session.scanner, selection.last, session.threshold, unit)
    return Diagnosis(
        verdict=judgement.verdict,
        causes=judgement.causes,
        driver=driver,
        gain=gain,
        next_test=next_test,
        minimum_detectable=sizes,
        not_testable=not_testable(session.scanner, selection.last, selection.estimate.model, sizes),
        noise=extended.noise_table(),
        noise_kinds={} if baseline.noise_given else noise_kinds(session.scanner, selection.last),
        evidence=_evidence(selection, judgement.credible_set),
        rounds=_rounds(session, selection, scale, hold_out),
        credible_set=judgement.credible_set,
        unexplained=judgement.unexplained,
        findings=(*findings, *judgement.findings),
        threshold=session.threshold + _more_needed(rankings[0], selection.path),
        threshold_kind="calibrated" if calibrate else "safe",
        p_value=_p_value(selection, nulls) if calibrate else None,
        searched=tuple(dict.fromkeys([*bank.names(), *(name for r in rankings for name in r.tangents)])),
        campaign=data.whole,
        predicted_before=from_internal(before, data.output_unit),
        predicted_after=from_internal(after, data.output_unit),
        residual_before=(output - before) / slopes[0] * scale,
        residual_after=(output - after) / slopes[1] * scale,
        rate_unit=unit,
        baseline=baseline,
        extended=extended,
    )


def _finished(estimate: Estimate, ordinary: bool) -> Estimate:
    """What is published: the last fit, with ordinary weights where they predict better and determine it too."""
    if ordinary:
        with contextlib.suppress(EstimateError):
            estimate = fit_record(estimate.record, estimate.model_as_given(), ordinary=True)
    return with_noise_intervals(estimate)


def _with_smooth_thermometers(
    session: _Session, baseline: Estimate, selection: Selection, say: Progress
) -> tuple[Record, Estimate, _Session, Selection] | None:
    """The search over smoothed thermometers, where their noise may cost evidence and the data are explained better so.

    Noise of a thermometer is none of what it measures: all that smooths, a lag or a narrow loop, would take it away.
    """
    record = with_smooth_thermometers(session.record)
    if _lost_to_thermometers(session.record, record, baseline, selection) < LOST:
        return None
    try:
        alike = fit_record(record, baseline.model_as_given())
    except EstimateError:
        return None
    scanner = Scanner(record, build_bank(record), session.scanner.grid, stated=alike.noise_given)
    again = _Session(scanner, session.threshold)
    other = again.run(alike, say)
    measured, smooth = (Steps(s.scanner, e, s.threshold) for s, e in ((session, baseline), (again, alike)))
    better = other.found and smooth.fits_better(other.found, selection.found, EXCHANGE, measured)
    return (record, alike, again, other) if better else None


def _lost_to_thermometers(measured: Record, smooth: Record, baseline: Estimate, selection: Selection) -> float:
    """The evidence (nats) that noise of thermometers may cost the model, what was found or what might have been."""
    here, lost = measured.present, [0.0]
    for estimate in (baseline, selection.estimate):
        before, after = (np.asarray(estimate.model.predict(r.signals))[: r.rows][here] for r in (measured, smooth))
        lost.append(0.5 * float(np.sum((after - before) ** 2)) / estimate.white_variance)
    first = selection.path[0].ranking if selection.path else selection.last
    for name in thermometers(measured.signals):
        before, after = (np.asarray(r.signals[name])[: r.rows][here] for r in (measured, smooth))
        share = np.var(after - before) / max(np.var(before), np.finfo(float).tiny)
        lost.append(float(share) * max(first.statistic.values()))
    return max(lost)


def _without_axis(
    measured: Sequence[Campaign], axis: str, model: GyroModel, threshold: float, say: Progress
) -> tuple[Data, Record, Estimate, _Session, Selection] | None:
    """The search of the runs about other axes, if there are any and what it finds explains them."""
    try:
        data = read(measured, without=axis)
        record, _ = with_columns_known(data.record)
        baseline = fit_record(record, model)
    except (CampaignError, EstimateError):
        return None
    grid = _grid(record, baseline)
    scanner = Scanner(record, build_bank(record), grid, stated=baseline.noise_given, step=data.step)
    session = _Session(scanner, threshold)
    selection = session.run(baseline, say)
    explained = selection.found and not unexplained_axes(selection.estimate)
    return (data, record, baseline, session, selection) if explained else None


def _grid(record: Record, baseline: Estimate) -> NoiseGrid:
    """Noise cells: the whole family; where the model states its noise, that cell first."""
    grid = noise_grid(int(record.present.sum()), record.interval, record_span(record))
    if not baseline.noise_given:
        return grid
    stated, prior = baseline.ratios, grid.log_prior
    each = [np.asarray(r) for r in np.broadcast_arrays(*grid.ratios)]
    if float(stated.markov):
        # Beside less of it than stated, which is none, as much: in the cells that can hold it.
        room = each[0] == 0
        level = np.stack(each)[:, room]
        level[2:] = [[float(stated.markov)], [float(stated.constant)]]
        each = [np.concatenate([a, b]) for a, b in zip(each, level, strict=True)]
        prior = np.concatenate([prior, prior[room]])
    ratios = NoiseRatios(*(np.append(float(a), b) for a, b in zip(stated, each, strict=True)))
    return grid._replace(ratios=ratios, log_prior=np.concatenate([[0.0], prior]))


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


def _unfinished(selection: Selection) -> bool:
    """Whether structure is left that would pass for a kind of noise."""
    return selection.driver is not None or bool(selection.remains)


def _like_hops(selection: Selection, free: Estimate) -> bool:
    """Whether all that was found is what hops of the bias could be taken for; `free` has its noise estimated."""
    in_time = all(f.frees_noise or f.name in (*SLOW_IN_TIME, "bias_periodic") for f in selection.found)
    slow = any(float(r) > 0 for r in free.ratios)
    return in_time and selection.driver in (None, "smooth(time)") and (slow or bool(selection.found))


def _more_needed(first: Ranking, path: Sequence[Found]) -> float:
    """Nats that the first name, or the leading one where none was added, needed more."""
    name = path[0].name if path else first.best(drivers=False)[0]
    return first.more_needed(name) if name else 0.0


def _evidence(selection: Selection, alike: Mapping[str, float]) -> dict[str, tuple[float, ...]]:
    """ln B at each of the prior's sizes beside all that was found; of that, and of what is alike, as it was added.

    Gross errors are a campaign's own.
    """
    of = dict.fromkeys(selection.last.statistic, selection.last)
    for f in reversed(selection.found):
        rivals = alike if f.name in alike else ()
        of |= {name: f.ranking for name in (*rivals, f.name) if name in f.ranking.statistic}
    return {name: ranking.at_sizes(name) for name, ranking in sorted(of.items()) if name != "outliers"}


def _p_value(selection: Selection, nulls: np.ndarray) -> float:
    """Share of campaigns with nothing hidden whose best candidate has as much evidence; this one is counted."""
    first = selection.path[0].ranking if selection.path else selection.last
    return float((1 + np.sum(nulls >= first.significance)) / (1 + len(nulls)))


def _gain(session: _Session, baseline: Estimate, selection: Selection, unit: str, scale: float, ordinary, say) -> Gain:
    if not any(f.effect is not None or f.frees_noise for f in selection.found):
        return no_gain(session.record, baseline, unit, scale)

    rankings = [f.ranking for f in selection.path] + [selection.last]
    noise = [e.ratios for e in selection.estimates]
    cells = sorted({g for ranking in rankings for g in cells_of_weight(ranking, FOLD_NEARBY)})

    def select(rows: np.ndarray, base: Estimate) -> Estimate:
        return _Session(session.scanner.without(rows, cells), session.threshold).run(base, noise=noise).estimate

    return nested_gain(
        session.record,
        baseline,
        select,
        unit,
        scale,
        ordinary,
        lambda k, n: say(f"held-out block {k} of {n}", 0.7 + 0.28 * k / n),
    )


def _rounds(session: _Session, selection: Selection, scale: float, hold_out: bool) -> tuple[Round, ...]:
    steps: list[tuple[Found | None, Ranking, Estimate]] = [
        (f, f.ranking, e) for f, e in zip(selection.path, selection.estimates[1:], strict=False)
    ]
    rounds = []
    unknown = (np.nan, np.nan, False)
    before = session.ladder(selection.estimates[0]) if hold_out else unknown
    rounds.append(
        Round(
            None,
            0.0,
            _ranking(selection.path[0].ranking if selection.path else selection.last),
            before[0] * scale,
            before[1],
        )
    )
    for step, ranking, estimate in steps:
        assert step is not None
        rms, score, _ = session.ladder(estimate) if hold_out else unknown
        rounds.append(Round(step.name, ranking.statistic[step.name], _ranking(ranking), rms * scale, score))
    return tuple(rounds)


def _ranking(ranking: Ranking) -> tuple[Candidate, ...]:
    order = sorted(ranking.statistic, key=lambda k: -ranking.statistic[k])[:12]
    return tuple(Candidate(str(k), ranking.statistic[k], ranking.posterior[k], _kind(k)) for k in order)


def _kind(name: str) -> Literal["effect", "driver", "noise"]:
    return "driver" if is_driver(name) else "noise" if is_noise(name) else "effect"
