"""What noise of two thermometers leaves beside a large error that follows them is given no name."""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import binom

import gyromodel as gm
from gyromodel.diagnosis._thermometers import left_by_thermometers
from gyromodel.effects.drivers import Bias
from gyromodel.effects.thermal import BiasTemperatureCurve, BiasTemperatureGradientRate
from gyromodel.estimate import fit_record
from gyromodel.noise import NoiseRatios
from gyromodel.signals import read_signals
from tests.truth import fiber_optic

HOURS, EACH, DEG_H = 3.0, 20, np.deg2rad(1.0) / 3600.0


def means(log: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Means over 20 s of a log of case and coil, in deg/h and degC."""
    each = {k: v.reshape(-1, EACH).mean(axis=1) for k, v in log.items()}
    return each | {"output": each["output"] / fiber_optic.SCALE_FACTOR}


def campaign(columns: dict[str, np.ndarray]) -> gm.Campaign:
    units = {"time": "s", "temperature": "degC", "temperature_coil": "degC", "output": "deg/h", "supply_voltage": "V"}
    columns = {k: v for k, v in columns.items() if k in units}
    return gm.Campaign(columns, {k: units[k] for k in columns}, {"kind": "rate"})


def simulation() -> gm.GyroModel:
    """The bias and the published bends over temperature."""
    bends = np.array(fiber_optic.BREAKPOINTS)
    curve = BiasTemperatureCurve(coefficients=np.zeros(1), hinges=np.zeros(2), breakpoints=bends)  # type: ignore[arg-type]
    return gm.GyroModel((Bias(), curve), fixed=frozenset({("bias_temperature_curve", "breakpoints")}))


@pytest.mark.law
@pytest.mark.long
def test_large_errors_of_a_changing_coil_are_named(rng: np.random.Generator):
    """Named in 19 draws of 20 or more, or in the set with what contains it; firm and wrong in one of 100 or less.

    At 16000 deg/h per degC/s the error is 100 deg/h in noise of 0.4, and what two thermometers leave of it 0.5.
    """
    right, wrong = 0, 0
    for size, effect in ((4000.0, "gradient_rate"), (16000.0, "gradient_rate"), (16000.0, "shupe")) * 3:
        name = {"gradient_rate": "bias_temperature_gradient_rate", "shupe": "bias_temperature_rate"}[effect]
        log = fiber_optic.log(fiber_optic.Gyro(**{effect: size}), HOURS, rng)
        found = gm.diagnose(campaign(means(log)), simulation(), hold_out=False)
        beside = {c.effect for c in found.causes} - {*found.credible_set}
        right += found.verdict in ("named", "ambiguous") and name in found.credible_set and not beside
        wrong += bool(beside) or (found.verdict == "named" and name not in found.credible_set)
        if found.verdict == "named" and name in found.credible_set and not beside:
            value = next(c for c in found.causes if c.effect == name).parameters[0]
            assert abs(value.value - size) < max(5.0 * value.std, 0.02 * size)
    assert binom.cdf(right, 9, 0.95) > 1e-3
    assert binom.sf(wrong - 1, 9, 0.01) > 1e-3


@pytest.mark.long
@pytest.mark.parametrize("beside", ["bias_supply_voltage", "bias_periodic", "gross errors"])
def test_what_follows_no_thermometer_is_told_of_beside_it(beside: str, rng: np.random.Generator):
    columns = means(fiber_optic.log(fiber_optic.Gyro(gradient_rate=16000.0), HOURS, rng))
    time, bad = columns["time"], rng.choice(len(columns["time"]) - 20, 2, replace=False) + 10
    columns["supply_voltage"] = 5.0 + 0.1 * np.sin(time / 700.0) + 0.02 * rng.standard_normal(len(time))
    columns["output"] = columns["output"] + {
        "bias_supply_voltage": 20.0 * (columns["supply_voltage"] - 5.0),
        "bias_periodic": 1.5 * np.sin(2 * np.pi * time / 171.0),
        "gross errors": np.where(np.isin(np.arange(len(time)), bad), 25.0, 0.0),
    }[beside]  # fmt: skip
    found = gm.diagnose(campaign(columns), simulation(), hold_out=False)
    names, gross = {c.effect for c in found.causes}, beside == "gross errors"
    assert (found.verdict, names) == ("named", {"bias_temperature_gradient_rate"} | ({beside} if not gross else set()))
    assert any("gross error" in line for line in found.findings) or not gross


@pytest.mark.long
@pytest.mark.parametrize("size", [0.2, 0.3])
def test_a_bias_over_temperature_is_named_beside_a_simulated_rate_effect(size: float, rng: np.random.Generator):
    """Of 5 and 8 deg/h from cold to warm: what thermometers leave of 100 deg/h is no function of the temperature."""
    log = fiber_optic.log(fiber_optic.Gyro(gradient_rate=16000.0), HOURS, rng)
    bent = np.interp(log["temperature"], *(np.linspace(0, 60, 601), fiber_optic.bent_bias(np.linspace(0, 60, 601))))
    columns = means(log | {"output": log["output"] - bent})
    columns["output"] = columns["output"] + size * (columns["temperature"] - 20.0)
    model = gm.model_from_effects(["bias", "bias_temperature_gradient_rate"])
    found = gm.diagnose(campaign(columns), model, hold_out=False)
    assert found.verdict in ("named", "ambiguous")
    assert {"bias_temperature", "bias_temperature_curve"} & {*found.credible_set, *(c.effect for c in found.causes)}


def test_what_is_left_is_what_a_perfect_thermometer_would_explain(rng: np.random.Generator):
    """Against the temperatures that the thermometers read, which no campaign knows."""
    effect = 16000.0
    seed = int(rng.integers(2**31))
    columns = means(fiber_optic.log(fiber_optic.Gyro(gradient_rate=effect), HOURS, np.random.default_rng(seed)))
    time, case = fiber_optic.chamber(HOURS, np.random.default_rng(seed))
    coil_rate = np.interp(time, time[::4], fiber_optic.coil_temperature_rate(time[::4], case[::4], fiber_optic.COIL))
    true = (np.gradient(case, time) - coil_rate).reshape(-1, EACH).mean(axis=1)
    record = read_signals(campaign(columns))
    fitted = fit_record(record, simulation().with_effect(BiasTemperatureGradientRate()))
    read = np.asarray(record.signals["temperature_rate"] - record.signals["temperature_coil_rate"])[: record.rows]
    left = DEG_H * effect * (read - true)
    white = replace(fitted, ratios=NoiseRatios(jnp.zeros(()), jnp.zeros(())), white_variance=(0.4 * DEG_H) ** 2)
    expected = 0.5 * record.rows * np.log1p(np.mean(left**2) / white.white_variance)
    assert left_by_thermometers(fitted, record, white) == pytest.approx(expected, rel=0.4)
