"""Noise: part of a model (white, flicker or Markov, random walk), deviations over averaging time, kinds and sizes in
a record.
"""

from gyromodel.noise._deviation import Deviation, Estimator, deviation, usual_interval, with_gaps
from gyromodel.noise._identify import IdentifiedNoise, Line, identify_noise
from gyromodel.noise._likelihood import CellFit, from_grams, gram_by_cell, restricted_likelihood
from gyromodel.noise._model import (
    MARKOV_TIME,
    NOISE_UNITS,
    TELEGRAPH_TIMES,
    TIMES,
    NoiseGrid,
    NoiseRatios,
    check_stated,
    coefficients,
    markov_cells,
    markov_sum,
    noise_grid,
    noise_units,
    stated_ratios,
)
from gyromodel.noise._terms import NoiseTerm

__all__ = [
    "MARKOV_TIME",
    "NOISE_UNITS",
    "TELEGRAPH_TIMES",
    "TIMES",
    "CellFit",
    "Deviation",
    "Estimator",
    "IdentifiedNoise",
    "Line",
    "NoiseGrid",
    "NoiseRatios",
    "NoiseTerm",
    "check_stated",
    "coefficients",
    "deviation",
    "from_grams",
    "gram_by_cell",
    "identify_noise",
    "markov_cells",
    "markov_sum",
    "noise_grid",
    "noise_units",
    "restricted_likelihood",
    "stated_ratios",
    "usual_interval",
    "with_gaps",
]
