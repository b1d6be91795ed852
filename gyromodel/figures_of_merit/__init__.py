"""Figures of merit of a gyro at rest as published, each with a standard uncertainty, beside its modern counterpart."""

from gyromodel.figures_of_merit._published import (
    angle_random_walk,
    bias,
    bias_repeatability,
    bias_stability,
    bias_temperature_sensitivity,
    random_walk_coefficients,
    stability_squares,
)
from gyromodel.figures_of_merit._runs import Figure, FiguresOfMerit, figures_of_merit

__all__ = [
    "Figure",
    "FiguresOfMerit",
    "angle_random_walk",
    "bias",
    "bias_repeatability",
    "bias_stability",
    "bias_temperature_sensitivity",
    "figures_of_merit",
    "random_walk_coefficients",
    "stability_squares",
]
