"""Models to and from YAML, with units and line-numbered errors."""

from __future__ import annotations

import re
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from gyromodel import __version__
from gyromodel._atomic import write_text
from gyromodel._checks import thermometers
from gyromodel._model_units import parameter_unit
from gyromodel._noise_entries import noise_entries, read_noise
from gyromodel._yaml import Place, complaint, compose, exact_text
from gyromodel.effects import Effect
from gyromodel.effects._base import Domain
from gyromodel.effects.drivers import BiasColumn
from gyromodel.effects.scale import ScaleTemperatureCurve
from gyromodel.effects.thermal import BiasTemperatureCurve
from gyromodel.estimate import Calibration, Estimate, validity_unit
from gyromodel.model import GyroModel, ModelError, make_effect
from gyromodel.numerics.uncertain import Source, Uncertain
from gyromodel.signals import Record
from gyromodel.units import convertible, from_internal, internal_unit

# Written into fitted models; `read_calibration` reads them, and no other use of the model needs them.
RECORD_KEYS = ("fit", "software")
# What a scale factor can be: output per rate; a plain number where the output is itself a rate.
GAIN_UNITS = ("count/deg", "count/(deg/s)", "bit/deg", "bit/(deg/s)", "V/(deg/s)", "V/deg", "A/(deg/s)", "1/deg", "")
FIT_KEYS = ("degrees_of_freedom", "validity", "data_hash", "covariance")
# By how much a factor's square may differ from the covariance, of its size.
SAME_COVARIANCE = 1e-6
# Parameters that are temperatures; others in degC are differences.
TEMPERATURES = ("breakpoints",)
SETTING_UNITS = {"reference": "degC", "full_rate": "deg/s", "lowest": "deg/s", "resistance": "ohm"}


def read_model(path: str | Path) -> GyroModel:
    """Read a model.

    Raises:
        ModelError: the file is not a model; the message names the line.
    """
    return _read(Path(path))[0]


def read_calibration(path: str | Path) -> Calibration:
    """Read a model with what its fit left in the file; one that was not fitted has neither covariance nor validity.

    Raises:
        ModelError: the file is not a model, misses a value, or its covariance is not that of its free parameters.
    """
    model, top = _read(Path(path))
    if "fit" not in top:
        return Calibration(model)
    fit = top["fit"].mapping(FIT_KEYS, "fit", complete=True, also=("sources",))
    validity = {}
    columns = {"rate", "temperature", *(n for e in model.effects for n in thermometers(e.columns_needed))}
    for name, place in fit["validity"].mapping(tuple(sorted(columns)), "validity").items():
        ends = [end.number_in(validity_unit(name)) for end in place.items("a range")]
        if len(ends) != 2 or ends[0] > ends[1]:
            raise place.error("a range is its lowest and its highest value")
        validity[name] = (ends[0], ends[1])
    covariance = _read_covariance(fit["covariance"], parameter_names(model))
    degrees = fit["degrees_of_freedom"].number_in("")
    if degrees < 0 or degrees != int(degrees):
        raise fit["degrees_of_freedom"].error("degrees of freedom are a whole number, not below zero")
    sources = _read_sources(fit["sources"], covariance) if "sources" in fit else {}
    return Calibration(model, covariance, validity, int(degrees), fit["data_hash"].text(), sources)


def _read_sources(place: Place, covariance: np.ndarray) -> dict[Source, np.ndarray]:
    sources = {}
    for item in place.items("sources"):
        found = item.mapping(("name", "factor"), "a source", complete=True, also=("degrees_of_freedom",))
        rows = [row.items("a row of the factor") for row in found["factor"].items("the factor")]
        if len(rows) != len(covariance) or len({len(row) for row in rows}) != 1:
            raise found["factor"].error(f"the factor needs {len(covariance)} rows of equally many numbers")
        degrees = found["degrees_of_freedom"].number_in("") if "degrees_of_freedom" in found else np.inf
        part = np.array([[entry.number_in("") for entry in row] for row in rows]).reshape(len(rows), -1)
        sources[Source(found["name"].text(), degrees)] = part
    size = np.sqrt(np.outer(np.diag(covariance), np.diag(covariance)))
    if (np.abs(sum((a @ a.T for a in sources.values()), -covariance)) > SAME_COVARIANCE * size).any():
        raise place.error("the sources do not add up to the covariance; fit the model again")
    return sources


def _read_covariance(place: Place, names: list[str]) -> np.ndarray:
    found = place.mapping(("parameters", "unit", "matrix"), "a covariance", complete=True)
    if [item.text() for item in found["parameters"].items("parameters")] != names:
        raise found["parameters"].error(
            "the covariance is not that of the model's free parameters; fit the model again"
        )
    rows = [row.items("a row of the matrix") for row in found["matrix"].items("the matrix")]
    if any(len(row) != len(names) for row in [rows, *rows]):
        raise found["matrix"].error(f"the matrix needs {len(names)} rows of as many numbers")
    matrix = np.array([[entry.number_in("") for entry in row] for row in rows]).reshape(len(names), len(names))
    try:
        Uncertain.stated(np.zeros(len(names)), matrix, "the matrix")
    except ValueError as problem:
        raise found["matrix"].error(str(problem)) from None
    return matrix


def _read(path: Path) -> tuple[GyroModel, dict[str, Place]]:
    """The model of a file, and the file's entries."""
    node = compose(path)
    if node is None:
        raise complaint(path, 0, "the file is empty; it needs a list of effects")
    place = Place(path, node)
    top = place.mapping(("gyro", "effects", "noise", *RECORD_KEYS), "a model")
    if "effects" not in top:
        raise place.error("the model lists no effects")
    effects: list[Effect] = []
    fixed: dict[str, set[tuple[str, str]]] = {}
    for item in top["effects"].items("effects"):
        effect, known = _read_effect(item)
        effects.append(effect)
        if fixed.setdefault(effect.label, known) != known:
            raise item.error(f"of several {effect.label} all have the same parameters fixed, or none")
    # A curve holds the line as its first power: of both, a fit would know nothing but the sum.
    curves = [e for e in effects if isinstance(e, BiasTemperatureCurve | ScaleTemperatureCurve)]
    lines = {name for e in curves if e.coefficients.size and not fixed[e.label] for name in e.supersedes}
    effects = [e for e in effects if e.label not in lines or fixed[e.label]]
    of: list[Domain] = [effects[0].domain] if effects else ["gyro", "platform"]
    noise, noise_of, level = read_noise(top["noise"], of) if "noise" in top else ({}, of[0], None)
    gyro = top["gyro"].text() if "gyro" in top else ""
    try:
        return GyroModel(tuple(effects), noise, frozenset().union(*fixed.values()), gyro, noise_of, level), top
    except ModelError as problem:
        raise top["effects"].error(str(problem)) from None


def _read_effect(place: Place) -> tuple[Effect, set[tuple[str, str]]]:
    pairs = place.node.value if isinstance(place.node, yaml.MappingNode) else []
    named = next((value for key, value in pairs if key.value == "effect"), None)
    if named is None:
        raise place.error("each entry needs an effect: id")
    named = Place(place.path, named)
    label = named.text()
    try:
        effect = make_effect(label)
    except ModelError as problem:
        raise named.error(str(problem)) from None
    declared = effect.declared()
    settings = effect.settings()
    found = place.mapping(("effect", "value", "fixed", *declared, *settings), label)
    if "value" in found:
        given = found.pop("value")
        name = _meant(given, effect)
        if name in found:
            raise given.error(f"value and {name} are the same parameter; keep one")
        found[name] = given
    values: dict[str, Any] = {"column": effect.column} if isinstance(effect, BiasColumn) else {}
    for name in declared:
        if name in found:
            values |= _read_parameter(found[name], effect, name)
    for name in settings:
        if name in found:
            values[name] = _read_setting(found[name], effect, name)
    try:
        effect = type(effect)(**values)
    except (TypeError, ValueError) as problem:
        raise place.error(f"{label}: {str(problem).splitlines()[0]}") from None
    return effect, _read_fixed(found["fixed"], effect) if "fixed" in found else set()


def _meant(place: Place, effect: Effect) -> str:
    """The parameter that a plain `value` is of: the only one, the only one that its unit suits, or the coefficient."""
    declared = effect.declared()
    if len(declared) == 1:
        return next(iter(declared))
    if isinstance(place.node, yaml.MappingNode):
        place = place.mapping(("value", "std"), "value").get("value", place)
    unit = place.quantity()[1] if isinstance(place.node, yaml.ScalarNode) else ""
    suits = [name for name, each in declared.items() if unit and convertible(unit, each.unit)]
    if len(suits) != 1 and suits[:1] != ["coefficient"]:
        raise place.error(f"{effect.label} has several parameters; name them: {', '.join(declared)}")
    return suits[0]


def _read_fixed(place: Place, effect: Effect) -> set[tuple[str, str]]:
    """Which parameters are known: all (true), none (false), or those listed."""
    declared = effect.declared()
    if isinstance(place.node, yaml.SequenceNode):
        names = [item.text() for item in place.items("fixed")]
        if absent := [name for name in names if name in declared and not np.size(getattr(effect, name))]:
            raise place.error(f"{effect.label} has no {absent[0]} that could be fixed")
    else:
        names = {"true": list(declared), "false": []}.get(place.text().lower())
    if names is None or not set(names) <= set(declared):
        raise place.error(f"fixed is true, false or a list of parameters ({', '.join(declared)})")
    if not all(np.isfinite(np.asarray(getattr(effect, name))).all() for name in names):
        raise place.error(f"{effect.label} is fixed but has no value")
    return {(effect.label, name) for name in names}


def _read_parameter(place: Place, effect: Effect, name: str) -> dict[str, Any]:
    """A parameter's value, and its unit where that depends on the campaign."""
    if isinstance(place.node, yaml.MappingNode):
        inner = place.mapping(("value", "std"), name)
        if "value" not in inner:
            raise place.error(f"{name} has no value")
        place = inner["value"]
    if np.ndim(getattr(effect, name)) > 0:
        places = place.items(name) if isinstance(place.node, yaml.SequenceNode) else [place]
        return {name: np.array([_number(p, effect, name) for p in places])}
    if effect.site == "gain":
        value = place.number_in(*GAIN_UNITS)
        if value == 0:
            raise place.error("a scale factor cannot be zero")
        return {name: value, "unit": place.quantity()[1] or "1"}
    if effect.site == "readout":
        value, unit = place.quantity()
        return {name: value, "unit": unit or "1"}
    if isinstance(effect, BiasColumn):
        value, unit = place.quantity()
        return {name: value, "unit": unit or ("1" if value else "")}
    return {name: _number(place, effect, name)}


def _number(place: Place, effect: Effect, name: str) -> float:
    return place.number_in(effect.declared()[name].unit, difference=name not in TEMPERATURES)


def _read_setting(place: Place, effect: Effect, name: str) -> Any:
    default = getattr(effect, name)
    if isinstance(default, str):
        return place.text()
    if isinstance(default, tuple | int):
        places = place.items(name) if isinstance(default, tuple) else [place]
        texts = [p.text() for p in places]
        if isinstance(default, tuple) and "str" in next(str(f.type) for f in fields(effect) if f.name == name):
            return tuple(texts)
        if not all(re.fullmatch(r"[-+]?\d{1,3}", text) for text in texts):
            raise place.error(f"{name} takes whole numbers below 1000")
        numbers = tuple(int(text) for text in texts)
        return numbers if isinstance(default, tuple) else numbers[0]
    return place.quantity()[0] if isinstance(effect, BiasColumn) else place.number_in(SETTING_UNITS[name])


def write_model(model: GyroModel | Estimate, path: str | Path) -> None:
    """Write a model; of an estimate also uncertainties, covariance, validity, data hash and software version."""
    estimate = model if isinstance(model, Estimate) else None
    gyro_model = model.model if isinstance(model, Estimate) else model
    write_text(
        Path(path), yaml.safe_dump(_document(gyro_model, estimate), sort_keys=False, allow_unicode=True, width=110)
    )


def _document(model: GyroModel, estimate: Estimate | None) -> dict[str, Any]:
    record = estimate.record if estimate else None
    spread = {}
    if estimate:
        spread = {(s.effect, s.field, s.index): float(sd) for s, sd in zip(model.slots(), estimate.std, strict=True)}
    document: dict[str, Any] = {"gyro": model.gyro} if model.gyro else {}
    document["effects"] = []
    for i, effect in enumerate(model.effects):
        entry: dict[str, Any] = {"effect": effect.label}
        for name in effect.declared():
            values = np.asarray(getattr(effect, name))
            if not np.isfinite(values).all():
                continue
            unit = _unit_of(effect, name, record)
            errors = [spread.get((i, name, j)) for j in range(values.size)]
            known = [e for e in errors if e is not None]
            entry[name] = _shown(values, unit)
            if known and len(known) == len(errors):
                entry[name] = {"value": entry[name], "std": _shown(np.reshape(known, values.shape), unit)}
        for name in effect.settings():
            value = getattr(effect, name)
            if value == "" or (isinstance(value, tuple) and not any(value)):
                continue
            if isinstance(value, tuple | int | str):
                entry[name] = list(value) if isinstance(value, tuple) else value
            elif np.isfinite(float(value)):
                entry[name] = exact_text(float(value), setting_unit(effect, name, record))
        fixed = [name for name in effect.declared() if (effect.label, name) in model.fixed]
        if fixed:
            entry["fixed"] = True if len(fixed) == len(effect.declared()) else fixed
        document["effects"].append(entry)
    document["noise"] = noise_entries(model)
    if estimate and record:
        document["fit"] = _fit_record(estimate)
        document["software"] = f"gyromodel {__version__}"
    return document


def _fit_record(estimate: Estimate) -> dict[str, Any]:
    record, validity = estimate.record, {}
    for name, ends in estimate.calibration().validity.items():
        unit = validity_unit(name)
        validity[name] = [f"{from_internal(end, unit):.10g} {unit}" for end in ends]
    return {
        "degrees_of_freedom": estimate.degrees_of_freedom,
        "validity": validity,
        "data_hash": record.data_hash,
        "covariance": {
            "parameters": parameter_names(estimate.model),
            "unit": "internal units of each parameter (rad, s, °C, count)",
            "matrix": estimate.covariance.tolist(),
        },
    } | ({"sources": _sources(estimate)} if estimate.inherited else {})


def _sources(estimate: Estimate) -> list[dict[str, Any]]:
    """Where the errors of a fit in stages come from."""
    return [
        {"name": source.name}
        | ({"degrees_of_freedom": source.degrees_of_freedom} if np.isfinite(source.degrees_of_freedom) else {})
        | {"factor": part.tolist()}
        for source, part in estimate.parameters.sources.items()
    ]


def parameter_names(model: GyroModel) -> list[str]:
    """The free parameters as the covariance in a file names them."""
    return [f"{model.labels[s.effect]}.{s.field}[{s.index}]" for s in model.slots()]


def _unit_of(effect: Effect, name: str, record: Record | None) -> str:
    """The unit a parameter is written in; before a fit, one that depends on the campaign is the one it was read in."""
    if record:
        return parameter_unit(effect, name, record.output_unit, record.units)
    if effect.site in ("gain", "readout") or isinstance(effect, BiasColumn):
        return getattr(effect, "unit", "")
    return effect.declared()[name].unit


def setting_unit(effect: Effect, name: str, record: Record | None) -> str:
    """The unit a setting is written in."""
    if not isinstance(effect, BiasColumn):
        return SETTING_UNITS[name]
    unit = record.units.get(effect.column, "") if record else ""
    return "degC" if internal_unit(unit) == "degC" else unit


def _shown(values: np.ndarray, unit: str) -> Any:
    """A parameter's values, internal, as the file shows them."""
    texts = [exact_text(float(v), unit) for v in np.ravel(values)]
    return texts if np.ndim(values) else texts[0]
