"""Error budgets: closed forms, dense linear algebra, published indices and designs.

Ishigami's indices (a = 7, b = 0.1) are those of Saltelli and others, *Global Sensitivity Analysis: The Primer*, 2008,
p. 182; D-optimal designs of a line and of a parabola on [−1, 1] those of Atkinson, Donev and Tobias, *Optimum
Experimental Designs*, 2007, chapter 11.
"""

from __future__ import annotations

import itertools
import json
import re
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import norm

from gyromodel import CampaignError, cli
from gyromodel.campaign import Campaign
from gyromodel.effects.converter import Quantisation
from gyromodel.effects.drivers import Bias
from gyromodel.effects.scale import ScaleFactor, ScaleNonlinearity, ScaleTemperature
from gyromodel.effects.thermal import BiasTemperature, BiasTemperatureRate
from gyromodel.estimate import Calibration, fit, two_stage
from gyromodel.model import GyroModel, ModelError
from gyromodel.model_files import write_model
from gyromodel.numerics.uncertain import Uncertain
from gyromodel.report import plan_sentence
from gyromodel.signals import read_signals
from gyromodel.simulation import simulate
from gyromodel.study import (
    OUTCOMES,
    Instrument,
    Outcome,
    Part,
    _mission,
    _next,
    best_plan,
    covariance_after,
    information,
    known,
    read_candidates,
    sensitivity,
    sobol_indices,
    symmetric_factor,
)
from gyromodel.study._known import models_at
from gyromodel.study._mission import read_mission
from gyromodel.study._next import slower

DEG_H = np.pi / 180 / 3600
ROWS, STEP = 200, 10.0
WHITE, WALK = 1e-6, 1e-10


def mission(
    rate: float = 0.0, temperature: float | np.ndarray = 20.0, step: float = STEP, **metadata: float
) -> Campaign:
    """Deg/s and °C over 2000 s."""
    time = np.arange(ROWS) * step
    columns = {"time": time, "rate": np.full(ROWS, rate), "temperature": np.zeros(ROWS) + temperature, "output": time}
    units = {"time": "s", "rate": "deg/s", "temperature": "degC", "output": "deg/s"}
    return Campaign(columns, units, {"kind": "rate", **metadata}, "mission")


RAMP = np.linspace(20.0, 60.0, ROWS)
THERMAL = (Bias(value=2 * DEG_H), BiasTemperature(coefficient=0.1 * DEG_H, reference=20.0))
NOISE = {"noise_white": WHITE, "noise_random_walk": WALK}
# Of the same structure, so that one compiled program serves both.
WHITE_ALONE = NOISE | {"noise_random_walk": 0.0}


def thermal(covariance: np.ndarray, noise: dict[str, float] | None = None) -> Calibration:
    return Calibration(GyroModel(THERMAL, NOISE if noise is None else noise), covariance)


COVARIANCE = np.array([[0.04, -0.0005], [-0.0005, 1e-4]]) * DEG_H**2


def test_a_scale_factor_error_turns_into_an_angle():
    """t ω σ_S/S."""
    model = GyroModel((ScaleFactor(value=2.0, unit="1"),))
    found = sensitivity(Calibration(model, np.array([[1e-6**2 * 4]])), mission(rate=10.0), ["angle", "rate"])
    angle, rate = (result.budget for result in found.results)
    assert angle.std == pytest.approx(2000.0 * 10.0 * 1e-6)
    assert rate.std == pytest.approx(10.0 * 3600 * 1e-6)
    assert angle.rows[0].sensitivity == pytest.approx(2000.0 * 10.0 / 2.0)
    assert not found.tests
    assert "no noise" in found.warnings[0]
    assert found.history.std[-1] == pytest.approx(angle.std)
    assert found.history.std[0] == pytest.approx(angle.std / ROWS)


def test_correlated_errors_cancel():
    """At 21 °C bias and slope enter alike: var = σ² + σ² + 2 r σ²."""
    r = -0.99
    found = sensitivity(thermal(np.array([[1, r], [r, 1]]) * DEG_H**2), mission(temperature=21.0), ["rate"])
    budget = found.results[0].budget
    assert budget.std == pytest.approx(np.sqrt(2 + 2 * r))
    assert [row.alone for row in budget.rows] == pytest.approx([1.0, 1.0])
    assert [row.share for row in budget.rows] == pytest.approx([0.5, 0.5])


def test_noise_and_instruments_have_closed_forms():
    """White: N√t; random walk from the start: K √(t³/3); one thermometer error: slope·t, one a sample: /√n."""
    t = ROWS * STEP
    found = sensitivity(
        thermal(COVARIANCE),
        mission(temperature=RAMP),
        ["angle", "rate"],
        instruments={"temperature": Instrument(0.5, 0.2)},
    )
    angle, rate = (result.budget for result in found.results)
    assert np.deg2rad(angle.noise["noise_white"]) == pytest.approx(WHITE * np.sqrt(t))
    assert np.deg2rad(angle.noise["noise_random_walk"]) == pytest.approx(WALK * np.sqrt(t**3 / 3), rel=0.01)
    assert rate.noise["noise_white"] * DEG_H == pytest.approx(WHITE / np.sqrt(STEP))
    assert set(angle.noise) == {"noise_white", "noise_random_walk"}
    slope = 0.1 / 3600 * t
    assert angle.instruments["temperature"] == pytest.approx(slope * np.hypot(0.5, 0.2 / np.sqrt(ROWS)))
    assert rate.instruments["temperature"] == pytest.approx(0.1 * np.hypot(0.5, 0.2))


@pytest.fixture
def averaged(monkeypatch: pytest.MonkeyPatch) -> None:
    """Missions and tests above 20 000 rows are averaged."""
    for room in (_mission, _next):
        monkeypatch.setattr(room, "LONGEST", 20_000)


def test_steps_of_the_output_are_noise_of_a_mission():
    """A step much finer than the noise adds a twelfth of its square."""
    white, step = WHITE / np.sqrt(STEP), 0.8 * WHITE / np.sqrt(STEP)
    model = GyroModel((*THERMAL, Quantisation(step=step, unit="deg/s")), NOISE)
    found = sensitivity(Calibration(model, COVARIANCE), mission(temperature=RAMP), ["rate"])
    read = np.sqrt(white**2 + step**2 / 12)
    assert found.results[0].budget.noise["noise_white"] * DEG_H == pytest.approx(read, rel=1e-3)


@pytest.mark.usefixtures("averaged")
def test_a_long_mission_has_the_noise_and_the_errors_of_its_samples():
    """The same ramp at a hundred times the rate, which is averaged: a rate's noise is that of one sample."""
    rows = 100 * ROWS + 100
    time = np.arange(rows) * STEP / 100
    columns = {"time": time, "rate": 0 * time, "temperature": np.linspace(20.0, 60.0, rows), "output": time}
    long = Campaign(columns, {"time": "s", "rate": "deg/s", "temperature": "degC", "output": "deg/s"}, {"kind": "rate"})
    errors = {"temperature": Instrument(0.0, 0.5)}
    found = sensitivity(thermal(COVARIANCE, WHITE_ALONE), long, ["angle", "rate"], instruments=errors)
    angle, rate = (result.budget for result in found.results)
    t = rows * STEP / 100
    assert rate.noise["noise_white"] * DEG_H == pytest.approx(WHITE / np.sqrt(STEP / 100))
    assert rate.instruments["temperature"] == pytest.approx(0.1 * 0.5)
    assert np.deg2rad(angle.noise["noise_white"]) == pytest.approx(WHITE * np.sqrt(t), rel=1e-3)
    assert angle.instruments["temperature"] == pytest.approx(0.1 / 3600 * t * 0.5 / np.sqrt(rows), rel=1e-3)
    assert "averaged by 2 samples" in found.warnings[0]


@pytest.mark.parametrize("rows", [20_000, 20_001, 50_000])
def test_a_rate_that_alternates_keeps_the_error_of_a_scale_factor(rows: int):
    """100 ppm of 10 deg/s, whichever way the gyro turns."""
    rate = np.where(np.arange(rows) % 2, 10.0, -10.0)
    units = {"time": "s", "rate": "deg/s", "output": "deg/s"}
    turned = Campaign({"time": 1.0 * np.arange(rows), "rate": rate, "output": rate}, units, {"kind": "rate"})
    model = GyroModel((ScaleFactor(value=1.0, unit="1"),), {"noise_white": WHITE})
    flown, _ = read_mission(turned, (model,))
    errors = flown.errors(models_at((model,), jnp.array([1.0 + 1e-4])))
    assert np.abs(errors[0, :rows]) == pytest.approx(np.deg2rad(1e-3), rel=1e-3)
    told = information(model, turned)
    assert told == pytest.approx(np.array([[rows * np.deg2rad(10.0) ** 2 / WHITE**2]]))


@pytest.mark.usefixtures("averaged")
def test_what_a_long_test_tells_counts_each_sample():
    """Of errors that each sample has by itself, a test of twice the samples tells twice as much, averaged or not."""
    model, errors = GyroModel(THERMAL, WHITE_ALONE), {"temperature": Instrument(0.0, 50.0)}

    def told(rows: int) -> np.ndarray:
        time = np.arange(rows) * 0.1
        columns = {"time": time, "temperature": np.linspace(20.0, 60.0, rows), "output": time}
        units = {"time": "s", "temperature": "degC", "output": "deg/s"}
        return information(model, Campaign(columns, units, {"kind": "rate"}), errors)

    np.testing.assert_allclose(told(30_000), 2 * told(15_000), rtol=1e-3)


def test_a_slower_course_has_no_further_runs():
    """And a run behind a gap begins with its power-on there too."""
    runs, half = np.repeat([1.0, 2.0], ROWS // 2), ROWS // 2
    time = STEP * np.arange(ROWS) + 3600.0 * (runs > 1)
    course = slower(mission(temperature=RAMP).with_column("run", runs, "1").with_column("time", time, "s"))
    assert course.columns["run"].tolist() == np.repeat([1.0, 2.0], ROWS).tolist()
    rises = np.diff(course.columns["temperature"])[:-1]
    assert np.delete(rises, [ROWS - 2, ROWS - 1]) == pytest.approx(0.5 * (RAMP[1] - RAMP[0]))
    assert rises[ROWS - 2 : ROWS] == pytest.approx([0.0, RAMP[1] - RAMP[0]])
    on = np.asarray(read_signals(course.with_column("output", np.arange(2.0 * ROWS), "deg/s")).signals["time_on"])
    assert on[: 2 * ROWS].tolist() == [*(STEP * np.arange(2 * half)), *(STEP * np.arange(2 * half))]


def test_draws_bear_the_first_order_out_and_shares_add_up(seed: int):
    """Draws differ by more than four standard errors in 1 of 16 000."""
    found = sensitivity(thermal(COVARIANCE), mission(temperature=RAMP), seed=seed)
    assert [r.budget.outcome for r in found.results] == ["rate", "angle", "peak", "bias_temperature"]
    for result in found.results:
        assert sum(row.share for row in result.budget.rows) == pytest.approx(1.0)
        assert result.drawn.agrees
        assert bool(result.sobol) == (result.budget.outcome == "peak")
    bt = found.results[3].budget
    assert (bt.value, bt.std) == (pytest.approx(0.1), pytest.approx(0.01))
    peak = found.results[2]
    assert peak.drawn.std >= peak.budget.std * 0.95  # the largest of many is larger than each


def test_an_outcome_that_bends_is_found_out(seed: int):
    """b + b²/σ: the draws' mean square is σ² + 3σ², and half of the variance is that of b² by itself."""
    sigma = 0.2 * DEG_H

    def bent(mission, model):
        change = model.effects[0].value - mission.models[0].effects[0].value
        return change + change**2 / sigma

    outcome = Outcome("bent", "deg/h", bent, of="models")
    [result] = sensitivity(thermal(COVARIANCE), mission(temperature=RAMP), [outcome], seed=seed, draws=4000).results
    assert result.budget.std == pytest.approx(0.2)
    assert not result.drawn.agrees
    assert result.drawn.std == pytest.approx(0.4, abs=6 * result.drawn.std_error)
    assert result.sobol[0].name == "bias value"
    assert result.sobol[0].total == pytest.approx(1.0, abs=0.1)


def test_stages_are_kept_apart():
    """Two sources with variances 1 and 3."""
    model = GyroModel(THERMAL, NOISE)
    first = Uncertain.stated(jnp.zeros(2), np.array([1.0, 0.0]), "rate table")
    second = Uncertain.stated(jnp.zeros(2), np.array([3.0, 0.0]), "chamber")
    both = Uncertain(np.asarray(model.vector()), model.with_vector, {**first.sources, **second.sources})
    stages = sensitivity(both, mission(), ["rate"]).results[0].budget.stages
    assert stages == {"rate table": pytest.approx(0.25), "chamber": pytest.approx(0.75)}


def test_figures_of_merit_of_the_scale_factor_have_closed_forms(seed: int):
    """Of a part k of the output at full rate as its square, the best line leaves k (x² − 1/3) of |x| ≤ 1."""
    effects = (
        ScaleFactor(value=1.0, unit="1"),
        ScaleNonlinearity(coefficients=jnp.array([300e-6]), powers=(2,), full_rate=np.deg2rad(10.0)),
        ScaleTemperature(coefficient=-20e-6, reference=25.0),
    )
    flight = mission(temperature=RAMP)
    flight = flight.with_column("rate", np.linspace(-10.0, 10.0, ROWS), "deg/s")
    covariance = np.diag([50e-6, 30e-6, 2e-6]) ** 2
    names = ["scale_factor", "scale_nonlinearity", "scale_temperature"]
    results = sensitivity(Calibration(GyroModel(effects, NOISE), covariance), flight, names, seed=seed).results
    factor, nonlinearity, temperature = (r.budget for r in results)
    # The mission's mean temperature is 40 °C, its mean rate zero.
    assert (factor.unit, factor.value) == ("ppm", pytest.approx(0.0, abs=1e-6))
    assert factor.std == pytest.approx(np.hypot(50.0, 2.0 * 15.0), rel=1e-2)
    assert (nonlinearity.value, nonlinearity.std) == (pytest.approx(100.0, rel=0.02), pytest.approx(10.0, rel=0.02))
    assert (temperature.value, temperature.unit) == (pytest.approx(20.0, rel=1e-6), "ppm/degC")
    assert temperature.std == pytest.approx(2.0, rel=1e-6)
    assert all(r.drawn.agrees for r in results)


def test_stages_go_through_the_model_s_file(tmp_path: Path, capsys: pytest.CaptureFixture[str], seed: int):
    """A bias from a soak, held while its temperature's coefficient is fitted."""
    soak, ramp = (mission(temperature=t) for t in (20.0, RAMP))
    model = GyroModel(THERMAL, WHITE_ALONE)
    first = fit(simulate(model, soak, seed=seed % 1000), GyroModel(THERMAL[:1], WHITE_ALONE), name="soak")
    held = GyroModel((first.model.effects[0], THERMAL[1]), WHITE_ALONE, frozenset({("bias", "value")}))
    second = two_stage(first, fit(simulate(model, ramp, seed=seed % 1000 + 1), held, name="ramp"))
    path, plan = tmp_path / "model.yaml", tmp_path / "plan.yaml"
    write_model(second, path)
    plan.write_text(PLAN, encoding="utf-8")
    assert run(path, "--plan", plan, "--outcome", "angle", "--json") == 0
    stages = json.loads(capsys.readouterr().out)["outcomes"]["angle"]["stages"]
    assert set(stages) == {"soak", "ramp"}
    assert stages["soak"] == pytest.approx(1 - second.own_covariance[0, 0] / second.covariance[0, 0])
    assert 0.05 < stages["soak"] < 0.95
    text = path.read_text(encoding="utf-8")
    for change, said in (
        (("- name: soak", "- nam: soak"), "unknown key 'nam'"),
        (("degrees_of_freedom: 199.0", "degrees_of_freedom: many"), "many"),
        (("factor:\n    - - [^\n]*", "factor:\n    - - 1.0"), "do not add up"),
    ):
        changed = re.sub(*change, text, count=1)
        assert changed != text
        path.write_text(changed, encoding="utf-8")
        assert run(path, "--plan", plan, "--outcome", "angle") == 1
        assert said in capsys.readouterr().err


@pytest.mark.long
def test_three_gyros_turn_a_platform():
    """Tilts b sin(ωt)/ω with Schuler's ω, and b t in azimuth, to what the Earth turns in ten minutes: 4 %."""
    covariance = np.diag([0.04, 1e-12]) * DEG_H**2
    found = sensitivity(thermal(covariance), mission(step=3.0, latitude_deg=40.0), ["attitude"], draws=1000)
    budget, drawn = found.results[0].budget, found.results[0].drawn
    t, w = ROWS * 3.0, np.sqrt(9.8 / 6.37e6)
    expected = 0.2 / 3600 * np.sqrt((2 * (np.sin(w * t) / w) ** 2 + t**2) / 3)
    assert budget.std / 60 == pytest.approx(expected, rel=0.04)
    assert drawn.agrees
    assert budget.rows[0].share == pytest.approx(1.0)
    assert len(budget.rows) == 2


def ishigami(z: np.ndarray) -> np.ndarray:
    x = np.pi * (2 * norm.cdf(z) - 1)
    return np.sin(x[:, 0]) + 7 * np.sin(x[:, 1]) ** 2 + 0.1 * x[:, 2] ** 4 * np.sin(x[:, 0])


def test_sobol_indices_of_ishigamis_function(seed: int):
    found = sobol_indices(ishigami, ["a", "b", "c"], base=4096, seed=seed % 1000)
    assert [i.first for i in found] == pytest.approx([0.3139, 0.4424, 0.0], abs=0.04)
    assert [i.total for i in found] == pytest.approx([0.5576, 0.4424, 0.2437], abs=0.04)
    assert all(0 < i.first_conf < 0.1 for i in found)


def test_the_symmetric_factor_is_a_root_that_treats_all_alike():
    std = np.array([1.0, 10.0, 0.1])
    correlation = np.array([[1, 0.5, 0.2], [0.5, 1, -0.3], [0.2, -0.3, 1]])
    root = symmetric_factor(correlation * np.outer(std, std))
    assert root @ root.T == pytest.approx(correlation * np.outer(std, std))
    scaled = root / std[:, None]
    assert scaled == pytest.approx(scaled.T)


def test_what_a_test_tells_is_that_of_the_dense_covariance():
    """V = σ²I + c cᵀ + diag, inverted as a whole."""
    model = thermal(COVARIANCE, WHITE_ALONE).model
    instruments = {"temperature": Instrument(0.5, 0.2), "rate": Instrument(1e-6)}
    told = information(model, mission(temperature=RAMP), instruments)
    j = np.column_stack([np.ones(ROWS), RAMP - 20.0])
    v = np.eye(ROWS) * WHITE**2 / STEP + (0.1 * DEG_H) ** 2 * (0.25 * np.ones((ROWS, ROWS)) + 0.04 * np.eye(ROWS))
    v += 1e-12 * np.ones((ROWS, ROWS))
    assert told == pytest.approx(j.T @ np.linalg.solve(v, j), rel=1e-6)
    after = covariance_after(np.linalg.cholesky(COVARIANCE), told)
    assert after == pytest.approx(np.linalg.inv(np.linalg.inv(COVARIANCE) + told), rel=1e-6)


def test_a_table_that_errs_by_a_part_of_its_rate_errs_both_ways():
    """Its error is one of the scale factor, in rates of either sign, and none of the bias."""
    rate = np.where(np.arange(ROWS) % 2, 100.0, -100.0)
    campaign, model = mission().with_column("rate", rate, "deg/s"), GyroModel(LINE, {"noise_white": WHITE})
    told = information(model, campaign, {"rate": Instrument(common_part=1e-3)})
    std = np.sqrt(np.diag(np.linalg.inv(told)))
    noise = WHITE / np.sqrt(STEP * ROWS)
    assert std[0] == pytest.approx(np.hypot(1e-3, noise / np.deg2rad(100.0)), rel=1e-6)
    assert std[1] == pytest.approx(noise, rel=1e-6)
    # Of a mission that turns as far back as forth nothing is left of the angle, whatever the thermometer's share.
    swing = mission(temperature=np.where(np.arange(ROWS) % 2, 5.0, -5.0))
    part = {"temperature": Instrument(common_part=0.1)}
    found = sensitivity(thermal(COVARIANCE, WHITE_ALONE), swing, ["angle", "rate"], instruments=part)
    angle, each = (result.budget for result in found.results)
    assert angle.instruments["temperature"] < 1e-6
    assert each.instruments["temperature"] == pytest.approx(0.1 * 0.5)


def test_the_next_test_halves_the_variance_of_the_last():
    """After a campaign of white noise alone, the same again."""
    j, campaign = np.column_stack([np.ones(ROWS), RAMP - 20.0]), mission(temperature=RAMP)
    estimate = thermal(WHITE**2 / STEP * np.linalg.inv(j.T @ j), WHITE_ALONE)
    found = sensitivity(estimate, campaign, ["angle"], instruments={"temperature": Instrument(1.0)})
    free = sensitivity(estimate, campaign, ["angle"])
    now = free.results[0].budget.std
    then = {test.sentence: test.std["angle"] for test in free.tests}
    assert then["Repeat the run."] == pytest.approx(now / np.sqrt(2), rel=1e-3)
    assert then["Repeat the run with half the noise."] == pytest.approx(now / np.sqrt(5), rel=1e-3)
    assert list(then.values()) == sorted(then.values())
    assert "half the noise" in (free.instrument_to_improve() or "")
    with_thermometer = {test.sentence: test.std["angle"] for test in found.tests}
    better = with_thermometer["Repeat the run with half the error of the temperature."]
    assert then["Repeat the run."] < better < with_thermometer["Repeat the run."] < now


def levels(rates: list[float]) -> list[Part]:
    """One minute at each rate (deg/s)."""
    parts = []
    for rate in rates:
        time = np.arange(6) * STEP
        columns = {"time": time, "rate": np.full(6, rate), "output": time}
        units = {"time": "s", "rate": "deg/s", "output": "deg/s"}
        parts.append(Part(f"{rate:g}", 60.0, Campaign(columns, units, {"kind": "rate"}, f"{rate:g}")))
    return parts


LINE = (ScaleFactor(value=1.0, unit="1"), Bias())
PARABOLA = (*LINE, ScaleNonlinearity(coefficients=jnp.zeros(1), powers=(2,), full_rate=np.deg2rad(2.0)))


def gyro(effects: tuple) -> GyroModel:
    return GyroModel(effects, {"noise_white": WHITE})


def test_the_d_optimal_line_is_measured_at_its_ends():
    """Ten minutes: Σr² is 40 instead of the 20 of each rate twice."""
    calibration = Calibration(gyro(LINE), np.eye(2))
    choice = best_plan(known(calibration), levels([-2, -1, 0, 1, 2]), 600.0, anew=True)
    assert choice.best.times == {"-2": 5, "2": 5}
    assert choice.equal.times == dict.fromkeys(("-2", "-1", "0", "1", "2"), 2)
    assert choice.gain == pytest.approx(2**0.25, rel=1e-4)


def test_the_d_optimal_parabola_is_measured_at_its_ends_and_in_the_middle():
    calibration = Calibration(gyro(PARABOLA), np.eye(3))
    choice = best_plan(known(calibration), levels([-2, -1.5, -1, -0.5, 0, 0.5, 1, 1.5, 2]), 540.0, anew=True)
    assert choice.best.times == {"-2": 3, "0": 3, "2": 3}


def test_the_plan_for_an_outcome_is_the_best_of_all():
    """The line at 2 deg/s, over all ways to spend six minutes on four rates."""
    rates, x = [-1.0, 0.0, 1.0, 1.5], np.deg2rad(2.0)
    calibration = Calibration(gyro(LINE), np.eye(2))
    seen = np.array([[x, 1.0]])
    choice = best_plan(known(calibration), levels(rates), 360.0, "outcome", jacobian=seen, anew=True)
    variances = []
    for n in itertools.product(range(7), repeat=4):
        if sum(n) == 6 and sum(k > 0 for k in n) > 1:
            j = np.repeat([[np.deg2rad(r), 1.0] for r in rates], n, axis=0)
            variances.append(float((seen @ np.linalg.inv(j.T @ j) @ seen.T)[0, 0]) * WHITE**2 / 60.0)
    assert (seen @ choice.best.covariance @ seen.T)[0, 0] == pytest.approx(min(variances), rel=1e-4)


def test_rivals_are_told_apart_by_the_plan_that_parts_them_most(seed: int):
    """A slope over temperature and one over its rate, of all plans of three parts.

    Δχ² of the rival's fit and the right one's has the mean s² over draws, s their separation: from least squares on
    columns written out here, of an open bias and one effect.
    """
    white, courses = 3e-4, {"cold": np.full(ROWS, 20.0), "mild": np.full(ROWS, 40.0), "ramp": RAMP}
    parts = [Part(name, ROWS * STEP, mission(temperature=course)) for name, course in courses.items()]
    calibration = Calibration(GyroModel((Bias(),), {"noise_white": white}), np.array([[1.0]]))
    rivals = [BiasTemperature.id, BiasTemperatureRate.id]
    choice = best_plan(known(calibration), parts, 3 * ROWS * STEP, "discrimination", rivals=rivals)
    sigma = white / np.sqrt(STEP)
    # Typical sizes are 1 deg/h/°C and 1000 deg/h/(°C/s).
    of = {name: (DEG_H * course, 1000 * DEG_H * np.gradient(course, STEP)) for name, course in courses.items()}

    def shown(times: dict[str, float]) -> list[np.ndarray]:
        return [np.concatenate([of[name][k] for name, n in times.items() for _ in range(int(n))]) for k in (0, 1)]

    def misfit(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        x = np.column_stack([np.ones(len(x)), x])
        return ((y - x @ np.linalg.lstsq(x, y, rcond=None)[0]) ** 2).sum(axis=0) / sigma**2

    def separation(times: dict[str, float]) -> float:
        a, b = shown(times)
        return float(np.sqrt(min(misfit(b, a[:, None]), misfit(a, b[:, None]))[0]))

    every = [dict(zip(courses, n, strict=True)) for n in itertools.product(range(4), repeat=3) if sum(n) == 3]
    assert choice.equal.times == {"cold": 1, "mild": 1, "ramp": 1}
    assert choice.best.separation == pytest.approx(max(map(separation, every)), rel=1e-3)
    assert choice.equal.separation == pytest.approx(separation(choice.equal.times), rel=1e-3)
    assert choice.gain == pytest.approx(choice.best.separation / choice.equal.separation)
    assert choice.gain > 1.05
    for plan in (choice.best, choice.equal):
        mean = []
        for right, wrong in (shown(plan.times), shown(plan.times)[::-1]):
            y = right[:, None] + sigma * np.random.default_rng(seed).standard_normal((len(right), 400))
            change = misfit(wrong, y) - misfit(right, y)
            mean.append((change.mean(), change.std() / 20))
        assert min(m for m, _ in mean) == pytest.approx(plan.separation**2, abs=5 * max(e for _, e in mean))


def test_the_gain_of_a_plan_knows_no_order_of_its_parts():
    """Of soaks that do not all fit into the time, each has its share."""
    parts = [Part(f"{t:g}", ROWS * STEP, mission(temperature=t)) for t in (20.0, 30.0, 45.0, 60.0)]
    calibration = known(thermal(COVARIANCE, WHITE_ALONE))
    forth, back = (best_plan(calibration, each, 2.5 * ROWS * STEP) for each in (parts, parts[::-1]))
    assert forth.gain == pytest.approx(back.gain, rel=1e-9)
    assert forth.equal.times == dict.fromkeys(("20", "30", "45", "60"), 0.5)
    assert forth.equal.duration == forth.best.duration == 2 * ROWS * STEP
    assert "by each part as often" in plan_sentence(forth, "angle")
    # One of two that are both needed is no better than half of each.
    line = known(Calibration(gyro(LINE), np.eye(2)))
    one = best_plan(line, levels([0, 2]), 119.0, anew=True)
    assert one.gain < 1.0
    assert "Each part as often, in shares, would tell more" in plan_sentence(one, "angle")


def test_an_instrument_s_error_is_one_in_all_parts():
    """A table that errs by 1 deg/h leaves that of the bias, however often a part is repeated."""
    calibration = known(Calibration(gyro((Bias(),)), np.eye(1)))
    errors = {"rate": Instrument(common=DEG_H)}
    for budget in (60.0, 6000.0):
        choice = best_plan(calibration, levels([0, 1]), budget, instruments=errors)
        noise = WHITE / np.sqrt(budget)
        assert choice.best.covariance[0, 0] == pytest.approx(DEG_H**2 + noise**2, rel=1e-4)
    # Of three gyros on one table each has it.
    three = known([Calibration(gyro((Bias(),)), np.eye(1))] * 3)
    choice = best_plan(three, levels([0, 1]), 6000.0, instruments=errors)
    assert np.diag(choice.best.covariance) == pytest.approx(np.full(3, DEG_H**2 + WHITE**2 / 6000.0), rel=1e-4)


def test_a_changeover_takes_its_time_with_each_part(tmp_path: Path):
    """Five parts of 2000 s fill 10 000 s; with 500 s between them, four do."""
    path = tmp_path / "candidates.yaml"
    calibration = known(thermal(COVARIANCE))
    for text, most in (("", 5), ("changeover: 500 s\n", 4)):
        path.write_text(text + CANDIDATES, encoding="utf-8")
        choice = best_plan(calibration, read_candidates(path), 10_000.0)
        assert [sum(plan.times.values()) for plan in (choice.best, choice.equal)] == [most, most]
        assert choice.best.duration == 10_000.0
        assert "changeover" not in read_candidates(path)[0].campaign.metadata
    of_list = CANDIDATES.replace("{temperature: 60 degC}", "[temperature]")
    for text, said in (
        ("changeover: 500\n" + CANDIDATES, "changeover: expected a time above zero with its unit"),
        (of_list, "candidate warm: columns must map"),
    ):
        path.write_text(text, encoding="utf-8")
        with pytest.raises(CampaignError, match=said):
            read_candidates(path)


def test_plans_that_cannot_be_say_why():
    line, steps = known(Calibration(gyro(LINE), np.eye(2))), levels([-1, 0, 1])
    for options, expected in (
        ({}, "two rival effects"),
        ({"rivals": ["bias_temperature", "bias_temperature"]}, "two rival effects"),
        ({"rivals": ["bias", "scale_nonlinearity"]}, "has bias already"),
        ({"rivals": ["bias_temperature", "scale_nonlinearity"]}, "needs a column temperature"),
        # Odd in the rate, as the scale factor is on these three rates.
        ({"rivals": ["scale_sagnac_sine", "scale_asymmetry"]}, "no plan of these candidates"),
        ({"budget": 10.0}, "fits into"),
        ({"budget": np.inf}, "more than 10000 times"),
    ):
        with pytest.raises(ModelError, match=expected):
            best_plan(line, steps, **{"budget": 600.0, "criterion": "discrimination", **options})
    with pytest.raises(ModelError, match="no uncertainty"):
        best_plan(line, steps, 600.0, "outcome", jacobian=np.zeros((1, 2)))


def test_a_calibration_without_errors_has_none_to_draw():
    for result in sensitivity(thermal(np.zeros((2, 2))), mission(temperature=RAMP), ["angle"]).results:
        assert (result.budget.std, result.drawn.agrees, result.sobol) == (0.0, True, ())


PLAN = """
kind: rate
duration: 2000 s
interval: 10 s
output: deg/s
instruments: {temperature: 0.5 degC}
columns:
  rate: 0 deg/s
  temperature: [{for: 2000 s, from: 20 degC, to: 60 degC}]
"""
CANDIDATES = """
kind: rate
interval: 10 s
output: deg/s
columns: {rate: 0 deg/s, temperature: 20 degC}
candidates:
  - {name: cold, duration: 2000 s}
  - {name: warm, duration: 2000 s, columns: {temperature: 60 degC}}
"""


def run(*arguments: object) -> int:
    with pytest.raises(SystemExit) as ended:
        cli.main(["sensitivity", *map(str, arguments)])
    return int(ended.value.code or 0)


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("study")
    model = GyroModel(THERMAL, {"noise_white": WHITE})
    write_model(fit(simulate(model, mission(temperature=RAMP), seed=1), model), folder / "model.yaml")
    write_model(model, folder / "bare.yaml")
    (folder / "plan.yaml").write_text(PLAN, encoding="utf-8")
    (folder / "candidates.yaml").write_text(CANDIDATES, encoding="utf-8")
    return folder


def test_the_command_writes_what_it_prints(files: Path, capsys: pytest.CaptureFixture[str]):
    (files / "hot.yaml").write_text(PLAN.replace("to: 60", "to: 90"), encoding="utf-8")
    common = [files / "model.yaml", "--plan", files / "hot.yaml", "-o", files / "out", "--outcome", "angle"]
    assert run(*common, "--candidates", files / "candidates.yaml", "--budget", "2 h") == 0
    said = capsys.readouterr()
    assert "temperature goes from 20 to 89.65 degC, the calibration only from 20 to 60 degC" in said.err
    assert "bias value" in said.out
    assert "Repeat the run." in said.out
    assert "Best plan" in said.out
    written = json.loads((files / "out" / "sensitivity.json").read_text(encoding="utf-8"))
    angle = written["outcomes"]["angle"]
    assert f"{angle['parameters'][0]['share'] * 100:.1f} %" in said.out
    assert sum(row["share"] for row in angle["parameters"]) == pytest.approx(1.0)
    assert {"warm", "cold"} >= set(written["plan"]["best"]["times"])
    for name in ("tornado", "budget"):
        assert "<svg" in (files / "out" / f"{name}.svg").read_text(encoding="utf-8")
    assert run(*common[:3], "--outcome", "angle", "--json") == 0
    again = json.loads(capsys.readouterr().out)
    assert again["outcomes"] == written["outcomes"]


@pytest.mark.long
def test_a_test_plan_is_best_for_what_was_asked(files: Path, capsys: pytest.CaptureFixture[str]):
    """For the first outcome where one is named; three units alike, as navigation needs them, are each measured."""
    text = PLAN.replace("kind: rate", "kind: rate\nlatitude_deg: 50").replace(
        "from: 20 degC, to: 60", "from: 59 degC, to: 60"
    )
    (files / "warm.yaml").write_text(text, encoding="utf-8")
    (files / "exact.yaml").write_text(text.replace("instruments", "# instruments"), encoding="utf-8")
    more = ["--candidates", files / "candidates.yaml", "--budget", "4 h", "--json"]

    def plan(mission: str, *asked: str) -> dict[str, Any]:
        assert run(files / "model.yaml", "--plan", files / mission, *more, *asked) == 0
        return json.loads(capsys.readouterr().out)["plan"]

    plain, rate = plan("exact.yaml"), plan("exact.yaml", "--outcome", "rate")
    attitude = plan("exact.yaml", "--outcome", "attitude", "--outcome", "rate")
    assert (plain["criterion"], rate["criterion"], rate["outcome"], attitude["outcome"]) == (
        "parameters", "outcome", "rate", "attitude"
    )  # fmt: skip
    # All of the mission is warm: so are the parts that serve it, where parameters want both ends.
    assert {*plain["best"]["times"]} == {"cold", "warm"}
    assert {*rate["best"]["times"]} == {"warm"}
    assert attitude["best"]["times"] == rate["best"]["times"]
    # A thermometer that errs in all parts alike is told by the cold end, from the calibration there.
    assert {*plan("warm.yaml", "--outcome", "rate")["best"]["times"]} == {"cold", "warm"}


@pytest.mark.parametrize(
    ("model", "change", "more", "expected"),
    [
        ("bare", None, [], "no covariance"),
        (
            "model",
            ("  temperature: [{for: 2000 s, from: 20 degC, to: 60 degC}]\n", ""),
            [],
            "instruments names temperature",
        ),
        ("model", ("temperature", "pressure"), [], "kPa"),
        ("model", ("0.5 degC", "0.5 V"), [], "no size in a unit like degC"),
        ("model", ("{temperature: 0.5 degC}", "{temperature: {often: 1 degC}}"), [], "common or independent"),
        ("model", None, ["--outcome", "position"], "needs latitude_deg"),
        ("model", None, ["--candidates", "PLAN", "--budget", "1 h"], "list of candidates"),
        ("model", None, ["--candidates", "C", "--budget", "1 s"], "fits into"),
        ("model", None, ["--candidates", "OTHER", "--budget", "4 h"], "instruments names nonsense"),
    ],
)
def test_a_study_that_cannot_be_says_why(
    files: Path, model: str, change: tuple[str, str] | None, more: list[str], expected: str,
    capsys: pytest.CaptureFixture[str],
):  # fmt: skip
    (files / "bent.yaml").write_text(PLAN.replace(*change) if change else PLAN, encoding="utf-8")
    (files / "other.yaml").write_text("instruments: {nonsense: 1 degC}\n" + CANDIDATES, encoding="utf-8")
    named = {"PLAN": "plan.yaml", "C": "candidates.yaml", "OTHER": "other.yaml"}
    more = [str(files / named[x]) if x in named else x for x in more]
    more = more if "--outcome" in more else [*more, "--outcome", "angle"]
    assert run(files / f"{model}.yaml", "--plan", files / "bent.yaml", *more, "-o", files / "none") == 1
    assert not (files / "none").exists()
    said = capsys.readouterr().err
    assert expected in said
    assert said.count("\n") <= 2
    assert "internal error" not in said


def test_a_budget_without_a_unit_is_wrong_usage(files: Path, capsys: pytest.CaptureFixture[str]):
    common = [files / "model.yaml", "--plan", files / "plan.yaml", "--candidates", files / "candidates.yaml"]
    assert run(*common, "--budget", "4") == 2
    assert "Invalid value for --budget: expected a time above zero" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        (["--outcome", "speed"], "--outcome: no outcome is called speed; there are rate"),
        (["--rival", "bias_drift", "--rival", "speed"], "--rival: unknown effect speed"),
        (["--rival", "bias_drift"], "--rival: effects are told apart where there are two"),
        (["--criterion", "discrimination"], "--rival: effects are told apart where there are two"),
    ],
)
def test_names_that_are_none_are_wrong_usage_before_the_work(
    files: Path, wrong: list[str], said: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.setattr("gyromodel.model_files.read_calibration", None)
    common = [files / "model.yaml", "--plan", files / "plan.yaml", "--candidates", files / "candidates.yaml"]
    assert run(*common, "--budget", "4 h", *wrong) == 2
    assert f"Invalid value for {said}" in " ".join(capsys.readouterr().err.split())


def test_what_is_for_a_test_plan_needs_candidates(files: Path, capsys: pytest.CaptureFixture[str]):
    for option in (["--rival", "bias_drift"], ["--criterion", "parameters"]):
        assert run(files / "model.yaml", "--plan", files / "plan.yaml", *option) == 2
        assert f"{option[0]}: is for a test plan, which needs --candidates" in capsys.readouterr().err


def test_outcomes_that_no_error_reaches_have_an_empty_figure(files: Path, capsys: pytest.CaptureFixture[str]):
    model = GyroModel(THERMAL[:1], {"noise_white": WHITE})
    write_model(fit(simulate(model, mission(temperature=RAMP), seed=1), model), files / "bias.yaml")
    common = [files / "bias.yaml", "--plan", files / "plan.yaml", "-o", files / "empty", "--outcome", "scale_factor"]
    assert run(*common) == 0
    assert "no error of the calibration" in (files / "empty" / "tornado.svg").read_text(encoding="utf-8").lower()


def test_a_mission_that_lacks_a_column_says_which(files: Path, capsys: pytest.CaptureFixture[str]):
    text = PLAN.replace("instruments: {temperature: 0.5 degC}\n", "").replace("  temperature:", "  pressure:")
    (files / "bent.yaml").write_text(text.replace("degC", "kPa"), encoding="utf-8")
    assert run(files / "model.yaml", "--plan", files / "bent.yaml") == 1
    assert "needs a column temperature" in capsys.readouterr().err


def test_one_budget_or_three():
    with pytest.raises(ModelError, match="one calibrated model, or three"):
        known([thermal(COVARIANCE)] * 2)
    three = sensitivity([thermal(COVARIANCE)] * 3, mission(temperature=RAMP), ["rate"]).results[0].budget
    assert {row.name for row in three.rows} >= {"x bias value", "z bias_temperature coefficient"}
    one = sensitivity(thermal(COVARIANCE), mission(temperature=RAMP), ["rate"]).results[0].budget
    assert three.std == pytest.approx(one.std)
    assert sum(row.share for row in three.rows) == pytest.approx(1.0)


def test_outcomes_of_the_catalogue_are_named_after_their_keys():
    assert all(outcome.name == name for name, outcome in OUTCOMES.items())
