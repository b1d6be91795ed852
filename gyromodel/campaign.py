"""`Campaign`: the measured data of one gyro unit, one row per sample, checked when it is made.

Values stay in the units of the file, so that reading and writing lose nothing; `si` gives them in internal units.
Rows in messages are data rows: row 1 is the first below the header.
"""

from __future__ import annotations

import hashlib
import json
import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from types import MappingProxyType
from typing import Any

import numpy as np

from gyromodel import units as unit_system

KINDS = ("rate", "increment", "angle")
AXES = ("x", "y", "z")
MAX_METADATA = 10_000

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
        (r"feedback_ramp", "raw counts, a voltage or a phase", "count bit V rad []"),
        (r"attitude_[wxyz]|segment|run|position", "a plain number", "[]"),
    )
)
_OUTPUT = re.compile(r"output(_[xyz])?")
# Raw counts say nothing about the kind, and neither does an analogue voltage.
_OUTPUT_UNITS = {
    "rate": ["deg/s", "deg/h", "rad/s", "count", "bit", "V", "count/s", "bit/s", "A", "Hz"],
    "increment": ["arcsec", "deg", "rad", "count", "bit", "V"],
    "angle": ["deg", "rad", "count", "bit", "V"],
}
_NO_TEXT = r"\x00-\x1f\x7f\ud800-\udfff"  # control characters, and halves of characters that no file can hold
_COLUMN_NAME = re.compile(rf"(?!.*\s$)[^\W_][^{_NO_TEXT}\[\],;\"/\\]*")
_METADATA_KEY = re.compile(rf"(?!.*\s$)[^\W_][^{_NO_TEXT}:]{{0,199}}")


class CampaignError(ValueError):
    """The data cannot be used; the message says what was found and where."""


@dataclass(frozen=True, eq=False)
class Campaign:
    """Named columns of equal length with units and metadata.

    Args:
        columns: values by column name, in the units of `units`; `time` is moved to the front.
        units: unit text by column name; `""` is dimensionless.
        metadata: text and numbers by key; `kind` is required.
        name: what reports call it; no part of the contents.

    Raises:
        CampaignError: a check fails.
    """

    columns: Mapping[str, np.ndarray] = field(repr=False)
    units: Mapping[str, str]
    metadata: Mapping[str, str | int | float]
    name: str = "campaign"

    __hash__ = None  # type: ignore[assignment]

    def __post_init__(self) -> None:
        self._settle()
        _check_usable(self)

    def __len__(self) -> int:
        return len(self.columns["time"])

    def __reduce__(self) -> tuple[Callable[..., Campaign], tuple[Any, ...]]:
        return _restore, (dict(self.columns), dict(self.units), dict(self.metadata), self.name)

    @property
    def outputs(self) -> tuple[str, ...]:
        """Names of the output columns: `("output",)` or some of `output_x`, `output_y`, `output_z`."""
        return tuple(name for name in self.columns if _OUTPUT.fullmatch(name))

    @property
    def covariates(self) -> tuple[str, ...]:
        """Names of all columns but `time` and the outputs."""
        return tuple(name for name in self.columns if name != "time" and not _OUTPUT.fullmatch(name))

    def si(self, name: str) -> np.ndarray:
        """A column in internal units."""
        values = self._column(name)
        return unit_system.to_internal(values, self.units[name])

    def in_unit(self, name: str, unit: str) -> np.ndarray:
        """A column in the given unit.

        Raises:
            CampaignError: there is no such column, or its unit does not convert.
        """
        values, own = self._column(name), self.units[name]
        if unit_system.tidy(unit) == own:
            return values
        if not unit_system.convertible(own, unit):
            raise CampaignError(f"column '{name}' is in [{own}], which does not convert to [{unit}]")
        return unit_system.from_internal(unit_system.to_internal(values, own), unit)

    def with_column(self, name: str, values: Any, unit: str) -> Campaign:
        """A copy with one column added or replaced; `values` is array-like, in `unit`."""
        return self._derived({**self.columns, name: values}, {**self.units, name: unit})

    def without(self, name: str) -> Campaign:
        """A copy without one column."""
        self._column(name)
        columns = {key: values for key, values in self.columns.items() if key != name}
        return self._derived(columns, self.units)

    def select(self, mask: Any) -> Campaign:
        """A copy with some rows: a boolean mask, a slice, or increasing row indices from 0."""
        return self._derived({name: values[mask] for name, values in self.columns.items()}, self.units)

    def axis(self, axis: str) -> Campaign:
        """One axis of a three-axis campaign as a single-axis one.

        `output_x` becomes `output`, `rate_x` becomes `rate`, and `temperature_x` becomes `temperature` where there is
        none; the other outputs go and every other column stays.

        Args:
            axis: `"x"`, `"y"` or `"z"`.

        Raises:
            CampaignError: the campaign has no such axis.
        """
        if axis not in AXES or f"output_{axis}" not in self.columns:
            raise CampaignError(f"there is no axis '{axis}': the outputs are {_listed(self.outputs)}")
        renamed = {f"output_{axis}": "output", f"rate_{axis}": "rate"}
        if f"rate_{axis}" in self.columns and "rate" in self.columns:
            raise CampaignError(f"both 'rate' and 'rate_{axis}' are given: keep the one that is about axis {axis}")
        if "temperature" not in self.columns:
            renamed[f"temperature_{axis}"] = "temperature"
        kept = [name for name in self.columns if name not in self.outputs or name in renamed]
        columns = {renamed.get(name, name): self.columns[name] for name in kept}
        units = {renamed.get(name, name): self.units[name] for name in kept}
        return self._derived(columns, units, f"{self.name}_{axis}")

    def gaps(self) -> list[tuple[int, float]]:
        """Steps in time longer than 1.5 times the median step: index of the row after it, from 0, and length in s."""
        with np.errstate(over="ignore"):
            steps = np.diff(self.si("time"))
        if not len(steps):
            return []
        rows = np.flatnonzero(steps > 1.5 * np.median(steps))
        return [(int(row) + 1, float(steps[row])) for row in rows]

    def digest(self) -> str:
        """SHA-256 of columns in their order, units and metadata, in hexadecimal; the same on every machine."""
        head = [[name, self.units[name]] for name in self.columns]
        total = hashlib.sha256(json.dumps([len(self), head, sorted(self.metadata.items())]).encode())
        for values in self.columns.values():
            # One bit pattern for every missing value, one byte order for every machine.
            total.update(np.where(np.isnan(values), np.nan, values).astype("<f8").tobytes())
        return total.hexdigest()

    def equals(self, other: Campaign) -> bool:
        """Whether both hold the same columns in the same order, units and metadata, bit for bit; names may differ."""
        return self.digest() == other.digest()

    def _column(self, name: str) -> np.ndarray:
        if name not in self.columns:
            raise CampaignError(f"there is no column '{name}': found {_listed(self.columns)}")
        return self.columns[name]

    def _derived(self, columns: Mapping[str, Any], units: Mapping[str, str], name: str | None = None) -> Campaign:
        """A part of a good campaign: a few rows at rest may be constant, so only the form is checked again."""
        return _restore(columns, {key: units[key] for key in columns}, self.metadata, name or self.name)

    def _settle(self) -> None:
        """Check the form and freeze the contents."""
        columns, units = dict(self.columns), dict(self.units)
        if "time" not in columns:
            raise CampaignError(f"there is no column 'time [s]': found {_listed(columns)}")
        if extra := units.keys() - columns:
            raise CampaignError(f"there are units for columns that do not exist: {_listed(extra)}")
        columns = {"time": columns.pop("time")} | columns
        frozen = {name: _frozen(name, values) for name, values in columns.items()}
        for name, values in frozen.items():
            if len(values) != len(frozen["time"]):
                raise CampaignError(f"column '{name}' has {len(values)} rows and 'time' has {len(frozen['time'])}")
        tidy = {name: check_unit(name, units.get(name)) for name in columns}
        metadata = dict(self.metadata)
        _check_metadata(metadata)
        check_time(frozen["time"])
        for name, values in frozen.items():
            if np.isinf(values).any():
                raise CampaignError(f"column '{name}' has an infinite value at data row {_first(np.isinf(values))}")
        for name in self.outputs:
            _check_output_unit(name, tidy[name], metadata.get("kind"))
        object.__setattr__(self, "columns", MappingProxyType(frozen))
        object.__setattr__(self, "units", MappingProxyType(tidy))
        object.__setattr__(self, "metadata", MappingProxyType(metadata))


def _restore(columns: Mapping[str, Any], units: Mapping[str, str], metadata: Mapping[str, Any], name: str) -> Campaign:
    campaign = object.__new__(Campaign)
    for key, value in (("columns", columns), ("units", units), ("metadata", metadata), ("name", name)):
        object.__setattr__(campaign, key, value)
    campaign._settle()
    return campaign


@lru_cache
def check_unit(name: str, unit: str | None) -> str:
    """The tidy unit text of a column.

    Raises:
        CampaignError: the name is unusable, or the unit is missing, unknown, or does not measure what the name says.
    """
    if not _COLUMN_NAME.fullmatch(name) or len(name.encode()) > 200:
        rule = 'it must start with a letter or digit, have at most 200 bytes and none of [ ] , ; " / \\'
        raise CampaignError(f"{shown(name)} cannot name a column: {rule}")
    known = next(((meaning, examples) for pattern, meaning, examples in _EXPECTED if pattern.fullmatch(name)), None)
    if unit is None:
        accepted = f"{known[0]}: {_listed(known[1])}" if known else unit_system.ACCEPTED
        example = known[1][0] if known else "unit"
        raise CampaignError(f"column '{name}' has no unit: write '{name} [{example}]' (accepted: {accepted})")
    try:
        unit = unit_system.tidy(unit)
    except unit_system.UnitError as error:
        raise CampaignError(f"column '{name}': {error}") from error
    if known and not any(unit_system.convertible(unit, example) for example in known[1]):
        raise CampaignError(f"column '{name}' has unit [{unit}], expected {known[0]}, such as {_listed(known[1])}")
    return unit


def check_time(time: np.ndarray, first_row: int = 1, previous: float | None = None) -> None:
    """Check that time is known and strictly increasing.

    Args:
        time: the values, or a later part of them.
        first_row: data row of the first value.
        previous: the value before the first, if any.

    Raises:
        CampaignError: names the rows and values.
    """
    if (missing := ~np.isfinite(time)).any():
        row = _first(missing)
        raise CampaignError(
            f"column 'time' is {time[row - 1]} at data row {first_row + row - 1}: every row needs a time"
        )
    if previous is not None:
        time, first_row = np.concatenate(([previous], time)), first_row - 1
    if (wrong := time[1:] <= time[:-1]).any():
        row = _first(wrong)
        raise CampaignError(
            f"column 'time' must increase from row to row, but is {time[row - 1]} at data row {first_row + row - 1} "
            f"and {time[row]} at data row {first_row + row} (row 1 is the first below the header)"
        )


def shown(text: str) -> str:
    """Foreign text as an error shows it: quoted, on one line and short."""
    return repr(text if len(text) <= 40 else text[:37] + "...")


def _check_usable(campaign: Campaign) -> None:
    """What a model needs: an output of known kind that varies, in three rows or more."""
    outputs = campaign.outputs
    if not outputs:
        names = _listed(campaign.columns)
        raise CampaignError(f"there is no column 'output' (or 'output_x', 'output_y', 'output_z'): found {names}")
    if "output" in outputs and len(outputs) > 1:
        raise CampaignError(f"give either 'output' or axes, not both: found {_listed(outputs)}")
    if len(campaign) < 3:
        raise CampaignError(f"there are {len(campaign)} rows of data, and at least 3 are needed")
    for name in outputs:
        values = campaign.columns[name]
        known = values[~np.isnan(values)]
        if not len(known):
            raise CampaignError(f"column '{name}' has no value: every row is missing")
        if (known == known[0]).all():
            raise CampaignError(f"column '{name}' is {known[0]} in every row, so that it measures nothing")
    if "kind" not in campaign.metadata:
        raise CampaignError(_kind_advice(campaign))


def _check_metadata(metadata: dict[str, Any]) -> None:
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


def _check_output_unit(name: str, unit: str, kind: Any) -> None:
    kinds = _possible_kinds(unit)
    if not kinds:
        accepted = _listed(_OUTPUT_UNITS["rate"] + ["deg", "arcsec"])
        advice = ", and [count] for raw numbers" if not unit else ""
        raise CampaignError(f"column '{name}' has unit [{unit}], expected one such as {accepted}{advice}")
    if kind is not None and kind not in kinds:
        raise CampaignError(
            f"column '{name}' is in [{unit}], which is no {kind}: metadata 'kind' must be {' or '.join(kinds)}, or the "
            "unit is wrong"
        )


def _kind_advice(campaign: Campaign) -> str:
    """What to write for the missing `kind`, from the unit and the Allan deviation at short times."""
    name = campaign.outputs[0]
    unit = campaign.units[name]
    kinds = likely = _possible_kinds(unit)
    slope = short_time_slope(campaign.columns[name])
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


def _frozen(name: str, values: Any) -> np.ndarray:
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


def _first(mask: np.ndarray) -> int:
    """Data row of the first true entry, counted from 1."""
    return int(np.argmax(mask)) + 1


def _listed(names: Any) -> str:
    names = list(names)
    return ", ".join(names[:20]) + (f" and {len(names) - 20} more" if len(names) > 20 else "") if names else "none"
