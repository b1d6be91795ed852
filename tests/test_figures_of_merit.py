"""Figures of merit. Expected: the printed definitions in numpy, noise of known coefficients from an independent
generator, closed forms of what averaging does to it, and the binomial law for how often intervals hold."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import binom

from gyromodel.campaign import Campaign
from gyromodel.estimate import EstimateError
from gyromodel.figures_of_merit import (
    Figure,
    angle_random_walk,
    bias,
    bias_repeatability,
    bias_stability,
    bias_temperature_sensitivity,
    figures_of_merit,
    random_walk_coefficients,
    stability_squares,
)
from tests.truth import noise as truth

ROWS, STEP = 640, 10.0
WHITE = 0.01  # deg/sqrt(h)
PER_ROOT_SECOND = 60 * WHITE  # deg/h times the root of a second
DEG_H = np.deg2rad(1 / 3600)


def run(output: np.ndarray, temperature: float | np.ndarray | None = None, unit: str = "deg/h", **metadata) -> Campaign:
    columns = {"time": np.arange(len(output)) * STEP, "output": output}
    units = {"time": "s", "output": unit}
    if temperature is not None:
        columns["temperature"], units["temperature"] = np.broadcast_to(temperature, len(output)), "degC"
    return Campaign(columns, units, {"kind": "rate", **metadata})


def white(rng: np.random.Generator, rows: int = ROWS) -> np.ndarray:
    return truth.white(rows, STEP, PER_ROOT_SECOND, rng)


def walk(rng: np.random.Generator, coefficient: float) -> np.ndarray:
    """Random walk from the start of the run, coefficient in deg/h/sqrt(h)."""
    return coefficient / 60 * np.sqrt(STEP) * np.cumsum(rng.standard_normal(ROWS))


def by_symbol(runs: Campaign | list[Campaign], **options) -> dict[str, Figure]:
    return {f.symbol: f for f in figures_of_merit(runs, **options).figures}


def test_definitions(rng: np.random.Generator):
    output = rng.normal(5.0, 2.0, 50)
    assert bias(output, 4.0) == pytest.approx(output.mean() / 4)
    root = np.sqrt(((output - output.mean()) ** 2).sum() / 49)
    assert bias_stability(output, 4.0) == pytest.approx(root / 4)
    assert bias_repeatability(output) == pytest.approx(root)
    assert angle_random_walk(output, 25.0, 4.0) == pytest.approx(root / 4 / 5)
    sensitivity, at = bias_temperature_sensitivity(np.array([1.0, 2.0, 5.0]), np.array([0.0, 20.0, 50.0]), 1)
    assert (sensitivity, at) == (pytest.approx(0.1), 2)
    times = np.array([1.0, 2.0, 4.0, 8.0, 16.0])
    assert random_walk_coefficients(times, 3 + 2 / times + 5 / times**2) == pytest.approx([3.0, 2.0, 5.0])
    squares = stability_squares(output, np.array([1, 3]))
    assert squares == pytest.approx([output.var(ddof=1), output[:48].reshape(16, 3).mean(axis=1).var(ddof=1)])


def test_white_noise_gives_one_coefficient_three_ways(rng: np.random.Generator):
    """Each within five of its own standard uncertainties, and these of the size of χ² of 640 samples."""
    found = by_symbol(run(7.0 + white(rng)))
    # By chance one of the two is refused in one run of three hundred.
    accepted = [found[symbol] for symbol in ("ARW", "RWC") if not found[symbol].refused]
    assert accepted
    for figure in accepted:
        assert figure.unit == "deg/sqrt(h)"
        assert abs(figure.published - WHITE) < 5 * figure.published_std
        assert abs(figure.modern - WHITE) < 5 * figure.modern_std
    sigma = PER_ROOT_SECOND / np.sqrt(STEP)
    stability = found["Bs"]
    assert abs(stability.published - sigma) < 5 * stability.published_std
    # Draws of the fitted noise, which may hold a little flicker: at least what white noise leaves.
    assert 0.85 < stability.published_std / (sigma / np.sqrt(2 * ROWS)) < 2.5
    assert abs(found["B0"].published - 7.0) < 5 * found["B0"].published_std


@pytest.mark.long
def test_uncertainties_hold_under_a_random_walk(rng: np.random.Generator):
    """2.5 standard uncertainties are about 95 % with noise estimated from each run; s/√n is fifteen times too small."""
    figures = figures_of_merit([run(white(rng) + walk(rng, 0.15)) for _ in range(30)]).figures
    for symbol, true in (("B0", 0.0), ("RWC", WHITE)):
        of = [f for f in figures if f.symbol == symbol and not f.refused]
        assert sum(abs(f.published - true) > 2.5 * f.published_std for f in of) <= binom.isf(1e-5, len(of), 0.05)
        assert len(of) > 15
    # The mean of a walk from zero, K √(T/3), of ten minutes' worth of 0.15 deg/h/√h each.
    mean = np.hypot(PER_ROOT_SECOND / np.sqrt(STEP * ROWS), 0.15 / 60 * np.sqrt(ROWS * STEP / 3))
    assert np.median([f.published_std for f in figures if f.symbol == "B0"]) == pytest.approx(mean, rel=0.5)


def test_conditions_that_fail_are_said():
    rng = np.random.default_rng(1)
    short = by_symbol(run(white(rng, 100), 25.0))
    assert "take 320" in short["ARW"].refused
    assert "fewer than 5 averaging times" in short["RWC"].refused
    assert np.isfinite(short["B0"].published)
    assert "two runs or more" in short["Br"].refused
    assert "differ by more than 1 °C" in short["Bt"].refused

    drift = by_symbol(run(white(rng), np.linspace(20, 30, ROWS)))
    for symbol in ("B0", "Bs", "ARW", "RWC"):
        assert "temperature moved by 9" in drift[symbol].refused
        assert np.isnan(drift[symbol].published)
        assert np.isfinite(drift[symbol].modern)

    holed = white(rng)
    holed[100:120] = np.nan
    gap = by_symbol(run(holed))
    assert "20 gaps or missing samples" in gap["ARW"].refused
    assert "20 gaps or missing samples" in gap["RWC"].refused
    assert np.isfinite(gap["Bs"].published)

    walking = by_symbol(run(white(rng) + walk(rng, 3.0)))
    assert "not white" in walking["ARW"].refused
    assert walking["RWC"].refused

    # The Earth's rate is no bias, and a table that turns is no rest.
    still = run(white(rng))
    there = by_symbol(still.with_column("rate", np.full(ROWS, 7.5), "deg/h"))
    assert there["B0"].published == pytest.approx(by_symbol(still)["B0"].published - 7.5)
    assert there["B0"].published == pytest.approx(there["B0"].modern, abs=5 * there["B0"].modern_std)
    turned = by_symbol(still.with_column("rate", np.linspace(0.0, 1.0, ROWS), "deg/s"))
    assert all("reference rate changed by 1 deg/s" in turned[symbol].refused for symbol in ("B0", "Bs", "ARW", "RWC"))

    # A line whose period is eight samples: means over whole periods lose it, which no power of τ does.
    line = by_symbol(run(white(rng) + 0.5 * np.sin(2 * np.pi * np.arange(ROWS) / 8 + 0.3)))
    assert "not of the form" in line["RWC"].refused


def test_repeatability_and_sensitivity_of_several_runs(rng: np.random.Generator):
    true = {25.0: (1.0, 1.4, 0.7), 40.0: (4.0,), 10.0: (0.1,)}
    runs = [run(b + white(rng), t) for t, biases in true.items() for b in biases]
    result = figures_of_merit(runs, room_temperature=22.0)
    found = {f.symbol: f for f in result.figures}
    repeatability, sensitivity = found["Br"], found["Bt"]
    assert repeatability.run == "3 runs"
    assert repeatability.published == pytest.approx(np.std([1.0, 1.4, 0.7], ddof=1), abs=0.1)
    assert repeatability.published_std == pytest.approx(repeatability.published / 2)
    room = np.mean(true[25.0])
    assert sensitivity.published == pytest.approx((4.0 - room) / 15, abs=6 * sensitivity.published_std)
    assert sensitivity.modern == pytest.approx(sensitivity.published, rel=1e-6)  # two points a side: the same chord
    assert sensitivity.unit == "deg/h/degC"
    lines = result.table().splitlines()
    # Remarks on a run, such as of a line that is there by chance, stand below.
    assert [line.split()[0] for line in lines[1:]][: len(result.figures)] == [f.symbol for f in result.figures]
    assert len(result.figures) == 4 * len(runs) + 2
    assert lines[0].split() == ["figure", "run", "published", "modern", "unit", "modern", "value", "is"]


def test_the_nominal_scale_factor():
    noise = 7.0 + white(np.random.default_rng(1))
    plain = by_symbol(run(noise))
    for options, metadata in (
        ({"scale_factor": "0.25 bit/(deg/h)"}, {}),
        ({}, {"nominal_scale_factor": "0.25 bit/(deg/h)"}),
    ):
        scaled = by_symbol(run(0.25 * noise, None, "bit", **metadata), **options)
        for symbol in ("B0", "Bs", "ARW", "RWC"):
            assert scaled[symbol].published == pytest.approx(plain[symbol].published, rel=1e-9)
            assert scaled[symbol].published_std == pytest.approx(plain[symbol].published_std, rel=0.05)
            assert scaled[symbol].modern == pytest.approx(plain[symbol].modern, rel=0.02)
    with pytest.raises(
        EstimateError, match=r"output is in \[bit\]: state the nominal scale factor, such as 0.09 bit/\(deg/h\)"
    ):
        figures_of_merit(run(noise, None, "bit"))
    with pytest.raises(EstimateError, match="5 V/deg does not give that"):
        figures_of_merit(run(noise, None, "bit"), scale_factor="5 V/deg")


def test_runs_without_a_thermometer_are_not_mixed_with_those_that_have_one():
    rng = np.random.default_rng(1)
    runs = [run(white(rng)), run(5 + white(rng), 0.0), run(20 + white(rng), 60.0)]
    found = by_symbol(runs)
    assert "two runs or more at one temperature" in found["Br"].refused
    assert found["Bt"].published == pytest.approx(15 / 60, abs=0.05)


def test_a_ramp_with_a_hole_is_still_a_ramp():
    rng = np.random.default_rng(1)
    ramp = np.linspace(20, 60, ROWS)
    ramp[: ROWS // 8] = np.nan
    assert "temperature moved" in by_symbol(run(white(rng), ramp))["B0"].refused
