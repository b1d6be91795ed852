"""Static tests of a rate-integrating gyro whose output is the torquer current: ± table rates and six positions.

Source: Xu, Deng, Zhang, Zhu, Lü, Gyroscope temperature test and modelling, Journal of Astronautics 1999(2), equations
(1) and (3)-(8). Currents in A, rates and drifts in rad/s, scale factors in rad/s/A; accelerations in units of local
gravity, +1 with the axis *down*: the opposite sign of what an accelerometer on that axis reads.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from gyromodel.numerics.ratio import fieller_interval

EARTH_RATE = 7.292115e-5  # rad/s, sidereal

# Input axis: south, north, up, west, down, west; spin axis: west, west, north, up, north, down. Columns: acceleration
# along input and spin axis; shares of the Earth rate's north and up component that act about the input axis.
_SIX = np.array(
    [
        [0.0, 0.0, -1.0, 0.0],
        [0.0, 0.0, 1.0, 0.0],
        [-1.0, 0.0, 0.0, 1.0],
        [0.0, -1.0, 0.0, 0.0],
        [1.0, 0.0, 0.0, -1.0],
        [0.0, 1.0, 0.0, 0.0],
    ]
)


class Conditions(NamedTuple):
    """What acts on the gyro in each run: gravity along its axes (+1 down), rate about its input axis (inertial)."""

    acceleration_input: Float[Array, " run"]
    acceleration_spin: Float[Array, " run"]
    rate: Float[Array, " run"]


class StaticModel(eqx.Module):
    """SF·I = Df + Di a_i + Ds a_s + ω, equation (1)."""

    scale_factor: Float[Array, "*batch"]
    fixed_drift: Float[Array, "*batch"]
    input_axis_drift: Float[Array, "*batch"]
    spin_axis_drift: Float[Array, "*batch"]

    def current(self, conditions: Conditions) -> Float[Array, "*batch run"]:
        """Torquer current in each run, A; equation (1)."""
        sf, df, di, ds = (jnp.asarray(v)[..., None] for v in jax.tree.leaves(self))
        rate = df + di * conditions.acceleration_input + ds * conditions.acceleration_spin + conditions.rate
        return rate / sf


def six_positions(latitude: float) -> Conditions:
    """Conditions of the six positions that equations (5)-(8) combine.

    Input axis south (1) and north (2) with the spin axis level; input axis up (3) and down (5); spin axis up (4) and
    down (6) with the input axis level east-west.

    Args:
        latitude: north positive, rad.
    """
    input_axis, spin, horizontal, vertical = jnp.asarray(_SIX).T
    along, up = earth_rate(latitude)
    return Conditions(input_axis, spin, horizontal * along + vertical * up)


def rate_table(rates: Float[Array | np.ndarray, " run"], latitude: float) -> Conditions:
    """Conditions on a level rate table that carries the gyro with its input axis up.

    Args:
        rates: of the table relative to the Earth, rad/s.
        latitude: north positive, rad.
    """
    rates = jnp.asarray(rates)
    return Conditions(jnp.full(rates.shape, -1.0), jnp.zeros(rates.shape), rates + earth_rate(latitude)[1])


def earth_rate(latitude: Any) -> tuple[Any, Any]:
    """Horizontal (north) and vertical (up) component of the Earth's rate, rad/s.

    Raises:
        ValueError: the latitude is a pole's, where no position sees a horizontal component, or beyond.
    """
    if not isinstance(latitude, Tracer) and not np.all(np.abs(latitude) < np.pi / 2):
        raise ValueError(f"a latitude of {latitude} rad is none that six positions work at: give radians within ±π/2")
    return EARTH_RATE * jnp.cos(latitude), EARTH_RATE * jnp.sin(latitude)


@jax.jit
def scale_factor_from_rates(
    rates: Float[Array, " rate"],
    forward: Float[Array, "*batch rate"],
    backward: Float[Array, "*batch rate"],
    zero: Float[Array, "*batch"],
) -> Float[Array, "*batch rate"]:
    """Scale factor at each table rate, the mean of both directions; equations (3) and (4).

    Args:
        rates: of the table, one sign, rad/s.
        forward: currents at `rates`, A.
        backward: currents at −`rates`.
        zero: current I₀ of the table at rest.

    Returns:
        rad/s/A; an error of I₀ cancels to first order.
    """
    zero = jnp.asarray(zero)[..., None]
    return (rates / (forward - zero) - rates / (backward - zero)) / 2


def six_position(currents: Float[Array | np.ndarray, "*batch 6"], latitude: float) -> StaticModel:
    """Scale factor and drifts from one current in each position; equations (5)-(8).

    Four of the six differences between positions: I3 + I5 and I4 + I6, which also hold the fixed drift, are not used.

    Args:
        currents: I1…I6, A.
        latitude: north positive, rad.

    Raises:
        ValueError: see `earth_rate`.
    """
    return _six_position(jnp.asarray(currents), *earth_rate(latitude))


@jax.jit
def _six_position(currents: Array, horizontal: Any, vertical: Any) -> StaticModel:
    i1, i2, i3, i4, i5, i6 = jnp.moveaxis(currents, -1, 0)
    scale_factor = 2 * horizontal / (i2 - i1)  # (5)
    return StaticModel(
        scale_factor,
        scale_factor * (i1 + i2) / 2,  # (6)
        scale_factor * (i5 - i3) / 2 + vertical,  # (7)
        scale_factor * (i6 - i4) / 2,  # (8)
    )


def six_position_interval(
    currents: Float[Array | np.ndarray, " position"],
    covariance: Float[np.ndarray, "position position"],
    latitude: float,
    level: float = 0.95,
    degrees_of_freedom: float = np.inf,
) -> tuple[StaticModel, StaticModel]:
    """Lower and upper end of the exact confidence interval of each result of `six_position` (Fieller).

    All four are ω_h n/(I2 − I1) plus a constant, n = 2, I1 + I2, I5 − I3, I6 − I4, and n and I2 − I1 are normal.

    Args:
        currents: I1…I6, A.
        covariance: of their errors, which are normal.
        latitude: north positive, rad.
        level: of confidence.
        degrees_of_freedom: behind the covariance.
    """
    along, up = (float(w) for w in earth_rate(latitude))
    combine = np.zeros((5, 6))
    combine[[0, 1, 1, 2, 2, 3, 3], [0, 0, 1, 4, 2, 5, 3]] = 0, 1, 1, 1, -1, 1, -1
    combine[4, [1, 0]] = 1, -1
    value = combine @ np.asarray(currents) + [2, 0, 0, 0, 0]
    spread = combine @ covariance @ combine.T
    ends = []
    for k, offset in enumerate((0.0, 0.0, up, 0.0)):
        pair = np.ix_([k, 4], [k, 4])
        low, high = fieller_interval(float(value[k]), float(value[4]), spread[pair], level, degrees_of_freedom)
        ends.append((offset + along * low, offset + along * high))
    lower, upper = (StaticModel(*(jnp.asarray(v) for v in side)) for side in zip(*ends, strict=True))
    return lower, upper
