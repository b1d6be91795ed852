"""White noise, flicker and random walk relative to the white variance.

Conventions, two-sided rate PSD and Allan variance: white N² and N²/τ, flicker B²/(2πf) and (2 ln2/π)B², random walk
K²/(2πf)² and K²τ/3.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from gyromodel.numerics.state_space import MarkovSum

# Public noise ids and the units they are written in.
NOISE_UNITS = {"noise_white": "deg/sqrt(h)", "noise_flicker": "deg/h", "noise_random_walk": "deg/h/sqrt(h)"}

# Up to this many samples (averaged test points, say) noise is taken as white: they cannot show its colour.
FEWEST_FOR_COLOUR = 40

# Markov terms that make up flicker; their time constants span from one sample to the record.
FLICKER_STATES = 6


class NoiseRatios(NamedTuple):
    """Flicker B² and random walk K²·(one sample interval), each over the white variance of a sample."""

    flicker: Float[Array | np.ndarray, "*cell"]
    walk: Float[Array | np.ndarray, "*cell"]


class NoiseGrid(NamedTuple):
    """Noise cells, their prior weights, and the time scales they are built on (s)."""

    ratios: NoiseRatios
    log_prior: np.ndarray
    interval: float
    span: float


def markov_sum(ratios: NoiseRatios, interval: float | Array, span: float | Array) -> MarkovSum:
    """Noise cells as a sum of Markov processes: the random walk first, then flicker.

    Markov terms of equal variance B² ln(ρ)/π whose time constants stand at ratio ρ add up to B²/(2πf).
    """
    steps = jnp.arange(FLICKER_STATES) / (FLICKER_STATES - 1)
    constants = interval * (span / interval) ** steps
    spacing = jnp.log(span / interval) / (FLICKER_STATES - 1)
    each = ratios.flicker * spacing / jnp.pi
    decay = jnp.concatenate([jnp.zeros(1), 1.0 / constants])
    return MarkovSum(decay, jnp.stack([ratios.walk / interval, *[each] * FLICKER_STATES]))


def noise_grid(samples: int, interval: float, span: float) -> NoiseGrid:
    """Cells from invisible to dominant, half an amplitude decade apart; half of each prior sits on "absent"."""
    if samples <= FEWEST_FOR_COLOUR:
        zero = jnp.zeros(1)
        return NoiseGrid(NoiseRatios(zero, zero), np.zeros(1), interval, max(span, 2 * interval))
    flicker = np.concatenate([[0.0], np.geomspace(0.3 / samples, 10.0, _levels(samples, 1.0))])
    walk = np.concatenate([[0.0], np.geomspace(3.0 / samples**2, 3.0, _levels(samples, 2.0))])
    f, w = (x.ravel() for x in np.meshgrid(flicker, walk, indexing="ij"))
    prior = np.outer(_half_on_absent(len(flicker)), _half_on_absent(len(walk))).ravel()
    return NoiseGrid(NoiseRatios(jnp.asarray(f), jnp.asarray(w)), np.log(prior), interval, max(span, 2 * interval))


def _levels(samples: int, power: float) -> int:
    return int(np.ceil(power * np.log(samples) / np.log(5.0))) + 2


def _half_on_absent(count: int) -> np.ndarray:
    return np.concatenate([[0.5], np.full(count - 1, 0.5 / (count - 1))])


def coefficients(ratios: NoiseRatios, white_variance: Any, interval: float) -> dict[str, Any]:
    """N, B, K as input rates (rad/s/√Hz, rad/s, rad/s/√s) from ratios and white variances of a sample."""
    return {
        "noise_white": np.sqrt(white_variance * interval),
        "noise_flicker": np.sqrt(np.asarray(ratios.flicker) * white_variance),
        "noise_random_walk": np.sqrt(np.asarray(ratios.walk) * white_variance / interval),
    }
