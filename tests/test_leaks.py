"""What of a record follows a drive behind leaks, against vessels integrated over steps far finer than the samples."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.stats import binom

from gyromodel.numerics.leaks import behind_leaks
from gyromodel.numerics.stretches import derivative_by_stretch, smooth_by_stretch

STEP = 10.0
TIME = STEP * np.arange(900)
AMBIENT = 20.0 + 8.0 * np.sin(2.0 * np.pi * TIME / 6500.0)


def dwells(rng: np.random.Generator) -> np.ndarray:
    """Powers of 60 dwells, of a motor that holds a table's rates."""
    return np.repeat(rng.uniform(-1.0, 1.0, 60) ** 2, 15)


def heated(power: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A case on a stator that the motor heats, and its rate of change: two vessels in a row, solved dwell by dwell."""
    stator, case, warm, rise = 0.0, 0.0, [], []
    for level in power[::15]:
        out = solve_ivp(
            lambda _, x, u=level: [(u - x[0]) / 90.0, (x[0] - x[1]) / 800.0],
            (0.0, 15 * STEP),
            [stator, case],
            t_eval=STEP * np.arange(16),
            rtol=1e-9,
            atol=1e-12,
        )
        warm.append(out.y[1, :-1])
        rise.append((out.y[0, :-1] - out.y[1, :-1]) / 800.0)
        stator, case = out.y[:, -1]
    return 10.0 * np.concatenate(warm), 10.0 * np.concatenate(rise)


@pytest.mark.parametrize("ambient", [0.0, 1.0])
def test_heat_of_a_motor_is_told_from_what_is_smooth(ambient: float, rng: np.random.Generator):
    """Both errors are less than a spline's alone, whose slope rounds every corner."""
    power = dwells(rng)
    warm, rise = heated(power)
    true, slope = warm + ambient * AMBIENT, rise + ambient * np.gradient(AMBIENT, TIME)
    measured = true + 0.1 * rng.standard_normal(len(TIME))
    smooth, rate = smooth_by_stretch(TIME, measured, power)
    alone, its_rate = smooth_by_stretch(TIME, measured, np.zeros(len(TIME)))
    assert np.array_equal(its_rate, derivative_by_stretch(TIME, measured))
    assert np.std(smooth - true) < 0.85 * np.std(alone - true)
    assert np.std(rate - slope) < 0.7 * np.std(its_rate - slope)


def test_each_stretch_has_its_own_heat_and_a_drive_may_be_missing_for_a_moment(rng: np.random.Generator):
    power = dwells(rng)
    warm, _ = heated(power)
    time = np.concatenate([TIME, 1e5 + TIME])
    drive = np.concatenate([power, power])
    drive[[200, 201, 1300]] = np.nan
    measured = np.concatenate([warm, 0.5 * warm]) + 0.02 * rng.standard_normal(len(time))
    smooth, rate = smooth_by_stretch(time, measured, drive)
    assert np.isfinite(smooth).all()
    assert np.isfinite(rate).all()
    for part, here in ((1.0, time < 9e4), (0.5, time > 9e4)):
        assert smooth[here] == pytest.approx(part * warm, abs=0.2)


@pytest.mark.law
def test_what_follows_no_drive_has_none_of_it(rng: np.random.Generator):
    """In one draw of fifty or fewer: ten nats are asked for, beside what five columns cost."""
    told = 0
    for _ in range(60):
        slow = np.cumsum(rng.standard_normal(len(TIME))) * 0.02
        walk = np.convolve(slow, np.ones(60) / 60.0, "same")
        value, _ = behind_leaks(TIME, AMBIENT + walk + 0.1 * rng.standard_normal(len(TIME)), dwells(rng))
        told += bool(value.any())
    assert binom.sf(told - 1, 60, 0.02) > 1e-5


def test_no_drive_leaves_a_record_as_it_is(rng: np.random.Generator):
    values, missing = np.sin(TIME / 300.0), np.full(len(TIME), np.nan)
    for of, drive in ((values, np.ones(len(TIME))), (values, missing), (np.ones(len(TIME)), dwells(rng))):
        assert not any(part.any() for part in behind_leaks(TIME, of, drive))


def test_a_record_without_noise_stays_itself(rng: np.random.Generator):
    power = dwells(rng)
    warm, rise = heated(power)
    smooth, rate = smooth_by_stretch(TIME, warm, power)
    assert smooth == pytest.approx(warm, abs=0.02 * float(np.std(warm)))
    assert np.std(rate - rise) < 0.1 * np.std(rise)
