"""A fit through the integrator on a real session: the second half judged by the first, against the rates as measured.

Expected values are the errors of the same windows without a fit, and with the bias of the rest alone.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

import gyromodel
from benchmarks import attitude_real as study
from gyromodel.model import model_from_effects
from gyromodel.three_axes import Triad, triad


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def test_bias_matrix_and_delay_are_worth_their_fit(measured_data: Callable[[str], Path]):
    name, rest, _ = study.SESSIONS["TStick 04"]
    session = study.read(name, measured_data(f"mems_attitude/{name}.csv.gz").parent)
    time, rates, _ = session
    windows = study.cut(*session, study.LENGTH, study.LENGTH)
    middle = time[len(time) // 2]
    train = study.some(windows, windows.begin + study.LENGTH <= middle)
    test = study.some(windows, windows.begin > middle)
    found = study.corrected(study.fitted((train,)).value)
    still = {**study.start(), "bias": jnp.asarray(-rates[time < time[0] + rest].mean(axis=0))}
    before = rms(study.error(study.start(), test))
    assert 1.6 < before < 3.5
    assert rms(study.error(found, test)) < 0.3 * min(before, rms(study.error(still, test)))
    # The turns of ten seconds or so tell a scale factor to a percent, and the delay is below a sample of the camera.
    assert np.abs(np.asarray(found["matrix"]) - np.eye(3)).max() < 0.05
    assert 0 < float(found["delay"]) < 0.01


@pytest.mark.long
@pytest.mark.parametrize("label", study.SESSIONS)
def test_the_fit_through_the_integrator_is_no_worse_in_sample(measured_data: Callable[[str], Path], label: str):
    """Than least squares on rates at the best delay, to 0.01 deg after 5 s; and better than the rates without a fit."""
    name, rest, _ = study.SESSIONS[label]
    folder = measured_data(f"mems_attitude/{name}.csv.gz").parent
    session = study.read(name, folder)
    time, rates, _ = session
    windows = study.cut(*session, study.LENGTH, study.LENGTH)
    through = study.corrected(study.fitted(study.windows_of(label, folder)).value)
    by_rates = study.by_rates(session, np.ones(len(time), bool), study.DELAYS)
    still = {**study.start(), "bias": jnp.asarray(-rates[time < time[0] + rest].mean(axis=0))}
    error = rms(study.error(through, windows))
    assert error <= rms(study.error(by_rates, windows)) + 0.01
    assert error < min(rms(study.error(way, windows)) for way in (study.start(), still))


@pytest.mark.long
def test_the_wand_is_mounted_askew_and_square(measured_data: Callable[[str], Path]):
    """By the session that turns about all axes; the other hardly turns about two, and does not count beside it."""
    first, second = (
        gyromodel.read_campaign(measured_data(f"mems_attitude/{study.SESSIONS[label][0]}.csv.gz"))
        for label in ("TStick 04", "TStick 02")
    )

    def lie(*campaigns: gyromodel.Campaign) -> Triad:
        model = model_from_effects(["bias", "scale_factor"], gyro="mems")
        found = triad(campaigns, {axis: gyromodel.fit([c.axis(axis) for c in campaigns], model) for axis in "xyz"})
        assert found is not None
        return found

    for found, left_out in ((lie(first), 0), (lie(first, second), 1)):
        assert (found.turned, found.oblique, found.not_told, found.left_out) == (True, False, "", left_out)
    assert lie(second).not_told.startswith("the rotation about a direction near ")
