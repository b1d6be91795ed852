"""Navigation of a measured campaign: three gyros and three accelerometers on one body."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from gyromodel._checks import CampaignError, shown
from gyromodel.attitude import COLUMNS as ATTITUDE
from gyromodel.campaign import AXES, Campaign
from gyromodel.numerics.rotations import rotate
from gyromodel.platform._earth import gravity
from gyromodel.platform._increments import CUBIC, coning, integrals, sculling
from gyromodel.platform._navigation import Navigation, navigate

# Parts of a step by which sample times may be uneven: clocks that are read to a digit.
EVEN = 0.02
# Part of gravity that the specific force of the first second (s) may differ by from that of a body at rest: another
# order or sign of the axes differs by more.
AT_REST, AT_FIRST = 0.5, 1.0
# Latitude (deg) from which on north turns about too fast for the equations.
POLAR = 89.99
PLACE = ("latitude_deg", "longitude_deg", "height_m")
WRITTEN = {
    "velocity_north": "m/s",
    "velocity_up": "m/s",
    "velocity_east": "m/s",
    "latitude": "deg",
    "longitude": "deg",
    "height": "m",
}


def navigate_campaign(campaign: Campaign) -> Campaign:
    """A campaign with the attitude, velocity and position at each of its samples, by inertial navigation alone.

    Args:
        campaign: at even times `output_x/_y/_z`, the rates of the body in inertial space (of a space-stabilised
            platform: its residual drift), `acceleration_x/_y/_z`, the specific force, and `attitude_w/_x/_y/_z`, the
            quaternion from body to north-up-east axes, of which only the first row is used; metadata `latitude_deg`
            and, where they are not zero, `longitude_deg` and `height_m`. The body starts at rest over the Earth.

    Returns:
        The campaign with its attitude replaced, velocity and position added, and metadata `navigated`.

    Raises:
        CampaignError: something of that is missing or no such thing, samples are missing or uneven, the first second
            is not that of a body at rest, or the way leads over a pole.
    """
    outputs, forces = ([f"{kind}_{axis}" for axis in AXES] for kind in ("output", "acceleration"))
    needed = [*outputs, *forces, *ATTITUDE]
    if missing := [name for name in needed if name not in campaign.columns]:
        raise CampaignError(f"{campaign.name}: navigation needs columns {', '.join(missing)}")
    if "latitude_deg" not in campaign.metadata:
        raise CampaignError(f"{campaign.name}: navigation needs metadata latitude_deg, where the body starts")
    if (kind := campaign.metadata.get("kind")) != "rate":
        raise CampaignError(f"{campaign.name}: navigation needs rates, and metadata 'kind' is {kind}")
    place = [campaign.metadata.get(key, 0.0) for key in PLACE]
    for key, value in zip(PLACE, place, strict=True):
        if isinstance(value, str):
            raise CampaignError(f"{campaign.name}: metadata '{key}' is {shown(value)}, expected a number")
    if len(campaign) < CUBIC:
        raise CampaignError(f"{campaign.name}: there are {len(campaign)} rows, and navigation needs {CUBIC} or more")
    time = campaign.si("time")
    step = float(np.mean(np.diff(time)))
    uneven = np.flatnonzero(np.abs(np.diff(time) - step) > EVEN * step)
    if len(uneven):
        raise CampaignError(f"{campaign.name}: navigation needs even times, and row {uneven[0] + 2} is off the rest")
    rates, force = (
        np.column_stack([campaign.in_unit(name, unit) for name in names])
        for names, unit in ((outputs, "rad/s"), (forces, "m/s^2"))
    )
    start = np.array([campaign.columns[name][0] for name in ATTITUDE])
    for values, names in ((rates, outputs), (force, forces), (start[None], ATTITUDE)):
        row, column = np.nonzero(~np.isfinite(values))
        if len(row):
            raise CampaignError(f"{campaign.name}: {names[column[0]]} is missing in row {row[0] + 1}")
    if abs(np.linalg.norm(start) - 1.0) > 0.01:
        raise CampaignError(f"{campaign.name}: the attitude of row 1 is no unit quaternion")
    position = jnp.array([*np.deg2rad(np.array(place[:2], float)), place[2]], float)
    begin = Navigation(jnp.asarray(start / np.linalg.norm(start)), jnp.zeros(3), position)
    _check_rest(campaign.name, begin, force[time < time[0] + AT_FIRST].mean(axis=0))
    angles, pushes = (integrals(jnp.asarray(samples), step) for samples in (rates, force))
    made = navigate(begin, coning(angles), sculling(angles, pushes), step)
    whole = [np.concatenate([np.asarray(a)[None], np.asarray(b)]) for a, b in zip(begin, made, strict=True)]
    whole[2][:, :2] = np.rad2deg(whole[2][:, :2])
    if not (np.abs(whole[2][:, 0]) < POLAR).all():
        raise CampaignError(f"{campaign.name}: navigation ends at {POLAR} deg of latitude, where north is lost")
    for name, values in zip(ATTITUDE, whole[0].T, strict=True):
        campaign = campaign.with_column(name, values, "")
    for (name, unit), values in zip(WRITTEN.items(), np.column_stack(whole[1:]).T, strict=True):
        campaign = campaign.with_column(name, values, unit)
    return campaign.with_metadata({"navigated": "attitude, velocity and position are computed from outputs and forces"})


def _check_rest(name: str, begin: Navigation, force: np.ndarray) -> None:
    """Whether gravity is where the attitude has it: in other axes, or of another sign, all that follows is wrong."""
    fall = float(gravity(begin.position[0], begin.position[2]))
    north, up, east = np.asarray(rotate(begin.attitude, jnp.asarray(force))).tolist()
    if not np.hypot(np.hypot(north, east), up - fall) < AT_REST * abs(fall):
        raise CampaignError(
            f"{name}: by the attitude of row 1 the specific force of the first second is ({north:.3g}, {up:.3g}, "
            f"{east:.3g}) m/s² north, up and east, and at rest it is (0, {fall:.3g}, 0): either is in other axes"
        )
