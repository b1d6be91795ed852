"""Vibration tests of the simulated platform as a user logs them: one file, one run after another."""

from __future__ import annotations

import numpy as np

from gyromodel.campaign import Campaign
from tests.truth import platform
from tests.truth.platform import Platform

# Outermost first, as the rigid-body simulation counts them.
GIMBALS = ("gimbal_y_outer", "gimbal_x", "gimbal_y", "gimbal_z")
PAUSE = 5.0
"""Between two runs, s."""


def vibration_test(
    design: Platform, amplitude: np.ndarray, frequency: np.ndarray, duration: float, skip: float = 0.0, seed: int = 0,
    noise: float = 0.0,
) -> Campaign:  # fmt: skip
    """Runs one after another, each from rest; what comes before `skip` is not logged.

    Args:
        design: of all runs.
        amplitude: run by X, Y, Z, rad.
        frequency: likewise, rad/s.
        duration: of each run, s.
        skip: s.
        seed: of the gyros' and the encoders' noise.
        noise: standard deviation of each encoder reading besides its quantum, rad.
    """
    run = platform.simulate(design, amplitude, frequency, duration, seed=seed)
    kept = run.time >= skip
    rng = np.random.default_rng([seed, 1])
    parts = []
    for k, (table, gimbals) in enumerate(zip(run.table, run.gimbals, strict=True)):
        readings = np.concatenate([table, gimbals], axis=1)[kept]
        readings = readings + noise * rng.standard_normal(readings.shape)
        time = run.time[kept] - skip + k * (duration - skip + PAUSE)
        parts.append(np.column_stack([time, np.full(kept.sum(), k + 1.0), np.rad2deg(readings)]))
    names = ["time", "segment", "table_x", "table_y", "table_z", *GIMBALS]
    units = dict(zip(names, ["s", "", *["deg"] * 7], strict=True))
    columns = dict(zip(names, np.concatenate(parts).T, strict=True))
    return Campaign(columns, units, {"latitude_deg": float(np.rad2deg(design.latitude))})
