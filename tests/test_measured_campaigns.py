"""What is said of measured campaigns, held against least squares by hand on the same data.

The data are read where they lie (docs/cases); without them the tests are skipped.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import gyromodel as gm
from gyromodel.model_files import read_model
from gyromodel.poses import static_poses
from gyromodel.signals import read_signals

Data = Callable[[str], Path]
pytestmark = pytest.mark.long
# Of a rad/s: nominal, from the publication of the data.
COUNTS = 4770.0


@pytest.mark.parametrize(("axis", "limit"), [("x", 0.020), ("y", 0.022), ("z", 0.018)])
def test_gravity_moves_the_gyros_of_a_hand_turned_unit(axis: str, limit: float, measured_data: Data, tmp_path: Path):
    """Errors of poses left out (deg/s), by what is named and by straight lines through the poses' means."""
    campaign = gm.read_campaign(measured_data("mems_multiposition_a/campaign.csv.gz")).axis(axis)
    model = tmp_path / "simulation.yaml"
    model.write_text(f"effects: [{{effect: bias}}, {{effect: scale_factor, value: {COUNTS} count*s/rad, fixed: true}}]")
    found = gm.diagnose(campaign, read_model(model))
    names = [c.effect for c in found.causes]
    assert found.verdict == "named"
    assert all(name.startswith("bias_acceleration_") for name in names)
    posed = static_poses(campaign)
    number, output = posed.columns["position"], posed.columns["output"] * np.rad2deg(1 / COUNTS)
    columns = [posed.columns[name.removeprefix("bias_")] for name in names]
    mean = np.array([[v[number == k].mean() for v in (output, *columns)] for k in np.unique(number)])
    y, one = mean[:, 0], np.ones(len(mean))
    errors = [left_out(np.column_stack([one, *mean[:, 1 : 1 + n].T]), y) for n in (0, len(names))]
    assert errors[0] > 2.4 * limit
    assert errors[1] < limit


def left_out(columns: np.ndarray, y: np.ndarray) -> float:
    """Rms error of each row by a least-squares fit to the others: residual over one less its leverage."""
    q = np.linalg.qr(columns)[0]
    return float(np.sqrt(np.mean(((y - q @ (q.T @ y)) / (1 - np.sum(q**2, axis=1))) ** 2)))


def test_gravity_does_not_move_those_of_a_unit_that_is_compensated(measured_data: Data):
    campaign = gm.read_campaign(measured_data("mems_multiposition_b/unit1.csv.gz")).axis("x")
    found = gm.diagnose(campaign, gm.model_from_effects(["bias"]), hold_out=False)
    # It is read in steps larger than its noise.
    assert [c.effect for c in found.causes] in ([], ["quantisation"])
    assert found.verdict != "unknown"


def test_the_codes_of_a_feedback_ramp_are_found_and_hold_later(measured_data: Data):
    """Of the 40 s after the first 40 the extended model leaves what a Fourier series of the code by hand does."""
    whole = gm.read_campaign(measured_data("fog_closed_loop_ramp/campaign.csv.gz"))
    time = whole.columns["time"] - whole.columns["time"][0]
    before, after = time < 40, (time >= 40) & (time < 80)
    found = gm.diagnose(whole.select(before), gm.model_from_effects(["bias"], gyro="fog"), hold_out=False)
    assert "bias_readout_code" in [c.effect for c in found.causes]
    later = read_signals(whole.select(after))
    left = np.asarray(later.signals["output"] - found.extended.model.predict(later.signals))[: later.rows]
    output, phase = whole.columns["output"], 2 * np.pi * whole.columns["feedback_ramp"] / 65560
    waves = np.column_stack([np.ones_like(phase), *(w(h * phase) for h in range(1, 13) for w in (np.cos, np.sin))])
    by_hand = output - waves @ np.linalg.lstsq(waves[before], output[before], rcond=None)[0]
    assert output[after].std() == pytest.approx(616, abs=1)
    assert 1e9 * left.std() < min(450, 1.03 * by_hand[after].std())


def test_a_dithered_ring_laser_has_lines_that_change_and_no_random_walk(measured_data: Data):
    campaign = gm.read_campaign(measured_data("rlg_static/campaign.csv.gz")).axis("x")
    found = gm.diagnose(campaign, gm.model_from_effects(["bias"], gyro="rlg"), hold_out=False)
    assert found.verdict == "unknown"
    assert not any("random_walk" in c.effect for c in found.causes)
    assert any("no steady line" in line and "acceleration_x" in line and "dither" in line for line in found.findings)
    assert any("comes in steps of 0.00012207 deg/s" in line for line in found.findings)
