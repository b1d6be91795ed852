"""Noise that is no colour: of the angle, hops between two levels, a level that varies."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from scipy import stats
from scipy.optimize import minimize

from gyromodel.diagnosis._result import Cause, ParameterValue
from gyromodel.estimate import (
    Estimate,
    EstimateError,
    angle_noise,
    even_stretches,
    filter_of,
    fit_record,
    with_noise_intervals,
)
from gyromodel.noise import NoiseRatios
from gyromodel.numerics.rounding import quantum
from gyromodel.signals import Record
from gyromodel.units import factor

# A record with fewer hops than this has steps, each with an epoch of its own; fewer rows show no hops.
FEWEST_HOPS, FEWEST_ROWS = 4, 100
# Lead (nats) over coloured noise and steps from which hops are told.
HOPS_LEAD = 10.0
# Standard deviation of held times over their mean from which on nothing regular switches; of random hops it is one.
IRREGULAR = 0.5
# Each level is held for four samples or more, and for this part of the record: heavy tails are no second level.
LEAST_HELD = 0.05
# Middle and half distance of the levels (ln), scatter about them (ln), chances of a hop a sample (logit) up and down.
MOST_HOPS = -1.1
BOUNDS = ((-4.0, 4.0), (-6.0, 2.0), (-6.0, 1.0), (-12.0, MOST_HOPS), (-12.0, MOST_HOPS))
# Levels closer than so many steps of the output are those of the readout.
FEWEST_STEPS = 2.0
# Columns that number what was done; the gyro does not hop where more than this share of hops is at their changes, and
# that is rare by chance.
NUMBERS, AT_CHANGES, BY_CHANCE = ("position", "segment", "run"), 0.5, 1e-3


def as_cause(name: str, evidence: float, *sizes: ParameterValue) -> Cause:
    """Noise that the model lacks."""
    p = float(np.exp(-max(evidence, 0.0)))
    return Cause(name, sizes, evidence, p, p, 1.0)


def quantisation(estimate: Estimate, threshold: float, stated: Estimate | None = None) -> Cause | None:
    """Quantisation noise (white noise of the angle) that a fit with its noise estimated has found.

    Beside a fit in stated noise that has some of it, where there is more.
    """
    if estimate.ratios.quantisation is None:
        return None
    flicker, walk, markov, constant, angle = estimate.ratios.each()
    # As fits without it find them: beside white noise that holds its variance too.
    whole = 1.0 + 2.0 * angle
    without = NoiseRatios(flicker / whole, walk / whole, markov / whole, constant)
    held = 0.0 if stated is None else float(stated.model.noise.get("noise_quantisation", 0.0))
    try:
        before = stated if held else fit_record(estimate.record, estimate.model_as_given(), ratios=without)
    except EstimateError:
        return None
    assert before is not None
    found = angle_noise(before.whitened, estimate.record)
    if found is None or found.evidence < threshold:
        return None
    estimate = with_noise_intervals(estimate)
    scale = factor("rad", "arcsec")
    value = float(estimate.model.noise["noise_quantisation"])
    low, high = estimate.noise_interval["noise_quantisation"]
    if low < held:
        return None
    size = ParameterValue("noise_quantisation", value * scale, (high - low) / 3.92 * scale, "arcsec")
    return as_cause("noise_quantisation", found.evidence, size)


def telegraph(baseline: Estimate, extended: Estimate, unit: str) -> Cause | None:
    """Hops to and fro between two levels in what the baseline leaves, where no coloured noise or steps explain it.

    At a regular pace they may as well be something that switches: then the cause has half of the posterior. Hops of a
    step or two of the output, and those where a position or a segment ends, are not the gyro's.
    """
    record = baseline.record
    residual, here = baseline.residual, np.isfinite(baseline.residual)
    count = int(here.sum())
    if count < FEWEST_ROWS:
        return None
    spread = residual[here].std()
    y = (residual[here] - residual[here].mean()) / spread
    restart = np.diff(even_stretches(record)[here], prepend=-1) != 0
    # Of a length that recurs; samples behind the last one count for nothing.
    samples = np.pad(y, (0, len(record.sampling.present) - count), constant_values=np.nan)
    opens = np.resize(restart, len(samples))

    def cost(x: np.ndarray) -> tuple[float, np.ndarray]:
        value, slope = _two_levels(x, samples, opens)
        return -float(value), -np.asarray(slope)

    best = min((minimize(cost, x, jac=True, method="L-BFGS-B", bounds=BOUNDS) for x in _starts(y)), key=lambda r: r.fun)
    _, half, sigma, up, down = best.x
    upper = _path(best.x, y, restart)
    changed = (np.diff(upper, prepend=upper[0]) != 0) & ~restart
    hops = int(changed.sum())
    size, step = 2.0 * np.exp(half) * spread, quantum(np.asarray(record.signals["output"])[: record.rows][here])
    if hops < FEWEST_HOPS or max(up, down) > MOST_HOPS - 0.01 or (step is not None and size < FEWEST_STEPS * step):
        return None
    near = _change(record)[here]
    at_changes = int(near[changed].sum())
    if at_changes > AT_CHANGES * hops and stats.binom.sf(at_changes - 1, hops, near.mean()) < BY_CHANCE:
        return None
    # Both in nats of the same samples; every free number of each costs half of ln n.
    other = _normal(extended, spread)
    extra = len(extended.model.slots()) - len(baseline.model.slots())
    extra += sum(float(r) > 0 for r in extended.ratios.each())
    lead = -best.fun - other - 0.5 * (len(best.x) - 2 - extra) * np.log(count)
    if lead < HOPS_LEAD or not LEAST_HELD < upper.mean() < 1.0 - LEAST_HELD:
        return None
    held = np.diff(np.flatnonzero(changed))
    scatter = np.concatenate([part / part.mean() for part in (held[::2], held[1::2]) if len(part)]).std()
    std = 2.0 * np.exp(sigma) * spread / np.sqrt(count / 4.0)
    dwell = [record.interval * (1.0 + np.exp(-rate)) for rate in (up, down)]
    scale = factor("rad/s", unit) / abs(float(baseline.model.gain()))
    cause = as_cause(
        "noise_telegraph",
        float(lead),
        ParameterValue("size", size * scale, std * scale, unit),
        *(
            ParameterValue(name, float(t), float(t) / np.sqrt(max(hops / 2.0, 1.0)), "s")
            for name, t in zip(("time_low", "time_high"), dwell, strict=True)
        ),
    )
    return cause if scatter >= IRREGULAR else replace(cause, posterior=0.5)


def _change(record: Record) -> np.ndarray:
    """Whether another position, segment or run begins at a row or beside it."""
    changed = np.zeros(record.rows, bool)
    for name in set(NUMBERS) & set(record.signals):
        changed |= np.diff(np.asarray(record.signals[name])[: record.rows], prepend=np.nan) != 0
    changed[0] = False
    return np.convolve(changed, np.ones(3), "same") > 0


def _path(x: np.ndarray, y: np.ndarray, restart: np.ndarray) -> np.ndarray:
    """The likeliest sequence of levels (upper or not), by Viterbi's algorithm."""
    middle, half, sigma, up, down = x
    each = -0.5 * np.square((y[:, None] - middle - np.array([-1.0, 1.0]) * np.exp(half)) / np.exp(sigma))
    stay_low, rise, fall, stay_high = (-float(np.log1p(np.exp(v))) for v in (up, -up, -down, down))
    low = high = 0.0
    # Whether each level was best reached from the upper one.
    back = np.zeros((len(y), 2), bool)
    for i, (in_low, in_high) in enumerate(each.tolist()):
        if restart[i]:
            best = max(low, high)
            back[i] = high > low
            low, high = best + in_low, best + in_high
            continue
        back[i] = high + fall > low + stay_low, high + stay_high > low + rise
        low, high = max(low + stay_low, high + fall) + in_low, max(high + stay_high, low + rise) + in_high
    path = np.zeros(len(y), bool)
    now = high > low
    for i in range(len(y) - 1, -1, -1):
        path[i] = now
        now = back[i, int(now)]
    return path


def _starts(y: np.ndarray) -> list[np.ndarray]:
    """Levels at the quartiles of samples, or of short means of them."""
    starts = []
    for m in (1, 8):
        low, high = np.quantile(np.convolve(y, np.full(m, 1.0 / m), mode="same"), [0.25, 0.75])
        half = max((high - low) / 2.0, 0.05)
        starts.append(np.array([(low + high) / 2.0, np.log(half), np.log(max(1.0 - half**2, 0.05)) / 2.0, -4.0, -4.0]))
    return starts


def _emissions(x, y):
    """Log likelihood of each sample in each level, and chances of a hop up and down."""
    levels = x[0] + jnp.array([-1.0, 1.0]) * jnp.exp(x[1])
    known = jnp.isfinite(y)
    off = (jnp.where(known, y, 0.0)[:, None] - levels) / jnp.exp(x[2])
    each = -0.5 * off**2 - x[2] - 0.5 * jnp.log(2.0 * jnp.pi)
    return jnp.where(known[:, None], each, 0.0), jax.nn.sigmoid(x[3]), jax.nn.sigmoid(x[4])


def _forward(x, y, restart):
    each, up, down = _emissions(x, y)
    hop = jnp.array([[1.0 - up, up], [down, 1.0 - down]])
    still = jnp.array([down, up]) / (up + down)

    def step(share, sample):
        log_likelihood, opens = sample
        top = log_likelihood.max()
        joint = jnp.where(opens, still, share @ hop) * jnp.exp(log_likelihood - top)
        total = joint.sum()
        return joint / total, jnp.log(total) + top

    return jax.lax.scan(step, still, (each, restart))[1]


@jax.jit
def _two_levels(x, y, restart):
    """Log likelihood of samples about two levels, and its derivative."""
    return jax.value_and_grad(lambda x: _forward(x, y, restart).sum())(x)


def _normal(estimate: Estimate, scale: float) -> float:
    """Log likelihood of the residual of a fit in its noise, in units of `scale`."""
    e = estimate.whitened[np.isfinite(estimate.whitened)]
    spread = np.log(np.sqrt(estimate.white_variance) / scale)
    determinant = 0.5 * float(filter_of(estimate.record, estimate.ratios).log_determinant)
    return float(-0.5 * np.sum(e**2) - len(e) * (spread + 0.5 * np.log(2.0 * np.pi)) - determinant)
