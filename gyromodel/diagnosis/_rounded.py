"""What rounding of the output makes, or may have left, of what a search finds: lines, curves, points, effects."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gyromodel.diagnosis._selection import Selection
from gyromodel.diagnosis._shapes import driver_shape
from gyromodel.diagnosis._steps import Steps
from gyromodel.effects.drivers import BiasPeriodic
from gyromodel.estimate import Estimate
from gyromodel.numerics.rounding import quantum

# Times the saw tooth of rounding that what it makes may be.
ROUNDED = 2.0


def of_rounding(estimate: Estimate) -> bool:
    """Whether rounding alone makes lines as large as the strongest, of rates or of the angle behind them."""
    record, gain = estimate.record, abs(float(estimate.model.gain()))
    lines = [e for e in estimate.model.effects if isinstance(e, BiasPeriodic)]
    output = np.asarray(record.signals["output"])[: record.rows][record.present]
    step = quantum(output)
    if step is None or not lines:
        return False
    # The fundamental of the saw tooth, less by what noise of the unrounded output smears of it; at least of an angle's,
    # whose differences have twice the variance of its rounding.
    noise = max(estimate.white_variance - step**2 / 6.0, 0.0)
    tooth = step / np.pi * np.exp(-2.0 * np.pi**2 * noise / step**2)
    strongest = max(float(np.hypot(e.cosine, e.sine).max()) for e in lines)
    return bool(gain * strongest < ROUNDED * tooth)


def curve_of_rounding(steps: Steps, selection: Selection, driver: str, saw_tooth: float) -> bool:
    """Whether a curve may be what rounding has left."""
    if not saw_tooth:
        return False
    curve = driver_shape(steps.scanner, selection, driver, steps.scanner.record.input_unit).y
    return bool(abs(float(selection.estimate.model.gain())) * np.ptp(curve) < ROUNDED * saw_tooth)


def no_farther(estimate: Estimate, rows: Sequence[int], saw_tooth: float) -> bool:
    """Whether rows that were given up lie no farther from the model than rounding may have left them."""
    signals = estimate.record.signals
    left = np.asarray(signals["output"] - estimate.model.predict(signals))
    return bool(np.abs(left[list(rows)]).max() < ROUNDED * saw_tooth)


def no_larger(estimate: Estimate, name: str, saw_tooth: float) -> bool:
    """Whether an effect does nowhere more to the output than rounding may have left in it."""
    signals, model = estimate.record.signals, estimate.model
    if name not in model.labels:
        return False
    change = np.asarray(model.predict(signals) - model.without(name).predict(signals))
    return bool(np.abs(change[: estimate.record.rows][estimate.record.present]).max() < ROUNDED * saw_tooth)
