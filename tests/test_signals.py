"""What effects see of a campaign, against the numbers it was made from: padding, derived columns, gaps and blocks, and
one rate output whatever the campaign recorded."""

from __future__ import annotations

import re

import numpy as np
import pytest

from gyromodel._checks import CampaignError
from gyromodel.campaign import Campaign
from gyromodel.numerics.smoothing import smooth_derivative
from gyromodel.signals import Record, padded_length, read_signals, with_columns_known, with_smooth_thermometers

ROWS, STEP = 256, 20.0


def campaign(
    time: np.ndarray, output: np.ndarray, unit: str = "deg/h", kind: str = "rate", **columns: np.ndarray
) -> Campaign:
    units = {"time": "s", "output": unit}
    units |= {name: {"temperature": "degC", "rate": "deg/s"}.get(name, "") for name in columns}
    return Campaign({"time": time, "output": output} | columns, units, {"kind": kind}, "test")


def output_of(record: Record) -> np.ndarray:
    """The output of the real rows, NaN where missing."""
    return np.where(record.present, np.asarray(record.signals["output"])[: record.rows], np.nan)


def test_padded_lengths_are_few_and_at_most_a_quarter_longer():
    lengths = np.array([padded_length(n) for n in range(1, 5000)])
    assert (lengths >= np.arange(1, 5000)).all()
    assert (np.diff(lengths) >= 0).all()
    assert (lengths[63:] < 1.25 * np.arange(64, 5000)).all()
    quarters = {m * 2**k for k in range(4, 11) for m in (4, 5, 6, 7, 8)}
    assert set(lengths[63:4096]) <= quarters
    assert set(lengths[4096:]) <= {4096 + 256 * m for m in range(17)}
    assert padded_length(10**6) == 31 * 2**15


@pytest.mark.parametrize("rows", [3, 63, 64, 65, 200, 256])
def test_padding_is_finite_and_missing(rows: int, rng: np.random.Generator):
    time = np.arange(rows) * STEP
    record = read_signals(campaign(time, rng.standard_normal(rows), rate=rng.standard_normal(rows)))
    total = padded_length(rows)
    assert record.rows == rows
    for values in (*record.signals.values(), *record.sampling):
        assert values.shape == (total,)
        assert np.isfinite(values).all()
    assert not np.asarray(record.sampling.present)[rows:].any()
    assert record.present.all()
    assert np.asarray(record.sampling.restart).sum() == 1
    assert record.interval == STEP
    assert len(record.blocks) == rows


def test_columns_are_in_internal_units_and_time_starts_at_zero(rng: np.random.Generator):
    time = 3.0 + np.arange(ROWS) / 60
    columns = {
        "time": time,
        "rate": rng.standard_normal(ROWS),
        "temperature": 300 + rng.standard_normal(ROWS),
        "pressure": rng.standard_normal(ROWS),
        "output_power": rng.standard_normal(ROWS),
        "output": rng.standard_normal(ROWS),
    }
    units = {
        "time": "h",
        "rate": "deg/h",
        "temperature": "K",
        "pressure": "kPa",
        "output_power": "W",
        "output": "deg/s",
    }
    measured = Campaign(columns, units, {"kind": "rate", "time_since_power_on": 90})
    record = read_signals(measured)
    signals = {k: np.asarray(v)[:ROWS] for k, v in record.signals.items()}
    assert signals["time"] == pytest.approx(np.arange(ROWS) * 60.0, abs=1e-9)
    assert signals["time_on"] == pytest.approx(90 + np.arange(ROWS) * 60.0, abs=1e-9)
    assert signals["rate"] == pytest.approx(np.deg2rad(columns["rate"]) / 3600)
    assert signals["temperature"] == pytest.approx(columns["temperature"] - 273.15)
    assert signals["pressure"] == pytest.approx(1000 * columns["pressure"])
    assert signals["output_power"] == pytest.approx(columns["output_power"])  # a column like any other
    assert signals["output"] == pytest.approx(np.deg2rad(columns["output"]))
    assert record.output_unit == "rad/s"
    assert record.units["pressure"] == "kPa"
    assert record.data_hash == measured.digest()


def test_a_run_behind_a_gap_begins_with_a_power_on():
    """Or so long after it as the metadata say; the fourth run follows the third without one."""
    columns = {"time": [0.0, 1.0, 50.0, 51.0, 52.0, 90.0, 91.0], "run": [1.0, 1.0, 2.0, 2.0, 2.0, 3.0, 4.0]}
    measured = {k: np.array(v) for k, v in columns.items()} | {"output": np.arange(7.0)}
    units, known = {"time": "min", "run": "", "output": "deg/s"}, {"kind": "rate", "time_since_power_on": 30}
    campaign = Campaign(measured, units, known)
    on = np.asarray(read_signals(campaign).signals["time_on"])[:7]
    assert on == pytest.approx([30.0, 90.0, 30.0, 90.0, 150.0, 30.0, 90.0])
    on = np.asarray(read_signals(campaign.without("run")).signals["time_on"])[:7]
    assert on == pytest.approx(60.0 * np.array(columns["time"]) + 30.0)


@pytest.mark.parametrize("interval", [0.1, 1 / 3, 0.3])
@pytest.mark.parametrize("rows", [7, 50, 333])
def test_a_missing_row_before_a_run_is_a_gap_however_time_is_rounded(interval: float, rows: int):
    kept = np.delete(np.arange(2 * rows + 1), rows)
    columns = {"time": interval * kept, "run": (kept > rows).astype(float), "output": np.arange(2.0 * rows)}
    units = {"time": "s", "run": "", "output": "deg/s"}
    on = np.asarray(read_signals(Campaign(columns, units, {"kind": "rate"})).signals["time_on"])[: 2 * rows]
    assert on == pytest.approx(np.tile(interval * np.arange(rows), 2))


def test_runs_of_one_row_begin_with_a_power_on_each():
    columns = {"time": 3600.0 * np.arange(6), "run": np.arange(6.0), "output": np.arange(6.0)}
    measured = Campaign(columns, {"time": "s", "run": "", "output": "deg/s"}, {"kind": "rate"})
    assert not np.asarray(read_signals(measured).signals["time_on"])[:6].any()


def test_power_on_time_is_a_time_or_a_number_of_seconds(rng: np.random.Generator):
    measured = campaign(np.arange(9.0), rng.standard_normal(9))
    late = Campaign(measured.columns, measured.units, {"kind": "rate", "time_since_power_on": "soon"})
    with pytest.raises(CampaignError, match="time_since_power_on is 'soon', expected a time such as 120 s"):
        read_signals(late)
    for given, seconds in (("2 min", 120.0), ("90", 90.0), (30, 30.0)):
        warm = Campaign(measured.columns, measured.units, {"kind": "rate", "time_since_power_on": given})
        assert read_signals(warm).signals["time_on"][0] == seconds


@pytest.mark.parametrize("unit", ["arcsec", "count"])
def test_increments_and_angles_give_the_same_rate_as_rates(unit: str, rng: np.random.Generator):
    """Unequal steps, each known but the first: the first increment, like the angle's first difference, is missing."""
    steps = STEP * rng.uniform(0.8, 1.2, ROWS)
    time = np.cumsum(steps)
    rate = rng.uniform(-5.0, 5.0, ROWS)
    steps[0] = np.median(np.diff(time))
    increments = rate * steps
    from_rates = output_of(read_signals(campaign(time, rate, f"{unit}/s")))
    from_increments = read_signals(campaign(time, increments, unit, "increment"))
    from_angles = read_signals(campaign(time, 7.0 + np.cumsum(increments), unit, "angle"))
    for found in (output_of(from_increments), output_of(from_angles)):
        assert np.isnan(found[0])
        assert found[1:] == pytest.approx(from_rates[1:], rel=1e-9, abs=1e-12)
    expected = "rad/s" if unit == "arcsec" else "count/s"
    assert from_increments.output_unit == from_angles.output_unit == expected


@pytest.mark.parametrize("kind", ["increment", "angle"])
def test_what_was_turned_through_in_a_gap_is_missing(kind: str, rng: np.random.Generator):
    time = np.arange(ROWS) * STEP
    keep = np.ones(ROWS, bool)
    keep[[40, 41, 42, 100]] = False
    rate = rng.uniform(-5.0, 5.0, ROWS)
    values = rate * STEP if kind == "increment" else np.cumsum(rate * STEP)
    record = read_signals(campaign(time[keep], values[keep], "arcsec", kind))
    found = output_of(record)
    behind = np.flatnonzero(np.diff(time[keep]) > STEP) + 1
    lost = np.zeros(keep.sum(), bool)
    lost[behind] = True
    lost[0] = kind == "angle"
    assert np.array_equal(np.isnan(found), lost)
    assert found[~lost] == pytest.approx(np.deg2rad(rate[keep] / 3600)[~lost])


@pytest.mark.parametrize(("unit", "turn", "words"), [("deg", 360.0, "one turn"), ("count", 65536.0, "2^16 counts")])
def test_an_angle_that_starts_anew_is_refused(unit: str, turn: float, words: str):
    """Also where samples are missing; an angle that only happens to reach as far is none that wraps."""
    time, angle = np.arange(ROWS) * STEP, turn / 60 * np.arange(ROWS)
    known = np.arange(ROWS) != 100
    wrapped = np.where(known, angle % turn, np.nan)
    with pytest.raises(CampaignError, match=re.escape(f"wraps round within {words}; unwrap it")):
        read_signals(campaign(time, wrapped, unit, "angle"))
    swung = 0.499 * turn * (1 + np.sin(angle / turn))
    for whole in (np.where(known, angle, np.nan), np.where(known, swung, np.nan)):
        assert read_signals(campaign(time, whole, unit, "angle")).present.sum() == ROWS - 3


def test_an_angle_that_only_jumps_as_far_is_none_that_starts_anew():
    """Across a pause, or to and fro between two places: nothing goes on as it did before."""
    time = np.r_[np.arange(20.0), 120.0 + np.arange(20.0)]
    paused = np.r_[np.linspace(0.0, 4.0, 20), np.linspace(240.0, 244.0, 20)]
    assert read_signals(campaign(time, paused, "count", "angle")).present.sum() == 38
    fro = np.where(np.arange(40) // 6 % 2, 243.0, 0.0) + np.linspace(0.0, 0.5, 40)
    for unit in ("count", "deg"):
        assert read_signals(campaign(np.arange(40.0), fro, unit, "angle")).present.sum() == 39


@pytest.mark.parametrize("kind", ["increment", "angle"])
def test_increments_in_some_rows_only_count_from_none(kind: str, rng: np.random.Generator):
    output = np.where(np.arange(ROWS) % 4 == 0, rng.standard_normal(ROWS), np.nan)
    with pytest.raises(CampaignError, match=f"an {kind} counts from the row before: leave out the rows between"):
        read_signals(campaign(np.arange(ROWS) * STEP, output, "arcsec", kind))


@pytest.mark.parametrize("every", [1, 4, 10])
def test_the_interval_is_that_of_rows_with_an_output(every: int, rng: np.random.Generator):
    output = np.where(np.arange(ROWS) % every == 0, rng.standard_normal(ROWS), np.nan)
    output[50:60] = np.nan
    assert read_signals(campaign(np.arange(ROWS) * STEP, output)).interval == pytest.approx(every * STEP)


def test_white_noise_of_campaigns_goes_by_their_intervals(rng: np.random.Generator):
    """N is the unit's: samples a hundredth as long scatter by ten times as much; dwells have no clock."""
    fast, slow = (campaign(np.arange(n) * s, rng.standard_normal(n)) for n, s in ((300, 0.01), (200, 1.0)))
    uneven = campaign(np.arange(90) * 0.1 + rng.uniform(-0.003, 0.003, 90), rng.standard_normal(90))
    record = read_signals([fast, slow, uneven])
    white = np.asarray(record.sampling.white)[: record.rows]
    assert record.interval / white == pytest.approx(np.repeat([0.01, 1.0, 0.1], [300, 200, 90]), rel=0.02)
    # Rows that are dwells have no clock: then a sample of any counts as one of another, however many there are.
    dwells = campaign(np.cumsum(rng.uniform(40.0, 80.0, 250)), rng.standard_normal(250))
    assert (np.asarray(read_signals([slow, dwells]).sampling.white) == 1.0).all()


def test_missing_outputs_are_not_present(rng: np.random.Generator):
    output = rng.standard_normal(ROWS)
    output[[0, 10, 255]] = np.nan
    record = read_signals(campaign(np.arange(ROWS) * STEP, output))
    assert np.array_equal(np.flatnonzero(~record.present), [0, 10, 255])
    fewer = record.without(np.array([3, 10]))
    assert np.array_equal(np.flatnonzero(~fewer.present), [0, 3, 10, 255])
    assert record.present.sum() == ROWS - 3


def test_one_axis_must_be_chosen(rng: np.random.Generator):
    time = np.arange(ROWS) * STEP
    columns = {"time": time} | {f"output_{a}": rng.standard_normal(ROWS) for a in "xy"}
    units = dict.fromkeys(columns, "deg/h") | {"time": "s"}
    both = Campaign(columns, units, {"kind": "rate"}, "pair")
    with pytest.raises(
        CampaignError, match=r"pair: has outputs output_x, output_y; choose one axis \(--axis x, y or z\)"
    ):
        read_signals(both)
    assert read_signals(both.axis("y")).rows == ROWS


def thermal(time: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A smooth temperature in °C and its rate."""
    slow, fast = 2 * np.pi / 4000, 2 * np.pi / 1500
    value = 20 + 15 * np.sin(slow * time) + 3 * np.cos(fast * time)
    return value, 15 * slow * np.cos(slow * time) - 3 * fast * np.sin(fast * time)


@pytest.mark.parametrize(("rows", "share"), [(256, 0.8), (9000, 0.1)])
def test_temperature_rate_is_the_derivative_through_the_noise(rows: int, share: float, rng: np.random.Generator):
    """Differences of the noisy samples are worse, the more so the faster they come; long records are averaged first."""
    time = np.cumsum(rng.uniform(0.7, 1.3, rows)) * (256 * STEP / rows)
    value, slope = thermal(time)
    noisy = value + 2e-3 * rng.standard_normal(rows)
    inner = slice(rows // 50, -rows // 50)
    error = np.sqrt(np.mean((smooth_derivative(time, noisy) - slope)[inner] ** 2))
    naive = np.sqrt(np.mean((np.gradient(noisy, time) - slope)[inner] ** 2))
    assert error < 0.02 * slope.std()
    assert error < share * naive
    record = read_signals(campaign(time, rng.standard_normal(rows), temperature=noisy))
    assert np.asarray(record.signals["temperature_rate"])[:rows] == pytest.approx(smooth_derivative(time, noisy))


def test_temperature_rate_of_simple_records():
    time = np.arange(50.0)
    assert smooth_derivative(time, 3 + 0.25 * time) == pytest.approx(0.25, abs=1e-9)
    assert smooth_derivative(time, np.full(50, 7.0)) == pytest.approx(0.0, abs=1e-15)
    assert smooth_derivative(time[:3], 0.5 * time[:3]) == pytest.approx(0.5)
    assert smooth_derivative(time[:1], time[:1]) == pytest.approx(0.0)
    long = np.arange(4001.0)  # more than the knots allow, and no multiple of the averaging length
    assert smooth_derivative(long, 3 + 0.25 * long) == pytest.approx(0.25, abs=1e-9)


def test_temperature_rate_knows_no_gap_and_no_missing_sample(rng: np.random.Generator):
    """Plateaus at two temperatures with nothing between: the rate is zero on both, not the jump over the gap."""
    time = np.concatenate([np.arange(100), np.arange(400, 500)]) * STEP
    temperature = np.where(np.arange(200) < 100, 10.0, 50.0) + 1e-3 * rng.standard_normal(200)
    temperature[[50, 130]] = np.nan
    record = read_signals(campaign(time, rng.standard_normal(200), temperature=temperature))
    rate = np.asarray(record.signals["temperature_rate"])[:200]
    assert np.array_equal(np.flatnonzero(np.isnan(rate)), [50, 130])
    assert np.nanmax(np.abs(rate)) < 40 / (300 * STEP) / 10


def test_blocks_are_the_parts_that_repeat_the_driver(rng: np.random.Generator):
    time = np.arange(240) * STEP
    output = rng.standard_normal(240)
    parts = read_signals(campaign(time, output))
    assert "of the record" in parts.block_scheme
    assert (np.diff(parts.blocks) >= 0).all()
    sizes = np.bincount(parts.blocks)
    assert sizes.max() - sizes.min() <= 1
    segments = np.repeat(np.array([3.0, 1.0, 7.0, 9.0, 11.0]), 48)
    numbered = read_signals(campaign(time, output, segment=segments))
    assert numbered.block_scheme == "segments"
    assert len(np.unique(numbered.blocks)) == 5
    assert all(len(np.unique(segments[numbered.blocks == b])) == 1 for b in range(5))
    few = read_signals(campaign(time, output, segment=np.repeat(np.array([1.0, 2.0]), 120)))
    assert few.block_scheme == parts.block_scheme
    gaps = np.concatenate([time[60 * i : 60 * (i + 1)] + 5000 * i for i in range(4)])
    apart = read_signals(campaign(gaps, output, segment=segments))
    assert apart.block_scheme == "stretches between gaps"
    assert np.array_equal(apart.blocks, np.repeat(np.arange(4), 60))


def test_campaigns_lie_end_to_end(rng: np.random.Generator):
    parts = [campaign(1e5 * k + np.arange(n) * STEP, rng.standard_normal(n)) for k, n in enumerate((100, 60))]
    record = read_signals(parts)
    assert record.rows == 160
    time, restart = np.asarray(record.signals["time"])[:160], np.asarray(record.sampling.restart)[:160]
    assert time == pytest.approx(np.concatenate([np.arange(100), np.arange(60)]) * STEP)
    assert np.array_equal(np.flatnonzero(restart), [0, 100])
    interval = np.asarray(record.sampling.interval)[:160]
    assert interval[~restart] == pytest.approx(STEP)
    assert output_of(record) == pytest.approx(np.concatenate([p.si("output") for p in parts]))
    assert not set(record.blocks[:100]) & set(record.blocks[100:])
    assert record.data_hash == "+".join(p.digest() for p in parts)


def test_campaigns_that_do_not_match_are_refused(rng: np.random.Generator):
    time, output = np.arange(60) * STEP, rng.standard_normal(60)
    plain = campaign(time, output)
    with pytest.raises(CampaignError, match="need the same columns; rate is in only some"):
        read_signals([plain, campaign(time, output, rate=output)])
    with pytest.raises(CampaignError, match=r"column 'output' is in \[count/s\], but in \[deg/h\]"):
        read_signals([plain, campaign(time, output, "count/s")])
    with pytest.raises(CampaignError, match="need the same columns; run is in only some"):
        read_signals([campaign(time, output, run=output), plain])
    extra = read_signals([campaign(time, output, heater=output), campaign(time, output * 2)])
    assert "heater" not in extra.signals
    same = read_signals([plain, campaign(time, output * 3600, "arcsec/h")])
    first, second = output_of(same)[:60], output_of(same)[60:]
    assert first == pytest.approx(second)


def test_runs_of_several_campaigns_are_counted_on_where_they_share_a_number():
    time, noise = np.arange(8.0), np.random.default_rng(2).standard_normal((3, 8))

    def runs(*numbers: list[float]) -> list[float]:
        record = read_signals([campaign(time, o, run=np.array(n)) for o, n in zip(noise, numbers, strict=False)])
        return np.asarray(record.signals["run"])[: record.rows : 4].tolist()

    one, two = [1.0] * 8, [1.0] * 4 + [2.0] * 4
    assert runs(one, one, one) == [1, 1, 2, 2, 3, 3]
    assert runs(two, two) == [1, 2, 3, 4]
    assert runs(two, [7.0] * 8) == [1, 2, 7, 7]


def test_a_thermometer_of_noise_alone_is_smoothed_to_its_mean(rng: np.random.Generator):
    """What a spline makes of noise is slow as drift is; a climb beneath the noise is kept, each stretch by itself."""
    time = np.concatenate([STEP * np.arange(400), 1e5 + STEP * np.arange(400)])
    climb = np.where(time > 9e4, 5.0 + 1e-4 * (time - 1e5), 0.0)
    noise = 0.05 * rng.standard_normal(len(time))
    record = read_signals(campaign(time, rng.standard_normal(len(time)), temperature=20.0 + climb + noise))
    smooth = np.asarray(with_smooth_thermometers(record).signals["temperature"])[: record.rows]
    apart = time < 9e4
    assert smooth[apart] == pytest.approx(20.0 + noise[apart].mean(), abs=1e-6)
    assert smooth[~apart] == pytest.approx((20.0 + climb)[~apart], abs=0.03)


def test_campaigns_given_twice_and_rates_of_two_frames_are_refused(rng: np.random.Generator):
    """Whichever of several they are; without a word the rate is relative to the Earth."""
    time = STEP * np.arange(ROWS)
    one, two, other = (campaign(time, rng.standard_normal(ROWS), rate=np.sin(time)) for _ in range(3))
    with pytest.raises(CampaignError, match="the same data were given twice"):
        read_signals([one, two, two])
    inertial = Campaign(other.columns, other.units, {"kind": "rate", "rate_frame": "inertial"}, "inertial")
    for pair in ([one, inertial], [inertial, one], [one, two, inertial]):
        with pytest.raises(CampaignError, match="need the same rate_frame"):
            read_signals(pair)


def test_many_columns_with_gaps_of_their_own_do_not_leave_a_campaign_without_rows(rng: np.random.Generator):
    """Six columns, each missing in another sixth of the rows: all rows would go for them."""
    part = np.arange(ROWS) * 6 // ROWS
    columns = {f"c{k}": np.where(part == k, np.nan, rng.standard_normal(ROWS)) for k in range(6)}
    record, said = with_columns_known(
        read_signals(campaign(STEP * np.arange(ROWS), rng.standard_normal(ROWS), **columns))
    )
    assert 0.5 * ROWS <= record.present.sum() < 0.7 * ROWS
    assert 2 <= len(said) <= 3


def test_the_precision_of_a_log_is_not_that_of_its_fill_value(rng: np.random.Generator):
    output = rng.standard_normal(ROWS)
    time = STEP * np.arange(ROWS)
    usual = read_signals(campaign(time, output)).imprecision
    output[17] = 1e30
    assert read_signals(campaign(time, output)).imprecision == pytest.approx(usual, rel=0.3)
