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
from scipy.linalg import solve_triangular
from scipy.special import gammaln
from threadpoolctl import ThreadpoolController

from gyromodel.diagnosis._bank import Bank
from gyromodel.diagnosis._batch import Batch, CellResult
from gyromodel.diagnosis._cells import Cell, Cells
from gyromodel.diagnosis._evidence import log_evidence_ratio, log_mean_evidence, log_mean_of_parts
from gyromodel.diagnosis._lines import PEAK_WIDTH, PEAKS, Line, line_grid
from gyromodel.diagnosis._points import MOST_APART, MOST_POINTS, SUSPECT, levels, suspects, test_points
from gyromodel.diagnosis._tangents import VANISHED, Tangent, add_tangents
from gyromodel.noise import NoiseGrid
from gyromodel.signals import Record

THREADS = 2
# A form with less than this part of its energy in the rows kept was told by those left out.
LOST = 1e-6
# Of what giving up points explains, the part of a sum that is rounding.
SINGULAR = 1e-10
# Standard deviations below zero that a coefficient which cannot be negative may be found at.
CLEARLY = 4.0
# Lines whose interpolated statistic, were it this much larger, would not pay for the search are left interpolated.
PEAK_SLACK = 1.5
# Further gross errors that are given up with the greatest: evidence of each alone (nats), the search over rows paid
# for, and rows to the next, as errors side by side share theirs.
ERROR_MARGIN, ERROR_DISTANCE = 8.0, 3


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
        # Blocks of one name together and, within it, of one structure.
        parts: dict[str, dict[str, list[int]]] = {}
        for i, block in enumerate(bank.blocks):
            parts.setdefault(block.name, {}).setdefault(block.structure, []).append(i)
        structures = [blocks for of_name in parts.values() for blocks in of_name.values()]
        self._names = list(parts)
        self._order = np.array([i for blocks in structures for i in blocks], int)
        self._structure_starts = np.cumsum([0, *map(len, structures)])[:-1]
        self._name_starts = np.cumsum([0, *map(len, parts.values())])[:-1]
        self._widths = np.array([b.width for b in bank.blocks], int)
        self._positive = np.array([b.effect is not None and b.effect.positive for b in bank.blocks])
        self._least = np.array([b.least for b in bank.blocks])
        self._grown = np.array([b.effect is not None and b.effect.grown for b in bank.blocks])
        self._price = np.array([b.price for b in bank.blocks])
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
        other._lost = np.array([b.kind == "effect" for b in self.bank.blocks]) & (gone > 0)
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
        spare = np.array([contained.get(b.name, 0) for b in self.bank.blocks])
        drivers = np.array([b.kind == "driver" for b in self.bank.blocks], bool)
        least = np.where(drivers, 1, np.maximum(self._widths - spare, 1))
        least = np.where(self._grown & (spare == 0), self._widths + 1, least)
        stacked = np.column_stack([*(t.column for t in tangents), jacobian, residuals])
        stacked = np.where(self.present[:, None], stacked, 0.0)
        p, first = jacobian.shape[1], len(tangents)
        # What follows a line closely is a line that is not steady, and no other line.
        barred = self.lines.barred(lines) if self.lines else np.zeros(0, bool)
        # Once: of what several sets leave, the rest of a curve would be the next.
        points = [] if self.points_among(given_up) else self.points
        most = int(len(points) * (MOST_POINTS if self.by_points else MOST_APART))
        least_score = 0.0 if self.by_points else SUSPECT
        orders = suspects(
            points, levels(self.record, points), jacobian[:, : p - len(given_up)], residuals, most, least_score
        )

        def search(group: Sequence[int]) -> list[Batch]:
            z, cross = self.cells.inner_products(group, stacked)
            batches = []
            for i, g in enumerate(group):
                x, zi = stacked[:, first:], z[i][:, first:]
                batches.append(batch := self._run_cell(g, x, zi, cross[i][:, first:], p, least, barred, points, orders))
                add_tangents(batch, tangents, stacked, z[i], p, self.degrees_of_freedom - p)
            return batches

        # Cells share the cores; BLAS threads on top of them would only wait for one another.
        with _libraries().limit(limits=1, user_api="blas"), ThreadPoolExecutor(THREADS) as pool:
            self.cells.prepare(cells, pool.map)
            groups = self.cells.groups(cells, stacked.shape[1])
            return [batch for group in pool.map(search, groups) for batch in group]

    def to_run_end(self, onwards: np.ndarray) -> np.ndarray:
        """Of sums from each sample to the last, those from each epoch to the end of its run."""
        return onwards[self.epochs] - np.concatenate([onwards, np.zeros_like(onwards[:1])])[self._run_ends]

    @property
    def degrees_of_freedom(self) -> int:
        """Samples present."""
        return int(self.present.sum())

    def _run_cell(
        self,
        g: int,
        x: np.ndarray,
        z: np.ndarray,
        cross: np.ndarray,
        p: int,
        least: np.ndarray,
        barred: np.ndarray,
        points: Sequence[np.ndarray],
        orders: Sequence[np.ndarray],
    ) -> Batch:
        cell = self.cells[g]
        against = x[:, :p].T @ z
        norm = np.sqrt(np.maximum(np.diag(against)[:p], 1e-300))
        scaled = against[:, :p] / np.outer(norm, norm) + 1e-13 * np.eye(p)
        root = np.linalg.inv(np.linalg.cholesky(scaled)) / norm
        jy = root @ against[:, p:]
        rss = np.maximum(np.sum(x[:, p:] * z[:, p:], axis=0) - np.sum(jy**2, axis=0), 1e-300)
        nu = int(self.present.sum()) - p
        log_j = 2.0 * np.log(norm).sum() + np.linalg.slogdet(scaled)[1]
        batch = Batch(-0.5 * cell.log_determinant - 0.5 * log_j - 0.5 * nu * np.log(rss), rss, {}, {}, {}, {})
        zj = z[:, :p] @ root.T
        zy = z[:, p:] - zj @ jy
        cross_j = cross[:, :p] @ root.T
        self._blocks(batch, cell, cross_j, cross[:, p:] - cross_j @ jy, nu, least)
        if self.steps:
            sj, sy = (self.to_run_end(np.cumsum(v[::-1], axis=0)[::-1]) for v in (zj, zy))
            self._single(batch, "bias_step", self.epochs, sy, self.to_run_end(cell.step), sj, nu)
        if self.outliers:
            rows = np.flatnonzero(self.present[: self.record.rows])
            if not self.by_points:
                self._single(batch, "outliers", rows, zy[rows], cell.pulse[rows], zj[rows], nu)
            if any(map(len, orders)):
                self._whole(batch, g, points, orders, zj, zy, nu)
        if self.lines:
            self._lines(batch, g, zj, zy, nu, barred)
        return batch

    def _blocks(
        self, batch: Batch, cell: Cell, cross: np.ndarray, against: np.ndarray, nu: int, least: np.ndarray
    ) -> None:
        """Every block's evidence from inner products of its columns with the baseline's and with the residuals."""
        blocks, draws = len(self.bank.blocks), against.shape[1]
        t_of, q_of, energy = np.zeros((blocks, draws)), np.zeros(blocks), np.zeros(blocks)
        for q, (first, count, start) in self.bank.layout().items():
            own = cell.blocks[q]
            c = cross[start : start + q * count].reshape(count, q, -1)
            b = against[start : start + q * count].reshape(count, q, draws)
            norm = np.sqrt(np.maximum(np.einsum("bii->bi", own), 1e-300))
            a = (own - c @ c.transpose(0, 2, 1)) / (norm[:, :, None] * norm[:, None, :])
            values, vectors = np.linalg.eigh(a)
            keep = values > VANISHED
            along = vectors.transpose(0, 2, 1) @ (b / norm[:, :, None])
            t = np.sum(np.where(keep, 1.0 / np.where(keep, values, 1.0), 0.0)[:, :, None] * along**2, axis=1)
            here = slice(first, first + count)
            out = b[:, 0] < (self._least[here] * a[:, 0, 0] * norm[:, 0] ** 2)[:, None]
            if q > 1 and self._positive[here].any():
                # What would be clearly negative in one of its coefficients.
                inverse = np.where(keep, 1.0 / np.where(keep, values, 1.0), 0.0)
                sizes = vectors @ (inverse[:, :, None] * along)
                spread = np.sqrt(np.einsum("bij,bj->bi", vectors**2, inverse))
                noise = np.sqrt(np.maximum(batch.rss - t, 1e-300) / nu)
                out = (sizes < -CLEARLY * spread[:, :, None] * noise[:, None, :]).any(axis=1)
            t_of[here] = np.where(self._positive[here, None] & out, 0.0, t)
            q_of[here] = keep.sum(1)
            energy[here] = np.sum(values * keep, axis=1) / np.maximum(q_of[here], 1) * np.mean(norm**2, axis=1)
        # A form that loses more columns than the baseline contains is another form in disguise.
        sound = (q_of >= least) & ~self._lost
        energy[~sound] = 0.0
        batch.explained = np.where(sound[:, None], t_of, 0.0)
        ratio = log_evidence_ratio(t_of, batch.rss, nu, q_of[:, None]) - self._price[:, None]
        ratio = np.where(sound[:, None], ratio, -np.inf)[self._order]
        # Structures compete by their mean over shapes; the best shape of the best structure stands for the name.
        means, shapes = log_mean_of_parts(ratio, self._structure_starts)
        evidence, best = log_mean_of_parts(means, self._name_starts)
        forms = self._order[np.take_along_axis(shapes, best, axis=0)]
        energies = np.split(energy[self._order], self._structure_starts[self._name_starts][1:])
        for name, value, form, own in zip(self._names, evidence, forms, energies, strict=True):
            batch.energy[name] = own
            if np.isfinite(value[0]):
                batch.evidence[name] = value
                batch.best[name] = (list(form), t_of[form, np.arange(draws)], q_of[form])

    def _single(
        self, batch: Batch, name: str, where: np.ndarray, b: np.ndarray, own: np.ndarray, cross: np.ndarray, nu: int
    ) -> None:
        left = own - np.sum(cross**2, axis=1)
        keep = left > VANISHED * own
        t = np.where(keep, 1.0 / np.where(keep, left, 1.0), 0.0)[:, None] * b**2
        self._record(batch, name, where, t, np.where(keep, left, 0.0), 1, nu)
        if name == "outliers" and t.shape[1] == 1 and len(where):
            batch.best[name][0][0] = tuple(int(where[i]) for i in _gross(t[:, 0], where, batch.rss[0], nu))

    def _whole(
        self,
        batch: Batch,
        g: int,
        points: Sequence[np.ndarray],
        orders: Sequence[np.ndarray],
        zj: np.ndarray,
        zy: np.ndarray,
        nu: int,
    ) -> None:
        """Sets of anomalous points in a robust order, priced by their number; in a series beside single rows."""
        among = np.unique(np.concatenate(orders))
        marks = np.zeros((len(self.present), len(among)))
        for column, k in zip(marks.T, among, strict=True):
            column[points[k]] = 1.0
        w, cross = self.cells.whiten(g, marks), marks.T @ zj
        length = np.linalg.norm(w, axis=0)
        left, y = (w.T @ w - cross @ cross.T) / np.outer(length, length), marks.T @ zy / length[:, None]
        evidence, explained, dimension = np.full(len(orders), -np.inf), np.zeros(len(orders)), np.zeros(len(orders))
        best: list[tuple[int, ...]] = [()] * len(orders)
        for i, (order, rss) in enumerate(zip(orders, batch.rss, strict=True)):
            sizes = np.arange(1, min(len(order), nu - 1) + 1)
            if not len(sizes):
                continue
            price = (
                gammaln(len(points) + 1) - gammaln(sizes + 1) - gammaln(len(points) - sizes + 1) + np.log(len(sizes))
            )
            chosen = np.searchsorted(among, order[: len(sizes)])
            # What the first, the first two … explain.
            root = np.linalg.cholesky(left[np.ix_(chosen, chosen)] + SINGULAR * np.eye(len(chosen)))
            t = np.minimum(np.cumsum(solve_triangular(root, y[chosen, i], lower=True) ** 2), rss)
            ratio = log_evidence_ratio(t, rss, nu, sizes) - price
            top = int(np.argmax(ratio))
            evidence[i], explained[i], dimension[i] = np.logaddexp.reduce(ratio), t[top], top + 1.0
            best[i] = tuple(sorted(int(r) for k in order[: top + 1] for r in points[k]))
        if self.by_points:
            batch.evidence["outliers"], batch.best["outliers"] = evidence, (best, explained, dimension)
            batch.energy["outliers"] = np.diag(left)
            return
        single, (rows, alone, one) = batch.evidence["outliers"], batch.best["outliers"]
        whole = evidence > single
        batch.evidence["outliers"] = np.logaddexp(single, evidence)
        batch.best["outliers"] = (
            [b if w else r for w, b, r in zip(whole, best, rows, strict=True)],
            np.where(whole, explained, alone),
            np.where(whole, dimension, one),
        )

    def _lines(self, batch: Batch, g: int, zj: np.ndarray, zy: np.ndarray, nu: int, barred: np.ndarray) -> None:
        assert self.lines is not None
        cell = self.cells[g]
        p = zj.shape[1]
        c, s = self.lines.spectrum(np.column_stack([zj, zy]))
        a11 = cell.line[:, 0, 0] - np.sum(c[:, :p] ** 2, axis=1)
        a22 = cell.line[:, 1, 1] - np.sum(s[:, :p] ** 2, axis=1)
        a12 = cell.line[:, 0, 1] - np.sum(c[:, :p] * s[:, :p], axis=1)
        determinant = a11 * a22 - a12**2
        keep = (determinant > 1e-3 * cell.line[:, 0, 0] * cell.line[:, 1, 1]) & (a11 > 0) & ~barred
        weight = np.where(keep, 1.0 / np.where(keep, determinant, 1.0), 0.0)[:, None]
        bc, bs = c[:, p:], s[:, p:]
        t = weight * (a22[:, None] * bc**2 - 2 * a12[:, None] * bc * bs + a11[:, None] * bs**2)
        worth = log_evidence_ratio(PEAK_SLACK * t.max(axis=0), batch.rss, nu, 2) > np.log(len(t))
        if len(worth) == 1 and worth[0]:
            batch.peaks = self._exact_peaks(g, t[:, 0], c, s)
        self._record(batch, "bias_periodic", np.arange(len(t)), t, np.where(keep, a11, 0.0), 2, nu)

    def _exact_peaks(self, g: int, t: np.ndarray, c: np.ndarray, s: np.ndarray) -> dict[int, float]:
        """Correct the statistic around the leading peaks, in place, by their exact energy; what each explains."""
        assert self.lines is not None
        local = np.flatnonzero((t[1:-1] >= t[:-2]) & (t[1:-1] >= t[2:])) + 1
        peaks = local[np.argsort(-t[local])][:PEAKS]
        if not len(peaks):
            return {}
        waves = self.lines.waves(np.resize(peaks, PEAKS))
        w = self.cells.whiten(g, waves)
        pair = w.reshape(len(w), 2, PEAKS)[:, :, : len(peaks)]
        own = np.einsum("nik,njk->kij", pair, pair)
        cross = np.stack([c[peaks], s[peaks]], axis=1)
        a = own - cross[:, :, :-1] @ cross[:, :, :-1].transpose(0, 2, 1)
        sound = np.linalg.det(a) > 1e-3 * own[:, 0, 0] * own[:, 1, 1]
        a[~sound] = np.eye(2)
        data = cross[:, :, -1:]
        right = np.where(sound, (data.transpose(0, 2, 1) @ np.linalg.solve(a, data))[:, 0, 0], 0.0)
        before = t.copy()
        # No line that was only interpolated may beat the best that is exact.
        np.minimum(t, right.max(), out=t)
        # The strongest last: side lobes of a line are peaks too, and must not overwrite it.
        for k, exact in zip(peaks[::-1], right[::-1], strict=True):
            around = slice(max(k - PEAK_WIDTH, 0), k + PEAK_WIDTH + 1)
            t[around] = np.minimum(before[around] * (exact / before[k] if before[k] > 0 else 0.0), exact)
        return {int(k): float(exact) for k, exact in zip(peaks, right, strict=True)}

    def _record(
        self, batch: Batch, name: str, where: np.ndarray, t: np.ndarray, energy: np.ndarray, q: int, nu: int
    ) -> None:
        if not len(where):
            return
        top = np.argmax(np.minimum(t, batch.rss), axis=0)
        best = np.minimum(t[top, np.arange(len(top))], batch.rss)
        batch.evidence[name] = log_mean_evidence(t, batch.rss, nu, q)
        batch.best[name] = (list(where[top]), best, np.full(len(top), float(q)))
        batch.energy[name] = energy


def epochs_of(record: Record) -> tuple[np.ndarray, np.ndarray]:
    """Samples that a step may come before, with two of their run or more on either side; and where their runs end."""
    run, rows = record.run, np.flatnonzero(record.present)
    parts = [part[2:-1] for part in np.split(rows, np.flatnonzero(np.diff(run[rows])) + 1)]
    epochs = np.concatenate(parts)
    return epochs, np.searchsorted(run, run[epochs], side="right")


def _gross(t: np.ndarray, where: np.ndarray, rss: float, nu: int) -> list[int]:
    """The greatest of many gross errors and, after it, each that is certain once those before it are given up."""
    order = np.argsort(-t)
    chosen, left = [int(order[0])], float(rss - t[order[0]])
    for i in order[1:]:
        if np.abs(where[chosen] - where[i]).min() < ERROR_DISTANCE:
            continue
        if not 0.0 < t[i] < left:
            break
        alone = log_evidence_ratio(t[[i]], left, nu - len(chosen), 1)[0] - np.log(len(t))
        if alone < ERROR_MARGIN:
            break
        chosen.append(int(i))
        left -= float(t[i])
    return chosen
