"""Steady lines of a record: found in its spectrum over the background around them, and fitted as regressors."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.ndimage import median_filter
from scipy.optimize import root_scalar

# Chance that noise alone shows a line anywhere in the spectrum.
FALSE_LINE = 1e-3
MOST_LINES = 12
# First frequency searched, in cycles a record, and the frequencies around a line that show its background.
FIRST, AROUND = 12, 81
# Loss of independent frequencies by the Hann window: 1 + 2 (4/9 + 1/36).
HANN = 35.0 / 18.0


class Spectrum(NamedTuple):
    """Two-sided PSD of the longest stretch without gaps, by frequency (Hz); neighbours are correlated by the taper."""

    frequency: np.ndarray
    power: np.ndarray


def spectrum(rate: np.ndarray, interval: float) -> Spectrum:
    """Periodogram under a Hann window, without the mean."""
    n = len(rate)
    taper = 1.0 - np.cos(2.0 * np.pi * (np.arange(n) + 0.5) / n)
    power = np.abs(np.fft.rfft((rate - rate.mean()) * taper)) ** 2 * interval / np.sum(taper**2)
    return Spectrum(np.fft.rfftfreq(n, interval)[1:-1], power[1:-1])


def background(power: np.ndarray) -> np.ndarray:
    """Median of the neighbouring powers, as the mean of exponential ones."""
    return median_filter(power, AROUND, mode="mirror") / np.log(2.0)


def _stands_out(frequencies: int) -> float:
    """Power over background that noise reaches at one of so many frequencies by chance FALSE_LINE.

    The median of n exponential variables scatters by 1/(ln 2 √n) of itself, nearly log-normally.
    """
    scatter = np.sqrt(HANN / AROUND) / np.log(2.0)
    nodes, weights = np.polynomial.hermite_e.hermegauss(60)
    weights /= weights.sum()

    def too_often(power: float) -> float:
        return frequencies * float(weights @ np.exp(-power * np.exp(scatter * nodes))) - FALSE_LINE

    return float(root_scalar(too_often, bracket=(1.0, 1e3)).root)


def find_lines(rate: np.ndarray, time: np.ndarray, interval: float) -> list[float]:
    """Frequencies (Hz) of the lines that stand out, strongest first; at most MOST_LINES."""
    found: list[float] = []
    left, least = rate, _stands_out(len(rate) // 2)
    while len(found) <= MOST_LINES and len(rate) > 4 * FIRST:
        seen = spectrum(left, interval)
        excess = seen.power / background(seen.power)
        excess[:FIRST] = 0.0
        # A line that was taken out leaves its surroundings raised.
        resolution = 1.0 / (len(rate) * interval)
        for frequency in found:
            excess[np.abs(seen.frequency - frequency) < 3.0 * resolution] = 0.0
        k = int(np.argmax(excess))
        if excess[k] < least:
            break
        found.append(_refined(left, time, float(seen.frequency[k]), resolution))
        columns = line_columns(np.asarray(found), time)
        left = rate - columns @ np.linalg.lstsq(columns, rate - rate.mean(), rcond=None)[0]
    return found


def _refined(rate: np.ndarray, time: np.ndarray, frequency: float, resolution: float) -> float:
    """Least squares in the frequency too, by Gauss-Newton steps of at most half a resolution."""
    centred, start = time - time.mean(), frequency
    for _ in range(4):
        c, s = line_columns(np.array([frequency]), centred).T
        a, b = np.linalg.lstsq(np.column_stack([c, s]), rate - rate.mean(), rcond=None)[0]
        columns = np.column_stack([c, s, 2.0 * np.pi * centred * (b * c - a * s)])
        change = np.linalg.lstsq(columns, rate - rate.mean() - a * c - b * s, rcond=None)[0][2]
        frequency += float(np.clip(change, -0.5 * resolution, 0.5 * resolution))
    return frequency if abs(frequency - start) < resolution else start


def refined_within(
    rate: np.ndarray, time: np.ndarray, frequencies: np.ndarray, rows: slice, whole: slice
) -> np.ndarray:
    """Frequencies found on some rows, refined on ever wider stretches up to `whole`, each beside the others.

    A stretch at most doubles, so that the phase stays known from one to the next.
    """
    first, last = rows.start, rows.stop
    while len(frequencies) and (first, last) != (whole.start, whole.stop):
        margin = 0.5 * (time[last - 1] - time[first])
        first = max(int(np.searchsorted(time, time[first] - margin)), whole.start)
        last = min(int(np.searchsorted(time, time[last - 1] + margin, "right")), whole.stop)
        y, t = rate[first:last], time[first:last]
        for j in range(len(frequencies)):
            others = np.column_stack([line_columns(np.delete(frequencies, j), t), np.ones(len(t))])
            left = y - others @ np.linalg.lstsq(others, y, rcond=None)[0]
            frequencies[j] = _refined(left, t, frequencies[j], 1.0 / (t[-1] - t[0]))
    return frequencies


def line_columns(frequencies: np.ndarray, time: np.ndarray) -> np.ndarray:
    """Cosine and sine of each line."""
    phase = 2.0 * np.pi * np.outer(time, frequencies)
    return np.stack([np.cos(phase), np.sin(phase)], axis=-1).reshape(len(time), -1)
