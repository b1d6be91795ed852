"""The ring laser gyro: the published table and its printed spline, and lock-in against the integrated beat phase.

Expected numbers: what the publication prints, and what a check of it found (the second differences and the spline's
k_i solved by hand from the published equations, slope jumps, distances); tests/truth/ring_laser.py, which integrates
the beat-phase equation and counts fringes; scipy's Bessel functions.
"""

from __future__ import annotations

from importlib import resources

import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats
from scipy.special import jv

import gyromodel as gm
from gyromodel.effects.readout import LockIn, LockInDithered, bessel, dither_random_walk, lock_in_error
from gyromodel.numerics.splines import CubicSpline, cubic_spline, second_differences, slope_jumps, slope_range
from tests.truth.ring_laser import ARCSEC, counted_rate, random_dither, resting_case, sinusoidal_dither

PRINTED_DIFFERENCES = [3.385, 1910.485, -3822.005, 912.805, 2002.335, -501.13, -996.185, 501.62, 1.605, 3698.225]
PRINTED_K = [0.0000, 0.0003, 0.1910, -0.3822, 0.0913, 0.2002, -0.0501, -0.0996, 0.0502, 0.0002, 0.3698, 0.0000]
TRUE_K = [-1270.0, 5100.1, -7667.7, 2638.7, 2589.9, -984.2, -1659.8, 1646.3, -1915.8, 6026.3]
SCALE_FACTOR = 77348.0  # count/(deg/s), of the line through eight of the points

FRINGE = 2 * ARCSEC
LOCK_IN_RATE = 100 * ARCSEC
DITHER_FREQUENCY = 400.0


@pytest.fixture(scope="module")
def table() -> CubicSpline:
    """The natural spline through the twelve published points, in deg/s and counts."""
    with resources.as_file(resources.files("gyromodel") / "data" / "ring_laser_table.csv") as path:
        campaign = gm.read_campaign(path)
    return cubic_spline(jnp.asarray(campaign.columns["rate"]), jnp.asarray(campaign.columns["output"]))


def test_printed_differences_but_one_are_those_of_the_table(table: CubicSpline) -> None:
    recomputed = np.asarray(second_differences(table.knots, table.values))
    printed = np.array(PRINTED_DIFFERENCES)
    wrong = np.abs(recomputed - printed) > 5e-4
    assert list(np.flatnonzero(wrong)) == [9]
    assert recomputed[9] == pytest.approx(3698.255, abs=5e-4)


def test_printed_k_are_the_differences_and_not_the_solution(table: CubicSpline) -> None:
    assert np.asarray(table.half_curvatures)[1:-1] == pytest.approx(TRUE_K, abs=0.06)
    assert 1e4 * np.array(PRINTED_K)[1:-1] == pytest.approx(PRINTED_DIFFERENCES, abs=0.6)
    printed = CubicSpline(table.knots, table.values, 1e4 * jnp.array(PRINTED_K), straight_ends=True)
    jumps = np.asarray(slope_jumps(printed))
    # A jump is −(h_{i−1} + h_i)/3 of the equation's residual.
    assert np.abs(3 * jumps / 20).max() == pytest.approx(5233, abs=1)
    assert np.abs(jumps).max() == pytest.approx(34_890, abs=5)
    assert np.abs(jumps).max() / SCALE_FACTOR == pytest.approx(0.45, abs=0.005)
    assert np.abs(np.asarray(slope_jumps(table))).max() < 1e-6
    rates = jnp.linspace(0.0, 110.0, 11_001)
    apart = float(jnp.abs(printed(rates) - table(rates)).max())
    assert apart == pytest.approx(30_455, abs=5)  # the k printed are rounded to 1
    assert apart / SCALE_FACTOR == pytest.approx(0.39, abs=0.005)


def test_printed_conclusion_that_the_curve_rises_holds(table: CubicSpline) -> None:
    assert float(slope_range(table)[0]) > 0.3 * SCALE_FACTOR


def test_bessel_functions_are_scipys() -> None:
    order = np.arange(-8, 9)
    for argument in (0.0, 2.4, 471.3, 3000.0):
        found = np.asarray(bessel(jnp.asarray(order), jnp.asarray(argument)))
        assert found == pytest.approx(jv(order, argument), abs=1e-13)


def test_beat_without_dither_is_the_closed_form(rng: np.random.Generator) -> None:
    duration = 2.0
    rate = np.linspace(-3.0, 3.0, 81) * LOCK_IN_RATE
    theta, step = resting_case(duration, 6000)
    counted = counted_rate(rate, LOCK_IN_RATE, FRINGE, step, theta, rng)
    expected = rate + np.asarray(lock_in_error(jnp.asarray(rate), jnp.asarray(LOCK_IN_RATE)))
    # The phases at both ends are anywhere in their fringe.
    assert np.abs(counted - expected).max() < FRINGE / (0.9 * duration)


@pytest.mark.parametrize("order", [0, 1])
def test_dither_leaves_a_band_of_the_bessel_function(order: int, rng: np.random.Generator) -> None:
    """Locked where less than one fringe is counted: as far as the beat at the edge of the band stays below that."""
    depth, periods = 3.0, 200
    amplitude = depth * FRINGE / (2 * np.pi)
    theta, step = sinusoidal_dither(amplitude, DITHER_FREQUENCY, periods, 48)
    half_width = LOCK_IN_RATE * abs(jv(order, depth))
    place = order * DITHER_FREQUENCY * FRINGE
    rate = place + np.linspace(-1.6, 1.6, 129) * half_width
    counted = counted_rate(rate, LOCK_IN_RATE, FRINGE, step, theta, rng)
    least = FRINGE / (0.9 * periods / DITHER_FREQUENCY)
    locked = rate[np.abs(counted - place) < least] - place
    tolerance = np.hypot(half_width, least) - half_width + 3.2 / 128 * half_width
    assert [-locked.min(), locked.max()] == pytest.approx([half_width, half_width], abs=tolerance)
    effect = LockInDithered(
        lock_in_rate=LOCK_IN_RATE, dither_amplitude=amplitude, dither_frequency=DITHER_FREQUENCY, fringe_angle=FRINGE
    )  # type: ignore[call-arg]
    signals = {"rate": jnp.asarray(rate), "time": jnp.zeros(len(rate))}
    model = rate + np.asarray(effect.contribution(signals))
    # Within the least that is counted; a draw was 0.5 % beyond it.
    assert np.abs(model - counted).max() < 1.1 * least


@pytest.mark.law
def test_random_dither_leaves_the_random_walk_of_the_formula(rng: np.random.Generator) -> None:
    """Turns that are far apart in phase: the formula holds within the spread of a variance and 15 % for its order."""
    depth, periods, lanes = 30.0, 30, 300
    amplitude = depth * FRINGE / (2 * np.pi)
    theta, step = random_dither(amplitude, 0.4, DITHER_FREQUENCY, periods, 300, lanes, rng)
    counted = counted_rate(np.full(lanes, 37.0 * ARCSEC), LOCK_IN_RATE, FRINGE, step, theta, rng)
    duration = 0.9 * periods / DITHER_FREQUENCY
    walk = dither_random_walk(LOCK_IN_RATE, FRINGE, 2 * np.pi * DITHER_FREQUENCY * amplitude)
    ratio = float(np.std(counted) * np.sqrt(duration)) / walk
    low, high = np.sqrt(stats.chi2.ppf([1e-5, 1 - 1e-5], lanes - 1) / (lanes - 1))
    assert 0.85 * low < ratio < 1.15 * high
    # The dead band is gone: the mean is the rate.
    assert np.mean(counted) == pytest.approx(37.0 * ARCSEC, abs=4.5 * np.std(counted) / np.sqrt(lanes))


def sweep(beat: np.ndarray, rate: np.ndarray, noise: float, rng: np.random.Generator) -> gm.Campaign:
    """A slow sweep of a ring laser of scale factor 1.0005 and bias 3 arcsec/s, in arcsec/s."""
    output = (1.0005 * (beat + 3 * ARCSEC) + noise * ARCSEC * rng.standard_normal(len(rate))) / ARCSEC
    columns = {"time": 8.0 * np.arange(len(rate)), "rate": rate / ARCSEC, "output": output}
    return gm.Campaign(
        columns, {"time": "s", "rate": "arcsec/s", "output": "arcsec/s"}, {"kind": "rate", "gyro": "rlg"}
    )


def up_and_down(top: float, count: int) -> np.ndarray:
    """Rates through zero and back, rad/s, none met twice."""
    half = np.linspace(-top, top, count // 2)
    return np.concatenate([half, half[::-1] - top / count]) * ARCSEC


def undithered(seed: int, earth: float, noise: float) -> gm.Campaign:
    """Up to three times the lock-in rate, the Earth turning the case by `earth` arcsec/s more."""
    rng = np.random.default_rng(seed)
    rate = up_and_down(300.0, 240)
    theta, step = resting_case(4.0, 8000)
    return sweep(counted_rate(rate + earth * ARCSEC, LOCK_IN_RATE, FRINGE, step, theta, rng), rate, noise, rng)


def rows_of(estimate: gm.Estimate, effect: str) -> dict[str, tuple[float, float]]:
    return {row.name: (row.value, row.std) for row in estimate.table() if row.effect == effect}


def test_fit_finds_the_dead_band(seed: int) -> None:
    campaign = undithered(seed, earth=10.0, noise=5.0)
    found = rows_of(gm.fit(campaign, gm.model_from_effects(["scale_factor", "bias", "lock_in"])), "lock_in")
    # In deg/h, which are arcsec/s. A sample close to the edge of the band, where the slope is infinite, makes the
    # linear interval up to 1.5 times too short.
    for name, truth in (("half_width", 100.0), ("centre", -10.0)):
        value, std = found[name]
        assert abs(value - truth) < 6 * std, name
        assert std < 1.0
    assert found["share"] == (1.0, 0.0)


@pytest.mark.long
def test_fit_finds_the_lock_in_rate_behind_a_dither(seed: int) -> None:
    """From the bands at rest and at the first harmonics, the dither being known; and the band at rest by itself."""
    depth = 3.0
    amplitude = depth * FRINGE / (2 * np.pi)
    rng = np.random.default_rng(seed)
    rate = up_and_down(1000.0, 250)
    theta, step = sinusoidal_dither(amplitude, DITHER_FREQUENCY, 400, 48)
    beat = counted_rate(rate, LOCK_IN_RATE, FRINGE, step, theta, rng)
    effect = LockInDithered(
        dither_amplitude=amplitude, dither_frequency=DITHER_FREQUENCY, fringe_angle=FRINGE, lock_in_rate=80 * ARCSEC
    )  # type: ignore[call-arg]
    model = gm.model_from_effects(["scale_factor", "bias"]).with_effect(effect)
    value, std = rows_of(gm.fit(sweep(beat, rate, 3.0, rng), model), "lock_in_dithered")["lock_in_rate"]
    # The bands are of first order in the lock-in rate over that of the first harmonic, an eighth here.
    assert abs(value - 100.0) < 6 * std + 1.0
    assert std < 2.0
    beat[np.abs(rate) > 0.5 * DITHER_FREQUENCY * FRINGE] = np.nan  # a missing sample
    start = LockIn(half_width=20 * ARCSEC)  # type: ignore[call-arg]
    model = gm.model_from_effects(["scale_factor", "bias"]).with_effect(start)
    value, std = rows_of(gm.fit(sweep(beat, rate, 3.0, rng), model), "lock_in")["half_width"]
    assert abs(value - 100.0 * abs(jv(0, depth))) < 6 * std + 0.5


def test_diagnosis_names_lock_in_and_nothing_without_it() -> None:
    simulation = gm.model_from_effects(["scale_factor", "bias"])
    found = gm.diagnose(undithered(1, earth=0.0, noise=5.0), simulation, hold_out=False)
    assert found.verdict == "named"
    assert [cause.effect for cause in found.causes] == ["lock_in"]
    assert np.isfinite(found.residual_after).all()
    values = {p.name: p.value for p in found.causes[0].parameters}
    assert values["half_width"] == pytest.approx(100.0, abs=3.0)
    rng = np.random.default_rng(1)
    rate = up_and_down(300.0, 240)
    assert gm.diagnose(sweep(rate, rate, 5.0, rng), simulation, hold_out=False).verdict == "adequate"


def test_lock_in_is_told_by_rates_outside_its_band(seed: int) -> None:
    """Steps whose least rate is three times the dead band's half width, each met four times in random order."""
    rng = np.random.default_rng(seed)
    levels = np.array([0.0, 300, 700, 1500, 4000, 1e4, 3e4, 9e4]) * ARCSEC
    rate = np.repeat(np.concatenate([rng.permutation(np.r_[levels, -levels[1:]]) for _ in range(2)]), 8)
    beat = np.sign(rate) * np.sqrt(np.maximum(rate**2 - LOCK_IN_RATE**2, 0.0))
    simulation = gm.model_from_effects(["scale_factor", "bias"])
    found = gm.diagnose(sweep(beat, rate, 1.0, rng), simulation, hold_out=False)
    assert [cause.effect for cause in found.causes] == ["lock_in"]
    told = {p.name: p for p in found.causes[0].parameters}["half_width"]
    assert abs(told.value - 100.0) < 5 * told.std


def test_lock_in_is_not_searched_without_small_rates(table: CubicSpline) -> None:
    signals = {"rate": jnp.deg2rad(table.knots), "time": table.knots}
    assert LockIn.candidates(signals) == []
    assert LockIn.candidates({"rate": jnp.zeros(9), "time": jnp.zeros(9)}) == []
    with resources.as_file(resources.files("gyromodel") / "data" / "ring_laser_table.csv") as path:
        found = gm.diagnose(gm.read_campaign(path), gm.model_from_effects(["scale_factor", "bias"]), hold_out=False)
    assert "2 deg/s of rest" in found.not_testable["lock_in"]
    assert "dither" in found.not_testable["lock_in_dithered"]
