"""A stabilised platform: its navigation over the Earth, gimbals, stabilisation loop, and angular vibration tests."""

from gyromodel.platform._acceptance import (
    FREQUENCIES,
    GAIN_LIMIT,
    PHASE_LIMIT,
    PRINTED_GAIN,
    PRINTED_PHASE,
    judge_gain,
    judge_phase,
    limits_at,
)
from gyromodel.platform._alternatives import ALTERNATIVES, ENTRIES, OFFERED, Alternative
from gyromodel.platform._assessment import VibrationTest, parameters, vibration_test
from gyromodel.platform._bench import Bench, base_on_table, simulate_vibration_test
from gyromodel.platform._campaign import navigate_campaign
from gyromodel.platform._drift import residual_drift
from gyromodel.platform._earth import EARTH_RATE, earth_rate, gravity, radii, transport_rate
from gyromodel.platform._errors import Errors, NavigationError, drift_errors, navigation_error, pushes_at_rest
from gyromodel.platform._explanations import (
    Explanation,
    Points,
    assumed_loop,
    explain,
    points,
    predicted,
    separation,
)
from gyromodel.platform._gimbals import (
    GimbalErrors,
    base_angles,
    euler_angles,
    euler_attitude,
    gimbal_attitude,
    least_motion_gimbals,
    nulled_gimbals,
)
from gyromodel.platform._increments import coning, integrals, sculling
from gyromodel.platform._judgement import EXCLUDED
from gyromodel.platform._loop import Loop, Margins, Mount, margins, measured_response
from gyromodel.platform._motion import GIMBALS, TABLE, BaseMotion, base_motion, is_platform
from gyromodel.platform._navigation import Navigation, attitudes, navigate
from gyromodel.platform._record import VibrationRecord, fit_vibration, vibration_record
from gyromodel.platform._responses import Response, responses
from gyromodel.platform._sensitivity import attitude_sensitivity
from gyromodel.platform._series import fit_series
from gyromodel.platform._simulation import Platform, PlatformMotion, simulate_platform
from gyromodel.platform._vibration import PublishedResponse, SineFit, fit_sines, published_response

__all__ = [
    "ALTERNATIVES",
    "EARTH_RATE",
    "ENTRIES",
    "EXCLUDED",
    "FREQUENCIES",
    "GAIN_LIMIT",
    "GIMBALS",
    "OFFERED",
    "PHASE_LIMIT",
    "PRINTED_GAIN",
    "PRINTED_PHASE",
    "TABLE",
    "Alternative",
    "BaseMotion",
    "Bench",
    "Errors",
    "Explanation",
    "GimbalErrors",
    "Loop",
    "Margins",
    "Mount",
    "Navigation",
    "NavigationError",
    "Platform",
    "PlatformMotion",
    "Points",
    "PublishedResponse",
    "Response",
    "SineFit",
    "VibrationRecord",
    "VibrationTest",
    "assumed_loop",
    "attitude_sensitivity",
    "attitudes",
    "base_angles",
    "base_motion",
    "base_on_table",
    "coning",
    "drift_errors",
    "earth_rate",
    "euler_angles",
    "euler_attitude",
    "explain",
    "fit_series",
    "fit_sines",
    "fit_vibration",
    "gimbal_attitude",
    "gravity",
    "integrals",
    "is_platform",
    "judge_gain",
    "judge_phase",
    "least_motion_gimbals",
    "limits_at",
    "margins",
    "measured_response",
    "navigate",
    "navigate_campaign",
    "navigation_error",
    "nulled_gimbals",
    "parameters",
    "points",
    "predicted",
    "published_response",
    "pushes_at_rest",
    "radii",
    "residual_drift",
    "responses",
    "sculling",
    "separation",
    "simulate_platform",
    "simulate_vibration_test",
    "transport_rate",
    "vibration_record",
    "vibration_test",
]
