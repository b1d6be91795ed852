"""Effects of all units together: drawn evidence with known shares, and simulated archives of weak effects."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import parquet
from scipy.stats import binom

from benchmarks.pooled_effects import Archive, archives, together, work
from gyromodel import cli
from gyromodel.batch import PooledEffect, leading, pooled_effects, pooled_sentences
from gyromodel.batch._results import SCHEMA
from tests.truth.verdicts import allowed

RARE = 1e-5
SIZES = (1e1, 1e2, 1e3, 1e4)


def evidence(z: float) -> list[float]:
    """ln B of one coefficient z standard errors from zero, the noise known, at each of the prior's sizes."""
    return [0.5 * z**2 * s / (1 + s) - 0.5 * math.log(1 + s) for s in SIZES]


def table(units: list[dict[str, list[float]]], campaigns: int = 1, **columns: list[str | None]) -> pa.Table:
    """Results of campaigns, each unit's in turn."""
    n = len(units)
    rows = {
        "campaign": [f"c{i}" for i in range(n)], "axis": [None] * n, "verdict": ["adequate"] * n, "causes": [""] * n,
        "serial": [f"U{i // campaigns}" for i in range(n)], "data_hash": [f"d{i}" for i in range(n)],
        "evidence": [json.dumps(u) for u in units],
    } | columns  # fmt: skip
    return pa.table(rows, pa.schema([(name, pa.string()) for name in rows]))


def drawn(rng: np.random.Generator, units: int, share: float, size: float) -> tuple[PooledEffect, np.ndarray]:
    has = rng.random(units) < share
    z = has * math.sqrt(size) * rng.standard_normal(units) + rng.standard_normal(units)
    [found] = pooled_effects(table([{"bias_drift": evidence(x)} for x in z]))
    return found, has


@pytest.mark.law
def test_shares_and_units_are_told_as_often_as_they_are_so(seed: int):
    """Drawn from the prior: the interval of the share covers, and of units told with p the part p has the effect."""
    rng, count, covered, off, variance = np.random.default_rng(seed), 200, 0, 0.0, 0.0
    for _ in range(count):
        share = rng.random()
        found, has = drawn(rng, 12, share, rng.choice(SIZES))
        covered += found.share.low - 0.011 <= share <= found.share.high + 0.011
        p = rng.integers(12)
        told = found.probability[f"U{p}"]
        off, variance = off + has[p] - told, variance + told * (1 - told)
    assert covered >= binom.ppf(RARE, count, 0.94), f"seed {seed}: {covered} of {count}"
    assert abs(off) < 4.5 * math.sqrt(variance), f"seed {seed}"


@pytest.mark.law
@pytest.mark.parametrize("units", [2, *(pytest.param(units, marks=pytest.mark.long) for units in (8, 60))])
def test_archives_with_nothing_in_them_show_nothing(units: int, seed: int):
    """ln B exceeds 4 in less than exp(−4) of archives, whatever their size: its mean is one."""
    rng, count = np.random.default_rng(seed), 300
    shown = sum(drawn(rng, units, 0.0, 1.0)[0].evidence >= 4 for _ in range(count))
    assert shown <= binom.isf(RARE, count, math.exp(-4)), f"seed {seed}: {shown} of {count}"


def test_evidence_is_the_mean_over_share_and_size():
    """By sums; of three units, one of which has it for certain."""
    deviations, total = [2.5, 0.3, -6.0], []
    [found] = pooled_effects(table([{"bias_drift": evidence(z)} for z in deviations]))
    for k in range(4):
        for share in np.arange(0.01, 1.0, 0.02):
            total.append(math.prod(1 - share + share * math.exp(evidence(z)[k]) for z in deviations))
    assert found.evidence == pytest.approx(math.log(np.mean(total)), rel=1e-12)
    assert found.probability["U2"] > 0.99 > found.probability["U0"] > found.probability["U1"]


def test_campaigns_of_a_unit_share_what_it_has_and_copies_count_once():
    weak = evidence(2.2)
    [units] = pooled_effects(table([{"bias_drift": weak}] * 4))
    [one] = pooled_effects(table([{"bias_drift": weak}] * 4, campaigns=4))
    assert list(one.probability) == ["U0"]
    assert one.evidence != pytest.approx(units.evidence)
    four = math.log(np.mean([0.5 + 0.5 * math.exp(4 * v) for v in weak]))
    assert one.evidence == pytest.approx(four, rel=1e-12)
    same = table([{"bias_drift": weak}] * 4, data_hash=["d", "d", "d", "e"])
    assert pooled_effects(same) == pooled_effects(table([{"bias_drift": weak}] * 2, serial=["U0", "U3"]))
    assert pooled_effects(table([{"bias_drift": weak}])) == []
    fitted = table([{"bias_drift": weak}] * 4, evidence=[None] * 4)
    assert pooled_effects(fitted) == []


def test_a_unit_that_cannot_show_an_effect_says_nothing_of_it():
    strong = [{"bias_magnetic": evidence(4.0), "bias_drift": evidence(0.5)}] * 3
    first = pooled_effects(table(strong))[0]
    assert first.effect == "bias_magnetic"
    more = pooled_effects(table([*strong, {"bias_drift": evidence(0.0)}]))[0]
    assert more == first._replace(posterior=more.posterior)


@pytest.mark.parametrize("bent", [0, 3])
def test_a_special_case_is_named_only_where_it_is_enough(bent: int):
    """Strong straight lines of a unit each, a curve's evidence being told beside them, and three units all bent."""
    straight = [{"bias_temperature": evidence(12.0), "bias_temperature_curve": evidence(0.5)}] * 5
    curved = [{"bias_temperature_curve": evidence(5.0)}] * bent
    causes = ["bias_temperature"] * 5 + ["bias_temperature_curve"] * bent
    units = table(straight + curved, verdict=["named"] * len(causes), causes=causes)
    assert leading(pooled_effects(units)) == [causes[-1]]


@pytest.mark.parametrize("name", ["bias_temperature_rate", "gimbal_nonorthogonality"])
def test_what_takes_in_another_of_its_kind_is_no_special_case_of_itself(name: str):
    units = table([{name: evidence(5.0), "bias_drift": evidence(0.5)}] * 4)
    assert leading(pooled_effects(units)) == [name]


SAID = {
    "bias_magnetic in": ({"bias_magnetic": 4.0, "bias_drift": 0.0}, "The simulation lacks bias_magnetic in"),
    "rivals": ({"bias_magnetic": 4.0, "table_tilt": 4.0}, "is missing that bias_magnetic or table_tilt explains"),
    "driver": ({"smooth(pressure)": 4.0, "bias_drift": 0.0}, "the error follows (pressure) as no effect"),
    "nothing": ({"bias_magnetic": 0.5, "bias_drift": 0.0}, "show nothing that was searched: the strongest is bias_m"),
}


@pytest.mark.parametrize("name", SAID)
def test_what_all_units_show_is_one_sentence_for_each_axis(name: str):
    deviations, expected = SAID[name]
    units = [{effect: evidence(z) for effect, z in deviations.items()}] * 6
    verdicts = ["named", *["adequate"] * 5]
    found = pooled_effects(table(units, verdict=verdicts, causes=["bias_magnetic", *[""] * 5]))
    [line] = pooled_sentences(found)
    assert pytest.approx(1.0) == sum(e.posterior for e in found)
    assert expected in line
    assert ("one names it by itself" in line) == (name == "bias_magnetic in")
    both = pooled_effects(table(units + units[:2], axis=["x", *["y"] * 7]))
    assert {e.axis for e in both} == {"y"}, "an axis that one campaign has is none to compare"
    [line] = pooled_sentences(both)
    assert line.startswith("Axis y: ")


def test_the_command_tells_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    told = json.dumps({"bias_drift": evidence(3.5)})
    rows = [{"campaign": f"c{i}", "verdict": "adequate", "causes": "", "evidence": told} for i in range(5)]
    whole = pa.Table.from_pylist(rows, SCHEMA).replace_schema_metadata({"gyromodel": "{}"})
    parquet.write_table(whole, tmp_path / "r.parquet")
    for more in ([], ["--json"]):
        with pytest.raises(SystemExit) as done:
            cli.main(["units", str(tmp_path / "r.parquet"), *more])
        assert done.value.code == 0
        said = capsys.readouterr().out
        if not more:
            assert "- The simulation lacks bias_drift in" in said
            assert "none shows it by itself" in said
    told = json.loads(said)
    assert told["parameters"] == []
    [effect] = told["effects"]
    assert (effect["effect"], effect["alone"], len(effect["probability"])) == ("bias_drift", 0, 5)


@pytest.mark.law
@pytest.mark.long
def test_effects_too_weak_for_a_campaign_are_named_over_eight(seed: int):
    """At 0.7 times the minimal detectable size; the benchmark has more archives, and some of half with the effect."""
    those = [a for a in archives(12, seed, 1.0) if a.effect != "bias_periodic"][:8]
    named, wrong, alone = 0, 0, 0
    for archive in those:
        rows = work(archive)
        answer, right = together(rows), allowed(archive.effect, archive.design)[0]
        named, wrong = named + (answer in right), wrong + (answer not in {*right, "", "?"})
        alone += sum(row["verdict"] == "named" and row["causes"] in right for row in rows)
    assert named >= binom.ppf(1e-4, len(those), 0.8), f"seed {seed}: {named} of {len(those)}"
    assert wrong <= 1, f"seed {seed}: {wrong} of {len(those)}"
    assert alone < 8 * named, f"seed {seed}"
    still = [together(work(a)) for a in archives(3, seed + 1, 0.0)]
    assert sum(map(bool, still)) <= 1, f"seed {seed}: {still}"


def test_an_archive_s_cases_have_the_effect_where_it_says():
    half = Archive("static_cycle", "white", "bias_pressure", 0.5, 1)
    assert [c.effect is not None for c in half.cases()] == [False, True] * 4
    assert len({c.seed for c in half.cases()}) == 8


def test_nothing_leads_where_nothing_stands_out():
    [found] = pooled_effects(table([{"bias_drift": evidence(0.1)}] * 3))
    assert leading([found]) == leading([]) == []
