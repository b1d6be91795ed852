"""Rates from attitudes of simulated motion, whose rates are known; the attitude is integrated by rotation vectors."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gyromodel._checks import CampaignError
from gyromodel.attitude import body_rates, with_reference_rates
from gyromodel.campaign import Campaign

STEP, FINER = 0.01, 50


def moved(rows: int = 1500) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Time, rates (rad/s, to 2 Hz) in the axes of the body, and its attitude as w, x, y, z."""
    fine = np.arange(rows * FINER) * STEP / FINER
    tones = np.random.default_rng(3).uniform([0.1, 0.0], [2.0, 6.28], (3, 4, 2))
    middle = fine + STEP / FINER / 2  # each small turn is by the rate in its middle
    rate, between = (
        sum(np.sin(6.28 * f * t[:, None] + p) for f, p in tones.transpose(1, 2, 0)) for t in (fine, middle)
    )
    attitude, turns = [Rotation.identity()], Rotation.from_rotvec(between * STEP / FINER)
    for k in range(0, (rows - 1) * FINER, FINER):
        turned = attitude[-1]
        for turn in turns[k : k + FINER]:
            turned = turned * turn
        attitude.append(turned)
    quaternion = Rotation.concatenate(attitude).as_quat(scalar_first=True)
    return fine[::FINER], rate[::FINER], quaternion


def test_rates_are_those_of_the_motion():
    time, rate, attitude = moved(300)
    found = body_rates(time, attitude * np.where(np.arange(len(time)) % 7 < 3, -1.0, 1.0)[:, None])
    inside = np.isfinite(found).all(axis=1)
    assert inside.sum() == len(time) - 4
    # A cubic through five samples loses 2e-5 of a rate at 2 Hz, at four tones of 1 rad/s each.
    assert np.abs(found - rate)[inside].max() < 1e-4


def test_rates_keep_the_gaps_of_the_attitude():
    time, rate, attitude = moved(300)
    attitude[100:120] = np.nan
    time[200:] += 1.0
    output = {f"output_{a}": rate[:, i] for i, a in enumerate("xyz")}
    columns = {"time": time} | output | {f"attitude_{p}": attitude[:, i] for i, p in enumerate("wxyz")}
    units = {n: "s" if n == "time" else "rad/s" if n.startswith("o") else "" for n in columns}
    campaign = Campaign(columns, units, {"kind": "rate"})
    found = with_reference_rates(campaign)
    left = np.r_[2:98, 122:198, 202:298]
    assert np.array_equal(found.columns["time"], time[left])
    assert np.abs(found.columns["rate_z"] - rate[left, 2]).max() < 1e-4
    assert found.axis("x").columns["rate"] is found.columns["rate_x"]
    # What has a rate keeps it.
    rated = campaign.with_column("rate", rate[:, 0], "rad/s")
    assert with_reference_rates(rated) is rated


@pytest.mark.parametrize(("attitude", "said"), [(2.0, "no unit quaternion"), (np.nan, "no stretch of 0.05 s")])
def test_what_is_no_attitude_is_refused(attitude: float, said: str):
    time = np.arange(50) * STEP
    columns = {"time": time, "output": np.sin(time)} | {f"attitude_{p}": np.full(50, attitude) for p in "wxyz"}
    units = dict.fromkeys(columns, "") | {"time": "s", "output": "rad/s"}
    with pytest.raises(CampaignError, match=said):
        with_reference_rates(Campaign(columns, units, {"kind": "rate"}))
