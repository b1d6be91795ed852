"""A stabilised platform: the Earth it is over, and its navigation from gyros and accelerometers."""

from gyromodel.platform._acceptance import (
    FREQUENCIES,
    GAIN_LIMIT,
    PHASE_LIMIT,
    PRINTED_GAIN,
    PRINTED_PHASE,
    judge_gain,
    judge_phase,
)
from gyromodel.platform._drift import residual_drift
from gyromodel.platform._earth import EARTH_RATE, earth_rate, gravity, radii, transport_rate
from gyromodel.platform._explanations import (
    ALTERNATIVES,
    Alternative,
    Explanation,
    Points,
    explain,
    points,
    separation,
)
from gyromodel.platform._increments import coning, integrals, sculling
from gyromodel.platform._loop import Loop, Margins, Mount, margins, measured_response
from gyromodel.platform._navigation import Navigation, attitudes, navigate
from gyromodel.platform._sensitivity import attitude_sensitivity
from gyromodel.platform._vibration import PublishedResponse, SineFit, fit_sines, published_response

__all__ = [
    "ALTERNATIVES",
    "EARTH_RATE",
    "FREQUENCIES",
    "GAIN_LIMIT",
    "PHASE_LIMIT",
    "PRINTED_GAIN",
    "PRINTED_PHASE",
    "Alternative",
    "Explanation",
    "Loop",
    "Margins",
    "Mount",
    "Navigation",
    "Points",
    "PublishedResponse",
    "SineFit",
    "attitude_sensitivity",
    "attitudes",
    "coning",
    "earth_rate",
    "explain",
    "fit_sines",
    "gravity",
    "integrals",
    "judge_gain",
    "judge_phase",
    "margins",
    "measured_response",
    "navigate",
    "points",
    "published_response",
    "radii",
    "residual_drift",
    "sculling",
    "separation",
    "transport_rate",
]
