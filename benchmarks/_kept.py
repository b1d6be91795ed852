"""Campaigns of the study on disk: a study that was stopped goes on, and several seeds make one page."""

from __future__ import annotations

import gzip
import hashlib
import json
import subprocess
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from tests.truth.campaigns import Truth
from tests.truth.contest import Control
from tests.truth.laws import Told
from tests.truth.study import Case, Record
from tests.truth.verdicts import Answer, Score

ROOT = Path(__file__).resolve().parents[1]


# What of the package diagnoses a campaign of a gyro: a study goes on where none of this has changed.
ENGINE = (
    "_noise_level.py", "_output_rate.py", "averages.py", "campaign.py", "diagnosis", "effects", "estimate", "model.py",
    "_model_units.py", "noise", "numerics", "poses.py", "signals.py", "units.py",
)  # fmt: skip


def code() -> str:
    """A digest of the engine as it is committed, with "+" where files differ from that."""
    paths = [f"gyromodel/{name}" for name in ENGINE]
    tree = subprocess.run(["git", "rev-parse", *(f"HEAD:{p}" for p in paths)], cwd=ROOT, capture_output=True).stdout
    changed = subprocess.run(["git", "diff", "--quiet", "HEAD", "--", *paths], cwd=ROOT).returncode
    return hashlib.sha256(tree).hexdigest()[:10] + ("+" if changed else "")


class Kept:
    """The parts of a study with one seed: records by label, what an oracle tells of some, what one process timed."""

    def __init__(self, path: Path) -> None:
        self.path = path
        stored = json.loads(gzip.decompress(path.read_bytes())) if path.exists() else {}
        self.code: str = stored.get("code", "")
        self.scale: float = stored.get("scale", 0.0)
        # Of a first process and one that it spares: by the processor, then by the clock.
        self.seconds: list[tuple[str, int, float, float, float, float]] = [tuple(r) for r in stored.get("seconds", [])]
        self.timed: str = stored.get("timed", "")
        self.oracle = {label: [Told(**t) for t in told] for label, told in stored.get("oracle", {}).items()}
        self.again: tuple[str, int, int] | None = tuple(stored["again"]) if stored.get("again") else None
        self.parts = {label: [_record(r) for r in records] for label, records in stored.get("parts", {}).items()}

    def save(self) -> None:
        """Write all of it, in one step."""
        parts = {label: [_plain(r) for r in records] for label, records in self.parts.items()}
        oracle = {label: [t._asdict() for t in told] for label, told in self.oracle.items()}
        stored = {"code": self.code, "scale": self.scale, "seconds": self.seconds, "again": self.again}
        stored["timed"] = self.timed
        stored |= {"oracle": oracle, "parts": parts}
        text = json.dumps(stored, default=_value, separators=(",", ":"))
        self.path.parent.mkdir(parents=True, exist_ok=True)
        part = self.path.with_suffix(".part")
        part.write_bytes(gzip.compress(text.encode(), mtime=0))
        part.replace(self.path)


def _plain(record: Record) -> dict[str, Any]:
    """A record without the samples of what was hidden."""
    none = np.zeros(0)
    truth = replace(record.truth, shape={}, error=none, errors=(), noise=none)
    return asdict(replace(record, truth=truth))


def _value(value: Any) -> Any:
    return value.tolist()


def _tuples(value: Any) -> Any:
    return tuple(map(_tuples, value)) if isinstance(value, list) else value


def _record(stored: dict[str, Any]) -> Record:
    truth = Truth(**{k: _tuples(v) for k, v in stored["truth"].items() if k not in ("error", "errors", "noise")})
    answer = {k: _tuples(v) for k, v in (stored["answer"] or {}).items()}
    if answer:
        answer["sizes"] = {k: _tuples(v) for k, v in stored["answer"]["sizes"].items()}
    return Record(**stored | {
        "case": Case(**{k: _tuples(v) for k, v in stored["case"].items()}),
        "truth": truth,
        "answer": Answer(**answer) if answer else None,
        "score": Score(**stored["score"]) if stored["score"] else None,
        "controls": {k: Control(*_tuples(v)) for k, v in stored["controls"].items()},
    })  # fmt: skip
