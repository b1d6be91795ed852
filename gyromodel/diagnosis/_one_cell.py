"""Evidence of every candidate in one noise cell, for what a baseline leaves there of the residuals."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from scipy.linalg import solve_triangular
from scipy.special import gammaln

from gyromodel.diagnosis._batch import Batch
from gyromodel.diagnosis._evidence import (
    FEW_SETS,
    evidence_of_draws,
    log_evidence_ratio,
    log_mean_evidence,
    log_mean_of_parts,
)
from gyromodel.diagnosis._lines import PEAK_WIDTH, PEAKS
from gyromodel.diagnosis._tangents import VANISHED

if TYPE_CHECKING:
    from gyromodel.diagnosis._cells import Products
    from gyromodel.diagnosis._scan import Scanner

# A column's energy, as a part of the greatest of its block, that single precision takes for none.
NOTHING = 1e-40
# Of what giving up points explains, the part of a sum that is rounding.
SINGULAR = 1e-10
# Standard deviations below zero that a coefficient which cannot be negative may be found at.
CLEARLY = 4.0
# Lines whose interpolated statistic, were it this much larger, would not pay for the search are left interpolated.
PEAK_SLACK = 1.5
# Data sets whose lines are worked out at once: as many as stay in the processor's cache.
SETS_TOGETHER = 16
# Further gross errors that are given up with the greatest: evidence of each alone (nats), the search over rows paid
# for, and rows to the next, as errors side by side share theirs.
ERROR_MARGIN, ERROR_DISTANCE = 8.0, 3


class OneCell:
    """What a baseline leaves of residuals in one noise cell; each method adds candidates' evidence to `batch`.

    Args:
        scanner: the search, and its cells.
        g: which cell.
        x: the baseline's columns, then the residuals, after `first` others.
        products: V⁻¹x, and its inner products with the candidates' columns; of many residuals in single precision.
        first: how many columns are neither.
        p: how many columns are the baseline's.
    """

    def __init__(self, scanner: Scanner, g: int, x: np.ndarray, products: Products, first: int, p: int) -> None:
        self._scanner, self._g, self._cell = scanner, g, scanner.cells[g]
        x, z = x[:, first:], products.z[:, first:]
        against = x[:, :p].T @ z
        norm = np.sqrt(np.maximum(np.diag(against)[:p], 1e-300))
        scaled = against[:, :p] / np.outer(norm, norm) + 1e-13 * np.eye(p)
        root = np.linalg.inv(np.linalg.cholesky(scaled)) / norm
        jy = root @ against[:, p:]
        self._nu = nu = scanner.degrees_of_freedom - p
        rss = np.einsum("ij,ij->j", x[:, p:], z[:, p:]) - np.sum(jy**2, axis=0)
        rss = np.maximum(rss, max(nu * scanner.least, 1e-300))
        log_j = 2.0 * np.log(norm).sum() + np.linalg.slogdet(scaled)[1]
        log_likelihood = -0.5 * self._cell.log_determinant - 0.5 * log_j - 0.5 * nu * np.log(rss)
        self.batch = Batch(log_likelihood, rss, {}, {}, {}, {})
        # V⁻¹ of the baseline's orthonormal columns and of what they leave; the candidates' inner products with both.
        self._zj = z[:, :p] @ root.T
        self._cross_j = products.baseline[:, first:] @ root.T
        kind = products.residuals.dtype
        self._zy = np.asarray(z[:, p:] - self._zj @ jy, kind)
        self._cross_y = products.residuals - self._cross_j.astype(kind) @ jy.astype(kind)
        self._rss = rss.astype(kind)

    def blocks(self, least: np.ndarray, lost: np.ndarray) -> None:
        """Every block's evidence.

        Args:
            least: how many columns of each block must be left beside the baseline.
            lost: blocks that the rows left out told of.
        """
        batch, nu, table, bank = self.batch, self._nu, self._scanner.table, self._scanner.bank
        blocks, draws, kind = len(bank.blocks), self._cross_y.shape[1], self._cross_y.dtype
        t_of, q_of, energy = np.zeros((blocks, draws), kind), np.zeros(blocks), np.zeros(blocks)
        for q, (first, count, start) in bank.layout().items():
            own = self._cell.blocks[q]
            c = self._cross_j[start : start + q * count].reshape(count, q, -1)
            b = self._cross_y[start : start + q * count].reshape(count, q, draws)
            square = np.einsum("bii->bi", own)
            # A column that is nothing beside the others of its block has no direction.
            norm = np.sqrt(np.where(square > NOTHING * square.max(axis=1, keepdims=True), square, np.inf))
            a = (own - c @ c.transpose(0, 2, 1)) / (norm[:, :, None] * norm[:, None, :])
            values, vectors = np.linalg.eigh(a)
            keep = values > VANISHED
            along = (vectors.transpose(0, 2, 1) / norm[:, None, :]).astype(kind) @ b
            inverse = np.where(keep, 1.0 / np.where(keep, values, 1.0), 0.0).astype(kind)
            t = np.sum(inverse[:, :, None] * along**2, axis=1)
            here = slice(first, first + count)
            out = b[:, 0] < (table.smallest[here] * a[:, 0, 0] * square[:, 0])[:, None]
            if q > 1 and table.positive[here].any():
                # What would be clearly negative in one of its coefficients.
                sizes = vectors @ (inverse[:, :, None] * along)
                spread = np.sqrt(np.einsum("bij,bj->bi", vectors**2, inverse))
                noise = np.sqrt(np.maximum(batch.rss - t, 1e-300) / nu)
                out = (sizes < -CLEARLY * spread[:, :, None] * noise[:, None, :]).any(axis=1)
            t_of[here] = np.where(table.positive[here, None] & out, 0.0, t)
            q_of[here] = keep.sum(1)
            energy[here] = np.sum(values * keep, axis=1) / np.maximum(q_of[here], 1) * np.mean(square, axis=1)
        # A form that loses more columns than the baseline contains is another form in disguise.
        sound = (q_of >= least) & ~lost
        energy[~sound] = 0.0
        energies = np.split(energy[table.order], table.structure_starts[table.name_starts][1:])
        batch.energy |= dict(zip(table.names, energies, strict=True))
        if draws > FEW_SETS:
            self._names_of_draws(t_of, q_of, sound)
            return
        batch.explained = np.where(sound[:, None], t_of, 0.0)
        ratio = log_evidence_ratio(t_of, self._rss, nu, q_of[:, None]) - table.price[:, None].astype(kind)
        ratio = np.where(sound[:, None], ratio, -np.inf)[table.order]
        # Structures compete by their mean over shapes; the best shape of the best structure stands for the name.
        means, shapes = log_mean_of_parts(ratio, table.structure_starts)
        evidence, best = log_mean_of_parts(means, table.name_starts)
        forms = table.order[np.take_along_axis(shapes, best, axis=0)]
        for name, value, form in zip(table.names, evidence, forms, strict=True):
            if np.isfinite(value[0]):
                batch.evidence[name] = value
                batch.best[name] = (list(form), t_of[form, np.arange(draws)], q_of[form])

    def _names_of_draws(self, t_of: np.ndarray, q_of: np.ndarray, sound: np.ndarray) -> None:
        """Evidence of names of many data sets, as `log_mean_of_parts` twice: none asks which form is best."""
        table, b = self._scanner.table, np.zeros(t_of.shape)
        for q in np.unique(q_of[sound]):
            here = np.flatnonzero(sound & (q_of == q))
            b[here] = evidence_of_draws(t_of[here], self._rss, self._nu, int(q)) * np.exp(-table.price[here])[:, None]
        count = sound[table.order].astype(int)
        b = b[table.order]
        for starts in (table.structure_starts, table.name_starts):
            of_part = np.add.reduceat(count, starts)
            b = np.add.reduceat(b, starts, axis=0) / np.maximum(of_part, 1)[:, None]
            count = (of_part > 0).astype(int)
        named = [(name, value) for name, value, there in zip(table.names, b, count, strict=True) if there]
        self.batch.evidence |= {name: np.log(value) for name, value in named}

    def steps(self) -> None:
        """A step before each epoch."""
        scanner = self._scanner
        zj, zy = (scanner.to_run_end(np.cumsum(v[::-1], axis=0)[::-1]) for v in (self._zj, self._zy))
        self._single("bias_step", scanner.epochs, zy, scanner.to_run_end(self._cell.step), zj)

    def gross_errors(self, rows: np.ndarray) -> None:
        """Single rows of a series, the greatest and those that are certain beside it."""
        t = self._single("outliers", rows, self._zy[rows], self._cell.pulse[rows], self._zj[rows])
        if t.shape[1] == 1 and len(rows):
            errors = _gross(t[:, 0], rows, self.batch.rss[0], self._nu)
            self.batch.best["outliers"][0][0] = tuple(int(rows[i]) for i in errors)

    def anomalous_points(self, points: Sequence[np.ndarray], orders: Sequence[np.ndarray]) -> None:
        """Sets of anomalous points in a robust order, priced by their number; in a series beside single rows."""
        batch, nu = self.batch, self._nu
        among = np.unique(np.concatenate(orders))
        marks = np.zeros((len(self._zj), len(among)))
        for column, k in zip(marks.T, among, strict=True):
            column[points[k]] = 1.0
        w, cross = self._scanner.cells.whiten(self._g, marks), marks.T @ self._zj
        length = np.linalg.norm(w, axis=0)
        left, y = (w.T @ w - cross @ cross.T) / np.outer(length, length), marks.T @ self._zy / length[:, None]
        evidence, explained, dimension = np.full(len(orders), -np.inf), np.zeros(len(orders)), np.zeros(len(orders))
        best: list[tuple[int, ...]] = [()] * len(orders)
        every = np.arange(1, min(len(among), nu - 1) + 1)
        sets = gammaln(len(points) + 1) - gammaln(every + 1) - gammaln(len(points) - every + 1)
        for i, (order, rss) in enumerate(zip(orders, batch.rss, strict=True)):
            sizes = every[: len(order)]
            if not len(sizes):
                continue
            price = sets[: len(sizes)] + np.log(len(sizes))
            chosen = np.searchsorted(among, order[: len(sizes)])
            # What the first, the first two … explain.
            root = np.linalg.cholesky(left[np.ix_(chosen, chosen)] + SINGULAR * np.eye(len(chosen)))
            t = np.minimum(np.cumsum(solve_triangular(root, y[chosen, i], lower=True) ** 2), rss)
            ratio = log_evidence_ratio(t, rss, nu, sizes) - price
            top = int(np.argmax(ratio))
            evidence[i], explained[i], dimension[i] = np.logaddexp.reduce(ratio), t[top], top + 1.0
            best[i] = tuple(sorted(int(r) for k in order[: top + 1] for r in points[k]))
        if "outliers" not in batch.evidence:
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

    def lines(self, barred: np.ndarray) -> None:
        """A line at each frequency but the barred."""
        assert self._scanner.lines is not None
        own, spectrum, kind = self._cell.line, self._scanner.lines.spectrum, self._zy.dtype
        cj, sj = spectrum(self._zj)
        a11 = own[:, 0, 0] - np.sum(cj**2, axis=1)
        a22 = own[:, 1, 1] - np.sum(sj**2, axis=1)
        a12 = own[:, 0, 1] - np.sum(cj * sj, axis=1)
        determinant = a11 * a22 - a12**2
        keep = (determinant > 1e-3 * own[:, 0, 0] * own[:, 1, 1]) & (a11 > 0) & ~barred
        # A line explains (along (c − lean s))² + (across s)².
        a22, determinant = np.where(keep, a22, 1.0), np.where(keep, determinant, 1.0)
        along, lean, across = (
            np.where(keep, x, 0.0).astype(kind) for x in (np.sqrt(a22 / determinant), a12 / a22, a22**-0.5)
        )
        t = np.zeros((self._zy.shape[1], len(keep)), kind)
        c = s = t.T
        for i in range(0, len(t), SETS_TOGETHER):
            c, s = spectrum(self._zy[:, i : i + SETS_TOGETHER])
            t[i : i + SETS_TOGETHER] = (along * (c.T - lean * s.T)) ** 2 + (across * s.T) ** 2
        if len(t) == 1:
            worth = log_evidence_ratio(PEAK_SLACK * t.max(axis=1), self._rss, self._nu, 2) > np.log(len(keep))
            if worth[0]:
                self.batch.peaks = self._exact_peaks(t[0], np.column_stack([cj, c]), np.column_stack([sj, s]))
        self._record("bias_periodic", np.arange(len(keep)), t.T, np.where(keep, a11, 0.0), 2)

    def _exact_peaks(self, t: np.ndarray, c: np.ndarray, s: np.ndarray) -> dict[int, float]:
        """Correct the statistic around the leading peaks, in place, by their exact energy; what each explains."""
        assert self._scanner.lines is not None
        local = np.flatnonzero((t[1:-1] >= t[:-2]) & (t[1:-1] >= t[2:])) + 1
        peaks = local[np.argsort(-t[local])][:PEAKS]
        if not len(peaks):
            return {}
        waves = self._scanner.lines.waves(np.resize(peaks, PEAKS))
        w = self._scanner.cells.whiten(self._g, waves)
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

    def _single(self, name: str, where: np.ndarray, b: np.ndarray, own: np.ndarray, cross: np.ndarray) -> np.ndarray:
        """Record one column anywhere; what it explains."""
        left = own - np.sum(cross**2, axis=1)
        keep = left > VANISHED * own
        t = np.where(keep, 1.0 / np.where(keep, left, 1.0), 0.0).astype(b.dtype)[:, None] * b**2
        self._record(name, where, t, np.where(keep, left, 0.0), 1)
        return t

    def _record(self, name: str, where: np.ndarray, t: np.ndarray, energy: np.ndarray, q: int) -> None:
        """Record what q columns, which may stand anywhere, explain there."""
        if not len(where):
            return
        batch = self.batch
        top = np.argmax(np.minimum(t, self._rss), axis=0)
        best = np.minimum(t[top, np.arange(len(top))], self._rss)
        batch.evidence[name] = log_mean_evidence(t, self._rss, self._nu, q)
        batch.best[name] = (list(where[top]), best, np.full(len(top), float(q)))
        batch.energy[name] = energy


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
