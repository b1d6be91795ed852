"""The NIST reference problems of nonlinear regression: models as their files state them, and certified values.

Source: the data files themselves (NIST/ITL StRD), one problem each.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

# Lanczos1 was made without errors: its residuals are below double precision, and so are its certified deviations.
WITHOUT_ERRORS = "Lanczos1"


@dataclass(frozen=True)
class Problem:
    """One problem: model, both starts, certified parameters and their standard deviations."""

    name: str
    model: Callable[[Any, Any], Any]
    starts: tuple[np.ndarray, np.ndarray]
    certified: np.ndarray
    deviations: np.ndarray
    response: np.ndarray
    predictor: np.ndarray


def read(path: Path) -> Problem:
    """A problem from its file; a response in logarithms stays one."""
    lines = path.read_text(encoding="ascii").splitlines()
    stated = [line.split("=")[1].split()[:4] for line in lines[40:60] if re.match(r"\s*b\d+\s*=", line)]
    numbers = np.array(stated, float)
    data = np.array([[float(v) for v in line.split()] for line in lines[60:] if line.strip()])
    response = np.log(data[:, 0]) if path.stem == "Nelson" else data[:, 0]
    predictor = data[:, 1:] if data.shape[1] > 2 else data[:, 1]
    return Problem(
        path.stem, MODELS[path.stem], (numbers[:, 0], numbers[:, 1]), numbers[:, 2], numbers[:, 3], response, predictor
    )


def digits(found: np.ndarray, certified: np.ndarray) -> float:
    """Certified digits that agree: least log relative error over the entries, at most 11."""
    error = np.abs(found - certified) / np.abs(certified)
    return float(np.min(np.clip(-np.log10(np.maximum(error, 1e-16)), 0.0, 11.0)))


def _bennett(b, x):
    return b[0] * (b[1] + x) ** (-1 / b[2])


def _rise(b, x):
    return b[0] * (1 - jnp.exp(-b[1] * x))


def _chwirut(b, x):
    return jnp.exp(-b[0] * x) / (b[1] + b[2] * x)


def _power(b, x):
    return b[0] * x ** b[1]


def _enso(b, x):
    year = 2 * jnp.pi * x / 12
    second, third = 2 * jnp.pi * x / b[3], 2 * jnp.pi * x / b[6]
    return (
        b[0]
        + b[1] * jnp.cos(year)
        + b[2] * jnp.sin(year)
        + b[4] * jnp.cos(second)
        + b[5] * jnp.sin(second)
        + b[7] * jnp.cos(third)
        + b[8] * jnp.sin(third)
    )


def _eckerle(b, x):
    return b[0] / b[1] * jnp.exp(-0.5 * ((x - b[2]) / b[1]) ** 2)


def _gauss(b, x):
    bell = b[2] * jnp.exp(-((x - b[3]) ** 2) / b[4] ** 2) + b[5] * jnp.exp(-((x - b[6]) ** 2) / b[7] ** 2)
    return b[0] * jnp.exp(-b[1] * x) + bell


def _cubic_ratio(b, x):
    return (b[0] + b[1] * x + b[2] * x**2 + b[3] * x**3) / (1 + b[4] * x + b[5] * x**2 + b[6] * x**3)


def _square_ratio(b, x):
    return (b[0] + b[1] * x + b[2] * x**2) / (1 + b[3] * x + b[4] * x**2)


def _lanczos(b, x):
    return b[0] * jnp.exp(-b[1] * x) + b[2] * jnp.exp(-b[3] * x) + b[4] * jnp.exp(-b[5] * x)


def _mgh09(b, x):
    return b[0] * (x**2 + x * b[1]) / (x**2 + x * b[2] + b[3])


def _mgh10(b, x):
    return b[0] * jnp.exp(b[1] / (x + b[2]))


def _mgh17(b, x):
    return b[0] + b[1] * jnp.exp(-x * b[3]) + b[2] * jnp.exp(-x * b[4])


def _misra_b(b, x):
    return b[0] * (1 - (1 + b[1] * x / 2) ** -2)


def _misra_c(b, x):
    return b[0] * (1 - (1 + 2 * b[1] * x) ** -0.5)


def _misra_d(b, x):
    return b[0] * b[1] * x / (1 + b[1] * x)


def _nelson(b, x):
    return b[0] - b[1] * x[:, 0] * jnp.exp(-b[2] * x[:, 1])


def _rat42(b, x):
    return b[0] / (1 + jnp.exp(b[1] - b[2] * x))


def _rat43(b, x):
    return b[0] / (1 + jnp.exp(b[1] - b[2] * x)) ** (1 / b[3])


def _roszman(b, x):
    return b[0] - b[1] * x - jnp.arctan(b[2] / (x - b[3])) / jnp.pi


MODELS = {
    "Bennett5": _bennett, "BoxBOD": _rise, "Chwirut1": _chwirut, "Chwirut2": _chwirut, "DanWood": _power,
    "ENSO": _enso, "Eckerle4": _eckerle, "Gauss1": _gauss, "Gauss2": _gauss, "Gauss3": _gauss, "Hahn1": _cubic_ratio,
    "Kirby2": _square_ratio, "Lanczos1": _lanczos, "Lanczos2": _lanczos, "Lanczos3": _lanczos, "MGH09": _mgh09,
    "MGH10": _mgh10, "MGH17": _mgh17, "Misra1a": _rise, "Misra1b": _misra_b, "Misra1c": _misra_c, "Misra1d": _misra_d,
    "Nelson": _nelson, "Rat42": _rat42, "Rat43": _rat43, "Roszman1": _roszman, "Thurber": _cubic_ratio,
}  # fmt: skip
