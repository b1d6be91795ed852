"""Attitude after five seconds from real rates, before and after a fit through the integrator.

    python -m benchmarks.attitude_real

writes benchmarks/results/attitude_real.md. The data are read from the folder that GYROMODEL_DATA names, or
../shared/data; they are not part of the project.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import gyromodel
from benchmarks._measure import DATA, table, write_result
from gyromodel.attitude import COLUMNS, body_rates
from gyromodel.estimate import fit_function
from gyromodel.numerics.rotations import cross, exponential, inverse, logarithm, product, to_matrix
from gyromodel.numerics.uncertain import Uncertain
from gyromodel.platform import integrals

# The file of each session, for how long the unit lies still before it is moved (s), and another session of that unit.
SESSIONS = {
    "01": ("01_undisturbed_slow_rotation_A", 30.0, "06"),
    "06": ("06_undisturbed_fast_rotation_A", 30.0, "01"),
    "TStick 02": ("TStick_Test02_Trial1", 3.0, "TStick 04"),
    "TStick 04": ("TStick_Test04_Trial2", 3.0, "TStick 02"),
}
FOLDS, LENGTH, SHORT, MEAN = 4, 5.0, 2.0, 0.2
# Too short for a gyro to err by much: what is left is of the optical attitude at both ends (s).
MOMENT = 0.5
# Delays that least squares on rates tries (s).
DELAYS = np.arange(-0.004, 0.0121, 0.001)
# What is known beforehand: about how far an attitude comes out wrong (rad), and standard deviations: of a bias (rad/s),
# of scale factors and of leans that no mounting takes away, of the mounting (rad), and of the delay (s).
WRONG = np.deg2rad(0.3)
BEFOREHAND = {"bias": np.deg2rad(1.0), "scale": 0.005, "lean": 0.005, "turn": 0.05, "delay": 0.005}
# The same from one session of a unit to another; of its bias no more is known than before.
BETWEEN = BEFOREHAND | {"scale": 0.002, "lean": 0.002, "turn": 0.002, "delay": 0.001}
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


def unknown(names: tuple[str, ...] = tuple(BEFOREHAND)) -> Parameters:
    """What is fitted, of a gyro without errors."""
    return {name: jnp.zeros(() if name == "delay" else 3) for name in names}


def corrected(fitted: Parameters) -> Parameters:
    """Bias, matrix and delay: the matrix of scale factors and leans (xy, yz, zx), turned by the mounting."""
    found = {**unknown(), **fitted}
    xy, yz, zx = found["lean"]
    unit = jnp.eye(3) + jnp.diag(found["scale"]) + jnp.array([[0.0, xy, zx], [xy, 0.0, yz], [zx, yz, 0.0]])
    turned = to_matrix(exponential(found["turn"]))
    return {"bias": found["bias"], "matrix": turned @ unit, "delay": found["delay"]}


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


def predicted(free: Parameters, data: tuple[Windows, ...], other: Parameters | None = None) -> jax.Array:
    """What the fit holds against zero: where the windows end, and how far the parameters are from what is known."""
    expected = unknown() if other is None else {**other, "bias": jnp.zeros(3)}
    parts = [misses(corrected(free), windows).ravel() for windows in data]
    return jnp.concatenate([*parts, *(jnp.ravel(free[name] - expected[name]) for name in sorted(free))])


def fitted(
    data: tuple[Windows, ...],
    names: tuple[str, ...] = tuple(BEFOREHAND),
    other: Uncertain | None = None,
    known: dict[str, float] | None = None,
) -> Uncertain:
    """Least squares through the integrator over the named parameters, with what is known beforehand.

    With what the fit to another session of the unit found, which is uncertain itself, the parameters are about that.
    """
    free = unknown(names)
    about = known or (BEFOREHAND if other is None else BETWEEN)
    windows = sum(3 * len(w.begin) for w in data)
    near = [np.full(np.size(free[name]), about[name]) for name in sorted(names)]
    std = np.concatenate([np.full(windows, WRONG), *near])
    groups = np.zeros(len(std), int)
    return fit_function(predicted, free, np.zeros(len(std)), data, given=other, std=std, groups=groups).parameters


def by_rates(
    session: tuple[np.ndarray, np.ndarray, np.ndarray], use: np.ndarray, delays: Sequence[float] | np.ndarray = (0.0,)
) -> Parameters:
    """Matrix and bias by ordinary least squares on means of the reference's rates, at the delay that fits best."""
    time, rates, attitude = session
    rows = round(MEAN / float(np.median(np.diff(time))))

    def means(x: np.ndarray) -> np.ndarray:
        return x[: len(x) // rows * rows].reshape(-1, rows, 3).mean(axis=1)

    reference = means(np.where(use[:, None], body_rates(time, attitude), np.nan))
    known = np.isfinite(reference).all(axis=1)
    fits = []
    for delay in delays:
        measured = means(np.column_stack([np.interp(time + delay, time, r) for r in rates.T]))
        columns = np.column_stack([measured, np.ones(len(measured))])[known]
        found = np.linalg.lstsq(columns, reference[known], rcond=None)[0]
        fits.append((float(np.sum((columns @ found - reference[known]) ** 2)), float(delay), found))
    _, delay, found = min(fits, key=lambda fit: fit[0])
    return {"matrix": jnp.asarray(found[:3].T), "bias": jnp.asarray(found[3]), "delay": jnp.asarray(delay)}


class Judged(NamedTuple):
    """Errors (deg) of all windows by each way to correct the rates."""

    held_out: dict[str, np.ndarray]
    in_sample: dict[str, np.ndarray]
    moment: np.ndarray


def windows_of(label: str, folder: Path) -> tuple[Windows, Windows]:
    """What a session is fitted to."""
    session = read(SESSIONS[label][0], folder)
    return cut(*session, LENGTH, LENGTH / 2), cut(*session, SHORT, SHORT)


def judge(label: str, folder: Path, folds: int = FOLDS) -> Judged:
    """Each way, by fits to the other parts of the session, and by fits to all of it."""
    name, rest, another = SESSIONS[label]
    session = read(name, folder)
    time, rates, _ = session
    judged, used = cut(*session, LENGTH, LENGTH), windows_of(label, folder)
    still = {**start(), "bias": jnp.asarray(-rates[time < time[0] + rest].mean(axis=0))}
    other = fitted(windows_of(another, folder))

    def ways(train: tuple[Windows, ...], use: np.ndarray) -> dict[str, Parameters]:
        return {
            "as measured": start(),
            "bias at rest": still,
            "matrix by rates": by_rates(session, use),
            "and delay": by_rates(session, use, DELAYS),
            "through the integrator": corrected(fitted(train).value),
            "with another session": corrected(fitted(train, other=other).value),
        }

    parts = []
    for low, high in pairwise(np.linspace(time[0], time[-1], folds + 1)):
        test = some(judged, (judged.begin >= low) & (judged.begin + LENGTH <= high))
        train = tuple(
            some(w, (w.begin + length < low) | (w.begin > high))
            for w, length in zip(used, (LENGTH, SHORT), strict=True)
        )
        found = ways(train, (time < low) | (time > high))
        parts.append({way: error(parameters, test) for way, parameters in found.items()})
    held_out = {way: np.concatenate([part[way] for part in parts]) for way in parts[0]}
    whole = ways(used, np.ones(len(time), bool))
    in_sample = {way: error(parameters, judged) for way, parameters in whole.items()}
    return Judged(held_out, in_sample, error(whole["through the integrator"], cut(*session, MOMENT, MOMENT)))


def main() -> None:
    folder = DATA / "mems_attitude"
    found = {label: judge(label, folder) for label in SESSIONS}

    def rows(schemes: dict[str, dict[str, np.ndarray]]) -> list[str]:
        head = ["session", "windows", *next(iter(schemes.values()))]
        lines = []
        for label, ways in schemes.items():
            cells = [f"{_rms(e):.2f} ({np.median(e):.2f})" for e in ways.values()]
            lines.append([label, str(len(ways["as measured"])), *cells])
        return table(head, lines)

    moments = ", ".join(f"{_rms(judged.moment):.2f} ({label})" for label, judged in found.items())
    lines = [
        f"Attitude {LENGTH:g} s after it was set to the optical reference: rms error in deg (median in brackets) over "
        f"windows side by side. *Matrix by rates*: ordinary least squares on rates from the attitude, means over "
        f"{MEAN:g} s, as they are and at the delay that fits best. The last two columns are fitted through the "
        f"integrator, to where windows of {SHORT:g} and {LENGTH:g} s end: bias, delay, scale factors and leans within "
        f"some {100 * BEFOREHAND['scale']:g} % of none, and a mounting within {BEFOREHAND['turn']:g} rad; the last one "
        f"begins from the other session of the same unit, as known as that fit has it and within some "
        f"{100 * BETWEEN['scale']:g} %, whose windows are none of those judged.",
        "",
        f"Held out: a session is cut into {FOLDS} parts; windows of each are judged by fits to the others, but for the "
        "bias of the rest at the beginning.",
        "",
        *rows({label: judged.held_out for label, judged in found.items()}),
        "",
        "In-sample: fitted to all of the session and judged by the same windows, which flatters whatever has more "
        "parameters.",
        "",
        *rows({label: judged.in_sample for label, judged in found.items()}),
        "",
        f"After {MOMENT:g} s, in which a gyro errs by little, the fit through the integrator is already wrong by "
        f"{moments} deg: that much is the error of the optical attitude at both ends.",
    ]
    write_result("attitude_real", "Attitude from real rates", "attitude_real", sys.argv[1:], lines)


def _rms(errors: np.ndarray) -> float:
    return float(np.sqrt(np.mean(errors**2)))


if __name__ == "__main__":
    main()
