"""A fit through the integrator on a real session: the second half judged by the first, against the rates as measured.

Expected values are the errors of the same windows without a fit, and with the bias of the rest alone.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from benchmarks import attitude_real as study


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
