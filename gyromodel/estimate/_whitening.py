"""The whitening filter of a noise cell on a record."""

from __future__ import annotations

import jax
import numpy as np

from gyromodel.noise import NoiseRatios, markov_sum
from gyromodel.numerics.state_space import Filter, build_filter, whiten
from gyromodel.signals import Record


@jax.jit
def make_filter(ratios: NoiseRatios, interval, longest, sampling) -> Filter:
    """The whitening filter of noise cells of one longest time constant."""
    return build_filter(markov_sum(ratios, interval, longest), sampling)


def filter_of(record: Record, ratios: NoiseRatios) -> Filter:
    """The whitening filter of one noise cell on a record."""
    ratios = NoiseRatios(*(np.asarray(r, float) for r in ratios.each()))
    return make_filter(ratios, record.interval, float(ratios.longest(record.span)), record.sampling)


whiten_columns = jax.jit(whiten)


def pad_columns(columns, step: int = 8):
    """Zero columns up to a multiple of `step`, so that compiled shapes recur."""
    return np.pad(columns, ((0, 0), (0, -columns.shape[1] % step)))
