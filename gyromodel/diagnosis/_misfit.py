"""Axes of a vibration test whose oscillations a fitted model does not explain, however well it does the rest.

A whitening filter takes what is left for noise, and a misfit of a hundredth of the noise's own spread, at the frequency
of each run, is none that it shows: standard uncertainties would be those of a model that holds.
"""

from __future__ import annotations

import numpy as np
from scipy.stats import chi2

from gyromodel.campaign import AXES
from gyromodel.estimate import Estimate, filter_of, whiten_columns

# Probability below which an axis is not explained.
SELDOM = 1e-4
# Part of an oscillation's own size, after what the parameters take of it, below which nothing is left to test.
LEFT = 1e-2


def unexplained_axes(estimate: Estimate) -> list[str]:
    """Axes X, Y, Z that fail the test below, the worst first."""
    found = axis_probabilities(estimate)
    return sorted((axis for axis in found if found[axis] < SELDOM), key=lambda axis: found[axis])


def axis_probabilities(estimate: Estimate) -> dict[str, float]:
    """Of sines as large in noise alone: χ² of the residual's at the frequencies of all runs about each axis."""
    record, signals = estimate.record, estimate.record.signals
    waves, jacobian = (np.asarray(signals[n]) for n in ("_real", "_imaginary")), estimate.model.linearise(signals)[1]
    # A run of the record is one axis of a run of the log, X, Y and Z in turn.
    moved = [k for k in np.unique(record.run) if np.any(np.asarray(signals["_real"])[record.run == k])]
    if not moved:
        return {}
    sines = np.stack([np.where(record.run == k, wave, 0.0) for wave in waves for k in moved], axis=1)
    columns = np.asarray(whiten_columns(filter_of(record, estimate.ratios), np.column_stack([jacobian, sines])))
    columns = columns[: record.rows][record.present]
    columns = columns / np.linalg.norm(columns, axis=0)
    jacobian, sines = np.split(columns, [-sines.shape[1]], axis=1)
    taken = np.linalg.qr(jacobian)[0]
    sines, axis = sines - taken @ (taken.T @ sines), np.tile(np.array(moved) % 3, 2)
    residual, found = estimate.whitened[record.present], {}
    for a in np.unique(axis):
        left, sizes, _ = np.linalg.svd(sines[:, axis == a], full_matrices=False)
        left = left[:, sizes > LEFT]
        found[AXES[a].upper()] = float(chi2.sf(np.sum((left.T @ residual) ** 2), left.shape[1]))
    return found
