"""Reference rates from a measured attitude, such as an optical one."""

from __future__ import annotations

import re
from collections.abc import Iterable

import numpy as np
from jaxtyping import Float
from scipy.signal import savgol_filter

from gyromodel._checks import MISSING_STEP, CampaignError
from gyromodel.campaign import AXES, Campaign

# Seconds, and at least so many samples, through which a cubic is laid. Sampled at 100 Hz or faster it passes 99 % of a
# rate at 10 Hz, at 50 Hz 93 %.
WINDOW, FEWEST = 0.05, 5
# Columns that are a reference rate, so that none is taken from the attitude.
_REFERENCE = re.compile(r"rate(_(?!estimated).*)?")
COLUMNS = tuple(f"attitude_{part}" for part in "wxyz")


def refuse_navigated(campaigns: Iterable[Campaign]) -> None:
    """What `navigate` has computed from the outputs says nothing of them.

    Raises:
        CampaignError: a campaign has such columns.
    """
    for campaign in campaigns:
        if "navigated" in campaign.metadata:
            raise CampaignError(
                f"{campaign.name}: its attitude, velocity and position were computed from its outputs, and tell "
                "nothing of the gyro: take the log that was navigated"
            )


def with_reference_rates(campaign: Campaign) -> tuple[Campaign, str]:
    """The campaign with the rates of its attitude, where it has one and no rate, and what to know of it, a sentence.

    The columns `attitude_w/_x/_y/_z` become `rate_x/_y/_z`, relative to the frame of the attitude, and the one about
    the axis of a single-axis campaign (metadata `axis`) becomes `rate`; rows where the attitude is missing, or too near
    a gap for its slope, are left out. Any other campaign is returned as it is, and so is one whose attitude gives none.

    Args:
        campaign: the attitude as a quaternion that turns vectors from the gyro's axes to the reference frame; either
            sign is the same attitude.
    """
    if not set(COLUMNS) <= set(campaign.columns) or any(_REFERENCE.fullmatch(n) for n in campaign.columns):
        return campaign, ""
    axis = str(campaign.metadata.get("axis")) if "output" in campaign.columns else ""
    attitude = np.column_stack([campaign.columns[n] for n in COLUMNS])
    rates = body_rates(campaign.si("time"), attitude)
    known = np.isfinite(rates).all(axis=1)
    reason = ""
    if axis and axis not in AXES:
        reason = "metadata 'axis' does not say about which of its axes, x, y or z, the gyro senses"
    elif not np.nanmax(np.abs(np.linalg.norm(attitude, axis=1) - 1.0), initial=0.0) < 0.1:
        reason = "it is no unit quaternion in every row"
    elif known.sum() < 3:
        reason = f"it has no stretch of {WINDOW:g} s without gaps"
    if reason:
        return campaign, f"{campaign.name}: the attitude was not used, as {reason}."
    rated = campaign
    for letter, values in zip(AXES, rates.T, strict=True):
        rated = rated.with_column("rate" if letter == axis else f"rate_{letter}", values, "rad/s")
    for name in COLUMNS:
        rated = rated.without(name)
    lost = int(np.sum(~known))
    said = f"{campaign.name}: {lost} rows without a rate from the attitude were left out."
    return rated.select(known), said if lost else ""


def body_rates(
    time: Float[np.ndarray, " sample"], attitude: Float[np.ndarray, "sample 4"]
) -> Float[np.ndarray, "sample 3"]:
    """Angular rate (rad/s) in the axes of the body, 2 q* q̇, with q̇ the slope of a cubic through the samples around.

    Args:
        time: seconds, increasing; its usual step is taken for all within a stretch.
        attitude: quaternions (w, x, y, z) from body to reference; NaN where missing.

    Returns:
        The rates; NaN within half a window of a gap or an end.
    """
    step = float(np.median(np.diff(time)))
    half = max(round(WINDOW / step) // 2, FEWEST // 2)
    good = np.asarray(np.isfinite(attitude).all(axis=1))
    # A stretch begins where the row before it is missing or too long ago.
    starts = good & ~(np.r_[False, good[:-1]] & (np.diff(time, prepend=-np.inf) < MISSING_STEP * step))
    rates = np.full((len(time), 3), np.nan)
    ends = np.flatnonzero(good & np.r_[starts[1:] | ~good[1:], True]) + 1
    for first, end in zip(np.flatnonzero(starts), ends, strict=True):
        q = attitude[first:end]
        if len(q) <= 2 * half:
            continue
        q = q * np.cumprod(np.r_[1.0, np.where(np.sum(q[1:] * q[:-1], axis=1) < 0, -1.0, 1.0)])[:, None]
        smooth, slope = (
            np.asarray(savgol_filter(q, 2 * half + 1, 3, deriv=d, delta=step, axis=0))[half:-half].T for d in (0, 1)
        )
        (w, v), (dw, dv) = ((q[0], q[1:]) for q in (smooth, slope))
        rate = 2.0 * (w * dv - dw * v - np.cross(v, dv, axis=0)) / np.sum(smooth**2, axis=0)
        rates[first + half : first + half + rate.shape[1]] = rate.T
    return rates
