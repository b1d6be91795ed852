"""A calibration for firmware and spreadsheets: C99 source, JSON, or CSV."""

from typing import Literal

from gyromodel.estimate import Calibration
from gyromodel.export._c import as_c
from gyromodel.export._tables import as_csv, as_json

__all__ = ["Form", "export_calibration"]

Form = Literal["c", "json", "csv"]


def export_calibration(calibration: Calibration, to: Form) -> str:
    """A calibration as text for use elsewhere.

    Args:
        calibration: of `Estimate.calibration` or `read_calibration`.
        to: "c", one C99 file that maps output and covariates to the rate as `compensate` does; "json", everything that
            it takes to compute the model elsewhere; "csv", one row a number.

    Raises:
        ModelError: to C, an effect that looks at other samples, or computes what a few C statements cannot.
    """
    return {"c": as_c, "json": as_json, "csv": as_csv}[to](calibration)
