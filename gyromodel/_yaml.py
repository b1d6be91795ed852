"""YAML as places that know their line, and quantities that come back exactly as they were written."""

from __future__ import annotations

import re
from decimal import Decimal
from pathlib import Path

import numpy as np
import yaml
from yaml.reader import ReaderError

from gyromodel.model import ModelError
from gyromodel.units import UnitError, convertible, factor, internal_unit, quantity, to_internal

_NUMBER = re.compile(r"\s*[-+]?[0-9.]+(?:[eE][-+]?[0-9]+)?")


class Place:
    """A piece of the file with its line, so that every complaint says where."""

    def __init__(self, path: Path, node: yaml.Node) -> None:
        self.path, self.node = path, node

    def error(self, message: str) -> ModelError:
        """A complaint about this place."""
        return complaint(self.path, self.node.start_mark.line, message)

    def mapping(
        self, allowed: tuple[str, ...], what: str, *, complete: bool = False, also: tuple[str, ...] = ()
    ) -> dict[str, Place]:
        """Its values by key, all keys allowed; with `complete`, all there, and those of `also` if they are."""
        if not isinstance(self.node, yaml.MappingNode):
            raise self.error(f"expected {what} as key: value pairs")
        found: dict[str, Place] = {}
        for key, value in self.node.value:
            place = Place(self.path, key)
            name = place.text()
            if name not in (*allowed, *also):
                raise place.error(f"unknown key {name!r} in {what}; known are {', '.join((*allowed, *also))}")
            if name in found:
                raise place.error(f"{name!r} appears twice")
            found[name] = Place(self.path, value)
        if complete and (missing := [name for name in allowed if name not in found]):
            raise self.error(f"{what} lacks {missing[0]}; fit the model again")
        return found

    def items(self, what: str) -> list[Place]:
        """The entries of a list."""
        if not isinstance(self.node, yaml.SequenceNode):
            raise self.error(f"expected {what} as a list")
        return [Place(self.path, n) for n in self.node.value]

    def text(self) -> str:
        """One value as it is written."""
        if not isinstance(self.node, yaml.ScalarNode):
            raise self.error("expected one value")
        return str(self.node.value)

    def quantity(self, difference: bool = False) -> tuple[float, str]:
        """A quantity "12 deg/h" in internal units, and the unit text it was written in.

        A `difference` of 1 K is 1 °C.
        """
        text = self.text()
        try:
            value, unit = quantity(text)
            if internal_unit(unit) == "degC" and not difference:
                value = float(to_internal(np.asarray(value), unit))
            elif value:
                value = _rounded_once(text, factor(unit, internal_unit(unit)))
        except UnitError as problem:
            raise self.error(str(problem)) from None
        if not np.isfinite(value):
            raise self.error(f"{text!r} is too large")
        return value, unit

    def number_in(self, *units: str, difference: bool = False) -> float:
        """A quantity that must convert to one of some units, in internal units."""
        value, written = self.quantity(difference)
        if not any(convertible(written, unit) for unit in units):
            expected = " or ".join(unit or "a plain number" for unit in units)
            raise self.error(
                f"{self.text()!r} is " + (f"not in {expected}" if written else f"without unit: {expected}")
            )
        return value


def complaint(path: Path, line: int, message: str) -> ModelError:
    """What is wrong in a line of a file, counted from zero."""
    return ModelError(f"{path.name}, line {line + 1}: {message}")


def _rounded_once(text: str, scale: float) -> float:
    """The number a text begins with, times a scale: rounded once, so that enough digits give any float exactly."""
    match = _NUMBER.match(text)
    assert match is not None
    return float(Decimal(match[0].strip()) * Decimal(scale))


def compose(path: Path) -> yaml.Node | None:
    """The root of a file; None where it is empty."""
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        raise ModelError(f"{path}: no such file") from None
    except OSError as problem:
        raise ModelError(f"{path}: cannot be read ({problem.__class__.__name__})") from None
    try:
        return yaml.compose(text := data.decode(), Loader=yaml.SafeLoader)
    except UnicodeDecodeError as problem:
        raise complaint(path, data[: problem.start].count(b"\n"), "not a text file in UTF-8") from None
    except ReaderError as problem:
        line = text[: int(problem.position)].count("\n")
        raise complaint(path, line, f"the character {chr(int(problem.character))!r} is not allowed") from None
    except yaml.MarkedYAMLError as problem:
        line = problem.problem_mark.line if problem.problem_mark else 0
        raise complaint(path, line, f"not valid YAML: {problem.problem}") from None
    except (yaml.YAMLError, RecursionError, ValueError, OverflowError) as problem:
        # PyYAML lets through what Python says of an escape beyond Unicode, or of thousands of nested brackets.
        raise complaint(path, 0, f"not valid YAML: {str(problem).splitlines()[0]}") from None


def exact_text(value: float, unit: str) -> str | float:
    """The shortest quantity that reads back as exactly this internal value."""
    scale = factor(unit, internal_unit(unit))
    if unit in ("", "1"):
        return value
    for digits in (15, 16, 17, 18, 19, 20, 21):
        text = f"{Decimal(value) / Decimal(scale):.{digits}g}" if digits > 17 else f"{value / scale:.{digits}g}"
        if _rounded_once(text, scale) == value:
            break
    return f"{text} {unit}"
