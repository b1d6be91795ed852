"""A calibration as numbers with names and units: JSON and CSV."""

from __future__ import annotations

import csv
import inspect
import io
import json
import math
from typing import Any, Literal, NamedTuple

import numpy as np

from gyromodel import __version__
from gyromodel._checks import usual_unit
from gyromodel.effects.drivers import BiasColumn
from gyromodel.estimate import Calibration, validity_unit
from gyromodel.model import LEVEL_UNITS
from gyromodel.model_files import SETTING_UNITS, parameter_names
from gyromodel.noise import TIMES, noise_units
from gyromodel.units import factor, from_internal, internal_unit

FORMULA = (
    "output = (product of gain terms) * (rate + sum of rate terms) * (1 + sum of scale terms); "
    "a term is the sum of its columns times their parameters; a readout term is how all that, with its noise, is read"
)


class Entry(NamedTuple):
    """One number of a calibration in its reporting unit, and internally, or the name of a column it depends on.

    `std` is NaN where there is none.
    """

    effect: str
    kind: Literal["parameter", "fixed", "setting", "noise"]
    name: str
    value: float | str
    std: float
    unit: str
    internal: float


def entries(calibration: Calibration) -> list[list[Entry]]:
    """The numbers of each effect: its parameters, then its settings."""
    model, rows = calibration.model, iter(calibration.table())
    found = []
    for effect in model.effects:
        group = []
        for name in effect.declared():
            kind = "fixed" if (effect.label, name) in model.fixed or name in effect.held else "parameter"
            for internal in np.ravel(getattr(effect, name)):
                row = next(rows)
                group.append(Entry(effect.label, kind, row.name, row.value, row.std, row.unit, float(internal)))
        for name in effect.settings():
            unit = column_unit(effect) if isinstance(effect, BiasColumn) else SETTING_UNITS.get(name, "")
            values = np.ravel(getattr(effect, name))
            for shown, internal in zip(shown_names(name, len(values)), values, strict=True):
                text = isinstance(internal, str)
                value = str(internal) if text else float(from_internal(internal, unit))
                internal = math.nan if text else float(internal)
                group.append(Entry(effect.label, "setting", shown, value, math.nan, unit, internal))
        found.append(group)
    return found


def shown_names(field: str, count: int) -> list[str]:
    """A field's numbers by name: the field where there is one, else numbered."""
    return [field] if count == 1 else [f"{field}[{j}]" for j in range(count)]


def column_unit(effect: BiasColumn) -> str:
    """Internal unit of the column that a linear driver follows, from that of its coefficient."""
    return internal_unit(f"deg/h/({effect.unit})") if effect.unit else usual_unit(effect.column)


def _noise(calibration: Calibration) -> list[Entry]:
    found = []
    for name, x in calibration.model.noise.items():
        effect, what = TIMES.get(name, (name, "value"))
        unit = noise_units(calibration.model.noise_of)[name]
        found.append(Entry(effect, "noise", what, float(from_internal(x, unit)), math.nan, unit, float(x)))
    if (level := calibration.model.level) is not None:
        found.append(Entry("noise_heteroscedastic", "noise", "value", level.ratio, math.nan, "1", level.ratio))
        unit = LEVEL_UNITS[level.driver]
        for end, x in (("from", level.low), ("to", level.high)):
            what, value = f"{level.driver} {end}", float(from_internal(x, unit))
            found.append(Entry("noise_heteroscedastic", "noise", what, value, math.nan, unit, x))
    return found


def validity(calibration: Calibration) -> dict[str, tuple[float, float, str]]:
    """Lowest and highest calibrated value and their unit, by column."""
    found = {}
    for name, ends in calibration.validity.items():
        low, high = (float(end) for end in from_internal(ends, validity_unit(name)))
        found[name] = low, high, validity_unit(name)
    return found


def as_csv(calibration: Calibration) -> str:
    """One row a number: parameters, settings, noise, ranges of validity."""
    rows = [entry[:-1] for group in entries(calibration) for entry in group]
    rows += [entry[:-1] for entry in _noise(calibration)]
    for name, (low, high, unit) in validity(calibration).items():
        rows += [(name, "validity", end, x, math.nan, unit) for end, x in (("lowest", low), ("highest", high))]
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(Entry._fields[:-1])
    writer.writerows([["" if x != x else x for x in row] for row in rows])
    return text.getvalue()


def as_json(calibration: Calibration) -> str:
    """Everything that it takes to compute the model elsewhere; the covariance is in the units of its parameters."""
    model = calibration.model
    effects = []
    for effect, group in zip(model.effects, entries(calibration), strict=True):
        equation, _, details = (inspect.getdoc(type(effect)) or "").partition("\n")
        effects.append({
            "effect": effect.label,
            "acts_on": effect.site,
            "equation": equation,
            "details": " ".join(details.split()),
            "columns": " ".join((inspect.getdoc(effect.columns) or "").split()) if effect.site != "gain" else "",
            "needs": list(effect.columns_needed),
            "parameters": [
                {"name": e.name, "value": e.value, "std": None if e.std != e.std else e.std, "unit": e.unit,
                 "meaning": effect.declared()[e.name.partition("[")[0]].meaning, "fixed": e.kind == "fixed"}
                for e in group if e.kind != "setting"
            ],
            "settings": [{"name": e.name, "value": e.value, "unit": e.unit} for e in group if e.kind == "setting"],
        })  # fmt: skip
    document: dict[str, Any] = {
        "software": f"gyromodel {__version__}",
        "gyro": model.gyro,
        "formula": FORMULA,
        "effects": effects,
        "noise": [{"effect": e.effect, "name": e.name, "value": e.value, "unit": e.unit} for e in _noise(calibration)],
        "validity": {
            name: {"lowest": low, "highest": high, "unit": unit}
            for name, (low, high, unit) in validity(calibration).items()
        },
        "degrees_of_freedom": calibration.degrees_of_freedom,
        "data_hash": calibration.data_hash,
        "covariance": None,
    }
    if calibration.covariance is not None:
        slots, declared = model.slots(), [e.declared() for e in model.effects]
        units = [getattr(model.effects[s.effect], "unit", "") or declared[s.effect][s.field].unit for s in slots]
        scale = np.array([factor(internal_unit(unit), unit) for unit in units])
        document["covariance"] = {
            "parameters": parameter_names(model),
            "units": units,
            "matrix": (calibration.covariance * np.outer(scale, scale)).tolist(),
        }
    return json.dumps(document, indent=2, ensure_ascii=False, allow_nan=False) + "\n"
