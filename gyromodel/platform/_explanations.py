"""Which causes explain amplitudes and phases of a vibration test, and which further test would tell them apart.

A time offset between the records, viscous friction through the loop and a resonance of the mount, alone and together:
`measured_response` says what each of them does.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from scipy.stats import chi2

from gyromodel.estimate import EstimateError
from gyromodel.numerics.least_squares import levenberg_marquardt
from gyromodel.platform._acceptance import AXES
from gyromodel.platform._alternatives import ENTRIES, SIZES, Alternative
from gyromodel.platform._loop import Loop, Mount, measured_response

# Amplitude of the published test, rad.
AMPLITUDE = np.deg2rad(0.15)
# Rounds of a fit and of the scatter that it leaves, and the relative change that ends them.
ROUNDS, SETTLED = 200, 1e-9
# Relative size of a singular value of the scaled Jacobian below which the points do not determine an alternative.
SINGULAR = 1e-9
# A standard uncertainty this many times the larger of a parameter's value and its start is no estimate.
RUNAWAY = 100.0
# The first entry of the loop, whose shape stays the usual one where fits begin near another, and what of their sizes
# others begin with there.
LOOP, SMALL = ENTRIES.index("corner"), 0.2
# Points of one compiled program are a multiple of this.
BUCKET = 16

Linearise = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]


class Points(NamedTuple):
    """Under what each response was measured.

    axis: its number; frequency: rad/s; amplifier: K_0 over that of the loop; integrated: one where navigation
    integrates the gyros; amplitude: of the table, rad.
    """

    axis: Int[np.ndarray, " point"]
    frequency: Float[np.ndarray, " point"]
    amplifier: Float[np.ndarray, " point"]
    integrated: Float[np.ndarray, " point"]
    amplitude: Float[np.ndarray, " point"]


def points(
    frequencies: Float[np.ndarray, " frequency"],
    amplifier: float = 1.0,
    integrated: float = 0.0,
    amplitude: float = AMPLITUDE,
) -> Points:
    """Every axis at some frequencies (rad/s), axis by axis."""
    axis = np.repeat(np.arange(len(AXES)), len(frequencies))
    ones = np.ones(len(axis))
    return Points(axis, np.tile(frequencies, len(AXES)), amplifier * ones, integrated * ones, amplitude * ones)


@dataclass(frozen=True, eq=False)
class Explanation:
    """A fitted alternative.

    Attributes:
        alternative: what was fitted.
        value: of each of `ENTRIES`, zero for what is not part of it or would be negative.
        std: standard uncertainty of each, zero for what was not fitted.
        scatter: of gains (dB) and phases (deg): estimated from what the fit leaves, unless it was given.
        residual: measured less explained, gains before phases.
        criterion: Akaike's, where the scatter is estimated corrected for few points; the smaller the better, and a
            difference of 2 is little.
        sum_of_squares: of residuals over their standard deviations.
        degrees_of_freedom: observations less parameters, those held at zero and scatters included.
        left_out: axes whose runs it leaves unexplained, at the price of a parameter each number.
    """

    alternative: Alternative
    value: Float[np.ndarray, " entry"]
    std: Float[np.ndarray, " entry"]
    scatter: Float[np.ndarray, " 2"]
    residual: Float[np.ndarray, " observation"]
    criterion: float
    sum_of_squares: float = np.nan
    degrees_of_freedom: int = 0
    left_out: tuple[str, ...] = ()

    @property
    def probability(self) -> float:
        """That known standard deviations leave a sum of squares as large as this."""
        return float(chi2.sf(self.sum_of_squares, self.degrees_of_freedom))


def explain(
    alternative: Alternative,
    at: Points,
    gain: Float[np.ndarray, " point"],
    phase: Float[np.ndarray, " point"],
    signed: bool = True,
    phase_std: Float[np.ndarray, " point"] | None = None,
    gain_std: Float[np.ndarray, " point"] | None = None,
    start: Float[np.ndarray, " entry"] | None = None,
) -> Explanation:
    """Fit an alternative to gains and phases.

    Their scatter is not known, but for one factor of gains and one of phases, unless `gain_std` is given.

    Friction, compliance and lag that would be negative are held at zero, the most negative one first; the criterion
    counts them all the same.

    Args:
        alternative: to fit.
        at: where the responses were measured.
        gain: dB.
        phase: deg.
        signed: whether the phases have a sign; those of an arccos do not, nor has then the offset.
        phase_std: standard deviations of the phases, deg; without `gain_std`, relative to each other, equal by default.
        gain_std: of the gains, dB; both are then taken for known.
        start: entries that the fit begins at.

    Raises:
        EstimateError: the points do not determine the alternative.
    """
    n, known = len(gain), gain_std is not None
    std = np.concatenate([np.ones(n) if x is None else x for x in (gain_std, phase_std)])
    measured, groups = np.concatenate([gain, phase]), None if known else np.repeat([0, 1], n)
    columns = tested(alternative, at)
    found = physical(columns, _linearise(alternative, at, signed), measured, std, groups, start)
    squares = np.mean((found.residual / std).reshape(2, n) ** 2, axis=1)
    k = columns.shape[1] + 2 * (not known)
    corrected = 2 * k * (k + 1) / (2 * n - k - 1) if 2 * n > k + 1 else np.inf
    cost = n * float(squares.sum()) if known else n * float(np.log(squares).sum()) + corrected
    scatter = np.sqrt(np.mean(std.reshape(2, n) ** 2, axis=1)) if known else found.scatter
    total, free = found.sum_of_squares, 2 * n - k
    return Explanation(alternative, found.value, found.std, scatter, found.residual, cost + 2 * k, total, free)


def beginning(found: Explanation) -> Float[np.ndarray, " entry"]:
    """Entries near an explanation, at which the fit of one that has more may begin: what it lacks is small there."""
    small = np.where(np.arange(len(ENTRIES)) < LOOP, SMALL, 1.0) * SIZES
    return np.where(found.value != 0, found.value, small)


def predicted(found: Explanation, at: Points) -> Float[np.ndarray, "2 point"]:
    """Gains (dB) and signed phases (deg) that a fitted explanation has at some points."""
    entries, data = jnp.asarray(found.value), _data(found.alternative, at, True)
    return np.asarray(_predicted(entries, data)).reshape(2, -1)


def assumed_loop(found: Explanation) -> Loop:
    """The loop of an explanation, with the corner of its integration and the crossover where those were fitted."""
    estimated = jnp.asarray([kind in found.alternative.kinds for kind in ("corner", "crossover")], float)
    return _loop(jnp.asarray(found.value), Loop(**found.alternative.loop), estimated)


def separation(
    truth: Explanation, rival: Alternative, before: Points, test: Points | None = None, signed: bool = False
) -> float:
    """By how many standard deviations a rival misses what a fitted explanation predicts, refitted as well as it can be.

    With 3.3 or more, 5 % of repetitions at most prefer the wrong one; with 0 no repetition helps.

    Args:
        truth: predicts what is measured; its scatter is that of every point.
        rival: fitted to the prediction.
        before: the points there are.
        test: those that a further test adds, with signed phases.
        signed: whether the phases of the first points have a sign.
    """
    at = before if test is None else Points(*(np.concatenate(pair) for pair in zip(before, test, strict=True)))
    n = len(at.axis)
    sign = np.arange(n) >= (0 if signed else len(before.axis))
    exact = np.asarray(_predicted(jnp.asarray(truth.value), _data(truth.alternative, at, sign)))
    std = np.repeat(truth.scatter, n)
    # Of one unknown factor, which does not change the fit: no test of whether its size is probable.
    found = [
        physical(tested(rival, at), _linearise(rival, at, sign), exact, std, np.zeros(2 * n, int), start)
        for start in (SIZES, beginning(truth))
    ]
    return min(float(np.linalg.norm(fit.residual / std)) for fit in found)


class _Data(NamedTuple):
    """What predictions need besides the entries."""

    at: Any
    signed: Float[Array, " point"]
    loop: Loop
    grounded: Float[Array, ""]
    estimated: Float[Array, " 2"]


def _data(alternative: Alternative, at: Points, signed: bool | np.ndarray) -> _Data:
    sign = np.broadcast_to(np.asarray(signed, float), at.frequency.shape)
    at, sign = jax.tree.map(jnp.asarray, (at, sign))
    return _Data(at, sign, *shape(alternative))


def shape(alternative: Alternative) -> tuple[Loop, Array, Array]:
    """Its loop, what its damper acts against, and whether corner and crossover are fitted, as `_Data` has them."""
    estimated = [float(kind in alternative.kinds) for kind in ("corner", "crossover")]
    return Loop(**alternative.loop), jnp.asarray(alternative.grounded), jnp.asarray(estimated)


@jax.jit
def _loop(entry: Array, loop: Loop, estimated: Array) -> Loop:
    """A loop with the corner and the crossover of the entries, as far as these are estimated."""
    corner = jnp.where(estimated[0] > 0, entry[13], loop.corner)
    loop = eqx.tree_at(lambda x: x.corner, loop, corner)
    # |L| = 1 at the crossover, there being no friction: K_0 = J ω/|W_c W_m G_fog|.
    crossover = jnp.where(estimated[1] > 0, entry[14], 1.0)
    amplifier = loop.amplifier / jnp.abs(loop.open_loop(crossover[None])[0])
    return eqx.tree_at(lambda x: x.amplifier, loop, jnp.where(estimated[1] > 0, amplifier, loop.amplifier))


def loop_and_mount(entry: Array, data: Any, axis: Array, amplifier: Array, dry: Array) -> tuple[Loop, Mount]:
    """Those of an axis by all entries, `dry` added to the friction; data: of `_Data` the last three."""
    loop = _loop(entry, data.loop, data.estimated)
    changed = entry[3:6][axis] + dry, amplifier * loop.amplifier
    loop = eqx.tree_at(lambda x: (x.friction, x.amplifier), loop, changed)
    return loop, Mount(entry[:3][axis], entry[9:12][axis], entry[12], data.grounded)


def _predict(entry: Array, data: _Data) -> Array:
    """Gains and then phases."""

    def one(axis, frequency, amplifier, integrated, amplitude):
        # Of the torque M sign(ω) of a body that slides, the part that goes with the rate is 4M/(π ω̂).
        dry = 4 / jnp.pi * entry[6:9][axis] / (frequency * amplitude)
        loop, mount = loop_and_mount(entry, data, axis, amplifier, dry)
        return measured_response(loop, mount, frequency[None], integrated)[0]

    response = jax.vmap(one)(*data.at)
    phase = jnp.rad2deg(jnp.angle(response))
    phase = jnp.where(data.signed > 0, phase, jnp.abs(phase))
    return jnp.concatenate([20 * jnp.log10(jnp.abs(response)), phase])


_predicted = jax.jit(_predict)


@jax.jit
def _linearised(entry: Array, data: _Data) -> tuple[Array, Array]:
    """Predictions and their derivatives by all entries, so that one program serves every alternative."""
    return _predict(entry, data), jax.jacfwd(_predict)(entry, data)


def _linearise(alternative: Alternative, at: Points, signed: bool | np.ndarray) -> Linearise:
    """Predictions at some points and their derivatives."""
    n = len(at.axis)
    # Of a number of points that recurs: a new one takes seconds to compile.
    fill = (0, -n % BUCKET)
    at = Points(*(np.pad(x, fill, mode="edge") for x in at))
    sign = np.pad(np.broadcast_to(np.asarray(signed, float), n), fill)
    data = _data(alternative, at, sign)
    kept = np.concatenate([np.arange(n), len(sign) + np.arange(n)])

    def linearise(entry: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        value, jacobian = (np.asarray(x) for x in _linearised(entry, data))
        return value[kept], jacobian[kept]

    return linearise


def tested(alternative: Alternative, at: Any) -> np.ndarray:
    """The columns that axes of the test (`at.axis`) have a part in."""
    seen = np.concatenate([np.tile(np.isin(range(len(AXES)), at.axis), 4), [True, True, True]])
    columns = alternative.columns
    return columns[:, columns[seen].any(axis=0)]


class Fit(NamedTuple):
    """Entries with their standard uncertainties, scatter of each group, and what is left."""

    value: Float[np.ndarray, " entry"]
    std: Float[np.ndarray, " entry"]
    scatter: Float[np.ndarray, " group"]
    residual: Float[np.ndarray, " observation"]
    sum_of_squares: float


def physical(
    columns: np.ndarray, linearise: Linearise, measured: np.ndarray, std: np.ndarray, groups: np.ndarray | None = None,
    start: np.ndarray | None = None,
) -> Fit:  # fmt: skip
    """The least-squares fit in which no entry but an offset is negative.

    Args:
        columns: entries by parameters.
        linearise: predictions and their derivatives by all entries.
        measured: what is predicted.
        std: its standard deviations.
        groups: of observations whose standard deviations have a common unknown factor; without, they are known.
        start: entries that the fit begins at.

    Raises:
        EstimateError: the observations do not determine the parameters.
    """
    while True:
        found = _fitted(columns, linearise, measured, std, groups, SIZES if start is None else start)
        size = columns.T @ SIZES
        relative = np.where(columns[:3].any(0), np.inf, columns.T @ found.value / size)
        if relative.min(initial=np.inf) >= 0:
            return found
        columns = np.delete(columns, relative.argmin(), axis=1)


def _fitted(
    columns: np.ndarray, linearise: Linearise, measured: np.ndarray, std: np.ndarray, groups: np.ndarray | None,
    start: np.ndarray,
) -> Fit:  # fmt: skip
    known = groups is None
    groups = np.zeros(len(measured), int) if groups is None else groups
    counts = columns.sum(0)

    def linearised(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        predicted, jacobian = linearise(columns @ x)
        return measured - predicted, jacobian @ columns

    def normal(x: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
        residual, jacobian = linearised(x)
        residual, jacobian = residual * weight, jacobian * weight[:, None]
        return jacobian.T @ jacobian, -jacobian.T @ residual, float(residual @ residual)

    x, scatter = columns.T @ start / counts, np.ones(groups.max() + 1)
    for _ in range(ROUNDS):
        weight = 1 / (std * scatter[groups])
        if len(x):
            x = levenberg_marquardt(normal, x, 1e-13, ROUNDS).x
        residual, jacobian = linearised(x)
        jacobian = jacobian * weight[:, None]
        if not (np.isfinite(residual).all() and np.isfinite(jacobian).all()):
            raise EstimateError("the points of the vibration test do not determine this explanation")
        norm = np.linalg.norm(jacobian, axis=0)
        left, singular, right = np.linalg.svd(jacobian / np.where(norm > 0, norm, 1.0), full_matrices=False)
        if singular.min(initial=1.0) < SINGULAR or not (norm > 0).all():
            raise EstimateError("the points of the vibration test do not determine this explanation")
        # What the fit takes of each group (Förstner 1979).
        freedom = np.bincount(groups, 1 - np.sum(left**2, axis=1))
        if known:
            break
        if freedom.min() < 1e-6:
            raise EstimateError("the points of the vibration test are as few as the parameters of this explanation")
        before, scatter = scatter, np.sqrt(np.bincount(groups, (residual / std) ** 2) / freedom)
        scatter = np.maximum(scatter, 1e-12)
        if np.all(np.abs(scatter - before) < SETTLED * before):
            break
    spread = (right.T / singular) / norm[:, None]
    if (np.linalg.norm(spread, axis=1) > RUNAWAY * np.maximum(np.abs(x), columns.T @ SIZES / counts)).any():
        raise EstimateError("the points of the vibration test do not determine this explanation")
    spread = columns @ spread
    squares = float(np.sum((residual / (std * scatter[groups])) ** 2))
    return Fit(columns @ x, np.linalg.norm(spread, axis=1), scatter, residual, squares)
