"""Effects of how the gyro stands: its axes, the table under it, and the field around it.

Amplitudes are components, so that no start value is needed for a direction: north and east, cosine and sine.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterable
from typing import Any, Self

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from gyromodel._checks import CampaignError, along_axes
from gyromodel.effects._base import Effect, Signals, parameter, stack

# Harmonics of the table angle that are searched.
HARMONICS = (1, 2, 3, 4)
# What poles, teeth and bearings make, each by itself.
HIGHER = range(5, 37)
# A rate that differs from a sine of the azimuth by less than this part of itself is one.
ALIKE = 1e-3
# Amplitudes of the cosine and of the sine that are searched: both, or one, where the other is known otherwise.
PARTS = ((1, 1), (1, 0), (0, 1))


def cross_rates(names: Iterable[str]) -> list[str]:
    """The rates about the axes across the input axis among some columns; of x, y and z, those of no more than two."""
    found = [name for name in along_axes("rate", names) if name != "rate_input"]
    return found if len(found) < 3 else []


def angle_column(signals: Signals, *names: str) -> str:
    """The first of some angles that varies; else the first that is there, or the first."""
    there = [n for n in names if n in signals]
    return next((n for n in there if np.ptp(np.asarray(signals[n])) > 0), [*there, names[0]][0])


def varying(signals: Signals, names: list[str]) -> list[str]:
    """The columns that vary."""
    return [n for n in names if np.ptp(np.asarray(signals[n])) > 0]


class Misalignment(Effect):
    """I += Θ_S ω_S + Θ_O ω_O: the input axis leans towards the two others by small angles.

    In terms of rotations about x and y of a gyro whose input axis is z: Θ_y ω_x − Θ_x ω_y. `about` names the columns of
    the cross rates; if empty, all that the campaign has.
    """

    id = "misalignment"
    site = "rate"
    needs = ("rate_spin or rate_output or rate_x or rate_y or rate_z",)
    cause = "The input axis is not where the mounting faces say, so that rates about the other axes are sensed."
    test = "Turn about the other axes at rates far above the Earth's: what follows specific force stays as it is."
    untested = "the rates about the other axes do not vary, or of x, y and z it is not known which is the input axis"

    angles: Float[Array, " axis"] = parameter("arcsec", 60.0, "lean of the input axis towards each axis", default=())
    about: tuple[str, ...] = eqx.field(static=True, default=("",))

    def __post_init__(self) -> None:
        if np.size(self.angles) == 0:
            self.angles = jnp.zeros(len(self.about))

    def __check_init__(self) -> None:
        if self.angles.shape != (len(self.about),):
            raise ValueError("about names one rate for each angle")

    @property
    def columns_needed(self) -> tuple[str, ...]:
        """The cross rates."""
        return self.about if any(self.about) else self.needs

    def columns(self, signals: Signals) -> Float[Array, "sample coefficient"]:
        """The cross rates."""
        return stack(*(signals[name] for name in self.about))

    def prepared(self, signals: Signals) -> Self:
        """Take all cross rates that vary."""
        if any(self.about):
            return self
        names = cross_rates(signals)
        if not names:
            raise CampaignError(
                "misalignment: it is not known which of rate_x, rate_y and rate_z is about the input axis: name the "
                "others in the model, as about: [rate_x, rate_y]"
            )
        return type(self)(about=tuple(varying(signals, names) or names[:1]))

    @classmethod
    def candidates(cls, signals: Signals) -> list[Self]:
        """Each cross rate, and both."""
        names = varying(signals, cross_rates(signals))
        return [cls(about=s) for n in (1, 2) for s in itertools.combinations(names, n)]


class TableTilt(Effect):
    """I += A_N cos Ψ + A_E sin Ψ, Ψ the azimuth: Earth's horizontal rate through a tilt.

    A tilt of the input axis by θ from the axis of the table, or of the table from the vertical, senses θ times the
    Earth's horizontal rate, 15.04 deg/h · cos(latitude): the amplitudes over that rate are the tilt in radians. Either
    part may have no entry: that which a rate given in inertial space follows is a scale error as well.
    """

    id = "table_tilt"
    site = "rate"
    needs = ("azimuth or table_angle",)
    cause = "The input axis or the table leans, and the Earth's horizontal rate enters as the gyro turns in azimuth."
    test = "Reverse the magnetic field around the gyro, or shield it: a tilt stays, a magnetic bias does not."

    north: Float[Array, " n"] = parameter("deg/h", 0.01, "part that follows the cosine of azimuth", default=())
    east: Float[Array, " e"] = parameter("deg/h", 0.01, "part that follows the sine", default=())
    angle: str = eqx.field(static=True, default="")

    def __post_init__(self) -> None:
        self.north, self.east = _two_parts(self.north, self.east)

    @property
    def columns_needed(self) -> tuple[str, ...]:
        """The angle."""
        return (self.angle,) if self.angle else self.needs

    def columns(self, signals: Signals) -> Float[Array, "sample coefficient"]:
        """Cosine and sine of the azimuth."""
        return stack(*_waves(signals[self.angle], self.north, self.east))

    def prepared(self, signals: Signals) -> Self:
        """Take the azimuth; the table angle where there is none that varies."""
        if self.angle:
            return self
        return dataclasses.replace(self, angle=angle_column(signals, "azimuth", "table_angle"))

    @classmethod
    def hidden(cls, signals: Signals) -> str:
        """What follows the rate, too."""
        return _as_the_rate(signals, cls().prepared(signals).angle)

    @classmethod
    def candidates(cls, signals: Signals) -> list[Self]:
        """Of the one angle, if it varies, both parts, and each."""
        angle = cls().prepared(signals).angle
        parts = PARTS if varying(signals, [angle]) else ()
        return [cls(jnp.zeros(north), jnp.zeros(east), angle) for north, east in parts]


class TableHarmonic(Effect):
    """I += Σ c_k cos kΘ + s_k sin kΘ, Θ the table angle: what returns with each turn of the table.

    `orders` lists the k.
    """

    id = "table_harmonic"
    site = "rate"
    needs = ("table_angle",)
    cause = "The table's bearing, encoder or drive, or stray fields along its turn, repeat with its angle."
    test = "Turn the gyro on the table by 90°: what comes from the table stays, what comes from the gyro moves along."

    cosine: Float[Array, " order"] = parameter("deg/h", 0.1, "in-phase amplitude of each harmonic", default=())
    sine: Float[Array, " order"] = parameter("deg/h", 0.1, "quadrature amplitude of each harmonic", default=())
    orders: tuple[int, ...] = eqx.field(static=True, default=HARMONICS)

    def __post_init__(self) -> None:
        self.cosine, self.sine = (v if np.size(v) else jnp.zeros(len(self.orders)) for v in (self.cosine, self.sine))

    def __check_init__(self) -> None:
        if not self.orders or min(self.orders) < 1 or len(set(self.orders)) < len(self.orders):
            raise ValueError("orders are different whole numbers from 1 on")
        if not self.cosine.shape == self.sine.shape == (len(self.orders),):
            raise ValueError("every order needs a cosine and a sine")

    @property
    def structure(self) -> str:
        """Whether it is of high orders, of which there are many."""
        return "higher" if min(self.orders) > max(HARMONICS) else ""

    def columns(self, signals: Signals) -> Float[Array, "sample coefficient"]:
        """The cosines, then the sines."""
        phase = signals["table_angle"][:, None] * jnp.asarray(self.orders, float)
        return jnp.concatenate([jnp.cos(phase), jnp.sin(phase)], axis=1)

    @classmethod
    def candidates(cls, signals: Signals) -> list[Self]:
        """Each harmonic by itself, and all up to the second, third or fourth."""
        each = [(k,) for k in (*HARMONICS, *HIGHER)]
        return [cls(orders=o) for o in (*each, *(HARMONICS[:n] for n in (2, 3, 4)))]


class BiasMagnetic(Effect):
    """D += D_H H: bias proportional to a magnetic field, or, where none is measured, A cos Θ + B sin Θ.

    Θ is the angle by which the gyro turns in a field that stands still, `angle` its column: the azimuth, or the table
    angle where there is none. With the field measured,
    `field` names the columns of its components; if both are empty, what the campaign has.
    """

    id = "bias_magnetic"
    site = "rate"
    needs = ("magnetic_field or magnetic_field_x or magnetic_field_y or magnetic_field_z or table_angle or azimuth",)
    cause = "Faraday rotation in a fiber coil, or a field on a motor, torquer or plasma."
    test = "Reverse the magnetic field around the gyro, or shield it: a tilt stays, a magnetic bias does not."

    coefficients: Float[Array, " component"] = parameter("deg/h/gauss", 1.0, "bias per unit of a component", default=())
    cosine: Float[Array, " harmonic"] = parameter("deg/h", 0.1, "what follows the cosine of the angle", default=())
    sine: Float[Array, " harmonic"] = parameter("deg/h", 0.1, "what follows its sine", default=())
    field: tuple[str, ...] = eqx.field(static=True, default=("",))
    angle: str = eqx.field(static=True, default="")

    def __post_init__(self) -> None:
        if np.size(self.coefficients) == 0 and any(self.field):
            self.coefficients = jnp.zeros(len(self.field))
        if self.angle:
            self.cosine, self.sine = _two_parts(self.cosine, self.sine)

    def __check_init__(self) -> None:
        if self.coefficients.shape != (len(self.field) * any(self.field),):
            raise ValueError("field names one column for each coefficient")
        if not self.angle and np.size(self.cosine) + np.size(self.sine):
            raise ValueError("a cosine and a sine need an angle")

    @property
    def columns_needed(self) -> tuple[str, ...]:
        """The components of the field, or the angle."""
        named = tuple(n for n in (*self.field, self.angle) if n)
        return named or self.needs

    def columns(self, signals: Signals) -> Float[Array, "sample coefficient"]:
        """The components of the field, and cosine and sine of the angle."""
        parts = [signals[n] for n in self.field if n]
        if self.angle:
            parts += _waves(signals[self.angle], self.cosine, self.sine)
        return stack(*parts) if parts else jnp.zeros((signals["time"].shape[0], 0))

    def prepared(self, signals: Signals) -> Self:
        """Take the field where it is measured, else the angle."""
        if any(self.field) or self.angle:
            return self
        names = _field(signals)
        if names:
            return type(self)(field=tuple(varying(signals, names) or names[:1]))
        return type(self)(angle=angle_column(signals, "azimuth", "table_angle"))

    @classmethod
    def hidden(cls, signals: Signals) -> str:
        """What follows the rate, too."""
        return _as_the_rate(signals, cls().prepared(signals).angle)

    @classmethod
    def candidates(cls, signals: Signals) -> list[Self]:
        """Each component of the field that varies, and all of them, or of the angle both parts, and each."""
        names = varying(signals, _field(signals))
        if names:
            sets = dict.fromkeys([*((n,) for n in names), tuple(names)])
            return [cls(field=s) for s in sets]
        angle = cls().prepared(signals).angle
        parts = PARTS if angle and varying(signals, [angle]) else ()
        return [cls(cosine=jnp.zeros(cosine), sine=jnp.zeros(sine), angle=angle) for cosine, sine in parts]


def _two_parts(*amplitudes: Any) -> list[Array]:
    """Amplitudes of a cosine and a sine, one of each at most: of both, where none is given."""
    if max(map(np.size, amplitudes)) > 1:
        raise ValueError("there is one cosine and one sine at most")
    given = any(map(np.size, amplitudes))
    return [jnp.ravel(jnp.asarray(a if given else 0.0, float)) for a in amplitudes]


def _waves(angle: Array, cosine: Array, sine: Array) -> list[Array]:
    """The cosine and the sine of an angle, as far as they have amplitudes."""
    return [jnp.cos(angle)] * jnp.size(cosine) + [jnp.sin(angle)] * jnp.size(sine)


def _as_the_rate(signals: Signals, angle: str) -> str:
    """Why a part of what follows an angle is not seen: the rate, as that of the Earth, does so as well."""
    if not angle or "rate" not in signals:
        return ""
    rate, turned = np.asarray(signals["rate"]), np.asarray(signals[angle])
    columns = np.stack([np.ones(len(rate)), np.cos(turned), np.sin(turned)], axis=1)
    left = rate - columns @ np.linalg.lstsq(columns, rate)[0]
    alike = np.std(rate) > 0.0 and np.std(left) < ALIKE * np.std(rate)
    return "what of it follows the rate is a scale error as well: needs another latitude or rate" if alike else ""


def _field(signals: Signals) -> list[str]:
    return ["magnetic_field"] if "magnetic_field" in signals else along_axes("magnetic_field", signals)
