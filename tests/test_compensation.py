"""Calibrations applied: rates against root finding (scipy's brentq) on models written out in NumPy and natural cubic
splines of scipy, uncertainties against closed forms, finite differences and the coverage of fits to fresh simulations
(binomial law)."""

from __future__ import annotations

from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from scipy.optimize import brentq
from scipy.stats import binom, t

from gyromodel._checks import CampaignError
from gyromodel.campaign import Campaign
from gyromodel.compensation import compensate
from gyromodel.effects import Effect
from gyromodel.effects.converter import Saturation
from gyromodel.effects.drivers import Bias, BiasDrift
from gyromodel.effects.dynamics import Bandwidth, TimeDelay
from gyromodel.effects.power_cycles import BiasTurnOn
from gyromodel.effects.readout import LockIn
from gyromodel.effects.scale import (
    ScaleAsymmetry,
    ScaleFactor,
    ScaleNonlinearity,
    ScaleSagnacSine,
    ScaleSpline,
    ScaleTemperature,
)
from gyromodel.effects.thermal import BiasTemperature, BiasTemperatureCurve, BiasTemperatureGradient
from gyromodel.estimate import Calibration, fit
from gyromodel.model import GyroModel, ModelError, model_from_effects
from gyromodel.simulation import simulate

ROWS = 200
RARE = 1e-5
SEEDS = 100
DEG = np.pi / 180


def value(*x: float):
    return jnp.asarray(x if len(x) > 1 else x[0], float)


def bench(output: np.ndarray, kind: str = "rate", unit: str = "rad/s", **columns: np.ndarray) -> Campaign:
    rows = len(output)
    all_columns = {"time": np.arange(rows) * 2.0, **columns, "output": output}
    units = {"time": "s", "temperature": "degC", "rate": "rad/s", "output": unit}
    return Campaign(all_columns, {name: units[name] for name in all_columns}, {"kind": kind})


def rates(campaign: Campaign) -> np.ndarray:
    return campaign.si("rate_estimated")


def stds(campaign: Campaign) -> np.ndarray:
    return campaign.si("rate_estimated_std")


def note(campaign: Campaign) -> str:
    return str(campaign.metadata.get("rate_estimated_note", ""))


def polynomial(r, temperature):
    return 5.0 * (r + 0.02 + 1e-3 * (temperature - 30)) * (1 + 0.1 * (r / 2) - 0.2 * (r / 2) ** 2 + 0.05 * (r / 2) ** 4)


def sine(r, temperature):
    share = np.sinc(0.9 * r / np.pi)  # sin(κr)/(κr)
    return -3.0 * (r - 0.01) * (share + 1e-3 * (temperature - 20))


def asymmetric(r, temperature):
    u = (temperature - 25) / 10
    bias = 0.01 * u - 0.002 * u**2 + 5e-4 * np.maximum(temperature - 31, 0)
    return 2.0 * (r + bias) * (1 + 0.5 * 0.05 * np.sign(r))


MODELS: dict[Callable, tuple[Effect, ...]] = {
    polynomial: (
        ScaleFactor(value=value(5.0)),
        Bias(value=value(0.02)),
        BiasTemperature(coefficient=value(1e-3), reference=value(30.0)),
        ScaleNonlinearity(coefficients=value(0.1, -0.2, 0.05), powers=(2, 3, 5), full_rate=value(2.0)),
    ),
    sine: (
        ScaleFactor(value=value(-3.0)),
        Bias(value=value(-0.01)),
        ScaleSagnacSine(kappa=value(0.9)),
        ScaleTemperature(coefficient=value(1e-3), reference=value(20.0)),
    ),
    asymmetric: (
        ScaleFactor(value=value(2.0)),
        ScaleAsymmetry(difference=value(0.05)),
        BiasTemperatureCurve(
            coefficients=value(0.01, -0.002), hinges=value(5e-4).reshape(1), breakpoints=value(31.0).reshape(1),
            reference=value(25.0),
        ),
    ),
}  # fmt: skip


def roots(forward: Callable, output: np.ndarray, temperature: np.ndarray) -> np.ndarray:
    def root(y, temperature):
        return brentq(lambda r: forward(r, temperature) - y, -1.6, 1.6, xtol=1e-15, rtol=1e-14)

    return np.array([root(*pair) for pair in zip(output, temperature, strict=True)])


@pytest.mark.parametrize("forward", MODELS, ids=lambda forward: forward.__name__)
def test_rates_are_those_of_an_independent_root_finder(forward: Callable, rng: np.random.Generator):
    temperature = rng.uniform(10, 50, ROWS)
    output = forward(rng.uniform(-1.5, 1.5, ROWS), temperature)
    result = compensate(bench(output, temperature=temperature), Calibration(GyroModel(MODELS[forward])))
    expected = roots(forward, output, temperature)
    assert rates(result) == pytest.approx(expected, rel=1e-10, abs=1e-12)
    assert list(result.columns) == ["time", "temperature", "output", "rate_estimated", "rate_estimated_std"]
    assert result.units["rate_estimated"] == result.units["rate_estimated_std"] == "deg/s"


def test_a_spline_is_inverted(rng: np.random.Generator):
    effect = ScaleSpline(coefficients=value(-0.1, 0.3, 0.05, -0.2), full_rate=value(1.4), lowest=value(-1.0))
    knots = np.linspace(-1.0, 1.4, 6)
    at_knots = np.asarray(effect.contribution({"rate": jnp.asarray(knots), "time": jnp.zeros(6)}))
    spline = CubicSpline(knots, at_knots, bc_type="natural")
    inside = rng.uniform(-0.99, 1.39, ROWS)
    output = inside + spline(inside)
    assert np.diff(knots + at_knots).min() > 0
    result = compensate(bench(output), Calibration(GyroModel((effect,))))
    assert rates(result) == pytest.approx(inside, rel=1e-10, abs=1e-12)


FOLDS = {
    # sin x reaches 1 and no more: at 3 rad/s the gain of 3 would need more.
    "sine": (ScaleSagnacSine(kappa=value(0.9)), 1 / 0.9),
    # r − r³/3 rises to 2/3 at r = 1; behind, it falls, and gives 0.7 and more at r < −1.
    "cubic": (ScaleNonlinearity(coefficients=value(-1 / 3).reshape(1), powers=(3,), full_rate=value(1.0)), 2 / 3),
    # r − r³ + r⁵/5 rises again beyond r² = 2.62, where it also gives 0.45: another branch.
    "quintic": (ScaleNonlinearity(coefficients=value(-1, 0.2), powers=(3, 5), full_rate=value(1.0)), 0.4),
}


@pytest.mark.parametrize("name", FOLDS)
def test_an_output_beyond_a_fold_has_no_rate(name: str, rng: np.random.Generator):
    effect, top = FOLDS[name]
    top += 0.0 if name != "quintic" else 0.4 * 0.001
    output = np.concatenate([top * rng.uniform(-0.98, 0.98, 50), top * rng.uniform(1.001, 1.5, 30), [np.nan]])
    output[50:60] *= -1
    result = compensate(bench(output), Calibration(GyroModel((effect,))))
    assert np.isfinite(rates(result)[:50]).all()
    assert np.isnan(rates(result)[50:]).all()
    assert np.isnan(stds(result)).all()
    assert note(result).startswith("30 of 80 samples have no estimated rate: ")


def test_where_the_output_jumps_the_rate_is_that_of_the_jump(rng: np.random.Generator):
    model = GyroModel((Bias(value=value(0.1)), ScaleAsymmetry(difference=value(0.02))))
    # At rest the output jumps from 0.1·0.99 to 0.1·1.01.
    result = compensate(bench(rng.uniform(0.0991, 0.1009, ROWS)), Calibration(model))
    assert np.abs(rates(result)).max() < 1e-8


def test_missing_outputs_stay_missing_and_a_given_rate_is_not_used(rng: np.random.Generator):
    temperature, truth = rng.uniform(10, 50, ROWS), rng.uniform(-1.5, 1.5, ROWS)
    output = polynomial(truth, temperature)
    output[::7] = np.nan
    plain = bench(output, temperature=temperature)
    calibration = Calibration(GyroModel(MODELS[polynomial], {"noise_white": 1e-3}))
    result = compensate(plain, calibration)
    assert np.isnan(rates(result)[::7]).all()
    assert np.isnan(stds(result)[::7]).all()
    assert np.isfinite(rates(result)).sum() == np.isfinite(output).sum()
    assert "no estimated rate" not in note(result)
    wrong = rng.standard_normal(ROWS)
    wrong[5] = np.nan
    again = compensate(bench(output, temperature=temperature, rate=wrong), calibration)
    assert np.array_equal(rates(again), rates(result), equal_nan=True)
    assert np.array_equal(again.si("rate"), wrong, equal_nan=True)


@pytest.mark.parametrize("kind", ["rate", "increment", "angle"])
def test_every_kind_of_output(kind: str, rng: np.random.Generator):
    truth = rng.uniform(-1, 1, ROWS)
    model = GyroModel((ScaleFactor(value=value(1000.0)), Bias(value=value(0.01)), ScaleSagnacSine(kappa=value(0.5))))
    pattern = bench(rng.standard_normal(ROWS), kind, "count/s" if kind == "rate" else "count", rate=truth)
    result = compensate(simulate(model, pattern).without("rate"), Calibration(model))
    first = 1 if kind == "angle" else 0
    assert rates(result)[first:] == pytest.approx(truth[first:], rel=1e-9, abs=1e-11)


def test_the_uncertainty_of_a_line_has_its_closed_form(rng: np.random.Generator):
    gain, bias, noise = 4.0, 0.3, 2e-3
    root = rng.standard_normal((2, 2))
    covariance = 1e-6 * root @ root.T
    model = GyroModel((ScaleFactor(value=value(gain)), Bias(value=value(bias))), {"noise_white": value(noise)})
    output = gain * (rng.uniform(-1, 1, ROWS) + bias)
    result = compensate(bench(output), Calibration(model, covariance))
    # rate = y/S − b
    by_gain, by_bias = -output / gain**2, -np.ones(ROWS)
    variance = by_gain**2 * covariance[0, 0] + 2 * by_gain * by_bias * covariance[0, 1] + covariance[1, 1]
    assert stds(result) == pytest.approx(np.sqrt(variance + noise**2 / 2.0), rel=1e-12)
    assert result.metadata["rate_estimated_std_holds"] == "parameter covariance, white noise of one sample"
    assert note(result) == ""


@pytest.mark.parametrize("forward", [polynomial, sine], ids=lambda forward: forward.__name__)
def test_the_uncertainty_of_a_curve_is_that_of_finite_differences(forward: Callable, rng: np.random.Generator):
    model = GyroModel(MODELS[forward])
    temperature = rng.uniform(10, 50, ROWS)
    campaign = bench(forward(rng.uniform(-1.2, 1.2, ROWS), temperature), temperature=temperature)
    vector = model.vector()
    root = rng.standard_normal((len(vector),) * 2)
    covariance = 1e-8 * root @ root.T
    columns = []
    for i in range(len(vector)):
        step = jnp.zeros(len(vector)).at[i].set(1e-6)
        ends = [Calibration(model.with_vector(vector + sign * step)) for sign in (1, -1)]
        up, down = (rates(compensate(campaign, end)) for end in ends)
        columns.append((up - down) / 2e-6)
    jacobian = np.stack(columns, axis=1)
    expected = np.sqrt(np.einsum("np,pq,nq->n", jacobian, covariance, jacobian))
    assert stds(compensate(campaign, Calibration(model, covariance))) == pytest.approx(expected, rel=1e-6)


def test_noise_counts_by_the_local_slope():
    kappa, noise = 0.9, 1e-3
    model = GyroModel((ScaleFactor(value=value(7.0)), ScaleSagnacSine(kappa=value(kappa))), {"noise_white": noise})
    truth = np.linspace(-1.5, 1.5, ROWS)
    result = compensate(bench(7 * np.sin(kappa * truth) / kappa), Calibration(model))
    # The curve bends a little within two standard deviations.
    assert stds(result) == pytest.approx(noise / np.sqrt(2.0) / np.cos(kappa * truth), rel=1e-3)


def test_a_dead_band_hides_the_rate_and_says_so():
    width, noise = 0.5, 1e-3
    lock = LockIn(half_width=value(width), centre=value(0.0))
    model = GyroModel((ScaleFactor(value=value(7.0)), lock), {"noise_white": noise})
    truth = np.linspace(-1.5, 1.5, ROWS)
    beyond = np.abs(truth) > width
    beat = np.sign(truth) * np.sqrt(np.maximum(truth**2 - width**2, 0.0))
    result = compensate(bench(7 * beat), Calibration(model))
    assert rates(result)[beyond] == pytest.approx(truth[beyond], rel=1e-9)
    assert np.abs(rates(result)[~beyond]).max() <= width * (1 + 1e-9)
    assert stds(result)[~beyond] == pytest.approx(width / 2, rel=1e-3)
    assert "leaves out the uncertainty of its parameters" in note(result)
    assert result.metadata["rate_estimated_std_holds"] == "white noise of one sample"


def test_a_saturated_output_tells_no_rate(rng: np.random.Generator):
    """At the limit any rate beyond gives the output, and noise above it is given by none: neither by rates of 1e10."""
    limit, noise = 1.0, 1e-6
    model = GyroModel((ScaleFactor(value=value(7.0)), Saturation(limit=value(limit))), {"noise_white": noise})
    truth = np.linspace(-1.5, 1.5, ROWS)
    # Within 1e-3 standard deviations of the limit, where a tolerance of the rate's would take it for the limit.
    output = np.clip(truth, -limit, limit) + 1e-9 * rng.standard_normal(ROWS)
    result = compensate(bench(7 * output), Calibration(model))
    inside = np.abs(truth) < limit - 1e-3
    assert rates(result)[inside] == pytest.approx(truth[inside], abs=1e-8)
    assert np.isnan(rates(result)[np.abs(truth) > limit]).all()
    assert np.isnan(stds(result)[np.abs(truth) > limit]).all()


@pytest.mark.long
def test_fits_cover_the_truth_as_often_as_they_claim(rng: np.random.Generator):
    """The rate of one more sample, by a calibration on 30: Student's t of the fit's degrees of freedom."""
    gain, bias, kappa, level = 1e3, 0.01, 0.7, 1e-3
    start = GyroModel(
        (ScaleFactor(value=value(900.0)), Bias(), ScaleSagnacSine(kappa=value(0.6))), {"noise_white": value(level)}
    )

    def measured(turning: np.ndarray, **columns: np.ndarray) -> Campaign:
        noise = level / np.sqrt(2.0) * rng.standard_normal(len(turning))
        return bench(gain * (np.sinc(kappa * turning / np.pi) * (turning + bias) + noise), unit="count/s", **columns)

    inside = {0.5: 0, 0.95: 0}
    for _ in range(SEEDS):
        calibrated = rng.uniform(-1.2, 1.2, 30)
        estimate = fit(measured(calibrated, rate=calibrated), start)
        # Beyond what was calibrated, so that the parameters' share counts.
        truth = np.array([1.6, 0.5, -0.5])
        result = compensate(measured(truth), estimate.calibration())
        score = abs(rates(result)[0] - truth[0]) / stds(result)[0]
        for share in inside:
            inside[share] += int(score < t.ppf((1 + share) / 2, estimate.degrees_of_freedom))
    for share, count in inside.items():
        assert binom.ppf(RARE, SEEDS, share) <= count <= binom.isf(RARE, SEEDS, share), (share, count)


def test_what_lies_outside_the_calibration_is_counted(rng: np.random.Generator):
    truth, temperature = rng.uniform(-1, 1, ROWS), rng.uniform(20, 40, ROWS)
    truth[:5], temperature[:7] = 1.5, 45.0
    model = GyroModel((ScaleFactor(value=value(2.0)),), {"noise_white": 1e-6})
    validity = {"rate": (-1.0, 1.0), "temperature": (20.0, 40.0)}
    calibration = Calibration(model, np.zeros((1, 1)), validity)
    result = compensate(bench(2 * truth, temperature=temperature), calibration)
    assert rates(result) == pytest.approx(truth)
    assert note(result) == (
        "5 of 200 samples lie outside the calibrated range of rate, -57.2958 to 57.2958 deg/s. "
        "7 of 200 samples lie outside the calibrated range of temperature, 20 to 40 degC."
    )
    blind = compensate(bench(2 * truth[5:]), calibration)
    assert note(blind) == "There is no column temperature to hold against the calibrated range of 20 to 40 degC."
    # A note of an earlier calibration does not outlive it.
    assert note(compensate(result, Calibration(model, np.zeros((1, 1))))) == ""


def test_effects_of_time_say_from_when_they_count(rng: np.random.Generator):
    model = GyroModel((BiasDrift(slope=value(1e-4)),), {"noise_white": 1e-6})
    result = compensate(bench(rng.standard_normal(ROWS)), Calibration(model, np.zeros((1, 1))))
    assert note(result) == "Time in bias_drift counts from the start of this campaign."


def test_the_fit_s_reference_points_are_used(rng: np.random.Generator):
    """A calibration around 30 °C, applied at 60 °C."""
    warm, cold = np.full(ROWS, 60.0), 30 + 10 * np.sin(np.arange(ROWS))
    truth = rng.uniform(-1, 1, ROWS)
    model = GyroModel((
        ScaleFactor(value=value(100.0)), Bias(value=value(0.05)),
        BiasTemperature(coefficient=value(1e-2), reference=value(30.0)),
    ))  # fmt: skip
    design = bench(rng.standard_normal(ROWS), unit="V", rate=truth, temperature=cold)
    names = ["scale_factor", "bias", "bias_temperature"]
    start = GyroModel(model_from_effects(names).effects, {"noise_white": value(1e-7)})
    calibration = fit(simulate(GyroModel(model.effects, {"noise_white": 1e-7}), design), start).calibration()
    measured = bench(100 * (truth + 0.05 + 1e-2 * (warm - 30)), unit="V", temperature=warm)
    assert rates(compensate(measured, calibration)) == pytest.approx(truth, abs=1e-5)


@pytest.mark.parametrize(
    ("effects", "unit", "expected"),
    [
        ((BiasTemperature(coefficient=value(1.0), reference=value(20.0)),), "rad/s", "needs a column temperature"),
        ((Bias(),), "count/s", "needs a scale_factor"),
        ((ScaleFactor(value=value(2.0), unit="count/deg"),), "V", "scale_factor is in count/deg"),
        ((TimeDelay(delay=value(0.1)),), "rad/s", "time_delay depends on the rates around a sample"),
        ((Bandwidth(time_constant=value(0.1)),), "rad/s", "bandwidth depends on the rates around a sample"),
        (
            (Bandwidth(natural_period=value(0.2)[None], time_constant=value(0.1)),),
            "rad/s",
            "bandwidth depends on the rates around a sample",
        ),
    ],
)
def test_what_does_not_fit_the_campaign_is_refused(effects: tuple[Effect, ...], unit: str, expected: str):
    with pytest.raises(ModelError, match=expected):
        compensate(bench(np.arange(9.0), unit=unit), Calibration(GyroModel(effects)))


def test_missing_covariates_are_named():
    temperature = np.arange(9.0)
    temperature[3] = np.nan
    model = GyroModel((BiasTemperature(coefficient=value(1.0), reference=value(20.0)),))
    with pytest.raises(ModelError, match="NaN in data rows 4"):
        compensate(bench(np.arange(9.0), temperature=temperature), Calibration(model))


def test_several_axes_must_be_chosen_from():
    columns = {"time": np.arange(5.0), "output_x": np.arange(5.0), "output_y": np.arange(5.0)}
    campaign = Campaign(columns, {"time": "s", "output_x": "deg/s", "output_y": "deg/s"}, {"kind": "rate"})
    with pytest.raises(CampaignError, match="--axis"):
        compensate(campaign, Calibration(GyroModel((Bias(),))))
    assert len(compensate(campaign.axis("x"), Calibration(GyroModel((Bias(),))))) == 5


@pytest.mark.parametrize("effect", [ScaleFactor(), BiasTemperature(coefficient=value(1.0))])
def test_a_model_without_values_is_no_calibration(effect: Effect):
    with pytest.raises(ModelError, match="has no value for"):
        Calibration(GyroModel((effect,)))


def test_a_covariance_of_other_parameters_is_refused():
    with pytest.raises(ModelError, match="1 parameters are free"):
        Calibration(GyroModel((Bias(),)), np.zeros((2, 2)))


def test_thermometers_that_the_model_leaves_open_are_the_campaign_s(rng: np.random.Generator):
    effect = BiasTemperatureGradient(coefficient=value(0.2))
    pair = {"temperature": 20 + rng.random(ROWS), "temperature_coil": 21 + rng.random(ROWS)}
    columns = {"time": np.arange(ROWS) * 1.0, "output": 0.2 * (pair["temperature"] - pair["temperature_coil"])}
    units = {"time": "s", "output": "rad/s", "temperature": "degC", "temperature_coil": "degC"}
    result = compensate(Campaign(columns | pair, units, {"kind": "rate"}), Calibration(GyroModel((effect,))))
    assert rates(result) == pytest.approx(0.0, abs=1e-12)


def test_a_run_that_was_not_fitted_is_noted():
    turn_on = BiasTurnOn(offsets=value(0.1, 0.2), runs=value(2.0, 3.0))
    calibration = Calibration(GyroModel((Bias(value(0.0)), turn_on)))
    runs = np.repeat([2.0, 7.0], [3, 5])
    campaign = bench(np.linspace(0.0, 1.0, 8)).with_column("run", runs, "")
    compensated = compensate(campaign, calibration)
    assert "5 of 8 samples are of other runs than 2, 3 and take the first run's bias" in note(compensated)
    assert "other runs" not in note(compensate(campaign.select(runs == 2.0), calibration))
