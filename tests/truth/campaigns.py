"""Campaigns with one hidden effect of a known size: what the engine is shown, and what it should say."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from .designs import Design
from .effects import EFFECTS, UNKNOWN, draw_shape, error
from .mde import amplitude, baseline, parts
from .motion import LAGS
from .noise import Noise
from .other_designs import OTHER_BRACKETS

Array = np.ndarray

A, B, C, RUNS, LOOP = "rate_temperature", "static_cycle", "rate_steps", "repeated_runs", "closed_loop"
_TIME = ("bias_drift", "bias_step", "bias_warmup", "bias_periodic")
_SCALE = ("scale_factor", "scale_asymmetry", "scale_nonlinearity", "scale_sagnac_sine")
_THERMAL = ("bias_temperature", "bias_temperature_curve")
_FORCE = ("bias_acceleration_input", "bias_acceleration_spin", "bias_acceleration_output", "bias_acceleration_squared")
TESTABLE: dict[str, tuple[str, ...]] = {  # catalogue effects that each design can show
    A: (*_SCALE, "scale_temperature", "scale_temperature_curve", "bias", *_THERMAL, *_TIME, "bias_supply_voltage",
        "scale_drift", "rate_hysteresis"),
    B: ("bias", *_THERMAL, "bias_temperature_rate", *_TIME, "bias_supply_voltage", "bias_pressure",
        "bias_laser_current", "bias_temperature_product", "bias_thermal_hysteresis"),
    C: (*_SCALE, "scale_temperature", "bias", "bias_temperature", *_TIME, "rate_hysteresis"),
    RUNS: ("bias_turn_on",),
    LOOP: ("bias_readout_code",),
    "static_ramp": ("bias_temperature", "bias_drift"),
    "one_speed_cycle": ("bias_temperature", "bias_temperature_rate", "bias_thermal_hysteresis"),
    "tumble": (*_FORCE, "misalignment", "scale_factor", "bias_temperature"),
    "turntable": ("table_tilt", "bias_magnetic", "table_harmonic", "scale_factor", "scale_asymmetry",
                  "bias_temperature"),
    "dynamic_rates": ("bias_vibration", "bias_anisoinertia", "misalignment", "output_axis_acceleration", "time_delay",
                      "bandwidth", "scale_factor", "bias_temperature"),
    "one_axis_tumble": ("misalignment", "bias_acceleration_input", "bias_acceleration_spin"),
    "one_field": ("table_tilt", "bias_magnetic", "table_harmonic"),
    "two_thermometers": ("bias_temperature_gradient", "bias_temperature_gradient_rate", *_THERMAL,
                         "bias_temperature_rate"),
    "laser_monitors": ("bias_backscatter", "bias_null_shift", "bias_temperature", "bias_supply_voltage"),
    "slow_rates": ("lock_in", "scale_factor", "scale_asymmetry", "rate_hysteresis", "bias"),
    "many_rates": ("scale_spline", *_SCALE, "rate_hysteresis"),
    "swept_rate": ("saturation", *_SCALE, "rate_hysteresis"),
    "torqued": ("torquer_scale", "bias", "bias_temperature"),
}  # fmt: skip
HOMES = (A, B, C, RUNS, LOOP)  # designs whose effects the study hides in turn
MOTION = ("tumble", "turntable", "dynamic_rates")
UNCATALOGUED: dict[str, tuple[str, ...]] = {
    A: ("temperature_ripple", "rate_ripple", "supply_voltage_ripple", "rate_temperature_bump"),
    B: (
        "temperature_ripple",
        "supply_voltage_ripple",
        "pressure_bump",
        "pressure_switch",
        "temperature_rate_switch",
        "buried_temperature_ripple",
    ),
    C: ("rate_ripple",),
    "tumble": ("temperature_ripple", "acceleration_spin_ripple"),
    "turntable": ("temperature_ripple",),
    "dynamic_rates": ("temperature_ripple", "rate_ripple", "vibration_ripple"),
}

# What a simulation may have besides, whether or not the campaign shows it: all but what has a place to be stated.
_MORE = ("bias_drift", "bias_warmup", "scale_nonlinearity", "scale_temperature", "rate_hysteresis", "time_delay")
STATED = {
    design: tuple(dict.fromkeys(e for e in (*TESTABLE[design], *_MORE) if e not in ("bias_step", "bias_periodic")))
    for design in (A, B, C, *MOTION)
}
# Where one of these is simulated, it takes up much of another that is hidden.
ALIKE = (
    {"bias_temperature", "bias_temperature_curve"},
    {"bias_temperature_rate", "bias_thermal_hysteresis", "bias_temperature_product"},
    {"scale_factor", "scale_asymmetry", "scale_nonlinearity", "scale_sagnac_sine", "rate_hysteresis"},
    {"scale_temperature", "scale_temperature_curve", "scale_drift"},
    {"time_delay", "bandwidth", "rate_hysteresis", "output_axis_acceleration"},
    {"table_tilt", "table_harmonic", "bias_magnetic"},
)


@dataclass(frozen=True)
class Truth:
    """What was hidden: `effect` None for nothing, two joined by "+"; `driver` the columns an unknown effect follows.

    `amplitude` and `shape` are those of the first effect.
    """

    effect: str | None
    amplitude: float = 0.0
    shape: dict[str, Any] = field(default_factory=dict)
    driver: tuple[str, ...] | None = None
    baseline: tuple[str, ...] = ()
    bias: float = 0.0
    scale_error: float = 0.0
    error: Array = field(default_factory=lambda: np.zeros(0))
    errors: tuple[Array, ...] = ()  # of each effect
    noise: Array = field(default_factory=lambda: np.zeros(0))


def hide(
    effect: str | None, design: Design, noise: Noise, times_mde: float, rng: np.random.Generator
) -> tuple[dict[str, Array], dict[str, str], dict[str, str | int | float], Truth]:
    """Simulate one campaign's output with `effect` hidden at `times_mde` times its minimal detectable size.

    What the baseline model holds (bias, scale factor) has values of its own that the fit must find.
    """
    names = baseline(design, effect)
    bias = np.deg2rad(rng.uniform(-20, 20) / 3600) if "bias" in names else 0.0
    scale_error = rng.uniform(-1e-3, 1e-3) if "scale_factor" in names else 0.0
    size, shape, errors = 0.0, {}, []
    for part in parts(effect)[::-1]:
        shape = draw_shape(part, design, rng)
        size = float(rng.choice([-1, 1])) * amplitude(part, design, noise, shape, times_mde)
        if part in ("scale_sagnac_sine", *LAGS, *OTHER_BRACKETS):
            size = abs(size)  # a phase has no second sign, nor has a lag, or a width
        errors.insert(0, error(part, design, size, shape))
    wrong = sum(errors, np.zeros(len(design.index)))
    drawn = noise.sample(design, rng)
    output = design.true["rate"] * (1 + scale_error) + (wrong + bias) * (1 + scale_error) + drawn
    columns = design.columns | {"output": np.rad2deg(output)}
    driver = UNKNOWN[effect][1] if effect in UNKNOWN else None
    truth = Truth(effect, size, shape, driver, names, bias, scale_error, wrong, tuple(errors), drawn)
    return columns, design.units | {"output": "deg/s"}, dict(design.metadata), truth


def known(effect: str | None) -> bool:
    """Whether something was hidden, and all of it is in the catalogue."""
    return effect is not None and all(part in EFFECTS for part in parts(effect))
