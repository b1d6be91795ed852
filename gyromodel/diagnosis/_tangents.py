"""Candidates that continue effects of the baseline, as their evidence enters a cell's results."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from gyromodel.diagnosis._batch import Batch
from gyromodel.diagnosis._evidence import log_evidence_ratio
from gyromodel.effects import Effect

# A candidate whose columns keep less than this share of their energy beside the baseline cannot be tested.
VANISHED = 1e-6


class Tangent(NamedTuple):
    """A candidate that continues effects of the baseline: its derivative by its amplitude there."""

    effect: Effect
    column: np.ndarray


def add_tangents(batch: Batch, tangents: Sequence[Tangent], x: np.ndarray, z: np.ndarray, p: int, nu: int) -> None:
    """Evidence of the candidates whose columns stand first in x, before p of the baseline and the residuals."""
    first = len(tangents)
    if not first:
        return
    left = x[:, : first + p].T @ z
    # In columns of length one: of a long and a short column of the baseline, neither may be left unprojected.
    length = np.sqrt(np.maximum(np.diag(left[first:, first : first + p]), 1e-300))
    left[first:] /= length[:, None]
    left[:, first : first + p] /= length
    own, cross, data = left[:first, :first], left[:first, first : first + p], left[:, first + p :]
    inner = np.linalg.lstsq(left[first:, first : first + p], np.column_stack([cross.T, data[first:]]), rcond=1e-13)[0]
    energy = np.diag(own - cross @ inner[:, :first])
    along = data[:first] - cross @ inner[:, first:]
    for tangent, size, norm, b in zip(tangents, energy, np.diag(own), along, strict=True):
        name = tangent.effect.id
        batch.energy[name] = np.array([size if size > VANISHED * norm else 0.0])
        if size > VANISHED * norm:
            # What the amplitude explains that is best within the effect's reach.
            best = np.clip(b / size, -tangent.effect.reach, tangent.effect.reach)
            t = np.minimum(2.0 * best * b - best**2 * size, batch.rss)
            batch.evidence[name] = log_evidence_ratio(t, batch.rss, nu, 1)
            batch.best[name] = ([0] * len(t), t, np.ones(len(t)))
