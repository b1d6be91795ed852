"""Settings every test shares: compilation cache, seeds that vary by run, hypothesis profile, measured data.

This file must not import gyromodel: the run-time shape checks are installed after it is read and before the package is.
"""

from __future__ import annotations

import os
import re
import secrets
import signal
from collections.abc import Callable
from functools import cache
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pytest
from hypothesis import settings
from hypothesis.database import DirectoryBasedExampleDatabase

import tests.typechecker  # noqa: F401  the import hook of pyproject.toml looks it up by this name

ROOT = Path(__file__).resolve().parents[1]
CACHE = ROOT / ".cache"
# Whose verdicts are of one draw, the same in each run: they err as often as the threshold allows, which
# test_discovery.py measures.
FIXED = {"test_as_recorded", "test_diagnosis", "test_held_out", "test_honesty"}

# Set in the environment, so that test workers and the commands that tests start share them.
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(CACHE / "jax"))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
os.environ.setdefault("MPLBACKEND", "agg")
if version("jaxlib") == "0.10.2":  # as commands have it: gyromodel/_compiling.py; workers compile side by side anyway
    os.environ.setdefault(
        "XLA_FLAGS",
        "--xla_cpu_use_fusion_emitters=false --xla_cpu_parallel_codegen_split_count=1 "
        "--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=100000000",
    )
if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:  # as in the background of a shell; what tests start inherits it
    signal.signal(signal.SIGINT, signal.default_int_handler)
os.environ.setdefault("GYROMODEL_TEST_SEED", str(secrets.randbelow(2**32)))

settings.register_profile(
    "gyromodel", deadline=None, print_blob=True, database=DirectoryBasedExampleDatabase(CACHE / "hypothesis")
)
settings.load_profile("gyromodel")


def pytest_report_header() -> str:
    """Show the seed of the statistical tests, as every run draws its own."""
    return f"GYROMODEL_TEST_SEED={os.environ['GYROMODEL_TEST_SEED']} repeats this run's random draws"


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with the longest, those of test_discovery.py, shared between two workers: each is dealt half, in order.

    A verdict of random draws that is not as a test has it is drawn anew, once: what chance fails once in fifty runs it
    hardly fails twice. What is wrong in some draws only shows less often; the summary tells which were. Tests of a law
    have limits of their own.
    """
    for item in items:
        drawn = isinstance(item, pytest.Function) and "seed" in item.fixturenames
        if drawn and _of_diagnosis(item.path) and not item.get_closest_marker("law"):
            item.add_marker(pytest.mark.flaky(reruns=1))
    first = [item for item in items if "test_discovery" in item.nodeid and item.get_closest_marker("long")]
    rest = [item for item in items if item not in first]
    half = len(items) // 2 - len(first[::2])
    items[:] = [*first[::2], *rest[:half], *first[1::2], *rest[half:]]


@cache
def _of_diagnosis(file: Path) -> bool:
    """Whether tests hold what a search tells of one campaign, or of a few: not of each draw."""
    return re.search("diagnos|verdict", file.read_text(encoding="utf-8")) is not None


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item):
    """Print the seed with each failure too: workers show no header."""
    report = yield
    if report.failed:
        report.sections.append(("seed", f"GYROMODEL_TEST_SEED={os.environ['GYROMODEL_TEST_SEED']}"))
    return report


@pytest.fixture
def seed(request: pytest.FixtureRequest) -> int:
    """A seed that differs between runs, tests and tries; GYROMODEL_TEST_SEED repeats a run.

    In modules of fixed draws only that of a law does.
    """
    if Path(request.node.path).stem in FIXED and not request.node.get_closest_marker("law"):
        return 1
    name = int.from_bytes(request.node.nodeid.encode(), "big")
    run = [int(os.environ["GYROMODEL_TEST_SEED"]), name, *range(1, getattr(request.node, "execution_count", 1))]
    return int(np.random.SeedSequence(run).generate_state(1)[0])


@pytest.fixture
def rng(seed: int) -> np.random.Generator:
    """A generator started at `seed`."""
    return np.random.default_rng(seed)


@pytest.fixture(scope="session")
def measured_data() -> Callable[[str], Path]:
    """Path of a measured data file by its name; skips the test where the data are absent."""
    folder = Path(os.environ.get("GYROMODEL_DATA", ROOT.parent / "shared" / "data"))

    def path(name: str) -> Path:
        if not (folder / name).exists():
            pytest.skip(f"measured data {name} not found; GYROMODEL_DATA names their folder")
        return folder / name

    return path
