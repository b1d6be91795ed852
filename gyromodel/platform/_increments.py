"""From sampled rates and specific forces to the rotation vectors and velocity increments that navigation takes.

Source: P. G. Savage, *Strapdown Inertial Navigation Integration Algorithm Design*, J. Guidance, Control and Dynamics
21(1) and 21(2), 1998.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from gyromodel.numerics.rotations import cross, left_jacobian

# Samples a cubic is laid through.
CUBIC = 4


@jax.jit
def integrals(samples: Float[Array, "sample 3"], step: Float[Array, ""] | float) -> Float[Array, "interval 3"]:
    """Integrals from sample to sample of the cubic through the four around: (−s₋₁ + 13 s₀ + 13 s₁ − s₂) · step/24.

    Args:
        samples: values at even times, such as a rate (rad/s) or a specific force (m/s²).
        step: time between two samples, s.

    Returns:
        One increment less than there are samples; at the ends the cubic is that of the interval beside.

    Raises:
        ValueError: there are fewer than four samples.
    """
    if len(samples) < CUBIC:
        raise ValueError(f"a cubic needs {CUBIC} samples, and there are {len(samples)}: use increments as measured")
    extrapolate = jnp.array([4.0, -6.0, 4.0, -1.0])
    before, after = extrapolate @ samples[:CUBIC], extrapolate @ samples[: -CUBIC - 1 : -1]
    s = jnp.concatenate([before[None], samples, after[None]])
    return step / 24 * (13 * (s[1:-2] + s[2:-1]) - s[:-3] - s[3:])


@jax.jit
def coning(angles: Float[Array, "step 3"]) -> Float[Array, "step 3"]:
    """Rotation vectors φ_k = α_k + α_{k−1} × α_k / 12 of steps in which the body turns by the integrals α of its rates.

    Args:
        angles: integrals of the rates over each step, rad. What is before the first is extrapolated.
    """
    return angles + cross(_previous(angles), angles) / 12


@jax.jit
def sculling(angles: Float[Array, "step 3"], velocities: Float[Array, "step 3"]) -> Float[Array, "step 3"]:
    """Velocity increments in the axes at the start of each step: J(φ) ν_k + (α_{k−1} × ν_k + ν_{k−1} × α_k)/12.

    J(φ) is the left Jacobian of the rotation vector: exact where rate and specific force stay as they are in the body.

    Args:
        angles: integrals α of the rates over each step, rad.
        velocities: integrals ν of the specific force over each step, in the axes of the body that turns, m/s.
    """
    together = cross(_previous(angles), velocities) + cross(_previous(velocities), angles)
    return left_jacobian(coning(angles), velocities) + together / 12


def _previous(increments: jax.Array) -> jax.Array:
    """The increments one step before, those of the first by a line through it and the next."""
    first = 2 * increments[0] - increments[min(1, len(increments) - 1)]
    return jnp.concatenate([first[None], increments[:-1]])
