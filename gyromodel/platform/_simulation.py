"""One axis of the stabilisation loop in time: what friction, which sticks and slides, and gyro errors do to the body.

Source: Zhang, Jiang, Jing and Wang, doi:10.19306/j.cnki.2095-8110.2022.06.009, 2022, figure 2.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

Scalar = Float[Array, ""] | float


class Axis(NamedTuple):
    """A body on a shaft of its base, held by its loop.

    inertia: J of what the motor turns, kg m²; viscous (N m s/rad) and coulomb (N m): friction of the shaft; numerator,
    denominator: of K_0 W_c(s) W_m(s) G_fog(s), torque over body rate (N m s/rad), highest power of s first, as many of
    each (leading zeros in the first).
    """

    inertia: Scalar
    viscous: Scalar
    coulomb: Scalar
    numerator: Float[Array, " power"]
    denominator: Float[Array, " power"]


@jax.jit
def simulate_axis(
    axis: Axis, base: Float[Array, " sample"], error: Float[Array, " sample"], step: Scalar
) -> Float[Array, " sample"]:
    """Angle of the body in inertial space, from rest, while the base moves and the gyro errs.

    J ω̇ = u − c (ω − ω_b) − M sign(ω − ω_b), u = −K_0 W_c W_m G_fog (ω + e), every step of the loop: the gyro gives the
    mean rate over it, the torque acts at its end, the network is discrete by the bilinear rule. Friction is implicit in
    the new rate, so that a body whose torque stays below M sticks; derivatives are those of sticking or of sliding.

    Small angles: it holds for an axis that no other gimbal shares, and so not for the one that the redundant gimbal
    follows up.

    Args:
        axis: the parameters.
        base: its angle about the axis, rad.
        error: what the gyro reads besides the rate: drift and noise, rad/s.
        step: between two samples, s.
    """
    A, B, C, D = _bilinear(axis.numerator, axis.denominator, step)
    stuck, mass = step * axis.coulomb, axis.inertia + step * axis.viscous

    def advance(carry, now):
        state, rate, angle = carry
        base_rate, error = now
        seen = rate + error
        torque = -(C @ state + D * seen)
        push = axis.inertia * (rate - base_rate) + step * torque
        # (J + h c) w + h M sign(w) = push has one solution.
        sliding = jnp.sign(push) * jnp.maximum(jnp.abs(push) - stuck, 0.0) / mass
        rate = base_rate + sliding
        return (A @ state + B * seen, rate, angle + step * rate), angle

    rates = jnp.diff(base) / step
    still = jnp.zeros(len(axis.denominator) - 1), jnp.zeros(()), jnp.zeros(())
    (_, _, last), angles = jax.lax.scan(advance, still, (rates, error[:-1]))
    return jnp.append(angles, last)


def _bilinear(numerator: jax.Array, denominator: jax.Array, step: Scalar) -> tuple[jax.Array, ...]:
    """x ← A x + B y, u = C x + D y of a transfer function, s = 2/h (z − 1)/(z + 1), time counted in steps."""
    order = len(denominator) - 1
    # Coefficients of powers of s h: all of one size.
    scale = step ** -jnp.arange(order, -1.0, -1.0)
    above, below = numerator * scale / (denominator[0] * scale[0]), denominator * scale / (denominator[0] * scale[0])
    flow = jnp.eye(order, k=-1).at[0].set(-below[1:])
    into, out = jnp.eye(order)[0], above[1:] - above[0] * below[1:]
    half = jnp.linalg.inv(jnp.eye(order) - 0.5 * flow)
    return half @ (jnp.eye(order) + 0.5 * flow), half @ into, out @ half, above[0] + 0.5 * out @ half @ into
