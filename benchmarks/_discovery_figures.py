"""Figures of the hidden-effect study."""

from __future__ import annotations

from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

from tests.truth import levels, study
from tests.truth.campaigns import known


def draw_power(records: list[study.Record], p_values: np.ndarray, path: Path) -> None:
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


def draw_confusion(records: list[study.Record], path: Path) -> None:
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


def _said(record: study.Record) -> str:
    answer = record.answer
    if answer is None:
        return "–"
    return (
        "+".join(answer.causes)
        if answer.verdict == "named" and len(answer.causes) == 1
        else ("several named" if answer.verdict == "named" else answer.verdict)
    )
