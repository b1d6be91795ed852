"""Four gimbals between a platform and its base: attitude from their angles, the angles from attitude, base angles.

Source: Zhang, Jiang, Jing and Wang, doi:10.19306/j.cnki.2095-8110.2022.06.009, 2022, equations (2) to (7), with

    Ry(a) = [cos a 0 −sin a; 0 1 0; sin a 0 cos a],  Rx(a) = [1 0 0; 0 cos a sin a; 0 −sin a cos a],
    Rz(a) = [cos a −sin a 0; sin a cos a 0; 0 0 1]:

Ry and Rx turn the body by −a about its axis, Rz by +a. Angles of gimbals stand from the outermost to the innermost:
β_y', β_x, β_y, β_z.
"""

from __future__ import annotations

from functools import reduce
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from gyromodel.numerics.rotations import cross, inverse, logarithm, product, rotate, to_matrix

Quaternion = Float[Array, "*#batch 4"]
Euler = Float[Array, "*#batch 3"]
Gimbals = Float[Array, "*#batch 4"]

# About what a positive angle turns the inside of each gimbal, and the two axes square to it.
AXES = np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, 1.0]])
SQUARE = np.array([np.eye(3)[np.flatnonzero(axis == 0)] for axis in AXES])
# Squared cosine of pitch below which azimuth and roll turn about one axis: their difference is all there is.
LOCKED = 1e-28
# Steps of the search for the least motion, and the rotation (rad) that it may miss the platform by.
STEPS, MISS = 20, 1e-11


class GimbalErrors(NamedTuple):
    """How the gimbals differ from ideal ones.

    nonorthogonality: what each axis has of the two other ones of x, y, z (in this order) in the frame it is carried by,
    rad; encoder_harmonic: c_k and s_k of each encoder, which reads r where the angle is
    r − Σ (c_k cos kr + s_k sin kr), k = 1, 2, …, rad.
    """

    nonorthogonality: Float[Array, "4 2"]
    encoder_harmonic: Float[Array, "4 harmonic 2"]


@jax.jit
def gimbal_attitude(angles: Gimbals, errors: GimbalErrors | None = None) -> Quaternion:
    """C_p^b = Ry(β_y') Rx(β_x) Ry(β_y) Rz(β_z), equation (3).

    Args:
        angles: what the encoders read, outermost first, rad.
        errors: of the gimbals; ideal ones without.

    Returns:
        Quaternion that turns vectors from platform to base axes.
    """
    if errors is not None:
        angles = angles - harmonics(angles, errors.encoder_harmonic)
    return chain(angles, gimbal_axes(errors))


def gimbal_axes(errors: GimbalErrors | None) -> Float[Array, "4 3"]:
    """Axis of each gimbal in the frame that it is carried by, outermost first; the nominal ones without errors."""
    axes = jnp.asarray(AXES)
    if errors is None:
        return axes
    axes = axes + jnp.einsum("gt,gtv->gv", errors.nonorthogonality, SQUARE)
    return axes / jnp.linalg.norm(axes, axis=1, keepdims=True)


@jax.jit
def nulled_gimbals(platform_to_base: Quaternion) -> Gimbals:
    """Angles of ideal gimbals whose redundant inner one is kept at β_y = 0, as a follow-up on the outermost does.

    What is left, Ry(β_y') Rx(β_x) Rz(β_z), has the form of equation (5). At β_x = ±90° the axes of β_y' and β_z are
    one: there β_z is taken for zero, and next to it both turn by up to half a turn at once, as no follow-up could.
    β_x stays within ±90°.

    Args:
        platform_to_base: quaternion of C_p^b.

    Returns:
        Outermost first, rad.
    """
    outer, middle, inner = jnp.moveaxis(euler_angles(platform_to_base), -1, 0)
    return jnp.stack([outer, middle, jnp.zeros_like(outer), inner], axis=-1)


@jax.jit
def least_motion_gimbals(
    start: Float[Array, " 4"], platform_to_base: Float[Array, "epoch 4"]
) -> Float[Array, "epoch 4"]:
    """Angles of ideal gimbals that follow a history, each epoch by the smallest |Δβ| from the one before.

    Minimum of |β − β₋|² where C(β) = C_p^b, by β ← β₋ + Jᵀ (J Jᵀ)⁻¹ [φ − J (β₋ − β)] with the axes J of the gimbals in
    the base and the rotation φ still missing. β_x = ±90° is no singularity of four gimbals. Theirs is sin β_x = 0 with
    cos β_y = 0, where all axes lie in a plane: from an epoch on that they cannot follow, or are too near that point to
    be found, angles are NaN. From random angles, a motion of 1° in one epoch is not found in 2 of 1000 cases, one of 5°
    in 1 of 100.

    Args:
        start: angles before the first epoch, such as those of `nulled_gimbals`, rad.
        platform_to_base: quaternions of C_p^b.

    Returns:
        Outermost first, rad; they go on beyond half a turn.
    """
    axes = jnp.asarray(AXES)

    def epoch(before, target):
        def improve(_, now):
            jacobian, missing = _axes_in_base(now), logarithm(product(target, inverse(chain(now, axes))))
            return before + jacobian.T @ _solve(jacobian @ jacobian.T, missing - jacobian @ (before - now))

        now = jax.lax.fori_loop(0, STEPS, improve, before)
        missing = logarithm(product(target, inverse(chain(now, axes))))
        now = jnp.where(jnp.max(jnp.abs(missing)) < MISS, now, jnp.nan)
        return now, now

    return jax.lax.scan(epoch, start, platform_to_base)[1]


@jax.jit
def euler_attitude(angles: Euler) -> Quaternion:
    """C = Ry(ψ) Rx(θ) Rz(γ), equations (4) and (5): of the platform, or the base, to north-up-east axes.

    Args:
        angles: azimuth ψ, pitch θ and roll γ, rad.
    """
    return chain(angles, jnp.asarray(AXES)[jnp.array([0, 1, 3])])


@jax.jit
def euler_angles(attitude: Quaternion) -> Euler:
    """Azimuth ψ = −atan2(a13, a33), pitch θ = asin(a23), roll γ = atan2(a21, a22), rad: equations (6) and (7).

    ψ is taken from C Rz(γ)ᵀ = Ry(ψ) Rx(θ), and θ from its cosine too: the same angles, exact up to ±90° of pitch. At
    ±90° roll is taken for zero, and pitch has no derivative (it is given as zero).

    Args:
        attitude: quaternion of the direction cosine matrix a.
    """
    a = to_matrix(attitude)
    squared = a[..., 1, 0] ** 2 + a[..., 1, 1] ** 2
    locked = squared < LOCKED
    roll = jnp.arctan2(jnp.where(locked, 0.0, a[..., 1, 0]), jnp.where(locked, 1.0, a[..., 1, 1]))
    level = jnp.arctan2(a[..., 1, 2], jnp.sqrt(jnp.where(locked, 1.0, squared)))
    pitch = jnp.where(locked, jnp.sign(a[..., 1, 2]) * jnp.pi / 2, level)
    cosine, sine = jnp.cos(roll), jnp.sin(roll)
    east, north = (a[..., k, 0] * cosine - a[..., k, 1] * sine for k in (2, 0))
    return jnp.stack([jnp.arctan2(east, north), pitch, roll], axis=-1)


@jax.jit
def base_angles(
    platform_to_nav: Float[Array, "epoch 4"],
    gimbals: Float[Array, "epoch 4"],
    mounting: Float[Array, "3 3"],
    errors: GimbalErrors | None = None,
) -> Float[Array, "epoch 3"]:
    """Angles of the base about the axes X, Y, Z of the table that carries it, from C_b^n = C_p^n C_b^p, equation (2).

    Euler angles are turns about table axes where the base is level on average, to first order in its motion, and where
    it moves about one axis at a time; roll is one anyway.

    Args:
        platform_to_nav: attitude history, as `navigate` gives it.
        gimbals: what the encoders read at its epochs, outermost first, rad.
        mounting: what X, Y and Z (rows) have of roll, azimuth and pitch (columns). In the source it is the identity. A
            table that counts right-handed turns about axes x, y, z of the base has [0 0 −1; 0 −1 0; 1 0 0].
        errors: of the gimbals; ideal ones without.

    Returns:
        Without jumps at half a turn, rad.
    """
    base_to_nav = product(platform_to_nav, inverse(gimbal_attitude(gimbals, errors)))
    azimuth, pitch, roll = jnp.moveaxis(jnp.unwrap(euler_angles(base_to_nav), axis=0), -1, 0)
    return jnp.stack([roll, azimuth, pitch], axis=-1) @ mounting.T


def chain(angles: jax.Array, axes: jax.Array) -> jax.Array:
    """Rotations by angles, each about its axis in the frame that those before have turned."""
    halves = 0.5 * angles[..., None]
    turns = jnp.concatenate([jnp.cos(halves), jnp.sin(halves) * axes], axis=-1)
    return reduce(product, jnp.moveaxis(turns, -2, 0))


def _axes_in_base(angles: jax.Array) -> jax.Array:
    """Where the gimbals before have put the axis of each: columns."""
    axes = jnp.asarray(AXES)
    return jnp.stack([axes[0], *(rotate(chain(angles[:k], axes[:k]), axes[k]) for k in (1, 2, 3))], axis=1)


def _solve(matrix: jax.Array, right: jax.Array) -> jax.Array:
    """Three linear equations by Cramer's rule: it stays inside the loop that it is called from."""
    a, b, c = matrix.T
    rows = jnp.stack([cross(b, c), cross(c, a), cross(a, b)])
    return rows @ right / (a @ rows[0])


def harmonics(angles: jax.Array, harmonics: jax.Array) -> jax.Array:
    """Error Σ (c_k cos kr + s_k sin kr) of each encoder."""
    turns = angles[..., None] * jnp.arange(1.0, harmonics.shape[1] + 1)
    return jnp.sum(harmonics[..., 0] * jnp.cos(turns) + harmonics[..., 1] * jnp.sin(turns), axis=-1)
