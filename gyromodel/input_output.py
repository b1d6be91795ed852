"""The input-output curve of a ring laser gyro: output over input rate through averaged test points, and back.

Source: Yang Heng et al., *A Study on Fitting Ring Laser Gyro Mathematic Model*, Aviation Metrology & Measurement
Technology 19(3), 1999: a natural cubic spline through the test points, used to compensate the gyro.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from gyromodel.numerics.splines import CubicSpline, cubic_spline, slope_range, smoothing_spline, spline_matrix
from gyromodel.units import factor

# Halvings of the interval between two knots, then Newton steps: together exact to rounding.
HALVINGS, NEWTON_STEPS = 30, 3
# Points beyond those that the curve uses up; fewer tell no scatter.
FEWEST_LEFT = 3.0


class CurveError(ValueError):
    """The curve cannot answer; the message says why."""


class InputOutputCurve(eqx.Module):
    """Output as a natural cubic spline of the input rate, its knots at the rates tested.

    In internal units: rates in rad/s, outputs in the campaign's internal output unit (count, V, rad/s, …).
    `covariance` is that of the output values at the knots; zeros where none is known.
    """

    spline: CubicSpline
    covariance: Float[Array, "knot knot"]

    @classmethod
    def through(
        cls,
        rate: Float[Array, " knot"],
        output: Float[Array, " knot"],
        covariance: Float[Array, "knot knot"] | None = None,
    ) -> InputOutputCurve:
        """The curve through averaged test points.

        Args:
            rate: two or more different rates, rad/s, in any order.
            output: mean output at each.
            covariance: of the means; it is the covariance of the curve's values there.

        Raises:
            CurveError: a rate stands twice, or a number is not finite.
        """
        order = _increasing(rate, output, fewest=2)
        if covariance is not None and not jnp.isfinite(covariance).all():
            raise CurveError("the covariance of the test points holds what is not a number: leave those points out")
        known = jnp.zeros((len(order), len(order))) if covariance is None else covariance[order][:, order]
        return cls(cubic_spline(rate[order], output[order]), known)

    @classmethod
    def smoothed(
        cls,
        rate: Float[Array, " knot"],
        output: Float[Array, " knot"],
        output_std: Float[Array, " knot"] | None = None,
    ) -> InputOutputCurve:
        """The smoothing spline over averaged test points, its smoothness estimated.

        Args:
            rate: four or more different rates, rad/s, in any order.
            output: mean output at each.
            output_std: standard uncertainty of each mean; estimated, alike for all, if not given.

        Raises:
            CurveError: a rate stands twice, a number is not finite, or the points alone do not tell their scatter.
        """
        order = _increasing(rate, output, fewest=4)
        if output_std is not None:
            if not (jnp.isfinite(output_std).all() and (output_std > 0).all()):
                raise CurveError("a standard uncertainty in output_std is not a number above zero: leave its point out")
            fit = smoothing_spline(rate[order], output[order], output_std[order] ** -2.0, variance=jnp.ones(()))
            return cls(fit.spline, fit.covariance)
        fit = smoothing_spline(rate[order], output[order])
        left = len(order) - float(fit.degrees_of_freedom)
        if left < FEWEST_LEFT:
            raise CurveError(
                f"the smoothest likely curve leaves {left:.1f} of {len(order)} points to tell their scatter from: give "
                "output_std, e.g. from repeated readings, or test more rates"
            )
        return cls(fit.spline, fit.covariance)

    def output(self, rate: Float[Array, " point"]) -> tuple[Float[Array, " point"], Float[Array, " point"]]:
        """Output at some rates, and its standard uncertainty.

        Raises:
            CurveError: a rate lies outside the rates tested.
        """
        self._check_rate(rate)
        return self.spline(rate), self._std(rate, 0)

    def scale_factor(self, rate: Float[Array, " point"]) -> tuple[Float[Array, " point"], Float[Array, " point"]]:
        """Local scale factor d(output)/d(rate) at some rates, and its standard uncertainty.

        Raises:
            CurveError: a rate lies outside the rates tested.
        """
        self._check_rate(rate)
        return self.spline(rate, 1), self._std(rate, 1)

    def rate(
        self, output: Float[Array, " point"], output_std: Float[Array, "#point"] | float = 0.0
    ) -> tuple[Float[Array, " point"], Float[Array, " point"]]:
        """The input rates that give some outputs, and their standard uncertainties to first order.

        Args:
            output: what the gyro reads.
            output_std: its own standard uncertainty; the curve's is added to it.

        Raises:
            CurveError: the curve is not monotone, so that an output can belong to several rates, or an output lies
                outside those of the rates tested.
        """
        low, high = self.slope_range()
        if low <= 0.0 <= high:
            raise CurveError(
                f"the curve is not monotone: its slope runs from {low:.6g} to {high:.6g} per rad/s, so that an output "
                "can belong to several rates; test more rates where it turns, or smooth the curve"
            )
        _check_inside(output, self.spline.values, "output", "")
        rate = _inverse(self.spline, output)
        spread = jnp.hypot(self._std(rate, 0), output_std)
        return rate, spread / jnp.abs(self.spline(rate, 1))

    def slope_range(self) -> tuple[float, float]:
        """Smallest and largest local scale factor over the rates tested: the curve is monotone if zero is not between.

        Exact, from the vertices of the slope's parabolas.
        """
        low, high = slope_range(self.spline)
        return float(low), float(high)

    def _std(self, rate: Float[Array, " point"], order: int) -> Float[Array, " point"]:
        by_knot = spline_matrix(self.spline.knots, rate, "natural", order)
        variance = jnp.einsum("pi,ij,pj->p", by_knot, self.covariance, by_knot)
        return jnp.sqrt(jnp.maximum(variance, 0.0))  # rounding can take a zero below it

    def _check_rate(self, rate: Float[Array, " point"]) -> None:
        scale = factor("rad/s", "deg/s")
        _check_inside(rate * scale, self.spline.knots * scale, "rate", " deg/s")


def _check_inside(values: Array, tested: Array, what: str, unit: str) -> None:
    """Refuse values outside those tested; a rounding of the unit's conversion is no step outside."""
    low, high = float(tested.min()), float(tested.max())
    slack = 1e-12 * max(abs(low), abs(high))
    given = np.asarray(values)
    outside = given[~((given >= low - slack) & (given <= high + slack))]
    if len(outside):
        raise CurveError(
            f"{what} {outside[0]:.10g}{unit} is outside the curve, which was tested from {low:.10g} to {high:.10g}"
            f"{unit}: a spline says nothing beyond its points"
        )


def _increasing(rate: Array, output: Array, fewest: int) -> np.ndarray:
    """The order of increasing rate; refuses what makes no curve."""
    if not (jnp.isfinite(rate).all() and jnp.isfinite(output).all()):
        raise CurveError("a test point is not a finite number: leave it out")
    order = np.argsort(np.asarray(rate))
    if len(order) < fewest or (jnp.diff(rate[order]) <= 0).any():
        raise CurveError(f"a curve needs {fewest} or more different rates: average the readings of each rate first")
    return order


@jax.jit
def _inverse(spline: CubicSpline, output: Float[Array, " point"]) -> Float[Array, " point"]:
    """Where a monotone spline takes some values: halvings between two knots, then Newton steps."""
    x = spline.knots
    sign = jnp.sign(spline.values[-1] - spline.values[0])
    i = jnp.clip(jnp.searchsorted(sign * spline.values, sign * output, side="right") - 1, 0, x.shape[0] - 2)

    def halve(_, bracket):
        low, high = bracket
        middle = 0.5 * (low + high)
        above = sign * spline(middle) > sign * output
        return jnp.where(above, low, middle), jnp.where(above, middle, high)

    low, high = jax.lax.fori_loop(0, HALVINGS, halve, (x[i], x[i + 1]))
    rate = 0.5 * (low + high)
    for _ in range(NEWTON_STEPS):
        rate = jnp.clip(rate - (spline(rate) - output) / spline(rate, 1), x[i], x[i + 1])
    return rate
