"""Effects of how fast the rate changes: delay, bandwidth, and the angular acceleration across the input axis.

They look at neighbouring samples, and take each stretch between gaps by itself.
"""

from __future__ import annotations

import math
from typing import Self

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from gyromodel.effects._base import Effect, Signals, parameter, stack

# A step in time this many times the usual one begins another stretch.
GAP = 10.0
# Least correlation of one change of the rate with the next: below it the rate is not followed between samples.
RESOLVED = 0.5
# Steps by which a rate is continued before the first sample.
CONTINUED = 2.0
# Time constants after which a lag has forgotten where it began.
FORGOTTEN = 8.0
# Delays and lags searched, in sample intervals: where only their product with the slope shows, to many.
SHORTEST, LONGEST, STEPS = 0.05, 64.0, 48
# Lags of second order by 1/w in sample intervals, where a faster one is as one of first order, and by damping ratio.
FASTEST, PERIODS, DAMPINGS = 0.25, 18, (0.2, 0.4, 0.7, 1.0, 1.5)
# Below this square of its argument a hyperbolic function is its series.
SMALL = 0.1


class TimeDelay(Effect):
    """I += ω(t − δ) − ω(t): the output is late.

    The search lets a share of the effect vary to have a linear coefficient, which for a small delay is −δ dω/dt; the
    fit holds it at one. Between samples the rate is a polynomial through the six around.
    """

    id = "time_delay"
    site = "rate"
    needs = ("rate",)
    cause = "Computing, filtering or transmission makes the output late, or clocks of gyro and table differ."
    test = "Sweep the rate over a decade of frequency or more: the phase of a delay grows on, that of a lag levels off."
    held = ("share",)
    untested = "the rate does not change, or in steps between which it is not known"
    remembers = True

    share: Float[Array, ""] = parameter("1", 1.0, "part of the output that is late", default=1.0)
    delay: Float[Array, ""] = parameter("ms", 1.0, "by how much", linear=False)

    def columns(self, signals: Signals) -> Float[Array, "sample coefficient"]:
        """ω(t − δ) − ω(t)."""
        return stack(earlier(signals["time"], signals["rate"], self.delay) - signals["rate"])

    def unknown(self, signals: Signals) -> Bool[Array, " sample"]:
        """Where the rate so much before or after was not recorded."""
        clock, first, last = _clock(signals["time"])
        return (clock - self.delay < clock[first]) | (clock - self.delay > clock[last])

    def settled(self) -> Self:
        """All of the output is late, by as much as has the same slope."""
        return type(self)(share=jnp.ones(()), delay=self.share * self.delay)

    @classmethod
    def candidates(cls, signals: Signals) -> list[Self]:
        """Delays from a part of the sample interval to many; a negative share of a small one is an early output."""
        if not resolved(signals):
            return []
        return [cls(delay=d) for d in interval(signals) * np.geomspace(SHORTEST, LONGEST, STEPS)]


class Bandwidth(Effect):
    """I += y − ω with y''/w² + τ y' + y = ω: the output follows the rate through a lag, of first order without y''.

    That of second order has the natural period P = 2π/w, the frequency 1/P, and the damping ratio ½ w τ = π τ/P; beyond
    one it is two lags of first order in series. The search lets a share of the effect vary to have a linear
    coefficient, which for a small time constant is −τ dω/dt; the fit holds it at one.
    """

    id = "bandwidth"
    site = "rate"
    needs = ("rate",)
    cause = "The loop or an output filter follows the rate with a limited bandwidth, 1/(2πτ) of first order."
    test = "Sweep the rate over a decade of frequency or more: beyond its bandwidth a lag attenuates, a delay does not."
    held = ("share",)
    positive = True
    untested = "the rate does not change, or in steps between which it is not known"
    remembers = True

    share: Float[Array, ""] = parameter("1", 1.0, "part of the output that lags", default=1.0)
    natural_period: Float[Array, " second"] = parameter(
        "ms", 100.0, "P of a lag of second order, whose damping ratio is π τ/P", linear=False, default=()
    )
    time_constant: Float[Array, ""] = parameter("ms", 1.0, "τ of the lag", linear=False, default=1e-3)

    def __check_init__(self) -> None:
        if self.time_constant <= 0:
            raise ValueError("a time constant is above zero")
        if np.size(self.natural_period) > 1 or np.any(np.asarray(self.natural_period) <= 0):
            raise ValueError("natural_period takes one value above zero, or none")

    def columns(self, signals: Signals) -> Float[Array, "sample coefficient"]:
        """y − ω."""
        time, rate = signals["time"], signals["rate"]
        if self.natural_period.size:
            return stack(second_order_lag(time, rate, self.natural_period[0], self.time_constant))
        return stack(lag(time, rate, self.time_constant))

    def unknown(self, signals: Signals) -> Bool[Array, " sample"]:
        """The first time constants, as only a steady change before them is allowed for."""
        slowest = self.time_constant
        if self.natural_period.size:
            slowest = slowest_time_constant(self.natural_period[0], slowest)
        return remembered(signals["time"], slowest)

    def settled(self) -> Self:
        """All of the output lags, by as much as has the same slope, damped as it is."""
        share = jnp.maximum(self.share, 1e-6)
        return type(self)(
            share=jnp.ones(()),
            natural_period=share * self.natural_period,
            time_constant=share * self.time_constant,
        )

    @classmethod
    def candidates(cls, signals: Signals) -> list[Self]:
        """Of either order, from a part of the sample interval to many."""
        if not resolved(signals):
            return []
        step = interval(signals)
        first = [cls(time_constant=t) for t in step * np.geomspace(SHORTEST, LONGEST, STEPS)]
        return first + [
            cls(natural_period=jnp.asarray([2.0 * np.pi * t]), time_constant=2.0 * damping * t)
            for t in step * np.geomspace(FASTEST, LONGEST, PERIODS)
            for damping in DAMPINGS
        ]


class OutputAxisAcceleration(Effect):
    """I += c α_O: angular acceleration about the output axis, dω_O/dt."""

    id = "output_axis_acceleration"
    site = "rate"
    needs = ("rate_output",)
    cause = "The float's inertia about the output axis: its case turns away under it."
    test = "Turn about the output axis alone, with changing rate: a delay needs rates about the input axis."
    remembers = True
    untested = "the rate about the output axis does not change, or in steps between which it is not known"

    coefficient: Float[Array, ""] = parameter("ms", 1.0, "I_O/H: input rate per angular acceleration")

    def columns(self, signals: Signals) -> Float[Array, "sample coefficient"]:
        """dω_O/dt."""
        return stack(slope(signals["time"], signals["rate_output"]))

    @classmethod
    def candidates(cls, signals: Signals) -> list[Self]:
        """Itself, where the rate about the output axis is followed from sample to sample."""
        return [cls()] if resolved(signals, "rate_output") else []


def interval(signals: Signals) -> float:
    """The usual step in time, s."""
    step = np.diff(np.asarray(signals["time"]))
    return float(np.median(step[step > 0]))


def resolved(signals: Signals, name: str = "rate") -> bool:
    """Whether a rate changes from sample to sample in a way that tells what it does between them."""
    step = np.diff(np.asarray(signals["time"]))
    within = (step > 0) & (step <= GAP * interval(signals))
    change, pairs = np.diff(np.asarray(signals[name])), within[1:] & within[:-1]
    one, next_one = change[:-1][pairs], change[1:][pairs]
    if not len(one) or not (np.ptp(one) > 0 and np.ptp(next_one) > 0):
        return False
    return bool(np.corrcoef(one, next_one)[0, 1] > RESOLVED)


def remembered(time: Float[Array, " sample"], time_constant: Float[Array, ""]) -> Bool[Array, " sample"]:
    """Samples at which a lag has not forgotten what was before the stretch: none if it is far below their interval."""
    clock, first, _ = _clock(time)
    return clock - clock[first] < FORGOTTEN * time_constant - 0.5 * _usual(time)


def _usual(time: Float[Array, " sample"]) -> Float[Array, ""]:
    """The usual step; padding repeats the last time, and a new run begins again at zero."""
    step = jnp.diff(time)
    return jnp.nanmedian(jnp.where(step > 0, step, jnp.nan))


def _clock(
    time: Float[Array, " sample"],
) -> tuple[Float[Array, " sample"], Int[Array, " sample"], Int[Array, " sample"]]:
    """Time that always rises, and the first and last row of the stretch that each row lies in."""
    step = jnp.diff(time)
    usual = _usual(time)
    starts = jnp.concatenate([jnp.ones(1, bool), (step <= 0) | (step > GAP * usual)])
    rows = jnp.arange(len(time))
    first = jax.lax.cummax(jnp.where(starts, rows, 0))
    last = jax.lax.cummin(jnp.where(jnp.concatenate([starts[1:], jnp.ones(1, bool)]), rows, len(time)), reverse=True)
    rising = jnp.concatenate([jnp.zeros(1), jnp.cumsum(jnp.where(step > 0, step, usual))])
    return rising, first, last


def _between(
    nodes: int,
    clock: Float[Array, " sample"],
    first: Int[Array, " sample"],
    last: Int[Array, " sample"],
    values: Float[Array, " sample"],
    wanted: Float[Array, " sample"],
) -> Float[Array, " sample"]:
    """The polynomial through so many samples around each wanted time, of the row's own stretch."""
    left = jnp.searchsorted(clock, wanted, side="right") - 1
    start = jnp.clip(left - (nodes - 1) // 2, first, jnp.maximum(last - (nodes - 1), first))
    rows = start[:, None] + jnp.arange(nodes)
    inside = rows <= last[:, None]
    rows = jnp.minimum(rows, last[:, None])
    places = clock[rows] - clock[start][:, None]
    at = wanted - clock[start]
    weights = []
    for j in range(nodes):
        weight = inside[:, j].astype(float)
        for k in set(range(nodes)) - {j}:
            apart = places[:, j] - places[:, k]
            factor = (at - places[:, k]) / jnp.where(apart == 0, 1.0, apart)
            weight = weight * jnp.where(inside[:, k], factor, 1.0)
        weights.append(weight)
    return jnp.sum(stack(*weights) * values[rows], axis=1)


# Compiled whole: an effect has many forms, and operation by operation each length would be compiled by itself.
@jax.jit
def earlier(
    time: Float[Array, " sample"], values: Float[Array, " sample"], delay: Float[Array, ""]
) -> Float[Array, " sample"]:
    """Values a delay before each sample, by the polynomial through the six samples around.

    Through four, a delay of a rate with ten samples a period is a lag besides. Beyond a stretch's ends it is continued
    by some steps and then held, for what came before is not known.
    """
    clock, first, last = _clock(time)
    beyond = CONTINUED * _usual(time)
    return _between(6, clock, first, last, values, jnp.clip(clock - delay, clock[first] - beyond, clock[last] + beyond))


@jax.jit
def slope(time: Float[Array, " sample"], values: Float[Array, " sample"]) -> Float[Array, " sample"]:
    """Derivative by time, of the polynomial through the five samples around: of four it is a part more to one side."""
    clock, first, last = _clock(time)
    return jax.jvp(lambda t: _between(5, clock, first, last, values, t), (clock,), (jnp.ones_like(clock),))[1]


@jax.jit
def lag(
    time: Float[Array, " sample"], values: Float[Array, " sample"], time_constant: Float[Array, ""]
) -> Float[Array, " sample"]:
    """Output less input of a first-order lag, which begins each stretch behind as it would under constant acceleration.

    d = y − ω follows τ dd/dt + d = −τ dω/dt; between samples dω/dt is a parabola.
    """
    clock, first, _ = _clock(time)
    begins = first == jnp.arange(len(time))
    step = jnp.diff(clock, prepend=clock[0] - 1.0)
    rising = slope(time, values)
    steady = -time_constant * rising
    # d = −τ dω/dt + τ² d²ω/dt² − …, which only small time constants can take from so few samples.
    known = jnp.exp(-((time_constant / (CONTINUED * _usual(time))) ** 2))
    bending = slope(time, rising)
    start = steady + known * time_constant**2 * bending
    decay, ratio = jnp.exp(-step / time_constant), time_constant / step
    mean = ratio * (1.0 - decay)
    drive = (1.0 - mean) * steady + (mean - decay) * jnp.concatenate([steady[:1], steady[:-1]])
    # A straight line less ½ d³ω/dt³ s(h − s) at s in a step h.
    drive += 0.5 * time_constant**2 * (1.0 + decay - 2.0 * mean) * jnp.diff(bending, prepend=bending[:1])
    decay, drive = jnp.where(begins, 0.0, decay), jnp.where(begins, start, drive)
    return jax.lax.scan(_followed, jnp.zeros(()), (decay, drive))[1]


@jax.jit
def second_order_lag(
    time: Float[Array, " sample"],
    values: Float[Array, " sample"],
    natural_period: Float[Array, ""],
    time_constant: Float[Array, ""],
) -> Float[Array, " sample"]:
    """Output less input of a second-order lag, which begins each stretch as the first-order one does.

    w = 2π over the natural period; d = y − ω follows d''/w² + τ d' + d = −τ ω' − ω''/w². Where ω' is a parabola, as
    between samples, so is one d: −τ ω' + (τ² − w⁻²) ω'' − τ (τ² − 2w⁻²) ω'''; what differs from it swings freely, by
    the exponential of a matrix.
    """
    clock, first, _ = _clock(time)
    begins = first == jnp.arange(len(time))
    step = jnp.diff(clock, prepend=clock[0] - 1.0)
    rising = slope(time, values)
    bending = slope(time, rising)
    tau, square = time_constant, (2.0 * jnp.pi / natural_period) ** 2
    second, third = tau**2 - 1.0 / square, -tau * (tau**2 - 2.0 / square)
    rising_before, bending_before = (jnp.concatenate([v[:1], v[:-1]]) for v in (rising, bending))
    # ω'' is that of the chord of ω', less and plus half of what ω''' changes in a step.
    chord, change = (rising - rising_before) / step, bending - bending_before
    jerk = change / step

    def followed(rising, bending):
        return -tau * rising + second * bending + third * jerk, -tau * bending + second * jerk

    before, before_slope = followed(rising_before, chord - 0.5 * change)
    after, after_slope = followed(rising, chord + 0.5 * change)
    free = _free(step, tau, square)
    drive = after - free[0] * before - free[1] * before_slope, after_slope - free[2] * before - free[3] * before_slope
    known = jnp.exp(-(tau**2 + 1.0 / square) / (CONTINUED * _usual(time)) ** 2)
    start = -tau * rising + known * second * bending, -known * tau * bending
    free = [jnp.where(begins, 0.0, f) for f in free]
    drive = [jnp.where(begins, s, d) for s, d in zip(start, drive, strict=True)]
    return jax.lax.scan(_swung, (jnp.zeros(()), jnp.zeros(())), (*free, *drive))[1]


def _free(step: Float[Array, " sample"], tau: Float[Array, ""], square: Float[Array, ""]) -> tuple[Array, ...]:
    """Rows of exp(A h), A = [[0, 1], [−w², −2a]] with a = ½ τ w²: how d and d' go on after a step h without a drive.

    It is e^(−ah) (cosh z + (A + a) h sinh(z)/z) with z² = (a² − w²) h², above critical damping or below.
    """
    a = 0.5 * tau * square
    z2 = (a**2 - square) * step**2
    near, real = jnp.abs(z2) < SMALL, z2 > 0
    z = jnp.sqrt(jnp.where(near, 1.0, jnp.abs(z2)))
    # a h − z without cancellation, and without overflow where the damping is strong.
    slow = jnp.exp(-jnp.where(real & ~near, square * step**2 / (a * step + z), 0.0))
    fast, damped = jnp.exp(-(a * step + jnp.where(real, z, 0.0))), jnp.exp(-a * step)
    cosine = jnp.where(real, 0.5 * (slow + fast), damped * jnp.cos(z))
    sine = jnp.where(real, 0.5 * (slow - fast), damped * jnp.sin(z)) / z
    series = jnp.where(near, z2, 0.0)
    cosine = jnp.where(near, damped * _series(series, 0), cosine)
    sine = step * jnp.where(near, damped * _series(series, 1), sine)
    return cosine + a * sine, sine, -square * sine, cosine - a * sine


def _series(z2: Float[Array, " sample"], odd: int) -> Float[Array, " sample"]:
    """cosh z, or sinh(z)/z, of a small z²."""
    return sum((z2**k / math.factorial(2 * k + odd) for k in range(1, 7)), jnp.ones_like(z2))


def slowest_time_constant(natural_period: Float[Array, ""], time_constant: Float[Array, ""]) -> Float[Array, ""]:
    """How slowly a second-order lag forgets: 2/(τ w²) where it swings, else the longer of its two time constants."""
    square = (2.0 * jnp.pi / natural_period) ** 2
    apart = time_constant**2 - 4.0 / square
    damped = 0.5 * (time_constant + jnp.sqrt(jnp.maximum(apart, 0.0)))
    return jnp.where(apart > 0, damped, 2.0 / (time_constant * square))


@jax.jit
def rate_behind(
    time: Float[Array, " sample"],
    values: Float[Array, " sample"],
    rate: Float[Array, " sample"],
    time_constant: Float[Array, ""],
) -> Float[Array, " sample"]:
    """Rate of what follows measured values through a first-order lag; below zero, of what they follow so.

    τ dy/dt + y = r with the values' rate r on a line between samples, and its mean in gaps; each run begins with y = r.
    """
    clock, _, _ = _clock(time)
    usual = _usual(time)
    begins = jnp.concatenate([jnp.ones(1, bool), jnp.diff(time) <= 0])
    step = jnp.diff(clock, prepend=clock[0] - 1.0)
    tau = jnp.maximum(time_constant, 1e-3 * usual)
    decay = jnp.exp(-step / tau)
    mean = tau / step * (1.0 - decay)
    before = jnp.concatenate([rate[:1], rate[:-1]])
    through = (1.0 - decay) * jnp.diff(values, prepend=values[:1]) / step
    drive = jnp.where(step > GAP * usual, through, (mean - decay) * before + (1.0 - mean) * rate)
    decay, drive = jnp.where(begins, 0.0, decay), jnp.where(begins, rate, drive)
    late = jax.lax.scan(_followed, jnp.zeros(()), (decay, drive))[1]
    return jnp.where(time_constant > 0, late, rate - time_constant * slope(time, rate))


# Sample by sample: an associative scan takes three times as long to compile, and longer to run.
def _followed(y: Array, now: tuple[Array, Array]) -> tuple[Array, Array]:
    y = now[0] * y + now[1]
    return y, y


def _swung(state: tuple[Array, Array], now: tuple[Array, ...]) -> tuple[tuple[Array, Array], Array]:
    d, rise = state
    d, rise = now[0] * d + now[1] * rise + now[4], now[2] * d + now[3] * rise + now[5]
    return (d, rise), d
