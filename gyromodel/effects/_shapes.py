"""What several effects share: a reference temperature, and the shape of a curve."""

from __future__ import annotations

import itertools
from typing import Any, Self

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from gyromodel._checks import accelerations
from gyromodel.effects._base import Effect, Signals, round_reference, setting

# Powers are of (x − reference)/10, so that their coefficients have the size of the effect over ten degrees.
POWER_SCALE = 10.0
# Twice the Earth's rate (rad/s), and specific force (m/s²) that noise of an accelerometer on a table does not reach.
SLOW, TURNED = 1.5e-4, 1.0
EARTHLY = "all rates are the Earth's, in attitudes that turn against gravity: no gyro bends or sticks within them"


def beyond_earth(signals: Signals) -> bool:
    """Whether functions of the rate are worth looking for: not in a tumble under the Earth's rate.

    There such a function follows specific force, and a gyro that bends or sticks so early would be no gyro beyond.
    """
    tumbles = any(np.ptp(np.asarray(signals[name])) > TURNED for name in accelerations(signals))
    return not tumbles or float(jnp.nanmax(jnp.abs(signals["rate"]))) > SLOW


class OverTemperature(Effect):
    """An effect of T − T0, with T0 the campaign's mean temperature unless it is set."""

    reference: Float[Array, ""] = setting()

    def prepared(self, signals: Signals) -> Self:
        """Refer to the campaign's mean temperature."""
        if np.isfinite(float(self.reference)):
            return self
        return eqx.tree_at(lambda e: e.reference, self, round_reference(signals["temperature"]))


def curve_columns(
    x: Float[Array, " sample"], reference: Float[Array, ""], powers: int, breakpoints: Float[Array, " hinge"]
) -> Float[Array, "sample column"]:
    """Powers 1…`powers` of (x − reference)/10, then max(x − breakpoint, 0) for each breakpoint."""
    u = (x - reference) / POWER_SCALE
    columns = [u**i for i in range(1, powers + 1)]
    columns += [jnp.maximum(x - breakpoints[j], 0.0) for j in range(breakpoints.shape[0])]
    return jnp.stack(columns, axis=1)


def check_curve(coefficients: Array, hinges: Array, breakpoints: Array) -> None:
    """Refuse a curve without terms, or hinges without their breakpoints."""
    if hinges.shape != breakpoints.shape:
        raise ValueError("a curve has one breakpoint for each hinge")
    if coefficients.ndim != 1 or coefficients.size + hinges.size == 0:
        raise ValueError("a curve needs a list of coefficients, or a hinge")


def curve_forms(x: Float[Array, " sample"]) -> list[dict[str, Any]]:
    """Zero-amplitude forms of a curve: quadratic, cubic, a line with one hinge, a line with two."""
    low, high = float(jnp.nanmin(x)), float(jnp.nanmax(x))
    if not high > low:
        return []
    one = np.linspace(low, high, 13)[1:-1]
    two = list(itertools.combinations(np.linspace(low, high, 8)[1:-1], 2))
    forms: list[dict[str, Any]] = [{"coefficients": np.zeros(order)} for order in (2, 3)]
    for breaks in [(b,) for b in one] + two:
        forms.append({"coefficients": np.zeros(1), "hinges": np.zeros(len(breaks)), "breakpoints": np.array(breaks)})
    return forms
