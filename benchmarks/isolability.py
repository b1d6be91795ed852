"""Row 11 of the hidden-effect study: confusion of two effects, predicted before the data and counted.

    python -m benchmarks.isolability --workers 2

writes benchmarks/results/isolability.md.
"""

from __future__ import annotations

import argparse
import sys
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import numpy as np

from benchmarks._measure import table, write_result
from tests.truth import study

# Pairs of one-column effects (design, hidden effect, rival), cells of each, campaigns a cell, predicted shares between.
PAIRS = (
    ("static_cycle", "bias_temperature", "bias_drift"),
    ("static_cycle", "bias_supply_voltage", "bias_temperature_rate"),
    ("static_cycle", "bias_drift", "bias_laser_current"),
    ("static_cycle", "bias_pressure", "bias_temperature"),
    ("rate_temperature", "bias_temperature", "bias_drift"),
    ("rate_temperature", "bias_supply_voltage", "bias_drift"),
    ("rate_steps", "bias_temperature", "bias_drift"),
)
CELLS, PER_CELL, PREDICTED = 3, 60, (0.03, 0.45)
# What must be reached, and what is wished for.
DEVIATION, CORRELATION = (0.05, 0.03), (0.85, 0.92)


def summary(cells: list[study.Confusion], rng: np.random.Generator) -> list[list[str]]:
    """Deviation and correlation of counted from predicted shares, with intervals of cells drawn again."""
    predicted, total = (np.array([getattr(c, name) for c in cells]) for name in ("predicted", "total"))
    counted = np.array([c.wrong for c in cells]) / total
    scatter = counted * (1 - counted) / (total - 1)

    def measures(rows: np.ndarray) -> tuple[float, float, float]:
        p, c, s = predicted[rows], counted[rows], scatter[rows].mean()
        deviation = np.sqrt(max(np.mean((c - p) ** 2) - s, 0.0))
        together, of_counts = np.mean((p - p.mean()) * (c - c.mean())), np.var(c)
        plain, true = (together / np.sqrt(np.var(p) * v) if v > 0 else np.nan for v in (of_counts, of_counts - s))
        return float(deviation), float(plain), float(min(true, 1.0))

    of = measures(np.arange(len(cells)))
    again = np.array([measures(rows) for rows in rng.integers(len(cells), size=(2000, len(cells)))])
    rows = []
    for i, (name, at_least, wanted) in enumerate(
        (
            ("deviation, root mean square", False, DEVIATION),
            ("correlation of the counts", True, CORRELATION),
            ("correlation of the shares", True, CORRELATION),
        )
    ):
        low, high = np.nanquantile(again[:, i], [0.025, 0.975])
        row = [name]
        for level, short in zip(wanted, ("**missed**", "missed"), strict=True):
            met, open_ = (of[i] >= level, high >= level) if at_least else (of[i] <= level, low <= level)
            row.append(f"{'≥' if at_least else '≤'} {level:g}: {'met' if met else 'open' if open_ else short}")
        rows.append([*row, f"{of[i]:.3f} ({low:.3f} to {high:.3f})"])
    return rows


def main(argv: list[str] | None = None) -> None:
    argv = sys.argv[1:] if argv is None else argv
    parser = argparse.ArgumentParser(description="Confusion of two effects, predicted and counted.")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args(argv)
    rng = np.random.default_rng(arguments.seed)
    drawn = [
        (int(rng.integers(2**53)), *pair, float(rng.uniform(*PREDICTED)), PER_CELL)
        for pair in PAIRS
        for _ in range(CELLS)
    ]
    with ProcessPoolExecutor(arguments.workers, mp_context=get_context("spawn")) as pool:
        cells = list(pool.map(study.confusion, *zip(*drawn, strict=True)))
    each = [
        [c.design, c.effect, c.rival, f"{100 * c.predicted:.0f} %", f"{c.wrong} of {c.total}"]
        for c in sorted(cells, key=lambda c: (PAIRS.index((c.design, c.effect, c.rival)), c.predicted))
    ]
    lines = [
        f"{len(cells)} cells of {PER_CELL} campaigns of white noise, each with a design, a noise level and a predicted",
        "share of its own. The deviation, and the correlation of the shares, have the scatter of the counts taken out;",
        "the scatter alone keeps the correlation of the counts from reaching one. Intervals (95 %) are those of cells",
        "drawn again; open is what is not met and not excluded by them.",
        "",
        *table(["measure", "must", "goal", "measured"], summary(cells, rng)),
        "",
        *table(["design", "hidden", "rival", "preferred to it: predicted", "counted"], each),
    ]
    write_result("isolability", "What can be told apart, predicted and counted", "isolability", argv, lines)


if __name__ == "__main__":
    main()
