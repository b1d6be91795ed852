"""A delay and a lag where a record begins in motion: what was before it is not known, and is not made up.

The output is the closed form of sines that have turned for ever.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import norm

import gyromodel as gm
from gyromodel.effects.dynamics import TimeDelay

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
    """With the first samples the lag was 13 standard uncertainties off; each is within 4 here but for interpolation."""
    (expected,) = true.values()
    for _ in range(3):
        found = gm.fit(log(rng, **true), gm.model_from_effects(["bias", "scale_factor", effect]))
        shape = found.table()[-1]
        assert shape.std < 1e-4 * 1e3 * expected
        assert shape.value == pytest.approx(1e3 * expected, abs=norm.isf(1e-6) * shape.std + 1e-4 * 1e3 * expected)
        assert 0 < found.to_dict()["missing"] < 100


def test_what_the_simulation_cannot_know_is_no_step(rng: np.random.Generator):
    """A delay that is as stated: the first samples had been named two steps of the bias."""
    model = gm.model_from_effects(["bias", "scale_factor"]).with_effect(TimeDelay(delay=0.3))
    found = gm.diagnose(log(rng, delay=0.3), replace(model, fixed=FIXED), hold_out=False)
    assert (found.verdict, found.causes) == ("adequate", ())
    said = "3 samples next to gaps or the record's ends were left out beside time_delay of the simulation"
    assert any(line.startswith(said) for line in found.findings)


def test_a_delay_stated_wrong_is_set_free(rng: np.random.Generator):
    model = gm.model_from_effects(["bias", "scale_factor"]).with_effect(TimeDelay(delay=0.5))
    found = gm.diagnose(log(rng, delay=0.2), replace(model, fixed=FIXED), hold_out=False)
    assert [cause.effect for cause in found.causes] == ["time_delay"]
    assert found.extended.table()[-1].value == pytest.approx(200.0, abs=0.05)
