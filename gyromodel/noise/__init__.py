"""Noise as part of the model: white, flicker and random walk as state-space blocks, and their restricted likelihood."""

from gyromodel.noise._deviation import Deviation, Estimator, deviation
from gyromodel.noise._identify import IdentifiedNoise, Line, NoiseTerm, identify_noise, with_gaps
from gyromodel.noise._likelihood import CellFit, from_grams, restricted_likelihood
from gyromodel.noise._model import NOISE_UNITS, NoiseGrid, NoiseRatios, coefficients, markov_sum, noise_grid

__all__ = [
    "NOISE_UNITS",
    "CellFit",
    "Deviation",
    "Estimator",
    "NoiseGrid",
    "NoiseRatios",
    "coefficients",
    "deviation",
    "from_grams",
    "markov_sum",
    "noise_grid",
    "restricted_likelihood",
]
