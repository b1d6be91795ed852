"""Rotations against scipy's, the axioms of the group, and power series worked out by hand for tiny angles."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from gyromodel.numerics import rotations as so3

ANGLES = [0.0, 1e-160, 1e-9, 1e-5, 0.09, 0.11, 1.0, 3.0, np.pi]
# One rotation an angle, all about one skew axis.
AXIS = np.array([0.6, -0.48, 0.64])
VECTORS = np.outer(ANGLES, AXIS)
QUATERNIONS = np.concatenate([np.cos(np.array(ANGLES) / 2)[:, None], np.outer(np.sin(np.array(ANGLES) / 2), AXIS)], 1)


def drawn(rng: np.random.Generator, rows: int = 9) -> np.ndarray:
    return Rotation.random(rows, rng=rng).as_quat(scalar_first=True)


def test_exponential_and_logarithm_to_the_last_digit():
    exponential, logarithm = jax.jit(so3.exponential), jax.jit(so3.logarithm)
    found = np.asarray(exponential(VECTORS))
    assert np.allclose(found, QUATERNIONS, rtol=1e-15, atol=2e-16)
    # Tiny parts too, which an absolute tolerance would not see.
    assert np.allclose(found[:5, 1:], QUATERNIONS[:5, 1:], rtol=1e-15, atol=0)
    back = np.asarray(logarithm(QUATERNIONS))
    assert np.allclose(back, VECTORS, rtol=2e-15, atol=0)
    assert np.allclose(logarithm(-QUATERNIONS)[:-1], VECTORS[:-1], rtol=2e-15, atol=0)
    beyond = logarithm(exponential(np.tile(4.0 * AXIS, (len(ANGLES), 1))))
    assert np.allclose(beyond, (4.0 - 2 * np.pi) * AXIS, rtol=1e-14)


def test_the_group(rng: np.random.Generator):
    p, q, r = (jnp.asarray(drawn(rng)) for _ in range(3))
    identity = jnp.broadcast_to(jnp.array([1.0, 0.0, 0.0, 0.0]), q.shape)
    near = {"rtol": 0, "atol": 4e-15}
    assert np.allclose(so3.product(so3.product(p, q), r), so3.product(p, so3.product(q, r)), **near)
    assert np.allclose(so3.product(q, so3.inverse(q)), identity, **near)
    assert np.allclose(so3.product(identity, q), q, **near)
    assert np.allclose(so3.to_matrix(so3.product(p, q)), so3.to_matrix(p) @ so3.to_matrix(q), **near)
    assert np.allclose(so3.normalise(3.0 * q), q, **near)


def test_the_same_as_scipy(rng: np.random.Generator):
    q, v = drawn(rng), rng.standard_normal((9, 3))
    theirs = Rotation.from_quat(q, scalar_first=True)
    assert np.allclose(so3.to_matrix(jnp.asarray(q)), theirs.as_matrix(), atol=4e-15)
    assert np.allclose(so3.rotate(jnp.asarray(q), jnp.asarray(v)), theirs.apply(v), atol=1e-14)
    assert np.allclose(so3.logarithm(jnp.asarray(q)), theirs.as_rotvec(), atol=1e-14)
    assert np.allclose(so3.cross(jnp.asarray(v), jnp.asarray(v[::-1])), np.cross(v, v[::-1]), atol=4e-15)


def test_matrix_and_back_half_turns_included(rng: np.random.Generator):
    half = [[0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0], [1.0, 0.0, 0.0, 0.0]]
    q = np.concatenate([half, drawn(rng, 5)])
    found = np.asarray(so3.from_matrix(jnp.asarray(Rotation.from_quat(q, scalar_first=True).as_matrix())))
    assert np.allclose(np.abs(np.sum(found * q, axis=1)), 1.0, atol=4e-15)
    assert (found[:, 0] >= 0).all()


def test_derivatives():
    """exp(φ + δ) = exp(J δ) ∘ exp(φ), and log takes both away; at zero the derivative of exp is half the identity."""
    angles = np.array([0.0, 1e-8, 0.05, 0.15, 2.0])
    vectors = jnp.asarray(np.outer(angles, AXIS))
    q = jax.jit(so3.exponential)(vectors)
    slopes = np.asarray(jax.jit(jax.vmap(jax.jacfwd(so3.exponential)))(vectors))
    back = np.asarray(jax.jit(jax.vmap(jax.jacrev(so3.logarithm)))(q))
    columns = jax.vmap(jax.vmap(so3.left_jacobian, (None, 0), 1), (0, None))
    jacobians = np.asarray(jax.jit(columns)(vectors, jnp.eye(3)))
    assert np.allclose(slopes[0], np.concatenate([np.zeros((1, 3)), np.eye(3) / 2]), atol=0)
    assert np.allclose(back @ slopes, np.eye(3), atol=4e-15)
    nodes, weights = np.polynomial.legendre.leggauss(20)
    for angle, slope, jacobian, at in zip(angles, slopes, jacobians, np.asarray(q), strict=True):
        # The change of exp, taken back by exp itself: its vector part is half the further turn.
        w, v = at[0], at[1:]
        turned = 2 * (w * slope[1:] - np.outer(v, slope[0]) - np.cross(slope[1:].T, v).T)
        assert np.allclose(turned, jacobian, atol=4e-15)
        # The mean of all turns from nothing to φ, by Gauss-Legendre quadrature.
        turns = Rotation.from_rotvec(np.outer((nodes + 1) / 2 * angle, AXIS)).as_matrix()
        assert np.allclose(jacobian, np.tensordot(weights / 2, turns, 1), atol=1e-14)
