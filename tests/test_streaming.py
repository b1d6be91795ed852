"""Files compensated in parts, against the same campaign in memory; and what memory a part takes."""

from __future__ import annotations

import gzip
import subprocess
import sys
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from gyromodel import _compensate_files, cli, streaming
from gyromodel._checks import CampaignError
from gyromodel.campaign import Campaign
from gyromodel.compensation import compensate, reference_error
from gyromodel.effects.drivers import Bias, BiasDrift, BiasStep
from gyromodel.effects.geometry import TableTilt
from gyromodel.effects.scale import ScaleFactor, ScaleNonlinearity
from gyromodel.effects.thermal import BiasTemperature, BiasTemperatureRate, BiasWarmup
from gyromodel.estimate import Calibration
from gyromodel.files import read_campaign, write_campaign
from gyromodel.model import GyroModel
from gyromodel.model_files import write_model

# Rows of a part, and of a campaign that ends one row into its fourth.
PART, ROWS = 256, 3 * 256 + 1
EFFECTS = (
    ScaleFactor(value=jnp.asarray(1500.0), unit="count/rad"),
    Bias(value=jnp.asarray(1e-3)),
    BiasTemperature(coefficient=jnp.asarray(1e-4), reference=jnp.asarray(20.0)),
    ScaleNonlinearity(coefficients=jnp.asarray([0.01]), powers=(2,), full_rate=jnp.asarray(1.0)),
    BiasDrift(slope=jnp.asarray(1e-7)),
)
CALIBRATION = Calibration(
    GyroModel(EFFECTS, {"noise_white": 1e-5}),
    np.diag([1.0, 1e-10, 1e-12, 1e-8, 1e-16]),
    {"temperature": (15.0, 24.0), "rate": (-0.5, 0.5)},
)


@pytest.fixture(autouse=True)
def _small_parts(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(streaming, "ROWS", PART)
    monkeypatch.setattr(_compensate_files, "LARGE", 0)


def campaign(rng: np.random.Generator) -> Campaign:
    """A clock that jitters, samples missing, temperatures and rates beyond the calibrated ones."""
    time = 1e5 + np.cumsum(0.01 * (1 + 0.2 * (np.arange(ROWS) % 7 == 3)))
    rate = np.rad2deg(0.6 * np.sin(np.arange(ROWS) / 30))
    temperature = 20 + 5 * np.sin(np.arange(ROWS) / 200)
    output = 1500 * (np.deg2rad(rate) + 1e-3 + 1e-4 * (temperature - 20)) + 0.01 * rng.standard_normal(ROWS)
    output[rng.choice(ROWS, 40, replace=False)] = np.nan
    columns = {"time": time, "rate": rate, "temperature": temperature, "output": output}
    units = {"time": "s", "rate": "deg/s", "temperature": "degC", "output": "count/s"}
    return Campaign(columns, units, {"kind": "rate", "time_since_power_on": 30, "serial": "A"}, "log")


def text_of(path: Path) -> bytes:
    return gzip.decompress(path.read_bytes()) if path.suffix == ".gz" else path.read_bytes()


def test_outputs_in_some_rows_of_some_campaigns_are_those_of_the_whole(tmp_path: Path, rng: np.random.Generator):
    sparse = campaign(rng)
    output = np.where(np.arange(ROWS) % 4 == 0, sparse.columns["output"], np.nan)
    numbered = sparse.with_column("campaign", 1.0 + np.arange(ROWS) // (ROWS // 2 + 1), "")
    write_campaign(numbered.with_column("output", output, "count/s"), tmp_path / "a.csv")
    steps = tuple(BiasStep(size=jnp.asarray(1e-4), epoch=jnp.asarray(1.0), campaign=k) for k in (1, 3))
    calibration = Calibration(GyroModel((*EFFECTS[:2], *steps), {"noise_white": 1e-5}))
    whole = compensate(read_campaign(tmp_path / "a.csv"), calibration)
    done = streaming.compensate_file(tmp_path / "a.csv", tmp_path / "b.csv", calibration)
    again = read_campaign(tmp_path / "b.csv")
    assert done is not None
    assert done.note == whole.metadata["rate_estimated_note"]
    assert "bias_step was in campaign 3" in done.note
    assert "campaign 1" not in done.note
    for name in ("rate_estimated", "rate_estimated_std"):
        np.testing.assert_allclose(again.columns[name], whole.columns[name], rtol=1e-9)


@pytest.mark.parametrize("kinds", ["csv csv", "csv.gz csv.gz", "parquet parquet", "csv parquet", "parquet csv"])
def test_a_file_in_parts_is_the_campaign_in_memory(kinds: str, tmp_path: Path, rng: np.random.Generator):
    """All but the rates bit by bit; those may differ in their last bits, since compilers group what is at an end."""
    source, target = (tmp_path / f"{name}.{kind}" for name, kind in zip("ab", kinds.split(), strict=True))
    whole_file = tmp_path / f"whole.{kinds.split()[1]}"
    write_campaign(campaign(rng), source)
    whole = compensate(read_campaign(source), CALIBRATION)
    write_campaign(whole, whole_file)
    done = streaming.compensate_file(source, target, CALIBRATION)
    assert done is not None
    again = read_campaign(target)
    assert dict(again.metadata) == dict(whole.metadata)
    assert "calibrated range of temperature" in done.note
    assert again.units == whole.units
    assert list(again.columns) == list(whole.columns)
    for name, values in whole.columns.items():
        near = 1e-12 * np.nanmax(np.abs(values)) * name.startswith("rate_estimated")
        np.testing.assert_allclose(again.columns[name], values, rtol=0, atol=near, err_msg=name)
    if target.suffix != ".parquet":
        head, *_ = (data[: data.index(b"\n1")] for data in map(text_of, (target, whole_file)))
        assert text_of(whole_file).startswith(head + b"\n")
    assert done.data_hash == again.digest()
    assert (done.rows, done.note) == (ROWS, whole.metadata["rate_estimated_note"])
    assert {path.name for path in tmp_path.iterdir()} == {source.name, target.name, whole_file.name}


def test_an_axis_and_a_reference_are_those_of_the_whole(
    tmp_path: Path, rng: np.random.Generator, capsys: pytest.CaptureFixture[str]
):
    """A calibration that makes things worse is refused, and what was there stays; the axis may rest for a while."""
    one = campaign(rng)
    rate = np.array(one.columns["rate"])
    still = np.where(np.arange(ROWS) < PART + 10, 0.25, rate)
    three = one.without("output").without("rate").with_column("rate_x", rate, "deg/s")
    three = three.with_column("output_x", still, "deg/s").with_column("output_y", rate, "deg/s")
    write_campaign(three, tmp_path / "log.csv")
    write_model(GyroModel((Bias(value=jnp.asarray(0.4)),), {"noise_white": 1e-5}), tmp_path / "model.yaml")
    command = ["compensate", *(str(tmp_path / n) for n in ("model.yaml", "log.csv")), "--axis", "x", "-o"]
    said, written = [], []
    for large in (0, 1 << 30):
        target = tmp_path / f"{large}.csv"
        target.write_text("before")
        with pytest.MonkeyPatch.context() as patched:
            patched.setattr(_compensate_files, "LARGE", large)
            with pytest.raises(SystemExit) as ended:
                cli.main([*command, str(target)])
            assert ended.value.code == 1
            assert target.read_text() == "before"
            with pytest.raises(SystemExit) as ended:
                cli.main([*command, str(target), "--force"])
            assert not ended.value.code
        told = capsys.readouterr()
        said.append((told.err, told.out.replace(str(target), "FILE")))
        written.append(target.read_bytes())
    assert "makes it worse" in said[0][0]
    assert said[0] == said[1]
    assert [len(text.splitlines()) for text in written] == [len(written[0].splitlines())] * 2
    whole = reference_error(compensate(three.axis("x"), Calibration(GyroModel((Bias(value=jnp.asarray(0.4)),)))))
    assert whole is not None
    assert f"{whole.compensated:.4g}" in said[0][1]


WHOLE = [
    "memory",
    "increment",
    "missing",
    "irregular",
    "zarr",
    "constant",
    "lacking",
    "open",
    "begun",
    "cut",
    "flipped",
]


@pytest.mark.parametrize("what", WHOLE)
def test_what_needs_the_whole_is_left_to_it(
    what: str, tmp_path: Path, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
):
    calibration, measured, name = CALIBRATION, campaign(rng), "log.csv"
    temperature, output = np.array(measured.columns["temperature"]), np.array(measured.columns["output"])
    match what:
        case "memory":
            calibration = Calibration(GyroModel((*EFFECTS[:1], BiasTemperatureRate(coefficient=jnp.asarray(1.0)))))
        case "increment":
            columns, units = dict(measured.columns), dict(measured.units) | {"output": "count"}
            measured = Campaign(columns, units, {"kind": "increment"})
        case "missing":
            temperature[np.flatnonzero(np.isfinite(output))[600]] = np.nan
            measured = measured.with_column("temperature", temperature, "degC")
        case "irregular":
            monkeypatch.setattr(streaming, "STEPS", 1)
        case "zarr":
            name = "log.zarr"
        case "constant":
            measured = measured.with_column("output", np.full(ROWS, 1.0), "count/s")
        case "lacking":
            measured = measured.without("temperature")
        case "open":  # its angle is the azimuth where that varies, which here is after the first part
            calibration = Calibration(GyroModel((TableTilt(north=jnp.asarray(1e-6), east=jnp.asarray(0.0)),)))
            measured = measured.with_column("table_angle", np.arange(ROWS), "deg")
            measured = measured.with_column("azimuth", np.maximum(np.arange(ROWS) - 600, 0), "deg")
        case "begun":  # a run's power-on is in the part where it begins
            calibration = Calibration(GyroModel((BiasWarmup(amplitude=jnp.asarray(1e-6)),)))
            measured = measured.with_column("run", np.where(np.arange(ROWS) < 600, 1.0, 2.0), "")
        case "cut" | "flipped":
            name = "log.csv.gz"
    write_campaign(measured, tmp_path / name)
    if name == "log.csv.gz":
        packed = bytearray((tmp_path / name).read_bytes())
        packed[len(packed) // 2] ^= 0xFF * (what == "flipped")
        (tmp_path / name).write_bytes(packed[: len(packed) // (1 + (what == "cut"))])
    assert streaming.compensate_file(tmp_path / name, tmp_path / "out.csv", calibration) is None
    assert [path.name for path in tmp_path.iterdir()] == [name]


@pytest.mark.parametrize("kind", ["csv", "parquet"])
def test_a_folder_is_not_replaced(kind: str, tmp_path: Path, rng: np.random.Generator):
    write_campaign(campaign(rng), tmp_path / "log.csv")
    (tmp_path / f"other.{kind}").mkdir()
    (tmp_path / f"other.{kind}" / "part.0").write_text("precious")
    with pytest.raises(CampaignError, match="is a folder that holds something else"):
        streaming.compensate_file(tmp_path / "log.csv", tmp_path / f"other.{kind}", CALIBRATION)
    assert (tmp_path / f"other.{kind}" / "part.0").read_text() == "precious"


MEMORY = """
import sys
from pathlib import Path
from gyromodel.model_files import read_calibration
from gyromodel.streaming import compensate_file
assert compensate_file(Path(sys.argv[1]), Path(sys.argv[1] + ".out.parquet"), read_calibration(Path(sys.argv[2])))
# What getrusage tells counts the process that started this one.
print(next(line.split()[1] for line in open("/proc/self/status") if line.startswith("VmHWM")))
"""


@pytest.mark.long
@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="no /proc that tells the peak of memory")
def test_memory_does_not_grow_with_the_file(tmp_path: Path):
    """Of files in groups of a million rows: three million more, whose columns alone would be 96 MiB more."""
    (tmp_path / "m.yaml").write_text("effects: [{effect: bias, value: 1 deg/h}]\n")
    peaks = []
    for rows in (1 << 20, 1 << 22):
        time = 0.01 * np.arange(rows)
        columns = {"time": time, "temperature": 20 + np.sin(time), "rate": np.sin(time), "output": np.sin(time)}
        units = {"time": "s", "temperature": "degC", "rate": "deg/s", "output": "deg/s"}
        write_campaign(Campaign(columns, units, {"kind": "rate"}), tmp_path / f"{rows}.parquet")
        command = [sys.executable, "-c", MEMORY, str(tmp_path / f"{rows}.parquet"), str(tmp_path / "m.yaml")]
        peaks.append(int(subprocess.run(command, capture_output=True, text=True, check=True).stdout) / 1024)
    assert peaks[1] - peaks[0] < 50, peaks
