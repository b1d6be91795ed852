"""A delay and a lag where a record begins in motion: what was before it is not known, and is not made up.

The output is the closed form of sines that have turned for ever.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import norm

import gyromodel as gm
from gyromodel.effects.dynamics import Bandwidth, TimeDelay
from gyromodel.effects.thermal import BiasTemperatureRate
from gyromodel.estimate import EstimateError, unknown_rows
from gyromodel.model import GyroModel
from gyromodel.signals import read_signals

ROWS, STEP, BIAS, NOISE = 2000, 0.1, 1e-3, 2e-3
# deg/s, Hz, rad
SINES = ((10.0, 0.1, 0.0), (5.0, 0.37, 1.0), (8.0, 0.021, 0.0))
FIXED = frozenset({("time_delay", "delay")})


def log(rng: np.random.Generator, lag: float = 0.0, delay: float = 0.0) -> gm.Campaign:
    """A table that swings, and a gyro that follows through a lag of first order, late by a delay (s)."""
    time, rate, told = STEP * np.arange(ROWS), 0.0, BIAS + NOISE * rng.standard_normal(ROWS)
    for size, frequency, phase in SINES:
        w = 2.0 * np.pi * frequency
        rate += size * np.sin(w * time + phase)
        told += size / np.hypot(1.0, w * lag) * np.sin(w * (time - delay) + phase - np.arctan(w * lag))
    units = {"time": "s", "rate": "deg/s", "output": "deg/s"}
    return gm.Campaign({"time": time, "rate": rate, "output": told}, units, {"kind": "rate"})


@pytest.mark.parametrize(("effect", "true"), [("bandwidth", {"lag": 1.0}), ("time_delay", {"delay": 0.3})])
def test_a_fit_leaves_out_what_it_cannot_know(effect: str, true: dict[str, float], rng: np.random.Generator):
    """With the first samples the lag was 12 standard uncertainties off; each is within 4 here but for interpolation."""
    (expected,) = true.values()
    for _ in range(3):
        found = gm.fit(log(rng, **true), gm.model_from_effects(["bias", "scale_factor", effect]))
        shape = found.table()[-1]
        assert shape.std < 1e-4 * 1e3 * expected
        assert shape.value == pytest.approx(1e3 * expected, abs=norm.isf(1e-6) * shape.std + 1e-4 * 1e3 * expected)
        assert 0 < found.to_dict()["missing"] < 100


def test_a_lag_behind_temperatures_keeps_its_soak():
    """What warms up with the power does so in the first minutes, when temperatures stand still."""
    time = 10.0 * np.arange(200)
    columns = {"time": time, "rate": np.sin(time), "temperature": np.maximum(time - 500.0, 0.0), "output": time}
    units = {"time": "s", "rate": "deg/s", "temperature": "degC", "output": "deg/s"}
    record = read_signals([gm.Campaign(columns, units, {"kind": "rate"})])
    assert unknown_rows(record, GyroModel((BiasTemperatureRate(lag=np.array([60.0])),), {})) == ()
    assert unknown_rows(record, GyroModel((Bandwidth(time_constant=5.0),), {})) == (0, 1, 2, 3)
    assert unknown_rows(record, GyroModel((Bandwidth(time_constant=0.01),), {})) == ()


def test_a_run_that_is_shorter_than_the_memory_is_told_of(rng: np.random.Generator):
    """Its bias had been fitted where the lag made up what was before it: all of them were wrong by 16 uncertainties."""
    long, short = log(rng, lag=0.5), log(rng, lag=0.5)
    short = gm.Campaign({name: values[:30] for name, values in short.columns.items()}, short.units, short.metadata)
    model = gm.model_from_effects(["bias", "scale_factor", "bandwidth", "bias_turn_on"])
    with pytest.raises(EstimateError, match="the 70 samples whose past bandwidth would have to know: bias_turn_on"):
        gm.fit([long, short], model)


def test_what_the_simulation_cannot_know_is_no_step(rng: np.random.Generator):
    """A delay that is as stated: the first samples had been named two steps of the bias."""
    model = gm.model_from_effects(["bias", "scale_factor"]).with_effect(TimeDelay(delay=0.3))
    found = gm.diagnose(log(rng, delay=0.3), replace(model, fixed=FIXED), hold_out=False)
    assert (found.verdict, found.causes) == ("adequate", ())
    said = f"Beside time_delay of the simulation 3 of {ROWS} samples were left out"
    assert any(line.startswith(said) for line in found.findings)


def test_a_delay_stated_wrong_is_set_free(rng: np.random.Generator):
    model = gm.model_from_effects(["bias", "scale_factor"]).with_effect(TimeDelay(delay=0.5))
    found = gm.diagnose(log(rng, delay=0.2), replace(model, fixed=FIXED), hold_out=False)
    assert [cause.effect for cause in found.causes] == ["time_delay"]
    assert found.extended.table()[-1].value == pytest.approx(200.0, abs=0.05)
