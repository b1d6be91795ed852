"""Campaigns as they come from loggers: drop-outs, blanks, long files, several files of unlike length and interval."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

import gyromodel as gm
from gyromodel._checks import CampaignError
from gyromodel.compensation import compensate
from gyromodel.diagnosis._causes import _size_of, _told
from gyromodel.diagnosis._data import read
from gyromodel.diagnosis._misfit import excess_band
from gyromodel.diagnosis._result import ParameterValue
from gyromodel.effects.drivers import Bias, BiasPeriodic, BiasStep
from gyromodel.effects.power_cycles import BiasTurnOn
from gyromodel.effects.scale import ScaleFactor
from gyromodel.effects.thermometer import TemperatureLag
from gyromodel.estimate import Calibration, fit, fit_record
from gyromodel.model import GyroModel, ModelError, model_from_effects
from gyromodel.report import sentence
from gyromodel.signals import read_signals, with_columns_known

DEG_H = np.pi / 180 / 3600


def campaign(output: np.ndarray, step: float = 10.0, unit: str = "deg/h", kind: str = "rate", **columns: np.ndarray):
    units = {"time": "s", "output": unit, "temperature": "degC", "rate": "deg/s"}
    values = {"time": step * np.arange(len(output)), "output": output, **columns}
    return gm.Campaign(values, {name: units.get(name, "") for name in values}, {"kind": kind})


def test_a_drop_out_of_the_logger_restarts_no_warm_up(rng: np.random.Generator):
    """A simulated warm-up of 20 deg/h in 900 s is right, whether or not 25 samples were lost."""
    rows = np.delete(np.arange(500), np.arange(100, 126))
    warm = 5.0 + 20.0 * np.exp(-10.0 * rows / 900.0) + 0.5 * rng.standard_normal(len(rows))
    lost = campaign(warm).with_column("time", 10.0 * rows, "s")
    found = gm.diagnose(lost, model_from_effects(["bias", "bias_warmup"]), hold_out=False)
    assert found.verdict == "adequate"
    amplitude = next(r for r in found.extended.table() if r.name == "amplitude")
    assert amplitude.value == pytest.approx(20.0, abs=4 * amplitude.std)
    # Read alone: time since power-on goes on behind the gap, and starts anew where a run does.
    assert np.asarray(read([lost]).record.signals["time_on"])[len(rows) - 1] == 10.0 * rows[-1]
    cycled = lost.with_column("run", np.where(rows < 113, 1.0, 2.0), "")
    assert np.asarray(read([cycled]).record.signals["time_on"])[100] == 0.0


@pytest.mark.parametrize("amplitude", [8.0, *(pytest.param(a, marks=pytest.mark.long) for a in (0.0, 40.0))])
def test_a_warm_up_behind_every_gap_is_named_once_a_column_run_tells(amplitude: float, rng: np.random.Generator):
    """A minute of each of six turn-ons, 8 deg/h that decay in 15 s: lines had been named, which fail held out.

    Forty follow time without a name where the gyro is said to be on all the time.
    """
    on, turn = np.tile(np.arange(60.0), 6), np.repeat(np.arange(6.0), 60)
    output = amplitude * np.exp(-on / 15.0) + rng.standard_normal(360)
    time = on + np.cumsum(rng.uniform(1000.0, 7000.0, 6).round())[turn.astype(int)]
    gaps, bias = campaign(output).with_column("time", time, "s"), model_from_effects(["bias"])
    found = gm.diagnose(gaps, bias)
    counted = any("warm-up behind every gap" in line for line in found.findings)
    if not amplitude:
        assert (found.verdict, counted) == ("adequate", False)
        return
    assert (found.verdict, found.causes[0].effect, counted) == ("ambiguous", "bias_warmup", True)
    assert found.credible_set == {"bias_warmup": 0.5, "smooth(time)": 0.5}
    assert "column run" in str(found.next_test)
    assert found.gain.ci95[0] > 1.5
    named = gm.diagnose(gaps.with_column("run", turn, ""), bias, hold_out=False)
    assert (named.verdict, [c.effect for c in named.causes]) == ("named", ["bias_warmup"])
    for told in (found, named):
        size, tau = told.causes[0].parameters
        assert size.value == pytest.approx(amplitude, abs=4 * size.std)
        assert tau.value == pytest.approx(15.0, abs=4 * tau.std)


@pytest.mark.long
def test_a_simulated_warm_up_takes_up_no_temperature_behind_gaps(rng: np.random.Generator):
    """A chamber that settles behind every gap, from elsewhere each time, and a simulation with a warm-up."""
    on, turn = np.tile(np.arange(60.0), 6), np.repeat(np.arange(6), 60)
    temperature = 20.0 + np.array([4.4, 3.7, 4.2, 3.6, 4.7, 3.9])[turn] * np.exp(-on / 15.0)
    measured = campaign(
        temperature - 20.0 + rng.standard_normal(360), temperature=temperature + 0.02 * rng.standard_normal(360)
    ).with_column("time", on + np.cumsum(rng.uniform(1000.0, 7000.0, 6).round())[turn], "s")
    found = gm.diagnose(measured, model_from_effects(["bias", "bias_warmup"]), hold_out=False)
    assert "bias_temperature" in [c.effect for c in found.causes]
    assert not any("warm-up behind every gap" in line for line in found.findings)


@pytest.mark.long
def test_what_settles_behind_every_gap_is_no_firm_warm_up(rng: np.random.Generator):
    """A coil that follows its chamber to another temperature in each of six gaps, the gyro on all the time."""
    on, turn = np.tile(np.arange(60.0), 6), np.repeat(np.arange(6), 60)
    output = rng.uniform(5.0, 12.0, 6)[turn] * np.exp(-on / 15.0) + rng.standard_normal(360)
    time = on + np.cumsum(rng.uniform(1000.0, 7000.0, 6).round())[turn]
    found = gm.diagnose(campaign(output).with_column("time", time, "s"), model_from_effects(["bias"]), hold_out=False)
    assert found.verdict in ("ambiguous", "unknown")
    assert any("warm-up behind every gap" in line for line in found.findings)


def test_time_since_power_on_counts_from_every_gap_as_from_every_run(rng: np.random.Generator):
    """Each start was recorded 30 s late; 25 000 rows are searched as means of two, which begin between samples."""
    for rows in (300, 25_000):
        run = np.repeat(np.arange(5.0), rows // 5)
        time = np.arange(float(rows)) + 1000.0 * run
        columns = {"time": time, "output": rng.standard_normal(rows)}
        without = gm.Campaign(columns, {"time": "s", "output": "deg/h"}, {"kind": "rate", "time_since_power_on": "30"})
        late = without.with_column("run", run, "")
        since = read([without]).time_on
        assert since is not None
        assert np.allclose(since, read([late]).record.signals["time_on"])


@pytest.mark.long
def test_runs_with_biases_of_their_own_are_held_out_in_parts(rng: np.random.Generator):
    """A run's own bias is not predicted by the others."""
    on, run = np.tile(np.arange(60.0), 6), np.repeat(np.arange(1.0, 7.0), 60)
    output = 8.0 * np.exp(-on / 15.0) + 3.0 * rng.standard_normal(6)[np.repeat(range(6), 60)] + rng.standard_normal(360)
    measured = campaign(output, run=run).with_column("time", on + 4000.0 * run, "s")
    found = gm.diagnose(measured, model_from_effects(["bias", "bias_turn_on"]))
    assert [c.effect for c in found.causes] == ["bias_warmup"]
    assert "fifths of stretches between gaps" in found.gain.scheme
    assert found.gain.ci95[0] > 1.5


def test_a_rate_that_stands_still_where_there_is_an_output_is_no_cause_of_noise(rng: np.random.Generator):
    """Slews with the output blank, rests between them."""
    slews = np.arange(300) % 60 >= 50
    output = np.where(slews, np.nan, 2.0 + rng.standard_normal(300))
    model = GyroModel((Bias(),), {"noise_white": DEG_H})
    found = gm.diagnose(campaign(output, 1.0, rate=np.where(slews, 20.0, 0.0)), model, hold_out=False)
    assert found.verdict == "adequate"
    assert not any("follows" in line for line in found.findings)


def test_blank_run_numbers_are_those_of_the_rows_beside_them(rng: np.random.Generator):
    run, output = np.repeat([1.0, 2.0, 3.0], 50), rng.standard_normal(150)
    blank = np.isin(np.arange(150), [*range(46, 54), *range(96, 104)])
    measured = campaign(np.where(blank, np.nan, output), run=np.where(blank, np.nan, run))
    record, said = with_columns_known(read_signals(measured))
    assert np.array_equal(np.asarray(record.signals["run"])[:150], run)
    assert not said
    [cycles] = BiasTurnOn.candidates(record.signals)
    assert np.asarray(cycles.runs).tolist() == [2.0, 3.0]


def test_a_column_known_wherever_all_others_are_is_known(rng: np.random.Generator):
    """It lacks more than a fifth of the rows, which are left out for others."""
    amp, humid, volt = (np.cumsum(rng.standard_normal(200)) for _ in range(3))
    amp[10:40], humid[60:85] = np.nan, np.nan
    volt[[*range(10, 40), *range(60, 85)]] = np.nan
    record, said = with_columns_known(read_signals(campaign(rng.standard_normal(200), amp=amp, humid=humid, volt=volt)))
    assert record.present.sum() == 145
    assert sorted(line.split()[0] for line in said) == ["25", "30"]
    assert all(np.isfinite(np.asarray(values)).all() for values in record.signals.values())


@pytest.mark.parametrize("rows", [24_000, 50_000])
def test_lines_are_not_those_of_means(rows: int, rng: np.random.Generator):
    """30 deg/h at 10.003 Hz and no phase in 100 samples a second, of which two or three go into a mean."""
    time = 0.01 * np.arange(rows)
    measured = campaign(30.0 * np.cos(2 * np.pi * 10.003 * time) + 5.0 * rng.standard_normal(rows), 0.01)
    record = read([measured]).record
    assert record.rows == -(-rows // -(-rows // 20_000))
    line = BiasPeriodic(cosine=[DEG_H], sine=[DEG_H], frequency=[10.003])
    estimate = fit_record(record, GyroModel((line,), {"noise_white": 0.5 * DEG_H}))
    cosine, sine, frequency = estimate.table()
    for row, true in ((cosine, 30.0), (sine, 0.0), (frequency, 10.003)):
        assert row.value == pytest.approx(true, abs=5 * row.std)
    assert cosine.std < 0.2
    # What it tells of the samples themselves: noise is left.
    left = compensate(measured, estimate.calibration()).in_unit("rate_estimated", "deg/h")
    assert np.std(left) == pytest.approx(5.0, rel=0.05)


def test_derivatives_of_lines_in_means_are_those_of_differences():
    signals = {
        "time": jnp.arange(50.0), "_averaged": jnp.repeat(jnp.array([3.0, 7.0]), 25), "_step": jnp.full(50, 0.1),
    }  # fmt: skip
    frequency = jnp.array([0.2, 1.3])

    def line(f):
        return BiasPeriodic(cosine=[1.0, 2.0], sine=[3.0, -1.0], frequency=f)

    far = (line(frequency + 1e-6).contribution(signals) - line(frequency - 1e-6).contribution(signals)) / 2e-6
    near = line(frequency).shape_derivatives(signals).sum(axis=1)
    # But for what means keep, which hardly changes.
    assert np.abs(near - far).max() < 0.05 * np.abs(far).max()


@pytest.mark.long
def test_gross_errors_given_up_shape_no_unknown_function(rng: np.random.Generator):
    temperature = 20.0 + 15.0 * np.sin(np.linspace(0.0, 12.0, 400))
    output = 10.0 * np.sin(2 * np.pi * temperature / 11.0) + rng.standard_normal(400)
    output[[57, 211, 333]] += [400.0, -600.0, 500.0]
    found = gm.diagnose(campaign(output, temperature=temperature), model_from_effects(["bias"]), hold_out=False)
    assert found.verdict == "unknown"
    assert "3 gross errors" in " ".join(found.findings)
    assert found.driver is not None
    assert np.abs(found.driver.y).max() < 14.0
    assert np.median(found.driver.std) < 1.0


@pytest.mark.parametrize("lengths", [(30_000, 5_000), (5_000, 30_000)])
def test_increments_of_unlike_length_are_read_together(lengths: tuple[int, int], rng: np.random.Generator):
    several = [campaign(rng.standard_normal(n), 0.01, "arcsec", "increment") for n in lengths]
    record = read(several).record
    assert record.rows == 20_000
    assert record.output_unit == "rad/s"


def test_no_band_is_told_of_where_intervals_differ(rng: np.random.Generator):
    """An oscillation near 0.2 Hz in rows of 1 s: of these alone it is told, beside rows of 0.1 s it has no place."""
    slow = np.cumsum(0.15 * rng.standard_normal(700)) + 2 * np.pi * 0.2 * np.arange(700)
    second = campaign(rng.standard_normal(700) + 4.0 * np.cos(slow), 1.0)
    first = campaign(rng.standard_normal(1500) / np.sqrt(0.1), 0.1)
    model = GyroModel((Bias(),), {"noise_white": DEG_H})
    alone, both = (excess_band(fit_record(read(of).record, model)) for of in ([second], [first, second]))
    assert alone is not None
    assert 0.15 < alone.low < alone.high < 0.25
    assert both is None


def test_effects_of_another_campaign_are_told_of(rng: np.random.Generator):
    model = GyroModel((Bias(value=0.0), BiasStep(size=1e-3, epoch=300.0, campaign=2)))
    alone = campaign(rng.standard_normal(60))
    note = compensate(alone, Calibration(model)).metadata["rate_estimated_note"]
    assert "bias_step was in campaign 2 of those that were fitted" in str(note)
    assert "need a column 'campaign []' that holds its number" in str(note)
    numbered = alone.with_column("campaign", np.full(60, 2.0), "")
    assert "was in" not in str(compensate(numbered, Calibration(model)).metadata["rate_estimated_note"])
    step = compensate(numbered.with_column("output", np.linspace(0, 1, 60), "deg/h"), Calibration(model))
    assert np.diff(step.si("rate_estimated"))[29] == pytest.approx(DEG_H / 59 - 1e-3)
    turned_on = GyroModel((Bias(value=0.0), BiasTurnOn(offsets=[1e-3], runs=[2.0])))
    found = compensate(numbered, Calibration(turned_on))
    assert found.si("rate_estimated") == pytest.approx(numbered.si("output") - 1e-3)


@pytest.mark.parametrize(("size", "told_as"), [(1000.4, "count/deg"), (1.0004, "1")])
def test_an_interval_after_selection_starts_from_what_was_stated(size: float, told_as: str):
    """At 97 % of its size it would not have been told: nothing is nearer to the simulation than by that."""
    stated = 1000.0 if told_as == "count/deg" else None
    parameter = ParameterValue("value", size, 1e-4 * size, told_as)
    found = _told(parameter, ScaleFactor(value=1.0), 0.97, stated)
    nothing = stated or 1.0
    z = (size - nothing) / parameter.std
    assert found.ci95 is not None
    low, high = ((end - nothing) / parameter.std for end in found.ci95)
    assert low < z - 1.96
    assert high == pytest.approx(z + 1.96, abs=1e-3)
    lag = TemperatureLag(coefficients=[1e-5], time_constant=100.0, reference=25.0)
    assert _size_of(lag, True, 1) == "time_constant"


@pytest.mark.long
def test_a_scale_factor_error_is_told_in_ppm(rng: np.random.Generator):
    rate = rng.uniform(-50.0, 50.0, 60)
    measured = campaign(rate * 1.001 + 0.002 * rng.standard_normal(60), unit="deg/s", rate=rate)
    found = gm.diagnose(measured, model_from_effects(["bias"]), hold_out=False)
    [cause] = [c for c in found.causes if c.effect == "scale_factor"]
    assert cause.parameters[0].value == pytest.approx(1.001, abs=1e-4)
    assert " ppm" in sentence(found)


@pytest.mark.parametrize("walk", [0.0, 5e-4])
@pytest.mark.parametrize(
    ("counted", "late"),
    [pytest.param(True, 0.0, marks=pytest.mark.long), (False, 0.0), pytest.param(False, 0.012, marks=pytest.mark.long)],
)
def test_increments_over_intervals_are_not_late(counted: bool, late: float, walk: float, rng: np.random.Generator):
    """Beside rates at the rows, whose product with the interval other increments are: a delay is none of half of it."""
    time = 0.01 * np.arange(1500)
    rate, then = (10.0 * np.sin(4.4 * t) + 3.0 * np.cos(12.0 * t) for t in (time, time - late))
    turned = -10.0 / 4.4 * np.cos(4.4 * time) + 3.0 / 12.0 * np.sin(12.0 * time)
    output = np.diff(turned, prepend=np.nan) if counted else 0.01 * then
    output = output + 2e-5 * rng.standard_normal(1500) + walk * np.cumsum(rng.standard_normal(1500))
    measured = campaign(output, 0.01, "deg", "increment", rate=rate)
    found = gm.diagnose(measured, gm.model_from_effects(["scale_factor", "bias"]), hold_out=False)
    assert any("intervals were taken" in line for line in found.findings) is counted
    if late:
        delay = next(r for r in found.extended.table() if r.name == "delay")
        assert abs(delay.value - 12.0) < 5.0 * delay.std
    else:
        assert not {"time_delay", "bandwidth"} & {*found.credible_set, *(c.effect for c in found.causes)}


def test_a_value_that_a_mean_would_hide_is_refused():
    temperature = np.where(np.arange(20_100) == 7, np.nan, 20.0)
    measured = campaign(np.arange(20_100.0), temperature=temperature)
    with pytest.raises(ModelError, match="needs column temperature, which is NaN in data rows 8"):
        gm.diagnose(measured, gm.model_from_effects(["bias", "bias_temperature"]))


def test_a_column_of_some_campaigns_is_not_searched(rng: np.random.Generator):
    first, second = (campaign(rng.standard_normal(9), temperature=rng.standard_normal(9)) for _ in range(2))
    first = first.with_column("heater", np.arange(9.0), "W")
    data = read([first, second])
    assert "heater is in only some of the campaigns: it was not searched." in data.findings
    assert "heater" not in data.record.signals
    assert "heater" not in data.whole.columns
    for asked in (fit, gm.diagnose):
        with pytest.raises(CampaignError, match="campaign: lacks column heater, which effect bias_heater needs"):
            asked([first, second], model_from_effects(["bias", "bias_heater"]))
