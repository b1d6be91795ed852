"""Lines at every frequency: the grid that is searched, and the energy of a cosine and sine in coloured noise.

Of several runs each has lines of its own, as every start has its own phase: line k is number k mod F of the F
frequencies, in run k div F.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple, cast

import numpy as np
import scipy.fft

from gyromodel.effects.drivers import BiasPeriodic
from gyromodel.model import GyroModel
from gyromodel.signals import Record

# A line's energy is computed exactly at the lowest and the highest frequencies, at log-spaced ones to interpolate
# between, and at the leading peaks of each pass, whose correction holds for their neighbours too.
LOWEST_LINES, SPACED_LINES, HIGHEST_LINES, PEAKS, PEAK_WIDTH = 24, 24, 12, 12, 6
# Lines closer than this many steps of the grid (a quarter of the resolution each) are one that is not steady.
RESOLVED = 4
# Places in time that a record's samples stand at, at most.
MOST_PLACES = 2**18
# Steps from sample to sample are uneven where most lie this part of the usual one apart.
UNEVEN = 0.3
# Fewer cycles in the record than this are a trend, not a line.
FEWEST_CYCLES = 1.5


class Line(NamedTuple):
    """A line's frequency (Hz), and the campaign that it is in; 0: all."""

    frequency: float
    campaign: int


def lines_of(model: GyroModel) -> list[Line]:
    """The lines that a model has."""
    effects = [e for e in model.effects if isinstance(e, BiasPeriodic)]
    each = [(np.ravel(e.frequency), e.campaigns or (0,) * np.size(e.frequency)) for e in effects]
    return [Line(float(f), c) for frequencies, campaigns in each for f, c in zip(frequencies, campaigns, strict=True)]


def near(one: Line, other: Line, distance: float) -> bool:
    """Whether two lines are of one campaign and nearer to each other than some distance (Hz)."""
    return one.campaign == other.campaign and abs(one.frequency - other.frequency) < distance


@dataclass
class LineGrid:
    """Frequencies searched for lines (Hz) and the Fourier grid that serves them.

    Attributes:
        frequencies: searched in each run, ascending.
        run: of each sample, from 0.
        rows: samples without padding.
        campaigns: by which effects know each run.
        unseen: of each line, whether its run has too few cycles of it, or samples a cycle.
        index: each sample's place on a regular grid of times.
        length: of the Fourier transform.
        first: its bin at the first frequency.
        exact: which frequencies have their energy computed in every noise cell.
        turn: cos and sin around one turn, `length` steps.
    """

    frequencies: np.ndarray
    run: np.ndarray
    rows: int
    campaigns: tuple[int, ...]
    unseen: np.ndarray
    index: np.ndarray
    length: int
    first: int
    exact: np.ndarray
    turn: tuple[np.ndarray, np.ndarray] = field(repr=False)

    def line(self, k: int) -> Line:
        """Line number k."""
        run, i = divmod(k, len(self.frequencies))
        return Line(float(self.frequencies[i]), self.campaigns[run])

    def runs_within(self, first: int, last: int) -> list[tuple[int, slice]]:
        """The runs that some rows belong to, each with its part of them."""
        numbers, starts = np.unique(self.run[first:last], return_index=True)
        return [(int(n), slice(a, b)) for n, a, b in zip(numbers, starts, [*starts[1:], last - first], strict=True)]

    def exact_waves(self) -> np.ndarray:
        """Cosines, then sines, of the exact frequencies, in all runs."""
        return self._waves(self.exact)

    def waves(self, which: np.ndarray) -> np.ndarray:
        """Cosines, then sines, of some lines by number."""
        run, i = np.divmod(which, len(self.frequencies))
        return self._waves(i) * np.tile(self.run[:, None] == run, 2)

    def _waves(self, which: np.ndarray) -> np.ndarray:
        phase = self.index[:, None] * (self.first + which) % self.length
        return np.concatenate([part[phase] for part in self.turn], axis=1)

    def spectrum(self, columns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Inner products of columns with the cosine and with the sine of every line."""
        here = slice(self.first, self.first + len(self.frequencies))
        found = []
        for rows, at, begins in self._places:
            spread = np.zeros((columns.shape[1], self.length), columns.dtype)
            own = columns[rows]
            spread[:, at] = (np.add.reduceat(own, begins) if len(begins) < len(own) else own).T
            found.append(np.asarray(scipy.fft.rfft(spread, axis=1))[:, here])
        both = np.concatenate(found, axis=1).T
        return np.real(both), -np.imag(both)

    @cached_property
    def _places(self) -> list[tuple[slice, np.ndarray, np.ndarray]]:
        """Rows of each run, the places on the grid that they have, and which rows are the first there."""
        runs = self.runs_within(0, self.rows)
        return [(rows, *np.unique(self.index[rows], return_index=True)) for _, rows in runs]

    def barred(self, lines: Sequence[Line]) -> np.ndarray:
        """Which lines their run does not show, or does not resolve from any of some lines."""
        near, barred = RESOLVED * self.frequencies[0] / self.first, self.unseen
        for line in lines:
            there = np.isin(self.campaigns, line.campaign) if line.campaign else np.ones(len(self.campaigns), bool)
            barred = barred | np.outer(there, np.abs(self.frequencies - line.frequency) < near).ravel()
        return barred

    def energies(self, cosine: np.ndarray, sine: np.ndarray, cross: np.ndarray) -> np.ndarray:
        """2×2 energies of every line from those of the exact ones (one axis more: run), each interpolated between.

        Cosine and sine differ at every frequency where the noise walks: the cosine begins with a jump.
        """
        return np.concatenate([self._energies(*one) for one in zip(cosine, sine, cross, strict=True)])

    def _energies(self, cosine: np.ndarray, sine: np.ndarray, cross: np.ndarray) -> np.ndarray:
        x, at = np.log(self.frequencies), np.log(self.frequencies[self.exact])
        squares = [np.maximum(e, 1e-300) for e in (cosine, sine)]
        cc, ss = (np.exp(np.interp(x, at, np.log(e))) for e in squares)
        cs = np.interp(x, at, cross / np.sqrt(squares[0] * squares[1])) * np.sqrt(cc * ss)
        return np.stack([np.stack([cc, cs], axis=-1), np.stack([cs, ss], axis=-1)], axis=-2)


def _highest(interval: float, span: float) -> float:
    """Half the sample rate, less half the resolution: nearer to it a sine fades."""
    return 0.5 / interval - 0.49 / (span + interval)


def _uneven(record: Record) -> bool:
    """Whether samples of each run stand so unevenly that a line and its alias at the mean sample rate look different.

    Most steps are then no multiples of the run's usual one, which bursts of a clock are.
    """
    run, interval = record.run[: record.rows], np.asarray(record.sampling.interval)[: record.rows]
    within = np.flatnonzero(run[1:] == run[:-1]) + 1
    return bool(len(within)) and all(
        _no_multiples(interval[within[run[within] == number]]) for number in np.unique(run[within])
    )


def _no_multiples(step: np.ndarray) -> bool:
    step = step / np.median(step)
    low, high = np.quantile(step, [0.1, 0.9])
    return bool(high - low > UNEVEN and np.median(np.abs(step - np.round(step))) > 0.1)


def line_grid(record: Record) -> LineGrid | None:
    """A quarter of the record's resolution, up to half the sample rate; None where that leaves no frequency."""
    time = np.asarray(record.signals["time"])
    # Where a run begins turns the phases alone.
    time = time - time[np.searchsorted(record.run, record.run)]
    span = record.span
    grid = record.interval
    share = 1.0
    if np.abs(time[: record.rows] / grid - np.round(time[: record.rows] / grid)).max() > 0.1:
        grid /= 4.0
        # What regular times fold, uneven ones tell apart.
        share = 0.5 if _uneven(record) else 1.0
    fastest = _highest(share * record.interval, span)
    if grid < span / MOST_PLACES:
        # Beside long gaps times are rounded to the grid, which slow lines hardly feel.
        grid = span / MOST_PLACES
        fastest = min(fastest, 0.25 / grid)
    # scipy declares no return type here.
    length = cast(int, scipy.fft.next_fast_len(int(np.ceil(4.0 * (span + grid) / grid)), real=True))
    first = int(np.ceil(FEWEST_CYCLES / span * length * grid))
    frequencies = np.arange(first, length // 2 + 1) / (length * grid)
    frequencies = frequencies[frequencies < fastest]
    if not len(frequencies):
        return None
    index = np.minimum(np.round(time / grid).astype(int), length - 1)
    angle = 2.0 * np.pi * np.arange(length) / length
    run = record.run
    # Median interval and span of each run.
    each = (time[: record.rows][run[: record.rows] == r] for r in range(run[-1] + 1))
    runs = [(float(np.median(np.diff(own))) if len(own) > 1 else record.interval, float(np.ptp(own))) for own in each]
    unseen = [
        (frequencies * (lasting + 1e-9 * span) < FEWEST_CYCLES) | (frequencies > _highest(share * step, lasting))
        for step, lasting in runs
    ]
    # A quarter of a run's resolution apart, which is more than one step of the grid for runs shorter than the longest.
    spaced = np.geomspace(min(LOWEST_LINES, len(frequencies) - 1) + 1, len(frequencies), SPACED_LINES)
    exact = [spaced.round().astype(int) - 1]
    for (step, lasting), out in zip(runs, unseen, strict=True):
        seen, stride = np.flatnonzero(~out), max(round(span / (lasting + step)), 1)
        exact += [seen[::stride][:LOWEST_LINES], seen[::-stride][:HIGHEST_LINES]]
    return LineGrid(
        frequencies,
        run,
        record.rows,
        record.run_numbers,
        np.concatenate(unseen),
        index,
        length,
        first,
        np.unique(np.concatenate(exact)),
        (np.cos(angle), np.sin(angle)),
    )
