"""How long a diagnosis of a long campaign takes, where the time goes, and how long commands take to start.

    python -m benchmarks.diagnose_speed

writes benchmarks/results/diagnose_speed.md. Every figure comes from fresh processes; `--rows 2000` is a quick look.
"""

from __future__ import annotations

import argparse
import cProfile
import json
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks._measure import MIB, in_fresh_process, peak_memory, table, timed, write_result

MODULE = "benchmarks.diagnose_speed"
DRAWS = 2000
HOURS = 5.0
FLOOR = "one plain least-squares F scan of the same columns, numpy"
# Stages of the work: the function that does each, by file and name.
STAGES = (
    ("fits (`fit_record`)", "_fit.py", "fit_record"),
    ("of which the noise search (`best_ratios`)", "_noise.py", "best_ratios"),
    ("bank of candidates (`build_bank`)", "_bank.py", "build_bank"),
    ("ranking (`rank`)", "_ranking.py", "rank"),
    ("of which noise cells (`Scanner.run`)", "_scan.py", "run"),
    ("rounds of the search (`search`)", "_search.py", "search"),
    ("held-out error of each round (`ladder_error`)", "_gain.py", "ladder_error"),
    ("nested held-out folds (`nested_gain`)", "_gain.py", "nested_gain"),
    ("judgement (`judge`)", "_verdict.py", "judge"),
)
STARTS = {
    "`python -c pass`": ["-c", "pass"],
    "`import jax`": ["-c", "import jax"],
    "`import gyromodel`": ["-c", "import gyromodel"],
    "`from gyromodel import diagnose`": ["-c", "from gyromodel import diagnose"],
    "`gyromodel --help`": ["-m", "gyromodel", "--help"],
    "`gyromodel effects`": ["-m", "gyromodel", "effects"],
}


def table_log(rows: int, seed: int = 5) -> Any:
    """Five hours on a rate table, temperature up and down twice, two other channels, a Shupe bias nobody modelled."""
    from gyromodel import Campaign

    rng = np.random.default_rng(seed)
    t = np.linspace(0.0, 3600.0 * HOURS, rows, endpoint=False)
    step = t[1]
    phase = t / (1800.0 * HOURS) % 1.0
    chamber = 20.0 + 40.0 * np.interp(phase, [0.0, 0.1, 0.4, 0.6, 0.9, 1.0], [0.0, 0.0, 1.0, 1.0, 0.0, 0.0])
    temperature = _lagged(chamber, 600.0 / step)
    shupe = 40.0 * np.gradient(temperature, step)
    white = 0.01 * 60.0 / np.sqrt(step) * rng.standard_normal(rows)
    walk = np.cumsum(rng.standard_normal(rows)) * 0.01 * np.sqrt(step / 3600.0)
    # A new rate every five minutes, in random order.
    levels = rng.permutation(np.linspace(-100.0, 100.0, round(12 * HOURS)))
    rate = np.repeat(levels, -(-rows // len(levels)))[:rows]
    wander = {name: _lagged(rng.standard_normal(rows), 900.0 / step) for name in ("supply_voltage", "pressure")}
    columns = {
        "time": t,
        "rate": rate,
        "temperature": temperature + 2e-3 * rng.standard_normal(rows),
        "supply_voltage": 5.0 + 0.03 * wander["supply_voltage"] / wander["supply_voltage"].std(),
        "pressure": 1.01e5 + 300.0 * wander["pressure"] / wander["pressure"].std(),
        "output": rate * (1.0 + 5e-5) + (3.0 + shupe + white + walk) / 3600.0,
    }
    units = {
        "time": "s",
        "rate": "deg/s",
        "temperature": "degC",
        "supply_voltage": "V",
        "pressure": "Pa",
        "output": "deg/s",
    }
    return Campaign(columns, units, {"gyro": "fog", "kind": "rate"}, "table log")


def _lagged(values: np.ndarray, samples: float) -> np.ndarray:
    from scipy.signal import lfilter

    a = np.exp(-1.0 / samples)
    return np.asarray(lfilter([1 - a], [1.0, -a], values, zi=[a * values[0]])[0])


def _scan_by_least_squares(campaign: Any) -> tuple[dict[str, float], int, int]:
    """The floor: F of every block of the same columns beside bias and scale, white noise assumed, in numpy."""
    from gyromodel.diagnosis._bank import build_bank
    from gyromodel.signals import read_signals

    record = read_signals(campaign)
    bank = build_bank(record)
    y = np.asarray(record.signals["output"])[: record.rows]
    columns = bank.columns[: record.rows]
    rate = np.asarray(record.signals["rate"])[: record.rows]
    base = np.linalg.qr(np.column_stack([np.ones_like(rate), rate]))[0]

    def scan() -> list[float]:
        residual = y - base @ (base.T @ y)
        rss = residual @ residual
        found = []
        for block in bank.blocks:
            c = columns[:, block.start : block.start + block.width]
            c = c - base @ (base.T @ c)
            gram, inner = c.T @ c, c.T @ residual
            explained = inner @ np.linalg.lstsq(gram, inner, rcond=1e-12)[0]
            found.append(explained / block.width / ((rss - explained) / (len(y) - 1 - block.width)))
        return found

    scan()
    return timed(scan)[1], len(bank.blocks), columns.shape[1]


def _stages(profile: cProfile.Profile) -> tuple[list[tuple[str, int, float]], list[tuple[str, int, float]]]:
    """Calls and seconds of the stages, and of what `diagnose` itself calls (which adds up to the whole)."""
    profile.create_stats()
    stats: dict[tuple[str, int, str], tuple[int, int, float, float, dict]] = profile.stats  # type: ignore[attr-defined]
    stages = []
    for title, file, name in STAGES:
        here = [v for (path, _, function), v in stats.items() if Path(path).name == file and function == name]
        stages.append((title, sum(v[1] for v in here), sum(v[3] for v in here)))
    parts = []
    for (path, _, function), (*_, callers) in stats.items():
        of = [v for (p, _, f), v in callers.items() if Path(p).name == "_diagnose.py" and f == "diagnose"]
        parts += [(f"`{Path(path).stem}.{function}`", v[1], v[3]) for v in of]
    return stages, sorted(parts, key=lambda part: -part[2])[:8]


def _measure(rows: int, profiled: bool) -> dict[str, Any]:
    """Two diagnoses in this process; the second under the profiler if asked."""
    import gyromodel

    campaign = table_log(rows)
    model = gyromodel.model_from_effects(["scale_factor", "bias"], gyro="fog")
    before = peak_memory()
    profile = cProfile.Profile()

    def again() -> Any:
        return profile.runcall(gyromodel.diagnose, campaign, model) if profiled else gyromodel.diagnose(campaign, model)

    diagnosis, first = timed(lambda: gyromodel.diagnose(campaign, model))
    _, second = timed(again)
    found = {
        "first": first,
        "second": second,
        "before": before,
        "peak": peak_memory(),
        "verdict": diagnosis.verdict,
        "causes": [c.effect for c in diagnosis.causes],
        "candidates": len(diagnosis.searched),
        "folds": diagnosis.gain.folds,
    }
    if not profiled:
        for name in ("calibrated", "recalled"):
            found[name] = timed(lambda: gyromodel.diagnose(campaign, model, calibrate=DRAWS))[1]
    if profiled:
        found["stages"], found["parts"] = _stages(profile)
        found["floor"], found["blocks"], found["columns"] = _scan_by_least_squares(campaign)
    return found


def _starts(repeats: int) -> list[list[str]]:
    """Best wall time of starting each command."""
    rows = []
    for title, arguments in STARTS.items():
        best = np.inf
        for _ in range(repeats):
            begun = time.perf_counter()
            subprocess.run([sys.executable, *arguments], stdout=subprocess.DEVNULL, check=True)
            best = min(best, time.perf_counter() - begun)
        rows.append([title, f"{best:.2f}"])
    return rows


def _imports(statement: str, most: int) -> list[list[str]]:
    """Packages whose own modules take longest to import, by `-X importtime`."""
    done = subprocess.run(
        [sys.executable, "-X", "importtime", "-c", statement], stderr=subprocess.PIPE, text=True, check=True
    )
    spent: dict[str, float] = {}
    for own, name in re.findall(r"import time:\s+(\d+) \|\s+\d+ \|\s+([\w.]+)", done.stderr):
        package = name.split(".")[0]
        spent[package] = spent.get(package, 0.0) + int(own) / 1e6
    return [[name, f"{s:.2f}"] for name, s in sorted(spent.items(), key=lambda item: -item[1])[:most]]


def main(argv: list[str] | None = None) -> None:
    argv = sys.argv[1:] if argv is None else argv
    parser = argparse.ArgumentParser(description="Time and memory of a diagnosis, and of starting commands.")
    parser.add_argument("--rows", type=int, default=18_000)
    parser.add_argument("--starts", type=int, default=5, help="times each command is started")
    parser.add_argument("--only", choices=("plain", "profiled"), help=argparse.SUPPRESS)
    args = parser.parse_args(argv)
    if args.only:
        print(json.dumps(_measure(args.rows, args.only == "profiled")))
        return
    with tempfile.TemporaryDirectory() as cache:
        keep = {
            "XDG_CACHE_HOME": cache,
            "JAX_COMPILATION_CACHE_DIR": cache,
            "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        }
        plain = in_fresh_process(MODULE, "--rows", str(args.rows), "--only", "plain", **keep)
        profiled = in_fresh_process(MODULE, "--rows", str(args.rows), "--only", "profiled", **keep)
    floor = profiled["floor"]

    def line(title: str, spent: dict[str, float]) -> list[str]:
        return [title, f"{spent['wall']:.1f}", f"{spent['cpu']:.1f}", f"{spent['wall'] / floor['wall']:.0f}"]

    total = profiled["second"]["wall"]

    def share(part: tuple[str, int, float]) -> list[str]:
        return [part[0], str(part[1]), f"{part[2]:.1f}", f"{100 * part[2] / total:.0f} %"]

    head = ["", "calls", "s", "share"]
    lines = [
        f"{args.rows:,} samples on a rate table ({HOURS:g} h, temperature up and down twice, supply voltage and "
        f"pressure recorded), a Shupe bias hidden, a model of scale factor and bias: {plain['candidates']} candidates "
        f"({profiled['blocks']} forms, {profiled['columns']} columns, besides steps and outliers at every epoch and "
        f"lines at every frequency), {plain['folds']} held-out blocks. The answer: {plain['verdict']}, "
        f"{', '.join(plain['causes']) or 'nothing'}.",
        "",
        *table(
            ["`diagnose`", "s", "processor s", "times the scan below"],
            [
                line("new process, nothing compiled before", plain["first"]),
                line("new process, compilation cache filled", profiled["first"]),
                line("second call in the process", plain["second"]),
                line(f"then with `--calibrate {DRAWS}`, new design", plain["calibrated"]),
                line("the same again, draws kept", plain["recalled"]),
                [FLOOR, f"{floor['wall']:.3f}", f"{floor['cpu']:.3f}", "1"],
            ],
        ),
        "",
        f"Peak memory {plain['peak'] / MIB:.0f} MiB, of which {plain['before'] / MIB:.0f} MiB before the first call.",
        "",
        "## Where the time of a second call goes",
        "",
        f"Under the profiler ({total:.1f} s). Stages contain one another: folds hold fits and searches of their own.",
        "",
        *table(head, [share(s) for s in profiled["stages"] if s[1]]),
        "",
        "What `diagnose` itself calls:",
        "",
        *table(head, [share(s) for s in profiled["parts"]]),
        "",
        "## Starting",
        "",
        *table(["", "s"], _starts(args.starts)),
        "",
        "Seconds of importing by package, for `from gyromodel import diagnose` under `-X importtime`, which slows it:",
        "",
        *table(["package", "s"], _imports("from gyromodel import diagnose", 8)),
    ]
    write_result("diagnose_speed", "Speed of a diagnosis", "diagnose_speed", argv, lines)


if __name__ == "__main__":
    main()
