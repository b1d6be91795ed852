"""Many campaigns fitted by one program: against single fits and against scipy on equations written out here, NIST's
certified values for the driver, and the binomial law for the intervals."""

from __future__ import annotations

from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.stats import binom

from gyromodel.campaign import Campaign
from gyromodel.effects.drivers import Bias
from gyromodel.effects.dynamics import TimeDelay
from gyromodel.effects.scale import ScaleFactor
from gyromodel.effects.thermal import BiasTemperature, BiasWarmup
from gyromodel.estimate import EstimateError, _fit, _together, fit_many, fit_record
from gyromodel.model import GyroModel
from gyromodel.noise import NoiseRatios
from gyromodel.numerics.compiled_least_squares import search_minimum, solve_positive
from gyromodel.signals import Record, read_signals
from tests.test_least_squares import DIGITS, load, right_digits

STEP = 10.0
DEG_H = np.pi / 180 / 3600
WHITE = NoiseRatios(jnp.zeros(()), jnp.zeros(()))


@pytest.fixture(autouse=True)
def _single_fits_to_the_end(monkeypatch: pytest.MonkeyPatch):
    """By themselves they end at a decrease that is no part of a standard deviation, but more than 1e-4 of it."""
    monkeypatch.setattr(_fit, "TOLERANCE", 1e-13)


# Scale factor, bias (deg/h), slope over temperature (deg/h/°C), warm-up (deg/h, s); noise of a sample (deg/h).
TRUTH, SIGMA = np.array([1.02, 0.3, 0.02, 2.0, 900.0]), 0.1
UNITS = np.array([1.0, DEG_H, DEG_H, DEG_H, 1.0])


def thermal_model(time_constant: float = 600.0, **noise: float) -> GyroModel:
    temperature = BiasTemperature(reference=jnp.asarray(20.0))
    effects = (ScaleFactor(value=jnp.asarray(1.0)), Bias(), temperature)
    return GyroModel((*effects, BiasWarmup(time_constant=jnp.asarray(time_constant))), noise)


def columns(rng: np.random.Generator, rows: int) -> dict[str, np.ndarray]:
    time = np.arange(rows) * STEP
    rate = np.repeat(rng.uniform(-20.0, 20.0, rows // 8 + 1), 8)[:rows]
    return {"time": time, "rate": rate, "temperature": 20 + 15 * np.sin(time / 700 + rng.uniform(0, 6))}


def equation(x: np.ndarray, c: dict[str, np.ndarray]) -> np.ndarray:
    """Output in deg/h."""
    return x[0] * (c["rate"] + x[1] + x[2] * (c["temperature"] - 20) + x[3] * np.exp(-c["time"] / x[4]))


def campaign(rng: np.random.Generator, rows: int, missing: int = 0, **changed: np.ndarray | float) -> Record:
    c = columns(rng, rows)
    c = c | {name: np.broadcast_to(value, rows).astype(float) for name, value in changed.items()}
    output = equation(TRUTH, c) + SIGMA * rng.standard_normal(rows)
    output[rng.choice(rows, missing, replace=False)] = np.nan
    units = {"time": "s", "rate": "deg/h", "temperature": "degC", "output": "deg/h"}
    return read_signals(Campaign(c | {"output": output}, units, {"kind": "rate"}, "test"))


def again(record: Record, rng: np.random.Generator) -> Record:
    """The same campaign with other noise: reading one takes longer than fitting it."""
    signals = {name: np.asarray(values) for name, values in record.signals.items()}
    c = signals | {"rate": signals["rate"] / DEG_H}
    output = DEG_H * (equation(TRUTH, c) + SIGMA * rng.standard_normal(len(c["time"])))
    return record._replace(signals={**record.signals, "output": jnp.asarray(output)})


def test_values_are_those_of_single_fits_at_every_length(
    rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One block and two, one sample less and more than full ones, with samples missing."""
    monkeypatch.setattr(_fit, "TOLERANCE", 1e-14)  # single fits may end some 1e-3 standard deviations away
    records = [campaign(rng, rows, rows // 9) for rows in (250, 511, 512, 513, 700, 1024)]
    fits = fit_many(iter(records), thermal_model(), threads=2)
    assert fits.converged.all()
    assert not any(fits.reasons)
    for i, record in enumerate(records):
        single = fit_record(record, thermal_model(), ratios=WHITE)
        assert np.abs((fits.values[i] - np.asarray(single.model.vector())) / single.std).max() < 1e-4
        size = np.outer(single.std, single.std)
        assert fits.covariance[i] / size == pytest.approx(single.covariance / size, abs=1e-3)
        assert fits.white_variance[i] == pytest.approx(single.white_variance, rel=1e-7)
        assert np.asarray(fits.model(i).vector()) == pytest.approx(fits.values[i])


def from_scipy(record: Record) -> tuple[np.ndarray, np.ndarray]:
    """Values and standard deviations by scipy, at tolerances of its rounding."""
    c = {k: np.asarray(v)[: record.rows] for k, v in record.signals.items()}
    c, output = c | {"rate": c["rate"] / DEG_H}, c["output"] / DEG_H
    limits = {"xtol": 1e-15, "ftol": 1e-15, "gtol": 1e-15}
    found = least_squares(lambda x: equation(x, c) - output, TRUTH, jac="cs", x_scale="jac", **limits)
    covariance = np.linalg.inv(found.jac.T @ found.jac) * 2 * found.cost / (record.rows - len(TRUTH))
    return found.x, np.sqrt(np.diag(covariance))


@pytest.mark.parametrize("rows", [(300, 450), (1600, 2300, 5000)])
def test_values_are_scipys_on_the_equation(rows: tuple[int, ...], rng: np.random.Generator):
    """The longer ones begin on a sample of their rows."""
    records = [campaign(rng, count) for count in rows]
    fits = fit_many(records, thermal_model())
    assert not fits.restarted.any()
    for i, record in enumerate(records):
        values, std = from_scipy(record)
        assert np.abs((fits.values[i] / UNITS - values) / std).max() < 1e-4
        assert fits.std[i] / UNITS == pytest.approx(std, rel=1e-3)


def test_searches_end_where_scipy_does_however_weak_an_effect_is(rng: np.random.Generator):
    """A warm-up of a few standard deviations: the rate of convergence by which a search ends is at its worst."""
    base = campaign(rng, 2100)
    signals = {k: np.asarray(v) for k, v in base.signals.items()}
    c = signals | {"rate": signals["rate"] / DEG_H}
    records = []
    for amplitude in rng.uniform(0.1, 0.5, 40):
        output = equation(TRUTH * [1, 1, 1, amplitude / TRUTH[3], 1], c) + SIGMA * rng.standard_normal(len(c["rate"]))
        records.append(base._replace(signals={**base.signals, "output": jnp.asarray(output * DEG_H)}))
    fits = fit_many(records, thermal_model())
    assert fits.converged.all()
    for i, record in enumerate(records):
        values, std = from_scipy(record)
        assert np.abs((fits.values[i] / UNITS - values) / std).max() < 1e-4


def test_a_sample_that_leads_astray_is_left(rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch):
    """To a time constant of a thousandth of a sample, from where no slope leads back."""
    whole = _together.search_minimum

    def astray(gram, start, linear, tolerance, most, *solved):
        found = whole(gram, start, linear, tolerance, most, *solved)
        return found if solved else found._replace(x=start.at[-1].set(0.01), converged=jnp.asarray(most > 0))

    records = [campaign(rng, 2100)]
    right = fit_many(records, thermal_model())
    monkeypatch.setattr(_together, "search_minimum", astray)
    _together.search.clear_cache()
    try:
        data = _together.side_by_side([_together.ready(0, records[0], _together.described(thermal_model()))], 8, {})
        found, _, thinned = _together.searches(data, [(0, np.asarray(thermal_model().vector()))], 100, 100)
        fits = fit_many(records, thermal_model(), restarts=False)
    finally:
        _together.search.clear_cache()
    assert thinned.all()
    assert abs(found.x[0, -1] / TRUTH[-1] - 1) > 0.5
    assert not fits.bad.any()
    assert np.abs((fits.values - right.values) / right.std).max() < 1e-4


def test_one_trace_for_each_power_of_two_of_lengths(rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch):
    traces: list[int] = []
    _together.search.clear_cache()
    whole = _together.gram_of

    def counted(model, data):
        traces.append(data.weight.shape[1])
        return whole(model, data)

    monkeypatch.setattr(_together, "gram_of", counted)
    base = [campaign(rng, rows) for rows in (200, 400, 600)]
    records = [again(base[i % 3], rng) for i in range(70)]
    fit_many(records, thermal_model(), threads=3)
    assert sorted(traces) == [1, 2]
    fit_many([*records[3:9], campaign(rng, 230)], thermal_model(500.0), threads=3)
    assert len(traces) == 2


def test_a_campaign_that_fails_is_told_of_and_stops_no_other(rng: np.random.Generator):
    good = [campaign(rng, 300), campaign(rng, 480)]
    unknown = campaign(rng, 400)
    temperature = np.array(unknown.signals["temperature"])
    temperature[[3, 17]] = np.nan
    unknown = unknown._replace(signals={**unknown.signals, "temperature": jnp.asarray(temperature)})
    lacking = campaign(rng, 400)
    lacking.signals.pop("temperature")
    alike = campaign(rng, 400, temperature=25.0)
    few = campaign(rng, 400).without(np.arange(5, 400))
    records = [unknown, good[0], lacking, alike, good[1], few]
    fits = fit_many(records, thermal_model())
    assert list(fits.converged) == [False, True, False, False, True, False]
    assert fits.reasons[0] == "effect bias_temperature needs column temperature, which is NaN in data rows 4, 18"
    assert fits.reasons[2] == "effect bias_temperature needs a column temperature, which the campaign lacks"
    assert "bias and bias_temperature cannot be told apart on this campaign" in fits.reasons[3]
    assert fits.reasons[5] == "5 samples cannot determine 5 parameters and their noise"
    assert np.isnan(fits.values[~fits.converged]).all()
    assert np.isnan(fits.std[~fits.converged]).all()
    alone = fit_many(good, thermal_model())
    assert fits.values[fits.converged] == pytest.approx(alone.values, rel=1e-12)


def test_a_generator_of_no_campaigns_gives_none():
    def none() -> Iterator[Record]:
        yield from ()

    fits = fit_many(none(), thermal_model())
    assert fits.values.shape[0] == 0
    assert fits.reasons == []


@pytest.mark.parametrize("rows", [500, 2100])
def test_a_false_minimum_is_seen_and_left(rows: int, rng: np.random.Generator):
    """From a time constant of a thousandth of a sample the warm-up has no slope to follow, and chi-squared tells."""
    base = campaign(rng, rows)
    records = [again(base, rng) for _ in range(4)]
    stuck = fit_many(records, thermal_model(0.01), restarts=False)
    assert not stuck.restarted.any()
    assert (stuck.reduced_chi_squared > 1.5).all()
    found = fit_many(records, thermal_model(0.01))
    assert found.restarted.all()
    assert found.converged.all()
    assert (np.abs(found.reduced_chi_squared - 1) < 0.4).all()
    assert (np.abs((found.values / UNITS - TRUTH) / (found.std / UNITS)) < 6).all()
    near = fit_many(records, thermal_model())
    assert not near.restarted.any()
    assert (np.abs(found.values - near.values) / near.std).max() < 1e-3


def test_intervals_cover_the_truth(rng: np.random.Generator):
    base = [campaign(rng, rows) for rows in (350, 500)]
    count = 400
    fits = fit_many([again(base[i % 2], rng) for i in range(count)], thermal_model())
    assert fits.converged.all()
    inside = (np.abs(fits.values / UNITS - TRUTH) < 1.96 * fits.std / UNITS).sum(axis=0)
    low, high = binom.ppf([1e-5, 1 - 1e-5], count, 0.95)
    assert ((low <= inside) & (inside <= high)).all(), inside
    assert (np.abs(fits.white_variance.mean() / (SIGMA * DEG_H) ** 2 - 1)) < 0.02


def test_stated_noise_whitens_as_in_single_fits(rng: np.random.Generator):
    white = SIGMA * DEG_H * np.sqrt(STEP)
    noise = {"noise_white": white, "noise_flicker": 0.3 * SIGMA * DEG_H, "noise_random_walk": white / 5e3}
    model = thermal_model(**noise)
    records = [campaign(rng, rows, 30) for rows in (400, 430)]
    fits = fit_many(records, model)
    for i, record in enumerate(records):
        single = fit_record(record, model)
        assert np.abs((fits.values[i] - np.asarray(single.model.vector())) / single.std).max() < 1e-4
        assert fits.std[i] == pytest.approx(single.std, rel=1e-3)
        stated = (SIGMA * DEG_H * float(single.model.gain())) ** 2
        assert fits.reduced_chi_squared[i] == pytest.approx(single.white_variance / stated, rel=1e-6)


def test_an_effect_that_remembers_sees_the_whole_campaign(rng: np.random.Generator):
    """A delay of 23 s of a rate that swings: at a block's edge it must know what came before."""
    time = np.arange(900) * STEP
    output = 50 * np.sin((time - 23.0) / 90) + 0.2 + 0.05 * rng.standard_normal(len(time))
    units = {"time": "s", "rate": "deg/h", "output": "deg/h"}
    data = Campaign({"time": time, "rate": 50 * np.sin(time / 90), "output": output}, units, {"kind": "rate"}, "swing")
    effects = (Bias(), TimeDelay(delay=jnp.asarray(5.0)))
    model = GyroModel(effects, {}, frozenset({("time_delay", "share")}))
    record = read_signals(data).without(np.arange(4))
    fits, single = fit_many([record], model), fit_record(record, model, ratios=WHITE)
    assert np.abs((fits.values[0] - np.asarray(single.model.vector())) / single.std).max() < 1e-4
    assert abs(fits.values[0, 1] - 23.0) < 6 * fits.std[0, 1] < 1.0


def test_single_precision_is_refused(rng: np.random.Generator):
    with jax.enable_x64(False), pytest.raises(EstimateError, match="single precision"):
        fit_many([], thermal_model())


@pytest.mark.parametrize("name", ["Misra1a", "Gauss1"])
def test_the_compiled_driver_on_certified_values(name: str, measured_data):
    problem = load(measured_data("nist_strd"), name)

    def gram(b):
        a, g, cost = problem.traced(b)
        return jnp.block([[a, g[:, None]], [g[None], cost[None, None]]])

    linear = jnp.zeros(len(problem.certified), bool)
    search = jax.jit(lambda start: search_minimum(gram, start, linear, 1e-14, 500))
    for start in problem.starts:
        found = search(jnp.asarray(start))
        assert found.converged
        assert right_digits(np.asarray(found.x), problem.certified) >= DIGITS


def test_positive_systems_are_solved_with_unknowns_held(rng: np.random.Generator):
    half = rng.standard_normal((9, 9)) * 10.0 ** rng.integers(-5, 5, 9)
    matrix, right = half.T @ half, half.T @ rng.standard_normal(9)
    held = np.arange(9) % 4 == 1
    found = np.asarray(solve_positive(jnp.asarray(matrix), jnp.asarray(right), jnp.asarray(held)))
    assert (found[held] == 0).all()
    size = np.sqrt(np.diag(matrix))[~held]
    part = np.linalg.solve(matrix[np.ix_(~held, ~held)] / np.outer(size, size), right[~held] / size)
    assert found[~held] * size == pytest.approx(part, rel=1e-5)
    twice = np.asarray(solve_positive(jnp.ones((2, 2)), jnp.ones(2), jnp.zeros(2, bool)))
    assert list(twice) == [1.0, 0.0]
