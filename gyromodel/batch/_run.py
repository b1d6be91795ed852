"""All campaigns of an archive, one after another or on a Dask cluster; killed at any moment, it goes on from there."""

from __future__ import annotations

import logging
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import pyarrow as pa

import gyromodel
from gyromodel._checks import CampaignError
from gyromodel.batch._archive import Entry, entries
from gyromodel.batch._results import Results
from gyromodel.batch._work import Row, examine, failed, read
from gyromodel.model import GyroModel

# Tasks that wait at each worker, so that none is idle, and times that a task may lose its worker.
WAITING, LOST = 4, 3
# Seconds in which a scheduler has to answer.
PATIENCE = 10
# Seconds over which the rate of work is averaged.
RECENT = 60.0

# What `examine` is given.
Task = tuple[Entry, str, GyroModel, str, bool]


class Batch(NamedTuple):
    """Results of an archive: the table, and how many campaigns there were, were examined in this run, and failed."""

    table: pa.Table
    campaigns: int
    examined: int
    failed: int


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
    are gone from the archive leave the table.

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
    with Results(results, made_by) as kept:
        finished = kept.finished()
        states = {entry: entry.state for entry in every}
        todo = [entry for entry in every if not states[entry] or finished.get(entry.campaign) != states[entry]]
        tasks = [(entry, states[entry], model, model_hash, diagnosing) for entry in todo]
        say = _Pace(progress, len(every), len(every) - len(todo))
        spread = _on_cluster(tasks, workers, scheduler) if workers > 1 or scheduler else _here(tasks)
        for rows in spread:
            kept.add(rows)
            say.one_more()
        table = kept.merge(every)
    lost = {
        name
        for name, status in zip(table["campaign"].to_pylist(), table["status"].to_pylist(), strict=True)
        if status == "failed"
    }
    return Batch(table, len(every), len(todo), len(lost))


def _here(tasks: Sequence[Task]) -> Iterator[list[Row]]:
    """Rows of each task; a thread reads the next campaigns meanwhile."""
    with ThreadPoolExecutor(1) as reader:
        ahead = deque(reader.submit(read, task[0]) for task in tasks[:WAITING])
        for i, task in enumerate(tasks):
            if i + WAITING < len(tasks):
                ahead.append(reader.submit(read, tasks[i + WAITING][0]))
            yield examine(*task, ahead.popleft().result())


def _on_cluster(tasks: Sequence[Task], workers: int, scheduler: str | None) -> Iterator[list[Row]]:
    """Rows of each task as it ends, whatever becomes of single workers."""
    from dask.config import set as configured
    from distributed import Client, LocalCluster, as_completed

    with configured({"distributed.scheduler.allowed-failures": LOST}), ExitStack() as open_ones:
        if scheduler is None:
            quiet = {"dashboard_address": "", "silence_logs": logging.CRITICAL}
            cluster = open_ones.enter_context(LocalCluster(n_workers=workers, threads_per_worker=1, **quiet))
        try:
            client = open_ones.enter_context(Client(scheduler or cluster, timeout=PATIENCE))
        except OSError:
            raise CampaignError(f"{scheduler}: no Dask scheduler answers there within {PATIENCE} s") from None
        waiting, of = iter(tasks), {}

        def submitted(count: int) -> list[Any]:
            new = {client.submit(examine, *task, pure=False): task for task in islice(waiting, count)}
            of.update({future.key: task for future, task in new.items()})
            return list(new)

        ahead = WAITING * max(workers, len(client.scheduler_info()["workers"]))
        running = as_completed(submitted(ahead))
        for future in running:
            entry, state, _, model_hash, _ = of.pop(future.key)
            if future.status == "finished":
                yield future.result()
            else:
                head = {"campaign": entry.campaign, "model_hash": model_hash, "file_state": state}
                yield [failed(head | {"version": gyromodel.__version__}, future.exception())]
            running.update(submitted(1))


class _Pace:
    """Tells how many are done, how fast it goes, and how long the rest will take."""

    def __init__(self, progress: Callable[[str, float], None] | None, total: int, done: int) -> None:
        self._progress, self._total, self._done = progress, total, done
        self._times = [time.monotonic()]

    def one_more(self) -> None:
        self._done += 1
        if self._progress is None:
            return
        now = time.monotonic()
        self._times = [t for t in self._times if now - t < RECENT] or self._times[-1:]
        rate = len(self._times) / max(now - self._times[0], 1e-3)
        self._times.append(now)
        left = (self._total - self._done) / rate
        clock = f"{int(left // 3600)}:{int(left // 60) % 60:02d}:{int(left) % 60:02d}"
        self._progress(f"{self._done}/{self._total}, {rate:.3g}/s, {clock} left", self._done / self._total)
