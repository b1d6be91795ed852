"""Effects that remember or belong to power cycles: simulators against closed forms, and what the search says."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.stats import binom

import gyromodel as gm
from gyromodel.compensation import compensate
from gyromodel.diagnosis._variance import steps_of_output, stretch_still, thermometers_still, without_still
from gyromodel.effects.memory import BiasThermalHysteresis
from gyromodel.effects.thermal import BiasTemperatureProduct, BiasTemperatureRate
from gyromodel.effects.thermometer import TemperatureLag
from gyromodel.estimate import Calibration
from gyromodel.model import GyroModel, ModelError, make_effect
from gyromodel.model_files import read_model, write_model
from gyromodel.numerics.play import play
from tests.truth import study
from tests.truth.designs import DESIGNS, Design
from tests.truth.effects import SHAPES
from tests.truth.memory import bias_thermal_hysteresis, clipped, dragged, late, rounded, with_late_thermometer


def test_relays_drag_along_as_dry_friction_does():
    """Up by 3 with play of ±0.5, down by 2, up by 0.6: dragged to 2.5, then down to 1.5, then nothing moves."""
    driver = np.concatenate([np.linspace(0, 3, 50), np.linspace(3, 1, 40), np.linspace(1, 1.6, 20)])
    follows = dragged(driver, np.array([0.5]))[:, 0]
    assert follows[[0, 49, 89, 109]] == pytest.approx([0.0, 2.5, 1.5, 1.5], abs=0.01)


@pytest.mark.parametrize("half_width", [0.3, 1.7])
def test_play_operator_is_the_sum_of_relays(half_width: float, rng: np.random.Generator):
    driver = np.cumsum(rng.standard_normal(200))
    found = play(jnp.asarray(driver), jnp.asarray(half_width), jnp.zeros(200, bool))
    assert np.asarray(found) == pytest.approx(
        dragged(driver, np.array([half_width]))[:, 0], abs=2 * np.ptp(driver) / 400
    )


def test_play_forgets_at_a_restart_and_has_a_derivative_by_its_width(rng: np.random.Generator):
    driver = jnp.asarray(np.cumsum(rng.standard_normal(300)))
    restart = jnp.zeros(300, bool).at[120].set(True)
    whole, second = play(driver, jnp.asarray(0.8), restart), play(driver[120:], jnp.asarray(0.8), jnp.zeros(180, bool))
    assert np.asarray(whole[120:]) == pytest.approx(np.asarray(second), rel=1e-12)
    slope = jax.jvp(lambda w: play(driver, w, restart), (jnp.asarray(0.8),), (jnp.ones(()),))[1]
    difference = (
        play(driver, jnp.asarray(0.8 + 1e-6), restart) - play(driver, jnp.asarray(0.8 - 1e-6), restart)
    ) / 2e-6
    assert np.asarray(slope) == pytest.approx(np.asarray(difference), abs=1e-6)
    assert set(np.unique(np.round(slope, 9))) <= {-1.0, 0.0, 1.0}


def test_the_loop_of_friction_has_its_height_at_any_speed(rng: np.random.Generator):
    """Far from reversals the elements all slip: the loop is ± the amplitude, whatever the speed of the ramp."""
    design = DESIGNS["static_cycle"](rng)
    wrong = bias_thermal_hysteresis(design, 2.0, 1.5)
    assert np.abs(wrong).max() == pytest.approx(2.0, rel=0.02)
    rising = design.true["temperature_rate"] > 0.5 * design.true["temperature_rate"].max()
    assert np.quantile(wrong[rising], 0.8) == pytest.approx(2.0, rel=0.02)


def test_a_late_thermometer_lags_a_ramp_by_its_time_constant():
    time = np.arange(0.0, 4000.0, 2.0)
    shown = late(time, 20 + 0.01 * time, 150.0)
    assert (20 + 0.01 * time - shown)[time > 2000] == pytest.approx(1.5, rel=1e-3)


def test_a_monotone_ramp_shows_no_loop(rng: np.random.Generator):
    record = gm.signals.read_signals(
        gm.Campaign(
            {"time": np.arange(100.0), "temperature": np.linspace(0, 40, 100), "output": rng.standard_normal(100)},
            {"time": "s", "temperature": "degC", "output": "deg/h"},
            {"kind": "rate"},
        )
    )
    assert BiasThermalHysteresis.candidates(record.signals) == []


# The answers of single diagnoses below are examples, of fixed seeds; the study counts how often they are right.
EXAMPLE = 1


def campaign_of(design: Design, output: np.ndarray, unit: str = "deg/h") -> gm.Campaign:
    return gm.Campaign(design.columns | {"output": output}, design.units | {"output": unit}, dict(design.metadata))


@pytest.mark.parametrize(
    "effect", ["bias_temperature_rate", pytest.param("bias_thermal_hysteresis", marks=pytest.mark.long)]
)
def test_one_ramp_speed_gives_no_firm_wrong_name(effect: str):
    score = study.run_case(study.Case(EXAMPLE, "one_speed_cycle", "white", effect, 3.0)).score
    assert score is not None
    assert not score.firm_and_wrong


def lagging(rng: np.random.Generator, kind: str) -> tuple[gm.Campaign, float]:
    """A static cycle with a bias over the coil's temperature and a late thermometer, and how late it is (s)."""
    design = DESIGNS["static_cycle"](rng)
    tau = rng.uniform(100.0, 300.0)
    design = with_late_thermometer(design, tau, rng)
    coil = design.true["coil"] - np.quantile(design.true["coil"], 0.25)
    wrong = coil if kind == "line" else coil**2 / 20
    return campaign_of(design, wrong + rng.standard_normal(len(coil))), tau


@pytest.mark.long
def test_a_late_thermometer_under_a_curved_bias_is_named_with_its_delay():
    campaign, tau = lagging(np.random.default_rng(EXAMPLE), "parabola")
    found = gm.diagnose(campaign, gm.model_from_effects(["bias", "bias_temperature_curve"]), hold_out=False)
    # But for a twentieth of it, a late parabola is a Shupe effect that changes with temperature.
    assert found.causes[0].effect == "temperature_lag"
    assert set(found.credible_set) <= {"temperature_lag", "bias_temperature_product"}
    delay = next(p for p in found.causes[0].parameters if p.name == "time_constant")
    assert delay.value == pytest.approx(tau, abs=5 * delay.std)
    assert set(found.extended.model.labels) == {"bias", "temperature_lag"}
    assert "temperature_lag" not in found.not_testable


def with_late_coil(rng: np.random.Generator, tau: float, curved: bool) -> gm.Campaign:
    """A static cycle with a bias over the temperature of a coil that is τ behind the case, where the thermometer is."""
    design = DESIGNS["static_cycle"](rng)
    time, case = design.thermal
    coil = np.interp(design.true["time"], time, late(time, case, tau))
    coil -= np.quantile(coil, 0.25)
    return campaign_of(design, (coil**2 / 20 if curved else coil) + rng.standard_normal(len(coil)))


@pytest.mark.parametrize("curved", [True, pytest.param(False, marks=pytest.mark.long)])
def test_a_coil_far_behind_the_thermometer_is_named_with_its_delay(curved: bool):
    """Its delay is no small part of the cycle, so that b(T) + b'(T) τ dT/dt is not what it makes."""
    rng = np.random.default_rng(EXAMPLE)
    tau = rng.uniform(300.0, 500.0)
    known = "bias_temperature_curve" if curved else "bias_temperature"
    found = gm.diagnose(with_late_coil(rng, tau, curved), gm.model_from_effects(["bias", known]), hold_out=False)
    assert (found.verdict, [c.effect for c in found.causes]) == ("named", ["temperature_lag"])
    delay = next(p for p in found.causes[0].parameters if p.name == "time_constant")
    assert delay.value == pytest.approx(tau, abs=4 * delay.std)
    effect = next(e for e in found.extended.model.effects if e.label == "temperature_lag")
    assert (effect.late, effect.remembers) == ("coil", True)


@pytest.mark.long
def test_a_late_coil_beside_stated_noise_leaves_no_noise_lacking():
    """Its part that the slope at no delay does not hold looks like a random walk, which is found first."""
    campaign = with_late_coil(np.random.default_rng(EXAMPLE), 350.0, curved=True)
    step = float(np.median(np.diff(campaign.si("time"))))
    noise = {"noise_white": jnp.asarray(np.deg2rad(1.0 / 3600.0) * np.sqrt(step))}
    model = gm.model_from_effects(["bias", "bias_temperature_curve"])
    found = gm.diagnose(campaign, GyroModel(model.effects, noise), hold_out=False)
    assert (found.verdict, [c.effect for c in found.causes]) == ("named", ["temperature_lag"])
    assert "As temperature_lag it is the coil that is late, of thermometer and coil." in found.findings


def test_a_late_coil_is_written_and_read(tmp_path):
    effect = TemperatureLag(time_constant=jnp.asarray(300.0), coefficients=jnp.asarray([2.0]), late="coil")
    write_model(GyroModel((effect,)), tmp_path / "model.yaml")
    assert read_model(tmp_path / "model.yaml").effects[0].late == "coil"
    text = (tmp_path / "model.yaml").read_text().replace("coil", "chamber")
    (tmp_path / "other.yaml").write_text(text)
    with pytest.raises(ModelError, match="late takes thermometer or coil"):
        read_model(tmp_path / "other.yaml")


@pytest.mark.long
def test_a_late_thermometer_under_a_straight_bias_is_the_shupe_effect():
    campaign, _ = lagging(np.random.default_rng(EXAMPLE), "line")
    found = gm.diagnose(campaign, gm.model_from_effects(["bias", "bias_temperature"]), hold_out=False)
    assert found.verdict == "ambiguous"
    assert set(found.credible_set) == {"bias_temperature_rate", "temperature_lag"}


@pytest.mark.long
def test_a_lag_beyond_reach_is_not_put_beside_the_shupe_effect():
    """A Shupe effect beside a bias so flat over temperature that the thermometer would have to be an hour late."""
    rng = np.random.default_rng(EXAMPLE)
    design = DESIGNS["static_cycle"](rng)
    output = 0.05 * design.true["temperature"] + 180 * design.true["temperature_rate"]
    output = output + 0.2 * rng.standard_normal(len(output))
    found = gm.diagnose(
        campaign_of(design, output), gm.model_from_effects(["bias", "bias_temperature"]), hold_out=False
    )
    assert (found.verdict, [c.effect for c in found.causes]) == ("named", ["bias_temperature_rate"])


def test_a_lag_of_nothing_is_not_testable(rng: np.random.Generator):
    assert TemperatureLag.continuing([make_effect("bias")], {}) is None
    curve = make_effect("bias_temperature_curve")
    grown = TemperatureLag.continuing([curve], {})
    assert grown is not None
    signals = {
        "temperature": jnp.asarray(rng.normal(20, 5, 30)),
        "temperature_rate": jnp.ones(30),
        "time": jnp.zeros(30),
    }
    curve = curve.with_linear(jnp.asarray([1.0, 2.0])).prepared(signals)
    grown = TemperatureLag.continuing([curve], {})
    assert grown is not None
    assert np.array_equal(grown.contribution(signals), curve.contribution(signals))


@pytest.mark.parametrize("lags", [(150.0,), (0.0, 400.0), (-30.0,)])
def test_a_coil_follows_the_thermometer_through_its_lags(lags: tuple[float, ...], rng: np.random.Generator):
    """Against a fine integration; where nothing was recorded the temperature changes evenly."""
    time = np.concatenate([np.arange(0.0, 3000.0, 10.0), np.arange(3600.0, 6000.0, 10.0)])
    rate = 0.02 * np.interp(time, [0, 500, 900, 2000, 2400, 4000, 4300, 6000], [0, 0, 1, 1, -1, -1, 0, 0])
    temperature = 20 + np.concatenate([[0.0], np.cumsum(0.5 * np.diff(time) * (rate[1:] + rate[:-1]))])
    fine = np.arange(0.0, 6000.0, 0.1)
    drive = np.interp(fine, time, rate)
    gap = (fine > 2990.0) & (fine < 3600.0)
    drive[gap] = (temperature[300] - temperature[299]) / 610.0
    expected = []
    for lag in lags:
        y, late = drive[0], np.empty_like(fine)
        for i, r in enumerate(drive):
            y = r if lag <= 0 else y + 0.1 / lag * (r - y)
            late[i] = y
        ahead = np.gradient(drive, fine) * max(-lag, 0.0)
        expected.append(np.interp(time, fine, late + ahead))
    signals = {"time": time, "temperature": temperature, "temperature_rate": rate}
    signals = {name: jnp.asarray(values) for name, values in signals.items()}
    parts = rng.normal(size=len(lags) - 1)
    effect = BiasTemperatureRate(coefficient=2.0, part=parts, lag=lags)
    truth = 2.0 * expected[0] + sum(p * (e - expected[0]) for p, e in zip(parts, expected[1:], strict=True))
    # A slope is not known to a sample where it jumps.
    smooth = np.ones(len(time), bool) if min(lags) >= 0 else np.abs(np.gradient(np.gradient(rate))) < 1e-9
    found = np.asarray(effect.contribution(signals))
    assert found[smooth] == pytest.approx(truth[smooth], abs=3e-3 * np.abs(truth).max())
    product = BiasTemperatureProduct(coefficient=0.3, at_reference=[2.0], part=parts, lag=lags, reference=20.0)
    truth += 0.3 * (temperature - 20.0) * expected[0]
    assert np.asarray(product.contribution(signals))[smooth] == pytest.approx(
        truth[smooth], abs=3e-3 * np.abs(truth).max()
    )


@pytest.mark.parametrize(
    ("effect", "steps"),
    [
        ("bias_temperature_rate", 24.0),
        pytest.param("bias_temperature_rate", 8.0, marks=pytest.mark.long),
        pytest.param("bias_temperature_product", 24.0, marks=pytest.mark.long),
        pytest.param("bias_temperature_product", 8.0, marks=pytest.mark.long),
    ],
)
def test_a_coil_late_by_many_samples_has_no_other_name(effect: str, steps: float, monkeypatch: pytest.MonkeyPatch):
    """A strong Shupe effect of a coil that heat diffuses into: what its lag leaves must not be named as well."""
    monkeypatch.setitem(SHAPES, effect, lambda design, rng: {"tau": steps * design.step})
    truth = study.build(study.Case(EXAMPLE, "static_cycle", "flicker", effect, 40.0))
    campaign = gm.Campaign(truth.columns, truth.units, truth.metadata)
    found = gm.diagnose(campaign, gm.model_from_effects(list(truth.truth.baseline)), hold_out=False)
    assert (found.verdict, [c.effect for c in found.causes]) == ("named", [effect])
    sizes = {p.name: p for p in found.causes[0].parameters}
    assert sizes["coefficient"].value == pytest.approx(
        truth.truth.amplitude / np.deg2rad(1 / 3600), abs=6 * sizes["coefficient"].std
    )
    if effect == "bias_temperature_rate" and "lag" in sizes:
        # On a steady ramp the mean of a slab is a third of the diffusion time behind its face.
        assert 0.2 < sizes["lag"].value / (steps * truth.design.step) < 0.6


def test_a_lag_of_a_coil_is_kept_in_the_model_file(tmp_path):
    model = GyroModel((BiasTemperatureProduct(coefficient=0.3, at_reference=[2.0], lag=(30.0,), reference=20.0),))
    write_model(model, tmp_path / "model.yaml")
    (again,) = read_model(tmp_path / "model.yaml").effects
    assert eqx.tree_equal(again, model.effects[0], rtol=1e-12)


def test_parts_need_lags():
    with pytest.raises(ValueError, match="part takes a value for each lag after the first"):
        BiasTemperatureRate(part=[1.0])


def test_compensate_refuses_a_memory_of_rates():
    campaign = gm.Campaign(
        {"time": np.arange(20.0), "output": np.arange(20.0)}, {"time": "s", "output": "deg/s"}, {"kind": "rate"}
    )
    with pytest.raises(ModelError, match="rate_hysteresis depends on the rates around"):
        compensate(campaign, Calibration(GyroModel((make_effect("bias"), make_effect("rate_hysteresis")))))


@pytest.mark.long
def test_a_clipped_output_is_saturation():
    """Rates of a table beyond the range of the converter, which simply ends."""
    rng = np.random.default_rng(EXAMPLE)
    design = DESIGNS["rate_steps"](rng)
    limit = rng.uniform(0.6, 0.85) * design.true["rate"].max()
    output = clipped(design.true["rate"], limit) + 1e-5 * rng.standard_normal(len(design.index))
    campaign = campaign_of(design, np.rad2deg(output), "deg/s")
    found = gm.diagnose(campaign, gm.model_from_effects(["scale_factor", "bias"]), hold_out=False)
    assert found.causes[0].effect == "saturation"
    told = next(p for p in found.causes[0].parameters if p.name == "limit")
    assert told.value == pytest.approx(np.rad2deg(limit), abs=max(5 * told.std, 1e-3))


def test_a_range_that_does_not_end_alike_on_both_sides(rng: np.random.Generator):
    """Fitted as one limit it was 3.5 deg/s wrong on both sides, with an uncertainty of 0.03."""
    rate = np.repeat([0.0, 60.0, -60.0, 120.0, -120.0, 180.0, -180.0, 230.0, -230.0, 260.0, -260.0, 300.0, -300.0], 40)
    rate = rate + np.tile(np.linspace(-2.0, 2.0, 40), 13)
    output = np.clip(rate + 0.3, -252.0, 245.0) + 0.15 * rng.standard_normal(len(rate))
    columns = {"time": 0.1 * np.arange(len(rate)), "rate": rate, "output": output}
    campaign = gm.Campaign(columns, {"time": "s", "rate": "deg/s", "output": "deg/s"}, {"kind": "rate"})
    found = gm.diagnose(campaign, gm.model_from_effects(["bias", "scale_factor"]), hold_out=False)
    assert (found.verdict, [c.effect for c in found.causes]) == ("named", ["saturation"])
    told = {p.name: p for p in found.causes[0].parameters}
    for name, limit in (("limit", 245.0), ("lower", -252.0)):
        assert abs(told[name].value - limit) < 5.0 * told[name].std < 0.5


@pytest.mark.long
def test_an_output_that_ends_has_its_errors_before_the_end():
    """Bias and scale move the rate at which a converter ends, not what it tells there."""
    rng = np.random.default_rng(EXAMPLE)
    design = DESIGNS["rate_temperature"](rng)
    rate, warmer = np.rad2deg(design.true["rate"]), design.true["temperature"] - 25.0
    limit = rng.uniform(0.6, 0.85) * rate.max()
    output = clipped((rate + 0.2) * (1.0 + 2e-4 * warmer), limit) + 1e-3 * rng.standard_normal(len(rate))
    found = gm.diagnose(
        campaign_of(design, output, "deg/s"), gm.model_from_effects(["scale_factor", "bias"]), hold_out=False
    )
    assert found.verdict == "named"
    assert {c.effect for c in found.causes} == {"saturation", "scale_temperature"}
    gain = float(found.extended.model.gain())
    told = next(p for c in found.causes if c.effect == "saturation" for p in c.parameters if p.name == "limit")
    assert gain * told.value == pytest.approx(limit, abs=0.002)


@pytest.mark.parametrize(("quantum", "said"), [(0.05, True), (2.0**-4, True), (1e-3, False)])
def test_steps_of_the_output_are_said_of(quantum: float, said: bool, rng: np.random.Generator):
    """A converter of whole numbers under noise of 0.05 deg/s; one much finer than the noise is nobody's concern."""
    output = rounded(0.3 + 0.05 * rng.standard_normal(400), quantum)
    campaign = gm.Campaign(
        {"time": np.arange(400.0), "output": output}, {"time": "s", "output": "deg/s"}, {"kind": "rate"}
    )
    sentence = steps_of_output(campaign)
    assert (sentence is not None) == said
    assert sentence is None or f"steps of {quantum:.5g} deg/s" in sentence


def test_a_sweep_of_rates_is_no_steps_of_the_output(rng: np.random.Generator):
    rate = 10.0 * np.arange(12)
    output = 77_283.0 * rate + 2500.0 * rng.standard_normal(12)
    columns = {"time": np.arange(12.0), "rate": rate, "output": output.round()}
    units = {"time": "s", "rate": "deg/s", "output": "count"}
    assert steps_of_output(gm.Campaign(columns, units, {"kind": "rate"})) is None


@pytest.mark.law
@pytest.mark.parametrize(
    ("quantum", "repeats", "said"), [(0.0, 4, False), (0.0, 7, True), (0.05, 6, False), (0.05, 40, True)]
)
def test_a_stretch_that_stands_still_is_said_of(quantum: float, repeats: int, said: bool, rng: np.random.Generator):
    """A dead stretch under noise of 0.05 deg/s; coarse steps repeat by chance, so that it takes more of them.

    Then some other stretch stands out in one log of two hundred: the value nearest to the mean repeats most.
    """
    told, logs = 0, 20 if said else 300
    for _ in range(logs):
        output = 0.3 + 0.05 * rng.standard_normal(400)
        output = rounded(output, quantum) if quantum else output
        output[100 : 100 + repeats] = 0.25
        output[300:310] = np.nan
        campaign = gm.Campaign(
            {"time": np.arange(400.0), "output": output}, {"time": "s", "output": "deg/s"}, {"kind": "rate"}
        )
        rows = stretch_still(campaign)
        told += rows is not None
        assert quantum or rows in (None, slice(100, 100 + repeats))
    assert told == logs if said else binom.sf(told - 1, logs, 0.005) > 1e-5


@pytest.mark.parametrize(("rate", "value"), [(False, 2.5), (False, 7.5), (True, 2.5)])
def test_what_a_dead_sensor_tells_is_given_up(rate: bool, value: float, rng: np.random.Generator):
    """Beside a slope over temperature its value was a step up and one down. At the end of a range it may well stand."""
    time = 20.0 * np.arange(900)
    temperature = np.interp(time, [0, 6000, 9000, 18000], [-20.0, 40.0, 40.0, 10.0])
    output = 3.0 + 0.05 * temperature + 0.2 * rng.standard_normal(900)
    output[200:260] = value
    columns = {"time": time, "temperature": temperature, "output": output}
    units = {"time": "s", "temperature": "degC", "output": "deg/h"}
    if rate:
        columns["rate"], units["rate"] = np.zeros(900), "deg/h"
    campaign = gm.Campaign(columns, units, {"kind": "rate"})
    kept, told = without_still(campaign)
    assert told is not None
    assert f"stands at {value:g} deg/h in data rows 201 to 260 of" in told
    given_up = value < 5.0 and not rate
    assert ("given up" in told) == given_up
    assert np.flatnonzero(np.isnan(kept.columns["output"])).tolist() == [*range(201, 260)] * given_up
    if given_up:
        found = gm.diagnose(campaign, gm.model_from_effects(["bias", "bias_temperature"]), hold_out=False)
        assert (found.verdict, told in found.findings) == ("adequate", True)


@pytest.mark.parametrize("steps", [1.0, 2.0, 3.0])
def test_a_coarse_output_that_drifts_does_not_stand_still(steps: float, rng: np.random.Generator):
    """Amid a step of three standard deviations a value follows itself with probability 0.87, at its edge with 0.5."""
    for _ in range(20):
        output = np.round(10.0 * np.sin(np.arange(3000) / 500.0) + rng.standard_normal(3000) / steps)
        campaign = gm.Campaign(
            {"time": np.arange(3000.0), "output": 0.01 * output}, {"time": "s", "output": "deg/s"}, {"kind": "rate"}
        )
        assert stretch_still(campaign) is None


@pytest.mark.parametrize(("jump", "noise", "said"), [(3.0, 0.0, True), (3.0, 0.02, True), (0.0, 0.0, False)])
def test_a_thermometer_dead_for_a_while_is_said_of(jump: float, noise: float, said: bool, rng: np.random.Generator):
    """It stands at one value and jumps when it lives again; a soak without noise ends in a ramp."""
    time = 20.0 * np.arange(900)
    temperature = np.interp(time, [0, 6000, 9000, 15000, 18000], [-20.0, 40.0, 40.0, 10.0, 10.0 + jump])
    temperature = temperature + noise * rng.standard_normal(900)
    if jump:
        temperature[330:420] = temperature[330]
        temperature[420:] += jump
    columns = {"time": time, "temperature": temperature, "output": rng.standard_normal(900)}
    campaign = gm.Campaign(columns, {"time": "s", "temperature": "degC", "output": "deg/h"}, {"kind": "rate"})
    told = thermometers_still(campaign)
    assert len(told) == said
    assert not said or "temperature stands at" in told[0]
    assert not (said and noise) or "in data rows 331 to 420 of" in told[0]


@pytest.mark.long
def test_a_warm_up_after_every_power_on(rng: np.random.Generator):
    """20 deg/h that decay within 300 s of each start, in noise of 5: the room wanders, and the off times differ."""
    design = DESIGNS["repeated_runs"](rng)
    time, run = design.true["time"], design.columns["run"]
    on = time - np.array([time[run == r].min() for r in run])
    error = np.deg2rad((20.0 * np.exp(-on / 300.0) + 5.0 * rng.standard_normal(len(on))) / 3600)
    campaign = gm.Campaign(
        design.columns | {"output": np.rad2deg(error)}, design.units | {"output": "deg/s"}, design.metadata
    )
    found = gm.diagnose(campaign, gm.model_from_effects(["bias"]), hold_out=False)
    assert (found.verdict, [c.effect for c in found.causes]) == ("named", ["bias_warmup"])
    sizes = {p.name: p for p in found.causes[0].parameters}
    assert sizes["time_constant"].value == pytest.approx(300.0, abs=4 * sizes["time_constant"].std)
    assert sizes["amplitude"].value == pytest.approx(20.0, abs=4 * sizes["amplitude"].std)


@pytest.mark.long
def test_runs_take_nothing_from_the_lags_that_are_searched() -> None:
    """A bias that follows the temperature's rate 250 s late, in runs of 400 s without a gap between them."""
    rows, before = 400, 600
    time = 10.0 * np.arange(-before, rows)
    temperature = 20 + 10 * np.sin(2 * np.pi * time / 2000) + 3 * np.sin(2 * np.pi * time / 700)
    rate = np.gradient(temperature, time)
    late = lfilter([0.04], [1.0, -0.96], rate)[before:]
    output = 5 + 150 * late + np.random.default_rng(1).standard_normal(rows)
    columns = {"time": time[before:], "temperature": temperature[before:], "output": output}
    units = {"time": "s", "temperature": "degC", "output": "deg/h", "run": ""}
    campaign = gm.Campaign(columns | {"run": np.arange(rows) // 40 * 1.0}, units, {"kind": "rate"})
    found = gm.diagnose(campaign, gm.model_from_effects(["bias"]), hold_out=False)
    assert (found.verdict, found.causes[0].effect) == ("named", "bias_temperature_rate")


@pytest.mark.long
def test_runs_of_one_power_on_have_one_warm_up(rng: np.random.Generator) -> None:
    """8 deg/h that decay with 600 s, in noise of 1: a run that follows without a gap was not off before."""
    time = 10.0 * np.arange(400)
    output = 8 * np.exp(-time / 600) + rng.standard_normal(400)
    columns = {"time": time, "run": np.arange(400) // 40 * 1.0, "output": output}
    campaign = gm.Campaign(columns, {"time": "s", "run": "", "output": "deg/h"}, {"kind": "rate"})
    found = gm.diagnose(campaign, gm.model_from_effects(["bias"]), hold_out=False)
    assert found.verdict in ("named", "ambiguous")
    assert "bias_warmup" in found.credible_set
