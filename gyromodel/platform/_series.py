"""The loop of a platform identified from the angle series of a vibration test, all axes and frequencies together.

Of each run the base's angle less so much of the table's as follows it is, besides a drift, sines at the frequency and
its overtones: the transfer function at each, and what dry friction's change of sign makes of odd ones. Their
amplitudes, with the noise of the colour that the run shows near each, hold all that the series tell of a loop.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float, Int

from gyromodel.platform._acceptance import AXES
from gyromodel.platform._alternatives import Alternative
from gyromodel.platform._explanations import Explanation, loop_and_mount, physical, shape, tested
from gyromodel.platform._loop import Loop, measured_response
from gyromodel.platform._motion import BaseMotion
from gyromodel.platform._responses import DEGREE, Response, _columns, _sine_covariance
from gyromodel.platform._vibration import DECIBELS

# Odd sines that are predicted; even ones and the drift are free.
ODD = (1, 3, 5)


class _Sines(NamedTuple):
    """Of each run and odd overtone: what is predicted, and along which directions it is measured.

    axis: its number; order: of the overtone; frequency: of the oscillation, rad/s; table: its z of Re[z e^(jωt)], rad;
    followed: how much of the table's angle was taken off; along: directions (columns) of sine and cosine.
    """

    axis: Int[np.ndarray, " sine"]
    order: Int[np.ndarray, " sine"]
    frequency: Float[np.ndarray, " sine"]
    table: Complex[np.ndarray, " sine"]
    followed: Float[np.ndarray, " sine"]
    along: Float[np.ndarray, "sine 2 2"]


class _Model(NamedTuple):
    """What predictions need besides the entries and the sines."""

    loop: Loop
    grounded: Float[Array, ""]
    estimated: Float[Array, " 2"]
    integrated: Float[Array, ""]


def fit_series(
    motion: BaseMotion, found: Sequence[Response], alternative: Alternative, integrated: bool = False,
    start: Float[np.ndarray, " entry"] | None = None,
) -> Explanation:  # fmt: skip
    """Fit an explanation's loop, friction, delay and mount to the angles of all runs at once.

    Beside `explain`, which takes amplitude and phase of each run: the overtones of dry friction count too. What of the
    loop is fitted is the explanation's; well below its crossover only friction over gain shows.

    Args:
        motion: angles of table and base.
        found: the runs that have a response, with their frequencies.
        alternative: what to fit.
        integrated: whether navigation integrated the rates of the platform.
        start: entries that the fit begins at.

    Returns:
        As of `explain` with known standard errors; residuals are in standard deviations.

    Raises:
        EstimateError: the series do not determine the alternative.
    """
    parts = [part for response in found for part in _sines(motion, response)]
    sines = _Sines(*map(np.array, zip(*(part[0] for part in parts), strict=True)))
    measured, std = (np.concatenate([part[k] for part in parts]) for k in (1, 2))
    model = _Model(*shape(alternative), jnp.asarray(float(integrated)))
    columns = tested(alternative, sines)
    fit = physical(columns, partial(_linearise, sines, model), measured, std, start=start)
    free = len(measured) - columns.shape[1]
    cost = fit.sum_of_squares + 2 * columns.shape[1]
    return Explanation(alternative, fit.value, fit.std, np.ones(2), fit.residual / std, cost, fit.sum_of_squares, free)


def _sines(motion: BaseMotion, found: Response) -> list[tuple[tuple[Any, ...], np.ndarray, np.ndarray]]:
    """Of each odd sine of a run: what `_Sines` holds, amplitudes along its directions, and their standard errors."""
    rows = np.flatnonzero(motion.segment == found.run - 1)
    axis, w = AXES.index(found.axis), found.frequency
    time = motion.time[rows] - motion.time[rows[0]]
    # At two samples a period a sine is one of any frequency.
    orders = [n for n in ODD if n * w * np.median(np.diff(time)) < 0.9 * np.pi]
    degree = int(np.clip(found.periods, 1, DEGREE))
    columns = _columns(time, w, degree, orders[-1])
    base, table = motion.base[rows, axis], motion.table[rows, axis]
    followed = 10 ** (found.gain / 20)
    signals = np.column_stack([base - followed * table, table])
    amplitudes = np.linalg.lstsq(columns, signals, rcond=None)[0]
    left = signals[:, 0] - columns @ amplitudes[:, 0]
    z = complex(amplitudes[1, 1], -amplitudes[0, 1])
    parts = []
    for n in orders:
        first = np.r_[2 * n - 2, 2 * n - 1, np.delete(np.arange(columns.shape[1]), [2 * n - 2, 2 * n - 1])]
        covariance, freedom = _sine_covariance(time, columns[:, first], left, n * found.periods)
        if n == 1:
            ratio = np.array([-z.imag, z.real]) / abs(z)
            # What encoders' steps add to the amplitude, in overtones as well.
            steps = max((found.gain_std / DECIBELS * abs(z)) ** 2 - float(ratio @ covariance @ ratio), 0.0)
        # A squared normal error over an estimated variance is ν/(ν − 2) on average.
        variance, along = np.linalg.eigh(freedom / (freedom - 2) * covariance + steps * np.eye(2))
        of_one = axis, n, w, z, followed, along
        parts.append((of_one, along.T @ amplitudes[2 * n - 2 : 2 * n, 0], np.sqrt(variance)))
    return parts


def _predict(entry: Array, sines: _Sines, model: _Model) -> Array:
    def one(axis, order, w, table, followed, along):
        size = jnp.abs(table)
        dry = entry[6:9][axis]
        # Of the torque M sign(ω) of a body that slides, the part that goes with the rate is 4M/(π ω̂).
        loop, mount = loop_and_mount(entry, model, axis, jnp.ones(()), 4 / jnp.pi * dry / (w * size))
        first = (measured_response(loop, mount, w[None], model.integrated)[0] - followed) * table
        # sign(cos x) = 4/π Σ (−1)^k cos((2k + 1) x)/(2k + 1), of the rate jωz.
        loop, _ = loop_and_mount(entry, model, axis, jnp.ones(()), jnp.zeros(()))
        at, s = order * w[None], 1j * order * w
        torque = 4 / jnp.pi * dry * (-1.0) ** (order // 2) / order * (1j * table / size) ** order
        turned = torque / (s * (s * loop.inertia + loop.friction + loop.damping(at)[0]))
        unseen = 1 - model.integrated * loop.gyro(at)[0]
        wave = jnp.where(order == 1, first, -jnp.exp(-s * mount.time_offset) * unseen * turned)
        return along.T @ jnp.stack([-jnp.imag(wave), jnp.real(wave)])

    return jax.vmap(one)(*sines).ravel()


@jax.jit
def _linearised(entry: Array, sines: _Sines, model: _Model) -> tuple[Array, Array]:
    return _predict(entry, sines, model), jax.jacfwd(_predict)(entry, sines, model)


def _linearise(sines: _Sines, model: _Model, entry: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    value, jacobian = _linearised(jnp.asarray(entry), jax.tree.map(jnp.asarray, sines), model)
    return np.asarray(value), np.asarray(jacobian)
