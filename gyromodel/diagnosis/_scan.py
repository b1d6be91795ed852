"""One pass of the search: evidence of every candidate in every noise cell, from the baseline's Jacobian and residual.

Per cell, the candidates' own energies CᵀV⁻¹C are computed once; each round then needs only V⁻¹ applied to the
baseline's columns and residual, and inner products with raw columns. Steps and pulses at every epoch and lines at every
frequency use cumulative sums and Fourier transforms of V⁻¹r instead of columns.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import cache
from typing import cast

import jax
import jax.numpy as jnp
import numpy as np
import scipy.fft
from scipy.special import gammaln
from threadpoolctl import ThreadpoolController

from gyromodel.diagnosis._bank import Bank
from gyromodel.diagnosis._evidence import log_evidence_ratio, log_mean
from gyromodel.estimate import make_filter, whiten_columns
from gyromodel.model import record_span
from gyromodel.noise import NoiseGrid, NoiseRatios
from gyromodel.numerics.state_space import Filter, step_and_pulse_energy, whiten, whiten_transposed
from gyromodel.signals import Record

# A candidate whose columns keep less than this share of their energy beside the baseline cannot be tested.
VANISHED = 1e-6
# A line's energy is computed exactly at the lowest frequencies, at log-spaced ones to interpolate between, and at the
# leading peaks of each pass, whose correction holds for their neighbours too.
LOWEST_LINES, SPACED_LINES, PEAKS, PEAK_WIDTH = 24, 40, 12, 6
COLUMN_STEP = 16
# Fewer cycles in the record than this are a trend, not a line.
FEWEST_CYCLES = 1.5
THREADS = 2
# Records this short are test points, each of which may be anomalous; longer ones are series with single gross errors.
TEST_POINTS = 40

_energies = jax.jit(step_and_pulse_energy)


@cache
def _libraries() -> ThreadpoolController:
    return ThreadpoolController()


@jax.jit
def _precision(filter: Filter, columns):
    return whiten_transposed(filter, whiten(filter, columns))


@dataclass
class LineGrid:
    """Frequencies searched for lines (Hz) and the Fourier grid that serves them, from its bin number `first` on."""

    frequencies: np.ndarray
    index: np.ndarray
    length: int
    first: int
    exact: np.ndarray
    basis: np.ndarray = field(repr=False)


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
    phase = 2.0 * np.pi * time[:, None] * frequencies[exact]
    index = np.minimum(np.round(time / grid).astype(int), length - 1)
    return LineGrid(frequencies, index, length, first, exact, np.concatenate([np.cos(phase), np.sin(phase)], axis=1))


@dataclass
class Cell:
    """What one noise cell remembers between rounds."""

    filter: Filter
    log_determinant: float
    blocks: dict[int, np.ndarray]
    step: np.ndarray
    pulse: np.ndarray
    line: np.ndarray


@dataclass
class CellResult:
    """One cell's verdict on every candidate, beside its own restricted likelihood."""

    log_likelihood: float
    rss: float
    evidence: dict[str, float]
    best: dict[str, tuple[int | tuple[int, ...], float, float]]
    energy: dict[str, np.ndarray]


@dataclass
class Batch:
    """A cell's results for several residuals: arrays have one entry a residual; `energy` is theirs in common."""

    log_likelihood: np.ndarray
    rss: np.ndarray
    evidence: dict[str, np.ndarray]
    best: dict[str, tuple[list, np.ndarray, np.ndarray]]
    energy: dict[str, np.ndarray]

    def first(self) -> CellResult:
        """The first residual's results as plain numbers."""
        best = {
            name: (form[0] if isinstance(form[0], tuple) else int(form[0]), float(t[0]), float(q[0]))
            for name, (form, t, q) in self.best.items()
        }
        evidence = {name: float(v[0]) for name, v in self.evidence.items()}
        return CellResult(float(self.log_likelihood[0]), float(self.rss[0]), evidence, best, self.energy)


class Scanner:
    """Evidence of a bank's candidates on one record (or the record less some rows), over noise cells."""

    def __init__(
        self, record: Record, bank: Bank, grid: NoiseGrid, *, outliers: bool = True, stated: bool = False
    ) -> None:
        self.record, self.bank, self.grid = record, bank, grid
        self.present = np.asarray(record.sampling.present)
        single = int(np.asarray(record.sampling.restart).sum()) == 1
        self.steps = single and "bias_step" in bank.scans
        self.lines = line_grid(record) if single and "bias_periodic" in bank.scans and record.rows >= 16 else None
        self.outliers = outliers
        # With stated noise the first cell is the statement, and the rest are what it may lack.
        self.stated = stated
        self.only_cells = self.all_cells()[: 1 if stated else None] if stated or len(grid.log_prior) == 1 else None
        self.by_points = int(self.present.sum()) <= TEST_POINTS
        self.cells: dict[int, Cell] = {}
        extra = self.lines.basis if self.lines else np.zeros((len(self.present), 0))
        raw = np.concatenate([bank.columns, extra], axis=1)
        self._raw = jnp.asarray(np.pad(raw, ((0, 0), (0, -raw.shape[1] % COLUMN_STEP))))
        widths = [b.width for b in bank.blocks]
        self._layout = {
            q: (widths.index(q), widths.count(q), bank.blocks[widths.index(q)].start) for q in sorted(set(widths))
        }
        names = [b.name for b in bank.blocks]
        structures = np.array([b.structure for b in bank.blocks])
        self._members = {
            name: [np.flatnonzero(structures == s) for s in dict.fromkeys(structures[np.array(names) == name])]
            for name in dict.fromkeys(names)
        }
        self._widths = np.array([b.width for b in bank.blocks], int)
        self._positive = np.array([b.effect is not None and b.effect.positive for b in bank.blocks])
        self.epochs = np.flatnonzero(self.present[: record.rows])[1:-1]

    def all_cells(self) -> list[int]:
        """Every noise cell."""
        return list(range(len(self.grid.log_prior)))

    def noise_families(self) -> dict[str, list[int]]:
        """Cells with more of one kind of noise than stated, and no more of the other; none where noise is estimated."""
        if not self.stated:
            return {}
        flicker, walk = (np.asarray(r) for r in self.grid.ratios)
        more_flicker, more_walk = flicker > 1.5 * flicker[0], walk > 1.5 * walk[0]
        families = {"noise_flicker": more_flicker & ~more_walk, "noise_random_walk": more_walk & ~more_flicker}
        return {name: [int(g) for g in np.flatnonzero(f)] for name, f in families.items() if f.any()}

    def _levels(self) -> tuple[np.ndarray, np.ndarray]:
        flicker, walk = (np.unique(np.asarray(r), return_inverse=True)[1] for r in self.grid.ratios)
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

    def _prepare(self, g: int) -> Cell:
        ratios = NoiseRatios(self.grid.ratios.flicker[g], self.grid.ratios.walk[g])
        filter = make_filter(ratios, self.grid.interval, self.grid.span, self.record.sampling)
        w = np.asarray(whiten_columns(filter, self._raw))
        blocks = {}
        for q, (_, count, start) in self._layout.items():
            part = w[:, start : start + q * count]
            gram = (part.T @ part).reshape(count, q, count, q)
            blocks[q] = np.ascontiguousarray(np.einsum("bicj->bcij", gram)[np.arange(count), np.arange(count)])
        line = np.zeros((0, 2, 2))
        if self.lines:
            lw = w[:, self.bank.columns.shape[1] :][:, : self.lines.basis.shape[1]]
            line = _line_energy(lw, self.lines)
        step, pulse = (np.asarray(e) for e in _energies(filter))
        return Cell(filter, float(filter.log_determinant), blocks, step, pulse, line)

    def cell(self, g: int) -> Cell:
        """The cell's memory, made at first use."""
        if g not in self.cells:
            self.cells[g] = self._prepare(g)
        return self.cells[g]

    def whiten(self, g: int, columns: jax.Array) -> np.ndarray:
        """Columns whitened in one noise cell."""
        padded = jnp.pad(columns, ((0, 0), (0, -columns.shape[1] % COLUMN_STEP)))
        return np.asarray(whiten_columns(self.cell(g).filter, padded))[:, : columns.shape[1]]

    def run(
        self, cells: Sequence[int], jacobian: np.ndarray, residual: np.ndarray, contained: dict[str, int]
    ) -> dict[int, CellResult]:
        """Evaluate every candidate against a baseline in the given noise cells.

        Args:
            cells: which.
            jacobian: the baseline's columns, any scale.
            residual: measured minus predicted, as a rate.
            contained: how many of a candidate's columns the baseline already has, by name.
        """
        batches = self.run_many(cells, jacobian, residual[:, None], contained)
        return {g: batch.first() for g, batch in zip(cells, batches, strict=True)}

    def run_many(
        self, cells: Sequence[int], jacobian: np.ndarray, residuals: np.ndarray, contained: dict[str, int]
    ) -> list[Batch]:
        """As `run`, for many residuals of one baseline at once (one a column); cells in the order given."""
        spare = np.array([contained.get(b.name, 0) for b in self.bank.blocks])
        drivers = np.array([b.kind == "driver" for b in self.bank.blocks], bool)
        least = np.where(drivers, 1, np.maximum(self._widths - spare, 1))
        stacked = np.column_stack([jacobian, residuals])
        pad = -stacked.shape[1] % COLUMN_STEP
        data = jnp.asarray(np.pad(np.where(self.present[:, None], stacked, 0.0), ((0, 0), (0, pad))))
        # Cells share the cores; BLAS threads on top of them would only wait for one another.
        with _libraries().limit(limits=1, user_api="blas"), ThreadPoolExecutor(THREADS) as pool:
            return list(pool.map(lambda g: self._run_cell(g, data, jacobian.shape[1], stacked.shape[1], least), cells))

    @property
    def degrees_of_freedom(self) -> int:
        """Samples present."""
        return int(self.present.sum())

    def _run_cell(self, g: int, data: jax.Array, p: int, columns: int, least: np.ndarray) -> Batch:
        cell = self.cell(g)
        z = np.asarray(_precision(cell.filter, data))[:, :columns]
        x = np.asarray(data)[:, :columns]
        against = x[:, :p].T @ z
        norm = np.sqrt(np.maximum(np.diag(against)[:p], 1e-300))
        scaled = against[:, :p] / np.outer(norm, norm) + 1e-13 * np.eye(p)
        root = np.linalg.inv(np.linalg.cholesky(scaled)) / norm
        jy = root @ against[:, p:]
        rss = np.maximum(np.sum(x[:, p:] * z[:, p:], axis=0) - np.sum(jy**2, axis=0), 1e-300)
        nu = int(self.present.sum()) - p
        log_j = 2.0 * np.log(norm).sum() + np.linalg.slogdet(scaled)[1]
        batch = Batch(-0.5 * cell.log_determinant - 0.5 * log_j - 0.5 * nu * np.log(rss), rss, {}, {}, {})
        zj = z[:, :p] @ root.T
        zy = z[:, p:] - zj @ jy
        self._blocks(batch, cell, zj, zy, nu, least)
        rows = self.epochs
        if self.steps:
            sj, sy = (np.cumsum(v[::-1], axis=0)[::-1][rows] for v in (zj, zy))
            self._single(batch, "bias_step", rows, sy, cell.step[rows], sj, nu)
        if self.outliers:
            rows = np.flatnonzero(self.present[: self.record.rows])
            if self.by_points:
                self._test_points(batch, cell, zj[rows], zy[rows], rows, nu)
            else:
                self._single(batch, "outliers", rows, zy[rows], cell.pulse[rows], zj[rows], nu)
        if self.lines:
            self._lines(batch, cell, zj, zy, nu)
        return batch

    def _blocks(self, batch: Batch, cell: Cell, zj: np.ndarray, zy: np.ndarray, nu: int, least: np.ndarray) -> None:
        cross = self.bank.columns.T @ zj
        against = self.bank.columns.T @ zy
        blocks, draws = len(self.bank.blocks), zy.shape[1]
        t_of, q_of, energy = np.zeros((blocks, draws)), np.zeros(blocks), np.zeros(blocks)
        for q, (first, count, start) in self._layout.items():
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
            t_of[here] = np.where(self._positive[here, None] & (b[:, 0] < 0), 0.0, t)
            q_of[here] = keep.sum(1)
            energy[here] = np.sum(values * keep, axis=1) / np.maximum(q_of[here], 1) * np.mean(norm**2, axis=1)
        # A form that loses more columns than the baseline contains is another form in disguise.
        sound = q_of >= least
        ratio = log_evidence_ratio(t_of, batch.rss, nu, q_of[:, None])
        for name, structures in self._members.items():
            batch.energy[name] = energy[np.concatenate(structures)]
            # Structures compete by their mean over shapes; the best shape of the best structure stands for the name.
            parts = [mine[sound[mine]] for mine in structures if sound[mine].any()]
            if parts:
                means = np.stack([log_mean(ratio[mine]) for mine in parts])
                tops = np.stack([mine[np.argmax(ratio[mine], axis=0)] for mine in parts])
                top = np.take_along_axis(tops, np.argmax(means, axis=0)[None], axis=0)[0]
                batch.evidence[name] = log_mean(means)
                batch.best[name] = (list(top), t_of[top, np.arange(draws)], q_of[top])

    def _single(
        self, batch: Batch, name: str, where: np.ndarray, b: np.ndarray, own: np.ndarray, cross: np.ndarray, nu: int
    ) -> None:
        left = own - np.sum(cross**2, axis=1)
        keep = left > VANISHED * own
        t = np.where(keep, 1.0 / np.where(keep, left, 1.0), 0.0)[:, None] * b**2
        self._record(batch, name, where, t, np.where(keep, left, 0.0), 1, nu)

    def _test_points(self, batch: Batch, cell: Cell, zj: np.ndarray, zy: np.ndarray, rows: np.ndarray, nu: int) -> None:
        """Sets of anomalous points, up to a third of all: in the order of a robust fit, priced by their number."""
        identity = jnp.zeros((len(self.present), len(rows))).at[rows, np.arange(len(rows))].set(1.0)
        left = np.asarray(_precision(cell.filter, identity))[rows] - zj @ zj.T
        sizes = np.arange(1, max(1, min(len(rows) // 3, nu - 1)) + 1)
        price = gammaln(len(rows) + 1) - gammaln(sizes + 1) - gammaln(len(rows) - sizes + 1) + np.log(len(sizes))
        evidence, sets, explained, dimension = [], [], [], []
        for y, rss in zip(zy.T, batch.rss, strict=True):
            order = _robust_order(left, y)
            t = np.array([_explained(left, y, order[:m]) for m in sizes])
            ratio = log_evidence_ratio(np.minimum(t, rss), rss, nu, sizes) - price
            top = int(np.argmax(ratio))
            evidence.append(float(np.logaddexp.reduce(ratio)))
            sets.append(tuple(int(r) for r in rows[order[: top + 1]]))
            explained.append(t[top])
            dimension.append(top + 1.0)
        batch.evidence["outliers"] = np.array(evidence)
        batch.best["outliers"] = (sets, np.array(explained), np.array(dimension))
        batch.energy["outliers"] = np.diag(left)

    def _lines(self, batch: Batch, cell: Cell, zj: np.ndarray, zy: np.ndarray, nu: int) -> None:
        assert self.lines is not None
        grid, p = self.lines, zj.shape[1]
        count = len(grid.frequencies)
        spread = np.zeros((grid.length, p + zy.shape[1]))
        np.add.at(spread, grid.index, np.column_stack([zj, zy]))
        spectrum = np.asarray(scipy.fft.rfft(spread, axis=0))[grid.first : grid.first + count]
        c, s = np.real(spectrum), -np.imag(spectrum)
        a11 = cell.line[:, 0, 0] - np.sum(c[:, :p] ** 2, axis=1)
        a22 = cell.line[:, 1, 1] - np.sum(s[:, :p] ** 2, axis=1)
        a12 = cell.line[:, 0, 1] - np.sum(c[:, :p] * s[:, :p], axis=1)
        determinant = a11 * a22 - a12**2
        keep = (determinant > 1e-3 * cell.line[:, 0, 0] * cell.line[:, 1, 1]) & (a11 > 0)
        weight = np.where(keep, 1.0 / np.where(keep, determinant, 1.0), 0.0)[:, None]
        bc, bs = c[:, p:], s[:, p:]
        t = weight * (a22[:, None] * bc**2 - 2 * a12[:, None] * bc * bs + a11[:, None] * bs**2)
        if t.shape[1] == 1:
            self._exact_peaks(cell, t[:, 0], c, s)
        self._record(batch, "bias_periodic", np.arange(count), t, np.where(keep, a11, 0.0), 2, nu)

    def _exact_peaks(self, cell: Cell, t: np.ndarray, c: np.ndarray, s: np.ndarray) -> None:
        """Correct the statistic around the leading peaks, in place, by their exact energy."""
        assert self.lines is not None
        local = np.flatnonzero((t[1:-1] >= t[:-2]) & (t[1:-1] >= t[2:])) + 1
        peaks = local[np.argsort(-t[local])][:PEAKS]
        phase = 2.0 * np.pi * np.asarray(self.record.signals["time"])[:, None] * self.lines.frequencies[peaks]
        basis = np.pad(np.concatenate([np.cos(phase), np.sin(phase)], axis=1), ((0, 0), (0, 2 * (PEAKS - len(peaks)))))
        w = np.asarray(whiten_columns(cell.filter, jnp.asarray(basis)))
        for i, k in enumerate(peaks):
            pair = w[:, [i, len(peaks) + i]]
            cross = np.stack([c[k], s[k]])
            a = pair.T @ pair - cross[:, :-1] @ cross[:, :-1].T
            sound = np.linalg.det(a) > 1e-3 * np.prod(np.sum(pair**2, axis=0))
            right = float(cross[:, -1] @ np.linalg.solve(a, cross[:, -1])) if sound else 0.0
            around = slice(max(k - PEAK_WIDTH, 0), k + PEAK_WIDTH + 1)
            t[around] = np.minimum(t[around] * (right / t[k] if t[k] > 0 else 0.0), right)

    def _record(
        self, batch: Batch, name: str, where: np.ndarray, t: np.ndarray, energy: np.ndarray, q: int, nu: int
    ) -> None:
        if not len(where):
            return
        t = np.minimum(t, batch.rss)
        ratio = log_evidence_ratio(t, batch.rss, nu, q)
        top = np.argmax(ratio, axis=0)
        batch.evidence[name] = log_mean(ratio)
        batch.best[name] = (list(where[top]), t[top, np.arange(t.shape[1])], np.full(t.shape[1], float(q)))
        batch.energy[name] = energy


def _explained(left: np.ndarray, y: np.ndarray, chosen: np.ndarray) -> float:
    return float(y[chosen] @ np.linalg.lstsq(left[np.ix_(chosen, chosen)], y[chosen], rcond=1e-10)[0])


def _robust_order(left: np.ndarray, zy: np.ndarray) -> np.ndarray:
    """Rows by how anomalous they are, from a backward search: drop the worst, refit, repeat."""
    rows, dropped = list(range(len(zy))), []
    best: tuple[float, list[int]] = (np.inf, [])
    # Start from every pair of points held good, keep the start whose median misfit is least: masking cannot hide there.
    covariance, y = left, zy
    for i in range(len(rows)):
        for j in range(i):
            out = [k for k in rows if k not in (i, j)]
            shift = np.linalg.lstsq(covariance[np.ix_(out, out)], y[out], rcond=1e-10)[0]
            misfit = np.sort(np.abs(shift))[len(out) // 2]
            if misfit < best[0]:
                best = (float(misfit), [out[k] for k in np.argsort(-np.abs(shift))])
    return np.array(best[1] + dropped)


def _line_energy(whitened: np.ndarray, grid: LineGrid) -> np.ndarray:
    """2×2 energies of cosine and sine at every frequency: exact at some, the mean power interpolated between."""
    count = len(grid.exact)
    c, s = whitened[:, :count], whitened[:, count:]
    cc, ss, cs = (c**2).sum(0), (s**2).sum(0), (c * s).sum(0)
    mean = np.interp(np.log(grid.frequencies), np.log(grid.frequencies[grid.exact]), 0.5 * (cc + ss))
    out = np.zeros((len(grid.frequencies), 2, 2))
    out[:, 0, 0] = out[:, 1, 1] = mean
    low = grid.exact < LOWEST_LINES
    i = grid.exact[low]
    out[i, 0, 0], out[i, 1, 1] = cc[low], ss[low]
    out[i, 0, 1] = out[i, 1, 0] = cs[low]
    return out
