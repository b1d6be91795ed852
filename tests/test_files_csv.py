"""CSV campaigns: expected values are what the text says, read by eye."""

from __future__ import annotations

import gzip
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings

import gyromodel._csv
from gyromodel._checks import CampaignError
from gyromodel.campaign import LARGEST, Campaign
from gyromodel.files import read_campaign, write_campaign
from tests.helpers import MUTANTS, SHARED_FOLDER, mutated, small_campaign

LINES = "# gyro: fog\n# kind: rate\ntime [s],rate [deg/s],output [count]\n0,0,1\n1,0.5,2\n2,,nan\n3,1e1,-8\n"


def read_text(folder: Path, text: str | bytes, name: str = "a.csv") -> Campaign:
    (folder / name).write_bytes(text if isinstance(text, bytes) else text.encode())
    return read_campaign(folder / name)


@pytest.mark.parametrize(
    "text",
    [
        LINES,
        LINES.replace("\n", "\r\n"),
        "\ufeff" + LINES,
        LINES.rstrip("\n"),
        LINES + "\n\n",
        LINES.replace("1,0.5", " \t\n1,0.5") + "  \n",
        LINES.replace("# kind: rate\n", "# a comment\n#kind:rate\n\n"),
        LINES.replace(",", " , "),
        LINES.replace("nan", "NA").replace(",,", ",null,"),
        LINES.replace("1e1", "+10.0"),
        LINES.replace("1e1", '"10"').replace("rate [deg/s]", '"rate [deg/s]"'),
        LINES.replace("[deg/s]", " [ deg/s ] "),
    ],
)
def test_csv_as_others_write_it(tmp_path: Path, text: str):
    campaign = read_text(tmp_path, text)
    assert dict(campaign.metadata) == {"gyro": "fog", "kind": "rate"}
    assert dict(campaign.units) == {"time": "s", "rate": "deg/s", "output": "count"}
    np.testing.assert_array_equal(campaign.columns["time"], [0, 1, 2, 3])
    np.testing.assert_array_equal(campaign.columns["rate"], [0, 0.5, math.nan, 10])
    np.testing.assert_array_equal(campaign.columns["output"], [1, 2, math.nan, -8])
    assert campaign.name == "a"


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("7", 7), ("-7", -7), ("7.0", 7.0), ("1e3", 1000.0), ("51.08", 51.08), ("007", "007"), ('"7"', "7"), ("", ""),
        ("nominal: 18 s", "nominal: 18 s"), ("nan", "nan"), ("9" * 5000, "9" * 5000), ("1e999", "1e999"),
        ('"open', '"open'),
    ],
)  # fmt: skip
def test_metadata_values(tmp_path: Path, text: str, value: Any):
    found = read_text(tmp_path, f"# note: {text}\n{LINES}").metadata["note"]
    assert found == value
    assert type(found) is type(value)


@pytest.mark.parametrize(
    ("text", "value"), [("1.10", "1.10"), ("12E4", "12E4"), ("1.1", 1.1), ("12", 12), ('"12"', "12"), ("007", "007")]
)
def test_serials_stay_as_they_are_written(tmp_path: Path, text: str, value: Any):
    campaign = read_text(tmp_path, f"# serial: {text}\n{LINES}")
    for name in ("b.csv", "b.parquet"):
        write_campaign(campaign, tmp_path / name)
        again = read_campaign(tmp_path / name).metadata["serial"]
        assert campaign.metadata["serial"] == again == value
        assert type(again) is type(value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "the file is empty"),
        ("# kind: rate\n", r"no header line 'time \[s\],...'"),
        ("0,1,2\n1,2,3\n", "line 1 holds numbers where the header"),
        (LINES[: LINES.index("0,0")], "a header and no row of data"),
        (LINES[: LINES.index("2,,")], "2 rows of data, and at least 3 are needed"),
        (LINES.replace(",", ";"), "line 3 has no comma: columns are separated by commas"),
        (
            LINES.replace("rate [deg/s]", "rate"),
            r"column 'rate' has no unit: write 'rate \[deg/s\]' .accepted: an angular",
        ),
        (LINES.replace("rate [deg/s]", "run"), r"column 'run' has no unit: write 'run \[\]' .accepted: a plain number"),
        (LINES.replace("rate [deg/s]", "rate [furlong]"), r"column 'rate': unknown unit 'furlong' \(accepted: s, ms"),
        (LINES.replace("rate [deg/s]", "[deg/s]"), "column 2 has no name in the header"),
        (LINES.replace("rate [deg/s]", "output [V]"), "two columns are named 'output': column 2 and 3"),
        (LINES.replace("time [s]", "t [s]"), r"no column 'time \[s\]': found 't, rate, output'"),
        (LINES.replace("time [s]", '"time [s]'), "line 3 is no CSV header"),
        ("# gyro: rlg\n" + LINES, "metadata 'gyro' is given twice, the second time in line 2"),
        (
            LINES.replace("# gyro: fog\n# kind: rate\n", ""),
            "metadata 'kind' is missing and not assumed: there are too few",
        ),
        (LINES.replace("1,0.5,2", "1,fast,2"), "column 'rate' is 'fast' at data row 2, expected a number"),
        (LINES.replace("1,0.5,2", "1,0x10,2"), "column 'rate' is '0x10' at data row 2"),
        (LINES.replace("1,0.5,2", "1,1_0,2"), "column 'rate' is '1_0' at data row 2"),
        (LINES.replace("1,0.5,2", "1,0.5"), "data row 2 has 2 fields and the header has 3"),
        (LINES.replace("1,0.5,2", "1,0,5,2"), "data row 2 has 4 fields and the header has 3"),
        (LINES.replace("1,0.5,2", "1,inf,2"), "column 'rate' has an infinite value at data row 2"),
        (LINES.replace("1,0.5,2", "1,1e999,2"), "column 'rate' has an infinite value at data row 2"),
        (LINES.replace("1,0.5,2", ",0.5,2"), "column 'time' is nan at data row 2"),
        (LINES.replace("1,0.5,2", "0,0.5,2"), r"0\.0 at data row 1 and 0\.0 at data row 2"),
        (LINES.replace("1,0.5,2", "# later"), "data row 2 has 1 fields"),
        (LINES.replace("fog", "föг").encode("utf-16"), r"line 1 is not UTF-8 text: b'\\xff"),
        (LINES.replace("[deg/s]", "[°/s]").encode("latin-1"), r"line 3 is not UTF-8 text: b'\\xb0/s"),
        (LINES.encode().replace(b"0.5", b"\xff5"), r"column 'rate' is '.*xff5' at data row 2"),
        (LINES.encode() + b"\0" * 100, "data row 5 has 1 fields"),
        (LINES + "4,1,2,3,4\n" * 3, "data row 5 has 5 fields"),
        (LINES.replace("0.5", "5" * 200_000), "data row 2 is no CSV line|infinite value at data row 2"),
    ],
)
def test_csv_that_is_refused(tmp_path: Path, text: str | bytes, message: str):
    with pytest.raises(CampaignError, match=message) as caught:
        read_text(tmp_path, text)
    assert str(caught.value).startswith(f"{tmp_path / 'a.csv'}: ")
    assert "\n" not in str(caught.value)


def test_rows_are_counted_over_blocks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Blocks of a few lines, so that faults, quoted numbers and steps in time lie in later ones."""
    monkeypatch.setattr("gyromodel._csv._BLOCK", 64)
    rows = [f"{i},{i % 7}.25,{i * i}" for i in range(200)]
    head = LINES[: LINES.index("0,0")]
    campaign = read_text(tmp_path, head + "\n".join(rows))
    np.testing.assert_array_equal(campaign.columns["output"], np.arange(200.0) ** 2)
    assert read_text(tmp_path, head + "\n".join(rows).replace("150,", '"150",')).equals(campaign)
    with pytest.raises(CampaignError, match="column 'rate' is 'x' at data row 151"):
        read_text(tmp_path, head + "\n".join(rows).replace("150,3.25", "150,x"))
    for i in range(1, 200):
        with pytest.raises(CampaignError, match=rf"{i - 1}\.0 at data row {i} and {i - 1}\.0 at data row {i + 1} "):
            read_text(tmp_path, head + "\n".join([*rows[:i], f"{i - 1},0,0", *rows[i + 1 :]]))


@pytest.mark.parametrize("line", [b"\0" * 6, b"0,0,0\n", b"\n"])
def test_a_huge_file_that_is_no_campaign_is_refused_early(tmp_path: Path, line: bytes, monkeypatch: pytest.MonkeyPatch):
    """2 GiB, sparse where the content allows; what is read of it is counted."""
    path = tmp_path / "huge.csv"
    with open(path, "wb") as file:
        file.write(LINES[: LINES.index("0,0")].encode())
        if line == b"\0" * 6:
            file.truncate(2 << 30)
        else:
            file.write(line * (40 << 20 if line == b"\n" else 10 << 20))
    parsed = []
    parse = gyromodel._csv._parse_block
    monkeypatch.setattr(
        "gyromodel._csv._parse_block", lambda block, *rest: parsed.append(len(block)) or parse(block, *rest)
    )
    with pytest.raises(CampaignError, match=r"longer than 1 MiB|must increase|no row of data"):
        read_campaign(path)
    assert sum(parsed) <= 9 << 20
    path.unlink()


def test_a_head_that_never_ends(tmp_path: Path):
    with open(tmp_path / "a.csv", "wb") as file:
        file.truncate(2 << 30)
    with pytest.raises(CampaignError, match="the header does not end within 16 MiB"):
        read_campaign(tmp_path / "a.csv")
    (tmp_path / "a.csv").unlink()


def test_csv_text(tmp_path: Path):
    write_campaign(small_campaign(), tmp_path / "a.csv")
    assert (tmp_path / "a.csv").read_text() == (
        '# gyro: fog\n# kind: rate\n# serial: 007\n# run_number: 7\n# drift: 2.0\n'
        "time [s],rate [deg/s],temperature [degC],output [count]\n"
        "0,0,25,3\n0.1,10,25.5,1003.25\n0.2,-10,nan,-997\n0.3,20,26.5,2003\n0.4,-20,27,nan\n"
        "0.5,0.3333333333333333,-0,1e-300\n"
    )  # fmt: skip


def test_the_same_campaign_gives_the_same_compressed_bytes(tmp_path: Path):
    for name in ("a.csv.gz", "b.csv.gz"):
        write_campaign(small_campaign(), tmp_path / name)
    assert (tmp_path / "a.csv.gz").read_bytes() == (tmp_path / "b.csv.gz").read_bytes()


def test_arrow_writes_the_digits_of_repr(tmp_path: Path, rng: np.random.Generator):
    output = rng.integers(0, 2**63, 1000, dtype=np.uint64).view(np.float64)
    output = output[np.abs(output) < LARGEST]
    columns = {"time": np.arange(float(len(output))), "output": output}
    write_campaign(Campaign(columns, {"time": "s", "output": "count"}, {"kind": "rate"}), tmp_path / "a.csv")
    written = [line.split(",")[1] for line in (tmp_path / "a.csv").read_text().splitlines()[2:]]
    assert [float(text) for text in written] == output.tolist()

    def digits(text: str) -> str:
        return text.split("e")[0].replace(".", "").strip("0")

    assert [digits(text) for text in written] == [digits(repr(value)) for value in output.tolist()]


def test_damaged_text_in_sound_gzip(tmp_path: Path):
    path = tmp_path / "bad.csv.gz"

    @settings(SHARED_FOLDER, max_examples=40)
    @given(MUTANTS)
    def check(changes: list[tuple[str, int, int, bytes]]) -> None:
        text = mutated(LINES.encode(), changes)
        path.write_bytes(gzip.compress(text))
        plain = tmp_path / "bad.csv"
        plain.write_bytes(text)
        results = []
        for file in (plain, path):
            try:
                results.append(read_campaign(file).digest())
            except CampaignError as error:
                results.append(str(error).removeprefix(str(file)))
        assert results[0] == results[1]

    check()
