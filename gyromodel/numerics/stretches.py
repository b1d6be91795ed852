"""Stretches of a record between gaps, and what each of them is by itself when it is smoothed."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

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
    return _by_stretch(time, values, smooth_derivative, rate)


def values_by_stretch(time: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Smoothed values, each stretch by itself; their mean where the curve varies less than they do about it."""

    def of(time: np.ndarray, own: np.ndarray) -> np.ndarray:
        smooth = smooth_values(time, own)
        return smooth if np.var(smooth) > np.var(own - smooth) else np.full(len(own), own.mean())

    return _by_stretch(time, values, of, values.copy())


def _by_stretch(
    time: np.ndarray, values: np.ndarray, of: Callable[[np.ndarray, np.ndarray], np.ndarray], into: np.ndarray
) -> np.ndarray:
    """What `of` makes of each stretch of two known values or more, put into an array."""
    known = np.flatnonzero(np.isfinite(values))
    for here in np.split(known, np.flatnonzero(np.diff(stretches_of(time)[known])) + 1):
        if len(here) > 1:
            into[here] = of(time[here], values[here])
    return into
