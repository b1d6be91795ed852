"""The package's platform against the independent rigid bodies, whose equations are of torques, not of energy; against
conservation laws and closed forms; and its log through the estimators.
"""

from __future__ import annotations

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import gyromodel
from gyromodel.model import model_from_effects
from gyromodel.platform import (
    Bench,
    GimbalErrors,
    Loop,
    PlatformMotion,
    base_motion,
    base_on_table,
    simulate_platform,
    simulate_vibration_test,
)
from gyromodel.platform import Platform as Ours
from tests.truth import platform
from tests.truth.platform import AXES, Platform
from tests.truth.platform_campaign import vibration_test

# Without the lead and the lag of the other network, which this one does not have.
LOOP = platform.Loop(lead=1000.0, lag=1000.0)
STEP, LATITUDE = Platform().step, Platform().latitude
ARCSEC = np.deg2rad(1 / 3600)
# Table angles with what of them is one axis after another, and all three at once.
AMPLITUDE, FREQUENCY = np.deg2rad([1.0, 0.8, -1.2]), np.array([10.0, 20.0, 30.0])
STILL = jnp.tile(jnp.array([1.0, 0.0, 0.0, 0.0]), (1001, 1))
QUIET = jnp.zeros((1001, 3))


def ours(design: Platform) -> Ours:
    """The same platform."""
    s = 1j * LOOP.crossover
    gain = abs(s * (1 + s * LOOP.gyro_lag) * (1 + s * LOOP.motor_lag) / (1 + LOOP.integral / s))
    loop = Loop(
        inertia=1.0, amplifier=gain, correction=1.0, corner=LOOP.integral, motor=1.0, motor_lag=LOOP.motor_lag,
        gyro_lag=LOOP.gyro_lag, control_delay=0.0,
    )  # fmt: skip
    square = np.stack([row[axis == 0] for row, axis in zip(design.tilts, AXES, strict=True)])
    errors = GimbalErrors(jnp.asarray(square), jnp.asarray(design.harmonics))
    return Ours(design.inertias, design.viscous, design.coulomb, loop, design.follow, errors)


RUBBING = Platform(
    viscous=np.array([0.5, 1.0, 0.3, 2.0]),
    coulomb=np.array([0.01, 0.1, 0.02, 0.05]),
    loop=LOOP,
    tilts=np.where(AXES == 0, 1e-3 * np.arange(12.0).reshape(4, 3), 0.0),
)


def test_the_same_platform_as_by_torques():
    """Three axes at once, oblique gimbals, friction that sticks and slides, drift: to 1e-3 of each gimbal's motion."""
    drift = np.array([2e-5, 1e-5, -3e-5])
    design = RUBBING._replace(drift=lambda t: np.outer(1 + t, drift), log=STEP)
    run = platform.simulate(design, AMPLITUDE[None], FREQUENCY[None], 1.0)
    time = jnp.arange(2000) * STEP
    base = base_on_table(jnp.asarray(AMPLITUDE), jnp.asarray(FREQUENCY), time, None, LATITUDE)
    found = simulate_platform(ours(design), base, (1 + time)[:, None] * drift, STEP)
    near = 1e-3 * np.ptp(run.angles[0], axis=0)
    assert (np.abs(found.gimbals - run.angles[0]).max(axis=0) < near).all()
    inertial = Rotation.from_rotvec(np.outer(time, earth())) * Rotation.from_matrix(run.platform[0])
    apart = (inertial.inv() * Rotation.from_quat(np.asarray(found.body), scalar_first=True)).as_rotvec()
    moved = (inertial[0].inv() * inertial).as_rotvec()
    assert np.abs(apart).max() < 5e-3 * np.abs(moved).max()
    # Friction of Coulomb's turns the body by more than that.
    slippery = simulate_platform(ours(design._replace(coulomb=np.zeros(4))), base, (1 + time)[:, None] * drift, STEP)
    apart = Rotation.from_quat(np.asarray(found.body), scalar_first=True).inv() * Rotation.from_quat(
        np.asarray(slippery.body), scalar_first=True
    )
    assert np.abs(apart.as_rotvec()).max() > 5e-2 * np.abs(moved).max()


def earth() -> np.ndarray:
    return platform.OMEGA * np.array([np.cos(LATITUDE), np.sin(LATITUDE), 0.0])


def tumble(steps: int) -> PlatformMotion:
    """Half a second of bodies that nothing holds, in so many steps."""
    free = ours(Platform(viscous=np.zeros(4), coulomb=np.zeros(4)))
    start, rates = jnp.array([0.3, 0.4, -0.5, 0.2]), jnp.array([0.5, -0.8, 1.1, 2.0])
    still = jnp.tile(STILL[:1], (steps + 1, 1))
    return simulate_platform(free, still, jnp.zeros((steps + 1, 3)), 0.5 / steps, start, rates, held=False)


def test_a_free_platform_keeps_its_energy():
    """Of all bodies, from their turns."""
    angles, body = np.asarray(tumble(1000).gimbals), Rotation.identity(1001)
    energy = np.zeros(1000)
    for axis, angle, inertia in zip(AXES, angles.T, Platform().inertias, strict=True):
        body = body * Rotation.from_rotvec(np.outer(angle, axis))
        energy += 0.5 * ((body[:-1].inv() * body[1:]).as_rotvec() / STEP) ** 2 @ inertia
    assert np.ptp(angles, axis=0).min() > 0.1
    assert np.ptp(energy) < 1e-6 * energy[0]


def test_the_order_of_convergence_is_two():
    ends = [np.asarray(tumble(steps).gimbals[-1]) for steps in (100, 200, 400)]
    ratio = np.linalg.norm(ends[1] - ends[0]) / np.linalg.norm(ends[2] - ends[1])
    assert np.log2(ratio) == pytest.approx(2.0, abs=0.15)


def test_friction_stops_and_holds():
    """Innermost gimbal: stops after J w²/(2 M), to a step; the others are held."""
    rubs = ours(Platform(viscous=np.zeros(4), coulomb=np.array([1e3, 1e3, 1e3, 0.5])))
    w, inertia = 0.2, Platform().inertias[3, 2]
    found = simulate_platform(rubs, STILL, QUIET, STEP, rates=jnp.array([0.0, 0.0, 0.0, w]), held=False)
    time = np.minimum(np.arange(1001) * STEP, inertia * w / 0.5)
    assert np.abs(found.gimbals[:, 3] - (w * time - 0.25 / inertia * time**2)).max() < w * STEP
    assert np.ptp(found.gimbals[-100:, 3]) == 0
    assert np.abs(found.gimbals[:, :3]).max() == 0


@pytest.mark.long
def test_gyro_noise_turns_the_body_as_a_random_walk(seed: int):
    """By N √t: χ² of 180, five standard deviations."""
    density, runs = 1e-4, 60
    noise = density / np.sqrt(STEP) * np.random.default_rng(seed).standard_normal((runs, 1001, 3))
    free = ours(Platform(viscous=np.zeros(4), coulomb=np.zeros(4)))
    found = jax.vmap(lambda e: simulate_platform(free, STILL, e, STEP).body[-1])(jnp.asarray(noise))
    turned = Rotation.from_quat(np.asarray(found), scalar_first=True).as_rotvec()
    assert np.mean(turned**2) == pytest.approx(density**2 * 0.5, rel=5 * np.sqrt(2 / 180))


def test_isolator_and_network_are_those_of_the_transfer_functions():
    """Base over table at, below and above the mode; body under a gyro's error, which the loop tracks."""
    w, zeta, time = 40.0, 0.4, jnp.arange(4000) * 5e-4
    for rate in (20.0, 40.0, 80.0):
        on = base_on_table(jnp.array([1e-3, 0, 0]), jnp.full(3, rate), time, (w, zeta), 0.0)
        off = base_on_table(jnp.zeros(3), jnp.full(3, rate), time, None, 0.0)
        roll = Rotation.from_quat(off, scalar_first=True).inv() * Rotation.from_quat(on, scalar_first=True)
        s = 1j * rate
        expected = 1e-3 * (2 * zeta * w * s + w * w) / (s * s + 2 * zeta * w * s + w * w)
        assert abs(phasor(time, roll.as_rotvec()[:, 2], rate) - expected) < 1e-6
        angle = roll.as_rotvec()[:3, 2]
        assert abs(angle[0]) < 1e-15
        assert abs(angle[1]) < 2 * 2 * zeta * w * 1e-3 * rate * 5e-4**2 / 2  # from rest

    default, rate = Ours(viscous=np.zeros(4), coulomb=np.zeros(4)), 150.0
    time = np.arange(2001) * 2.5e-4
    error = np.stack([1e-4 * np.sin(rate * (time - 1.25e-4)), 0 * time, 0 * time], axis=1)
    run = simulate_platform(default, jnp.tile(STILL[:1], (2001, 1)), jnp.asarray(error), 2.5e-4)
    turned = Rotation.from_quat(np.asarray(run.body), scalar_first=True).as_rotvec()[:, 0]
    loop = default.loop
    damping = complex(loop.damping(jnp.array([rate]))[0]) / float(loop.inertia)
    expected = -1e-4 * damping / (1j * rate + damping) / (1j * rate)
    assert abs(phasor(time, turned, rate) - expected) < 0.01 * abs(expected)


def phasor(time: np.ndarray | jax.Array, x: np.ndarray, w: float) -> complex:
    """a of x = Re(−i a exp(iwt)) + line, past the first half."""
    time, x = np.asarray(time)[len(time) // 2 :], x[len(time) // 2 :]
    basis = np.stack([np.sin(w * time), np.cos(w * time), np.ones_like(time), time], 1)
    sine, cosine = np.linalg.lstsq(basis, x, rcond=None)[0][:2]
    return complex(sine, cosine)


@jax.jit
def size(design: Ours, scale: jax.Array) -> jax.Array:
    """Of the body's motion, with friction, inertias and loop changed by parts."""
    design = Ours(
        design.inertias * (1 + scale[0]), design.viscous * (1 + scale[1]), design.coulomb * (1 + scale[2]),
        jax.tree.map(lambda x: x * (1 + scale[3]), design.loop), design.follow_up,
    )  # fmt: skip
    base = base_on_table(jnp.asarray(AMPLITUDE), jnp.asarray(FREQUENCY), jnp.arange(400) * STEP, None, 0.0)
    return 1e6 * jnp.sum(simulate_platform(design, base, jnp.zeros((400, 3)), STEP).body[:, 1:] ** 2)


@pytest.mark.long
def test_derivatives_in_both_modes_are_differences():
    """Of a platform whose shafts slide; where they stick, friction of Coulomb's changes nothing."""
    design, none = Ours(), jnp.zeros(4)
    back, forward = (np.asarray(way(size, 1)(design, none)) for way in (jax.grad, jax.jacfwd))
    assert back == pytest.approx(forward, rel=1e-9)
    for k, unit in enumerate(1e-5 * jnp.eye(4)):
        difference = float(size(design, unit) - size(design, -unit)) / 2e-5
        assert float(back[k]) == pytest.approx(difference, rel=2e-3), k
    stuck = Ours(coulomb=np.full(4, 1e6))
    assert float(jax.jacfwd(size, 1)(stuck, none)[2]) == 0
    base = base_on_table(jnp.asarray(AMPLITUDE), jnp.asarray(FREQUENCY), jnp.arange(50) * STEP, None, 0.0)
    carried = simulate_platform(stuck, base, jnp.zeros((50, 3)), STEP, rates=jnp.zeros(4))
    assert np.abs(carried.gimbals).max() == 0
    assert carried.body == pytest.approx(np.asarray(base), abs=1e-15)


TEST = np.deg2rad(0.15) * np.repeat(np.eye(3), 2, axis=0), np.tile([10.0, 30.0], 3)[:, None] * np.ones(3)


def test_its_log_is_that_of_the_same_test():
    """Records late, oblique gimbals, encoders with harmonics: against the independent log, in arcsec."""
    design = RUBBING._replace(harmonics=1e-4 * np.arange(8.0).reshape(4, 1, 2), offset=-0.002, latitude=LATITUDE)
    theirs = vibration_test(design, *TEST, 1.0, skip=0.1)
    found = simulate_vibration_test(ours(design), *TEST, 1.0, Bench(late=0.002), skip=0.1)
    assert found.units == theirs.units
    assert found.metadata == theirs.metadata
    for name, column in theirs.columns.items():
        assert found.columns[name] == pytest.approx(column, abs=1e-9 if name == "time" else 0.1 / 3600), name


@cache
def log(late: float, gyros: bool, seed: int) -> gyromodel.Campaign:
    bench = Bench(late=late, scatter=ARCSEC, walk=np.deg2rad(1e-4) / 60, gyros=gyros)
    return simulate_vibration_test(Ours(), *TEST, 4.0, bench, skip=0.4, seed=seed)


@pytest.mark.long
def test_the_commands_name_what_was_simulated(seed: int):
    """The delay to a twentieth: its interval is linear, and bends with the friction of a gimbal that hardly turns."""
    diagnosis = gyromodel.diagnose(log(0.002, False, seed), model_from_effects([]), hold_out=False)
    assert {cause.effect for cause in diagnosis.causes} == {"sync_delay", "shaft_friction"}
    (delay,) = [row for row in diagnosis.extended.table() if row.name == "delay"]
    assert abs(delay.value - 2.0) < 0.1
    assert delay.std < 0.05


@pytest.mark.long
def test_logged_gyros_see_how_friction_turns_the_body(seed: int):
    """Integrated they give back the motion of the base; without them 5 arcsec of the body's are missing."""
    left = {}
    for gyros in (True, False):
        motion = base_motion(log(0.0, gyros, seed))
        left[gyros] = np.std((motion.base - motion.table)[motion.segment == 1], axis=0)[0] / ARCSEC
    assert left[True] == pytest.approx(np.sqrt(2), rel=0.2)  # of four encoders two turn with X, one of them the table's
    assert left[False] > 1.3 * left[True]


def test_records_of_before_the_table_moves_are_refused():
    with pytest.raises(ValueError, match=r"late by .* need as much to be skipped"):
        simulate_vibration_test(Ours(), *TEST, 1.0, Bench(late=0.01))
