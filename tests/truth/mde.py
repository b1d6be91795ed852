"""Minimal detectable sizes from a dense oracle that knows the noise.

Whiten with V = L L^T, project the baseline's columns out, and the norm lambda of what is left of an effect decides
its power. An effect is at its MDE when a test of all its coefficients, at all its shapes, finds it in 80 % of campaigns
at 1 %/20 false alarms: lambda = 4.3 for one coefficient and no shape, 6.1 for a line of any frequency.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from scipy.linalg import cholesky, solve_triangular
from scipy.optimize import root_scalar
from scipy.stats import chi2, ncx2

from .designs import Design
from .effects import UNKNOWN, error
from .motion import BRACKETS, SMALL
from .noise import Noise
from .other_designs import OTHER_BRACKETS, OTHER_SMALL

Array = np.ndarray
FALSE_ALARMS, POWER = 0.01 / 20, 0.8
# Coefficients of an effect, and to how many independent trials the search over its shapes comes (`trials`).
TESTED = dict.fromkeys(UNKNOWN, (1, 100)) | {
    "scale_nonlinearity": (4, 1),
    "scale_temperature_curve": (1, 5),
    "bias_temperature_curve": (1, 5),
    "bias_thermal_hysteresis": (1, 3),
    "rate_hysteresis": (1, 3),
    "bias_warmup": (1, 3),
    "bias_step": (1, 100),
    "bias_periodic": (2, 700),
    "bias_turn_on": (5, 1),
    "bias_readout_code": (16, 1),
    "bias_acceleration_squared": (5, 1),
    "misalignment": (2, 1),
    "table_tilt": (2, 1),
    "table_harmonic": (2, 4),
    "time_delay": (1, 2),
    "bandwidth": (1, 2),
    "scale_spline": (8, 2),
    "saturation": (1, 5),
    "lock_in": (1, 3),
    "torquer_scale": (3, 1),
}


def parts(effect: str | None) -> tuple[str, ...]:
    """The effects that are hidden together: "a+b"."""
    return tuple(effect.split("+")) if effect else ()


def baseline(design: Design, effect: str | None = None) -> tuple[str, ...]:
    """Names in the model that the engine starts from: scale and bias, less what is hidden."""
    names = ("scale_factor", "bias") if design.rotates else ("bias",)
    return tuple(n for n in names if n not in parts(effect))


def simpler(effect: str | None) -> tuple[str, ...]:
    """The straight line that a curve must differ from for its name to be earned."""
    return (effect.removesuffix("_curve"),) if effect and effect.endswith("_curve") else ()


@dataclass(frozen=True)
class Oracle:
    """Whitening by the true covariance, and projection off the baseline."""

    cholesky: Array
    basis: Array  # orthonormal columns spanning the whitened baseline

    def reduce(self, signals: Array) -> Array:
        """Whitened, projected signals (columns)."""
        whitened = solve_triangular(self.cholesky, signals, lower=True)
        return whitened - self.basis @ (self.basis.T @ whitened)

    def norm(self, signal: Array) -> float:
        """lambda of one signal."""
        return float(np.linalg.norm(self.reduce(signal[:, None])))


def oracle(design: Design, noise: Noise, names: tuple[str, ...]) -> Oracle:
    """Oracle of a design under its true noise, with `names` as the baseline."""
    L = cholesky(noise.covariance(design), lower=True)
    if not names:
        return Oracle(L, np.zeros((len(L), 0)))
    columns = np.column_stack([error(name, design, 1.0, {}) for name in names])
    basis = np.linalg.qr(solve_triangular(L, columns, lower=True))[0]
    return Oracle(L, basis)


@cache
def target(effect: str) -> float:
    """lambda at the MDE."""
    coefficients, shapes = TESTED.get(effect, (1, 1))
    limit = chi2.isf(FALSE_ALARMS / shapes, coefficients)
    return root_scalar(lambda x: ncx2.sf(limit, coefficients, x**2) - POWER, bracket=(2.0, 12.0)).root


def amplitude(effect: str, design: Design, noise: Noise, shape: dict[str, Any], times_mde: float) -> float:
    """Amplitude that puts an effect at `times_mde` times its minimal detectable size, or as near as it can be."""
    judge = oracle(design, noise, baseline(design, effect) + simpler(effect))
    wanted = times_mde * target(effect)
    brackets = BRACKETS | OTHER_BRACKETS
    if effect == "scale_sagnac_sine":
        full = np.abs(design.true["rate"]).max()
        brackets = {effect: (1e-4 / full, 1.5 / full)}
    if effect in brackets:  # not linear in its amplitude

        def excess(log_size: float) -> float:
            return judge.norm(error(effect, design, np.exp(log_size), shape)) - wanted

        low, high = np.log(brackets[effect])
        if excess(high) < 0:
            return float(np.exp(high))  # as large as it can be
        return float(np.exp(root_scalar(excess, bracket=(low, high)).root))
    small = (SMALL | OTHER_SMALL).get(effect, 1.0)
    return wanted * small / judge.norm(error(effect, design, small, shape))
