"""The motion of a platform's base in a logged test: what navigation and gimbals say of it, beside what the table says.

Source: Zhang, Jiang, Jing and Wang, doi:10.19306/j.cnki.2095-8110.2022.06.009, 2022, equations (1) to (7).
"""

from __future__ import annotations

import re
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from gyromodel._checks import CampaignError, first, listed
from gyromodel.attitude import COLUMNS as ATTITUDE
from gyromodel.campaign import AXES, Campaign
from gyromodel.numerics.rotations import exponential, inverse, product
from gyromodel.platform._earth import earth_rate
from gyromodel.platform._gimbals import base_angles, euler_attitude, gimbal_attitude
from gyromodel.platform._navigation import attitudes

# Outermost first: β_y', β_x, β_y, β_z.
GIMBALS = ("gimbal_y_outer", "gimbal_x", "gimbal_y", "gimbal_z")
TABLE = tuple(f"table_{axis}" for axis in AXES)
TURNS = ("roll", "azimuth", "pitch")
# Ratio of two motions, and the angle (rad) between them, that are not of one axis: degrees taken for mrad are 17.
UNLIKE, AGAINST = 15.0, np.deg2rad(150.0)


class BaseMotion(NamedTuple):
    """A platform on a vibration table, sample by sample.

    time: s; table: angles of its axes X, Y, Z as recorded, rad; base: the same angles as gimbals and navigation give
    them, rad; gimbals: as their encoders read, outermost first, rad; platform: C_p^n as quaternions; mounting: what X,
    Y, Z (rows) have of roll, azimuth and pitch; segment: number of the run that each sample is of.
    """

    time: Float[np.ndarray, " sample"]
    table: Float[np.ndarray, "sample 3"]
    base: Float[np.ndarray, "sample 3"]
    gimbals: Float[np.ndarray, "sample 4"]
    platform: Float[np.ndarray, "sample 4"]
    mounting: Float[np.ndarray, "3 3"]
    segment: Int[np.ndarray, " sample"]


def is_platform(campaign: Campaign) -> bool:
    """Whether a campaign is of a platform in gimbals on a table rather than of gyros."""
    return any(name in campaign.columns for name in GIMBALS)


def base_motion(campaign: Campaign) -> BaseMotion:
    """Navigate the platform, project its attitude through the gimbals, and lay the result beside the table's angles.

    Args:
        campaign: `table_x/_y/_z` and `gimbal_y_outer`, `gimbal_x`, `gimbal_y`, `gimbal_z`; `output_x/_y/_z`, the rates
            of the platform body in inertial space, where they were logged: without, it keeps its inertial attitude.
            `segment` numbers runs; without, gaps divide them. Metadata `latitude_deg`; `heading_deg`, the azimuth of
            the base where the table's is zero (0 by default), unless the rows have the attitude of the platform
            (`attitude_w/_x/_y/_z`), of which the first of each run is used; and `table_axes`, what X, Y, Z turn:
            "roll, azimuth, pitch" as in the source by default, with a minus sign for the other sense.

    Raises:
        CampaignError: something of that is missing or unusable.
    """
    if missing := [name for name in (*TABLE, *GIMBALS) if name not in campaign.columns]:
        raise CampaignError(f"{campaign.name}: a platform's test needs columns {listed(missing)}")
    if not isinstance(latitude := campaign.metadata.get("latitude_deg"), int | float):
        raise CampaignError(f"{campaign.name}: a platform's test needs metadata latitude_deg, where it was made")
    if not isinstance(heading := campaign.metadata.get("heading_deg", 0.0), int | float):
        raise CampaignError(f"{campaign.name}: metadata 'heading_deg' is {heading!r}, expected a number of degrees")
    mounting = _mounting(campaign)
    # Encoders may begin anew after a turn.
    table, gimbals = (np.unwrap(_known(campaign, names, "rad"), axis=0) for names in (TABLE, GIMBALS))
    outputs = [f"output_{axis}" for axis in AXES]
    logged = [name in campaign.columns for name in outputs]
    if any(logged) and not all(logged):
        raise CampaignError(f"{campaign.name}: the rates of the platform need all of {listed(outputs)}")
    if any(logged) and campaign.metadata.get("kind") != "rate":
        raise CampaignError(f"{campaign.name}: outputs of a platform's gyros are rates here: kind must be rate")
    rates = _known(campaign, outputs, "rad/s") if all(logged) else np.zeros((len(campaign), 3))
    segment = _segments(campaign)
    begins = np.searchsorted(segment, np.arange(segment[-1] + 1))
    if set(ATTITUDE) <= set(campaign.columns):
        starts = _known(campaign, ATTITUDE, "")[begins]
        if not (np.abs(np.linalg.norm(starts, axis=1) - 1.0) < 0.01).all():
            raise CampaignError(f"{campaign.name}: the attitude at the start of a run is no unit quaternion")
        starts = starts / np.linalg.norm(starts, axis=1, keepdims=True)
    else:
        roll, azimuth, pitch = np.linalg.solve(mounting, table[begins].T)
        level = euler_attitude(jnp.asarray(np.stack([azimuth + np.deg2rad(heading), pitch, roll], axis=1)))
        starts = np.asarray(product(level, gimbal_attitude(jnp.asarray(gimbals[begins]))))
    time = campaign.si("time")
    since, align = time - time[begins][segment], (starts[segment], begins[segment])
    platform = _attitude_history(*map(jnp.asarray, (time, since, *align, rates, np.deg2rad(latitude))))
    base = np.asarray(base_angles(platform, jnp.asarray(gimbals), jnp.asarray(mounting)))
    # Whole turns and the heading stay out of what is compared.
    base = base - np.deg2rad(heading) * mounting[:, 1]
    base = base - 2 * np.pi * np.round((base[0] - table[0]) / (2 * np.pi))
    _check_alike(campaign, base, table, segment)
    return BaseMotion(time, table, base, gimbals, np.asarray(platform), mounting, segment)


def _known(campaign: Campaign, names: tuple[str, ...] | list[str], unit: str) -> np.ndarray:
    values = np.column_stack([campaign.in_unit(name, unit) for name in names])
    for name, column in zip(names, values.T, strict=True):
        if (missing := ~np.isfinite(column)).any():
            raise CampaignError(f"{campaign.name}: {name} is missing in row {first(missing)}")
    return values


def _check_alike(campaign: Campaign, base: np.ndarray, table: np.ndarray, segment: np.ndarray) -> None:
    """Refuse an axis about which the base moves by another amount than the table, or against it, in every run.

    Angles of other axes, signs or units look like a delay, or a mode, of a size that none has.
    """
    ratios: list[list[complex]] = [[], [], []]
    for k in range(segment[-1] + 1):
        rows = segment == k
        window = np.hanning(rows.sum())[:, None]
        lines = [np.fft.rfft(window * (x[rows] - x[rows].mean(0)), axis=0) for x in (base, table)]
        axis, at = np.unravel_index(np.argmax(np.abs(lines[1].T)), lines[1].T.shape)
        # The mean of what stands still leaves a rounding error.
        if np.ptp(table[rows, axis]) > 0:
            ratios[axis].append(lines[0][at, axis] / lines[1][at, axis])
    for name, found in zip(TABLE, ratios, strict=True):
        size, turned = np.abs(found), np.abs(np.angle(found))
        if found and ((size < 1 / UNLIKE) | (size > UNLIKE) | (turned > AGAINST)).all():
            raise CampaignError(
                f"{campaign.name}: gimbals and navigation move {size[0]:.2g} times as far as {name}, "
                f"{np.rad2deg(turned[0]):.0f} deg away from it: check its unit, those of the gimbals, and metadata "
                f"table_axes, which says that X, Y, Z turn {campaign.metadata.get('table_axes', ', '.join(TURNS))}"
            )


def _mounting(campaign: Campaign) -> np.ndarray:
    """Rows X, Y, Z; columns roll, azimuth, pitch."""
    text = str(campaign.metadata.get("table_axes", ", ".join(TURNS)))
    words = re.findall(r"([+−-]?)\s*([a-z]+)", text.lower())
    if sorted(word for _, word in words) != sorted(TURNS):
        raise CampaignError(
            f"{campaign.name}: metadata 'table_axes' is {text!r}, expected what X, Y, Z turn, such as "
            "'roll, azimuth, pitch' or '-pitch, -azimuth, roll'"
        )
    mounting = np.zeros((3, 3))
    for row, (sign, word) in zip(mounting, words, strict=True):
        row[TURNS.index(word)] = -1.0 if sign in ("-", "−") else 1.0
    return mounting


def _segments(campaign: Campaign) -> np.ndarray:
    for name in ("segment", "run"):
        if name in campaign.columns:
            changed = np.diff(_known(campaign, [name], "")[:, 0]) != 0
            return np.concatenate([[0], np.cumsum(changed)])
    segment = np.zeros(len(campaign), int)
    for row, _ in campaign.gaps():
        segment[row:] += 1
    return segment


@jax.jit
def _attitude_history(
    time: Float[Array, " sample"],
    since: Float[Array, " sample"],
    starts: Float[Array, "sample 4"],
    begins: Int[Array, " sample"],
    rates: Float[Array, "sample 3"],
    latitude: Array,
) -> Float[Array, "sample 4"]:
    """C_p^n while the Earth turns n, at one place: Ċ_p^n = C_p^n [ω_ip^p ×] − [ω_ie^n ×] C_p^n, anew in each run."""
    turns = 0.5 * (rates[1:] + rates[:-1]) * jnp.diff(time)[:, None]
    still = jnp.array([1.0, 0.0, 0.0, 0.0])
    turned = jnp.concatenate([still[None], attitudes(still, turns)])
    turned = product(inverse(turned[begins]), turned)
    return product(exponential(-since[:, None] * earth_rate(latitude)), product(starts, turned))
