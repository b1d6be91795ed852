"""Models to and from YAML, with units and line-numbered errors."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import yaml

from gyromodel import __version__
from gyromodel._atomic import write_text
from gyromodel.effects import Effect
from gyromodel.effects.drivers import BiasColumn
from gyromodel.estimate import Estimate
from gyromodel.model import GyroModel, ModelError, effect_class, make_effect, parameter_unit
from gyromodel.noise import NOISE_UNITS
from gyromodel.units import UnitError, convertible, factor, from_internal, internal_unit, quantity, to_internal

# Written into fitted models for the reader; not needed to use them again.
RECORD_KEYS = ("fit", "software")


class _Place:
    """A piece of the file with its line, so that every complaint says where."""

    def __init__(self, path: Path, node: yaml.Node) -> None:
        self.path, self.node = path, node

    def error(self, message: str) -> ModelError:
        return ModelError(f"{self.path.name}, line {self.node.start_mark.line + 1}: {message}")

    def mapping(self, allowed: tuple[str, ...], what: str) -> dict[str, _Place]:
        if not isinstance(self.node, yaml.MappingNode):
            raise self.error(f"expected {what} as key: value pairs")
        found: dict[str, _Place] = {}
        for key, value in self.node.value:
            place = _Place(self.path, key)
            if key.value not in allowed:
                raise place.error(f"unknown key {key.value!r} in {what}; known are {', '.join(allowed)}")
            if key.value in found:
                raise place.error(f"{key.value!r} appears twice")
            found[key.value] = _Place(self.path, value)
        return found

    def items(self, what: str) -> list[_Place]:
        if not isinstance(self.node, yaml.SequenceNode):
            raise self.error(f"expected {what} as a list")
        return [_Place(self.path, n) for n in self.node.value]

    def text(self) -> str:
        if not isinstance(self.node, yaml.ScalarNode):
            raise self.error("expected one value")
        return str(self.node.value)

    def number_in(self, unit: str) -> float:
        """A quantity "12 deg/h" converted to the internal form of `unit`; a bare number counts in `unit` itself."""
        text = self.text()
        try:
            value, written = quantity(text)
            if written == "" and not convertible("", unit):
                raise self.error(f"{text!r} needs a unit, for example {text} {unit}")
            if not convertible(written, unit):
                raise self.error(f"{text!r} is not a quantity in {unit}")
            return (
                float(to_internal(np.asarray(value), written))
                if unit == "degC"
                else value * factor(written, internal_unit(unit))
            )
        except UnitError as problem:
            raise self.error(str(problem)) from None


def read_model(path: str | Path) -> GyroModel:
    """Read a model.

    Raises:
        ModelError: the file is not a model; the message names the line.
    """
    path = Path(path)
    try:
        node = yaml.compose(path.read_text(encoding="utf-8"), Loader=yaml.SafeLoader)
    except FileNotFoundError:
        raise ModelError(f"{path}: no such file") from None
    except (OSError, UnicodeDecodeError) as problem:
        raise ModelError(f"{path}: cannot be read as text ({problem.__class__.__name__})") from None
    except yaml.MarkedYAMLError as problem:
        line = problem.problem_mark.line + 1 if problem.problem_mark else 1
        raise ModelError(f"{path.name}, line {line}: not valid YAML: {problem.problem}") from None
    except yaml.YAMLError as problem:
        raise ModelError(f"{path.name}: not valid YAML: {str(problem).splitlines()[0]}") from None
    if node is None:
        raise ModelError(f"{path.name}: the file is empty; it needs a list of effects")
    top = _Place(path, node).mapping(("gyro", "effects", "noise", *RECORD_KEYS), "a model")
    if "effects" not in top:
        raise ModelError(f"{path.name}: the model lists no effects")
    effects, fixed = [], set()
    for place in top["effects"].items("effects"):
        effect, known = _read_effect(place)
        effects.append(effect)
        fixed |= known
    noise = _read_noise(top["noise"]) if "noise" in top else {}
    gyro = top["gyro"].text() if "gyro" in top else ""
    try:
        return GyroModel(tuple(effects), noise, frozenset(fixed), gyro)
    except ModelError as problem:
        raise top["effects"].error(str(problem)) from None


def _read_effect(place: _Place) -> tuple[Effect, set[tuple[str, str]]]:
    keys = {key.value: value for key, value in place.node.value} if isinstance(place.node, yaml.MappingNode) else {}
    if "effect" not in keys:
        raise place.error("each entry needs an effect: id")
    label = _Place(place.path, keys["effect"]).text()
    try:
        effect = make_effect(label)
    except ModelError as problem:
        raise place.error(str(problem)) from None
    declared = effect_class(label).declared()
    settings = [f.name for f in fields(effect) if f.name not in declared and f.name != "column"]
    found = place.mapping(("effect", "value", "fixed", "std", *declared, *settings), label)
    if "value" in found and len(declared) == 1:
        found[next(iter(declared))] = found.pop("value")
    elif "value" in found:
        raise found["value"].error(f"{label} has several parameters; name them: {', '.join(declared)}")
    values: dict[str, Any] = {}
    for name in declared:
        if name in found:
            values[name] = _read_parameter(found[name], effect, name)
    for name in settings:
        if name in found:
            values[name] = _read_setting(found[name], name)
    extra = {"column": effect.column} if isinstance(effect, BiasColumn) else {}
    effect = type(effect)(**values, **extra)
    known: set[tuple[str, str]] = set()
    if "fixed" in found:
        text = found["fixed"].text().lower()
        if text not in ("true", "false"):
            raise found["fixed"].error("fixed is true or false")
        known = {(label, name) for name in declared} if text == "true" else set()
        if text == "true" and not all(np.isfinite(np.asarray(getattr(effect, n))).all() for n in declared):
            raise found["fixed"].error(f"{label} is fixed but has no value")
    return effect, known


def _read_parameter(place: _Place, effect: Effect, name: str) -> np.ndarray | float:
    unit = effect.declared()[name].unit
    if isinstance(place.node, yaml.MappingNode):
        inner = place.mapping(("value", "std", "unit"), name)
        if "value" not in inner:
            raise place.error(f"{name} has no value")
        place = inner["value"]
    places = place.items(name) if isinstance(place.node, yaml.SequenceNode) else [place]
    if effect.site == "gain" or isinstance(effect, BiasColumn):
        values = [_free_unit(p) for p in places]
    else:
        values = [p.number_in(unit) for p in places]
    return np.array(values) if isinstance(place.node, yaml.SequenceNode) else values[0]


def _free_unit(place: _Place) -> float:
    """A quantity whose unit depends on the campaign (output per rate, bias per column), in internal units."""
    try:
        value, written = quantity(place.text())
        return value * factor(written, internal_unit(written))
    except UnitError as problem:
        raise place.error(str(problem)) from None


def _read_setting(place: _Place, name: str) -> Any:
    if isinstance(place.node, yaml.SequenceNode):
        try:
            return tuple(int(p.text()) for p in place.items(name))
        except ValueError:
            raise place.error(f"{name} is a list of whole numbers") from None
    try:
        value, written = quantity(place.text())
        return jnp.asarray(to_internal(np.asarray(value), written))
    except UnitError as problem:
        raise place.error(str(problem)) from None


def _read_noise(place: _Place) -> dict[str, float]:
    if isinstance(place.node, yaml.ScalarNode):
        if place.text() != "auto":
            raise place.error('noise is "auto" or a list of noise_* effects with values')
        return {}
    noise: dict[str, float] = {}
    for item in place.items("noise"):
        entry = item.mapping(("effect", "value", "lo", "hi"), "a noise entry")
        if "effect" not in entry or "value" not in entry:
            raise item.error("each noise entry needs an effect: id and a value")
        name = entry["effect"].text()
        if name not in NOISE_UNITS:
            raise entry["effect"].error(f"unknown noise {name}; known are {', '.join(NOISE_UNITS)}")
        noise[name] = entry["value"].number_in(NOISE_UNITS[name])
        if noise[name] < 0:
            raise entry["value"].error(f"{name} cannot be negative")
    return noise


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
            unit = parameter_unit(
                effect, name, record.output_unit if record else "rad/s", record.units if record else {}
            )
            values = np.asarray(getattr(effect, name))
            if not np.isfinite(values).all():
                continue
            scale = factor(internal_unit(unit), unit)
            texts = [_quantity_text(v * scale, unit) for v in np.ravel(values)]
            errors = [spread.get((i, name, j)) for j in range(values.size)]
            shown: Any = texts if values.ndim else texts[0]
            if all(e is not None for e in errors) and errors:
                stds = [_quantity_text(e * scale, unit) for e in errors if e is not None]
                shown = {"value": shown, "std": stds if values.ndim else stds[0]}
            entry[name] = shown
        for f in fields(effect):
            value = getattr(effect, f.name)
            if f.name in effect.declared() or f.name == "column":
                continue
            if isinstance(value, tuple):
                entry[f.name] = list(value)
            elif np.isfinite(np.asarray(value)).all():
                entry[f.name] = _setting_text(effect, f.name, float(value), record)
        if any(label == effect.label for label, _ in model.fixed):
            entry["fixed"] = True
        document["effects"].append(entry)
    if not model.noise:
        document["noise"] = "auto"
    else:
        document["noise"] = [
            {
                "effect": k,
                "value": _quantity_text(
                    float(v) * factor(internal_unit(NOISE_UNITS[k]), NOISE_UNITS[k]), NOISE_UNITS[k]
                ),
            }
            for k, v in model.noise.items()
        ]
    if estimate and record:
        document["fit"] = _fit_record(estimate)
        document["software"] = f"gyromodel {__version__}"
    return document


def _fit_record(estimate: Estimate) -> dict[str, Any]:
    record, model = estimate.record, estimate.model
    validity = {}
    for name, unit in (("rate", "deg/s"), ("temperature", "degC")):
        if name in record.signals:
            values = from_internal(np.asarray(record.signals[name])[: record.rows], unit)
            validity[name] = [_quantity_text(np.nanmin(values), unit), _quantity_text(np.nanmax(values), unit)]
    names = [f"{model.labels[s.effect]}.{s.field}[{s.index}]" for s in model.slots()]
    return {
        "degrees_of_freedom": estimate.degrees_of_freedom,
        "validity": validity,
        "data_hash": record.data_hash,
        "covariance": {
            "parameters": names,
            "unit": "internal units of each parameter (rad, s, °C, count)",
            "matrix": [[float(v) for v in row] for row in estimate.covariance],
        },
    }


def _setting_text(effect: Effect, name: str, value: float, record: Any) -> str:
    if isinstance(effect, BiasColumn):
        unit = (record.units.get(effect.column, "") if record else "") or ""
    else:
        unit = {"reference": "degC", "full_rate": "deg/s"}[name]
    return _quantity_text(float(from_internal(np.asarray(value), unit)), unit)


def _quantity_text(value: float, unit: str) -> str:
    return f"{value:.17g}" if unit in ("", "1") else f"{value:.17g} {unit}"
