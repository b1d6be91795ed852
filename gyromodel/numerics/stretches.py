"""Stretches of a record between gaps, and what each of them is by itself when it is smoothed."""

from __future__ import annotations

import numpy as np

from gyromodel.numerics.leaks import behind_leaks
from gyromodel.numerics.smoothing import smooth_derivative, smooth_values

# A step this many times the median one separates stretches of a record.
GAP = 10.0


def stretches_of(time: np.ndarray) -> np.ndarray:
    """The number of each sample's stretch between gaps, from 0."""
    step = np.diff(time)
    typical = np.median(step)
    return np.concatenate([[0], np.cumsum(step > GAP * typical)]).astype(int)


def derivative_by_stretch(time: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Derivative of smoothed values, each stretch by itself; a sample alone takes the slope to its neighbours."""
    good = np.isfinite(values)
    rate = np.full(len(time), np.nan)
    if good.sum() < 2:
        return rate
    rate[good] = np.gradient(values[good], time[good])
    for here in _known(time, values):
        rate[here] = smooth_derivative(time[here], values[here])
    return rate


def smooth_by_stretch(time: np.ndarray, values: np.ndarray, drive: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Smoothed values and their derivative, each stretch by itself: a spline, and what a drive explains behind leaks.

    The spline is its mean where it varies less than the values do about it.
    """
    smooth, rate = values.copy(), derivative_by_stretch(time, values)
    for here in _known(time, values):
        driven, flow = behind_leaks(time[here], values[here], drive[here])
        rest = values[here] - driven
        curve = smooth_values(time[here], rest)
        smooth[here] = driven + (curve if np.var(curve) > np.var(rest - curve) else rest.mean())
        if driven.any():
            rate[here] = flow + smooth_derivative(time[here], rest)
    return smooth, rate


def _known(time: np.ndarray, values: np.ndarray) -> list[np.ndarray]:
    """The known samples of each stretch that has two or more."""
    known = np.flatnonzero(np.isfinite(values))
    each = np.split(known, np.flatnonzero(np.diff(stretches_of(time)[known])) + 1)
    return [here for here in each if len(here) > 1]
