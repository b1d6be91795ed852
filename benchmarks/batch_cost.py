"""How the cost of fitting an archive grows with its campaigns and their samples, and what it is on a GPU.

    python -m benchmarks.batch_cost

writes benchmarks/results/batch_cost.md, of the campaigns and the model of `benchmarks.batch_fits`. On a machine with a
GPU that JAX computes on (`pip install "jax[cuda13]"`) the same fits are made there too.
"""

from __future__ import annotations

import argparse
import json
import sys
from typing import Any

from benchmarks._measure import MIB, gpu, in_fresh_process, table, write_result

# Three decades.
SAMPLES, FEW = (512, 4096, 32768, 262144, 524288), 8
RAGGED = {12: 1000, 40: 200}


def run(parameters: int, count: int, *lengths: tuple[int, int], platform: str = "cpu") -> dict[str, Any]:
    call = json.dumps(["ours", parameters, count, *lengths])
    return in_fresh_process("benchmarks.batch_fits", "--only", call, JAX_PLATFORMS=platform)


def cost(samples: str, count: int, found: dict[str, Any]) -> list[str]:
    seconds, passes = found["without restarts"], found["samples"] * found["iterations"]
    memory = (found["peak"] - found["before"]) / MIB
    each = [f"{1e3 * seconds / count:.2f}", f"{1e6 * seconds / passes:.3f}", f"{memory:.0f}"]
    return [samples, str(count), f"{found['iterations']:.1f}", *each]


def beside(there: dict[int, dict[str, Any]], here: dict[int, dict[str, Any]]) -> list[list[str]]:
    rows = []
    for p, count in RAGGED.items():
        ms = [1e3 * found["wall"] / count for found in (there[p], here[p])]
        same = abs(there[p]["iterations"] - here[p]["iterations"]) < 0.1 and there[p]["converged"] == count
        rows.append(
            [str(p), str(count), *(f"{x:.2f}" for x in ms), f"{ms[1] / ms[0]:.2f}", "yes" if same else "**no**"]
        )
    return rows


def main(argv: list[str]) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--accelerator", default="cuda", help="JAX's name for the platform to hold against processors")
    given = parser.parse_args(argv)
    rows = [cost(str(n), FEW, run(12, FEW, (n, n))) for n in SAMPLES]
    rows += [cost("3500 to 6500", n, run(12, n)) for n in (1, 10, 100, 1000)]
    head = ["samples", "campaigns", "iterations", "processor ms a fit", "µs a sample and iteration", "memory, MiB"]
    lines = [
        "12 parameters, the second call in a process; memory is what the largest resident one of the process rose by "
        "while all were fitted, their data being there before.",
        "",
        *table(head, rows),
        "",
    ]
    if gpu() or given.accelerator != "cuda":
        platforms = (given.accelerator, "cpu")
        there, here = ({p: run(p, n, platform=name) for p, n in RAGGED.items()} for name in platforms)
        head = ["parameters", "campaigns", f"ms a fit on {gpu() or given.accelerator}", "ms on the processors"]
        head += ["ratio", "same iterations, all converged"]
        lines += ["## On a GPU", "", "3500 to 6500 samples, wall time.", "", *table(head, beside(there, here))]
    else:
        lines.append("No GPU was there to hold this against.")
    write_result("batch_cost", "Cost of fits over samples and campaigns", "batch_cost", argv, lines)


if __name__ == "__main__":
    main(sys.argv[1:])
