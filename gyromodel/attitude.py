"""Reference rates from a measured attitude, such as an optical one."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.signal import savgol_filter

from gyromodel._checks import MISSING_STEP, CampaignError
from gyromodel.campaign import AXES, Campaign

# Seconds, and at least so many samples, through which a cubic is laid. Sampled at 100 Hz or faster it passes 99 % of a
# rate at 10 Hz, at 50 Hz 93 %.
WINDOW, FEWEST = 0.05, 5
COLUMNS = tuple(f"attitude_{part}" for part in "wxyz")


def with_reference_rates(campaign: Campaign) -> Campaign:
    """The campaign with the rates of its attitude, where it has one and no rate; any other as it is.

    The columns `attitude_w/_x/_y/_z` become `rate_x/_y/_z`, relative to the frame of the attitude; rows where the
    attitude is missing, or too near a gap for its slope, are left out. Fits and searches then take means over 0.2 s.

    Args:
        campaign: the attitude as a quaternion that turns vectors from the gyro's axes to the reference frame; either
            sign is the same attitude.

    Raises:
        CampaignError: there is no stretch of the attitude as long as the window, or its length is not one.
    """
    if not set(COLUMNS) <= set(campaign.columns) or any(n.startswith("rate") for n in campaign.columns):
        return campaign
    time, attitude = campaign.si("time"), np.column_stack([campaign.columns[n] for n in COLUMNS])
    length = np.linalg.norm(attitude, axis=1)
    if not np.nanmax(np.abs(length - 1.0), initial=0.0) < 0.1:
        raise CampaignError(f"{campaign.name}: attitude_w/_x/_y/_z is no unit quaternion in every row")
    rate = body_rates(time, attitude)
    known = np.isfinite(rate).all(axis=1)
    if known.sum() < 3:
        raise CampaignError(f"{campaign.name}: the attitude has no stretch of {WINDOW:g} s without gaps")
    for axis, values in zip(AXES, rate.T, strict=True):
        campaign = campaign.with_column(f"rate_{axis}", values, "rad/s")
    for name in COLUMNS:
        campaign = campaign.without(name)
    return campaign.select(known).with_metadata({"reference": "attitude"})


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
    stretch = np.where(good, np.cumsum(starts), 0)
    rates = np.full((len(time), 3), np.nan)
    for first in np.flatnonzero(starts):
        q = attitude[first : first + int((stretch == stretch[first]).sum())]
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
