"""Lines at every frequency: the grid that is searched, and the energy of a cosine and sine in coloured noise."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import cast

import numpy as np
import scipy.fft

from gyromodel.model import record_span
from gyromodel.signals import Record

# A line's energy is computed exactly at the lowest frequencies, at log-spaced ones to interpolate between, and at the
# leading peaks of each pass, whose correction holds for their neighbours too.
LOWEST_LINES, SPACED_LINES, PEAKS, PEAK_WIDTH = 24, 24, 12, 6
# Lines closer than this many steps of the grid (a quarter of the resolution each) are one that is not steady.
RESOLVED = 4
# Fewer cycles in the record than this are a trend, not a line.
FEWEST_CYCLES = 1.5


@dataclass
class LineGrid:
    """Frequencies searched for lines (Hz) and the Fourier grid that serves them.

    Attributes:
        frequencies: searched, ascending.
        index: each sample's place on a regular grid of times.
        length: of the Fourier transform.
        first: its bin at the first frequency.
        exact: which frequencies have their energy computed in every noise cell.
        turn: cos and sin around one turn, `length` steps.
    """

    frequencies: np.ndarray
    index: np.ndarray
    length: int
    first: int
    exact: np.ndarray
    turn: tuple[np.ndarray, np.ndarray] = field(repr=False)

    def waves(self, which: np.ndarray) -> np.ndarray:
        """Cosines, then sines, of some frequencies by number."""
        phase = self.index[:, None] * (self.first + which) % self.length
        return np.concatenate([part[phase] for part in self.turn], axis=1)

    def spectrum(self, columns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Inner products of columns with the cosine and with the sine of every frequency."""
        spread = np.stack([np.bincount(self.index, column, self.length) for column in columns.T])
        here = slice(self.first, self.first + len(self.frequencies))
        found = np.asarray(scipy.fft.rfft(spread, axis=1))[:, here].T
        return np.real(found), -np.imag(found)

    def unresolved(self, lines: np.ndarray) -> np.ndarray:
        """Which frequencies the record cannot resolve from any of some lines (Hz)."""
        near = np.abs(self.frequencies[:, None] - lines) < RESOLVED * (self.frequencies[1] - self.frequencies[0])
        return np.asarray(near.any(axis=1))

    def energies(self, cosine: np.ndarray, sine: np.ndarray, cross: np.ndarray) -> np.ndarray:
        """2×2 energies at every frequency from those of the exact ones, each interpolated between.

        Cosine and sine differ at every frequency where the noise walks: the cosine begins with a jump.
        """
        x, at = np.log(self.frequencies), np.log(self.frequencies[self.exact])
        squares = [np.maximum(e, 1e-300) for e in (cosine, sine)]
        cc, ss = (np.exp(np.interp(x, at, np.log(e))) for e in squares)
        cs = np.interp(x, at, cross / np.sqrt(squares[0] * squares[1])) * np.sqrt(cc * ss)
        return np.stack([np.stack([cc, cs], axis=-1), np.stack([cs, ss], axis=-1)], axis=-2)


def line_grid(record: Record) -> LineGrid:
    """A quarter of the record's resolution, up to half the sample rate."""
    time = np.asarray(record.signals["time"])
    span = record_span(record)
    grid = record.interval
    if np.abs(time[: record.rows] / grid - np.round(time[: record.rows] / grid)).max() > 0.1:
        grid /= 4.0
    grid = max(grid, span / 2**18)
    # scipy declares no return type here.
    length = cast(int, scipy.fft.next_fast_len(int(np.ceil(4.0 * (span + grid) / grid)), real=True))
    first = int(np.ceil(FEWEST_CYCLES / span * length * grid))
    frequencies = np.arange(first, length // 2 + 1) / (length * grid)
    frequencies = frequencies[frequencies < 0.5 / record.interval * (1 - 0.5 / record.rows)]
    exact = np.arange(min(LOWEST_LINES, len(frequencies)))
    spaced = np.geomspace(len(exact) + 1, len(frequencies), SPACED_LINES).round().astype(int) - 1
    exact = np.unique(np.concatenate([exact, np.clip(spaced, 0, len(frequencies) - 1)]))
    index = np.minimum(np.round(time / grid).astype(int), length - 1)
    angle = 2.0 * np.pi * np.arange(length) / length
    return LineGrid(frequencies, index, length, first, exact, (np.cos(angle), np.sin(angle)))
