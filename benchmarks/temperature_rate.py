"""The rate of noisy, quantised thermometers: the smoothing spline against differences and Savitzky-Golay filters.

    python -m benchmarks.temperature_rate

writes benchmarks/results/temperature_rate.md.
"""

from __future__ import annotations

import argparse
import sys

import numpy as np
from scipy.interpolate import make_smoothing_spline
from scipy.signal import lfilter, savgol_filter

from benchmarks._measure import table, timed, write_result

SAMPLINGS = ((1800, 10.0), (14400, 1.0), (300, 60.0))  # rows, seconds
SENSORS = ((0.0, 0.002), (0.0, 0.05), (0.0625, 0.002), (0.0625, 0.05))  # step, noise (degC)
WIDTHS = (11, 31, 101, 301, 1001)
DRAWS = 3


def courses(rows: int, step: float) -> dict[str, np.ndarray]:
    """Temperatures (degC) between 14 and 42."""
    time, span = np.arange(rows) * step, rows * step
    corners = np.interp(time, [0, 0.2 * span, 0.6 * span, span], [14.0, 14.0, 42.0, 42.0])
    decay = np.exp(-step / 600)
    return {
        "ramp with soaks": lfilter([1 - decay], [1.0, -decay], corners, zi=[decay * 14])[0],
        "exponential soak": 42 - 28 * np.exp(-5 * time / span),
        "six sines of 5 °C": 28 + 5 * np.sin(12 * np.pi * time / span),
        "ramp with 60 ripples of 0.2 °C": 14 + 28 * time / span + 0.2 * np.sin(120 * np.pi * time / span),
    }


def plain_spline(time: np.ndarray, values: np.ndarray) -> np.ndarray:
    """scipy's smoothing spline by its own generalised cross-validation, on the same means."""
    block = -(-len(time) // 400)
    t, v = (x[: len(x) // block * block].reshape(-1, block).mean(axis=1) for x in (time, values))
    unit = (t[-1] - t[0]) / len(t)
    return make_smoothing_spline((t - t[0]) / unit, v).derivative()((time - t[0]) / unit) / unit


def main(argv: list[str] | None = None) -> None:
    argv = sys.argv[1:] if argv is None else argv
    argparse.ArgumentParser(description="The rate of noisy thermometers.").parse_args(argv)
    from gyromodel.numerics.smoothing import smooth_derivative, smoothing_bandwidth

    rng = np.random.default_rng(1)
    rows, seconds = [], []
    for samples, step in SAMPLINGS:
        time = np.arange(samples) * step
        for name, course in courses(samples, step).items():
            true = np.gradient(course, step)
            for lsb, noise in SENSORS:
                errors, edges = [], []
                for _ in range(DRAWS):
                    values = course + noise * rng.standard_normal(samples)
                    values = np.round(values / lsb) * lsb if lsb else values
                    ours, cost = timed(lambda t=time, v=values: smooth_derivative(t, v))
                    seconds.append(cost["cpu"])
                    widths = [w for w in WIDTHS if w < samples]
                    filters = [savgol_filter(values, w, 3, deriv=1, delta=step) for w in widths]
                    found = [np.gradient(values, step), plain_spline(time, values), ours, *filters]
                    errors.append([np.sqrt(np.mean((f - true) ** 2) / np.mean(true**2)) for f in found])
                    edges.append(1 / smoothing_bandwidth(time, values))
                e = np.mean(errors, axis=0)
                cells = [f"{100 * v:.2g} %" for v in (e[0], e[3:].min(), e[1], e[2])]
                rows.append(
                    [f"{samples} × {step:g} s", name, f"{lsb:g}", f"{noise:g}", *cells, f"{np.mean(edges):.0f} s"]
                )
    head = ["record", "course", "step, °C", "noise, °C", "differences", "Savitzky-Golay, best of 5 widths"]
    lines = [
        "Root-mean-square error of dT/dt over the rms of the true one, mean of "
        f"{DRAWS} draws. The best width of the filter is chosen with the truth in hand. Shortest period: of what "
        "passes with 1/√2 of its amplitude. Median processor time of the spline: "
        f"{1000 * np.median(seconds):.0f} ms.",
        "",
        *table([*head, "spline, plain cross-validation", "spline, as used", "shortest period"], rows),
    ]
    write_result("temperature_rate", "The rate of a thermometer", "temperature_rate", argv, lines)


if __name__ == "__main__":
    main()
