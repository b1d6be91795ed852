"""What effects and drivers are called in a sentence."""

from __future__ import annotations

import re
from collections.abc import Container, Sequence

from gyromodel.declarations import BEHIND, EARLIER, RATE_OF, column_of, measured

PHRASES = {
    "scale_factor": "a scale-factor error",
    "scale_asymmetry": "a scale-factor asymmetry between the two senses of rotation",
    "scale_nonlinearity": "a scale-factor nonlinearity over rate",
    "scale_spline": "a smooth scale-factor curve over rate",
    "scale_sagnac_sine": "a sine-shaped response to rate (open-loop Sagnac phase)",
    "scale_drift": "a scale-factor drift in time",
    "scale_temperature": "a scale factor that changes with temperature",
    "scale_temperature_curve": "a scale factor that curves with temperature",
    "torquer_scale": "a scale error of the torquer",
    "lock_in": "lock-in: a dead band around rest",
    "lock_in_dithered": "lock-in under dither: dead bands at rest and at harmonics of the dither",
    "bias": "a constant bias",
    "bias_temperature": "a bias proportional to temperature",
    "bias_temperature_curve": "a bias that curves with temperature",
    "bias_temperature_rate": "a temperature-rate bias",
    "bias_temperature_product": "a temperature-rate bias that changes with temperature",
    "temperature_lag": "a delay between thermometer and coil",
    "thermometer_error": "an error of the thermistor's calibration",
    "bias_thermal_hysteresis": "a thermal hysteresis of the bias",
    "bias_temperature_gradient": "a bias proportional to a temperature difference",
    "bias_temperature_gradient_rate": "a bias proportional to the rate of a temperature difference",
    "rate_hysteresis": "a hysteresis over rate",
    "quantisation": "a quantisation of the output",
    "saturation": "saturation: the output ends at the limits of its range",
    "bias_readout_code": "an error of the feedback ramp's codes",
    "bias_turn_on": "a bias that differs from turn-on to turn-on",
    "bias_warmup": "a warm-up bias",
    "bias_drift": "a bias drift in time",
    "bias_step": "a step of the bias",
    "bias_periodic": "a periodic bias",
    "bias_acceleration_input": "a bias from acceleration along the input axis",
    "bias_acceleration_spin": "a bias from acceleration along the spin axis",
    "bias_acceleration_output": "a bias from acceleration along the output axis",
    "bias_acceleration_squared": "a bias from products of accelerations",
    "bias_vibration": "a bias rectified from vibration",
    "bias_anisoinertia": "an anisoinertia bias",
    "bias_magnetic": "a magnetic bias",
    "bias_backscatter": "a bias from light scattered back between the beams",
    "bias_null_shift": "a bias from unequal beams (null shift)",
    "misalignment": "a misalignment of the input axis",
    "table_tilt": "a tilt of the table or the input axis",
    "table_harmonic": "an error that repeats with each turn of the table",
    "output_axis_acceleration": "a response to angular acceleration about the output axis",
    "time_delay": "a delay of the output",
    "bandwidth": "a limited bandwidth (lag)",
    "sync_delay": "a delay between the clocks of table and platform",
    "loop_resonance": "a resonance of the base on its mount",
    "shaft_friction": "friction of the shafts",
    "loop_dynamics": "a stabilisation loop other than the simulated one",
    "gimbal_nonorthogonality": "gimbal axes that are not at right angles",
    "encoder_harmonic": "an error of encoders that repeats with their angle",
    "platform_drift": "a drift of the platform in inertial space",
    "outliers": "outlying points",
    "noise_white": "white rate noise (angle random walk)",
    "noise_flicker": "flicker noise (bias instability)",
    "noise_random_walk": "a rate random walk",
    "noise_markov": "Markov noise",
    "noise_quantisation": "quantisation noise (white noise of the angle)",
    "noise_telegraph": "hops of the bias between two levels (telegraph noise)",
    "noise_heteroscedastic": "a noise level that varies",
    "noise_markov_time": "time constant of the Markov noise",
    "noise_telegraph_low": "mean time on the lower level",
    "noise_telegraph_high": "mean time on the upper level",
}


# Of an angle, such as that of a platform's base, the same names of noise mean other things.
_OF_ANGLE = {
    "noise_white": "white noise of the angle",
    "noise_flicker": "flicker noise of the angle",
    "noise_random_walk": "an angle random walk",
}
_DRIVERS = {
    "campaign": "the campaign (from run to run)",
    "table": "the table's angle",
    "table_rate": "the table's rate",
} | {f"gimbal_{name}": f"the angle of gimbal {name.replace('_', ' ')}" for name in ("y_outer", "x", "y", "z")}


def spoken(name: str) -> str:
    """A column or parameter name in words."""
    return re.sub(r"\s+", " ", name.replace("_", " ")).strip()


def driver_columns(driver: str, known: Container[str] = ()) -> list[str]:
    """The columns of a driver, from its name "smooth(a, b)", or from "a" or "a and b" of known columns."""
    if is_driver(driver):
        return [column.strip() for column in driver.removeprefix("smooth(").removesuffix(")").split(",")]
    halves = [(driver[: cut.start()], driver[cut.end() :]) for cut in re.finditer(" and ", driver)]
    pairs = [pair for pair in halves if all(measured(column)[0] in known for column in pair)]
    return [driver] if measured(driver)[0] in known or not pairs else list(pairs[0])


def is_driver(name: str) -> bool:
    """Whether a name is that of a driver and not of the catalogue."""
    return name.startswith("smooth(")


def driver_name(driver: str, known: Container[str] = ()) -> str:
    """The columns of a driver in words, from what `driver_columns` takes."""
    return listed([driven(column) for column in driver_columns(driver, known)])


def driven(column: str) -> str:
    """A column that a driver follows, or what is derived of it, in words."""
    base, form = measured(column)
    if (base, form) == ("rate", RATE_OF):
        return "angular acceleration"
    if (base, form) == ("rate", EARLIER):
        return "the root mean square of the rate some time before"
    if form == BEHIND:
        return f"the {spoken(base)} some time before, less the {spoken(base)} itself"
    after = {RATE_OF: " rate", EARLIER: " some time before"}.get(form, "")
    return _DRIVERS.get(base, spoken(base)) + after


def phrase(effect: str, kind: str = "effect") -> str:
    """An effect or a driver as a noun with its article; of kind "angle" the noise of an angle."""
    if is_driver(effect):
        return f"some smooth function of {driver_name(effect)}"
    if kind == "angle" and effect in _OF_ANGLE:
        return _OF_ANGLE[effect]
    base = re.split(r"[\[(:]", effect, maxsplit=1)[0].strip()
    detail = effect[len(base) :].strip("[](): ")
    if base in PHRASES:
        return PHRASES[base] + (f" ({spoken(detail)})" if detail else "")
    if base.startswith("bias_"):
        return f"a bias proportional to {spoken(column_of(effect))}"
    return f"an effect named {spoken(effect)}"


def definite(effect: str) -> str:
    """An effect that the simulation has, with the definite article."""
    own = {"bias": "the bias", "scale_factor": "the scale factor"}
    return own.get(effect) or re.sub(r"^an? ", "the ", phrase(effect).partition(":")[0])


def title(effect: str, kind: str = "effect") -> str:
    """An effect as the head of a table row."""
    text = re.sub(r"^(a|an) (effect named )?", "", phrase(effect, kind))
    return text[:1].upper() + text[1:]


def listed(items: Sequence[str], last: str = "and") -> str:
    """Items as a sentence lists them."""
    if len(items) < 3:
        return f" {last} ".join(items)
    return f"{', '.join(items[:-1])} {last} {items[-1]}"
