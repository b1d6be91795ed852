"""What must not change a diagnosis, and what must: units, order and sign; the effect put back or doubled; a safeguard
switched off.

The seeds are fixed: these are examples, small enough to be run each time.
"""

from __future__ import annotations

import numpy as np
import pytest

import gyromodel
from gyromodel.campaign import Campaign
from gyromodel.diagnosis import Diagnosis
from gyromodel.model import GyroModel, model_from_effects
from tests.truth.mutants import mutated

ROWS, STEP = 240, 20.0
SIZE = 0.05  # deg/s per V
UNITS = {"time": "s", "rate": "deg/s", "temperature": "degC", "supply_voltage": "V", "output": "deg/s"}
MODEL = model_from_effects(["scale_factor", "bias"])


def campaign(size: float, seed: int = 3) -> Campaign:
    """Eight rates in random order and a slow swing of temperature, over a random walk; the supply acts on the bias."""
    rng = np.random.default_rng(seed)
    time = np.arange(ROWS) * STEP
    rate = np.repeat(rng.permutation(np.tile(np.linspace(-50, 50, 8), 5)), ROWS // 40)
    temperature = 25 + 8 * np.sin(2 * np.pi * time / time[-1] + 0.3) + 2e-3 * rng.standard_normal(ROWS)
    supply = 5 + 0.03 * np.interp(time, np.linspace(0, time[-1], 25), rng.standard_normal(25))
    noise = 2e-4 * rng.standard_normal(ROWS) + 2e-5 * np.cumsum(rng.standard_normal(ROWS))
    output = 1.001 * rate + 2e-3 + size * (supply - 5) + noise
    columns = {"time": time, "rate": rate, "temperature": temperature, "supply_voltage": supply, "output": output}
    return Campaign(columns, UNITS, {"kind": "rate"})


def diagnosed(*campaigns: Campaign, model: GyroModel = MODEL) -> Diagnosis:
    return gyromodel.diagnose(list(campaigns), model, hold_out=False)


@pytest.fixture(scope="module")
def first() -> Diagnosis:
    found = diagnosed(campaign(SIZE))
    assert (found.verdict, [c.effect for c in found.causes]) == ("named", ["bias_supply_voltage"])
    return found


def statistics(found: Diagnosis) -> dict[str, float]:
    return {c.effect: c.statistic for c in found.rounds[0].ranking}


def assert_alike(found: Diagnosis, other: Diagnosis) -> None:
    """The same verdict, and the same evidence to rounding."""
    assert found.verdict == other.verdict
    assert [c.effect for c in found.causes] == [c.effect for c in other.causes]
    assert set(found.credible_set) == set(other.credible_set)
    assert statistics(found) == pytest.approx(statistics(other), abs=1e-6)


def test_the_named_effect_put_back_leaves_nothing(first: Diagnosis):
    """At its fitted value and fixed in the simulation; and taken away from the output."""
    extended = first.extended.model
    effect = next(e for e in extended.effects if e.label == "bias_supply_voltage")
    fixed = frozenset({("bias_supply_voltage", "coefficient")})
    model = GyroModel((*MODEL.effects, effect), {}, fixed)
    assert diagnosed(campaign(SIZE), model=model).verdict == "adequate"
    given = campaign(SIZE)
    told = next(p for p in first.causes[0].parameters if p.name == "coefficient")
    scale = 1 / 3600 if told.unit.startswith("deg/h") else 1.0
    output = given.columns["output"] - scale * told.value * (given.columns["supply_voltage"] - 5)
    assert diagnosed(given.with_column("output", output, "deg/s")).verdict == "adequate"


@pytest.mark.long
def test_a_larger_effect_never_ranks_lower():
    ranks = []
    for size in SIZE * 0.0125 * 2.0 ** np.arange(4):
        names = [c.effect for c in diagnosed(campaign(size)).rounds[0].ranking]
        ranks.append(names.index("bias_supply_voltage") if "bias_supply_voltage" in names else len(names))
    assert ranks == sorted(ranks, reverse=True)
    assert ranks[-1] == 0


def test_units_change_nothing(first: Diagnosis):
    given = campaign(SIZE)
    other = {"time": "min", "rate": "rad/s", "temperature": "K", "supply_voltage": "mV", "output": "deg/h"}
    turned = Campaign({n: given.in_unit(n, other[n]) for n in given.columns}, other, given.metadata)
    assert_alike(diagnosed(turned), first)


def test_the_order_of_columns_changes_nothing(first: Diagnosis):
    given = campaign(SIZE)
    names = list(given.columns)[::-1]
    turned = Campaign({n: given.columns[n] for n in names}, {n: given.units[n] for n in names}, given.metadata)
    assert_alike(diagnosed(turned), first)


def test_the_sign_of_output_and_rate_changes_nothing(first: Diagnosis):
    given = campaign(SIZE)
    turned = given.with_column("rate", -given.columns["rate"], "deg/s")
    turned = turned.with_column("output", -given.columns["output"], "deg/s")
    assert_alike(diagnosed(turned), first)


@pytest.mark.long
def test_the_order_of_runs_changes_nothing():
    half = np.arange(ROWS) < ROWS // 2
    one, two = campaign(SIZE, 4).select(half), campaign(SIZE, 5).select(half)
    assert_alike(diagnosed(one, two), diagnosed(two, one))


def without(safeguard: str, given: Campaign, *, hold_out: bool = False) -> Diagnosis:
    with mutated(safeguard):
        return gyromodel.diagnose(given, MODEL, hold_out=hold_out)


@pytest.mark.long
def test_each_safeguard_is_needed(first: Diagnosis):
    """Campaigns with nothing hidden, and `first`, whose answers go wrong with one safeguard off."""
    nothing = campaign(0.0, 13)
    kept = diagnosed(nothing)
    assert kept.verdict == "adequate"
    assert without("no_whitening", nothing).verdict != "adequate"
    blind = without("no_look_elsewhere", nothing)
    assert blind.verdict != "adequate"
    assert blind.rounds[0].ranking[0].statistic > kept.rounds[0].ranking[0].statistic + 3.0
    assert without("no_projection", campaign(SIZE)).verdict != first.verdict

    # The best candidate added by force: it seems to gain only where its choice saw the blocks.
    other = campaign(0.0, 4)
    nested, seen = (without(name, other, hold_out=True) for name in ("forced", "forced_no_nesting"))
    assert [c.effect for c in nested.causes] == [c.effect for c in seen.causes] != []
    assert nested.gain.log_score < 0 < seen.gain.log_score
