"""What an archive costs: campaigns a second and memory as it grows, and what is lost to keeping the table safe.

    python -m benchmarks.archive

writes benchmarks/results/archive.md. Each archive is fitted by the `batch` command's own function in a fresh process
that has compiled before; `--campaigns 100 --samples 500` is a quick look.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks._measure import MIB, in_fresh_process, peak_memory, table, timed, write_result

EFFECTS = ["bias", "bias_temperature", "bias_temperature_rate"]
# Of the campaigns' noise, internal units: 0.05 deg/h in samples of 10 s.
STATED = {"noise_white": np.deg2rad(0.05 / 3600) * np.sqrt(10.0)}
# So many campaigns compile whatever there is to compile.
WARM = 4


def make(folder: Path, campaigns: int, samples: int) -> None:
    """Parquet campaigns of seven units, up to a tenth shorter than the longest."""
    from gyromodel import Campaign
    from gyromodel.files import write_campaign

    folder.mkdir(parents=True)
    for k in range(campaigns):
        rng = np.random.default_rng(k)
        n = int(samples * rng.uniform(0.9, 1.0))
        time = 10.0 * np.arange(n)
        temperature = 20 + 15 * np.sin(2 * np.pi * time / time[-1] * rng.uniform(1, 3))
        rate = np.gradient(temperature, time)
        output = 3 + 0.2 * (temperature - 20) + 40 * rate + 0.05 * rng.standard_normal(n)
        columns = {"time": time, "temperature": temperature, "output": output}
        units = {"time": "s", "temperature": "degC", "output": "deg/h"}
        write_campaign(Campaign(columns, units, {"kind": "rate", "serial": f"U{k % 7}"}), folder / f"c{k:05d}.parquet")


def measured(folder: Path, campaigns: int, samples: int, stated: bool) -> dict[str, float]:
    """Seconds of the batch, and of a loop that reads and fits and keeps nothing safe; peak memory."""
    from gyromodel import fit, model_from_effects
    from gyromodel.batch import run_batch
    from gyromodel.files import read_campaign

    model = replace(model_from_effects(EFFECTS), noise=STATED if stated else {})
    make(folder / "warm", WARM, samples)
    make(folder / "archive", campaigns, samples)
    run_batch(str(folder / "warm"), model, "m", folder / "warm.parquet")
    before = peak_memory()
    done, seconds = timed(lambda: run_batch(str(folder / "archive"), model, "m", folder / "results.parquet"))
    memory = (peak_memory() - before) / MIB
    assert done.failed == 0
    few = sorted((folder / "archive").glob("*.parquet"))[:20]
    [fit(read_campaign(path), model) for path in few]  # compiles
    loop = timed(lambda: [fit(read_campaign(path), model) for path in few])[1]
    each = {name: seconds[name] / campaigns for name in seconds}
    rows = len(done.table) / campaigns
    return each | {"loop": loop["wall"] / len(few), "memory": memory, "rows": rows}


def main(argv: list[str]) -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--campaigns", type=int, default=1000, help="with stated noise; a tenth with estimated noise")
    parser.add_argument("--samples", type=int, default=5000)
    parser.add_argument("--one", nargs=3, type=int)
    options = parser.parse_args(argv)
    if options.one:
        with tempfile.TemporaryDirectory() as folder:
            campaigns, samples, stated = options.one
            print(json.dumps(measured(Path(folder), campaigns, samples, bool(stated))))
        return
    tenth, many = options.campaigns // 10, options.campaigns
    rows = []
    for stated in (True, False):
        sizes = [(tenth, options.samples), (tenth, options.samples // 10)]
        sizes += [(many, options.samples)] if stated else []
        for campaigns, samples in sizes:
            found = in_fresh_process("benchmarks.archive", "--one", str(campaigns), str(samples), str(int(stated)))
            rows.append([
                "stated" if stated else "estimated", str(campaigns), str(samples), f"{1 / found['wall']:.3g}",
                f"{1e3 * found['wall']:.0f}", f"{1e3 * found['cpu']:.0f}", f"{1e3 * found['loop']:.0f}",
                f"{found['wall'] / found['loop']:.2f}", f"{found['memory']:.0f}",
            ])  # fmt: skip
    head = ["noise", "campaigns", "samples of each, up to", "campaigns a second", "ms a campaign", "processor ms"]
    head += ["plain loop of `fit`, ms", "ratio", "memory beyond the warm-up, MiB"]
    lines = table(head, rows)
    lines += [
        "",
        f"Model: {', '.join(EFFECTS)}; noise stated as white, or estimated (white, flicker, random walk, Markov) with "
        "its intervals. The plain loop reads and fits 20 of the campaigns one after another and writes nothing.",
    ]
    write_result("archive", "Cost of an archive", "archive", argv, lines)


if __name__ == "__main__":
    main(sys.argv[1:])
