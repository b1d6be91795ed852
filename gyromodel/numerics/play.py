"""The play operator: rate-independent memory, as of backlash, dry friction and hysteresis.

Source: M. A. Krasnosel'skii and A. V. Pokrovskii, *Systems with Hysteresis*, Springer 1989, section 2.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float


@jax.jit
def play(
    values: Float[Array, " sample"], half_width: Float[Array, ""], restart: Bool[Array, " sample"]
) -> Float[Array, " sample"]:
    """p_n = min(max(p_{n−1}, x_n − w), x_n + w): what a driver of position x drags along through play of ±w.

    Args:
        values: x, in order of time.
        half_width: w, in the unit of x.
        restart: where the past is forgotten: there, and at the first sample, p = x.

    Returns:
        p, in the unit of x.
    """

    def follow(dragged, now):
        x, fresh = now
        dragged = jnp.where(fresh, x, jnp.clip(dragged, x - half_width, x + half_width))
        return dragged, dragged

    return jax.lax.scan(follow, values[0], (values, restart))[1]
