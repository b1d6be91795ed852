"""The gain of a search on blocks that it did not see: the whole of it repeated without each."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from gyromodel.diagnosis._gain import nested_gain, no_gain
from gyromodel.diagnosis._ranking import cells_of_weight
from gyromodel.diagnosis._result import Gain
from gyromodel.diagnosis._selection import Selection
from gyromodel.diagnosis._session import Session
from gyromodel.diagnosis._thermometers import within_thermometers
from gyromodel.estimate import Estimate
from gyromodel.signals import Record

# Folds search the noise cells within this many nats of the best of the main pass.
FOLD_NEARBY = 3.0


def gain_of(
    session: Session,
    baseline: Estimate,
    selection: Selection,
    measured: Record,
    unit: str,
    scale: float,
    ordinary: tuple[bool, bool],
    say: Callable[[str, float], None],
) -> Gain:
    """The gain on blocks left out; `measured` is the record with temperatures as they were read."""
    if not any(f.effect is not None or f.frees_noise for f in selection.found):
        return no_gain(session.record, session.ladder(baseline)[0] * scale, unit)

    rankings = [f.ranking for f in selection.path] + [selection.last]
    noise = [e.ratios for e in selection.estimates]
    cells = sorted({g for ranking in rankings for g in cells_of_weight(ranking, FOLD_NEARBY)})

    def select(rows: np.ndarray, base: Estimate) -> Estimate:
        fold = Session(session.scanner.without(rows, cells), base, session.threshold)
        return within_thermometers(replace(fold.steps, noise=noise), fold.run(noise=noise), measured)[0].estimate

    return nested_gain(
        session.record,
        baseline,
        select,
        unit,
        scale,
        ordinary,
        lambda k, n: say(f"held-out block {k} of {n}", 0.7 + 0.28 * k / n),
    )
