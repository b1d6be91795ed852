"""The one table of an archive's results, written in atomic parts so that nothing finished is ever lost or repeated."""

from __future__ import annotations

import errno
import fcntl
import json
import os
import shutil
import threading
import time
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import pyarrow as pa
from pyarrow import parquet

from gyromodel._atomic import sibling
from gyromodel._checks import CampaignError
from gyromodel.batch._archive import Entry

SCHEMA = pa.schema(
    [(name, pa.string()) for name in ("campaign", "axis", "parameter")]
    + [(name, pa.float64()) for name in ("value", "std", "low", "high")]
    + [(name, pa.string()) for name in ("unit", "status", "reason", "verdict", "causes", "evidence")]
    + [("gain_ratio", pa.float64()), ("samples", pa.int64()), ("iterations", pa.int64())]
    + [(name, pa.string()) for name in ("serial", "date", "data_hash", "model_hash", "version", "file_state")]
)
# Seconds of finished work that a kill may cost.
PART_EVERY = 1.0
# What a lock fails with where the file system knows none.
UNKNOWN_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP)
# Under this key the table says what made it.
MADE_BY = b"gyromodel"


class Results:
    """What is finished of an archive: an earlier table, and parts written since.

    Use as a context manager, which keeps other runs away from the same table.

    Args:
        path: of the table.
        made_by: what determines the results besides the data, such as hashes; a table made otherwise is refused. One
            made before there were any `references` is not.

    Raises:
        CampaignError: the table is something else, was made otherwise, or is being written by another run.
    """

    def __init__(self, path: Path, made_by: Mapping[str, str]) -> None:
        self.path, self.made_by = path, dict(made_by)
        self._folder = _parts_of(path)
        self._tables: list[pa.Table] = []
        self._waiting: list[dict[str, Any]] = []
        self._written = 0.0
        self._turn = threading.RLock()

    def __enter__(self) -> Self:
        # A table that cannot be continued is refused before anything is made beside it.
        if self.path.exists():
            self._read(self.path)
        self._folder.mkdir(parents=True, exist_ok=True)
        self._lock = open(self._folder / "lock", "w")
        try:
            self._begin()
        except BaseException:
            self._lock.close()
            raise
        return self

    def _begin(self) -> None:
        """Take the lock, and then read what there is: a run that ends meanwhile has written another table."""
        try:
            try:
                fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError as error:
                if error.errno not in UNKNOWN_LOCKS:
                    raise
            # The other run takes its lock away when it ends, and may do so between those two steps.
            same = os.path.samestat(os.fstat(self._lock.fileno()), os.stat(self._lock.name))
        except (BlockingIOError, FileNotFoundError):
            same = False
        if not same:
            raise CampaignError(f"{self.path}: another run is writing it")
        if self.path.exists():
            self._tables.append(self._read(self.path))
        for part in sorted(self._folder.glob("*.parquet")):
            try:
                self._tables.append(self._read(part))
            except CampaignError:
                if self._made_otherwise(part):
                    raise
                part.unlink()  # cut short with the machine
        self._next = 1 + max((int(part.stem) for part in self._folder.glob("*.parquet")), default=0)

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None):
        """Keep what is finished, whatever ended the run."""
        with self._turn:
            try:
                self.flush()
            finally:
                self._lock.close()

    def finished(self) -> dict[str, str]:
        """The state in which each campaign was examined, by its name; empty where that has to be done again."""
        states: dict[str, str] = {}
        for table in self._tables:
            own: dict[str, str] = {}
            for name, state in zip(table["campaign"].to_pylist(), table["file_state"].to_pylist(), strict=True):
                own[name] = state if own.get(name, state) else ""
            states |= own
        return states

    def add(self, rows: Iterable[dict[str, Any]]) -> None:
        """Take the rows of one campaign; they are on disk a moment later, whenever the next ones come."""
        with self._turn:
            first = not self._waiting
            self._waiting += rows
            if time.monotonic() - self._written > PART_EVERY:
                self.flush()
            elif first:
                timer = threading.Timer(PART_EVERY, self._flush_in_time)
                timer.daemon = True
                timer.start()

    def flush(self) -> None:
        """Write what waits as a part."""
        with self._turn:
            if self._waiting:
                table = self._table(self._waiting)
                write_table(table, self._folder / f"{self._next:08d}.parquet")
                self._tables.append(table)
                self._waiting, self._next = [], self._next + 1
            self._written = time.monotonic()

    def _flush_in_time(self) -> None:
        """As `flush`, in a thread that nobody asks what went wrong: the next flush meets it again, and tells."""
        with self._turn, suppress(OSError):
            if not self._lock.closed:
                self.flush()

    def merge(self, order: Sequence[Entry]) -> pa.Table:
        """Write the table: each campaign of the archive once, in its order, as it was examined last."""
        self.flush()
        place = {entry.campaign: i for i, entry in enumerate(order)}
        # The last table that has a campaign counts.
        source = {name: i for i, table in enumerate(self._tables) for name in table["campaign"].unique().to_pylist()}
        kept = []
        for i, table in enumerate(self._tables):
            names = table["campaign"].to_pylist()
            rows = [k for k, name in enumerate(names) if source[name] == i and name in place]
            places = pa.array([place[names[k]] for k in rows], pa.int64())
            kept.append(table.take(pa.array(rows, pa.int64())).append_column("_place", places))
        # The sort keeps equal ones as they are: parameters stay in the order of the model.
        whole = pa.concat_tables(kept)
        order_of = sorted(range(len(whole)), key=whole["_place"].to_pylist().__getitem__)
        whole = whole.take(order_of).drop_columns(["_place"]).replace_schema_metadata(self._metadata())
        write_table(whole, self.path)
        shutil.rmtree(self._folder)
        return whole

    def _table(self, rows: list[dict[str, Any]]) -> pa.Table:
        return pa.Table.from_pylist(rows, SCHEMA).replace_schema_metadata(self._metadata())

    def _metadata(self) -> dict[bytes, str]:
        return {MADE_BY: json.dumps(self.made_by)}

    def _read(self, path: Path) -> pa.Table:
        table = read_results(path)
        made_by = json.loads(table.schema.metadata[MADE_BY])
        if made_by.get("references", "{}") == "{}":
            made_by["references"] = self.made_by.get("references")
        if other := " and ".join(sorted(k for k in self.made_by if made_by.get(k) != self.made_by[k])):
            there = [str(self.path)] * (path == self.path) + [str(self._folder)] * self._folder.exists()
            raise CampaignError(
                f"{self.path}: there are results of another {other}: name another file, or remove {' and '.join(there)}"
            )
        return table

    def _made_otherwise(self, part: Path) -> bool:
        try:
            return MADE_BY in (parquet.read_schema(part).metadata or {})
        except (pa.ArrowException, OSError):
            return False


def _parts_of(path: Path) -> Path:
    return path.with_name(f".{path.name}.parts")


def references_of(path: Path) -> dict[str, Any]:
    """The references of a table, or of the parts of one that is not finished; empty where none has any yet."""
    for file in (path, *sorted(_parts_of(path).glob("*.parquet"))):
        with suppress(pa.ArrowException, OSError):
            made_by = json.loads((parquet.read_schema(file).metadata or {}).get(MADE_BY, b"{}"))
            if found := json.loads(made_by.get("references", "{}")):
                return found
    return {}


def read_results(path: Path) -> pa.Table:
    """A table of results.

    Raises:
        CampaignError: it is none.
    """
    try:
        with parquet.ParquetFile(path) as file:
            table = file.read()
    except (pa.ArrowException, OSError) as error:
        raise CampaignError(f"{path}: is no table of results, or cannot be read") from error
    if MADE_BY not in (table.schema.metadata or {}):
        raise CampaignError(f"{path}: is no table of results")
    try:
        return table.select(SCHEMA.names).cast(SCHEMA).replace_schema_metadata(table.schema.metadata)
    except (KeyError, ValueError, pa.ArrowException) as error:
        raise CampaignError(f"{path}: is no longer the table that was written: {error.args[0]}") from error


def write_table(table: pa.Table, path: Path) -> None:
    """Whole or not at all, and on disk; of a link, what it leads to."""
    if path.is_symlink():
        path = Path(os.path.realpath(path))
    with sibling(path) as temporary:
        with open(temporary, "wb") as file:
            parquet.write_table(table, file, compression="zstd")
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
