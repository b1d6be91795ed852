"""Numbers and units as a reader expects them: the uncertainty to two digits, the value to the same digit."""

from __future__ import annotations

import math
import re

_SYMBOLS = {"degC": "°C", "degF": "°F", "sqrt(h)": "√h", "sqrt(s)": "√s", "sqrt(Hz)": "√Hz", "ohm": "Ω", "um": "µm"}
_TIMES = {"s", "ms", "min", "h", "day", "√h", "√s", "√Hz", "Hz"}
_POWERS = str.maketrans("0123456789-.", "⁰¹²³⁴⁵⁶⁷⁸⁹⁻·")


def unit_text(unit: str) -> str:
    """A unit as print: "deg/h/degC" becomes "deg/h per °C", and a dimensionless one nothing."""
    unit = unit.strip()
    if unit in ("", "1", "[]", "dimensionless"):
        return ""
    top, *below = _divided(unit)
    text = "" if top == "1" else _pretty(top)
    named = text in ("ppm", "%")
    for part in below:
        shown = _pretty(part)
        plain = re.sub(r"[⁰¹²³⁴⁵⁶⁷⁸⁹⁻·]+$", "", shown)
        if plain in _TIMES or (plain in ("deg", "rad", "m") and "/" not in text and not named):
            text += f"/{shown}" if text else f"1/{shown}"
        else:
            text = f"{text} per {shown}".strip()
    return text


def _divided(unit: str) -> list[str]:
    """Split at the slashes that no parenthesis encloses."""
    parts, depth = [""], 0
    for letter in unit:
        depth += (letter == "(") - (letter == ")")
        if letter == "/" and depth == 0:
            parts.append("")
        else:
            parts[-1] += letter
    return [part.strip() for part in parts]


def _pretty(part: str) -> str:
    if part.startswith("(") and part.endswith(")"):
        part = part[1:-1]
    for plain, symbol in _SYMBOLS.items():
        part = re.sub(rf"(?<![A-Za-z]){re.escape(plain)}(?![A-Za-z])", symbol, part)
    part = re.sub(r"(\*\*|\^)\(?(-?[\d.]+)\)?", lambda found: found[2].translate(_POWERS), part)
    return part.replace("*", "·")


def with_uncertainty(value: float, std: float, unit: str = "") -> str:
    """A value and its standard uncertainty to the same digit, e.g. "(0.0981 ± 0.0030) deg/s per °C/s".

    Args:
        value: the value.
        std: its standard uncertainty; zero, NaN or infinity is said in words or left out.
        unit: unit text of both.
    """
    shown = unit_text(unit)
    after = f" {shown}" if shown else ""
    if not math.isfinite(value):
        return "not determined"
    if not math.isfinite(std) or std <= 0.0:
        note = " (uncertainty unknown)" if not math.isfinite(std) else ""
        return f"{number(value, 6 if std == 0 else 3)}{after}{note}"
    last = _exponent(float(f"{std:.1e}")) - 1  # position of the uncertainty's second digit, after rounding
    size = max(_exponent(round(value, -last)), last + 1)
    power = 0 if -3 <= size <= 4 and last <= 0 else size
    digits = max(power - last, 0)
    body = f"{_unsigned(value / 10.0**power, digits)} ± {std / 10.0**power:.{digits}f}"
    if power:
        return f"({body})e{power}{after}"
    return f"({body}){after}" if after else body


def stated(value: float, unit: str = "") -> str:
    """A value that was stated, in the fewest digits that tell it, up to ten."""
    same = (d for d in range(1, 10) if math.isclose(float(f"{value:.{d - 1}e}"), value, rel_tol=1e-10))
    return f"{number(value, next(same, 10))} {unit_text(unit)}".strip()


def number(value: float, digits: int = 2, power: int | None = None) -> str:
    """A value to so many significant digits, e.g. "3.6e-4".

    Args:
        value: the value.
        digits: significant digits.
        power: print it with this power of ten; by default only where plain decimals would be unreadable.
    """
    if not math.isfinite(value):
        return "–" if math.isnan(value) else ("∞" if value > 0 else "−∞")
    if value == 0.0:
        return "0"
    exponent = _exponent(float(f"{value:.{digits - 1}e}"))
    if power is None:
        power = 0 if -3 <= exponent <= 4 else exponent
    decimals = max(digits - 1 - exponent + power, 0)
    return _unsigned(value / 10.0**power, decimals) + (f"e{power}" if power else "")


def pair(first: float, second: float) -> tuple[str, str]:
    """Two values to compare: with one power of ten unless they lie far apart, and two to four digits, to differ."""
    values = [v for v in (first, second) if math.isfinite(v) and v != 0.0]
    exponents = [_exponent(float(f"{v:.1e}")) for v in values]
    if exponents and max(exponents) - min(exponents) > 1:
        return number(first), number(second)
    power = max(exponents) if exponents and min(exponents) < -3 else None
    for digits in (2, 3, 4):
        shown = number(first, digits, power), number(second, digits, power)
        if shown[0] != shown[1]:
            break
    return shown


def count(whole: int) -> str:
    """A whole number with thin spaces between thousands."""
    return f"{whole:,}".replace(",", "\u202f")


def percent(share: float) -> str:
    """A share of one, without pretending to certainty: "> 99.9 %" rather than "100 %"."""
    if not math.isfinite(share):
        return "–"
    if share > 0.999:
        return "> 99.9 %"
    if 0.0 < share < 0.001:
        return "< 0.1 %"
    if share == 0.0:
        return "0 %"
    return f"{100.0 * share:.{1 if share < 0.1 or share > 0.95 else 0}f} %"


def _exponent(value: float) -> int:
    return math.floor(math.log10(abs(value))) if value else -99


def _unsigned(value: float, decimals: int) -> str:
    """Fixed decimals, with no minus sign on a zero."""
    text = f"{value:.{decimals}f}"
    return text.removeprefix("-") if float(text) == 0.0 else text
