"""What a baseline leaves of every candidate in one noise cell, whatever the data are."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from gyromodel.diagnosis._tangents import VANISHED

if TYPE_CHECKING:
    from gyromodel.diagnosis._scan import Scanner

# A column's energy, as a part of the greatest of its block, that single precision takes for none.
NOTHING = 1e-40
# Part of a column's energy from which on what is left of it has a size of its own.
SHOWN = 1e-3


class Width(NamedTuple):
    """The blocks of one number of columns beside a baseline.

    `turn` takes a block's columns to orthonormal directions of what is left of them, `left` in number, and to zeros;
    `energy` is what is left of the first column that sizes are told of and that the baseline leaves, else on average;
    `blocks` and `columns` are where they stand.
    """

    blocks: slice
    columns: slice
    turn: np.ndarray
    left: np.ndarray
    energy: np.ndarray


class Beside:
    """What a baseline leaves of every candidate in one noise cell, whatever the data are.

    Args:
        scanner: the search, and its cells.
        g: which cell.
        x: the baseline's columns.
        z: V⁻¹x.
        cross: inner products of the candidates' columns with z.
        barred: lines that are not searched.
        suspected: the rows of each point that may be anomalous in any of the data.
        most: how many columns of each block can be left.
    """

    def __init__(
        self,
        scanner: Scanner,
        g: int,
        x: np.ndarray,
        z: np.ndarray,
        cross: np.ndarray,
        barred: np.ndarray,
        suspected: Sequence[np.ndarray],
        most: np.ndarray,
    ) -> None:
        self.scanner, self.g, self.cell, self._barred = scanner, g, scanner.cells[g], barred
        self.suspected, self._most = suspected, most
        against = x.T @ z
        norm = np.sqrt(np.maximum(np.diag(against), 1e-300))
        scaled = against / np.outer(norm, norm) + 1e-13 * np.eye(len(norm))
        root = np.linalg.inv(np.linalg.cholesky(scaled)) / norm
        self.nu = scanner.degrees_of_freedom - len(norm)
        self.log_determinant = self.cell.log_determinant + 2.0 * np.log(norm).sum() + np.linalg.slogdet(scaled)[1]
        # V⁻¹ of the baseline's orthonormal columns, and the candidates' inner products with it.
        self.z, self.cross = z @ root.T, cross @ root.T

    @cached_property
    def widths(self) -> list[Width]:
        """What is left of the blocks, by their number of columns."""
        found = []
        for q, (first, count, start) in self.scanner.bank.layout().items():
            blocks, columns, own = slice(first, first + count), slice(start, start + q * count), self.cell.blocks[q]
            c = self.cross[columns].reshape(count, q, -1)
            square = np.einsum("bii->bi", own)
            # A column that is nothing beside the others of its block has no direction.
            norm = np.sqrt(np.where(square > NOTHING * square.max(axis=1, keepdims=True), square, np.inf))
            rest = (own - c @ c.transpose(0, 2, 1)) / (norm[:, :, None] * norm[:, None, :])
            values, vectors = np.linalg.eigh(rest)
            keep = (values > VANISHED) & (np.arange(q) >= q - self._most[blocks, None])
            turn = vectors / norm[:, :, None] * np.where(keep, np.where(keep, values, 1.0) ** -0.5, 0.0)[:, None, :]
            left = keep.sum(axis=1)
            energy = np.sum(values * keep, axis=1) / np.maximum(left, 1) * np.mean(square, axis=1)
            share = np.einsum("bii->bi", rest)
            told = (share > SHOWN) & (np.arange(q) < self.scanner.table.leading[blocks, None])
            first = np.arange(count), told.argmax(axis=1)
            energy = np.where((left > 0) & told[first], (share * square)[first], energy)
            found.append(Width(blocks, columns, turn, left, energy))
        return found

    @cached_property
    def turned(self) -> list[np.ndarray]:
        """The columns along those directions, of each width, in single precision; one row each."""
        columns, found = self.scanner.bank.columns[: self.scanner.record.rows], []
        for width in self.widths:
            own = columns[:, width.columns].reshape(len(columns), *width.turn.shape[:2]).transpose(1, 2, 0)
            found.append((width.turn.transpose(0, 2, 1) @ own).reshape(-1, len(columns)).astype(np.float32))
        return found

    @cached_property
    def steps(self) -> np.ndarray:
        """What is left of a step before each epoch."""
        to_end = self.scanner.to_run_end
        return _left(to_end(self.cell.step), to_end(np.cumsum(self.z[::-1], axis=0)[::-1]))

    def pulses(self, rows: np.ndarray) -> np.ndarray:
        """What is left of single rows."""
        return _left(self.cell.pulse[rows], self.z[rows])

    @cached_property
    def points(self) -> tuple[np.ndarray, np.ndarray]:
        """What is left of the suspected points and they share, each of unit length whitened; and these lengths."""
        marks = np.zeros((len(self.z), len(self.suspected)))
        for column, rows in zip(marks.T, self.suspected, strict=True):
            column[rows] = 1.0
        w, cross = self.scanner.cells.whiten(self.g, marks), marks.T @ self.z
        length = np.linalg.norm(w, axis=0)
        return (w.T @ w - cross @ cross.T) / np.outer(length, length), length

    @cached_property
    def lines(self) -> Lines:
        """What is left of every line."""
        assert self.scanner.lines is not None
        own = self.cell.line
        cosine, sine = self.scanner.lines.spectrum(self.z)
        a11 = own[:, 0, 0] - np.sum(cosine**2, axis=1)
        a22 = own[:, 1, 1] - np.sum(sine**2, axis=1)
        a12 = own[:, 0, 1] - np.sum(cosine * sine, axis=1)
        determinant = a11 * a22 - a12**2
        keep = (determinant > 1e-3 * own[:, 0, 0] * own[:, 1, 1]) & (a11 > 0) & ~self._barred
        a22, determinant = np.where(keep, a22, 1.0), np.where(keep, determinant, 1.0)
        parts = (np.where(keep, x, 0.0) for x in (np.sqrt(a22 / determinant), a12 / a22, a22**-0.5, a11))
        return Lines(cosine, sine, *parts)


class Lines(NamedTuple):
    """Lines beside a baseline: inner products of their waves with it, and what is left of them.

    Of inner products c and s with the data a line explains (along (c − lean s))² + (across s)².
    """

    cosine: np.ndarray
    sine: np.ndarray
    along: np.ndarray
    lean: np.ndarray
    across: np.ndarray
    energy: np.ndarray


def _left(own: np.ndarray, cross: np.ndarray) -> np.ndarray:
    """Energy of single columns beside what they share with the baseline; 0 where nothing is left."""
    left = own - np.sum(cross**2, axis=1)
    return np.where(left > VANISHED * own, left, 0.0)
