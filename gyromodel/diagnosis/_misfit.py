"""What a fit leaves that is no noise of the fitted kinds, however well it explains the rest.

A whitening filter takes what is left for noise. In a vibration test a misfit of a hundredth of the noise's own spread,
at the frequency of each run, is none that it shows: standard uncertainties would be those of a model that holds. A line
that changes is fitted by its mean, and the rest of it is left, like whatever oscillates at no steady frequency.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from numpy.polynomial.legendre import legvander
from scipy.stats import chi2, f, norm

from gyromodel._checks import listed
from gyromodel.campaign import AXES
from gyromodel.diagnosis._drivers import driver_names
from gyromodel.diagnosis._lines import lines_of, near
from gyromodel.estimate import Estimate, filter_of, whiten_columns
from gyromodel.signals import Record

# Probability below which what is left is no noise.
SELDOM = 1e-4
# Part of an oscillation's own size, after what the parameters take of it, below which nothing is left to test.
LEFT = 1e-2
# Polynomials of time by which a line's size and phase may change, and the part of its energy that such a change has.
BENDS, UNSTEADY = 4, 0.2
# Lines nearer to each other than this, over the length of the record, are as well one that changes.
NEAR = 1.5
# Cycles a record up to which a line's distance from half the sample rate is no beat but any slow change of what
# alternates from sample to sample, as folded mains do: no noise of the fits is of that kind, as a walk is of slow bias.
ALTERNATING = 4.0
# Ordinates of a band of frequencies, and its power over that of the others, from which on it is told of.
NARROWEST, EXCESS = 8, 1.25
# Ordinates nearest to a line that tell of the noise there, and how many times the power next to these a column has that
# oscillates too.
BESIDE, SHAKEN = 32, 2.0
# Spreads beyond which a sample is a tail: two such side by side would make a band by themselves.
TAIL = 4.0
# Runs whose intervals differ by more than this ratio have no frequencies in common.
UNLIKE = 1.1


class Band(NamedTuple):
    """A band of frequencies (Hz) that holds more than the fitted noise, and its power over that of the others."""

    low: float
    high: float
    ratio: float

    def told(self, record: Record) -> str:
        """What is said of it, and of measured columns that have more power there too."""
        places = np.linspace(self.low, self.high, 2 + int((self.high - self.low) * record.span / BESIDE))
        return (
            f"Noise of the fitted kinds does not explain what is left from {self.low:.3g} to {self.high:.3g} Hz, with "
            f"{self.ratio:.2g} times the power of the rest: something oscillates there that is no steady line, or it "
            "is noise of another kind." + shaken(record, places)
        )


def unexplained_axes(estimate: Estimate) -> list[str]:
    """Axes X, Y, Z that fail the test below, the worst first."""
    found = axis_probabilities(estimate)
    return sorted((axis for axis in found if found[axis] < SELDOM), key=lambda axis: found[axis])


def axis_probabilities(estimate: Estimate) -> dict[str, float]:
    """Of sines as large in noise alone: χ² of the residual's at the frequencies of all runs about each axis."""
    record, signals = estimate.record, estimate.record.signals
    waves, jacobian = (np.asarray(signals[n]) for n in ("_real", "_imaginary")), estimate.model.linearise(signals)[1]
    # A run of the record is one axis of a run of the log, X, Y and Z in turn.
    moved = [k for k in np.unique(record.run) if np.any(np.asarray(signals["_real"])[record.run == k])]
    if not moved:
        return {}
    sines = np.stack([np.where(record.run == k, wave, 0.0) for wave in waves for k in moved], axis=1)
    columns = np.asarray(whiten_columns(filter_of(record, estimate.ratios), np.column_stack([jacobian, sines])))
    columns = columns[: record.rows][record.present]
    columns = columns / np.linalg.norm(columns, axis=0)
    jacobian, sines = np.split(columns, [-sines.shape[1]], axis=1)
    taken = np.linalg.qr(jacobian)[0]
    sines, axis = sines - taken @ (taken.T @ sines), np.tile(np.array(moved) % 3, 2)
    residual, found = estimate.whitened[record.present], {}
    for a in np.unique(axis):
        left, sizes, _ = np.linalg.svd(sines[:, axis == a], full_matrices=False)
        left = left[:, sizes > LEFT]
        found[AXES[a].upper()] = float(chi2.sf(np.sum((left.T @ residual) ** 2), left.shape[1]))
    return found


def unsteady_lines(estimate: Estimate) -> list[bool]:
    """Whether each line of a model has, or may have, another size or frequency at other times of its campaign.

    Near half the sample rate it may.
    """
    model, record, lines = estimate.model, estimate.record, lines_of(estimate.model)
    if not lines:
        return []
    time = np.asarray(record.signals["time"])[: record.rows]
    number = np.asarray(record.signals.get("campaign", np.ones_like(time)))[: record.rows]
    bent, alternating = [], list[bool]()
    for line in lines:
        within = number == line.campaign if line.campaign else number > 0
        begin, end = time[within].min(), time[within].max()
        bends = legvander(2 * (time - begin) / (end - begin) - 1, BENDS)[:, 1:] * within[:, None]
        wave = np.exp(2j * np.pi * line.frequency * time)[:, None] * bends
        bent += [wave.real, wave.imag]
        beat = abs(0.5 / record.interval - line.frequency) * (end - begin)
        alternating.append(bool(beat < ALTERNATING))
    jacobian = np.asarray(model.linearise(record.signals)[1])
    p = jacobian.shape[1]
    columns = np.pad(jacobian, ((0, 0), (0, 2 * BENDS * len(lines))))
    columns[: record.rows, p:] = np.concatenate(bent, axis=1)
    columns = np.asarray(whiten_columns(filter_of(record, estimate.ratios), columns))[: record.rows][record.present]
    columns = columns / np.linalg.norm(columns, axis=0)
    taken = np.linalg.qr(columns[:, :p])[0]
    residual, sizes_of, found = estimate.whitened[record.present], line_energies(estimate), []
    for k in range(len(lines)):
        wave = columns[:, p + 2 * BENDS * k :][:, : 2 * BENDS]
        left, sizes, _ = np.linalg.svd(wave - taken @ (taken.T @ wave), full_matrices=False)
        left = left[:, sizes > LEFT]
        changing = float(np.sum((left.T @ residual) ** 2))
        seldom = chi2.sf(changing, left.shape[1]) * len(lines) < SELDOM
        beside = any(near(lines[k], other, NEAR / record.span) for other in lines[:k] + lines[k + 1 :])
        changes = bool(seldom and changing > UNSTEADY * (changing + sizes_of[k]))
        found.append(beside or alternating[k] or changes)
    return found


def changed(record: Record, frequencies: list[float], weaker: list[float]) -> str:
    """What is said of lines that change, by their frequencies (Hz), and of weaker ones that are given up with them."""
    places, others = (listed([f"{line:.4g}" for line in sorted(lines)]) for lines in (frequencies, weaker))
    fastest = 0.5 / record.interval
    said = f"What oscillates near {places} Hz changes its size or its frequency: no steady line, and not named."
    said += f" Nor is what oscillates more weakly near {others} Hz." if weaker else ""
    if min(abs(fastest - line) for line in frequencies) * record.span < ALTERNATING:
        said += (
            f" {fastest:.4g} Hz is half the sample rate: there the output alternates from one sample to the next, by "
            "an amount that may change. Faster lines that sampling folds, or a converter, do so: log at another rate."
        )
    return said + shaken(record, frequencies)


def shaken(record: Record, frequencies: Iterable[float]) -> str:
    """What is said of measured columns that have more power about some frequencies (Hz) than next to them."""
    if len(np.unique(record.run[: record.rows])) > 1:
        return ""
    ordinates, length = np.arange(1, record.rows // 2), record.rows * record.interval
    fast = [line * length for line in frequencies if line * length > 2 * BESIDE]
    about, further = (np.any([np.abs(ordinates - k) <= n * BESIDE for k in fast], axis=0) for n in (1, 3))
    if not (further > about).any():
        return ""
    moved = []
    for name in driver_names(record):
        power = np.abs(np.fft.rfft(np.asarray(record.signals[name])[: record.rows])[1 : len(ordinates) + 1]) ** 2
        ratio = power[about].mean() / max(power[further > about].mean(), np.finfo(float).tiny)
        if ratio > SHAKEN and f.sf(ratio, 2 * about.sum(), 2 * (further > about).sum()) < SELDOM:
            moved.append(name)
    if not moved:
        return ""
    there = "oscillates there too" if len(moved) == 1 else "oscillate there too"
    return (
        f" {listed(moved)} {there}: what shakes the gyro, as a dither that sampling folds, moves both, so that one "
        "follows the other and need not be its cause."
    )


def lines_of_noise(estimate: Estimate) -> list[bool]:
    """Whether each line of a model is no larger than what a band of unexplained noise about it makes.

    That is the band's mean power, or that next to the line, where noise that rises to an end of the band has more. A
    line is about the band up to the narrowest that is told apart: the last ordinate is below the highest line.
    """
    lines, band = lines_of(estimate.model), excess_band(estimate)
    if not lines or band is None:
        return [False] * len(lines)
    power, spacing = _periodogram(estimate)
    energies, margin, found = line_energies(estimate), NARROWEST * spacing, list[bool]()
    for line, energy in zip(lines, energies, strict=True):
        nearest = np.argsort(np.abs((1 + np.arange(len(power))) * spacing - line.frequency))[:BESIDE]
        # Of a median, which other lines do not raise.
        mean = float(np.median(power[nearest])) / np.log(2.0)
        chance = max(chi2.sf(energy / band.ratio, 2), f.sf(energy / 2 / mean, 2, len(nearest)))
        about = band.low - margin <= line.frequency <= band.high + margin
        found.append(about and bool(chance * estimate.record.rows / 2 > SELDOM))
    return found


def line_energies(estimate: Estimate) -> np.ndarray:
    """χ² of the cosine and sine of each line of a model."""
    model = estimate.model
    values, slots = np.asarray(model.vector()), list(enumerate(model.slots()))
    found = []
    for k in range(len(lines_of(model))):
        own = [i for i, s in slots if s.linear and s.index == k and model.labels[s.effect] == "bias_periodic"]
        found.append(values[own] @ np.linalg.solve(estimate.covariance[np.ix_(own, own)], values[own]))
    return np.array(found)


def excess_band(estimate: Estimate) -> Band | None:
    """The band of frequencies that has more power than the fitted noise gives it, beyond chance; None where none has.

    Nothing is said of runs of unlike intervals, which have no frequencies in common.
    Bands are halves, quarters and so on of all frequencies, overlapping by half; their number is paid for.
    """
    record = estimate.record
    time, run = np.asarray(record.signals["time"])[: record.rows], record.run[: record.rows]
    each = [np.diff(time[run == k]) for k in np.unique(run)]
    steps = [np.median(step) for step in each if len(step) >= NARROWEST]
    if steps and max(steps) > UNLIKE * min(steps):
        return None
    power, spacing = _periodogram(estimate)
    if not power.any():
        return None
    count, total = len(power), np.concatenate([[0.0], np.cumsum(power)])
    bands, width = [(1.0, 1.0, 0, 0)], count // 2
    while width >= NARROWEST:
        for begin in range(0, count - width + 1, width // 2):
            inside = (total[begin + width] - total[begin]) / width
            ratio = float(inside * (count - width) / (total[-1] - width * inside))
            bands.append((float(f.sf(ratio, 2 * width, 2 * (count - width))), ratio, begin + 1, begin + width))
        width //= 2
    seldom, ratio, *ends = min(bands)
    if seldom * len(bands) > SELDOM or ratio < EXCESS:
        return None
    low, high = (k * spacing for k in ends)
    return Band(low, high, ratio)


def _periodogram(estimate: Estimate) -> tuple[np.ndarray, float]:
    """Power of what is left of a fit, whitened, at whole numbers of cycles a record from 1, and their spacing (Hz).

    Mean 1 where the noise is as fitted; the far tails count no more than their bound.
    """
    record = estimate.record
    residual = estimate.whitened[record.present]
    most = TAIL * float(np.median(np.abs(residual))) / norm.isf(0.25)
    if estimate.ratios.quantisation is None or not most > 0.0:
        # Counts have tails of their own: less of these would fall apart less.
        residual = np.clip(residual, -most, most)
    count = (len(residual) - 1) // 2
    power = np.abs(np.fft.rfft(residual))[1 : count + 1] ** 2 / len(residual)
    return power, 1.0 / (len(residual) * record.interval)
