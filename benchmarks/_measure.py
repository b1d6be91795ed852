"""Time, memory and the machine, for the benchmarks: measurements run in fresh processes, one at a time."""

from __future__ import annotations

import json
import os
import platform
import resource
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

from scipy.stats import beta

ROOT = Path(__file__).resolve().parents[1]
RESULTS = Path(__file__).parent / "results"
# Measured data, which are no part of the project.
DATA = Path(os.environ.get("GYROMODEL_DATA", ROOT.parent / "shared" / "data"))
MIB = 2**20


def machine() -> str:
    """Processor, memory, load and versions, as one sentence."""
    model = platform.processor() or platform.machine()
    if Path("/proc/cpuinfo").exists():
        names = [x.split(":")[1] for x in Path("/proc/cpuinfo").read_text().splitlines() if x.startswith("model name")]
        model = names[0].strip() if names else model
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
    versions = ", ".join(f"{name} {version(name)}" for name in ("jax", "numpy"))
    cores = str(os.cpu_count())
    if hasattr(os, "sched_getaffinity") and len(own := os.sched_getaffinity(0)) < int(cores):
        cores = f"{len(own)} of {cores}"
    return (
        f"{cores} cores ({model}) shared with other work (load average {os.getloadavg()[0]:.1f} at the end), "
        f"{memory:.0f} GiB, {gpu() or 'no GPU'}, Python {platform.python_version()}, {versions}"
    )


@cache
def gpu() -> str:
    """The GPU that JAX computes on here; empty without one."""
    ask = "import jax; d = jax.devices()[0]; print(d.device_kind if d.platform == 'gpu' else '')"
    return subprocess.run([sys.executable, "-c", ask], stdout=subprocess.PIPE, text=True, check=True).stdout.strip()


def peak_memory() -> int:
    """Largest resident memory of this process so far, in bytes."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)


def timed(work: Callable[[], Any]) -> tuple[Any, dict[str, float]]:
    """The result of a call, with its wall and processor seconds."""
    wall, cpu = time.perf_counter(), time.process_time()
    result = work()
    return result, {"wall": time.perf_counter() - wall, "cpu": time.process_time() - cpu}


def in_fresh_process(module: str, *arguments: str, **environment: str) -> Any:
    """The last line that a module prints, run on its own in a new process, as JSON.

    The caller should hold little memory itself: on Linux a child's peak starts from its parent's.
    """
    done = subprocess.run(
        [sys.executable, "-m", module, *arguments],
        cwd=ROOT,
        env=os.environ | environment,
        stdout=subprocess.PIPE,
        text=True,
        check=True,
    )
    return json.loads(done.stdout.splitlines()[-1])


def share(flags: Sequence[bool] | int, of: int = 0) -> str:
    """How many of some are true, with the 95 % Clopper-Pearson interval; or so many of a number."""
    hits, of = (flags, of) if isinstance(flags, int) else (sum(flags), len(flags))
    low = beta.ppf(0.025, hits, of - hits + 1) if hits else 0.0
    high = beta.ppf(0.975, hits + 1, of - hits) if hits < of else 1.0
    return f"{hits} of {of} ({100 * low:.0f}-{100 * high:.0f} %)"


def table(head: list[str], rows: list[list[str]]) -> list[str]:
    """Lines of a Markdown table."""
    return [f"| {' | '.join(row)} |" for row in [head, ["---"] * len(head), *rows]]


def write_result(name: str, title: str, module: str, argv: list[str], lines: list[str]) -> None:
    """A result page: title, machine, the command that makes it, and the rest."""
    command = f"python -m benchmarks.{module} {' '.join(argv)}".rstrip()
    RESULTS.mkdir(parents=True, exist_ok=True)
    page = [f"# {title}", "", f"On {machine()}. Made by", "", f"    {command}", "", *lines, ""]
    (RESULTS / f"{name}.md").write_text("\n".join(page), encoding="utf-8")
    print("\n".join(page))
