"""How the attitude history moves with the parameters of the gyros, exact to first order."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from gyromodel.numerics.rotations import exponential, left_jacobian, normalise, product, to_matrix
from gyromodel.platform._navigation import in_epochs


@partial(jax.jit, static_argnames=("function", "every"))
def attitude_sensitivity(
    function: Callable[..., Float[Array, "step 3"]],
    parameters: Any,
    rows: Any,
    start: Float[Array, " 4"],
    every: int,
) -> tuple[Float[Array, "epoch 4"], Any]:
    """The attitudes that `attitudes` gives, and their derivatives by any number of parameters.

    q(p + δp) = exp(S δp) ∘ q(p): S_k = S_{k−1} + C_{k−1} J(φ_k) ∂φ_k/∂p, with C the direction cosines before step k and
    J the left Jacobian. The sum over an epoch is three products of a row with ∂φ/∂p, however many parameters there are.

    Args:
        function: `function(parameters, rows)`, the rotation vectors of some steps, each from its own row alone. Defined
            once at module level it is compiled once.
        parameters: a tree of arrays.
        rows: a tree of arrays over steps, such as the increments of each step and of the step before.
        start: quaternion from body to reference before the first step.
        every: steps between two epochs of the history.

    Returns:
        Quaternions at the end of each epoch, and the tree of parameters with S (rad per unit, in the reference axes) in
        place of each, behind axes of epoch and of x, y, z.

    Raises:
        ValueError: the steps are not a whole number of epochs.
    """

    def advance(q, turn):
        return product(q, exponential(turn)), q

    def epoch(carry, block):
        q, total = carry
        turns, pull = jax.vjp(lambda p: function(p, block), parameters)
        q, before = jax.lax.scan(advance, q, turns)
        # Jᵀ(φ) = J(−φ), on each row of C.
        weights = jnp.stack([left_jacobian(-turns, to_matrix(before)[:, i]) for i in range(3)])
        total = jax.tree.map(jnp.add, total, jax.vmap(pull)(weights)[0])
        now = normalise(q), total
        return now, now

    zero = jax.tree.map(lambda p: jnp.zeros((3, *jnp.shape(p))), parameters)
    blocks = jax.tree.map(lambda x: in_epochs(x, every), rows)
    return jax.lax.scan(epoch, (start, zero), blocks)[1]
