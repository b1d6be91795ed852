"""The stabilisation loop of one axis, and what a vibration test of the platform then measures.

Source: Zhang, Jiang, Jing and Wang, doi:10.19306/j.cnki.2095-8110.2022.06.009, 2022, figure 2. Its networks are not
published: the defaults are a design whose crossover and whose closed-loop bandwidth both lie within the published
200-350 rad/s, with margins of 66° and 20 dB.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float
from scipy.optimize import brentq

# Where margins are looked for, rad/s, and at how many frequencies.
LOWEST, HIGHEST, SEARCHED = 1e-1, 1e5, 6000

Scalar = Float[Array, ""] | float
Response = Complex[Array, " frequency"]


def value(default: float) -> Any:
    """A number that fits may change."""
    return eqx.field(converter=partial(jnp.asarray, dtype=float), default=default)


class Loop(eqx.Module):
    """A loop that holds the body still in inertial space by the rate its gyro senses, while friction drags it along.

    J s θ̇_p = c (θ̇_b − θ̇_p) − K_0 W_c(s) W_m(s) G_fog(s) e^(−τs) θ̇_p, of body angle θ_p and base angle θ_b, with
    W_c = k (1 + ω_i/s)(1 + ω_2/s), W_m = k_m/(1 + T_m s), G_fog = 1/(1 + T_g s).
    """

    inertia: Scalar = value(0.2)  # J, kg m²
    amplifier: Scalar = value(10.0)  # K_0, V/V
    correction: Scalar = value(6.0)  # k, V s/rad
    corner: Scalar = value(40.0)  # ω_i of W_c, rad/s
    second_corner: Scalar = value(0.0)  # ω_2 of W_c, rad/s: a second integrator where it is not zero
    motor: Scalar = value(0.7)  # k_m, N m/V
    motor_lag: Scalar = value(3e-4)  # T_m, s
    gyro_lag: Scalar = value(5e-4)  # T_g, s
    control_delay: Scalar = value(3e-4)  # τ, s
    friction: Scalar = value(0.0)  # c of shafts, bearings and leads, N m s/rad

    def gyro(self, frequency: Float[Array, " frequency"]) -> Response:
        """G_fog(jω): rate sensed over rate of the body."""
        return 1 / (1 + 1j * frequency * self.gyro_lag)

    def damping(self, frequency: Float[Array, " frequency"]) -> Response:
        """K_0 W_c W_m G_fog e^(−τs): torque against the rate of the body, N m s/rad."""
        s = 1j * frequency
        network = self.correction * (1 + self.corner / s) * (1 + self.second_corner / s)
        motor = self.motor / (1 + s * self.motor_lag)
        return self.amplifier * network * motor * self.gyro(frequency) * jnp.exp(-s * self.control_delay)

    def open_loop(self, frequency: Float[Array, " frequency"]) -> Response:
        """L(jω): torque of the motor over that which the body takes; friction is part of the body."""
        return self.damping(frequency) / (1j * frequency * self.inertia + self.friction)

    def residual(self, frequency: Float[Array, " frequency"]) -> Response:
        """θ_p/θ_b = c/(J s + c + K_0 W_c W_m G_fog e^(−τs)): how far friction drags the body along with the base."""
        return self.friction / (1j * frequency * self.inertia + self.friction + self.damping(frequency))


class Mount(NamedTuple):
    """What lies between table angle and base angle, and between their records.

    time_offset: by how much the platform's records are late, s. A spring and a damper carry the base:
    compliance: 1/ω_n², s²; lag: 2ζ/ω_n, s; grounded: part of the damping that acts against inertial space instead of
    against the table. Zero compliance and lag are a stiff mount.
    """

    time_offset: Float[Array, ""] | float = 0.0
    compliance: Float[Array, ""] | float = 0.0
    lag: Float[Array, ""] | float = 0.0
    grounded: Float[Array, ""] | float = 0.0


@jax.jit
def measured_response(
    loop: Loop,
    mount: Mount,
    frequency: Float[Array, " frequency"],
    integrated: Float[Array, ""] | float = 0.0,
) -> Response:
    """Ratio of the base angle that the platform measures to the table angle.

    The gimbals read θ_b − θ_p. Navigation adds what it knows of θ_p: nothing where it takes the body for still but for
    a slow drift, G_fog θ_p where it integrates the gyros. So the ratio is

        e^(−sδ) · (1 + d' s)/(1 + d s + s²/ω_n²) · [1 − (1 − G_fog integrated) θ_p/θ_b],   d' = d (1 − grounded).

    Args:
        loop: of this axis.
        mount: of this axis.
        frequency: rad/s.
        integrated: one where navigation integrates the gyros, zero where it does not.

    Returns:
        A negative angle of it is a base that is late.
    """
    s = 1j * frequency
    carried = 1 + s * mount.lag * (1 - mount.grounded)
    base = carried / (1 + s * mount.lag + s**2 * mount.compliance)
    unseen = 1 - integrated * loop.gyro(frequency)
    return jnp.exp(-s * mount.time_offset) * base * (1 - unseen * loop.residual(frequency))


class Margins(NamedTuple):
    """How far a loop is from oscillating.

    crossover: where |L| = 1, rad/s; bandwidth: where |L/(1 + L)| falls through −3 dB, rad/s; phase: margin at the
    crossover, deg; gain: margin where the phase of L is −180°, dB.
    """

    crossover: float
    bandwidth: float
    phase: float
    gain: float


def margins(loop: Loop) -> Margins:
    """Bandwidth and stability margins of a loop that is stable when open, but for integrators.

    Raises:
        ValueError: |L| or the phase of L does not cross where margins are read between 0.1 and 1e5 rad/s.
    """
    grid = np.geomspace(LOWEST, HIGHEST, SEARCHED)

    def at(frequency: float) -> complex:
        return complex(_open_loop(loop, jnp.array([frequency]))[0])

    response = np.asarray(_open_loop(loop, jnp.asarray(grid)))
    crossover = _falls(lambda w: abs(at(w)) - 1, grid, np.abs(response) - 1, "|L| = 1")
    closed = np.abs(response / (1 + response)) - math.sqrt(0.5)
    bandwidth = _falls(lambda w: abs(at(w) / (1 + at(w))) - math.sqrt(0.5), grid, closed, "|L/(1 + L)| = −3 dB")
    # −L has the phase zero where that of L is −180°; below, the imaginary part of L is negative, as −90° is.
    below = np.where(np.real(response) < 0, -np.imag(response), 1.0)
    turning = _falls(lambda w: -at(w).imag, grid, below, "phase −180°")
    phase = 180 + math.degrees(math.atan2(at(crossover).imag, at(crossover).real))
    return Margins(crossover, bandwidth, phase - 360 * (phase > 180), -20 * math.log10(abs(at(turning))))


_open_loop = jax.jit(Loop.open_loop)


def _falls(function: Callable[[float], float], grid: np.ndarray, values: np.ndarray, what: str) -> float:
    """The lowest frequency at which a function goes from positive to negative."""
    place = np.flatnonzero((values[:-1] > 0) & (values[1:] <= 0))
    if not len(place):
        raise ValueError(f"the loop has no {what} between {LOWEST:g} and {HIGHEST:g} rad/s: it is not that of figure 2")
    root: Any = brentq(function, grid[place[0]], grid[place[0] + 1], xtol=1e-9)
    return float(root)
