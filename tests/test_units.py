"""Units: sizes come from scipy.constants (SI definitions), temperatures from their definitions."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import constants

from gyromodel.units import (
    UnitError,
    convertible,
    factor,
    from_internal,
    internal_unit,
    parse,
    quantity,
    tidy,
    to_internal,
)

DEG, HOUR = constants.degree, constants.hour
# text: (internal unit, size in it)
SIZES = {
    "s": ("s", 1.0),
    "ms": ("s", 1e-3),
    "min": ("s", constants.minute),
    "h": ("s", HOUR),
    "day": ("s", constants.day),
    "deg": ("rad", DEG),
    "arcsec": ("rad", constants.arcsecond),
    "arcmin": ("rad", constants.arcminute),
    "mrad": ("rad", 1e-3),
    "rev": ("rad", 2 * math.pi),
    "deg/s": ("rad/s", DEG),
    "mdps": ("rad/s", DEG * 1e-3),
    "deg/h": ("rad/s", DEG / HOUR),
    "nrad/s": ("rad/s", 1e-9),
    "rpm": ("rad/s", 2 * math.pi / 60),
    "Hz": ("1/s", 1.0),
    "deg/sqrt(h)": ("rad/sqrt(s)", DEG / math.sqrt(HOUR)),
    "deg/h/sqrt(h)": ("rad/s^1.5", DEG / HOUR**1.5),
    "deg/h/degC": ("rad/s/degC", DEG / HOUR),
    "deg/h/(degC/s)": ("rad/degC", DEG / HOUR),
    "deg/h/g": ("rad*s/m", DEG / HOUR / constants.g),
    "deg/h/G": ("rad/s/T", DEG / HOUR * 1e4),
    "m/s^2": ("m/s^2", 1.0),
    "g": ("m/s^2", constants.g),
    "mg": ("m/s^2", constants.g * 1e-3),
    "count": ("count", 1.0),
    "count/deg": ("count/rad", 1 / DEG),
    "bit/(deg/h)": ("bit*s/rad", HOUR / DEG),
    "s/rad": ("s/rad", 1.0),
    "V": ("V", 1.0),
    "mA": ("A", 1e-3),
    "kohm": ("ohm", 1e3),
    "hPa": ("Pa", 1e2),
    "mbar": ("Pa", constants.bar * 1e-3),
    "atm": ("Pa", constants.atm),
    "psi": ("Pa", constants.psi),
    "torr": ("Pa", constants.torr),
    "uT": ("T", 1e-6),
    "gauss": ("T", 1e-4),
    "kg*m^2": ("kg*m^2", 1.0),
    "ppm": ("", 1e-6),
    "%": ("", 1e-2),
    "ppm/degC": ("1/degC", 1e-6),
    "ppm/degF": ("1/degC", 1e-6 * 1.8),
    "": ("", 1.0),
    "[]": ("", 1.0),
    "1": ("", 1.0),
}


@pytest.mark.parametrize(("text", "internal", "size"), [(text, *expected) for text, expected in SIZES.items()])
def test_size_and_name_of_the_internal_unit(text: str, internal: str, size: float):
    assert internal_unit(text) == internal
    assert to_internal(np.array([0.0, 1.0, -2.5]), text) == pytest.approx([0.0, size, -2.5 * size], rel=1e-14)
    assert from_internal(size, text) == pytest.approx(1.0, rel=1e-14)
    assert convertible(text, internal)
    assert factor(text, internal) == pytest.approx(size, rel=1e-14)
    assert internal_unit(internal) == internal


@pytest.mark.parametrize(
    ("text", "same"),
    [
        ("°/s", "deg/s"),
        ("dps", "deg/s"),
        ("deg/√h", "deg/sqrt(h)"),
        ("deg/√(h)", "deg/sqrt(h)"),
        ("deg/hr", "deg/h"),
        ("m/s²", "m/s^2"),
        ("m s-2", "m/s^2"),
        ("m s**-2", "m/s^2"),
        ("rad·s⁻¹", "rad/s"),
        ("degrees", "deg"),
        ("degree_Celsius", "degC"),
        ("°C", "degC"),
        ("ppm/°C", "ppm/degC"),
        ("ppm/K", "ppm/degC"),
        ("µT", "uT"),
        ("kΩ", "kohm"),
        (" [deg / s] ", "deg/s"),
        ("1/s", "Hz"),
        ("degC/degC", ""),
    ],
)
def test_other_spellings(text: str, same: str):
    assert parse(text).dimensionality == parse(same).dimensionality
    assert to_internal(2.0, text) == pytest.approx(to_internal(2.0, same), rel=1e-14)


@pytest.mark.parametrize(
    ("text", "degrees"), [("degC", 25.0), ("K", 25.0 + 273.15), ("degF", 77.0), ("mK", (25.0 + 273.15) * 1e3)]
)
def test_a_plain_temperature_is_absolute(text: str, degrees: float):
    assert to_internal(degrees, text) == pytest.approx(25.0, abs=1e-10)
    assert from_internal(25.0, text) == pytest.approx(degrees, rel=1e-12)


def test_a_temperature_factor_is_a_difference():
    assert factor("degF", "degC") == pytest.approx(5 / 9)
    assert factor("K", "degC") == 1.0


def test_celsius_passes_through_unchanged(rng: np.random.Generator):
    values = rng.normal(size=100)
    assert (to_internal(values, "degC") == values).all()
    assert to_internal(values, "degC") is not values


@pytest.mark.parametrize(
    ("a", "b", "same"),
    [
        ("deg/s", "rad/h", True),
        ("deg/s", "Hz", False),  # an angle is no plain number
        ("count", "bit", False),
        ("count", "", False),
        ("g", "m/s^2", True),
        ("g", "kg", False),
        ("degC", "K", True),
        ("deg/h/degC", "deg/h/K", True),
    ],
)
def test_what_converts(a: str, b: str, same: bool):
    assert convertible(a, b) is same
    if not same:
        with pytest.raises(UnitError, match="different things"):
            factor(a, b)


@pytest.mark.parametrize(
    "text",
    [
        "furlong", "C", "Deg/s", "ss", "degs/s", "seconds since 1970-01-01", "deg//s", "deg/", "/s", "(deg", "deg)",
        "2 s", "9**9**9**9", "s^999", "s^1e9", "s^", "sqrt", "deg.s", "x" * 1000, "(" * 90, "\0", "٣", "s٣",
        "__import__",
    ],
)  # fmt: skip
def test_what_is_refused(text: str):
    with pytest.raises(UnitError) as caught:
        parse(text)
    assert len(str(caught.value)) < 500
    assert "\n" not in str(caught.value)


def test_an_unknown_unit_names_itself_and_what_is_accepted():
    with pytest.raises(UnitError, match=r"unknown unit 'furlong' in 'furlong/h' \(accepted: s, .*deg/h.*count"):
        parse("furlong/h")


@given(st.text(max_size=30) | st.text("degshrac mV/*^()√°²-12.", max_size=20))
def test_any_text_is_a_unit_or_a_unit_error(text: str):
    try:
        unit = internal_unit(text)
    except UnitError:
        return
    assert convertible(unit, text)
    assert math.isfinite(float(to_internal(1.0, text)))
    assert tidy(tidy(text)) == tidy(text)
    assert parse(tidy(text)) == parse(text)


@given(st.sampled_from(sorted(SIZES)), st.floats(-1e6, 1e6))
def test_there_and_back(text: str, value: float):
    assert from_internal(to_internal(value, text), text) == pytest.approx(value, rel=1e-14, abs=1e-300)


@pytest.mark.parametrize(
    ("text", "number", "unit"),
    [
        ("1000 count/deg", 1000.0, "count/deg"),
        ("-1.5e-3 deg/h", -1.5e-3, "deg/h"),
        ("+.5deg", 0.5, "deg"),
        ("7", 7.0, ""),
        ("7 []", 7.0, ""),
        ("3 1/s", 3.0, "1/s"),
        ("12 [deg/s]", 12.0, "deg/s"),
    ],
)
def test_quantity(text: str, number: float, unit: str):
    assert quantity(text) == (number, unit)


@pytest.mark.parametrize("text", ["", "deg", "1e999 s", "nan s", "1.2.3 s", "count 5"])
def test_no_quantity(text: str):
    with pytest.raises(UnitError, match="expected a number and a unit, such as '1000 count/deg'"):
        quantity(text)


def test_quantity_in_an_unknown_unit():
    with pytest.raises(UnitError, match="unknown unit 'furlong'"):
        quantity("5 furlong")
