"""Figures of merit of a gyro at rest, as published: closed forms.

Source: 2021 thesis on a fiber-optic-gyro line-of-sight stabilisation system, chapter 3, equations (3-1)-(3-7). F is the
output at rest and S_n (or K) the nominal scale factor.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int


def bias(output: Float[np.ndarray, " sample"], scale_factor: float = 1.0) -> float:
    """B0 = mean(F)/S_n (3-1)."""
    return float(np.mean(output)) / scale_factor


def bias_stability(output: Float[np.ndarray, " sample"], scale_factor: float = 1.0) -> float:
    """Bs = (1/K) [Σ(F_i − mean F)²/(n − 1)]^½ (3-2)."""
    return float(np.std(output, ddof=1)) / scale_factor


def bias_repeatability(biases: Float[np.ndarray, " run"]) -> float:
    """Br = [Σ(B0_i − mean B0)²/(Q − 1)]^½ over Q runs (3-3)."""
    return float(np.std(biases, ddof=1))


def bias_temperature_sensitivity(
    biases: Float[np.ndarray, " point"], temperatures: Float[np.ndarray, " point"], room: int
) -> tuple[float, int]:
    """Bt = max_i |B0_i − B0_m|/|T_i − T_m|, m the point at room temperature (3-4), and the point that it comes from."""
    difference = np.abs(temperatures - temperatures[room])
    ratio = np.divide(np.abs(biases - biases[room]), difference, out=np.zeros(len(biases)), where=difference > 0)
    return float(ratio.max()), int(ratio.argmax())


def angle_random_walk(output: Float[np.ndarray, " sample"], bandwidth: float, scale_factor: float = 1.0) -> float:
    """ARW = RMS/√W about the mean (3-5)(3-6).

    Args:
        output: samples of F.
        bandwidth: W (Hz). With the two-sided 1/τ1 of samples that are means over τ1, ARW is the coefficient N of white
            noise; a one-sided bandwidth 1/(2τ1) gives √2 N.
        scale_factor: K.
    """
    return bias_stability(output, scale_factor) / float(np.sqrt(bandwidth))


def random_walk_coefficients(
    times: Float[np.ndarray, " time"], squares: Float[np.ndarray, " time"]
) -> Float[np.ndarray, " coefficient"]:
    """a0, a1, a2 of Bs²(τ) = a0 + a1/τ + a2/τ² by least squares; RWC = √a1 (3-7)."""
    return np.linalg.lstsq(powers(times), squares, rcond=None)[0]


def stability_squares(
    rate: Float[np.ndarray, "*batch sample"], lengths: Int[np.ndarray, " time"]
) -> Float[np.ndarray, "*batch time"]:
    """Bs²(τ): the variance (3-2) of means.

    Args:
        rate: of a gyro at rest.
        lengths: of the means, in samples.

    Returns:
        In the square of the rate's unit.
    """
    found = []
    for k in lengths:
        whole = rate.shape[-1] // k * k
        means = rate[..., :whole].reshape(*rate.shape[:-1], -1, k).mean(axis=-1)
        found.append(means.var(axis=-1, ddof=1))
    return np.stack(found, axis=-1)


def powers(times: np.ndarray) -> np.ndarray:
    return np.stack([np.ones(len(times)), 1.0 / times, 1.0 / times**2], axis=1)
