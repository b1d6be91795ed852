"""The hidden-effect study: how often the diagnosis is right, on simulated campaigns it has not seen.

    python -m benchmarks.discovery --nulls 400 --effects 600 --unknowns 300 --workers 2 --controls

writes a table with 95 % Clopper-Pearson intervals and a confusion matrix to benchmarks/results/discovery.md and .png.
"""

from __future__ import annotations

import argparse
import random
import sys
import time
from collections import Counter
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

from tests.truth import levels, study
from tests.truth.campaigns import known
from tests.truth.noise import FAMILY, OUTSIDE

RESULTS = Path(__file__).parent / "results"


def _arguments(argv: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Hidden-effect study of the diagnosis.")
    parser.add_argument("--nulls", type=int, default=400, help="campaigns with nothing hidden, per noise group")
    parser.add_argument("--effects", type=int, default=600, help="campaigns with a catalogue effect, per size")
    parser.add_argument("--unknowns", type=int, default=300, help="campaigns with an uncatalogued effect, per size")
    parser.add_argument("--inseparable", type=int, default=120, help="campaigns that cannot separate, and drifts")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--output", type=Path, default=RESULTS / "discovery.md")
    parser.add_argument("--controls", action="store_true", help="also the control methods that should fail")
    return parser.parse_args(argv)


def _row(v: levels.Level) -> str:
    low, high = v.interval
    must = f"{'≥' if v.at_least else '≤'} {100 * v.must:.1f} %"
    measured = f"{100 * v.share:.1f} % ({100 * low:.1f}-{100 * high:.1f})"
    verdict = "met" if v.met else "**missed**"
    return f"| {v.row} | {v.measure} | {v.prototype} | {must} | {measured} | {v.total} | {verdict} |"


def _controls(nulls: list[study.Record], effects: list[study.Record], seed: int) -> list[str]:
    """Share of false extensions and of exact names at 3 x MDE, for each control and for shuffled truths."""
    truths = [r.case.effect for r in effects]
    most = Counter(truths).most_common(1)[0][0]
    lines = ["| control | false extension, nothing hidden | exact name, 3× |", "|---|---|---|"]
    for name in study.CONTROLS:
        false = np.mean([bool(r.controls[name].added) for r in nulls])
        exact = np.mean([r.controls[name].added == (r.case.effect,) for r in effects])
        lines.append(f"| {name.replace('_', ' ')} | {100 * false:.1f} % | {100 * exact:.1f} % |")
    lines.append("| always none | 0.0 % | 0.0 % |")
    lines.append(f"| most frequent name ({most}) | 100.0 % | {100 * np.mean([t == most for t in truths]):.1f} % |")
    knew = np.mean([r.oracle_first == r.case.effect for r in effects])
    lines.append(f"| oracle: noise and size known, an effect is there | – | {100 * knew:.1f} % |")
    shuffled = random.Random(seed).sample(truths, len(truths))
    chance = np.mean([r.answer is not None and r.answer.causes == (t,) for r, t in zip(effects, shuffled, strict=True)])
    lines.append(f"| the engine against shuffled truths | – | {100 * chance:.1f} % |")
    return lines


def _said(record: study.Record) -> str:
    answer = record.answer
    if answer is None:
        return "–"
    return (
        "+".join(answer.causes)
        if answer.verdict == "named" and len(answer.causes) == 1
        else ("several named" if answer.verdict == "named" else answer.verdict)
    )


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
    start = time.time()

    def run(label: str, cases: list[study.Case], **options: bool) -> list[study.Record]:
        records = study.run_cases(cases, args.workers, **options)
        print(f"{label}: {len(records)} campaigns, {time.time() - start:.0f} s", file=sys.stderr, flush=True)
        return records

    nulls = run("nothing hidden", study.null_cases(args.nulls, args.seed), controls=args.controls)
    outside = run("noise outside the family", study.null_cases(args.nulls, args.seed + 1, OUTSIDE))
    sized = {}
    for k, size in enumerate((1.0, 3.0, 10.0)):
        cases = study.effect_cases(args.effects, args.seed + 10 + k, size, FAMILY)
        sized[size] = run(f"effects at {size:g} x MDE", cases, controls=args.controls and size == 3.0, gain=size == 3.0)
    unknown = []
    for k, size in enumerate((3.0, 10.0)):
        unknown += run(
            f"unknown at {size:g} x MDE", study.unknown_cases(args.unknowns, args.seed + 20 + k, size, FAMILY)
        )
    inseparable = run("inseparable", study.inseparable_cases(args.inseparable, args.seed + 30))
    drifts = run("drifts", study.drift_cases(args.inseparable, args.seed + 31))

    effects = [r for records in sized.values() for r in records]
    levels = levels.null_levels(nulls + outside) + levels.effect_levels(effects) + levels.unknown_levels(unknown)
    levels += [*levels.ambiguity_levels(inseparable, drifts), levels.gain_coverage(sized[3.0])]
    levels.sort(key=lambda v: (float(v.row.rstrip("+")), v.measure))
    everything = [*nulls, *outside, *effects, *unknown, *inseparable, *drifts]
    seconds = [r.answer.seconds for r in everything if r.answer]
    figure = args.output.with_suffix(".png")
    lines = [
        "# Hidden-effect study",
        "",
        f"{len(everything)} campaigns, seed {args.seed}, {np.median(seconds):.2f} s a diagnosis (median). Made by",
        "",
        f"    python -m benchmarks.discovery {' '.join(argv if argv is not None else sys.argv[1:])}".rstrip(),
        "",
        "Sizes are multiples of the minimal detectable size, by a dense oracle that knows the noise. A level is met",
        "when the 95 % Clopper-Pearson interval does not exclude it. Rows are those of the numbers to reach; 5+ counts",
        "every effect, isolable or not; confusions that nothing can resolve are accepted (`tests/truth/verdicts.py`).",
        "",
        "| row | measure | prototype | must | measured (95 % interval) | n | |",
        "|---|---|---|---|---|---|---|",
        *map(_row, levels),
        "",
        f"Mean size of the 95 % set at 3×, isolable campaigns: {levels.mean_set_size(sized[3.0]):.2f} (must: ≤ 1.5).",
        "",
    ]
    if args.controls:
        lines += ["## Controls", "", *_controls(nulls, sized[3.0], args.seed), ""]
    lines += ["## What is said of what was hidden, at 3×", "", f"![confusion matrix]({figure.name})", ""]
    args.output.parent.mkdir(parents=True, exist_ok=True)
    args.output.write_text("\n".join(lines), encoding="utf-8")
    _confusion(sized[3.0] + [r for r in unknown if r.case.times_mde == 3.0], figure)


if __name__ == "__main__":
    main()
