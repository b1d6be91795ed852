"""Navigation written a second way: Cartesian and inertial, an adaptive Runge-Kutta rule, the attitude as a matrix.

Gravity is gravitation less the centrifugal part, from the closed form of normal gravity by its values at equator and
pole (Heiskanen and Moritz, *Physical Geodesy*, 1967, equation 2-78), its height term by equation 2-124. Axes at the
start: x to where equator and the meridian of Greenwich meet, z to the pole.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

A, B = 6378137.0, 6356752.3142
OMEGA = 7.292115e-5
GM = 3986004.418e8
EQUATOR, POLE = 9.7803253359, 9.8321849378

Array = np.ndarray


def axes(latitude: float, longitude: float) -> Array:
    """Columns: north, up and east in Earth-fixed axes."""
    sl, cl, so, co = np.sin(latitude), np.cos(latitude), np.sin(longitude), np.cos(longitude)
    north, up, east = (-sl * co, -sl * so, cl), (cl * co, cl * so, sl), (-so, co, 0.0)
    return np.column_stack([north, up, east])


def spin(angle: float) -> Array:
    """From Earth-fixed to inertial axes when the Earth has turned by an angle."""
    s, c = np.sin(angle), np.cos(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def cartesian(latitude: float, longitude: float, height: float) -> Array:
    """Earth-fixed position."""
    across = A**2 / np.hypot(A * np.cos(latitude), B * np.sin(latitude))
    flat = np.array([across + height, across + height, (B / A) ** 2 * across + height])
    return flat * axes(latitude, longitude)[:, 1]


def geodetic(r: Array) -> Array:
    """Latitude, longitude and height: from Bowring's latitude by fixed-point iteration."""
    rho, e2 = np.hypot(r[0], r[1]), 1 - (B / A) ** 2
    latitude = np.arctan2(r[2], rho * (1 - e2))
    for _ in range(8):
        across = A / np.sqrt(1 - e2 * np.sin(latitude) ** 2)
        latitude = np.arctan2(r[2] + e2 * across * np.sin(latitude), rho)
    height = rho * np.cos(latitude) + r[2] * np.sin(latitude) - A * np.sqrt(1 - e2 * np.sin(latitude) ** 2)
    return np.array([latitude, np.arctan2(r[1], r[0]), height])


def normal_gravity(latitude: float, height: float) -> float:
    """Gravity at a height, downwards."""
    c2, s2 = np.cos(latitude) ** 2, np.sin(latitude) ** 2
    surface = (A * EQUATOR * c2 + B * POLE * s2) / np.sqrt(A**2 * c2 + B**2 * s2)
    flattening, m = 1 - B / A, OMEGA**2 * A**2 * B / GM
    slope = 1 + flattening + m - 2 * flattening * s2
    return float(surface * (1 - 2 * slope * height / A + 3 * height**2 / A**2))


def gravitation(r: Array) -> Array:
    """At an Earth-fixed position, in Earth-fixed axes: gravity less its centrifugal part."""
    latitude, longitude, height = geodetic(r)
    down = -axes(latitude, longitude)[:, 1]
    return normal_gravity(latitude, height) * down - OMEGA**2 * np.array([r[0], r[1], 0.0])


def along(time: Array, start: Array, towards: Array, turn: float, height: float) -> tuple[Array, Array, Array]:
    """Upward normal, and Earth-fixed position and velocity, where the normal goes round a great circle.

    Args:
        time: s.
        start: normal at time zero.
        towards: unit vector at right angles to it.
        turn: rate of the normal, rad/s.
        height: above the ellipsoid, m.
    """
    s, c = np.sin(turn * time)[:, None], np.cos(turn * time)[:, None]
    n, dn, square = c * start + s * towards, turn * (c * towards - s * start), np.array([A, A, B]) ** 2
    size = np.sqrt((n * n) @ square)[:, None]
    velocity = square * (dn / size - n * ((n * dn) @ square)[:, None] / size**3)
    return n, square * n / size + height * n, velocity + height * dn


def strapdown(
    attitude: Array, velocity: Array, position: Array, rotations: Array, pushes: Array, step: float
) -> tuple[Array, Array, Array]:
    """What `navigate` returns, from increments: turns by matrices, velocity by half kicks of gravitation (Verlet).

    Args:
        attitude, velocity, position: as of `navigate`.
        rotations: rotation vector of each step in the axes of the body.
        pushes: integral of the specific force over each step in the axes of the body at its start.
        step: s.
    """
    local, r = axes(*position[:2]), cartesian(*position)
    v, matrix = local @ velocity + np.cross([0.0, 0.0, OMEGA], r), local @ attitude
    kick = 0.5 * step * gravitation(r)
    for k, (turn, push) in enumerate(zip(Rotation.from_rotvec(rotations).as_matrix(), pushes, strict=True), 1):
        pushed = matrix @ push
        r = r + step * (v + kick + 0.5 * pushed)
        earth = spin(OMEGA * k * step)
        before, kick = kick, 0.5 * step * earth @ gravitation(earth.T @ r)
        v, matrix = v + before + pushed + kick, matrix @ turn
    return _on_earth(OMEGA * step * len(pushes), r, v, matrix)


def navigate(
    attitude: Array, velocity: Array, position: Array,
    rate: Callable[[float], Array], force: Callable[[float], Array], end: float,
) -> tuple[Array, Array, Array]:  # fmt: skip
    """Cosines from platform to north-up-east, velocity and position at the end.

    Args:
        attitude: cosines from platform to north-up-east at time zero.
        velocity: north, up, east, relative to the Earth, m/s.
        position: latitude, longitude (rad), height (m).
        rate: of the platform relative to inertial space, in its axes, at a time.
        force: specific force in the axes of the platform, at a time.
        end: s.
    """
    local, r = axes(*position[:2]), cartesian(*position)
    turning = np.array([0.0, 0.0, OMEGA])
    start = np.concatenate([r, local @ velocity + np.cross(turning, r), (local @ attitude).ravel()])

    def slope(t: float, y: Array) -> Array:
        matrix, earth, (p, q, s) = y[6:].reshape(3, 3), spin(OMEGA * t), rate(t)
        acceleration = matrix @ force(t) + earth @ gravitation(earth.T @ y[:3])
        turn = matrix @ np.array([[0.0, -s, q], [s, 0.0, -p], [-q, p, 0.0]])
        return np.concatenate([y[3:6], acceleration, turn.ravel()])

    y = solve_ivp(slope, (0.0, end), start, method="DOP853", rtol=1e-13, atol=1e-13).y[:, -1]
    return _on_earth(OMEGA * end, y[:3], y[3:6], y[6:].reshape(3, 3))


def _on_earth(angle: float, r: Array, v: Array, matrix: Array) -> tuple[Array, Array, Array]:
    """Attitude to north-up-east, velocity over the Earth and position of what is inertial, the Earth turned so far."""
    earth = spin(angle)
    r = earth.T @ r
    position = geodetic(r)
    local = axes(*position[:2])
    velocity = local.T @ (earth.T @ v - np.cross([0.0, 0.0, OMEGA], r))
    return local.T @ earth.T @ matrix, velocity, position
