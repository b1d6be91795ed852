"""Generalised least squares against plain least squares on one large matrix: time and memory, each in fresh processes.

    python -m benchmarks.least_squares

writes benchmarks/results/least_squares.md. The noise (white, flicker, random walk) is known; the generalised fit builds
the whitening filter, whitens, forms the normal equations and solves them.
"""

from __future__ import annotations

import argparse
import json
import sys
from typing import Any

import numpy as np

from benchmarks._measure import MIB, in_fresh_process, peak_memory, table, timed, write_result

# Flicker and random walk relative to the white variance of a sample, and the sample interval (s).
FLICKER, WALK, INTERVAL = 0.05, 1e-7, 0.01
METHODS = {
    "lstsq": "plain: `numpy.linalg.lstsq`",
    "qr": "plain: `numpy.linalg.qr`, Qᵀy, triangular solve",
    "generalised": "**generalised: filter, `whitened_gram`, Cholesky**",
    "whitened": "generalised: filter, `whiten`, `numpy.linalg.lstsq`",
}
MUST_TIME, MUST_MEMORY = 3.0, 4.0


def _problem(rows: int, width: int, seed: int = 1) -> np.ndarray:
    """Powers of time, lines and random columns of unequal size, and last their sum in white noise."""
    rng = np.random.default_rng(seed)
    data = np.empty((rows, width + 1))
    time = np.linspace(-1.0, 1.0, rows)
    for j in range(width):
        if j < 4:
            data[:, j] = time**j
        elif j < width // 2:
            np.sin(np.pi * (j + 0.3) * time, out=data[:, j])
        else:
            data[:, j] = rng.standard_normal(rows)
        data[:, j] *= 10.0 ** (j % 3)
    np.sum(data[:, :width], axis=1, out=data[:, width])
    data[:, width] += rng.standard_normal(rows)
    return data


def _plain(method: str, columns: np.ndarray, measured: np.ndarray) -> np.ndarray:
    from scipy.linalg import solve_triangular

    if method == "lstsq":
        return np.linalg.lstsq(columns, measured, rcond=None)[0]
    q, r = np.linalg.qr(columns)
    return solve_triangular(r, q.T @ measured)


def _generalised(method: str, data: np.ndarray) -> np.ndarray:
    import jax
    import jax.numpy as jnp
    from scipy.linalg import cho_factor, cho_solve

    from gyromodel.estimate import make_filter, whiten_columns
    from gyromodel.noise import NoiseRatios
    from gyromodel.numerics.state_space import Sampling, whitened_gram

    rows, width = len(data), data.shape[1] - 1
    even = Sampling(jnp.full(rows, INTERVAL), jnp.arange(rows) == 0, jnp.ones(rows, bool), jnp.ones(rows))
    filter = make_filter(NoiseRatios(jnp.asarray(FLICKER), jnp.asarray(WALK)), INTERVAL, rows * INTERVAL, even)
    if method == "whitened":
        w = np.asarray(whiten_columns(filter, jax.device_put(data)))
        return np.linalg.lstsq(w[:, :width], w[:, width], rcond=None)[0]
    gram = np.asarray(jax.jit(whitened_gram)(filter, jax.device_put(data)))
    scale = np.sqrt(np.diag(gram)[:width])
    factor = cho_factor(gram[:width, :width] / np.outer(scale, scale))
    return cho_solve(factor, gram[:width, width] / scale) / scale


def _measure(method: str, rows: int, width: int) -> dict[str, Any]:
    """One method in this process: the first call compiles, the second is the one that counts."""
    if method in ("lstsq", "qr"):
        data = _problem(rows, width)
        columns, measured = data[:, :width].copy(), data[:, width].copy()
        del data
        empty = peak_memory()

        def work() -> np.ndarray:
            return _plain(method, columns, measured)
    else:
        import gyromodel.estimate  # noqa: F401  its import is no part of the first call

        data = _problem(rows, width)
        empty = peak_memory()

        def work() -> np.ndarray:
            return _generalised(method, data)

    _, first = timed(work)
    coefficients, second = timed(work)
    return {
        "first": first["wall"],
        **second,
        "before": empty,
        "peak": peak_memory(),
        "coefficients": list(coefficients),
    }


def main(argv: list[str] | None = None) -> None:
    argv = sys.argv[1:] if argv is None else argv
    parser = argparse.ArgumentParser(description="Generalised against plain least squares.")
    parser.add_argument("--rows", type=int, default=1_000_000)
    parser.add_argument("--columns", type=int, default=40)
    parser.add_argument("--repeats", type=int, default=3, help="fresh processes per method, taken in turns")
    parser.add_argument("--only", choices=METHODS, help=argparse.SUPPRESS)
    args = parser.parse_args(argv)
    if args.only:
        print(json.dumps(_measure(args.only, args.rows, args.columns)))
        return
    runs: dict[str, list[dict[str, Any]]] = {method: [] for method in METHODS}
    for _ in range(args.repeats):
        for method in METHODS:
            size = ("--rows", str(args.rows), "--columns", str(args.columns))
            runs[method].append(in_fresh_process("benchmarks.least_squares", "--only", method, *size))
    matrix = args.rows * args.columns * 8
    best = {m: {key: min(r[key] for r in of) for key in ("first", "wall", "cpu", "peak")} for m, of in runs.items()}
    plain = best["lstsq"]
    rows = [
        [
            METHODS[m],
            f"{b['first']:.2f}",
            f"{b['wall']:.2f}",
            f"{b['cpu']:.2f}",
            f"{b['wall'] / plain['wall']:.2f}",
            f"{b['cpu'] / plain['cpu']:.2f}",
            f"{b['peak'] / MIB:.0f}",
            f"{b['peak'] / matrix:.2f}",
        ]
        for m, b in best.items()
    ]
    head = ["method", "first call s", "s", "processor s", "time ratio", "processor ratio", "peak MiB", "peak / matrix"]
    x = {m: np.array(of[0]["coefficients"]) for m, of in runs.items()}
    apart = [float(np.max(np.abs(x[a] / x[b] - 1))) for a, b in (("generalised", "whitened"), ("qr", "lstsq"))]
    ours = best["generalised"]
    time_ratio, memory_ratio = ours["wall"] / plain["wall"], ours["peak"] / matrix
    verdicts = [
        "met" if v <= must else "**missed**" for v, must in ((time_ratio, MUST_TIME), (memory_ratio, MUST_MEMORY))
    ]
    lines = [
        f"{args.columns} columns on {args.rows:,} samples: {matrix / MIB:.0f} MiB in double precision. Best "
        f"of {args.repeats} processes, the second call in each; the first compiles. Peaks are of whole processes, with "
        "libraries and the matrix.",
        "",
        *table(head, rows),
        "",
        f"Generalised over plain (`lstsq`): time {time_ratio:.2f} (must: ≤ {MUST_TIME:g}, {verdicts[0]}), memory "
        f"{memory_ratio:.2f} matrices (must: ≤ {MUST_MEMORY:g}, {verdicts[1]}).",
        "",
        f"Coefficients of the two generalised fits agree to {apart[0]:.0e}, of the two plain ones to {apart[1]:.0e}.",
    ]
    write_result("least_squares", "Generalised against plain least squares", "least_squares", argv, lines)


if __name__ == "__main__":
    main()
