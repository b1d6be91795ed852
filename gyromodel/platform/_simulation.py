"""A stabilised platform in four gimbals on a moving base, in time: rigid bodies with one centre, whose shafts rub.

Source: Zhang, Jiang, Jing and Wang, doi:10.19306/j.cnki.2095-8110.2022.06.009, 2022, figure 2. The mechanics are
Lagrange's, d/dt ∂T/∂β̇ = ∂T/∂β + τ − c β̇ − M sign(β̇), of T = ½ Σ ω_gᵀ I_g ω_g with ω_g = R_gᵀ ω_g₋₁ + a_g β̇_g from the
base inwards, by the variational midpoint rule: of the second order, and without friction no energy is lost.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from gyromodel.numerics.rotations import inverse, logarithm, product, rotate
from gyromodel.platform._gimbals import GimbalErrors, chain, gimbal_axes
from gyromodel.platform._loop import Loop, value

# Of the equations of a step, which are implicit in the rates and in which shafts stick.
ITERATIONS = 4
# Damping of the follow-up of the outermost gimbal, over critical.
FOLLOW_UP_DAMPING = 0.8

Scalar = Float[Array, ""] | float


def _numbers(*default: float | tuple[float, ...]) -> Any:
    return eqx.field(converter=partial(jnp.asarray, dtype=float), default=default)


class Platform(eqx.Module):
    """What is simulated; gimbals stand from the outermost to the innermost."""

    # Principal ones of what each gimbal carries inside, about x, y, z, kg m²; of the platform body last. Next to rings
    # that weigh nothing the redundant gimbal is faster than any step.
    inertias: Float[Array | np.ndarray, "4 3"] = _numbers(
        (0.2, 0.15, 0.2), (0.1, 0.15, 0.12), (0.06, 0.05, 0.08), (0.4, 0.5, 0.45)
    )
    viscous: Float[Array | np.ndarray, " 4"] = _numbers(0.5, 0.5, 0.5, 0.5)  # friction of each shaft, N m s/rad
    coulomb: Float[Array | np.ndarray, " 4"] = _numbers(0.002, 0.002, 0.002, 0.002)  # below which it sticks, N m
    # Of each body axis: its torque is scaled by the inertia that the axis turns, over the loop's own; its friction is
    # not used. Sampling is part of its delay, which is no shorter than half a step.
    loop: Loop = eqx.field(default_factory=Loop)
    # Natural angular rate, rad/s, at which the outermost gimbal keeps the redundant one at zero.
    follow_up: Scalar = value(60.0)
    errors: GimbalErrors | None = None

    def carried(self) -> Float[Array, " 3"]:
        """Inertia that motors turn about the body's x, y, z where all gimbals are at zero, kg m²."""
        i = jnp.asarray(self.inertias)
        return jnp.stack([i[1:, 0].sum(), i[2:, 1].sum(), i[3, 2]])


class PlatformMotion(NamedTuple):
    """A history.

    gimbals: true angles, outermost first, rad; body: its attitude in inertial axes, quaternions; sensed: what the gyros
    give of the mean rate over the step before, their lag and errors with it, rad/s.
    """

    gimbals: Float[Array, "epoch 4"]
    body: Float[Array, "epoch 4"]
    sensed: Float[Array, "epoch 3"]


class _Now(NamedTuple):
    """What a step hands to the next."""

    angles: jax.Array
    rates: jax.Array
    momentum: jax.Array  # N m s
    sliding: jax.Array  # signs of the rates; zero where a shaft sticks
    body: jax.Array
    signals: jax.Array  # before and after each section of the network


@partial(jax.jit, static_argnames="held")
def simulate_platform(
    platform: Platform,
    base: Float[Array, "epoch 4"],
    error: Float[Array, "epoch 3"],
    step: Scalar,
    start: Float[Array, " 4"] | None = None,
    rates: Float[Array, " 4"] | None = None,
    *,
    held: bool = True,
) -> PlatformMotion:
    """The platform while its base moves and its gyros err.

    Gyros give the mean rate over each step, and the torque that the network makes of it is held over the next. Friction
    is implicit in the rates: shafts whose torque stays below Coulomb's stick, and derivatives are those of sticking or
    of sliding.

    Args:
        platform: its parameters.
        base: attitude in inertial axes, quaternions.
        error: what the gyros read besides the mean rate over the step before: drift and noise, rad/s.
        step: between two epochs, s.
        start: angles of the gimbals, rad; zero without.
        rates: of the gimbals, rad/s; without, those that keep the body still.
        held: by the loop and the follow-up; nothing but friction acts on the shafts otherwise.

    Returns:
        At the epochs of the base.
    """
    axes = gimbal_axes(platform.errors)
    turns = logarithm(product(inverse(base[:-1]), base[1:])) / step
    angles = jnp.zeros(4) if start is None else start
    attitude = partial(chain, axes=axes)
    sections, servo = _sections(platform.loop, step), platform.inertias[:2, 1].sum() * platform.follow_up
    gain = platform.loop.amplifier * platform.loop.correction * platform.loop.motor
    gain = gain * platform.carried() / platform.loop.inertia
    friction = step * platform.coulomb

    def mechanics(angles, rates, turn):
        pull, (base_to, gimbals_to) = jax.grad(_energy, has_aux=True)(angles, rates, turn, axes, platform.inertias)
        weighed = platform.inertias[..., None] * gimbals_to
        mass = jnp.einsum("gvi,gvj->ij", weighed, gimbals_to)
        return pull, mass, jnp.einsum("gvi,gvw,w->i", weighed, base_to, turn), gimbals_to[-1]

    def sense(now: _Now, base, error):
        body = product(base, attitude(now.angles))
        return body, _through(sections, now.signals, logarithm(product(inverse(now.body), body)) / step + error)

    def advance(now: _Now, moved):
        base, turn, error = moved
        body, signals = sense(now, base, error)
        *_, shafts = mechanics(now.angles, now.rates, turn)
        stabilising = -(gain * signals[-1]) @ shafts
        redundant = platform.follow_up * now.angles[2] + 2 * FOLLOW_UP_DAMPING * now.rates[2]
        motors = stabilising.at[0].set(jnp.sign(jnp.cos(now.angles[1])) * servo * redundant)
        known = now.momentum + (step * motors if held else 0.0)

        def improve(_, found):
            rates, sliding = found
            pull, mass, carried, _ = mechanics(now.angles + 0.5 * step * rates, rates, turn)
            right = known + 0.5 * step * pull - carried
            return _slide(mass + step * jnp.diag(platform.viscous), right, friction, sliding)

        rates, sliding = jax.lax.fori_loop(0, ITERATIONS, improve, (now.rates, now.sliding))
        pull, mass, carried, _ = mechanics(now.angles + 0.5 * step * rates, rates, turn)
        momentum = mass @ rates + carried + 0.5 * step * pull
        after = _Now(now.angles + step * rates, rates, momentum, sliding, body, signals)
        return after, PlatformMotion(now.angles, body, signals[1])

    # A step ends with the momentum at its end.
    begin = 1.5 * turns[0] - 0.5 * turns[1]
    _, mass, carried, shafts = mechanics(angles, jnp.zeros(4), begin)
    seen = rotate(inverse(attitude(angles)), begin)
    turning = -shafts.T @ jnp.linalg.solve(shafts @ shafts.T, seen) if rates is None else rates
    body, still = product(base[0], attitude(angles)), jnp.zeros((len(sections) + 1, 3))
    first = _Now(angles, turning, mass @ turning + carried, jnp.sign(turning), body, still)
    last, history = jax.lax.scan(advance, first, (base[:-1], turns, error[:-1]))
    body, signals = sense(last, base[-1], error[-1])
    end = PlatformMotion(last.angles, body, signals[1])
    return jax.tree.map(lambda x, y: jnp.concatenate([x, y[None]]), history, end)


def _energy(angles, rates, turn, axes, inertias):
    """Kinetic energy, and what base and gimbals contribute to the rate of each body, in its axes."""
    cosines, sines = jnp.cos(angles), jnp.sin(angles)
    base_to, gimbals_to = jnp.eye(3), jnp.zeros((3, 4))
    parts = []
    for a, c, s, k in zip(axes, cosines, sines, range(4), strict=True):
        inwards = c * jnp.eye(3) - s * jnp.cross(jnp.eye(3), a) + (1 - c) * jnp.outer(a, a)
        base_to, gimbals_to = inwards @ base_to, (inwards @ gimbals_to).at[:, k].set(a)
        parts.append((base_to, gimbals_to))
    of_base, of_gimbals = (jnp.stack(x) for x in zip(*parts, strict=True))
    return 0.5 * jnp.sum(inertias * (of_base @ turn + of_gimbals @ rates) ** 2), (of_base, of_gimbals)


def _slide(mass, known, friction, sliding):
    """A step towards rates v with mass·v + friction·sign(v) = known, and |known − mass·v| ≤ friction where v = 0."""
    moves = sliding != 0
    square = jnp.where(moves[:, None] & moves, mass, jnp.eye(4))
    rates = _solved(square, jnp.where(moves, known - friction * sliding, 0.0))
    pushed = known - mass @ rates + jnp.diagonal(mass) * rates
    return rates, jnp.where(jnp.abs(pushed) > friction, jnp.sign(pushed), 0.0)


def _solved(matrix, right):
    """Equations of a positive matrix by elimination that stays inside the loop it is called from."""
    rows = jnp.concatenate([matrix, right[:, None]], axis=1)
    for k, unit in enumerate(jnp.eye(len(right))):
        rows = rows - jnp.outer(rows[:, k] - unit, rows[k] / rows[k, k])
    return rows[:, -1]


def _sections(loop: Loop, step: Scalar) -> Float[Array, "section 3"]:
    """The network but for its gain: sections y = a x + b x₋ + c y₋ of the first order, by the bilinear rule."""
    late = 0.5 * jnp.maximum(loop.control_delay - 0.5 * step, 0.0)
    one, none = jnp.ones(()), jnp.zeros(())
    # (n₁ s + n₀)/(d₁ s + d₀)
    parts = [
        (none, one, loop.gyro_lag, one),
        (one, loop.corner, one, none),
        (one, loop.second_corner, one, none),
        (none, one, loop.motor_lag, one),
        (-late, one, late, one),
    ]
    n1, n0, d1, d0 = jnp.stack([jnp.stack(part) for part in parts], axis=1)
    n1, d1 = 2 * n1 / step, 2 * d1 / step
    return jnp.stack([n1 + n0, n0 - n1, d1 - d0], axis=1) / (d1 + d0)[:, None]


def _through(sections, before, rate):
    """The signals of a network, one after another, of a rate that enters it; and of those a step before."""
    signals = [rate]
    for (a, b, c), into, out in zip(sections, before[:-1], before[1:], strict=True):
        signals.append(a * signals[-1] + b * into + c * out)
    return jnp.stack(signals)
