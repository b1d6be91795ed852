"""`Campaign`: the measured data of one gyro unit, one row per sample, checked when it is made.

Values stay in the units of the file, so that reading and writing lose nothing; `si` gives them in internal units.
Rows in messages are data rows: row 1 is the first below the header.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

import numpy as np

from gyromodel import units as unit_system
from gyromodel._checks import (
    MISSING_STEP,
    CampaignError,
    check_metadata,
    check_output_unit,
    check_time,
    check_unit,
    first,
    frozen,
    kind_advice,
    listed,
)

AXES = ("x", "y", "z")
# Beyond this size a value is a mark of something else, and its square no number.
LARGEST = 1e100
_OUTPUT = re.compile(r"output(_[xyz])?")


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

    def with_metadata(self, entries: Mapping[str, str | int | float | None]) -> Campaign:
        """A copy with metadata added or replaced; None removes."""
        metadata = {key: value for key, value in {**self.metadata, **entries}.items() if value is not None}
        return _restore(self.columns, self.units, metadata, self.name)

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
        none; the other outputs go and every other column stays. Metadata `axis` says which it was.

        Args:
            axis: `"x"`, `"y"` or `"z"`.

        Raises:
            CampaignError: the campaign has no such axis.
        """
        if axis not in AXES or f"output_{axis}" not in self.columns:
            raise CampaignError(f"there is no axis '{axis}': the outputs are {listed(self.outputs)}")
        if reason := self.dead(f"output_{axis}"):
            raise CampaignError(reason)
        return self.renamed_axis(axis)

    def renamed_axis(self, axis: str) -> Campaign:
        """As `axis`, of a part of a campaign that need not vary."""
        renamed = {f"output_{axis}": "output", f"rate_{axis}": "rate"}
        if f"rate_{axis}" in self.columns and "rate" in self.columns:
            raise CampaignError(f"both 'rate' and 'rate_{axis}' are given: keep the one that is about axis {axis}")
        if "temperature" not in self.columns:
            renamed[f"temperature_{axis}"] = "temperature"
        kept = [name for name in self.columns if name not in self.outputs or name in renamed]
        columns = {renamed.get(name, name): self.columns[name] for name in kept}
        units = {renamed.get(name, name): self.units[name] for name in kept}
        return self._derived(columns, units, f"{self.name}_{axis}").with_metadata({"axis": axis})

    def dead(self, output: str) -> str:
        """Why an output measures nothing; empty where it does. One dead axis does not stop the others."""
        values = self._column(output)
        known = values[~np.isnan(values)]
        if not len(known):
            return f"column '{output}' has no value: every row is missing"
        constant = (known == known[0]).all()
        return f"column '{output}' is {known[0]} in every row, so that it measures nothing" if constant else ""

    def gaps(self) -> list[tuple[int, float]]:
        """Steps in time longer than 1.5 times the median step: index of the row after it, from 0, and length in s."""
        with np.errstate(over="ignore"):
            steps = np.diff(self.si("time"))
        if not len(steps):
            return []
        rows = np.flatnonzero(steps > MISSING_STEP * np.median(steps))
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
            raise CampaignError(f"there is no column '{name}': found {listed(self.columns)}")
        return self.columns[name]

    def _derived(self, columns: Mapping[str, Any], units: Mapping[str, str], name: str | None = None) -> Campaign:
        """A part of a good campaign: a few rows at rest may be constant, so only the form is checked again."""
        return _restore(columns, {key: units[key] for key in columns}, self.metadata, name or self.name)

    def _settle(self) -> None:
        """Check the form and freeze the contents."""
        columns, units = dict(self.columns), dict(self.units)
        if "time" not in columns:
            raise CampaignError(f"there is no column 'time [s]': found {listed(columns)}")
        if extra := units.keys() - columns:
            raise CampaignError(f"there are units for columns that do not exist: {listed(extra)}")
        columns = {"time": columns.pop("time")} | columns
        settled = {name: frozen(name, values) for name, values in columns.items()}
        for name, values in settled.items():
            if len(values) != len(settled["time"]):
                raise CampaignError(f"column '{name}' has {len(values)} rows and 'time' has {len(settled['time'])}")
        tidy = {name: check_unit(name, units.get(name)) for name in columns}
        metadata = dict(self.metadata)
        check_metadata(metadata)
        check_time(settled["time"])
        for name, values in settled.items():
            if np.isinf(values).any():
                raise CampaignError(f"column '{name}' has an infinite value at data row {first(np.isinf(values))}")
        for name in self.outputs:
            check_output_unit(name, tidy[name], metadata.get("kind"))
        object.__setattr__(self, "columns", MappingProxyType(settled))
        object.__setattr__(self, "units", MappingProxyType(tidy))
        object.__setattr__(self, "metadata", MappingProxyType(metadata))


def part_of_campaign(
    columns: Mapping[str, Any], units: Mapping[str, str], metadata: Mapping[str, Any], name: str
) -> Campaign:
    """Some rows of a campaign, which may be few or constant: only the form is checked."""
    return _restore(columns, units, metadata, name)


def _restore(columns: Mapping[str, Any], units: Mapping[str, str], metadata: Mapping[str, Any], name: str) -> Campaign:
    campaign = object.__new__(Campaign)
    for key, value in (("columns", columns), ("units", units), ("metadata", metadata), ("name", name)):
        object.__setattr__(campaign, key, value)
    campaign._settle()
    return campaign


def _check_usable(campaign: Campaign) -> None:
    """What a model needs: three rows of usable numbers, with an output of known kind that varies, or gimbal angles."""
    for name, values in campaign.columns.items():
        if (far := np.abs(values) > LARGEST).any():
            raise CampaignError(
                f"column '{name}' is {values[far][0]:g} at data row {first(far)}, which nothing measures: leave "
                "the cell empty where a sample is missing"
            )
    outputs = campaign.outputs
    if not outputs and len(campaign) >= 3 and any(name.startswith("gimbal_") for name in campaign.columns):
        return  # a platform tells its attitude by its gimbals
    if not outputs:
        names = listed(campaign.columns)
        raise CampaignError(f"there is no column 'output' (or 'output_x', 'output_y', 'output_z'): found {names}")
    if "output" in outputs and len(outputs) > 1:
        raise CampaignError(f"give either 'output' or axes, not both: found {listed(outputs)}")
    if len(campaign) < 3:
        raise CampaignError(f"there are {len(campaign)} rows of data, and at least 3 are needed")
    dead = [reason for name in outputs if (reason := campaign.dead(name))]
    if len(dead) == len(outputs):
        raise CampaignError(dead[0])
    if "kind" not in campaign.metadata:
        name = campaign.outputs[0]
        raise CampaignError(kind_advice(name, campaign.units[name], campaign.columns[name]))
