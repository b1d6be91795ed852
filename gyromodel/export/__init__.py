"""A calibration for firmware and spreadsheets: C99 source, JSON, CSV, or parameters of PX4."""

from typing import Literal

from gyromodel.estimate import Calibration
from gyromodel.export._c import as_c
from gyromodel.export._px4 import as_px4
from gyromodel.export._tables import as_csv, as_json
from gyromodel.model import ModelError

__all__ = ["Form", "export_calibration"]

Form = Literal["c", "json", "csv", "px4"]


def export_calibration(calibration: Calibration, to: Form, axis: str = "x") -> str:
    """A calibration as text for use elsewhere.

    Args:
        calibration: of `Estimate.calibration` or `read_calibration`.
        to: "c", one C99 file that maps output and covariates to the rate as `compensate` does; "json", everything that
            it takes to compute the model elsewhere; "csv", one row a number; "px4", a thermal calibration of one axis.
        axis: which one that is, of the autopilot's gyro.

    Raises:
        ModelError: the model is of a platform, or an effect does not say which columns it reads; to C, one that looks
            at other samples, or computes what a few C statements cannot; to PX4, one that it has no parameter for.
    """
    if calibration.model.domain == "platform":
        raise ModelError("a model of a platform's base corrects no gyro: only models of gyros are exported")
    for effect in calibration.model.effects:
        if unnamed := [name for name in effect.columns_needed if "<" in name]:
            raise ModelError(
                f"effect {effect.label} does not say which column {unnamed[0]} is: fit it, or state `between`"
            )
    if to == "px4":
        return as_px4(calibration, axis)
    return {"c": as_c, "json": as_json, "csv": as_csv}[to](calibration)
