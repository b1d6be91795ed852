"""Whether the stated uncertainties of the figures of merit are those that they have, on simulated runs of known noise.

    python -m benchmarks.figures_of_merit

writes benchmarks/results/figures_of_merit.md.
"""

from __future__ import annotations

import argparse
import sys

import numpy as np

from benchmarks._measure import table, write_result
from tests.truth import noise as truth

ROWS, STEP = 1024, 10.0
WHITE, FLICKER, WALK = 0.01, 0.03, 0.1  # deg/sqrt(h), deg/h, deg/h/sqrt(h)
DEG_H = np.deg2rad(1 / 3600)
KINDS = ("white", "white, random walk", "white, flicker")


def draw(kind: str, rng: np.random.Generator) -> np.ndarray:
    """One run's noise in deg/h; the random walk begins at the start of the run."""
    noise = truth.white(ROWS, STEP, 60 * DEG_H * WHITE, rng) / DEG_H
    if "walk" in kind:
        noise = noise + WALK / 60 * np.sqrt(STEP) * np.cumsum(rng.standard_normal(ROWS))
    if "flicker" in kind:
        noise = noise + truth.flicker(ROWS, STEP, FLICKER, rng)
    return noise


def study(seeds: int) -> list[list[str]]:
    """A row for each noise and figure."""
    from gyromodel import Campaign
    from gyromodel.figures_of_merit import figures_of_merit

    rows = []
    time = np.arange(ROWS) * STEP
    for kind in KINDS:
        rng = np.random.default_rng(KINDS.index(kind))
        values: dict[str, list[tuple[float, ...]]] = {}
        naive = []
        for _ in range(seeds):
            output = draw(kind, rng)
            run = Campaign({"time": time, "output": output}, {"time": "s", "output": "deg/h"}, {"kind": "rate"})
            naive.append(output.std(ddof=1) / np.sqrt(ROWS))
            for f in figures_of_merit(run).figures[:4]:
                values.setdefault(f.symbol, []).append((f.published, f.published_std, f.modern, f.modern_std))
        for symbol, found in values.items():
            v = np.array(found)
            refused = int(np.isnan(v[:, 0]).sum())
            good = v[np.isfinite(v[:, 0])]
            cells = [_cell(good[:, 0], good[:, 1]) if len(good) > 2 else "–", _cell(v[:, 2], v[:, 3])]
            plain = f"{v[:, 0].std(ddof=1) / np.mean(naive):.1f}" if symbol == "B0" else ""
            rows.append([kind, symbol, *cells, f"{refused} of {seeds}", plain])
        print(kind, file=sys.stderr)
    return rows


def _cell(value: np.ndarray, std: np.ndarray) -> str:
    return f"{value.mean():.4f}, {value.std(ddof=1) / np.sqrt(np.mean(std**2)):.2f}"


def main(argv: list[str] | None = None) -> None:
    argv = sys.argv[1:] if argv is None else argv
    parser = argparse.ArgumentParser(description="Uncertainties of the figures of merit.")
    parser.add_argument("--seeds", type=int, default=60, help="runs for each noise")
    seeds = parser.parse_args(argv).seeds
    head = ["noise", "figure", "published: mean, scatter/stated", "modern: mean, scatter/stated", "refused"]
    lines = [
        f"{seeds} runs of {ROWS} samples {STEP:g} s apart for each noise: white {WHITE} deg/√h, random walk {WALK} "
        f"deg/h/√h from the start of the run, flicker {FLICKER} deg/h that began long before it; no bias. "
        "Scatter/stated is the standard deviation of the figure over runs, over the root mean square of its stated "
        "standard uncertainty: one is right. The last column is the same for B0 with s/√n.",
        "",
        *table([*head, "B0 with s/√n"], study(seeds)),
    ]
    write_result("figures_of_merit", "Uncertainties of the figures of merit", "figures_of_merit", argv, lines)


if __name__ == "__main__":
    main()
