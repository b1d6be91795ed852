"""Noise: part of a model (white, flicker, random walk), deviations over averaging time, kinds and sizes in a record."""

from gyromodel.noise._deviation import Deviation, Estimator, deviation, with_gaps
from gyromodel.noise._identify import IdentifiedNoise, Line, identify_noise
from gyromodel.noise._likelihood import CellFit, from_grams, restricted_likelihood
from gyromodel.noise._model import NOISE_UNITS, NoiseGrid, NoiseRatios, coefficients, markov_sum, noise_grid
from gyromodel.noise._terms import NoiseTerm

__all__ = [
    "NOISE_UNITS",
    "CellFit",
    "Deviation",
    "Estimator",
    "IdentifiedNoise",
    "Line",
    "NoiseGrid",
    "NoiseRatios",
    "NoiseTerm",
    "coefficients",
    "deviation",
    "from_grams",
    "identify_noise",
    "markov_sum",
    "noise_grid",
    "restricted_likelihood",
    "with_gaps",
]
