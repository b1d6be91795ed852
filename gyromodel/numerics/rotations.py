"""Rotations: unit quaternions (w, x, y, z), rotation vectors (rad) and direction cosine matrices.

A quaternion, or the matrix of it, turns the components of a vector in the rotated axes (the body) into those in the
reference axes; the product of "b to a" and "c to b" is "c to a". All functions take any leading axes.
Source: M. D. Shuster, *A Survey of Attitude Representations*, J. Astronautical Sciences 41(4), 1993.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import reduce
from math import factorial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

Quaternion = Float[Array, "*#batch 4"]
Vector = Float[Array, "*#batch 3"]
Matrix = Float[Array, "*#batch 3 3"]

# Squared angle below which functions of the angle are taken from their series: there the term left out is below the
# last digit. Divided by an angle of zero they would have no derivative.
SMALL = 1e-2
TERMS = 6


def product(p: Quaternion, q: Quaternion) -> Quaternion:
    """p ∘ q: the rotation q in the axes that p has rotated."""
    a, b, c, d = _parts(p)
    w, x, y, z = _parts(q)
    return _vector(
        a * w - b * x - c * y - d * z,
        a * x + b * w + c * z - d * y,
        a * y - b * z + c * w + d * x,
        a * z + b * y - c * x + d * w,
    )


def inverse(q: Quaternion) -> Quaternion:
    """The rotation back: the conjugate of a unit quaternion."""
    return q * jnp.array([1.0, -1.0, -1.0, -1.0])


def rotate(q: Quaternion, v: Vector) -> Vector:
    """Components in the reference axes of a vector given in the rotated ones."""
    w, axis = q[..., :1], q[..., 1:]
    twice = 2.0 * cross(axis, v)
    return v + w * twice + cross(axis, twice)


def cross(a: Vector, b: Vector) -> Vector:
    """a × b, written out: it stays inside the loop that it is called from."""
    (ax, ay, az), (bx, by, bz) = _parts(a), _parts(b)
    return _vector(ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx)


def exponential(rotation_vector: Vector) -> Quaternion:
    """(cos θ/2, sin(θ/2)/θ · φ), θ = |φ|: the rotation by the angle |φ| about φ."""
    squared = _squared(rotation_vector)
    halves = [(-0.25) ** k for k in range(TERMS)]
    terms = (
        [h / factorial(2 * k) for k, h in enumerate(halves)],
        [0.5 * h / factorial(2 * k + 1) for k, h in enumerate(halves)],
    )

    def small(squared):
        return tuple(_horner(t, squared) for t in terms)

    def any_size(squared):
        cosine = _by_series(squared, lambda angle: jnp.cos(0.5 * angle), terms[0])
        return cosine, _by_series(squared, lambda angle: jnp.sin(0.5 * angle) / angle, terms[1])

    # The steps of a gyro are small: without sine and cosine they take half the time.
    cosine, sine = jax.lax.cond(jnp.all(squared < SMALL), small, any_size, squared)
    return jnp.concatenate([cosine[..., None], sine[..., None] * rotation_vector], axis=-1)


def logarithm(q: Quaternion) -> Vector:
    """The rotation vector of at most half a turn, φ = 2 atan2(|v|, w)/|v| · v for q = (w, v) with w ≥ 0."""
    q = jnp.where(q[..., :1] < 0, -q, q)
    w, axis = q[..., 0], q[..., 1:]
    squared = _squared(axis)
    # asin(s)/s in powers of s².
    terms = [factorial(2 * k) / (4**k * factorial(k) ** 2 * (2 * k + 1)) for k in range(TERMS + 1)]
    return 2.0 * _by_series(squared, lambda s: jnp.arctan2(s, w) / s, terms)[..., None] * axis


def left_jacobian(rotation_vector: Vector, v: Vector) -> Vector:
    """J(φ) v = v + (1 − cos θ)/θ² φ×v + (θ − sin θ)/θ³ φ×(φ×v): the mean of v turned by 0 to φ.

    A small change of φ by δ turns exp(φ) further by J(φ) δ about the reference axes; the transpose of J(φ) is J(−φ).
    """
    squared = _squared(rotation_vector)
    first = _by_series(
        squared,
        lambda angle: 0.5 * (jnp.sin(0.5 * angle) / (0.5 * angle)) ** 2,
        [(-1.0) ** k / factorial(2 * k + 2) for k in range(TERMS)],
    )
    second = _by_series(
        squared,
        lambda angle: (angle - jnp.sin(angle)) / angle**3,
        [(-1.0) ** k / factorial(2 * k + 3) for k in range(TERMS)],
    )
    turned = cross(rotation_vector, v)
    return v + first[..., None] * turned + second[..., None] * cross(rotation_vector, turned)


def normalise(q: Quaternion) -> Quaternion:
    """The unit quaternion along q."""
    w, x, y, z = _parts(q)
    return q / jnp.sqrt(w * w + x * x + y * y + z * z)[..., None]


def to_matrix(q: Quaternion) -> Matrix:
    """The direction cosine matrix of a unit quaternion."""
    w, x, y, z = _parts(q)
    rows = (
        _vector(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        _vector(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        _vector(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return jnp.stack(rows, axis=-2)


def from_matrix(matrix: Matrix) -> Quaternion:
    """The unit quaternion, w ≥ 0, of a direction cosine matrix.

    The row of 4 q qᵀ with the largest diagonal entry is q without loss of digits (Shepperd, J. Guidance and Control
    1(3), 1978).
    """
    (a, b, c), (d, e, f), (g, h, i) = (tuple(_parts(matrix[..., k, :])) for k in range(3))
    rows = jnp.stack(
        [
            _vector(1 + a + e + i, h - f, c - g, d - b),
            _vector(h - f, 1 + a - e - i, b + d, c + g),
            _vector(c - g, b + d, 1 - a + e - i, f + h),
            _vector(d - b, c + g, f + h, 1 - a - e + i),
        ],
        axis=-2,
    )
    largest = jnp.argmax(jnp.diagonal(rows, axis1=-2, axis2=-1), axis=-1)
    q = normalise(jnp.take_along_axis(rows, largest[..., None, None], axis=-2)[..., 0, :])
    return jnp.where(q[..., :1] < 0, -q, q)


def _parts(x: jax.Array) -> list[jax.Array]:
    return [x[..., k] for k in range(x.shape[-1])]


def _vector(*parts: jax.Array) -> jax.Array:
    return jnp.stack(parts, axis=-1)


def _squared(v: jax.Array) -> jax.Array:
    x, y, z = _parts(v)
    return x * x + y * y + z * z


def _by_series(squared: jax.Array, function: Callable[[jax.Array], jax.Array], terms: list[float]) -> jax.Array:
    """f(√s), for small s by its power series in s; neither branch meets what it cannot differentiate."""
    small = squared < SMALL
    series = _horner(terms, jnp.where(small, squared, 0.0))
    return jnp.where(small, series, function(jnp.sqrt(jnp.where(small, 1.0, squared))))


def _horner(terms: list[float], x: jax.Array) -> jax.Array:
    """Σ terms[k] xᵏ, written out."""
    return reduce(lambda total, term: total * x + term, reversed(terms), jnp.zeros_like(x))
