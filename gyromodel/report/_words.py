"""What effects and drivers are called in a sentence."""

from __future__ import annotations

import re
from collections.abc import Sequence

from gyromodel.declarations import column_of

PHRASES = {
    "scale_factor": "a scale-factor error",
    "scale_asymmetry": "a scale-factor asymmetry between the two senses of rotation",
    "scale_nonlinearity": "a scale-factor nonlinearity over rate",
    "scale_spline": "a smooth scale-factor curve over rate",
    "scale_sagnac_sine": "a sine-shaped response to rate (open-loop Sagnac phase)",
    "scale_temperature": "a scale factor that changes with temperature",
    "scale_temperature_curve": "a scale factor that curves with temperature",
    "scale_drift": "a scale factor that drifts in time",
    "torquer_scale": "a torquer scale error",
    "bias": "a constant bias",
    "bias_temperature": "a bias proportional to temperature",
    "bias_temperature_curve": "a bias that curves with temperature",
    "bias_temperature_rate": "a temperature-rate bias",
    "bias_temperature_gradient": "a bias proportional to a temperature difference",
    "bias_temperature_gradient_rate": "a bias proportional to the rate of a temperature difference",
    "bias_temperature_product": "a bias proportional to temperature times its rate",
    "temperature_lag": "a temperature lag between thermometer and gyro",
    "bias_thermal_hysteresis": "a thermal hysteresis of the bias",
    "bias_warmup": "a warm-up bias",
    "thermometer_error": "a thermometer error",
    "bias_turn_on": "a bias that differs between power cycles",
    "bias_drift": "a bias drift in time",
    "bias_step": "a step of the bias",
    "bias_periodic": "a periodic bias",
    "bias_acceleration_input": "a bias from acceleration along the input axis",
    "bias_acceleration_spin": "a bias from acceleration along the spin axis",
    "bias_acceleration_output": "a bias from acceleration along the output axis",
    "bias_acceleration_squared": "a bias from squared acceleration",
    "bias_vibration": "a bias from vibration",
    "bias_anisoinertia": "a bias from the product of two rates (anisoinertia)",
    "bias_magnetic": "a bias from the magnetic field",
    "bias_backscatter": "a bias from backscatter",
    "bias_null_shift": "a null-shift bias",
    "bias_readout_code": "a bias that repeats with the feedback ramp code",
    "misalignment": "a misalignment of the input axis",
    "table_tilt": "a tilt of the table",
    "table_harmonic": "a harmonic error of the table angle",
    "time_delay": "a time delay",
    "bandwidth": "a limited bandwidth",
    "output_axis_acceleration": "a response to acceleration about the output axis",
    "lock_in": "a lock-in dead band",
    "lock_in_dithered": "lock-in dead bands of the dither",
    "rate_hysteresis": "a hysteresis over rate",
    "quantisation": "a quantisation of the output",
    "saturation": "a saturation of the output",
    "outliers": "outlying points",
    "noise_white": "white rate noise (angle random walk)",
    "noise_quantisation": "quantisation noise",
    "noise_flicker": "flicker noise (bias instability)",
    "noise_random_walk": "a rate random walk",
    "noise_rate_ramp": "a rate ramp",
    "noise_markov": "correlated (Markov) noise",
    "noise_heteroscedastic": "noise whose size changes with the conditions",
    "noise_telegraph": "two-level (telegraph) noise",
    "loop_dynamics": "an error of the loop dynamics",
    "loop_resonance": "a resonance in the loop",
    "shaft_friction": "a shaft friction",
    "sync_delay": "a delay between table and platform clocks",
    "gimbal_nonorthogonality": "a non-orthogonality of the gimbals",
    "encoder_harmonic": "a harmonic error of the encoder",
    "platform_drift": "a drift of the platform",
    "none": "nothing at all",
}


def spoken(name: str) -> str:
    """A column or parameter name in words."""
    return re.sub(r"\s+", " ", name.replace("_", " ")).strip()


def driver_name(text: str) -> str:
    """The columns of a driver in words, from its label such as "smooth(rate, temperature)"."""
    columns = text.removeprefix("smooth(").removesuffix(")") if text.startswith("smooth(") else text
    return listed([spoken(column) for column in columns.split(",")])


def phrase(effect: str, kind: str = "effect") -> str:
    """An effect as a noun with its article."""
    if kind == "driver":
        return f"some smooth function of {driver_name(effect)}"
    if kind == "none":
        return PHRASES["none"]
    base = re.split(r"[\[(:]", effect, maxsplit=1)[0].strip()
    detail = effect[len(base) :].strip("[](): ")
    if base in PHRASES:
        return PHRASES[base] + (f" ({spoken(detail)})" if detail else "")
    if base.startswith("bias_"):
        return f"a bias proportional to {spoken(column_of(effect))}"
    return f"an effect named {spoken(effect)}"


def title(effect: str, kind: str = "effect") -> str:
    """An effect as the head of a table row."""
    text = re.sub(r"^(a|an) (effect named )?", "", phrase(effect, kind))
    return text[:1].upper() + text[1:]


def listed(items: Sequence[str], last: str = "and") -> str:
    """Items as a sentence lists them."""
    if len(items) < 3:
        return f" {last} ".join(items)
    return f"{', '.join(items[:-1])} {last} {items[-1]}"
