"""Means of consecutive samples, where a fit or a search needs no more rows."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from scipy.interpolate import make_interp_spline

from gyromodel._checks import MISSING_STEP, NUMBERED
from gyromodel._output_rate import rate_output
from gyromodel.campaign import Campaign
from gyromodel.numerics.stretches import GAP
from gyromodel.units import factor, from_internal, is_angle

MAXIMUM_ROWS = 20_000
# Degrees that an angle may turn within a mean: a cosine loses 1 % of its amplitude.
MOST_TURN = 30.0
# Rates from an attitude err by its noise and its smoothing at high frequencies; their means over so long (s) hardly do.
MEAN_OF_ATTITUDE = 0.2
# Of splines through rates: at twelve rows a period a cubic one's means are wrong by 10⁻⁴, one of this degree's by 10⁻⁶.
DEGREE = 5
# Part of a corner's change of slope that those at the two rows before it, or at the two behind, stay below.
STRAIGHT = 0.1


def average(campaign: Campaign, maximum: int = MAXIMUM_ROWS, seconds: float = 0.0) -> tuple[Campaign, int]:
    """Means of consecutive samples, never across a gap or a change of segment, run or position.

    Increments and angles of the output become rates, so that a mean is one whatever its samples' spacing; other angles
    are averaged by cosine and sine. Means are of the samples with an output, where there are any: of a column that is
    known beside none of these, of all. Where a stretch ends, a
    last group of less than half the samples is dropped, unless it is all of the stretch. Of a campaign with a feedback
    ramp the first samples are kept as they are: a mean over its turns tells nothing of its codes.

    Args:
        campaign: one axis.
        maximum: about the most rows to leave.
        seconds: the least length of a mean.

    Returns:
        The shorter campaign and how many samples went into each mean (1: unchanged).
    """
    rows = len(campaign)
    time = campaign.columns["time"]
    if rows > maximum and "feedback_ramp" in campaign.columns:
        return campaign.select(np.arange(rows) < maximum), 1
    together = max(-(-rows // maximum), round(seconds / float(np.median(np.diff(campaign.si("time"))))))
    if together == 1:
        return campaign, 1
    if campaign.metadata["kind"] != "rate":
        campaign = as_rate(campaign)
    step = np.diff(time)
    breaks = np.concatenate([[False], step > GAP * np.median(step)])
    for name in NUMBERED:
        if name in campaign.columns:
            breaks |= np.concatenate([[False], np.diff(campaign.columns[name]) != 0])
    stretch = np.cumsum(breaks)
    first = np.flatnonzero(np.concatenate([[True], np.diff(stretch) > 0]))
    within = np.arange(rows) - first[stretch]
    starts = np.flatnonzero(within % together == 0)
    counts = np.diff(np.append(starts, rows))
    kept = (2 * counts >= together) | (within[starts] == 0)
    columns, measured = {}, np.isfinite(campaign.columns.get("output", time))
    for name, values in campaign.columns.items():
        seen = np.isfinite(values)
        seen &= measured | ~np.repeat(np.logical_or.reduceat(seen & measured, starts), counts)
        total, count = (np.add.reduceat(x, starts)[kept] for x in (np.where(seen, values, 0.0), seen.astype(float)))
        columns[name] = np.where(count > 0, total / np.maximum(count, 1.0), np.nan)
        if is_angle(campaign.units[name]):
            # By its cosine and sine, beside the first value of the group: 359 and 1 deg have the mean 360 deg.
            first_seen = np.minimum.reduceat(np.where(seen, np.arange(rows), rows - 1), starts)
            origin, scale = values[first_seen], factor("rad", campaign.units[name])
            away = (values - np.repeat(origin, counts)) / scale
            sine, cosine = (np.add.reduceat(np.where(seen, f(away), 0.0), starts) for f in (np.sin, np.cos))
            columns[name] = np.where(count > 0, (origin + np.arctan2(sine, cosine) * scale)[kept], np.nan)
    return Campaign(columns, campaign.units, campaign.metadata, campaign.name), together


def turning(campaign: Campaign, together: int) -> list[str]:
    """Angles that often turn so far within a mean of so many samples that their cosine and sine lose by it."""
    found = []
    for name in campaign.covariates:
        if is_angle(campaign.units[name]) and together > 1:
            angle = campaign.si(name)
            angle = np.unwrap(angle[np.isfinite(angle)])
            turned = np.abs(angle[together:] - angle[:-together])
            if len(turned) and np.quantile(turned, 0.9) > np.deg2rad(MOST_TURN):
                found.append(name)
    return found


def as_rate(campaign: Campaign) -> Campaign:
    """The campaign with its output as a rate, whatever it recorded."""
    if campaign.metadata["kind"] == "rate":
        return campaign
    output, _ = rate_output(campaign)
    unit = f"{campaign.units['output']}/s"
    return Campaign(
        {**campaign.columns, "output": from_internal(output, unit)},
        {**campaign.units, "output": unit},
        {**campaign.metadata, "kind": "rate"},
        campaign.name,
    )


def with_interval_rates(campaign: Campaign) -> Campaign:
    """The campaign with its output as a rate, and reference rates as their means over the interval before each row.

    The means are those of quintic splines through the rates, from corner to corner of these. In the first row and
    behind gaps none is known, and the output is left out.
    """
    campaign = as_rate(campaign)
    time, step = campaign.columns["time"], np.diff(campaign.columns["time"], prepend=np.nan)
    unknown = ~(step <= MISSING_STEP * np.nanmedian(step))
    for name in campaign.covariates:
        values = campaign.columns[name]
        if name.partition("_")[0] == "rate" and np.isfinite(values).all():
            means = np.where(unknown, values, _turned(time, values) / step)
            campaign = campaign.with_column(name, means, campaign.units[name])
    output = np.where(unknown, np.nan, campaign.columns["output"])
    return campaign.with_column("output", output, campaign.units["output"])


def _turned(time: np.ndarray, rate: np.ndarray) -> np.ndarray:
    """What a rate has turned since the row before; nothing is known of the first.

    A spline through a corner, where a table changes its acceleration at once, would be wrong on both sides of it.
    """
    turned = np.full(len(time), np.nan)
    for begin, end in pairwise([0, *_corners(time, rate), len(time) - 1]):
        part = slice(begin, end + 1)
        spline = make_interp_spline(time[part], rate[part], min(DEGREE, end - begin))
        turned[begin + 1 : end + 1] = np.diff(spline.antiderivative()(time[part]))
    return turned


def _corners(time: np.ndarray, rate: np.ndarray) -> np.ndarray:
    """Rows where a straight course of the rate begins or ends: its slope changes there, and not at the two beyond."""
    change = np.abs(np.diff(np.diff(rate) / np.diff(time)))
    inner = change[2:-2]
    before, after = (np.maximum(change[k : len(change) - 4 + k], change[k + 1 : len(change) - 3 + k]) for k in (0, 3))
    return 3 + np.flatnonzero(np.minimum(before, after) < STRAIGHT * inner)
