"""Amplitude and phase of an angular vibration: base angle against table angle.

Source of the correlation method: Zhang, Jiang, Jing and Wang, doi:10.19306/j.cnki.2095-8110.2022.06.009, 2022,
equations (8)-(29); x is the base angle and y the table angle. Beside it, the maximum-likelihood fit of both sines.
"""

from __future__ import annotations

import math
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

# dB of a natural logarithm, and what rounding may lift a correlation coefficient above one.
DECIBELS = 20 / math.log(10.0)
ROUNDING = 1e-12
# Frequencies tried on either side of the nominal one, in quarters of 2π over the length of the record.
TRIED = 16
# Gauss-Newton steps of the frequency: each leaves of its error about the noise over the amplitude.
STEPS = 12


class PublishedResponse(NamedTuple):
    """Amplitude ratio (dB) and phase (deg) from correlations; the phase has no sign."""

    gain: Float[Array, "*record"]
    phase: Float[Array, "*record"]


@jax.jit
def published_response(
    base: Float[Array, "*record sample"],
    table: Float[Array, "*record sample"],
    base_variance: Float[Array, "*#record"] | float = 0.0,
    table_variance: Float[Array, "*#record"] | float = 0.0,
) -> PublishedResponse:
    """M = 20 log₁₀(A/B) and φ = arccos[2 R_xy(0)/(A B)], A = √(2[R_x(0) − σ_x²]), B likewise: equations (8)-(29).

    The samples cover whole periods and have no mean. With σ² left at zero, noise makes of φ = 0 the phase
    √(2 [σ_x²/A² + σ_y²/B²]); with σ² given, half of the records at φ = 0 have no arccos.

    Args:
        base: base angle, any unit.
        table: table angle, the same unit.
        base_variance: σ_x² of its noise.
        table_variance: σ_y².

    Returns:
        NaN where the noise variance is larger than R(0), and where the arccos has no value.
    """
    a, b = (jnp.sqrt(2 * (jnp.mean(x**2, -1) - v)) for x, v in ((base, base_variance), (table, table_variance)))
    cosine = 2 * jnp.mean(base * table, -1) / (a * b)
    phase = jnp.where(jnp.abs(cosine) <= 1 + ROUNDING, jnp.arccos(jnp.clip(cosine, -1.0, 1.0)), jnp.nan)
    return PublishedResponse(DECIBELS * jnp.log(a / b), jnp.rad2deg(phase))


class SineFit(NamedTuple):
    """What two sines of one frequency say of each other.

    gain: 20 log₁₀(A/B), dB; phase: of the base angle before the table angle, deg, negative where the base is late;
    covariance: of gain and phase; frequency: rad/s, with its standard error, zero where it was given; amplitude and
    noise: of base and table, in their unit; degrees_of_freedom: behind each noise.
    """

    gain: Float[Array, ""]
    phase: Float[Array, ""]
    covariance: Float[Array, "2 2"]
    frequency: Float[Array, ""]
    frequency_std: Float[Array, ""]
    amplitude: Float[Array, " 2"]
    noise: Float[Array, " 2"]
    degrees_of_freedom: Float[Array, ""]

    @property
    def gain_std(self) -> Float[Array, "*record"]:
        """Standard error of the gain, dB."""
        return jnp.sqrt(self.covariance[..., 0, 0])

    @property
    def phase_std(self) -> Float[Array, "*record"]:
        """Standard error of the phase, deg."""
        return jnp.sqrt(self.covariance[..., 1, 1])


@partial(jax.jit, static_argnames=("known", "degree", "harmonics"))
def fit_sines(
    time: Float[Array, " sample"],
    base: Float[Array, " sample"],
    table: Float[Array, " sample"],
    frequency: Float[Array, ""] | float,
    known: bool = True,
    degree: int = 1,
    harmonics: int = 1,
) -> SineFit:
    """Maximum-likelihood fit of x = A sin(ωt + θ + φ) and y = B sin(ωt + θ), each with a drift and overtones.

    White normal noise of unknown size in each signal. With ω given that is least squares of each signal by itself; else
    ω is that of both, and minimises ln Σ residual_x² + ln Σ residual_y².

    Args:
        time: s; samples may be missing.
        base: base angle, any unit.
        table: table angle, the same unit.
        frequency: ω, rad/s; where it is not known, what the table was set to, within 8π over the length of the record.
        known: whether ω is exact.
        degree: of the polynomial that each signal drifts by.
        harmonics: sines fitted, the fundamental included.

    Returns:
        Standard errors to first order; a record has to be longer than a period.
    """
    middle, half = 0.5 * (time[0] + time[-1]), 0.5 * (time[-1] - time[0])
    # Phases in the middle of the record are least correlated with the frequency; their difference is the same anywhere.
    time = time - middle
    signals = jnp.stack([base, table], axis=1)
    drift = jnp.stack([(time / half) ** k for k in range(degree + 1)], axis=1)
    freedom = len(time) - 2.0 * harmonics - degree - 1 - (0.0 if known else 0.5)
    solve = partial(_project, time, drift, signals)
    w = jnp.asarray(frequency, float)
    if not known:
        tried = w + jnp.arange(-TRIED, TRIED + 1) * jnp.pi / (4 * half)
        # Without overtones, whose presence would let a fraction of ω pass for it.
        costs = jax.lax.map(lambda w: jnp.sum(jnp.log(solve(1, w).squares)), tried)
        w = tried[jnp.nanargmin(jnp.where(tried > jnp.pi / (4 * half), costs, jnp.nan))]
        w = jax.lax.fori_loop(0, STEPS, lambda _, w: w + solve(harmonics, w).step, w)
    part = solve(harmonics, w)
    noise = jnp.sqrt(part.squares / freedom)
    variance = 0.0 if known else 1 / jnp.sum(part.slopes / noise**2)

    # Gain and phase by sine and cosine of both signals, and these by ω.
    sine, cosine = part.fundamental
    size = sine**2 + cosine**2
    signs = jnp.array([1.0, -1.0])
    rows = jnp.stack([jnp.stack([sine, cosine]) / size, jnp.stack([-cosine, sine]) / size]) * signs
    units = jnp.array([DECIBELS, 180 / jnp.pi])
    by_frequency = jnp.einsum("ocs,cs->o", rows, part.by_frequency)
    covariance = jnp.einsum("ocs,cd,pds,s->op", rows, part.inverse, rows, noise**2)
    covariance = (covariance + variance * jnp.outer(by_frequency, by_frequency)) * jnp.outer(units, units)

    # x = a sin + b cos = A sin(ωt + atan2(b, a)).
    phases = jnp.arctan2(cosine, sine)
    phase = jnp.mod(phases[0] - phases[1] + jnp.pi, 2 * jnp.pi) - jnp.pi
    gain = 0.5 * DECIBELS * jnp.log(size[0] / size[1])
    amplitude, freedom = jnp.sqrt(size), jnp.asarray(freedom)
    return SineFit(gain, jnp.rad2deg(phase), covariance, w, jnp.sqrt(variance + 0 * w), amplitude, noise, freedom)


class _Projected(NamedTuple):
    """Least squares at one frequency: sine and cosine of both signals, their derivative by ω, and a step of ω."""

    fundamental: jax.Array
    inverse: jax.Array
    by_frequency: jax.Array
    squares: jax.Array
    slopes: jax.Array
    step: jax.Array


def _project(time: jax.Array, drift: jax.Array, signals: jax.Array, harmonics: int, w: jax.Array) -> _Projected:
    """Variable projection (Golub and Pereyra 1973, in Kaufman's form) of both signals."""
    orders = jnp.arange(1, harmonics + 1)
    angles = w * time[:, None] * orders
    columns = jnp.concatenate([jnp.sin(angles[:, :1]), jnp.cos(angles[:, :1]), drift], axis=1)
    columns = jnp.concatenate([columns, jnp.sin(angles[:, 1:]), jnp.cos(angles[:, 1:])], axis=1)
    q, inverse = _orthonormal(columns)
    coefficients = inverse @ (q.T @ signals)
    residual = signals - q @ (q.T @ signals)
    sines, cosines = (jnp.concatenate([coefficients[k : k + 1], more]) for k, more in
                      enumerate(jnp.split(coefficients[2 + drift.shape[1] :], 2)))  # fmt: skip
    # ∂x/∂ω of a sin kωt + b cos kωt, and what the columns leave of it.
    turned = (orders * time[:, None])[:, :, None]
    moved = jnp.sum(turned * (jnp.cos(angles)[:, :, None] * sines - jnp.sin(angles)[:, :, None] * cosines), axis=1)
    left = moved - q @ (q.T @ moved)
    squares, slopes = jnp.sum(residual**2, axis=0), jnp.sum(left**2, axis=0)
    # Each signal counts by its own noise.
    step = jnp.sum(jnp.sum(left * residual, axis=0) / squares) / jnp.sum(slopes / squares)
    by_frequency = -(inverse @ (q.T @ moved))[:2]
    return _Projected(coefficients[:2], (inverse @ inverse.T)[:2, :2], by_frequency, squares, slopes, step)


def _orthonormal(columns: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Q = columns · T and T, triangular: Gram-Schmidt, each column twice.

    Not by LAPACK, whose calls in a compiled loop over many records waited for one another for ever on two cores.
    """
    own = jnp.eye(columns.shape[1])

    # A loop, as columns written out one by one take seconds to compile.
    def add(k, found):
        q, t = found
        column, mine = columns[:, k], own[:, k]
        for _ in range(2):
            along = q.T @ column
            column, mine = column - q @ along, mine - t @ along
        norm = jnp.sqrt(column @ column)
        return q.at[:, k].set(column / norm), t.at[:, k].set(mine / norm)

    return jax.lax.fori_loop(0, len(own), add, (jnp.zeros_like(columns), jnp.zeros_like(own)))
