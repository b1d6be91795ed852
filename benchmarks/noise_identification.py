"""Errors of noise coefficients by slope reading, fits of the Allan variance and likelihood, on simulated static logs.

    python -m benchmarks.noise_identification

writes benchmarks/results/noise_identification.md. The logs (6 h at 10 Hz) come from tests/truth/noise.py, which shares
no code with the package: white noise and random walk, white noise alone, white noise and flicker.
"""

from __future__ import annotations

import argparse
import sys

import numpy as np
from scipy.optimize import nnls

from benchmarks._measure import share, table, timed, write_result

ROWS, STEP = 216_000, 0.1
N, K, B = 3e-3, 2e-6, 3e-4  # deg/s/sqrt(Hz), deg/s^1.5, deg/s
TRUTHS = {"white + walk": (N, 0.0, K), "white": (N, 0.0, 0.0), "white + flicker": (N, B, 0.0)}


def _log(truth: str, seed: int) -> np.ndarray:
    from tests.truth import noise

    white, flicker, walk = TRUTHS[truth]
    rng = np.random.default_rng([list(TRUTHS).index(truth), seed])
    log = noise.white(ROWS, STEP, white, rng)
    if flicker:
        log += noise.flicker(ROWS, STEP, flicker, rng)
    if walk:
        log += noise.random_walk(ROWS, STEP, walk, rng)
    return log


def _read_slopes(tau: np.ndarray, sigma: np.ndarray) -> tuple[float, float]:
    """N and K from the points where the curve's slope comes nearest to −½ and +½."""
    slope = np.gradient(np.log(sigma), np.log(tau))
    white, walk = (int(np.argmin(np.abs(slope - s))) for s in (-0.5, 0.5))
    return float(sigma[white] * np.sqrt(tau[white])), float(sigma[walk] * np.sqrt(3.0 / tau[walk]))


def _fit_curve(tau: np.ndarray, sigma: np.ndarray, freedom: np.ndarray, *, known: bool) -> tuple[float, float]:
    """N and K by non-negative least squares of the Allan variance, weighted by its own scatter."""
    shapes = (
        [1 / tau, tau / 3] if known else [1 / tau, tau / 3, 3 / tau**2, 2 * np.log(2) / np.pi + 0 * tau, tau**2 / 2]
    )
    weight = np.sqrt(freedom) / sigma**2
    squares = nnls(np.column_stack(shapes) * weight[:, None], sigma**2 * weight)[0]
    return float(np.sqrt(squares[0])), float(np.sqrt(squares[1]))


def _oracle(log: np.ndarray) -> tuple[float, float]:
    """N and K of greatest restricted likelihood, told that there is nothing else."""
    from gyromodel.noise import deviation
    from gyromodel.noise._fits import WALK, WHITE, Fits
    from gyromodel.noise._identify import _start
    from gyromodel.noise._reduced import reduced

    scale, time = log.std(), np.arange(ROWS) * STEP
    record = reduced(time, log / scale, np.ones((ROWS, 1)), time == 0, STEP, ROWS)
    fits = Fits(record, STEP, ROWS * STEP, _start(deviation(log / scale, STEP)))
    known = (True, False, False, True, False)
    fits.fit([known])
    x = scale * np.exp(0.5 * fits.found[known][0])
    return float(x[WHITE] * np.sqrt(STEP)), float(x[WALK])


def main(argv: list[str] | None = None) -> None:
    argv = sys.argv[1:] if argv is None else argv
    parser = argparse.ArgumentParser(description="Errors of noise coefficients.")
    parser.add_argument("--seeds", type=int, default=40, help="logs of each kind")
    seeds = parser.parse_args(argv).seeds

    from gyromodel.noise import deviation, identify_noise

    time = np.arange(ROWS) * STEP
    errors: dict[str, list[tuple[float, float]]] = {}
    verdicts: dict[str, list[dict[str, str]]] = {}
    covered: dict[str, list[tuple[bool, bool]]] = {}
    seconds = []
    for truth, (white, _, walk) in TRUTHS.items():
        for seed in range(seeds):
            log = _log(truth, seed)
            found, spent = timed(lambda log=log: identify_noise(log, time))
            seconds.append(spent["wall"])
            n, k = found.terms["noise_white"], found.terms["noise_random_walk"]
            verdicts.setdefault(truth, []).append({key: term.verdict for key, term in found.terms.items()})
            covered.setdefault(truth, []).append((n.low <= white <= n.high, k.low <= walk <= k.high))
            if truth == "white + walk":
                seen = deviation(log, STEP)
                curve = seen.tau, seen.deviation
                results = {
                    "slope reading": _read_slopes(*curve),
                    "non-negative least squares": _fit_curve(*curve, seen.degrees_of_freedom, known=False),
                    "the same, told the two terms": _fit_curve(*curve, seen.degrees_of_freedom, known=True),
                    "likelihood, told the two terms (oracle)": _oracle(log),
                    "**identify_noise**": (n.value, k.value),
                }
                for method, (a, b) in results.items():
                    errors.setdefault(method, []).append((a / N - 1, b / K - 1))
            print(truth, seed, f"{spent['wall']:.1f} s", n[:4], k[:4], file=sys.stderr, flush=True)
    rms = {method: 100 * np.sqrt(np.mean(np.square(e), axis=0)) for method, e in errors.items()}
    rows = [[method, f"{a:.2f}", f"{b:.0f}"] for method, (a, b) in rms.items()]
    ids = [key for key in verdicts["white"][0] if key != "noise_white"]
    counts = [
        [truth, key, *(str(sum(v[key] == verdict for v in of)) for verdict in ("found", "ambiguous"))]
        for truth, of in verdicts.items()
        for key in ids
    ]
    coverage = [[truth, *(share(int(hits), len(of)) for hits in np.sum(of, axis=0))] for truth, of in covered.items()]
    lines = [
        f"{seeds} logs of each kind, 6 h at 10 Hz: N = {N:g} deg/s/√Hz, with K = {K:g} deg/s^1.5, alone, or with "
        f"B = {B:g} deg/s. One identification with its intervals took {np.median(seconds):.1f} s (median of "
        f"{len(seconds)}).",
        "",
        "Root mean square errors with white noise and random walk:",
        "",
        *table(["method", "N, %", "K, %"], rows),
        "",
        "How often 95 % intervals hold the truth (K = 0 where there is none):",
        "",
        *table(["log", "N", "K"], coverage),
        "",
        f"How often other kinds were found, or called ambiguous (one of several), of {seeds}:",
        "",
        *table(["log", "kind", "found", "ambiguous"], counts),
    ]
    write_result("noise_identification", "Noise coefficients from simulated logs", "noise_identification", argv, lines)


if __name__ == "__main__":
    main()
