"""Static poses of simulated hand-turned tests, of which the true poses are known, and of a measured one."""

from __future__ import annotations

import numpy as np
import pytest

import gyromodel
from gyromodel._checks import CampaignError
from gyromodel.campaign import Campaign
from gyromodel.files import read_campaign
from gyromodel.poses import at_rest, static_poses

STEP = 0.01


def turned(rng: np.random.Generator, poses: int, by_gravity: float = 0.0) -> tuple[Campaign, np.ndarray]:
    """Rests of 3 to 8 s, turns of 1 to 2 s between them; and the number of each row's pose, 0 in motion.

    A hand's tremor of 10 Hz stays at rest; `by_gravity` is the gyro's error (rad/s) at 1 g along y.
    """
    truth, rate, level = [], [], []
    start = rng.uniform(-1, 1, 3)
    for k in range(poses):
        rest, turn = int(rng.uniform(3, 8) / STEP), int(rng.uniform(1, 2) / STEP)
        end, phase = rng.uniform(-1, 1, 3), (1 - np.cos(np.pi * np.arange(turn) / turn)) / 2
        truth.append(np.r_[np.full(rest, k + 1), np.zeros(turn)])
        rate.append(np.r_[np.zeros(rest), rng.uniform(0.5, 1.5) * np.sin(np.pi * np.arange(turn) / turn)])
        level.append(np.r_[np.tile(start, (rest, 1)), start + (end - start) * phase[:, None]])
        start = end
    truth, rate, level = (np.concatenate(v) for v in (truth, rate, level))
    acceleration = 9.8 * level + 0.02 * rng.standard_normal(level.shape)
    time = np.arange(len(rate)) * STEP
    wrong = by_gravity * level[:, 1] + 0.005 * np.sin(62.8 * time) + 0.01 * rng.standard_normal(len(rate))
    columns = {"time": time, "output": rate + wrong}
    columns |= {f"acceleration_{axis}": acceleration[:, i] for i, axis in enumerate("xyz")}
    units = {"time": "s", "output": "rad/s"} | {f"acceleration_{axis}": "m/s^2" for axis in "xyz"}
    return Campaign(columns, units, {"kind": "rate", "test": "multi_position"}), truth


def test_poses_are_those_that_were_held():
    campaign, truth = turned(np.random.default_rng(4), 20)
    found = at_rest(campaign)
    kept = np.searchsorted(campaign.columns["time"], found.columns["time"])
    assert np.array_equal(found.columns["position"], truth[kept])
    # All rows of a pose but about a window at its ends.
    assert len(kept) > (truth > 0).sum() - 20 * 1.2 / STEP


@pytest.mark.parametrize("step", [0.04, 0.1, 0.4])
def test_coarse_readings_are_at_rest_as_well(step: float, rng: np.random.Generator):
    """Steps of 4 to 40 mg for a noise of 2: readings that do not move, or go to and fro."""
    campaign, truth = turned(rng, 12)
    columns = {n: v if n in ("time", "output") else step * np.round(v / step) for n, v in campaign.columns.items()}
    columns["acceleration_z"] = np.full(len(truth), step)
    found = at_rest(Campaign(columns, campaign.units, campaign.metadata))
    kept = np.searchsorted(campaign.columns["time"], found.columns["time"])
    assert np.array_equal(found.columns["position"], truth[kept])


def test_hand_turned_poses_of_a_measured_unit(measured_data):
    """Its authors turned it 37 times after a still start."""
    found = at_rest(read_campaign(measured_data("mems_multiposition_a/campaign.csv.gz")))
    assert len(np.unique(found.columns["position"])) == 38


def test_what_numbers_its_positions_or_is_no_such_test_stays_as_it_is(rng: np.random.Generator):
    campaign, truth = turned(rng, 3)
    for other in (campaign.with_metadata({"test": "static"}), campaign.with_column("position", truth, "")):
        assert at_rest(other) is other


def test_without_poses_or_accelerations_there_is_a_sentence(rng: np.random.Generator):
    campaign, _ = turned(rng, 3)
    bare = campaign
    for axis in "xyz":
        bare = bare.without(f"acceleration_{axis}")
    with pytest.raises(CampaignError, match="there are none"):
        static_poses(bare)
    with pytest.raises(CampaignError, match="shows 1 static poses"):
        static_poses(campaign.select(slice(0, 250)))


@pytest.mark.long
def test_what_gravity_adds_is_named_and_judged_by_means_of_poses():
    """The truth is 0.004 rad/s per g; noise of 0.01 rad/s a row leaves 0.01/√300 = 6e-4 in the mean of a pose."""
    rng = np.random.default_rng(6)
    wrong, right = (turned(rng, 16, by_gravity)[0] for by_gravity in (4e-3, 0.0))
    found = gyromodel.diagnose(wrong, gyromodel.model_from_effects(["bias"]))
    assert [cause.effect for cause in found.causes] == ["bias_acceleration_y"]
    assert found.gain.folds == 10
    assert "groups of positions" in found.gain.scheme
    assert found.gain.after < 1e-3
    assert found.gain.ci95[0] > 1.0
    assert gyromodel.diagnose(right, gyromodel.model_from_effects(["bias"]), hold_out=False).verdict == "adequate"
