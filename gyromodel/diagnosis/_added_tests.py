"""What could be done besides: a campaign again with one thing done otherwise, or with one more column."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from scipy.signal import lfilter

from gyromodel._checks import accelerations, along_axes, thermometers
from gyromodel.attitude import COLUMNS
from gyromodel.campaign import Campaign
from gyromodel.diagnosis._drivers import NOT_DRIVERS, proportion
from gyromodel.effects.geometry import cross_rates
from gyromodel.units import from_internal

RESISTANCE = "thermistor_resistance"
# Columns that a test cannot step by themselves.
NOT_SET = (*NOT_DRIVERS, *COLUMNS, "rate", "rate_spin", "rate_output", "azimuth")
# Rates (rad/s) up to which the Earth alone turns the gyro, and to which a table turns it about another axis.
EARTH, FAST = np.deg2rad(16.0 / 3600.0), np.deg2rad(10.0)
# How many times as fast the temperature is cycled, and how often up and down at least.
FASTER, CYCLES = 4, 2
# Levels of a column that is stepped up and down, and delays tried between two thermometers as parts of the record.
LEVELS, DELAYS = 5, np.linspace(0.0, 0.1, 41)
# A second thermometer that is not there yet: taken to lag by so much (s), at most by this part of the record.
LATE, LATEST = 60.0, 0.05


class AddedTest(NamedTuple):
    """What to do, as a sentence, and the campaign to come; its output is that of the campaign at hand."""

    sentence: str
    campaign: Campaign


def added_tests(campaign: Campaign) -> Iterator[AddedTest]:
    """Tests as long as a campaign, each of which changes one thing that the campaign has a column for."""
    yield AddedTest("Repeat the run.", campaign)
    if "temperature" in campaign.columns and np.ptp(campaign.columns["temperature"]) > 0:
        yield from _thermal(campaign)
    yield from _turned(campaign, cross_rates(campaign.columns))
    if "rate" in campaign.columns and np.ptp(campaign.columns["rate"]) > 0 and not _at_rest(campaign):
        rate = campaign.columns["rate"]
        for sentence, rates in (("with their signs reversed", -rate), ("in the opposite order", rate[::-1])):
            moved = _in_proportion(campaign, "rate", rates) | {"rate": rates}
            yield AddedTest(f"Run the same rates {sentence}.", _with(campaign, **moved))
    if "azimuth" in campaign.columns:
        turned = campaign.columns["azimuth"] + from_internal(np.pi / 2, campaign.units["azimuth"])
        yield AddedTest("Turn the gyro by 90° in azimuth and repeat.", _with(campaign, azimuth=turned))
    columns = campaign.columns
    kept = {*NOT_SET, RESISTANCE, *along_axes("rate", columns), *thermometers(columns), *accelerations(columns)}
    for name in campaign.covariates:
        if name in kept or not np.ptp(campaign.columns[name]) > 0:
            continue
        still = {
            other: np.full(len(campaign), np.median(campaign.columns[other]))
            for other in campaign.covariates
            if other not in NOT_SET
        }
        stepped = still | {name: _staircase(campaign.columns[name], len(campaign))}
        yield AddedTest(f"Step {name} up and down between its extremes, all else held.", _with(campaign, **stepped))


def second_thermometer(campaign: Campaign) -> Iterator[AddedTest]:
    """The campaign itself with a second column of temperature, where it has one; what that will read is a guess."""
    if thermometers(campaign.columns) != ["temperature"] or not np.ptp(campaign.columns["temperature"]) > 0:
        return
    time = campaign.si("time")
    late = min(LATE, LATEST * float(np.ptp(time)))
    reading = _lagging(time, campaign.columns["temperature"], late)
    sentence = f"Log a second thermometer, at the coil or the case, here taken to lag by {late:.3g} s."
    yield AddedTest(sentence, campaign.with_column("temperature_second", reading, campaign.units["temperature"]))


def _at_rest(campaign: Campaign) -> bool:
    """Whether the Earth is all that turns the gyro, so that no rate can be set by itself."""
    rates = [n for n in ("rate", *along_axes("rate", campaign.columns)) if n in campaign.columns]
    return all(np.nanmax(np.abs(campaign.si(n))) < EARTH for n in rates)


def _turned(campaign: Campaign, cross: list[str]) -> Iterator[AddedTest]:
    """Attitudes turned in azimuth, and rates about the other axes one by one."""
    still = {other: np.full(len(campaign), np.median(campaign.columns[other])) for other in cross}
    for name in cross:
        fast = max(FAST, float(np.nanmax(np.abs(campaign.si(name)))))
        steps = from_internal(_staircase(np.array([-fast, fast]), len(campaign)), campaign.units[name])
        axis = name.removeprefix("rate_")
        sentence = f"Turn about the {axis} axis at up to {np.rad2deg(fast):.3g} deg/s both ways, all else held."
        yield AddedTest(sentence, _with(campaign, **(still | {name: steps})))
    force = accelerations(campaign.columns)
    if len(force) == 3 and len(cross) == 2 and "rate" in campaign.columns and _at_rest(campaign):
        # Columns by axis in one order; the other handedness would be a turn the other way.
        names = [
            "rate" if n.replace("acceleration", "rate") not in cross else n.replace("acceleration", "rate")
            for n in force
        ]
        up = np.stack([campaign.si(n) for n in force], axis=1)
        up = up / np.linalg.norm(up, axis=1, keepdims=True)
        rates = np.stack([campaign.si(n) for n in names], axis=1)
        turned = np.sum(rates * up, axis=1, keepdims=True) * up + np.cross(up, rates)
        new = {n: from_internal(turned[:, i], campaign.units[n]) for i, n in enumerate(names)}
        yield AddedTest("Turn every attitude by 90° in azimuth and repeat.", _with(campaign, **new))


def _thermal(campaign: Campaign) -> Iterator[AddedTest]:
    """Other histories of temperature; further thermometers and a thermistor follow the first as in the campaign."""
    time, values = campaign.si("time"), campaign.columns["temperature"]
    low, high, unit = values.min(), values.max(), campaign.units["temperature"]
    part = (time - time[0]) / np.ptp(time)
    speed = np.quantile(np.abs(np.gradient(values, time)), 0.9)
    cycles = max(round(FASTER * speed * np.ptp(time) / (2.0 * (high - low))), CYCLES)
    between = f"between {low:.3g} and {high:.3g} {unit}"
    middle = float(np.median(values))
    # From where the campaign begins.
    start = float(values[0] > 0.5 * (low + high))
    triangle = np.abs((2.0 * cycles * part + start + 1.0) % 2.0 - 1.0)
    once = np.abs((2.0 * part + start + 1.0) % 2.0 - 1.0)
    square = (np.floor(2.0 * cycles * part) + start) % 2.0
    histories = {
        "Run the temperature history backwards.": values[::-1],
        f"Hold the temperature at {middle:.3g} {unit}.": np.full(len(values), middle),
        f"Ramp the temperature up and down {cycles} times {between}.": low + (high - low) * (1.0 - triangle),
        f"Ramp the temperature up and down once {between}.": low + (high - low) * (1.0 - once),
        f"Step the temperature to and fro {cycles} times {between}.": low + (high - low) * square,
        f"Soak at each end for half of the run {between}.": np.where((part >= 0.5) ^ (start > 0), high, low),
    }
    for sentence, history in histories.items():
        others = {
            name: _followed(time, values, campaign.columns[name], history)
            for name in thermometers(campaign.columns)
            if name != "temperature"
        }
        if RESISTANCE in campaign.columns:
            # Its logarithm bends little over temperature.
            logs = np.log(np.maximum(campaign.columns[RESISTANCE], np.finfo(float).tiny))
            others[RESISTANCE] = np.exp(np.polynomial.Polynomial.fit(values, logs, 3)(history))
        moved = _in_proportion(campaign, "temperature", history) | others | {"temperature": history}
        yield AddedTest(sentence, _with(campaign, **moved))


def _in_proportion(campaign: Campaign, name: str, values: np.ndarray) -> dict[str, np.ndarray]:
    """The columns that went with another in proportion, as they go where it has other values: nothing parts them."""
    others = [n for n in campaign.covariates if n != name and n not in NOT_DRIVERS]
    lines = {n: line for n in others if (line := proportion(campaign.columns[name], campaign.columns[n])) is not None}
    return {n: line[0] * values + line[1] for n, line in lines.items()}


def _with(campaign: Campaign, **columns: np.ndarray) -> Campaign:
    for name, values in columns.items():
        campaign = campaign.with_column(name, values, campaign.units[name])
    return campaign


def _staircase(values: np.ndarray, rows: int) -> np.ndarray:
    """Up and down again in steps between the extremes."""
    levels = np.concatenate([np.arange(LEVELS), np.arange(LEVELS)[::-1]]) / (LEVELS - 1)
    return values.min() + np.ptp(values) * levels[np.arange(rows) * len(levels) // rows]


def _followed(time: np.ndarray, first: np.ndarray, second: np.ndarray, history: np.ndarray) -> np.ndarray:
    """A second thermometer under another history: the first, late and offset as it fits the campaign best."""
    ways = [(late, part * np.ptp(time)) for late in (_delayed, _lagging) for part in DELAYS]
    late, by = min(ways, key=lambda way: np.var(second - way[0](time, first, way[1])))
    return late(time, history, by) + np.mean(second - late(time, first, by))


def _delayed(time: np.ndarray, values: np.ndarray, delay: float) -> np.ndarray:
    """What was some time before."""
    return np.interp(time - delay, time, values)


def _lagging(time: np.ndarray, values: np.ndarray, constant: float) -> np.ndarray:
    """What follows with a time constant, at rest before; straight between samples."""
    even, step = np.linspace(time[0], time[-1], len(time), retstep=True)
    kept = np.exp(-step / constant) if constant else 0.0
    late = (1.0 - kept) * constant / step
    x = np.interp(even, time, values)
    return np.interp(time, even, lfilter([1.0 - late, late - kept], [1.0, -kept], x, zi=[late * x[0]])[0])
