"""What one noise cell says of every candidate, for one set of residuals or for many."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np


@dataclass
class CellResult:
    """One cell's verdict on every candidate, beside its own restricted likelihood.

    `explained`: what each form laid out as columns explains, by its number.
    """

    log_likelihood: float
    rss: float
    evidence: dict[str, float]
    best: dict[str, tuple[int | tuple[int, ...], float, float]]
    energy: dict[str, np.ndarray]
    peaks: dict[int, float]
    explained: np.ndarray = field(repr=False)


@dataclass
class Batch:
    """A cell's results for several residuals: arrays have one entry a residual; `energy` is theirs in common.

    `peaks` are the leading lines of a single residual: what each explains, by number of its frequency.
    """

    log_likelihood: np.ndarray
    rss: np.ndarray
    evidence: dict[str, np.ndarray]
    best: dict[str, tuple[list, np.ndarray, np.ndarray]]
    energy: dict[str, np.ndarray]
    peaks: dict[int, float]
    explained: np.ndarray = field(default_factory=lambda: np.zeros((0, 1)), repr=False)

    def of(self, which: np.ndarray) -> Batch:
        """What is said of some of many residuals, without the forms."""
        evidence = {name: values[which] for name, values in self.evidence.items()}
        return Batch(self.log_likelihood[which], self.rss[which], evidence, {}, self.energy, {})

    @staticmethod
    def joined(batches: Sequence[Batch]) -> Batch:
        """Of further residuals beside the same baseline, without the forms."""
        one = batches[0]
        log, rss = (np.concatenate([getattr(b, name) for b in batches]) for name in ("log_likelihood", "rss"))
        none = [np.full(len(b.rss), -np.inf) for b in batches]
        names = dict.fromkeys(name for b in batches for name in b.evidence)
        each = {n: [b.evidence.get(n, nothing) for b, nothing in zip(batches, none, strict=True)] for n in names}
        return Batch(log, rss, {n: np.concatenate(parts) for n, parts in each.items()}, {}, one.energy, {})

    def first(self) -> CellResult:
        """The first residual's results as plain numbers."""
        best = {
            name: (form[0] if isinstance(form[0], tuple) else int(form[0]), float(t[0]), float(q[0]))
            for name, (form, t, q) in self.best.items()
        }
        evidence = {name: float(v[0]) for name, v in self.evidence.items()}
        log, rss = float(self.log_likelihood[0]), float(self.rss[0])
        return CellResult(log, rss, evidence, best, self.energy, self.peaks, self.explained[:, 0])
