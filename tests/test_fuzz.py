"""Random and mutated campaign and model files through the commands: each ends in a result or in one clear sentence,
soon, and without a trace of a half-written answer.
"""

from __future__ import annotations

import re
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from gyromodel import cli
from gyromodel.batch import read_results
from gyromodel.campaign import Campaign
from gyromodel.files import SUFFIXES, write_campaign

FILES, ARCHIVE = 2000, 300
ROWS = 48
# Seconds after which a command hangs, on any machine.
LIMIT = 600
VALUES = [
    "nan", "", "inf", "-inf", "1e308", "-1e308", "1e-320", "0", "-0.0", "text", "1,2", "0x10", "١", "1e", "--3", '"',
    "12345678901234567890",
]  # fmt: skip
UNITS = [
    "deg/h", "rad", "", "furlong", "count", "K", "s", "deg/s/s", "1/0", "degC", "[", "µ", "V", "m/s^2", "**",
    "a" * 300,
]  # fmt: skip
NAMES = [
    "time", "output", "temperature", "output_x", "output_y", "rate", "gimbal_x", "segment", "position", "",
    "temperature_rate", "attitude_w", "table_x", "Zeit", "run", "\u202e",
]  # fmt: skip
KEYS = [
    "kind: angle", "kind: increment", "kind: nothing", "latitude_deg: 90", "latitude_deg: north",
    "time_since_power_on: soon", "serial", ": :", "nominal_scale_factor: 0", "nominal_scale_factor: 1000 count/deg",
    "rate_frame: inertial",
]  # fmt: skip
SCALARS = [
    "0", "-1", "1e400", "nan", ".inf", "true", "null", "[]", "{}", "bias", "3 deg/h", "1 furlong",
    "!!python/object/apply:os.system [echo]", "&a [*a]", "'", "1e-300 deg/h", "-5 s",
]  # fmt: skip
EFFECTS = [
    "bias_temperature", "scale_factor", "bias_warmup", "bias_periodic", "lock_in", "bias_step", "nothing",
    "bias_column", "noise_white", "scale_spline", "time_delay", "bias_pressure", "temperature_lag",
]  # fmt: skip
MODEL = """gyro: fog
effects:
  - effect: bias
    value: 3 deg/h
  - effect: bias_temperature
    coefficient: 0.2 deg/h/degC
    reference: 20 degC
noise:
  - effect: noise_white
    value: 0.002 deg/sqrt(h)
"""


def campaign() -> Campaign:
    rng = np.random.default_rng(1)
    time = 10.0 * np.arange(ROWS)
    temperature = 20 + 10 * np.sin(time / 90)
    output = 3 + 0.2 * (temperature - 20) + 0.05 * rng.standard_normal(ROWS)
    columns = {"time": time, "temperature": temperature, "output": output}
    return Campaign(columns, {"time": "s", "temperature": "degC", "output": "deg/h"}, {"kind": "rate", "serial": "A"})


def bytes_changed(rng: np.random.Generator, data: bytes) -> bytes:
    """Bytes flipped, dropped, doubled, or cut off."""
    data = bytearray(data)
    for _ in range(rng.integers(1, 6)):
        at = int(rng.integers(len(data) + 1))
        match rng.integers(5):
            case 0 if at < len(data):
                data[at] ^= 1 << int(rng.integers(8))
            case 1:
                del data[at : at + int(rng.integers(1, 40))]
            case 2:
                data[at:at] = data[at : at + int(rng.integers(1, 40))]
            case 3:
                data[at:at] = rng.bytes(int(rng.integers(1, 9)))
            case _ if rng.random() < 0.2:
                del data[at:]
            case _:
                pass
    return bytes(data)


def table_changed(rng: np.random.Generator, text: str) -> str:
    """What people and programs get wrong in a table."""
    lines = text.splitlines()
    head = next(i for i, line in enumerate(lines) if not line.startswith("#"))
    for _ in range(rng.integers(1, 4)):
        row = int(rng.integers(head + 1, len(lines))) if len(lines) > head + 1 else head
        cells, names = lines[row].split(","), lines[head].split(",")
        place = int(rng.integers(len(cells)))
        column = int(rng.integers(len(names)))
        match rng.integers(11):
            case 0 | 1:
                cells[place] = str(rng.choice(VALUES))
                lines[row] = ",".join(cells)
            case 2:
                names[column] = re.sub(r"\[.*\]", lambda _: f"[{rng.choice(UNITS)}]", names[column])
                lines[head] = ",".join(names)
            case 3:
                names[column] = re.sub(r"^[^\[]*", lambda _: f"{rng.choice(NAMES)} ", names[column])
                lines[head] = ",".join(names)
            case 4:
                lines.insert(0, f"# {rng.choice(KEYS)}")
                head += 1
            case 5:
                lines.insert(row, lines[row])
            case 6:
                del lines[row:]
            case 7:
                lines = [line for i, line in enumerate(lines) if i <= head or rng.random() < 0.5]
            case 8:
                # One column of one value only.
                value = str(rng.choice(VALUES))
                lines[head + 1 :] = [
                    ",".join(value if i == column else c for i, c in enumerate(line.split(",")))
                    for line in lines[head + 1 :]
                ]
            case 9:
                lines[head] = lines[head].replace(",", ";")
            case _:
                lines = [line for line in lines if not line.startswith("#")]
                head = 0
        if head >= len(lines):
            break
    return "\n".join(lines) + "\n"


def model_changed(rng: np.random.Generator, text: str) -> str:
    """What people get wrong in a model."""
    lines = text.splitlines()
    for _ in range(rng.integers(1, 4)):
        at = int(rng.integers(len(lines)))
        match rng.integers(6):
            case 0 | 1:
                lines[at] = re.sub(r": .*", lambda _: f": {rng.choice(SCALARS)}", lines[at])
            case 2:
                lines[at] = re.sub(r"effect: .*", lambda _: f"effect: {rng.choice(EFFECTS)}", lines[at])
            case 3:
                lines.insert(at, lines[int(rng.integers(len(lines)))])
            case 4 if len(lines) > 1:
                del lines[at]
            case _:
                lines.insert(at, f"  - effect: {rng.choice(EFFECTS)}")
    return "\n".join(lines) + "\n"


@contextmanager
def soon() -> Iterator[None]:
    """No command hangs."""

    def late(*_: object) -> None:
        raise TimeoutError(f"nothing within {LIMIT} s")

    before = signal.signal(signal.SIGALRM, late)
    signal.alarm(LIMIT)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


COMMANDS: list[Callable[[str, str], list[str]]] = [
    lambda data, model: ["fit", data, "--model", model, "-o", "out"],
    lambda data, model: ["simulate", model, "--like", data, "-o", "out/simulated.csv"],
    lambda data, model: ["compensate", model, data, "-o", "out/compensated.parquet"],
    lambda data, model: ["allan", data, "-o", "out"],
    lambda data, model: ["navigate", data, "-o", "out/navigated.csv"],
    lambda data, model: ["export", model, "--to", "c", "-o", "out/rate.h"],
    lambda data, model: ["export", model, "--to", "json"],
    lambda data, model: ["diagnose", data, "--model", model, "-o", "out"],
]
# Of each command; a diagnosis takes seconds.
SHARES = [0.16, 0.14, 0.14, 0.14, 0.14, 0.12, 0.12, 0.04]


@pytest.mark.long
@pytest.mark.parametrize("part", range(4))
def test_every_file_ends_in_a_result_or_a_sentence(
    part: int, seed: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    rng = np.random.default_rng(seed)
    monkeypatch.chdir(tmp_path)
    for suffix in (".csv", ".parquet", ".nc"):
        write_campaign(campaign(), Path(f"good{suffix}"))
    good = {suffix: Path(f"good{suffix}").read_bytes() for suffix in (".csv", ".parquet", ".nc")}
    done = 0
    for k in range(FILES // 4):
        suffix, model = ".csv", MODEL
        data = good[suffix]
        match rng.integers(5):
            case 0:
                suffix = str(rng.choice([".csv", ".parquet", ".nc"], p=[0.6, 0.2, 0.2]))
                data = bytes_changed(rng, good[suffix])
            case 1 | 2:
                data = table_changed(rng, data.decode()).encode()
            case 3:
                model = model_changed(rng, model)
            case _:
                model = bytes_changed(rng, model.encode()).decode("utf-8", "surrogateescape")
        place = tmp_path / f"case{k}"
        place.mkdir()
        (place / f"data{suffix}").write_bytes(data)
        (place / "model.yaml").write_bytes(model.encode("utf-8", "surrogateescape"))
        monkeypatch.chdir(place)
        command = COMMANDS[int(rng.choice(len(COMMANDS), p=SHARES))](f"data{suffix}", "model.yaml")
        told = f"seed {seed}, case {k}: {' '.join(command)} in {place}"
        try:
            with soon(), pytest.raises(SystemExit) as ended:
                cli.main(command)
        except BaseException as error:
            raise AssertionError(told) from error
        said = capsys.readouterr()
        written = [p for p in Path("out").rglob("*") if p.is_file()] if Path("out").exists() else []
        if ended.value.code in (0, None):
            done += 1
            assert not [p for p in written if p.name.startswith(".")], told
        else:
            assert ended.value.code in (1, 2), told
            lines = said.err.strip().splitlines()
            assert not re.search("internal error|Traceback", said.err), f"{told}\n{said.err}"
            assert lines[-1].startswith(("gyromodel: ", "Error: ")), f"{told}\n{said.err}"
            assert len(lines[-1]) < 1000, f"{told}\n{said.err}"
            assert not written, f"{told}\n{written}"
        monkeypatch.chdir(tmp_path)
    # Neither all refused nor all let through.
    assert 0.1 * FILES / 4 < done < 0.9 * FILES / 4


@pytest.mark.long
def test_every_damaged_campaign_of_an_archive_is_a_row(seed: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """Of every kind of file; what is left whole is fitted beside them."""
    rng = np.random.default_rng(seed)
    archive = tmp_path / "archive"
    archive.mkdir()
    for k in range(ARCHIVE):
        path = archive / f"{k:03d}{rng.choice(SUFFIXES)}"
        write_campaign(campaign(), path)
        inside = [p for p in [path, *path.rglob("*")] if p.is_file()]
        victim = inside[int(rng.integers(len(inside)))]
        victim.write_bytes(bytes_changed(rng, victim.read_bytes()))
    (tmp_path / "model.yaml").write_text(MODEL, encoding="utf-8")
    results = tmp_path / "results.parquet"
    with soon(), pytest.raises(SystemExit) as ended:
        cli.main(["batch", str(archive), "--model", str(tmp_path / "model.yaml"), "-o", str(results)])
    said = capsys.readouterr().err
    assert ended.value.code in (0, 1, None), f"seed {seed}: {said}"
    table = read_results(results).to_pandas()
    assert set(table["campaign"]) == {p.name for p in archive.iterdir()}, f"seed {seed}"
    lost = table[table["status"] == "failed"]
    assert not lost["campaign"].duplicated().any(), f"seed {seed}"
    assert not lost["reason"].str.contains("internal error").any(), f"seed {seed}: {lost['reason'].tolist()}"
    assert 0.05 * ARCHIVE < len(lost) < ARCHIVE, f"seed {seed}"
    assert np.isfinite(table.loc[(table["status"] == "fitted") & table["std"].notna(), "value"]).all()
