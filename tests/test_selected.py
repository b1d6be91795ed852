"""Intervals of sizes that are told only because they were large: the binomial law, and whole diagnoses."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import binom, norm

import gyromodel as gm
from gyromodel.diagnosis._selected import after_selection
from tests.test_diagnosis import ROWS, static_log

LEAST = 3.6


@pytest.mark.long
@pytest.mark.parametrize("size", [2.0, 3.6, 5.0, -4.0])
def test_of_what_was_told_the_interval_holds_the_truth(size: float, rng: np.random.Generator) -> None:
    """Half of what is just large enough is told at all, and of that the plain interval holds less than 92 %."""
    drawn = size + rng.standard_normal(60_000)
    told = drawn[np.abs(drawn) >= LEAST][:2000]
    held = sum(low <= size <= high for low, high in (after_selection(z, LEAST) for z in told))
    assert held >= binom.ppf(1e-5, len(told), 0.95)
    if size == 2.0:
        assert np.mean(np.abs(told - size) < 1.96) < 0.9


@pytest.mark.parametrize("z", [4.2, -5.0, 8.0])
def test_the_end_towards_zero_is_that_of_the_truncated_law(z: float) -> None:
    low, high = after_selection(z, LEAST)
    inner, outer = (low, high) if z > 0 else (-high, -low)
    assert outer == pytest.approx(abs(z) + 1.96)
    told = norm.sf(LEAST - inner) + norm.cdf(-LEAST - inner)
    assert norm.sf(abs(z) - inner) / told == pytest.approx(0.025, rel=1e-3)


@pytest.mark.parametrize("z", [6.0, 11.9, 12.33, -40.0, 200.0])
def test_what_is_just_large_enough_may_be_nothing(z: float) -> None:
    """Of what is told only at z or beyond, the nearer end is where the other sign is 39 times as likely."""
    low, high = after_selection(z, abs(z))
    inner = low if z > 0 else -high
    assert inner == pytest.approx(-np.log(39) / (2 * abs(z)), rel=0.04)


def test_far_above_what_is_needed_nothing_is_allowed_for() -> None:
    assert after_selection(30.0, LEAST) == pytest.approx((30 - 1.96, 30 + 1.96), abs=1e-3)


@pytest.mark.parametrize(("slope", "widened"), [pytest.param(0.036, True, marks=pytest.mark.long), (0.3, False)])
def test_a_weak_cause_has_the_wider_interval(slope: float, widened: bool) -> None:
    above = 15 * np.sin(2 * np.pi * 20.0 * np.arange(ROWS) / 4000.0)
    campaign = static_log(np.random.default_rng(2), slope * above)
    found = gm.diagnose(campaign, gm.model_from_effects(["bias"]), hold_out=False)
    assert [c.effect for c in found.causes] == ["bias_temperature"]
    (size,) = found.causes[0].parameters
    assert size.ci95 is not None
    low, high = size.ci95
    assert low < slope < high
    assert high == pytest.approx(size.value + 1.96 * size.std)
    assert (size.value - low > 2.1 * size.std) == widened
