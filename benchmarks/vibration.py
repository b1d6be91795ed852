"""Angular vibration: two estimators of amplitude and phase, and what the published table says of its platform.

    python -m benchmarks.vibration

writes benchmarks/results/vibration.md.
"""

from __future__ import annotations

import argparse
import sys
from typing import Any

import numpy as np

from benchmarks._measure import table, write_result

# Amplitude of the published test (deg), records of each row, samples of each (100 Hz, 20 s).
AMPLITUDE, RECORDS, SAMPLES, STEP = 0.15, 400, 2000, 0.01
PERIODS = 20
NOISES, PHASES = (2e-4, 6e-4), (0.0, -0.1, -0.5, -2.0)
# Explanations that none of the others beats by more than chance, and tests that may tell them apart.
LEADING = (
    "time offset, resonance",
    "resonance, damped against inertial space",
    "time offset, friction, double integration",
    "friction, resonance, quick integration",
)
FURTHER = (40.0, 60.0, 80.0, 100.0, 140.0)
TOLD_APART = 3.3


def estimators(records: int) -> list[list[str]]:
    """Mean and standard deviation of the phase by both estimators, in whole periods without drift."""
    import jax
    import jax.numpy as jnp

    from gyromodel.platform import fit_sines, published_response

    rng, rows = np.random.default_rng(0), []
    time = np.arange(SAMPLES) * STEP
    w = 2 * np.pi * PERIODS / (SAMPLES * STEP)
    fits = jax.jit(jax.vmap(lambda x, y: fit_sines(jnp.asarray(time), x, y, w, degree=0)))
    for noise in NOISES:
        for phase in PHASES:
            clean = (AMPLITUDE * np.sin(w * time + p) for p in (np.deg2rad(phase), 0.0))
            base, table_ = (jnp.asarray(x + noise * rng.standard_normal((records, SAMPLES))) for x in clean)
            plain = np.asarray(published_response(base, table_).phase)
            taken = np.asarray(published_response(base, table_, noise**2, noise**2).phase)
            found = fits(base, table_)
            stated = float(np.sqrt(np.mean(np.asarray(found.phase_std) ** 2)))
            there = taken[np.isfinite(taken)]
            rows.append(
                [
                    f"{3600 * noise:.1f}",
                    f"{phase:g}",
                    _cell(plain),
                    f"{_cell(there)} ({np.isnan(taken).mean():.0%})",
                    _cell(np.asarray(found.phase)),
                    f"{stated:.4f}",
                ]
            )
    return rows


def _cell(values: np.ndarray) -> str:
    return f"{values.mean():.4f} ± {values.std(ddof=1):.4f}"


def explanations(phase_std: np.ndarray | None) -> dict[str, Any]:
    """Every alternative fitted to the printed table."""
    from gyromodel.estimate import EstimateError
    from gyromodel.platform import ALTERNATIVES, FREQUENCIES, PRINTED_GAIN, PRINTED_PHASE, explain, points

    printed = PRINTED_GAIN.ravel(), PRINTED_PHASE.ravel()
    at, found = points(FREQUENCIES), {}
    for name, alternative in ALTERNATIVES.items():
        try:
            found[name] = explain(alternative, at, *printed, signed=False, phase_std=phase_std)
        except EstimateError as error:
            print(f"{name}: {error}", file=sys.stderr)
    return found


def _entries(found: Any, part: slice, unit: float) -> str:
    value, std = found.value[part] * unit, found.std[part] * unit
    if not value.any():
        return ""
    pairs = [f"{v:.1f} ± {s:.1f}" if s else "0" for v, s in zip(value, std, strict=True)]
    return pairs[0] if len(set(pairs)) == 1 else ", ".join(pairs)


def table_of_explanations() -> tuple[list[list[str]], dict[str, Any]]:
    """Rows in the order of the criterion with equal scatter of the phases."""
    from gyromodel.platform import FREQUENCIES, Loop

    same = explanations(None)
    growing = explanations(np.tile((1 + FREQUENCIES) / 10, 3))
    best = [min(e.criterion for e in group.values()) for group in (same, growing)]
    rows, inertia = [], float(Loop().inertia)
    for name, e in sorted(same.items(), key=lambda item: item[1].criterion):
        rows.append(
            [
                name,
                f"{e.criterion - best[0]:.1f}",
                f"{growing[name].criterion - best[1]:.1f}" if name in growing else "not determined",
                f"{e.scatter[0]:.3f}, {e.scatter[1]:.2f}",
                _entries(e, slice(0, 3), 1e3),
                _entries(e, slice(3, 6), 1 / inertia),
                _entries(e, slice(6, 9), 1e3 / inertia),
                _entries(e, slice(9, 12), 1e6),
                _entries(e, slice(12, 13), 1e3),
                _entries(e, slice(13, 14), 1.0),
            ]
        )
    return rows, same


def further_tests(fitted: dict[str, Any]) -> list[list[str]]:
    """The least separation of any two leading explanations with each further test, and that of either cause of lag."""
    from gyromodel.platform import ALTERNATIVES, FREQUENCIES, points, separation

    tests = {"none": None, "the same again, phases with sign": points(FREQUENCIES)}
    tests |= {f"{w:g} rad/s": points(np.array([w])) for w in FURTHER}
    tests["the same at half the amplifier gain"] = points(FREQUENCIES, amplifier=0.5)
    tests["the same, gyros integrated by navigation"] = points(FREQUENCIES, integrated=1.0)
    at, rows = points(FREQUENCIES), []
    for name, test in tests.items():
        apart = {(a, b): separation(fitted[a], ALTERNATIVES[b], at, test) for a in LEADING for b in LEADING if a != b}
        rival = min(apart[a, b] for a, b in ((LEADING[0], LEADING[3]), (LEADING[3], LEADING[0])))
        pair, least = min(apart.items(), key=lambda item: item[1])
        rows.append([name, f"{rival:.1f}", f"{least:.1f}", f"{pair[0]} / {pair[1]}"])
        print(name, file=sys.stderr)
    return rows


def limits(scatter: np.ndarray) -> list[list[str]]:
    """The printed points against the design limits with the estimated scatter, phases of either sign."""
    from scipy.stats import t as student

    from gyromodel.platform import FREQUENCIES, PRINTED_GAIN, PRINTED_PHASE, judge_gain, judge_phase

    # Gains and phases have at least eight degrees of freedom each beside what an explanation takes.
    half = student.ppf(0.975, 8) * scatter
    gain = judge_gain(PRINTED_GAIN - half[0], PRINTED_GAIN + half[0])
    phase = judge_phase(-PRINTED_PHASE - half[1], -PRINTED_PHASE + half[1])
    return [
        [axis, f"{w:g}", f"{PRINTED_GAIN[k, j]:.2f}", gain[k, j], f"{PRINTED_PHASE[k, j]:.2f}", phase[k, j]]
        for k, axis in enumerate("XYZ")
        for j, w in enumerate(FREQUENCIES)
    ]


def main(argv: list[str] | None = None) -> None:
    argv = sys.argv[1:] if argv is None else argv
    parser = argparse.ArgumentParser(description="Angular vibration.")
    parser.add_argument("--records", type=int, default=RECORDS, help="records of each row of the first table")
    records = parser.parse_args(argv).records
    rows, fitted = table_of_explanations()
    best = min(fitted.values(), key=lambda e: e.criterion)
    lines = [
        "## Two estimators of a phase",
        "",
        f"{records} records of {PERIODS} periods, {SAMPLES} samples, amplitude {AMPLITUDE}° of table and base, equal "
        "white noise in both, no drift. Mean and standard deviation of the phase in degrees: as published with σ² "
        "left at zero; as published with σ² given (of the records that have an arccos; in brackets those that have "
        "none); and by the fit of sines, with the standard error that it states.",
        "",
        *table(
            ["noise, arcsec", "true phase", "published", "published, σ² given", "sine fit", "stated"],
            estimators(records),
        ),
        "",
        "## What explains the published table",
        "",
        "Each alternative fitted to twelve amplitudes and twelve phases without sign, whose scatter (dB, deg) is what "
        "the fit leaves. Δ is Akaike's criterion (corrected for few points) above the best: with equal scatter of all "
        "phases, and with one that grows as 1 + ω s. Values are of equal scatter; time offset in ms, friction c/J of "
        "X, Y, Z in 1/s, dry friction M/J in 1e-3 rad/s², compliance 1/ω_n² of X, Y, Z in 1e-6 s², lag 2ζ/ω_n in ms, "
        "corner of the integration in rad/s, where it is fitted. What would be negative is held at zero; what the "
        "points do not determine with equal scatter is not listed. Friction acts through the default loop unless said: "
        "integration from 40 rad/s down; quick, from 120 rad/s; double, twice from 48 rad/s.",
        "",
        *table(
            [
                "alternative",
                "Δ",
                "Δ, growing",
                "scatter",
                "time offset",
                "friction",
                "dry",
                "compliance",
                "lag",
                "corner",
            ],
            rows,
        ),
        "",
        "## Which further test would tell",
        "",
        "Standard deviations (of the scatter estimated above, the same at all frequencies) by which an explanation "
        "misses what another predicts, refitted to the printed points and the further ones of all axes together: of "
        f"a time offset and friction, each with a resonance, and least of any two of {', '.join(LEADING)}. With "
        f"{TOLD_APART} the wrong one is preferred in 5 % of repetitions.",
        "",
        *table(["further test", "offset or friction", "any two", "least of"], further_tests(fitted)),
        "",
        "## Design limits",
        "",
        f"With 95 % intervals from the scatter of the best explanation ({best.scatter[0]:.3f} dB, "
        f"{best.scatter[1]:.2f}°), and phases taken for lags. The printed values themselves are all within the limits.",
        "",
        *table(["axis", "rad/s", "dB", "", "deg", ""], limits(best.scatter)),
    ]
    write_result("vibration", "Angular vibration", "vibration", argv, lines)


if __name__ == "__main__":
    main()
