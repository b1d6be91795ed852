"""Campaigns that have not been measured yet, from a YAML plan of what every column is to do.

A column is constant or a list of segments, whose last value stays; any key but the five of what is planned and
`instruments`, the errors of columns, is metadata.

    gyro: fog
    kind: rate
    duration: 4 h
    interval: 10 s
    output: count/s                       # unit of the output to come
    columns:
      rate: 0 deg/s
      temperature:
        - {for: 1 h, at: 20 degC}
        - {for: 30 min, to: 60 degC}      # a ramp from the value before, or from the one given as `from`
        - repeat: 3
          segments: [{for: 10 min, at: 60 degC}, {for: 10 min, at: 50 degC}]
"""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Mapping
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import yaml

from gyromodel._checks import CampaignError
from gyromodel.campaign import Campaign
from gyromodel.units import UnitError, convertible, factor, from_internal, quantity, to_internal

_KEYS = {"duration", "interval", "kind", "output", "columns"}
# What a plan may say besides, that is no metadata of the campaign.
_APART = {"instruments"}
_MOST_SAMPLES = 100_000_000


class _Loader(yaml.SafeLoader):
    """Dates stay text, as in all metadata, and no key is given twice."""

    yaml_implicit_resolvers: ClassVar[Any] = {
        first: [(tag, pattern) for tag, pattern in known if tag != "tag:yaml.org,2002:timestamp"]
        for first, known in yaml.SafeLoader.yaml_implicit_resolvers.items()
    }

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, Any]:
        """As YAML has it, but of a key that is there twice neither counts."""
        keys = [key.value for key, _ in node.value]
        if twice := [key for key in keys if keys.count(key) > 1]:
            raise CampaignError(f"{twice[0]!r} appears twice in what begins in line {node.start_mark.line + 1}")
        return super().construct_mapping(node, deep)


def read_yaml(path: Path) -> Any:
    """A plan's file as it is written, dates as text.

    Raises:
        CampaignError: it is no YAML file, or has a key twice.
    """
    try:
        return yaml.load(path.read_text(encoding="utf-8"), _Loader)
    except CampaignError as error:
        raise CampaignError(f"{path}: {error}") from None
    except (yaml.YAMLError, ValueError) as error:
        raise CampaignError(f"{path}: is no YAML file: {' '.join(str(error).split())}") from None


def read_plan(path: str | Path) -> Campaign:
    """The planned campaign, its output all missing.

    Args:
        path: YAML file of the form shown at the top of this module.

    Raises:
        CampaignError: the file is no plan; the message names the key or the segment.
    """
    path = Path(path)
    plan = read_yaml(path)
    missing = sorted(_KEYS - set(plan)) if isinstance(plan, dict) else sorted(_KEYS)
    if missing:
        raise CampaignError(f"{path}: a plan needs the keys {', '.join(sorted(_KEYS))}; missing: {', '.join(missing)}")
    try:
        return planned(plan, path.stem)
    except (CampaignError, UnitError) as error:
        raise CampaignError(f"{path}: {error}") from None


def planned(plan: Mapping[str, Any], name: str) -> Campaign:
    """The campaign of a plan that has been read.

    Raises:
        CampaignError: a segment is none.
        UnitError: a quantity is none.
    """
    duration, interval = _seconds("duration", plan["duration"]), _seconds("interval", plan["interval"])
    if not isinstance(plan["columns"], dict):
        raise CampaignError("columns must map column names to a value or a list of segments")
    if duration / interval > _MOST_SAMPLES:
        raise CampaignError(f"duration / interval is over {_MOST_SAMPLES} samples; shorten it or sample more slowly")
    time = np.arange(max(round(duration / interval), 1)) * interval
    columns, units = {"time": time}, {"time": "s"}
    for column, course in ((str(key), value) for key, value in plan["columns"].items()):
        columns[column], units[column] = _course(f"column {column}", course, time)
    metadata = {str(key): value for key, value in plan.items() if key == "kind" or key not in _KEYS | _APART}
    unit = str(plan["output"])
    # A campaign is checked to hold measurements, which a plan has not: it passes with a stand-in, taken out again.
    campaign = Campaign(columns | {"output": time}, units | {"output": unit}, metadata, name)
    return campaign.with_column("output", np.full(len(time), np.nan), unit)


def _course(where: str, course: Any, time: np.ndarray) -> tuple[np.ndarray, str]:
    """One column's values in the unit of its first quantity."""
    if not isinstance(course, list):
        value, unit = _quantity(where, course)
        return np.full(len(time), value), unit
    values, unit, start, level = np.full(len(time), np.nan), None, 0.0, None
    # Segment ends are sums of floats: a sample within a billionth of the interval belongs to the segment that begins.
    clock = time + 1e-9 * (time[1] if len(time) > 1 else 1.0)
    for number, segment in enumerate(_segments(where, course), 1):
        if start > clock[-1]:
            break  # however often the rest is repeated
        spot = f"{where}, segment {number}"
        if not isinstance(segment, dict) or "for" not in segment or ("at" in segment) == ("to" in segment):
            raise CampaignError(f"{spot}: expected {{for: 1 h, at: 20 degC}} or {{for: 1 h, to: 60 degC}}")
        unknown = sorted(set(segment) - ({"for", "at"} if "at" in segment else {"for", "from", "to"}))
        if unknown:
            raise CampaignError(f"{spot}: unknown key {unknown[0]}")
        unit = unit or _quantity(spot, segment.get("at", segment.get("to")))[1]
        if "at" in segment:
            begin = end = _in_unit(spot, segment["at"], unit)
        else:
            begin = _in_unit(spot, segment["from"], unit) if "from" in segment else level
            end = _in_unit(spot, segment["to"], unit)
        if begin is None:
            raise CampaignError(f"{spot}: the first ramp needs a value to start from: add `from`")
        length = _seconds(f"{spot}, for", segment["for"])
        inside = (clock >= start) & (clock < start + length)
        values[inside] = begin + (end - begin) * (time[inside] - start) / length
        start, level = start + length, end
    if unit is None or level is None:
        raise CampaignError(f"{where}: has no segments")
    values[clock >= start] = level
    return values, unit


def _segments(where: str, items: Any) -> Iterator[Any]:
    for item in items:
        if isinstance(item, dict) and "repeat" in item:
            times, inner = item["repeat"], item.get("segments")
            if not isinstance(times, int) or times < 1 or not isinstance(inner, list) or not inner:
                raise CampaignError(f"{where}: repeat needs a whole number above zero and a list of segments")
            for _ in range(times):
                yield from _segments(where, inner)
        else:
            yield item


def _quantity(where: str, text: Any) -> tuple[float, str]:
    try:
        return quantity(str(text))
    except UnitError as error:
        raise CampaignError(f"{where}: {error}") from None


def _in_unit(where: str, text: Any, unit: str) -> float:
    value, own = _quantity(where, text)
    if not convertible(own, unit):
        raise CampaignError(f"{where}: {text} is not in a unit like {unit or '[]'}, which this column began with")
    return value if own == unit else float(from_internal(to_internal(value, own), unit))


def _seconds(where: str, text: Any) -> float:
    try:
        return seconds(text)
    except (CampaignError, UnitError) as error:
        raise CampaignError(f"{where}: {error}") from None


def seconds(text: Any) -> float:
    """A time with its unit, above zero.

    Raises:
        CampaignError, UnitError: it is none.
    """
    value, unit = quantity(str(text))
    if not convertible(unit, "s") or not value > 0:
        raise CampaignError(f"expected a time above zero with its unit, such as 10 s, not {text}")
    return value * factor(unit, "s")
