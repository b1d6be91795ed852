"""A counted angle: what is known and found where its noise is told from white noise of the rate, and where it is not.

    python -m benchmarks.angle_noise --workers 2

writes benchmarks/results/angle_noise.md.
"""

from __future__ import annotations

import argparse
import sys
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from typing import NamedTuple
from unittest.mock import patch

import numpy as np

from benchmarks._measure import share, table, write_result
from tests.truth import noise as truth

ROWS, STEP = 900, 10.0
WHITE = np.deg2rad(0.002) / 60.0  # rad/sqrt(s)
# Standard deviation of the counts' errors over what white noise turns by in a sample.
COUNTS = (0.3, 1.0, 3.0, 10.0)
DRAWS, TIMES = 24, 4.0


class Known(NamedTuple):
    """Of one draw: error and uncertainty of a temperature coefficient over the least there can be, and what is said."""

    error: float
    std: float
    white: float
    causes: tuple[str, ...]
    falsely: tuple[str, ...]


def temperature() -> np.ndarray:
    """Up and down once and half a time, from 10 to 40 degC."""
    return 25.0 + 15.0 * np.interp(np.arange(ROWS) / ROWS, [0.0, 0.3, 0.7, 1.0], [-1.0, 1.0, -1.0, 0.5])


def least(angle: float) -> float:
    """Standard error of a temperature coefficient beside a bias, by the dense covariance of what is drawn."""
    change = np.eye(ROWS) - np.eye(ROWS, k=-1)
    first = np.zeros((ROWS, ROWS))
    first[0, 0] = 1.0
    dense = WHITE**2 / STEP * np.eye(ROWS) + (angle / STEP) ** 2 * (change @ change.T + first)
    columns = np.column_stack([np.ones(ROWS), temperature() - 25.0])
    return float(np.sqrt(np.linalg.inv(columns.T @ np.linalg.solve(dense, columns))[1, 1]))


def known(seed: int, counts: float, told: bool) -> Known:
    """One draw, fitted and diagnosed; `told` apart from white noise of the rate or not."""
    import gyromodel as gm

    rng = np.random.default_rng(seed)
    angle = counts * WHITE * np.sqrt(STEP)
    best, found = least(angle), []
    for slope in (TIMES * best, 0.0):
        rate = 4e-5 + slope * (temperature() - 25.0) + truth.white(ROWS, STEP, WHITE, rng)
        output = truth.shaken(rate, STEP, angle * np.sqrt(12.0), rng)
        columns = {"time": np.arange(ROWS) * STEP, "temperature": temperature(), "output": output}
        units = {"time": "s", "temperature": "degC", "output": "rad/s"}
        campaign = gm.Campaign(columns, units, {"kind": "rate"})
        with patch("gyromodel.estimate._noise.angle_noise", lambda *_: None) if not told else patch.dict({}):
            estimate = gm.fit(campaign, gm.model_from_effects(["bias", "bias_temperature"]))
            answer = gm.diagnose(campaign, gm.model_from_effects(["bias"]), hold_out=False)
        found.append((slope, estimate, tuple(c.effect for c in answer.causes)))
    (slope, estimate, causes), (_, _, falsely) = found
    error = float(np.asarray(estimate.model.vector())[1]) - slope
    white = float(estimate.model.noise["noise_white"]) / WHITE
    return Known(error / best, float(estimate.std[1]) / best, white, causes, falsely)


def main(argv: list[str] | None = None) -> None:
    argv = sys.argv[1:] if argv is None else argv
    parser = argparse.ArgumentParser(description="A counted angle.")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args(argv)
    rows = []
    with ProcessPoolExecutor(arguments.workers, mp_context=get_context("spawn")) as pool:
        for counts in COUNTS:
            for told in (True, False):
                work = partial(known, counts=counts, told=told)
                each = list(pool.map(work, range(arguments.seed, arguments.seed + DRAWS)))
                inside = [abs(k.error) < 1.96 * k.std for k in each]
                rows.append(
                    [
                        f"{counts:g}",
                        "yes" if told else "no",
                        f"{np.sqrt(np.mean([k.error**2 for k in each])):.2f}",
                        f"{np.median([k.std for k in each]):.2f}",
                        share(inside),
                        f"{np.median([k.white for k in each]):.2f}",
                        share(["bias_temperature" in k.causes for k in each]),
                        share([bool(k.falsely) for k in each]),
                    ]
                )
    head = [
        "counts over white noise",
        "told apart",
        "error",
        "uncertainty",
        "95 % interval holds",
        "white noise found",
        "named, alone or in a set",
        "something said, nothing hidden",
    ]
    lines = [
        f"Logs at rest of a shaken gyro whose angle is counted, {ROWS} samples, {DRAWS} draws a row. A temperature",
        f"coefficient of {TIMES:g} times the least standard error there can be, by the dense covariance of what was",
        "drawn; its error (rms) and uncertainty (median) in that unit, the white noise found in that which was drawn.",
        "Counts: standard deviation of their errors over the angle that white noise turns by in a sample. Not told",
        "apart, the search and the fit take them for white noise, flicker and walk of the rate.",
        "",
        *table(head, rows),
    ]
    write_result("angle_noise", "Noise of a counted angle", "angle_noise", argv, lines)


if __name__ == "__main__":
    main()
