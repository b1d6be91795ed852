"""The cases of docs/cases: the commands of the tool on measured campaigns, as an engineer would run them.

    python -m benchmarks.cases [NAME …]

writes benchmarks/results/cases.md, or with names only those parts of it to the screen. The data are read from the
folder that GYROMODEL_DATA names, or ../shared/data; they are not part of the project.
"""

from __future__ import annotations

import argparse
import json
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

import gyromodel
from benchmarks._measure import DATA, ROOT, table, timed, write_result
from gyromodel.estimate import fit_record
from gyromodel.model_files import read_model
from gyromodel.poses import static_poses
from gyromodel.signals import Record, read_signals

# Nominal, from the publication of the data: gyro 4770 count per rad/s, accelerometer 416 count per m/s².
COUNTS = "4770 count*s/rad"
GRAVITY = 416.0 * 9.81  # count
AXES = "xyz"
BIAS = "gyro: mems\neffects:\n  - effect: bias\n"
KNOWN_SCALE = f"{BIAS}  - {{effect: scale_factor, value: {COUNTS}, fixed: true}}\n"


def command(*arguments: str | Path) -> tuple[dict[str, Any], float, str]:
    """What a command prints with --json, how long it took (s), and its sentence where it refuses."""
    call = [sys.executable, "-m", "gyromodel", *map(str, arguments), "--json"]
    done, spent = timed(lambda: subprocess.run(call, cwd=ROOT, capture_output=True, text=True, check=False))
    if done.returncode not in (0, 1):
        raise SystemExit(done.stderr)
    return json.loads(done.stdout or "{}"), spent["wall"], done.stderr.strip()


def diagnosed(campaign: Path, model: str, axis: str, folder: Path) -> tuple[dict[str, Any], float]:
    """A diagnosis of one axis, its results in `folder`."""
    folder.mkdir(parents=True)
    (folder / "simulation.yaml").write_text(model)
    arguments = ("--model", folder / "simulation.yaml", "--axis", axis, "-o", folder)
    result, seconds, refusal = command("diagnose", campaign, *arguments)
    if not result:
        raise SystemExit(refusal)
    return result, seconds


def causes(result: dict[str, Any]) -> str:
    """The verdict and its causes with ln B."""
    named = ", ".join(f"{c['effect']} ({c['statistic']:.0f})" for c in result["causes"])
    return f"{result['verdict']}{': ' if named else ''}{named}"


def mems_multiposition_a(folder: Path) -> list[str]:
    """Raw counts of 38 poses: what gravity adds."""
    path = DATA / "mems_multiposition_a/campaign.csv.gz"
    rows = []
    for axis in AXES:
        result, seconds = diagnosed(path, KNOWN_SCALE, axis, folder / axis)
        gain = result["gain"]
        sizes = [
            f"{c['effect'][-1]}: {c['parameters'][0]['value'] * GRAVITY / 3600:+.3f} ± "
            f"{c['parameters'][0]['std'] * GRAVITY / 3600:.3f}"
            for c in result["causes"]
        ]
        one = [_pose_left_out(path, axis, folder / axis / name) for name in ("simulation.yaml", "model.yaml")]
        rows.append([
            axis, causes(result), "; ".join(sizes), f"{gain['before']:.4f} → {gain['after']:.4f}",
            f"{one[0]:.4f} → {one[1]:.4f}", f"{seconds:.0f}",
        ])  # fmt: skip
    head = ["axis", "verdict (ln B)", "deg/s at 1 g along", "held out, search repeated, deg/s",
            "one pose left out, deg/s", "s"]  # fmt: skip
    return table(head, rows)


def _pose_left_out(path: Path, axis: str, model: Path) -> float:
    """Rms error (deg/s) of the mean of each pose, by a model fitted to the means of the others, all poses alike."""
    posed = static_poses(gyromodel.read_campaign(path).axis(axis))
    number = posed.columns["position"]
    means = {n: np.array([v[number == k].mean() for k in np.unique(number)]) for n, v in posed.columns.items()}
    record = read_signals(gyromodel.Campaign(means, posed.units, posed.metadata))
    start, errors = read_model(model), []
    for k in range(record.rows):
        fitted = fit_record(record.without(np.array([k])), start, ordinary=True).model
        predicted = np.asarray(fitted.predict(record.signals))[k]
        errors.append((means["output"][k] - predicted) / float(fitted.gain()))
    return float(np.rad2deg(np.sqrt(np.mean(np.square(errors)))))


def mems_multiposition_b(folder: Path) -> list[str]:
    """Three units compensated at the factory: nothing of that kind."""
    rows = []
    for unit in ("unit1", "unit2", "unit3"):
        for axis in AXES:
            path = DATA / f"mems_multiposition_b/{unit}.csv.gz"
            result, seconds = diagnosed(path, BIAS, axis, folder / unit / axis)
            shown = [result["minimum_detectable"][f"bias_acceleration_{other}"] for other in AXES]
            least = [s["size"] / 3600 * 9.81 for s in shown]
            poses = next(f for f in result["findings"] if "static poses" in f).split()[0]
            rows.append([
                unit, axis, poses, causes(result), f"{np.rad2deg(result['gain']['after']):.4f}",
                " / ".join(f"{x:.3f}" for x in least), f"{seconds:.0f}",
            ])  # fmt: skip
    head = ["unit", "axis", "poses", "verdict", "one of ten groups left out, deg/s",
            "least that would have been seen along x / y / z, deg/s/g", "s"]  # fmt: skip
    return table(head, rows)


def mems_attitude(folder: Path) -> list[str]:
    """Scale factor and lean of one axis from optical attitude, each fit offered to every session."""
    sessions = {
        "01": "01_undisturbed_slow_rotation_A",
        "06": "06_undisturbed_fast_rotation_A",
        "TStick 02": "TStick_Test02_Trial1",
        "TStick 04": "TStick_Test04_Trial2",
    }
    folder.mkdir(parents=True)
    model = folder / "simulation.yaml"
    model.write_text(f"{BIAS}  - effect: scale_factor\n  - effect: misalignment\n")
    fits, offered = [], []
    for label, name in sessions.items():
        path = DATA / f"mems_attitude/{name}.csv.gz"
        result, _, refusal = command("fit", path, "--model", model, "--axis", "x", "-o", folder / label)
        if not result:
            raise SystemExit(refusal)
        values = [p for p in result["parameters"] if p["effect"] != "bias"]
        fits.append([label, *(f"{p['value']:.4g} ± {p['std']:.2g}" for p in values)])
    for label in sessions:
        row = [label]
        for name in sessions.values():
            arguments = (folder / label / "model.yaml", DATA / f"mems_attitude/{name}.csv.gz", "--axis", "x")
            result, _, refusal = command("compensate", *arguments, "-o", folder / "out.csv")
            if result:
                error = result["reference_error"]
                row.append(f"{error['as_measured']:.3f} → {error['compensated']:.3f}")
            else:
                after, before = re.findall(r"(?:rate is|and) ([0-9.]+)", refusal)
                row.append(f"refused: {before} → {after}")
        offered.append(row)
    head = ["session", "scale factor", "lean to y, arcsec", "lean to z, arcsec"]
    title = "A row's calibration offered to each session: rms error against the attitude's rate, axis x, deg/s."
    return [*table(head, fits), "", title, "", *table(["fitted on", *sessions], offered)]


def rlg_static(folder: Path) -> list[str]:
    """A dithered ring laser at rest: steps of the output, and noise that is of no usual kind."""
    rows, path = [], DATA / "rlg_static/campaign.csv.gz"
    for axis in AXES:
        found, seconds, refusal = command("allan", path, "--axis", axis, "-o", folder / axis)
        if not found:
            raise SystemExit(refusal)
        lines = sorted(found["lines"], key=lambda line: -line["amplitude"])[:3]
        rows.append([
            axis, f"{found['quantum'] * 2**13:.6f}", found["noise"]["noise_quantisation"]["verdict"],
            found["noise"]["noise_random_walk"]["verdict"], ", ".join(f"{x['frequency_hz']:.3f}" for x in lines),
            str(len(found["misfits"])), f"{seconds:.0f}",
        ])  # fmt: skip
    head = ["axis", "step, 2⁻¹³ deg/s", "quantisation noise", "random walk", "strongest lines, Hz",
            "bands that contradict", "s"]  # fmt: skip
    # Without blocks left out, which take six times as long.
    model, start = gyromodel.model_from_effects(["bias"], gyro="rlg"), time.perf_counter()
    found = gyromodel.diagnose(gyromodel.read_campaign(path).axis("x"), model, hold_out=False)
    named = ", ".join(f"{c.effect} ({c.statistic:.0f})" for c in found.causes) or "–"
    follows = f", follows {found.driver.column}" if found.driver else ""
    spent = time.perf_counter() - start
    said = f"`diagnose` of x beside a bias, {spent:.0f} s: {found.verdict}{follows}; causes: {named}."
    return [*table(head, rows), "", said, "", *(f"- {line}" for line in found.findings)]


def fog_closed_loop_ramp(folder: Path) -> list[str]:
    """The error of a feedback ramp's codes, fitted on 100 s and judged on the 80 s that follow; and the mains."""
    folder.mkdir(parents=True)
    whole = gyromodel.read_campaign(DATA / "fog_closed_loop_ramp/campaign.csv.gz")
    first = np.arange(len(whole)) < len(whole) * 5 // 9
    gyromodel.write_campaign(whole.select(first), folder / "first.csv")
    (folder / "simulation.yaml").write_text("gyro: fog\neffects:\n  - effect: bias\n")
    arguments = ("--model", folder / "simulation.yaml", "-o", folder)
    result, seconds, refusal = command("diagnose", folder / "first.csv", *arguments)
    if not result:
        raise SystemExit(refusal)
    later, extended = read_signals(whole.select(~first)), read_model(folder / "model.yaml")

    def left(record: Record, *names: str) -> np.ndarray:
        """What the effects of some names leave, rad/s."""
        model = gyromodel.GyroModel(tuple(e for e in extended.effects if e.label in names))
        return np.asarray(record.signals["output"] - model.predict(record.signals))[: record.rows][record.present]

    everything = read_signals(whole)
    mains = _with_double_mains(left(everything, "bias", "bias_readout_code"), whole.columns["time"], first)
    steps = (
        ("bias alone", left(later, "bias")),
        ("and the codes' error", left(later, "bias", "bias_readout_code")),
        ("and all that was named", left(later, *extended.labels)),
        ("bias, the codes' error and twice the mains, whose phase is read from the line at 50 Hz in these 80 s", mains),
    )
    rows = [[label, f"{1e9 * rest.std():.0f}"] for label, rest in steps]
    said, gain = f"`diagnose`: {causes(result)}; {seconds:.0f} s.", result["gain"]
    said += f" Held out, the search repeated: {gain['before']:.0f} → {gain['after']:.0f} {gain['unit']}."
    code = next((c for c in result["causes"] if c["effect"] == "bias_readout_code"), None)
    period = next((p for p in code["parameters"] if p["name"] == "period"), None) if code else None
    if period:
        said += f" Period of the codes' error: {period['value']:.5g}."
    splits = [row for fitted in (40, 60, 80, 100) for row in _split(whole, fitted)]
    return [
        said, "", *table(["model, fitted on the first 100 s", "std on the 80 s after, nrad/s"], rows), "",
        "The level of the record changes with time; `diagnose` of parts of it, and what follows each:", "",
        *table(["diagnosed: the first", "judged: the", "bias alone, nrad/s", "codes' error", "all named"], splits),
    ]  # fmt: skip


def _split(whole: gyromodel.Campaign, fitted: int) -> list[list[str]]:
    """What a bias, the codes' error and all that `diagnose` names on the first seconds leave of those after, nrad/s.

    Without blocks left out, which take ten times as long.
    """
    time = whole.columns["time"] - whole.columns["time"][0]
    bias = gyromodel.model_from_effects(["bias"], gyro="fog")
    named, rows = gyromodel.diagnose(whole.select(time < fitted), bias, hold_out=False).extended.model, []
    codes = gyromodel.GyroModel(tuple(e for e in named.effects if e.label in ("bias", "bias_readout_code")))
    for judged in (40, 80):
        after = read_signals(whole.select((time >= fitted) & (time < fitted + judged)))
        output = after.signals["output"]
        left = (output, *(output - model.predict(after.signals) for model in (codes, named)))
        std = (f"{1e9 * np.asarray(values)[: after.rows][after.present].std():.0f}" for values in left)
        rows.append([f"{fitted} s", f"{judged} s after", *std])
    return rows


def _with_double_mains(rest: np.ndarray, time: np.ndarray, first: np.ndarray) -> np.ndarray:
    """What is left after the first part once what goes with twice the phase of the 50 Hz line is taken out.

    Amplitude and phase against that line are fitted on the first part; the line's own phase wanders and is followed.
    """
    window = np.hanning(int(12.0 / np.median(np.diff(time))))
    line = np.convolve(rest * np.exp(-2j * np.pi * 50.0 * time), window, "same")
    double = np.exp(2j * (np.angle(line) + 2 * np.pi * 50.0 * time))
    columns = np.column_stack([double.real, double.imag])
    return (rest - columns @ np.linalg.lstsq(columns[first], rest[first], rcond=None)[0])[~first]


CASES: dict[str, Callable[[Path], list[str]]] = {
    "mems_multiposition_a": mems_multiposition_a,
    "mems_multiposition_b": mems_multiposition_b,
    "mems_attitude": mems_attitude,
    "rlg_static": rlg_static,
    "fog_closed_loop_ramp": fog_closed_loop_ramp,
}


def main(argv: Sequence[str] | None = None) -> None:
    """Run all cases, or those named."""
    parser = argparse.ArgumentParser(description="The cases of docs/cases on measured campaigns.")
    parser.add_argument("names", nargs="*", choices=[*CASES, []], metavar="NAME")
    names = parser.parse_args(argv).names
    if absent := [name for name in names or CASES if not (DATA / name).exists()]:
        print(f"{', '.join(absent)}: not found in {DATA}; GYROMODEL_DATA names the folder of the measured data")
        return
    lines = []
    with tempfile.TemporaryDirectory() as folder:
        for name in names or CASES:
            lines += [f"## [{name}](../../docs/cases/{name}.md)", "", *CASES[name](Path(folder, name)), ""]
    if names:
        print("\n".join(lines))
    else:
        write_result("cases", "Measured campaigns", "cases", [], lines)


if __name__ == "__main__":
    main()
