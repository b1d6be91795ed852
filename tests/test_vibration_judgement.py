"""What a vibration test may name, and what it must leave open. Expected: the truth behind simulated logs; tests of few
runs, of which none may be firm and wrong."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

import gyromodel
from gyromodel.campaign import Campaign
from gyromodel.files import read_campaign
from gyromodel.platform import (
    ALTERNATIVES,
    OFFERED,
    Alternative,
    Bench,
    Loop,
    Platform,
    VibrationTest,
    margins,
    parameters,
    simulate_vibration_test,
    vibration_test,
)
from gyromodel.report import vibration_words
from gyromodel.report._numbers import with_uncertainty
from gyromodel.report._vibration_words import vibration_sentence
from tests.truth.platform_demo import demo_log

LOG = Path(gyromodel.__file__).parent / "data" / "platform_vibration.csv.gz"
README = Path(__file__).resolve().parents[1] / "README.md"
LATE, SECOND = 2e-3, np.deg2rad(1 / 3600)


@pytest.mark.long
@pytest.mark.parametrize(
    "kept",
    [
        # Six runs about axes without fault.
        [1, 2, 3, 9, 10, 11],
        [5, 6, 7, 8, 10, 11],
        [1, 2, 3, 4, 5, 6, 7, 8],
        [1, 4, 5, 8, 9, 12],
        [3, 4, 7, 8],
        [5, 6, 7, 8, 9, 10, 11, 12],
    ],
)
def test_parts_of_a_log_are_not_firm_and_wrong(kept: list[int]):
    """Of the embedded log: 2 ms late, friction, and Y sticks."""
    log = read_campaign(LOG)
    found = vibration_test(log.select(np.isin(log.columns["segment"], kept)))
    assert not found.firm or is_right(found), found.possible
    assert found.few or all(found.explanations[name].degrees_of_freedom >= 5 for name in found.possible)
    assert found.firm == (kept == [1, 2, 3, 9, 10, 11])


@pytest.mark.long
@pytest.mark.parametrize("seed", [3, 6, None])
def test_other_noise_of_the_same_test(seed: int | None, rng: np.random.Generator):
    """What the standard errors of the responses allow with Y, a resonance, the angles do not."""
    found = vibration_test(demo_log(int(rng.integers(2**31)) if seed is None else seed))
    assert found.firm or seed is None
    assert not found.firm or is_right(found), found.possible


def is_right(found: VibrationTest) -> bool:
    """Whether the first explanation has friction and the delay, no resonance, and no fit of the axis that sticks."""
    name, axes = found.possible[0], {r.axis for r in found.responses}
    fits = "friction" in name and "resonance" not in name and offset_fits(found)
    return fits and ("Y" in found.left_out or "Y" not in axes)


def offset_fits(found: VibrationTest) -> bool:
    """Whether the first explanation has the delay within four standard uncertainties."""
    rows = {row.name: row for row in parameters(found.explanations[found.possible[0]])}
    return "time offset" in rows and abs(rows["time offset"].value - 1e3 * LATE) < 4 * rows["time offset"].std


@pytest.mark.long
def test_too_few_runs_name_nothing_and_say_what_to_do():
    log = read_campaign(LOG)
    found = vibration_test(log.select(np.isin(log.columns["segment"], [2, 3, 6, 7])))
    assert found.supported == ()
    assert found.series is None
    assert found.next_test == "more frequencies about each axis"
    assert "too few to name" in vibration_sentence(found)
    text = "\n".join(vibration_words(found).lines)
    assert "The runs are too few to name one explanation" in text
    assert found.to_dict()["too_few_runs"] is True


def simulated(
    frequencies: Sequence[float], duration: float, amplifier: float = 10.0, **bench: float | tuple[float, float]
) -> Campaign:  # fmt: skip
    """Runs about X and Z of a platform of rigid bodies without dry friction."""
    platform = Platform(coulomb=np.zeros(4), loop=Loop(amplifier=amplifier))
    amplitude = np.deg2rad(0.15) * np.repeat(np.eye(3)[[0, 2]], len(frequencies), axis=0)
    frequency = np.tile(frequencies, 2)[:, None] * np.ones(3)
    skip = 0.125 * duration
    return simulate_vibration_test(
        platform, amplitude, frequency, duration, Bench(late=LATE, scatter=SECOND, **bench), skip=skip, seed=4
    )


@pytest.mark.long
def test_an_isolator_with_friction():
    """60 rad/s, damped by a tenth of critical: neither the friction nor an axis may be lost, nor the delay be wrong."""
    found = vibration_test(simulated([5.0, 10.0, 20.0, 30.0], 8.0, isolator=(60.0, 0.1), walk=np.deg2rad(0.002) / 60))
    assert found.left_out == ()
    assert all("damped" in name and "friction" in name for name in found.supported)
    assert offset_fits(found)
    assert found.series is not None
    rows = {row.name: row for row in parameters(found.series)}
    assert rows["time offset"].value == pytest.approx(1e3 * LATE, abs=3 * rows["time offset"].std)
    assert rows["compliance X"].value == pytest.approx(1e6 / 60**2, rel=0.01)


@pytest.mark.long
@pytest.mark.parametrize("amplifier", [6.0, 10.0])
def test_the_crossover_shows_where_runs_reach_it(amplifier: float):
    """Gain of the amplifier 0.6 of the assumed one, or that: K/J is the loop's, the same for all axes."""
    found = vibration_test(simulated([10.0, 30.0, 60.0, 120.0, 200.0], 4.0, amplifier, step=5e-4))
    assert found.scatter_stated
    assert found.left_out == ()
    assert offset_fits(found)
    assert found.crossover is not None
    true = margins(Loop(amplifier=amplifier)).crossover
    assert found.crossover.value == pytest.approx(true, abs=3 * found.crossover.std)
    assert found.crossover.std < 0.1 * true
    fitted = [name for name in found.supported if "loop estimated" in name]
    assert fitted == list(found.supported) if amplifier == 6.0 else not fitted
    [line] = [line for line in vibration_words(found).lines if "crossover is" in line]
    assert "±" in line
    if fitted:
        told = with_uncertainty(found.crossover.value, found.crossover.std, found.crossover.unit)
        assert told in " ".join(README.read_text(encoding="utf-8").split())
        assert found.series is not None
        assert parameters(found.series)[-1].name == "crossover"
        assert parameters(found.series)[-1].value == pytest.approx(true, abs=3 * parameters(found.series)[-1].std)


def test_what_contains_what():
    """By hand: an explanation is within another that has all its kinds, in a loop that can be the same."""
    within = {(a, b) for a, one in OFFERED.items() for b, other in OFFERED.items() if one.within(other)}
    assert all((name, name) in within and ("nothing", name) in within for name in OFFERED)
    assert ("friction", "time offset, friction, loop estimated") in within
    assert ("friction, quick integration", "friction, integration estimated") in within
    assert ("time offset", "time offset of each axis") in within
    assert ("friction, double integration", "friction, integration estimated") not in within
    assert ("friction", "friction, quick integration") not in within
    assert ("time offset, resonance", "resonance, damped") not in within
    assert ("resonance, damped", "resonance, damped against inertial space") not in within
    assert OFFERED.items() >= ALTERNATIVES.items()
    # No two names for one explanation.
    assert len({(a.kinds, tuple(a.loop.items()), a.grounded) for a in OFFERED.values()}) == len(OFFERED)
    assert Alternative(()).columns.shape == (15, 0)
