"""What of a noisy record is a drive's behind leaks, beside what is smooth: it has a corner where the drive changes."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from gyromodel.numerics.smoothing import shares_beside_smooth

# Time constants of leaks, from so many samples to a part of the record: a few make any between.
LEAKS, QUICKEST, SLOWEST = 5, 8.0, 0.3
# Fewer samples have no corners to tell.
FEWEST = 60
# Samples of the drive that may be missing, in all.
MISSING = 0.2


def behind_leaks(
    time: Float[np.ndarray, " sample"], values: Float[np.ndarray, " sample"], drive: Float[np.ndarray, " sample"]
) -> tuple[Float[np.ndarray, " sample"], Float[np.ndarray, " sample"]]:
    """What of the values follows a drive that fills vessels which leak, and its derivative; zeros where nothing shows.

    As heat of a motor does a temperature. A drive that is missing for a moment is between its neighbours.
    """
    nothing = np.zeros(len(time)), np.zeros(len(time))
    known = np.isfinite(drive)
    if len(time) < FEWEST or known.mean() < 1.0 - MISSING or np.ptp(drive[known]) == 0 or np.ptp(values) == 0:
        return nothing
    flow = np.interp(time, time[known], drive[known] / np.max(np.abs(drive[known])))
    step = np.diff(time)
    leaks = np.geomspace(QUICKEST * np.median(step), SLOWEST * (time[-1] - time[0]), LEAKS)
    kept = np.exp(-step[:, None] / leaks)
    inside = np.empty((len(time), LEAKS))
    inside[0] = flow[0]
    for i, between in enumerate(0.5 * (flow[1:] + flow[:-1])):
        inside[i + 1] = between + kept[i] * (inside[i] - between)
    shares = shares_beside_smooth(time, values, inside)
    return inside @ shares, ((flow[:, None] - inside) / leaks) @ shares
