"""Campaign checks and methods; expected values are written out by hand, Allan slopes follow from the noise drawn."""

from __future__ import annotations

import copy
import pickle
import subprocess
import sys
from typing import Any

import numpy as np
import pytest

from gyromodel._checks import CampaignError, check_time, short_time_slope
from gyromodel.campaign import Campaign
from tests.helpers import COLUMNS, METADATA, UNITS, small_campaign

NAN = float("nan")


def test_contents():
    campaign = small_campaign()
    assert len(campaign) == 6
    assert campaign.outputs == ("output",)
    assert campaign.covariates == ("rate", "temperature")
    assert all(values.dtype == np.float64 for values in campaign.columns.values())
    assert dict(campaign.units) == UNITS
    assert dict(campaign.metadata) == METADATA


def test_time_comes_first():
    columns = {name: COLUMNS[name] for name in ("output", "time", "rate", "temperature")}
    assert list(Campaign(columns, UNITS, METADATA).columns) == ["time", "output", "rate", "temperature"]


def test_nothing_can_be_changed_and_the_callers_arrays_stay_theirs():
    output = COLUMNS["output"].copy()
    campaign = small_campaign({"output": output})
    output[0] = 99.0
    assert campaign.columns["output"][0] == 3.0
    with pytest.raises(ValueError, match="read-only"):
        campaign.columns["output"][0] = 1.0
    for mapping in (campaign.columns, campaign.units, campaign.metadata):
        with pytest.raises(TypeError):
            mapping["new"] = 1  # type: ignore[index]
    with pytest.raises(AttributeError):
        campaign.name = "other"  # type: ignore[misc]


@pytest.mark.parametrize("dtype", [np.int16, np.uint8, np.float32, bool])
def test_other_numbers_become_float64(dtype: type):
    values = np.array([0, 1, 2, 3, 4, 5]).astype(dtype)
    column = small_campaign({"flag": values}, {"flag": ""}).columns["flag"]
    assert column.dtype == np.float64
    assert (column == values).all()


def test_a_masked_value_is_missing():
    values = np.ma.masked_equal([1, 2, 3, -99, 5, 6], -99)
    assert np.isnan(small_campaign({"extra": values}, {"extra": "V"}).columns["extra"]).tolist() == [0, 0, 0, 1, 0, 0]


def test_internal_and_other_units():
    campaign = small_campaign({"pressure": np.arange(6.0)}, {"pressure": "kPa"})
    assert campaign.si("pressure").tolist() == [0, 1000, 2000, 3000, 4000, 5000]
    assert campaign.si("rate")[1] == pytest.approx(10 * np.pi / 180)
    assert campaign.in_unit("temperature", "K")[0] == pytest.approx(298.15)
    assert (campaign.in_unit("rate", "deg/s") == COLUMNS["rate"]).all()
    with pytest.raises(CampaignError, match=r"column 'rate' is in \[deg/s\], which does not convert to \[degC\]"):
        campaign.in_unit("rate", "degC")
    with pytest.raises(CampaignError, match="no column 'humidity': found time, rate"):
        campaign.si("humidity")


def test_columns_come_and_go():
    campaign = small_campaign()
    longer = campaign.with_column("supply_voltage", [5, 5, 5, 5, 5, 5.1], "V")
    assert longer.covariates == ("rate", "temperature", "supply_voltage")
    assert longer.without("supply_voltage").equals(campaign)
    replaced = campaign.with_column("rate", np.zeros(6), "rad/s")
    assert list(replaced.columns) == list(campaign.columns)
    assert replaced.units["rate"] == "rad/s"
    with pytest.raises(CampaignError, match="column 'x' has 2 rows and 'time' has 6"):
        campaign.with_column("x", [1, 2], "")
    with pytest.raises(CampaignError, match=r"column 'rate' has unit \[V\]"):
        campaign.with_column("rate", np.zeros(6), "V")


def test_select_rows():
    campaign = small_campaign()
    assert campaign.select(campaign.columns["rate"] > 5).columns["rate"].tolist() == [10, 20]
    assert campaign.select(slice(2, 4)).columns["time"].tolist() == [0.2, 0.3]
    assert campaign.select(np.array([0, 5])).columns["time"].tolist() == [0, 0.5]
    # A part at rest may be constant, or too short for a fit of its own.
    assert len(campaign.select(slice(0, 1))) == 1


def three_axes() -> Campaign:
    columns = {"time": np.arange(4.0)}
    for k, name in enumerate(
        ["output_x", "output_y", "output_z", "rate_x", "rate_y", "acceleration_x", "temperature_y"]
    ):
        columns[name] = np.arange(4.0) + 10 * k
    units = dict.fromkeys(columns, "deg/s") | {"time": "s", "acceleration_x": "g", "temperature_y": "degC"}
    return Campaign(columns, units, {"kind": "rate"}, "imu")


def test_one_axis_of_three():
    campaign = three_axes()
    assert campaign.outputs == ("output_x", "output_y", "output_z")
    y = campaign.axis("y")
    assert y.outputs == ("output",)
    assert y.covariates == ("rate_x", "rate", "acceleration_x", "temperature")
    assert (y.columns["output"] == campaign.columns["output_y"]).all()
    assert (y.columns["rate"] == campaign.columns["rate_y"]).all()
    assert y.name == "imu_y"
    assert campaign.axis("z").covariates == ("rate_x", "rate_y", "acceleration_x", "temperature_y")


def test_an_axis_that_is_not_there():
    with pytest.raises(CampaignError, match="no axis 'x': the outputs are output"):
        small_campaign().axis("x")
    with pytest.raises(CampaignError, match="no axis 'w'"):
        three_axes().axis("w")
    with pytest.raises(CampaignError, match="both 'rate' and 'rate_x'"):
        three_axes().with_column("rate", np.zeros(4), "deg/s").axis("x")


def test_gaps():
    time = np.array([0, 100, 200, 1200, 1300, 1449.0])
    campaign = small_campaign({"time": time}, {"time": "ms"})
    assert campaign.gaps() == [(3, pytest.approx(1.0))]
    assert campaign.select([0]).gaps() == []


def test_digest_sees_every_part():
    campaign = small_campaign()
    others = [
        small_campaign({"output": np.nextafter(COLUMNS["output"], np.inf)}),
        small_campaign({"temperature": np.abs(COLUMNS["temperature"])}),  # only the sign of zero differs
        small_campaign(units={"rate": "deg/h"}),
        small_campaign(serial="7"),
        small_campaign(serial=7),
        small_campaign(run_number=7.0),
        small_campaign(drift=None),
        campaign.without("temperature"),
        Campaign({n: COLUMNS[n] for n in ("time", "temperature", "rate", "output")}, UNITS, METADATA),
    ]
    assert len({campaign.digest(), *(other.digest() for other in others)}) == 10
    assert not any(campaign.equals(other) for other in others)


def test_digest_is_the_same_everywhere():
    """A fixed value, so that hashes in stored results stay comparable between versions and machines."""
    assert small_campaign().digest().startswith("a9d47d37f8037fe8")
    payload = COLUMNS["output"].copy()
    payload.view(np.uint64)[4] ^= 1  # another bit pattern of the missing value
    assert np.isnan(payload[4])
    assert small_campaign({"output": payload}).equals(small_campaign())
    shuffled = Campaign(COLUMNS, UNITS, dict(reversed(METADATA.items())), "another name")
    assert shuffled.equals(small_campaign())


def test_copies_and_pickles():
    part = small_campaign().select(slice(0, 1))
    for other in (pickle.loads(pickle.dumps(part)), copy.deepcopy(part)):
        assert other.equals(part)
        assert other.name == "small"
        assert not other.columns["rate"].flags.writeable


def test_a_campaign_is_no_key():
    with pytest.raises(TypeError, match="unhashable"):
        hash(small_campaign())


@pytest.mark.parametrize(
    ("columns", "units", "message"),
    [
        ({"time": [0, 0.1, 0.2, 0.2, 0.4, 0.5]}, {}, r"0\.2 at data row 3 and 0\.2 at data row 4 \(row 1 is the first"),
        ({"time": [0, 0.1, 0.2, 0.1, 0.4, 0.5]}, {}, r"is 0\.2 at data row 3 and 0\.1 at data row 4"),
        ({"time": [0, 1e-320, 0.2, 0.3, 0.4, 0.5]}, {}, "is 0.0 at data row 1 and 1e-320 at data row 2"),
        ({"time": [0, 0.1, NAN, 0.3, 0.4, 0.5]}, {}, "column 'time' is nan at data row 3"),
        ({"time": [0, 0.1, 0.2, 0.3, 0.4, np.inf]}, {}, "column 'time' is inf at data row 6"),
        ({"rate": [0, 1, 2, np.inf, 4, 5]}, {}, "column 'rate' has an infinite value at data row 4"),
        ({"output": [5.0, 5, 5, NAN, 5, 5]}, {}, r"column 'output' is 5\.0 in every row"),
        ({"output": [NAN] * 6}, {}, "column 'output' has no value"),
        ({"x": ["a"] * 6}, {"x": ""}, "column 'x' is no row of numbers"),
        ({"x": np.zeros((6, 2))}, {"x": ""}, r"column 'x' is no row of numbers: found float64 of shape \(6, 2\)"),
        ({"x": [1j] * 6}, {"x": ""}, "column 'x' is no row of numbers: found complex128"),
        ({"x": [1.0]}, {"x": ""}, "column 'x' has 1 rows and 'time' has 6"),
        (
            {"x": [1.0] * 6},
            {},
            r"column 'x' has no unit: write 'x \[unit\]' \(accepted: s, ms,.*\[\] for dimensionless",
        ),
        ({}, {"x": "V"}, "units for columns that do not exist: x"),
        ({"x": [1.0] * 6}, {"x": "furlong"}, "column 'x': unknown unit 'furlong' .accepted: s, ms"),
        ({}, {"time": "deg"}, r"column 'time' has unit \[deg\], expected a time, such as s, ms"),
        ({}, {"rate": "Hz"}, r"column 'rate' has unit \[Hz\], expected an angular rate, such as deg/s"),
        ({}, {"temperature": "V"}, r"column 'temperature' has unit \[V\], expected a temperature, such as degC, K"),
        (
            {"temperature_coil": [1] * 6},
            {"temperature_coil": ""},
            "'temperature_coil' has unit .., expected a temperature",
        ),
        ({"pressure": [1] * 6}, {"pressure": "T"}, "column 'pressure' has unit .T., expected a pressure"),
        ({"segment": [1] * 6}, {"segment": "s"}, "column 'segment' has unit .s., expected a plain number"),
        (
            {},
            {"output": ""},
            r"column 'output' has unit \[\], expected one such as deg/s.* and \[count\] for raw numbers",
        ),
        (
            {},
            {"output": "deg"},
            r"'output' is in \[deg\], which is no rate: metadata 'kind' must be increment or angle",
        ),
        ({"output_x": [1, 2, 3, 4, 5, 6]}, {"output_x": "V"}, "either 'output' or axes, not both"),
        ({"a,b": [1] * 6}, {"a,b": ""}, "'a,b' cannot name a column"),
        ({"_a": [1] * 6}, {"_a": ""}, "'_a' cannot name a column"),
        ({"run [[]]": [1] * 6}, {"run [[]]": ""}, r"; write 'run \[\]'"),
        ({"temp[C] x": [1] * 6}, {"temp[C] x": "1"}, r"none of \[ \] , ; \" / \\$"),
        ({"heat[earlier]": [1] * 6}, {"heat[earlier]": "1"}, r"none of \[ \] , ; \" / \\$"),
        ({"a ": [1] * 6}, {"a ": ""}, "'a ' cannot name a column"),
        ({"\ud800": [1] * 6}, {"\ud800": ""}, "cannot name a column"),
        ({"é" * 101: [1] * 6}, {"é" * 101: ""}, "cannot name a column"),
    ],
)
def test_what_is_refused(columns: dict[str, Any], units: dict[str, str], message: str):
    with pytest.raises(CampaignError, match=message) as caught:
        small_campaign({name: np.asarray(values) for name, values in columns.items()}, units)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("metadata", "message"),
    [
        ({"kind": "speed"}, "metadata 'kind' is 'speed', expected rate, increment or angle"),
        ({"kind": "angle", "rate_frame": "ecef"}, "'rate_frame' is 'ecef', expected table or inertial"),
        ({"latitude_deg": "north"}, "'latitude_deg' is 'north'"),
        ({"latitude_deg": 91}, "'latitude_deg' is '91'"),
        ({"a:b": 1}, "'a:b' cannot be a metadata key"),
        ({"": 1}, "'' cannot be a metadata key"),
        ({"x": float("inf")}, "metadata 'x' is inf"),
        ({"x": 2**63}, "metadata 'x' is 9223372036854775808"),
        ({"x": "a\0"}, "metadata 'x' is longer than 10000 characters or no plain text"),
        ({"x": "a" * 10_001}, "metadata 'x' is longer"),
        ({"x": True}, "metadata 'x' is a bool"),
    ],
)
def test_metadata_that_is_refused(metadata: dict[str, Any], message: str):
    with pytest.raises(CampaignError, match=message):
        small_campaign(**metadata)


def test_missing_columns_and_rows():
    with pytest.raises(CampaignError, match=r"no column 'time \[s\]': found t, output"):
        Campaign({"t": np.arange(3.0), "output": np.arange(3.0)}, {"t": "s", "output": "count"}, {"kind": "rate"})
    with pytest.raises(CampaignError, match=r"no column 'output' \(or 'output_x', .*\): found time, rate"):
        Campaign({"time": np.arange(3.0), "rate": np.arange(3.0)}, {"time": "s", "rate": "deg/s"}, {"kind": "rate"})
    with pytest.raises(CampaignError, match="2 rows of data, and at least 3 are needed"):
        Campaign({"time": np.arange(2.0), "output": np.arange(2.0)}, {"time": "s", "output": "count"}, {"kind": "rate"})


@pytest.mark.parametrize(
    ("name", "unit"),
    [
        ("rate_spin", "rpm"),
        ("temperature_coil", "degF"),
        ("thermistor_resistance", "kohm"),
        ("acceleration_z", "count"),
        ("acceleration_input", "mg"),
        ("magnetic_field", "nT"),
        ("supply_voltage", "mV"),
        ("pressure", "psi"),
        ("table_angle", "deg"),
        ("gimbal_outer", "rad"),
        ("azimuth", "deg"),
        ("feedback_ramp", "count"),
        ("attitude_w", ""),
        ("position", "1"),
        ("anything else", "V/g"),
        ("laser current", "mA"),
    ],
)
def test_known_columns_in_usual_units(name: str, unit: str):
    assert name in small_campaign({name: np.arange(6.0)}, {name: unit}).covariates


@pytest.mark.parametrize(
    ("unit", "kinds"),
    [
        ("deg/s", {"rate"}),
        ("count/s", {"rate"}),
        ("bit/s", {"rate"}),
        ("deg", {"increment", "angle"}),
        ("count", {"rate", "increment", "angle"}),
        ("V", {"rate", "increment", "angle"}),
    ],
)
def test_output_unit_and_kind_agree(unit: str, kinds: set[str]):
    for kind in ("rate", "increment", "angle"):
        if kind in kinds:
            small_campaign(units={"output": unit}, kind=kind)
        else:
            with pytest.raises(CampaignError, match="'kind' must be"):
                small_campaign(units={"output": unit}, kind=kind)


def advice(values: np.ndarray, unit: str) -> str:
    time = np.arange(len(values)) * 0.01
    with pytest.raises(CampaignError, match="metadata 'kind' is missing and not assumed") as caught:
        Campaign({"time": time, "output": values}, {"time": "s", "output": unit}, {})
    return str(caught.value)


def test_missing_kind_says_what_the_data_look_like(rng: np.random.Generator):
    white = rng.normal(size=4000)
    white[5:9] = NAN
    summed = np.nancumsum(white)
    assert "add the line '# kind: rate' or '# kind: increment' (" in advice(white, "count")
    assert "which a slope cannot tell apart" in advice(white, "count")
    assert "its unit [deg/s] allows rate only; add the line '# kind: rate' (" in advice(white, "deg/s")
    assert "add the line '# kind: increment' (" in advice(white, "arcsec")
    assert "add the line '# kind: angle' (" in advice(summed, "count")
    assert "add the line '# kind: angle' (" in advice(summed, "deg")
    assert "a turning gyro" in advice(summed, "deg/s")
    assert "add the line '# kind: rate' (" in advice(summed, "deg/s")
    assert "too few values" in advice(white[:5], "count")


def test_short_time_slope_of_known_noise(rng: np.random.Generator):
    """Allan deviation of white noise falls as τ^-1/2, of its differences as τ^-1; a sampled random walk rises as
    sqrt((2 m^2 + 1) / (6 m)) over averages of m samples, whose fitted slope from 1 to 8 is +0.41."""
    white = rng.normal(size=200_000)
    lengths = np.array([1, 2, 4, 8])
    walk = np.polyfit(np.log(lengths), np.log(np.sqrt((2 * lengths**2 + 1) / (6 * lengths))), 1)[0]
    assert short_time_slope(white) == pytest.approx(-0.5, abs=0.03)
    assert short_time_slope(np.diff(white)) == pytest.approx(-1.0, abs=0.03)
    assert short_time_slope(np.cumsum(white)) == pytest.approx(walk, abs=0.03)
    assert short_time_slope(np.arange(1000.0)) == pytest.approx(1.0)
    assert short_time_slope(1e308 * (white / np.abs(white).max())) == pytest.approx(-0.5, abs=0.03)
    assert short_time_slope(np.full(100, NAN)) is None
    assert short_time_slope(np.zeros(100)) is None


def test_time_is_checked_across_parts():
    check_time(np.array([3.0, 4.0]), 11, 2.0)
    with pytest.raises(CampaignError, match=r"3\.0 at data row 10 and 3\.0 at data row 11"):
        check_time(np.array([3.0, 4.0]), 11, 3.0)


def test_importing_loads_nothing_heavy():
    code = (
        "import sys, gyromodel.campaign, gyromodel.files, gyromodel.units;"
        "print(sorted({'jax', 'pint', 'pandas', 'pyarrow', 'xarray', 'zarr', 'h5py', 'scipy'} & set(sys.modules)))"
    )
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "[]"
