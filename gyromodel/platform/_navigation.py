"""Navigation of a space-stabilised platform in north-up-east axes, and of anything else that carries its sensors.

Source: Zhang, Jiang, Jing and Wang, doi:10.19306/j.cnki.2095-8110.2022.06.009, 2022, equation (1).
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from gyromodel.numerics.rotations import cross, exponential, normalise, product, rotate
from gyromodel.platform._earth import earth_rate, gravity, radii, transport_rate

# Most steps of attitude in one inner loop, where epochs are shorter. XLA makes that loop one kernel and dispatches the
# operations around it one by one: an inner loop for each short epoch would cost little else.
BLOCK = 1024


class Navigation(NamedTuple):
    """Attitude, velocity and position of a platform; a history has an axis of epochs in front.

    attitude: quaternion that turns vectors from platform to north-up-east axes; velocity: north, up, east (m/s);
    position: latitude, longitude (rad) and height (m).
    """

    attitude: Float[Array, "*epoch 4"]
    velocity: Float[Array, "*epoch 3"]
    position: Float[Array, "*epoch 3"]


@partial(jax.jit, static_argnames="every")
def attitudes(start: Float[Array, " 4"], rotations: Float[Array, "step 3"], every: int = 1) -> Float[Array, "epoch 4"]:
    """Attitude in inertial axes, q ← q ∘ exp(φ) at each step: exact for the rotation vectors φ.

    Args:
        start: quaternion from body to reference before the first step.
        rotations: rotation vector of each step in the axes of the body, rad.
        every: steps between two epochs of the history.

    Returns:
        Quaternions at the end of each epoch; `to_matrix` makes direction cosine matrices of them.

    Raises:
        ValueError: the steps are not a whole number of epochs.
    """
    epochs = len(in_epochs(rotations, every))
    together = max(n for n in range(1, max(BLOCK // every, 1) + 1) if epochs % n == 0)

    def advance(q, turn):
        q = product(q, exponential(turn))
        return q, q

    # In reverse mode each block is computed again: what is kept is no longer than the history.
    @jax.checkpoint
    def block(q, turns):
        q, history = jax.lax.scan(advance, q, turns)
        return normalise(q), normalise(history[every - 1 :: every])

    return jax.lax.scan(block, start, in_epochs(rotations, together * every))[1].reshape(-1, 4)


@partial(jax.jit, static_argnames=("every", "level"))
def navigate(
    start: Navigation,
    rotations: Float[Array, "step 3"],
    velocities: Float[Array, "step 3"],
    step: Float[Array, ""] | float,
    every: int = 1,
    level: bool = False,
) -> Navigation:
    """Attitude, then velocity, then position, from what gyros and accelerometers on the platform sense.

    Ċ_p^n = C_p^n [ω_np^p ×],  v̇^n = f^n − (2 ω_ie^n + ω_en^n) × v^n + g^n,
    L̇ = v_N/(R_M + h),  λ̇ = v_E/((R_N + h) cos L),  ḣ = v_U.

    The platform turns in inertial space by the rotation vectors of the steps; the Earth, its gravity and the velocity
    are taken in the middle of each epoch (explicit midpoint rule, of second order in its length). Height is that of
    pure inertial navigation, whose errors grow e-fold in some ten minutes.

    Args:
        start: before the first step.
        rotations: rotation vector of the platform relative to inertial space in each step, in its own axes, rad: that
            of its residual drift, or zero for ideal gyros.
        velocities: integral of the specific force over each step, in the platform axes at its start, m/s.
        step: length of a step, s.
        every: steps in an epoch.
        level: whether the height stays, as with an altimeter, instead of being navigated.

    Returns:
        The history, at the end of each epoch.

    Raises:
        ValueError: the steps are not a whole number of epochs.
    """
    length = step * every
    sensed = jnp.array([1.0, 0.0, 1.0]) if level else jnp.ones(3)

    def sense(carry, increments):
        turned, pushed = carry
        turn, push = increments
        return (product(turned, exponential(turn)), pushed + rotate(turned, push)), None

    def accelerated(position, velocity, pushed):
        """Rotation of the axes in an epoch, and change of velocity where its middle is at a position and velocity."""
        earth, transport, fall = _of_place(position, velocity)
        turn = length * (earth + transport)
        change = pushed - 0.5 * cross(turn, pushed) + length * (fall - cross(2 * earth + transport, velocity))
        return turn, change * sensed

    @jax.checkpoint
    def epoch(now, increments):
        still = jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.zeros(3)
        (turned, pushed), _ = jax.lax.scan(sense, still, increments)
        pushed = rotate(now.attitude, pushed)

        _, change = accelerated(now.position, now.velocity, pushed)
        middle = now.position + 0.5 * length * _position_rate(now.position, now.velocity)
        turn, change = accelerated(middle, now.velocity + 0.5 * change, pushed)

        attitude = normalise(product(exponential(-turn), product(now.attitude, turned)))
        position = now.position + length * _position_rate(middle, now.velocity + 0.5 * change)
        now = Navigation(attitude, now.velocity + change, position)
        return now, now

    increments = in_epochs(rotations, every), in_epochs(velocities, every)
    return jax.lax.scan(epoch, start, increments)[1]


def in_epochs(rows: jax.Array, every: int) -> jax.Array:
    """Rows as epochs of some steps each."""
    if len(rows) % every:
        raise ValueError(
            f"{len(rows)} steps are not a whole number of epochs of {every} steps: leave out the last ones"
        )
    return rows.reshape(-1, every, *rows.shape[1:])


def _of_place(position: jax.Array, velocity: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Earth rate, transport rate and gravity in north-up-east axes."""
    latitude, height = position[0], position[2]
    fall = jnp.array([0.0, -1.0, 0.0]) * gravity(latitude, height)
    return earth_rate(latitude), transport_rate(latitude, height, velocity), fall


def _position_rate(position: jax.Array, velocity: jax.Array) -> jax.Array:
    """Rates of latitude, longitude and height."""
    latitude, _, height = position
    meridian, across = radii(latitude)
    north, up, east = velocity
    return jnp.stack([north / (meridian + height), east / ((across + height) * jnp.cos(latitude)), up])
