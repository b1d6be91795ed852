"""A search laid out on one record, and the searches that may stand in for it: smoothed, weighted, without an axis."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Array, Float

from gyromodel._checks import CampaignError, thermometers
from gyromodel.campaign import Campaign
from gyromodel.diagnosis._bank import build_bank
from gyromodel.diagnosis._data import Data, read
from gyromodel.diagnosis._evidence import safe_threshold
from gyromodel.diagnosis._gain import ladder_error
from gyromodel.diagnosis._misfit import unexplained_axes
from gyromodel.diagnosis._scan import Scanner
from gyromodel.diagnosis._search import Progress, search, steadied
from gyromodel.diagnosis._selection import Selection, significant_driver
from gyromodel.diagnosis._steps import EXCHANGE, NoisePath, Steps, standing
from gyromodel.diagnosis._thermometers import left_by_thermometers
from gyromodel.diagnosis._unseen import fitted
from gyromodel.diagnosis._variance import Growth, with_variance
from gyromodel.estimate import Estimate, EstimateError, Unrounded, fit_record
from gyromodel.model import GyroModel
from gyromodel.noise import NoiseGrid, NoiseRatios, noise_grid
from gyromodel.signals import Record, with_columns_known, with_smooth_thermometers

# Nats that noise of thermometers may have cost from which on they are smoothed and searched again: it is an estimate.
LOST = 0.5


class Session:
    """One record with its search laid out beside a fitted simulation: what the main pass and every fold do alike."""

    def __init__(self, scanner: Scanner, baseline: Estimate, threshold: float) -> None:
        self.record, self.scanner, self.baseline, self.threshold = scanner.record, scanner, baseline, threshold
        # Estimates are kept beside what is theirs, so that no other takes their number.
        self._ladder: dict[int, tuple[Estimate, tuple[float, float, bool]]] = {}
        self._fits: dict[Hashable, Estimate | None] = {}

    def ladder(self, estimate: Estimate) -> tuple[float, float, bool]:
        """Held-out rms, log score and weighting of an estimate's structure, computed once."""
        if id(estimate) not in self._ladder:
            self._ladder[id(estimate)] = estimate, ladder_error(estimate.record, estimate)
        return self._ladder[id(estimate)][1]

    @property
    def steps(self) -> Steps:
        """What tries steps of this search."""
        return Steps(self.scanner, self.baseline, self.threshold, fits=self._fits)

    def run(self, progress: Progress = None, noise: NoisePath = ()) -> Selection:
        """The rounds."""
        return search(replace(self.steps, noise=noise), progress)

    def pruned(self, selection: Selection) -> Selection:
        """The rounds, cut where (after the first step) the error on blocks left out stops falling for good."""
        estimates = selection.estimates
        for i in range(2, len(estimates)):
            # Two that show only together are judged together.
            step, first = selection.path[i - 1], i - 1 - selection.path[i - 2].paired
            if not first or step.paired or step.effect is None:
                continue
            if rises_for_good(*(self.ladder(e)[:2] for e in (estimates[first], *estimates[i:]))):
                path, kept = selection.path[:first], estimates[: first + 1]
                found = tuple(standing(path))
                ranking = self.steps.rank(kept[-1], found) if step.beside else step.ranking
                # What was cut may have stood for a driver that was ahead of it.
                driver = significant_driver(ranking, self.threshold, True)
                if driver and ranking.statistic[driver] < ranking.statistic[step.name] + EXCHANGE:
                    driver = None
                cut = Selection(
                    kept[-1],
                    found,
                    path,
                    ranking,
                    kept,
                    driver,
                    remains=step.name,
                    beside_it=estimates[i],
                    alone=selection.alone,
                    rival=selection.rival,
                    either=selection.either,
                )
                return steadied(self.steps, cut)
        return selection


def rises_for_good(before: tuple[float, float], *after: tuple[float, float]) -> bool:
    """Whether held-out errors rise, and log scores fall, at the next of some rounds and all that follow.

    What stands in for two for a while may make it worse until the second is there. A round that some block alone
    determines has no error, and decides nothing.
    """
    known = [later for later in after if np.isfinite(later[0])]
    return bool(np.isfinite(after[0][0])) and all(rms > before[0] and score < before[1] for rms, score in known)


def laid_out(
    record: Record,
    model: GyroModel,
    threshold: float | None = None,
    step: float = 0.0,
    outliers: bool = True,
    start: NoiseRatios | None = None,
) -> Session:
    """A search on a record.

    Args:
        record: the data.
        model: the simulation.
        threshold: the safe one if none is given.
        step: of the coarsest reading behind its output.
        outliers: whether gross errors are looked for.
        start: noise to begin with.

    Raises:
        EstimateError: the simulation cannot be fitted.
    """
    baseline = fitted(record, model, start)
    bank, grid = build_bank(record, baseline.model), _grid(record, baseline)
    scanner = Scanner(record, bank, grid, outliers=outliers, stated=baseline.noise_given, step=step)
    safe = safe_threshold(baseline.degrees_of_freedom)
    return Session(scanner, baseline, safe if threshold is None else threshold)


def over_angle_noise(
    session: Session, selection: Selection, model: GyroModel, say: Progress
) -> tuple[Session, Selection] | None:
    """The search beside white noise of the angle where it shows beside what was found, and not before."""
    found, before = selection.estimate, session.baseline
    if found.noise_given or found.ratios.quantisation is None or before.ratios.quantisation is not None:
        return None
    kept = {"step": session.scanner.step, "outliers": session.scanner.outliers}
    try:
        again = laid_out(session.record, model, session.threshold, start=found.ratios, **kept)
    except EstimateError:
        return None
    return again, again.run(say)


def over_unrounded(
    record: Record, found: Unrounded, model: GyroModel, threshold: float | None = None
) -> Session | None:
    """The search beside rounding as it was found at a fit; None where rounding adds noise alone, or cannot be told.

    Samples that were given up stay so: where edges are sharp gross errors are not looked for, as what is read beyond an
    edge stands apart too.

    Args:
        record: as it was read.
        found: the fit's data, less what rounding adds.
        model: the simulation.
        threshold: see `laid_out`.
    """
    if not found.changed:
        return None
    try:
        corrected = record.signals | {"output": found.record.signals["output"]}
        record = record._replace(signals=corrected, in_steps=True)
        if found.saw_tooth:
            record = record.without(np.flatnonzero(record.present & ~found.record.present))
        return laid_out(record, model, threshold, outliers=not found.saw_tooth)
    except EstimateError:
        return None


def over_power_cycles(
    session: Session, selection: Selection, time_on: Float[Array, " sample"], model: GyroModel, say: Progress
) -> tuple[Session, Selection, str] | None:
    """The search as if the gyro had been off in every gap, where a warm-up after each explains the data better.

    And what a gyro that never was off has in the warm-up's place.

    Args:
        session: the search as if it never had been.
        selection: what that found.
        time_on: time since each gap.
        model: the simulation.
        say: progress.
    """
    record = session.record._replace(signals=session.record.signals | {"time_on": time_on})
    try:
        off = laid_out(
            record, model, session.threshold, outliers=session.scanner.outliers, start=_counted(session.baseline)
        )
    except EstimateError:
        return None
    # Nothing else asks when the gyro was turned on.
    simulated = "bias_warmup" in model.labels
    if simulated and not off.steps.fits_better((), (), EXCHANGE, session.steps):
        return None
    if not simulated and off.steps.rank(off.baseline, []).statistic.get("bias_warmup", -np.inf) < off.threshold:
        return None
    other = off.run(say)
    own = {f.name for f in other.found}
    left = max(selection.followed, selection.last.statistic.get(selection.remains, 0.0))
    ahead = EXCHANGE + left - other.followed
    if not (simulated or "bias_warmup" in own):
        return None
    if not off.steps.fits_better(other.found, selection.found, ahead, session.steps):
        return None
    instead = [f.name for f in selection.found if f.follows and f.name not in own]
    return off, other, selection.driver or next(iter(instead), "smooth(time)")


def over_smooth_thermometers(
    session: Session, selection: Selection, model: GyroModel, say: Progress
) -> tuple[Session, Selection] | None:
    """The search over smoothed thermometers, where their noise may cost evidence and the data are explained better so.

    Noise of a thermometer is none of what it measures: all that smooths, a lag or a narrow loop, would take it away.
    """
    record = with_smooth_thermometers(session.record)
    if _lost_to_thermometers(session, record, selection) < LOST:
        return None
    try:
        smooth = laid_out(
            record, model, session.threshold, outliers=session.scanner.outliers, start=_counted(session.baseline)
        )
    except EstimateError:
        return None
    other = smooth.run(say)
    some = other.found or selection.found or selection.driver
    # What only followed a column was found too, if not named; what smooth records leave to follow one is no gain.
    ahead = EXCHANGE + max(selection.followed - other.followed, 0.0)
    if not other.found and other.driver is None:
        # What smooth records leave of the simulation alone passes for what follows a column.
        ahead = max(EXCHANGE, ahead - left_by_thermometers(other.estimate, session.record, other.estimate))
    better = some and smooth.steps.fits_better(other.found, selection.found, ahead, session.steps)
    return (smooth, other) if better else None


def _lost_to_thermometers(session: Session, smooth: Record, selection: Selection) -> float:
    """The evidence (nats) that noise of thermometers may cost the model, what was found or what might have been."""
    measured = session.record
    here, lost = measured.present, [0.0]
    for estimate in (session.baseline, selection.estimate):
        before, after = (np.asarray(estimate.model.predict(r.signals))[: r.rows][here] for r in (measured, smooth))
        lost.append(0.5 * float(np.sum((after - before) ** 2)) / estimate.white_variance)
    first = selection.first
    for name in thermometers(measured.signals):
        before, after = (np.asarray(r.signals[name])[: r.rows][here] for r in (measured, smooth))
        share = np.var(after - before) / max(np.var(before), np.finfo(float).tiny)
        lost.append(float(share) * max(first.statistic.values()))
    return max(lost)


def without_axis(
    measured: Sequence[Campaign], axis: str, model: GyroModel, threshold: float, say: Progress
) -> tuple[Data, Session, Selection] | None:
    """The search of a platform's runs about other axes, if there are any and what it finds explains them."""
    try:
        data = read(measured, without=axis)
        record, _ = with_columns_known(data.record)
        session = laid_out(record, model, threshold, data.step)
    except (CampaignError, EstimateError):
        return None
    selection = session.run(say)
    explained = selection.found and not unexplained_axes(selection.estimate)
    return (data, session, selection) if explained else None


def over_weighted(session: Session, grows: Growth, model: GyroModel, say: Progress) -> tuple[Session, Selection] | None:
    """The search of samples weighted by their noise levels, where it leaves no structure that passes for a level.

    What little may be left where samples count least cannot, where the level is much more certain.
    """
    record, scanner = with_variance(session.record, grows.white), session.scanner
    try:
        baseline = fit_record(record, model, start=_counted(session.baseline))
    except EstimateError:
        return None
    kept = {"outliers": scanner.outliers, "stated": baseline.noise_given, "step": scanner.step}
    weighted = Scanner(record, scanner.bank, _grid(record, baseline), **kept)
    again = Session(weighted, baseline, session.threshold)
    selection = again.run(say)
    passes = selection.remains or max(grows.ratio, 1.0 / grows.ratio) * selection.followed >= grows.evidence
    return None if selection.unfinished and passes else (again, selection)


def _counted(baseline: Estimate) -> NoiseRatios | None:
    """The noise to begin with where a fit has white noise of the angle, which may show only beside what is found."""
    return None if baseline.ratios.quantisation is None else baseline.ratios


def _grid(record: Record, baseline: Estimate) -> NoiseGrid:
    """Noise cells: the whole family; where the model states its noise, that cell first."""
    grid, stated = noise_grid(int(record.present.sum()), record.interval, record.span), baseline.ratios
    # White noise of the angle is told by its own frequencies, and held at what the fit says.
    grid = grid._replace(ratios=grid.ratios._replace(quantisation=stated.quantisation))
    if not baseline.noise_given:
        return grid
    prior, each = grid.log_prior, [np.asarray(r) for r in np.broadcast_arrays(*grid.ratios.each())]
    if float(stated.markov):
        # Beside less of it than stated, which is none, as much: in the cells that can hold it.
        room = each[0] == 0
        level = np.stack(each)[:, room]
        level[2:4] = [[float(stated.markov)], [float(stated.constant)]]
        each = [np.concatenate([a, b]) for a, b in zip(each, level, strict=True)]
        prior = np.concatenate([prior, prior[room]])
    ratios = NoiseRatios(*(np.append(float(a), b) for a, b in zip(stated.each(), each, strict=True)))
    return grid._replace(ratios=ratios, log_prior=np.concatenate([[0.0], prior]))
