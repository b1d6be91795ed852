"""What specific force, fields, geometry and time do to a gyro, from the physics: errors in rate (rad/s) on a design.

A strapped-down body is turned by rotation matrices in the Earth's rate and gravity; a lag is integrated on a fine grid;
torques come from Euler's equations of the float. Amplitudes are in SI, specific forces in g.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from .designs import Design
from .motion_designs import EARTH, _about, earth_and_gravity

Array = np.ndarray
Effect = Callable[..., Array]
AXES = ("input", "output", "spin")
FINE = 40  # steps of the lag's integration in a sample


def _force(design: Design) -> Array:
    """Specific force in the body (g): gravity turned through the attitude."""
    return earth_and_gravity(design.true["turns"], 0.0)[1]


def _acceleration(axis: str) -> Effect:
    def effect(design: Design, amplitude: float) -> Array:
        return amplitude * _force(design)[:, AXES.index(axis)]

    effect.__doc__ = f"A pendulous mass: torque in proportion to the force along the {axis} axis."
    return effect


def bias_acceleration_squared(design: Design, amplitude: float, compliance: Array) -> Array:
    """A mass on unequal springs: the force displaces it, and then acts on it at the displaced place.

    `compliance` is symmetric, without trace; the moment about the output axis of displacement × force.
    """
    force = _force(design)
    return amplitude * np.einsum("ti,ij,tj->t", force, compliance, force)


def bias_vibration(design: Design, amplitude: float) -> Array:
    """Rectified vibration, by what the shaker did in each sample."""
    return amplitude * design.true["vibration"]


def bias_anisoinertia(design: Design, amplitude: float) -> Array:
    """Euler's equations of a float of unequal inertia: the torque ω × (J ω) about the output axis, over H = 1."""
    inertia = np.array([1.0, 1.7, 1.0 + amplitude])
    rates = np.column_stack([design.true[name] for name in ("rate", "rate_output", "rate_spin")])
    torque = np.cross(rates, rates * inertia)
    return -torque[:, 1]


def misalignment(design: Design, amplitude: float, towards: tuple[float, float]) -> Array:
    """The input axis rotated by small angles: what it senses less what it should."""
    output, spin = amplitude * np.asarray(towards)
    # Rotation by `spin` about the spin axis carries the input axis towards output, and so on.
    lean = (_about(2, output) @ _about(1, -spin))[:, 0]
    rates = np.column_stack([design.true[name] for name in ("rate", "rate_output", "rate_spin")])
    return rates @ (lean - np.array([1.0, 0.0, 0.0]))


def table_tilt(design: Design, amplitude: float, at: float, latitude: float) -> Array:
    """A gyro whose input axis leans from the vertical table axis by an angle, turned in azimuth under the Earth's rate.

    The table's own rate about the leaning axis differs to second order only.
    """
    earth = EARTH * np.array([0.0, np.cos(latitude), np.sin(latitude)])
    sensed = np.empty(len(design.index))
    axis = _about(2, at) @ _about(0, amplitude) @ np.array([0.0, 0.0, 1.0])
    for i, azimuth in enumerate(design.true["azimuth"]):
        sensed[i] = earth @ _about(2, -azimuth) @ axis  # azimuth counts clockwise from north
    return sensed - EARTH * np.sin(latitude)


def bias_magnetic(design: Design, amplitude: float) -> Array:
    """Proportional to the field along the gyro (gauss)."""
    return amplitude * design.true["magnetic_field"]


def table_harmonic(design: Design, amplitude: float, order: int, at: float) -> Array:
    """A bearing with `order` lobes."""
    return amplitude * np.real(np.exp(1j * (order * design.true["table_angle"] - at)))


def output_axis_acceleration(design: Design, amplitude: float) -> Array:
    """Float inertia about the output axis over H, times the case's angular acceleration there."""
    assert design.motion is not None
    return amplitude * design.motion["output"].derivative(design.true["time"])


def time_delay(design: Design, amplitude: float) -> Array:
    """What the rate was a while ago."""
    assert design.motion is not None
    rate, time = design.motion["rate"], design.true["time"]
    return rate(time - amplitude) - rate(time)


def bandwidth(design: Design, amplitude: float, damping: float | None = None) -> Array:
    """A first-order loop integrated on a fine grid (trapezoidal rule), running for long before the first sample.

    With a damping ratio one of second order, of the natural frequency 2 damping/amplitude.
    """
    assert design.motion is not None
    if damping is not None:
        return _loop(design, 2 * damping / amplitude, damping)
    rate, time = design.motion["rate"], design.true["time"]
    step = design.step / FINE
    start = max(int(np.ceil(25 * abs(amplitude) / design.step)), 1) * FINE
    fine = (np.arange(start + (len(time) - 1) * FINE + 1) - start) * step
    forced = rate(fine)
    # y' = (ω − y)/τ by the trapezoidal rule, in the difference d = y − ω, which loses no digits: d' = −d/τ − ω'.
    a = step / (2 * amplitude)
    lag = np.empty_like(fine)
    # Where the loop is far faster than the grid, the trapezoidal rule would ring: the quasi-steady lag is then exact.
    if amplitude < 0.5 * step:
        second = -np.outer(np.ones(len(fine)), rate.frequency**2)
        slopes = rate.derivative(fine)
        curve = np.sum(np.sin(np.outer(fine, rate.frequency) + rate.phase) * rate.amplitude * second, axis=1)
        return (-amplitude * slopes + amplitude**2 * curve)[start::FINE]
    lag[0] = -amplitude * rate.derivative(fine[:1])[0]
    for i in range(1, len(fine)):
        lag[i] = ((1 - a) * lag[i - 1] - (forced[i] - forced[i - 1])) / (1 + a)
    return lag[start::FINE]


def _loop(design: Design, natural: float, damping: float) -> Array:
    """A mass on a spring and a damper that the rate pulls at, output and its slope by Runge and Kutta's rule."""
    assert design.motion is not None
    rate, time = design.motion["rate"], design.true["time"]
    step = design.step / FINE
    slowest = natural * (damping - np.sqrt(max(damping**2 - 1, 0.0)))
    start = int(np.ceil(25 / slowest / design.step)) * FINE
    forced = rate((np.arange(2 * (start + (len(time) - 1) * FINE) + 1) - 2 * start) * step / 2)

    def pulled(y: float, slope: float, u: float) -> tuple[float, float]:
        return slope, natural * (natural * (u - y) - 2 * damping * slope)

    output = np.empty((len(forced) + 1) // 2)
    output[0], slope = forced[0], 0.0
    y = output[0]
    for i in range(1, len(output)):
        before, between, after = forced[2 * i - 2 : 2 * i + 1]
        a, p = pulled(y, slope, before)
        b, q = pulled(y + step / 2 * a, slope + step / 2 * p, between)
        c, r = pulled(y + step / 2 * b, slope + step / 2 * q, between)
        d, s = pulled(y + step * c, slope + step * r, after)
        y, slope = y + step / 6 * (a + 2 * b + 2 * c + d), slope + step / 6 * (p + 2 * q + 2 * r + s)
        output[i] = y
    return output[start::FINE] - rate(time)


MOTION_EFFECTS: dict[str, Effect] = {f"bias_acceleration_{axis}": _acceleration(axis) for axis in AXES} | {
    f.__name__: f
    for f in (
        bias_acceleration_squared, bias_vibration, bias_anisoinertia, misalignment, table_tilt, bias_magnetic,
        table_harmonic, output_axis_acceleration, time_delay, bandwidth,
    )
}  # fmt: skip
# Not linear in the amplitude: the sizes among which the one for a wanted signal is found; and those without a sign.
BRACKETS = {"time_delay": (1e-9, 0.1), "bandwidth": (1e-9, 0.2), "misalignment": (1e-9, 0.5), "table_tilt": (1e-9, 0.5)}
LAGS = ("time_delay", "bandwidth")


def _draw_compliance(design: Design, rng: np.random.Generator) -> dict[str, Any]:
    """One pair of axes, or all of them."""
    kind = rng.integers(3)
    if kind == 0:  # two unequal springs
        diagonal = rng.permutation([1.0, -1.0, 0.0])
        return {"compliance": np.diag(diagonal)}
    if kind == 1:  # springs that pull sideways
        matrix = np.zeros((3, 3))
        i, j = rng.permutation(3)[:2]
        matrix[i, j] = matrix[j, i] = 0.5
        return {"compliance": matrix}
    matrix = rng.standard_normal((3, 3))
    matrix = matrix + matrix.T
    return {"compliance": matrix - np.eye(3) * np.trace(matrix) / 3}


def _draw_towards(design: Design, rng: np.random.Generator) -> dict[str, Any]:
    angle = rng.uniform(0, 2 * np.pi)
    return {"towards": (np.cos(angle), np.sin(angle))}


MOTION_SHAPES: dict[str, Callable[[Design, np.random.Generator], dict[str, Any]]] = {
    "bias_acceleration_squared": _draw_compliance,
    "misalignment": _draw_towards,
    "table_tilt": lambda design, rng: {"at": rng.uniform(0, 2 * np.pi), "latitude": np.deg2rad(rng.uniform(30, 60))},
    "table_harmonic": lambda design, rng: {
        "order": 1 if design.name == "one_field" else int(rng.integers(2, 5)),
        "at": rng.uniform(0, 2 * np.pi),
    },
}


def _pairs() -> list[dict[str, Any]]:
    """Compliances that span all without trace."""
    found = [{"compliance": np.diag(d)} for d in ([1.0, -1.0, 0.0], [0.0, 1.0, -1.0])]
    for i, j in ((0, 1), (0, 2), (1, 2)):
        matrix = np.zeros((3, 3))
        matrix[i, j] = matrix[j, i] = 0.5
        found.append({"compliance": matrix})
    return found


# Shapes whose signals together span an effect.
BASIS: dict[str, list[dict[str, Any]]] = {
    "bias_acceleration_squared": _pairs(),
    "misalignment": [{"towards": (1.0, 0.0)}, {"towards": (0.0, 1.0)}],
    "table_tilt": [{"at": a, "latitude": 0.7} for a in (0.0, np.pi / 2)],
    "table_harmonic": [{"order": k, "at": a} for k in (1, 2, 3, 4) for a in (0.0, np.pi / 2)],
}
# At unit amplitude these are far from small.
SMALL = {"misalignment": 1e-4, "table_tilt": 1e-4, "time_delay": 1e-5, "bandwidth": 1e-5}
