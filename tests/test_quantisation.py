"""Outputs read in steps: rounding against a real quantiser, fits beside it, and the name that a search gives it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.stats import binom

import gyromodel as gm
from gyromodel.diagnosis import Diagnosis
from gyromodel.diagnosis._readings import _of_samples
from gyromodel.effects.converter import Quantisation
from gyromodel.estimate import Calibration, fit_many, read_for_fit
from gyromodel.model import ModelError
from gyromodel.model_files import read_model, write_model
from gyromodel.numerics.rounding import grid_step, noise_before, quantum, rounded_variance, staircase
from gyromodel.simulation import simulate
from tests.truth import study
from tests.truth.memory import rounded

RARE = 1e-4
NOISE = 0.002  # deg/s


@pytest.mark.law
@pytest.mark.parametrize("noise", [0.0, 0.05, 0.2, 0.4, 0.7, 1.0])
def test_the_mean_and_the_scatter_of_a_real_quantiser(noise: float, rng: np.random.Generator):
    """Values anywhere between steps; the standard errors are those of so many draws."""
    values = rng.uniform(-3.0, 3.0, 200_000)
    left = rounded(values + noise * rng.standard_normal(len(values)), 1.0) - values - staircase(values, noise)
    spread = left.std() / np.sqrt(len(values))
    for wave in (np.ones_like(values), np.sin(2.0 * np.pi * values), np.sin(4.0 * np.pi * values)):
        assert abs(np.mean(left * wave)) < 4.5 * spread + 1e-12
    error = np.std(left**2) / np.sqrt(len(values))
    assert rounded_variance(noise) == pytest.approx(np.mean(left**2), abs=4.5 * error + 2e-5)
    assert noise_before(rounded_variance(noise)) == pytest.approx(noise, abs=1e-4)


@pytest.mark.parametrize("step", [0.01, 2.0**-13, 0.3, 1.0, 3.3e-7])
@pytest.mark.parametrize("rows", [40, 500])
def test_the_step_of_a_fine_grid_is_its_values_common_divisor(step: float, rows: int, rng: np.random.Generator):
    """Values of a rate table: thousands of steps apart, and no two of them neighbours."""
    values = step * (rng.integers(-40_000, 40_000, rows) + 0.25)
    assert grid_step(values) == pytest.approx(step, rel=1e-6)
    assert quantum(values) is None  # far finer than so few values would show without Euclid's algorithm
    assert grid_step(values + step * rng.standard_normal(rows)) is None


def test_numbers_of_some_digits_lie_on_the_grid_of_the_last():
    values = np.random.default_rng(1).uniform(-80.0, 80.0, 300)
    assert grid_step(np.round(values, 4)) == pytest.approx(1e-4, rel=1e-6)
    assert grid_step(values) is None
    assert grid_step(np.full(20, 3.0)) is None


def rest(output: np.ndarray, unit: str = "deg/s", kind: str = "rate") -> gm.Campaign:
    return gm.Campaign(
        {"time": np.arange(float(len(output))), "output": output}, {"time": "s", "output": unit}, {"kind": kind}
    )


def model_file(path: Path, step: str) -> Path:
    entries = ("{effect: bias, value: 3 deg/h}", f"{{effect: quantisation, step: {step}}}")
    text = "effects:\n" + "".join(f"  - {entry}\n" for entry in entries)
    path.write_text(text + "noise:\n  - {effect: noise_white, value: 0.3 deg/sqrt(h)}\n", encoding="utf-8")
    return path


def test_a_simulated_output_is_read_in_steps(tmp_path: Path):
    """The noise is rounded with it; an angle is rounded as it stands, so that nothing of an increment is lost."""
    model = read_model(model_file(tmp_path / "m.yaml", "0.01 deg/s"))
    output = simulate(model, rest(np.arange(400.0)), seed=3).columns["output"]
    plain = simulate(model.without("quantisation"), rest(np.arange(400.0)), seed=3).columns["output"]
    assert output == pytest.approx(rounded(plain, 0.01), abs=1e-12)
    of_angle = read_model(model_file(tmp_path / "a.yaml", "36 arcsec"))
    whole = simulate(of_angle, rest(np.arange(400.0), "deg", "angle"), seed=3).columns["output"]
    parts = simulate(of_angle, rest(np.arange(400.0), "deg", "increment"), seed=3).columns["output"]
    assert whole / 0.01 == pytest.approx(np.round(whole / 0.01), abs=1e-9)
    assert np.cumsum(parts) == pytest.approx(whole, abs=1e-9)
    with pytest.raises(ModelError, match=r"quantisation is in arcsec, but the output is in \[deg/s\]"):
        simulate(of_angle, rest(np.arange(40.0)))


@pytest.mark.parametrize(
    ("step", "said"),
    [
        ("0.01", "quantisation is a plain number, but the output is in"),
        ("0.01 degC", "quantisation is in degC, but the output is in"),
        ("-1 deg/s", "a step is above zero"),
        ("0 deg/s", "a step is above zero"),
    ],
)
def test_steps_that_make_no_sense_are_refused(step: str, said: str, tmp_path: Path):
    with pytest.raises(ModelError, match=said):
        gm.fit(rest(rounded(NOISE * np.random.default_rng(0).standard_normal(50), 0.001)),
               read_model(model_file(tmp_path / "m.yaml", step)))  # fmt: skip


def test_no_step_is_infinite():
    with pytest.raises(ValueError, match="above zero and finite"):
        Quantisation(step=np.inf)


def test_a_model_without_a_step_takes_that_of_the_data(tmp_path: Path):
    rng = np.random.default_rng(5)
    campaign = rest(rounded(0.01 + NOISE * rng.standard_normal(300), 0.005))
    estimate = gm.fit(campaign, gm.model_from_effects(["bias", "quantisation"]))
    row = next(r for r in estimate.table() if r.effect == "quantisation")
    assert (row.value, row.std, row.unit) == (pytest.approx(0.005), 0.0, "deg/s")
    write_model(estimate, tmp_path / "fitted.yaml")
    assert float(read_model(tmp_path / "fitted.yaml").reading.step) == pytest.approx(np.deg2rad(0.005), rel=1e-12)
    with pytest.raises(ModelError, match="comes in no steps"):
        gm.fit(rest(rng.standard_normal(50)), gm.model_from_effects(["bias", "quantisation"]))


def levels(step: float, rng: np.random.Generator, visits: int = 4) -> tuple[gm.Campaign, np.ndarray]:
    """Visits to rates of a table, drawn off any grid, and the true scale factor and bias (rad/s)."""
    table = np.repeat(rng.permutation(np.repeat(rng.uniform(-8.0, 8.0, 25), visits)), 4)
    output = 1.0003 * table + 0.01 + NOISE * rng.standard_normal(len(table))
    columns = {"time": np.arange(float(len(table))), "rate": table, "output": rounded(output, step)}
    units = {"time": "s", "rate": "deg/s", "output": "deg/s"}
    return gm.Campaign(columns, units, {"kind": "rate"}), np.array([1.0003, np.deg2rad(0.01)])


@pytest.mark.long
@pytest.mark.law
@pytest.mark.parametrize("steps", [1.0, 3.0, 8.0])
def test_intervals_beside_rounding_hold_the_truth(steps: float, rng: np.random.Generator):
    """25 rates: what rounding does to each is the same in every visit."""
    inside = noise = 0
    for _ in range(20):
        campaign, truth = levels(steps * NOISE, rng)
        estimate = gm.fit(campaign, gm.model_from_effects(["scale_factor", "bias", "quantisation"]))
        off = np.abs(np.asarray(estimate.model.vector()) - truth) / estimate.std
        inside += int(np.sum(off < 1.96))
        row = estimate.noise_table()["noise_white"]
        noise += float(row["lo"]) < NOISE * 60.0 < float(row["hi"])
    assert binom.cdf(inside, 40, 0.93) > RARE
    # How much noise there was shows in a few of the rates where steps are far coarser.
    assert steps > 3.0 or binom.cdf(noise, 20, 0.9) > RARE


@pytest.mark.long
@pytest.mark.law
def test_what_rounding_adds_is_taken_away(rng: np.random.Generator):
    """A fit that knows the steps errs less than half as much as one that takes all of rounding for noise."""
    errors = []
    for _ in range(20):
        campaign, truth = levels(10.0 * NOISE, rng, visits=8)
        fits = (
            gm.fit(campaign, gm.model_from_effects(["scale_factor", "bias", *more])) for more in ([], ["quantisation"])
        )
        errors.append([np.abs(np.asarray(e.model.vector()) - truth)[1] for e in fits])
    plain, beside = np.square(errors).mean(axis=0)
    assert beside < 0.5 * plain


@pytest.mark.long
@pytest.mark.law
@pytest.mark.parametrize("steps", [3.0, 12.0])
def test_an_output_stuck_in_a_step_tells_no_more_than_that(steps: float, rng: np.random.Generator):
    """A gyro at rest: where in its step the bias lies shows in the noise, or not at all.

    Where the last sample alone is in another step, a random walk explains it, and the bias is known less.
    """
    inside, known, step = 0, 0, steps * NOISE
    for _ in range(30):
        output = np.zeros(300)
        while not np.ptp(output):  # one that never changes is refused
            bias = rng.uniform(-3.0, 3.0) * step
            output = rounded(bias + NOISE * rng.standard_normal(300), step)
        estimate = gm.fit(rest(output), gm.model_from_effects(["bias", "quantisation"]))
        inside += bool(abs(float(estimate.model.vector()[0]) - np.deg2rad(bias)) < 1.96 * estimate.std[0])
        known += bool(estimate.std[0] < np.deg2rad(step))
    assert binom.cdf(inside, 30, 0.93) > RARE
    assert binom.cdf(known, 30, 0.99) > RARE


def test_a_rate_read_in_steps_is_known_no_better_than_they_are():
    model = gm.model_from_effects(["scale_factor", "bias", "quantisation"])
    campaign, _ = levels(10.0 * NOISE, np.random.default_rng(2))
    estimate = gm.fit(campaign, model)
    found = gm.compensate(campaign, Calibration(estimate.model, estimate.covariance))
    std = found.columns["rate_estimated_std"]
    assert std == pytest.approx(NOISE * np.hypot(1.0, 10.0 / np.sqrt(12.0)), rel=0.1)


def hidden(case: study.Case, steps: float, seed: int = 0) -> tuple[Diagnosis, gm.Campaign, gm.GyroModel]:
    """A case of the study with its output read in steps of so many standard deviations of its noise."""
    built = study.build(case)
    noise = np.rad2deg(built.truth.noise)
    step = steps * np.diff(noise).std() / np.sqrt(2.0)
    columns = built.columns | {"output": rounded(built.columns["output"], step)}
    campaign = gm.Campaign(columns, built.units, built.metadata)
    model = gm.model_from_effects(list(built.truth.baseline))
    return gm.diagnose(campaign, model, hold_out=False), campaign, model


COARSER = (("rate_temperature", 5.0), ("dynamic_rates", 10.0))


@pytest.mark.parametrize(
    ("design", "steps"),
    [("rate_steps", 2.0), ("static_cycle", 3.0), *(pytest.param(*case, marks=pytest.mark.long) for case in COARSER)],
)
def test_coarse_steps_are_named_and_nothing_else(design: str, steps: float):
    """Steps that a search of the plain output takes for a function of the rate; then the simulation has them."""
    found, campaign, _ = hidden(study.Case(11, design, "white"), steps)
    assert (found.verdict, [c.effect for c in found.causes]) == ("named", ["quantisation"])
    told = found.causes[0].parameters[0]
    assert told.value == pytest.approx(grid_step(campaign.columns["output"]), rel=1e-6)
    again = gm.diagnose(campaign, found.extended.model_as_given(), hold_out=False)
    assert (again.verdict, again.causes) == ("adequate", ())


@pytest.mark.parametrize("design", ["rate_steps", "static_cycle"])
def test_fine_steps_are_no_cause(design: str):
    found, _, _ = hidden(study.Case(12, design, "white"), 0.5)
    assert (found.verdict, found.causes) == ("adequate", ())
    assert found.minimum_detectable["quantisation"][0] > 0.0


def test_an_effect_beside_steps_keeps_its_name_and_size():
    case = study.Case(5, "static_cycle", "white", "bias_temperature_rate", 10.0)
    found, _, _ = hidden(case, 3.0)
    assert found.verdict == "named"
    assert {c.effect for c in found.causes} == {"bias_temperature_rate", "quantisation"}
    size = next(p for c in found.causes if c.effect == "bias_temperature_rate" for p in c.parameters)
    truth = study.build(case).truth.amplitude / np.deg2rad(1.0 / 3600.0)
    assert size.value == pytest.approx(truth, abs=5.0 * size.std)


@pytest.mark.long
def test_a_wrong_step_of_the_simulation_is_told():
    _, campaign, model = hidden(study.Case(13, "rate_steps", "white"), 3.0)
    step = np.deg2rad(float(grid_step(campaign.columns["output"]) or 0.0))
    for factor, verdict in ((1.0, "adequate"), (2.0, "named")):
        stated = model.with_effect(Quantisation(step=factor * step, unit="deg/s"))
        assert gm.diagnose(campaign, stated, hold_out=False).verdict == verdict


@pytest.mark.long
def test_stated_noise_is_that_before_rounding():
    """Three times its size is read where steps are ten times as large."""
    _, campaign, model = hidden(study.Case(14, "rate_temperature", "white"), 10.0)
    built = study.build(study.Case(14, "rate_temperature", "white"))
    white = built.truth.noise.std() * np.sqrt(built.design.step)
    step = np.deg2rad(float(grid_step(campaign.columns["output"]) or 0.0))
    stated = gm.GyroModel((*model.effects, Quantisation(step=step, unit="deg/s")), {"noise_white": white})
    found = gm.diagnose(campaign, stated, hold_out=False)
    assert found.verdict == "adequate"
    assert not any("noise is" in line for line in found.findings)


@pytest.mark.long
@pytest.mark.parametrize("hold_out", [False, True])
def test_two_levels_do_not_end_a_search(hold_out: bool):
    """A gyro that hardly leaves a step: every value but a few is the same, and a fit may leave nothing at all."""
    rng = np.random.default_rng(4)
    time = np.arange(600.0)
    output = np.zeros(600)
    output[rng.permutation(600)[:9]] = -0.02
    columns = {"time": time, "temperature": 20.0 + 10.0 * np.sin(time / 90.0), "output": output}
    campaign = gm.Campaign(columns, {"time": "s", "temperature": "degC", "output": "deg/s"}, {"kind": "rate"})
    found = gm.diagnose(campaign, gm.model_from_effects(["bias"]), hold_out=hold_out)
    assert "quantisation" in {c.effect for c in found.causes}
    assert found.verdict in ("named", "ambiguous")


@pytest.mark.long
def test_lines_of_a_rounded_angle_are_not_a_periodic_bias():
    """2.6 counts a sample: the rates alternate between two values at a pace of their own."""
    rng = np.random.default_rng(3)
    angle = np.cumsum(0.013 + 0.0005 * rng.standard_normal(1200))
    found = gm.diagnose(
        rest(np.diff(rounded(angle, 0.005), prepend=0.0)), gm.model_from_effects(["bias"]), hold_out=False
    )
    assert found.verdict == "adequate" or "noise_quantisation" in found.credible_set


@pytest.mark.parametrize("rates", [11, 41])
@pytest.mark.parametrize("digits", [4, 15])
def test_a_sweep_of_even_rates_is_no_grid(rates: int, digits: int, rng: np.random.Generator):
    """Outputs as evenly spaced as the rates, but for noise down to the last digit."""
    for noise in (1e-4, 1e-3, 1e-2):
        output = 1.0003 * np.linspace(-100.0, 100.0, rates) + 0.01 + noise * rng.standard_normal(rates)
        step = grid_step(np.round(output, digits))
        assert step is None or step < 1.5e-4


@pytest.mark.parametrize("slow", [pytest.param("lag", marks=pytest.mark.long), "walk"])
def test_the_last_digit_of_slow_noise_is_no_step(slow: str, rng: np.random.Generator):
    """Noise of a narrow band has next to no white part, and still scatters from sample to sample."""
    drawn = rng.standard_normal(2000)
    noise = 0.003 * np.cumsum(drawn) if slow == "walk" else 0.0044 * lfilter([1.0], [1.0, -0.9], drawn)
    found = gm.diagnose(rest(np.round(noise, 3)), gm.model_from_effects(["bias"]), hold_out=False)
    assert "quantisation" not in {c.effect for c in found.causes}


def test_gross_errors_beside_sharp_edges_stay_left_out():
    campaign, _ = levels(10.0 * NOISE, np.random.default_rng(3))
    output = campaign.columns["output"].copy()
    output[[123, 301]] += [1.0, -1.0]
    model = gm.model_from_effects(["scale_factor", "bias"])
    found = gm.diagnose(campaign.with_column("output", output, "deg/s"), model, hold_out=False)
    assert (found.verdict, [c.effect for c in found.causes]) == ("named", ["quantisation"])
    said = [line.split()[0] for line in found.findings if "samples that stand apart" in line]
    assert len(said) == 1
    assert 2 <= int(said[0]) <= 8


@pytest.mark.long
def test_means_of_coarse_samples_have_their_noise_before_rounding():
    """A log that is averaged for the search: the steps are those of its samples, and so is what they add."""
    rng = np.random.default_rng(6)
    log = rest(rounded(0.01 + 0.01 * rng.standard_normal(60_000), 0.02))
    found = gm.diagnose(log, gm.model_from_effects(["bias"]), hold_out=False)
    assert (found.verdict, [c.effect for c in found.causes]) == ("named", ["quantisation"])
    row = found.noise["noise_white"]
    assert float(row["value"]) == pytest.approx(0.01 * 60.0, rel=0.03)
    moving = log.columns | {"rate": 30.0 * np.sin(np.arange(60_000.0) / 3.0)}
    moving["output"] = rounded(moving["rate"] + 0.01 * rng.standard_normal(60_000), 0.05)
    scatter = _of_samples(gm.Campaign(moving, {**log.units, "rate": "deg/s"}, {"kind": "rate"}))
    assert np.rad2deg(scatter) == pytest.approx(np.hypot(0.01, 0.05 / np.sqrt(12.0)), rel=0.1)


@pytest.mark.parametrize("kind", ["increment", "angle"])
def test_a_model_of_a_rounded_angle_is_kept_and_simulated(kind: str, tmp_path: Path):
    rng = np.random.default_rng(7)
    output = rounded(np.cumsum(0.003 + NOISE * rng.standard_normal(300)), 0.01)
    campaign = rest(output if kind == "angle" else np.diff(output, prepend=0.0), "deg", kind)
    model = gm.model_from_effects(["bias", "quantisation"])
    estimate = gm.fit(campaign, model)
    write_model(estimate, tmp_path / "fitted.yaml")
    again = simulate(read_model(tmp_path / "fitted.yaml"), campaign, seed=1).columns["output"]
    assert again / 0.01 == pytest.approx(np.round(again / 0.01), abs=1e-6)
    found = gm.diagnose(campaign, gm.model_from_effects(["bias"]), hold_out=False)
    assert "quantisation" in found.not_testable
    assert "quantisation" not in found.searched


def test_campaigns_of_different_steps_are_said_not_to_be_searched():
    """What they do to a curve over the rate is not told as anything else."""
    rng = np.random.default_rng(8)
    two = [levels(step, rng)[0] for step in (0.02, 0.03)]
    model = gm.model_from_effects(["scale_factor", "bias"])
    found = gm.diagnose(two, model, hold_out=False)
    assert "different steps" in found.not_testable["quantisation"]
    assert found.verdict == "adequate" or "quantisation" in found.credible_set
    assert any("steps of their own" in line for line in found.findings)
    with pytest.raises(ModelError, match="read in different steps"):
        gm.fit(two, gm.model_from_effects(["scale_factor", "bias", "quantisation"]))


def test_a_short_campaign_is_read_in_the_steps_of_the_long_one():
    """Of a few samples no grid is told, but whether they lie on that of the others."""
    whole = levels(0.02, np.random.default_rng(8))[0]
    both, model = [whole, whole.select(np.arange(len(whole)) < 7)], gm.model_from_effects(["scale_factor", "bias"])
    found = gm.diagnose(both, model, hold_out=False)
    assert "quantisation" not in found.not_testable
    assert "quantisation" in {c.effect for c in found.causes}


def test_a_step_that_the_data_are_not_read_in_takes_nothing_from_the_noise():
    campaign = rest(0.01 + NOISE * np.random.default_rng(10).standard_normal(400))
    model = gm.GyroModel((*gm.model_from_effects(["bias"]).effects, Quantisation(step=np.deg2rad(0.02), unit="deg/s")))
    plain = gm.fit(campaign, gm.model_from_effects(["bias"])).noise_table()["noise_white"]
    assert gm.fit(campaign, model).noise_table()["noise_white"] == pytest.approx(plain)
    found = gm.diagnose(campaign, model, hold_out=False)
    assert any("not read in the steps" in line for line in found.findings)
    assert float(found.noise["noise_white"]["value"]) == pytest.approx(NOISE * 60.0, rel=0.15)


def test_exact_outputs_of_even_rates_are_no_steps():
    """Each rate several times and next to no noise: the grid is that of the rates."""
    rate = np.tile(np.linspace(-20.0, 20.0, 5), 40)
    columns = {"time": np.arange(200.0), "rate": rate, "output": 1.001 * rate}
    campaign = gm.Campaign(columns, {"time": "s", "rate": "deg/s", "output": "deg/s"}, {"kind": "rate"})
    found = gm.diagnose(campaign, gm.model_from_effects(["scale_factor", "bias"]), hold_out=False)
    assert (found.verdict, found.causes) == ("adequate", ())


@pytest.mark.parametrize(
    ("hidden", "scale"),
    [
        pytest.param("", 1.001, marks=pytest.mark.long),
        pytest.param("bias_temperature", 1234.5, marks=pytest.mark.long),
        ("scale_nonlinearity", 1.001),
        ("bias_periodic", 1234.5),
    ],
)
def test_data_without_noise_show_what_is_hidden_and_no_rounding_of_doubles(
    hidden: str, scale: float, rng: np.random.Generator
):
    time = np.arange(600.0)
    rate, warm = 50.0 * np.sin(time / 30.0) + rng.uniform(-1.0, 1.0, 600), 10.0 * np.sin(time / 200.0)
    more = {
        "bias_temperature": 3e-3 * warm,
        "scale_nonlinearity": 1e-6 * rate**2,
        "bias_periodic": 0.01 * np.sin(0.7 * time),
    }
    columns = {
        "time": time,
        "rate": rate,
        "temperature": 25.0 + warm,
        "output": scale * (rate + more.get(hidden, 0.02)),
    }
    units = {"time": "s", "rate": "deg/s", "temperature": "degC", "output": "deg/s" if scale < 2 else "count/s"}
    campaign = gm.Campaign(columns, units, {"kind": "rate"})
    found = gm.diagnose(campaign, gm.model_from_effects(["scale_factor", "bias"]), hold_out=False)
    assert [c.effect for c in found.causes] == [hidden] * bool(hidden)
    assert found.verdict == ("named" if hidden else "adequate")


def test_many_campaigns_in_steps_are_fitted_one_at_a_time():
    records = [read_for_fit([levels(0.02, np.random.default_rng(11))[0]])]
    model = gm.model_from_effects(["scale_factor", "bias", "quantisation"])
    fits = fit_many(records, gm.GyroModel(model.effects, {"noise_white": 6e-7}))
    assert not fits.converged[0]
    assert "one campaign at a time" in fits.reasons[0]


@pytest.mark.long
def test_known_steps_leave_no_doubt_of_their_own(tmp_path: Path):
    """A fit without free parameters, and a search that takes no leftover of rounding for what the model has."""
    rate = np.linspace(-3.0, 3.0, 400) + 0.013
    output = rounded(rate + 5e-4 * np.random.default_rng(9).standard_normal(400), 0.01)
    columns = {"time": np.arange(400.0), "rate": np.round(rate, 4), "output": np.round(output, 4)}
    campaign = gm.Campaign(columns, {"time": "s", "rate": "deg/s", "output": "deg/s"}, {"kind": "rate"})
    text = "effects:\n  - {effect: scale_factor, value: 1, fixed: true}\n  - {effect: quantisation, step: 0.01 deg/s}\n"
    (tmp_path / "fixed.yaml").write_text(text, encoding="utf-8")
    model = read_model(tmp_path / "fixed.yaml")
    assert gm.fit(campaign, model).covariance.size == 0
    found = gm.diagnose(campaign, model, hold_out=False)
    assert "quantisation" not in found.credible_set
