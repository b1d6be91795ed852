"""All that the search tries on a campaign, as columns: catalogue effects in every form, and smooth unknown drivers."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from jaxtyping import Array

from gyromodel._checks import of_usual_unit, usual_unit
from gyromodel.diagnosis._drivers import driver_names, is_no_driver, unusable
from gyromodel.diagnosis._smooths import products, smooths
from gyromodel.effects import CATALOGUE, Effect, Signals
from gyromodel.effects._base import lacking
from gyromodel.effects._shapes import SLOW
from gyromodel.effects.drivers import BiasColumn
from gyromodel.model import GyroModel
from gyromodel.signals import Record

# Columns whose linear effect on the bias is in the catalogue, is the scale factor, or means nothing.
OWN_EFFECTS = ("rate", "temperature", "campaign")
# The effect that follows a column in its own way, so that a bias proportional to the column is not searched besides.
OWNERS = (
    {
        "acceleration_input": "bias_acceleration_input",
        "acceleration_spin": "bias_acceleration_spin",
        "acceleration_output": "bias_acceleration_output",
        "vibration": "bias_vibration",
        "magnetic_field": "bias_magnetic",
        "rate_spin": "misalignment",
        "rate_output": "misalignment",
        "azimuth": "table_tilt",
        "table_angle": "table_harmonic",
        "torquer_current": "torquer_scale",
        "backscatter": "bias_backscatter",
        "null_shift": "bias_null_shift",
    }
    | {f"magnetic_field_{axis}": "bias_magnetic" for axis in "xyz"}
    | {f"rate_{axis}": "misalignment" for axis in "xyz"}
)
# Before the name of an effect that is searched, but not in all its forms.
PART_OF = "part of "
NOTHING_KNOWN = GyroModel(())


@dataclass(frozen=True)
class Block:
    """Columns of one form of one candidate; they stand at `start` … `start + width` of the bank.

    Forms of one `structure` differ only in the values of nonlinear parameters. `along` is what a driver's first column
    is drawn over; `least` the smallest coefficient of a positive effect; `price` what its evidence pays (nats) for
    being one of many of its kind, or by its prior odds.
    """

    name: str
    kind: Literal["effect", "driver"]
    start: int
    width: int
    structure: str
    effect: Effect | None
    along: np.ndarray | None = field(default=None, repr=False)
    least: float = 0.0
    price: float = 0.0


@dataclass(frozen=True)
class Bank:
    """All blocks, ordered by width so that blocks of one width lie together, and why the rest cannot be tested."""

    columns: np.ndarray = field(repr=False)
    blocks: tuple[Block, ...]
    scans: tuple[str, ...]
    not_testable: dict[str, str]

    def names(self) -> tuple[str, ...]:
        """Every candidate once: blocks, then fast scans."""
        return tuple(dict.fromkeys([b.name for b in self.blocks] + list(self.scans)))

    def forms(self, name: str) -> list[Effect]:
        """The forms of a catalogue effect that are laid out as columns, but those that others grow into."""
        return [b.effect for b in self.blocks if b.name == name and b.effect is not None and not b.effect.grown]

    def structures(self, name: str) -> int:
        """How many structures a catalogue effect's forms have."""
        return len({b.structure for b in self.blocks if b.name == name and b.effect is not None and not b.effect.grown})

    def price(self, name: str) -> float:
        """What a candidate's evidence pays beside that for its forms (nats); nothing where it has no columns here."""
        return next((b.price for b in self.blocks if b.name == name), 0.0)

    def layout(self) -> dict[int, tuple[int, int, int]]:
        """By width: the first block of that width, how many there are, and the first one's first column."""
        widths = [b.width for b in self.blocks]
        return {q: (widths.index(q), widths.count(q), self.blocks[widths.index(q)].start) for q in sorted(set(widths))}


class BlockTable:
    """A bank's blocks as arrays, and the order in which those of a name and, within it, of a structure lie together.

    `smallest` is the smallest coefficient of a positive effect, `leading` how many columns its sizes are told of.
    """

    def __init__(self, bank: Bank) -> None:
        parts: dict[str, dict[str, list[int]]] = {}
        for i, block in enumerate(bank.blocks):
            parts.setdefault(block.name, {}).setdefault(block.structure, []).append(i)
        structures = [blocks for of_name in parts.values() for blocks in of_name.values()]
        self.names = list(parts)
        self.order = np.array([i for blocks in structures for i in blocks], int)
        self.structure_starts = np.cumsum([0, *map(len, structures)])[:-1]
        self.name_starts = np.cumsum([0, *map(len, parts.values())])[:-1]
        self.drivers = np.array([b.kind == "driver" for b in bank.blocks], bool)
        self.positive = np.array([b.effect is not None and b.effect.positive for b in bank.blocks])
        self.smallest = np.array([b.least for b in bank.blocks])
        self.price = np.array([b.price for b in bank.blocks])
        self._blocks = [b.name for b in bank.blocks]
        self._widths = np.array([b.width for b in bank.blocks], int)
        leading = [b.width if b.effect is None else np.size(getattr(b.effect, b.effect.leading())) for b in bank.blocks]
        self.leading = np.minimum(leading, self._widths)
        self._grown = np.array([b.effect is not None and b.effect.grown for b in bank.blocks])
        self._scaled = np.array([b.effect is not None and b.effect.site == "scale" for b in bank.blocks], bool)

    def most(self, contained: dict[str, int]) -> np.ndarray:
        """How many columns of each block can be left: of scale terms, those that a baseline does not have.

        What scale terms multiply differs a little from the bank's, as all that was found has moved the bias: the
        difference is a bias, and nothing of the scale factor.
        """
        spare = np.array([contained.get(name, 0) for name in self._blocks])
        return np.where(self._scaled, np.maximum(self._widths - spare, 0), self._widths)

    def least(self, contained: dict[str, int]) -> np.ndarray:
        """How many columns of each block must be left beside a baseline that has so many of a name's."""
        spare = np.array([contained.get(name, 0) for name in self._blocks])
        least = np.where(self.drivers, 1, np.maximum(self._widths - spare, 1))
        return np.where(self._grown & (spare == 0), self._widths + 1, least)


def _usable(record: Record) -> dict[str, Array]:
    """Signals less the columns that catalogue effects cannot take for their unit."""
    return {n: v for n, v in record.signals.items() if of_usual_unit(n, record.units.get(n, usual_unit(n)))}


def _is_owned(record: Record, name: str) -> bool:
    """Whether a column's linear effect on the bias has another name than the column's."""
    return name in OWN_EFFECTS or (name in OWNERS and of_usual_unit(name, record.units[name]))


def build_bank(record: Record, model: GyroModel = NOTHING_KNOWN) -> Bank:
    """Lay out the search for a record: columns of extensions of a fitted model, at zero amplitude, as input rates."""
    signals = _usable(record)
    of, gain = model.columns_at(record.signals), float(model.gain())

    def columns(effect: Effect, seen: Signals) -> np.ndarray:
        # Of a gain by its relative change.
        whole = float(effect.value) if effect.site == "gain" else 1.0  # type: ignore[attr-defined]
        return np.asarray(of(effect, seen)) * whole / gain

    blocks: list[tuple[str, Literal["effect", "driver"], np.ndarray, Effect | None]] = []
    not_testable: dict[str, str] = {}
    scans = []
    for name, kind in sorted(CATALOGUE.items()):
        if kind.domain != record.domain:
            continue
        if kind.site == "readout":
            continue
        if name == "bias_column" or (kind.site == "gain" and "rate" not in signals):
            if name != "bias_column":
                not_testable[name] = "needs a column rate"
            continue
        reason = _missing(kind, record, signals)
        if reason:
            not_testable[name] = reason
        elif kind.scan and not record.run_numbers:
            not_testable[name] = "is searched in runs that a column campaign numbers from 1 to 99: here it does not"
        elif kind.scan:
            scans.append(name)
        else:
            forms = kind.candidates(signals)
            if not forms:
                not_testable[name] = kind.untested
            elif part := kind.hidden(signals):
                not_testable[PART_OF + name] = part
            blocks.extend((name, "effect", columns(e, signals), e) for e in forms)
    # A column of a platform's test is part of its motion, in proportion to which the angle errs by other names.
    linear = record.domain == "gyro"
    for name in record.signals:
        reason = "" if is_no_driver(name) else unusable(record, name)
        if reason:
            not_testable |= {f"smooth({name})": reason} | (
                {} if not linear or _is_owned(record, name) else {BiasColumn(column=name).label: reason}
            )
    for name in [n for n in driver_names(record) if linear and not _is_owned(record, n)]:
        effect = BiasColumn(column=name).prepared(record.signals)
        blocks.append((effect.label, "effect", columns(effect, record.signals), effect))
    along = {}
    for name, values, shape in smooths(record):
        along[len(blocks)] = values
        blocks.append((name, "driver", shape, None))
    many = list(products(record, {name for name, *_ in blocks}))
    for name, values, shape in many:
        along[len(blocks)] = values
        blocks.append((name, "driver", shape, None))
    priced = len(blocks) - len(many)
    order = sorted(range(len(blocks)), key=lambda i: blocks[i][2].shape[1])
    laid, start = [], 0
    for i in order:
        name, kind_of, shape, effect = blocks[i]
        width = shape.shape[1]
        laid.append(
            Block(
                name,
                kind_of,
                start,
                width,
                _structure(name, effect, width),
                effect,
                along.get(i),
                effect.least(signals) if effect is not None else 0.0,
                float(np.log(len(many)) if i >= priced else -np.log(effect.odds if effect is not None else 1.0)),
            )
        )
        start += shape.shape[1]
    laid_out = np.concatenate([blocks[i][2] for i in order], axis=1) if blocks else np.zeros((len(signals["time"]), 0))
    return Bank(laid_out, tuple(laid), tuple(scans), not_testable)


def _structure(name: str, effect: Effect | None, width: int) -> str:
    if effect is None:
        return f"{name}/{width}"
    shapes = [np.shape(getattr(effect, k)) for k in effect.declared()]
    return f"{name}/{shapes}/{effect.structure}"


def _missing(kind: type[Effect], record: Record, usable: Signals) -> str:
    for name in kind.needs:
        if lacking((name,), usable):
            return f"needs a column {name}" + (f" in a unit like {usual_unit(name)}" if name in record.signals else "")
        reasons = [unusable(record, n) for n in name.split(" or ") if n in usable]
        if reasons and all(reasons) and not (name == "rate" and _is_multiplied(kind, usable["rate"])):
            return " and ".join(reasons)
    return ""


def _is_multiplied(kind: type[Effect], rate: Array) -> bool:
    """Whether an effect of the scale factor or of another column shows at a steady rate, beyond the Earth's."""
    return (kind.site == "gain" or len(kind.needs) > 1) and float(np.min(np.abs(rate))) > SLOW
