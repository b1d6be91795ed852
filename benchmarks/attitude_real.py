"""Attitude after five seconds from real rates, before and after a fit through the integrator.

    python -m benchmarks.attitude_real

writes benchmarks/results/attitude_real.md. The data are read from the folder that GYROMODEL_DATA names, or
../shared/data; they are not part of the project.
"""

from __future__ import annotations

import sys
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import gyromodel
from benchmarks._measure import DATA, table, write_result
from gyromodel.attitude import COLUMNS, body_rates
from gyromodel.estimate import fit_function
from gyromodel.numerics.rotations import cross, exponential, inverse, logarithm, product
from gyromodel.platform import integrals

# The file of each session, and for how long the unit lies still before it is moved (s).
SESSIONS = {
    "01": ("01_undisturbed_slow_rotation_A", 30.0),
    "06": ("06_undisturbed_fast_rotation_A", 30.0),
    "TStick 02": ("TStick_Test02_Trial1", 3.0),
    "TStick 04": ("TStick_Test04_Trial2", 3.0),
}
FOLDS, LENGTH, SHORT, MEAN = 4, 5.0, 2.0, 0.2
# What is known beforehand: about how far an attitude comes out wrong (rad), and standard deviations of a bias (rad/s),
# of the entries of the matrix, and of the delay (s).
WRONG = np.deg2rad(0.3)
BEFOREHAND = {"bias": np.deg2rad(1.0), "matrix": 0.02, "delay": 0.005}
Parameters = dict[str, jax.Array]


class Windows(NamedTuple):
    """Stretches of equal length: when they begin (s), increments, those of the step before, and what surrounds them.

    `edges` are the rates at the first and last sample, `attitudes` the reference there.
    """

    begin: np.ndarray
    increments: np.ndarray
    before: np.ndarray
    edges: np.ndarray
    attitudes: np.ndarray
    step: np.ndarray


def start() -> Parameters:
    """A gyro without errors."""
    return {"bias": jnp.zeros(3), "matrix": jnp.eye(3), "delay": jnp.zeros(())}


def read(name: str, folder: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Time, rates in rad/s, and reference attitude of a session."""
    campaign = gyromodel.read_campaign(folder / f"{name}.csv.gz")
    rates = np.column_stack([campaign.si(f"output_{axis}") for axis in "xyz"])
    return campaign.si("time"), rates, np.column_stack([campaign.columns[c] for c in COLUMNS])


def cut(time: np.ndarray, rates: np.ndarray, attitude: np.ndarray, length: float, apart: float) -> Windows:
    """Windows of a length that begin so far apart (s), where the reference is known at both ends."""
    step = float(np.median(np.diff(time)))
    rows = round(length / step)
    increments = np.asarray(integrals(jnp.asarray(rates), step))
    known = np.isfinite(attitude).all(axis=1)
    first = np.arange(2, len(time) - rows - 2, round(apart / step))
    first = first[known[first] & known[first + rows]]
    inside = first[:, None] + np.arange(rows)
    ends = np.stack([first, first + rows], axis=1)
    # Over some samples, as the quantisation of one is as large as the delay's effect.
    smooth = (rates[ends - 1] + 2 * rates[ends] + rates[ends + 1]) / 4
    steps = np.full(len(first), step)
    return Windows(time[first], increments[inside], increments[inside - 1], smooth, attitude[ends], steps)


def some(windows: Windows, which: np.ndarray) -> Windows:
    """Some of the windows."""
    return Windows(*(x[which] for x in windows))


def misses(parameters: Parameters, windows: Windows) -> jax.Array:
    """Rotation vectors from the reference to the integrated attitude at the end of each window (rad).

    The rate is M ω + b. What the gyro says at t happened a delay before: the turn during it is taken from the beginning
    and added to the end.
    """

    def one(increments, before, edges, attitudes, step):
        now, last = (x @ parameters["matrix"].T + parameters["bias"] * step for x in (increments, before))
        late = parameters["delay"] * (edges @ parameters["matrix"].T + parameters["bias"])
        turns = jnp.concatenate([-late[:1], now + cross(last, now) / 12, late[1:]])
        end = jax.lax.scan(lambda q, turn: (product(q, exponential(turn)), None), attitudes[0], turns)[0]
        return logarithm(product(inverse(attitudes[1]), end))

    return jax.vmap(one)(*windows[1:])


_misses = jax.jit(misses)


def error(parameters: Parameters, windows: Windows) -> np.ndarray:
    """Angle by which each window ends wrong, deg."""
    return np.rad2deg(np.linalg.norm(np.asarray(_misses(parameters, windows)), axis=1))


def predicted(free: Parameters, data: tuple[Windows, ...]) -> jax.Array:
    """What the fit holds against zero: where the windows end, and how far the parameters are from the start."""
    ideal = start()
    parts = [misses({**ideal, **free}, windows).ravel() for windows in data]
    return jnp.concatenate([*parts, *(jnp.ravel(free[name] - ideal[name]) for name in sorted(free))])


def fitted(data: tuple[Windows, ...], names: tuple[str, ...]) -> Parameters:
    """Least squares through the integrator over the named parameters, with what is known beforehand."""
    free = {name: start()[name] for name in names}
    windows = sum(3 * len(w.begin) for w in data)
    known = [np.full(np.size(free[name]), BEFOREHAND[name]) for name in sorted(names)]
    std = np.concatenate([np.full(windows, WRONG), *known])
    groups = np.zeros(len(std), int)
    return {**start(), **fit_function(predicted, free, np.zeros(len(std)), data, std=std, groups=groups).value}


def by_rates(time: np.ndarray, rates: np.ndarray, attitude: np.ndarray, use: np.ndarray) -> Parameters:
    """Matrix and bias by ordinary least squares on means of the reference's rates, so that a delay matters less."""
    reference = np.where(use[:, None], body_rates(time, attitude), np.nan)
    rows = round(MEAN / float(np.median(np.diff(time))))
    measured, reference = (x[: len(x) // rows * rows].reshape(-1, rows, 3).mean(axis=1) for x in (rates, reference))
    known = np.isfinite(reference).all(axis=1)
    columns = np.column_stack([measured, np.ones(len(measured))])
    found = np.linalg.lstsq(columns[known], reference[known], rcond=None)[0]
    return {**start(), "matrix": jnp.asarray(found[:3].T), "bias": jnp.asarray(found[3])}


def held_out(name: str, rest: float, folder: Path, folds: int = FOLDS) -> dict[str, np.ndarray]:
    """Errors (deg) of all windows by each way to correct the rates, judged by fits to other parts of the session."""
    session = read(name, folder)
    time, rates, _ = session
    judged = cut(*session, LENGTH, LENGTH)
    used = cut(*session, LENGTH, LENGTH / 2), cut(*session, SHORT, SHORT)
    still = {**start(), "bias": jnp.asarray(-rates[time < time[0] + rest].mean(axis=0))}
    found: dict[str, list[np.ndarray]] = {}
    bounds = np.linspace(time[0], time[-1], folds + 1)
    for low, high in pairwise(bounds):
        test = some(judged, (judged.begin >= low) & (judged.begin + LENGTH <= high))
        lengths = zip(used, (LENGTH, SHORT), strict=True)
        train = tuple(some(w, (w.begin + length < low) | (w.begin > high)) for w, length in lengths)
        ways: dict[str, Any] = {
            "as measured": start(),
            "bias at rest": still,
            "matrix by rates": by_rates(*session, (time < low) | (time > high)),
            "bias and matrix": fitted(train, ("bias", "matrix")),
            "and delay": fitted(train, ("bias", "matrix", "delay")),
        }
        for way, parameters in ways.items():
            found.setdefault(way, []).append(error(parameters, test))
    return {way: np.concatenate(errors) for way, errors in found.items()}


def main() -> None:
    rows: list[list[str]] = []
    head: list[str] = []
    for label, (name, rest) in SESSIONS.items():
        errors = held_out(name, rest, DATA / "mems_attitude")
        head = ["session", "windows", *errors]
        cells = [f"{np.sqrt(np.mean(e**2)):.2f} ({np.median(e):.2f})" for e in errors.values()]
        rows.append([label, str(len(next(iter(errors.values())))), *cells])
    lines = [
        f"Attitude {LENGTH:g} s after it was set to the optical reference: rms error in deg (median in brackets) over "
        f"windows side by side. A session is cut into {FOLDS} parts; windows of each are judged by fits to the others, "
        f"but for the bias of the rest at the beginning. *Matrix by rates*: ordinary least squares on rates from the "
        f"attitude, means over {MEAN:g} s. The last two columns are fitted through the integrator, to where windows of "
        f"{SHORT:g} and {LENGTH:g} s end, with a matrix within some 2 % of the ideal one.",
        "",
        *table(head, rows),
    ]
    write_result("attitude_real", "Attitude from real rates", "attitude_real", sys.argv[1:], lines)


if __name__ == "__main__":
    main()
