"""Averages of long campaigns: the search needs no more rows than resolve the slow effects."""

from __future__ import annotations

import numpy as np

from gyromodel.campaign import Campaign
from gyromodel.signals import GAP

MAXIMUM_ROWS = 20_000


def average(campaign: Campaign, maximum: int = MAXIMUM_ROWS) -> tuple[Campaign, int]:
    """Means of consecutive samples, never across a gap or a change of segment, run or position.

    Returns:
        The shorter campaign and how many samples went into each mean (1: unchanged).
    """
    rows = len(campaign)
    together = -(-rows // maximum)
    if together == 1:
        return campaign, 1
    time = campaign.columns["time"]
    step = np.diff(time)
    breaks = np.concatenate([[False], step > GAP * np.median(step)])
    for name in ("segment", "run", "position"):
        if name in campaign.columns:
            breaks |= np.concatenate([[False], np.diff(campaign.columns[name]) != 0])
    stretch = np.cumsum(breaks)
    first = np.flatnonzero(np.concatenate([[True], np.diff(stretch) > 0]))
    within = np.arange(rows) - first[stretch]
    starts = np.flatnonzero(within % together == 0)
    counts = np.diff(np.append(starts, rows))
    starts, counts = starts[counts == together], counts[counts == together]
    index = starts[:, None] + np.arange(together)
    columns = {}
    for name, values in campaign.columns.items():
        group = values[index]
        seen = np.isfinite(group).sum(1)
        mean = np.where(seen > 0, np.nansum(group, axis=1) / np.maximum(seen, 1), np.nan)
        if name.startswith("output") and campaign.metadata["kind"] == "increment":
            mean = mean * together
        if name.startswith("output") and campaign.metadata["kind"] == "angle":
            mean = group[:, -1]
        columns[name] = mean
    return Campaign(columns, campaign.units, campaign.metadata, campaign.name), together
