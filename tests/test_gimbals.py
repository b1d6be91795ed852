"""Gimbal kinematics against the source's matrices written out, scipy's rotations, and the geometry of the axes."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gyromodel.platform import (
    GimbalErrors,
    base_angles,
    euler_angles,
    euler_attitude,
    gimbal_attitude,
    least_motion_gimbals,
    nulled_gimbals,
)

NUMBER = 500
"""Of most tests here: one shape, compiled once."""


def ry(a: float) -> np.ndarray:
    return np.array([[np.cos(a), 0, -np.sin(a)], [0, 1, 0], [np.sin(a), 0, np.cos(a)]])


def rx(a: float) -> np.ndarray:
    return np.array([[1, 0, 0], [0, np.cos(a), np.sin(a)], [0, -np.sin(a), np.cos(a)]])


def rz(a: float) -> np.ndarray:
    return np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]])


def matrices(q: jax.Array) -> np.ndarray:
    return Rotation.from_quat(np.asarray(q), scalar_first=True).as_matrix()


def quaternions(matrix: np.ndarray) -> jax.Array:
    return jnp.asarray(Rotation.from_matrix(matrix).as_quat(scalar_first=True))


def angles_of(rng: np.random.Generator, columns: int) -> np.ndarray:
    return rng.uniform(-np.pi, np.pi, (NUMBER, columns))


def test_the_matrices_are_the_sources(rng: np.random.Generator):
    """Equations (3) to (5) as written there, and by scipy: −a about y and x, +a about z."""
    angles = angles_of(rng, 4)
    expected = np.stack([ry(a) @ rx(b) @ ry(c) @ rz(d) for a, b, c, d in angles])
    found = matrices(gimbal_attitude(jnp.asarray(angles)))
    assert np.abs(found - expected).max() < 1e-14
    by_scipy = Rotation.from_euler("YXY", angles[:, :3] * [-1, -1, -1]) * Rotation.from_euler("Z", angles[:, 3:])
    assert np.abs(by_scipy.as_matrix() - expected).max() < 1e-14
    euler = angles[:, :3]
    expected = np.stack([ry(a) @ rx(b) @ rz(c) for a, b, c in euler])
    assert np.abs(matrices(euler_attitude(jnp.asarray(euler))) - expected).max() < 1e-14


def test_euler_angles_are_the_published_ones(rng: np.random.Generator):
    """Equations (6), (7) written out; and there and back, pitch within a hair of ±90° and on it."""
    a = Rotation.random(NUMBER, random_state=rng).as_matrix()
    azimuth, roll = -np.arctan2(a[:, 0, 2], a[:, 2, 2]), np.arctan2(a[:, 1, 0], a[:, 1, 1])
    published = np.stack([azimuth, np.arcsin(a[:, 1, 2]), roll], 1)
    found = np.asarray(euler_angles(quaternions(a)))
    assert np.abs((found - published + np.pi) % (2 * np.pi) - np.pi).max() < 1e-9
    near = angles_of(rng, 3)
    near[:, 1] = rng.choice([-1, 1], NUMBER) * (np.pi / 2 - np.append(0.0, np.geomspace(1e-16, 0.1, NUMBER - 1)))
    for angles in (found, near):
        there = euler_attitude(jnp.asarray(angles))
        back = matrices(euler_attitude(euler_angles(there)))
        assert np.abs(back - matrices(there)).max() < 2e-14


def test_derivatives_are_finite_at_the_singularity():
    def both(angles: jax.Array) -> jax.Array:
        return euler_angles(euler_attitude(angles))

    for pitch in (np.pi / 2, -np.pi / 2, 0.3):
        assert np.isfinite(np.asarray(jax.jacfwd(both)(jnp.array([0.4, pitch, -0.2])))).all()
    assert np.allclose(jax.jacfwd(both)(jnp.array([0.4, 1.2, -0.2])), np.eye(3), atol=1e-12)


def test_nulled_gimbals(rng: np.random.Generator):
    """The inner gimbal at zero, the same attitude, also where β_x is ±90°."""
    attitude = Rotation.random(NUMBER, random_state=rng).as_matrix()
    attitude[0], attitude[1] = ry(0.3) @ rx(np.pi / 2) @ rz(0.1), ry(0.3) @ rx(-np.pi / 2) @ rz(0.1)
    angles = nulled_gimbals(quaternions(attitude))
    assert np.abs(np.asarray(angles)[:, 2]).max() == 0
    assert np.abs(matrices(gimbal_attitude(angles)) - attitude).max() < 5e-15
    assert np.allclose(np.asarray(angles)[:2, 1], [np.pi / 2, -np.pi / 2], atol=1e-7)


def over_the_top() -> np.ndarray:
    """A base that pitches through 90° while it rolls a little: C_p^b of a platform that stands still."""
    turn = np.linspace(0.0, np.pi, NUMBER)
    return np.stack([ry(0.2 * np.sin(t)) @ rx(t) @ ry(0.02 + 0.1 * np.sin(3 * t)) for t in turn])


def test_least_motion_goes_through_ninety_degrees():
    """Where the nulled policy would turn two gimbals by half a turn, none moves by more than the base does or so."""
    attitude = over_the_top()
    history = quaternions(attitude)
    angles = np.asarray(least_motion_gimbals(nulled_gimbals(history)[0], history))
    assert np.abs(matrices(gimbal_attitude(jnp.asarray(angles))) - attitude).max() < 1e-10
    step = Rotation.from_matrix(attitude[1:] @ attitude[:-1].transpose(0, 2, 1)).magnitude().max()
    assert np.abs(np.diff(angles, axis=0)).max() < 3 * step
    jumps = np.abs(np.diff(np.unwrap(np.asarray(nulled_gimbals(history)), axis=0), axis=0)).max()
    assert jumps > 10 * step
    # No other angles of the same attitude are nearer to those before: a scan along the one free direction.
    before, now = angles[99], angles[100]
    others = []
    for inner in now[2] + np.linspace(-2e-2, 2e-2, 41):
        a = attitude[100]
        x = np.arcsin(a[1, 2] / np.cos(inner))
        z = np.arctan2(a[1, 0], a[1, 1]) - np.arctan2(np.sin(x) * np.sin(inner), np.cos(x))
        y = np.arctan2(a[2, 2], a[0, 2]) - np.arctan2(np.cos(x) * np.cos(inner), -np.sin(inner))
        assert np.allclose(ry(y) @ rx(x) @ ry(inner) @ rz(z), a, atol=1e-12)
        others.append((np.array([y, x, inner, z]) - before + np.pi) % (2 * np.pi) - np.pi)
    assert np.argmin(np.linalg.norm(others, axis=1)) == 20


def test_gimbals_in_a_plane_cannot_follow():
    """At β_x = 0, β_y = 90° no axis is left for a turn about x × y: from there on nothing is claimed."""
    stuck = jnp.array([0.3, 1e-3, np.pi / 2, 0.1])
    turned = ry(0.3) @ rz(1e-2) @ ry(np.pi / 2) @ rz(0.1)
    still = ry(0.3) @ ry(np.pi / 2) @ rz(0.1)
    history = np.stack([still] * 10 + [turned] * (NUMBER - 10))
    angles = np.asarray(least_motion_gimbals(stuck, quaternions(history)))
    assert not np.isfinite(angles[10:]).any()


def test_errors_of_the_gimbals(rng: np.random.Generator):
    """Rotations about tilted axes by scipy; an encoder that reads r stands at r − c cos r − s sin r − …."""
    angles, tilts, harmonics = angles_of(rng, 4), 1e-2 * rng.normal(size=(4, 2)), 1e-3 * rng.normal(size=(4, 2, 2))
    found = matrices(gimbal_attitude(jnp.asarray(angles), GimbalErrors(jnp.asarray(tilts), jnp.asarray(harmonics))))
    expected = Rotation.identity(NUMBER)
    signed = [(-1, 1, (0, 2)), (-1, 0, (1, 2)), (-1, 1, (0, 2)), (1, 2, (0, 1))]
    for k, (sign, along, square) in enumerate(signed):
        axis, r, (one, two) = np.zeros(3), angles[:, k], harmonics[k]
        axis[along], axis[list(square)] = sign, tilts[k]
        true = r - one[0] * np.cos(r) - one[1] * np.sin(r) - two[0] * np.cos(2 * r) - two[1] * np.sin(2 * r)
        expected = expected * Rotation.from_rotvec(np.outer(true, axis / np.linalg.norm(axis)))
    assert np.abs(found - expected.as_matrix()).max() < 1e-14
    none = GimbalErrors(jnp.zeros((4, 2)), jnp.zeros((4, 2, 2)))
    ideal = gimbal_attitude(jnp.asarray(angles))
    assert np.array_equal(gimbal_attitude(jnp.asarray(angles), none), ideal)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_base_angles_and_mounting(rng: np.random.Generator, axis: int):
    """A base that turns right-handed about one of its axes is read there alone; half a turn makes no jump."""
    turn = np.linspace(-0.4, 0.4, NUMBER)
    base = Rotation.from_rotvec(turn[:, None] * np.eye(3)[axis]).as_matrix()
    platform = Rotation.random(NUMBER, random_state=rng).as_matrix()
    gimbals = nulled_gimbals(quaternions(base.transpose(0, 2, 1) @ platform))
    mounting = jnp.array([[0.0, 0.0, -1.0], [0.0, -1.0, 0.0], [1.0, 0.0, 0.0]])
    found = np.asarray(base_angles(quaternions(platform), gimbals, mounting))
    assert np.abs(found - turn[:, None] * np.eye(3)[axis]).max() < 1e-14
    published = np.asarray(base_angles(quaternions(platform), gimbals, jnp.eye(3)))
    assert np.abs(published[:, [2, 1, 0][axis]]).max() > 0.39
    round_about = ry(np.pi) @ base
    gimbals = nulled_gimbals(quaternions(round_about.transpose(0, 2, 1) @ platform))
    again = np.asarray(base_angles(quaternions(platform), gimbals, mounting))
    assert np.abs(np.diff(again, axis=0)).max() < 0.01
