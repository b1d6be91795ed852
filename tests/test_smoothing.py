"""The derivative of noisy, quantised thermometers, against the truth, raw differences and a Savitzky-Golay filter; the
stated bandwidth against what scipy's spline of that penalty does to a sine."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.interpolate import make_smoothing_spline
from scipy.optimize import minimize_scalar
from scipy.signal import lfilter, savgol_filter

from gyromodel.numerics.smoothing import _best_fit, smooth_derivative, smooth_values, smoothing_bandwidth

ROWS, STEP = 1800, 10.0
TIME = np.arange(ROWS) * STEP
SPAN = ROWS * STEP


def ramp() -> np.ndarray:
    corners = np.interp(TIME, [0, 0.2 * SPAN, 0.6 * SPAN, SPAN], [14.0, 14.0, 42.0, 42.0])
    decay = np.exp(-STEP / 600)
    return lfilter([1 - decay], [1.0, -decay], corners, zi=[decay * 14])[0]


COURSES = {
    "ramp": ramp(),
    "soak": 42 - 28 * np.exp(-TIME / (SPAN / 5)),
    "sine": 28 + 5 * np.sin(2 * np.pi * TIME / (SPAN / 6)),
    "cycling": 14 + 28 * TIME / SPAN + 0.2 * np.sin(2 * np.pi * TIME / (SPAN / 60)),
}


def error(found: np.ndarray, true: np.ndarray) -> float:
    return float(np.sqrt(np.mean((found - true) ** 2) / np.mean(true**2)))


@pytest.mark.parametrize("noise", [0.002, 0.05], ids=["staircase", "dithered"])
@pytest.mark.parametrize("course", COURSES)
def test_quantised_thermometers(course: str, noise: float, rng: np.random.Generator):
    """Far better than differences, and near the filter of the best width, which nobody knows in life.

    One draw in two hundred is 1.5 times as far off as that filter; the geometric mean of eight is so in none of 10⁷.
    """
    true = np.gradient(COURSES[course], STEP)
    far = []
    for _ in range(8):
        measured = np.round((COURSES[course] + noise * rng.standard_normal(ROWS)) / 0.0625) * 0.0625
        ours = error(smooth_derivative(TIME, measured), true)
        raw = error(np.gradient(measured, TIME), true)
        widths = (11, 31, 101, 301, 901)
        best = min(error(savgol_filter(measured, w, 3, deriv=1, delta=STEP), true) for w in widths)
        assert ours < (0.25 if course == "cycling" else 0.04)
        assert ours < raw / 3
        far.append(np.log(ours / best))
    if course != "soak":  # which a cubic over a sixth of the record fits whole
        assert np.exp(np.mean(far)) < 1.3


def test_cross_validation_is_not_caught_in_a_side_minimum(rng: np.random.Generator):
    """A ramp with a ripple has two minima; a search in one of them follows the ramp alone."""
    measured = COURSES["cycling"] + 0.002 * rng.standard_normal(ROWS)
    true = np.gradient(COURSES["cycling"], STEP)
    assert error(smooth_derivative(TIME, measured), true) < 0.1
    knots = measured[:1800].reshape(-1, 5).mean(axis=1)
    local = make_smoothing_spline(np.arange(360.0), knots).derivative()(np.arange(360.0))
    assert error(local / 50, true.reshape(-1, 5).mean(axis=1)) > 0.5


def test_the_penalty_is_that_of_exact_cross_validation(rng: np.random.Generator):
    """The smoother as a dense matrix: scipy's splines through unit vectors."""
    x = np.sort(rng.uniform(0, 60, 60))
    y = np.sin(x / 8) + 0.1 * rng.standard_normal(60)

    def criterion(log_penalty: float) -> float:
        matrix = np.stack([make_smoothing_spline(x, e, lam=np.exp(log_penalty))(x) for e in np.eye(60)], axis=1)
        left = y - matrix @ y
        squares = np.trace(matrix @ matrix) / 60
        return np.log(np.sum(left**2) / np.trace(np.eye(60) - matrix) ** 2 * (0.3 + 0.7 * squares))

    exact = minimize_scalar(criterion, bounds=(-2, 12), method="bounded", options={"xatol": 0.05}).x
    ours = _best_fit(x, y)[0]
    assert criterion(np.log(ours)) < criterion(exact) + 0.02


@pytest.mark.parametrize("rows", [300, 1800])
def test_the_bandwidth_is_where_a_sine_falls_to_its_half_power(rows: int, rng: np.random.Generator):
    time = np.arange(rows) * STEP
    measured = 14 + 28 * time / time[-1] + 5 * np.sin(2 * np.pi * time / 3000) + 0.05 * rng.standard_normal(rows)
    edge = smoothing_bandwidth(time, measured)
    block = -(-rows // 400)
    knots = time.reshape(-1, block).mean(axis=1)
    unit = (knots[-1] - knots[0]) / len(knots)
    penalty = _best_fit((knots - knots[0]) / unit, measured.reshape(-1, block).mean(axis=1))[0]
    wave = np.sin(2 * np.pi * edge * time)
    spline = make_smoothing_spline((knots - knots[0]) / unit, wave.reshape(-1, block).mean(axis=1), lam=penalty)
    middle = slice(rows // 4, -rows // 4)
    passed = spline((time - knots[0]) / unit)[middle]
    assert passed @ wave[middle] / (wave[middle] @ wave[middle]) == pytest.approx(np.sqrt(0.5), abs=0.02)


@pytest.mark.parametrize("course", list(COURSES))
def test_the_smooth_record_is_nearer_the_truth_and_has_the_slope_of_its_derivative(
    course: str, rng: np.random.Generator
):
    measured = COURSES[course] + 0.02 * rng.standard_normal(ROWS)
    smooth = smooth_values(TIME, measured)
    assert error(smooth, COURSES[course]) < 0.7 * error(measured, COURSES[course])
    inner = slice(5, -5)
    slope = np.gradient(smooth, TIME)[inner] - smooth_derivative(TIME, measured)[inner]
    assert np.std(slope) < 0.1 * np.std(np.gradient(smooth, TIME))


def test_nothing_to_smooth():
    assert np.array_equal(smooth_derivative(np.arange(9.0), np.ones(9)), np.zeros(9))
    for values in (np.ones(9), np.arange(4.0) ** 2):
        assert np.array_equal(smooth_values(np.arange(float(len(values))), values), values)
    for time in (np.arange(4.0), np.arange(9.0)):
        with pytest.raises(ValueError, match="six samples"):
            smoothing_bandwidth(time, np.ones(len(time)))
