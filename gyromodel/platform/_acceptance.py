"""The published angular vibration test and its design limits, and whether a response is within them.

Source: Zhang, Jiang, Jing and Wang, doi:10.19306/j.cnki.2095-8110.2022.06.009, 2022, table 1: amplitude 0.15°.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from jaxtyping import Float

Verdict = Literal["pass", "fail", "cannot tell"]

AXES = ("X", "Y", "Z")
# rad/s
FREQUENCIES = np.array([1.0, 10.0, 20.0, 30.0])
# M (dB) and φ (deg) as printed, one row an axis. The φ come out of an arccos: they have no sign.
PRINTED_GAIN = np.array([[0.02, 0.03, 0.04, 0.10], [0.02, 0.05, 0.07, 0.10], [0.03, 0.01, -0.06, -0.03]])
PRINTED_PHASE = np.array([[0.02, 0.72, 1.93, 2.82], [0.06, 1.24, 2.19, 5.45], [0.45, 1.29, 1.84, 4.48]])
# |M| ≤ and φ ≥, at each frequency.
GAIN_LIMIT = np.array([0.1, 0.1, 0.1, 0.2])
PHASE_LIMIT = np.array([-0.5, -1.5, -2.5, -10.0])


def judge_gain(low: Float[np.ndarray, " *point"], high: Float[np.ndarray, " *point"]) -> np.ndarray:
    """Whether |M| keeps to its limit, at each frequency of the last axis.

    Args:
        low: lower end of an interval of M, dB; equal ends are a value taken for exact.
        high: upper end.
    """
    return _verdicts((low >= -GAIN_LIMIT) & (high <= GAIN_LIMIT), (low > GAIN_LIMIT) | (high < -GAIN_LIMIT))


def judge_phase(low: Float[np.ndarray, " *point"], high: Float[np.ndarray, " *point"]) -> np.ndarray:
    """Whether φ keeps above its limit, at each frequency of the last axis.

    Args:
        low: lower end of an interval of the signed phase, deg. Of a phase without sign, minus the larger end.
        high: upper end. Of a phase without sign, the larger end.
    """
    return _verdicts(low >= PHASE_LIMIT, high < PHASE_LIMIT)


def _verdicts(within: np.ndarray, outside: np.ndarray) -> np.ndarray:
    """An array of `Verdict`."""
    return np.where(within, "pass", np.where(outside, "fail", "cannot tell"))
