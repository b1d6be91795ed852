"""A vibration test from its log to its verdict. Expected: the truth behind simulated logs, the binomial and χ² laws
over fresh draws, `fit_sines`, and closed forms."""

from __future__ import annotations

import gzip
import json
import re
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import binom, chi2, kstest

import gyromodel
from gyromodel import CampaignError, cli
from gyromodel._console import print_table
from gyromodel.campaign import Campaign
from gyromodel.files import read_campaign, write_campaign
from gyromodel.platform import (
    ALTERNATIVES,
    FREQUENCIES,
    BaseMotion,
    Explanation,
    VibrationTest,
    base_motion,
    explain,
    fit_sines,
    limits_at,
    parameters,
    points,
    predicted,
    responses,
    vibration_test,
)
from gyromodel.platform._judgement import _explained
from gyromodel.report import vibration_words, with_uncertainty

LOG = Path(gyromodel.__file__).parent / "data" / "platform_vibration.csv.gz"
SECOND = np.deg2rad(1 / 3600)
SAMPLES, STEP, AMPLITUDE = 1000, 0.02, np.deg2rad(0.15)
GAIN, PHASE = -0.05, -1.0


def motion(base: np.ndarray, table: np.ndarray, time: np.ndarray | None = None) -> BaseMotion:
    """Runs (rows of both) of one axis, the others still."""
    runs, samples = base.shape
    time = np.arange(samples) * STEP if time is None else time
    still = np.zeros((base.size, 2))
    angles = [np.column_stack([x.ravel(), still]) for x in (table, base)]
    readings = np.column_stack([base.ravel(), np.zeros((base.size, 3))])
    times = (time + np.arange(runs)[:, None] * (time[-1] + 1)).ravel()
    segment = np.repeat(np.arange(runs), samples)
    return BaseMotion(times, *angles, readings, np.zeros((base.size, 4)), np.eye(3), segment)


def sines(w: float, rng: np.random.Generator, runs: int) -> tuple[np.ndarray, np.ndarray]:
    angle = w * np.arange(SAMPLES) * STEP + rng.uniform(0, 2 * np.pi, (runs, 1))
    return 10 ** (GAIN / 20) * AMPLITUDE * np.sin(angle + np.deg2rad(PHASE)), AMPLITUDE * np.sin(angle)


def noise(kind: str, rng: np.random.Generator, shape: tuple[int, int]) -> np.ndarray:
    """Of the base, rad: white; the angle of a gyro with a random walk; that of one whose rate walks."""
    white = SECOND * rng.standard_normal(shape)
    walk = np.sqrt(STEP) * np.cumsum(rng.standard_normal(shape), axis=1)
    rate = 10 * SECOND * STEP * np.cumsum(walk, axis=1)
    return white + {"white": 0.0, "walk": 5 * SECOND * walk, "rate walk": rate, "quantised": 0.0}[kind]


@pytest.mark.parametrize("kind", ["white", "walk", "rate walk", "quantised"])
@pytest.mark.parametrize("w", [0.5, 10.0])
def test_intervals_hold_in_noise_of_any_colour(kind: str, w: float, rng: np.random.Generator):
    runs = 50
    base, table = sines(w, rng, runs)
    base, table = base + noise(kind, rng, base.shape), table + noise("white", rng, base.shape)
    if kind == "quantised":
        base, table = (np.round(x / (10 * SECOND)) * 10 * SECOND for x in (base, table))
    found, remarks = responses(motion(base, table))
    assert len(found) == runs, remarks
    least = binom.ppf(1e-5, runs, 0.95)
    for name, true in (("gain", GAIN), ("phase", PHASE)):
        ends = np.array([getattr(r, f"{name}_interval") for r in found])
        assert np.sum((ends[:, 0] <= true) & (true <= ends[:, 1])) >= least
        errors = np.array([getattr(r, name) for r in found]) - true
        stated = np.array([getattr(r, f"{name}_std") for r in found])
        # Not much wider than they need be: 1.3 times, with the rms of 50 errors as small as the χ² law allows. An
        # encoder's steps are allowed for at their worst.
        wide = 4.0 if kind == "quantised" else 1.3 / np.sqrt(chi2.ppf(1e-4, runs) / runs)
        assert np.sqrt(np.mean(stated**2)) < wide * np.sqrt(np.mean(errors**2))


def test_the_same_sines_as_at_the_known_frequency(rng: np.random.Generator):
    base, table = (x + 1e-6 * rng.standard_normal(x.shape) for x in sines(10.0, rng, 1))
    [found] = responses(motion(base, table))[0]
    time = jnp.arange(SAMPLES) * STEP
    fit = fit_sines(time, jnp.asarray(base[0]), jnp.asarray(table[0]), found.frequency, degree=3, harmonics=3)
    assert (found.gain, found.phase) == pytest.approx((float(fit.gain), float(fit.phase)), abs=1e-9)
    assert found.frequency == pytest.approx(10.0, abs=5 * found.frequency_std)
    # White noise: the same standard error but for what is estimated of its colour.
    assert found.phase_std == pytest.approx(float(fit.phase_std), rel=0.5)
    assert found.axis == "X"
    assert found.amplitude == pytest.approx(0.15, rel=1e-4)
    assert found.cross == {"Y": (0.0, 0.0), "Z": (0.0, 0.0)}


def test_times_may_be_uneven(rng: np.random.Generator):
    time = np.sort(rng.uniform(0, 20, SAMPLES))
    table = AMPLITUDE * np.sin(3.0 * time)[None]
    base = AMPLITUDE * np.sin(3.0 * time - 0.01)[None]
    [found] = responses(motion(base + 1e-9 * rng.standard_normal(base.shape), table, time))[0]
    assert (found.frequency, found.phase) == pytest.approx((3.0, np.rad2deg(-0.01)), rel=1e-4)


def test_other_motion_of_the_table_is_told_of(rng: np.random.Generator):
    """A second tone of 90 %, at an overtone or not, and a random walk; a sine in noise has none."""
    time, runs = np.arange(SAMPLES) * STEP, 4
    base, table = sines(5.0, rng, runs)
    for k, w in ((1, 10.0), (2, 7.3)):
        base[k], table[k] = (x + 0.9 * AMPLITUDE * np.sin(w * time) for x in (base[k], table[k]))
    base[3] = table[3] = 0.05 * AMPLITUDE * np.cumsum(rng.standard_normal(SAMPLES))
    found, remarks = responses(motion(*(x + SECOND * rng.standard_normal(x.shape) for x in (base, table))))
    assert [r.run for r in found][:3] == [1, 2, 3]
    told = {remark.split(":")[0] for remark in remarks if remark.startswith("run")}
    assert told == {"run 2", "run 3", "run 4"}
    part, where = re.findall(r"by ([\d.]+) % of this sine besides, most at ([\d.]+)", " ".join(remarks))[1]
    assert float(part) == pytest.approx(90, abs=5)
    assert float(where) == pytest.approx(7.3, abs=0.05)


def test_a_gimbal_that_reads_one_value_is_told_of():
    log = read_campaign(LOG)
    log = log.select(np.isin(log.columns["segment"], [2, 6]))
    assert responses(base_motion(log))[1] == []
    dead = changed(log, "gimbal_y", np.full(len(log), 0.3))
    [remark] = responses(base_motion(dead))[1]
    assert remark.startswith("gimbal_y reads one value while the table moves about Y")
    about_x = dead.select(dead.columns["segment"] == 2)
    assert responses(base_motion(about_x))[1] == []


def test_limits_are_those_of_published_frequencies():
    assert limits_at(1.005) == (0.1, -0.5)
    assert limits_at(30.3) == (0.2, -10.0)
    assert limits_at(15.0) is None


@pytest.fixture(scope="module")
def demo() -> VibrationTest:
    return vibration_test(read_campaign(LOG))


def test_the_embedded_log(demo: VibrationTest):
    """Records 2 ms late; friction of X (inertia 0.45) and Z (0.56) 0.5 N m s/rad, in a loop of 220 rad/s instead of the
    assumed 210, whose lags differ too: what they do to offset and friction is a part in 200, and in seven."""
    assert [(r.axis, round(r.frequency)) for r in demo.responses] == [(a, w) for a in "XYZ" for w in (1, 10, 20, 30)]
    assert not demo.remarks
    assert all(r.verdicts[0] == "pass" for r in demo.responses)
    best = demo.supported[0]
    assert best == "time offset, wet and dry friction, integration estimated, without axis Y"
    assert demo.left_out == ("Y",)
    assert demo.firm
    # Of those that do not only add to it the next, a resonance in place of dry friction without Z, is e^-3 as likely.
    first = demo.explanations[best]
    more = [e for e in demo.explanations.values() if first.alternative.within(e.alternative) and e.left_out == ("Y",)]
    rest = [e for e in demo.explanations.values() if e not in more]
    assert min(e.criterion for e in rest) - first.criterion > 5.5
    values = {row.name: row.value for row in parameters(demo.explanations[best])}
    assert values["time offset"] == pytest.approx(2.0, abs=0.02)
    assert values["friction over inertia X"] == pytest.approx(0.5 / 0.45 * 210 / 220, rel=0.25)
    assert values["friction over inertia Z"] == pytest.approx(0.5 / 0.56 * 210 / 220, rel=0.25)
    assert values["corner"] == pytest.approx(30.0, rel=0.25)


def test_the_series_of_the_embedded_log(demo: VibrationTest):
    """Friction of the redundant gimbal sticks, which overtones about Y tell; without Y the series hold the truth."""
    assert demo.series is not None
    assert demo.series.probability > 0.01
    rows = {row.name: row for row in parameters(demo.series)}
    inertia = {"X": 0.45, "Z": 0.56}
    expected = {"time offset": 2.0} | {f"friction over inertia {a}": 0.5 / j for a, j in inertia.items()}
    expected |= {f"dry friction over inertia {a}": 0.002 / j for a, j in inertia.items()}
    for name, true in expected.items():
        assert rows[name].value == pytest.approx(true, abs=2.5 * rows[name].std), name


def test_the_readme_prints_what_the_command_does(demo: VibrationTest, capsys: pytest.CaptureFixture[str]):
    readme = (Path(__file__).resolve().parents[1] / "README.md").read_text(encoding="utf-8")
    words = vibration_words(demo)
    print_table(words.head, words.runs)
    assert "\n".join(capsys.readouterr().out.splitlines()[:5]) in readme
    rows = {row.name: row for row in parameters(demo.explanations[demo.supported[0]])}
    for name in ("time offset", "friction over inertia X", "friction over inertia Z"):
        assert with_uncertainty(rows[name].value, rows[name].std, rows[name].unit) in readme
    series = {row.name: row for row in parameters(demo.series)} if demo.series else {}
    for name in ("time offset", "friction over inertia X", "friction over inertia Z"):
        assert with_uncertainty(series[name].value, series[name].std, series[name].unit) in readme


def explained(rng: np.random.Generator, passed: Callable[[float], complex]) -> dict[str, Explanation]:
    """Explanations of three runs of X whose base moves by what a transfer function of jω makes of the table."""
    frequencies, draws = (1.0, 10.0, 30.0), []
    for w in frequencies:
        wave = np.exp(1j * w * np.arange(SAMPLES) * STEP)
        draws.append([AMPLITUDE * x.imag + SECOND * rng.standard_normal(SAMPLES) for x in (passed(w) * wave, wave)])
    found, _ = responses(motion(*(np.stack(x) for x in zip(*draws, strict=True))))
    return _explained(found, integrated=False)


@pytest.mark.long
def test_an_isolator_is_no_time_offset(rng: np.random.Generator):
    """60 rad/s, damped against the table by 0.1 of critical."""
    natural, damping = 60.0, 0.1

    def isolator(w: float) -> complex:
        s = 1j * w / natural
        return (1 + 2 * damping * s) / (1 + 2 * damping * s + s**2)

    explanations = explained(rng, isolator)
    likely = [name for name, e in explanations.items() if e.probability > 1e-6]
    assert all("resonance" in name or "loop estimated" in name for name in likely)
    right = explanations["resonance, damped"]
    # What a loop's gain does besides costs more than it explains.
    best = min(explanations.values(), key=lambda e: e.criterion)
    assert right.criterion - best.criterion < 6.0
    assert right.probability > 1e-6
    assert explanations["time offset, resonance"].probability < 1e-6
    rows = {row.name: row for row in parameters(right)}
    assert rows["lag"].value == pytest.approx(1e3 * 2 * damping / natural, abs=5 * rows["lag"].std)
    assert rows["compliance X"].value == pytest.approx(1e6 / natural**2, abs=5 * rows["compliance X"].std)
    late = parameters(explanations["time offset, resonance, damped"])[0]
    assert abs(late.value) < 5 * late.std


@pytest.mark.long
def test_a_delay_is_no_friction_that_no_loop_would_hold(rng: np.random.Generator):
    """With a corner far above all frequencies friction delays by c/(J ω_c ω_i) and does nothing else."""
    explanations = explained(rng, lambda w: np.exp(-2e-3j * w))
    assert explanations["time offset"].probability > 1e-6
    assumed = {name: e for name, e in explanations.items() if "loop estimated" not in name}
    rates = {name: {row.name: row.value for row in parameters(e)} for name, e in assumed.items()}
    # The default loop's damping over its inertia: 210 1/s.
    assert all(row.get("friction over inertia X", 0.0) < 210.0 for row in rates.values())
    assert "friction" in rates


@pytest.mark.long
def test_one_axis_at_two_frequencies_tells_less():
    """Untested axes have no numbers; the explanations that are left are set apart by the test that is named."""
    log = read_campaign(LOG)
    found = vibration_test(log.select(log.columns["segment"] == 3))
    assert len(found.responses) == 1
    found = vibration_test(log.select(np.isin(log.columns["segment"], [3, 4])))
    assert {r.axis for r in found.responses} == {"X"}
    names = {row.name for e in found.explanations.values() for row in parameters(e)}
    assert "friction over inertia X" in names
    assert not any(name.endswith(("Y", "Z")) for name in names)
    assert all(e.degrees_of_freedom > 0 for e in found.explanations.values())
    assert len(found.possible) > 1
    assert found.supported == ()
    assert max(found.further.values()) > 3.3
    # The predictions of one explanation need not determine another.
    assert vibration_test(log.select(log.columns["segment"] <= 3)).further.keys() == found.further.keys()


def test_known_standard_errors(rng: np.random.Generator):
    """Sums of squares follow χ², and intervals of parameters hold."""
    alternative, at = ALTERNATIVES["time offset, friction"], points(FREQUENCIES)
    value = np.zeros(15)
    value[:6] = [1.5e-3] * 3 + [2.0, 3.0, 4.0]
    exact = predicted(Explanation(alternative, value, value, np.ones(2), np.zeros(24), 0.0), at)
    std, draws = np.array([np.full(12, 2e-3), np.full(12, 2e-2)]), 60
    found = [
        explain(alternative, at, *(exact + std * rng.standard_normal(exact.shape)), phase_std=std[1], gain_std=std[0])
        for _ in range(draws)
    ]
    assert kstest([e.probability for e in found], "uniform").pvalue > 1e-4
    for k in (0, 3, 5):
        errors = np.array([(e.value[k] - value[k]) / e.std[k] for e in found])
        assert np.sum(np.abs(errors) < 1.96) >= binom.ppf(1e-5, draws, 0.95)
    wrong = explain(ALTERNATIVES["time offset"], at, *exact, phase_std=std[1], gain_std=std[0])
    assert wrong.probability < 1e-6


def run(arguments: list[str]) -> int:
    with pytest.raises(SystemExit) as done:
        cli.main(["vibration", *arguments])
    return int(done.value.code or 0)


@pytest.mark.long
def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert run([str(LOG), "-o", str(tmp_path / "out"), "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result == json.loads((tmp_path / "out" / "vibration.json").read_text(encoding="utf-8"))
    assert len(result["runs"]) == 12
    assert result["supported"][0] == result["explanations"][0]["name"]
    names = ["attitude", "responses", "explanations", "loop"]
    drawn = {path.stem: path.read_text(encoding="utf-8") for path in (tmp_path / "out").glob("*.svg")}
    assert sorted(drawn) == sorted(names)
    for text in ("angle (deg)", "(10⁻³ deg)", "time (s)", "base, from navigation", "axis X, run 2: 10 rad/s"):
        assert text in drawn["attitude"]
    # Nothing fitted is drawn of an axis that was left out.
    assert "axis Y, left out" in drawn["explanations"]
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert re.findall(r"""(?:src|href)=["'](?!#)[^"']*|url\((?!#)[^)]*|@import""", page) == []
    assert page.count("<svg") == len(names)
    assert "time offset (1.9995" in page
    runs = page[page.index('id="runs"') : page.index('id="explained"')]
    assert runs.count('<tr><th scope="row">') == 12


@pytest.mark.long
def test_the_command_prints_its_files(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    log = read_campaign(LOG)
    write_campaign(log.select(np.isin(log.columns["segment"], [3, 4])), tmp_path / "log.csv")
    assert run([str(tmp_path / "log.csv"), "-o", str(tmp_path / "out")]) == 0
    printed = capsys.readouterr().out
    assert all(str(path) in printed for path in (tmp_path / "out").iterdir())
    assert "axis none" not in printed


def test_the_command_leaves_no_figure_of_an_earlier_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("gyromodel.platform.vibration_test", lambda *_: SimpleNamespace(to_dict=dict))
    monkeypatch.setattr("gyromodel.report.vibration_figures", lambda _: {"attitude": "<svg/>"})
    monkeypatch.setattr("gyromodel.report.vibration_page", lambda *_: "")
    for name in ("explanations", "loop", "mine"):
        (tmp_path / f"{name}.svg").write_text("<svg/>")
    assert run([str(LOG), "-o", str(tmp_path), "--json"]) == 0
    assert sorted(path.name for path in tmp_path.glob("*.svg")) == ["attitude.svg", "mine.svg"]


def changed(campaign: Campaign, name: str, values: np.ndarray) -> Campaign:
    return campaign.with_column(name, values, campaign.units[name])


@pytest.mark.parametrize(
    ("broken", "said"),
    [
        (lambda c: c.without("gimbal_x"), "needs columns gimbal_x"),
        (lambda c: c.without("gimbal_x").without("table_z"), "table_z, gimbal_x"),
        (lambda c: changed(c, "table_y", np.where(np.arange(len(c)) == 9, np.nan, 0)), "table_y is missing in row 10"),
        (lambda c: changed(c, "table_x", np.zeros(len(c))), "at rest"),
        (lambda c: changed(c, "table_x", np.full(len(c), 3.0)), "at rest"),
        (lambda c: c.select(slice(0, 200)), "less than a period"),
        (lambda c: changed(c, "segment", np.arange(len(c))), "1 samples are fewer"),
        (lambda c: c.with_metadata({"latitude_deg": None}), "latitude_deg"),
    ],
)
def test_what_cannot_be_answered_is_refused(broken, said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    log = read_campaign(LOG)
    write_campaign(broken(log.select(log.columns["segment"] == 1)), tmp_path / "log.csv")
    assert run([str(tmp_path / "log.csv"), "-o", str(tmp_path / "out")]) == 1
    message = capsys.readouterr().err
    assert said in message
    assert message.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_runs_without_a_response_are_left_out_and_named():
    log = read_campaign(LOG)
    log = log.select(log.columns["segment"] <= 2)
    at_rest = changed(log, "table_x", np.where(log.columns["segment"] == 1, 0.0, log.columns["table_x"]))
    found = vibration_test(at_rest)
    assert [r.run for r in found.responses] == [2]
    assert found.remarks[0].startswith("run 1: left out, the table is at rest")
    with pytest.raises(CampaignError, match="no run has a vibration"):
        vibration_test(at_rest.select(at_rest.columns["segment"] == 1))


def test_the_embedded_log_is_small():
    assert LOG.stat().st_size < 300_000
    assert gzip.decompress(LOG.read_bytes()).startswith(b"# ")
