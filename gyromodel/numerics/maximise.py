"""Newton's method on many small problems side by side, for functions that are cheap only in batches."""

from __future__ import annotations

from collections.abc import Callable
from itertools import combinations

import numpy as np

# Step of finite differences, longest Newton step of a parameter, and gain that is no longer worth a step.
STEP, LONGEST, WORTH = 0.02, 2.0, 1e-3
ITERATIONS = 40
# Where the function is undefined it counts as this much lower.
UNDEFINED = 1e6
# Least curvature in any direction: below it a parameter is out of sight, and steps are long.
FLAT = 1e-2


def maximise(
    function: Callable[[np.ndarray], np.ndarray], start: np.ndarray, free: np.ndarray, low: np.ndarray, high: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Local maxima over the free parameters of each problem.

    Args:
        function: from points, shape (point, parameter), to their values, shape (point,); −inf where undefined.
        start: first guesses, shape (problem, parameter).
        free: which parameters may move, same shape; the others stay, also where they are −inf.
        low: lower bound of each parameter, shape (parameter,).
        high: upper bound of each parameter, shape (parameter,).

    Returns:
        The maxima, shape (problem, parameter), and their values, shape (problem,).
    """
    best, value = start.copy(), np.full(len(start), -np.inf)
    trial, move = start.copy(), np.zeros_like(start)
    active = np.ones(len(start), bool)
    for _ in range(ITERATIONS):
        which = np.flatnonzero(active)
        stencils = [_stencil(trial[k], free[k]) for k in which]
        values = np.split(function(np.concatenate(stencils)), np.cumsum([len(s) for s in stencils])[:-1])
        for k, v in zip(which, values, strict=True):
            if not v[0] > value[k]:  # too far: come back
                move[k] *= 0.25
                active[k] = np.abs(move[k]).max(initial=0.0) > 1e-6
                trial[k] = np.where(free[k], np.clip(best[k] + move[k], low, high), best[k])
                continue
            best[k], value[k] = trial[k], v[0]
            index = np.flatnonzero(free[k])
            gradient, curvature = _derivatives(v, len(index))
            # A parameter that pushes against its bound stays there.
            inside = ~(
                (best[k, index] <= low[index]) & (gradient < 0) | (best[k, index] >= high[index]) & (gradient > 0)
            )
            gradient, curvature = gradient[inside], curvature[np.ix_(inside, inside)]
            size, axes = np.linalg.eigh(curvature) if inside.any() else (np.zeros(0), np.zeros((0, 0)))
            step = axes @ ((axes.T @ gradient) / np.maximum(np.abs(size), FLAT))
            active[k] = bool(0.5 * gradient @ step > WORTH)
            move[k] = 0.0
            move[k, index[inside]] = step * min(1.0, LONGEST / max(np.abs(step).max(initial=0.0), 1e-300))
            trial[k] = np.where(free[k], np.clip(best[k] + move[k], low, high), best[k])
        if not active.any():
            break
    return best, value


def _stencil(x: np.ndarray, free: np.ndarray) -> np.ndarray:
    """The point, then each free parameter moved up and down, then pairs moved up."""
    index = np.flatnonzero(free)
    moves = np.zeros((1 + 2 * len(index) + len(index) * (len(index) - 1) // 2, len(x)))
    for j, i in enumerate(index):
        moves[1 + 2 * j, i], moves[2 + 2 * j, i] = STEP, -STEP
    for j, (a, b) in enumerate(combinations(index, 2)):
        moves[1 + 2 * len(index) + j, [a, b]] = STEP
    return x + moves


def _derivatives(v: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Gradient and negative Hessian from the values on a stencil."""
    v = np.maximum(v, v[0] - UNDEFINED)
    up, down, pairs = v[1 : 1 + 2 * count : 2], v[2 : 1 + 2 * count : 2], v[1 + 2 * count :]
    curvature = np.diag((2 * v[0] - up - down) / STEP**2)
    for value, (a, b) in zip(pairs, combinations(range(count), 2), strict=True):
        curvature[a, b] = curvature[b, a] = -(value - up[a] - up[b] + v[0]) / STEP**2
    return (up - down) / (2 * STEP), curvature
