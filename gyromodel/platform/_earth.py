"""The Earth in local north-up-east axes: radii of curvature, normal gravity, earth and transport rate.

Source: NIMA TR8350.2, *Department of Defense World Geodetic System 1984*, third edition, 2000.
"""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

# Equatorial radius (m), flattening, rotation (rad/s) and GM (m³/s²): table 3.1.
SEMI_MAJOR_AXIS = 6378137.0
FLATTENING = 1 / 298.257223563
EARTH_RATE = 7.292115e-5
GRAVITATIONAL_CONSTANT = 3.986004418e14
# Normal gravity at the equator (m/s²), Somigliana's constant, and m = ω²a²b/GM: table 3.4.
EQUATOR_GRAVITY = 9.7803253359
SOMIGLIANA = 0.00193185265241
CENTRIFUGAL = EARTH_RATE**2 * SEMI_MAJOR_AXIS**3 * (1 - FLATTENING) / GRAVITATIONAL_CONSTANT
ECCENTRICITY_SQUARED = FLATTENING * (2 - FLATTENING)

Scalar = Float[Array, "*#batch"]
Vector = Float[Array, "*#batch 3"]


def radii(latitude: Scalar) -> tuple[Scalar, Scalar]:
    """Radii of curvature (m) along the meridian, a(1 − e²)/(1 − e² sin²L)^³⁄₂, and across, a/(1 − e² sin²L)^½.

    Args:
        latitude: geodetic, rad.
    """
    flat = 1 - ECCENTRICITY_SQUARED * jnp.sin(latitude) ** 2
    across = SEMI_MAJOR_AXIS / jnp.sqrt(flat)
    return across * (1 - ECCENTRICITY_SQUARED) / flat, across


def gravity(latitude: Scalar, height: Scalar) -> Scalar:
    """Normal gravity (m/s²), downwards: Somigliana's formula on the ellipsoid, its second order in height above.

    γ = γ_e (1 + k sin²L)/(1 − e² sin²L)^½, γ_h = γ [1 − 2(1 + f + m − 2f sin²L) h/a + 3 h²/a²] (equations 4-1, 4-3).

    Args:
        latitude: geodetic, rad.
        height: above the ellipsoid, m.
    """
    squared = jnp.sin(latitude) ** 2
    surface = EQUATOR_GRAVITY * (1 + SOMIGLIANA * squared) / jnp.sqrt(1 - ECCENTRICITY_SQUARED * squared)
    ratio = height / SEMI_MAJOR_AXIS
    return surface * (1 - 2 * (1 + FLATTENING + CENTRIFUGAL - 2 * FLATTENING * squared) * ratio + 3 * ratio**2)


def earth_rate(latitude: Scalar) -> Vector:
    """Rate of the Earth, rad/s: Ω (cos L, sin L, 0).

    Args:
        latitude: geodetic, rad.
    """
    north, up = EARTH_RATE * jnp.cos(latitude), EARTH_RATE * jnp.sin(latitude)
    return jnp.stack([north, up, jnp.zeros_like(north)], axis=-1)


def transport_rate(latitude: Scalar, height: Scalar, velocity: Vector) -> Vector:
    """Rate of the axes over the Earth, rad/s: (v_E/(R_N + h), v_E tan L/(R_N + h), −v_N/(R_M + h)).

    Args:
        latitude: geodetic, rad; the axes have no north at a pole.
        height: above the ellipsoid, m.
        velocity: north, up and east, m/s.
    """
    meridian, across = radii(latitude)
    north = velocity[..., 2] / (across + height)
    return jnp.stack([north, north * jnp.tan(latitude), -velocity[..., 0] / (meridian + height)], axis=-1)
