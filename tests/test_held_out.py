"""What blocks left out say of a step: scores against dense algebra, causes that one block alone determines."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

import gyromodel as gm
from gyromodel.diagnosis import _session
from gyromodel.diagnosis._gain import _summary, folds_of, held_out
from gyromodel.estimate import fit_record
from gyromodel.noise import NoiseRatios
from gyromodel.signals import read_signals
from tests.test_diagnosis import dense_covariance
from tests.truth.gains import true_gain
from tests.truth.study import Case, build

RUNS, ROWS = 4, 80
# Of the temperature's bias (deg/s/°C), and of the input axis towards two cross rates (rad).
WARM, LEANS = 1e-2, np.array([5e-4, 4e-4])


def log(rng: np.random.Generator, throughout: bool = False) -> gm.Campaign:
    """Runs in one of which the unit turns about y, and in another about z: each lean is determined by one block.

    `throughout`: it turns about both in all of them, by more where it is warm.
    """
    run = np.repeat(np.arange(1.0, RUNS + 1), ROWS)
    row = np.arange(len(run))
    time = 10.0 * row + 2000 * (run - 1)
    temperature = 20 + 10 * np.sin(time / 1300) + 0.01 * rng.standard_normal(len(run))
    rate = np.tile(np.repeat([-10.0, 0.0, 10.0, 5.0], ROWS // 4), RUNS)
    cross = np.stack([np.where(run == k, 10 * np.sin(row / 7), 0.0) for k in (2, 3)], 1)
    cross += 0.02 * rng.standard_normal(cross.shape)
    if throughout:
        cross = 2 * rng.standard_normal(cross.shape) + 0.1 * (temperature[:, None] - 20)
    output = rate + 0.02 + WARM * (temperature - 20) + cross @ LEANS + 1e-3 * rng.standard_normal(len(run))
    columns = {"time": time, "segment": run, "rate": rate, "rate_y": cross[:, 0], "rate_z": cross[:, 1]}
    columns |= {"temperature": temperature, "output": output}
    units = {name: {"time": "s", "segment": "", "temperature": "degC"}.get(name, "deg/s") for name in columns}
    return gm.Campaign(columns, units, {"kind": "rate"})


@pytest.mark.parametrize("walk", [0.0, 0.01])
def test_scores_equal_dense_algebra(rng: np.random.Generator, walk: float):
    """The density of a block predicted from the others by universal kriging."""
    record = read_signals([log(rng)])
    rows = np.flatnonzero(record.blocks == record.blocks[ROWS])
    ratios = NoiseRatios(np.array(0.05), np.array(walk))
    train = fit_record(record.without(rows), gm.model_from_effects(["bias", "bias_temperature"]), ratios=ratios)
    errors, score = held_out(record, train, rows)
    time = np.asarray(record.signals["time"])[: record.rows]
    run = np.zeros(record.rows)
    noise = dense_covariance(ratios, record.interval, record.span, time, run) * train.white_variance
    predicted, columns = (np.asarray(part)[: record.rows] for part in train.model.linearise(record.signals))
    residual = np.asarray(record.signals["output"])[: record.rows] - predicted
    others = np.setdiff1d(np.arange(record.rows), rows)
    weights = np.linalg.solve(noise[np.ix_(others, others)], noise[np.ix_(others, rows)]).T
    inverse = np.linalg.inv(noise[np.ix_(others, others)])
    left = columns[rows] - weights @ columns[others]
    unknown = np.linalg.inv(columns[others].T @ inverse @ columns[others])
    fitted = unknown @ columns[others].T @ inverse @ residual[others]
    spread = noise[np.ix_(rows, rows)] - weights @ noise[np.ix_(others, rows)] + left @ unknown @ left.T
    wrong = residual[rows] - left @ fitted - weights @ residual[others]
    expected = -0.5 * (wrong @ np.linalg.solve(spread, wrong) + np.linalg.slogdet(2 * np.pi * spread)[1])
    assert score == pytest.approx(expected, rel=1e-6)
    assert errors == pytest.approx(residual[rows])


@pytest.mark.long
def test_what_one_block_alone_determines_is_not_cut(rng: np.random.Generator):
    """The error on blocks left out rises with both leans, as the others leave each of them open."""
    found = gm.diagnose(log(rng), gm.model_from_effects(["scale_factor", "bias"]))
    assert found.verdict == "named"
    assert [step.added for step in found.rounds[1:]] == ["bias_temperature", "misalignment"]
    assert found.rounds[2].held_out > found.rounds[1].held_out
    assert found.rounds[2].log_score > found.rounds[1].log_score
    assert not any("More remains" in line for line in found.findings)
    leans = found.causes[[c.effect for c in found.causes].index("misalignment")].parameters
    for parameter, lean in zip(leans, np.rad2deg(LEANS) * 3600, strict=True):
        assert abs(parameter.value - lean) < 5 * parameter.std < abs(lean)


@pytest.mark.long
def test_values_beside_what_was_cut_say_so(rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch):
    """A cut by force: the coefficient over temperature takes up a part of the leans, and what it would be is told."""
    forced = lambda record, estimate: (p := float(len(estimate.model.slots())), -p, False)  # noqa: E731
    monkeypatch.setattr(_session, "ladder_error", forced)
    found = gm.diagnose(log(rng, throughout=True), gm.model_from_effects(["scale_factor", "bias"]))
    assert [c.effect for c in found.causes] == ["bias_temperature"]
    (said,) = (line for line in found.findings if line.startswith("More remains"))
    assert "misalignment is still significant" in said
    assert "All values are those without it; with it" in said
    found_there = re.search(r"coefficient of bias_temperature would be \((\S+) ± (\S+)\) deg/h/degC", said)
    assert found_there
    value, std = map(float, found_there.groups())
    assert abs(value - 3600 * WARM) < 5 * std < 1.0


@pytest.mark.long
def test_friction_that_one_run_of_each_axis_shows_is_not_cut():
    """Six runs of the embedded log: cut, the friction's lag made the delay 2.087 ± 0.002 ms for 2."""
    whole = gm.read_campaign(Path(gm.__file__).parent / "data" / "platform_vibration.csv.gz")
    found = gm.diagnose(whole.select(np.isin(whole.columns["segment"], [1, 4, 5, 8, 9, 12])), gm.model_from_effects([]))
    assert {cause.effect for cause in found.causes} == {"sync_delay", "shaft_friction"}
    (delay,) = (p for c in found.causes for p in c.parameters if p.name == "delay")
    assert abs(delay.value - 2.0) < 4 * delay.std < 0.02


@pytest.mark.parametrize("signal", [14.0, 500.0])
def test_blocks_alike_by_chance_do_not_make_a_gain_known_better_than_noise_leaves_it(
    signal: float, rng: np.random.Generator
):
    """The ratio's scatter over draws of white noise, with a signal of so many standard deviations in 1000 errors."""
    n, draws = 1000, rng.standard_normal((4000, 1000))
    power, before = np.sum(draws**2, axis=1), np.sum((draws + signal / np.sqrt(n)) ** 2, axis=1)
    mean = 1.0 + signal**2 / n
    gain = _summary(
        np.full(5, mean), np.ones(5), np.full(5, signal**2 / 10), np.full(5, n // 5), "fifths", "deg/h", 1.0
    )
    half = 1.96 * np.std(0.5 * np.log(before / power))
    assert np.log(gain.ci95[1] / gain.ratio) == pytest.approx(half, rel=0.1)
    assert np.array(gain.log_score_ci95) == pytest.approx(0.5 * signal**2 + 1.96 * signal * np.array([-1, 1]), rel=1e-3)


def test_the_error_of_blocks_of_unlike_lengths_is_that_of_their_rows():
    before, after, sizes = np.array([9.0, 1.0, 4.0]), np.array([4.0, 1.0, 1.0]), np.array([10, 1000, 90])
    gain = _summary(before, after, np.zeros(3), sizes, "runs", "deg/h", 1.0)
    assert gain.before == pytest.approx(np.sqrt(np.repeat(before, sizes).mean()))
    assert gain.after == pytest.approx(np.sqrt(np.repeat(after, sizes).mean()))


@pytest.mark.parametrize("effect", ["bias", "bias_pressure", "bias_turn_on"])
def test_the_true_gain_of_the_study_is_that_of_least_squares_on_average(effect: str, rng: np.random.Generator):
    """Fits drawn many times, their columns written out; no run's own offset is known of a run left out."""
    case = Case(7, "repeated_runs" if effect == "bias_turn_on" else "static_cycle", "white", effect, 3.0)
    built = build(case)
    wrong, spread, true = built.truth.error, built.truth.noise.std(), built.design.true
    run = true.get("run", np.zeros(len(wrong)))
    constant, none = np.ones((len(wrong), 1)), np.zeros((len(wrong), 0))
    simulated, own = {
        "bias": (none, constant),
        "bias_pressure": (constant, true.get("pressure", run)[:, None]),
        "bias_turn_on": (constant, run[:, None] == np.unique(run)[1:]),
    }[effect]
    folds = folds_of(read_signals(gm.Campaign(columns=built.columns, units=built.units, metadata=built.metadata)))[0]
    squares = np.zeros(2)
    for _ in range(60):
        output = (wrong + spread * rng.standard_normal(len(wrong))) / spread
        for rows in folds:
            others = np.setdiff1d(np.arange(len(wrong)), rows)
            for i, columns in enumerate((simulated, np.column_stack([simulated, own]))):
                fitted = np.linalg.lstsq(columns[others], output[others], rcond=1e-9)[0]
                squares[i] += np.mean((output[rows] - columns[rows] @ fitted) ** 2)
    assert np.sqrt(squares[0] / squares[1]) == pytest.approx(true_gain(case), rel=0.02)


@pytest.mark.parametrize(
    ("after", "cut"),
    [
        ([(3.0, 50.0)], True),
        ([(3.0, 50.0), (2.0, 60.0)], True),
        ([(3.0, 50.0), (0.5, 150.0)], False),
        ([(0.5, 150.0), (2.0, 60.0)], False),
        ([(3.0, 120.0)], False),
        ([(3.0, 50.0), (np.nan, -np.inf)], True),
        ([(np.nan, -np.inf), (3.0, 50.0)], False),
    ],
)
def test_rounds_are_cut_where_the_error_left_out_rises_for_good(after: list[tuple[float, float]], cut: bool) -> None:
    """Held-out errors and log scores of rounds after one with 1 and 100."""
    assert _session.rises_for_good((1.0, 100.0), *after) == cut


def test_the_errors_of_one_block_give_no_ratio():
    """Two thirds of the record are the model's to the last digit: without the third block there is 0 over 0."""
    before, after = np.array([0.0, 0.0, 4.0]), np.array([0.0, 0.0, 1.0])
    gain = _summary(before, after, np.ones(3), np.full(3, 50.0), "thirds", "deg/h", 1.0)
    assert gain.ratio == pytest.approx(2.0)
    assert gain.ci95 == (0.0, np.inf)
