"""The published temperature compensation of a fiber-optic gyro at rest: means over 5 s, a low pass, three lines.

Source: 2021 thesis on a fiber-optic-gyro line-of-sight stabilisation system, chapter 3, equations (3-8)-(3-10). Its
lines are independent and jump where they meet; the package's own compensation is `bias_temperature_curve` with hinges.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

# The log is summed to 1 Hz and averaged over this long (s).
AVERAGING = 5.0
# G(z) = 5 (z + 1)/(13 z − 3): y_k = (3 y_{k−1} + 5 x_k + 5 x_{k−1})/13.
NUMERATOR, POLE, DENOMINATOR = 5.0, 3.0, 13.0
# G is the bilinear transform of 1/(τ s + 1) at 5 s: 13 = 5 + 2τ, −3 = 5 − 2τ.
TIME_CONSTANT = 4.0
# Where the lines change (°C).
BREAKPOINTS = (23.6, 30.0)
# Printed slopes K_l, K_m, K_h (bit/°C) and intercepts R0 (bit), from units of 0.01 bit.
PRINTED_SLOPES, PRINTED_INTERCEPTS = (0.3386, 0.1045, 0.4082), (-7.3229, -2.0033, -11.492)
# Bit of a one-second sum per deg/h, from the printed ±2.5 bit = ±0.0076 deg/s.
PRINTED_SCALE_FACTOR = 2.5 / (0.0076 * 3600.0)


class ThreeLines(eqx.Module):
    """R_c = K T + R0 below the first, between and above the second breakpoint, each line by itself (3-8)-(3-10)."""

    slopes: Float[Array, " line"] = eqx.field(converter=jnp.asarray)
    intercepts: Float[Array, " line"] = eqx.field(converter=jnp.asarray)
    breakpoints: Float[Array, " breakpoint"] = eqx.field(converter=jnp.asarray, default=BREAKPOINTS)

    def __call__(self, temperature: Float[Array, " sample"]) -> Float[Array, " sample"]:
        """The bias at some temperatures (°C), in the unit of the fitted output."""
        return _lines_at(self, temperature)

    @property
    def jumps(self) -> Float[Array, " breakpoint"]:
        """By how much the bias jumps upwards at each breakpoint."""
        return jnp.diff(self.slopes) * self.breakpoints + jnp.diff(self.intercepts)

    @property
    def crossings(self) -> Float[Array, " breakpoint"]:
        """Temperatures at which neighbouring lines meet (°C)."""
        return -jnp.diff(self.intercepts) / jnp.diff(self.slopes)


def printed_lines() -> ThreeLines:
    """The lines as printed: bit of a one-second sum over °C."""
    return ThreeLines(PRINTED_SLOPES, PRINTED_INTERCEPTS)


class Chain(NamedTuple):
    """The means after the low pass, less the start-up offset, and the temperature treated alike."""

    output: Float[Array, " mean"]
    temperature: Float[Array, " mean"]


@partial(jax.jit, static_argnames="length")
def block_means(values: Float[Array, " sample"], length: int) -> Float[Array, " mean"]:
    """Means over consecutive blocks of `length` samples; an incomplete last block is left out."""
    whole = values.shape[0] // length * length
    return values[:whole].reshape(-1, length).mean(axis=1)


@jax.jit
def low_pass(values: Float[Array, " mean"]) -> Float[Array, " mean"]:
    """G(z) = 5 (z + 1)/(13 z − 3), started in its steady state at the first value."""

    def step(carry, value):
        last, before = carry
        now = (POLE * last + NUMERATOR * (value + before)) / DENOMINATOR
        return (now, value), now

    return jax.lax.scan(step, (values[0], values[0]), values)[1]


@partial(jax.jit, static_argnames=("length", "settling"))
def published_chain(
    output: Float[Array, " sample"], temperature: Float[Array, " sample"], length: int = 5, settling: int = 12
) -> Chain:
    """The published treatment of a log at rest before its lines are fitted.

    Args:
        output: samples at 1 Hz, in any unit.
        temperature: thermometer at the same times (°C).
        length: samples averaged: 5 s as published.
        settling: means whose average is the start-up offset that is taken off.

    Returns:
        Means every `length` samples.
    """
    means = low_pass(block_means(output, length))
    return Chain(means - means[:settling].mean(), low_pass(block_means(temperature, length)))


@jax.jit
def fit_three_lines(
    temperature: Float[Array, " mean"], output: Float[Array, " mean"], breakpoints: Float[Array, " breakpoint"]
) -> ThreeLines:
    """Three independent least-squares lines, one a range of temperature (3-8)-(3-10).

    A range with fewer than two different temperatures gives NaN.
    """
    part = _part(temperature, breakpoints)

    def line(i):
        weight = (part == i).astype(float)
        total = weight.sum()
        t, y = weight @ temperature / total, weight @ output / total
        slope = (weight * (temperature - t)) @ (output - y) / (weight @ (temperature - t) ** 2)
        return slope, y - slope * t

    slopes, intercepts = jax.vmap(line)(jnp.arange(3))
    return ThreeLines(slopes, intercepts, breakpoints)


@jax.jit
def _lines_at(lines: ThreeLines, temperature: Float[Array, " sample"]) -> Float[Array, " sample"]:
    part = _part(temperature, lines.breakpoints)
    return lines.slopes[part] * temperature + lines.intercepts[part]


def _part(temperature: Float[Array, " sample"], breakpoints: Float[Array, " breakpoint"]) -> Int[Array, " sample"]:
    """Which line holds: T ≤ 23.6 is the low one, T ≥ 30 the high one, as printed."""
    return (temperature > breakpoints[0]).astype(int) + (temperature >= breakpoints[1])
