"""Noise of kinds that a fit cannot hold: quantisation, hops between two levels, a level that varies."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from scipy import stats
from scipy.fft import dst
from scipy.optimize import minimize

from gyromodel.diagnosis._evidence import log_sum
from gyromodel.diagnosis._result import Cause, ParameterValue
from gyromodel.estimate import Estimate, filter_of
from gyromodel.numerics.rounding import quantum
from gyromodel.signals import Record
from gyromodel.units import factor

# Even stretches shorter than this show no correlation from sample to sample.
STRETCH = 16
# Quantisation variances over white ones that are tried.
SHARES = np.geomspace(1e-3, 1e3, 61)
# Times the variance that a line has at its frequency, parts of the frequencies that may be lines, turns of their fit.
LINE, LINES, TURNS = 20.0, (1e-6, 0.01, 0.03, 0.1), 20
# Where a band may begin, in the units of quantisation's spectrum (0.1 to 0.45 times the sample rate), and by how much.
EDGES, RAISED = 2.0 - 2.0 * np.cos(2.0 * np.pi * np.linspace(0.1, 0.45, 8)), np.geomspace(0.1, 300.0, 16)
CHI_MEDIAN = float(stats.chi2.median(1))
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


def quantisation(estimate: Estimate, threshold: float) -> Cause | None:
    """Quantisation noise (white noise of the angle) in what a fit leaves, by its falling correlation.

    Its covariance over an even stretch is tridiagonal, and the sine transform diagonalises it.
    """
    record, known = estimate.record, np.isfinite(estimate.whitened)
    ends = np.flatnonzero((np.diff(_stretch(record), prepend=0) > 0) | ~known)
    stretches = [e[np.isfinite(e)] for e in np.split(estimate.whitened, ends)]
    stretches = [e for e in stretches if len(e) >= STRETCH]
    if not stretches:
        return None
    if not any(e.any() for e in stretches):
        return None
    power = np.concatenate([np.square(np.asarray(dst(e, type=1, norm="ortho"))) for e in stretches])
    spectrum = np.concatenate([2.0 - 2.0 * np.cos(np.pi * np.arange(1, len(e) + 1) / (len(e) + 1)) for e in stretches])
    white, likelihood = _spectral_fit(power, 1.0 + np.append(0.0, SHARES)[:, None] * spectrum)
    evidence = log_sum(likelihood[1:]) - likelihood[0] - np.log(len(SHARES))
    if evidence < threshold:
        return None
    # Many weak lines, or noise of a band, raise the spectrum from some frequency on.
    band = spectrum >= EDGES[:, None]
    other = _spectral_fit(power, 1.0 + (RAISED[:, None, None] * band).reshape(-1, len(power)))[1]
    if log_sum(other) - np.log(len(other)) > likelihood[0] + evidence:
        return None
    white, gain = white[1:], likelihood[1:]
    weight = np.exp(gain - log_sum(gain))
    unit = record.interval * np.sqrt(estimate.white_variance) / abs(float(estimate.model.gain()))
    sizes = unit * np.sqrt(SHARES * white)
    value = float(weight @ sizes)
    std = float(np.sqrt(weight @ (sizes - value) ** 2 + (value**2) / (2.0 * len(power))))
    scale = factor("rad", "arcsec")
    return as_cause(
        "noise_quantisation",
        float(evidence),
        ParameterValue("noise_quantisation", value * scale, std * scale, "arcsec"),
    )


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
    restart = np.diff(_stretch(record)[here], prepend=-1) != 0
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
    extra = len(extended.model.slots()) - len(baseline.model.slots()) + sum(float(r) > 0 for r in extended.ratios)
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


def _spectral_fit(power: np.ndarray, variance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Level and log likelihood of each shape of a spectrum, of which a part of the frequencies are lines.

    Normal coefficients of variance level · shape, or LINE times that where there is a line; by that algorithm which
    weighs each frequency by how likely it has none (Dempster, Laird, Rubin 1977).
    """
    part = power / variance
    level, best = part.mean(1), np.full(len(part), -np.inf)
    levels = level
    for lines in LINES:
        level = np.maximum(np.median(part, axis=1) / CHI_MEDIAN, 1e-300)
        for _ in range(TURNS):
            each = part / level[:, None]
            odds = lines / (1.0 - lines) / np.sqrt(LINE) * np.exp(np.minimum(0.5 * each * (1.0 - 1.0 / LINE), 700.0))
            quiet = 1.0 / (1.0 + odds)
            level = np.maximum(np.mean(part * (quiet + (1.0 - quiet) / LINE), axis=1), 1e-300)
        each = part / level[:, None]
        odds = lines / (1.0 - lines) / np.sqrt(LINE) * np.exp(np.minimum(0.5 * each * (1.0 - 1.0 / LINE), 700.0))
        value = np.sum(np.log1p(odds) - 0.5 * each, axis=1) + len(power) * np.log(1.0 - lines)
        value -= 0.5 * (np.log(variance).sum(1) + len(power) * np.log(level))
        levels = np.where(value > best, level, levels)
        best = np.maximum(best, value)
    return levels, best


def _stretch(record: Record) -> np.ndarray:
    """Number of the even stretch without restart or gap that each row is of."""
    sampling = record.sampling
    opens = np.asarray(sampling.restart) | (np.asarray(sampling.interval) > 1.5 * record.interval)
    return np.cumsum(opens[: record.rows])


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
