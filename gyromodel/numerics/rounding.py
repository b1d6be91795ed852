"""Values read in steps: their grid, and what rounding makes of values with noise, on the average and in its spread."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.optimize import root_scalar
from scipy.special import ndtr

# Values closer than this part of the largest are one, rounded in two ways: exact ones, and those of some digits. A grid
# is coarser than this by so much.
ROUNDED, FINEST = (1e-9, 1e-7, 1e-5), 40.0
# Parts of a value that computing and single precision leave open, how many values tell with how many digits all are
# written, and units of the last of them by which values may lie off a grid.
EXACT, SINGLE, ENOUGH, OFF_GRID = 1e-9, 2.0**-23, 2000, 0.75
# Edges of steps on either side that noise of half a step reaches, and harmonics of the saw tooth that are added up.
EDGES, HARMONICS = np.arange(0.5, 5.0), np.arange(1.0, 4001.0)
# Noise (steps) from which on rounding adds noise of its own and nothing else, to parts in a hundred thousand.
DITHERED = 0.75
# Least noise that is looked for, and values that tell it.
LEAST, SAMPLED = 1e-3, 4096


def quantum(values: Float[np.ndarray, " sample"]) -> float | None:
    """The step of the grid that all values lie on; None without one, or where it is too fine for so few values to show.

    Args:
        values: in any unit; NaN where missing.
    """
    levels, alone = _levels(values)
    if len(levels) < 2:
        return None
    apart = np.diff(levels)
    step = _on_grid(levels, float(apart.min()), np.sort(apart), alone)
    return step if step is not None and levels[-1] - levels[0] < np.isfinite(values).sum() * step else None


def grid_step(values: Float[np.ndarray, " sample"]) -> float | None:
    """As `quantum`, and however fine the grid is: the last digit of numbers written with some digits is one.

    It is the greatest common divisor of their differences, by Euclid's algorithm for numbers that are not quite exact.
    """
    if (step := quantum(values)) is not None:
        return step
    levels, alone = _levels(values)
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
        found = _on_grid(levels, step, levels[1:] - levels[0], alone) if step > FINEST * rounded else None
        if found is not None:
            return found
    return None


def _levels(values: Float[np.ndarray, " sample"]) -> tuple[Float[np.ndarray, " level"], bool]:
    """Different values in order, and whether each was read once."""
    known = np.sort(values[np.isfinite(values)])
    fresh = np.diff(known, prepend=-np.inf) > ROUNDED[0] * np.abs(known).max(initial=0.0)
    return known[fresh], bool(fresh.all())


def _remainder(value: float, step: float) -> float:
    left = value % step
    return min(left, step - left)


def _on_grid(
    levels: Float[np.ndarray, " level"], step: float, apart: Float[np.ndarray, " gap"], alone: bool
) -> float | None:
    """The step that makes rising distances whole numbers of it best, from one that is near; None if levels do not.

    `alone`: whether each of them was read once.
    """
    # Each distance is a whole number of steps, so that dividing by that number tells the step ever better.
    for reach in apart:
        step = reach / max(round(reach / step), 1)
    places = (levels - levels[0]) / step
    step *= float(places[-1] / max(round(places[-1]), 1))
    places = (levels - levels[0]) / step
    off = np.abs(places - np.round(places)) * step
    last, apart = _last_digit(levels), np.diff(np.round(places))
    # Evenly spaced rates make evenly spaced outputs; what is on one grid with another is the same.
    evenly, twice = bool((apart == apart[0]).all()) and len(levels) > 2, bool((apart == 0.0).any())
    near = bool((off <= OFF_GRID * (last + last.max())).all())
    return step if near and not twice and not (evenly and alone) else None


def _last_digit(levels: Float[np.ndarray, " level"]) -> Float[np.ndarray, " level"]:
    """What of each value is open by how it is written: in single precision, or in decimals and digits of all."""
    size = np.abs(levels)
    if (levels == levels.astype(np.float32)).all():
        return SINGLE * size.max() + 0.0 * size
    some = levels[:: -(-len(levels) // ENOUGH)]
    written = [np.format_float_scientific(v, trim="-").partition("e") for v in some]
    digits = [len(text.lstrip("-").replace(".", "")) for text, _, _ in written]
    last = min(int(power) + 1 - n for n, (_, _, power) in zip(digits, written, strict=True))
    leading = np.floor(np.log10(np.where(size > 0.0, size, 1.0)))
    open_digits = np.maximum(10.0**last, 10.0 ** (leading + 1.0 - max(digits)))
    return np.maximum(open_digits, EXACT * size.max())


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


def noise_at(values: Float[np.ndarray, " sample"], variance: float) -> float:
    """As `noise_before`, of values that are known."""
    if variance >= rounded_variance(DITHERED):
        return noise_before(variance)
    left = (values - np.round(values))[:: -(-len(values) // SAMPLED), None]

    def excess(noise: float) -> float:
        up, down = ndtr((left - EDGES) / noise), ndtr((-left - EDGES) / noise)
        mean = np.sum(up - down, axis=1)
        return float(np.mean(np.sum(2.0 * EDGES * (up + down), axis=1) - mean**2)) - variance

    if excess(LEAST) > 0.0:
        return LEAST
    return float(root_scalar(excess, bracket=(LEAST, 2.0 * DITHERED)).root)


def noise_before(variance: float) -> float:
    """Standard deviation before rounding to whole numbers where `variance` is that about the mean of what is read.

    Of values anywhere between whole numbers.
    """
    if variance >= rounded_variance(DITHERED):
        return float(np.sqrt(variance - 1.0 / 12.0))
    if variance <= rounded_variance(0.0):
        return 0.0
    return float(root_scalar(lambda noise: rounded_variance(noise) - variance, bracket=(0.0, DITHERED)).root)
