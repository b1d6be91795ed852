"""The hidden-effect study: how often the diagnosis is right, on simulated campaigns it has not seen.

    python -m benchmarks.discovery --workers 2

writes a table with 95 % Clopper-Pearson intervals, a confusion matrix, power curves and p-values to
benchmarks/results/discovery.md, discovery_confusion.png and discovery_power.png. --scale 0.25 takes a quarter of the
campaigns. What was run is kept in benchmarks/results/discovery/, by seed: a study that was stopped goes on where it
was; --again 200 counts how many of 200 answers are still today's engine's. The page is made of all finished seeds
there, of this engine if it has any; they differ by a hundred or more, as parts of one seed differ by less. --page
makes it again without running anything.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from importlib.util import find_spec
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks._discovery_page import SIZES, TIMED_DRAWS, asked, write_page
from benchmarks._kept import Kept, code
from gyromodel._compiling import keep_compiled, switch_compiler
from tests.truth import study
from tests.truth.campaigns import HOMES, MOTION, A, B, C
from tests.truth.noise import FAMILY, OUTSIDE

RESULTS = Path(__file__).parent / "results"
# Campaigns at full scale, by what is hidden in them.
NULLS, EFFECTS, CURVE, OUTER, UNKNOWNS, PAIRS = 400, 600, 200, 150, 300, 400
SUPERFLUOUS = 150  # with nothing hidden, and with an effect
OTHERS = 128  # of each size, of what few campaigns log
MOVING = 48  # of unlisted errors, and of pairs, of gyros that are tumbled, turned and driven
INSEPARABLE, CALIBRATED, MUTATED = 120, 200, 60
# However small the part, so many of what is counted in few campaigns.
FEWEST = 24
# Parts that an oracle is asked about which knows how levels of noise are drawn.
ORACLE = (
    "nothing", "effects 1", "effects 1, white", "effects 10", "effects 10, white", "unknown 10", "unknown 10, moving",
    "inseparable", "nothing, moving", "effects 10, other",
)  # fmt: skip
DRAWS = 200  # of a calibration whose p-values are looked at
# Diagnoses timed: campaigns of about 1000 rows.
TIMED = ("static_cycle", "rate_temperature", "rate_steps", "tumble")


def _arguments(argv: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Hidden-effect study of the diagnosis.")
    parser.add_argument("--scale", type=float, default=1.0, help="part of the full number of campaigns")
    parser.add_argument("--seed", type=int, default=1, help="of several, a hundred apart")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--output", type=Path, default=RESULTS / "discovery.md")
    parser.add_argument("--kept", type=Path, default=RESULTS / "discovery", help="folder of what was run")
    parser.add_argument("--page", action="store_true", help="make the page of what is there")
    parser.add_argument("--again", type=int, default=0, help="diagnose so many of the kept campaigns again, and count")
    parser.add_argument("--timed", action="store_true", help="time row 18 again")
    parser.add_argument(
        "--go-on", action="store_true", help="go on also with another engine, which the page then names"
    )
    return parser.parse_args(argv)


def _seconds(case: study.Case) -> tuple[int, float, float]:
    """Rows, and seconds of the processor and the clock of a diagnosis with calibration and hold-out.

    What is new is compiled meanwhile.
    """
    built = study.build(case)
    start, clock = time.process_time(), time.perf_counter()
    study.run_engine(built, gain=True, calibrate=TIMED_DRAWS)
    return len(built.truth.noise), time.process_time() - start, time.perf_counter() - clock


def _timed(seed: int, designs: Sequence[str] = TIMED) -> list[tuple[str, int, float, float, float, float]]:
    """Row 18: design, rows and seconds, nothing drawn before; by a first process, and by one that it spares.

    The second finds what the first has compiled, and has other campaigns, as draws are kept too.
    """
    kept, found = dict(os.environ), []
    with tempfile.TemporaryDirectory() as cache:
        try:
            # As commands have it, read by the new processes.
            for name in ("JAX_COMPILATION_CACHE_DIR", "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "XLA_FLAGS"):
                os.environ.pop(name, None)
            os.environ["XDG_CACHE_HOME"] = cache
            keep_compiled()
            switch_compiler()
            if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
                raise SystemExit(f"{cache}: nothing compiled can be kept there")
            for first in (seed, seed + len(designs)):
                cases = [study.Case(first + i, name, "flicker", None) for i, name in enumerate(designs)]
                with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
                    found.append(list(pool.map(_seconds, cases)))
        finally:
            os.environ.clear()
            os.environ.update(kept)
    return [
        (name, rows, *(second for both in zip(one, two, strict=True) for second in both))
        for name, (rows, *one), (_, *two) in zip(designs, *found, strict=True)
    ]


def _plan(seed: int, scale: float, controls: Sequence[str]) -> Iterator[tuple[str, list[study.Case], dict[str, Any]]]:
    """Label, campaigns and options of every part."""

    def many(count: int) -> int:
        return max(round(count * scale), 6)

    def few(count: int) -> int:
        return max(many(count), FEWEST)

    beside = {"controls": controls}
    yield "nothing", study.null_cases(many(NULLS) * 2 // 3, seed, designs=HOMES), beside
    yield "nothing, moving", study.null_cases(many(NULLS) // 3, seed + 3, designs=MOTION), beside
    yield "nothing, outside", study.null_cases(many(NULLS), seed + 1, OUTSIDE), {}
    yield "calibrated", study.null_cases(many(CALIBRATED), seed + 2), {"calibrate": DRAWS}
    for k, (size, count) in enumerate(zip(SIZES, (CURVE, EFFECTS, CURVE, EFFECTS, EFFECTS), strict=True)):
        cases = study.effect_cases(many(count) * 2 // 3, seed + 10 + k, size, FAMILY)
        cases += study.motion_cases(many(count) // 3, seed + 60 + k, size, FAMILY)
        at_three = beside | {"after": True} if size == 3.0 else {}
        white = [c for c in cases if c.noise == "white"]
        yield f"effects {size:g}", [c for c in cases if c not in white], at_three
        yield f"effects {size:g}, white", white, at_three | {"gain": size == 3.0}
    anywhere = [n for n in OUTSIDE if not n.startswith("grows")]
    cases = study.effect_cases(many(OUTER) * 2 // 3, seed + 80, 3.0, anywhere)
    yield "effects 3, outside", cases + study.motion_cases(many(OUTER) // 3, seed + 81, 3.0, anywhere), {}
    yield "unknown 3", study.unknown_cases(many(UNKNOWNS), seed + 20, 3.0, FAMILY), beside
    yield "unknown 10", study.unknown_cases(many(UNKNOWNS), seed + 21, 10.0, FAMILY), {}
    yield "pairs", study.pair_cases(many(PAIRS), seed + 25, 3.0, FAMILY), {}
    for size in (3.0, 10.0):
        cases = study.moving_unknown_cases(many(MOVING), seed + 90 + int(size), size)
        yield f"unknown {size:g}, moving", cases, {}
    yield "pairs, moving", study.moving_pair_cases(many(MOVING), seed + 91, 3.0), {}
    yield "inseparable", study.inseparable_cases(few(INSEPARABLE), seed + 30), {"after": True}
    yield "drifts", study.drift_cases(few(INSEPARABLE), seed + 31), {}
    for label, size in (("nothing", 0.0), ("effects 10", 10.0)):
        yield f"{label}, superfluous", study.superfluous_cases(many(SUPERFLUOUS), seed + 45 + bool(size), size), {}
    for size in (3.0, 10.0):
        yield f"effects {size:g}, other", study.other_cases(many(OTHERS), seed + 47 + (size > 3.0), size), {}
    # With a safeguard off, and the same campaigns with it on.
    broken = study.null_cases(many(MUTATED), seed + 40, ("flicker_and_walk",), (A, B, C))
    whole = study.curve_cases(many(MUTATED), seed + 41, 3.0)
    more = study.null_cases(few(MUTATED), seed + 42)
    yield "broken", broken, {}
    yield "no_whitening", broken, {"mutant": "no_whitening"}
    yield "no_look_elsewhere", broken, {"mutant": "no_look_elsewhere"}
    yield "unbroken", whole, {}
    yield "no_projection", whole, {"mutant": "no_projection"}
    yield "forced", more, {"mutant": "forced", "gain": True}
    yield "forced_no_nesting", more, {"mutant": "forced_no_nesting", "gain": True}


def _again(kept: Kept, count: int, workers: int) -> tuple[str, int, int]:
    """Today's engine, how many campaigns it diagnoses again, and how many of these have another answer.

    Of those that were diagnosed without a gain, which prunes.
    """
    plain = ("nothing", "effects", "unknown", "pairs", "inseparable", "drifts")
    labels = [label for label in kept.parts if label.startswith(plain) and label != "effects 3, white"]
    before = [r for label in labels for r in kept.parts[label]]
    before = [before[i] for i in np.random.default_rng(0).permutation(len(before))[:count]]

    def said(record: study.Record) -> tuple[str, tuple[str, ...], tuple[str, ...]]:
        if record.answer is None:
            return "refused", (), ()
        return record.answer.verdict, tuple(sorted(record.answer.causes)), record.answer.driver

    after = study.run_cases([r.case for r in before], workers)
    return code(), len(before), sum(said(a) != said(b) for a, b in zip(before, after, strict=True))


def main(argv: list[str] | None = None) -> None:
    args = _arguments(argv)
    start, controls = time.time(), study.CONTROLS if find_spec("sklearn") else ()
    if not controls:
        print(
            "scikit-learn is not installed: no other methods run beside (pip install gyromodel[peers])", file=sys.stderr
        )
    if not args.page:
        # Every part has processes of its own.
        keep_compiled()
        kept = Kept(args.kept / f"seed_{args.seed}.json.gz")
        before = kept.code.split(" and ") if kept.parts and args.go_on else []
        made = " and ".join(dict.fromkeys([*before, code()])), args.scale
        plan = [part for part in _plan(args.seed, args.scale, controls) if part[0] not in kept.parts]
        if kept.parts and (made[1] != kept.scale or (plan and made[0] != kept.code and not args.go_on)):
            raise SystemExit(
                f"{kept.path} was made by code {kept.code} at scale {kept.scale:g}, and this is {made[0]} at "
                f"{made[1]:g}: take another --seed, or remove it"
            )
        for label, cases, options in plan:
            kept.code, kept.scale = made
            kept.parts[label] = study.run_cases(cases, args.workers, **options)
            kept.save()
            print(f"{label}: {len(cases)} campaigns, {time.time() - start:.0f} s", file=sys.stderr, flush=True)
        for label in (label for label in ORACLE if label not in kept.oracle):
            told = partial(study.oracle_told, beside=label.startswith("effects 10"))
            kept.oracle[label] = study.in_processes(told, asked(label, kept.parts[label]), args.workers)
            kept.save()
            print(f"{label}, the oracle: {time.time() - start:.0f} s", file=sys.stderr, flush=True)
        if args.again:
            kept.again = _again(kept, args.again, args.workers)
            kept.save()
        if not kept.seconds or args.timed:
            kept.seconds, kept.timed = _timed(args.seed + 70), code()
            kept.save()
    found = [Kept(path) for path in sorted(args.kept.glob("seed_*.json.gz"), key=lambda path: int(path.stem[5:-5]))]
    whole = [k for k in found if k.seconds]
    # Of one engine: this one, where it has been studied.
    whole = [k for k in whole if k.code.endswith(code())] or whole
    if not whole:
        raise SystemExit(f"{args.kept} holds no finished study")
    write_page(args.output, whole)


if __name__ == "__main__":
    main()
