"""How well the epoch of a step is known: no fit tells, as nothing changes while it moves between two samples."""

from __future__ import annotations

import numpy as np

from gyromodel.diagnosis._scan import Scanner
from gyromodel.diagnosis._tangents import VANISHED
from gyromodel.effects.drivers import BiasStep

# Share of the posterior that the interval holds.
CREDIBLE = 0.95


def epoch_interval(
    scanner: Scanner, columns: np.ndarray, residual: np.ndarray, step: BiasStep, g: int
) -> tuple[float, float, float]:
    """Standard uncertainty (s) and 95 % interval of the epoch of a step, in one noise cell.

    Every moment of its run is as likely beforehand. Given the data p(k) ∝ w_k (RSS − t_k)^(−(ν−1)/2) / √a_k, w_k the
    time between a sample and the one before, t_k what a step there explains beside everything else, a_k the energy of
    a unit step; the sizes of step and noise are integrated out. Between two samples all moments are alike.

    Args:
        scanner: the search.
        columns: of everything else, any scale.
        residual: what everything else leaves, as a rate.
        step: the step.
        g: the cell.
    """
    record = scanner.record
    x = np.where(scanner.present[:, None], np.column_stack([columns, residual]), 0.0)
    x = x / np.maximum(np.linalg.norm(x, axis=0), 1e-300)
    z = scanner.cells.precision(g, x)
    gram = x.T @ z
    inner = np.linalg.lstsq(gram[:-1, :-1], gram[:-1], rcond=1e-13)[0]
    after = scanner.to_run_end(np.cumsum(z[::-1], axis=0)[::-1])
    along = after[:, -1] - after[:, :-1] @ inner[:, -1]
    own = scanner.to_run_end(scanner.cells[g].step)
    energy = own - np.sum(after[:, :-1] * (after[:, :-1] @ np.linalg.pinv(gram[:-1, :-1], rcond=1e-13)), axis=1)
    run = record.run[scanner.epochs]
    within = run == (record.run_numbers.index(step.campaign) if step.campaign else 0)
    keep = within & (energy > VANISHED * own)
    rss = gram[-1, -1] - gram[-1, :-1] @ inner[:, -1]
    left = np.maximum(rss - along[keep] ** 2 / energy[keep], 1e-12 * rss)
    time, rows = np.asarray(record.signals["time"]), np.flatnonzero(scanner.present)
    to = time[scanner.epochs[keep]]
    width = to - time[rows[np.searchsorted(rows, scanner.epochs[keep]) - 1]]
    freedom = scanner.degrees_of_freedom - x.shape[1]
    log = np.log(width) - 0.5 * freedom * np.log(left) - 0.5 * np.log(energy[keep])
    part = np.exp(log - log.max())
    part /= part.sum()
    middle = to - 0.5 * width
    std = float(np.sqrt(part @ ((middle - part @ middle) ** 2 + width**2 / 12.0)))
    # Spread evenly within each pair of samples, which follow one another.
    share, ends = np.cumsum(np.append(0.0, part)), np.append(to[0] - width[0], to)
    low, high = np.interp([0.5 * (1.0 - CREDIBLE), 0.5 * (1.0 + CREDIBLE)], share, ends)
    return std, float(low), float(high)
