"""Attitude, full navigation and sensitivities of a million steps, beside loops that numba has compiled.

    python -m benchmarks.navigation_speed

writes benchmarks/results/navigation_speed.md. Without numba there is nothing to compare with, and the page says so.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable
from importlib.util import find_spec
from itertools import product
from typing import Any

import numpy as np

from benchmarks._measure import MIB, in_fresh_process, peak_memory, table, timed, write_result
from gyromodel._compiling import FUSIONS, LOOPS

STEP, CALLS = 1e-3, 7
# Steps of an epoch: a history at each step, at 100 Hz, and of 100 epochs in a million steps.
EVERY = (1, 10, 100, 10_000)
# By default XLA compiles as one kernel only the smallest loops, and dispatches the operations of others one by one.
AS_COMMANDS = f"--{FUSIONS}=false {LOOPS}"
MUST_NAVIGATION, MUST_SENSITIVITY = 1.5, 1.5


def _motion(steps: int) -> tuple[np.ndarray, np.ndarray]:
    """Angle and velocity increments of a platform near rest at 40° of latitude."""
    rng = np.random.default_rng(1)
    angle = 1e-6 * rng.standard_normal((steps, 3))
    return angle, STEP * np.array([0.0, 9.80, 0.0]) + 1e-6 * rng.standard_normal((steps, 3))


def _peer(angle: np.ndarray, velocity: np.ndarray, position: np.ndarray, every: int) -> dict[str, Callable[[], Any]]:
    """The same as loops over scalars, compiled by numba; Earth, gravity and position at each step or epoch."""
    import numba

    jit: Any = numba.njit

    @jit
    def exponential(x, y, z):
        angle = np.sqrt(x * x + y * y + z * z)
        s = np.sin(0.5 * angle) / angle if angle > 1e-8 else 0.5
        return np.cos(0.5 * angle), s * x, s * y, s * z

    @jit
    def product(a, b, c, d, w, x, y, z):
        return (
            a * w - b * x - c * y - d * z,
            a * x + b * w + c * z - d * y,
            a * y - b * z + c * w + d * x,
            a * z + b * y - c * x + d * w,
        )

    @jit
    def rotate(w, x, y, z, a, b, c):
        p, q, r = 2 * (y * c - z * b), 2 * (z * a - x * c), 2 * (x * b - y * a)
        return a + w * p + y * r - z * q, b + w * q + z * p - x * r, c + w * r + x * q - y * p

    @jit
    def attitude(turns, every):
        out = np.empty((len(turns) // every, 4))
        w, x, y, z = 1.0, 0.0, 0.0, 0.0
        for k in range(len(turns)):
            e = exponential(turns[k, 0], turns[k, 1], turns[k, 2])
            w, x, y, z = product(w, x, y, z, *e)
            if (k + 1) % every == 0:
                out[k // every, 0], out[k // every, 1], out[k // every, 2], out[k // every, 3] = w, x, y, z
        return out

    @jit
    def change(lat, h, v, u, t):
        s, c = np.sin(lat), np.cos(lat)
        flat = 1 - 0.00669437999014 * s * s
        across = 6378137.0 / np.sqrt(flat)
        meridian = across * (1 - 0.00669437999014) / flat
        g = 9.7803253359 * (1 + 0.00193185265241 * s * s) / np.sqrt(flat)
        r = h / 6378137.0
        g *= 1 - 2 * (1.00680259717 - 0.00670562132 * s * s) * r + 3 * r * r
        en, em = v[2] / (across + h), -v[0] / (meridian + h)
        a, b, d = 7.292115e-5 * c + en, 7.292115e-5 * s + en * s / c, em
        e, f = a + 7.292115e-5 * c, b + 7.292115e-5 * s
        dn = u[0] - 0.5 * t * (b * u[2] - d * u[1]) - t * (f * v[2] - d * v[1])
        du = u[1] - 0.5 * t * (d * u[0] - a * u[2]) - t * (d * v[0] - e * v[2]) - t * g
        de = u[2] - 0.5 * t * (a * u[1] - b * u[0]) - t * (e * v[1] - f * v[0])
        return (t * a, t * b, t * d), (dn, du, de), (meridian + h, (across + h) * c)

    @jit
    def full(turns, pushes, start, every, step):
        out = np.empty((len(turns) // every, 10))
        w, x, y, z = 1.0, 0.0, 0.0, 0.0
        vn, vu, ve = 0.0, 0.0, 0.0
        lat, lon, h = start
        t = step * every
        for k in range(len(out)):
            a, b, c, d = w, x, y, z
            un, uu, ue = 0.0, 0.0, 0.0
            for j in range(k * every, (k + 1) * every):
                p, q, r = rotate(a, b, c, d, pushes[j, 0], pushes[j, 1], pushes[j, 2])
                un, uu, ue = un + p, uu + q, ue + r
                e = exponential(turns[j, 0], turns[j, 1], turns[j, 2])
                a, b, c, d = product(a, b, c, d, *e)
            _, dv, radius = change(lat, h, (vn, vu, ve), (un, uu, ue), t)
            ml, mh = lat + 0.5 * t * vn / radius[0], h + 0.5 * t * vu
            middle = vn + 0.5 * dv[0], vu + 0.5 * dv[1], ve + 0.5 * dv[2]
            turn, dv, radius = change(ml, mh, middle, (un, uu, ue), t)
            e = exponential(-turn[0], -turn[1], -turn[2])
            w, x, y, z = product(*e, a, b, c, d)
            lat += t * (vn + 0.5 * dv[0]) / radius[0]
            lon += t * (ve + 0.5 * dv[2]) / radius[1]
            h += t * (vu + 0.5 * dv[1])
            vn, vu, ve = vn + dv[0], vu + dv[1], ve + dv[2]
            out[k, 0], out[k, 1], out[k, 2], out[k, 3] = w, x, y, z
            out[k, 4], out[k, 5], out[k, 6], out[k, 7], out[k, 8], out[k, 9] = vn, vu, ve, lat, lon, h
        return out

    return {
        "attitude": lambda: attitude(angle, every),
        "navigation": lambda: full(angle, velocity, position, every, STEP),
    }


def _ours(angle: np.ndarray, velocity: np.ndarray, position: np.ndarray, every: int) -> dict[str, Callable[[], Any]]:
    import jax
    import jax.numpy as jnp

    import gyromodel  # noqa: F401  switches to float64
    from gyromodel.platform import Navigation, attitude_sensitivity, attitudes, navigate

    level, turns, pushes = jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.asarray(angle), jnp.asarray(velocity)
    start = Navigation(level, jnp.zeros(3), jnp.asarray(position))
    parameters = {"bias": jnp.zeros(3), "matrix": jnp.eye(3)}
    rows = turns, jnp.concatenate([turns[:1], turns[:-1]])
    return {
        "attitude": lambda: np.asarray(attitudes(level, turns, every)),
        "navigation": lambda: np.concatenate([np.asarray(x) for x in navigate(start, turns, pushes, STEP, every)], 1),
        "sensitivity": lambda: jax.block_until_ready(attitude_sensitivity(_corrected, parameters, rows, level, every)),
    }


def _corrected(parameters, rows):
    """Rotation vectors by a matrix and a bias: twelve parameters."""
    import jax.numpy as jnp

    now, before = (x @ parameters["matrix"].T - parameters["bias"] for x in rows)
    return now + jnp.cross(before, now) / 12


def _coning() -> float:
    """Drift (rad/s) of the attitude under coning of 1° at 10 Hz in 4 s, from sampled rates with the correction."""
    import jax.numpy as jnp

    import gyromodel  # noqa: F401  switches to float64
    from gyromodel.platform import attitudes, coning, integrals

    angle, phase = np.deg2rad(1.0), 2 * np.pi * 10.0 * STEP * np.arange(4001)
    # q = exp(A (0, cos, sin)), and ω = 2 q* q̇.
    tilt = np.full(len(phase), np.cos(angle) - 1)
    rates = 20 * np.pi * np.stack([tilt, -np.sin(angle) * np.sin(phase), np.sin(angle) * np.cos(phase)], axis=1)
    q = np.array([np.cos(angle / 2), 0.0, np.sin(angle / 2), 0.0])  # at whole turns, as first and last
    end = attitudes(jnp.asarray(q), coning(integrals(jnp.asarray(rates), STEP)), 4000)[-1]
    return 2 * float(np.linalg.norm(np.asarray(end) - q)) / (4000 * STEP)


def _measure(what: str, steps: int, every: int) -> dict[str, float]:
    """Best of some calls of each, in turns; the first call compiles and is not counted."""
    data = (*_motion(steps), np.array([np.deg2rad(40.0), 0.0, 0.0]), every)
    ours, apart, theirs = _ours(*data)[what], 0.0, None
    if find_spec("numba") and what != "sensitivity":
        theirs = _peer(*data)[what]
        apart = float(np.max(np.abs(ours() - theirs())))
    ours()
    spent: tuple[list[float], list[float]] = ([], [])
    for _ in range(CALLS):
        for call, times in zip((ours, theirs), spent, strict=True):
            if call is not None:
                times.append(timed(call)[1]["wall"])
    return {"ours": min(spent[0]), "theirs": min(spent[1], default=0.0), "apart": apart, "peak": peak_memory()}


def main(argv: list[str] | None = None) -> None:
    argv = sys.argv[1:] if argv is None else argv
    parser = argparse.ArgumentParser(description="Speed of attitude, navigation and sensitivities.")
    parser.add_argument("--steps", type=int, default=1_000_000)
    parser.add_argument("--only", nargs=2, help=argparse.SUPPRESS)
    args = parser.parse_args(argv)
    if args.only:
        print(json.dumps(_measure(args.only[0], args.steps, int(args.only[1]))))
        return
    rows = []
    for what, flags in product(("attitude", "navigation", "sensitivity"), ("", AS_COMMANDS)):
        for every in EVERY if what != "sensitivity" else EVERY[-1:]:
            command = ("--steps", str(args.steps), "--only", what, str(every))
            m = in_fresh_process("benchmarks.navigation_speed", *command, XLA_FLAGS=flags)
            peer = ["–", "–", "–"]
            if m["theirs"]:
                nanoseconds = m["theirs"] / args.steps * 1e9
                peer = [f"{nanoseconds:.0f}", f"{m['ours'] / m['theirs']:.2f}", f"{m['apart']:.0e}"]
            name = "sensitivity to 12 parameters" if what == "sensitivity" else what
            name += ", as commands" if flags else ""
            ours = f"{m['ours'] / args.steps * 1e9:.0f}"
            rows.append([name, f"{every:,}", ours, *peer, f"{m['peak'] / MIB:.0f}"])
    head = [
        "",
        "steps in an epoch",
        "gyromodel ns a step",
        "numba ns a step",
        "ratio",
        "largest difference",
        "peak MiB",
    ]
    found = "" if find_spec("numba") else " numba is not installed: there is nothing to compare with."
    lines = [
        f"{args.steps:,} steps of {STEP:g} s; best of {CALLS} calls in turns, one process each row, compilation not "
        "counted. The numba loops hold the same equations in scalars. Of navigation, Earth, gravity and position are "
        f"taken once an epoch, in both. The aims are the loop's time for attitude, {MUST_NAVIGATION:g} times it for "
        f"navigation, and {MUST_SENSITIVITY:g} s for the sensitivities of a million steps. *As commands* is with "
        f"XLA_FLAGS={AS_COMMANDS!r}, which commands set; elsewhere it has to be in the environment, as XLA takes it "
        f"for no single function, and without it each epoch of navigation costs some 2 µs of dispatch.{found}",
        "",
        f"Coning of 1° at 10 Hz and {1 / STEP:g} samples a second, corrected: a drift of {_coning():.1e} rad/s.",
        "",
        *table(head, rows),
    ]
    write_result("navigation_speed", "Speed of navigation", "navigation_speed", argv, lines)


if __name__ == "__main__":
    main()
