"""Rates from attitudes of simulated motion, whose rates are known; the attitude is integrated by rotation vectors."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gyromodel.attitude import body_rates, with_reference_rates
from gyromodel.campaign import Campaign
from gyromodel.compensation import compensate, reference_error
from gyromodel.estimate import fit
from gyromodel.model import model_from_effects

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


def rotating(rows: int = 300, **metadata: str) -> tuple[Campaign, np.ndarray]:
    """A three-axis gyro without errors under its attitude, or axis x of it where metadata are given; and its rates."""
    time, rate, attitude = moved(rows)
    outputs = {"output": rate[:, 0]} if metadata else {f"output_{a}": rate[:, i] for i, a in enumerate("xyz")}
    columns = {"time": time} | outputs | {f"attitude_{p}": attitude[:, i] for i, p in enumerate("wxyz")}
    units = {n: "s" if n == "time" else "rad/s" if n.startswith("o") else "" for n in columns}
    return Campaign(columns, units, {"kind": "rate"} | metadata), rate


def without_attitude(campaign: Campaign, rows: np.ndarray) -> Campaign:
    for name in [n for n in campaign.columns if n.startswith("attitude")]:
        campaign = campaign.with_column(name, np.where(rows, np.nan, campaign.columns[name]), "")
    return campaign


def test_rates_keep_the_gaps_of_the_attitude():
    campaign, rate = rotating()
    row = np.arange(300)
    time = campaign.columns["time"] + (row >= 200)
    campaign = without_attitude(campaign.with_column("time", time, "s"), (row >= 100) & (row < 120))
    found, said = with_reference_rates(campaign)
    left = np.r_[2:98, 122:198, 202:298]
    assert np.array_equal(found.columns["time"], time[left])
    assert "32 rows without a rate from the attitude were left out" in said
    assert np.abs(found.columns["rate_z"] - rate[left, 2]).max() < 1e-4
    assert found.axis("x").columns["rate"] is found.columns["rate_x"]
    # What has a rate keeps it.
    rated = campaign.with_column("rate", rate[:, 0], "rad/s")
    assert with_reference_rates(rated) == (rated, "")


def test_a_single_axis_says_which_it_is():
    campaign, rate = rotating(axis="x")
    found, _ = with_reference_rates(campaign)
    assert {"rate", "rate_y", "rate_z"} == {n for n in found.columns if n.startswith("rate")}
    assert np.abs(found.columns["rate"] - rate[2:-2, 0]).max() < 1e-4
    three, _ = with_reference_rates(rotating()[0].axis("x"))
    assert np.array_equal(three.columns["rate_y"], found.columns["rate_y"])
    nameless = campaign.with_metadata({"axis": None})
    kept, said = with_reference_rates(nameless)
    assert kept is nameless
    assert "metadata 'axis' does not say" in said


@pytest.mark.parametrize(("attitude", "said"), [(2.0, "no unit quaternion"), (np.nan, "no stretch of 0.05 s")])
def test_what_is_no_attitude_is_not_used(attitude: float, said: str):
    campaign = without_attitude(rotating(50)[0], np.ones(50, bool))
    campaign = campaign.with_column("attitude_w", np.full(50, attitude), "")
    campaign = campaign.with_column("attitude_x", np.full(50, 0.0 * attitude), "")
    for name in ("attitude_y", "attitude_z"):
        campaign = campaign.with_column(name, np.full(50, 0.0 * attitude), "")
    kept, found = with_reference_rates(campaign)
    assert kept is campaign
    assert said in found


def test_fit_takes_the_rates_and_compensate_keeps_the_rows():
    """Every second seventh of the attitude is missing; a lean towards y needs its rates, a scale factor does not."""
    campaign = without_attitude(rotating(700, axis="x")[0], np.arange(700) // 100 % 2 == 1)
    lean = "misalignment"
    for effects in (["scale_factor"], ["scale_factor", lean]):
        estimate = fit(campaign, model_from_effects(effects))
        assert float(estimate.model.gain()) == pytest.approx(1.0, abs=1e-3)
        out = compensate(campaign, estimate.calibration())
        assert len(out) == 700
        assert set(campaign.columns) <= set(out.columns)
        assert np.isfinite(out.columns["rate_estimated"]).sum() == (700 if lean not in effects else 4 * 96)
        error = reference_error(out)
        assert error is not None
        assert error.compensated < 2e-3


def test_an_attitude_on_few_rows_stops_nothing():
    campaign = without_attitude(rotating(300, axis="x")[0], np.arange(300) % 10 > 0)
    estimate = fit(campaign, model_from_effects(["bias"]))
    assert estimate.record.rows == 300
    assert len(compensate(campaign, estimate.calibration())) == 300
