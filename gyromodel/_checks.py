"""What the columns, units, times and metadata of a campaign must be, and what an error says of those that are not."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from contextlib import suppress
from functools import lru_cache
from typing import Any

import numpy as np

from gyromodel import units as unit_system

# Signals that models see besides the columns: time since power-on, and the rate of each thermometer.
DERIVED = re.compile(r"time_on|temperature(_.+)?_rate")
_THERMOMETER = re.compile(r"temperature(_.+)?(?<!_rate)")
# Columns that number stretches of a campaign.
NUMBERED = ("segment", "run", "position")
KINDS = ("rate", "increment", "angle")
MAX_METADATA = 10_000
# A step in time of more than this many nominal ones leaves out samples.
MISSING_STEP = 1.5
# Of time, in the unit of its column; one over the square of what is shorter than 1e-154 is no number.
SHORTEST_STEP = 1e-100

# What the unit of a known column must measure, by examples: one of their dimensions is required.
_EXPECTED = tuple(
    (re.compile(pattern), meaning, examples.split())
    for pattern, meaning, examples in (
        (r"time", "a time", "s ms min h"),
        (r"rate(_(x|y|z|input|spin|output|estimated|estimated_std))?", "an angular rate", "deg/s deg/h rad/s rpm"),
        (r"temperature(_.+)?", "a temperature", "degC K degF"),
        (r"thermistor_resistance", "a resistance", "ohm kohm"),
        (r"acceleration(_(x|y|z|input|spin|output))?", "an acceleration or raw counts", "m/s^2 g count"),
        (r"magnetic_field(_(x|y|z))?", "a magnetic flux density", "T uT gauss"),
        (r"supply_voltage", "a voltage", "V mV"),
        (r"pressure", "a pressure", "Pa kPa mbar"),
        (r"table_angle|azimuth|table_(x|y|z|inner|middle|outer)|gimbal_.+", "an angle", "deg rad"),
        (r"torquer_current", "an electric current or raw counts", "mA A uA count"),
        (r"backscatter|null_shift", "what a beam monitor gives: a voltage, current, power or number", "count V A W []"),
        (r"feedback_ramp", "raw counts, a voltage or a phase", "count bit V rad []"),
        (r"attitude_[wxyz]|segment|run|position", "a plain number", "[]"),
    )
)
# Columns whose unit is free, but for the effect that is named after them: mean square acceleration.
_USUAL = {"vibration": "m^2/s^4"}
_AXES = (("input", "spin", "output"), ("x", "y", "z"))
# Raw counts say nothing about the kind, and neither does an analogue voltage.
_OUTPUT_UNITS = {
    "rate": ["deg/s", "deg/h", "rad/s", "count", "bit", "V", "count/s", "bit/s", "V/s", "A", "Hz"],
    "increment": ["arcsec", "deg", "rad", "count", "bit", "V"],
    "angle": ["deg", "rad", "count", "bit", "V"],
}
_NO_TEXT = r"\x00-\x1f\x7f\ud800-\udfff"  # control characters, and halves of characters that no file can hold
_COLUMN_NAME = re.compile(rf"(?!.*\s$)[^\W_][^{_NO_TEXT}\[\],;\"/\\]*")
_METADATA_KEY = re.compile(rf"(?!.*\s$)[^\W_][^{_NO_TEXT}:]{{0,199}}")


class CampaignError(ValueError):
    """The data cannot be used; the message says what was found and where."""


@lru_cache
def check_unit(name: str, unit: str | None) -> str:
    """The tidy unit text of a column.

    Raises:
        CampaignError: the name is unusable, or the unit is missing, unknown, or does not measure what the name says.
    """
    if not _COLUMN_NAME.fullmatch(name) or len(name.encode()) > 200:
        rule = 'it must start with a letter or digit, have at most 200 bytes and none of [ ] , ; " / \\'
        written = re.fullmatch(r"([^][]+?) *\[+([^][]*)\]+", name)
        if written and len(name) <= 40 and _COLUMN_NAME.fullmatch(written[1]) and _is_unit(written[2]):
            rule += f"; write '{written[1]} [{written[2]}]'"
        raise CampaignError(f"{shown(name)} cannot name a column: {rule}")
    if DERIVED.fullmatch(name):
        raise CampaignError(f"column '{name}' has the name of a signal that is derived from others: rename it")
    known = _known(name)
    if unit is None:
        accepted = f"{known[0]}: {listed(known[1])}" if known else unit_system.ACCEPTED
        example = known[1][0].strip("[]") if known else "unit"
        raise CampaignError(f"column '{name}' has no unit: write '{name} [{example}]' (accepted: {accepted})")
    try:
        unit = unit_system.tidy(unit)
    except unit_system.UnitError as error:
        raise CampaignError(f"column '{name}': {error}") from error
    if known and not any(unit_system.convertible(unit, example) for example in known[1]):
        raise CampaignError(f"column '{name}' has unit [{unit}], expected {known[0]}, such as {listed(known[1])}")
    return unit


def _is_unit(text: str) -> bool:
    with suppress(unit_system.UnitError):
        unit_system.tidy(text)
        return True
    return False


def _known(name: str) -> tuple[str, list[str]] | None:
    """What a known column measures, and examples of its unit."""
    return next(((meaning, examples) for pattern, meaning, examples in _EXPECTED if pattern.fullmatch(name)), None)


def usual_unit(name: str) -> str:
    """Internal unit of a known column; dimensionless for any other."""
    known = _known(name)
    return unit_system.internal_unit(known[1][0]) if known else _USUAL.get(name, "")


def of_usual_unit(name: str, unit: str) -> bool:
    """Whether a column is in a unit that the effects of that column can take, which raw counts of a measure are not."""
    known = _known(name)
    if not known:
        return name not in _USUAL or unit_system.convertible(unit, _USUAL[name])
    return any(unit_system.convertible(unit, e) for e in known[1] if e != "count" or e == known[1][0])


def check_time(time: np.ndarray, first_row: int = 1, previous: float | None = None) -> None:
    """Check that time is known and strictly increasing, by SHORTEST_STEP or more.

    Args:
        time: the values, or a later part of them, in the unit of their column.
        first_row: data row of the first value.
        previous: the value before the first, if any.

    Raises:
        CampaignError: names the rows and values.
    """
    if (missing := ~np.isfinite(time)).any():
        row = first(missing)
        raise CampaignError(
            f"column 'time' is {time[row - 1]} at data row {first_row + row - 1}: every row needs a time"
        )
    if previous is not None:
        time, first_row = np.concatenate(([previous], time)), first_row - 1
    if (wrong := time[1:] - time[:-1] < SHORTEST_STEP).any():
        row = first(wrong)
        raise CampaignError(
            f"column 'time' must increase from row to row, but is {time[row - 1]} at data row {first_row + row - 1} "
            f"and {time[row]} at data row {first_row + row} (row 1 is the first below the header)"
        )


def thermometers(names: Iterable[str]) -> list[str]:
    """Those of the names that are thermometers, `temperature` before every temperature_<place>."""
    return sorted(name for name in names if _THERMOMETER.fullmatch(name))


def along_axes(kind: str, names: Iterable[str]) -> list[str]:
    """The columns of a vector among some names: by the gyro's axes, <kind>_input/_spin/_output, else by x, y, z."""
    names = set(names)
    found = [[f"{kind}_{axis}" for axis in axes if f"{kind}_{axis}" in names] for axes in _AXES]
    return found[0] or found[1]


def accelerations(names: Iterable[str]) -> list[str]:
    """The columns of specific force among some names."""
    return along_axes("acceleration", names)


def shown(text: str) -> str:
    """Foreign text as an error shows it: quoted, on one line and short."""
    return repr(text if len(text) <= 40 else text[:37] + "...")


def legible(text: str) -> str:
    """A file's name, or text with one in it, as UTF-8 can hold it: bytes of another coding as hexadecimal digits."""
    return text.encode("utf-8", "surrogateescape").decode("utf-8", "backslashreplace")


def check_metadata(metadata: dict[str, Any]) -> None:
    for key, value in metadata.items():
        if not isinstance(key, str) or not _METADATA_KEY.fullmatch(key):
            raise CampaignError(
                f"{shown(str(key))} cannot be a metadata key: a key starts with a letter or digit and has no colon"
            )
        if isinstance(value, bool) or not isinstance(value, str | int | float):
            raise CampaignError(f"metadata '{key}' is a {type(value).__name__}: only text and numbers can be kept")
        if isinstance(value, str) and (len(value) > MAX_METADATA or re.search("[\0\ud800-\udfff]", value)):
            raise CampaignError(f"metadata '{key}' is longer than {MAX_METADATA} characters or no plain text")
        if not isinstance(value, str) and not (
            math.isfinite(value) and (isinstance(value, float) or abs(value) < 2**63)
        ):
            raise CampaignError(f"metadata '{key}' is {value}, which is no finite 64-bit number")
        # Subclasses, NumPy's float64 among them, would not come back as what they are.
        metadata[key] = str(value) if isinstance(value, str) else (int if isinstance(value, int) else float)(value)
    if (kind := metadata.get("kind", "rate")) not in KINDS:
        raise CampaignError(f"metadata 'kind' is {shown(str(kind))}, expected rate, increment or angle")
    if (frame := metadata.get("rate_frame", "table")) not in ("table", "inertial"):
        raise CampaignError(f"metadata 'rate_frame' is {shown(str(frame))}, expected table or inertial")
    latitude = metadata.get("latitude_deg", 0)
    if isinstance(latitude, str) or abs(latitude) > 90:
        raise CampaignError(f"metadata 'latitude_deg' is {shown(str(latitude))}, expected degrees from -90 to 90")


@lru_cache
def _possible_kinds(unit: str) -> list[str]:
    return [kind for kind, examples in _OUTPUT_UNITS.items() if any(unit_system.convertible(unit, e) for e in examples)]


def check_output_unit(name: str, unit: str, kind: Any) -> None:
    kinds = _possible_kinds(unit)
    if not kinds:
        accepted = listed(_OUTPUT_UNITS["rate"] + ["deg", "arcsec"])
        advice = ", and [count] for raw numbers" if not unit else ""
        raise CampaignError(f"column '{name}' has unit [{unit}], expected one such as {accepted}{advice}")
    if kind is not None and kind not in kinds:
        raise CampaignError(
            f"column '{name}' is in [{unit}], which is no {kind}: metadata 'kind' must be {' or '.join(kinds)}, or the "
            "unit is wrong"
        )


def kind_advice(name: str, unit: str, values: np.ndarray) -> str:
    """What to write for the missing `kind`, from an output's unit and its Allan deviation at short times."""
    kinds = likely = _possible_kinds(unit)
    slope = short_time_slope(values)
    seen = "there are too few values to see what they are"
    if slope is not None:
        seen = f"the Allan deviation of '{name}' has slope {slope:+.2f} from 1 to 8 samples"
        if slope < -0.25:
            likely = [kind for kind in kinds if kind != "angle"]
            seen += ", as white noise of a rate or of increments, which a slope cannot tell apart"
        elif slope > 0.25:
            likely = ["angle"] if "angle" in kinds else kinds
            seen += ", as an accumulated angle or a turning gyro"
        else:
            seen += ", which decides nothing"
    if len(kinds) < len(KINDS):
        seen += f"; its unit [{unit}] allows {' or '.join(kinds)} only"
    lines = " or ".join(f"'# kind: {kind}'" for kind in likely)
    return f"metadata 'kind' is missing and not assumed: {seen}; add the line {lines} (or set the attribute)"


def short_time_slope(values: np.ndarray) -> float | None:
    """Slope of log Allan deviation against log time from 1 to 8 samples: -1/2 for white noise, +1/2 for its sum.

    Returns:
        The slope, or None when there are too few values or they do not change.
    """
    size = np.abs(values[np.isfinite(values)]).max(initial=0.0)
    if size == 0:
        return None
    values = values / size  # so that no square overflows
    deviations = []
    for length in (1, 2, 4, 8):
        means = values[: len(values) // length * length].reshape(-1, length).mean(axis=1)
        steps = np.diff(means)
        steps = steps[np.isfinite(steps)]
        if len(steps) < 4 or not np.abs(steps).max() > 1e-100:
            return None
        deviations.append(np.linalg.norm(steps) / np.sqrt(len(steps)))
    return float(np.polyfit(np.log([1, 2, 4, 8]), np.log(deviations), 1)[0])


def frozen(name: str, values: Any) -> np.ndarray:
    """The values as a read-only float64 copy; an array that already is one is shared."""
    if isinstance(values, np.ma.MaskedArray):
        values = np.ma.filled(values.astype(np.float64), np.nan)
    array = np.asarray(values)
    if array.ndim != 1 or array.dtype.kind not in "iufb":
        raise CampaignError(f"column '{name}' is no row of numbers: found {array.dtype} of shape {array.shape}")
    if array.dtype != np.float64 or array.flags.writeable or not array.flags.c_contiguous:
        array = np.array(array, dtype=np.float64, order="C")
        array.flags.writeable = False
    return array


def first(mask: np.ndarray) -> int:
    """Data row of the first true entry, counted from 1."""
    return int(np.argmax(mask)) + 1


def listed(names: Any) -> str:
    names = list(names)
    return ", ".join(names[:20]) + (f" and {len(names) - 20} more" if len(names) > 20 else "") if names else "none"
