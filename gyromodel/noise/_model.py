"""White noise, flicker, random walk, Markov and quantisation noise relative to the white variance.

Conventions, two-sided rate PSD and Allan variance: white N² and N²/τ, flicker B²/(2πf) and (2 ln2/π)B², random walk
K²/(2πf)² and K²τ/3, Markov (q T)²/(1 + (2πf T)²) with variance q²T/2, quantisation (2πf)²Q²τ0 and 3Q²/τ².
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from gyromodel.declarations import NOISE
from gyromodel.numerics.state_space import MarkovSum

MARKOV_TIME = "noise_markov_time"
TELEGRAPH_TIMES = ("noise_telegraph_low", "noise_telegraph_high")
# Times that belong to a kind: its id, and what a model file calls them.
TIMES = {
    MARKOV_TIME: ("noise_markov", "time_constant"),
    TELEGRAPH_TIMES[0]: ("noise_telegraph", "time_low"),
    TELEGRAPH_TIMES[1]: ("noise_telegraph", "time_high"),
}
# What a model can state of its noise, by public id, and the units it is written in.
NOISE_UNITS = {
    name: NOISE[name].unit
    for name in (
        "noise_white",
        "noise_flicker",
        "noise_random_walk",
        "noise_markov",
        "noise_quantisation",
        "noise_telegraph",
    )
} | dict.fromkeys(TIMES, "s")

# The same of an angle, such as that of a platform's base.
ANGLE_NOISE_UNITS = {
    "noise_white": "deg/sqrt(Hz)",
    "noise_flicker": "deg",
    "noise_random_walk": "deg/sqrt(h)",
    "noise_markov": "deg/sqrt(h)",
    MARKOV_TIME: "s",
}


def noise_units(of: Literal["gyro", "platform"]) -> dict[str, str]:
    """Units of stated noise: of a gyro's rate, or of the angle of a platform's base."""
    return ANGLE_NOISE_UNITS if of == "platform" else NOISE_UNITS


# Up to this many samples (averaged test points, say) noise is taken as white: they cannot show its colour.
FEWEST_FOR_COLOUR = 40

# Markov terms that make up flicker; their time constants span from one sample to the record.
FLICKER_STATES = 6
# Markov noise has time constants from so many samples to this part of a record, and so many levels at this ratio.
SHORTEST, LONGEST = 3.0, 5.0
MARKOV_LEVELS, MARKOV_STEP = 8, 4.0


class NoiseRatios(NamedTuple):
    """Flicker B², random walk K²·(one sample interval) and Markov q²T/2, each over the white variance of a sample.

    A cell holds flicker or a Markov process of time constant T (s), never both. Quantisation is Q² over the square of a
    sample interval; none is another structure than zero, with a state less to filter.
    """

    flicker: Float[Array | np.ndarray, "*cell"]
    walk: Float[Array | np.ndarray, "*cell"]
    markov: Float[Array | np.ndarray, "*#cell"] = np.zeros(())
    constant: Float[Array | np.ndarray, "*#cell"] = np.zeros(())
    quantisation: Float[Array | np.ndarray, "*#cell"] | None = None

    def each(self) -> tuple[Any, ...]:
        """Those there are."""
        return tuple(ratio for ratio in self if ratio is not None)

    def take(self, index: int | np.ndarray) -> NoiseRatios:
        """Some cells."""
        return NoiseRatios(*(x[index] for x in np.broadcast_arrays(*self.each())))

    def longest(self, span: float) -> np.ndarray:
        """The longest time constant of each cell: the span of the record that flicker needs, or T."""
        return np.where(np.asarray(self.markov) > 0, self.constant, span)


class NoiseGrid(NamedTuple):
    """Noise cells, their prior weights, and the time scales they are built on (s)."""

    ratios: NoiseRatios
    log_prior: np.ndarray
    interval: float
    span: float


def markov_sum(ratios: NoiseRatios, interval: float | Array, longest: float | Array) -> MarkovSum:
    """Noise cells of one longest time constant as a sum of Markov processes: the random walk first, that one last.

    Markov terms of equal variance B² ln(ρ)/π whose time constants stand at ratio ρ add up to B²/(2πf).
    """
    steps = jnp.arange(FLICKER_STATES) / (FLICKER_STATES - 1)
    constants = interval * (longest / interval) ** steps
    spacing = jnp.log(longest / interval) / (FLICKER_STATES - 1)
    each = ratios.flicker * spacing / jnp.pi
    decay = jnp.concatenate([jnp.zeros(1), 1.0 / constants])
    variance = jnp.stack([ratios.walk / interval, *[each] * (FLICKER_STATES - 1), each + ratios.markov])
    if ratios.quantisation is None:
        return MarkovSum(decay, variance)
    return MarkovSum(decay, variance, ratios.quantisation * interval**2 * jnp.ones_like(each), interval)


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


def markov_cells(samples: int, interval: float, span: float) -> NoiseRatios:
    """Markov noise beside white, from time constants of a few samples to a part of the record, as `noise_grid`."""
    if samples <= FEWEST_FOR_COLOUR:
        none = np.zeros(0)
        return NoiseRatios(none, none, none, none)
    constants = np.geomspace(SHORTEST * interval, span / LONGEST, max(int(np.log(span / interval)), 2))
    # At a time constant of so many samples, from half of the white variance that is left in their mean.
    level = np.geomspace(0.5, 0.5 * MARKOV_STEP ** (MARKOV_LEVELS - 1), MARKOV_LEVELS)
    markov = (level * interval / constants[:, None]).ravel()
    none = np.zeros_like(markov)
    return NoiseRatios(none, none, markov, np.repeat(constants, MARKOV_LEVELS))


def _levels(samples: int, power: float) -> int:
    return int(np.ceil(power * np.log(samples) / np.log(5.0))) + 2


def _half_on_absent(count: int) -> np.ndarray:
    return np.concatenate([[0.5], np.full(count - 1, 0.5 / (count - 1))])


def coefficients(ratios: NoiseRatios, white_variance: Any, interval: float) -> dict[str, Any]:
    """N, B, K as input rates (rad/s/√Hz, rad/s, rad/s/√s) from ratios and white variances of a sample.

    Of cells with Markov noise N, q and T, in rad/s/√Hz, rad/s/√s and s. With quantisation also Q, in rad.
    """
    white = {"noise_white": np.sqrt(white_variance * interval)}
    if ratios.quantisation is not None:
        white["noise_quantisation"] = np.sqrt(np.asarray(ratios.quantisation) * white_variance) * interval
    markov, constant = np.asarray(ratios.markov), np.asarray(ratios.constant)
    if np.any(markov > 0):
        q = np.sqrt(2.0 * markov * white_variance / constant)
        return white | {"noise_markov": q, MARKOV_TIME: constant}
    return white | {
        "noise_flicker": np.sqrt(np.asarray(ratios.flicker) * white_variance),
        "noise_random_walk": np.sqrt(np.asarray(ratios.walk) * white_variance / interval),
    }


def check_stated(noise: Mapping[str, Any]) -> None:
    """Refuse (ValueError) a statement without white noise, or of Markov noise without its time or beside flicker."""
    if float(noise.get("noise_white", 0.0)) <= 0:
        raise ValueError("noise needs a noise_white above zero")
    if float(noise.get("noise_markov", 0.0)):
        if float(noise.get("noise_flicker", 0.0)):
            raise ValueError("noise_flicker and noise_markov cannot stand side by side; state one of them")
        if float(noise.get(MARKOV_TIME, 0.0)) <= 0:
            raise ValueError("noise_markov needs a time_constant above zero")
    if "noise_telegraph" in noise:
        if float(noise["noise_telegraph"]) <= 0:
            raise ValueError("noise_telegraph needs a size above zero")
        if float(noise.get("noise_flicker", 0.0)) or float(noise.get("noise_markov", 0.0)):
            raise ValueError("noise_telegraph cannot stand beside noise_flicker or noise_markov; state one of them")
        if not all(float(noise.get(name, 0.0)) > 0 for name in TELEGRAPH_TIMES):
            raise ValueError("noise_telegraph needs a time_low and a time_high above zero")


def stated_ratios(noise: Mapping[str, Any], interval: float) -> NoiseRatios:
    """The cell of stated coefficients (internal units): the inverse of `coefficients`, after `check_stated`.

    Hops between two levels have the variance and the correlation of a Markov process, which stands for them.
    """
    check_stated(noise)
    stated = {name: float(value) for name, value in noise.items()}
    variance = stated["noise_white"] ** 2 / interval
    flicker, walk = stated.get("noise_flicker", 0.0), stated.get("noise_random_walk", 0.0)
    q, constant = stated.get("noise_markov", 0.0), stated.get(MARKOV_TIME, 0.0)
    level = q**2 * constant / 2.0
    if size := stated.get("noise_telegraph", 0.0):
        low, high = (stated[name] for name in TELEGRAPH_TIMES)
        level, constant = size**2 * low * high / (low + high) ** 2, low * high / (low + high)
    ratios = (flicker**2 / variance, walk**2 * interval / variance, level / variance, constant)
    angle = stated.get("noise_quantisation", 0.0)
    return NoiseRatios(*(jnp.asarray(r) for r in (*ratios, *[angle**2 / interval**2 / variance] * (angle > 0))))
