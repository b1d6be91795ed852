"""How the cost of fitting an archive grows with its campaigns and their samples.

    python -m benchmarks.batch_cost

writes benchmarks/results/batch_cost.md, of the campaigns and the model of `benchmarks.batch_fits`.
"""

from __future__ import annotations

import json
import sys
from typing import Any

from benchmarks._measure import MIB, in_fresh_process, table, write_result

# Three decades.
SAMPLES, FEW = (512, 4096, 32768, 262144, 524288), 8


def run(parameters: int, count: int, *lengths: tuple[int, int], platform: str = "cpu") -> dict[str, Any]:
    call = json.dumps(["ours", parameters, count, *lengths])
    return in_fresh_process("benchmarks.batch_fits", "--only", call, JAX_PLATFORMS=platform)


def cost(samples: str, count: int, found: dict[str, Any]) -> list[str]:
    seconds, passes = found["without restarts"], found["samples"] * found["iterations"]
    memory = (found["peak"] - found["before"]) / MIB
    each = [f"{1e3 * seconds / count:.2f}", f"{1e6 * seconds / passes:.3f}", f"{memory:.0f}"]
    return [samples, str(count), f"{found['iterations']:.1f}", *each]


def main(argv: list[str]) -> None:
    rows = [cost(str(n), FEW, run(12, FEW, (n, n))) for n in SAMPLES]
    rows += [cost("3500 to 6500", n, run(12, n)) for n in (1, 10, 100, 1000)]
    head = ["samples", "campaigns", "iterations", "processor ms a fit", "µs a sample and iteration", "memory, MiB"]
    lines = [
        "12 parameters, the second call in a process; memory is what the largest resident one of the process rose by "
        "while all were fitted, their data being there before.",
        "",
        *table(head, rows),
    ]
    write_result("batch_cost", "Cost of fits over samples and campaigns", "batch_cost", argv, lines)


if __name__ == "__main__":
    main(sys.argv[1:])
