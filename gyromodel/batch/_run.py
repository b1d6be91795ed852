"""All campaigns of an archive, one after another or on a Dask cluster; killed at any moment, it goes on from there."""

from __future__ import annotations

import json
import logging
import signal
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from itertools import zip_longest
from multiprocessing import resource_tracker
from pathlib import Path
from typing import Any, NamedTuple

import pyarrow as pa

import gyromodel
from gyromodel._checks import CampaignError
from gyromodel.batch._archive import Entry, entries
from gyromodel.batch._references import References, open_references, with_references
from gyromodel.batch._results import Results, references_of
from gyromodel.batch._work import Lot, Row, examine, failed, read
from gyromodel.model import GyroModel

# Lots that wait at each thread of a worker, so that none is idle, and times that one may lose its worker.
WAITING, LOST = 4, 3
# Campaigns, and bytes of their files, that are read and fitted in one go.
MOST, LARGEST = 32, 16 << 20
# Seconds in which a scheduler has to answer.
PATIENCE = 10
# Seconds over which the rate of work is averaged.
RECENT = 60.0


class Batch(NamedTuple):
    """Results of an archive: the table, and how many campaigns there were, were examined in this run, and failed.

    `references` holds the reference points that the model left open and all campaigns share, by effect and setting: in
    internal units, and as a text.
    """

    table: pa.Table
    campaigns: int
    examined: int
    failed: int
    references: References


def run_batch(
    archive: str,
    model: GyroModel,
    model_hash: str,
    results: Path,
    *,
    diagnosing: bool = False,
    workers: int = 1,
    scheduler: str | None = None,
    progress: Callable[[str, float], None] | None = None,
) -> Batch:
    """Fit, or diagnose, every campaign of an archive and write one table.

    A campaign that cannot be read or fitted is a row with the reason. Campaigns that an earlier run has finished, and
    that have not changed since, are not examined again, unless the machine was at fault and not the data; those that
    are gone from the archive leave the table. A reference point that the model leaves open is that of the first
    campaign that has it in all, so that their parameters compare; so are those of effects that a diagnosis adds.

    Args:
        archive: see `entries`.
        model: what each campaign is fitted with.
        model_hash: of the model, for the table.
        results: the Parquet file to write.
        diagnosing: whether to diagnose each campaign rather than fit it.
        workers: processes of a local cluster, where above one.
        scheduler: address of a Dask scheduler whose workers share the archive's file system; a local one without.
        progress: called with a line and the share done.

    Raises:
        CampaignError: there is nothing to do, or the results cannot be written there.
    """
    every = entries(archive, but=results)
    task = "diagnose" if diagnosing else "fit"
    made_by = {
        "archive": str(Path(archive).resolve()),
        "model": model_hash,
        "version": gyromodel.__version__,
        "task": task,
    }
    # As before: the first campaign may be another one now.
    references = {key: (value, text) for key, (value, text) in references_of(results).items()}
    references = references or open_references(every, model, diagnosing)
    made_by["references"] = json.dumps(references)
    if references:
        model = with_references(model, references)
    with Results(results, made_by) as kept:
        finished = kept.finished()
        states = {entry: entry.state for entry in every}
        todo = [entry for entry in every if not states[entry] or finished.get(entry.campaign) != states[entry]]
        # What takes longer by itself than reading does is kept apart: finished work is on disk within a second.
        most = 1 if diagnosing or not model.noise else MOST
        lots = [
            Lot(tuple(some), tuple(states[entry] for entry in some), model, model_hash, diagnosing, references)
            for some in _parted(todo, states, most)
        ]
        say = _Pace(progress, len(every), len(every) - len(todo))
        spread = _on_cluster(lots, workers, scheduler) if workers > 1 or scheduler else _here(lots)
        for lot, rows in spread:
            kept.add(rows)
            say.more(len(lot.entries))
        table = kept.merge(every)
    lost = {
        name
        for name, status in zip(table["campaign"].to_pylist(), table["status"].to_pylist(), strict=True)
        if status == "failed"
    }
    return Batch(table, len(every), len(todo), len(lost), references)


def _parted(todo: Sequence[Entry], states: Mapping[Entry, str], most: int) -> Iterator[list[Entry]]:
    """Neighbours, so many at most, and of files that are not too large together."""
    some, size = list[Entry](), 0
    for entry in todo:
        own = int(states[entry].partition("-")[0] or 0)
        if some and (len(some) == most or size + own > LARGEST):
            yield some
            some, size = [], 0
        some.append(entry)
        size += own
    if some:
        yield some


def _here(lots: Sequence[Lot]) -> Iterator[tuple[Lot, list[Row]]]:
    """Rows of each lot; a thread reads the next one meanwhile."""
    with ThreadPoolExecutor(1) as reader:
        ahead = reader.submit(read, lots[0]) if lots else None
        for lot, following in zip_longest(lots, lots[1:]):
            axes = ahead.result() if ahead else None
            ahead = reader.submit(read, following) if following else None
            yield lot, examine(lot, axes)


def _on_cluster(lots: Sequence[Lot], workers: int, scheduler: str | None) -> Iterator[tuple[Lot, list[Row]]]:
    """Rows of each lot as it ends, whatever becomes of single workers."""
    from dask.config import set as configured
    from distributed import CancelledError, Client, LocalCluster, as_completed
    from distributed.client import ClosedClientError

    # Its warnings, and its tracebacks while it ends, are of no use to who waits for a table.
    for name in ("distributed", "distributed.client"):
        logging.getLogger(name).setLevel(logging.CRITICAL)
    with configured({"distributed.scheduler.allowed-failures": LOST}), ExitStack() as open_ones:
        if scheduler is None:
            quiet = {"dashboard_address": "127.0.0.1:0", "silence_logs": logging.CRITICAL}
            with _deaf_to_interrupts():
                cluster = open_ones.enter_context(LocalCluster(n_workers=workers, threads_per_worker=1, **quiet))
        try:
            client = open_ones.enter_context(Client(scheduler or cluster, timeout=PATIENCE))
        except OSError:
            raise CampaignError(f"{scheduler}: no Dask scheduler answers there within {PATIENCE} s") from None
        waiting, of = deque(lots), {}

        def submitted() -> list[Any]:
            # Workers may have come since.
            ahead = WAITING * max(workers, sum(client.nthreads().values()))  # pyright: ignore[reportAttributeAccessIssue]
            some = [waiting.popleft() for _ in range(min(ahead - len(of), len(waiting)))]
            new = {client.submit(examine, lot, pure=False): lot for lot in some}
            of.update({future.key: lot for future, lot in new.items()})
            return list(new)

        try:
            running = as_completed(submitted())
            for future in running:
                # Without its scheduler a client cancels what it waits for, and would wait for ever for anything new.
                if future.status == "cancelled" or client.status != "running":
                    raise CancelledError
                lot = of.pop(future.key)
                if future.status == "finished":
                    yield lot, future.result()
                elif len(lot.entries) > 1:
                    # One of them may be what no worker survives.
                    both = zip(lot.entries, lot.states, strict=True)
                    waiting += [lot._replace(entries=(entry,), states=(state,)) for entry, state in both]
                else:
                    yield lot, [failed(lot.heads()[0], future.exception())]
                running.update(submitted())
        except (CancelledError, ClosedClientError, OSError):
            lost = "the local cluster" if scheduler is None else f"{scheduler}: the Dask scheduler"
            raise CampaignError(f"{lost} was lost; the same command goes on from here") from None


@contextmanager
def _deaf_to_interrupts() -> Iterator[None]:
    """Threads and processes that begin here, and those that these begin, leave Ctrl-C to the main thread."""
    resource_tracker.ensure_running()  # what starts it lets the signal through again
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


class _Pace:
    """Tells how many are done, how fast it goes, and how long the rest will take."""

    def __init__(self, progress: Callable[[str, float], None] | None, total: int, done: int) -> None:
        self._progress, self._total, self._done = progress, total, done
        self._past = [(time.monotonic(), done)]

    def more(self, count: int) -> None:
        self._done += count
        if self._progress is None:
            return
        now = time.monotonic()
        self._past = [(t, done) for t, done in self._past if now - t < RECENT] or self._past[-1:]
        since, done = self._past[0]
        rate = (self._done - done) / max(now - since, 1e-3)
        self._past.append((now, self._done))
        left = (self._total - self._done) / rate
        clock = f"{int(left // 3600)}:{int(left // 60) % 60:02d}:{int(left) % 60:02d}"
        self._progress(f"{self._done}/{self._total}, {rate:.3g}/s, {clock} left", self._done / self._total)
