"""Lines in slow sweeps of the rate: of rounding, of mains, and one that wanders."""

from __future__ import annotations

import numpy as np
import pytest

import gyromodel as gm
from gyromodel.campaign import Campaign
from gyromodel.diagnosis import Diagnosis

ROWS = 2000


def sweep(rng: np.random.Generator, *, line: np.ndarray | float = 0.0, step: float = 0.0) -> Diagnosis:
    """Triangles of ±2 deg/s at 1 Hz, noise of 0.003 deg/s, the output rounded to `step` deg/s."""
    time = np.arange(float(ROWS))
    rate = 2.0 * (2.0 * np.abs((3.0 * time / ROWS + rng.uniform()) % 1.0 * 2.0 - 1.0) - 1.0)
    output = 1.0002 * rate + 0.01 + line + 0.003 * rng.standard_normal(ROWS)
    if step:
        output = step * np.round(output / step)
    units = {"time": "s", "rate": "deg/s", "output": "deg/s"}
    campaign = Campaign({"time": time, "rate": rate, "output": output}, units, {"kind": "rate"})
    return gm.diagnose(campaign, gm.model_from_effects(["scale_factor", "bias"]), hold_out=False)


@pytest.mark.long
def test_lines_of_rounding_are_not_named_a_periodic_bias(rng: np.random.Generator):
    """Samples every quarter of a step, on the way up as on the way down."""
    found = sweep(rng, step=0.05)
    assert "quantisation" in {c.effect for c in found.causes}
    if found.verdict != "named" or len(found.causes) > 1:
        assert found.verdict == "ambiguous"
        assert "quantisation" in found.credible_set


@pytest.mark.long
def test_a_line_larger_than_rounding_makes_is_named(rng: np.random.Generator):
    line = 0.05 * np.sin(2.0 * np.pi * 0.17 * np.arange(ROWS) + rng.uniform(0, 2 * np.pi))
    found = sweep(rng, line=line, step=0.01)
    assert (found.verdict, {c.effect for c in found.causes}) == ("named", {"bias_periodic", "quantisation"})


@pytest.mark.long
def test_lines_that_a_fit_moves_together_are_not_named(rng: np.random.Generator):
    """A line that wanders over forty times the resolution; whatever is named has lines that the record resolves."""
    time = np.arange(float(ROWS))
    found = sweep(rng, line=0.01 * np.sin(2.0 * np.pi * (0.17 * time + 5e-6 * time**2)))
    for cause in found.causes:
        frequencies = sorted(p.value for p in cause.parameters if p.name.startswith("frequency"))
        assert (np.diff(frequencies) > 0.5 / ROWS).all()
