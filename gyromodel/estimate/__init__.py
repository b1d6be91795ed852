"""Joint generalised least squares with the noise estimated alongside; estimates carry their covariance."""

from gyromodel.estimate._angle_noise import angle_noise, even_stretches
from gyromodel.estimate._calibration import Calibration, validity_unit
from gyromodel.estimate._estimate import Estimate, EstimateError, calibration_of, noise_table
from gyromodel.estimate._fit import (
    check_covariates,
    fit,
    fit_record,
    given_ratios,
    read_for_fit,
    refuse_apart,
    refuse_missing,
    unknown_rows,
)
from gyromodel.estimate._function import FunctionFit, fit_function
from gyromodel.estimate._many import ManyFits, fit_many
from gyromodel.estimate._noise import with_noise_intervals
from gyromodel.estimate._rounding import Unrounded, as_read, step_of, unrounded, widened, with_reading, with_step_of
from gyromodel.estimate._two_stage import two_stage
from gyromodel.estimate._whitening import filter_of, make_filter, pad_columns, whiten_columns

__all__ = [
    "Calibration",
    "Estimate",
    "EstimateError",
    "FunctionFit",
    "ManyFits",
    "Unrounded",
    "angle_noise",
    "as_read",
    "calibration_of",
    "check_covariates",
    "even_stretches",
    "filter_of",
    "fit",
    "fit_function",
    "fit_many",
    "fit_record",
    "given_ratios",
    "make_filter",
    "noise_table",
    "pad_columns",
    "read_for_fit",
    "refuse_apart",
    "refuse_missing",
    "step_of",
    "two_stage",
    "unknown_rows",
    "unrounded",
    "validity_unit",
    "whiten_columns",
    "widened",
    "with_noise_intervals",
    "with_reading",
    "with_step_of",
]
