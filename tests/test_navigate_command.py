"""`gyromodel navigate`: closed forms of a body at rest and of one that turns about the vertical; what it refuses."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gyromodel import cli
from gyromodel.campaign import Campaign
from gyromodel.files import read_campaign, write_campaign
from tests.truth.navigation import OMEGA, normal_gravity

ROWS, STEP, LATITUDE = 601, 0.1, 0.7
START = Rotation.from_rotvec([0.3, -0.2, 1.1])


def log(turning: float = 0.1) -> Campaign:
    """A body that turns about the vertical (its own second axis at the start is anywhere), at rest over the Earth."""
    time = np.arange(ROWS) * STEP
    attitude = Rotation.from_rotvec(np.outer(turning * time, [0.0, 1.0, 0.0])) * START
    rate = OMEGA * np.array([np.cos(LATITUDE), np.sin(LATITUDE), 0.0]) + np.array([0.0, turning, 0.0])
    rates = attitude.inv().apply(rate)
    forces = attitude.inv().apply([0.0, normal_gravity(LATITUDE, 50.0), 0.0])
    columns = {"time": time}
    columns |= {f"output_{a}": np.rad2deg(rates[:, i]) for i, a in enumerate("xyz")}
    columns |= {f"acceleration_{a}": forces[:, i] for i, a in enumerate("xyz")}
    columns |= dict(zip([f"attitude_{p}" for p in "xyzw"], np.tile(START.as_quat(), (ROWS, 1)).T, strict=True))
    units = {name: "deg/s" if name.startswith("output") else "m/s^2" for name in columns} | {"time": "s"}
    units |= dict.fromkeys([n for n in columns if n.startswith("attitude")], "")
    return Campaign(columns, units, {"kind": "rate", "latitude_deg": np.rad2deg(LATITUDE), "height_m": 50.0})


def navigated(campaign: Campaign, folder: Path) -> Campaign:
    write_campaign(campaign, folder / "log.csv")
    with pytest.raises(SystemExit) as done:
        cli.main(["navigate", str(folder / "log.csv"), "-o", str(folder / "out" / "navigated.csv"), "--json"])
    assert done.value.code == 0
    return read_campaign(folder / "out" / "navigated.csv")


@pytest.mark.parametrize("turning", [-0.1, 0.4])
def test_a_body_over_one_place_stays_there(turning: float, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    made = navigated(log(turning), tmp_path)
    # Files hold sixteen digits; the rates of a cone are integrated by a cubic.
    assert np.abs([made.columns[f"velocity_{n}"] for n in ("north", "up", "east")]).max() < 2e-5
    assert np.rad2deg(LATITUDE) == pytest.approx(made.columns["latitude"], abs=1e-8)
    assert made.columns["height"] == pytest.approx(50.0, abs=1e-3)
    end = Rotation.from_quat([made.columns[f"attitude_{p}"][-1] for p in "xyzw"])
    expected = Rotation.from_rotvec([0.0, turning * STEP * (ROWS - 1), 0.0]) * START
    assert (end * expected.inv()).magnitude() < 1e-6
    assert json.loads(capsys.readouterr().out)["rows"] == ROWS
    assert "navigated" in made.metadata


def in_other_unit(campaign: Campaign, columns: str, unit: str, kind: str) -> Campaign:
    units = dict(campaign.units) | {n: unit for n in campaign.columns if n.startswith(columns)}
    return Campaign(campaign.columns, units, dict(campaign.metadata) | {"kind": kind})


def upside_down(campaign: Campaign) -> Campaign:
    """Accelerometers that read gravity instead of what holds the body against it."""
    for name in ("acceleration_x", "acceleration_y", "acceleration_z"):
        campaign = campaign.with_column(name, -campaign.columns[name], "m/s^2")
    return campaign


def east_north_up(campaign: Campaign) -> Campaign:
    """The same body, its attitude by the commoner order of axes."""
    to = Rotation.from_matrix([[0, 0, 1], [1, 0, 0], [0, 1, 0]])
    for name, value in zip([f"attitude_{p}" for p in "xyzw"], (to * START).as_quat(), strict=True):
        campaign = campaign.with_column(name, np.full(ROWS, value), "")
    return campaign


@pytest.mark.parametrize(
    ("broken", "said"),
    [
        (lambda c: c.without("acceleration_y"), "needs columns acceleration_y"),
        (lambda c: c.with_metadata({"latitude_deg": None}), "latitude_deg"),
        (lambda c: c.select(np.delete(np.arange(ROWS), 100)), "even times, and row 101"),
        (
            lambda c: c.with_column("output_z", np.where(np.arange(ROWS) == 7, np.nan, 0.1), "deg/s"),
            "output_z is missing",
        ),
        (lambda c: c.with_column("attitude_w", np.full(ROWS, 3.0), ""), "no unit quaternion"),
        (lambda c: c.with_metadata({"longitude_deg": "12.5E"}), "'longitude_deg' is '12.5E', expected a number"),
        (lambda c: c.with_metadata({"height_m": "sea level"}), "'height_m' is 'sea level'"),
        (lambda c: c.with_metadata({"height_m": 1e9}), "specific force"),
        (lambda c: c.with_metadata({"latitude_deg": 90}), "89.99 deg of latitude"),
        (lambda c: c.select(slice(0, 3)), "3 rows, and navigation needs 4"),
        (lambda c: in_other_unit(c, "output", "deg", "increment"), "needs rates, and metadata 'kind' is increment"),
        (lambda c: in_other_unit(c, "output", "count", "rate"), "which does not convert to [rad/s]"),
        (lambda c: in_other_unit(c, "acceleration", "count", "rate"), "which does not convert to [m/s^2]"),
        (upside_down, "(0, 9.8, 0): either is in other axes"),
        (east_north_up, "(0, 9.8, 0): either is in other axes"),
    ],
)
def test_what_cannot_be_navigated_is_refused(broken, said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    write_campaign(broken(log()), tmp_path / "log.csv")
    with pytest.raises(SystemExit) as done:
        cli.main(["navigate", str(tmp_path / "log.csv"), "-o", str(tmp_path / "navigated.csv")])
    assert done.value.code == 1
    message = capsys.readouterr().err
    assert said in message
    assert message.count("\n") == 1
    assert not (tmp_path / "navigated.csv").exists()


def test_what_was_navigated_is_no_reference(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """Its attitude is made of the outputs: a fit to it would find a perfect gyro."""
    navigated(log(), tmp_path)
    model, source = tmp_path / "model.yaml", tmp_path / "out" / "navigated.csv"
    model.write_text("effects: [{effect: scale_factor, value: 1.1}]")
    for command in ("fit", "diagnose"):
        with pytest.raises(SystemExit) as done:
            cli.main([command, str(source), "--axis", "x", "--model", str(model), "-o", str(tmp_path / command)])
        assert done.value.code == 1
        assert "were computed from its outputs, and tell nothing of the gyro" in capsys.readouterr().err
        assert not [*(tmp_path / command).rglob("*.*")]
    with pytest.raises(SystemExit) as done:
        cli.main(["compensate", str(model), str(source), "--axis", "x", "-o", str(tmp_path / "c.csv"), "--json"])
    assert done.value.code == 0
    assert json.loads(capsys.readouterr().out)["reference_error"] is None
