"""An archive of campaigns fitted one by one: `fit_many` against loops and batches of the usual solvers.

    python -m benchmarks.batch_fits

writes benchmarks/results/batch_fits.md; `benchmarks.batch_cost` says how the cost grows, and
`benchmarks.batch_gpu` what it is on a GPU.
Campaigns are drawn from the fitted model with white noise; peers are given the model's structured columns as their
Jacobian, compiled, and parameters scaled by their typical sizes, but for one row of optimistix with the parameters as
the model holds them. Every measurement runs in a process of its own.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import time
from functools import partial
from typing import Any

import numpy as np

from benchmarks._measure import MIB, in_fresh_process, peak_memory, table, timed, write_result
from gyromodel._compiling import former_fusions

STEP, SIGMA = 2.0, 0.5
LENGTHS = 3500, 6500
DEG_H = np.pi / 180 / 3600
SIZES = {"scale_factor": 1e-3, "scale_spline": 3e-4, "scale_temperature_curve": 3e-5, "bias": 3 * DEG_H}
SCIPY, STOCK = {12: 60, 40: 24}, 32
MUST = {"scipy": 8.0, "stock": 40.0, "pass": 3.0, "scipy, 40": 5.0, "compile": 10.0, "agree": 1e-4}


def thermal_rate_model(parameters: int) -> Any:
    """Spline scale factor, bias a quartic of the lagged temperature, warm-up; with 40 also curves with hinges."""
    from gyromodel.effects.drivers import Bias
    from gyromodel.effects.scale import ScaleFactor, ScaleSpline, ScaleTemperatureCurve
    from gyromodel.effects.thermal import BiasTemperatureCurve, BiasWarmup
    from gyromodel.effects.thermometer import TemperatureLag
    from gyromodel.model import GyroModel

    hinges = {n: {"hinges": np.zeros(n), "breakpoints": np.linspace(0.0, 30.0, n)} for n in (11, 14)}
    lag = TemperatureLag(coefficients=np.zeros(4), time_constant=100.0, reference=15.0)
    spline = ScaleSpline(knots=5 if parameters == 12 else 7, full_rate=1.0, lowest=-1.0)
    effects = [ScaleFactor(value=1.0), spline, Bias(), lag, BiasWarmup()]
    if parameters == 40:
        effects.append(BiasTemperatureCurve(coefficients=np.zeros(0), reference=15.0, **hinges[11]))
        effects.append(ScaleTemperatureCurve(coefficients=np.zeros(1), reference=15.0, **hinges[14]))
    fixed = {("bias_temperature_curve", "breakpoints"), ("scale_temperature_curve", "breakpoints")}
    return GyroModel(tuple(effects), {}, frozenset(fixed))


def truth(model: Any, rng: np.random.Generator) -> np.ndarray:
    """Parameters of one campaign's gyro."""
    x = np.asarray(model.vector()).copy()
    for i, slot in enumerate(model.slots()):
        label, draw = model.labels[slot.effect], rng.standard_normal()
        if label == "temperature_lag":
            x[i] = rng.uniform(20.0, 250.0) if slot.field == "time_constant" else 3.0 * 0.3**slot.index * DEG_H * draw
        elif label == "bias_warmup":
            x[i] = 5 * DEG_H * np.sign(draw) * rng.uniform(0.5, 2.0)
            if slot.field == "time_constant":
                x[i] = np.exp(rng.uniform(*np.log([150.0, 3000.0])))
        elif label == "bias_temperature_curve":
            x[i] = 0.1 * DEG_H * draw
        else:
            x[i] += SIZES[label] * draw
    return x


def campaigns(model: Any, count: int, lengths: tuple[int, int] = LENGTHS, seed: int = 1) -> Any:
    """Records of rates in random order through chamber cycles, one after the other."""
    import jax
    import jax.numpy as jnp

    from gyromodel.numerics.state_space import Sampling
    from gyromodel.signals import Record, padded_length

    predict = jax.jit(lambda x, signals: model.with_vector(x).predict(signals))
    for i in range(count):
        rng = np.random.default_rng([seed, i])
        rows = int(rng.integers(lengths[0], lengths[1] + 1))
        time = STEP * np.arange(2 ** (padded_length(rows) - 1).bit_length())
        turns, phases = 2 * np.pi / rng.uniform([5000.0, 1500.0], [9000.0, 2500.0]), rng.uniform(0, 2 * np.pi, 2)
        swings = np.array([28.0, 6.0])
        angles = turns[:, None] * time + phases[:, None]
        signals = {
            "time": time,
            "time_on": time,
            "temperature": 15.0 + swings @ np.sin(angles),
            "temperature_rate": (swings * turns) @ np.cos(angles),
            "rate": np.repeat(rng.uniform(-1.0, 1.0, len(time) // 16 + 1), 16)[: len(time)],
        }
        clean = np.asarray(predict(jnp.asarray(truth(model, rng)), signals))[:rows]
        signals = {name: values[:rows] for name, values in signals.items()}
        signals["output"] = clean + SIGMA * DEG_H * rng.standard_normal(rows)
        even = Sampling(np.full(rows, STEP), np.arange(rows) == 0, np.ones(rows, bool), np.ones(rows))
        yield Record(signals, even, rows, STEP, "rad/s", {}, np.zeros(rows, int), "none")


def _typical(model: Any) -> np.ndarray:
    """Typical sizes of the free parameters, internal units."""
    from gyromodel.units import factor, internal_unit

    declared = [model.effects[s.effect].declared()[s.field] for s in model.slots()]
    return np.array([d.typical * factor(d.unit, internal_unit(d.unit)) for d in declared])


def ours(parameters: int, count: int, lengths: tuple[int, int] = LENGTHS) -> dict[str, Any]:
    from gyromodel.estimate import fit_many

    model = thermal_rate_model(parameters)
    records = list(campaigns(model, count, lengths))
    _, first = timed(lambda: fit_many(records[: min(count, 64)], model))
    before = peak_memory()
    (fits, cost), samples = timed(lambda: fit_many(records, model)), sum(r.rows for r in records)
    (_, once) = timed(lambda: fit_many(records, model, restarts=False))
    return {
        **cost,
        "first": first["wall"],
        "without restarts": once["cpu"],
        "iterations": float(np.mean(fits.iterations)),
        "most": int(fits.iterations.max()),
        "converged": int(fits.converged.sum()),
        "restarted": int(fits.restarted.sum()),
        "chi": float(np.nanmax(fits.reduced_chi_squared)),
        "peak": peak_memory(),
        "before": before,
        "samples": samples,
        "values": fits.values[:STOCK].tolist(),
        "std": fits.std[:STOCK].tolist(),
    }


def far_start(count: int, time_constant: float) -> dict[str, Any]:
    """Fits from a time constant of the warm-up far from all of them, held against those from the usual start."""
    import jax.numpy as jnp

    from gyromodel.estimate import fit_many
    from gyromodel.model import GyroModel

    model = thermal_rate_model(12)
    warm_up = type(model.effects[-1])(time_constant=jnp.asarray(time_constant))
    far = GyroModel((*model.effects[:-1], warm_up), {}, model.fixed)
    records = list(campaigns(model, count))
    near, once, fits = fit_many(records, model), fit_many(records, far, restarts=False), fit_many(records, far)

    def apart(of: Any) -> np.ndarray:
        return np.abs((of.values - near.values) / near.std).max(axis=1)

    return {
        "wrong": int(np.sum(~(apart(once) < 0.01))),
        "restarted": int(fits.restarted.sum()),
        "wrong after": int(np.sum(~(apart(fits) < 0.01))),
        "needless": int(np.sum(fits.restarted & (apart(once) < 0.01))),
    }


def scipy_loop(parameters: int, method: str, tight: bool = False, forward: bool = False) -> dict[str, Any]:
    """What a user would do: compiled residual and Jacobian, one campaign after the other.

    Campaigns are padded to powers of two, as each length costs a program; all are compiled before. The Jacobian has
    this package's structured columns, or is JAX's by forward mode.
    """
    import jax
    from scipy.optimize import least_squares

    from gyromodel.estimate._together import described, kind_of, ready

    model = thermal_rate_model(parameters)
    start, size = np.asarray(model.vector()), _typical(model)
    records = list(campaigns(model, SCIPY[parameters]))

    @jax.jit
    def residual(u, signals):
        return (model.with_vector(u * size).predict(signals) - signals["output"]) / (SIGMA * DEG_H)

    @jax.jit
    def jacobian(u, signals):
        if forward:
            return jax.jacfwd(residual)(u, signals)
        return model.with_vector(u * size).linearise(signals)[1] * (size / (SIGMA * DEG_H))

    given = described(model)
    lengths = [512 * kind_of(ready(0, r, given))[0] for r in records]
    padded = [
        {k: np.pad(v, (0, n - r.rows), mode="edge") for k, v in r.signals.items()}
        for r, n in zip(records, lengths, strict=True)
    ]
    limits = {"ftol": 1e-15, "xtol": 1e-12, "gtol": 1e-15} if tight else {}

    def one(record: Any, signals: Any) -> Any:
        rows = record.rows
        return least_squares(
            lambda u: np.asarray(residual(u, signals))[:rows],
            start / size,
            jac=lambda u: np.asarray(jacobian(u, signals))[:rows],  # pyright: ignore[reportArgumentType]
            method=method,  # pyright: ignore[reportArgumentType]
            x_scale="jac",
            **limits,
        )

    for i in {n: i for i, n in enumerate(lengths)}.values():
        one(records[i], padded[i])
    found, cost = timed(lambda: [one(r, s) for r, s in zip(records, padded, strict=True)])
    return {
        "wall": cost["wall"] / len(found),
        "cpu": cost["cpu"] / len(found),
        "evaluations": float(np.mean([f.nfev for f in found])),
        "values": [(f.x * size).tolist() for f in found[:STOCK]],
        "chi": [2 * f.cost / (r.rows - parameters) for f, r in zip(found, records, strict=True)],
    }


def stock(parameters: int, over: str, scaled: bool) -> dict[str, Any]:
    """optimistix's Levenberg-Marquardt over a stack of campaigns padded to the longest."""
    import jax
    import jax.numpy as jnp
    import optimistix as optx

    model = thermal_rate_model(parameters)
    start = np.asarray(model.vector())
    size = _typical(model) if scaled else np.ones(len(start))
    records = list(campaigns(model, STOCK))
    longest = max(r.rows for r in records)
    names = records[0].signals
    stacked = {k: np.stack([np.pad(r.signals[k], (0, longest - r.rows), mode="edge") for r in records]) for k in names}
    weight = np.stack([np.arange(longest) < r.rows for r in records]) / (SIGMA * DEG_H)
    solver = optx.LevenbergMarquardt(rtol=1e-8, atol=1e-8)

    def one(signals, weight):
        def residual(u, _):
            return weight * (model.with_vector(u * size).predict(signals) - signals["output"])

        found = optx.least_squares(residual, solver, jnp.asarray(start / size), max_steps=256, throw=False)
        return found.value * size, found.stats["num_steps"], jnp.sum(residual(found.value, None) ** 2)

    batch = jax.jit(jax.vmap(one) if over == "vmap" else lambda *data: jax.lax.map(lambda d: one(*d), data))
    compiled = batch.lower(stacked, weight).compile()
    (x, steps, chi), cost = timed(lambda: jax.block_until_ready(compiled(stacked, weight)))
    memory = compiled.memory_analysis()
    return {
        "wall": cost["wall"] / STOCK,
        "cpu": cost["cpu"] / STOCK,
        "steps": float(np.mean(steps)),
        "most": int(np.max(steps)),
        "temporary": memory.temp_size_in_bytes,
        "values": np.asarray(x).tolist(),
        "chi": [float(c) / (r.rows - parameters) for c, r in zip(chi, records, strict=True)],
    }


def one_pass(parameters: int) -> dict[str, Any]:
    """One evaluation of the normal equations on 5 120 samples against BLAS syrk of the columns; both on one core."""
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    import jax
    import jax.numpy as jnp
    from scipy.linalg.blas import dsyrk

    from gyromodel.estimate._blocks import BLOCK, Blocks, gram_of
    from gyromodel.estimate._together import OPTIONS

    model = thermal_rate_model(parameters)
    record = next(campaigns(model, 1, (5120, 5120)))
    blocks = 5120 // BLOCK
    signals = {k: jnp.asarray(v).reshape(1, blocks, BLOCK) for k, v in record.signals.items()}
    x = jnp.asarray(truth(model, np.random.default_rng(0)))
    weight, repeats = jnp.ones((1, blocks, BLOCK)), 200

    @partial(jax.jit, compiler_options=OPTIONS)
    def passes(x, signals, weight, used, count):
        data = Blocks(signals, weight, 0, used, None)
        gram = gram_of(model, data)
        # Each pass begins where the last one ended, as far as the compiler knows.
        return jax.lax.fori_loop(0, count, lambda _, g: gram(x + 1e-300 * g[0, 0]), jnp.zeros((len(x) + 2,) * 2))

    columns = np.column_stack(model.with_vector(x).linearise(record.signals)).T
    stacked = np.asfortranarray(columns.T)

    def best(work: Any) -> float:
        work()
        return min(timed(work)[1]["cpu"] for _ in range(7)) / repeats

    floor = best(lambda: [dsyrk(1.0, stacked, trans=1) for _ in range(repeats)])
    ours = best(lambda: passes(x, signals, weight, blocks, repeats).block_until_ready())
    return {"ours": ours, "floor": floor}


def compiling(parameters: int) -> dict[str, Any]:
    """The program of the longest bucket: time to trace and to compile, temporary memory."""
    from gyromodel.estimate import _together

    model = thermal_rate_model(parameters)
    given = _together.described(model)
    records = campaigns(model, _together.TOGETHER, (6000, 6500))
    waiting = [_together.ready(i, r, given) for i, r in enumerate(records)]
    data = _together.side_by_side(waiting, 16, {})
    points = np.full((2, _together.TOGETHER), 100)
    tasks = np.arange(_together.TOGETHER), np.stack([c.start for c in waiting]), *points
    before = time.perf_counter()
    lowered = _together.search.lower(data, *tasks)
    traced = time.perf_counter()
    compiled = lowered.compile()
    done = time.perf_counter()
    return {
        "trace": traced - before,
        "compile": done - traced,
        "temporary": compiled.memory_analysis().temp_size_in_bytes,
    }


def main(argv: list[str] | None = None) -> None:
    argv = sys.argv[1:] if argv is None else argv
    parser = argparse.ArgumentParser(description="Archives of campaigns fitted by one compiled program.")
    parser.add_argument("--campaigns", type=int, default=1000)
    parser.add_argument("--only", help=argparse.SUPPRESS)
    args = parser.parse_args(argv)
    if args.only:
        name, *given = json.loads(args.only)
        print(json.dumps(globals()[name](*given)))
        return

    def run(*call: Any, **environment: str) -> Any:
        return in_fresh_process(
            "benchmarks.batch_fits", "--only", json.dumps(call), **{"JAX_PLATFORMS": "cpu"} | environment
        )

    count = args.campaigns
    with tempfile.TemporaryDirectory() as empty:
        kept = {"JAX_COMPILATION_CACHE_DIR": empty, "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"}
        compiled = {p: [run("compiling", p, **kept) for _ in range(2)] for p in (12, 40)}
    mine = {12: run("ours", 12, count), 40: run("ours", 40, max(count // 5, STOCK))}
    ragged = {40: max(count // 5, STOCK), 12: count}
    loops = {(p, m): run("scipy_loop", p, m) for p in (12, 40) for m in ("lm", "trf")}
    loops |= {(p, "lm, Jacobian by `jacfwd`"): run("scipy_loop", p, "lm", False, True) for p in (12, 40)}
    switches = " ".join(f"--{name}={str(value).lower()}" for name, value in former_fusions().items())
    alike = run("scipy_loop", 12, "lm", XLA_FLAGS=switches)
    exact = {p: run("scipy_loop", p, "lm", True) for p in (12, 40)}
    asked = ("vmap", False), ("vmap", True), ("map", True)
    batches = {(over, scaled): run("stock", 12, over, scaled) for over, scaled in asked}
    passes = {p: run("one_pass", p) for p in (12, 40)}
    far = {tau: run("far_start", min(count, 200), tau) for tau in (5.0, 60000.0)}
    lines = _page(ragged, mine, loops, alike, exact, batches, passes, compiled, far)
    write_result("batch_fits", "An archive of campaigns fitted", "batch_fits", argv, lines)


def _apart(values: list[list[float]], mine: dict[str, Any]) -> np.ndarray:
    """Largest difference of each campaign's parameters, in posterior standard deviations."""
    count = min(len(values), len(mine["values"]))
    return np.abs((np.array(values[:count]) - mine["values"][:count]) / mine["std"][:count]).max(axis=1)


def _met(value: float, must: float, above: bool) -> str:
    met = value >= must if above else value <= must
    return f"{value:.3g} (must: {'≥' if above else '≤'} {must:g}, {'met' if met else '**missed**'})"


def _page(ragged, mine, loops, alike, exact, batches, passes, compiled, far) -> list[str]:
    per_fit = {p: {k: mine[p][k] / ragged[p] for k in ("wall", "cpu", "without restarts")} for p in mine}
    rows = []
    for p in (12, 40):
        own = per_fit[p]
        name = f"**`fit_many`**, {ragged[p]} campaigns"
        steps = f"{mine[p]['iterations']:.1f} (at most {mine[p]['most']})"
        rows.append([str(p), name, f"{1e3 * own['wall']:.2f}", f"{1e3 * own['cpu']:.2f}", "1", steps])
        for method in ("lm", "trf", "lm, Jacobian by `jacfwd`"):
            r = loops[p, method]
            times = [f"{1e3 * r['wall']:.1f}", f"{1e3 * r['cpu']:.1f}", f"{r['cpu'] / own['cpu']:.1f}"]
            name = f"scipy `least_squares`, method {method}, {SCIPY[p]} campaigns"
            rows.append([str(p), name, *times, f"{r['evaluations']:.1f} residuals"])
    for (over, scaled), r in batches.items():
        times = [f"{1e3 * r['wall']:.1f}", f"{1e3 * r['cpu']:.1f}", f"{r['cpu'] / per_fit[12]['cpu']:.1f}"]
        name = f"optimistix `LevenbergMarquardt`, {over}, {'scaled' if scaled else 'as it is'}, {STOCK} campaigns"
        rows.append(["12", name, *times, f"{r['steps']:.1f} (at most {r['most']})"])
    best = {p: min(loops[p, m]["cpu"] for m in ("lm", "trf")) / per_fit[p]["cpu"] for p in (12, 40)}
    agree = {p: _apart(exact[p]["values"], mine[p]) for p in (12, 40)}
    lines = [
        "Spline scale factor, bias a quartic of the lagged temperature, warm-up; with 40 parameters also 25 hinges "
        f"over temperature. Campaigns of {LENGTHS[0]} to {LENGTHS[1]} samples, white noise of unknown size. "
        "Milliseconds a fit, everything compiled by earlier calls in a fresh process; ratios are of processor time. "
        "`fit_many` gives each core campaigns of its own, so that its wall time goes with their number, and that of a "
        "loop does not. Reading campaigns, with the smoothing of their thermometers, is not in it. Peers were measured "
        "on the first of the same campaigns, and have the same structured columns (but for the rows by `jacfwd`), "
        "compiled, and scaled parameters; scipy at its default tolerances, optimistix at 1e-8, and in one row with "
        "parameters as the model holds them, unscaled. Iterations of `fit_many` are passes over all samples, after a "
        "search on at most 512 of them.",
        "",
        *table(["parameters", "method", "wall ms", "processor ms", "ratio", "iterations"], rows),
        "",
        f"The faster of the scipy loops over `fit_many`: {_met(best[12], MUST['scipy'], True)} with 12 parameters, "
        f"{_met(best[40], MUST['scipy, 40'], True)} with 40. Peers are compiled as JAX does by "
        "default; with the switch that `fit_many` compiles with, the loop with 12 parameters (lm) takes "
        f"{1e3 * alike['cpu']:.1f} ms: {alike['cpu'] / per_fit[12]['cpu']:.2g} times as long. optimistix under "
        f"vmap, as it is: {_met(batches['vmap', False]['cpu'] / per_fit[12]['cpu'], MUST['stock'], True)}; given our "
        f"scaling: {batches['vmap', True]['cpu'] / per_fit[12]['cpu']:.3g}.",
        "",
        "## Same answers",
        "",
        "Largest difference in any parameter from scipy's at tolerances of 1e-12, in posterior standard deviations: ",
        *[
            f"{p} parameters: median {np.median(agree[p]):.1e}, largest {_met(agree[p].max(), MUST['agree'], False)}, "
            f"{len(agree[p])} campaigns."
            for p in (12, 40)
        ],
        f"Converged: {mine[12]['converged']} of {ragged[12]} and {mine[40]['converged']} of {ragged[40]}; restarted: "
        f"{mine[12]['restarted']} and {mine[40]['restarted']}.",
        "",
        "## False minima",
        "",
        "Of 200 campaigns started at a time constant of the warm-up far from all of theirs (150 to 3000 s):",
        "",
        *table(
            ["start, s", "elsewhere than from the usual start", "tried again", "of these needlessly", "elsewhere then"],
            [
                [f"{t:g}", *(str(f[k]) for k in ("wrong", "restarted", "needless", "wrong after"))]
                for t, f in far.items()
            ],
        ),
        "",
        "## One pass",
        "",
        "Residual, columns and normal equations of 5120 samples, against BLAS syrk of the columns; both on one core:",
        "",
        *table(
            ["parameters", "pass ms", "syrk ms", "ratio"],
            [
                [str(p), f"{1e3 * r['ours']:.2f}", f"{1e3 * r['floor']:.2f}", _met(r["ours"] / r["floor"], 3.0, False)]
                for p, r in passes.items()
            ],
        ),
        "",
        "## Compiling and memory",
        "",
        "A program serves one power of two of lengths; that of up to 8192 samples, in a first process and in a second "
        "one that finds the compilation cache:",
        "",
        *table(
            ["parameters", "trace s", "compile s", "second process, trace s", "compile s", "temporary memory MB"],
            [
                [
                    str(p),
                    f"{first['trace']:.2f}",
                    _met(first["compile"], MUST["compile"], False),
                    f"{second['trace']:.2f}",
                    f"{second['compile']:.2f}",
                    f"{first['temporary'] / 1e6:.2f}",
                ]
                for p, (first, second) in compiled.items()
            ],
        ),
        "",
        f"One Jacobian of 8192 samples has {8192 * 13 * 8 / 1e6:.2f} and {8192 * 41 * 8 / 1e6:.2f} MB. optimistix "
        f"takes {batches['vmap', True]['temporary'] / 1e6:.0f} MB for {STOCK} campaigns under vmap. While {ragged[12]} "
        "campaigns were fitted the largest resident memory rose by "
        f"{(mine[12]['peak'] - mine[12]['before']) / MIB:.0f} MiB.",
    ]
    return lines


if __name__ == "__main__":
    main()
