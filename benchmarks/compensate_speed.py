"""How long a calibration takes to apply to a million samples, in Python and as exported C.

    python -m benchmarks.compensate_speed

writes benchmarks/results/compensate_speed.md. Each model has a fresh process; `--rows 10000` is a quick look.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from benchmarks._measure import MIB, in_fresh_process, peak_memory, table, timed, write_result

REPEATS = 5
THERMAL = ["scale_factor", "bias", "bias_temperature", "bias_temperature_rate"]
MODELS = {
    "scale factor, bias, bias over temperature and its rate": THERMAL,
    "the same, Sagnac sine, scale over temperature, asymmetry, six-knot spline": [
        *THERMAL, "scale_sagnac_sine", "scale_temperature", "scale_asymmetry", "scale_spline",
    ],
}  # fmt: skip
# Values in internal units, by effect and field.
VALUES = {
    "scale_factor.value": 6e4, "bias.value": 1e-4, "bias_temperature.coefficient": 1e-6,
    "bias_temperature.reference": 25.0, "bias_temperature_rate.coefficient": 1e-4, "scale_sagnac_sine.kappa": 0.6,
    "scale_temperature.coefficient": 1e-5, "scale_temperature.reference": 25.0, "scale_asymmetry.difference": 1e-3,
    "scale_spline.coefficients": 1e-4 * np.array([1.0, -2.0, 1.0, 0.5]), "scale_spline.full_rate": 1.7,
    "scale_spline.lowest": -1.7,
}  # fmt: skip
PROGRAM = """\
#include "gyromodel_compensate.h"
#include <stdio.h>
#include <time.h>
int main(void)
{
    gyromodel_sample s = {0};
    const int rows = 1000000;
    double sum = 0.0;
    const clock_t start = clock();
    for (int i = 0; i < rows; i++) {
        s.output_count_per_s = 1e5 * (2.0 * i / rows - 1.0);
        sum += gyromodel_rate(&s);
    }
    printf("%g %g\\n", (double)(clock() - start) / CLOCKS_PER_SEC / rows * 1e9, sum);
    return 0;
}
"""


def measured(labels: list[str], rows: int) -> dict[str, float]:
    """Seconds of the first and of the best later call, peak memory, and nanoseconds a sample in C."""
    from dataclasses import fields, replace

    from gyromodel import Calibration, Campaign, GyroModel, compensate, export_calibration, model_from_effects

    effects = []
    for effect in model_from_effects(labels).effects:
        known = {f.name: VALUES[f"{effect.id}.{f.name}"] for f in fields(effect) if f"{effect.id}.{f.name}" in VALUES}
        effects.append(replace(effect, **known, **({"unit": "count/rad"} if effect.id == "scale_factor" else {})))
    model = GyroModel(tuple(effects), {"noise_white": 1e-5})
    calibration = Calibration(model, 1e-14 * np.eye(len(model.slots())))
    time = np.arange(rows) * 0.01
    columns = {"time": time, "temperature": 25 + 10 * np.sin(time / 3000), "output": 1e5 * np.sin(time / 100)}
    campaign = Campaign(columns, {"time": "s", "temperature": "degC", "output": "count/s"}, {"kind": "rate"})
    before = peak_memory()
    seconds = [timed(lambda: compensate(campaign, calibration))[1]["wall"] for _ in range(REPEATS + 1)]
    found = {"first": seconds[0], "later": min(seconds[1:]), "memory": (peak_memory() - before) / MIB}
    compiler = shutil.which("cc")
    if compiler:
        with tempfile.TemporaryDirectory() as folder:
            header = Path(folder, "gyromodel_compensate.h")
            header.write_text(export_calibration(calibration, "c"), encoding="utf-8")
            header.with_name("main.c").write_text(PROGRAM, encoding="utf-8")
            subprocess.run([compiler, "-std=c99", "-O2", "-o", "main", "main.c", "-lm"], cwd=folder, check=True)
            runs = [subprocess.run(["./main"], cwd=folder, capture_output=True, check=True).stdout for _ in range(3)]
            found["c"] = min(float(run.split()[0]) for run in runs)
    return found


def main() -> None:
    """Measure and write the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rows", type=int, default=1_000_000)
    parser.add_argument("--model", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.model:
        print(json.dumps(measured(MODELS[options.model], options.rows)))
        return
    head = ["model", "first call, s", "later calls, s", "peak memory added, MiB", "exported C, ns a sample"]
    rows = []
    for name in MODELS:
        found = in_fresh_process("benchmarks.compensate_speed", "--model", name, "--rows", str(options.rows))
        speed = f"{found['c']:.0f}" if "c" in found else "no compiler"
        rows.append([name, f"{found['first']:.1f}", f"{found['later']:.2f}", f"{found['memory']:.0f}", speed])
    note = (
        f"`compensate` on {options.rows:,} samples in memory, uncertainties included; the first call compiles. Best of "
        f"{REPEATS} later calls; C with -O2."
    )
    lines = [note, "", *table(head, rows)]
    write_result("compensate_speed", "Speed of compensation", "compensate_speed", sys.argv[1:], lines)


if __name__ == "__main__":
    main()
