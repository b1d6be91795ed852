"""Evidence of every candidate in one noise cell, for what a baseline leaves there of the residuals."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.special import gammaln

from gyromodel.diagnosis._batch import Batch
from gyromodel.diagnosis._evidence import (
    evidence_of_draws,
    log_evidence_ratio,
    log_mean,
    log_mean_of_parts,
    mean_evidence_of_draws,
)
from gyromodel.diagnosis._left import Beside
from gyromodel.diagnosis._lines import PEAK_WIDTH, PEAKS

# Of what giving up points explains, the part of a sum that is rounding.
SINGULAR = 1e-10
# Standard deviations below zero that a coefficient which cannot be negative may be found at.
CLEARLY = 4.0
# Lines whose interpolated statistic, were it this much larger, would not pay for the search are left interpolated.
PEAK_SLACK = 1.5
# Data sets whose lines, or sets of points, are worked out at once: as many as stay in the processor's cache.
SETS_TOGETHER = 16
# Further gross errors that are given up with the greatest: evidence of each alone (nats), the search over rows paid
# for, and rows to the next, as errors side by side share theirs.
ERROR_MARGIN, ERROR_DISTANCE = 8.0, 3


class OneCell:
    """What a baseline leaves of residuals in one noise cell; each method adds candidates' evidence to `batch`.

    Args:
        beside: the baseline there.
        y: the residuals.
        z: V⁻¹y.
        cross: inner products of the candidates' columns with z; none of draws, which have theirs in single precision.
    """

    def __init__(self, beside: Beside, y: np.ndarray, z: np.ndarray, cross: np.ndarray | None) -> None:
        self._beside, self._scanner = beside, beside.scanner
        jy = beside.z.T @ y
        self._nu = nu = beside.nu
        rss = np.einsum("ij,ij->j", y, z) - np.sum(jy**2, axis=0)
        rss = np.maximum(rss, max(nu * self._scanner.least, 1e-300))
        self.batch = Batch(-0.5 * beside.log_determinant - 0.5 * nu * np.log(rss), rss, {}, {}, {}, {})
        # V⁻¹ of what the baseline leaves of the residuals, and the candidates' inner products with it.
        self._zy = z - beside.z @ jy
        self._cross, self._rss = None, rss
        if cross is not None:
            self._cross = cross - beside.cross @ jy
        else:
            self._zy, self._rss = self._zy.astype(np.float32), rss.astype(np.float32)

    def blocks(self, least: np.ndarray, lost: np.ndarray) -> None:
        """Every block's evidence.

        Args:
            least: how many columns of each block must be left beside the baseline.
            lost: blocks that the rows left out told of.
        """
        batch, nu, table, draws = self.batch, self._nu, self._scanner.table, self._zy.shape[1]
        t_of = np.zeros((len(self._scanner.bank.blocks), draws), self._zy.dtype)
        q_of, energy = np.zeros(len(t_of)), np.zeros(len(t_of))
        for k, (here, columns, turn, left, size) in enumerate(self._beside.widths):
            if self._cross is None:
                along = self._beside.turned[k] @ self._zy[: self._scanner.record.rows]
                along = along.reshape(*turn.shape[:2], draws)
            else:
                along = turn.transpose(0, 2, 1) @ self._cross[columns].reshape(*turn.shape[:2], draws)
            t_of[here], q_of[here], energy[here] = np.einsum("bqd,bqd->bd", along, along), left, size
            if table.positive[here].any():
                sizes = turn.astype(along.dtype) @ along
                if turn.shape[1] == 1:
                    out = sizes[:, 0] < table.smallest[here, None]
                else:
                    # What would be clearly negative in one of its coefficients.
                    spread = np.sqrt(np.sum(turn**2, axis=2))
                    noise = np.sqrt(np.maximum(batch.rss - t_of[here], 1e-300) / nu)
                    out = (sizes < -CLEARLY * spread[:, :, None] * noise[:, None, :]).any(axis=1)
                t_of[here] = np.where(table.positive[here, None] & out, 0.0, t_of[here])
        # A form that loses more columns than the baseline contains is another form in disguise.
        sound = (q_of >= least) & ~lost
        energy[~sound] = 0.0
        energies = np.split(energy[table.order], table.structure_starts[table.name_starts][1:])
        batch.energy |= dict(zip(table.names, energies, strict=True))
        if self._cross is None:
            self._names_of_draws(t_of, q_of, sound)
            return
        batch.explained = np.where(sound[:, None], t_of, 0.0)
        ratio = log_evidence_ratio(t_of, self._rss, nu, q_of[:, None]) - table.price[:, None]
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
        epochs, to_end = self._scanner.epochs, self._scanner.to_run_end
        self._single("bias_step", epochs, to_end(np.cumsum(self._zy[::-1], axis=0)[::-1]), self._beside.steps)

    def gross_errors(self, rows: np.ndarray) -> None:
        """Single rows of a series, the greatest and those that are certain beside it."""
        t = self._single("outliers", rows, self._zy[rows], self._beside.pulses(rows))
        if self._cross is not None and t.shape[1] == 1 and len(rows):
            errors = _gross(t[:, 0], rows, self.batch.rss[0], self._nu)
            self.batch.best["outliers"][0][0] = tuple(int(rows[i]) for i in errors)

    def anomalous_points(self, count: int, orders: Sequence[np.ndarray]) -> None:
        """Sets of anomalous points in a robust order, priced by their number; in a series beside single rows.

        Args:
            count: how many points there are.
            orders: of each residual, numbers of suspected points.
        """
        batch, nu, suspected = self.batch, self._nu, self._beside.suspected
        left, length = self._beside.points
        begins = np.cumsum([0, *map(len, suspected[:-1])])
        y = np.add.reduceat(self._zy[np.concatenate(suspected)], begins, axis=0) / length[:, None]
        evidence, explained, dimension = np.full(len(orders), -np.inf), np.zeros(len(orders)), np.zeros(len(orders))
        best: list[tuple[int, ...]] = [()] * len(orders)
        numbers = np.minimum([len(order) for order in orders], nu - 1)
        sizes = np.arange(1, max(numbers.max(), 0) + 1)
        sets = gammaln(count + 1) - gammaln(sizes + 1) - gammaln(count - sizes + 1)
        some = np.flatnonzero(numbers > 0)
        for here in np.split(some, range(SETS_TOGETHER, len(some), SETS_TOGETHER)):
            held = sizes <= numbers[here, None]
            chosen = np.zeros(held.shape, int)
            chosen[held] = np.concatenate([orders[i][: numbers[i]] for i in here] or [[]])
            # What the first, the first two … explain.
            both = left[chosen[:, :, None], chosen[:, None, :]] * (held[:, :, None] & held[:, None, :])
            both[:, sizes - 1, sizes - 1] += np.where(held, SINGULAR, 1.0)
            along = np.linalg.solve(np.linalg.cholesky(both), np.where(held, y[chosen, here[:, None]], 0.0)[:, :, None])
            rss = batch.rss[here, None]
            t = np.minimum(np.cumsum(along[:, :, 0] ** 2, axis=1), rss)
            ratio = np.where(held, log_evidence_ratio(t, rss, nu, sizes) - sets - np.log(numbers[here, None]), -np.inf)
            top = np.argmax(ratio, axis=1)
            evidence[here], dimension[here] = np.logaddexp.reduce(ratio, axis=1), top + 1.0
            explained[here] = t[np.arange(len(here)), top]
            if self._cross is not None:
                for i, last in zip(here, top, strict=True):
                    best[i] = tuple(sorted(int(r) for k in orders[i][: last + 1] for r in suspected[k]))
        single = batch.evidence.get("outliers")
        if single is None:
            batch.energy["outliers"] = np.diag(left)
        batch.evidence["outliers"] = evidence if single is None else np.logaddexp(single, evidence)
        if self._cross is None:
            return
        whole = np.ones(len(evidence), bool) if single is None else evidence > single
        rows, alone, one = batch.best.get("outliers", (best, explained, dimension))
        batch.best["outliers"] = (
            [b if w else r for w, b, r in zip(whole, best, rows, strict=True)],
            np.where(whole, explained, alone),
            np.where(whole, dimension, one),
        )

    def lines(self) -> None:
        """A line at each frequency."""
        assert self._scanner.lines is not None
        beside, spectrum = self._beside.lines, self._scanner.lines.spectrum
        along, lean, across = (x.astype(self._zy.dtype) for x in (beside.along, beside.lean, beside.across))
        t = np.zeros((self._zy.shape[1], len(along)), self._zy.dtype)
        c = s = t.T
        for i in range(0, len(t), SETS_TOGETHER):
            c, s = spectrum(self._zy[:, i : i + SETS_TOGETHER])
            t[i : i + SETS_TOGETHER] = (along * (c.T - lean * s.T)) ** 2 + (across * s.T) ** 2
        if self._cross is not None and len(t) == 1:
            worth = log_evidence_ratio(PEAK_SLACK * t.max(axis=1), self._rss, self._nu, 2) > np.log(len(along))
            if worth[0]:
                both = np.column_stack([beside.cosine, c]), np.column_stack([beside.sine, s])
                self.batch.peaks = self._exact_peaks(t[0], *both)
        self._record("bias_periodic", np.arange(len(along)), t.T, beside.energy, 2)

    def _exact_peaks(self, t: np.ndarray, c: np.ndarray, s: np.ndarray) -> dict[int, float]:
        """Correct the statistic around the leading peaks, in place, by their exact energy; what each explains."""
        assert self._scanner.lines is not None
        # Half the sample rate, where each run's lines end, is a peak like any; where they begin slow things end.
        after = np.pad(t.reshape(len(self._scanner.lines.campaigns), -1)[:, 1:], ((0, 0), (0, 1))).ravel()
        local = np.flatnonzero((t[1:] >= t[:-1]) & (t[1:] >= after[1:])) + 1
        peaks = local[np.argsort(-t[local])][:PEAKS]
        if not len(peaks):
            return {}
        waves = self._scanner.lines.waves(np.resize(peaks, PEAKS))
        w = self._scanner.cells.whiten(self._beside.g, waves)
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

    def _single(self, name: str, where: np.ndarray, b: np.ndarray, left: np.ndarray) -> np.ndarray:
        """Record one column anywhere; what it explains."""
        t = np.where(left > 0, 1.0 / np.where(left > 0, left, 1.0), 0.0).astype(b.dtype)[:, None] * b**2
        self._record(name, where, t, left, 1)
        return t

    def _record(self, name: str, where: np.ndarray, t: np.ndarray, energy: np.ndarray, q: int) -> None:
        """Record what q columns, which may stand anywhere, explain there."""
        if not len(where):
            return
        batch, rss = self.batch, self._rss
        batch.energy[name] = energy
        if self._cross is None:
            batch.evidence[name] = np.log(mean_evidence_of_draws(t, rss, self._nu, q))
            return
        batch.evidence[name] = log_mean(log_evidence_ratio(t, rss, self._nu, q))
        top = np.argmax(np.minimum(t, rss), axis=0)
        best = np.minimum(t[top, np.arange(len(top))], rss)
        batch.best[name] = (list(where[top]), best, np.full(len(top), float(q)))


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
