"""Reading and writing campaigns: a round trip gives back what was written; files of others are made by their tools."""

from __future__ import annotations

import gzip
import json
import os
import pickle
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as parquet
import pytest
import xarray as xr
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from gyromodel._checks import CampaignError
from gyromodel.batch import entries
from gyromodel.campaign import LARGEST, Campaign
from gyromodel.files import read_campaign, replacing, write_campaign
from tests.helpers import MUTANTS, SHARED_FOLDER, mutated, small_campaign

FORMATS = (".csv", ".csv.gz", ".parquet", ".nc", ".zarr")
finite = st.floats(-LARGEST, LARGEST)
# Names that promise nothing about unit or value.
names = st.from_regex(r"[A-Z0-9µ][A-Za-z0-9_ .()%+°é-]{0,12}", fullmatch=True).filter(lambda text: text == text.strip())
texts = st.text(st.characters(exclude_characters="\0", exclude_categories=["Cs"]), max_size=20)
numbers = st.integers(-(2**63) + 1, 2**63 - 1) | finite
number_texts = numbers.map(repr) | st.sampled_from(["007", "+5", "1_000", "1e999", ".5", "-0", "nan", '"quoted"', '"'])
values = st.one_of(finite, st.just(float("nan")))


@st.composite
def contents(draw: st.DrawFn) -> tuple[dict[str, np.ndarray], dict[str, str], dict[str, Any]]:
    """Columns, units and metadata; the campaign is made in the test, as the type checker draws random numbers."""
    time = sorted({t if abs(t) > 1e-90 else 0.0 for t in draw(st.lists(finite, min_size=4, max_size=12, unique=True))})
    assume(len(time) > 2)
    n = len(time)
    outputs = draw(st.sampled_from([("output",), ("output_x",), ("output_z", "output_x")]))
    others = draw(
        st.lists(names.filter(lambda name: "output" not in name and "time" not in name), max_size=3, unique=True)
    )
    columns: dict[str, Any] = {"time": np.array(time)}
    units = {"time": draw(st.sampled_from(["s", "ms", "h"]))}
    for name in draw(st.permutations([*outputs, *others, "temperature"])):
        columns[name] = np.array(draw(st.lists(values, min_size=n, max_size=n)))
        units[name] = draw(st.sampled_from(["", "V", "deg/√h", "m s-2", "ppm/°C"]))
    for name in outputs:
        known = columns[name][~np.isnan(columns[name])]
        assume(len(known) and (known != known[0]).any())
        units[name] = "count"
    units["temperature"] = "degF"
    metadata = draw(st.dictionaries(names, texts | numbers | number_texts, max_size=4))
    return columns, units, {**metadata, "kind": draw(st.sampled_from(["rate", "increment", "angle"]))}


@pytest.mark.parametrize("suffix", FORMATS)
def test_round_trip_of_any_campaign(tmp_path: Path, suffix: str):
    @settings(SHARED_FOLDER, max_examples=20 if suffix in (".nc", ".zarr") else 60)
    @given(contents())
    def check(parts: tuple[dict[str, np.ndarray], dict[str, str], dict[str, Any]]) -> None:
        campaign = Campaign(*parts)
        path = tmp_path / f"any{suffix}"
        write_campaign(campaign, path)
        back = read_campaign(path)
        assert back.equals(campaign)
        assert list(back.columns) == list(campaign.columns)
        assert back.units == campaign.units
        assert back.metadata == campaign.metadata
        assert all(type(value) is type(campaign.metadata[key]) for key, value in back.metadata.items())
        assert os.listdir(tmp_path) == [path.name]

    check()


@pytest.mark.parametrize("suffix", FORMATS)
def test_a_missing_stretch_longer_than_a_chunk_survives(tmp_path: Path, suffix: str, rng: np.random.Generator):
    n = 150_000
    output = rng.normal(size=n)
    output[10:140_000] = np.nan
    campaign = Campaign(
        {"time": np.arange(n) * 0.01, "output": output}, {"time": "s", "output": "deg/s"}, {"kind": "rate"}
    )
    write_campaign(campaign, tmp_path / f"long{suffix}")
    back = read_campaign(tmp_path / f"long{suffix}")
    assert back.equals(campaign)
    assert back.name == "long"


@pytest.mark.parametrize("suffix", FORMATS)
def test_writing_replaces_what_was_there(tmp_path: Path, suffix: str):
    path = tmp_path / f"a{suffix}"
    write_campaign(small_campaign(), path)
    write_campaign(small_campaign(serial="008").without("temperature"), path)
    assert read_campaign(path).metadata["serial"] == "008"
    assert os.listdir(tmp_path) == [path.name]


def test_a_failed_write_leaves_what_was_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    path = tmp_path / "a.csv"
    write_campaign(small_campaign(), path)

    def full(*_: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("pyarrow.csv.write_csv", full)
    with pytest.raises(CampaignError, match=r"a\.csv: cannot be written: No space left on device"):
        write_campaign(small_campaign(serial="008"), path)
    assert os.listdir(tmp_path) == ["a.csv"]
    assert read_campaign(path).equals(small_campaign())


FULL = """
import resource, sys
from gyromodel.files import write_campaign
from gyromodel import CampaignError
from pathlib import Path
from gyromodel._atomic import write_text
from tests.helpers import small_campaign
write_campaign(small_campaign(), "warm" + sys.argv[1])
resource.setrlimit(resource.RLIMIT_FSIZE, (100, 100))
try:
    write_campaign(small_campaign(serial="008"), "a" + sys.argv[1])
except CampaignError as error:
    print(error)
try:
    write_text(Path("a.txt"), "long " * 100)
except OSError as error:
    print(error.filename)
"""


@pytest.mark.parametrize("suffix", FORMATS)
def test_a_disk_that_is_full_ends_in_a_sentence(tmp_path: Path, suffix: str):
    """As a limit of the size of files makes it, in the libraries' own code too."""
    write_campaign(small_campaign(), tmp_path / f"a{suffix}")
    done = subprocess.run(
        [sys.executable, "-c", FULL, suffix], capture_output=True, text=True, check=False, cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(Path(__file__).parents[1])},
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (0, "")
    assert re.fullmatch(rf"a{re.escape(suffix)}: cannot be written: .*File too large\na\.txt\n", done.stdout)
    assert read_campaign(tmp_path / f"a{suffix}").equals(small_campaign())
    assert {*os.listdir(tmp_path)} == {f"a{suffix}", f"warm{suffix}"}


@pytest.mark.parametrize("suffix", [".csv", ".zarr"])
def test_what_a_killed_write_left_goes_with_the_next(tmp_path: Path, suffix: str):
    """Of the same target only, and not what another run is writing."""
    path = tmp_path / f"a{suffix}"
    kill = "import os, sys; from pathlib import Path; from gyromodel.files import replacing; "
    kill += "f = replacing(Path(sys.argv[1])); f.__enter__().mkdir(); os.kill(os.getpid(), 9)"
    subprocess.run([sys.executable, "-c", kill, str(path)], check=False)
    [left] = tmp_path.iterdir()
    others = {tmp_path / ".b.csv.01234567.tmp", tmp_path / f".a{suffix}.notes.tmp"}
    for other in others:
        other.touch()
    with replacing(tmp_path / "c.csv") as writing:
        writing.touch()
        write_campaign(small_campaign(), path)
        assert {*tmp_path.iterdir()} == {left, path, writing, *others}
        (tmp_path / "c.csv").touch()
    write_campaign(small_campaign(), path)
    assert {*tmp_path.iterdir()} == {path, tmp_path / "c.csv", *others}


KILLED = """
import os, shutil, sys
from gyromodel import _atomic, files
from tests.helpers import small_campaign
def killing(whole, left=[int(sys.argv[2])]):
    def step(*arguments, **options):
        done = whole(*arguments, **options)
        left[0] -= 1
        if not left[0]:
            os.kill(os.getpid(), 9)
        return done
    return step
os.replace, _atomic._exchange, shutil.rmtree = map(killing, (os.replace, _atomic._exchange, shutil.rmtree))
if len(sys.argv) > 3:
    def _exchange(*_):
        raise OSError(22, "Invalid argument")
    _atomic._exchange = _exchange
files.write_campaign(small_campaign(serial="008"), sys.argv[1])
"""


@pytest.mark.long
@pytest.mark.parametrize("swaps", [True, False])
def test_a_folder_killed_at_any_step_of_its_replacement_is_there(tmp_path: Path, swaps: bool):
    """Without a swap in one step, it is from the next write on, even of one that fails."""
    path, steps = tmp_path / "a.zarr", 0
    while True:
        write_campaign(small_campaign(), path)
        steps += 1
        command = [sys.executable, "-c", KILLED, str(path), str(steps), *([] if swaps else ["x"])]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode == 0:
            break
        assert done.returncode == -9, done.stderr
        if not swaps:
            with suppress(RuntimeError), replacing(path):
                raise RuntimeError
        assert read_campaign(path).metadata["serial"] in ("007", "008")
        write_campaign(small_campaign(), path)
        assert os.listdir(tmp_path) == ["a.zarr"]
    assert steps > (2 if swaps else 4)


def test_where_nothing_can_be_written(tmp_path: Path):
    with pytest.raises(CampaignError, match="cannot be written: No such file or directory"):
        write_campaign(small_campaign(), tmp_path / "nowhere" / "a.csv")
    (tmp_path / "notes.zarr").mkdir()
    with pytest.raises(CampaignError, match="holds something else than a campaign"):
        write_campaign(small_campaign(), tmp_path / "notes.zarr")
    with pytest.raises(CampaignError, match=r"expected a name ending in \.csv, \.csv\.gz, \.parquet, \.nc, \.zarr"):
        write_campaign(small_campaign(), tmp_path / "a.xlsx")


@pytest.mark.parametrize("name", ["a.txt", "a", ".csv", "a.csv.zip", "a.xlsx"])
def test_an_unknown_suffix(tmp_path: Path, name: str):
    (tmp_path / name).write_text("# kind: rate\ntime [s],output [count]\n0,1\n1,2\n2,4\n")
    with pytest.raises(CampaignError, match=r"expected a name ending in \.csv, \.csv\.gz"):
        read_campaign(tmp_path / name)


@pytest.mark.parametrize("suffix", FORMATS)
def test_missing_and_foreign_files(tmp_path: Path, suffix: str):
    path = tmp_path / f"a{suffix}"
    with pytest.raises(CampaignError, match="there is no such file"):
        read_campaign(path)
    path.write_bytes(b"")
    with pytest.raises(CampaignError, match=r"is empty|is no .* file, or is cut short|is a folder"):
        read_campaign(path)
    path.write_bytes(os.urandom(1000))
    with pytest.raises(CampaignError):
        read_campaign(path)
    path.unlink()
    path.mkdir()
    with pytest.raises(CampaignError, match=r"is a file, and this is none|is no Zarr file, or is cut short"):
        read_campaign(path)


@pytest.mark.parametrize("suffix", [".csv.gz", ".parquet", ".nc"])
def test_cut_short(tmp_path: Path, suffix: str):
    path = tmp_path / f"a{suffix}"
    write_campaign(small_campaign(), path)
    whole = path.read_bytes()
    for keep in (0.1, 0.5, 0.9, 0.99):
        path.write_bytes(whole[: int(keep * len(whole))])
        with pytest.raises(CampaignError):
            read_campaign(path)


def test_a_zarr_copy_that_lacks_a_chunk(tmp_path: Path):
    write_campaign(small_campaign(), tmp_path / "a.zarr")
    shutil.rmtree(tmp_path / "a.zarr" / "output" / "c")
    with pytest.raises(CampaignError, match="column 'output' lacks 1 of 1 chunks: the copy is not complete"):
        read_campaign(tmp_path / "a.zarr")
    (tmp_path / "a.zarr" / "temperature" / "zarr.json").unlink()
    with pytest.raises(CampaignError, match="column 'temperature' lacks its description: the copy is not complete"):
        read_campaign(tmp_path / "a.zarr")


class Runs:
    """A pickle of it makes a folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def __reduce__(self) -> Any:
        return os.mkdir, (str(self.folder),)


@pytest.mark.parametrize("column", ["time", "output"])
def test_a_pickle_in_a_zarr_file_is_not_looked_at(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, column: str):
    """As numcodecs may, which has a codec for it."""
    monkeypatch.setattr("numcodecs.pickles.Pickle.decode", lambda self, data, out=None: pickle.loads(bytes(data)))
    path = tmp_path / "a.zarr"
    whole = {"zarr_format": 2, "shape": [6], "chunks": [6], "compressor": None, "fill_value": None, "order": "C"}
    kinds: dict[str, Any] = {name: {"dtype": "<f8", "filters": None} for name in ("time", "output")}
    kinds[column] = {"dtype": "|O", "filters": [{"id": "vlen-utf8"}, {"id": "pickle"}]}
    for name, kind in kinds.items():
        (path / name).mkdir(parents=True)
        (path / name / ".zarray").write_text(json.dumps(whole | kind))
        (path / name / ".zattrs").write_text('{"units": "s", "_ARRAY_DIMENSIONS": ["time"]}')
        (path / name / "0").write_bytes(np.arange(6.0).tobytes())
    (path / ".zgroup").write_text('{"zarr_format": 2}')
    (path / column / "0").write_bytes(pickle.dumps(Runs(tmp_path / "made")))
    with pytest.raises(CampaignError, match=f"column '{column}' holds .*, expected numbers"):
        read_campaign(path)
    assert not (tmp_path / "made").exists()


def test_hdf5_texts_with_a_wrong_length(tmp_path: Path):
    """HDF5 2.0 never returns from some such files, so that it must not get them."""
    path = tmp_path / "a.nc"
    write_campaign(small_campaign(), path)
    data = bytearray(path.read_bytes())
    length = data.index(b"GCOL") + 16 + 8
    right = data[length]
    refused = ""
    for wrong in {*range(0, 256, 3)} - {right}:
        data[length] = wrong
        path.write_bytes(data)
        with pytest.raises(CampaignError) as caught:
            read_campaign(path)
        refused += str(caught.value)
        assert [entry.campaign for entry in entries(str(tmp_path))] == ["a.nc"]
    assert "is damaged: a block of texts in it does not add up" in refused


def test_parquet_from_pandas(tmp_path: Path):
    frame = pd.DataFrame({"time [s]": [0, 1, 2], "output [count]": [1, None, 5], "run []": [1, 1, 1]})
    table = pa.Table.from_pandas(frame)
    table = table.replace_schema_metadata({**(table.schema.metadata or {}), "kind": "rate", "serial": "12"})
    parquet.write_table(table, tmp_path / "a.parquet")
    campaign = read_campaign(tmp_path / "a.parquet")
    assert dict(campaign.metadata) == {"kind": "rate", "serial": 12}
    np.testing.assert_array_equal(campaign.columns["output"], [1, np.nan, 5])
    parquet.write_table(pa.table({"time [s]": [0, 1, 2], "output [count]": ["a", "b", "c"]}), tmp_path / "b.parquet")
    with pytest.raises(CampaignError, match="column 'output' holds string, expected numbers"):
        read_campaign(tmp_path / "b.parquet")


def dataset(**changes: Any) -> xr.Dataset:
    variables: dict[str, Any] = {
        "output": ("time", np.array([1, -2, 3, -128], np.int8), {"units": "deg s-1", "scale_factor": 0.05}),
        "temperature": ("time", np.array([20, 21, 22, 23], np.float32), {"units": "degree_Celsius"}),
        "time": ("time", np.arange(4.0), {"units": "s"}),
    }
    return xr.Dataset({**variables, **changes}, attrs={"kind": "rate", "serial": 12, "note": ["a", "b"]})


@pytest.mark.parametrize("suffix", [".nc", ".zarr"])
def test_cf_files_of_others(tmp_path: Path, suffix: str):
    path = tmp_path / f"a{suffix}"

    def write(data: xr.Dataset) -> None:
        data["output"].encoding["_FillValue"] = np.int8(-128)
        if suffix == ".nc":
            data.to_netcdf(path, engine="h5netcdf")
        else:
            data.to_zarr(path, mode="w", consolidated=False)

    write(dataset())
    campaign = read_campaign(path)
    np.testing.assert_allclose(campaign.columns["output"], [0.05, -0.1, 0.15, np.nan], rtol=1e-15)
    assert campaign.units == {"time": "s", "output": "deg s-1", "temperature": "degree_Celsius"}
    assert campaign.metadata["serial"] == 12
    assert campaign.metadata["note"] == "['a', 'b']"
    for change, message in [
        (("time", np.arange(4.0)), "column 'extra' has no unit"),
        (("time", np.array([True, False, True, True]), {"units": "V"}), "column 'extra' holds .*, expected numbers"),
        (
            ("axis", np.arange(3.0), {"units": "V"}),
            r"variable 'extra' has dimensions \('axis',\), expected \('time',\)",
        ),
    ]:
        write(dataset(extra=change))
        with pytest.raises(CampaignError, match=message):
            read_campaign(path)


@pytest.mark.parametrize("suffix", FORMATS[:4])
def test_a_damaged_file_loads_or_is_refused_in_one_sentence(tmp_path: Path, suffix: str):
    write_campaign(small_campaign(), tmp_path / f"good{suffix}")
    good = (tmp_path / f"good{suffix}").read_bytes()
    path = tmp_path / f"bad{suffix}"

    @settings(SHARED_FOLDER, max_examples={".csv": 200, ".csv.gz": 40}.get(suffix, 60))
    @given(MUTANTS)
    def check(changes: list[tuple[str, int, int, bytes]]) -> None:
        path.write_bytes(mutated(good, changes))
        try:
            campaign = read_campaign(path)
        except CampaignError as error:
            message = str(error)
        else:
            message = ", ".join(campaign.outputs)
        assert message
        assert "\n" not in message

    check()


MEASURED = {
    "fog_rate_temperature/campaign.csv.gz": {"rate": "rad/s", "temperature": "degC", "output": "count"},
    "fog_closed_loop_ramp/campaign.csv.gz": {"output": "nrad/s", "feedback_ramp": "count"},
    "mems_multiposition_a/campaign.csv.gz": {"output_x": "count", "acceleration_z": "count"},
    "mems_multiposition_b/unit1.csv.gz": {"output_x": "rad/s", "acceleration_x": "m/s^2"},
    "mems_multiposition_b/unit2.csv.gz": {"output_y": "rad/s"},
    "mems_multiposition_b/unit3.csv.gz": {"output_z": "rad/s"},
    "rlg_static/campaign.csv.gz": {"output_x": "deg/s"},
    "mems_attitude/01_undisturbed_slow_rotation_A.csv.gz": {"output_x": "rad/s", "attitude_w": ""},
    "mems_attitude/06_undisturbed_fast_rotation_A.csv.gz": {"output_x": "rad/s", "attitude_w": ""},
    "mems_attitude/TStick_Test02_Trial1.csv.gz": {"output_x": "rad/s", "attitude_w": ""},
    "mems_attitude/TStick_Test04_Trial2.csv.gz": {"output_x": "rad/s", "attitude_w": ""},
    "mems_static_long/run1.nc": {"output_x": "deg/s"},
    "mems_static_long/run2.nc": {"output_z": "deg/s"},
}


@pytest.mark.parametrize("name", MEASURED)
def test_measured_data_load(measured_data: Callable[[str], Path], name: str):
    path = measured_data(name)
    campaign = read_campaign(path)
    assert {key: campaign.units[key] for key in MEASURED[name]} == MEASURED[name]
    assert campaign.metadata["kind"] == "rate"
    if path.suffix == ".gz":
        with gzip.open(path, "rt") as text:
            lines = [line for line in text if not line.startswith("#")]
        assert len(campaign) == len(lines) - 1
        np.testing.assert_array_equal(
            [values[-1] for values in campaign.columns.values()],
            [float(field or "nan") for field in lines[-1].split(",")],
        )
    else:
        # 10 000 s at 100 Hz in steps of 0.05 deg/s, as the list of the data says.
        assert len(campaign) == 1_000_000
        steps = campaign.columns["output_x"] / 0.05
        np.testing.assert_allclose(steps, np.round(steps), atol=1e-9)


def test_chunks_of_zeros_that_a_writer_left_out_are_zeros(tmp_path: Path):
    """As xarray writes whole numbers; a missing chunk of values with fractions is damage."""
    import xarray as xr

    columns = {"time": ("s", np.arange(5.0)), "run": ("1", np.zeros(5, int)), "output": ("deg/s", np.arange(5.0))}
    data = {name: ("time", values, {"units": unit}) for name, (unit, values) in columns.items()}
    path = tmp_path / "a.zarr"
    xr.Dataset(data, attrs={"kind": "rate"}).to_zarr(path, consolidated=False)
    assert not (path / "run" / "c").exists()
    assert not read_campaign(path).columns["run"].any()
    shutil.rmtree(path / "output" / "c")
    with pytest.raises(CampaignError, match="'output' lacks 1 of 1 chunks"):
        read_campaign(path)


def test_times_since_a_date_are_times(tmp_path: Path):
    import xarray as xr

    dates = np.datetime64("2026-01-01T00:00:00", "ns") + np.arange(5) * np.timedelta64(500, "ms")
    data = {"output": ("time", np.arange(5.0), {"units": "deg/s"})}
    xr.Dataset(data, coords={"time": dates}, attrs={"kind": "rate"}).to_netcdf(tmp_path / "a.nc", engine="h5netcdf")
    campaign = read_campaign(tmp_path / "a.nc")
    assert campaign.units["time"] == "ms"
    assert np.diff(campaign.si("time")) == pytest.approx(0.5)


def test_a_zarr_folder_of_another_name_keeps_all_of_it(tmp_path: Path):
    write_campaign(small_campaign(), tmp_path / "z.zarr")
    (tmp_path / "z.zarr").rename(tmp_path / "z.zarr.old")
    assert read_campaign(tmp_path / "z.zarr.old").name == "z.zarr.old"


@pytest.mark.parametrize("key", ["NAME", "CLASS", "REFERENCE_LIST", "DIMENSION_LIST"])
def test_metadata_that_hdf5_keeps_for_itself_is_named(tmp_path: Path, key: str):
    campaign = small_campaign().with_metadata({key: "north"})
    with pytest.raises(CampaignError, match=f"a.nc: .*'{key}'"):
        write_campaign(campaign, tmp_path / "a.nc")
    assert os.listdir(tmp_path) == []
    for suffix in set(FORMATS) - {".nc"}:
        write_campaign(campaign, tmp_path / f"a{suffix}")
        assert read_campaign(tmp_path / f"a{suffix}").metadata[key] == "north"
