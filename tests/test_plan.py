"""Planned campaigns: values computed by hand from the plan."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gyromodel._checks import CampaignError
from gyromodel.campaign import Campaign
from gyromodel.plan import read_plan

HEAD = "gyro: fog\nkind: rate\nduration: 1 min\ninterval: 10 s\noutput: count/s\ncolumns:\n"


def planned(folder: Path, columns: str) -> Campaign:
    (folder / "plan.yaml").write_text(HEAD + columns, encoding="utf-8")
    return read_plan(folder / "plan.yaml")


def test_columns_follow_their_segments(tmp_path: Path):
    campaign = planned(
        tmp_path,
        "  rate: -3.5 deg/s\n"
        "  temperature: [{for: 20 s, at: 20 degC}, {for: 20 s, to: 313.15 K}]\n"
        "  pressure: [{repeat: 2, segments: [{for: 10 s, at: 1 kPa}, {for: 10 s, from: 0 Pa, to: 500 Pa}]}]\n",
    )
    assert campaign.columns["time"].tolist() == [0, 10, 20, 30, 40, 50]
    assert campaign.columns["rate"].tolist() == [-3.5] * 6
    assert campaign.columns["temperature"] == pytest.approx([20, 20, 20, 30, 40, 40])
    assert campaign.columns["pressure"] == pytest.approx([1, 0, 1, 0, 0.5, 0.5])
    assert dict(campaign.units) == {
        "time": "s", "rate": "deg/s", "temperature": "degC", "pressure": "kPa", "output": "count/s"
    }  # fmt: skip
    assert campaign.metadata == {"gyro": "fog", "kind": "rate"}
    assert np.isnan(campaign.columns["output"]).all()


def test_a_sample_at_a_segment_end_belongs_to_the_next_segment(tmp_path: Path):
    """Sums of 0.1 s are not exact in binary."""
    segments = ", ".join(f"{{for: 0.1 s, at: {level} deg/s}}" for level in range(30))
    text = HEAD.replace("1 min", "3 s").replace("10 s", "0.1 s") + f"  rate: [{segments}]\n"
    (tmp_path / "plan.yaml").write_text(text, encoding="utf-8")
    assert read_plan(tmp_path / "plan.yaml").columns["rate"].tolist() == list(range(30))


def test_repeats_end_with_the_plan_and_names_may_be_numbers(tmp_path: Path):
    course = "[{repeat: 1000000000, segments: [{for: 10 s, at: 1 deg/s}, {for: 10 s, at: 2 deg/s}]}]"
    campaign = planned(tmp_path, f"  rate: {course}\n  1: 3 V\n")
    assert campaign.columns["rate"].tolist() == [1, 2, 1, 2, 1, 2]
    assert campaign.units["1"] == "V"


@pytest.mark.parametrize("date", ["2024-05-01", "2024-02-30"])
def test_dates_are_text(tmp_path: Path, date: str):
    (tmp_path / "plan.yaml").write_text(f"date: {date}\n{HEAD}  rate: 1 deg/s\n", encoding="utf-8")
    assert read_plan(tmp_path / "plan.yaml").metadata["date"] == date


@pytest.mark.parametrize(
    ("columns", "expected"),
    [
        ("  temperature: [{for: 1 s, to: 20 degC}]\n", "segment 1: the first ramp needs"),
        ("  temperature: [{for: 1 s, at: 20 degC}, {at: 3 degC}]\n", "segment 2: expected"),
        ("  temperature: [{for: 1 s, at: 20 degC, from: 3 degC}]\n", "unknown key from"),
        ("  temperature: [{for: 1 s, at: 20 degC}, {for: 1 s, at: 3 V}]\n", "3 V is not in a unit like degC"),
        ("  temperature: [{for: 3 m, at: 20 degC}]\n", "expected a time above zero"),
        ("  temperature: [{for: -3 s, at: 20 degC}]\n", "expected a time above zero"),
        ("  temperature: []\n", "no segments"),
        ("  temperature: [{repeat: 0, segments: []}]\n", "repeat needs a whole number"),
        ("  temperature: [{repeat: 2, segments: []}]\n", "repeat needs a whole number"),
        ("  temperature: warm\n", "column temperature: 'warm' is no quantity"),
        ("  - rate\n", "columns must map"),
    ],
)
def test_mistakes_are_named_where_they_are(tmp_path: Path, columns: str, expected: str):
    with pytest.raises(CampaignError, match=r"plan\.yaml") as caught:
        planned(tmp_path, columns)
    assert expected in str(caught.value)


def test_no_key_is_given_twice(tmp_path: Path):
    with pytest.raises(CampaignError, match=r"plan\.yaml: 'rate' appears twice in what begins in line 7"):
        planned(tmp_path, "  rate: 5 deg/s\n  rate: 0 deg/s\n")


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", "missing: columns, duration, interval, kind, output"),
        (HEAD.replace("kind: rate\n", ""), "missing: kind"),
        (HEAD.replace("duration: 1 min\n", ""), "missing: duration"),
        (HEAD.replace("10 s", "1e-9 s") + "  rate: 0 deg/s\n", "samples"),
        ("a: [", "is no YAML file"),
    ],
)
def test_a_plan_needs_its_keys(tmp_path: Path, text: str, expected: str):
    (tmp_path / "plan.yaml").write_text(text, encoding="utf-8")
    with pytest.raises(CampaignError, match=r"plan\.yaml") as caught:
        read_plan(tmp_path / "plan.yaml")
    assert expected in str(caught.value)
