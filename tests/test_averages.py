"""Means of samples that turn: angles against the cosines and sines of their own samples."""

from __future__ import annotations

import numpy as np
import pytest

from gyromodel._checks import CampaignError
from gyromodel.averages import average, turning, with_interval_rates
from gyromodel.campaign import Campaign

ROWS = 1000


def turned(speed: float, unit: str = "deg") -> Campaign:
    """A table that turns by some degrees a sample, its angle from 0 to 360; the gyro senses the angle's cosine."""
    angle = speed * np.arange(ROWS) % 360.0
    columns = {"time": np.arange(ROWS) * 1.0, "output": np.cos(np.deg2rad(angle)), "azimuth": angle}
    return Campaign(columns, {"time": "s", "output": "deg/h", "azimuth": unit}, {"kind": "rate"})


@pytest.mark.parametrize("speed", [1.1, 6.1])
def test_an_angle_keeps_its_direction_across_its_wrap(speed: float):
    short, together = average(turned(speed), 200)
    assert together == 5
    mean = np.cos(np.deg2rad(short.columns["azimuth"]))
    # A mean of five cosines is as much shorter as a chord of the turn: one number for all.
    ratio = np.sin(5 * np.deg2rad(speed) / 2) / (5 * np.sin(np.deg2rad(speed) / 2))
    assert np.abs(short.columns["output"] - ratio * mean).max() < 1e-9


def test_an_angle_that_stands_or_never_wraps_has_its_plain_mean():
    still = turned(1.1).with_column("azimuth", np.full(ROWS, 200.1), "deg")
    assert (average(still, 200)[0].columns["azimuth"] == 200.1).all()
    missing = still.with_column("azimuth", np.where(np.arange(ROWS) < 7, np.nan, 3600.0 + np.arange(ROWS)), "deg")
    found = average(missing, 200)[0].columns["azimuth"]
    assert np.isnan(found[0])
    assert found[1:3] == pytest.approx([3608.0, 3612.0])


def test_means_are_of_the_samples_with_an_output():
    """A perfect gyro that answers each tenth sample of a swept rate reads the rate; a column known elsewhere stays."""
    row = np.arange(ROWS)
    rate, place = 0.1 * row, np.where(row % 10 == 5, 20.0 + row, np.nan)
    columns = {"time": 0.01 * row, "rate": rate, "temperature": place, "output": np.where(row % 10 == 0, rate, np.nan)}
    units = {"time": "s", "rate": "deg/s", "temperature": "degC", "output": "deg/s"}
    short, together = average(Campaign(columns, units, {"kind": "rate"}), 50)
    assert together == 20
    assert np.abs(short.columns["output"] - short.columns["rate"]).max() < 1e-12
    assert short.columns["temperature"] == pytest.approx(30.0 + 20.0 * np.arange(50))


def test_angles_that_turn_far_within_a_mean_are_told():
    assert turning(turned(6.1), 5) == ["azimuth"]
    assert turning(turned(1.1), 5) == []
    assert turning(turned(6.1), 1) == []


def test_three_axes_of_increments_are_asked_to_choose_one():
    columns = {"time": np.arange(ROWS) * 1.0} | {f"output_{a}": np.sin(np.arange(ROWS)) for a in "xyz"}
    campaign = Campaign(columns, {n: "s" if n == "time" else "arcsec" for n in columns}, {"kind": "increment"})
    with pytest.raises(CampaignError, match="choose one axis"):
        average(campaign, 200)


def test_rates_over_intervals_are_what_an_angle_has_turned():
    """Of a sine, whose integral is known; not in the first row, nor behind a gap."""
    time = np.delete(0.01 * np.arange(400), range(200, 210))
    angle, rate = -10.0 / 3.0 * np.cos(3.0 * time), 10.0 * np.sin(3.0 * time)
    columns = {"time": time, "rate": rate, "temperature": rate, "output": np.diff(angle, prepend=0.0)}
    units = {"time": "s", "rate": "deg/s", "temperature": "degC", "output": "deg"}
    of = with_interval_rates(Campaign(columns, units, {"kind": "increment"}))
    known = np.isfinite(of.columns["output"])
    assert np.flatnonzero(~known).tolist() == [0, 200]
    assert of.columns["rate"][known] == pytest.approx(np.diff(angle, prepend=0.0)[known] / 0.01, abs=2e-6)
    assert np.abs(rate - of.columns["rate"])[known].max() > 0.1
    assert (of.columns["temperature"] == rate).all()


@pytest.mark.parametrize("shift", [0.0, 0.3])
def test_rates_over_intervals_know_the_corners_of_a_table(shift: float):
    """Of ramps between constant rates, whose corners are rows or lie between; the integral by hand."""
    time = np.arange(200.0)
    corners = shift + np.array([0.0, 20.0, 25.0, 50.0, 55.0, 80.0, 90.0, 120.0, 121.0, 150.0])
    rates = np.array([0.0, 0.0, 10.0, 10.0, -5.0, -5.0, 5.0, 5.0, 0.0, 0.0])
    fine = np.linspace(0.0, 199.0, 199_001)
    course = np.interp(fine, corners, rates)
    angle = np.concatenate([[0.0], np.cumsum(0.5e-3 * (course[1:] + course[:-1]))])[::1000]
    columns = {"time": time, "rate": np.interp(time, corners, rates), "output": np.diff(angle, prepend=0.0)}
    of = with_interval_rates(Campaign(columns, {"time": "s", "rate": "deg/s", "output": "deg"}, {"kind": "increment"}))
    off = np.abs(of.columns["rate"] - np.diff(angle, prepend=0.0))[1:]
    if shift:
        # A corner between two rows is not known: only there is the mean off, by an eighth of the change of slope or so.
        assert (off > 0.03).sum() <= 2 * (len(corners) - 1)
        assert off.max() < 5.0 / 8.0 + 0.1
    else:
        assert off.max() < 1e-9
