"""Effects of how fast the rate changes: delay, bandwidth, and the angular acceleration across the input axis.

They look at neighbouring samples, and take each stretch between gaps by itself.
"""

from __future__ import annotations

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
FORGOTTEN = 5.0
# Delays and lags searched, in sample intervals: where only their product with the slope shows, to many.
SHORTEST, LONGEST, STEPS = 0.05, 64.0, 48


class TimeDelay(Effect):
    """I += ω(t − δ) − ω(t): the output is late.

    The search lets a share of the effect vary to have a linear coefficient, which for a small delay is −δ dω/dt; the
    fit holds it at one. Between samples the rate is a cubic through the four around.
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
    """I += y − ω with τ dy/dt + y = ω: the output follows the rate through a first-order lag.

    The search lets a share of the effect vary to have a linear coefficient, which for a small time constant is
    −τ dω/dt; the fit holds it at one.
    """

    id = "bandwidth"
    site = "rate"
    needs = ("rate",)
    cause = "The loop or an output filter follows the rate with a limited bandwidth, 1/(2πτ)."
    test = "Sweep the rate over a decade of frequency or more: beyond 1/(2πτ) a lag attenuates, a delay does not."
    held = ("share",)
    positive = True
    untested = "the rate does not change, or in steps between which it is not known"
    remembers = True

    share: Float[Array, ""] = parameter("1", 1.0, "part of the output that lags", default=1.0)
    time_constant: Float[Array, ""] = parameter("ms", 1.0, "τ of the lag", linear=False, default=1e-3)

    def __check_init__(self) -> None:
        if self.time_constant <= 0:
            raise ValueError("a time constant is above zero")

    def columns(self, signals: Signals) -> Float[Array, "sample coefficient"]:
        """y − ω."""
        return stack(lag(signals["time"], signals["rate"], self.time_constant))

    def unknown(self, signals: Signals) -> Bool[Array, " sample"]:
        """The first time constants, as only a steady change before them is allowed for."""
        return remembered(signals["time"], self.time_constant)

    def settled(self) -> Self:
        """All of the output lags, by as much as has the same slope."""
        return type(self)(share=jnp.ones(()), time_constant=jnp.maximum(self.share, 1e-6) * self.time_constant)

    @classmethod
    def candidates(cls, signals: Signals) -> list[Self]:
        """Time constants from a part of the sample interval to many."""
        if not resolved(signals):
            return []
        return [cls(time_constant=t) for t in interval(signals) * np.geomspace(SHORTEST, LONGEST, STEPS)]


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
    """Samples at which a lag has not forgotten what was before the stretch."""
    clock, first, _ = _clock(time)
    return clock - clock[first] < FORGOTTEN * time_constant


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


def _cubic(
    clock: Float[Array, " sample"],
    first: Int[Array, " sample"],
    last: Int[Array, " sample"],
    values: Float[Array, " sample"],
    wanted: Float[Array, " sample"],
) -> Float[Array, " sample"]:
    """The cubic through the four samples around each wanted time, of the row's own stretch."""
    left = jnp.searchsorted(clock, wanted, side="right") - 1
    start = jnp.clip(left - 1, first, jnp.maximum(last - 3, first))
    rows = start[:, None] + jnp.arange(4)
    inside = rows <= last[:, None]
    rows = jnp.minimum(rows, last[:, None])
    places = clock[rows] - clock[start][:, None]
    at = wanted - clock[start]
    weights = []
    for j in range(4):
        weight = inside[:, j].astype(float)
        for k in {0, 1, 2, 3} - {j}:
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
    """Values a delay before each sample, by the cubic through the four samples around.

    Beyond a stretch's ends it is continued by some steps and then held, for what came before is not known.
    """
    clock, first, last = _clock(time)
    beyond = CONTINUED * _usual(time)
    return _cubic(clock, first, last, values, jnp.clip(clock - delay, clock[first] - beyond, clock[last] + beyond))


@jax.jit
def slope(time: Float[Array, " sample"], values: Float[Array, " sample"]) -> Float[Array, " sample"]:
    """Derivative by time, of the cubic through the four samples around."""
    clock, first, last = _clock(time)
    return jax.jvp(lambda t: _cubic(clock, first, last, values, t), (clock,), (jnp.ones_like(clock),))[1]


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
