"""Campaigns that log what few do: two thermometers, beam monitors, a torquer's current, rates near rest and very many.

And the errors that show there, from the physics, as in `effects`: rates in rad/s, temperatures in degC.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline

from .designs import FINE, THERMOMETER, Design, _build, _wander, static_cycle
from .memory import clipped, coil_temperature_rate
from .monitors import precession, unequal_beams, wandering
from .motion_designs import NOISY, _warm

Array = np.ndarray
Effect = Callable[..., Array]
LASER_RATE = np.deg2rad(15.0)  # at which a ring laser is turned while its monitors are read
TORQUED_RATE = np.deg2rad(400.0) / 3600  # of the largest current
PHASES = 4096  # of a beat
GAIN = 1.3  # of a ring laser's pass, over its mean loss


def two_thermometers(rng: np.random.Generator) -> Design:
    """The static cycle with a thermometer in the coil, into which the heat of the case diffuses."""
    design = static_cycle(rng)
    time, case = design.thermal
    rate = coil_temperature_rate(time, case, rng.uniform(300, 700))
    coil = case[0] + np.concatenate([[0.0], np.cumsum(0.5 * (rate[1:] + rate[:-1]) * FINE)])
    inside, changing = (np.interp(design.true["time"], time, values) for values in (coil, rate))
    read = inside + THERMOMETER * rng.standard_normal(len(inside))
    return replace(
        design,
        name="two_thermometers",
        columns=design.columns | {"temperature_coil": read},
        units=design.units | {"temperature_coil": "degC"},
        true=design.true | {"temperature_coil": inside, "temperature_coil_rate": changing},
    )


def laser_monitors(rng: np.random.Generator) -> Design:
    """A ring laser turned steadily, with the power scattered back and the difference of its beams."""
    step, rows = 10.0, 600
    power, loss = wandering(rows, rng), 0.02 * (wandering(rows, rng) - 0.5)
    extra = {
        "backscatter": (0.2 * power, 2e-4, "V"),
        "null_shift": (unequal_beams(loss, GAIN, 1.0)[1], 1e-4, ""),
        "supply_voltage": (5.0 + _wander(np.arange(rows) * step, 0.03, 600.0, rng), 2e-4, "V"),
    }
    steady = np.full(rows, LASER_RATE)
    more: dict[str, str | int | float] = {"test": "monitors", "gyro": "rlg"}
    design = _build("laser_monitors", np.arange(rows), step, steady, _warm(rows, step, rng), extra, more, rng)
    return replace(design, true=design.true | {"power": power, "loss": loss})


def slow_rates(rng: np.random.Generator) -> Design:
    """Rest and 16 rates a sign, most of them small, in random order, three visits of 8 s."""
    step, hold = 1.0, 8
    side = np.deg2rad(np.geomspace(0.02, 8.0, 16) * rng.uniform(0.95, 1.05, 16))
    table = np.concatenate([-side, [0.0], side])
    rate = np.concatenate([np.repeat(rng.permutation(table), hold) for _ in range(3)])
    rows = len(rate)
    more: dict[str, str | int | float] = {"test": "rate_table", "gyro": "rlg"}
    return _build("slow_rates", np.arange(rows), step, rate, _warm(rows, step, rng), {}, more, rng)


def many_rates(rng: np.random.Generator) -> Design:
    """61 rates in random order, three visits of 4 s."""
    step, hold = 1.0, 4
    table = np.deg2rad(rng.uniform(100, 200)) * np.linspace(-1, 1, 61)
    rate = np.concatenate([np.repeat(rng.permutation(table), hold) for _ in range(3)])
    rows = len(rate)
    return _build("many_rates", np.arange(rows), step, rate, _warm(rows, step, rng), {}, {"test": "rate_table"}, rng)


def swept_rate(rng: np.random.Generator) -> Design:
    """A noisy gyro swept to its full range and back as a sine, six times."""
    step, rows = 1.0, 750
    rate = np.deg2rad(rng.uniform(150, 300)) * np.sin(2 * np.pi * (np.arange(rows) / 125 + rng.uniform()))
    design = _build("swept_rate", np.arange(rows), step, rate, _warm(rows, step, rng), {}, {"test": "rates"}, rng)
    return replace(design, white=NOISY)


def torqued(rng: np.random.Generator) -> Design:
    """A platform's gyro torqued both ways by 20 currents in random order, twice for 150 s: the rest is its error."""
    step, hold = 10.0, 15
    part = np.concatenate([np.repeat(rng.permutation(np.linspace(-1, 1, 20)), hold) for _ in range(2)])
    rows = len(part)
    extra = {"torquer_current": (40.0 * part, 1e-4, "mA")}
    more: dict[str, str | int | float] = {"test": "torquing", "gyro": "rig"}
    design = _build("torqued", np.arange(rows), step, np.zeros(rows), _warm(rows, step, rng), extra, more, rng)
    columns, units = ({k: v for k, v in d.items() if k != "rate"} for d in (design.columns, design.units))
    return replace(design, columns=columns, units=units, true=design.true | {"part": part})


OTHER_DESIGNS: dict[str, Callable[[np.random.Generator], Design]] = {
    f.__name__: f for f in (two_thermometers, laser_monitors, slow_rates, many_rates, swept_rate, torqued)
}


def bias_temperature_gradient(design: Design, amplitude: float) -> Array:
    """Bias in proportion to what case and coil differ by."""
    return amplitude * (design.true["temperature"] - design.true["temperature_coil"])


def bias_temperature_gradient_rate(design: Design, amplitude: float) -> Array:
    """Bias in proportion to the rate of that difference."""
    return amplitude * (design.true["temperature_rate"] - design.true["temperature_coil_rate"])


def beat(rate: Array, lock_in_rate: Array) -> Array:
    """Mean rate of a beat's phase dψ/dt = ω − ω_L sin ψ, from the time that each turn takes; none where it locks."""
    psi = 2 * np.pi * (np.arange(PHASES) + 0.5) / PHASES
    free = np.abs(rate) > lock_in_rate
    speed = np.abs(rate[free])[:, None] - lock_in_rate[free][:, None] * np.sin(psi)
    told = np.zeros(len(rate))
    told[free] = np.sign(rate[free]) / np.mean(1.0 / speed, axis=1)
    return told


def bias_backscatter(design: Design, amplitude: float) -> Array:
    """What the power scattered back takes from a steady beat, `amplitude` at its most."""
    lock_in_rate = np.sqrt(2 * LASER_RATE * amplitude * design.true["power"])
    steady = np.full(len(lock_in_rate), LASER_RATE)
    return beat(steady, lock_in_rate) - steady


def bias_null_shift(design: Design, amplitude: float) -> Array:
    """What beams of unequal intensity are pulled apart by."""
    return unequal_beams(design.true["loss"], GAIN, amplitude)[0]


def lock_in(design: Design, amplitude: float) -> Array:
    """Beams that lock within `amplitude` of rest, and slow each other beyond it."""
    levels, of = np.unique(design.true["rate"], return_inverse=True)
    return (beat(levels, np.full(len(levels), amplitude)) - levels)[of]


def scale_spline(design: Design, amplitude: float, knots: Array, values: Array) -> Array:
    """A smooth curve over rate through some points, between the largest rates."""
    rate = design.true["rate"]
    return amplitude * CubicSpline(knots, values, bc_type="natural")(rate / np.abs(rate).max())


def saturation(design: Design, amplitude: float) -> Array:
    """An output that ends at `amplitude` below the largest rate."""
    rate = design.true["rate"]
    return clipped(rate, np.abs(rate).max() - amplitude) - rate


def torquer_scale(design: Design, amplitude: float, mix: tuple[float, float, float]) -> Array:
    """A torquer whose magnet, bridge and warmth are not what they should be."""
    error, unequal, loss = amplitude * np.asarray(mix)
    return TORQUED_RATE * precession(design.true["part"], design.true["temperature"], (error, unequal, loss / 10))


OTHER_EFFECTS: dict[str, Effect] = {
    f.__name__: f
    for f in (
        bias_temperature_gradient, bias_temperature_gradient_rate, bias_backscatter, bias_null_shift, lock_in,
        scale_spline, saturation, torquer_scale,
    )
}  # fmt: skip


def _draw_constants(design: Design, rng: np.random.Generator) -> dict[str, Any]:
    """One of a torquer's three, or all."""
    which, signs = rng.integers(4), rng.choice([-1.0, 1.0], 3)
    return {"mix": tuple(signs * (np.eye(3)[which] if which < 3 else rng.uniform(0.5, 1.0, 3)))}


def _draw_knots(design: Design, rng: np.random.Generator) -> dict[str, Any]:
    """Five to seven points, each but the outer ones moved by up to a quarter of their distance."""
    many = int(rng.integers(5, 8))
    knots = np.linspace(-1, 1, many)
    knots[1:-1] += rng.uniform(-0.25, 0.25, many - 2) * (knots[1] - knots[0])
    return {"knots": knots, "values": rng.standard_normal(many)}


OTHER_SHAPES: dict[str, Callable[[Design, np.random.Generator], dict[str, Any]]] = {
    "scale_spline": _draw_knots,
    "torquer_scale": _draw_constants,
}
# As in `motion`: sizes of what is not linear in them, without a sign; signals that span; what is small.
OTHER_BRACKETS = {
    "lock_in": (1e-9, 0.1),
    "saturation": (1e-9, 1.0),
    "bias_backscatter": (1e-12, 0.05),
    "torquer_scale": (1e-9, 0.5),
}
OTHER_BASIS: dict[str, list[dict[str, Any]]] = {"torquer_scale": [{"mix": tuple(row)} for row in np.eye(3)]}
OTHER_SMALL = {"bias_backscatter": 1e-7, "torquer_scale": 1e-4, "saturation": 0.1, "lock_in": 1e-3}
