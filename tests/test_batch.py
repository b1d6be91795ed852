"""An archive into one table: each campaign as `fit` has it, once, whatever kills the run or its workers."""

from __future__ import annotations

import errno
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from hashlib import sha256
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import psutil
import pyarrow as pa
import pytest
from distributed import Client, LocalCluster
from pyarrow import parquet

from gyromodel import CampaignError, cli, compensate, export_calibration, files
from gyromodel.batch import Entry, entries, pooled_table, read_results, run_batch, unit_statistics, write_table
from gyromodel.batch import _references as references
from gyromodel.batch import _results as storage
from gyromodel.batch import _run as running
from gyromodel.batch import _work as work
from gyromodel.batch._references import open_references, referred
from gyromodel.batch._results import SCHEMA, Results
from gyromodel.campaign import Campaign
from gyromodel.effects.drivers import BiasStep
from gyromodel.estimate import fit
from gyromodel.files import read_campaign, write_campaign
from gyromodel.model import GyroModel
from gyromodel.model_files import read_model
from gyromodel.platform import fit_vibration
from gyromodel.signals import read_signals
from tests.test_begun_in_motion import log as in_motion

MODEL = "effects: [{effect: bias}, {effect: bias_temperature}]\n"
# Of two lengths, so that few shapes are compiled.
LENGTHS = (60, 64)
PLATFORM = Path(cli.__file__).parent / "data" / "platform_vibration.csv.gz"


def campaign(k: int, **metadata: str) -> Campaign:
    rng, rows = np.random.default_rng(k), LENGTHS[k % 2]
    time = 10.0 * np.arange(rows)
    temperature = 20 + 10 * np.sin(time / 90)
    output = 3 + 0.2 * (temperature - 20) + 0.05 * rng.standard_normal(rows)
    columns = {"time": time, "temperature": temperature, "output": output}
    units = {"time": "s", "temperature": "degC", "output": "deg/h"}
    return Campaign(columns, units, {"kind": "rate", "serial": f"U{k % 3}", **metadata})


def archive(folder: Path, count: int) -> Path:
    """Half of the campaigns in a folder below."""
    for k in range(count):
        place = folder / "archive" / ("below" if k % 2 else ".")
        place.mkdir(parents=True, exist_ok=True)
        write_campaign(campaign(k), place / f"c{k:03d}.csv")
    (folder / "model.yaml").write_text(MODEL)
    return folder / "archive"


def batch(folder: Path, *more: str, results: str = "results.parquet") -> tuple[int, dict[str, object]]:
    """Exit status and printed result of the command."""
    command = ["batch", str(folder / "archive"), "--model", str(folder / "model.yaml"), "-o", str(folder / results)]
    done = subprocess.run(
        [sys.executable, "-m", "gyromodel", *command, "--json", *more], capture_output=True, text=True, check=False
    )
    assert "Traceback" not in done.stderr, done.stderr
    return done.returncode, json.loads(done.stdout) if done.stdout else {"said": done.stderr}


def table(folder: Path, results: str = "results.parquet") -> list[dict[str, object]]:
    return parquet.read_table(folder / results).to_pylist()


def here(folder: Path, name: str = "results.parquet", where: Path | None = None):
    return run_batch(str(where or folder / "archive"), read_model(folder / "model.yaml"), "m", folder / name)


def test_every_row_is_what_fit_finds(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    place = archive(tmp_path, 3)
    (place / "bad.csv").write_text("time [s],output [deg/h]\n0,1\n")
    with pytest.raises(SystemExit) as done:
        cli.main(["batch", str(place), "--model", str(tmp_path / "model.yaml"), "-o", str(tmp_path / "r.parquet")])
    assert done.value.code == 1
    said = capsys.readouterr()
    assert "1 of 4 campaigns failed" in said.err
    assert "4 campaigns, 4 examined" in said.out
    rows = table(tmp_path, "r.parquet")
    assert [row["campaign"] for row in rows if row["status"] == "failed"] == ["bad.csv"]
    assert "at least 3" in rows[0]["reason"]
    assert list(dict.fromkeys(r["campaign"] for r in rows)) == ["bad.csv", "below/c001.csv", "c000.csv", "c002.csv"]
    estimate = fit(campaign(0), read_model(tmp_path / "model.yaml"))
    mine = {row["parameter"]: row for row in rows if row["campaign"] == "c000.csv"}
    for row in estimate.table():
        stored = mine[f"{row.effect}.{row.name}"]
        assert (stored["value"], stored["std"], stored["unit"]) == (row.value, row.std, row.unit)
        assert stored["data_hash"] == campaign(0).digest()
        assert stored["model_hash"] == sha256(MODEL.encode()).hexdigest()
        assert stored["serial"] == "U0"
    assert mine["noise_white"]["low"] < mine["noise_white"]["value"] < mine["noise_white"]["high"]


STATED = """effects: [{effect: bias}, {effect: bias_temperature}]
noise: [{effect: noise_white, value: 0.0028 deg/sqrt(h)}, {effect: noise_random_walk, value: 0.02 deg/h/sqrt(h)}]
"""


def test_stated_noise_is_fitted_together_as_each_by_itself(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Of two lengths, with three axes of which one is dead, samples missing, and one file that is none."""
    place = archive(tmp_path, 5)
    (tmp_path / "model.yaml").write_text(STATED)
    start, one, columns = read_model(tmp_path / "model.yaml"), campaign(7), dict(campaign(8).columns)
    three = one.without("output")
    for axis, values in zip("xyz", (one.columns["output"], 2 - one.columns["output"], np.zeros(len(one))), strict=True):
        three = three.with_column(f"output_{axis}", values, "deg/h")
    write_campaign(three, place / "three.csv")
    columns["output"] = np.where(np.arange(60) % 9 == 4, np.nan, columns["output"])
    gaps = Campaign(columns, campaign(8).units, campaign(8).metadata)
    write_campaign(gaps, place / "gaps.csv")
    # No temperature to tell the slope by: the sentence is that of the fit by itself.
    write_campaign(campaign(9).with_column("temperature", np.full(64, 20.0), "degC"), place / "still.csv")
    (place / "bad.csv").write_text("time [s],output [deg/h]\n0,1\n")
    by_themselves = []
    monkeypatch.setattr(work, "fit", lambda c, m: by_themselves.append(c.name) or fit(c, m))
    done = here(tmp_path)
    assert by_themselves == ["still"]
    reasons = {r["campaign"]: r["reason"] for r in done.table.to_pylist() if r["status"] == "failed"}
    assert "bias_temperature" in reasons.pop("still.csv")
    assert set(reasons) == {"bad.csv", "three.csv"}
    measured = {("c000.csv", None): campaign(0), ("below/c003.csv", None): campaign(3), ("gaps.csv", None): gaps}
    measured |= {("three.csv", axis): three.axis(axis) for axis in "xy"}
    for (name, axis), data in measured.items():
        estimate = fit(data, start)
        mine = {r["parameter"]: r for r in done.table.to_pylist() if (r["campaign"], r["axis"]) == (name, axis)}
        assert len(mine) == 4
        for row in estimate.table():
            stored = mine[f"{row.effect}.{row.name}"]
            assert abs(stored["value"] - row.value) < 1e-4 * row.std
            assert (stored["std"], stored["unit"]) == (pytest.approx(row.std, rel=1e-6), row.unit)
            assert stored["samples"] == estimate.record.present.sum()
        for noise, found in estimate.noise_table().items():
            stored = mine[noise]
            assert (stored["value"], stored["low"], stored["high"]) == (found["value"], found["lo"], found["hi"])


def test_a_campaign_that_cannot_be_fitted_leaves_those_fitted_with_it(tmp_path: Path):
    """Two lack the column that an effect needs; two others have other numbers of power cycles."""
    (tmp_path / "archive").mkdir()
    noise = STATED.split("\n")[1]
    (tmp_path / "model.yaml").write_text(f"effects: [{{effect: bias}}, {{effect: bias_temperature}}]\n{noise}\n")
    for k in range(4):
        one = campaign(k)
        write_campaign(one.without("temperature") if k in (0, 2) else one, tmp_path / "archive" / f"c{k}.csv")
    rows = here(tmp_path).table.to_pylist()
    assert {row["campaign"] for row in rows if row["status"] == "fitted"} == {"c1.csv", "c3.csv"}
    assert {row["campaign"]: "temperature" in (row["reason"] or "") for row in rows if row["status"] == "failed"} == {
        "c0.csv": True, "c2.csv": True,
    }  # fmt: skip
    (tmp_path / "model.yaml").write_text(f"effects: [{{effect: bias}}, {{effect: bias_turn_on}}]\n{noise}\n")
    for k in range(4):
        cycles = np.arange(LENGTHS[k % 2]) * (2 + (k > 1)) // LENGTHS[k % 2]
        write_campaign(campaign(k).with_column("run", cycles, ""), tmp_path / "archive" / f"c{k}.csv")
    rows = here(tmp_path, "other.parquet").table.to_pylist()
    assert {row["status"] for row in rows} == {"fitted"}
    offsets = Counter(row["campaign"] for row in rows if row["parameter"].startswith("bias_turn_on.offsets"))
    assert offsets == {"c0.csv": 1, "c1.csv": 1, "c2.csv": 2, "c3.csv": 2}


def test_what_begins_in_motion_is_fitted_together_as_each_by_itself(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """A lag still shows at first what was before the record: the same samples are left out."""
    (tmp_path / "archive").mkdir()
    effects = "{effect: bias}, {effect: scale_factor, value: 1}, {effect: bandwidth, time_constant: 0.5 s}"
    noise = "{effect: noise_white, value: 0.038 deg/sqrt(h)}"
    (tmp_path / "model.yaml").write_text(f"effects: [{effects}]\nnoise: [{noise}]\n")
    logs = {f"c{k}.csv": in_motion(np.random.default_rng(k), lag=1.0) for k in range(2)}
    for name, log in logs.items():
        write_campaign(log, tmp_path / "archive" / name)
    monkeypatch.setattr(work, "fit", None)
    rows = here(tmp_path).table.to_pylist()
    for name, log in logs.items():
        expected = fit(log, read_model(tmp_path / "model.yaml"))
        found = {r["parameter"]: r for r in rows if r["campaign"] == name}["bandwidth.time_constant"]
        assert found["samples"] == expected.record.present.sum() < len(log)
        assert found["value"] == pytest.approx(expected.table()[-1].value, abs=1e-3 * expected.table()[-1].std)


def test_what_a_diagnosis_holds_has_no_row(tmp_path: Path):
    (tmp_path / "archive").mkdir()
    (tmp_path / "model.yaml").write_text(MODEL)
    one = campaign(0)
    still = one.with_column("temperature", np.full(len(one), 20.0), "degC")
    noise = np.random.default_rng(1).standard_normal(len(one))
    write_campaign(still.with_column("output", noise, "deg/h"), tmp_path / "archive" / "still.csv")
    model = read_model(tmp_path / "model.yaml")
    rows = run_batch(str(tmp_path / "archive"), model, "m", tmp_path / "r.parquet", diagnosing=True).table.to_pylist()
    assert {(r["status"], r["verdict"]) for r in rows} == {("diagnosed", "adequate")}
    assert not [r for r in rows if (r["parameter"] or "").startswith("bias_temperature")]


def test_lots_are_of_a_size_in_memory():
    """Neighbours, the large ones by themselves, none lost."""
    many = [Entry(f"{k:03d}", f"/{k}") for k in range(100)]
    states = {e: f"{(40 << 20) if k == 50 else 1000}-1" for k, e in enumerate(many)} | {many[99]: ""}
    lots = list(running._parted(many, states, 32))
    assert [e for lot in lots for e in lot] == many
    assert [many[50]] in lots
    assert max(map(len, lots)) == 32
    assert len(lots) <= 5
    assert list(running._parted(many[:3], states, 1)) == [[e] for e in many[:3]]


@pytest.mark.long
def test_a_killed_run_goes_on_where_it_was(tmp_path: Path):
    archive(tmp_path, 40)
    whole = here(tmp_path, "whole.parquet").table
    command = [sys.executable, "-m", "gyromodel", "batch", str(tmp_path / "archive")]
    options = ["--model", str(tmp_path / "model.yaml"), "-o", str(tmp_path / "results.parquet")]
    process = subprocess.Popen([*command, *options])
    parts = tmp_path / ".results.parquet.parts"
    while process.poll() is None and not list(parts.glob("*.parquet")):
        time.sleep(0.02)
    process.send_signal(signal.SIGKILL)
    assert process.wait() == -signal.SIGKILL
    assert not (tmp_path / "results.parquet").exists()
    finished = {row["campaign"] for part in parts.glob("*.parquet") for row in parquet.read_table(part).to_pylist()}
    assert finished
    (parts / "99999999.parquet").write_bytes(b"PAR1 cut short with the machine")

    status, result = batch(tmp_path)
    assert status == 0
    assert result["examined"] == 40 - len(finished)
    again = parquet.read_table(tmp_path / "results.parquet")
    model_hash = again.column_names.index("model_hash")
    assert again.remove_column(model_hash).equals(whole.remove_column(model_hash))
    assert not parts.exists()


def test_what_has_changed_is_examined_again(tmp_path: Path):
    place = archive(tmp_path, 4)
    assert here(tmp_path).examined == 4
    assert here(tmp_path).examined == 0
    write_campaign(campaign(7), place / "c000.csv")
    (place / "c002.csv").unlink()
    write_campaign(campaign(4), place / "new.csv")
    done = here(tmp_path)
    assert (done.campaigns, done.examined, done.failed) == (4, 2, 0)
    hashes = {row["campaign"]: row["data_hash"] for row in done.table.to_pylist()}
    assert hashes == {
        "below/c001.csv": campaign(1).digest(),
        "below/c003.csv": campaign(3).digest(),
        "c000.csv": campaign(7).digest(),
        "new.csv": campaign(4).digest(),
    }


def test_results_made_otherwise_are_kept(tmp_path: Path):
    archive(tmp_path, 1)
    here(tmp_path)
    before = (tmp_path / "results.parquet").read_bytes()
    start = read_model(tmp_path / "model.yaml")
    with pytest.raises(CampaignError, match="of another model: name another file"):
        run_batch(str(tmp_path / "archive"), start, "other", tmp_path / "results.parquet")
    parts = tmp_path / ".results.parquet.parts"
    parts.mkdir()
    (parts / "00000001.parquet").write_bytes(before)
    for there in (f"remove {tmp_path}/results.parquet and {parts}$", f"remove {parts}$"):
        with pytest.raises(CampaignError, match=there):
            run_batch(str(tmp_path / "archive"), start, "other", tmp_path / "results.parquet")
        (tmp_path / "results.parquet").unlink(missing_ok=True)
    shutil.rmtree(parts)
    (tmp_path / "results.parquet").write_bytes(before)
    with pytest.raises(CampaignError, match="of another task"):
        run_batch(str(tmp_path / "archive"), start, "m", tmp_path / "results.parquet", diagnosing=True)
    other = tmp_path / "archive" / "below"
    other.mkdir(exist_ok=True)
    write_campaign(campaign(9), other / "c.csv")
    with pytest.raises(CampaignError, match="of another archive"):
        here(tmp_path, where=other)
    assert (tmp_path / "results.parquet").read_bytes() == before
    foreign = tmp_path / "foreign.parquet"
    parquet.write_table(pa.table({"a": [1]}), foreign)
    with pytest.raises(CampaignError, match="is no table of results"):
        here(tmp_path, "foreign.parquet")
    assert parquet.read_table(foreign).to_pylist() == [{"a": 1}]


def test_two_runs_do_not_write_one_table(tmp_path: Path):
    archive(tmp_path, 1)
    made_by = {"archive": "a", "model": "m"}
    with storage.Results(tmp_path / "results.parquet", made_by), pytest.raises(CampaignError, match="another run"):
        storage.Results(tmp_path / "results.parquet", made_by).__enter__()


def test_a_file_system_without_locks_is_no_other_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """A fault of the disk is told as one."""

    def flock(number: int) -> None:
        def fails(*_: object) -> None:
            raise OSError(number, os.strerror(number))

        monkeypatch.setattr(storage.fcntl, "flock", fails)

    for number in (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP):
        flock(number)
        with storage.Results(tmp_path / "results.parquet", {}) as kept:
            kept.add([{"campaign": "c"}])
    flock(errno.EIO)
    with pytest.raises(OSError, match="Input/output"):
        storage.Results(tmp_path / "results.parquet", {}).__enter__()


def test_a_result_is_on_disk_within_a_second_whenever_the_next_ends(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Of two that end at once; a disk that is full meanwhile is told when the next is written."""
    monkeypatch.setattr(storage, "PART_EVERY", 0.5)
    parts = tmp_path / ".results.parquet.parts"

    def on_disk() -> int:
        return sum(len(parquet.read_table(part)) for part in parts.glob("*.parquet"))

    with storage.Results(tmp_path / "results.parquet", {}) as kept:
        for name in "ab":
            kept.add([{"campaign": name}])
        until = time.monotonic() + 10
        while on_disk() < 2 and time.monotonic() < until:
            time.sleep(0.02)
        assert on_disk() == 2
        with monkeypatch.context() as patched:
            patched.setattr(storage, "write_table", full_disk)
            with pytest.raises(OSError, match="No space"):  # noqa: PT012
                for name in "cd":
                    kept.add([{"campaign": name}])
                    time.sleep(0.7)
    assert on_disk() > 2


def full_disk(*_: object) -> None:
    raise OSError(28, "No space left on device")


def test_a_table_that_a_link_leads_to_is_written_there(tmp_path: Path):
    archive(tmp_path, 1)
    (tmp_path / "disk").mkdir()
    (tmp_path / "results.parquet").symlink_to("disk/results.parquet")
    here(tmp_path)
    assert (tmp_path / "results.parquet").is_symlink()
    assert here(tmp_path).examined == 0
    assert (tmp_path / "disk" / "results.parquet").is_file()


def test_a_full_disk_leaves_what_is_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    archive(tmp_path, 3)
    done = here(tmp_path)
    write_campaign(campaign(8), tmp_path / "archive" / "new.csv")

    with monkeypatch.context() as patched:
        patched.setattr(storage.os, "fsync", full_disk)
        with pytest.raises(OSError, match="No space"):
            here(tmp_path)
    assert parquet.read_table(tmp_path / "results.parquet").equals(done.table)
    assert not list(tmp_path.rglob("*.tmp"))
    assert here(tmp_path).campaigns == 4


LOST = """
import gc, signal, threading
from gyromodel import __main__, _archive_files
def interrupt(*_):
    # The others are deaf, and one that raised it would keep it.
    if threading.current_thread() is threading.main_thread():
        gc.callbacks.remove(interrupt)
        signal.raise_signal(signal.SIGINT)
def run(*arguments, whole=_archive_files.run_batch, **options):
    gc.callbacks.append(interrupt)
    return whole(*arguments, **options)
_archive_files.run_batch = run
__main__.main()
"""


def test_ctrl_c_within_the_garbage_collector_counts(tmp_path: Path):
    """Python drops what is raised in its callbacks, and JAX has one."""
    archive(tmp_path, 2)
    options = ["batch", str(tmp_path / "archive"), "--model", str(tmp_path / "model.yaml"), "-o", "results.parquet"]
    done = subprocess.run(
        [sys.executable, "-c", LOST, *options], capture_output=True, text=True, check=False, cwd=tmp_path
    )
    assert done.returncode == 130, done.stderr
    assert re.fullmatch("gyromodel: interrupted; .*\n", done.stderr)


@pytest.mark.long
@pytest.mark.parametrize("workers", ["1", "2"])
def test_ctrl_c_ends_in_one_sentence(tmp_path: Path, workers: str):
    """In a terminal it goes to the workers, too."""
    archive(tmp_path, 24)
    command = [sys.executable, "-m", "gyromodel", "batch", str(tmp_path / "archive"), "--workers", workers]
    options = ["--model", str(tmp_path / "model.yaml"), "-o", str(tmp_path / "results.parquet")]
    process = subprocess.Popen([*command, *options], stderr=subprocess.PIPE, text=True, start_new_session=True)
    parts = tmp_path / ".results.parquet.parts"
    while process.poll() is None and not list(parts.glob("*.parquet")):
        time.sleep(0.02)
    os.killpg(process.pid, signal.SIGINT)
    said = process.communicate(timeout=60)[1]
    assert process.returncode == 130, said
    assert re.fullmatch("gyromodel: interrupted; .*\n", said)
    status, result = batch(tmp_path)
    assert (status, result["campaigns"]) == (0, 24)
    assert 0 < int(str(result["examined"])) < 24


@pytest.mark.long
def test_a_worker_that_dies_loses_nothing(tmp_path: Path):
    """Of a local cluster of two processes, one is killed when the first results are there."""
    archive(tmp_path, 24)
    command = [sys.executable, "-m", "gyromodel", "batch", str(tmp_path / "archive"), "--workers", "2", "--json"]
    options = ["--model", str(tmp_path / "model.yaml"), "-o", str(tmp_path / "results.parquet")]
    process = subprocess.Popen([*command, *options], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    parts = tmp_path / ".results.parquet.parts"
    while process.poll() is None and not list(parts.glob("*.parquet")):
        time.sleep(0.02)
    workers = [p for p in psutil.Process(process.pid).children(recursive=True) if "spawn_main" in " ".join(p.cmdline())]
    assert len(workers) == 2
    workers[0].kill()
    out, said = process.communicate(timeout=120)
    assert process.returncode == 0, said
    assert json.loads(out)["campaigns"] == 24
    rows = table(tmp_path)
    assert {row["status"] for row in rows} == {"fitted"}
    assert len({(row["campaign"], row["parameter"]) for row in rows}) == len(rows) == 24 * 5


@pytest.mark.long
def test_a_scheduler_that_dies_loses_nothing(tmp_path: Path):
    """One sentence, no row of what it had not finished, and the next run ends with the rows of one left alone."""
    archive(tmp_path, 40)
    assert batch(tmp_path, results="whole.parquet")[0] == 0
    dask = [sys.executable, "-m", "distributed.cli"]
    where, quiet = tmp_path / "scheduler.json", {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    options = ["--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--scheduler-file", str(where)]
    scheduler = subprocess.Popen([*dask[:2], f"{dask[2]}.dask_scheduler", *options], **quiet)
    while not where.exists():
        time.sleep(0.02)
    address = json.loads(where.read_text())["address"]
    options = ["--nthreads", "1", "--no-nanny", "--no-dashboard"]
    worker = subprocess.Popen([*dask[:2], f"{dask[2]}.dask_worker", address, *options], **quiet, cwd=tmp_path)
    command = [sys.executable, "-m", "gyromodel", "batch", str(tmp_path / "archive"), "--scheduler", address]
    options = ["--model", str(tmp_path / "model.yaml"), "-o", str(tmp_path / "results.parquet")]
    process = subprocess.Popen([*command, *options], stderr=subprocess.PIPE, text=True)
    parts = tmp_path / ".results.parquet.parts"
    try:
        while process.poll() is None and not list(parts.glob("*.parquet")):
            time.sleep(0.02)
        scheduler.kill()
        said = process.communicate(timeout=60)[1]
    finally:
        for each in (process, worker, scheduler):
            each.kill()
            each.wait()
    assert process.returncode == 1
    assert said == f"gyromodel: {address}: the Dask scheduler was lost; the same command goes on from here\n"
    rows = [row for part in parts.glob("*.parquet") for row in parquet.read_table(part).to_pylist()]
    finished = {row["campaign"] for row in rows}
    assert {row["status"] for row in rows} == {"fitted"}
    status, result = batch(tmp_path)
    assert (status, result["examined"]) == (0, 40 - len(finished))
    assert parquet.read_table(tmp_path / "results.parquet").equals(parquet.read_table(tmp_path / "whole.parquet"))


def test_parts_without_a_row_that_counts_merge(tmp_path: Path):
    """What failed for the machine alone is in a part of its own, and done again later."""
    head = dict.fromkeys(("campaign", "status", "file_state"), "m")
    with storage.Results(tmp_path / "results.parquet", {"model": "m"}) as kept:
        for status in ("failed", "fitted"):
            kept.add([head | {"status": status}])
            kept.flush()
        assert kept.merge([Entry("m", "/m")])["status"].to_pylist() == ["fitted"]


def test_archives_of_every_kind(tmp_path: Path):
    folder = tmp_path / "a"
    (folder / "x" / ".hidden").mkdir(parents=True)
    for name in ("one.csv", "x/two.csv.gz", "x/three.parquet", "x/.hidden/no.csv"):
        write_campaign(campaign(0), folder / name)
    (folder / "notes.txt").write_text("not a campaign")
    write_campaign(campaign(1), folder / "group.zarr" / "unit1.zarr")
    write_campaign(campaign(2), folder / "group.zarr" / "deep" / "unit2.zarr")
    for group in (folder / "group.zarr", folder / "group.zarr" / "deep"):
        (group / "zarr.json").write_text('{"zarr_format": 3, "node_type": "group", "attributes": {}}')
    inside = ["group.zarr/deep/unit2.zarr", "group.zarr/unit1.zarr", "one.csv", "x/three.parquet", "x/two.csv.gz"]
    assert [e.campaign for e in entries(str(folder))] == inside
    assert [e.campaign for e in entries(str(folder / "group.zarr"))] == ["deep/unit2.zarr", "unit1.zarr"]
    found = entries(f"{folder}/**/*.csv*")
    assert [Path(e.path).name for e in found] == ["one.csv", "two.csv.gz"]
    (folder / "notes.txt").unlink()
    for pattern in ("**", "**/*"):
        assert [e.campaign for e in entries(f"{folder}/{pattern}")] == [f"{folder}/{name}" for name in inside]
    manifest = folder / "list.parquet"
    parquet.write_table(pa.table({"campaign": ["x/two.csv.gz", "one.csv"]}), manifest)
    assert entries(str(manifest)) == [
        Entry("x/two.csv.gz", str(folder / "x" / "two.csv.gz")), Entry("one.csv", str(folder / "one.csv"))
    ]  # fmt: skip
    assert [e.campaign for e in entries(str(folder / "one.csv"))] == ["one.csv"]
    with pytest.raises(CampaignError, match="no such folder"):
        entries(str(tmp_path / "nothing"))
    (tmp_path / "empty").mkdir()
    with pytest.raises(CampaignError, match="no campaign in it"):
        entries(str(tmp_path / "empty"))


def test_arrays_of_a_zarr_campaign_are_no_campaigns(tmp_path: Path):
    """However its descriptions are laid out, and where one is damaged."""
    folder = tmp_path / "archive"
    for name in ("compact.zarr", "damaged.zarr"):
        write_campaign(campaign(0), folder / name)
    for path in (folder / "compact.zarr").rglob("zarr.json"):
        path.write_text(json.dumps(json.loads(path.read_text()), separators=(",", ":")))
    (folder / "damaged.zarr" / "output" / "zarr.json").write_text('{"node_type"')
    (tmp_path / "model.yaml").write_text(MODEL)
    for where in (None, tmp_path / "archive" / "*", tmp_path / "archive" / "**"):
        found = entries(str(where or folder))
        assert [Path(entry.path).name for entry in found] == ["compact.zarr", "damaged.zarr"]
    done = here(tmp_path)
    assert (done.campaigns, done.failed) == (2, 1)
    assert "damaged" in str(done.table["reason"].to_pylist()[-1])


def test_what_commands_have_written_is_no_campaign(tmp_path: Path):
    """Tables, an exported calibration and compensated copies, in the archive's folder; a damaged file is told of."""
    place = archive(tmp_path, 3)
    for name in ("archive/results.parquet", "archive/other.parquet"):
        assert (here(tmp_path, name).examined, here(tmp_path, name).examined) == (3, 0)
    found = read_results(place / "other.parquet")
    write_table(pooled_table(found, unit_statistics(found)), place / "pooled.parquet")
    parquet.write_table(pa.table({"campaign": ["c000.csv"]}), place / "list.parquet")
    calibration = fit(campaign(0), read_model(tmp_path / "model.yaml")).calibration()
    (place / "calibration.csv").write_text(export_calibration(calibration, "csv"))
    for suffix in files.SUFFIXES:
        write_campaign(compensate(campaign(0), calibration), place / f"copy{suffix}")
    write_campaign(campaign(1).with_metadata({"navigated": "yes"}), place / "way.csv")
    write_campaign(campaign(0), tmp_path / "group.zarr" / "one.zarr")
    write_campaign(compensate(campaign(0), calibration), tmp_path / "group.zarr" / "two.zarr")
    (tmp_path / "group.zarr" / ".zgroup").write_text('{"zarr_format": 2}')
    assert [entry.campaign for entry in entries(str(tmp_path / "group.zarr"))] == ["one.zarr"]
    for pattern, count in ((None, 3), (place / "*.*", 2)):
        (place / "results.parquet").unlink(missing_ok=True)
        done = here(tmp_path, "archive/results.parquet", where=pattern)
        assert (done.campaigns, done.failed) == (count, 0)
    (place / "cut.parquet").write_bytes(b"PAR1")
    (place / "cut.csv.gz").write_bytes(b"")
    assert here(tmp_path, "archive/other.parquet").failed == 2


@pytest.mark.skipif(sys.platform == "darwin", reason="every name is UTF-8 there")
def test_names_of_another_coding_are_told_in_utf_8(tmp_path: Path):
    """Two that differ in such a letter alone, and one that is no campaign."""
    (tmp_path / "archive").mkdir()
    (tmp_path / "model.yaml").write_text(STATED)
    for k, letter in enumerate((b"\xe9", b"\xe8", b"\xea")):
        write_campaign(campaign(2 * k), tmp_path / "archive" / os.fsdecode(b"gyro_" + letter + b".csv"))
    (tmp_path / "archive" / os.fsdecode(b"gyro_\xea.csv")).write_text("time [s],output [deg/h]\n0,1\n")
    rows = here(tmp_path).table.to_pylist()
    assert Counter(row["campaign"] for row in rows) == {r"gyro_\xe9.csv": 4, r"gyro_\xe8.csv": 4, r"gyro_\xea.csv": 1}
    assert r"gyro_\xea.csv: " in rows[-1]["reason"]
    assert read_campaign(tmp_path / "archive" / os.fsdecode(b"gyro_\xe9.csv")).name == r"gyro_\xe9"


def test_links_neither_double_nor_lose_a_campaign(tmp_path: Path):
    place = archive(tmp_path, 2)
    (tmp_path / "disk").mkdir()
    write_campaign(campaign(2), tmp_path / "disk" / "d.csv")
    for name, target in (
        ("latest.csv", "c000.csv"), ("a", "below"), ("loop", "."), ("disk", "../disk"), ("gone.csv", "no")
    ):  # fmt: skip
        (place / name).symlink_to(target)
    inside = ["below/c001.csv", "c000.csv", "disk/d.csv", "gone.csv"]
    assert [e.campaign for e in entries(str(place))] == inside
    assert [e.campaign for e in entries(f"{place}/**/*.csv")] == [f"{place}/{name}" for name in inside]
    (place / "up").symlink_to("..")
    (tmp_path / "disk" / "back").symlink_to("../archive")
    assert [e.campaign for e in entries(str(place))] == inside
    # Followed one by one, loops in loops would never end.
    for pattern in (f"{place}/**/*.csv", f"{place}/**"):
        assert [e.campaign for e in entries(pattern)] == [f"{place}/{name}" for name in inside]
    # The same archive by another path.
    assert here(tmp_path).examined == 4
    (tmp_path / "link").symlink_to("archive")
    for same in (tmp_path / "link", tmp_path / "disk" / ".." / "archive"):
        done = here(tmp_path, where=same)
        assert (done.campaigns, done.examined, done.failed) == (4, 1, 1)


def test_manifests_of_every_writer(tmp_path: Path):
    """Texts as pandas, polars and categories hold them; a path twice, however spelled, and none are refused."""
    place = archive(tmp_path, 1)
    names = pa.array(["archive/c000.csv"])
    for kind in (pa.string(), pa.large_string(), pa.string_view(), pa.dictionary(pa.int32(), pa.string())):
        column = names.dictionary_encode() if isinstance(kind, pa.DictionaryType) else names.cast(kind)
        parquet.write_table(pa.table({"campaign": column}), tmp_path / "list.parquet")
        assert entries(str(tmp_path / "list.parquet")) == [Entry("archive/c000.csv", str(place / "c000.csv"))]
    for other, expected in ((str(place / "c000.csv"), "twice"), ("./archive/c000.csv", "twice"), (None, "row 2 names")):
        parquet.write_table(pa.table({"campaign": ["archive/c000.csv", other]}), tmp_path / "list.parquet")
        with pytest.raises(CampaignError, match=expected):
            entries(str(tmp_path / "list.parquet"))


def test_what_could_not_be_read_is_tried_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """A disk that fails is no fault of the campaign, which has not changed when it works again; a bad file is."""
    place = archive(tmp_path, 2)
    (place / "bad.csv").write_text("time [s],output [deg/h]\n0,1\n")
    whole = files._READERS[".csv"]

    def fails(path: Path):
        if path.name == "c000.csv":
            raise PermissionError(13, "Permission denied")
        return whole(path)

    with monkeypatch.context() as patched:
        patched.setitem(files._READERS, ".csv", fails)
        assert (here(tmp_path).failed, here(tmp_path).failed) == (2, 2)
    done = here(tmp_path)
    assert (done.examined, done.failed) == (1, 1)


def test_one_axis_that_the_machine_has_failed_is_tried_again(tmp_path: Path):
    row = dict.fromkeys(SCHEMA.names) | {"campaign": "c.csv"}
    with Results(tmp_path / "results.parquet", {}) as kept:
        kept.add([row | {"axis": "x", "file_state": ""}, row | {"axis": "y", "file_state": "10-20"}])
        kept.flush()
        assert kept.finished() == {"c.csv": ""}
        kept.add([row | {"axis": axis, "file_state": "10-20"} for axis in "xy"])
        kept.flush()
        assert kept.finished() == {"c.csv": "10-20"}


def test_an_archive_without_a_readable_campaign_goes_on_when_there_is_one(tmp_path: Path):
    """The first temperature is then the reference; before, no campaign had any."""
    place = tmp_path / "archive"
    place.mkdir()
    (tmp_path / "model.yaml").write_text(STATED)
    (place / "c0.csv").write_text("time [s],temperature [degC],output [deg/h]\n0,20,1\n")
    first = here(tmp_path)
    assert (first.failed, first.references) == (1, {})
    write_campaign(campaign(0), place / "c0.csv")
    done = here(tmp_path)
    assert (done.failed, set(done.references)) == (0, {"bias_temperature.reference"})
    warmer = np.array(campaign(1).columns["temperature"]) + 40.0
    write_campaign(campaign(1).with_column("temperature", warmer, "degC"), place / "a0.csv")
    more = here(tmp_path)
    assert (more.examined, more.references) == (1, done.references)


def test_a_run_that_ends_meanwhile_is_no_lock(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """It removes its lock between the opening and the locking of another: two would then write."""
    table, whole = tmp_path / "results.parquet", storage.fcntl.flock
    made_by = {"archive": "a", "model": "m"}

    def late(*arguments: object):
        shutil.rmtree(tmp_path / ".results.parquet.parts")
        whole(*arguments)

    with monkeypatch.context() as patched:
        patched.setattr(storage.fcntl, "flock", late)
        with pytest.raises(CampaignError, match="another run"):
            storage.Results(table, made_by).__enter__()
    with storage.Results(table, made_by):
        pass


@pytest.mark.long
def test_axes_and_diagnoses(tmp_path: Path):
    """Each axis has its rows, and a dead one its reason; with a diagnosis come verdict and gain."""
    (tmp_path / "archive").mkdir()
    one = campaign(0)
    columns = {f"output_{a}": one.columns["output"] + i for i, a in enumerate("xy")} | {"output_z": np.zeros(len(one))}
    several = one.without("output")
    for name, values in columns.items():
        several = several.with_column(name, values, "deg/h")
    write_campaign(several, tmp_path / "archive" / "three.csv")
    (tmp_path / "model.yaml").write_text("effects: [{effect: bias}]\n")
    start = read_model(tmp_path / "model.yaml")
    done = run_batch(str(tmp_path / "archive"), start, "m", tmp_path / "r.parquet", diagnosing=True)
    rows = done.table.to_pylist()
    assert done.failed == 1
    assert {r["axis"]: r["status"] for r in rows} == {"x": "diagnosed", "y": "diagnosed", "z": "failed"}
    told = {(r["verdict"], r["causes"]) for r in rows if r["axis"] != "z"}
    assert told == {("named", "bias_temperature")}
    assert all(r["gain_ratio"] > 2 for r in rows if r["axis"] != "z")
    assert any(r["parameter"] == "bias_temperature.coefficient" for r in rows)


AT_ONCE = [0]


def slow(_: object) -> list[int]:
    """How many are examined at once, as if these were rows."""
    AT_ONCE[0] += 1
    time.sleep(0.2)
    found = AT_ONCE[0]
    AT_ONCE[0] -= 1
    return [found]


def test_workers_that_join_have_work(monkeypatch: pytest.MonkeyPatch):
    """One of two threads, and another that comes when a lot has ended: as many lots are examined at once."""
    monkeypatch.setattr(running, "WAITING", 1)
    monkeypatch.setattr(running, "examine", slow)
    lots = [running.Lot((), (), GyroModel(()), "m", False, {}) for _ in range(20)]
    options = {"n_workers": 1, "threads_per_worker": 2, "processes": False, "dashboard_address": "127.0.0.1:0"}
    with LocalCluster(**options) as cluster, Client(cluster) as client:
        found = running._on_cluster(lots, 1, cluster.scheduler_address)
        next(found)
        cluster.scale(2)
        client.wait_for_workers(2)
        at_once = [rows[0] for _, rows in found]
    assert len(at_once) == 19
    assert max(at_once) > 2


@pytest.mark.long
def test_a_scheduler_that_is_not_there_is_said(tmp_path: Path):
    archive(tmp_path, 1)
    status, result = batch(tmp_path, "--scheduler", "tcp://127.0.0.1:9")
    assert status == 1
    assert "no Dask scheduler answers" in str(result["said"])
    assert os.listdir(tmp_path / ".results.parquet.parts") == ["lock"]


def test_biases_of_an_archive_are_of_one_temperature(tmp_path: Path):
    """Of like gyros measured at other temperatures, and whatever is measured later."""
    place = tmp_path / "archive"
    place.mkdir()
    (tmp_path / "model.yaml").write_text(STATED)

    def measured(k: int, name: str):
        warmer = np.array(campaign(k).columns["temperature"]) + 10 * k
        output = campaign(k).columns["output"] + 0.2 * 10 * k
        changed = campaign(k).with_column("temperature", warmer, "degC").with_column("output", output, "deg/h")
        write_campaign(changed, place / name)

    for k in range(4):
        measured(k, f"c{k}.csv")
    first = here(tmp_path)
    assert {row["reason"] for row in first.table.to_pylist()} == {None}
    assert set(first.references) == {"bias_temperature.reference"}
    measured(5, "a5.csv")
    done = here(tmp_path)
    assert (done.examined, done.references) == (1, first.references)
    found = [row for row in done.table.to_pylist() if row["parameter"] == "bias.value"]
    expected = 3 + 0.2 * (first.references["bias_temperature.reference"][0] - 20)
    assert max(abs(row["value"] - expected) / row["std"] for row in found) < 5


RATED = """effects: [{effect: scale_factor}, {effect: bias%s}, {effect: %s%s}]
noise: [{effect: noise_white, value: 0.0028 deg/sqrt(h)}]
"""


@pytest.mark.parametrize(
    ("effect", "more", "points"),
    [
        ("bias_temperature", "", {"reference": "50 degC"}),
        ("bias_temperature_curve", ", coefficients: [1 deg/h, 1 deg/h]", {"reference": "-30 degC"}),
        ("scale_temperature", "", {"reference": "50 degC"}),
        ("scale_nonlinearity", "", {"full_rate": "7 deg/s"}),
    ],
)
def test_a_result_is_told_at_other_points_as_if_fitted_at_them(
    tmp_path: Path, effect: str, more: str, points: dict[str, str]
):
    """Values, and the covariance of all parameters."""
    rate = np.repeat(np.linspace(-10.0, 10.0, 12), 5)
    rated = campaign(0).with_column("rate", rate, "deg/s")
    rated = rated.with_column("output", 3600 * rate + campaign(0).columns["output"], "deg/h")
    estimates = []
    for stated in ("", "".join(f", {name}: {text}" for name, text in points.items())):
        (tmp_path / "model.yaml").write_text(RATED % ("", effect, more + stated))
        estimates.append(fit(rated, read_model(tmp_path / "model.yaml")))
    own, expected = estimates
    places = {f"{effect}.{name}": float(getattr(expected.model.effects[2], name)) for name in points}
    model, covariance, common = referred(own, {key: (value, "") for key, value in places.items()})
    assert common
    std = np.sqrt(np.diag(expected.covariance))
    assert np.asarray(model.vector()) == pytest.approx(
        np.asarray(expected.model.vector()), abs=1e-4 * std.min(), rel=1e-6
    )
    assert covariance / np.outer(std, std) == pytest.approx(expected.covariance / np.outer(std, std), abs=1e-4)


def test_what_cannot_be_told_at_other_points_does_not_compare(tmp_path: Path):
    """Knots elsewhere make another curve, and a bias that is fixed cannot be that of another temperature."""
    rate = np.linspace(-10.0, 10.0, 60)
    rated = campaign(0).with_column("rate", rate, "deg/s")
    rated = rated.with_column("output", 3600 * rate + campaign(0).columns["output"], "deg/h")
    for effect, fixed, key in (
        ("scale_spline", "", "full_rate"),
        ("bias_temperature", ", value: 3 deg/h, fixed: true", "reference"),
    ):
        (tmp_path / "model.yaml").write_text(RATED % (fixed, effect, ""))
        estimate = fit(rated, read_model(tmp_path / "model.yaml"))
        model, _, common = referred(estimate, {f"{effect}.{key}": (0.1, "")})
        assert not common
        assert model is estimate.model


def test_each_reference_point_is_that_of_the_first_campaign_that_has_it(tmp_path: Path):
    """The first has no thermometer; a second column comes late, and is no longer looked for after many without."""
    many = []
    for k in range(2):
        other = campaign(k) if k else campaign(k).without("temperature")
        write_campaign(other, tmp_path / f"c{k}.csv")
        many.append(Entry(f"c{k}.csv", str(tmp_path / f"c{k}.csv")))
    write_campaign(campaign(2).with_column("fan", np.arange(60.0), "V"), tmp_path / "fan.csv")
    late = [*many, Entry("fan.csv", str(tmp_path / "fan.csv"))]
    (tmp_path / "model.yaml").write_text("effects: [{effect: bias}]\n")
    model = read_model(tmp_path / "model.yaml")
    found = open_references(late, model, True)
    assert found["bias_temperature.reference"][1] == "20 degC"
    assert found["bias_fan.reference"][1].endswith(" V")
    assert not [key for key in found if key.startswith(("bias_time", "bias_output", "bias_column"))]
    unlike = open_references([*many, *many * references.ENOUGH, *late[2:]], model, True)
    assert set(found) - set(unlike) == {"bias_fan.reference"}
    assert open_references(late, model, False) == {}


@pytest.mark.long
def test_what_a_diagnosis_adds_is_of_one_temperature_too(tmp_path: Path):
    """Like gyros measured at other temperatures, whose simulation knows a bias alone."""
    (tmp_path / "archive").mkdir()
    for k in range(3):
        warmer = np.array(campaign(k).columns["temperature"]) + 10 * k
        output = campaign(k).columns["output"] + 0.2 * 10 * k
        changed = campaign(k).with_column("temperature", warmer, "degC").with_column("output", output, "deg/h")
        write_campaign(changed, tmp_path / "archive" / f"c{k}.csv")
    (tmp_path / "model.yaml").write_text("effects: [{effect: bias}]\n")
    start = read_model(tmp_path / "model.yaml")
    done = run_batch(str(tmp_path / "archive"), start, "m", tmp_path / "r.parquet", diagnosing=True)
    rows = done.table.to_pylist()
    assert {row["causes"] for row in rows} == {"bias_temperature"}
    assert done.references["bias_temperature.reference"][1] == "20 degC"
    for row in rows:
        if row["parameter"] == "bias.value":
            assert abs(row["value"] - 3) < 5 * row["std"]
    assert {s.parameter: s.campaigns for s in unit_statistics(done.table)}["bias.value"] == 3
    kept = done.table.set_column(done.table.column_names.index("reason"), "reason", pa.array(["own"] * len(rows)))
    assert unit_statistics(kept) == []


@pytest.mark.parametrize("outputs", [True, False])
def test_a_vibration_test_of_a_platform_is_fitted_as_one(tmp_path: Path, outputs: bool):
    """Not as three gyros, where it has the rates of the platform as well."""
    log = read_campaign(PLATFORM)
    for name in log.outputs if not outputs else ():
        log = log.without(name)
    (tmp_path / "model.yaml").write_text("effects: [{effect: sync_delay}]\n")
    (tmp_path / "archive").mkdir()
    write_campaign(log, tmp_path / "archive" / "log.csv")
    rows = here(tmp_path).table.to_pylist()
    estimate = fit_vibration([log], read_model(tmp_path / "model.yaml"))
    assert {(row["axis"], row["status"]) for row in rows} == {(None, "fitted")}
    values = {row["parameter"]: row["value"] for row in rows}
    assert values["sync_delay.delay"] == pytest.approx({r.name: r.value for r in estimate.table()}["delay"])


def test_parameters_of_unlike_structure_do_not_mix(tmp_path: Path):
    """An axis that leans towards one that turns in some campaigns, and another one in others."""
    (tmp_path / "model.yaml").write_text("effects: [{effect: bias}, {effect: misalignment}]\n" + STATED.split("\n")[1])
    (tmp_path / "archive").mkdir()
    units = {"time": "s", "rate": "deg/s", "rate_spin": "deg/s", "rate_output": "deg/s", "output": "deg/s"}
    for k, (about, lean) in enumerate([("rate_spin", 1e-3), ("rate_output", -2e-3)] * 2):
        time, turn = np.arange(200.0), np.where(np.arange(200) % 20 < 10, 20.0, -20.0)
        columns = {"time": time, "rate": 0 * time, "rate_spin": 0 * time, "rate_output": 0 * time, about: turn}
        output = lean * turn + 1e-5 * np.random.default_rng(k).standard_normal(200)
        measured = Campaign(columns | {"output": output}, units, {"kind": "rate", "serial": "U1"})
        write_campaign(measured, tmp_path / "archive" / f"c{k}.csv")
    found = {each.parameter: each.mean for each in unit_statistics(here(tmp_path).table)}
    arcsec = 3600 * np.rad2deg(1e-3)
    assert found["misalignment.angles[about rate_spin]"] == pytest.approx(arcsec, rel=1e-3)
    assert found["misalignment.angles[about rate_output]"] == pytest.approx(-2 * arcsec, rel=1e-3)
    assert "misalignment.angles" not in found


def test_two_effects_of_one_name_are_two_parameters():
    steps = tuple(
        BiasStep(size=jnp.asarray(size), epoch=jnp.asarray(epoch)) for size, epoch in ((1.0, 9.0), (2.0, 20.0))
    )
    model, record = GyroModel(steps, {}), read_signals(campaign(0))
    rows = work._parameters({}, record, model, np.eye(len(model.slots())), 1)
    assert [r["parameter"] for r in rows] == [f"bias_step{k}.{n}" for k in ("", "[2]") for n in ("size", "epoch")]
