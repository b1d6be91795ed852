"""Static poses of a multi-position test, found in the data where no column numbers them."""

from __future__ import annotations

import numpy as np

from gyromodel._checks import CampaignError
from gyromodel.campaign import Campaign

# Length (s) of the windows whose scatter tells rest from motion, and of the shortest pose.
WINDOW, SHORTEST = 0.5, 1.5
# At rest the scatter of each column is below this many times its usual one there, the lowest fifth of the windows.
QUIET, USUAL = 6.0, 0.2


def at_rest(campaign: Campaign) -> Campaign:
    """The static poses of a multi-position test that numbers none and logs no rate; any other campaign as it is."""
    unnumbered = campaign.metadata.get("test") == "multi_position" and not {"position", "rate"} & set(campaign.columns)
    return static_poses(campaign) if unnumbered else campaign


def static_poses(campaign: Campaign) -> Campaign:
    """The campaign without the rows in motion, and with a column `position` that numbers the poses from 1.

    A pose is a stretch in which the scatter of every output and acceleration within half a second stays low.

    Args:
        campaign: with at least one acceleration; outputs and accelerations in any unit.

    Raises:
        CampaignError: there are no accelerations, or fewer than two poses.
    """
    watched = [n for n in campaign.columns if n.startswith(("output", "acceleration"))]
    if not any(n.startswith("acceleration") for n in watched):
        raise CampaignError(f"{campaign.name}: poses are found by accelerations, and there are none")
    time = campaign.si("time")
    width = max(round(WINDOW / float(np.median(np.diff(time)))), 2)
    still = np.ones(len(time), bool)
    for name in watched:
        values = campaign.columns[name]
        scatter, steps = _scatter(values, width), np.diff(np.unique(values[np.isfinite(values)]))
        # A coarse reading at rest stays as it is, or goes to and fro by one step.
        least = QUIET * np.quantile(scatter[np.isfinite(scatter)], USUAL)
        still &= scatter < max(least, steps.min(initial=np.inf))
    # A window that moves tells of motion somewhere in it.
    moving = np.convolve(~still, np.ones(width), "same") > 0.5
    ends = np.flatnonzero(np.diff(np.concatenate([[True], moving, [True]]).astype(int)))
    position = np.zeros(len(time))
    for first, last in ends.reshape(-1, 2):
        if time[last - 1] - time[first] >= SHORTEST:
            position[first:last] = position.max() + 1
    if position.max() < 2:
        raise CampaignError(f"{campaign.name}: shows {int(position.max())} static poses of {SHORTEST:g} s or more")
    return campaign.with_column("position", position, "").select(position > 0)


def _scatter(values: np.ndarray, width: int) -> np.ndarray:
    """Standard deviation in a window around each row; infinite where a sample is missing."""
    values = values - np.nanmean(values)
    sums = [np.convolve(v, np.ones(width) / width, "same") for v in (values, values**2)]
    spread = np.sqrt(np.maximum(sums[1] - sums[0] ** 2, 0.0))
    return np.where(np.isfinite(spread), spread, np.inf)
