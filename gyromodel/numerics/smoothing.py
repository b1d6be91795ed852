"""A noisy, unevenly sampled record and its derivative by a cubic smoothing spline, smooth by robust cross-validation.

Criterion: M. A. Lukas, Robust generalized cross-validation for choosing the regularization parameter, Inverse Problems
22 (2006).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.interpolate import CubicSpline
from scipy.linalg import get_lapack_funcs, solveh_banded
from scipy.optimize import bisect

# More knots than this cost time and resolve nothing of a thermal record.
MAXIMUM_KNOTS = 400
# Weight of plain cross-validation; the rest punishes curves that follow every point, as those of a quantised
# thermometer do, whose errors repeat from sample to sample.
ROBUSTNESS = 0.3
# Penalties searched, over the range in which they change the curve.
LEVELS = 120
# Evidence (nats) that columns beside a smooth curve need, and singular values that count for none, of the largest.
CORNERS, COLLINEAR = 10.0, 1e-6


class _Smooth(NamedTuple):
    """A smoothed record: the spline over (time − start)/unit, its penalty there, and rows averaged a knot."""

    spline: CubicSpline
    penalty: float
    start: float
    unit: float
    block: int


def smooth_derivative(
    time: Float[np.ndarray, " sample"], values: Float[np.ndarray, " sample"]
) -> Float[np.ndarray, " sample"]:
    """d(values)/d(time) of the smoothed record; long records are averaged to at most 400 points first."""
    n = len(time)
    if n < 6 or np.ptp(values) == 0:
        return np.gradient(values, time) if n > 1 else np.zeros(n)
    smooth = _smoothed(time, values)
    return np.asarray(smooth.spline.derivative()((time - smooth.start) / smooth.unit)) / smooth.unit


def smooth_values(
    time: Float[np.ndarray, " sample"], values: Float[np.ndarray, " sample"]
) -> Float[np.ndarray, " sample"]:
    """The smoothed record itself, whose derivative `smooth_derivative` is; fewer than six samples are as they are."""
    if len(time) < 6 or np.ptp(values) == 0:
        return values
    smooth = _smoothed(time, values)
    return np.asarray(smooth.spline((time - smooth.start) / smooth.unit))


def shares_beside_smooth(
    time: Float[np.ndarray, " sample"],
    values: Float[np.ndarray, " sample"],
    columns: Float[np.ndarray, "sample column"],
) -> Float[np.ndarray, " column"]:
    """How much of each column the values hold beside a smooth curve; zeros where all explain no more than chance does.

    What the spline leaves of the values is compared with what it leaves of the columns, twice: its penalty is that of
    the values less the columns. Chance is Schwarz's criterion, and ten nats for a spline that follows corners badly.

    Source: P. Speckman, Kernel smoothing in partial linear models, J. R. Statist. Soc. B 50 (1988).
    """
    knots = _at_knots(time, np.column_stack([values, columns]))
    own, parts = knots.values[:, 0], knots.values[:, 1:]
    shares, bands = np.zeros(parts.shape[1]), _bands(knots.x)
    for _ in range(2):
        penalty, _ = _best_fit(knots.x, own - parts @ shares)
        left = _left(bands, penalty, knots.values)
        shares = np.linalg.lstsq(left[:, 1:], left[:, 0], rcond=COLLINEAR)[0]
    before, after = (np.sum(rest**2) for rest in (left[:, 0], left[:, 0] - left[:, 1:] @ shares))
    least = 0.5 * len(shares) * np.log(len(own)) + CORNERS
    return shares if before > after * np.exp(2.0 * least / len(own)) else np.zeros(len(shares))


def smoothing_bandwidth(time: Float[np.ndarray, " sample"], values: Float[np.ndarray, " sample"]) -> float:
    """Frequency (1/unit of time) at which `smooth_derivative` of this record passes 1/√2 of the true derivative.

    A spline of penalty λ and unit spacing passes 1/(1 + λ(2πf)⁴) of what varies with frequency f; means over a knot
    pass sinc f of it. At most half the frequency of the knots.

    Raises:
        ValueError: fewer than six samples, or constant values: nothing is smoothed.
    """
    if len(time) < 6 or np.ptp(values) == 0:
        raise ValueError("a bandwidth needs six samples or more whose values vary")
    smooth = _smoothed(time, values)
    averaged = float(smooth.block > 1)

    def above(f: float) -> float:
        return float(np.sinc(f * averaged)) / (1.0 + smooth.penalty * (2.0 * np.pi * f) ** 4) - np.sqrt(0.5)

    edge = 0.5 if above(0.5) >= 0 else bisect(above, 0.0, 0.5)
    return edge / smooth.unit  # type: ignore[operator]


class _Knots(NamedTuple):
    """Means of rows at knots of unit mean spacing."""

    x: np.ndarray
    values: np.ndarray
    start: float
    unit: float
    block: int


def _at_knots(time: np.ndarray, values: np.ndarray) -> _Knots:
    n = len(time)
    block = -(-n // MAXIMUM_KNOTS)
    edges = np.arange(0, n, block)
    if len(edges) > 1 and n - edges[-1] < block:
        edges = edges[:-1]
    counts = np.diff(np.append(edges, n))
    t = np.add.reduceat(time, edges) / counts
    v = (np.add.reduceat(values, edges).T / counts).T
    unit = float(t[-1] - t[0]) / len(t)
    return _Knots((t - t[0]) / unit, v, float(t[0]), unit, block)


def _smoothed(time: np.ndarray, values: np.ndarray) -> _Smooth:
    x, means, start, unit, block = _at_knots(time, values)
    penalty, fitted = _best_fit(x, means)
    # The natural spline through what the smoothing spline is at its knots is the same curve.
    return _Smooth(CubicSpline(x, fitted, bc_type="natural"), penalty, start, unit, block)


class _Bands(NamedTuple):
    """Qᵀ takes differences of slopes, R f″ = Qᵀf; upper bands of R and QᵀQ (Green and Silverman 1994, section 2.1)."""

    differences: tuple[np.ndarray, np.ndarray, np.ndarray]
    mass: np.ndarray
    bending: np.ndarray


def _bands(x: np.ndarray) -> _Bands:
    n, h = len(x), np.diff(x)
    a, b, c = 1 / h[:-1], -1 / h[:-1] - 1 / h[1:], 1 / h[1:]
    mass, bending = np.zeros((3, n - 2)), np.zeros((3, n - 2))
    mass[2], mass[1, 1:] = (h[:-1] + h[1:]) / 3, h[1:-1] / 6
    bending[2], bending[1, 1:], bending[0, 2:] = a**2 + b**2 + c**2, b[:-1] * a[1:] + c[:-1] * b[1:], c[:-2] * a[2:]
    return _Bands((a, b, c), mass, bending)


def _left(bands: _Bands, penalty: float, y: np.ndarray) -> np.ndarray:
    """y − f of columns at the knots: λ Q f″."""
    a, b, c = (d[:, None] for d in bands.differences)
    curvature = solveh_banded(bands.mass + penalty * bands.bending, a * y[:-2] + b * y[1:-1] + c * y[2:])
    left = np.zeros_like(y)
    left[:-2] += a * curvature
    left[1:-1] += b * curvature
    left[2:] += c * curvature
    return penalty * left


def _best_fit(x: np.ndarray, y: np.ndarray) -> tuple[float, np.ndarray]:
    """The penalty λ of Σ(y − f)² + λ∫f″² by robust cross-validation, and f at the knots.

    All levels are tried, since it can have several minima. The traces in it are those of evenly spaced knots, which
    pass cosines of frequency ω by 1/(1 + λ d(ω)).
    """
    n = len(x)
    (a, b, c), mass, bending = _bands(x)
    bend = a * y[:-2] + b * y[1:-1] + c * y[2:]
    cosine = np.cos(np.pi * (np.arange(1, n - 1) + 0.5) / n)
    d = 12.0 * (1.0 - cosine) ** 2 / (2.0 + cosine)
    levels = np.geomspace(0.1 / d[-1], 10.0 / d[0], LEVELS)
    passed = 1.0 / (1.0 + levels[:, None] * d)
    # LAPACK itself: what solveh_banded does around it takes twice as long.
    (solve,) = get_lapack_funcs(("pbsv",), (bending,))
    curvature = np.array([solve(mass + level * bending, bend)[1] for level in levels])
    # y − f = λ Q f″
    pad = np.pad(curvature, ((0, 0), (2, 2)))
    residual = levels[:, None] * (
        pad[:, 2:] * np.pad(a, (0, 2)) + pad[:, 1:-1] * np.pad(b, 1) + pad[:, :-2] * np.pad(c, (2, 0))
    )
    cross_validation = (residual**2).sum(axis=1) / (1.0 - passed).sum(axis=1) ** 2
    squares = ((passed**2).sum(axis=1) + 2.0) / n
    best = np.argmin(cross_validation * (ROBUSTNESS + (1.0 - ROBUSTNESS) * squares))
    return float(levels[best]), y - residual[best]
