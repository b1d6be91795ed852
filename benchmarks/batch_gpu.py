"""Fits of an archive's campaigns on a GPU, beside the same fits on the machine's processors.

    python -m benchmarks.batch_gpu

writes benchmarks/results/batch_gpu.md, of the campaigns and the model of `benchmarks.batch_fits`, where JAX computes on
a GPU (`pip install "jax[cuda13]"`). --accelerator takes another platform of JAX's, `cpu` to try the benchmark itself.
"""

from __future__ import annotations

import argparse
import sys
from typing import Any

import numpy as np

from benchmarks._measure import gpu, table, write_result
from benchmarks.batch_cost import run

ARCHIVE = {12: 1000, 40: 200}  # campaigns, by parameters


def main(argv: list[str]) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--accelerator", default="cuda", help="JAX's name of the platform")
    given = parser.parse_args(argv)
    if given.accelerator == "cuda" and not gpu():
        print("JAX finds no GPU here: batch_gpu.md stays as it is", file=sys.stderr)
        return
    there, here = ({p: run(p, n, platform=name) for p, n in ARCHIVE.items()} for name in (given.accelerator, "cpu"))
    head = ["parameters", "campaigns", f"ms a fit on {gpu() or given.accelerator}", "ms on the processors", "ratio",
            "first call there, s", "here, s", "estimates differ by, standard uncertainties"]  # fmt: skip
    rows = [_beside(p, n, there[p], here[p]) for p, n in ARCHIVE.items()]
    write_result("batch_gpu", "Fits of an archive on a GPU", "batch_gpu", argv, [
        "3500 to 6500 samples; wall time of the second call in a process, and of the first, which compiles.",
        "",
        *table(head, rows),
    ])  # fmt: skip


def _beside(parameters: int, count: int, there: dict[str, Any], here: dict[str, Any]) -> list[str]:
    ms = [1e3 * found["wall"] / count for found in (there, here)]
    values, others, std = (np.array(x) for x in (there["values"], here["values"], here["std"]))
    apart = f"{np.abs((values - others) / std).max():.1g}" if there["converged"] == count else "**not all converged**"
    first = (f"{found['first']:.0f}" for found in (there, here))
    return [str(parameters), str(count), *(f"{x:.2f}" for x in ms), f"{ms[1] / ms[0]:.2f}", *first, apart]


if __name__ == "__main__":
    main(sys.argv[1:])
