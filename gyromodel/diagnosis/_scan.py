"""One pass of the search: evidence of every candidate in every noise cell, from the baseline's Jacobian and residual.

Per cell, the candidates' own energies CᵀV⁻¹C are computed once; each round then needs only V⁻¹ applied to the
baseline's columns and residual, and inner products with raw columns. Steps and pulses at every epoch and lines at every
frequency use cumulative sums and Fourier transforms of V⁻¹r instead of columns.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from copy import copy
from functools import cache

import numpy as np
from threadpoolctl import ThreadpoolController

from gyromodel.diagnosis._bank import Bank, BlockTable
from gyromodel.diagnosis._batch import Batch, CellResult
from gyromodel.diagnosis._cells import Cells
from gyromodel.diagnosis._evidence import FEW_SETS
from gyromodel.diagnosis._left import Beside
from gyromodel.diagnosis._lines import Line, line_grid
from gyromodel.diagnosis._one_cell import OneCell
from gyromodel.diagnosis._points import (
    DWELL_FITS,
    FEW_FITTED,
    FITS,
    MOST_APART,
    MOST_POINTS,
    SUSPECT,
    levels,
    suspects,
    test_points,
)
from gyromodel.diagnosis._tangents import Tangent, add_tangents
from gyromodel.noise import NoiseGrid
from gyromodel.signals import Record

THREADS = 2
# Draws worked out at once, more of short records, whose values stay within so many.
LEAST_TOGETHER, MOST_TOGETHER, VALUES_TOGETHER = 64, 256, 2**18
# A form with less than this part of its energy in the rows kept was told by those left out.
LOST = 1e-6


@cache
def _libraries() -> ThreadpoolController:
    return ThreadpoolController()


class Scanner:
    """Evidence of a bank's candidates on one record (or the record less some rows), over noise cells."""

    def __init__(
        self,
        record: Record,
        bank: Bank,
        grid: NoiseGrid,
        *,
        outliers: bool = True,
        stated: bool = False,
        step: float = 0.0,
    ) -> None:
        self.record, self.bank, self.grid = record, bank, grid
        # Of the readings that the output is computed from; none of a gyro.
        self.step = step
        self.present = np.asarray(record.sampling.present)
        # Of data without noise rounding is what is left, and no structure.
        self.least = record.imprecision
        self.runs = int(np.asarray(record.sampling.restart).sum())
        self.steps = "bias_step" in bank.scans
        self.lines = line_grid(record) if "bias_periodic" in bank.scans and record.rows >= 16 else None
        self.outliers = outliers
        # With stated noise the first cell is the statement, and the rest are what it may lack.
        self.stated = stated
        self.only_cells = self.all_cells() if len(grid.log_prior) == 1 else None
        self.points = test_points(record) if outliers else []
        self.by_points = len(self.points) == self.present.sum()
        self.cells = Cells(record.sampling, grid, bank, self.lines)
        self.table = BlockTable(bank)
        self._lost = np.zeros(len(bank.blocks), bool)
        self.epochs, self._run_ends = epochs_of(record)

    def without(self, rows: np.ndarray, cells: list[int] | None) -> Scanner:
        """The same search on the record without some rows, in some of the noise cells, or all.

        An effect's form is left out with the rows that told it: what hardly shows in the others says nothing of them.
        """
        other = copy(self)
        other.record = self.record.without(rows)
        other.present = np.asarray(other.record.sampling.present)
        whole, left = (np.sum(self.bank.columns[present] ** 2, axis=0) for present in (self.present, other.present))
        gone = np.add.reduceat((left < LOST * whole).astype(int), [b.start for b in self.bank.blocks])
        other.points = [p for p in (p[other.present[p]] for p in self.points) if len(p)]
        other._lost = self._lost | (~self.table.drivers & (gone > 0))
        other.epochs, other._run_ends = epochs_of(other.record)
        other.cells, other.only_cells = self.cells.sampled(other.record.sampling), cells
        return other

    def points_among(self, rows: Sequence[int]) -> list[np.ndarray]:
        """The whole points among some rows; single gross errors of a series are none."""
        return [p for p in self.points if np.isin(p, rows).all()]

    def all_cells(self) -> list[int]:
        """Every noise cell."""
        return list(range(len(self.grid.log_prior)))

    def noise_families(self) -> dict[str, list[int]]:
        """Cells by how they differ from the stated noise; none where noise is estimated.

        More of one kind than stated and no more of the other, under that kind's id; no more of either, under "".
        """
        if not self.stated:
            return {}
        flicker, walk = (np.asarray(r) for r in self.grid.ratios[:2])
        more_flicker, more_walk = flicker > 1.5 * flicker[0], walk > 1.5 * walk[0]
        families = {
            "": ~more_flicker & ~more_walk,
            "noise_flicker": more_flicker & ~more_walk,
            "noise_random_walk": more_walk & ~more_flicker,
        }
        return {name: [int(g) for g in np.flatnonzero(f)] for name, f in families.items() if f.any()}

    def _levels(self) -> tuple[np.ndarray, np.ndarray]:
        flicker, walk = (np.unique(np.asarray(r), return_inverse=True)[1] for r in self.grid.ratios[:2])
        return flicker, walk

    def coarse_cells(self) -> list[int]:
        """Every other level of flicker and of walk."""
        flicker, walk = self._levels()
        return [g for g in self.all_cells() if flicker[g] % 2 == 0 and walk[g] % 2 == 0]

    def checked(self, cells: Sequence[int]) -> list[int]:
        """Every other of some cells, as on a board of chess."""
        flicker, walk = self._levels()
        return [g for g in cells if (flicker[g] + walk[g]) % 2 == 0]

    def neighbours(self, cells: set[int]) -> list[int]:
        """These cells and those one level away."""
        flicker, walk = self._levels()
        return [
            g
            for g in self.all_cells()
            if any(abs(flicker[g] - flicker[c]) <= 1 and abs(walk[g] - walk[c]) <= 1 for c in cells)
        ]

    def run(
        self,
        cells: Sequence[int],
        jacobian: np.ndarray,
        residual: np.ndarray,
        contained: dict[str, int],
        lines: Sequence[Line] = (),
        tangents: Sequence[Tangent] = (),
        given_up: Sequence[int] = (),
    ) -> dict[int, CellResult]:
        """Evaluate every candidate against a baseline in the given noise cells.

        Args:
            cells: which.
            jacobian: the baseline's columns, any scale.
            residual: measured minus predicted, as a rate.
            contained: how many of a candidate's columns the baseline already has, by name.
            lines: the baseline's.
            tangents: candidates that continue effects of the baseline.
            given_up: rows that the last of the columns mark.
        """
        batches = self.run_many(cells, jacobian, residual[:, None], contained, lines, tangents, given_up)
        return {g: batch.first() for g, batch in zip(cells, batches, strict=True)}

    def run_many(
        self,
        cells: Sequence[int],
        jacobian: np.ndarray,
        residuals: np.ndarray,
        contained: dict[str, int],
        lines: Sequence[Line] = (),
        tangents: Sequence[Tangent] = (),
        given_up: Sequence[int] = (),
    ) -> list[Batch]:
        """As `run`, for many residuals of one baseline at once (one a column); cells in the order given."""
        least, most_left = self.table.least(contained), self.table.most(contained)
        stacked = np.column_stack([*(t.column for t in tangents), jacobian, residuals])
        stacked = np.where(self.present[:, None], stacked, 0.0)
        p, first = jacobian.shape[1], len(tangents)
        # What follows a line closely is a line that is not steady, and no other line.
        barred = self.lines.barred(lines) if self.lines else np.zeros(0, bool)
        # Once: of what several sets leave, the rest of a curve would be the next.
        points = [] if self.points_among(given_up) else self.points
        most = int(len(points) * (MOST_POINTS if self.by_points else MOST_APART))
        least_score, few = 0.0 if self.by_points else SUSPECT, p - len(given_up) <= FEW_FITTED and not self.by_points
        fitted, fits = jacobian[:, : p - len(given_up)], DWELL_FITS if few else FITS
        orders = suspects(points, levels(self.record, points), fitted, residuals, most, least_score, fits)
        among = np.unique(np.concatenate(orders))
        suspected, orders = [points[k] for k in among], [np.searchsorted(among, order) for order in orders]

        exact, data, nu = stacked[:, : first + p], stacked[:, first + p :], self.degrees_of_freedom - p

        def beside(g: int, z: np.ndarray, cross: np.ndarray) -> Beside:
            both = slice(first, first + p)
            return Beside(self, g, exact[:, both], z[:, both], cross[:, both], barred, suspected, most_left)

        def search(group: Sequence[int]) -> list[Batch]:
            found = []
            for g, (z, cross) in zip(group, self.cells.inner_products(group, stacked), strict=True):
                one = OneCell(beside(g, z, cross), data, z[:, first + p :], cross[:, first + p :])
                found.append(self._searched(one, least, len(points), orders))
                add_tangents(found[-1], tangents, stacked, z, p, nu)
            return found

        def search_draws(group: Sequence[int]) -> list[Batch]:
            [g], found = group, []
            z = self.cells.precision(g, exact)
            baseline = beside(g, z, self.bank.columns.T @ z)
            together = min(max(VALUES_TOGETHER // len(data), LEAST_TOGETHER), MOST_TOGETHER)
            for i in range(0, data.shape[1], together):
                y = data[:, i : i + together]
                own = self.cells.precision(g, y)
                one = OneCell(baseline, y, own, None)
                found.append(self._searched(one, least, len(points), orders[i : i + together]))
                add_tangents(found[-1], tangents, np.hstack([exact, y]), np.hstack([z, own]), p, nu)
            return [Batch.joined(found)]

        many = data.shape[1] > FEW_SETS
        # Cells share the cores; BLAS threads on top of them would only wait for one another.
        with _libraries().limit(limits=1, user_api="blas"), ThreadPoolExecutor(THREADS) as pool:
            self.cells.prepare(cells, pool.map)
            groups = [[g] for g in cells] if many else self.cells.groups(cells, stacked.shape[1])
            return [batch for group in pool.map(search_draws if many else search, groups) for batch in group]

    def _searched(self, one: OneCell, least: np.ndarray, points: int, orders: Sequence[np.ndarray]) -> Batch:
        """What one cell says of every candidate."""
        one.blocks(least, self._lost)
        if self.steps:
            one.steps()
        if self.outliers and not self.by_points:
            one.gross_errors(np.flatnonzero(self.present[: self.record.rows]))
        if self.outliers and any(map(len, orders)):
            one.anomalous_points(points, orders)
        if self.lines:
            one.lines()
        return one.batch

    def to_run_end(self, onwards: np.ndarray) -> np.ndarray:
        """Of sums from each sample to the last, those from each epoch to the end of its run."""
        return onwards[self.epochs] - np.concatenate([onwards, np.zeros_like(onwards[:1])])[self._run_ends]

    @property
    def degrees_of_freedom(self) -> int:
        """Samples present."""
        return int(self.present.sum())


def epochs_of(record: Record) -> tuple[np.ndarray, np.ndarray]:
    """Samples that a step may come before, with two of their run or more on either side; and where their runs end."""
    run, rows = record.run, np.flatnonzero(record.present)
    parts = [part[2:-1] for part in np.split(rows, np.flatnonzero(np.diff(run[rows])) + 1)]
    epochs = np.concatenate(parts)
    return epochs, np.searchsorted(run, run[epochs], side="right")
