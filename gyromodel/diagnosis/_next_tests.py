"""What to measure next, in words, where no further test was computed."""

from __future__ import annotations

import numpy as np

from gyromodel.declarations import BEHIND, EARLIER, RATE_OF, measured
from gyromodel.diagnosis._drivers import CLOCK_DRIVER, smooth_columns
from gyromodel.diagnosis._result import Cause
from gyromodel.model import effect_class
from gyromodel.signals import Record
from gyromodel.units import factor

# What parts two effects that no other course of the same columns does, or not as directly as this.
BETWEEN_PAIRS = {
    frozenset({"temperature_lag", "bias_temperature_rate"}): (
        "Log one more thermometer, at the coil itself: the bias is a plain function of its reading if the first one is "
        "late, and keeps a part that follows the temperature's rate if not. Or ramp through temperatures where the "
        "bias rises and where it falls: what a late thermometer makes changes sign between them."
    ),
    frozenset({"time_delay", "bandwidth"}): (
        "Drive the rate at higher frequencies than here: a lag attenuates there and its phase levels off, while the "
        "phase of a delay grows on."
    ),
}


def test_of_driver(driver: str) -> str:
    """What to measure of an error that follows some columns and has no name."""
    bases, forms = zip(*(measured(c) for c in smooth_columns(driver)), strict=True)
    if bases == ("time",):
        return "Repeat the run from power-on, everything held: noise does not come back."
    if driver == CLOCK_DRIVER:
        return "Compare the clocks of gyro and reference at the beginning and the end, or record both by one clock."
    if any(base.startswith("acceleration_") for base in bases):
        between = " and ".join(bases)
        return f"Repeat the run with attitudes between those of this one, so that {between} takes more values."
    how = "in steps up and down"
    if RATE_OF in forms:
        how = "in ramps of several speeds up and down"
    elif {EARLIER, BEHIND} & set(forms):
        how = "in steps held until nothing changes any more"
    varied = [base for base in bases if base != "time"]
    return f"Vary {' and '.join(varied)} alone, {how}, everything else held, and repeat the run."


def test_of_names(names: list[str], record: Record, cause: Cause) -> str:
    """What to measure to tell names apart, the first of which is that of a cause, where no computed test does."""
    if "outliers" in names and cause.points and "rate" in record.signals:
        rate = np.asarray(record.signals["rate"])[list(cause.points)] * factor("rad/s", "deg/s")
        levels = ", ".join(dict.fromkeys(f"{r:.4g}" for r in sorted(rate)))
        return (
            f"Repeat the points at {levels} deg/s several times, in both directions and in random order: anomalous "
            "test points do not come back, a curve does."
        )
    if "quantisation" in names:
        return effect_class("quantisation").test
    if {"bias_periodic", "noise_quantisation"} <= set(names):
        return (
            "Run the rates at another speed, or read the output in finer steps: what rounding makes of a steady change "
            "moves or vanishes, a line stays."
        )
    if any(n.startswith("noise_") for n in names) and not all(n.startswith("noise_") for n in names):
        return "Repeat the run: a deterministic change comes back the same, noise does not."
    if all(n.startswith("noise_") for n in names):
        return (
            "A longer record at rest: in the Allan deviation flicker levels off, a random walk goes on rising and a "
            "Markov process falls again."
        )
    alike = [pair for pair in BETWEEN_PAIRS if pair <= {*names}]
    rest = [n for n in names if n != "outliers" and not n.startswith("noise_") and not any(n in p for p in alike)]
    return " ".join(dict.fromkeys([*(BETWEEN_PAIRS[p] for p in alike), *(effect_class(n).test for n in rest)]))
