"""The base motion of a logged platform test against the motion that was simulated, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest

from gyromodel import CampaignError
from gyromodel.campaign import Campaign
from gyromodel.platform import base_motion, is_platform
from tests.truth.platform import Platform
from tests.truth.platform_campaign import vibration_test

FREE = Platform(viscous=np.zeros(4), coulomb=np.zeros(4), earth=0.0)
AMPLITUDE = np.deg2rad(0.15) * np.eye(3)


@pytest.fixture(scope="module")
def log() -> Campaign:
    return vibration_test(FREE, AMPLITUDE, np.full((3, 3), 10.0), 2.0)


def still(campaign: Campaign) -> Campaign:
    """At the pole of an Earth that hardly turns the platform: its rate is vertical, about the azimuth alone."""
    return campaign.with_metadata({"latitude_deg": 90.0})


def test_the_base_moves_as_the_table(log: Campaign):
    assert is_platform(log)
    motion = base_motion(still(log))
    # The Earth turns the axes under a body that does not, about the vertical; each run is aligned anew.
    turned = np.outer(motion.time % 7.0, [0.0, 7.292115e-5, 0.0])
    assert np.abs(motion.base - turned - motion.table).max() < 2e-6
    assert np.bincount(motion.segment).tolist() == [200] * 3


def test_the_axes_of_the_table_are_what_the_log_says(log: Campaign):
    """Roll, azimuth and pitch by other names and senses: the same agreement."""
    renamed = {
        "table_x": -log.columns["table_z"],
        "table_y": log.columns["table_x"],
        "table_z": -log.columns["table_y"],
    }
    other = still(log).with_metadata({"table_axes": "-pitch, roll, -azimuth"})
    for name, values in renamed.items():
        other = other.with_column(name, values, "deg")
    first, second = base_motion(still(log)), base_motion(other)
    assert np.abs(second.base - first.base[:, [2, 0, 1]] * [-1, 1, -1]).max() < 1e-12


@pytest.mark.parametrize("heading", [0.0, 45.0, 90.0, -90.0, 180.0])
def test_a_heading_turns_the_axes_about_which_the_earth_turns(log: Campaign, heading: float):
    """On the equator a body that keeps its attitude turns about north by minus the Earth's rate.

    North is x at heading 0, about which pitch turns by −x, and −z at 90 degrees, where roll turns by z.
    """
    motion = base_motion(log.with_metadata({"latitude_deg": 0.0, "heading_deg": heading}))
    for run in range(3):
        one = motion.segment == run
        slope = np.polyfit(motion.time[one], (motion.base - motion.table)[one], 1)[0] / 7.292115e-5
        assert slope == pytest.approx([np.sin(np.deg2rad(heading)), 0.0, np.cos(np.deg2rad(heading))], abs=0.02)


def test_logged_rates_turn_the_platform(log: Campaign):
    """Gimbals that read the same on a body that turns are on a base that turns: azimuth by −y."""
    quiet, turning = still(log).with_metadata({"kind": "rate"}), {"x": 0.0, "y": 72.0, "z": 0.0}
    for axis, rate in turning.items():
        quiet = quiet.with_column(f"output_{axis}", np.full(len(log), rate), "deg/h")
    changed = base_motion(quiet).base - base_motion(still(log)).base
    since = base_motion(quiet).time % 7.0
    assert changed == pytest.approx(np.outer(-np.deg2rad(72.0) / 3600 * since, [0.0, 1.0, 0.0]), abs=3e-6)


def test_angles_may_wrap(log: Campaign):
    """Encoders that count from 0 to 360 deg, some of whose runs begin below zero: the same motion."""
    wrapped = log
    for name in log.columns:
        if log.units[name] == "deg":
            wrapped = wrapped.with_column(name, np.mod(log.columns[name], 360.0), "deg")
    one, two = base_motion(log), base_motion(wrapped)
    assert np.abs((one.base - one.table) - (two.base - two.table)).max() < 1e-9
    assert np.ptp(two.table, axis=0).max() < np.deg2rad(1.0)
    assert np.ptp(two.gimbals, axis=0).max() < np.deg2rad(1.0)


@pytest.mark.parametrize(
    "change",
    [
        lambda c: c.with_metadata({"table_axes": "-roll, azimuth, pitch"}),
        lambda c: c.with_metadata({"table_axes": "azimuth, roll, pitch"}),
        lambda c: c.with_column("table_x", c.columns["table_x"], "arcsec"),
        lambda c: c.with_column("gimbal_z", c.columns["gimbal_z"], "mrad"),
        lambda c: c.with_column("gimbal_z", 0.0 * c.columns["gimbal_z"], "deg"),
    ],
    ids=["sign", "axes", "unit", "mrad", "dead encoder"],
)
def test_axes_that_do_not_move_alike_are_refused(log: Campaign, change):
    """They would pass for a delay of half a period, or for a mode."""
    with pytest.raises(CampaignError, match=r"times as far as table_x, .*table_axes"):
        base_motion(change(log))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda c: c.without("table_y"), "table_y"),
        (lambda c: c.without("gimbal_y"), "gimbal_y"),
        (lambda c: c.with_metadata({"latitude_deg": None}), "latitude_deg"),
        (lambda c: c.with_metadata({"heading_deg": "north"}), "heading_deg"),
        (lambda c: c.with_metadata({"table_axes": "yaw, roll, pitch"}), "table_axes"),
        (lambda c: c.with_column("table_x", np.where(np.arange(len(c)) == 7, np.nan, 0.0), "deg"), "row 8"),
        (lambda c: c.with_column("output_x", np.zeros(len(c)), "deg/h").with_metadata({"kind": "rate"}), "output_y"),
    ],
)
def test_what_is_missing_is_named(log: Campaign, change, words: str):
    with pytest.raises(CampaignError, match=words):
        base_motion(change(log))
