"""A calibration as thermal calibration parameters of a PX4 autopilot.

PX4 takes from each axis x₀ + x₁ΔT + x₂ΔT² + x₃ΔT³ (rad/s) with ΔT = T − TREF, T kept within TMIN and TMAX, in single
precision; a scale factor of a gyro it does not know.
"""

from __future__ import annotations

import math
from collections import defaultdict

import jax
import jax.numpy as jnp
import numpy as np
from numpy.polynomial import Chebyshev, Polynomial

from gyromodel import __version__
from gyromodel.effects import Effect
from gyromodel.estimate import Calibration
from gyromodel.model import ModelError
from gyromodel.units import convertible

DEGREE, POINTS = 3, 200
# MAVLink's numbers of types.
INTEGER, SINGLE = 6, 9


def as_px4(calibration: Calibration, axis: str, number: int = 0) -> str:
    """Lines of a `.params` file as ground stations read them, for one axis of one gyro.

    Args:
        calibration: its output an angular rate, its effects a bias and what follows temperature.
        axis: "x", "y" or "z".
        number: of the gyro; its TC_Gn_ID, which names the sensor, is left to the autopilot.

    Raises:
        ModelError: PX4 has no parameter for an effect, or the range of temperature is not known.
    """
    model = calibration.model
    for effect in model.effects:
        if effect.site == "gain":
            unit = getattr(effect, "unit", "")
            if not convertible(unit or "1", "1") or float(effect.value) != 1.0:  # type: ignore[attr-defined]
                raise ModelError(f"PX4 has no parameter for a gyro's {effect.label}: fit the rates it already scales")
        elif not _follows_temperature(effect):
            raise ModelError(f"PX4 has no parameter for {effect.label}: its offset is a cubic of temperature alone")
    thermal = any("temperature" in effect.columns_needed for effect in model.effects)
    if thermal and "temperature" not in calibration.validity:
        raise ModelError("the model does not say for which temperatures it holds: fit it")
    # A bias alone holds at any temperature.
    low, high = calibration.validity.get("temperature", (25.0, 25.0))
    middle = 0.5 * (low + high)
    grid = np.linspace(low, high, POINTS)
    offset = np.asarray(model.predict(_of_temperature(grid) | {"rate": jnp.zeros(POINTS)}))
    cubic = Chebyshev.fit(grid, offset, DEGREE) if high > low else Polynomial([offset[0]])
    shifted = cubic.convert(kind=Polynomial, domain=[-1, 1], window=[-1, 1])(Polynomial([middle, 1.0]))
    coefficients = np.zeros(DEGREE + 1, np.float32)
    coefficients[: len(shifted.coef)] = shifted.coef[: DEGREE + 1]
    # As the autopilot computes it.
    delta = (grid - middle).astype(np.float32)
    computed = sum((c * delta**k for k, c in enumerate(coefficients)), np.float32(0))
    departure = float(np.abs(computed - offset).max())
    index = "xyz".index(axis)
    values: list[tuple[str, float, int]] = [("TC_G_ENABLE", 1, INTEGER)]
    values += [(f"TC_G{number}_X{k}_{index}", float(c), SINGLE) for k, c in enumerate(coefficients)]
    if thermal:
        values += [(f"TC_G{number}_{end}", x, SINGLE) for end, x in (("TREF", middle), ("TMIN", low), ("TMAX", high))]
    lines = [
        f"# Offset of gyro {number} about {axis} over temperature, written by gyromodel {__version__}",
        f"# of {', '.join(model.labels)}; furthest from it in single precision: {math.degrees(departure):.2g} deg/s.",
        f"# TC_G{number}_ID has to name the sensor. Vehicle, component, name, value, type:",
    ]
    shown = (str(int(x)) if kind == INTEGER else f"{np.float32(x):.9g}" for _, x, kind in values)
    lines += [f"1\t1\t{name}\t{text}\t{kind}" for (name, _, kind), text in zip(values, shown, strict=True)]
    return "\n".join(lines) + "\n"


def _follows_temperature(effect: Effect) -> bool:
    """Whether a bias follows the temperature of the moment and nothing else, nor time."""
    alone = set(effect.columns_needed) <= {"temperature"} and not (effect.remembers or effect.scan)
    finite = effect.site == "rate" and np.isfinite(effect.contribution(_of_temperature(np.zeros(3)))).all()
    return bool(alone and finite)


def _of_temperature(values: np.ndarray) -> dict[str, jax.Array]:
    """Signals of which only the temperature is known: what reads another one has no value."""
    unknown = jnp.full(len(values), jnp.nan)
    return defaultdict(lambda: unknown, temperature=jnp.asarray(values))
