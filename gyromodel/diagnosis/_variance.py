"""Noise that grows with a driver: a score test on whitened residuals, and the variance function that answers it."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from scipy import stats

from gyromodel._checks import listed, thermometers
from gyromodel._noise_level import FORMS
from gyromodel.campaign import Campaign
from gyromodel.declarations import RATE_OF
from gyromodel.estimate import Estimate, EstimateError, fit_record
from gyromodel.model import Level
from gyromodel.numerics.rounding import quantum
from gyromodel.signals import Record

SIGNIFICANT = 1e-5
# Standard deviations from which on the residuals of a high noise level follow one another.
FOLLOW = 4.0
HEAVY = 6.0
# Greatest slope of ln σ² over the range of what it follows; turns of it and of the fit, which end where it changes by
# less than this.
STEEPEST, TURNS, SETTLED = 12.0, 6, 0.02
# Two-sided significance at which a stated noise level is contradicted.
CONTRADICTED = 1e-4
# Sample intervals that differ by this factor are of different kinds.
CHANGED = 1.2
# Steps of the output are said of where each level comes so often, or from this part of the output's scatter on.
OFTEN, COARSE = 50, 0.5
# A stretch that stands still is said of from so many repeats on, and where its other values make it less likely;
# never where more of them repeat than this, as one amid a coarse step then stands by itself.
FEWEST_REPEATS, CHANCE, MOST_REPEATS = 4, 1e-4, 0.5
# Times its greatest other step that a column jumps by once a dead sensor lives again.
JUMP = 2.0


CAMPAIGN = "campaign"
LABELS = {"rate": "|rate|", "temperature": "temperature", "temperature_rate": "|temperature rate|", "time": "time"}


def variance_drivers(record: Record) -> dict[str, np.ndarray]:
    """What the noise may grow with, each scaled to 0…1; of several campaigns a column for each but the first."""
    found = {}
    for name, label in LABELS.items():
        if name in record.signals:
            values = FORMS[name](np.asarray(record.signals[name]))
            inside = values[: record.rows]
            if np.isfinite(inside).all() and np.ptp(inside) > 0:
                found[label] = ((values - inside.min()) / np.ptp(inside))[:, None]
    interval = np.asarray(record.sampling.interval)
    within = ~np.asarray(record.sampling.restart)[: record.rows]
    low, high = np.quantile(interval[: record.rows][within], [0.05, 0.95])
    if high > CHANGED * low:
        # Means over another time have another scatter. Gaps are no interval, nor has a first row one.
        found["sample interval"] = ((np.clip(interval, low, high) - low) / (high - low))[:, None]
    if record.domain == "gyro" and (further := np.arange(1, record.run[-1] + 1)).size:
        found[CAMPAIGN] = (record.run[:, None] == further).astype(float)
    return found


class Growth(NamedTuple):
    """What the noise level follows, the variance it gives each sample, σ at its largest over σ at its least, evidence.

    `ratio_std` is the standard error of that ratio.
    """

    driver: str
    white: np.ndarray
    ratio: float
    ratio_std: float
    evidence: float

    @property
    def column(self) -> str:
        """What the driver is made of."""
        return RATE_OF.format("temperature") if "temperature rate" in self.driver else self.driver.strip("|")

    def level(self, record: Record) -> Level | None:
        """What a model states of it: the driver over the record's range; an interval of samples none can."""
        name = next((name for name, label in LABELS.items() if label == self.driver), None)
        if name is None:
            return None
        values = FORMS[name](np.asarray(record.signals[name])[: record.rows])
        return Level(name, float(values.min()), float(values.max()), self.ratio)

    def told(self, record: Record) -> str:
        """What the noise level follows, as a sentence."""
        if self.driver == CAMPAIGN:
            first = np.unique(record.run[: record.rows], return_index=True)[1]
            levels = np.sqrt(self.white[first] / self.white[0])
            times = listed([f"{level:.3g}" for level in levels])
            return (
                f"The noise level differs from campaign to campaign, {times} times that of the first, which is the one "
                "told; samples are weighted accordingly."
            )
        times = max(self.ratio, 1.0 / self.ratio)
        return (
            f"The noise level follows {self.driver}, {times:.3g} times as large at one end as at the other; samples "
            "are weighted accordingly."
        )


def growing_noise(record: Record, estimate: Estimate) -> Growth | None:
    """The driver that the noise level follows most; None where it follows none, or there is none but rounding."""
    if estimate.white_variance <= record.imprecision:
        return None
    use = np.isfinite(estimate.whitened)
    # Large residuals are shortened, so that a few gross errors do not pass for a trend.
    e = np.minimum(estimate.whitened[use] ** 2, 9.0)
    e = e - e.mean()
    best: tuple[float, float, str, np.ndarray] | None = None
    drivers = variance_drivers(record)
    for label, z in drivers.items():
        x = z[: record.rows][use]
        x = x - x.mean(axis=0)
        explained = x @ np.linalg.lstsq(x, e, rcond=1e-10)[0]
        statistic = len(e) * float(explained @ explained) / max(float(e @ e), 1e-300)
        chance = float(stats.chi2.logsf(statistic, max(np.linalg.matrix_rank(x), 1)))
        if best is None or chance < best[0]:
            best = (chance, statistic, label, z)
    if best is None or best[0] + np.log(len(drivers)) > np.log(SIGNIFICANT):
        return None
    z = np.clip(best[3], 0.0, 1.0)
    x = z[: record.rows][use]
    slope, fitted, alone = np.zeros(x.shape[1]), estimate, np.asarray(record.sampling.white)
    white, changes = alone, list[np.ndarray]()
    # Of a column the level is told halfway along it, of campaigns that of the first.
    middle = np.full(len(slope), 0.5 * (best[2] != CAMPAIGN))
    # Slow noise, which does not grow, is a part of the quiet samples' scatter: in turns.
    for turn in range(TURNS):
        changes.append(_log_slopes(x, fitted.whitened[use] ** 2))
        slope = np.clip(slope + changes[-1], -STEEPEST, STEEPEST)
        white = alone * np.exp((z - middle) @ slope)
        if np.abs(changes[-1]).max() < SETTLED or turn == TURNS - 1:
            break
        try:
            data = with_variance(estimate.record, white)
            fitted = fit_record(data, replace(estimate.model, noise={}), start=estimate.ratios)
        except EstimateError:
            break
    # Along a column, or from the quietest campaign to the loudest.
    along = np.ones(1)
    if best[2] == CAMPAIGN:
        each = np.vstack([np.zeros(len(slope)), np.eye(len(slope))])
        along = each[(each @ slope).argmax()] - each[(each @ slope).argmin()]
    ratio = float(np.exp(0.5 * along @ slope))
    # A turn makes up as much of what the slope lacks as scatter is white, and only that part of it tells the slope.
    share = 1.0 - np.clip((along @ changes[1]) / (along @ changes[0]), 0.0, 0.9) if len(changes) > 1 else 1.0
    x = x - x.mean(axis=0)
    std = ratio * float(np.sqrt(0.5 * along @ np.linalg.pinv(x.T @ x) @ along) / share)
    evidence = 0.5 * (best[1] - len(slope) * np.log(len(e))) - np.log(len(drivers))
    return Growth(best[2], white, ratio, std, float(evidence))


def _log_slopes(x: np.ndarray, square: np.ndarray) -> np.ndarray:
    """Slopes of ln σ² on some columns by iterated gamma regression."""
    design = np.column_stack([np.ones(len(x)), x])
    beta = np.append(np.log(square.mean()), np.zeros(x.shape[1]))
    for _ in range(50):
        mean = np.exp(np.clip(design @ beta, -30, 30))
        step = np.linalg.lstsq(design, np.minimum(square, 16 * mean) / mean - 1.0, rcond=None)[0]
        beta = beta + np.clip(step, -1, 1)
        if np.abs(step).max() < 1e-6:
            break
    return np.clip(beta[1:], -STEEPEST, STEEPEST)


def with_variance(record: Record, white: np.ndarray) -> Record:
    """The record with another relative white variance of each sample."""
    return record._replace(sampling=record.sampling._replace(white=jnp.asarray(white)))


def follow(estimate: Estimate, grows: Growth) -> str | None:
    """A sentence where residuals of a high level follow one another, in time or along the driver, as noise does not."""
    white = grows.white[: estimate.record.rows]
    high = np.flatnonzero(np.isfinite(estimate.whitened) & (white > np.median(white)))
    for order in (high, high[np.argsort(white[high], kind="stable")]):
        e = estimate.whitened[order]
        product = e[1:] * e[:-1]
        if np.abs(product.sum()) > FOLLOW * np.linalg.norm(product):
            return (
                f"Residuals at that end of {grows.driver} follow one another: something that no effect searched "
                "describes may be taken for noise there."
            )
    return None


def tails(estimate: Estimate) -> str | None:
    """A sentence where whitened residuals have far heavier tails than a normal distribution."""
    e = estimate.whitened[np.isfinite(estimate.whitened)]
    if len(e) < 50 or not e.std() or estimate.white_variance <= estimate.record.imprecision:
        return None
    excess = stats.kurtosis(e)
    if excess / np.sqrt(24.0 / len(e)) < HEAVY:
        return None
    return (
        f"Residuals have heavy tails (excess kurtosis {excess:.1f}): intervals that assume normal noise are optimistic."
    )


def steps_of_output(campaign: Campaign) -> str | None:
    """A sentence where the output comes in steps: in few levels, or in steps as large as its scatter.

    Values that never come back are none, such as those of a sweep of rates that are evenly apart.
    """
    name = campaign.outputs[0]
    values = campaign.columns[name][np.isfinite(campaign.columns[name])]
    step = quantum(values) if len(np.unique(values)) < len(values) else None
    scatter = float(np.diff(values).std() / np.sqrt(2.0))
    if step is None or not scatter or (step < COARSE * scatter and len(values) < OFTEN * len(np.unique(values))):
        return None
    return (
        f"The output comes in steps of {step:.5g} {campaign.units[name]}, {step / scatter:.2g} times its scatter from "
        "sample to sample: its quantisation counts as white noise."
    )


def stretch_still(campaign: Campaign) -> slice | None:
    """Rows in which the output repeats one value for longer than its other values make likely."""
    values = campaign.columns[campaign.outputs[0]]
    edges = np.flatnonzero(np.concatenate([[True], values[1:] != values[:-1], [True]]))
    longest = int(np.argmax(np.diff(edges)))
    start, stop = map(int, edges[longest : longest + 2])
    repeats = stop - start - 1
    others = (len(values) - len(edges) + 1 - repeats + 1) / len(values)
    # A value of probability p follows itself with p, and the mean over values of p² is what the others show.
    likely = np.log(len(values)) + 0.5 * repeats * np.log(others)
    if repeats < FEWEST_REPEATS or others > MOST_REPEATS or likely > np.log(CHANCE):
        return None
    return slice(start, stop)


def without_still(campaign: Campaign) -> tuple[Campaign, str | None]:
    """The campaign without what it told while its output stood still, and a sentence on that.

    At an end of its range the output may well stand, and in a lock-in band beside a rate; and nothing may be known of
    an angle or of increments alone: these are kept.
    """
    rows = stretch_still(campaign)
    if rows is None:
        return campaign, None
    name = campaign.outputs[0]
    values, unit = campaign.columns[name], campaign.units[name]
    told = f"The output stands at {values[rows.start]:.6g} {unit} in data rows {rows.start + 1} to {rows.stop} of "
    inside = np.nanmin(values) < values[rows.start] < np.nanmax(values)
    if not inside or "rate" in campaign.columns or campaign.metadata["kind"] != "rate":
        return campaign, (
            f"{told}{campaign.name}: check whether sensor and logger were alive, as steps at its ends would be theirs."
        )
    values = values.copy()
    # The first was read while it lived.
    values[rows.start + 1 : rows.stop] = np.nan
    told = f"{told}{campaign.name}: given up, as no gyro's noise stands still."
    return campaign.with_column(name, values, unit), told


def thermometers_still(campaign: Campaign) -> list[str]:
    """Sentences on thermometers that repeat one value for longer than the others make likely, and then jump."""
    said = []
    for name in thermometers(campaign.columns):
        values = campaign.columns[name]
        steps = np.abs(np.diff(values))
        edges = np.flatnonzero(np.concatenate([[True], steps != 0.0, [True]]))
        longest = int(np.argmax(np.diff(edges)))
        start, stop = edges[longest : longest + 2]
        others = np.concatenate([steps[: max(start - 1, 0)], steps[stop:]])
        repeats, share = stop - start - 1, np.mean([*(others == 0.0), True])
        likely = np.log(len(values)) + repeats * np.log(share)
        if repeats < FEWEST_REPEATS or stop == len(values) or likely > np.log(CHANCE):
            continue
        if steps[stop - 1] > JUMP * np.nanmax(others):
            said.append(
                f"{name} stands at {values[start]:.6g} {campaign.units[name]} in data rows {start + 1} to {stop} of "
                f"{campaign.name}, and then jumps: check its sensor, as what is found may be that sensor's."
            )
    return said


def noise_level(estimate: Estimate) -> float | None:
    """How many times as large as the model states the noise is, where the residuals contradict that; else none."""
    if not estimate.noise_given:
        return None
    gain = float(estimate.model.gain())
    stated = float(estimate.model.noise["noise_white"] * gain) ** 2 / estimate.record.interval
    nu = estimate.degrees_of_freedom
    ratio = estimate.white_variance / stated
    if 2 * min(stats.chi2.sf(nu * ratio, nu), stats.chi2.cdf(nu * ratio, nu)) > CONTRADICTED:
        return None
    return float(np.sqrt(ratio))
