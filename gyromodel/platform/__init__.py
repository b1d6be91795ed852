"""A stabilised platform: the Earth it is over, and its navigation from gyros and accelerometers."""

from gyromodel.platform._campaign import navigate_campaign
from gyromodel.platform._drift import residual_drift
from gyromodel.platform._earth import EARTH_RATE, earth_rate, gravity, radii, transport_rate
from gyromodel.platform._errors import Errors, NavigationError, navigation_error
from gyromodel.platform._increments import coning, integrals, sculling
from gyromodel.platform._navigation import Navigation, attitudes, navigate
from gyromodel.platform._sensitivity import attitude_sensitivity

__all__ = [
    "EARTH_RATE",
    "Errors",
    "Navigation",
    "NavigationError",
    "attitude_sensitivity",
    "attitudes",
    "coning",
    "earth_rate",
    "gravity",
    "integrals",
    "navigate",
    "navigate_campaign",
    "navigation_error",
    "radii",
    "residual_drift",
    "sculling",
    "transport_rate",
]
