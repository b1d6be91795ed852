"""A calibration applied to a file larger than memory: read, compensated and written some rows after others.

What comes out is what `compensate` gives of the whole, for models that look at no other samples. The file is read
twice: a median step or a fault is known only when all of it was seen.
"""

from __future__ import annotations

import gzip
import hashlib
import json
import shutil
import zlib
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from gyromodel._checks import check_time, thermometers
from gyromodel._csv import csv_head, to_text, write_csv_rows, write_headers
from gyromodel.campaign import LARGEST, Campaign, part_of_campaign
from gyromodel.compensation import (
    PARTS,
    ErrorAgainstReference,
    apply_calibration,
    judged,
    reference_errors,
    told,
)
from gyromodel.estimate import Calibration
from gyromodel.files import reading_parts, replacing
from gyromodel.signals import Record, read_signals

# Rows in memory at a time; a length that is padded by none.
ROWS = 1 << 16
# Different steps of a clock that are counted; a clock of more is not regular.
STEPS = 1 << 18
SUFFIXES = (".csv", ".csv.gz", ".parquet")


class Streamed(NamedTuple):
    """A file that was written: its rows, its note, how it compares with a reference rate, and its digest."""

    rows: int
    note: str
    error: ErrorAgainstReference | None
    data_hash: str


class _Scan(NamedTuple):
    """What only the whole file tells: the first time and the usual step (s), and the campaigns that rows are of."""

    start: float
    interval: float
    campaigns: set[float]


def compensate_file(
    source: Path,
    target: Path,
    calibration: Calibration,
    axis: str | None = None,
    accept: Callable[[ErrorAgainstReference | None], None] | None = None,
) -> Streamed | None:
    """Compensate a CSV or Parquet file into another with a few rows in memory at a time.

    Args:
        source: the campaign.
        target: replaced when it is complete.
        calibration: see `compensate`.
        axis: of a three-axis campaign.
        accept: called before the target is replaced; what it raises leaves that as it was.

    Returns:
        None where only the whole campaign can be compensated: another kind of file, increments or angles, rates from an
        attitude, a clock without regular steps, a model that looks at other samples (lags, hysteresis, rates of
        temperature) or leaves open which columns it takes, or a campaign with a fault, which `compensate` names.
    """
    if not all(path.name.lower().endswith(SUFFIXES) for path in (source, target)):
        return None
    try:
        scan = _scanned(source, axis, calibration)
    except (ValueError, OSError, EOFError, zlib.error):
        return None  # what reads the whole names the fault
    if scan is None:
        return None
    counts, rows, head = Counter[str](), 0, None
    with ExitStack() as open_ones:
        temporary = open_ones.enter_context(replacing(target))
        errors, text = (open_ones.enter_context(TemporaryFile(dir=target.parent)) for _ in range(2))
        body = open_ones.enter_context(_Body(target, temporary, text))
        spilled: list[Any] = []
        for part in _parts(source, axis):
            done, more = apply_calibration(part, _read(part, scan), calibration)
            counts.update(more)
            rows += len(done)
            head = done
            spilled = spilled or [open_ones.enter_context(TemporaryFile(dir=target.parent)) for _ in done.columns]
            for file, values in zip(spilled, done.columns.values(), strict=True):
                file.write(np.where(np.isnan(values), np.nan, values).astype("<f8").tobytes())
            if (pair := reference_errors(done)) is not None:
                errors.write(pair.T.tobytes())
            body.write(done)
        assert head is not None
        head = head.with_metadata(told(calibration, head, counts, scan.campaigns))
        judgement = _judgement(errors)
        if accept:
            accept(judgement)
        body.finish(head)
        digest = _digest(head, rows, spilled)
    return Streamed(rows, str(head.metadata.get("rate_estimated_note", "")), judgement, digest)


def _parts(path: Path, axis: str | None) -> Iterator[Campaign]:
    """A campaign's rows, ROWS at a time."""
    with reading_parts(path) as opened:
        assert opened is not None
        units, metadata, parts = opened
        held: list[list[np.ndarray]] = []

        def part(columns: list[np.ndarray]) -> Campaign:
            whole = part_of_campaign(dict(zip(units, columns, strict=True)), units, metadata, path.name)
            return whole.renamed_axis(axis) if axis else whole

        count = 0
        for columns in parts:
            held.append(columns)
            count += len(columns[0])
            if count >= ROWS:
                joined = [np.concatenate(each) for each in zip(*held, strict=True)]
                for first in range(0, count - ROWS + 1, ROWS):
                    yield part([values[first : first + ROWS] for values in joined])
                first = count - count % ROWS
                held, count = [[values[first:].copy() for values in joined]], count % ROWS
        if count:
            yield part([np.concatenate(each) for each in zip(*held, strict=True)])


def _read(part: Campaign, scan: _Scan) -> Record:
    """The signals of some rows, as they are among those of the whole."""
    if len(part) == 1:  # a single one has no step
        again = {name: np.repeat(values, 2) for name, values in part.columns.items()}
        again["time"] = part.columns["time"] + np.array([0.0, 1.0])
        record = read_signals(part_of_campaign(again, part.units, part.metadata, part.name))
        record = record.without(np.array([1]))._replace(rows=1)
    else:
        record = read_signals(part)
    time = np.asarray(part.si("time"))
    padded = np.pad(time - scan.start, (0, len(record.signals["time"]) - len(time)), mode="edge")
    on = float(np.asarray(record.signals["time_on"])[0] - np.asarray(record.signals["time"])[0])
    signals = record.signals | {"time": jnp.asarray(padded), "time_on": jnp.asarray(padded + on)}
    return record._replace(signals=signals, interval=scan.interval)


def _scanned(path: Path, axis: str | None, calibration: Calibration) -> _Scan | None:
    """What the whole file tells, or None where it cannot be compensated in parts."""
    with reading_parts(path) as opened:
        if opened is None or any(effect.remembers for effect in calibration.model.effects):
            return None
    if (level := calibration.model.level) is not None and level.driver == "temperature_rate":
        return None  # that of a smooth curve through the whole record
    needed = {name for effect in calibration.model.effects for name in effect.columns_needed} - {"rate"}
    steps, scan, row = Counter[float](), None, 1
    last, end, lowest, highest, numbers = None, np.zeros(0), np.inf, -np.inf, set[float]()
    for part in _parts(path, axis):
        if part.outputs != ("output",) or part.metadata.get("kind") != "rate":
            return None
        check_time(part.columns["time"], row, last)
        row, last = row + len(part), float(part.columns["time"][-1])
        time, output = part.si("time"), part.columns["output"]
        known = np.isfinite(output)
        # From one row with an output to the next.
        seen = np.concatenate([end, time[known]])
        steps.update(np.diff(seen).tolist())
        end = seen[-1:]
        numbers |= {*np.unique(part.columns.get("campaign", np.ones(1))).tolist()}
        lowest = np.min(output[known], initial=lowest)
        highest = np.max(output[known], initial=highest)
        faulty = any((np.abs(values) > LARGEST).any() for values in part.columns.values())
        missing = not all(np.isfinite(part.columns[name][known]).all() for name in needed & {*part.columns})
        if faulty or missing or len(steps) > STEPS:
            return None
        if scan is None:
            scan = _begun(part, needed, calibration)
            if scan is None:
                return None
    return scan._replace(interval=_median(steps), campaigns=numbers) if scan and lowest < highest else None


def _begun(part: Campaign, needed: set[str], calibration: Calibration) -> _Scan | None:
    """The scan of a file that begins with these rows; None where a sample's rate depends on more than its own row."""
    attitude = any(name.startswith("attitude_") for name in part.columns) and "rate" not in part.columns
    if attitude or needed & {"rate_x", "rate_y", "rate_z"} - {*part.columns} or len(part) < 3:
        return None
    signals = read_signals(part).signals
    signals = signals | {"rate": jnp.zeros_like(signals["time"])}
    model = calibration.model
    if model.prepared(signals) is not model:
        return None  # which columns it takes, or which runs, only the whole tells
    # A rate of temperature is that of a smooth curve through the whole record.
    # So is the time since power-on of a run that began before these rows.
    lost = [f"{name}_rate" for name in thermometers(part.columns)] + ["time_on"] * ("run" in part.columns)
    unknown = jnp.full_like(signals["time"], jnp.nan)
    if np.isnan(np.asarray(model.predict(signals | dict.fromkeys(lost, unknown)))).any():
        return None
    return _Scan(float(part.si("time")[0]), np.nan, set())


def _median(steps: Counter[float]) -> float:
    """As of the list that was counted."""
    values = np.array(sorted(steps))
    reached = np.cumsum([steps[value] for value in values.tolist()])
    middle = [(reached[-1] - 1) // 2, reached[-1] // 2]
    return float(np.mean(values[np.searchsorted(reached, middle, side="right")]))


def _judgement(errors: Any) -> ErrorAgainstReference | None:
    """Of pairs of errors in a file, in as many parts as those of a campaign in memory."""
    count = errors.tell() // 16
    if count < 2 * PARTS:
        return None
    errors.seek(0)
    sums, counts = np.zeros((PARTS, 2)), np.full(PARTS, count // PARTS) + (np.arange(PARTS) < count % PARTS)
    for i, left in enumerate(counts):
        while left:
            pairs = np.frombuffer(errors.read(16 * min(left, ROWS))).reshape(-1, 2)
            sums[i] += np.sum(pairs**2, axis=0)
            left -= len(pairs)
    return judged(sums, counts)


class _Body:
    """Rows on their way to a file whose metadata come last."""

    def __init__(self, target: Path, temporary: Path, rows: Any) -> None:
        self._name, self._temporary, self._rows = target.name.lower(), temporary, rows
        self._writer: Any = None

    def __enter__(self) -> _Body:
        return self

    def __exit__(self, *_: object) -> None:
        if self._writer is not None:
            self._writer.close()

    def write(self, part: Campaign) -> None:
        if not self._name.endswith(".parquet"):
            write_csv_rows(part, self._rows)
            return
        import pyarrow as pa
        from pyarrow import parquet

        table = pa.table([pa.array(values) for values in part.columns.values()], names=write_headers(part))
        if self._writer is None:
            # A schema that is stored at the beginning would hide the metadata that come at the end.
            options: dict[str, Any] = {"compression": "zstd", "write_page_checksum": True, "store_schema": False}
            self._writer = parquet.ParquetWriter(self._temporary, table.schema, **options)
        self._writer.write_table(table)

    def finish(self, head: Campaign) -> None:
        """Write the metadata, and what follows on them."""
        if self._writer is not None:
            self._writer.add_key_value_metadata({key: to_text(value) for key, value in head.metadata.items()})
            self._writer.close()
            return
        self._rows.seek(0)
        with open(self._temporary, "xb") as file:
            if not self._name.endswith(".gz"):
                file.write(csv_head(head))
                shutil.copyfileobj(self._rows, file)
                return
            # As `write_campaign` does.
            with gzip.GzipFile("", "wb", 4, file, mtime=0) as stream:
                stream.write(csv_head(head))
                shutil.copyfileobj(self._rows, stream)


def _digest(head: Campaign, rows: int, columns: list[Any]) -> str:
    """`Campaign.digest` of columns in files."""
    units = [[name, head.units[name]] for name in head.columns]
    total = hashlib.sha256(json.dumps([rows, units, sorted(head.metadata.items())]).encode())
    for file in columns:
        file.seek(0)
        while data := file.read(1 << 20):
            total.update(data)
    return total.hexdigest()
