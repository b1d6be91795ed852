"""Statistics of an archive's units on drawn archives: intervals cover, false alarms are as rare as stated."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import parquet
from scipy.stats import binom, chi2

from gyromodel import CampaignError, cli
from gyromodel.batch import Parameter, copies, pooled_table, read_results, unit_statistics
from gyromodel.batch._results import SCHEMA

RARE = 1e-5


def drawn(
    rng: np.random.Generator, units: int, campaigns: int, between: float, within: float, shift: float = 0.0,
    drift: float = 0.0,
) -> tuple[pa.Table, np.ndarray]:  # fmt: skip
    """Results of an archive and the true values; unit 0 is off by `shift` and changes by `drift` a campaign."""
    unit = np.repeat(np.arange(units), campaigns)
    number = np.tile(np.arange(campaigns), units)
    std = 10 ** rng.uniform(-0.5, 0.5, len(unit))
    true = 40 + between * rng.standard_normal(units)[unit] + within * rng.standard_normal(len(unit))
    true = true + (unit == 0) * (shift + drift * number)
    value = true + std * rng.standard_normal(len(unit))
    n = len(unit)
    table = {
        "campaign": [f"c{i}" for i in range(n)], "axis": [None] * n, "parameter": ["bias.value"] * n,
        "value": value, "std": std, "unit": ["deg/h"] * n, "serial": [f"U{u}" for u in unit], "date": [None] * n,
        "reason": [None] * n, "data_hash": [f"d{i}" for i in range(n)],
    }  # fmt: skip
    return pa.table(table, pa.schema([("campaign", pa.string()), ("axis", pa.string()), ("parameter", pa.string()),
        ("value", pa.float64()), ("std", pa.float64()), ("unit", pa.string()), ("serial", pa.string()),
        ("date", pa.string()), ("reason", pa.string()), ("data_hash", pa.string())])), true  # fmt: skip


def statistics(table: pa.Table) -> Parameter:
    [found] = unit_statistics(table)
    return found


@pytest.mark.parametrize(
    ("units", "campaigns"), [(12, 1), *(pytest.param(*case, marks=pytest.mark.long) for case in ((6, 4), (20, 3)))]
)
def test_intervals_cover_whatever_the_spreads_are(units: int, campaigns: int, seed: int):
    """One campaign of each archive, as those of one archive err together; a uniform prior errs on the wide side."""
    rng = np.random.default_rng(seed)
    archives, covered, spread, closer, wide = 120, 0, 0, [], []
    for _ in range(archives):
        between, within = rng.choice([0.1, 1.0, 5.0]), rng.choice([0.0, 0.5])
        table, true = drawn(rng, units, campaigns, between, within)
        found = statistics(table)
        true, std = true[found.pooled["row"]], table["std"].to_numpy()[found.pooled["row"]]
        k = rng.integers(len(true))
        covered += bool(found.pooled["low"][k] <= true[k] <= found.pooled["high"][k])
        spread += bool(found.between.low <= between <= found.between.high)
        closer.append(np.mean(found.pooled["std"] / std))
        if between == 5.0:
            wide.append(found.between.high / found.between.low)
    assert covered >= binom.ppf(RARE, archives, 0.95), f"seed {seed}: {covered} of {archives}"
    if (units, campaigns) != (12, 1):
        assert spread >= binom.ppf(RARE, archives, 0.93), f"seed {seed}: {spread} of {archives}"
    # As wide as χ² of the units makes it.
    assert np.median(wide) < 1.5 * np.sqrt(chi2.ppf(0.975, units - 1) / chi2.ppf(0.025, units - 1))
    assert np.mean(closer) < 0.9, "pooling helps nobody"


def test_short_campaigns_gain_most_where_units_are_alike(seed: int):
    table, true = drawn(np.random.default_rng(seed), 40, 1, 0.2, 0.0)
    found = statistics(table)
    order = found.pooled["row"]
    std, value, true = table["std"].to_numpy()[order], table["value"].to_numpy()[order], true[order]
    assert np.median((found.pooled["std"] / std)[std > 1]) < 0.4
    raw, pooled = (np.sqrt(np.mean((x - true) ** 2)) for x in (value, found.pooled["value"]))
    assert pooled < 0.5 * raw


@pytest.mark.long
def test_nothing_stands_out_but_by_chance(seed: int):
    rng, archives = np.random.default_rng(seed), 120
    alarms = np.zeros(2, int)
    for _ in range(archives):
        found = statistics(drawn(rng, 8, 4, rng.choice([0.3, 3.0]), rng.choice([0.0, 1.0]))[0])
        alarms += [bool(found.outliers), bool(found.drifts)]
    assert alarms.max() <= binom.isf(RARE, archives, 0.01), f"seed {seed}: {alarms} of {archives}"


def test_a_unit_that_is_off_and_one_that_drifts_are_named(seed: int):
    rng = np.random.default_rng(seed)
    found = statistics(drawn(rng, 15, 4, 1.0, 0.3, shift=12.0)[0])
    # Another one beside it is a false alarm, which one archive in a hundred may have.
    [off] = [o for o in found.outliers if o.unit == "U0"]
    assert off.deviations > 3.5
    assert f"{off.value:.4g}" in found.sentences().__next__()
    found = statistics(drawn(rng, 8, 8, 1.0, 0.0, drift=3.0)[0])
    [drift] = [d for d in found.drifts if d.unit == "U0"]
    assert abs(drift.rate - 3.0) < 5 * drift.std
    assert "per campaign" in "".join(found.sentences())


def test_dates_give_drifts_per_day(seed: int):
    table, _ = drawn(np.random.default_rng(seed), 4, 6, 1.0, 0.0, drift=5.0)
    dates = pa.array([f"2026-{1 + i % 6:02d}-01" for i in range(24)])
    table = table.set_column(table.column_names.index("date"), "date", dates)
    [drift] = [d for d in statistics(table).drifts if d.unit == "U0"]
    assert drift.per == "day"
    assert abs(drift.rate - 5 / 30.2) < 4 * drift.std + 0.01


def test_units_of_measure_change_nothing_and_failures_are_left_out(seed: int):
    table, _ = drawn(np.random.default_rng(seed), 6, 2, 1.0, 0.5)
    first = statistics(table)
    for name in ("value", "std"):
        table = table.set_column(table.column_names.index(name), name, pa.array(table[name].to_numpy() / 3600))
    lost = table.slice(0, 1).set_column(table.column_names.index("reason"), "reason", pa.array(["no rate"]))
    table = pa.concat_tables([table, lost])
    second = statistics(table)
    assert second.campaigns == 12
    assert (second.mean * 3600, second.between.value * 3600) == pytest.approx((first.mean, first.between.value))
    pooled = pooled_table(table, [second])
    assert pooled["pooled_value"].to_numpy() * 3600 == pytest.approx(
        first.pooled["value"][np.argsort(first.pooled["row"])]
    )
    assert pooled["campaign"].to_pylist() == [f"c{i}" for i in range(12)]


@pytest.mark.parametrize("campaigns", [3, 8])
def test_one_unit_has_its_mean_its_scatter_and_its_drift(campaigns: int, seed: int):
    """Units say nothing of each other where there is one; its campaigns do, and a drift is seen by itself."""
    rng = np.random.default_rng(seed)
    archives, covered, alarms = 120, 0, 0
    for _ in range(archives):
        table, true = drawn(rng, 1, campaigns, 1.0, rng.choice([0.0, 0.5, 3.0]))
        found = statistics(table)
        k = rng.integers(len(true))
        covered += bool(found.pooled["low"][k] <= true[found.pooled["row"]][k] <= found.pooled["high"][k])
        alarms += bool(found.drifts)
        assert (found.units, found.campaigns, found.outliers) == (1, campaigns, ())
        assert np.isnan(found.between.value)
    assert covered >= binom.ppf(RARE, archives, 0.94), f"seed {seed}: {covered} of {archives}"
    assert alarms <= binom.isf(RARE, archives, 0.01), f"seed {seed}: {alarms} of {archives}"
    drifts = [statistics(drawn(rng, 1, 8, 1.0, 0.0, drift=5.0)[0]).drifts for _ in range(20)]
    assert [d.unit for [d] in drifts] == ["U0"] * 20
    assert abs(np.mean([d.rate - 5.0 for [d] in drifts])) < 5 * np.mean([d.std for [d] in drifts]) / np.sqrt(20)


def test_one_campaign_has_nothing_to_compare(tmp_path: Path, seed: int, capsys: pytest.CaptureFixture[str]):
    assert unit_statistics(drawn(np.random.default_rng(seed), 1, 1, 1.0, 0.0)[0]) == []
    whole = pa.Table.from_pylist([], SCHEMA).replace_schema_metadata({"gyromodel": "{}"})
    parquet.write_table(whole, tmp_path / "r.parquet")
    with pytest.raises(SystemExit) as done:
        cli.main(["units", str(tmp_path / "r.parquet")])
    assert done.value.code == 0
    assert "Nothing to compare" in capsys.readouterr().out


def test_copies_of_a_campaign_count_once(seed: int):
    """Under other names, as a link or a backup has; and what is held fixed, or has no number, does not count."""
    table, _ = drawn(np.random.default_rng(seed), 6, 2, 1.0, 0.5)
    again = table.slice(0, 4).set_column(0, "campaign", pa.array([f"copy of c{i}" for i in range(4)]))
    odd = [table.slice(i, 1).set_column(0, "campaign", pa.array([f"odd{i}"])) for i in range(3)]
    for i, (name, value) in enumerate((("std", 0.0), ("std", None), ("value", np.nan))):
        place = table.column_names.index(name)
        odd[i] = odd[i].set_column(place, name, pa.array([value], pa.float64()))
        odd[i] = odd[i].set_column(table.column_names.index("data_hash"), "data_hash", pa.array([f"odd{i}"]))
    whole = pa.concat_tables([table, again, *odd])
    assert copies(whole) == [f"copy of c{i}" for i in range(4)]
    first, second = statistics(table), statistics(whole)
    assert (second.campaigns, second.mean, second.between) == (12, first.mean, first.between)
    assert pooled_table(whole, [second]).equals(pooled_table(table, [first]))


@pytest.mark.parametrize(("units", "campaigns"), [(2, 1), (2, 3)])
def test_two_units_are_enough(units: int, campaigns: int, seed: int):
    """The mean of all and what is told of each lie where they should; with two, how far apart units are is a guess."""
    rng, archives, covered, mean = np.random.default_rng(seed), 120, 0, 0
    for _ in range(archives):
        between = rng.choice([0.1, 1.0, 5.0])
        table, true = drawn(rng, units, campaigns, between, 0.0)
        found = statistics(table)
        k = rng.integers(len(true))
        covered += bool(found.pooled["low"][k] <= true[found.pooled["row"]][k] <= found.pooled["high"][k])
        mean += abs(found.mean - 40) < 2 * found.mean_std
        assert not found.outliers
    assert min(covered, mean) >= binom.ppf(RARE, archives, 0.93), f"seed {seed}: {covered}, {mean} of {archives}"


@pytest.mark.parametrize("name", SCHEMA.names)
def test_a_table_that_was_changed_is_refused(tmp_path: Path, name: str):
    """A column renamed; what was added does no harm."""
    whole = pa.Table.from_pylist([], SCHEMA).replace_schema_metadata({"gyromodel": "{}"})
    parquet.write_table(whole.append_column("note", pa.array([], pa.string())), tmp_path / "r.parquet")
    assert read_results(tmp_path / "r.parquet").equals(whole)
    other = whole.rename_columns({name: f"{name}_old"}).replace_schema_metadata(whole.schema.metadata)
    parquet.write_table(other, tmp_path / "r.parquet")
    with pytest.raises(CampaignError, match=f"no longer the table that was written: .*{name}"):
        read_results(tmp_path / "r.parquet")
