"""A stabilised platform: the Earth it is over, and its navigation from gyros and accelerometers, its gimbals."""

from gyromodel.platform._campaign import navigate_campaign
from gyromodel.platform._drift import residual_drift
from gyromodel.platform._earth import EARTH_RATE, earth_rate, gravity, radii, transport_rate
from gyromodel.platform._errors import Errors, NavigationError, navigation_error
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
from gyromodel.platform._navigation import Navigation, attitudes, navigate
from gyromodel.platform._sensitivity import attitude_sensitivity
from gyromodel.platform._simulation import Axis, simulate_axis

__all__ = [
    "EARTH_RATE",
    "Axis",
    "Errors",
    "GimbalErrors",
    "Navigation",
    "NavigationError",
    "attitude_sensitivity",
    "attitudes",
    "base_angles",
    "coning",
    "earth_rate",
    "euler_angles",
    "euler_attitude",
    "gimbal_attitude",
    "gravity",
    "integrals",
    "least_motion_gimbals",
    "navigate",
    "navigate_campaign",
    "navigation_error",
    "nulled_gimbals",
    "radii",
    "residual_drift",
    "sculling",
    "simulate_axis",
    "transport_rate",
]
