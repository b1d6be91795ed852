"""Values read in steps: their grid, and what rounding makes of values with noise, on the average and in its spread."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.optimize import root_scalar
from scipy.special import ndtr

# Values closer than this part of the largest are one, rounded in two ways: exact ones, and those of some digits. A grid
# is coarser than this by so much, and its values lie on it to that part of a step.
ROUNDED, FINEST, OFF_GRID = (1e-9, 1e-7, 1e-5), 40.0, 0.05
# Edges of steps on either side that noise of half a step reaches, and harmonics of the saw tooth that are added up.
EDGES, HARMONICS = np.arange(0.5, 5.0), np.arange(1.0, 4001.0)
# Noise (steps) from which on rounding adds noise of its own and nothing else, to parts in a hundred thousand.
DITHERED = 0.75


def quantum(values: Float[np.ndarray, " sample"]) -> float | None:
    """The step of the grid that all values lie on; None without one, or where it is too fine for so few values to show.

    Args:
        values: in any unit; NaN where missing.
    """
    levels = np.unique(values[np.isfinite(values)])
    apart = np.diff(levels)
    apart = apart[apart > ROUNDED[0] * np.abs(levels).max(initial=0.0)]
    step = _on_grid(levels, float(apart.min()), np.sort(apart)) if len(apart) else None
    return step if step is not None and levels[-1] - levels[0] < np.isfinite(values).sum() * step else None


def grid_step(values: Float[np.ndarray, " sample"]) -> float | None:
    """As `quantum`, and however fine the grid is: the last digit of numbers written with some digits is one.

    It is the greatest common divisor of their differences, by Euclid's algorithm for numbers that are not quite exact.
    """
    if (step := quantum(values)) is not None:
        return step
    levels = np.unique(values[np.isfinite(values)])
    for rounded in np.multiply(ROUNDED, np.abs(levels).max(initial=0.0)):
        apart = np.unique(np.diff(levels))
        apart = apart[apart > rounded]
        step = float(apart[0]) if len(apart) else 0.0
        for gap in apart:
            left = _remainder(gap, step)
            while left > rounded:
                step, left = left, _remainder(step, left)
            if step < FINEST * rounded:
                break
        if step > FINEST * rounded and (found := _on_grid(levels, step, levels[1:] - levels[0])) is not None:
            return found
    return None


def _remainder(value: float, step: float) -> float:
    left = value % step
    return min(left, step - left)


def _on_grid(levels: Float[np.ndarray, " level"], step: float, apart: Float[np.ndarray, " gap"]) -> float | None:
    """The step that makes rising distances whole numbers of it best, from one that is near; None if levels do not."""
    # Each distance is a whole number of steps, so that dividing by that number tells the step ever better.
    for reach in apart:
        step = reach / max(round(reach / step), 1)
    places = (levels - levels[0]) / step
    step *= float(places[-1] / max(round(places[-1]), 1))
    places = (levels - levels[0]) / step
    return step if np.abs(places - np.round(places)).max() < OFF_GRID else None


def staircase(values: Float[np.ndarray, " sample"], noise: float) -> Float[np.ndarray, " sample"]:
    """What rounding to whole numbers adds to values with normal noise of some standard deviation, on the average."""
    if noise >= DITHERED:
        return np.zeros_like(values)
    below = np.round(values)
    left = (values - below)[:, None]
    if noise <= 0.0:
        return -left[:, 0]
    up, down = ndtr((left - EDGES) / noise), ndtr((-left - EDGES) / noise)
    return np.sum(up - down, axis=1) - left[:, 0]


def rounded_variance(noise: float) -> float:
    """Variance of what is read about its mean, of values anywhere between steps: σ² + 1/12 less the saw tooth's.

    Args:
        noise: standard deviation σ before rounding to whole numbers.
    """
    waves = np.exp(-((2.0 * np.pi * noise * HARMONICS) ** 2)) / (2.0 * (np.pi * HARMONICS) ** 2)
    return float(noise**2 + 1.0 / 12.0 - waves.sum())


def noise_before(variance: float) -> float:
    """Standard deviation before rounding to whole numbers where `variance` is that about the mean of what is read."""
    if variance >= rounded_variance(DITHERED):
        return float(np.sqrt(variance - 1.0 / 12.0))
    if variance <= rounded_variance(0.0):
        return 0.0
    return float(root_scalar(lambda noise: rounded_variance(noise) - variance, bracket=(0.0, DITHERED)).root)
