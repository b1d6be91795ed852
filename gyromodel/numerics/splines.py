"""Cubic splines through points in Newton form, and the smoothing spline of greatest restricted likelihood.

A spline P is held by its values and by half its second derivatives k_i = P''(x_i)/2 at the knots. Source of the form
and of the equations: Yang Heng et al., Aviation Metrology & Measurement Technology 19(3), 1999.
"""

from __future__ import annotations

from functools import partial
from typing import Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.lax.linalg import tridiagonal_solve
from jaxtyping import Array, Float

Ends = Literal["natural", "clamped", "not-a-knot"]

# Smoothness is searched at this many levels, and this far (as a factor) beyond the range in which it changes the curve.
LEVELS, BEYOND = 81, 1e6
# Golden-section steps from one level to the next: 0.618^40 of it.
GOLDEN_STEPS = 40


class CubicSpline(eqx.Module):
    """A piecewise cubic given by values and half second derivatives at its knots; leading axes of both are batches.

    Beyond its knots it continues as the straight line of its end's value and slope if `straight_ends`, else as the
    cubic of its last interval.
    """

    knots: Float[Array, " knot"]
    values: Float[Array, "*batch knot"]
    half_curvatures: Float[Array, "*batch knot"]
    straight_ends: bool = eqx.field(static=True, default=False)

    def __call__(self, points: Float[Array, " point"], order: Literal[0, 1, 2] = 0) -> Float[Array, "*batch point"]:
        """The spline at some points, or its first or second derivative."""
        return _evaluate(self, points, order)


@partial(jax.jit, static_argnames="ends")
def cubic_spline(
    knots: Float[Array, " knot"],
    values: Float[Array, "*batch knot"],
    ends: Ends = "natural",
    end_slopes: Float[Array, "*#batch 2"] | None = None,
) -> CubicSpline:
    """The cubic spline through points: one tridiagonal solve, O(knots).

    Args:
        knots: abscissae, two or more, strictly increasing; not checked.
        values: ordinates; leading axes are splines on the same knots.
        ends: "natural" ends have no curvature and continue straight; "clamped" ones have the slopes given;
            "not-a-knot" has one cubic over each outer pair of intervals (and is a parabola through three points, a line
            through two).
        end_slopes: of a clamped spline at its two ends; zero if not given.
    """
    batch, count = values.shape[:-1], knots.shape[0]
    h = jnp.diff(knots)
    lower, diagonal, upper = (jnp.zeros(count) for _ in range(3))
    diagonal = diagonal + 2.0
    right = jnp.zeros(values.shape)
    if count > 2:
        # μ_i k_{i−1} + 2 k_i + λ_i k_{i+1} = 3 c_i, with μ_i = h_{i−1}/(h_{i−1} + h_i) and λ_i = 1 − μ_i.
        mu = h[:-1] / (h[:-1] + h[1:])
        lower, upper = lower.at[1:-1].set(mu), upper.at[1:-1].set(1.0 - mu)
        right = right.at[..., 1:-1].set(3.0 * second_differences(knots, values))
    first, last = h[0] / h[min(1, count - 2)], h[-1] / h[max(-2, 1 - count)]
    if ends == "clamped":
        slopes = jnp.zeros(2) if end_slopes is None else end_slopes
        divided = jnp.diff(values) / h
        upper, lower = upper.at[0].set(1.0), lower.at[-1].set(1.0)
        right = right.at[..., 0].set(3.0 * (divided[..., 0] - slopes[..., 0]) / h[0])
        right = right.at[..., -1].set(3.0 * (slopes[..., 1] - divided[..., -1]) / h[-1])
    elif ends == "not-a-knot" and count > 3:
        # k continues its line over the first two intervals: k_1 = (1 + r) k_2 − r k_3 with r = h_1/h_2, put into the
        # equation of knot 2; the last likewise.
        diagonal = diagonal.at[1].set(2.0 + first).at[-2].set(2.0 + last)
        lower, upper = lower.at[1].set(0.0).at[-2].set(1.0 - last), upper.at[1].set(1.0 - first).at[-2].set(0.0)
    columns = right.reshape(-1, count).T
    k = tridiagonal_solve(lower, diagonal, upper, columns).T.reshape(*batch, count)
    if ends == "not-a-knot" and count > 3:
        k = k.at[..., 0].set((1.0 + first) * k[..., 1] - first * k[..., 2])
        k = k.at[..., -1].set((1.0 + last) * k[..., -2] - last * k[..., -3])
    elif ends == "not-a-knot" and count == 3:
        k = jnp.broadcast_to(second_differences(knots, values), k.shape)
    return CubicSpline(knots, values, k, straight_ends=ends == "natural")


@jax.jit
def second_differences(
    knots: Float[Array, " knot"], values: Float[Array, "*batch knot"]
) -> Float[Array, "*batch interior"]:
    """Second divided differences c_i = P[x_{i−1}, x_i, x_{i+1}] at the interior knots."""
    return jnp.diff(jnp.diff(values) / jnp.diff(knots)) / (knots[2:] - knots[:-2])


@jax.jit
def slope_jumps(spline: CubicSpline) -> Float[Array, "*batch interior"]:
    """How far the slope jumps at each interior knot, right minus left: zero if the k_i solve the spline's equations."""
    h, k = jnp.diff(spline.knots), spline.half_curvatures
    divided = jnp.diff(spline.values) / h
    after = divided - h * (2.0 * k[..., :-1] + k[..., 1:]) / 3.0
    before = divided + h * (k[..., :-1] + 2.0 * k[..., 1:]) / 3.0
    return after[..., 1:] - before[..., :-1]


@partial(jax.jit, static_argnames=("ends", "order"))
def spline_matrix(
    knots: Float[Array, " knot"],
    points: Float[Array, " point"],
    ends: Ends = "natural",
    order: Literal[0, 1, 2] = 0,
) -> Float[Array, "point knot"]:
    """The spline, or its derivative, at some points as a linear map of its values at the knots.

    A clamped spline has end slopes of zero here.
    """
    return cubic_spline(knots, jnp.eye(knots.shape[0]), ends)(points, order).T


@jax.jit
def slope_range(spline: CubicSpline) -> tuple[Float[Array, "*batch"], Float[Array, "*batch"]]:
    """Smallest and largest slope between the outer knots, exact: the slope is a parabola on each interval.

    Returns:
        The two extremes, over both ends and the vertex of each parabola.
    """
    x, h, k = spline.knots, jnp.diff(spline.knots), spline.half_curvatures
    at_knots = _evaluate(spline, x, 1)
    change = k[..., 1:] - k[..., :-1]
    # Half of P'' runs from k_i to k_{i+1}; where it crosses zero inside, P' has its vertex.
    inside = k[..., 1:] * k[..., :-1] < 0
    share = jnp.where(inside, -k[..., :-1] / jnp.where(inside, change, 1.0), 0.0)
    # P'(x_i + s h) = P'(x_i) + 2 h (k_i s + (k_{i+1} − k_i) s²/2)
    start = jnp.diff(spline.values) / h - h * (2.0 * k[..., :-1] + k[..., 1:]) / 3.0
    vertices = start + 2.0 * h * (k[..., :-1] * share + 0.5 * change * share**2)
    slopes = jnp.concatenate([at_knots, vertices], axis=-1)
    return slopes.min(axis=-1), slopes.max(axis=-1)


@partial(jax.jit, static_argnames="order")
def _evaluate(spline: CubicSpline, points: Float[Array, " point"], order: Literal[0, 1, 2]) -> Array:
    x, y, k = spline.knots, spline.values, spline.half_curvatures
    inside = jnp.clip(points, x[0], x[-1]) if spline.straight_ends else points
    i = jnp.clip(jnp.searchsorted(x, inside, side="right") - 1, 0, x.shape[0] - 2)
    left, right, h = inside - x[i], inside - x[i + 1], x[i + 1] - x[i]
    third = (k[..., i + 1] - k[..., i]) / h
    # P[x, x_i, x_{i+1}] is the mean of k at the three points, k being linear between knots.
    at_point = k[..., i] + third * left
    second = (k[..., i] + k[..., i + 1] + at_point) / 3.0
    divided = (y[..., i + 1] - y[..., i]) / h
    slope = divided + (left + right) * second + left * right * third / 3.0
    if order == 2:
        return jnp.where(inside == points, 2.0 * at_point, 0.0)
    if order == 1:
        return slope
    return y[..., i] + left * divided + left * right * second + slope * (points - inside)


class SmoothingSpline(NamedTuple):
    """A natural cubic spline with n knots, one a point, that passes near the points.

    `spline` goes through the fitted values, `covariance` is theirs (Bayesian: σ² times the posterior under the prior
    that the smoothness states, both held at their estimates), `variance` the σ² of a point of weight one, `smoothness`
    the λ of Σ w (y − f)² + λ∫f''², `degrees_of_freedom` the trace of the map from points to fitted values (2 for a
    line), `log_restricted_likelihood` its maximum.
    """

    spline: CubicSpline
    covariance: Float[Array, "point point"]
    variance: Float[Array, ""]
    smoothness: Float[Array, ""]
    degrees_of_freedom: Float[Array, ""]
    log_restricted_likelihood: Float[Array, ""]


@jax.jit
def smoothing_spline(
    points: Float[Array, " point"],
    values: Float[Array, " point"],
    weights: Float[Array, " point"] | None = None,
    smoothness: Float[Array, ""] | None = None,
    variance: Float[Array, ""] | None = None,
) -> SmoothingSpline:
    """The natural cubic smoothing spline, its smoothness by restricted maximum likelihood.

    As a mixed model, f is a line plus an integrated random walk of variance σ²/λ. What a line cannot change, Qᵀy, has
    covariance σ²(QᵀW⁻¹Q + R/λ), and its likelihood is the restricted one. Both matrices are diagonalised together once,
    O(n³): a second at some hundred points. With few points and σ² unknown, the likelihood can be greatest where the
    curve takes all scatter for its own and σ² vanishes: `degrees_of_freedom` is then near n.

    Args:
        points: abscissae, four or more, strictly increasing; not checked. Average repeated points, and weigh them.
        values: ordinates.
        weights: inverse variances up to a common factor, ones if not given.
        smoothness: λ to use instead of estimating it.
        variance: σ² to use instead of estimating it.

    Source: Green & Silverman, Nonparametric Regression and Generalized Linear Models, 1994, §2.1 and 2.3 (Q, R);
        Wecker & Ansley, J. Am. Stat. Assoc. 78, 1983 (restricted likelihood).
    """
    count = points.shape[0]
    # In a unit of mean spacing, so that Q and R are of one size.
    unit = (points[-1] - points[0]) / (count - 1)
    h = jnp.diff(points) / unit
    noise = jnp.ones(count) if weights is None else 1.0 / weights
    rows = jnp.arange(count - 2)
    q = jnp.zeros((count, count - 2)).at[rows, rows].set(1.0 / h[:-1])
    q = q.at[rows + 1, rows].set(-1.0 / h[:-1] - 1.0 / h[1:]).at[rows + 2, rows].set(1.0 / h[1:])
    r = jnp.diag((h[:-1] + h[1:]) / 3.0) + jnp.diag(h[1:-1] / 6.0, 1) + jnp.diag(h[1:-1] / 6.0, -1)
    # R = LLᵀ, and L⁻¹ QᵀW⁻¹Q L⁻ᵀ = V diag(d) Vᵀ.
    factor = jnp.linalg.cholesky(r)
    root = jax.scipy.linalg.solve_triangular(factor, (q * jnp.sqrt(noise)[:, None]).T, lower=True)
    vectors, singular, _ = jnp.linalg.svd(root, full_matrices=False)
    d = singular**2
    basis = vectors.T @ jax.scipy.linalg.solve_triangular(factor, q.T, lower=True)
    contrasts = basis @ values
    log_det_r = 2.0 * jnp.sum(jnp.log(jnp.diag(factor)))
    log_det_q = jnp.linalg.slogdet(q.T @ q)[1]

    def profile(log_ratio):
        """ln of the restricted likelihood for a ratio of walk to noise, and the best σ² for it where that is free."""
        spread = d + jnp.exp(log_ratio)
        mean = jnp.mean(contrasts**2 / spread)
        scatter = mean if variance is None else variance
        determinant = jnp.sum(jnp.log(spread)) + log_det_r - log_det_q
        return -0.5 * ((count - 2) * (jnp.log(2.0 * jnp.pi * scatter) + mean / scatter) + determinant), scatter

    if smoothness is None:
        log_ratio = _maximum(lambda x: profile(x)[0], jnp.log(d[-1] / BEYOND), jnp.log(d[0] * BEYOND))
    else:
        log_ratio = jnp.log(unit**3 / smoothness)
    likelihood, scatter = profile(log_ratio)
    ratio = jnp.exp(log_ratio)
    # f = y − W⁻¹Q (QᵀW⁻¹Q + R/λ)⁻¹ Qᵀy
    pull = noise[:, None] * basis.T
    fitted = values - pull @ (contrasts / (d + ratio))
    covariance = scatter * (jnp.diag(noise) - (pull / (d + ratio)) @ pull.T)
    return SmoothingSpline(
        cubic_spline(points, fitted),
        covariance,
        scatter,
        unit**3 / ratio,
        2.0 + jnp.sum(ratio / (d + ratio)),
        likelihood,
    )


def _maximum(function, low, high):
    """Where a function of one number is greatest: the best of many levels, then golden sections around it."""
    levels = jnp.linspace(low, high, LEVELS)
    best = levels[jnp.argmax(jax.vmap(function)(levels))]
    step = (high - low) / (LEVELS - 1)
    golden = 0.5 * (jnp.sqrt(5.0) - 1.0)

    def narrow(_, bracket):
        a, b = bracket
        left, right = b - golden * (b - a), a + golden * (b - a)
        upper = function(left) < function(right)
        return jnp.where(upper, left, a), jnp.where(upper, b, right)

    a, b = jax.lax.fori_loop(0, GOLDEN_STEPS, narrow, (best - step, best + step))
    return 0.5 * (a + b)
