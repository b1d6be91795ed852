"""How large the best evidence ratio gets with nothing hidden, on the demo's design, by kind of noise.

    python -m benchmarks.threshold

writes benchmarks/results/threshold.md.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
from importlib import resources

import numpy as np

from benchmarks._measure import table, write_result

WHITE, FLICKER, WALK = 0.005, 0.01, 0.005  # deg/sqrt(h), deg/h, deg/h/sqrt(h): those of the demo's truth
NOISES = {
    "white": (0.0, 0.0),
    "white, flicker": (FLICKER, 0.0),
    "white, random walk": (0.0, WALK),
    "white, flicker, random walk": (FLICKER, WALK),
}


def scores(flicker: float, walk: float, draws: int, effects: list[str]) -> np.ndarray:
    """S of campaigns of noise alone, through the search that `diagnose` makes beside some effects."""
    from gyromodel import GyroModel, model_from_effects, simulate
    from gyromodel.diagnosis._bank import build_bank
    from gyromodel.diagnosis._calibrate import null_scores
    from gyromodel.diagnosis._scan import Scanner
    from gyromodel.estimate import fit_record
    from gyromodel.noise import NoiseRatios, noise_grid
    from gyromodel.plan import read_plan
    from gyromodel.signals import read_signals

    with resources.as_file(resources.files("gyromodel") / "data" / "fiber_optic_plan.yaml") as path:
        plan = read_plan(path)
    model = model_from_effects(effects)
    levels = {"noise_white": WHITE * 60.0, "noise_flicker": flicker, "noise_random_walk": walk / 60.0}
    noise = {name: np.deg2rad(level / 3600.0) for name, level in levels.items()}
    record = read_signals(simulate(GyroModel(model.effects, noise, frozenset()), plan, seed=1))
    variance = noise["noise_white"] ** 2 / record.interval
    ratios = NoiseRatios(
        np.asarray(noise["noise_flicker"] ** 2 / variance),
        np.asarray(noise["noise_random_walk"] ** 2 * record.interval / variance),
    )
    baseline = fit_record(record, model, ratios=ratios)
    grid = noise_grid(int(record.present.sum()), record.interval, record.span)
    return null_scores(Scanner(record, build_bank(record), grid), baseline, draws, 1, lambda line, done: None)


def main(argv: list[str] | None = None) -> None:
    argv = sys.argv[1:] if argv is None else argv
    parser = argparse.ArgumentParser(description="The best evidence ratio with nothing hidden.")
    parser.add_argument("--draws", type=int, default=1024, help="campaigns for each noise")
    draws = parser.parse_args(argv).draws
    from gyromodel.diagnosis import SAFE_THRESHOLD

    rows, above = [], 0
    with tempfile.TemporaryDirectory() as cache:
        os.environ["XDG_CACHE_HOME"] = cache
        cases = [(name, levels, ["bias", "bias_temperature"]) for name, levels in NOISES.items()]
        cases += [(f"{name}; no bias simulated", levels, ["bias_temperature"]) for name, levels in NOISES.items()]
        for name, levels, effects in cases:
            s = scores(*levels, draws, effects)
            over = int((s > SAFE_THRESHOLD).sum())
            above += over
            marks = [f"{v:.1f}" for v in (*np.quantile(s, [0.5, 0.95, 0.99]), s.max())]
            rows.append([name, *marks, f"{over} of {draws}"])
    head = ["noise", "median of S", "95 %", "99 %", "largest", f"over {SAFE_THRESHOLD:g}"]
    total = draws * len(cases)
    lines = [
        "S is ln of the evidence ratio of the best name or driver, less what it needs more for what a random walk "
        "would take of it. Campaigns of noise alone on the design of the fiber-optic demo, through the search over the "
        "noise cells that carry weight. A bias that is not simulated has prior odds; the walk starts at zero.",
        "",
        *table(head, rows),
        "",
        f"Over the safe threshold of {SAFE_THRESHOLD:g}: {above} of {total:,} ({100 * above / total:.2f} %).",
    ]
    write_result("threshold", "The threshold", "threshold", argv, lines)


if __name__ == "__main__":
    main()
