"""Fits against dense linear algebra: generalised least squares, its covariance and that of ordinary least squares, with
the noise covariance written down from its definition; against optimistix; and what a fit must refuse."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import binom, chi2, norm

from gyromodel.campaign import Campaign
from gyromodel.effects.drivers import Bias, BiasDrift
from gyromodel.effects.scale import ScaleFactor
from gyromodel.effects.thermal import BiasTemperature, BiasTemperatureCurve, BiasWarmup
from gyromodel.estimate import Estimate, EstimateError, _fit, fit, fit_record, two_stage, with_noise_intervals
from gyromodel.estimate._estimate import noise_table
from gyromodel.model import GyroModel, ModelError, model_from_effects
from gyromodel.noise import NoiseRatios, markov_sum
from gyromodel.numerics.least_squares import Solution
from gyromodel.signals import Record, read_signals
from gyromodel.simulation import draw_noise
from tests.test_state_space import covariance

ROWS, STEP = 256, 20.0
RATIOS = NoiseRatios(jnp.asarray(0.3), jnp.asarray(0.02))
DEG_H = np.pi / 180 / 3600


def campaign(
    rng: np.random.Generator, rows: int = ROWS, unit: str = "deg/h", size: float = 1.0, **extra: np.ndarray
) -> Campaign:
    """A rate and temperature test; the output is rate, a bias over temperature and noise, times `size`, in `unit`."""
    time = np.arange(rows) * STEP
    rate = np.resize(rng.permutation(np.linspace(-1.0, 1.0, 32)).repeat(8), rows)
    temperature = 20 + 15 * np.sin(time / 700) + 5 * np.cos(time / 250)
    output = size * (rate + 0.3 + 0.01 * (temperature - 20) + 1e-2 * rng.standard_normal(rows))
    columns = {"time": time, "rate": rate, "temperature": temperature, "output": output} | extra
    units = {"time": "s", "rate": "deg/h", "temperature": "degC", "output": unit} | dict.fromkeys(extra, "V")
    return Campaign(columns, units, {"kind": "rate"}, "test")


def linear_model() -> GyroModel:
    """Linear in its free parameters."""
    effects = (
        ScaleFactor(value=jnp.ones(())),
        *model_from_effects(["bias", "bias_temperature", "bias_drift"]).effects,
    )
    return GyroModel(effects, {}, frozenset({("scale_factor", "value")}))


def dense(record: Record, ratios: NoiseRatios) -> np.ndarray:
    """Noise covariance of the rows present, in units of the white variance."""
    here = np.asarray(record.sampling.present)
    return covariance(markov_sum(ratios, record.interval, record.span), record.sampling)[np.ix_(here, here)]


def regression(record: Record, model: GyroModel) -> tuple[np.ndarray, np.ndarray]:
    """Jacobian and data of a linear model by differences of its predictions, rows present only."""
    here = np.asarray(record.sampling.present)
    model = model.prepared(record.signals)
    zero = model.with_vector(jnp.zeros(len(model.slots())))
    base = np.asarray(zero.predict(record.signals))[here]
    unit = np.eye(len(model.slots()))
    columns = [np.asarray(model.with_vector(jnp.asarray(row)).predict(record.signals))[here] - base for row in unit]
    return np.column_stack(columns), np.asarray(record.signals["output"])[here] - base


def thinned(record: Record, rng: np.random.Generator) -> Record:
    """Some rows missing."""
    return record.without(rng.choice(record.rows, 40, replace=False))


def test_generalised_least_squares_is_the_dense_one(rng: np.random.Generator):
    record = thinned(read_signals(campaign(rng)), rng)
    estimate = fit_record(record, linear_model(), ratios=RATIOS)
    matrix, data = regression(record, linear_model())
    weight = np.linalg.inv(dense(record, RATIOS))
    scale = np.abs(matrix).max(axis=0)
    information = (matrix / scale).T @ weight @ (matrix / scale)
    solution = np.linalg.solve(information, (matrix / scale).T @ weight @ data) / scale
    residual = data - matrix @ solution
    variance = residual @ weight @ residual / (len(data) - 3)
    expected = np.linalg.inv(information) / np.outer(scale, scale) * variance

    assert np.asarray(estimate.model.vector()) == pytest.approx(solution, rel=1e-9)
    assert estimate.covariance / np.outer(estimate.std, estimate.std) == pytest.approx(
        expected / np.outer(estimate.std, estimate.std), abs=1e-9
    )
    assert estimate.degrees_of_freedom == record.rows - 40 - 3
    assert estimate.white_variance == pytest.approx(variance, rel=1e-9)
    assert estimate.residual[record.present] == pytest.approx(residual, rel=1e-9, abs=1e-15)
    assert np.isnan(estimate.residual[~record.present]).all()
    lower = np.linalg.cholesky(dense(record, RATIOS))
    whitened = np.linalg.solve(lower, residual) / np.sqrt(variance)
    assert estimate.whitened[record.present] == pytest.approx(whitened, rel=1e-8, abs=1e-8)
    assert np.isnan(estimate.whitened[~record.present]).all()


def test_ordinary_least_squares_has_its_dense_covariance(rng: np.random.Generator):
    record = thinned(read_signals(campaign(rng)), rng)
    estimate = fit_record(record, linear_model(), ratios=RATIOS, ordinary=True)
    matrix, data = regression(record, linear_model())
    scale = np.abs(matrix).max(axis=0)
    pseudo = np.linalg.pinv(matrix / scale) / scale[:, None]
    assert np.asarray(estimate.model.vector()) == pytest.approx(pseudo @ data, rel=1e-7)
    expected = pseudo @ dense(record, RATIOS) @ pseudo.T * estimate.white_variance
    size = np.outer(estimate.std, estimate.std)
    assert estimate.covariance / size == pytest.approx(expected / size, abs=1e-8)


def test_weights_follow_the_relative_white_variance(rng: np.random.Generator):
    record = read_signals(campaign(rng))
    white = rng.uniform(0.2, 5.0, len(record.sampling.white))
    record = record._replace(sampling=record.sampling._replace(white=jnp.asarray(white)))
    for ordinary in (False, True):
        estimate = fit_record(
            record, linear_model(), ratios=NoiseRatios(jnp.zeros(()), jnp.zeros(())), ordinary=ordinary
        )
        matrix, data = regression(record, linear_model())
        root = 1 / np.sqrt(white[: record.rows])
        scale = np.abs(matrix).max(axis=0)
        pseudo = np.linalg.pinv(matrix * root[:, None] / scale) / scale[:, None]
        assert np.asarray(estimate.model.vector()) == pytest.approx(pseudo @ (data * root), rel=1e-7)
        expected = pseudo @ pseudo.T * estimate.white_variance
        size = np.outer(estimate.std, estimate.std)
        assert estimate.covariance / size == pytest.approx(expected / size, abs=1e-8)


NONLINEAR = ["scale_factor", "bias", "bias_temperature", "scale_temperature", "bias_warmup"]


def started() -> GyroModel:
    model = model_from_effects(NONLINEAR)
    return model.with_vector(jnp.asarray([jnp.nan, 0.0, 0.0, 0.0, DEG_H, 1000.0]))


@pytest.fixture(scope="module")
def warm() -> Record:
    rng = np.random.default_rng(11)
    measured = campaign(rng)
    decay = 2.0 * np.exp(-measured.columns["time"] / 900)
    return thinned(read_signals(measured.with_column("output", measured.columns["output"] + decay, "deg/h")), rng)


@pytest.fixture(scope="module")
def nonlinear(warm: Record) -> Estimate:
    return fit_record(warm, started(), ratios=RATIOS)


def test_nonlinear_fit_ends_where_the_dense_gradient_vanishes(warm: Record, nonlinear: Estimate):
    here = np.asarray(warm.sampling.present)
    model = nonlinear.model
    jacobian = jax.jit(jax.jacfwd(lambda v: model.with_vector(v).predict(warm.signals)))(model.vector())
    matrix = np.asarray(jacobian)[here] * nonlinear.std
    weight = np.linalg.inv(dense(warm, RATIOS))
    residual = nonlinear.residual[warm.present]
    assert np.abs(matrix.T @ weight @ residual) / nonlinear.white_variance == pytest.approx(0.0, abs=1e-3)
    expected = np.linalg.inv(matrix.T @ weight @ matrix) * nonlinear.white_variance
    assert nonlinear.covariance / np.outer(nonlinear.std, nonlinear.std) == pytest.approx(expected, abs=1e-6)
    rows = {(r.effect, r.name): r for r in nonlinear.table()}
    for name, size in (("time_constant", 900.0), ("amplitude", 2.0)):
        row = rows[("bias_warmup", name)]
        assert abs(row.value - size) < 6 * row.std


@pytest.mark.parametrize(("unit", "size"), [("deg/h", 1.0), ("count/s", 4e6), ("deg/s", 1e-6)])
def test_both_solvers_agree_in_any_unit(unit: str, size: float, warm: Record):
    """Tolerances are relative: neither solver stops early where the numbers are small."""
    factor = size / DEG_H if unit == "count/s" else size
    record = warm._replace(
        signals=warm.signals | {"output": warm.signals["output"] * factor},
        output_unit="count/s" if unit == "count/s" else "rad/s",
    )
    own = fit_record(record, started(), ratios=RATIOS)
    other = fit_record(record, started(), ratios=RATIOS, solver="optimistix")
    assert np.asarray(own.model.vector() - other.model.vector()) / own.std == pytest.approx(0.0, abs=2e-3)
    assert own.covariance / np.outer(own.std, own.std) == pytest.approx(
        other.covariance / np.outer(own.std, own.std), abs=1e-3
    )


def test_scaling_the_output_scales_the_fit(warm: Record):
    """The noise is estimated here: its ratios, the likelihood's choice of them and the intervals know no unit."""
    model = model_from_effects(["scale_factor", "bias", "bias_temperature"])
    one = with_noise_intervals(fit_record(warm, model))
    scaled = warm._replace(signals=warm.signals | {"output": 4e9 * warm.signals["output"]})
    other = with_noise_intervals(fit_record(scaled, model))
    ratio = np.asarray(other.model.vector() / one.model.vector())
    assert ratio == pytest.approx([4e9, 1.0, 1.0], rel=1e-6)
    assert other.std / one.std == pytest.approx([4e9, 1.0, 1.0], rel=1e-6)
    for name, (low, high) in one.noise_interval.items():
        assert other.noise_interval[name] == pytest.approx((low, high), rel=1e-6)
        assert float(other.model.noise[name]) == pytest.approx(float(one.model.noise[name]), rel=1e-6)
        assert low <= float(one.model.noise[name]) * (1 + 1e-9)
        assert float(one.model.noise[name]) <= high * (1 + 1e-9)


def test_propagation_is_the_derivative_by_hand_and_the_spread_of_draws(nonlinear: Estimate, rng: np.random.Generator):
    amplitude, tau = (nonlinear.model.vector()[i] for i in (4, 5))

    def at_ten_minutes(model: GyroModel):
        warmup = model.effects[4]
        return warmup.amplitude[0] * jnp.exp(-600.0 / warmup.time_constant[0])  # type: ignore[attr-defined]

    later = nonlinear.propagate(at_ten_minutes)
    value, variance = later.value, later.covariance
    decay = np.exp(-600.0 / float(tau))
    assert float(value) == pytest.approx(float(amplitude) * decay)
    by_hand = np.array([0, 0, 0, 0, decay, float(amplitude) * decay * 600 / float(tau) ** 2])
    assert variance == pytest.approx(np.array([[by_hand @ nonlinear.covariance @ by_hand]]), rel=1e-9)

    draws = rng.multivariate_normal(np.zeros(6), nonlinear.covariance / np.outer(nonlinear.std, nonlinear.std), 20_000)
    a, t = (np.asarray(nonlinear.model.vector())[i] + 0.1 * nonlinear.std[i] * draws[:, i] for i in (4, 5))
    spread = np.var(a * np.exp(-600.0 / t)) / 0.1**2
    assert spread == pytest.approx(float(variance[0, 0]), rel=0.06)  # 1 % of statistics, the rest for curvature

    first = nonlinear.propagate(lambda m: m.predict(nonlinear.record.signals)[:5])
    values, matrix = first.value, first.covariance
    assert values.shape == (5,)
    assert matrix.shape == (5, 5)
    jacobian = np.asarray(nonlinear.model.linearise(nonlinear.record.signals)[1])[:5]
    assert matrix == pytest.approx(jacobian @ nonlinear.covariance @ jacobian.T, rel=1e-9)


def test_table_and_summary_are_in_reporting_units(nonlinear: Estimate):
    rows = nonlinear.table()
    assert [r.unit for r in rows] == ["1", "deg/h", "deg/h/degC", "ppm/degC", "deg/h", "s"]
    assert rows[1].value * DEG_H == pytest.approx(float(nonlinear.model.vector()[1]))
    assert rows[1].std * DEG_H == pytest.approx(nonlinear.std[1])
    summary = nonlinear.to_dict()
    assert summary["samples"] + summary["missing"] == ROWS
    assert summary["missing"] == 40
    assert len(summary["parameters"]) == 6


def test_missing_outputs_are_rows_left_out(rng: np.random.Generator):
    measured = campaign(rng)
    output = measured.columns["output"].copy()
    holes = np.sort(rng.choice(ROWS, 40, replace=False))
    output[holes] = np.nan
    temperature = measured.columns["temperature"].copy()
    temperature[holes[:7]] = np.nan  # nobody needs to know what it was where nothing was measured
    pierced = measured.with_column("output", output, "deg/h").with_column("temperature", temperature, "degC")
    record = read_signals(pierced)
    filled = read_signals(measured).without(holes)
    model = linear_model().prepared(filled.signals)
    one, other = (fit_record(r, model, ratios=RATIOS) for r in (record, filled))
    assert np.asarray(one.model.vector()) == pytest.approx(np.asarray(other.model.vector()), rel=1e-10)
    assert one.covariance == pytest.approx(other.covariance, rel=1e-8)


def test_padding_changes_nothing(rng: np.random.Generator):
    """Below and above a padded length: the same rows with many or no rows of padding."""
    record = read_signals(campaign(rng))
    assert len(record.sampling.present) == ROWS
    longer = record._replace(
        signals={k: jnp.pad(v, (0, 64), mode="edge") for k, v in record.signals.items()},
        sampling=type(record.sampling)(*(jnp.pad(x, (0, 64)) for x in record.sampling))._replace(
            white=jnp.pad(record.sampling.white, (0, 64), mode="edge")
        ),
    )
    model = linear_model().prepared(record.signals)
    one, other = (fit_record(r, model, ratios=RATIOS) for r in (record, longer))
    assert np.asarray(one.model.vector()) == pytest.approx(np.asarray(other.model.vector()), rel=1e-11)
    assert one.log_likelihood == pytest.approx(other.log_likelihood, rel=1e-11)


def test_campaigns_fitted_together_are_independent_records(rng: np.random.Generator):
    parts = [campaign(rng, rows) for rows in (100, 156)]
    record = read_signals(parts)
    estimate = fit_record(record, linear_model(), ratios=RATIOS)
    matrix, data = regression(record, linear_model())
    total = dense(record, RATIOS)
    assert not total[:100, 100:].any()
    weight, scale = np.linalg.inv(total), np.abs(matrix).max(axis=0)
    information = (matrix / scale).T @ weight @ (matrix / scale)
    solution = np.linalg.solve(information, (matrix / scale).T @ weight @ data) / scale
    assert np.asarray(estimate.model.vector()) == pytest.approx(solution, rel=1e-9)
    assert fit(parts, linear_model()).degrees_of_freedom == 253
    # Information adds; the noise level is each fit's own and does not.
    alone = fit_record(read_signals(parts[1]), linear_model(), ratios=RATIOS)
    unit, unit_alone = (e.std / np.sqrt(e.white_variance) for e in (estimate, alone))
    assert (unit < unit_alone).all()


def test_campaigns_of_unlike_intervals_weigh_by_their_white_noise(rng: np.random.Generator):
    """A fast, noisy campaign and a slow one of the same N, both following a column: errors against their intervals."""
    parts, seeds, true = ((300, 0.01), (600, 1.0)), 40, 3.0 * DEG_H
    model = model_from_effects(["bias", "bias_supply_voltage"])
    inside, z = 0, []
    for _ in range(seeds):
        found = []
        for rows, step in parts:
            voltage = np.sin(np.linspace(0.0, 20.0, rows))
            output = true * voltage + DEG_H / np.sqrt(step) * rng.standard_normal(rows)
            columns = {"time": step * np.arange(rows), "supply_voltage": voltage, "output": output}
            found.append(Campaign(columns, {"time": "s", "supply_voltage": "V", "output": "rad/s"}, {"kind": "rate"}))
        estimate = fit_record(read_signals(found), model, ratios=NoiseRatios(jnp.asarray(0.0), jnp.asarray(0.0)))
        assert float(estimate.model.noise["noise_white"]) == pytest.approx(DEG_H, rel=0.15)
        z.append((float(estimate.model.vector()[1]) - true) / estimate.std[1])
        inside += abs(z[-1]) < norm.isf(0.025)
    assert binom.cdf(inside, seeds, 0.95) > 1e-5
    assert 1e-5 < chi2.cdf(np.sum(np.square(z)), seeds) < 1 - 1e-5


def test_stated_noise_is_used_as_it_stands(rng: np.random.Generator):
    record = read_signals(campaign(rng))
    N = 1e-2 * DEG_H * np.sqrt(STEP)
    noise = {"noise_white": N, "noise_random_walk": np.sqrt(0.02) * N / STEP, "noise_flicker": np.sqrt(0.3 / STEP) * N}
    model = GyroModel(linear_model().effects, noise, linear_model().fixed)
    estimate = fit_record(record, model)
    assert estimate.noise_given
    held = fit_record(record, linear_model(), ratios=RATIOS)
    assert np.asarray(estimate.model.vector()) == pytest.approx(np.asarray(held.model.vector()), rel=1e-9)
    assert {k: float(v) for k, v in estimate.model.noise.items()} == pytest.approx(noise)
    with pytest.raises(ModelError, match="needs a noise_white above zero"):
        fit_record(record, GyroModel(model.effects, {"noise_flicker": 1e-9}))
    assert estimate.model_as_given().noise != {}
    assert held.model_as_given().noise == {}


def ramp(rng: np.random.Generator) -> Campaign:
    measured = campaign(rng)
    return measured.with_column("temperature", np.linspace(10.0, 40.0, ROWS), "degC")


UNDETERMINED = [
    (["bias", "scale_asymmetry"], {"rate": 0.0}, {"scale_asymmetry"}),
    (["scale_factor", "bias"], {"rate": 0.0}, {"scale_factor", "bias"}),
    (["bias", "scale_nonlinearity"], {"rate": 0.0}, {"scale_nonlinearity"}),
    (["bias", "scale_spline"], {"rate": 0.0}, {"scale_spline"}),
    (["bias", "bias_temperature"], {"temperature": 25.0}, {"bias_temperature"}),
    (["bias", "bias_supply_voltage"], {"supply_voltage": 5.0}, {"bias_supply_voltage"}),
    (["bias", "bias_temperature_rate"], {"temperature": 25.0}, {"bias_temperature_rate"}),
    (["bias", "bias_temperature", "bias_drift"], {"temperature": "ramp"}, {"bias_temperature", "bias_drift"}),
    (["bias", "bias_temperature", "bias_temperature_curve"], {}, {"bias_temperature", "bias_temperature_curve"}),
    (["scale_factor", "bias", "scale_temperature"], {"temperature": 25.0}, {"scale_temperature"}),
]


@pytest.mark.parametrize(("labels", "columns", "named"), UNDETERMINED)
def test_what_the_campaign_does_not_determine_is_named(
    labels: list[str], columns: dict[str, float | str], named: set[str], rng: np.random.Generator
):
    measured = campaign(rng, supply_voltage=5 + rng.standard_normal(ROWS))
    for name, level in columns.items():
        values = np.linspace(10.0, 40.0, ROWS) if level == "ramp" else np.full(ROWS, level)
        measured = measured.with_column(name, values, measured.units[name])
    with pytest.raises(EstimateError) as caught:
        fit_record(read_signals(measured), model_from_effects(labels), ratios=RATIOS)
    message = str(caught.value)
    for effect in named:
        assert effect in message
    for effect in set(labels) - named - {"bias"}:
        assert f"{effect} " not in message.split(" can")[0].replace(",", " ") + " "
    assert "fix" in message


def test_fixing_one_of_two_alike_determines_the_other(rng: np.random.Generator):
    record = read_signals(ramp(rng))
    model = GyroModel((Bias(), BiasDrift(), BiasTemperature()), {}, frozenset({("bias_drift", "slope")}))
    assert fit_record(record, model, ratios=RATIOS).covariance.shape == (2, 2)


def test_a_missing_covariate_is_named_by_rows(rng: np.random.Generator):
    measured = campaign(rng)
    temperature = measured.columns["temperature"].copy()
    temperature[[3, 17]] = np.nan
    record = read_signals(measured.with_column("temperature", temperature, "degC"))
    with pytest.raises(
        ModelError, match=r"bias_temperature needs column temperature, which is NaN in data rows 4, 18$"
    ):
        fit_record(record, model_from_effects(["bias", "bias_temperature"]), ratios=RATIOS)
    with pytest.raises(ModelError, match="rows 4, 18"):
        fit_record(record, model_from_effects(["bias", "bias_temperature_rate"]), ratios=RATIOS)
    fit_record(record, model_from_effects(["bias"]), ratios=RATIOS)
    nothing = read_signals(measured.with_column("temperature", np.full(ROWS, np.nan), "degC"))
    with pytest.raises(ModelError, match="rows 1, 2, 3, 4, 5…"):
        fit_record(nothing, model_from_effects(["bias", "bias_temperature"]), ratios=RATIOS)
    with pytest.raises(ModelError, match="bias_pressure needs a column pressure"):
        fit(measured, model_from_effects(["bias", "bias_pressure"]))


@pytest.mark.parametrize("size", [0.0, 1e-160, 1e-308])
def test_what_hardly_moves_the_output_has_no_variance(size: float, rng: np.random.Generator):
    """A variance beyond all numbers would end a search with an error of linear algebra."""
    columns = np.stack([np.ones(ROWS), size * rng.standard_normal(ROWS)], axis=1)
    with pytest.raises(EstimateError, match="bias_drift cannot be estimated: this campaign does not excite it"):
        _fit.unit_covariance(columns, GyroModel((Bias(value=jnp.asarray(0.0)), BiasDrift(slope=jnp.asarray(0.0)))))


def test_two_stages_carry_the_uncertainty_of_the_first(rng: np.random.Generator):
    """A scale factor from one campaign, held in the fit of another: the response by refits at moved values."""
    table, log = campaign(rng), campaign(rng)
    first = fit(table, model_from_effects(["scale_factor", "bias"]))
    effects = model_from_effects(["bias", "bias_temperature", "bias_temperature_rate"]).effects

    def held(value) -> GyroModel:
        scale = ScaleFactor(value=jnp.asarray(value))
        return GyroModel((scale, *effects), {}, frozenset({("scale_factor", "value")}))

    value, std = float(first.model.vector()[0]), float(first.std[0])
    second = fit_record(read_signals(log), held(value), ratios=RATIOS)
    ends = [fit_record(read_signals(log), held(value + s * std), ratios=RATIOS) for s in (1.0, -1.0)]
    moved = np.asarray(ends[0].model.vector() - ends[1].model.vector()) / 2
    carried = two_stage(first, second).covariance - second.covariance
    size = np.sqrt(np.outer(np.diag(carried), np.diag(carried)))
    assert carried / size == pytest.approx(np.outer(moved, moved) / size, abs=1e-4)
    with pytest.raises(EstimateError, match="holds no parameter that the first one fitted"):
        two_stage(second, first)
    with pytest.raises(EstimateError, match="holds value of scale_factor at another value than the first one found"):
        two_stage(first, ends[0])


def test_a_fit_that_does_not_converge_is_refused(rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch):
    lost = Solution(np.zeros(1), 1.0, 100, False)
    monkeypatch.setattr(_fit, "levenberg_marquardt", lambda *_: lost)
    monkeypatch.setattr(_fit, "optimistix_solution", lambda *_: lost)
    with pytest.raises(EstimateError, match="fit of bias did not converge in 100 iterations: give start values"):
        fit_record(read_signals(campaign(rng)), model_from_effects(["bias"]), ratios=RATIOS)


@pytest.mark.parametrize("start", [2.0, 20.0, 1e5])
def test_a_far_start_ends_at_the_warm_up_or_is_refused(start: float, rng: np.random.Generator):
    """3 deg/h decaying in 3600 s, white noise of 0.05 deg/h a sample, from starts far on either side."""
    time = 60.0 * np.arange(400)
    output = 3.0 * np.exp(-time / 3600.0) + 0.05 * rng.standard_normal(len(time))
    log = Campaign({"time": time, "output": output}, {"time": "s", "output": "deg/h"}, {"kind": "rate"})
    model = GyroModel((BiasWarmup(time_constant=jnp.asarray(start)),), {"noise_white": 0.05 * DEG_H * np.sqrt(60.0)})
    assert fit(log, model).table()[1].value == pytest.approx(3600.0, abs=100.0)


def test_too_few_samples_are_refused(rng: np.random.Generator):
    measured = campaign(rng).select(slice(0, 5))
    with pytest.raises(EstimateError, match="5 samples cannot determine 4 parameters and their noise"):
        fit(measured, model_from_effects(["scale_factor", "bias", "bias_temperature", "bias_drift"]))


def test_single_precision_is_refused(rng: np.random.Generator):
    record = read_signals(campaign(rng))
    with jax.enable_x64(False), pytest.raises(EstimateError, match="single precision"):
        fit_record(record, model_from_effects(["bias"]))


def test_nothing_to_fit_still_gives_the_noise(rng: np.random.Generator):
    measured = campaign(rng)
    known = GyroModel((Bias(value=jnp.asarray(0.3 * DEG_H)),), {}, frozenset({("bias", "value")}))
    estimate = fit(measured, known)
    assert estimate.covariance.shape == (0, 0)
    assert estimate.degrees_of_freedom == ROWS
    assert estimate.table()[0].std == 0.0
    assert "(fixed)" in str(estimate.table()).splitlines()[0]
    assert set(estimate.noise_interval) == set(estimate.model.noise) > {"noise_white"}


def test_progress_is_told(rng: np.random.Generator):
    told: list[tuple[str, float]] = []
    fit(campaign(rng), model_from_effects(["bias"]), progress=lambda line, done: told.append((line, done)))
    assert [done for _, done in told] == sorted(done for _, done in told)
    assert told[-1][1] == 1.0


def test_a_breakpoint_is_found(rng: np.random.Generator):
    """A kink at 24 °C, started at 18 °C."""
    measured = campaign(rng)
    kinked = 0.3 + 0.2 * np.maximum(measured.columns["temperature"] - 24.0, 0.0)
    output = measured.columns["rate"] + kinked + 0.02 * rng.standard_normal(ROWS)
    measured = measured.with_column("output", output, "deg/h")
    curve = BiasTemperatureCurve(coefficients=jnp.zeros(1), hinges=jnp.zeros(1), breakpoints=jnp.asarray([18.0]))
    estimate = fit(measured, GyroModel((Bias(), curve)))
    row = next(r for r in estimate.table() if r.name == "breakpoints")
    assert abs(row.value - 24.0) < 6 * row.std < 1.0


compilations: list[float] = []
jax.monitoring.register_event_duration_secs_listener(
    lambda event, duration_secs, **_: compilations.append(duration_secs) if "backend_compile" in event else None
)


def test_campaigns_of_one_padded_length_share_their_programs(rng: np.random.Generator):
    model = model_from_effects(["scale_factor", "bias", "bias_temperature"])
    noisy = GyroModel(model.effects, {"noise_white": 1e-8, "noise_flicker": 1e-9, "noise_random_walk": 1e-12})

    def simulate_and_fit(rows: int) -> None:
        measured = campaign(rng, rows)
        record = read_signals(measured)
        noise = draw_noise(noisy.prepared(record.signals), record, rng)
        fit(measured.with_column("output", measured.si("output") + noise, "rad/s"), model)

    simulate_and_fit(256)
    before = len(compilations)
    assert before > 0
    for rows in (250, 240, 256):
        simulate_and_fit(rows)
    assert len(compilations) == before


@pytest.mark.parametrize("rows", [20, 100])
def test_colour_that_so_few_samples_cannot_show_has_no_upper_end(rows: int, rng: np.random.Generator):
    time = STEP * np.arange(rows)
    columns = {"time": time, "output": DEG_H * rng.standard_normal(rows)}
    found = fit(Campaign(columns, {"time": "s", "output": "rad/s"}, {"kind": "rate"}), model_from_effects(["bias"]))
    ends = [found.noise_table()[name]["hi"] for name in ("noise_flicker", "noise_random_walk")]
    assert np.isfinite(ends).all() == (rows > 40)
    assert np.isfinite(found.noise_table()["noise_white"]["hi"])


def test_an_interval_of_noise_holds_its_value():
    """The likeliest Markov noise of a misfit lay beyond the cells around it, and its interval did not hold it."""
    model = GyroModel((Bias(),), {"noise_white": jnp.asarray(1e-5), "noise_flicker": jnp.asarray(1e-7)})
    rows = noise_table(model, {"noise_white": (2e-5, 3e-5), "noise_flicker": (0.0, 5e-8)})
    for row in rows.values():
        assert float(row["lo"]) <= float(row["value"]) <= float(row["hi"])
        assert float(row["lo"]) < float(row["hi"])
