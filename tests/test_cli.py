"""The command line against its contract: commands, exit status, one readable sentence on error, `--json`.

Expected values are the contract's, and for the demo the published ring laser table: eight of its twelve points lie on a
line and the points at 30, 50, 70 and 110 deg/s do not (the line and the misses follow from the printed counts).
"""

from __future__ import annotations

import json
import math
import os
import re
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gyromodel import _compiling, _console, cli
from gyromodel.campaign import Campaign
from gyromodel.files import read_campaign, write_campaign

COMMANDS = ("demo", "fit", "diagnose", "simulate", "plan", "navigate", "compensate", "export", "allan", "effects")
HEAVY = {"jax", "equinox", "numpy", "pandas", "pint", "matplotlib", "xarray", "scipy", "rich"}

PLAN = """\
gyro: fog
kind: rate
duration: 2 h
interval: 20 s
output: count/s
columns:
  rate:
    - repeat: 6
      segments: [{for: 10 min, at: 10 deg/s}, {for: 10 min, at: -10 deg/s}]
  temperature:
    - {for: 1 h, from: 20 degC, to: 50 degC}
    - {for: 1 h, to: 20 degC}
"""
TRUTH = """\
gyro: fog
effects:
  - effect: scale_factor
    value: 1000 count/deg
  - effect: bias
    value: 5 deg/h
noise:
  - {effect: noise_white, value: 0.02 deg/sqrt(h)}
"""
SIMULATION = """\
gyro: fog
effects:
  - effect: scale_factor
  - effect: bias
noise: auto
"""
CAMPAIGN = """\
# kind: rate
time [s],rate [deg/s],output [count/s]
0,0,1
1,1,1002
2,-1,-999
3,2,2001
"""


@dataclass
class Outcome:
    status: int
    out: str
    err: str


Run = Callable[..., Outcome]


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Run:
    """Run the command line in this process."""
    monkeypatch.delenv("GYROMODEL_DEBUG", raising=False)

    def call(*arguments: object) -> Outcome:
        with pytest.raises(SystemExit) as ended:
            cli.main([str(argument) for argument in arguments])
        code = ended.value.code
        captured = capsys.readouterr()
        return Outcome(code if isinstance(code, int) else 0, captured.out, captured.err)

    return call


@pytest.fixture
def bench(tmp_path: Path, run: Run) -> Path:
    """A folder with a simulated campaign, the model behind it and the model to fit."""
    for name, text in {"plan.yaml": PLAN, "truth.yaml": TRUTH, "simulation.yaml": SIMULATION}.items():
        (tmp_path / name).write_text(text, encoding="utf-8")
    made = run("simulate", tmp_path / "truth.yaml", "--plan", tmp_path / "plan.yaml", "-o", tmp_path / "campaign.csv")
    assert made.status == 0, made.err
    return tmp_path


def refusal(outcome: Outcome) -> str:
    """The one sentence of a command that could not answer."""
    assert outcome.status == 1, outcome
    assert outcome.err.startswith("gyromodel: ")
    assert outcome.err.count("\n") == 1
    assert "Traceback" not in outcome.err
    assert "internal error" not in outcome.err
    return outcome.err


@pytest.mark.parametrize("arguments", [["--help"], ["--version"], ["effects"], ["effects", "bias"], ["fit", "--help"]])
def test_commands_that_compute_nothing_load_nothing_heavy(arguments: list[str]):
    code = (
        "import sys, atexit\n"
        f"atexit.register(lambda: print('loaded', *sorted({HEAVY!r} & set(sys.modules))))\n"
        f"from gyromodel.cli import main; main({arguments!r})"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1].strip() == "loaded"


def test_help_lists_every_command(run: Run):
    shown = run("--help")
    assert shown.status == 0
    assert all(f"\n  {command} " in shown.out for command in COMMANDS)


STARTING = """
import signal, sys
loading = sys.argv.pop()
class Finder:
    def find_spec(self, name, *_):
        if name == loading:
            sys.meta_path.remove(self)
            eval("signal.raise_signal(signal.SIGINT)")
sys.meta_path.insert(0, Finder())
from gyromodel.__main__ import main
main()
"""


@pytest.mark.parametrize("loading", ["gyromodel.cli", "typer", "jax"])
def test_ctrl_c_ends_in_one_sentence_from_the_first_import_on(tmp_path: Path, loading: str):
    command = [sys.executable, "-c", STARTING, "allan", "no.csv", "-o", str(tmp_path), loading]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 130, done.stderr
    assert re.fullmatch("gyromodel: interrupted; .*\n", done.stderr)


def test_ctrl_c_after_the_last_line_is_too_late():
    ending = "import atexit, signal; from gyromodel.__main__ import main\n"
    ending += "atexit.register(signal.raise_signal, signal.SIGINT); main()"
    command = [sys.executable, "-c", ending, "effects", "bias", "--json"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert json.loads(done.stdout)


def test_the_module_runs_as_a_program():
    done = subprocess.run([sys.executable, "-m", "gyromodel", "fit"], capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert "Missing argument" in done.stderr


@pytest.mark.parametrize(
    "arguments",
    [
        [],
        ["fits"],
        ["fit"],
        ["fit", "campaign.csv"],
        ["fit", "campaign.csv", "--model", "m.yaml"],
        ["diagnose", "campaign.csv", "--model", "m.yaml", "-o", "out", "--axis", "w"],
        ["diagnose", "campaign.csv", "--model", "m.yaml", "-o", "out", "--calibrate", "-1"],
        ["diagnose", "campaign.csv", "--model", "m.yaml", "-o", "out", "--seed", "one"],
        ["simulate", "m.yaml", "-o", "out.csv"],
        ["simulate", "m.yaml", "-o", "out.csv", "--like", "a.csv", "--plan", "b.yaml"],
        ["compensate", "m.yaml", "campaign.csv"],
        ["compensate", "m.yaml", "-o", "out.csv"],
        ["export", "m.yaml"],
        ["export", "m.yaml", "--to", "fortran"],
        ["allan", "campaign.csv"],
        ["allan", "campaign.csv", "-o", "out", "--axis", "w"],
        ["effects", "scale_temprature"],
        ["effects", "bias_"],
        ["effects", "--unknown"],
    ],
)
def test_wrong_usage_ends_with_status_2(run: Run, arguments: list[str]):
    outcome = run(*arguments)
    assert outcome.status == 2
    assert outcome.err
    assert "Traceback" not in outcome.err


def test_a_misspelt_effect_is_met_with_the_nearest(run: Run):
    for name in ("bias_temperature", "scale_temperature"):
        assert name in run("effects", name.replace("era", "ra")).err


@pytest.mark.parametrize(
    ("name", "entry"),
    [
        ("bias_pressure", "bias_column"),
        ("bias_acceleration_x", "bias_column"),
        ("bias_column_temperature_rate", "bias_column"),
        ("outliers", "outliers"),
    ],
)
def test_every_name_that_results_have_is_explained(run: Run, name: str, entry: str):
    assert json.loads(run("effects", name, "--json").out)["id"] == entry


def test_effects_lists_the_catalogue(run: Run):
    shown = run("effects")
    assert shown.status == 0
    assert {"scale_factor", "bias_temperature_rate"} <= {line.split()[0] for line in shown.out.splitlines()}


def test_effects_shows_one_entry_in_full(run: Run):
    shown = run("effects", "bias_temperature_rate")
    for part in ("Shupe", "deg/h/(degC/s)", "temperature", "fiber coil", "ramp speeds"):
        assert part in shown.out


def test_effects_as_json(run: Run):
    listed = json.loads(run("effects", "--json").out)
    one = json.loads(run("effects", "scale_factor", "--json").out)
    assert one in listed
    assert one["id"] == "scale_factor"
    assert {"equation", "needs", "cause", "test", "parameters"} <= set(one)


@pytest.mark.long
def test_plan_tells_what_could_be_told_apart(tmp_path: Path, run: Run):
    """One ramp: temperature and time are one line, which the table, the tests and the JSON form all say."""
    (tmp_path / "plan.yaml").write_text(
        "gyro: fog\nkind: rate\nduration: 1 h\ninterval: 20 s\noutput: deg/h\n"
        "columns:\n  temperature: [{for: 1 h, from: 20 degC, to: 60 degC}]\n",
        encoding="utf-8",
    )
    (tmp_path / "model.yaml").write_text(
        "effects:\n  - effect: bias\nnoise:\n  - {effect: noise_white, value: 0.005 deg/sqrt(h)}\n", encoding="utf-8"
    )
    told = run("plan", "--design", tmp_path / "plan.yaml", "--model", tmp_path / "model.yaml")
    assert told.status == 0, told.err
    row = next(line.split() for line in told.out.splitlines() if line.startswith("bias_temperature "))
    assert row[2] == "bias_drift"
    assert "Not testable: scale_factor (needs a column rate)." in told.out
    first = told.out.split("the most helpful first:\n")[1].splitlines()[0]
    assert "temperature" in first
    assert "bias_temperature at" in first
    listed = run("plan", "--design", tmp_path / "plan.yaml", "--model", tmp_path / "model.yaml", "--json")
    sizes = {(a["effect"], a["from"]): a["size"] for a in json.loads(listed.out)["apart"]}
    assert sizes["bias_temperature", "bias_drift"] is None or sizes["bias_temperature", "bias_drift"] > 100


def test_simulate_repeats_with_its_seed_and_differs_without(bench: Path, run: Run):
    def simulated(seed: int, name: str) -> bytes:
        made = run(
            "simulate", bench / "truth.yaml", "--like", bench / "campaign.csv", "--seed", seed, "-o", bench / name
        )
        assert made.status == 0, made.err
        return (bench / name).read_bytes()

    assert simulated(3, "a.csv") == simulated(3, "b.csv")
    assert simulated(3, "a.csv") != simulated(4, "c.csv")


@pytest.mark.parametrize("name", ["made.csv.gz", "made.parquet", "made.nc", "made.zarr", "new/folder/made.csv"])
def test_simulate_writes_every_format(bench: Path, run: Run, name: str):
    made = run("simulate", bench / "truth.yaml", "--like", bench / "campaign.csv", "-o", bench / name, "--json")
    assert made.status == 0, made.err
    said = json.loads(made.out)
    assert said["rows"] == 360
    assert (bench / name).exists()


@pytest.mark.parametrize("command", ["simulate", "compensate", "navigate", "units", "batch"])
def test_a_target_of_no_known_kind_is_wrong_usage(bench: Path, run: Run, command: str):
    """Before the work, and with nothing made."""
    truth, campaign = bench / "truth.yaml", bench / "campaign.csv"
    given = {
        "simulate": [truth, "--like", campaign], "compensate": [truth, campaign], "navigate": [campaign],
        "units": [campaign], "batch": [bench, "--model", truth],
    }[command]  # fmt: skip
    done = run(command, *given, "-o", bench / "new" / "result.txt")
    assert done.status == 2
    assert "its name has to end in" in done.err
    assert not (bench / "new").exists()


@pytest.mark.parametrize("output", ["", ",0", ","])
def test_simulate_needs_no_measured_output(bench: Path, run: Run, output: str):
    """Times and temperatures alone, or beside an output that says nothing, and without its kind."""
    head = "time [s],temperature [degC]" + (",output [deg/h]" if output else "")
    rows = [f"{60 * k},{20 + k}{output}" for k in range(30)]
    (bench / "mission.csv").write_text("\n".join([head, *rows, ""]))
    (bench / "model.yaml").write_text(
        "effects: [{effect: bias_temperature, coefficient: 3 deg/h/degC, reference: 20 degC}]\n"
    )
    done = run("simulate", bench / "model.yaml", "--like", bench / "mission.csv", "-o", bench / "made.csv")
    assert done.status == 0, done.err
    made = read_campaign(bench / "made.csv")
    assert np.rad2deg(made.si("output")) == pytest.approx(np.arange(30) / 1200.0)


def test_simulate_says_that_no_noise_is_stated(bench: Path, run: Run):
    done = run("simulate", bench / "simulation.yaml", "--like", bench / "campaign.csv", "-o", bench / "quiet.csv")
    assert "states no noise, and none is drawn" in done.err
    done = run("simulate", bench / "truth.yaml", "--like", bench / "campaign.csv", "-o", bench / "noisy.csv")
    assert not done.err


def test_fit_recovers_the_simulated_values(bench: Path, run: Run):
    out = bench / "results" / "fit"
    done = run("fit", bench / "campaign.csv", "--model", bench / "simulation.yaml", "-o", out, "--json")
    assert done.status == 0, done.err
    said = json.loads(done.out)
    assert said == json.loads((out / "fit.json").read_text(encoding="utf-8"))
    bias = next(row for row in said["parameters"] if row["effect"] == "bias")
    assert bias["unit"] == "deg/h"
    assert abs(bias["value"] - 5.0) < 5.0 * bias["std"]
    assert 0 < bias["std"] < 1.0


def test_fit_prints_a_table_and_its_paths(bench: Path, run: Run):
    done = run("fit", bench / "campaign.csv", "--model", bench / "simulation.yaml", "-o", bench / "out")
    assert done.status == 0, done.err
    for part in ("scale_factor", "count/deg", "±", "noise_white", "model.yaml", "fit.json"):
        assert part in done.out, part


def test_a_fitted_model_is_an_input_of_every_command(bench: Path, run: Run):
    fitted = bench / "out" / "model.yaml"
    campaign = bench / "campaign.csv"
    assert run("fit", campaign, "--model", bench / "simulation.yaml", "-o", bench / "out").status == 0
    assert run("simulate", fitted, "--like", campaign, "-o", bench / "again.csv").status == 0
    refit = run("fit", bench / "again.csv", "--model", fitted, "-o", bench / "refit")
    assert refit.status == 0, refit.err
    assert re.search(r"^noise_white +\S+ +stated  ", refit.out, re.MULTILINE)


@pytest.fixture
def fitted(bench: Path, run: Run) -> Path:
    """The bench with a fitted model beside its campaign."""
    done = run("fit", bench / "campaign.csv", "--model", bench / "simulation.yaml", "-o", bench / "fit")
    assert done.status == 0, done.err
    return bench


@pytest.mark.parametrize("name", ["rate.csv", "rate.csv.gz", "rate.parquet", "rate.nc", "new/rate.zarr"])
def test_compensate_recovers_the_rate(fitted: Path, run: Run, name: str):
    done = run("compensate", fitted / "fit" / "model.yaml", fitted / "campaign.csv", "-o", fitted / name, "--json")
    assert done.status == 0, done.err
    assert done.err == ""
    campaign, result = read_campaign(fitted / "campaign.csv"), read_campaign(fitted / name)
    said = json.loads(done.out)
    assert (said["rows"], said["note"], said["data_hash"]) == (360, "", result.digest())
    added = ["rate_estimated", "rate_estimated_std"]
    assert list(result.columns) == [*campaign.columns, *added]
    error = result.columns["rate_estimated"] - campaign.columns["rate"]
    std = result.columns["rate_estimated_std"]
    # 0.02 deg/√h at 20 s, and six standard deviations.
    assert std == pytest.approx(0.02 / 60 / 20**0.5, rel=0.3)
    assert abs(error / std).max() < 6
    assert 0.8 < (error / std).std() < 1.2


def test_compensate_says_what_its_user_must_know(fitted: Path, run: Run):
    model = fitted / "fit" / "model.yaml"
    lines = (fitted / "campaign.csv").read_text(encoding="utf-8").splitlines()
    head = next(i for i, line in enumerate(lines) if line.startswith("time"))
    names = lines[head].split(",")
    rows = [dict(zip(names, line.split(","), strict=True)) for line in lines[head + 1 :]]
    kept = ["time [s]", "temperature [degC]", "output [count/s]"]
    rows[0]["temperature [degC]"] = "90"
    rows[1]["output [count/s]"] = ""
    text = [*lines[:head], ",".join(kept), *(",".join(row[name] for name in kept) for row in rows)]
    (fitted / "hot.csv").write_text("\n".join(text), encoding="utf-8")
    done = run("compensate", model, fitted / "hot.csv", "-o", fitted / "out.csv")
    assert done.status == 0
    assert done.err == ("gyromodel: 1 of 359 samples lie outside the calibrated range of temperature, 20 to 50 degC.\n")
    assert "360 samples in" in done.out
    result = read_campaign(fitted / "out.csv")
    assert result.metadata["rate_estimated_note"] in done.err
    assert math.isnan(result.columns["rate_estimated"][1])
    assert math.isfinite(result.columns["rate_estimated"][0])


@pytest.mark.parametrize(
    ("model", "expected"),
    [
        (SIMULATION, "no value"),
        (TRUTH.replace("scale_factor", "bias_drift").replace("1000 count/deg", "1 deg/h/h"), "needs a scale_factor"),
        (TRUTH.replace("1000 count/deg", "1000 V/(deg/s)"), "scale_factor is in V/(deg/s)"),
        (TRUTH.replace("effect: bias\n", "effect: bias_pressure\n").replace("5 deg/h", "5 deg/h/mbar"), "no value"),
        (
            TRUTH.replace("effect: bias\n", "effect: bias_pressure\n    reference: 1 bar\n").replace(
                "5 deg/h", "5 deg/h/mbar"
            ),
            "needs a column pressure",
        ),
        (TRUTH + "fit: {}\n", "fit lacks degrees_of_freedom"),
        (TRUTH.replace("effects", "efects"), "efects"),
    ],
)
def test_compensate_refuses_what_it_cannot_apply(tmp_path: Path, run: Run, model: str, expected: str):
    (tmp_path / "campaign.csv").write_text(CAMPAIGN, encoding="utf-8")
    (tmp_path / "model.yaml").write_text(model, encoding="utf-8")
    outcome = run("compensate", tmp_path / "model.yaml", tmp_path / "campaign.csv", "-o", tmp_path / "out.csv")
    assert expected in refusal(outcome)
    assert not (tmp_path / "out.csv").exists()


def test_compensate_refuses_what_makes_a_campaign_with_a_reference_worse(tmp_path: Path, run: Run):
    """A scale factor and a lean of its own unit, and the same of a unit that errs the other way round."""
    rng, time = np.random.default_rng(5), np.arange(500) * 0.1
    rate, cross = 30.0 * np.sin(time), 30.0 * np.cos(0.7 * time)
    noise = 0.02 * rng.standard_normal(500)
    for name, sign in (("own", 1.0), ("other", -1.0)):
        columns = {"time": time, "rate_x": rate, "rate_y": cross}
        columns["output_x"] = rate * (1.0 + 0.004 * sign) + 0.003 * sign * cross + noise
        units = {"time": "s"} | dict.fromkeys(("rate_x", "rate_y", "output_x"), "deg/s")
        write_campaign(Campaign(columns, units, {"kind": "rate"}), tmp_path / f"{name}.csv")
    (tmp_path / "model.yaml").write_text(
        "effects:\n  - {effect: scale_factor, value: 1.004}\n"
        "  - {effect: misalignment, angles: [0.003 rad], about: [rate_y]}\n",
        encoding="utf-8",
    )
    given = (tmp_path / "model.yaml", "--axis", "x", "-o", tmp_path / "out.csv")
    done = run("compensate", *given, tmp_path / "own.csv", "--json")
    assert done.status == 0, done.err
    found = json.loads(done.out)["reference_error"]
    assert found["compensated"] == pytest.approx(noise.std(), rel=0.05)
    wrong = np.std(0.004 * rate + 0.003 * cross)
    assert found["as_measured"] == pytest.approx(np.hypot(wrong, noise.std()), rel=0.05)
    (tmp_path / "out.csv").unlink()
    said = refusal(run("compensate", *given, tmp_path / "other.csv"))
    assert f"makes it worse: the rms error against its reference rate is {2 * wrong:.1f}" in said
    assert not (tmp_path / "out.csv").exists()
    forced = run("compensate", *given, tmp_path / "other.csv", "--force")
    assert forced.status == 0
    assert "rms error" in forced.out


@pytest.mark.parametrize(("to", "part"), [("c", "gyromodel_rate"), ("json", '"covariance"'), ("csv", "scale_factor,")])
def test_export_prints_or_writes(fitted: Path, run: Run, to: str, part: str):
    model = fitted / "fit" / "model.yaml"
    printed = run("export", model, "--to", to)
    assert printed.status == 0, printed.err
    assert part in printed.out
    assert run("export", model, "--to", to, "-o", fitted / "new" / "file").out == ""
    assert (fitted / "new" / "file").read_text(encoding="utf-8") == printed.out
    assert run("export", model, "--to", to, "-o", model).status == 2


def test_export_lists_its_forms(run: Run):
    assert "'c', 'json', 'csv', 'px4'" in run("export", "m.yaml", "--to", "matlab").err
    assert "--to px4 --axis x" in run("export", "m.yaml", "--to", "c", "--axis", "x").err


def test_px4_parameters_are_of_axis_x_unless_told(bench: Path, run: Run):
    (bench / "flat.yaml").write_text("effects: [{effect: bias, value: 3 deg/h}]")
    plain = run("export", bench / "flat.yaml", "--to", "px4")
    assert plain.status == 0, plain.err
    assert "axis x" in plain.err
    assert plain.out == run("export", bench / "flat.yaml", "--to", "px4", "--axis", "x").out
    assert plain.out != run("export", bench / "flat.yaml", "--to", "px4", "--axis", "y").out


def test_a_platform_is_no_gyro_to_simulate(bench: Path, run: Run):
    (bench / "flat.yaml").write_text("effects: [{effect: bias, value: 3 deg/h}]")
    rows = "".join(f"{t},{t},1\n" for t in range(9))
    (bench / "gimbals.csv").write_text(f"time [s],gimbal_1 [deg],table_x [deg]\n{rows}")
    like = run("simulate", bench / "flat.yaml", "--like", bench / "gimbals.csv", "-o", bench / "out.csv")
    assert (like.status, "is of a platform" in like.err) == (1, True)
    searched = run("diagnose", bench / "gimbals.csv", "--model", bench / "flat.yaml", "-o", bench / "out")
    assert "a platform's gimbals are gimbal_y_outer" in refusal(searched)


def test_export_refuses_a_model_without_values(bench: Path, run: Run):
    assert "no value" in refusal(run("export", bench / "simulation.yaml", "--to", "c"))


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    """The demo's folder and what it printed as JSON, from another directory and another process."""
    place = tmp_path_factory.mktemp("anywhere")
    command = [sys.executable, "-m", "gyromodel", "demo", "--json"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=place)
    assert done.returncode == 0, done.stderr
    return place / "gyromodel-demo", json.loads(done.stdout)


def test_diagnose_writes_its_results(demo: tuple[Path, dict[str, Any]], tmp_path: Path, run: Run):
    folder, out = demo[0], tmp_path / "diagnosis"
    done = run("diagnose", folder / "campaign.csv", "--model", folder / "simulation.yaml", "-o", out)
    assert done.status == 0, done.err
    said = json.loads((out / "diagnosis.json").read_text(encoding="utf-8"))
    assert said["verdict"] in {"adequate", "named", "ambiguous", "unknown"}
    assert {"causes", "driver", "gain", "next_test", "minimum_detectable", "not_testable", "noise"} <= set(said)
    assert (out / said["model"]).is_file()
    assert (out / "report.html").stat().st_size > 1000
    assert any((out / "figures").iterdir())
    for name in ("report.html", "diagnosis.json", "model.yaml"):
        assert str(out / name) in done.out
    assert not [path for path in out.rglob("*") if path.name.startswith(".")]


def test_noise_is_not_read_at_speed(tmp_path: Path, run: Run):
    rows = "".join(f"{i},{60 * (i // 50 % 2)},{60 * (i // 50 % 2) + (i * 7919 % 13) / 100}\n" for i in range(400))
    (tmp_path / "moving.csv").write_text(
        f"# kind: rate\ntime [s],rate [deg/s],output [deg/s]\n{rows}", encoding="utf-8"
    )
    said = refusal(run("allan", tmp_path / "moving.csv", "-o", tmp_path / "out"))
    assert "column 'rate' changes by 60 deg/s, but noise is read at a constant rate" in said


def test_allan_writes_deviations_and_coefficients(bench: Path, run: Run):
    """Of the simulated gyro with 0.02 deg/sqrt(h), but at rest: the motion would be in the way."""
    rest = PLAN.replace(
        "rate:\n    - repeat: 6\n      segments: [{for: 10 min, at: 10 deg/s}, {for: 10 min, at: -10 deg/s}]",
        "rate: 0 deg/s",
    )
    (bench / "rest.yaml").write_text(rest, encoding="utf-8")
    made = run("simulate", bench / "truth.yaml", "--plan", bench / "rest.yaml", "-o", bench / "rest.csv")
    assert made.status == 0, made.err
    done = run("allan", bench / "rest.csv", "-o", bench / "noise")
    assert done.status == 0, done.err
    for part in ("white", "random walk", "not identifiable: below", "count/s", "allan.json", "allan.svg"):
        assert part in done.out, part
    said = json.loads((bench / "noise" / "allan.json").read_text(encoding="utf-8"))
    assert set(said["deviations"]) == {"allan", "modified", "hadamard", "total"}
    white = said["noise"]["noise_white"]
    assert white["verdict"] == "found"
    assert abs(white["value"] / (1000 * 0.02 / 60) - 1) < 0.2  # 1000 count/deg
    assert said["noise"]["noise_random_walk"]["value"] is None
    assert said["noise"]["noise_random_walk"]["bound"] > 0
    figure = (bench / "noise" / "allan.svg").read_text(encoding="utf-8")
    for part in ("Allan deviation", "averaging time", "white N", "fitted model"):
        assert part in figure, part
    assert json.loads(run("allan", bench / "rest.csv", "-o", bench / "noise", "--json").out) == said


def test_allan_refuses_what_has_no_noise(tmp_path: Path, run: Run):
    resting = "".join(f"{line.split(',')[0]},0,{i}\n" for i, line in enumerate(CAMPAIGN.splitlines()[2:]))
    still = "\n".join(CAMPAIGN.splitlines()[:2]) + "\n" + resting
    (tmp_path / "campaign.csv").write_text(still, encoding="utf-8")
    assert "at least 64" in refusal(run("allan", tmp_path / "campaign.csv", "-o", tmp_path / "out"))
    axes = CAMPAIGN.replace("output [count/s]", "output_x [count/s]")
    (tmp_path / "campaign.csv").write_text(axes, encoding="utf-8")
    assert "axis" in refusal(run("allan", tmp_path / "campaign.csv", "-o", tmp_path / "out"))
    assert "nothing.csv" in refusal(run("allan", tmp_path / "nothing.csv", "-o", tmp_path / "out"))


def test_demo_writes_its_results_beside_the_inputs(demo: tuple[Path, dict[str, Any]]):
    folder, said = demo
    for name, place in {"ring_laser": folder, "fiber_optic": folder / "fiber_optic"}.items():
        assert said[name] == json.loads((place / "diagnosis.json").read_text(encoding="utf-8"))
        for file in ("report.html", "model.yaml", "campaign.csv", "simulation.yaml"):
            assert (place / file).is_file()


def test_demo_finds_the_four_anomalous_points(demo: tuple[Path, dict[str, Any]]):
    said = demo[1]["ring_laser"]
    assert said["verdict"] == "ambiguous"
    assert [3, 5, 7, 11] in [sorted(cause["points"]) for cause in said["causes"]]
    assert said["next_test"]


def test_demo_names_the_hidden_effect_and_its_size(demo: tuple[Path, dict[str, Any]]):
    said = demo[1]["fiber_optic"]
    assert said["verdict"] == "named"
    assert [cause["effect"] for cause in said["causes"]] == ["bias_temperature_rate"]
    found = said["causes"][0]["parameters"][0]
    assert found["unit"] == "deg/h/(degC/s)"
    assert abs(found["value"] - 40.0) < 4.0 * found["std"]
    assert said["gain"]["ci95"][0] > 1.0


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (CAMPAIGN.replace("output [count/s]", "output"), "output"),
        (CAMPAIGN.replace("[count/s]", "[counts per blink]"), "output"),
        (CAMPAIGN.replace("# kind: rate\n", ""), "kind"),
        (CAMPAIGN.replace("2,-1", "0.5,-1"), "increas"),
        (CAMPAIGN.replace("1002", "many"), "many"),
        (CAMPAIGN.replace("output", "output_x"), "axis"),
        (CAMPAIGN.replace("rate [deg/s]", "speed [deg/s]"), "rate"),
        (CAMPAIGN.replace("time [s]", "clock [s]"), "time"),
        ("", "campaign.csv"),
        ("\x00\xff", "campaign.csv"),
    ],
)
def test_bad_data_ends_with_status_1_and_a_sentence(tmp_path: Path, run: Run, text: str, expected: str):
    (tmp_path / "campaign.csv").write_text(text, encoding="latin-1")
    (tmp_path / "model.yaml").write_text(SIMULATION, encoding="utf-8")
    outcome = run("fit", tmp_path / "campaign.csv", "--model", tmp_path / "model.yaml", "-o", tmp_path / "out")
    assert expected in refusal(outcome)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", "empty"),
        ("effects: [", "line 1"),
        ("effects:\n  - effect: bias_temprature_of_what\n    values: 3", "line"),
        (SIMULATION.replace("bias", "bias_temperature"), "temperature"),
        (SIMULATION.replace("effects", "efects"), "efects"),
        (SIMULATION + "  - effect: bias\n", "line"),
        (SIMULATION.replace("auto", "loud"), "noise"),
    ],
)
def test_a_bad_model_ends_with_status_1_and_a_sentence(tmp_path: Path, run: Run, text: str, expected: str):
    (tmp_path / "campaign.csv").write_text(CAMPAIGN, encoding="utf-8")
    (tmp_path / "model.yaml").write_text(text, encoding="utf-8")
    outcome = run("diagnose", tmp_path / "campaign.csv", "--model", tmp_path / "model.yaml", "-o", tmp_path / "out")
    assert expected in refusal(outcome)


@pytest.mark.parametrize("command", ["fit", "diagnose"])
def test_missing_files_are_named(tmp_path: Path, run: Run, command: str):
    (tmp_path / "model.yaml").write_text(SIMULATION, encoding="utf-8")
    no_data = run(command, tmp_path / "nothing.csv", "--model", tmp_path / "model.yaml", "-o", tmp_path / "out")
    assert "nothing.csv" in refusal(no_data)
    (tmp_path / "campaign.csv").write_text(CAMPAIGN, encoding="utf-8")
    no_model = run(command, tmp_path / "campaign.csv", "--model", tmp_path / "nothing.yaml", "-o", tmp_path / "out")
    assert "nothing.yaml" in refusal(no_model)


def test_an_output_folder_that_is_a_file_is_refused_before_the_work(bench: Path, run: Run):
    (bench / "taken").write_text("", encoding="utf-8")
    outcome = run("fit", bench / "nothing.csv", "--model", bench / "simulation.yaml", "-o", bench / "taken")
    assert "taken: no folder for the output can be made there (file exists)" in refusal(outcome)


def test_inputs_are_never_overwritten(bench: Path, run: Run):
    (bench / "model.yaml").write_text(SIMULATION, encoding="utf-8")
    campaign, truth = bench / "campaign.csv", bench / "truth.yaml"
    before = campaign.read_bytes()
    assert run("fit", campaign, "--model", bench / "model.yaml", "-o", bench).status == 2
    assert run("diagnose", campaign, "--model", bench / "model.yaml", "-o", bench).status == 2
    assert run("simulate", truth, "--like", campaign, "-o", campaign).status == 2
    assert run("compensate", truth, campaign, "-o", campaign).status == 2
    assert (bench / "model.yaml").read_text(encoding="utf-8") == SIMULATION
    assert campaign.read_bytes() == before


def test_what_nobody_foresaw_is_one_sentence_too(bench: Path, run: Run, monkeypatch: pytest.MonkeyPatch):
    def broken(path: Path) -> None:
        raise RuntimeError("broken\nin two lines")

    monkeypatch.setattr("gyromodel.files.read_campaign", broken)
    arguments = ("fit", bench / "campaign.csv", "--model", bench / "simulation.yaml", "-o", bench / "out")
    outcome = run(*arguments)
    assert outcome.status == 1
    assert outcome.err.count("\n") == 1
    assert "internal error (RuntimeError: broken in two lines); please report" in outcome.err
    monkeypatch.setenv("GYROMODEL_DEBUG", "1")
    with pytest.raises(RuntimeError, match="broken"):
        cli.main([str(argument) for argument in arguments])


def test_compiled_code_is_kept_where_that_is_possible(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def kept(home: Path) -> str | None:
        monkeypatch.setenv("XDG_CACHE_HOME", str(home))
        monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR", raising=False)
        _compiling.keep_compiled()
        return os.environ.get("JAX_COMPILATION_CACHE_DIR")

    monkeypatch.setenv("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
    found = Path(kept(tmp_path) or "")
    assert found.is_dir()
    assert tmp_path in found.parents
    (tmp_path / "file").write_text("")
    assert kept(tmp_path / "file") is None
    # What the user has set stays.
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", "mine")
    _compiling.keep_compiled()
    assert os.environ["JAX_COMPILATION_CACHE_DIR"] == "mine"


def test_the_compiler_gets_switches_that_it_knows_only(monkeypatch: pytest.MonkeyPatch):
    def switches(jaxlib: str) -> str | None:
        monkeypatch.setattr(_compiling, "version", lambda name: {"jaxlib": jaxlib}[name])
        monkeypatch.delenv("XLA_FLAGS", raising=False)
        _compiling.switch_compiler()
        return os.environ.get("XLA_FLAGS")

    assert (switches("0.10.2") or "").startswith("--xla_cpu_use_fusion_emitters=false ")
    assert switches("0.10.3") is switches("0.11.0") is None
    monkeypatch.setenv("XLA_FLAGS", "mine")
    _compiling.switch_compiler()
    assert os.environ["XLA_FLAGS"] == "mine"


def test_json_has_null_where_there_is_no_number():
    assert json.loads(_console.json_text({"a": float("nan"), "b": [float("inf"), 1.5], 3: ("x", None)})) == {
        "a": None,
        "b": [None, 1.5],
        "3": ["x", None],
    }
