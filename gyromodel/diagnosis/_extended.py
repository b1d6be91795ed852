"""What is published of the last fit: its weights, and the noise that was found beside it as a model states that."""

from __future__ import annotations

import contextlib
from dataclasses import replace

import jax.numpy as jnp
import numpy as np

from gyromodel._noise_level import with_level
from gyromodel.diagnosis._result import Cause
from gyromodel.diagnosis._variance import Growth
from gyromodel.estimate import Estimate, EstimateError, fit_record, with_noise_intervals
from gyromodel.model import Level
from gyromodel.noise import MARKOV_TIME, TELEGRAPH_TIMES
from gyromodel.units import factor, internal_unit

# What fits take hops of the bias for: about their two levels the noise was white.
STANDS_FOR_HOPS = ("noise_flicker", "noise_random_walk", "noise_markov", MARKOV_TIME)


def finished(estimate: Estimate, ordinary: bool) -> Estimate:
    """What is published: the last fit, with ordinary weights where they predict better and determine it too."""
    if ordinary:
        with contextlib.suppress(EstimateError):
            estimate = fit_record(estimate.record, estimate.model_as_given(), ordinary=True)
    return with_noise_intervals(estimate)


def stated_counts(estimate: Estimate, free: Estimate) -> Estimate:
    """The fit in stated noise that lacks counts of the angle, with the noise of one that has them in its model."""
    free = with_noise_intervals(free)
    return replace(
        estimate, model=replace(estimate.model, noise=dict(free.model.noise)), noise_interval=free.noise_interval
    )


def stated_hops(estimate: Estimate, hops: Cause) -> Estimate:
    """The fit with hops of the bias as its model states them, in the place of the noise that stood for them."""
    noise = {name: v for name, v in estimate.model.noise.items() if name not in STANDS_FOR_HOPS}
    intervals = {name: v for name, v in estimate.noise_interval.items() if name in noise}
    for name, p in zip(("noise_telegraph", *TELEGRAPH_TIMES), hops.parameters, strict=True):
        scale = factor(p.unit, internal_unit(p.unit))
        noise[name] = jnp.asarray(p.value * scale)
        intervals[name] = max(p.value - 1.96 * p.std, 0.0) * scale, (p.value + 1.96 * p.std) * scale
    return replace(estimate, model=replace(estimate.model, noise=noise), noise_interval=intervals)


def louder(estimate: Estimate, times: float) -> Estimate:
    """The fit in stated noise with all of it so many times as large as its model states."""
    noise = {k: v if k in (MARKOV_TIME, *TELEGRAPH_TIMES) else v * times for k, v in estimate.model.noise.items()}
    interval = {k: (low * times, high * times) for k, (low, high) in estimate.noise_interval.items()}
    return replace(estimate, model=replace(estimate.model, noise=noise), noise_interval=interval)


def stated_level(estimate: Estimate, grows: Growth, level: Level) -> Estimate:
    """The fit with what its noise level follows as its model states it."""
    model, more = with_level(estimate.model, level)
    if model is estimate.model or model.level is None:
        return estimate
    ratio, spread = model.level.ratio, float(np.exp(1.96 * grows.ratio_std / grows.ratio))
    interval = {**estimate.noise_interval, "noise_heteroscedastic": (ratio / spread, ratio * spread)}
    if "noise_white" in interval:
        low, high = interval["noise_white"]
        interval["noise_white"] = low * more, high * more
    return replace(estimate, model=model, noise_interval=interval)
