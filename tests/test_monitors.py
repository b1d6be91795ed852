"""Effects of beam monitors and of a torquer's current: hidden by simulators of their physics, found by the search."""

from __future__ import annotations

import numpy as np
import pytest

import gyromodel as gm
from gyromodel.diagnosis._bank import build_bank
from gyromodel.effects.drivers import BiasColumn
from gyromodel.signals import read_signals
from tests.truth.monitors import backscattered, precession, unequal_beams, wandering

ROWS, DEG_H = 400, np.deg2rad(1 / 3600)


# Verdicts are examples, of one draw.
@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(1)


def log(wrong: np.ndarray, rng: np.random.Generator, noise: float = 0.3, **columns: tuple[np.ndarray, str]):
    """A campaign in deg/h with white noise; columns with their units."""
    values = {name: v for name, (v, _) in columns.items()}
    units = {name: unit for name, (_, unit) in columns.items()} | {"time": "s", "output": "deg/h"}
    values["temperature"], units["temperature"] = 25 + 10 * wandering(ROWS, rng), "degC"
    output = wrong / DEG_H + noise * rng.standard_normal(ROWS)
    return gm.Campaign({"time": 10.0 * np.arange(ROWS), **values, "output": output}, units, {"kind": "rate"})


def diagnosed(campaign: gm.Campaign, *labels: str) -> gm.Diagnosis:
    return gm.diagnose(campaign, gm.model_from_effects(["bias", *labels]), hold_out=False)


def test_backscatter_slows_a_turning_ring_laser_in_proportion_to_its_monitor(rng: np.random.Generator):
    """ω_L²/2ω, as a beat-phase equation has it, with ω_L² the scattered power."""
    power, rate, lock_in = wandering(ROWS, rng), np.deg2rad(10.0), np.deg2rad(0.1)
    measured = power * 0.2 + 1e-3 * rng.standard_normal(ROWS)
    found = diagnosed(log(backscattered(power, rate, lock_in, rng) - rate, rng, backscatter=(measured, "V")))
    assert (found.verdict, [c.effect for c in found.causes]) == ("named", ["bias_backscatter"])
    size = found.causes[0].parameters[0]
    assert size.unit == "deg/h/(V)"
    assert size.value == pytest.approx(-(lock_in**2) / (2 * rate) / DEG_H / 0.2, abs=5 * size.std)


@pytest.mark.long
def test_unequal_beams_shift_the_null_in_proportion_to_their_difference(rng: np.random.Generator):
    shifted, monitor = unequal_beams(0.02 * (wandering(ROWS, rng) - 0.5), 1.3, 50 * DEG_H)
    found = diagnosed(log(shifted, rng, null_shift=(monitor + 1e-4 * rng.standard_normal(ROWS), "")))
    assert (found.verdict, [c.effect for c in found.causes]) == ("named", ["bias_null_shift"])


@pytest.mark.parametrize("column", ["backscatter", "null_shift", "torquer_current"])
def test_a_monitor_has_one_name(column: str, rng: np.random.Generator):
    names = build_bank(read_signals(log(np.zeros(ROWS), rng, **{column: (wandering(ROWS, rng), "mA")}))).names()
    assert ({"torquer_scale"} if column == "torquer_current" else {f"bias_{column}"}) <= set(names)
    assert BiasColumn(column=column).label not in set(names) - {f"bias_{column}"}
    assert not {"bias_torquer_current", f"bias_column_{column}"} & set(names)
    counted = build_bank(read_signals(log(np.zeros(ROWS), rng, **{column: (wandering(ROWS, rng), "count")}))).names()
    assert f"bias_{column}" in counted
    assert "torquer_scale" not in counted


# A platform's gyro torqued both ways in steps: the current is a command, and the output what the platform then does.
def commanded(rng: np.random.Generator) -> np.ndarray:
    return np.repeat(rng.permutation(np.linspace(-40.0, 40.0, 20)), ROWS // 20)


@pytest.mark.parametrize(
    ("constants", "terms"),
    [
        ((2e-3, 0.0, 0.0), {"scale"}),
        pytest.param((0.0, 4e-3, 0.0), {"asymmetry"}, marks=pytest.mark.long),
        pytest.param((0.0, 4e-3, 3e-4), {"scale", "asymmetry", "temperature"}, marks=pytest.mark.long),
    ],
)
def test_a_torquer_that_errs_is_named(constants: tuple[float, float, float], terms: set[str], rng: np.random.Generator):
    current, nominal = commanded(rng), 9.29
    measured = log(np.zeros(ROWS), rng, torquer_current=(current, "mA"))
    wrong = nominal * precession(current, measured.columns["temperature"], constants)
    measured = measured.with_column("output", measured.columns["output"] + wrong, "deg/h")
    found = diagnosed(measured)
    assert (found.verdict, [c.effect for c in found.causes]) == ("named", ["torquer_scale"])
    sizes = {p.name: p for p in found.causes[0].parameters}
    assert set(sizes) == terms
    # At the mean temperature, to which it refers, the magnet has lost some of its flux.
    warmer = float(found.extended.model.effects[-1].reference) - 20.0  # type: ignore[attr-defined]
    error, unequal, loss = constants
    truth = {"scale": error - loss * warmer, "asymmetry": unequal, "temperature": -loss}
    for name, size in sizes.items():
        assert size.value == pytest.approx(nominal * truth[name], abs=5 * size.std)


@pytest.mark.long
@pytest.mark.parametrize("effect", ["scale_asymmetry", "scale_temperature"])
def test_a_torquer_beside_a_rate_that_it_follows_is_in_doubt(effect: str, rng: np.random.Generator):
    """The current is read by an instrument of its own, and is the rate over the torquer's scale."""
    rate = 9.29 * commanded(rng)
    measured = log(
        np.zeros(ROWS),
        rng,
        rate=(rate, "deg/h"),
        torquer_current=(rate / 9.29 + 1e-4 * rng.standard_normal(ROWS), "mA"),
    )
    warmer = measured.columns["temperature"] - 30
    wrong = rate * (1 + (1e-2 * np.sign(rate) if effect == "scale_asymmetry" else 5e-4 * warmer))
    found = diagnosed(measured.with_column("output", measured.columns["output"] + wrong, "deg/h"), "scale_factor")
    assert found.verdict == "ambiguous"
    assert set(found.credible_set) == {effect, "torquer_scale"}


@pytest.mark.parametrize("with_rate", [True, False])
def test_a_current_that_is_the_output_explains_nothing(with_rate: bool, rng: np.random.Generator):
    rate = 9.29 * commanded(rng)
    columns = {"rate": (rate, "deg/h")} if with_rate else {}
    measured = log(rate * DEG_H if with_rate else np.zeros(ROWS), rng, **columns)
    current = measured.columns["output"] / 9.29 + 0.01 * rng.standard_normal(ROWS)
    measured = measured.with_column("torquer_current", current, "mA")
    found = diagnosed(measured, *(["scale_factor"] if with_rate else []))
    assert found.verdict == "adequate"
    assert "it is the output" in found.not_testable["torquer_scale"]
