"""Which causes explain amplitudes and phases of a vibration test, and which further test would tell them apart.

A time offset between the records, viscous friction through the loop and a resonance of the mount, alone and together:
`measured_response` says what each of them does.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from gyromodel.estimate import FunctionFit, fit_function
from gyromodel.platform._acceptance import AXES
from gyromodel.platform._loop import Loop, Mount, measured_response

# What the causes are made of: time offset (s), friction (N m s/rad) and compliance (s²) of each axis, lag (s) of all.
ENTRIES = (*(f"{kind} {axis}" for kind in ("offset", "friction", "compliance") for axis in AXES), "lag")
# Where fits begin; all but offsets are positive.
SIZES = np.repeat([1e-3, 1.0, 1e-5, 1e-3], [3, 3, 3, 1])
# Loops of the published bandwidth other than the default one: with as much integration as margins of 45° allow, and
# with two integrators.
QUICK = {"correction": 5.0, "corner": 120.0}
DOUBLE = {"correction": 5.5, "corner": 48.0, "second_corner": 48.0}


class Alternative(NamedTuple):
    """An explanation: which kinds of entries it has, in which loop, and what the mount's damper acts against.

    kinds: of "offset" (the same for all axes), "offsets" (of each axis), "friction", "compliance" and "lag"; loop: what
    of it differs from the default one.
    """

    kinds: tuple[str, ...]
    loop: Mapping[str, Any] = MappingProxyType({})
    grounded: float = 0.0

    @property
    def columns(self) -> Float[np.ndarray, "entry parameter"]:
        """Entries by parameters."""
        unit = np.eye(len(ENTRIES))
        parts = {
            "offset": unit[:, :3].sum(1, keepdims=True),
            "offsets": unit[:, :3],
            "friction": unit[:, 3:6],
            "compliance": unit[:, 6:9],
            "lag": unit[:, 9:],
        }
        return np.concatenate([parts[kind] for kind in self.kinds], axis=1)


ALTERNATIVES = {
    "time offset": Alternative(("offset",)),
    "time offset of each axis": Alternative(("offsets",)),
    "friction": Alternative(("friction",)),
    "friction, quick integration": Alternative(("friction",), QUICK),
    "friction, double integration": Alternative(("friction",), DOUBLE),
    "resonance": Alternative(("compliance",)),
    "resonance, damped against inertial space": Alternative(("compliance", "lag"), grounded=1.0),
    "time offset, resonance": Alternative(("offset", "compliance")),
    "time offset, friction": Alternative(("offset", "friction")),
    "time offset, friction, double integration": Alternative(("offset", "friction"), DOUBLE),
    "friction, resonance": Alternative(("friction", "compliance")),
    "friction, resonance, quick integration": Alternative(("friction", "compliance"), QUICK),
    "time offset, friction, resonance": Alternative(("offset", "friction", "compliance")),
}


class Points(NamedTuple):
    """Under what each response was measured.

    axis: its number; frequency: rad/s; amplifier: K_0 over that of the loop; integrated: one where navigation
    integrates the gyros.
    """

    axis: Int[np.ndarray, " point"]
    frequency: Float[np.ndarray, " point"]
    amplifier: Float[np.ndarray, " point"]
    integrated: Float[np.ndarray, " point"]


def points(frequencies: Float[np.ndarray, " frequency"], amplifier: float = 1.0, integrated: float = 0.0) -> Points:
    """Every axis at some frequencies (rad/s), axis by axis."""
    axis = np.repeat(np.arange(len(AXES)), len(frequencies))
    ones = np.ones(len(axis))
    return Points(axis, np.tile(frequencies, len(AXES)), amplifier * ones, integrated * ones)


@dataclass(frozen=True, eq=False)
class Explanation:
    """A fitted alternative.

    Attributes:
        alternative: what was fitted.
        value: of each of `ENTRIES`, zero for what is not part of it or would be negative.
        std: standard uncertainty of each, zero for what was not fitted.
        scatter: of gains (dB) and phases (deg): estimated from what the fit leaves, unless it was given.
        residual: measured less explained, gains before phases.
        criterion: Akaike's, corrected for few points; the smaller the better, and a difference of 2 is little.
    """

    alternative: Alternative
    value: Float[np.ndarray, " entry"]
    std: Float[np.ndarray, " entry"]
    scatter: Float[np.ndarray, " 2"]
    residual: Float[np.ndarray, " observation"]
    criterion: float


def explain(
    alternative: Alternative,
    at: Points,
    gain: Float[np.ndarray, " point"],
    phase: Float[np.ndarray, " point"],
    signed: bool = True,
    phase_std: Float[np.ndarray, " point"] | None = None,
) -> Explanation:
    """Fit an alternative to gains and phases whose scatter is not known: one factor for gains and one for phases.

    Friction, compliance and lag that would be negative are held at zero, the most negative one first; the criterion
    counts them all the same.

    Args:
        alternative: to fit.
        at: where the responses were measured.
        gain: dB.
        phase: deg.
        signed: whether the phases have a sign; those of an arccos do not, nor has then the offset.
        phase_std: standard deviations of the phases relative to each other; equal by default.

    Raises:
        EstimateError: the points do not determine the alternative.
    """
    n = len(gain)
    std = np.concatenate([np.ones(n), np.ones(n) if phase_std is None else phase_std])
    measured, groups = np.concatenate([gain, phase]), np.repeat([0, 1], n)
    found, columns = _physical(alternative, at, measured, signed, std, groups)
    squares = [np.mean((found.residual / std)[groups == group] ** 2) for group in (0, 1)]
    k = alternative.columns.shape[1] + 2
    criterion = n * float(np.log(squares).sum()) + 2 * k + 2 * k * (k + 1) / (2 * n - k - 1)
    spread = np.sqrt(np.diag(columns @ found.parameters.covariance @ columns.T))
    value = columns @ found.parameters.vector
    return Explanation(alternative, value, spread, found.scatter, found.residual, criterion)


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
    data = _data(truth.alternative, at, sign, np.eye(len(ENTRIES)))
    predicted = np.asarray(_predicted(jnp.asarray(truth.value), data))
    std = np.repeat(truth.scatter, n)
    # Of one unknown factor, which does not change the fit: no test of whether its size is probable.
    found, _ = _physical(rival, at, predicted, sign, std, np.zeros(2 * n, int))
    return float(np.linalg.norm(found.residual / std))


class _Data(NamedTuple):
    """What predictions need besides the parameters."""

    columns: Float[Array, "entry parameter"]
    at: Any
    signed: Float[Array, " point"]
    loop: Loop
    grounded: Float[Array, ""]


def _data(alternative: Alternative, at: Points, signed: bool | np.ndarray, columns: np.ndarray) -> _Data:
    sign = np.broadcast_to(np.asarray(signed, float), at.frequency.shape)
    at, arrays = jax.tree.map(jnp.asarray, (at, (columns, sign, alternative.grounded)))
    return _Data(arrays[0], at, arrays[1], Loop(**alternative.loop), arrays[2])


def _predict(parameters: Array, data: _Data) -> Array:
    """Gains and then phases."""
    entry = data.columns @ parameters

    def one(axis, frequency, amplifier, integrated):
        changed = entry[3:6][axis], amplifier * data.loop.amplifier
        loop = eqx.tree_at(lambda x: (x.friction, x.amplifier), data.loop, changed)
        mount = Mount(entry[:3][axis], entry[6:9][axis], entry[9], data.grounded)
        return measured_response(loop, mount, frequency[None], integrated)[0]

    response = jax.vmap(one)(*data.at)
    phase = jnp.rad2deg(jnp.angle(response))
    phase = jnp.where(data.signed > 0, phase, jnp.abs(phase))
    return jnp.concatenate([20 * jnp.log10(jnp.abs(response)), phase])


_predicted = jax.jit(_predict)


def _physical(
    alternative: Alternative,
    at: Points,
    measured: np.ndarray,
    signed: bool | np.ndarray,
    std: np.ndarray,
    groups: np.ndarray,
) -> tuple[FunctionFit, np.ndarray]:
    """The fit, and the columns that are left when no entry but an offset is negative."""
    columns = alternative.columns
    names = ("gains", "phases") if groups.any() else "vibration test"
    while True:
        start = (columns / columns.sum(0)).T @ SIZES
        found = fit_function(
            _predict, start, measured, _data(alternative, at, signed, columns), std=std, groups=groups, name=names
        )
        relative = np.where(columns[:3].any(0), np.inf, found.parameters.vector / start)
        if relative.min() >= 0:
            return found, columns
        columns = np.delete(columns, relative.argmin(), axis=1)
