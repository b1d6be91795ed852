"""What each noise cell remembers between rounds: its filter, and the energies CᵀV⁻¹C of all that is searched in it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from copy import copy
from dataclasses import dataclass, replace
from itertools import groupby
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gyromodel.diagnosis._bank import Bank
from gyromodel.diagnosis._lines import LineGrid
from gyromodel.estimate import make_filter, whiten_columns
from gyromodel.noise import NoiseGrid
from gyromodel.numerics.state_space import (
    Filter,
    Sampling,
    at_rest,
    step_and_pulse_energy,
    whiten,
    whiten_on,
    whiten_transposed,
)

COLUMN_STEP = 16
# Cells filtered side by side, rows and columns whitened at a time, and about as many columns in one Gram matrix of
# whole blocks: they stay in cache.
CELLS_TOGETHER, ROWS_TOGETHER, COLUMNS_TOGETHER, GRAM_COLUMNS = 8, 1024, 192, 24
# Data are whitened in several cells side by side for at most this many columns: beyond, one alone keeps the processor
# busy.
FEW_COLUMNS, FEW_STEP = 12, 4

_energies = jax.jit(step_and_pulse_energy)
_whiten_rows = jax.jit(whiten_on)


@jax.jit
def weighted(filter: Filter, columns):
    """V⁻¹x."""
    return whiten_transposed(filter, whiten(filter, columns))


@dataclass(frozen=True)
class Cell:
    """What one noise cell remembers between rounds."""

    filter: Filter
    log_determinant: float
    blocks: dict[int, np.ndarray]
    step: np.ndarray
    pulse: np.ndarray
    line: np.ndarray


NO_LINES = np.zeros((0, 2, 2))


class Pack(NamedTuple):
    """Whole blocks of columns that are whitened together.

    `rows` are the columns, some rows at a time; of each part: the width of its blocks (of the lines' 2 × 2: none), the
    first of them, how many, and where their columns begin.
    """

    rows: list[jax.Array]
    parts: list[tuple[int | None, int, int, int]]


class Cells:
    """The noise cells of a grid, each prepared at first use."""

    def __init__(self, sampling: Sampling, grid: NoiseGrid, bank: Bank, lines: LineGrid | None) -> None:
        self._sampling, self._grid, self._lines = sampling, grid, lines
        self._columns, self._layout = bank.columns, bank.layout()
        self._cells: dict[int, Cell] = {}
        blocks: list[tuple[int | None, int, int, np.ndarray]] = [
            (q, q, count, bank.columns[:, start : start + q * count]) for q, (_, count, start) in self._layout.items()
        ]
        if lines:
            pairs = lines.exact_waves().reshape(len(bank.columns), 2, -1).transpose(0, 2, 1)
            blocks.append((None, 2, len(lines.exact), pairs.reshape(len(pairs), -1)))
        self._packs = _packed(blocks)

    def sampled(self, sampling: Sampling) -> Cells:
        """The same cells with other samples missing."""
        other = copy(self)
        other._sampling, other._cells = sampling, {}
        return other

    def __getitem__(self, g: int) -> Cell:
        """The cell's memory, made at first use."""
        if g not in self._cells:
            self.prepare([g], map)
        return self._cells[g]

    def prepare(self, cells: Sequence[int], each: Callable[..., Iterable]) -> None:
        """Prepare those cells that are not yet; `each` is `map` or a pool's."""
        cells = [g for g in cells if g not in self._cells]
        groups = self._alike(cells, CELLS_TOGETHER)
        made = [cell for group in each(self._filters, groups) for cell in group]
        for g, cell in zip(cells, each(self._with_energies, made), strict=True):
            self._cells[g] = cell

    def _filters(self, cells: Sequence[int]) -> list[Cell]:
        """Cells without their candidates' energies."""
        index = np.resize(cells, CELLS_TOGETHER)
        ratios = self._grid.ratios.take(index)
        filter = make_filter(ratios, self._grid.interval, ratios.longest(self._grid.span)[0], self._sampling)
        step, pulse = (np.asarray(e) for e in _energies(filter))
        gain, scale = np.asarray(filter.gain), np.asarray(filter.scale)
        log_determinant = np.asarray(filter.log_determinant)
        made = []
        for i in range(len(cells)):
            own = filter._replace(gain=gain[..., i].copy(), scale=scale[..., i].copy())
            made.append(Cell(own, float(log_determinant[i]), {}, step[:, i].copy(), pulse[:, i].copy(), NO_LINES))
        return made

    def _with_energies(self, cell: Cell) -> Cell:
        """CᵀV⁻¹C of every block and line, a few rows at a time."""
        starts = _row_starts(len(cell.filter.transition))
        filters = [jax.tree.map(lambda part, i=i: np.asarray(part)[i : i + ROWS_TOGETHER], cell.filter) for i in starts]
        blocks = {q: np.zeros((count, q, q)) for q, (_, count, _) in self._layout.items()}
        # Of each run, as noise starts anew there.
        pairs = np.zeros((len(self._lines.campaigns), len(self._lines.exact), 2, 2)) if self._lines else NO_LINES
        for pack in self._packs:
            state = at_rest(cell.filter, pack.rows[0].shape[1])
            for i, filter, rows in zip(starts, filters, pack.rows, strict=True):
                state, whitened = _whiten_rows(state, filter, rows)
                w = np.asarray(whitened)
                for key, first, count, start in pack.parts:
                    if key is not None:
                        _add_squares(blocks[key][first : first + count], w[:, start : start + key * count])
                        continue
                    for run, here in self._lines.runs_within(i, i + len(w)) if self._lines else ():
                        _add_squares(pairs[run, first : first + count], w[here, start : start + 2 * count])
        if not self._lines:
            return replace(cell, blocks=blocks, line=NO_LINES)
        return replace(
            cell, blocks=blocks, line=self._lines.energies(pairs[..., 0, 0], pairs[..., 1, 1], pairs[..., 0, 1])
        )

    def whiten(self, g: int, columns: np.ndarray) -> np.ndarray:
        """Columns whitened in one noise cell."""
        padded = np.pad(columns, ((0, 0), (0, -columns.shape[1] % COLUMN_STEP)))
        return np.asarray(whiten_columns(self[g].filter, padded))[:, : columns.shape[1]]

    def groups(self, cells: Sequence[int], columns: int) -> list[Sequence[int]]:
        """Cells as `inner_products` takes them for data of so many columns."""
        return self._alike(cells, CELLS_TOGETHER if columns <= FEW_COLUMNS else 1)

    def _alike(self, cells: Sequence[int], together: int) -> list[Sequence[int]]:
        """Groups of cells of one longest time constant."""
        longest = np.broadcast_to(self._grid.ratios.longest(self._grid.span), len(self._grid.log_prior))
        groups: list[Sequence[int]] = []
        for _, alike in groupby(cells, lambda g: longest[g]):
            same = list(alike)
            groups += [same[i : i + together] for i in range(0, len(same), together)]
        return groups

    def precision(self, g: int, data: np.ndarray) -> np.ndarray:
        """V⁻¹x of the data's columns in one noise cell."""
        columns = data.shape[1]
        return np.asarray(weighted(self[g].filter, np.pad(data, ((0, 0), (0, -columns % COLUMN_STEP)))))[:, :columns]

    def inner_products(self, group: Sequence[int], data: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
        """Per cell of a group, V⁻¹x of the data's columns and its inner products with the candidates' columns."""
        columns = data.shape[1]
        if columns > FEW_COLUMNS:
            found = (self.precision(g, data) for g in group)
            return [(z, self._columns.T @ z) for z in found]
        data = np.pad(data, ((0, 0), (0, -columns % FEW_STEP)))
        filters = [self[g].filter for g in (*group, *[group[0]] * (CELLS_TOGETHER - len(group)))]
        gain, scale = (np.stack([np.asarray(getattr(f, part)) for f in filters], axis=-1) for part in ("gain", "scale"))
        z = np.asarray(weighted(filters[0]._replace(gain=gain, scale=scale), data))[:, :columns, : len(group)]
        z = np.ascontiguousarray(z.transpose(0, 2, 1))
        cross = (self._columns.T @ z.reshape(len(z), -1)).reshape(-1, len(group), columns)
        return [(z[:, i], cross[:, i]) for i in range(len(group))]


def _add_squares(total: np.ndarray, columns: np.ndarray) -> None:
    """Add to each square block CᵀC of the columns C that belong to it."""
    count, q = total.shape[:2]
    together = max(GRAM_COLUMNS // q, 1)
    for k in range(0, count, together):
        part = columns[:, q * k : q * (k + together)]
        many = part.shape[1] // q
        square = (part.T @ part).reshape(many, q, many, q)
        total[k : k + many] += square[np.arange(many), :, np.arange(many), :]


def _row_starts(rows: int) -> range:
    return range(0, rows, ROWS_TOGETHER)


def _packed(groups: Sequence[tuple[int | None, int, int, np.ndarray]]) -> list[Pack]:
    """Groups of blocks (key, width, number, columns) in packs of few widths, which are padded with zeros."""
    packs: list[tuple[list[np.ndarray], list[tuple[int | None, int, int, int]]]] = [([], [])]
    used = 0
    for key, q, count, columns in groups:
        k = 0
        while k < count:
            room = (COLUMNS_TOGETHER - used) // q
            if not room and used:
                packs.append(([], []))
                used = 0
                continue
            many = min(max(room, 1), count - k)
            packs[-1][0].append(columns[:, q * k : q * (k + many)])
            packs[-1][1].append((key, k, many, used))
            used, k = used + q * many, k + many
    found = []
    for parts, where in packs:
        if parts:
            raw = np.concatenate(parts, axis=1)
            raw = np.pad(raw, ((0, 0), (0, -raw.shape[1] % (COLUMNS_TOGETHER // 2))))
            found.append(Pack([jnp.asarray(raw[i : i + ROWS_TOGETHER]) for i in _row_starts(len(raw))], where))
    return found
