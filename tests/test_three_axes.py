"""Three sensing axes laid out by rotations of their own: mounting told from angles that are not right."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from gyromodel import _diagnose_files, cli
from gyromodel._checks import CampaignError
from gyromodel.campaign import Campaign
from gyromodel.diagnosis import Diagnosis, diagnose
from gyromodel.effects.drivers import BiasPeriodic
from gyromodel.effects.geometry import Misalignment
from gyromodel.estimate import EstimateError, fit
from gyromodel.files import write_campaign
from gyromodel.model import GyroModel, ModelError, model_from_effects
from gyromodel.three_axes import Triad, triad

ARCSEC = np.deg2rad(1 / 3600)
ROWS = 240
# About x, y and z, deg/s.
TURNS = np.full(3, 60.0)


def rates(rng: np.random.Generator, size: np.ndarray) -> np.ndarray:
    """Turns about each axis and all of them, in steps (deg/s)."""
    return np.deg2rad(size) * rng.uniform(-1, 1, (ROWS // 4, 3)).repeat(4, axis=0)


def measured(axes: np.ndarray, rng: np.random.Generator, size: np.ndarray = TURNS) -> Campaign:
    """Outputs of three unit vectors' rates, each with a bias and white noise."""
    rate = rates(rng, size)
    output = rate @ axes.T + np.deg2rad([20.0, -10.0, 5.0]) / 3600 + 2e-5 * rng.standard_normal((ROWS, 3))
    columns = {"time": np.arange(ROWS) * 1.0}
    columns |= {f"rate_{a}": np.rad2deg(rate[:, i]) for i, a in enumerate("xyz")}
    columns |= {f"output_{a}": np.rad2deg(output[:, i]) for i, a in enumerate("xyz")}
    return Campaign(columns, {n: "s" if n == "time" else "deg/s" for n in columns}, {"kind": "rate"})


def lie_of(*campaigns: Campaign) -> Triad:
    model = model_from_effects(["scale_factor", "bias"])
    found = triad(campaigns, {a: fit([c.axis(a) for c in campaigns], model) for a in "xyz"})
    assert found is not None
    return found


def lie(axes: np.ndarray, rng: np.random.Generator, size: np.ndarray = TURNS) -> Triad:
    return lie_of(measured(axes, rng, size))


def as_likely_as_noise(values: np.ndarray, covariance: np.ndarray) -> bool:
    return bool(chi2.sf(values @ np.linalg.solve(covariance, values), 3) > 1e-6)


@pytest.mark.parametrize("degrees", [(0.08, -0.06, 0.14), (2.0, -3.0, 1.5)])
def test_a_turned_unit_is_turned_and_square(degrees: tuple[float, ...], rng: np.random.Generator):
    """Of the second order there are 370 arcsec in the larger turn, and a standard uncertainty is below one."""
    turn = np.deg2rad(degrees)
    # Rows of the matrix are the axes.
    found = lie(Rotation.from_rotvec(turn).as_matrix().T, rng)
    assert np.sqrt(np.diag(found.squareness_covariance)).max() < 2 * ARCSEC
    assert found.turned
    assert as_likely_as_noise(found.rotation - turn, found.rotation_covariance)
    assert as_likely_as_noise(found.squareness, found.squareness_covariance)
    assert "which is the mounting" in found.sentence() or "the mounting;" in found.sentence()


def test_a_mounting_leaves_the_angles_between_axes(rng: np.random.Generator):
    """Axis x is 1 deg off its right angle with y, and the unit is turned by 3 deg."""
    mounting, off = Rotation.from_rotvec(np.deg2rad([2.0, -2.0, 1.0])), np.deg2rad(1.0)
    axes = np.eye(3)
    axes[0] = Rotation.from_rotvec([0, 0, off]).apply([1.0, 0, 0])
    found = lie(mounting.apply(axes), rng)
    assert found.turned
    assert found.oblique
    assert as_likely_as_noise(found.squareness - np.array([off, 0, 0]), found.squareness_covariance)
    # Square axes that share what is lacking lie half way.
    turn = (mounting * Rotation.from_rotvec([0, 0, off / 2])).as_rotvec()
    assert as_likely_as_noise(found.rotation - turn, found.rotation_covariance)


def test_what_noise_could_hide_is_told():
    """A rotation that nobody sees is no zero."""
    seen, unseen = (np.eye(3) * np.deg2rad(std) ** 2 for std in (3 / 3600, 2.14))
    none, one = np.zeros(3), np.deg2rad([0.1, 0.0, 0.0])
    for found, end in (
        (Triad(none, seen, none, unseen), "reference rates within the noise (standard uncertainties up to 2.1 deg)."),
        (Triad(one, seen, none, seen), "right angles within the noise (standard uncertainties up to 3.0 arcsec)."),
        (Triad(none, unseen, one, seen), "not turned within the noise (standard uncertainties up to 2.1 deg)."),
    ):
        assert found.sentence().endswith(end)


def test_axes_that_are_not_square_are_the_unit(rng: np.random.Generator):
    """Only x is moved, towards y: half of it looks like a turn."""
    axes = np.eye(3)
    axes[0] = Rotation.from_rotvec([0, 0, 400 * ARCSEC]).apply([1.0, 0, 0])
    found = lie(axes, rng)
    std = np.sqrt(np.diag(found.squareness_covariance))
    assert found.oblique
    assert np.abs(found.squareness - np.array([400.0, 0, 0]) * ARCSEC).max() < 6 * std.max()
    assert "which is the unit" in found.sentence()


def test_a_lean_wants_all_three_axes_turned(rng: np.random.Generator):
    """An axis 400 arcsec off its right angles is told of by a third of the fastest rotation, and not by a twentieth."""
    axes = np.eye(3)
    axes[0] = Rotation.from_rotvec([0, 0, 400 * ARCSEC]).apply([1.0, 0, 0])
    assert lie(axes, rng, np.array([60.0, 60.0, 20.0])).oblique
    still = lie(axes, rng, np.array([60.0, 60.0, 3.0]))
    assert not still.oblique
    assert not still.turned
    assert "not told: the rotation about a direction near z" in still.sentence()
    assert str(still.to_dict()["not_told"]) in still.sentence()


def test_a_campaign_that_hardly_turns_does_not_count_beside_one_that_does(rng: np.random.Generator):
    """Its reference errs by 400 arcsec of the fastest rotation: a lean that the unit does not have."""
    axes = np.eye(3)
    axes[1] = Rotation.from_rotvec([0, 0, 400 * ARCSEC]).apply([0.0, 1.0, 0.0])
    erring, other = (measured(axes, rng, np.array([60.0, 3.0, 3.0])) for _ in range(2))
    found = lie_of(measured(np.eye(3), rng), erring)
    assert not found.oblique
    assert found.sentence().endswith("Leans of a campaign that hardly turned about some direction do not count.")
    assert found.to_dict()["campaigns_left_out"] == 1
    assert "not told: no campaign turns about all three directions" in lie_of(erring, other).sentence()
    # Nor where the axes of the reference are between those of the motion.
    turn = Rotation.from_rotvec(np.deg2rad([8.0, 8.0, 8.0]))
    seen = turn.apply(np.column_stack([erring.columns[f"rate_{a}"] for a in "xyz"]))
    for a, values in zip("xyz", seen.T, strict=True):
        erring = erring.with_column(f"rate_{a}", values, "deg/s")
    assert "not told" in lie_of(erring).sentence()


def test_campaigns_mounted_otherwise_tell_nothing_of_the_unit(rng: np.random.Generator):
    """By 1 deg: beside one that turns, one that hardly does leaves the unit square; two that turn differ, it says."""
    turn = Rotation.from_rotvec(np.deg2rad([1.0, -1.0, 1.0])).as_matrix().T
    found = lie_of(measured(np.eye(3), rng), measured(turn, rng, np.array([60.0, 3.0, 3.0])))
    assert as_likely_as_noise(found.squareness, found.squareness_covariance)
    assert as_likely_as_noise(found.rotation, found.rotation_covariance)
    assert not found.not_told
    assert (
        "lie otherwise against the reference in one campaign"
        in lie_of(measured(np.eye(3), rng), measured(turn, rng)).sentence()
    )
    assert not lie_of(measured(turn, rng), measured(turn, rng)).not_told


def test_what_one_campaign_alone_has_keeps_its_number_beside_one_that_does_not_count(rng: np.random.Generator):
    """A line in the second of two campaigns, the first of which hardly turns."""
    still, full = measured(np.eye(3), rng, np.array([60.0, 3.0, 3.0])), measured(np.eye(3), rng)
    wave = 0.05 * np.sin(2 * np.pi * 0.11 * full.columns["time"])
    full = full.with_column("output_x", full.columns["output_x"] + wave, "deg/s")
    line = BiasPeriodic(cosine=np.zeros(1), sine=np.zeros(1), frequency=np.array([0.11]), campaigns=(2,))
    models = {a: model_from_effects(["scale_factor", "bias"]) for a in "xyz"}
    models["x"] = models["x"].with_effect(line)
    found = triad([still, full], {a: fit([still.axis(a), full.axis(a)], m) for a, m in models.items()})
    assert found is not None
    assert found.left_out == 1
    assert np.sqrt(np.diag(found.squareness_covariance)).max() < 2 * ARCSEC
    assert np.abs(found.squareness).max() < 6 * ARCSEC


def test_a_unit_mounted_anew_for_each_axis_tells_nothing_of_its_angles(rng: np.random.Generator):
    """Square axes, turned about one axis a campaign, each mounted otherwise: 800 arcsec off together."""
    campaigns = [
        measured(Rotation.from_rotvec([0, 0, angle * ARCSEC]).as_matrix().T, rng, np.roll([60.0, 0.5, 0.5], k))
        for k, angle in enumerate((400.0, -400.0, 0.0))
    ]
    found = lie_of(*campaigns)
    assert "no campaign turns about all three directions" in found.not_told
    assert not found.oblique
    assert not found.turned


@pytest.mark.law
@pytest.mark.long
def test_axes_as_they_should_be_say_so(rng: np.random.Generator):
    """A true triad is called turned, or not square, once in a thousand each: its errors have the law they claim."""
    found = [lie(np.eye(3), rng) for _ in range(8)]
    assert sum(t.turned + t.oblique for t in found) <= 1
    for angles in ("rotation", "squareness"):
        each = [(getattr(t, angles), getattr(t, f"{angles}_covariance")) for t in found]
        assert 1e-5 < chi2.cdf(sum(a @ np.linalg.solve(c, a) for a, c in each), 3 * len(each)) < 1 - 1e-5


@pytest.mark.long
def test_diagnose_takes_all_axes_of_a_campaign(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """One example, of a fixed seed."""
    rng = np.random.default_rng(1)
    axes = Rotation.from_rotvec(np.array([0.0, 0.0, 900.0]) * ARCSEC).as_matrix().T
    write_campaign(measured(axes, rng), tmp_path / "campaign.csv")
    (tmp_path / "simulation.yaml").write_text("effects: [{effect: scale_factor}, {effect: bias}]", encoding="utf-8")
    with pytest.raises(SystemExit) as done:
        cli.main(["diagnose", str(tmp_path / "campaign.csv"), "--model", str(tmp_path / "simulation.yaml"),
                  "-o", str(tmp_path / "out")])  # fmt: skip
    assert done.value.code == 0
    said = capsys.readouterr().out
    written = json.loads((tmp_path / "out" / "axes.json").read_text(encoding="utf-8"))
    assert "misalignment" in [c["effect"] for c in written["axes"]["x"]["causes"]]
    assert written["axes"]["z"]["verdict"] == "adequate"
    assert written["triad"]["rotation"]["significant"]
    assert not written["triad"]["squareness"]["significant"]
    assert "Axis y: Your simulation lacks" in said
    turn = written["triad"]["rotation"]["z"]
    assert turn["value"] == pytest.approx(900.0, abs=6 * turn["std"])
    assert f"{turn['value']:.0f}" in said
    assert (tmp_path / "out" / "x" / "report.html").exists()


def test_a_lean_that_was_fixed_is_fitted_anew():
    campaign = measured(np.eye(3), np.random.default_rng(4))
    known = Misalignment(angles=jnp.array([400 * ARCSEC]), about=("rate_y",))
    lean = frozenset({("misalignment", "angles")})
    fixed = GyroModel((*model_from_effects(["scale_factor", "bias"]).effects, known), fixed=lean)
    assert not fixed.without("misalignment").fixed
    extended = {a: fit(campaign.axis(a), model_from_effects(["scale_factor", "bias"])) for a in "yz"}
    found = triad([campaign], extended | {"x": fit(campaign.axis("x"), fixed)})
    assert found is not None
    assert not found.oblique


def test_axes_without_a_cross_rate_have_no_lie():
    campaign = measured(np.eye(3), np.random.default_rng(4))
    extended = {a: fit(campaign.axis(a), model_from_effects(["bias"])) for a in "xyz"}
    gap = np.where(np.arange(ROWS) == 7, np.nan, campaign.columns["rate_y"])
    with pytest.raises((EstimateError, ModelError), match="rate_y"):
        triad([campaign.with_column("rate_y", gap, "deg/s")], extended)


def test_an_axis_that_cannot_be_diagnosed_leaves_the_others(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    campaign = measured(np.eye(3), np.random.default_rng(4))
    campaign = campaign.with_column("output_y", np.zeros(ROWS), "deg/s")
    x_only = campaign.axis("x")

    def only_x(alone: list[Campaign], model: Path, output: Path, **_) -> tuple[Diagnosis, str]:
        if output.name != "x":
            raise CampaignError("the angle in 'output' wraps round")
        (tmp_path / "x").mkdir(exist_ok=True)
        return diagnosis, "Nothing is missing."

    diagnosis = diagnose(x_only, model_from_effects(["scale_factor", "bias"]), hold_out=False)
    monkeypatch.setattr(_diagnose_files, "diagnose_to", only_x)
    (tmp_path / "y" / "figures").mkdir(parents=True)
    (tmp_path / "model.yaml").write_text("effects: []", encoding="utf-8")
    for name in ("report.html", "diagnosis.json", "model.yaml", "mine.txt", "figures/driver.svg", "figures/mine.svg"):
        (tmp_path / "y" / name).write_text("of an earlier run", encoding="utf-8")
    found, said, _ = _diagnose_files.diagnose_axes([campaign], tmp_path / "model.yaml", tmp_path, 0, 0)
    assert (list(found["axes"]), found["triad"], said) == (["x"], None, "Axis x: Nothing is missing.")
    assert "wraps round" in found["not_diagnosed"]["z"]
    assert found["not_diagnosed"]["y"].startswith(f"{campaign.name}: column 'output_y' is 0.0")
    assert sorted(path.name for path in (tmp_path / "y").rglob("*.*")) == ["mine.svg", "mine.txt"]
    second = replace(campaign.without("output_z"), name="second")
    found, *_ = _diagnose_files.diagnose_axes([second, campaign], tmp_path / "model.yaml", tmp_path, 0, 0)
    assert list(found["axes"]) == ["x"]
    assert found["not_diagnosed"]["z"].startswith("second: there is no axis 'z'")
    with pytest.raises(CampaignError, match="there is no axis 'x'"):
        _diagnose_files.diagnose_axes([campaign, x_only], tmp_path / "model.yaml", tmp_path, 0, 0)
