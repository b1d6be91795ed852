"""The threshold from simulated data with nothing hidden, through the same search over the noise cells that matter.

Draws are kept by design (columns, sampling, model and noise), so that the next campaign of the same design waits for
none.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
from contextlib import suppress

import jax
import numpy as np

from gyromodel import __version__
from gyromodel._cache import cache_folder
from gyromodel.diagnosis._ranking import EASE, cells_of_weight, ease, rank, skipped, tangents
from gyromodel.diagnosis._scan import Scanner
from gyromodel.estimate import Estimate, filter_of
from gyromodel.numerics.state_space import colour

DRAWS_TOGETHER = 64
# Draws are searched in the noise cells within this many nats of the best on the data: each has noise of its own.
WITHIN = 12.0

_draw = jax.jit(jax.vmap(colour, in_axes=(None, 0)))


def null_scores(
    scanner: Scanner, baseline: Estimate, draws: int, seed: int, say: Callable[[str, float], None]
) -> np.ndarray:
    """S of each draw of the baseline's own noise, from the cache where this design has been drawn before.

    S is the largest ln B, with what a name needs less where the noise beside it has no random walk.

    Args:
        scanner: the search laid out on the record.
        baseline: the fitted simulation; its noise is what is drawn.
        draws: how many.
        seed: of the draws.
        say: progress.
    """
    columns = np.asarray(baseline.model.linearise(scanner.record.signals)[1])
    kept = cache_folder("thresholds") / f"{_design(scanner, baseline, columns, draws, seed)}.npy"
    with suppress(OSError, ValueError, EOFError):
        return np.load(kept)
    skip = skipped(baseline.model, scanner.record.signals)
    continued = list(tangents(scanner, baseline.model, skip).values())
    cells = [0] if scanner.stated else scanner.only_cells
    if cells is None:
        cells = cells_of_weight(rank(scanner, scanner.coarse_cells(), baseline, (), skip), WITHIN)
    filter = filter_of(scanner.record, baseline.ratios)
    prior = scanner.grid.log_prior[cells][:, None]
    walks = np.asarray(scanner.grid.ratios.walk)[cells] > 0
    rng = np.random.default_rng(seed)
    scores = []
    for start in range(0, draws, DRAWS_TOGETHER):
        white = rng.standard_normal((DRAWS_TOGETHER, len(scanner.present)))
        drawn = np.asarray(_draw(filter, jax.numpy.asarray(white))).T
        batches = scanner.run_many(cells, columns, drawn, {}, tangents=continued)
        logs = np.stack([b.log_likelihood for b in batches]) + prior
        names = set.intersection(*(set(b.evidence) for b in batches)) - skip
        null, each = np.logaddexp.reduce(logs), []
        for name in sorted(names):
            beside = logs + np.stack([b.evidence[name] for b in batches])
            each.append(
                np.logaddexp.reduce(beside) - null + np.where(walks[beside.argmax(axis=0)], 0.0, ease(name, False))
            )
        scores.append(np.max(each, axis=0))
        say("calibrating the threshold", 0.06 + 0.18 * min(1.0, (start + DRAWS_TOGETHER) / draws))
    found = np.concatenate(scores)[:draws]
    with suppress(OSError):
        kept.parent.mkdir(parents=True, exist_ok=True)
        part = kept.with_suffix(f".{os.getpid()}.npy")
        np.save(part, found)
        part.replace(kept)
    return found


def _design(scanner: Scanner, baseline: Estimate, columns: np.ndarray, draws: int, seed: int) -> str:
    """A digest of all that the draws depend on; noise ratios to a fifth of a decade."""
    digest = hashlib.sha256(f"{__version__} {EASE} {baseline.model.labels} {scanner.stated} {draws} {seed}".encode())
    sampling = scanner.record.sampling
    for part in (scanner.bank.columns, columns, scanner.present, sampling.interval, sampling.white):
        digest.update(np.round(np.asarray(part, float), 9).tobytes())
    ratios = [round(5 * np.log10(max(float(r), 1e-30))) for r in baseline.ratios]
    digest.update(f"{ratios} {scanner.grid.interval} {scanner.grid.span}".encode())
    return digest.hexdigest()[:32]
