"""What the gyros' errors do to a platform: the rate at which it drifts."""

from __future__ import annotations

from collections.abc import Sequence

import jax.numpy as jnp
from jaxtyping import Array, Float

from gyromodel.effects import Signals
from gyromodel.model import GyroModel


def residual_drift(models: Sequence[GyroModel], signals: Sequence[Signals]) -> Float[Array, "sample 3"]:
    """ω_ip^p (rad/s) of a platform whose loops hold the outputs of its gyros at zero.

    Each axis turns at the rate that its gyro takes for rest: minus its output at rest over the slope there.

    Args:
        models: one gyro for each axis, x, y and z; fitted ones, or prepared on the signals.
        signals: what their effects see; a rate among them is not used.
    """
    still = [{**s, "rate": jnp.zeros_like(s["time"])} for s in signals]
    pairs = zip(models, still, strict=True)
    return jnp.stack([-model.predict(s) / model.slope(s) for model, s in pairs], axis=1)
