"""Units at the border: text in files and reports on one side, the package's fixed internal units on the other.

Inside, everything is in s, rad, degC, m, kg, count, bit, V, A, Pa, T, ohm and their products; dimensionless numbers
count 1. Only the units named here are accepted, so that no spelling is guessed: `g` is standard gravity, `h` the hour,
and the radian is a dimension of its own, which keeps deg/s apart from Hz.
"""

from __future__ import annotations

import math
import re
from functools import lru_cache
from typing import Any

import numpy as np

ZERO_CELSIUS = 273.15  # K

# pint's definition format; the first unit of a dimension is the internal one.
_DEFINITIONS = """
pico- = 1e-12
nano- = 1e-9
micro- = 1e-6
milli- = 1e-3
centi- = 1e-2
hecto- = 1e2
kilo- = 1e3
mega- = 1e6
second = [time]
minute = 60 second
hour = 3600 second
day = 86400 second
hertz = 1 / second
radian = [angle]
degree = 0.017453292519943295 radian
arcminute = degree / 60
arcsecond = degree / 3600
turn = 360 degree
rpm = turn / minute
dps = degree / second
kelvin = [temperature]
rankine = 5 / 9 * kelvin
degree_Celsius = kelvin; offset: 273.15
degree_Fahrenheit = 5 / 9 * kelvin; offset: 233.15 + 200 / 9
meter = [length]
standard_gravity = 9.80665 meter / second ** 2
kilogram = [mass]
newton = kilogram * meter / second ** 2
pascal = newton / meter ** 2
bar = 1e5 pascal
atmosphere = 101325 pascal
torr = atmosphere / 760
psi = 6894.757293168361 pascal
watt = newton * meter / second
ampere = [current]
volt = watt / ampere
ohm = volt / ampere
tesla = volt * second / meter ** 2
gauss = 1e-4 tesla
count = [count]
bit = [bit]
percent = 1e-2
ppm = 1e-6
ppb = 1e-9
"""

# canonical name: symbols that take an SI prefix | words that do not
_SPELLINGS = """
second: s | sec second seconds
minute: | min minute minutes
hour: | h hr hour hours
day: | d day days
hertz: Hz | hertz
radian: rad | radian radians
degree: deg | ° º degree degrees
arcminute: | arcmin arcminute arcminutes
arcsecond: | arcsec arcsecond arcseconds
turn: | turn turns rev revolution revolutions
rpm: | rpm
dps: dps |
kelvin: K | kelvin
degree_Celsius: | degC °C ºC ℃ celsius Celsius deg_C degree_C degrees_C degree_Celsius degree_celsius degrees_Celsius
degree_Fahrenheit: | degF °F ºF ℉ fahrenheit Fahrenheit deg_F degree_F degrees_F degree_Fahrenheit
meter: m | meter meters metre metres
centimeter: | cm
standard_gravity: g | standard_gravity
kilogram: | kg
newton: N | newton
pascal: Pa | pascal
hectopascal: | hPa
bar: bar |
atmosphere: | atm
torr: | torr Torr mmHg
psi: | psi
watt: W | watt
ampere: A | ampere amp
volt: V | volt volts
ohm: ohm Ω Ω | ohms
tesla: T | tesla
gauss: G | gauss
count: count | counts
bit: bit | bits
percent: | % percent
ppm: | ppm
ppb: | ppb
"""
_PREFIXES = {"p": "pico", "n": "nano", "u": "micro", "µ": "micro", "μ": "micro", "m": "milli", "k": "kilo", "M": "mega"}
# Internal symbols in the order in which they are written (below the line the second leads: rad/s/degC), with the unit
# whose dimension they stand for.
_INTERNAL = {
    "count": "count", "bit": "bit", "V": "volt", "A": "ampere", "Pa": "pascal", "T": "tesla", "ohm": "ohm",
    "kg": "kilogram", "rad": "radian", "m": "meter", "s": "second", "degC": "kelvin",
}  # fmt: skip
_BASE = {"[time]": "s", "[angle]": "rad", "[temperature]": "degC", "[length]": "m", "[mass]": "kg", "[current]": "A"}
_BASE |= {"[count]": "count", "[bit]": "bit"}
# An absolute temperature has an offset; the same unit inside a product is a difference and has none.
_DIFFERENCE = {"degree_Celsius": "kelvin", "degree_Fahrenheit": "rankine"}

ACCEPTED = (
    "s, ms, min, h, deg, rad, mrad, arcsec, rpm, Hz, degC, K, degF, m/s^2, g, mg, count, bit, V, mA, Pa, kPa, mbar, "
    "uT, gauss, ohm, ppm, %, [] for dimensionless, and products such as deg/s, deg/h, deg/sqrt(h), count/deg, ppm/degC"
)

_TOKEN = re.compile(
    r"\s*(?:(?P<name>[^\W\d]+|[°ºΩ℃℉%][CF]?)|(?P<number>[-+]?[0-9]+(?:\.[0-9]+)?)|(?P<sign>\*\*|[*/^()√]))\s*"
)
_QUANTITY = re.compile(r"\s*([-+]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][-+]?[0-9]+)?)(?![0-9.])\s*(.*)", re.DOTALL)
_SUPERSCRIPTS = str.maketrans("⁰¹²³⁴⁵⁶⁷⁸⁹⁻⁺·⋅×", "0123456789-+***")


class UnitError(ValueError):
    """A unit is missing, unknown, or of the wrong dimension."""


def tidy(text: str) -> str:
    """The unit text without outer brackets and doubled spaces; every way to write dimensionless becomes `""`.

    Raises:
        UnitError: the text names no known unit.
    """
    text = " ".join(text.split())
    if text.startswith("[") and text.endswith("]"):
        text = text[1:-1].strip()
    return text if _powers(text) or text not in ("", "1") else ""


def parse(text: str) -> Any:
    """The pint unit that a text names; `""`, `"1"` and `"[]"` are dimensionless.

    Args:
        text: products, quotients, powers and square roots of known units: `deg/h`, `m/s^2`, `rad s-1`, `deg/√h`.

    Raises:
        UnitError: a name is unknown or the text is no unit expression.
    """
    units = _registry()
    powers = _powers(text)
    return units.Unit(units.UnitsContainer(powers))


def is_angle(text: str) -> bool:
    """Whether a unit is one of an angle, so that a column in it may wrap round."""
    return internal_unit(text) == "rad"


@lru_cache
def internal_unit(text: str) -> str:
    """The internal unit of a unit text: `deg/h` gives `rad/s`, `degF` gives `degC`, dimensionless gives `""`."""
    units = _registry()
    by_dimension = {units.Unit(name).dimensionality: symbol for symbol, name in _INTERNAL.items()}
    total: dict[str, float] = {}
    for name, power in _powers(text).items():
        dimension = units.Unit(name).dimensionality
        symbols = (
            {by_dimension[dimension]: 1} if dimension in by_dimension else {_BASE[k]: p for k, p in dimension.items()}
        )
        for symbol, times in symbols.items():
            total[symbol] = total.get(symbol, 0.0) + power * times
    above = "*".join(_power_text(s, total[s]) for s in _INTERNAL if total.get(s, 0.0) > 0)
    seconds_first = sorted(_INTERNAL, key=lambda symbol: symbol != "s")
    below = "".join("/" + _power_text(s, -total[s]) for s in seconds_first if total.get(s, 0.0) < 0)
    return (above or "1") + below if above or below else ""


def to_internal(values: Any, unit_text: str) -> np.ndarray:
    """Values in a unit of a file, in internal units; a plain temperature unit is an absolute temperature, to degC."""
    return _convert(values, unit_text, to_file=False)


def from_internal(values: Any, unit_text: str) -> np.ndarray:
    """Internal values in a unit of a file; the inverse of `to_internal`."""
    return _convert(values, unit_text, to_file=True)


def convertible(a: str, b: str) -> bool:
    """Whether two unit texts have the same dimension."""
    return parse(a).dimensionality == parse(b).dimensionality


def factor(from_text: str, to_text: str) -> float:
    """The number of `to_text` in one `from_text`; temperatures count as differences.

    Raises:
        UnitError: the dimensions differ.
    """
    if not convertible(from_text, to_text):
        raise UnitError(f"cannot convert '{from_text}' to '{to_text}': they measure different things")
    return 1.0 if _powers(from_text) == _powers(to_text) else _scale(from_text) / _scale(to_text)


def quantity(text: str) -> tuple[float, str]:
    """A number and its unit text: `"1000 count/deg"` gives `(1000.0, "count/deg")`, a bare number a unit of `""`.

    Raises:
        UnitError: no finite number stands first, or the rest is no unit.
    """
    match = _QUANTITY.fullmatch(text)
    if match is None or not math.isfinite(float(match[1])):
        raise UnitError(f"{_quoted(text)} is no quantity: expected a number and a unit, such as '1000 count/deg'")
    unit = match[2].strip()
    if unit.startswith("[") and unit.endswith("]"):
        unit = unit[1:-1].strip()
    parse(unit)
    return float(match[1]), unit


def _convert(values: Any, unit_text: str, *, to_file: bool) -> np.ndarray:
    values = np.asarray(values, dtype=float)
    powers = _powers(unit_text)
    if powers == {"degree_Celsius": 1}:
        return values.copy()
    if _is_temperature(powers):
        units = _registry()
        pair = (parse(unit_text), units.Unit("degree_Celsius"))
        source, target = reversed(pair) if to_file else pair
        return np.asarray(units.Quantity(values, source).to(target).magnitude)
    return np.asarray(values / _scale(unit_text) if to_file else values * _scale(unit_text))


def _is_temperature(powers: dict[str, float]) -> bool:
    return list(powers.values()) == [1] and _registry().Unit(next(iter(powers))).dimensionality == {"[temperature]": 1}


@lru_cache
def _scale(text: str) -> float:
    """Size of one unit in internal units, temperatures as differences."""
    units = _registry()
    container = units.UnitsContainer({_DIFFERENCE.get(name, name): power for name, power in _powers(text).items()})
    return float(units.get_base_units(container)[0])


def _power_text(symbol: str, power: float) -> str:
    if power == 0.5:
        return f"sqrt({symbol})"
    return symbol if power == 1 else f"{symbol}^{power:g}"


@lru_cache(1)
def _registry() -> Any:
    import pint

    registry: Any = pint.UnitRegistry(None)  # pyright: ignore[reportArgumentType]  (None: no definitions but ours)
    registry.load_definitions(_DEFINITIONS.strip().splitlines())
    return registry


@lru_cache(1)
def _names() -> dict[str, str]:
    """Every accepted spelling without prefix, and every prefixed symbol, with the name the registry knows."""
    exact: dict[str, str] = {}
    prefixed: dict[str, str] = {}
    for line in _SPELLINGS.strip().splitlines():
        name, _, rest = line.partition(":")
        symbols, _, words = rest.partition("|")
        exact |= dict.fromkeys(symbols.split() + words.split(), name)
        prefixed |= {p + symbol: prefix + name for symbol in symbols.split() for p, prefix in _PREFIXES.items()}
    return prefixed | exact  # the exact spelling wins: "min" is the minute, "kg" the kilogram


@lru_cache
def _powers(text: str) -> dict[str, float]:
    """Exponent of each unit in the text, units in their registry names."""
    text = text.strip()
    if text.startswith("[") and text.endswith("]"):
        text = text[1:-1].strip()
    if not text:
        return {}
    if len(text) > 100:
        raise UnitError(f"unit {_quoted(text)} is too long to be a unit")
    tokens: list[tuple[str, str]] = []
    position = 0
    plain = text.translate(_SUPERSCRIPTS)
    while position < len(plain):
        match = _TOKEN.match(plain, position)
        if match is None:
            raise UnitError(
                f"{_quoted(plain[position])} in unit {_quoted(text)} is not understood (accepted: {ACCEPTED})"
            )
        tokens.append((match.lastgroup or "", match[match.lastgroup or 0]))
        position = match.end()
    powers = _Expression(tokens, text).read()
    powers = {name: power for name, power in powers.items() if power}
    if sum(abs(power) for power in powers.values()) > 20:
        raise UnitError(f"unit {_quoted(text)} has exponents too large to be a unit")
    if powers != {"degree_Celsius": 1} and powers != {"degree_Fahrenheit": 1}:
        merged: dict[str, float] = {}
        for name, power in powers.items():
            name = _DIFFERENCE.get(name, name)
            merged[name] = merged.get(name, 0.0) + power
        powers = {name: power for name, power in merged.items() if power}
    return powers


class _Expression:
    """Recursive descent over unit tokens: product = factor (("*" | "/" | space) factor)*."""

    def __init__(self, tokens: list[tuple[str, str]], text: str) -> None:
        self.tokens = tokens
        self.text = text
        self.at = 0

    def read(self) -> dict[str, float]:
        powers = self.product()
        if self.at < len(self.tokens):
            raise self.error()
        return powers

    def error(self) -> UnitError:
        found = _quoted(self.tokens[self.at][1]) if self.at < len(self.tokens) else "its end"
        return UnitError(f"unit {_quoted(self.text)} is not understood at {found} (accepted: {ACCEPTED})")

    def peek(self, *wanted: str) -> bool:
        return self.at < len(self.tokens) and self.tokens[self.at][1] in wanted

    def take(self, *wanted: str) -> bool:
        self.at += (found := self.peek(*wanted))
        return found

    def product(self) -> dict[str, float]:
        powers = dict(self.factor())
        while self.at < len(self.tokens) and not self.peek(")"):
            sign = -1 if self.take("/") else 1
            if sign == 1:
                self.take("*")
            for name, power in self.factor().items():
                powers[name] = powers.get(name, 0.0) + sign * power
        return powers

    def factor(self) -> dict[str, float]:
        if self.at >= len(self.tokens):
            raise self.error()
        kind, token = self.tokens[self.at]
        if token in ("(", "√", "sqrt"):
            root = not self.take("(")
            self.at += root
            powers = self.factor() if root else self.bracketed()
            powers = {name: power / 2 for name, power in powers.items()} if root else powers
            return self.raised(powers, plain=False)
        if kind == "number" and token == "1":
            self.at += 1
            return {}
        if kind != "name":
            raise self.error()
        if token not in _names():
            raise UnitError(f"unknown unit {_quoted(token)}{self.inside(token)} (accepted: {ACCEPTED})")
        self.at += 1
        return self.raised({_names()[token]: 1.0}, plain=True)

    def bracketed(self) -> dict[str, float]:
        powers = self.product()
        if not self.take(")"):
            raise self.error()
        return powers

    def raised(self, powers: dict[str, float], *, plain: bool) -> dict[str, float]:
        """Apply an exponent: `^2`, `**-1`, or as CF writes it, `s-1`."""
        if not (self.take("^", "**") or (plain and self.at < len(self.tokens) and self.tokens[self.at][0] == "number")):
            return powers
        if self.at >= len(self.tokens) or self.tokens[self.at][0] != "number":
            raise self.error()
        exponent = float(self.tokens[self.at][1])
        self.at += 1
        return {name: power * exponent for name, power in powers.items()}

    def inside(self, token: str) -> str:
        return "" if token == self.text else f" in {_quoted(self.text)}"


def _quoted(text: str) -> str:
    """The text as an error shows it: on one line and short."""
    return repr(text if len(text) <= 40 else text[:37] + "...")
