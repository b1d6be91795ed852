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
# Part of a published frequency by which a test may differ from it: 0.16 Hz is 1.005 rad/s.
CLOSE = 0.02

Values = Float[np.ndarray, " *point"] | float


def limits_at(frequency: float) -> tuple[float, float] | None:
    """Limits of |M| (dB) and φ (deg) at a frequency, rad/s; none but at the four published ones, to 2 %."""
    near = np.flatnonzero(np.abs(frequency / FREQUENCIES - 1) < CLOSE)
    return (float(GAIN_LIMIT[near[0]]), float(PHASE_LIMIT[near[0]])) if len(near) else None


def judge_gain(low: Values, high: Values, limit: Values = GAIN_LIMIT) -> np.ndarray:
    """Whether |M| keeps to its limit.

    Args:
        low: lower end of an interval of M, dB; equal ends are a value taken for exact.
        high: upper end.
        limit: of |M|; by default the published ones at the frequencies of the last axis.
    """
    return _verdicts((low >= -limit) & (high <= limit), (low > limit) | (high < -limit))


def judge_phase(low: Values, high: Values, limit: Values = PHASE_LIMIT) -> np.ndarray:
    """Whether φ keeps above its limit.

    Args:
        low: lower end of an interval of the signed phase, deg. Of a phase without sign, minus the larger end.
        high: upper end. Of a phase without sign, the larger end.
        limit: of φ; by default the published ones at the frequencies of the last axis.
    """
    return _verdicts(low >= limit, high < limit)


def _verdicts(within: np.ndarray | bool, outside: np.ndarray | bool) -> np.ndarray:
    """An array of `Verdict`."""
    return np.where(within, "pass", np.where(outside, "fail", "cannot tell"))
