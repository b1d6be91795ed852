"""What is known, and not known, of the gyros of a platform, as errors of the navigation that relies on them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from gyromodel.effects import Signals
from gyromodel.estimate import Estimate
from gyromodel.model import GyroModel
from gyromodel.numerics.rotations import exponential, inverse, logarithm, product, rotate
from gyromodel.numerics.uncertain import Uncertain, together
from gyromodel.platform._drift import residual_drift
from gyromodel.platform._earth import earth_rate, gravity, radii
from gyromodel.platform._navigation import Navigation, attitudes, in_epochs, navigate


class Errors(NamedTuple):
    """Computed minus true, in north-up-east axes: small rotation (rad), velocity (m/s), position (m)."""

    attitude: Float[Array, "epoch 3"]
    velocity: Float[Array, "epoch 3"]
    position: Float[Array, "epoch 3"]


@dataclass(frozen=True)
class NavigationError:
    """Errors of a navigation at the end of each epoch, and where their uncertainty comes from.

    Args:
        errors: `Errors` with the covariance that the gyros' fits leave; `errors.value` is what a computer makes that
            takes its platform for one without drift, `errors.covariance` what is left of it once that is subtracted.
        shares: of each parameter, named by axis, effect and field: its part of each variance. Parts of one variance add
            up to one; a correlation counts half for either parameter, so that a part may be negative.
    """

    errors: Uncertain
    shares: Mapping[str, Errors]


def navigation_error(
    gyros: Sequence[Estimate],
    signals: Sequence[Signals],
    start: Navigation,
    velocities: Float[Array, "step 3"],
    step: float,
    every: int = 1,
) -> NavigationError:
    """Push three fitted gyros through the navigation of a space-stabilised platform.

    The platform drifts as the gyros have it, its accelerometers sense in the axes that it has then, and the computer
    takes both for those of a platform that keeps its attitude. The gyros' noise is not in it.

    Args:
        gyros: fits of the gyros of the platform's axes x, y and z.
        signals: for each, what its effects see at every step.
        start: before the first step.
        velocities: integral of the specific force over each step that a platform without drift senses, m/s.
        step: length of a step, s.
        every: steps in an epoch.
    """
    vectors = together(*(g.parameters for g in gyros))
    run = partial(_errors, signals=tuple(signals), start=start, velocities=velocities, step=step, every=every)

    def flat(vector: jax.Array) -> jax.Array:
        return ravel_pytree(run(vectors.build(vector)))[0]

    x = jnp.asarray(vectors.vector)
    value, build = ravel_pytree(run(vectors.value))
    jacobian = np.asarray(jax.jacfwd(flat)(x))
    errors = Uncertain(np.asarray(value), build, {s: jacobian @ a for s, a in vectors.sources.items()})
    parts = jacobian * (jacobian @ vectors.covariance)
    total = parts.sum(1)
    shares = np.divide(parts, total[:, None], out=np.zeros_like(parts), where=total[:, None] > 0)
    names = [
        f"{axis} {g.model.labels[slot.effect]} {slot.field}" + (f" {slot.index + 1}" if slot.index else "")
        for axis, g in zip("xyz", gyros, strict=True)
        for slot in g.model.slots()
    ]
    return NavigationError(errors, {n: build(jnp.asarray(s)) for n, s in zip(names, shares.T, strict=True)})


@partial(jax.jit, static_argnames="every")
def _errors(
    models: tuple[GyroModel, ...], signals: Any, start: Navigation, velocities: jax.Array, step: Any, every: int
) -> Errors:
    return drift_errors(residual_drift(models, signals), start, velocities, step, every)


@partial(jax.jit, static_argnames=("every", "level"))
def drift_errors(
    drift: Float[Array, "step 3"],
    start: Navigation,
    velocities: Float[Array, "step 3"],
    step: Float[Array, ""] | float,
    every: int = 1,
    level: bool = False,
    ideal: Navigation | None = None,
) -> Errors:
    """What a platform's drift makes of a navigation whose computer takes it for one that keeps its attitude.

    Args:
        drift: rate of the platform in inertial space during each step, in its own axes, rad/s.
        start: before the first step.
        velocities: integral of the specific force over each step that a platform without drift senses, m/s.
        step: length of a step, s.
        every: steps in an epoch.
        level: whether the computer is told its height.
        ideal: the navigation without drift, where it is at hand.

    Returns:
        The errors at the end of each epoch.
    """
    still = jnp.array([1.0, 0.0, 0.0, 0.0])
    turns = drift * step
    turned = attitudes(still, turns)
    midway = product(turned, exponential(-0.5 * turns))
    fixed = jnp.zeros_like(velocities)
    ideal = navigate(start, fixed, velocities, step, every, level) if ideal is None else ideal
    made = navigate(start, fixed, rotate(inverse(midway), velocities), step, every, level)
    true = product(ideal.attitude, in_epochs(turned, every)[:, -1])
    meridian, across = radii(ideal.position[:, 0])
    latitude, height = ideal.position[:, 0], ideal.position[:, 2]
    metres = jnp.stack([meridian + height, (across + height) * jnp.cos(latitude), jnp.ones_like(height)], axis=1)
    north, east, up = jnp.moveaxis((made.position - ideal.position) * metres, 1, 0)
    return Errors(
        logarithm(product(made.attitude, inverse(true))),
        made.velocity - ideal.velocity,
        jnp.stack([north, up, east], axis=1),
    )


def pushes_at_rest(start: Navigation, steps: int, step: Float[Array, ""] | float) -> Float[Array, "step 3"]:
    """Integral of the specific force (m/s) over each step of a body at rest over the Earth, in axes that keep still.

    Args:
        start: its attitude and position.
        steps: how many.
        step: length of a step, s.
    """
    latitude, height = start.position[0], start.position[2]
    turn = earth_rate(latitude) * (step * (jnp.arange(steps) + 0.5))[:, None]
    up = jnp.array([0.0, 1.0, 0.0]) * gravity(latitude, height) * step
    return rotate(inverse(start.attitude), rotate(exponential(turn), up))
