"""What a campaign cannot tell beside what it can: doubts stay in the verdict, with the test that settles them."""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.stats import binom

import gyromodel as gm
from gyromodel.diagnosis import _searches
from gyromodel.diagnosis._apart import shows
from gyromodel.effects.scale import ScaleFactor
from gyromodel.report import sentence
from gyromodel.report._tables import searched_rows

ROWS, STEP = 600, 40.0
SUPPLY, SHUPE = 1.5, 60.0  # deg/h per V, deg/h per degC/s


def chamber(rng: np.random.Generator) -> gm.Campaign:
    """Two ramps of different speed and a supply that is stepped; both make a bias, in white noise."""
    time = STEP * np.arange(ROWS)
    temperature = np.interp(time, [0, 3000, 8000, 10_000, 12_000, 20_000, 24_000], [20, 20, 50, 50, 20, 20, 45])
    supply = 5.0 + 0.2 * np.repeat(rng.standard_normal(ROWS // 30), 30)
    output = 3.0 + SUPPLY * (supply - 5.0) + SHUPE * np.gradient(temperature, time)
    output += 0.5 * (temperature - 25.0) + 0.1 * rng.standard_normal(ROWS)
    columns = {"time": time, "temperature": temperature, "supply_voltage": supply, "output": output}
    units = {"time": "s", "temperature": "degC", "supply_voltage": "V", "output": "deg/h"}
    return gm.Campaign(columns, units, {"kind": "rate"})


@pytest.mark.law
def test_a_doubt_beside_a_firm_cause_stays_one_of_the_verdict(rng: np.random.Generator):
    """A bias that follows the temperature's rate is one of a late thermometer; one of the supply voltage is neither."""
    model = gm.model_from_effects(["bias", "bias_temperature"])
    right = 0
    for _ in range(8):
        found = gm.diagnose(chamber(rng), model, hold_out=False)
        causes = [cause.effect for cause in found.causes]
        if not (
            found.verdict == "ambiguous"
            and set(found.credible_set) == {"bias_temperature_rate", "temperature_lag"}
            and set(causes[:2]) == set(found.credible_set)
            and causes[2:] == ["bias_supply_voltage"]
        ):
            continue
        right += 1
        told = {row["id"]: row["found"] for row in searched_rows(found)}
        assert [told.get(name, "") for name in found.credible_set] == ["possible"] * len(found.credible_set)
        assert "one more thermometer, at the coil" in (found.next_test or "")
        assert "lacks a bias proportional to supply voltage of (1." in sentence(found)
    assert binom.cdf(right, 8, 0.97) > 1e-3


def grid(rng: np.random.Generator, null: float) -> gm.Campaign:
    """Rates of both signs at each of seven temperatures, of a gyro whose output at rest is that of some deg/s."""
    temperature = np.repeat([20.0, -20.0, 40.0, 0.0, 60.0, 10.0, 50.0], 30)
    rate = np.tile(np.repeat([-100.0, -50.0, -20.0, 0.0, 20.0, 50.0], 5), 7)
    error = 12.0 / 3600.0 * (temperature - 20.0)
    output = (rate + null + error) * (1.0 + 2e-5 * (temperature - 20.0)) + 0.03 * rng.standard_normal(len(rate))
    columns = {"time": 20.0 * np.arange(len(rate)), "rate": rate, "temperature": temperature, "output": output}
    units = {"time": "s", "rate": "deg/s", "temperature": "degC", "output": "deg/s"}
    return gm.Campaign(columns, units, {"kind": "rate"})


@pytest.mark.parametrize("null", [0.0, 250.0])
def test_a_curve_of_the_scale_factor_holds_nothing_of_a_temperature_bias(null: float, rng: np.random.Generator):
    """Beside a simulated scale factor over temperature: its column is that of rate and bias, and so are the curve's."""
    model = gm.model_from_effects(["scale_factor", "bias", "scale_temperature"])
    for _ in range(2):
        found = gm.diagnose(grid(rng, null), model, hold_out=False)
        assert "bias_temperature" in [cause.effect for cause in found.causes]
        assert not any(cause.effect.startswith("scale") for cause in found.causes)
        first = {candidate.effect: candidate.statistic for candidate in found.rounds[0].ranking}
        assert first["bias_temperature"] > first.get("scale_temperature_curve", 0.0) + 5.0


@pytest.mark.law
def test_what_a_walk_may_be_instead_is_told(rng: np.random.Generator):
    """A straight line over one ramp of temperature, ten standard deviations, in white noise and flicker."""
    time = 30.0 * np.arange(360)
    told = 0
    for _ in range(6):
        white = 0.05 * rng.standard_normal(len(time))
        flicker = sum(
            0.008 * lfilter([1.0], [1.0, -(1.0 - 1.0 / tau)], rng.standard_normal(len(time)) / np.sqrt(tau / 2.0))
            for tau in (3.0, 10.0, 30.0, 100.0)
        )
        output = 1.0 + 0.065 * time / 3600.0 + white + flicker
        columns = {"time": time, "temperature": 20.0 + time / 360.0, "output": output}
        campaign = gm.Campaign(columns, {"time": "s", "temperature": "degC", "output": "deg/h"}, {"kind": "rate"})
        found = gm.diagnose(campaign, gm.model_from_effects(["bias"]), hold_out=False)
        assert found.verdict in ("adequate", "ambiguous")
        walk = [line for line in found.findings if line.startswith("What was taken for a random walk of the bias may")]
        told += found.verdict == "ambiguous" or any("bias_temperature" in line or "bias_drift" in line for line in walk)
    assert binom.cdf(told, 6, 0.9) > 1e-4


def test_what_would_show_of_a_scale_factor_is_a_part_of_it():
    """Of a fixed one in counts: some standard errors by least squares, and not of its value in counts."""
    rng = np.random.default_rng(1)
    rate = np.repeat([-20.0, -10.0, 0.0, 10.0, 20.0, 5.0, -5.0], 20)
    columns = {"time": 5.0 * np.arange(140), "rate": rate, "output": 1000.0 * rate + rng.standard_normal(140)}
    campaign = gm.Campaign(columns, {"time": "s", "rate": "deg/s", "output": "count/s"}, {"kind": "rate"})
    effects = (*gm.model_from_effects(["bias"]).effects, ScaleFactor(value=np.rad2deg(1000.0), unit="count/deg"))
    model = gm.GyroModel(effects, fixed=frozenset({("scale_factor", "value")}))
    size, unit = gm.diagnose(campaign, model, hold_out=False).minimum_detectable["scale_factor"]
    least = 1e6 / (1000.0 * np.sqrt(np.sum((rate - rate.mean()) ** 2)))
    assert unit == "ppm"
    assert 3.0 < size / least < 8.0


def unit(rng: np.random.Generator, level: float, error: np.ndarray | float = 0.0, **columns: np.ndarray) -> gm.Campaign:
    """A log of a bias of 3 deg/h and an error, in white noise of some level."""
    output = 3.0 + error + level * rng.standard_normal(ROWS)
    values = {"time": STEP * np.arange(ROWS), "output": output} | columns
    units = {"time": "s", "output": "deg/h"} | {k: {"temperature": "degC"}.get(k, "uT") for k in columns}
    return gm.Campaign(values, units, {"kind": "rate"})


@pytest.mark.long
@pytest.mark.law
@pytest.mark.parametrize("louder", [1.0, 4.0])
def test_campaigns_of_unlike_noise_hide_nothing(louder: float, rng: np.random.Generator):
    """In one noise for all, the louder one had lines; in two of five draws, firmly."""
    adequate = 0
    for _ in range(10):
        found = gm.diagnose([unit(rng, 1.0), unit(rng, louder)], gm.model_from_effects(["bias"]), hold_out=False)
        adequate += found.verdict == "adequate"
        assert any("differs from campaign to campaign" in line for line in found.findings) == (louder > 1.0)
    assert binom.cdf(adequate, 10, 0.98) > 1e-4


def test_what_all_campaigns_lack_is_weighted_by_their_noise(rng: np.random.Generator):
    """A slope over temperature of 0.05 deg/h/degC: nearly all of what is known of it is from the quiet one."""
    temperature = 20.0 + 25.0 * np.sin(np.arange(ROWS) / 50.0)
    both = [unit(rng, level, 0.05 * temperature, temperature=temperature) for level in (1.0, 8.0)]
    found = gm.diagnose(both, gm.model_from_effects(["bias"]), hold_out=False)
    [size] = found.causes[0].parameters
    assert found.causes[0].effect == "bias_temperature"
    alone = 1.0 / np.linalg.norm(temperature - temperature.mean())
    # Estimated slow noise adds some tenths; in one noise for both it is four times as large.
    assert 0.85 * alone < size.std < 1.7 * alone
    assert abs(size.value - 0.05) < 4.0 * size.std


def test_an_offset_that_slow_noise_hides_is_no_firm_cause():
    """One of two files begins with a decay that no column explains: a turn-on of (0.06 ± 0.56) deg/h was firm."""
    for seed in range(4):
        rng = np.random.default_rng(seed)
        decay = 1.6 * np.exp(-STEP * np.arange(ROWS) / 900.0)
        found = gm.diagnose([unit(rng, 0.05, decay), unit(rng, 0.05)], gm.model_from_effects(["bias"]))
        assert found.verdict in ("ambiguous", "unknown")


@pytest.mark.long
@pytest.mark.law
def test_a_line_of_two_regular_clocks_is_not_named_at_its_alias(rng: np.random.Generator):
    """A line of the slower campaign: unlike steps of two campaigns are no uneven times, which would tell them apart."""
    right = 0
    for _ in range(4):
        logs = []
        for step, size in ((1.0, 0.0), (2.5, 1.5)):
            time = step * np.arange(300)
            output = 3.0 + size * np.cos(2 * np.pi * 0.0733 * time + 1.0) + 0.4 * rng.standard_normal(300)
            columns = {"time": time, "output": output}
            logs.append(gm.Campaign(columns, {"time": "s", "output": "deg/h"}, {"kind": "rate"}))
        found = gm.diagnose(logs, gm.model_from_effects(["bias"]), hold_out=False)
        lines = np.array([p.value for c in found.causes for p in c.parameters if p.name.startswith("frequency")])
        right += found.verdict == "named" and bool(np.any(np.abs(lines - 0.0733) < 1e-3))
        assert not np.any(np.abs(lines - (1.0 / 2.5 - 0.0733)) < 1e-3)
    assert binom.cdf(right, 4, 0.95) > 1e-3


@pytest.mark.long
def test_lines_of_two_campaigns_of_uneven_times_are_searched_as_far_as_of_one(rng: np.random.Generator):
    """Above half of their mean rate, which even times would have folded: 0.021 Hz at 0.025 Hz."""
    logs = []
    for _ in range(2):
        time = np.cumsum(STEP + rng.uniform(-0.4 * STEP, 0.4 * STEP, ROWS))
        columns = {"time": time, "output": 3.0 + np.cos(2 * np.pi * 0.021 * time) + 0.3 * rng.standard_normal(ROWS)}
        logs.append(gm.Campaign(columns, {"time": "s", "output": "deg/h"}, {"kind": "rate"}))
    found = gm.diagnose(logs, gm.model_from_effects(["bias"]), hold_out=False)
    assert found.causes[0].effect == "bias_periodic"
    assert any(abs(p.value - 0.021) < 1e-5 for p in found.causes[0].parameters)


def test_a_line_that_uneven_times_tell_from_its_alias_is_named(rng: np.random.Generator):
    """0.021 Hz at a mean rate of 0.025 Hz: it was named at 0.004 Hz, where even times would have folded it."""
    log = unit(rng, 1.0)
    time = np.cumsum(STEP + rng.uniform(-0.4 * STEP, 0.4 * STEP, ROWS))
    output = 3.0 + np.cos(2 * np.pi * 0.021 * time) + 0.3 * rng.standard_normal(ROWS)
    uneven = gm.Campaign(log.columns | {"time": time, "output": output}, log.units, {"kind": "rate"})
    found = gm.diagnose(uneven, gm.model_from_effects(["bias"]), hold_out=False)
    assert (found.verdict, [cause.effect for cause in found.causes]) == ("named", ["bias_periodic"])
    frequency = next(p for p in found.causes[0].parameters if p.name == "frequency")
    assert abs(frequency.value - 0.021) < 5e-6


def test_which_of_two_columns_in_proportion_is_left_open(rng: np.random.Generator):
    """Of one effect it is a finding, of two an ambiguous verdict; no further test moves one and holds the other."""
    field = np.sin(np.arange(ROWS) / 40.0)
    log = unit(rng, 0.3, field, magnetic_field_x=30.0 * field, magnetic_field_y=-60.0 * field)
    found = gm.diagnose(log, gm.model_from_effects(["bias"]), hold_out=False)
    assert [cause.effect for cause in found.causes] == ["bias_magnetic"]
    assert any("go in proportion here" in line for line in found.findings)
    warm = 20.0 + 25.0 * np.abs(np.arange(ROWS) / 300.0 - 1.0)
    log = unit(rng, 0.3, 0.1 * warm, temperature=warm).with_column("pressure", 1e5 + 40.0 * warm, "Pa")
    found = gm.diagnose(log, gm.model_from_effects(["bias"]), hold_out=False)
    assert set(found.credible_set) == {"bias_temperature", "bias_pressure"}
    assert (found.next_test or "").startswith("Step pressure up and down")


def test_what_one_sample_tells_may_be_a_gross_error(rng: np.random.Generator):
    """A supply that stands still but for one glitch, in the row where the output jumps."""
    row = np.arange(ROWS) == 217
    log = unit(rng, 0.3, 3.0 * row).with_column("supply_voltage", 5.0 + 0.5 * row, "V")
    found = gm.diagnose(log, gm.model_from_effects(["bias"]), hold_out=False)
    assert found.verdict != "named"
    assert {"outliers", "bias_supply_voltage"} <= set(found.credible_set)


@pytest.mark.long
@pytest.mark.law
def test_a_column_that_steps_in_a_random_walk_is_no_gross_error(rng: np.random.Generator):
    """In a walk a step tells by the one increment at its edge, which no single wrong sample makes."""
    on = (np.arange(ROWS) > 217).astype(float)
    named = 0
    for _ in range(6):
        walk = np.cumsum(0.02 * rng.standard_normal(ROWS))
        log = unit(rng, 0.001, 2.0 * on + walk).with_column("supply_voltage", 5.0 + on, "V")
        found = gm.diagnose(log, gm.model_from_effects(["bias"]), hold_out=False)
        assert "outliers" not in found.credible_set
        named += "bias_supply_voltage" in found.credible_set
    assert binom.cdf(named, 6, 0.95) > 1e-3


def test_sizes_show_by_what_differs_from_the_simulation():
    """What a simulation states of a slope is no evidence of one more: its sizes count from there."""
    rng = np.random.default_rng(2)
    temperature = 20.0 + 25.0 * np.sin(np.arange(ROWS) / 50.0)
    stated = gm.model_from_effects(["bias", "bias_temperature"])
    for change, there in ((0.0, False), (0.5, True)):
        found = gm.fit(unit(rng, 0.3, (0.4 + change) * temperature, temperature=temperature), stated)
        size = float(np.deg2rad(0.4 / 3600.0))
        effects = tuple(
            replace(e, coefficient=jnp.asarray(size)) if e.label == "bias_temperature" else e for e in stated.effects
        )
        before = replace(stated, effects=effects, fixed=frozenset({("bias_temperature", "coefficient")}))
        assert shows(found, "bias_temperature", before) is there
        assert shows(found, "bias_temperature", gm.model_from_effects(["bias"]))


def test_the_extended_model_states_the_noise_that_there_is(rng: np.random.Generator):
    """Stated three times too small, it had stayed so in the model, and in what `compensate` says of its results."""
    stated = gm.model_from_effects(["bias"])
    white = float(np.deg2rad(1.0 / 3600.0) * np.sqrt(STEP))
    stated = replace(stated, noise={"noise_white": jnp.asarray(white / 3.0)})
    found = gm.diagnose(unit(rng, 1.0), stated, hold_out=False)
    assert any("3.0" in line or "2.9" in line or "3.1" in line for line in found.findings)
    assert float(found.extended.model.noise["noise_white"]) == pytest.approx(white, rel=0.1)


def test_many_dwells_that_stand_apart_are_no_gross_errors(rng: np.random.Generator):
    """Ten of sixty, by twenty standard deviations either way: something makes them."""
    rate = np.repeat(rng.permutation(np.tile([-60.0, -30.0, 0.0, 30.0, 60.0], 12)), 8)
    off = np.repeat(20.0 * rng.choice([-1.0, 1.0], 60) * (rng.permutation(60) < 10), 8)
    output = 3600.0 * rate + off + rng.standard_normal(480)
    log = gm.Campaign(
        {"time": 5.0 * np.arange(480), "rate": rate, "output": output},
        {"time": "s", "rate": "deg/s", "output": "deg/h"},
        {"kind": "rate"},
    )
    found = gm.diagnose(log, gm.model_from_effects(["scale_factor", "bias"]), hold_out=False)
    assert found.verdict == "unknown"
    # Where steps are found among them first, dwells are left that the search could not add.
    told = ("so many are no gross errors", "More remains than was named")
    assert any(words in line for line in found.findings for words in told)


def test_calibrated_thresholds_are_not_of_noise(monkeypatch: pytest.MonkeyPatch):
    """No draw is searched for noise beyond what is stated: it keeps the safe threshold, and no p-value is of it."""
    rng = np.random.default_rng(3)
    monkeypatch.setattr(_searches, "null_scores", lambda *_: np.full(400, 1.5))
    stated = replace(
        gm.model_from_effects(["bias"]),
        noise={"noise_white": jnp.asarray(float(np.deg2rad(1.0 / 3600.0) * np.sqrt(STEP)))},
    )
    log = unit(rng, 1.0, np.cumsum(0.1 * rng.standard_normal(ROWS)))
    session = _searches.searched([log], stated, 400, 0, lambda line, done: None).session
    ranking = session.steps.rank(session.baseline, [])
    assert session.steps.least(ranking, "bias_drift") == pytest.approx(1.5)
    assert session.steps.least(ranking, "noise_random_walk") > 3.0
    assert max(ranking.statistic, key=ranking.statistic.__getitem__) == "noise_random_walk"
    found = gm.diagnose(log, stated, hold_out=False, calibrate=400)
    assert found.threshold_kind == "calibrated"
    assert found.p_value == (1.0 / 401.0 if ranking.significance > 1.5 else 1.0)
