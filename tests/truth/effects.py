"""What can be wrong with a gyro, from the physics: each function returns the error in rate (rad/s) on a design.

The first argument is the design as lived (true columns), the second the amplitude in SI (degC for temperature,
scale errors as fractions). Shape parameters are keyword arguments, drawn off any grid by `SHAPES`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from .designs import Design
from .memory import (
    bias_readout_code,
    bias_thermal_hysteresis,
    bias_turn_on,
    coil_temperature_rate,
    draw_hysteresis,
    draw_table,
    rate_hysteresis,
    scale_drift,
)
from .motion import MOTION_EFFECTS, MOTION_SHAPES
from .other_designs import OTHER_EFFECTS, OTHER_SHAPES

Array = np.ndarray
Effect = Callable[..., Array]


# Scale: error = scale error times rate.
def scale_factor(design: Design, amplitude: float) -> Array:
    """Constant scale error."""
    return amplitude * design.true["rate"]


def scale_asymmetry(design: Design, amplitude: float) -> Array:
    """Scale differs between the two senses by `amplitude`."""
    rate = design.true["rate"]
    return np.where(rate > 0, 0.5, -0.5) * amplitude * rate


def scale_nonlinearity(design: Design, amplitude: float, mix: Array) -> Array:
    """Polynomial output error: mix holds the orders 2 ... 5 relative to full scale."""
    rate = design.true["rate"]
    full = np.abs(rate).max()
    return amplitude * full * sum(m * (rate / full) ** k for k, m in enumerate(mix, start=2))


def scale_temperature(design: Design, amplitude: float) -> Array:
    """Scale error proportional to temperature."""
    return amplitude * (design.true["temperature"] - 20.0) * design.true["rate"]


def scale_temperature_curve(design: Design, amplitude: float, kind: str, at: float) -> Array:
    """Scale error curved in temperature."""
    return amplitude * _curve(design.true["temperature"], kind, at) * design.true["rate"]


def scale_sagnac_sine(design: Design, amplitude: float) -> Array:
    """Open-loop FOG without linearisation; amplitude is the Sagnac phase per rate (s).

    The detector sees 1 + cos(phase + depth cos theta); the demodulated first harmonic is the output.
    """
    theta = 2 * np.pi * np.arange(64) / 64
    depth = 1.8

    def demodulated(phase: Array) -> Array:
        intensity = 1 + np.cos(phase[:, None] + depth * np.cos(theta))
        return intensity @ np.cos(theta)

    rate = design.true["rate"]
    small = 1e-4
    slope = (demodulated(np.array([small])) - demodulated(np.array([-small])))[0] / (2 * np.sin(small))
    return demodulated(amplitude * rate) / slope / amplitude - rate


# Bias by temperature.
def _curve(temperature: Array, kind: str, at: float) -> Array:
    """Parabola around `at`, or a bend at `at`."""
    return (temperature - at) ** 2 if kind == "parabola" else np.maximum(temperature - at, 0.0)


def bias_temperature(design: Design, amplitude: float) -> Array:
    """Bias proportional to temperature."""
    return amplitude * (design.true["temperature"] - 20.0)


def bias_temperature_curve(design: Design, amplitude: float, kind: str, at: float) -> Array:
    """Bias curved in temperature."""
    return amplitude * _curve(design.true["temperature"], kind, at)


def bias_temperature_rate(design: Design, amplitude: float, tau: float) -> Array:
    """Shupe: bias proportional to the rate of the coil's temperature."""
    time, surface = design.thermal
    return amplitude * np.interp(design.true["time"], time, coil_temperature_rate(time, surface, tau))


def bias_temperature_product(design: Design, amplitude: float, tau: float) -> Array:
    """Shupe whose coefficient changes with temperature and is zero in the middle."""
    temperature = design.true["temperature"]
    return bias_temperature_rate(design, amplitude, tau) * (temperature - temperature.mean())


# Bias by time.
def bias(design: Design, amplitude: float) -> Array:
    """Constant bias."""
    return np.full(len(design.index), amplitude)


def bias_drift(design: Design, amplitude: float) -> Array:
    """Linear drift."""
    return amplitude * design.true["time"]


def bias_step(design: Design, amplitude: float, at: float) -> Array:
    """Jump at one time."""
    return amplitude * (design.true["time"] > at)


def bias_warmup(design: Design, amplitude: float, tau: float) -> Array:
    """Exponential decay from power-on."""
    return amplitude * np.exp(-design.true["time"] / tau)


def bias_periodic(design: Design, amplitude: float, frequency: float, phase: float) -> Array:
    """A spectral line."""
    return amplitude * np.sin(2 * np.pi * frequency * design.true["time"] + phase)


# Bias by another channel.
def _linear(column: str) -> Effect:
    def effect(design: Design, amplitude: float) -> Array:
        values = design.true[column]
        return amplitude * (values - values.mean())

    effect.__doc__ = f"Bias proportional to {column}."
    return effect


# In no catalogue.
def _unit(design: Design, column: str) -> Array:
    """Column mapped to 0 ... 1 over its range."""
    values = design.true[column]
    return (values - values.min()) / np.ptp(values)


def _ripple(column: str) -> Effect:
    def effect(design: Design, amplitude: float, cycles: float, phase: float) -> Array:
        return amplitude * np.sin(2 * np.pi * cycles * _unit(design, column) + phase)

    effect.__doc__ = f"Bias rippling with {column}, several periods over its range."
    return effect


def pressure_bump(design: Design, amplitude: float, at: float, width: float) -> Array:
    """Bias in a narrow band of pressure."""
    return amplitude * np.exp(-0.5 * ((_unit(design, "pressure") - at) / width) ** 2)


def pressure_switch(design: Design, amplitude: float, at: float, width: float) -> Array:
    """Bias that switches within a narrow band of pressure and back beyond a wider one."""
    u = _unit(design, "pressure")
    return amplitude * (np.tanh((u - at) / width) - np.tanh((u - at - 0.4) / width))


def rate_temperature_bump(design: Design, amplitude: float, at: tuple[float, float], width: float) -> Array:
    """Error only near one rate at one temperature: follows neither column alone."""
    u, v = _unit(design, "rate"), _unit(design, "temperature")
    return amplitude * np.exp(-0.5 * (((u - at[0]) / width) ** 2 + ((v - at[1]) / width) ** 2))


def temperature_rate_switch(design: Design, amplitude: float, width: float) -> Array:
    """Bias that saturates with the temperature's rate: joints that slip as soon as it moves."""
    rate = design.true["temperature_rate"]
    return amplitude * np.tanh(rate / (width * np.abs(rate).max()))


def buried_temperature_ripple(design: Design, amplitude: float, cycles: float, phase: float, lag: float) -> Array:
    """Bias rippling with the temperature of a place that follows the thermometer some time later."""
    time, surface = design.thermal
    before = np.interp(design.true["time"] - lag * np.ptp(time), time, surface)
    return amplitude * np.sin(2 * np.pi * cycles * (before - before.min()) / np.ptp(before) + phase)


EFFECTS: dict[str, Effect] = {
    f.__name__: f
    for f in (
        scale_factor, scale_asymmetry, scale_nonlinearity, scale_temperature, scale_temperature_curve,
        scale_sagnac_sine, bias, bias_temperature, bias_temperature_curve, bias_temperature_rate,
        bias_drift, bias_step, bias_warmup, bias_periodic, bias_temperature_product, bias_thermal_hysteresis,
        rate_hysteresis, bias_turn_on, scale_drift, bias_readout_code,
    )
} | {f"bias_{c}": _linear(c) for c in ("supply_voltage", "pressure", "laser_current")}  # fmt: skip
EFFECTS |= MOTION_EFFECTS | OTHER_EFFECTS

RIPPLING = ("temperature", "rate", "supply_voltage", "acceleration_spin", "vibration")
UNKNOWN: dict[str, tuple[Effect, tuple[str, ...]]] = {  # effect and the columns it follows
    **{f"{c}_ripple": (_ripple(c), (c,)) for c in RIPPLING},
    "pressure_bump": (pressure_bump, ("pressure",)),
    "pressure_switch": (pressure_switch, ("pressure",)),
    "rate_temperature_bump": (rate_temperature_bump, ("rate", "temperature")),
    "temperature_rate_switch": (temperature_rate_switch, ("d(temperature)/dt",)),
    "buried_temperature_ripple": (buried_temperature_ripple, ("temperature[earlier]",)),
}


def _draw_curve(design: Design, rng: np.random.Generator) -> dict[str, Any]:
    low, high = np.percentile(design.true["temperature"], [25, 75])
    return {"kind": str(rng.choice(["parabola", "bend"])), "at": rng.uniform(low, high)}


def _draw_mix(design: Design, rng: np.random.Generator) -> dict[str, Any]:
    mix = rng.standard_normal(4) * (rng.random(4) < 0.5)
    mix[rng.integers(4)] = rng.choice([-1.0, 1.0])
    return {"mix": mix}


def _draw_line(design: Design, rng: np.random.Generator) -> dict[str, Any]:
    span = np.ptp(design.true["time"])
    return {"frequency": rng.uniform(5 / span, 0.2 / design.step), "phase": rng.uniform(0, 2 * np.pi)}


def _draw_ripple(design: Design, rng: np.random.Generator) -> dict[str, Any]:
    return {"cycles": rng.uniform(3.0, 5.5), "phase": rng.uniform(0, 2 * np.pi)}


SHAPES: dict[str, Callable[[Design, np.random.Generator], dict[str, Any]]] = (
    {
        "scale_nonlinearity": _draw_mix,
        "scale_temperature_curve": _draw_curve,
        "bias_temperature_curve": _draw_curve,
        "bias_temperature_rate": lambda design, rng: {"tau": rng.uniform(1.0, 4.0) * design.step},
        "bias_temperature_product": lambda design, rng: {"tau": rng.uniform(1.0, 4.0) * design.step},
        "bias_thermal_hysteresis": lambda design, rng: draw_hysteresis(design.true["temperature"], rng),
        "rate_hysteresis": lambda design, rng: draw_hysteresis(design.true["rate"], rng),
        "bias_turn_on": lambda design, rng: {"offsets": rng.standard_normal(len(np.unique(design.true["run"])))},
        "bias_readout_code": lambda design, rng: draw_table(rng),
        "bias_step": lambda design, rng: {"at": rng.uniform(*np.quantile(design.true["time"], [0.1, 0.9]))},
        "bias_warmup": lambda design, rng: {"tau": rng.uniform(0.05, 0.25) * design.true["time"][-1]},
        "bias_periodic": _draw_line,
        **{f"{c}_ripple": _draw_ripple for c in RIPPLING},
        "temperature_rate_switch": lambda design, rng: {"width": rng.uniform(0.05, 0.15)},
        "buried_temperature_ripple": lambda design, rng: {
            "cycles": rng.uniform(2.0, 3.0),
            "phase": rng.uniform(0, 2 * np.pi),
            "lag": rng.uniform(0.02, 0.06),
        },
        "pressure_bump": lambda design, rng: {"at": rng.uniform(0.3, 0.7), "width": rng.uniform(0.06, 0.12)},
        "pressure_switch": lambda design, rng: {"at": rng.uniform(0.2, 0.4), "width": rng.uniform(0.02, 0.05)},
        "rate_temperature_bump": lambda design, rng: {
            "at": (rng.uniform(0.25, 0.75), rng.uniform(0.25, 0.75)),
            "width": rng.uniform(0.12, 0.2),
        },
    }
    | MOTION_SHAPES
    | OTHER_SHAPES
)


def draw_shape(name: str, design: Design, rng: np.random.Generator) -> dict[str, Any]:
    """Shape parameters of an effect on a design."""
    return SHAPES[name](design, rng) if name in SHAPES else {}


def error(name: str, design: Design, amplitude: float, shape: dict[str, Any]) -> Array:
    """Rate error of a catalogued or unknown effect."""
    effect = EFFECTS[name] if name in EFFECTS else UNKNOWN[name][0]
    return effect(design, amplitude, **shape)
