"""A platform's loop from the angle series themselves. Expected: friction, clock and loop of the rigid-body simulation,
whose loop is here the one that is assumed; the binomial law over fresh encoders' noise; the fit of the responses."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest
from scipy.stats import binom

from gyromodel.platform import (
    Alternative,
    BaseMotion,
    Explanation,
    Loop,
    Points,
    Response,
    base_motion,
    explain,
    fit_series,
    responses,
)
from gyromodel.platform._explanations import ENTRIES
from tests.truth import platform
from tests.truth.platform import Platform
from tests.truth.platform_campaign import vibration_test as logged

AXES = "XYZ"
DRAWS, NOISE, DELAY = 40, np.deg2rad(1 / 3600), 1e-3
STEP, FREQUENCIES, AMPLITUDE = 1e-3, (4.0, 10.0, 25.0), np.deg2rad(0.5)
# N m s/rad and N m, of gimbal_x and gimbal_z alone, which turn with Z and X: no frame between them sticks.
WET, DRY = 0.5, 0.05
ALTERNATIVE = Alternative(("offset", "friction", "dry friction", "corner"), {"control_delay": 0.5 * STEP})


def simulated_loop() -> platform.Loop:
    """The loop that explanations assume: its gain over inertia is that of an open loop with this crossover."""
    loop = Loop()
    gain = float(loop.amplifier * loop.correction * loop.motor / loop.inertia)
    lags, corner, w = [float(loop.gyro_lag), float(loop.motor_lag)], float(loop.corner), gain
    for _ in range(100):
        w = gain * np.hypot(1, corner / w) / np.prod([np.hypot(1, w * lag) for lag in lags])
    return platform.Loop(crossover=w, gyro_lag=lags[0], motor_lag=lags[1], integral=corner, lead=1e5, lag=1e5)


DESIGN = Platform(
    viscous=np.array([0, WET, 0, WET]),
    coulomb=np.array([0, DRY, 0, DRY]),
    loop=simulated_loop(),
    step=STEP,
    earth=0.0,
    offset=-DELAY,
)
# gimbal_z carries what turns about roll, X; gimbal_x what turns about pitch, Z.
INERTIA = DESIGN.carried()
SCALE = float(Loop().inertia) / np.array([INERTIA[2], np.nan, INERTIA[0]])
TRUE = {f"{kind} {axis}": size * SCALE[AXES.index(axis)] for axis in "XZ"
        for kind, size in (("friction", WET), ("dry friction", DRY))}  # fmt: skip
TRUE |= {"offset X": DELAY, "corner": float(Loop().corner)}


class Draw(NamedTuple):
    """Of one draw: the motion, its responses, and both fits."""

    motion: BaseMotion
    runs: list[Response]
    series: Explanation
    fitted: Explanation


@pytest.fixture(scope="module")
def clean() -> BaseMotion:
    amplitude = AMPLITUDE * np.repeat(np.eye(3)[[0, 2]], len(FREQUENCIES), axis=0)
    frequency = np.tile(FREQUENCIES, 2)[:, None] * np.ones(3)
    return base_motion(logged(DESIGN, amplitude, frequency, 6.5, skip=0.5).with_metadata({"latitude_deg": 90.0}))


def drawn(clean: BaseMotion, rng: np.random.Generator) -> Draw:
    noisy = clean._replace(**{
        name: getattr(clean, name) + NOISE * rng.standard_normal(clean.base.shape) for name in ("base", "table")
    })  # fmt: skip
    runs, _ = responses(noisy)
    axis = np.array([AXES.index(r.axis) for r in runs])
    w, gain, phase, gain_std, phase_std, size = (
        np.array([getattr(r, name) for r in runs])
        for name in ("frequency", "gain", "phase", "gain_std", "phase_std", "amplitude")
    )
    at = Points(axis, w, np.ones(len(w)), np.zeros(len(w)), np.deg2rad(size))
    fitted = explain(ALTERNATIVE, at, gain, phase, phase_std=phase_std, gain_std=gain_std)
    return Draw(noisy, runs, fit_series(noisy, runs, ALTERNATIVE), fitted)


@pytest.mark.long
def test_intervals_hold_and_both_fits_agree(clean: BaseMotion, rng: np.random.Generator):
    draws = [drawn(clean, rng) for _ in range(DRAWS)]
    # Draw by fit (of the series, of the responses) by entry.
    values, stds = (
        np.array([[getattr(e, of) for e in (d.series, d.fitted)] for d in draws]) for of in ("value", "std")
    )
    for name, true in TRUE.items():
        value, std = (x[:, :, ENTRIES.index(name)] for x in (values, stds))
        errors = value[:, 0] - true
        assert np.sum(np.abs(errors) < 1.96 * std[:, 0]) >= binom.ppf(1e-5, DRAWS, 0.95), (name, errors / std[:, 0])
        # Wider than they need be, but not by far: each run tells its own noise.
        assert np.median(std[:, 0]) < 2.5 * np.std(errors), name
        assert (np.abs(value[:, 0] - value[:, 1]) < 4 * np.hypot(*std.T)).all(), name
    # Overtones tell dry friction from wet.
    dry = stds[:, :, ENTRIES.index("dry friction X")]
    assert np.median(dry[:, 0] / dry[:, 1]) < 0.95
    assert sum(d.series.probability < 0.01 for d in draws) <= binom.ppf(1 - 1e-5, DRAWS, 0.02)
