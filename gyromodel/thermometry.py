"""Thermistor thermometry: temperature from resistance, calibrated against a reference thermometer.

Source: Xu, Deng, Zhang, Zhu, Lü, Gyroscope temperature test and modelling, Journal of Astronautics 1999(2), equation
(2), whose printed form is lost: the extended Steinhart-Hart equation stands in its place.
"""

from __future__ import annotations

from dataclasses import replace
from math import comb
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from gyromodel._checks import CampaignError
from gyromodel.estimate import EstimateError, FunctionFit, fit_function
from gyromodel.units import ZERO_CELSIUS

ORDER = 4
# From the solution of the first two terms, five steps reach rounding over any range that a thermistor serves.
NEWTON_STEPS = 6

Terms = tuple[Float[Array, " shared"], Float[Array, "segment own"]]


class Thermistor(eqx.Module):
    """1/T = Σ_k b_k (ln R/R₀)^k, k = 0…3, T absolute; by two segments that part at R₀ if there are two rows.

    Args:
        coefficients: b_k of each segment, 1/K; with two rows the first is the colder segment, R > R₀.
        reference: R₀, ohm.
        continuity: how many of the lowest terms the segments share.
    """

    coefficients: Float[Array, "segment 4"]
    reference: Float[Array, ""]
    continuity: int = eqx.field(static=True, default=0)

    @property
    def terms(self) -> Terms:
        """The terms that the segments share, and those of their own."""
        return self.coefficients[0, : self.continuity], self.coefficients[:, self.continuity :]

    def temperature(self, resistance: Float[Array | np.ndarray, "*sample"]) -> Float[Array, "*sample"]:
        """Temperature in °C; differentiable by the resistance and by the coefficients.

        Raises:
            CampaignError: a resistance is not above zero.
        """
        check_resistance(resistance)
        return _temperature(self, jnp.asarray(resistance))

    def resistance(self, temperature: Float[Array | np.ndarray, "*sample"]) -> Float[Array, "*sample"]:
        """Resistance in ohm at temperatures in °C; where two segments overlap, that of the warmer one."""
        return _resistance(self, jnp.asarray(temperature))

    def raw_coefficients(self) -> Float[Array, "segment 4"]:
        """B_k of 1/T = Σ_k B_k (ln R/ohm)^k, which loses digits to cancellation: to compare with published ones."""
        shift = -jnp.log(self.reference)
        # (l + shift)^k = Σ_j C(k, j) shift^(k−j) l^j
        binomial = [[comb(k, j) * shift ** (k - j) if j <= k else 0.0 for j in range(ORDER)] for k in range(ORDER)]
        return self.coefficients @ jnp.asarray(binomial)


def fit_thermistor(
    resistance: Float[Array | np.ndarray, " point"],
    temperature: Float[Array | np.ndarray, " point"],
    *,
    joint: float | None = None,
    continuity: int = 0,
    std: Float[Array | np.ndarray, "*point"] | float | None = None,
    name: str = "thermometry",
) -> FunctionFit:
    """Calibrate a thermistor by least squares in temperature.

    Args:
        resistance: of the thermistor, ohm.
        temperature: of the reference thermometer, °C.
        joint: temperature where two segments meet, °C; None for one segment over all.
        continuity: what meets at the joint: 0 nothing, 1 the value, 2 also the slope, 3 also the curvature.
        std: standard deviation of the reference temperatures, if it is known.
        name: what this calibration is called in budgets.

    Returns:
        The fit: its value is a `Thermistor`, its `scatter` the residual standard deviation of each segment in °C, the
        colder first (S1 and S2 of the source); 1 where `std` is known.

    Raises:
        CampaignError: a resistance is not above zero.
        EstimateError: too few points, or they do not determine the coefficients.
    """
    check_resistance(resistance)
    if not np.isfinite([*np.ravel(resistance), *np.ravel(temperature)]).all():
        raise EstimateError(f"{name}: a resistance or temperature is missing; leave such points out")
    if not 0 <= continuity < ORDER or (joint is None and continuity):
        raise EstimateError("continuity at the joint is 0, 1, 2 or 3, and needs a joint")
    kelvin = np.asarray(temperature, float) + ZERO_CELSIUS
    reference = joint_resistance(resistance, temperature, joint)
    x = np.log(np.asarray(resistance) / reference)
    segment = np.zeros(len(x), int) if joint is None else np.where(x > 0, 0, 1)
    segments = 1 if joint is None else 2
    fewest = ORDER - continuity + (std is None)
    if min(np.bincount(segment, minlength=segments)) < fewest:
        raise EstimateError(f"{name}: a segment needs {fewest} points or more for its own terms and their scatter")
    # 1/T is linear in the coefficients: that solution is the start.
    powers = x[:, None] ** np.arange(ORDER)
    own = [powers[:, continuity:] * (segment == s)[:, None] for s in range(segments)]
    solution = np.linalg.lstsq(np.concatenate([powers[:, :continuity], *own], axis=1), 1 / kelvin, rcond=None)[0]
    start = jnp.asarray(solution[:continuity]), jnp.asarray(solution[continuity:].reshape(segments, -1))
    data = jnp.asarray(reference), jnp.asarray(resistance)
    groups = segment if std is None else None
    fit = fit_function(_calibration, start, temperature, data, std=std, groups=groups, name=name)
    return replace(fit, parameters=fit.parameters.propagate(lambda terms: thermistor(terms, data[0])))


def thermistor(terms: Terms, reference: Any) -> Thermistor:
    """A thermistor from its terms, lowest powers first.

    With R₀ at the joint the term of power k alone decides about the k-th derivative there.
    """
    shared, own = terms
    rows = jnp.broadcast_to(shared, (own.shape[0], shared.shape[0]))
    return Thermistor(jnp.concatenate([rows, own], axis=1), reference, shared.shape[0])


def joint_resistance(resistance: Any, temperature: Any, joint: float | None) -> float:
    """Resistance at the joint, by the calibrated points; their geometric mean where there is none."""
    log, inverse = np.log(np.asarray(resistance, float)), 1 / (np.asarray(temperature, float) + ZERO_CELSIUS)
    if joint is None:
        return float(np.exp(log.mean()))
    # ln R is nearly a line in 1/T, and smooth: a cubic centred on the joint.
    x = (inverse - 1 / (joint + ZERO_CELSIUS)) / np.ptp(inverse)
    return float(np.exp(np.polynomial.polynomial.polyfit(x, log, min(ORDER, len(log)) - 1)[0]))


def check_resistance(resistance: Any) -> None:
    """Refuse resistances that have no logarithm, naming their rows; NaN passes, as a missing value."""
    if isinstance(resistance, Tracer):
        return
    bad = np.flatnonzero(np.asarray(resistance) <= 0)
    if len(bad):
        some = ", ".join(str(i + 1) for i in bad[:5]) + ("…" if len(bad) > 5 else "")
        raise CampaignError(f"a thermistor's resistance is above zero, but rows {some} are not: leave them out")


def _calibration(terms: Terms, data: tuple[Array, Array]) -> Array:
    reference, resistance = data
    return _temperature(thermistor(terms, reference), resistance)


@eqx.filter_jit
def _temperature(thermistor: Thermistor, resistance: Array) -> Array:
    x = jnp.log(resistance / thermistor.reference)
    # Horner's rule keeps its derivatives at x = 0, where those of powers of zero are delicate.
    b = jnp.where(x[..., None] > 0, thermistor.coefficients[0], thermistor.coefficients[-1])
    return 1 / _cubic(b, x) - ZERO_CELSIUS


@eqx.filter_jit
def _resistance(thermistor: Thermistor, temperature: Array) -> Array:
    inverse = 1 / (temperature + ZERO_CELSIUS)
    b = jnp.where((inverse > thermistor.coefficients[-1, 0])[..., None], *thermistor.coefficients[jnp.array([0, -1])])
    x = (inverse - b[..., 0]) / b[..., 1]
    for _ in range(NEWTON_STEPS):
        slope = b[..., 1] + x * (2 * b[..., 2] + 3 * x * b[..., 3])
        x = x - (_cubic(b, x) - inverse) / slope
    return thermistor.reference * jnp.exp(x)


def _cubic(b: Array, x: Array) -> Array:
    return b[..., 0] + x * (b[..., 1] + x * (b[..., 2] + x * b[..., 3]))
