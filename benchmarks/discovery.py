"""The hidden-effect study: how often the diagnosis is right, on simulated campaigns it has not seen.

    python -m benchmarks.discovery --workers 2

writes a table with 95 % Clopper-Pearson intervals, a confusion matrix, power curves and p-values to
benchmarks/results/discovery.md and discovery_*.png. --scale 0.25 takes a quarter of the campaigns.
"""

from __future__ import annotations

import argparse
import random
import sys
import time
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from importlib.util import find_spec
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

from tests.truth import levels, study
from tests.truth.campaigns import known
from tests.truth.noise import FAMILY, OUTSIDE

RESULTS = Path(__file__).parent / "results"
# Campaigns at full scale, by what is hidden in them; draws of a calibration.
NULLS, EFFECTS, CURVE, UNKNOWNS, PAIRS, INSEPARABLE, CALIBRATED, MUTATED, DRAWS = (
    400,
    600,
    200,
    300,
    400,
    120,
    200,
    60,
    200,
)
# Shares of confusion predicted, and pairs of one-column effects: design, hidden effect, rival.
PREDICTED, CONFUSED = (
    (0.05, 0.15, 0.3),
    (
        ("static_cycle", "bias_temperature", "bias_drift"),
        ("static_cycle", "bias_supply_voltage", "bias_temperature_rate"),
        ("static_cycle", "bias_drift", "bias_laser_current"),
        ("static_cycle", "bias_pressure", "bias_temperature"),
        ("rate_temperature", "bias_temperature", "bias_drift"),
        ("rate_steps", "bias_temperature", "bias_drift"),
    ),
)
PER_CELL = 40


def _arguments(argv: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Hidden-effect study of the diagnosis.")
    parser.add_argument("--scale", type=float, default=1.0, help="part of the full number of campaigns")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--output", type=Path, default=RESULTS / "discovery.md")
    return parser.parse_args(argv)


Run = Callable[..., list[study.Record]]


def _row(v: levels.Level) -> str:
    low, high = v.interval
    must = f"{'≥' if v.at_least else '≤'} {100 * v.must:.1f} %"
    measured = f"{100 * v.share:.1f} % ({100 * low:.1f}-{100 * high:.1f})"
    verdict = "met" if v.met else "**missed**"
    return f"| {v.row} | {v.measure} | {v.prototype} | {must} | {measured} | {v.total} | {verdict} |"


def _controls(
    nulls: list[study.Record], effects: list[study.Record], unknown: list[study.Record], seed: int
) -> list[str]:
    """What each control and practitioner's method says at 3 x MDE, and the engine against shuffled truths."""
    truths = [r.case.effect for r in effects]
    most = Counter(truths).most_common(1)[0][0]
    lines = [
        "| method | extension with nothing hidden | exact name, 3× | right column of an unknown effect, 3× |",
        "|---|---|---|---|",
    ]
    for name in study.CONTROLS if nulls[0].controls else ():
        false = np.mean([bool(r.controls[name].added) for r in nulls])
        exact = np.mean([r.controls[name].added == (r.case.effect,) for r in effects])
        driver = np.mean(
            [r.controls[name].added == (f"smooth({' and '.join(r.truth.driver or ())})",) for r in unknown]
        )
        lines.append(f"| {name.replace('_', ' ')} | {100 * false:.1f} % | {100 * exact:.1f} % | {100 * driver:.1f} % |")
    lines.append("| always none | 0.0 % | 0.0 % | 0.0 % |")
    lines.append(
        f"| most frequent name ({most}) | 100.0 % | {100 * np.mean([t == most for t in truths]):.1f} % | 0.0 % |"
    )
    knew = np.mean([r.oracle_first == r.case.effect for r in effects])
    lines.append(f"| oracle: noise and size known, an effect is there | – | {100 * knew:.1f} % | – |")
    mine = [np.mean([bool(s.detected) for r in nulls if (s := r.score)]),
            np.mean([s.named for r in effects if (s := r.score)]),
            np.mean([s.driver_right for r in unknown if (s := r.score)])]  # fmt: skip
    lines.append("| **gyromodel** | " + " | ".join(f"**{100 * share:.1f} %**" for share in mine) + " |")
    shuffled = random.Random(seed).sample(truths, len(truths))
    chance = np.mean([r.answer is not None and r.answer.causes == (t,) for r, t in zip(effects, shuffled, strict=True)])
    lines.append(f"| gyromodel against shuffled truths | – | {100 * chance:.1f} % | – |")
    return lines


def _mutants(run: Run, nulls: list[study.Case], effects: list[study.Case]) -> list[str]:
    """Rows 1, 5 and 15 with a safeguard off, beside the same campaigns with it on."""
    lines = ["| switched off | measure | with it | without |", "|---|---|---|---|"]

    def line(off: str, measure: str, cases: list[study.Case], flag: str, mutant: str, beside: str, gain: bool) -> None:
        shares = []
        for name in (beside, mutant):
            records = run(f"{off}, {name or 'nothing off'}", cases, mutant=name, gain=gain)
            shares.append(100 * float(np.mean([getattr(r.score, flag) for r in records])))
        lines.append(f"| {off} | {measure} | {shares[0]:.0f} % | {shares[1]:.0f} % |")

    said = "extension with nothing hidden, flicker and walk"
    line("whitening", said, nulls, "detected", "no_whitening", "", False)
    line("price of the search", said, nulls, "detected", "no_look_elsewhere", "", False)
    line("projection", "named, 3×", effects, "named", "no_projection", "", False)
    forced = "gain claimed for the best candidate with nothing hidden"
    line("nesting", forced, nulls, "gain_claimed", "forced_no_nesting", "forced", True)
    return lines


def _confused(scale: float, seed: int, workers: int) -> tuple[list[str], list[study.Confusion]]:
    """Row 11: confusion of two effects as predicted before the data, and as counted."""
    draws = max(round(PER_CELL * scale), 8)
    cells = [(seed + i, *names, p, draws) for i, names in enumerate(CONFUSED) for p in PREDICTED]
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        found = list(pool.map(study.confusion, *zip(*cells, strict=True)))
    predicted, counted = (np.array(v) for v in zip(*((c.predicted, c.wrong / c.total) for c in found), strict=True))
    lines = [
        f"Row 11, {draws} campaigns of white noise a cell: predicted minus counted "
        f"{100 * np.mean(predicted - counted):+.1f} % on average (must: within 5 %), correlation "
        f"{np.corrcoef(predicted, counted)[0, 1]:.2f} (must: ≥ 0.85).",
        "",
        "| design | hidden | rival | preferred to it: predicted | counted |",
        "|---|---|---|---|---|",
        *(
            f"| {c.design} | {c.effect} | {c.rival} | {100 * c.predicted:.0f} % | {100 * c.wrong / c.total:.0f} % |"
            for c in found
        ),
    ]
    return lines, found


def _curves(records: list[study.Record], p_values: np.ndarray, path: Path) -> None:
    """Power over size by noise, and the p-values of campaigns with nothing hidden."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(10, 4), layout="constrained")
    sizes = sorted({r.case.times_mde for r in records})
    for noise in sorted({r.case.noise for r in records}):
        shares = []
        for size in sizes:
            group = [r for r in records if r.case.times_mde == size and r.case.noise == noise and r.isolable]
            shares.append(levels.Level("", "", "", 0.0, True, sum(r.score.named for r in group if r.score), len(group)))
        middle = np.array([v.share for v in shares])
        low, high = (np.array([v.interval[i] for v in shares]) for i in (0, 1))
        shift = 1.0 + 0.02 * len(left.containers)
        left.errorbar(
            np.array(sizes) * shift,
            middle,
            [middle - low, high - middle],
            marker="o",
            capsize=2,
            label=noise.replace("_", " "),
        )
    left.set(
        xscale="log",
        xlabel="size, in minimal detectable sizes",
        ylabel="share named, isolable campaigns",
        ylim=(0, 1.03),
    )
    left.set_xticks(sizes, [f"{size:g}" for size in sizes], minor=False)
    left.minorticks_off()
    left.legend(title="noise")
    p = np.sort(p_values)
    right.plot([0, 1], [0, 1], color="0.7", label="uniform")
    right.step(
        np.concatenate([[0.0], p, [1.0]]),
        np.concatenate([np.arange(len(p) + 1) / len(p), [1.0]]),
        where="post",
        label="nothing hidden",
    )
    right.set(xlabel="p-value of the campaign", ylabel="share of campaigns at or below")
    right.legend()
    figure.savefig(path, dpi=130)
    plt.close(figure)


def _said(record: study.Record) -> str:
    answer = record.answer
    if answer is None:
        return "–"
    return (
        "+".join(answer.causes)
        if answer.verdict == "named" and len(answer.causes) == 1
        else ("several named" if answer.verdict == "named" else answer.verdict)
    )


def _missed(records: list[study.Record]) -> list[str]:
    """Every campaign at 3 x MDE, or with nothing hidden, whose answer was not right: enough to draw it again."""
    wrong = [r for r in records if r.score and r.answer and not r.score.right]
    lines = [
        "## Answers that were not right",
        "",
        "| seed | design | noise | hidden | isolable | said |",
        "|---|---|---|---|---|---|",
    ]
    for r in sorted(wrong, key=lambda r: (str(r.case.effect), r.case.design)):
        said = f"{r.answer.verdict} {', '.join(r.answer.causes) or ' and '.join(r.answer.driver)}" if r.answer else ""
        isolable = "yes" if r.isolable else "no"
        lines.append(
            f"| {r.case.seed} | {r.case.design} | {r.case.noise} | {r.case.effect or '–'} | {isolable} | {said} |"
        )
    return [*lines, ""]


def _confusion(records: list[study.Record], path: Path) -> None:
    """Truth against what was said, share of each row."""
    verdicts = ["several named", "ambiguous", "unknown", "adequate"]
    truths = sorted({str(r.case.effect) for r in records}, key=lambda e: (not known(e), e))
    said = [t for t in truths if known(t)]
    said += sorted({_said(r) for r in records} - set(said) - set(verdicts)) + verdicts
    table = np.zeros((len(truths), len(said)))
    for r in records:
        table[truths.index(str(r.case.effect)), said.index(_said(r))] += 1
    share = table / table.sum(1, keepdims=True)
    figure, axes = plt.subplots(figsize=(0.42 * len(said) + 3, 0.34 * len(truths) + 3), layout="constrained")
    image = axes.imshow(share, cmap="Blues", vmin=0, vmax=1)
    for (i, j), value in np.ndenumerate(share):
        if value:
            axes.text(
                j, i, f"{100 * value:.0f}", ha="center", va="center", fontsize=7, color="w" if value > 0.5 else "k"
            )
    axes.set_xticks(range(len(said)), [s.replace("_", " ") for s in said], rotation=90)
    axes.set_yticks(range(len(truths)), [t.replace("_", " ") for t in truths])
    axes.set(xlabel="the diagnosis says", ylabel="hidden, 3 × minimal detectable size")
    figure.colorbar(image, label="share of campaigns", shrink=0.6)
    figure.savefig(path, dpi=130)
    plt.close(figure)


def main(argv: list[str] | None = None) -> None:
    args = _arguments(argv)
    start, controls = time.time(), find_spec("sklearn") is not None
    if not controls:
        print(
            "scikit-learn is not installed: no other methods run beside (pip install gyromodel[peers])", file=sys.stderr
        )

    def many(count: int) -> int:
        return max(round(count * args.scale), 6)

    def run(label: str, cases: list[study.Case], **options: Any) -> list[study.Record]:
        records = study.run_cases(cases, args.workers, **options)
        print(f"{label}: {len(records)} campaigns, {time.time() - start:.0f} s", file=sys.stderr, flush=True)
        return records

    seed = args.seed
    at_rest = study.null_cases(many(NULLS) * 2 // 3, seed)
    nulls = run("nothing hidden", at_rest, controls=controls, gain=True)
    nulls += run("nothing hidden, moving", study.motion_nulls(many(NULLS) // 3, seed + 3), controls=controls, gain=True)
    outside = run("noise outside the family", study.null_cases(many(NULLS), seed + 1, OUTSIDE), gain=True)
    calibrated = run("calibrated", study.null_cases(many(CALIBRATED), seed + 2), calibrate=DRAWS)
    sized = {}
    for k, (size, count) in enumerate(((0.5, CURVE), (1.0, EFFECTS), (2.0, CURVE), (3.0, EFFECTS), (10.0, EFFECTS))):
        cases = study.effect_cases(many(count) * 2 // 3, seed + 10 + k, size, FAMILY)
        cases += study.motion_cases(many(count) // 3, seed + 60 + k, size, FAMILY)
        at_three = {"controls": controls, "after": True} if size == 3.0 else {}
        white = [c for c in cases if c.noise == "white"]
        sized[size] = run(f"effects at {size:g} x MDE", [c for c in cases if c not in white], **at_three)
        sized[size] += run("the same in white noise", white, gain=size == 3.0, **at_three)
    unknown = {}
    for k, size in enumerate((3.0, 10.0)):
        cases = study.unknown_cases(many(UNKNOWNS), seed + 20 + k, size, FAMILY)
        unknown[size] = run(f"unknown at {size:g} x MDE", cases, controls=controls and size == 3.0)
    pairs = run("two causes", study.pair_cases(many(PAIRS), seed + 25, 3.0, FAMILY))
    inseparable = run("inseparable", study.inseparable_cases(many(INSEPARABLE), seed + 30), after=True)
    drifts = run("drifts", study.drift_cases(many(INSEPARABLE), seed + 31))
    broken = study.null_cases(many(MUTATED), seed + 40, ("flicker_and_walk",))
    mutants = _mutants(run, broken, study.effect_cases(many(MUTATED), seed + 41, 3.0))
    confused, cells = _confused(args.scale, seed + 50, args.workers)

    main_sizes = [r for size in (1.0, 3.0, 10.0) for r in sized[size]]
    uncatalogued = [r for records in unknown.values() for r in records]
    reached = levels.null_levels(nulls + outside) + levels.effect_levels(main_sizes)
    reached += levels.unknown_levels(uncatalogued) + levels.pair_levels(pairs) + levels.amplitude_levels(main_sizes)
    reached += [*levels.ambiguity_levels(inseparable, drifts), levels.settled_level(inseparable)]
    reached += [levels.noise_level(nulls), levels.adequacy_level(sized[3.0]), levels.gain_coverage(sized[3.0])]
    reached.sort(key=lambda v: (float(v.row.rstrip("+")), v.measure))
    everything = [*nulls, *outside, *main_sizes, *sized[0.5], *sized[2.0], *uncatalogued, *pairs, *inseparable, *drifts]
    figures = {k: args.output.with_name(f"{args.output.stem}_{k}.png") for k in ("confusion", "power")}
    uniform, lowest, count = levels.uniform_p_values(calibrated)
    by_design: dict[str, list[float]] = {}
    for r in (r for r in everything if r.answer):
        by_design.setdefault(r.case.design, []).append(r.answer.seconds)
    in_all = len(everything) + len(calibrated) + 2 * 4 * len(broken) + sum(c.total for c in cells)
    lines = [
        "# Hidden-effect study",
        "",
        f"{in_all} campaigns, seed {seed}, on {args.workers} workers. Made by",
        "",
        f"    python -m benchmarks.discovery {' '.join(argv if argv is not None else sys.argv[1:])}".rstrip(),
        "",
        "Sizes are multiples of the minimal detectable size, by a dense oracle that knows the noise. A level is met",
        "when the 95 % Clopper-Pearson interval does not exclude it. 5+ counts every effect, isolable or not;",
        "confusions that nothing can resolve are accepted (`tests/truth/verdicts.py`).",
        "",
        "| row | measure | prototype | must | measured (95 % interval) | n | |",
        "|---|---|---|---|---|---|---|",
        *map(_row, reached),
        "",
        f"Row 3: p-values of {count} campaigns with nothing hidden, {DRAWS} draws each: Kolmogorov-Smirnov p =",
        f"{uniform:.2g} (must: > 0.01); {100 * lowest:.1f} % of them in the lowest tenth.",
        "",
        f"Row 7: mean size of the 95 % set at 3×, isolable: {levels.mean_set_size(sized[3.0]):.2f} (must: ≤ 1.5).",
        "",
        "Row 18: median seconds a diagnosis without hold-out, workers side by side: "
        + ", ".join(f"{name} {np.median(v):.1f}" for name, v in by_design.items() if v)
        + " (must: 60).",
        "",
        *confused,
        "",
        "## Other methods on the same campaigns",
        "",
        *_controls(nulls, sized[3.0], unknown[3.0], seed),
        "",
        "## Safeguards switched off",
        "",
        *mutants,
        "",
        "## Power, and p-values with nothing hidden",
        "",
        f"![share named over size; p-values against uniform]({figures['power'].name})",
        "",
        "## What is said of what was hidden, at 3×",
        "",
        f"![confusion matrix]({figures['confusion'].name})",
        "",
        *_missed(sized[3.0] + unknown[3.0] + nulls + outside),
    ]
    args.output.parent.mkdir(parents=True, exist_ok=True)
    args.output.write_text("\n".join(lines), encoding="utf-8")
    _confusion(sized[3.0] + unknown[3.0], figures["confusion"])
    p_values = np.array([r.answer.p_value for r in calibrated if r.answer])
    _curves([r for records in sized.values() for r in records], p_values, figures["power"])


if __name__ == "__main__":
    main()
