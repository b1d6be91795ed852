"""All that the search tries on a campaign, as columns: catalogue effects in every form, and smooth unknown drivers."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import jax.numpy as jnp
import numpy as np

from gyromodel._checks import DERIVED
from gyromodel.effects import CATALOGUE, Effect, Signals
from gyromodel.effects._base import lacking
from gyromodel.effects.drivers import BiasColumn
from gyromodel.signals import Record

# Length scales of the smooth functions, as parts of the driver's range.
SMOOTH_SCALES = (0.08, 0.2, 0.5)
PAIR_SCALES = (0.25, 0.6)
# Columns whose linear effect on the bias is in the catalogue, is the scale factor, or means nothing.
OWN_EFFECTS = ("rate", "temperature", "campaign")
# What `compensate` adds is the output itself; every function of the ramp's code is bias_readout_code.
NOT_DRIVERS = ("time", "output", "segment", "run", "position", "feedback_ramp", "rate_estimated", "rate_estimated_std")


@dataclass(frozen=True)
class Block:
    """Columns of one form of one candidate; they stand at `start` … `start + width` of the bank.

    Forms of one `structure` differ only in the values of nonlinear parameters.
    """

    name: str
    kind: Literal["effect", "driver"]
    start: int
    width: int
    structure: str
    effect: Effect | None


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

    def layout(self) -> dict[int, tuple[int, int, int]]:
        """By width: the first block of that width, how many there are, and the first one's first column."""
        widths = [b.width for b in self.blocks]
        return {q: (widths.index(q), widths.count(q), self.blocks[widths.index(q)].start) for q in sorted(set(widths))}


def driver_names(record: Record) -> tuple[str, ...]:
    """Measured columns that vary: what an unknown discrepancy may follow, besides time."""
    return tuple(n for n in record.signals if not _is_no_driver(n) and not _unusable(record, n))


def _is_no_driver(name: str) -> bool:
    return name in NOT_DRIVERS or bool(DERIVED.fullmatch(name))


def build_bank(record: Record) -> Bank:
    """Lay out the search for a record."""
    signals = record.signals
    blocks: list[tuple[str, Literal["effect", "driver"], np.ndarray, Effect | None]] = []
    not_testable: dict[str, str] = {}
    scans = []
    rate = np.asarray(signals.get("rate", jnp.zeros_like(signals["time"])))
    for name, kind in sorted(CATALOGUE.items()):
        if name == "bias_column" or (kind.site == "gain" and "rate" not in signals):
            if name != "bias_column":
                not_testable[name] = "needs a column rate"
            continue
        reason = _missing(kind, record)
        if reason:
            not_testable[name] = reason
        elif kind.scan and np.asarray(record.sampling.restart).sum() > 1:
            not_testable[name] = "is searched in one run at a time: diagnose the runs one by one too"
        elif kind.scan:
            scans.append(name)
        else:
            forms = kind.candidates(signals)
            if not forms:
                not_testable[name] = kind.untested
            blocks.extend((name, "effect", _weighted(e, signals, rate), e) for e in forms)
    plain = [n for n in driver_names(record) if n not in OWN_EFFECTS]
    for name in record.signals:
        reason = "" if _is_no_driver(name) else _unusable(record, name)
        if reason:
            not_testable |= {f"smooth({name})": reason} | (
                {} if name in OWN_EFFECTS else {BiasColumn(column=name).label: reason}
            )
    for name in plain:
        effect = BiasColumn(column=name).prepared(signals)
        blocks.append((effect.label, "effect", _weighted(effect, signals, rate), effect))
    for name, shape in _smooths(record):
        blocks.append((name, "driver", shape, None))
    blocks.sort(key=lambda b: b[2].shape[1])
    laid, start = [], 0
    for name, kind_of, shape, effect in blocks:
        laid.append(Block(name, kind_of, start, shape.shape[1], _structure(name, effect, shape.shape[1]), effect))
        start += shape.shape[1]
    columns = np.concatenate([b[2] for b in blocks], axis=1) if blocks else np.zeros((len(rate), 0))
    return Bank(columns, tuple(laid), tuple(scans), not_testable)


def _structure(name: str, effect: Effect | None, width: int) -> str:
    if effect is None:
        return f"{name}/{width}"
    shapes = [np.shape(getattr(effect, k)) for k in effect.declared()]
    return f"{name}/{shapes}/{getattr(effect, 'powers', '')}"


def _missing(kind: type[Effect], record: Record) -> str:
    for name in kind.needs:
        if lacking((name,), record.signals):
            return f"needs a column {name}"
        if name in record.signals and (reason := _unusable(record, name)):
            return reason
    return ""


def _unusable(record: Record, name: str) -> str:
    """Why a column cannot be searched; empty where it can."""
    values = np.asarray(record.signals[name])[: record.rows][record.present]
    missing = int((~np.isfinite(values)).sum())
    if missing:
        return f"{name} is missing in {missing} of {len(values)} rows"
    return "" if np.ptp(values) > 0 else f"{name} does not vary"


def _weighted(effect: Effect, signals: Signals, rate: np.ndarray) -> np.ndarray:
    """The extension's derivative at zero amplitude, as an input rate."""
    if effect.site == "gain":
        return rate[:, None]
    columns = np.asarray(effect.columns(signals))
    return columns * rate[:, None] if effect.site == "scale" else columns


def _smooths(record: Record) -> list[tuple[str, np.ndarray]]:
    names = driver_names(record)
    found = [
        (f"smooth({name})", s) for name in (*names, "time") for s in _kernel_features(record, (name,), SMOOTH_SCALES)
    ]
    rate_first = sorted(names, key=lambda n: n not in ("rate", "temperature"))[:3]
    pairs = [(a, b) for i, a in enumerate(rate_first) for b in rate_first[i + 1 :]]
    return found + [(f"smooth({a}, {b})", s) for a, b in pairs for s in _kernel_features(record, (a, b), PAIR_SCALES)]


def _unit_interval(record: Record, name: str) -> np.ndarray:
    values = np.asarray(record.signals[name])
    low, high = values[: record.rows].min(), values[: record.rows].max()
    return (values - low) / (high - low)


def _kernel_features(record: Record, names: tuple[str, ...], scales: tuple[float, ...]) -> list[np.ndarray]:
    """Gaussian bumps one length scale apart, of one column or of the product of two."""
    found = []
    for scale in scales:
        per_column = []
        for name in names:
            centres = np.linspace(0.0, 1.0, round(1.0 / scale) + 1)
            distance = (_unit_interval(record, name)[:, None] - centres) / scale
            per_column.append(np.exp(-0.5 * distance**2))
        shape = per_column[0]
        for other in per_column[1:]:
            shape = (shape[:, :, None] * other[:, None, :]).reshape(len(shape), -1)
        found.append(shape)
    return found


def smooth_columns(name: str) -> tuple[str, ...]:
    """The columns a driver candidate's name holds: "smooth(rate, temperature)" → (rate, temperature)."""
    return tuple(part.strip() for part in name.removeprefix("smooth(").removesuffix(")").split(","))
