"""The simulated platform against its linear transfer functions by scipy, conservation laws and closed forms; and the
whole chain on it: navigation and gimbal angles give back the motion of the base to the quantum of the encoders.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gyromodel.platform import GimbalErrors, Navigation, base_angles, navigate
from tests.truth import navigation, platform
from tests.truth.platform import AXES, Loop, Platform

FREE = Platform(viscous=np.zeros(4), coulomb=np.zeros(4), loop=None, earth=0.0, log=Platform().step)
QUANTUM = 2 * np.pi / 2**20
"""Of the encoders. Without friction the mechanics' step of the second order moves the body by less than a tenth."""
LIGHT = np.concatenate([np.full((3, 3), 1e-6), FREE.inertias[3:]])
"""Rings that weigh nothing: moving they turn nothing."""
NONE = np.zeros((1, 3))


def gains(inertia: float, w: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Torque over rate of the loop at angular rates, and the delay of half a step."""
    return Loop().torque(inertia).freqresp(w)[1], np.exp(-0.5j * w * Platform().step)


def test_margins_of_the_default_loop():
    w = np.geomspace(10.0, 5000.0, 50_000)
    torque, delay = gains(0.7, w)
    opened = torque * delay / (0.7j * w)
    phase = np.rad2deg(np.unwrap(np.angle(opened)))
    crossing = np.argmin(np.abs(np.log(np.abs(opened))))
    assert w[crossing] == pytest.approx(220.0, rel=1e-3)
    assert 180 + phase[crossing] == pytest.approx(84.0, abs=0.5)
    assert -20 * np.log10(np.abs(opened[np.argmax(phase < -180)])) == pytest.approx(16.2, abs=0.1)
    closed = np.abs(opened / (1 + opened))
    bandwidth = w[np.argmax((closed < np.sqrt(0.5)) & (w > 100))]
    assert bandwidth == pytest.approx(247, abs=1)


def phasor(time: np.ndarray, x: np.ndarray, w: float) -> complex:
    """a of x = Re(−i a exp(iwt)) + line, past the first half: 1 for sin wt."""
    time, x = time[len(time) // 2 :], x[len(time) // 2 :]
    basis = np.stack([np.sin(w * time), np.cos(w * time), np.ones_like(time), time], 1)
    sine, cosine = np.linalg.lstsq(basis, x, rcond=None)[0][:2]
    return complex(sine, cosine)


def turned(attitude: np.ndarray) -> np.ndarray:
    """Rotation vectors since the start, in n."""
    return Rotation.from_matrix(attitude @ attitude[0].T).as_rotvec()


def test_sine_response_is_that_of_the_linear_loop():
    """Gyro error: rate = −H/(Js + f + H e) · error. Base: angle = f/(Js + f + H e) · angle of base, about x and z."""
    rates = np.array([60.0, 247.0, 500.0])
    base = np.array([10.0, 30.0])
    viscous = np.array([0.0, 1.0, 0.0, 2.0])

    def error(time: np.ndarray) -> np.ndarray:
        quiet = np.zeros((len(base), len(time), 3))
        sine = 1e-3 * np.sin(rates[:, None] * time)
        return np.concatenate([np.stack([sine, 0 * sine, sine], 2), quiet])

    design = FREE._replace(loop=Loop(), viscous=viscous, drift=error)
    frequency = np.concatenate([rates, base])[:, None] * np.ones(3)
    amplitude = np.array([0, 0, 0, 1, 1])[:, None] * np.deg2rad([0.15, 0.0, -0.15])
    run = platform.simulate(design, amplitude, frequency, 1.2)
    for axis, friction in ((0, 1.0), (2, 2.0)):
        inertia = design.carried()[axis]
        for w, moved, attitude in zip(frequency[:, 0], amplitude[:, 0], run.platform, strict=True):
            torque, delay = (complex(g[0]) for g in gains(inertia, np.array([w])))
            s = 1j * w
            under = inertia * s + friction + torque * delay
            expected = friction / under * moved if moved else -1e-3 * torque / under / s
            found = phasor(run.time, turned(attitude)[:, axis], w)
            assert abs(found - expected) < 0.01 * abs(expected), (axis, w, found, expected)


def energies(design: Platform, angles: np.ndarray) -> np.ndarray:
    """Kinetic energy between samples, from the turns of each body."""
    total, body = np.zeros(len(angles) - 1), Rotation.identity(len(angles))
    for k in range(4):
        body = body * Rotation.from_rotvec(np.outer(angles[:, k], AXES[k]))
        turns = (body[:-1].inv() * body[1:]).as_rotvec() / design.step
        total += 0.5 * turns**2 @ design.inertias[k]
    return total


def test_a_free_platform_keeps_energy_and_angular_momentum():
    """Energy of all bodies; momentum of the body alone, in rings that weigh nothing."""
    start, rates = np.array([0.3, 0.4, -0.5, 0.2]), np.array([0.5, -0.8, 1.1, 2.0])
    run = platform.simulate(FREE, NONE, NONE, 0.5, start, rates=rates)
    energy = energies(FREE, run.angles[0])
    assert np.ptp(run.angles[0], axis=0).min() > 0.1
    assert np.ptp(energy) < 1e-5 * energy[0]

    light = FREE._replace(inertias=LIGHT)
    run = platform.simulate(light, NONE, NONE, 0.5, start, rates=rates)
    body = Rotation.from_matrix(run.platform[0])
    turns = (body[:-1].inv() * body[1:]).as_rotvec()
    middle = body[:-1] * Rotation.from_rotvec(0.5 * turns)
    momentum = middle.apply(turns / FREE.step * FREE.inertias[3])
    assert np.abs(momentum - momentum[0]).max() < 1e-4 * np.linalg.norm(momentum[0])
    assert np.ptp(turns, axis=0).max() > 0.05 * np.abs(turns).max()  # the body tumbles


def test_friction_stops_and_holds():
    """Innermost gimbal: stops after J w²/(2 M), to a step; all others are held and go with the base."""
    design = FREE._replace(coulomb=np.array([1e3, 1e3, 1e3, 0.5]))
    w, inertia = 0.2, FREE.inertias[3, 2]
    run = platform.simulate(design, NONE, NONE, 0.5, rates=np.array([0.0, 0.0, 0.0, w]))
    time = np.minimum(run.time, inertia * w / 0.5)
    expected = w * time - 0.5 * 0.5 / inertia * time**2
    assert np.abs(run.angles[0, :, 3] - expected).max() < w * design.step
    assert np.ptp(run.angles[0, -100:, 3]) == 0
    assert np.abs(run.angles[0, :, :3]).max() == 0

    locked = FREE._replace(coulomb=np.full(4, 1e3))
    moved = np.full((1, 3), np.deg2rad(1.0))
    run = platform.simulate(locked, moved, 20 * np.ones((1, 3)), 0.2, rates=np.zeros(4))
    assert np.abs(run.angles).max() == 0
    assert np.array_equal(run.platform, run.base)


def test_isolator_mode():
    """The base over the table, at, below and above the mode."""
    w, zeta, at = 40.0, 0.4, np.array([20.0, 40.0, 80.0])
    design = FREE._replace(coulomb=np.full(4, 1e3), isolator=(w, zeta), log=0.001)
    run = platform.simulate(design, 1e-3 * np.eye(3)[[0, 0, 0]], at[:, None] * np.ones(3), 1.2, rates=np.zeros(4))
    for rate, base in zip(at, run.base, strict=True):
        s = 1j * rate
        expected = 1e-3 * (2 * zeta * w * s + w * w) / (s * s + 2 * zeta * w * s + w * w)
        assert abs(phasor(run.time, turned(base)[:, 2], rate) - expected) < 1e-3 * abs(expected)


def test_growing_drift_and_noise(seed: int):
    """The body turns at −(b + ct); white noise of density N² turns it by N √t."""
    bias, growth = np.array([1e-3, -2e-3, 3e-3]), np.array([2e-3, 1e-3, -1e-3])
    design = FREE._replace(loop=Loop(), drift=lambda t: bias + np.outer(t, growth), log=0.01)
    run = platform.simulate(design, NONE, NONE, 0.8)
    turn, end = turned(run.platform[0]), run.time[:, None]
    expected = -(bias * end + 0.5 * growth * end**2)
    assert np.abs(turn - expected)[40:].max() < 0.02 * np.abs(expected).max()
    rate = (turn[-1] - turn[40]) / (end[-1] - end[40])
    assert rate == pytest.approx(-(bias + growth * 0.5 * (end[-1] + end[40])), rel=2e-3)

    noisy = FREE._replace(loop=Loop(), noise=1e-4, log=0.1)
    run = platform.simulate(noisy, np.zeros((60, 3)), np.zeros((60, 3)), 0.4, seed=seed)
    ends = Rotation.from_matrix(run.platform[:, -1]).as_rotvec()
    # χ² of 180: five standard deviations.
    assert np.mean(ends**2) == pytest.approx(1e-8 * run.time[-1], rel=5 * np.sqrt(2 / 180))


def chain(design: Platform, run: platform.Run, errors: GimbalErrors) -> np.ndarray:
    """Base angles X, Y, Z after the first record, by navigation without drift and what the encoders read."""
    start, gravity = run.platform[0, 0], navigation.normal_gravity(design.latitude, 0.0)
    earth = design.earth * np.array([np.cos(design.latitude), np.sin(design.latitude), 0.0])
    middle = run.time[:-1, None] + 0.5 * design.log
    force = Rotation.from_rotvec(middle * earth).apply([0.0, gravity, 0.0]) @ start
    q = jnp.asarray(Rotation.from_matrix(start).as_quat(scalar_first=True))
    still = Navigation(q, jnp.zeros(3), jnp.array([design.latitude, 0.0, 0.0]))
    history = navigate(still, jnp.zeros(force.shape), jnp.asarray(force * design.log), design.log)
    attitude = Rotation.from_quat(np.asarray(history.attitude), scalar_first=True).as_matrix()
    assert np.abs(attitude - run.platform[0, 1:]).max() < QUANTUM / 6
    return np.asarray(base_angles(history.attitude, jnp.asarray(run.gimbals[0, 1:]), jnp.eye(3), errors))


def test_the_chain_gives_back_the_motion_of_the_base(rng: np.random.Generator):
    """Ideal loop: nothing disturbs the body. Four encoders round by half a quantum each; the gimbals' clock is late."""
    offset = 0.004
    tilts = np.where(AXES == 0, 1e-3 * rng.uniform(0.5, 1.0, (4, 3)), 0.0)
    harmonics = 1e-4 * rng.uniform(0.5, 1.0, (4, 2, 2))
    square = np.stack([row[axis == 0] for row, axis in zip(tilts, AXES, strict=True)])
    exact = GimbalErrors(jnp.zeros((4, 2)), jnp.zeros((4, 2, 2)))
    amplitude, frequency = np.deg2rad([[1.0, 0.8, -1.2]]), np.array([[10.0, 20.0, 30.0]])
    level, start = np.array([0.02, 0.5, -0.03]), np.array([0.3, -0.2, 0.0, 0.4])
    ideal = FREE._replace(loop=Loop(), earth=platform.OMEGA, log=0.01, quantum=QUANTUM, offset=offset)
    for design, errors in (
        (ideal, exact),
        (ideal._replace(tilts=tilts, harmonics=harmonics), GimbalErrors(jnp.asarray(square), jnp.asarray(harmonics))),
    ):
        run = platform.simulate(design, amplitude, frequency, 1.0, start, level)
        true = level + amplitude * np.sin(frequency * (run.time[1:, None] + offset))
        miss = np.abs(chain(design, run, errors) - true).max()
        assert QUANTUM / 2 < miss < 2.2 * QUANTUM
        assert (
            np.abs(run.table[0, 1:] - level - amplitude * np.sin(frequency * run.time[1:, None])).max() < QUANTUM / 1.9
        )
    assert np.abs(chain(design, run, exact) - true).max() > 10 * QUANTUM
