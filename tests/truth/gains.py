"""What adding the right effect gains on blocks left out, on average over white noise, by ordinary least squares."""

from __future__ import annotations

import numpy as np

from .contest import library
from .effects import error
from .study import Case, build

Array = np.ndarray
# Part of a signal's norm that shapes on a grid may miss.
MISSED = 0.01


def true_gain(case: Case) -> float:
    """Held-out rms of the simulation over that of the one that has the hidden effect too, fitted without each block.

    Both rms hold the noise and what noise leaves open of the parameters; an offset of its own that each run has is
    unknown of a run left out. Beyond 1 it is less than √(1 + λ²/n), at which nothing has to be estimated.
    """
    import gyromodel
    from gyromodel.diagnosis._gain import folds_of
    from gyromodel.signals import read_signals

    built = build(case)
    design, truth = built.design, built.truth
    signal = truth.error / np.linalg.norm(truth.error)
    before = np.column_stack([np.zeros((len(signal), 0)), *(error(n, design, 1.0, {}) for n in truth.baseline)])
    forms = np.moveaxis(library(design, case.effect)[str(case.effect)], 1, 0)
    models = [np.column_stack([before, form]) for form in forms]
    left = [np.linalg.norm(signal - _fit(model, signal, model)) for model in models]
    after = models[int(np.argmin(left))]
    if len(forms) > 1 and min(left) > MISSED:
        # A shape between those of the grid, which is a parameter as well.
        after = np.column_stack([after, signal])
    variance = float(np.mean(truth.noise**2))
    campaign = gyromodel.Campaign(columns=built.columns, units=built.units, metadata=built.metadata)
    folds = folds_of(read_signals(campaign))[0]
    simulated, extended = (
        np.mean([_error(model, truth.error, variance, rows) for rows in folds]) for model in (before, after)
    )
    return float(np.sqrt(simulated / extended))


def _fit(columns: Array, values: Array, predictors: Array) -> Array:
    """What columns fitted to values predict; of what the values do not tell, nothing."""
    scale = np.linalg.norm(columns, axis=0)
    scale[scale == 0] = 1.0
    return predictors / scale @ np.linalg.lstsq(columns / scale, values, rcond=1e-9)[0]


def _error(columns: Array, signal: Array, variance: float, rows: Array) -> float:
    """Expected mean square of a block by a model fitted to all other samples."""
    others = np.setdiff1d(np.arange(len(signal)), rows)
    missed = signal[rows] - _fit(columns[others], signal[others], columns[rows])
    weights = _fit(columns[others], np.eye(len(others)), columns[rows])
    return float(np.mean(missed**2) + variance * (1 + np.mean(np.sum(weights**2, axis=1))))
