"""A logged vibration test as a record that fits and searches take: the base's angle less the table's, axis by axis.

Of each run the axes X, Y, Z follow one another, each with a constant of its own, in means of as many samples as leave
the oscillation whole. Every signal is a mean over the same samples, so that no effect loses by it.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from gyromodel._checks import CampaignError
from gyromodel.campaign import AXES, Campaign
from gyromodel.effects.platform import ODD, SHAFTS
from gyromodel.effects.platform_gimbals import ORDERS, TILTS
from gyromodel.estimate import Estimate, fit_record, with_noise_intervals
from gyromodel.model import GyroModel
from gyromodel.numerics.rotations import exponential, product
from gyromodel.platform._gimbals import GimbalErrors, base_angles
from gyromodel.platform._motion import GIMBALS, BaseMotion, base_motion
from gyromodel.signals import Record, laid_out

# Phase (rad) of the fastest oscillation over a mean of samples, that of a record with too many rows, whose fastest
# oscillations a mean makes smaller by a sixth at most, and their number.
PHASE, WIDEST, MAXIMUM_ROWS = 0.7, 2.0, 4_000
# Fewest means of a run, and most groups of runs of which each is left out once.
FEWEST, GROUPS = 24, 6
# Variance of a stretch's own constant, over that of white noise.
UNKNOWN = 1e6
# A sine is one whose energy is so many times the noise's, and what else moves may be this part of it.
SEEN, UNLIKE = 50.0, 0.05
# What whole turns taken off leave of an angle (rad).
ROUNDED = 1e-13
# Sines that a gimbal's motion is made of, the fundamental included.
OVERTONES = 4
# Steps of its encoder by which a gimbal turns if its friction is to be told.
RESOLVED = 10
# Times that a reading returns where the steps of an encoder show.
OFTEN = 4
# Change (rad) of what angles depend on, by which they are differentiated.
NUDGE = 1e-4
# Time between two stretches of the record in reports, s.
PAUSE = 1.0


class VibrationRecord(NamedTuple):
    """What a log says, ready to be searched.

    record: the angles; campaign: its rows as reports show them; findings: what was done to the log, in sentences;
    step: of the coarsest encoder, rad, zero where none shows.
    """

    record: Record
    campaign: Campaign
    findings: tuple[str, ...]
    step: float


def fit_vibration(campaigns: Campaign | Sequence[Campaign], model: GyroModel) -> Estimate:
    """Fit a model of platform effects to logs of vibration tests of one platform, as `gyromodel.fit` fits gyros.

    Args:
        campaigns: as `base_motion` takes them.
        model: what to fit; effects that are not of a platform are refused.

    Raises:
        CampaignError, ModelError, EstimateError: the data or the model cannot answer; the message says why.
    """
    return with_noise_intervals(fit_record(vibration_record(campaigns).record, model))


def vibration_record(campaigns: Campaign | Sequence[Campaign], without: str = "") -> VibrationRecord:
    """Read logs of vibration tests of one platform.

    Args:
        campaigns: as `base_motion` takes them; in every run each axis of the table stands still or oscillates at one
            frequency. Runs that do otherwise are left out.
        without: axes X, Y, Z about which runs that oscillate are left out too.

    Raises:
        CampaignError: something is missing or unusable, or no run is left.
    """
    campaigns = [campaigns] if isinstance(campaigns, Campaign) else list(campaigns)
    runs, findings, count = [], [], 0
    for campaign in campaigns:
        motion = base_motion(campaign)
        step = _step(campaign)
        # What an error may follow must not hold the noise of the readings that it is the error of.
        smooth = motion._replace(gimbals=_smooth(motion))
        changes = _sensitivities(smooth)
        for k in range(motion.segment[-1] + 1):
            count += 1
            rows = np.flatnonzero(motion.segment == k)
            name = f"Run {count}" if motion.segment[-1] or len(campaigns) > 1 else "The run"
            run = _run(motion, smooth.gimbals[rows], rows, changes, step)
            if isinstance(run, str):
                findings.append(f"{name} was left out: {run}.")
            elif not any(w for axis, (_, w) in zip("XYZ", run.waves, strict=True) if axis in without):
                runs.append(run)
    if not runs:
        raise CampaignError(f"{campaigns[0].name}: no run can be used. {' '.join(findings)}")
    phase = min(PHASE * max(sum(map(_rows, runs)) / MAXIMUM_ROWS, 1.0), WIDEST)
    stretches, numbers = [], []
    for number, run in enumerate(runs):
        stretches += _stretches(run, phase)
        numbers += [np.full(len(s["time"]), number) for s in stretches[-3:]]
    together = [int(s.pop("_together")[0]) for s in stretches]
    if max(together) > 1:
        findings.append(
            f"Means of up to {max(together)} consecutive samples were searched, shorter ones in faster runs."
        )
    columns = {name: np.concatenate([s[name] for s in stretches]) for name in stretches[0]}
    blocks = np.concatenate(numbers) % GROUPS
    scheme = "runs" if len(runs) <= GROUPS else "groups of runs"
    if len(runs) < 4:
        parts = np.concatenate([np.arange(len(s["time"])) * 5 // len(s["time"]) for s in stretches])
        blocks, scheme = 5 * blocks + parts, "fifths of a run"
    interval = float(np.median(columns["_interval"]))
    columns["_white"] *= interval / columns["_interval"]
    units = {"time": "s", "table": "deg", "table_rate": "deg/s"} | dict.fromkeys(GIMBALS, "deg")
    record = laid_out(columns, blocks, scheme, "rad", units)
    record = record._replace(interval=interval, data_hash="+".join(c.digest() for c in campaigns))
    shown = _shown(campaigns[0], columns, np.concatenate(numbers))
    return VibrationRecord(record, shown, tuple(findings), max(map(_step, campaigns)))


def _step(campaign: Campaign) -> float:
    """The usual distance of neighbouring readings of the coarsest encoder that repeats its readings."""
    steps = [0.0]
    for name in GIMBALS:
        levels = np.unique(campaign.si(name))
        if 1 < len(levels) < len(campaign) / OFTEN:
            steps.append(float(np.median(np.diff(levels))))
    return max(steps)


class _Run(NamedTuple):
    """One run at the rate of its log; oscillations are complex, zero where there is none, with their angular rates."""

    time: np.ndarray
    table: np.ndarray
    output: np.ndarray
    gimbals: np.ndarray
    changes: np.ndarray
    waves: list[tuple[np.ndarray, float]]
    turns: list[tuple[np.ndarray, float]]


def _run(motion: BaseMotion, smooth: np.ndarray, rows: np.ndarray, changes: np.ndarray, step: float) -> _Run | str:
    """A run, read by encoders of some step, its gimbals' angles without noise, or why it cannot be used."""
    time = motion.time[rows] - motion.time[rows[0]]
    if len(rows) < FEWEST:
        return f"it has {len(rows)} rows, and {FEWEST} are needed"
    table, gimbals, changes = motion.table[rows], motion.gimbals[rows], changes[rows]
    waves = []
    for axis, angle in zip(AXES, table.T, strict=True):
        wave, frequency, left = _sine(time, angle)
        if left > UNLIKE:
            return f"the motion of table_{axis} is no oscillation of one frequency"
        waves.append((wave, frequency))
    # Gimbals follow the Earth as well; what turns by few steps of its encoder is taken to stand still.
    turns = [_sine(time, angle, drifts=True)[:2] for angle in gimbals.T]
    turns = [(w, f) if np.abs(w[0]) > RESOLVED * step else (0.0 * w, 0.0) for w, f in turns]
    output = motion.base[rows] - table
    # Where the platform began is known to a reading: it is turned so that mean angles agree.
    turn = _aligning(changes, output[..., None])
    output = output - (changes[..., :3] @ turn)[..., 0]
    changes = np.concatenate([changes, _drifting(changes, time)], axis=2)
    return _Run(time, table, output, smooth, changes, waves, turns)


def _smooth(motion: BaseMotion) -> np.ndarray:
    """Angles of the gimbals without the noise of their readings: in each run a line, an oscillation and its overtones.

    A reading that hardly moves is noise, and so is what a tilt or an encoder's error would make of it.
    """
    smooth = motion.gimbals.copy()
    for k in range(motion.segment[-1] + 1):
        rows = np.flatnonzero(motion.segment == k)
        if len(rows) < FEWEST:
            continue
        time = motion.time[rows] - motion.time[rows].mean()
        for gimbal in range(len(GIMBALS)):
            angle = motion.gimbals[rows, gimbal]
            w = _sine(time - time[0], angle, drifts=True)[1]
            # At two samples a period an overtone is one of any frequency.
            phases = [n * w * time for n in range(1, OVERTONES + 1) if 0 < n * w * np.diff(time).mean() < 0.9 * np.pi]
            columns = np.column_stack([np.ones_like(time), time, *(f(p) for p in phases for f in (np.sin, np.cos))])
            smooth[rows, gimbal] = columns @ np.linalg.lstsq(columns, angle, rcond=None)[0]
    return smooth


def _aligning(changes: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Small turns in north-up-east axes that take away the means of columns (sample by axis by column)."""
    return np.linalg.solve(changes[..., :3].mean(0), columns.mean(0))


def _drifting(changes: np.ndarray, time: np.ndarray) -> np.ndarray:
    return -changes[..., 3:6] * time[:, None, None]


def _rows(run: _Run, phase: float = PHASE) -> int:
    return 3 * (len(run.time) // _together(run, phase))


def _together(run: _Run, phase: float) -> int:
    """Samples in a mean."""
    step = float(run.time[-1]) / (len(run.time) - 1)
    fastest = max(w for _, w in (*run.waves, *run.turns))
    return int(max(1, min(phase / (fastest * step) if fastest else np.inf, len(run.time) // FEWEST)))


def _stretches(run: _Run, phase: float) -> list[dict[str, np.ndarray]]:
    """Signals of the three axes of a run, of which each is a stretch."""
    m = _together(run, phase)
    count = len(run.time) // m

    def mean(values: np.ndarray) -> np.ndarray:
        return values[: count * m].reshape(count, m, *values.shape[1:]).mean(1)

    gimbals = {name: run.changes[..., 6 + i] for i, name in enumerate(GIMBALS)}
    tilts = {name: -run.changes[..., 10 + i] for i, name in enumerate(TILTS)}
    drifts = {f"drift_{axis}": run.changes[..., 18 + i] for i, axis in enumerate(AXES)}
    terms = {}
    for i, name in enumerate(GIMBALS):
        for k in ORDERS:
            for part, function in (("cosine", np.cos), ("sine", np.sin)):
                terms[f"{name}/{k}_{part}"] = gimbals[name] * function(k * run.gimbals[:, [i]])
    linear = np.stack([*tilts.values(), *drifts.values(), *terms.values()], axis=-1)
    linear = linear - run.changes[..., :3] @ _aligning(run.changes, linear)
    # Every encoder is taken to be as good as the others: the noise of an angle is that of the table and the gimbals.
    noise = 0.5 * (1.0 + np.mean(run.changes[..., 6:10] ** 2, axis=0).sum(-1))
    driver = {
        name: mean(np.real(wave)) + run.gimbals[:, i].mean()
        for i, (name, (wave, _)) in enumerate(zip(GIMBALS, run.turns, strict=True))
    }
    time, stretches = mean(run.time), []
    for a in range(3):
        wave, frequency = run.waves[a]
        signals = {
            "time": time,
            "table": mean(np.real(wave)) + run.table[:, a].mean(),
            "table_rate": mean(np.real(1j * frequency * wave)),
            **driver,
            "_real": mean(np.real(wave)),
            "_imaginary": mean(np.imag(wave)),
            "_frequency": np.full(count, frequency),
            "output": mean(run.output[:, a]),
            "_interval": np.full(count, m * run.time[-1] / (len(run.time) - 1)),
            "_restart": np.arange(count) == 0,
            "_white": np.full(count, noise[a]),
            "_start": np.full(count, UNKNOWN),
            "_together": np.full(count, m),
        }
        for shaft, (wave, frequency) in ((s, run.turns[GIMBALS.index(s)]) for s in SHAFTS):
            size = np.abs(wave[0])
            signals[f"_{shaft}_amplitude"] = np.full(count, size)
            signals[f"_{shaft}_frequency"] = np.full(count, frequency)
            for n in ODD:
                passed = mean(gimbals[shaft][:, a] * (wave / size if size else wave) ** n)
                signals |= {f"_{shaft}_{n}_real": np.real(passed), f"_{shaft}_{n}_imaginary": np.imag(passed)}
        names = (*tilts, *drifts, *terms)
        stretches.append(signals | {f"_{n}": v for n, v in zip(names, mean(linear[:, a]).T, strict=True)})
    return stretches


def _sine(time: np.ndarray, angle: np.ndarray, drifts: bool = False) -> tuple[np.ndarray, float, float]:
    """The oscillation z of an angle Re z + constant, its angular rate, and what part of the angle's motion it leaves.

    The constant is a line where the angle drifts. Zero where no oscillation is seen. The frequency is that of the
    largest line of the spectrum, by Gauss-Newton steps.
    """
    n, span = len(time), float(time[-1])
    middle = time - 0.5 * span
    if drifts:
        angle = angle - np.polyval(np.polyfit(middle, angle, 1), middle)
    still = np.zeros(n, complex), 0.0, 0.0
    padded = 8 * n
    frequencies = 2 * np.pi * np.arange(padded // 2 + 1) / padded * (n - 1) / span
    even = np.interp(np.linspace(0.0, span, n), time, angle)
    power = np.abs(np.fft.rfft(even - even.mean(), padded)) ** 2
    # Slower than three quarters of a period is a drift; at half the sample rate cosine and sine are alike.
    inside = slice(6, int(0.45 * padded))
    w = float(frequencies[inside][np.argmax(power[inside])])
    low, high = w - np.pi / (2 * span), w + np.pi / (2 * span)
    line = np.polynomial.polynomial.polyvander(middle, int(drifts))
    for _ in range(12):
        waves = np.column_stack([np.cos(w * middle), np.sin(w * middle), line])
        found = np.linalg.lstsq(waves, angle, rcond=None)[0]
        a, b = found[:2]
        slope = middle * (b * waves[:, 0] - a * waves[:, 1])
        steps = np.linalg.lstsq(np.column_stack([waves, slope]), angle - waves @ found, rcond=None)[0]
        w = float(np.clip(w + steps[-1], low, high))
    z = (a - 1j * b) * np.exp(1j * w * middle)
    left = angle - line @ found[2:] - z.real
    # White noise shows in differences, a motion does not.
    noise = 0.5 * float(np.mean(np.diff(left) ** 2))
    if 0.5 * n * abs(z[0]) ** 2 <= SEEN * max(noise, ROUNDED**2):
        return still
    return z, w, float(np.sqrt(max(np.mean(left**2) - 2.0 * noise, 0.0) / np.mean(z.real**2)))


@jax.jit
@partial(jax.vmap, in_axes=(0, None, None, None))
def _changed(
    by: Float[Array, " change"],
    platform: Float[Array, "sample 4"],
    gimbals: Float[Array, "sample 4"],
    mounting: Float[Array, "3 3"],
) -> Float[Array, "sample 3"]:
    turned = product(product(exponential(by[:3]), platform), exponential(by[3:6]))
    errors = GimbalErrors(by[10:].reshape(4, 2), jnp.zeros((4, 0, 2)))
    return base_angles(turned, gimbals + by[6:10], mounting, errors)


def _sensitivities(motion: BaseMotion) -> Float[np.ndarray, "sample 3 change"]:
    """By turns in navigation axes, turns about axes of the body, readings of the gimbals, and tilts of their axes.

    From changes of ±NUDGE, which miss a 10⁻⁸ of them: derivatives took three times as long to compile.
    """
    rows = len(motion.time)
    # Of a length that recurs.
    extra = -rows % 4096
    platform, gimbals = (
        jnp.asarray(np.pad(x, ((0, extra), (0, 0)), mode="edge")) for x in (motion.platform, motion.gimbals)
    )
    nudges = NUDGE * np.eye(18)
    up, down = (np.asarray(_changed(by, platform, gimbals, jnp.asarray(motion.mounting))) for by in (nudges, -nudges))
    return np.moveaxis((up - down)[:, :rows] / (2 * NUDGE), 0, -1)


def _shown(campaign: Campaign, columns: dict[str, np.ndarray], run: np.ndarray) -> Campaign:
    """The record's rows one after another, as reports show them."""
    starts = np.flatnonzero(columns["_restart"])
    ends = np.append(starts[1:], len(run)) - 1
    length = columns["time"][ends] + PAUSE
    shift = np.repeat(np.cumsum(np.append(0.0, length[:-1])), ends - starts + 1)
    shown = {"time": columns["time"] + shift, "output": np.rad2deg(columns["output"]), "segment": run + 1.0}
    shown |= {name: np.rad2deg(columns[name]) for name in ("table", "table_rate", *GIMBALS)}
    units = {"time": "s", "output": "deg", "segment": "", "table_rate": "deg/s"}
    units |= dict.fromkeys(("table", *GIMBALS), "deg")
    return Campaign(shown, units, {"kind": "angle"}, campaign.name)
