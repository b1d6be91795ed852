"""The threshold from simulated data with nothing hidden, through the same search over the same noise cells."""

from __future__ import annotations

from collections.abc import Callable

import jax
import numpy as np
from scipy.special import logsumexp

from gyromodel.diagnosis._scan import Scanner
from gyromodel.diagnosis._search import skipped
from gyromodel.estimate import Estimate, filter_of
from gyromodel.numerics.state_space import colour

_draw = jax.jit(jax.vmap(colour, in_axes=(None, 0)))


def null_scores(
    scanner: Scanner, baseline: Estimate, draws: int, seed: int, say: Callable[[str, float], None]
) -> np.ndarray:
    """S = max ln B of each draw of the baseline's own noise.

    Args:
        scanner: the search laid out on the record.
        baseline: the fitted simulation; its noise is what is drawn.
        draws: how many.
        seed: of the draws.
        say: progress.
    """
    record = scanner.record
    rng = np.random.default_rng(seed)
    white = rng.standard_normal((draws, len(scanner.present)))
    data = np.asarray(_draw(filter_of(record, baseline.ratios), jax.numpy.asarray(white)))
    _, jacobian = baseline.model.linearise(record.signals)
    columns = np.asarray(jacobian)
    skip = skipped(baseline.model)
    cells = scanner.all_cells() if baseline.noise_given else scanner.coarse_cells()
    results = scanner.run_many(
        cells, columns, data.T, lambda k: say("calibrating the threshold", 0.06 + 0.18 * k / len(cells))
    )
    likelihood = np.stack([results[g][0] + scanner.grid.log_prior[g] for g in cells])
    null = np.asarray(logsumexp(likelihood, axis=0))
    names = [n for n in results[cells[0]][1] if n not in skip]
    scores = [logsumexp(likelihood + np.stack([results[g][1][n] for g in cells]), axis=0) - null for n in names]
    return np.max(scores, axis=0)
