"""What noise of thermometers may pass for beside a cause that follows their rate of change: further thermal names."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gyromodel._checks import listed, thermometers
from gyromodel.declarations import measured as base_of
from gyromodel.diagnosis._drivers import smooth_columns
from gyromodel.diagnosis._ranking import is_driver, is_noise
from gyromodel.diagnosis._selection import Selection
from gyromodel.diagnosis._steps import Found, Steps, quality, rows_of
from gyromodel.estimate import Estimate, filter_of, whiten_columns
from gyromodel.noise import NoiseRatios
from gyromodel.signals import Record, laid_under, smooth_thermometer, thermometer_rate, with_smooth_thermometers

# What follows a temperature's rate of change, or how far one temperature is behind another.
LATE = (
    "bias_temperature_rate",
    "bias_temperature_product",
    "bias_temperature_gradient",
    "bias_temperature_gradient_rate",
    "bias_thermal_hysteresis",
    "temperature_lag",
)
# Evidence (nats) that such noise must be able to make from which on it is asked for.
SHOWS = 3.0


def within_thermometers(steps: Steps, selection: Selection, as_read: Record) -> tuple[Selection, str]:
    """What was found, less further thermal names that explain no more than noise of thermometers leaves of the largest.

    A rate of change is known no better than its thermometer is read: beside a large error that follows it, what that
    leaves is more than the gyro's noise, follows other thermal names by a part, and is in no fit. What follows a
    temperature itself, or no thermometer, stays where it shows beside what is left, and all stays that explains more.

    Args:
        steps: of the search.
        selection: what it found.
        as_read: the record with thermometers as they were read.

    Returns:
        The selection, and what is to be said of names that it no longer has.
    """
    found, first = selection.found, selection.first
    heated = smoothed(steps.scanner.record, as_read)
    thermal = selection.driver is not None and _thermal(selection.driver, heated)
    if steps.scanner.record.domain != "gyro" or not (thermal or any(f.name in LATE for f in found)):
        return selection, ""
    others = [f for f in found if f.name not in LATE]
    bases = [(steps.baseline, others)]
    name, _ = first.best(drivers=False, but=("outliers", *filter(is_noise, first.statistic)))
    if found and name is not None:
        strongest = next((f for f in selection.path[:1] if f.name == name), None)
        alone = selection.estimates[1] if strongest else None
        if strongest is None:
            strongest = steps.step([], steps.baseline, first, name)
            alone = steps.fit([strongest])
        if alone is not None:
            bases.append((alone, [strongest, *(f for f in others if f.name != name)]))
    for base, kept in bases:
        if thermal or {f.name for f in kept} != {f.name for f in found}:
            left = left_by_thermometers(base, as_read, selection.estimate)
            fewer = _only(steps, selection, kept, left, heated) if left >= SHOWS else None
            if fewer is not None:
                return fewer
    return selection, ""


def _thermal(driver: str, heated: bool) -> bool:
    """Whether a driver is of a temperature, or of the rate where that is in part known by its heat."""
    columns = {base_of(column)[0] for column in smooth_columns(driver)}
    return bool(thermometers(columns)) or (heated and "rate" in columns)


def smoothed(record: Record, as_read: Record) -> bool:
    """Whether a record's thermometers are others than were read."""
    return any(
        not np.array_equal(*(np.asarray(r.signals[name])[: as_read.rows] for r in (record, as_read)), equal_nan=True)
        for name in thermometers(as_read.signals)
    )


def _only(
    steps: Steps, selection: Selection, kept: list[Found], left: float, heated: bool
) -> tuple[Selection, str] | None:
    """A selection of a part of what was found, each ranked beside those before it, and what is said of the rest.

    None where the rest explains more than is left (nats), or there is no fit.
    """
    path, estimates = list[Found](), [steps.baseline]
    for step in kept:
        ranking = steps.rank(estimates[-1], path)
        least = steps.least(ranking, step.name) + step.more + steps.further(path, step.name)
        if not step.points and ranking.statistic.get(step.name, -np.inf) < least:
            continue
        path.append(replace(step, ranking=ranking, paired=False))
        after = steps.fit(path)
        if after is None:
            return None
        estimates.append(after)
    # In one noise, as another would take up what is missing.
    held = replace(steps, noise=(selection.estimate.ratios,))
    given_up = Found("", None, rows_of([*selection.found, *path]), selection.first)
    fewer, whole = held.fit([*path, given_up]), held.fit([*selection.found, given_up])
    thermal = selection.driver if selection.driver and _thermal(selection.driver, heated) else ""
    followed = selection.followed if thermal else 0.0
    if fewer is None or whole is None or quality(whole) - quality(fewer) + followed > left:
        return None
    last = steps.rank(estimates[-1], path)
    drivers = {k: v for k, v in last.statistic.items() if is_driver(k)}
    shows = {k: v for k, v in drivers.items() if v >= steps.least(last, k)}
    if any(_thermal(k, heated) and v > left for k, v in shows.items()):
        return None
    more = selection.remains
    if last.statistic.get(more, -np.inf) < (left if more in LATE else steps.least(last, more) if more else np.inf):
        more = ""
    rest = sorted({f.name for f in selection.found} - {f.name for f in path})
    rest += [f"what follows {' and '.join(smooth_columns(thermal))}"] if thermal else []
    if not rest:
        return None
    beside = f" beside {listed([f.name for f in path])}" if path else ""
    said = (
        f"Not named{beside}: {listed(rest)}. Together they explain no more than about what noise of the thermometers "
        "leaves: less of it, or the temperature changed more slowly, would tell."
    )
    return Selection(
        estimates[-1],
        tuple(path),
        tuple(path),
        last,
        tuple(estimates),
        max((k for k in shows if not _thermal(k, heated)), key=lambda k: shows[k], default=None),
        remains=more,
        unresolved=selection.unresolved,
    ), said


def left_by_thermometers(estimate: Estimate, as_read: Record, noise: Estimate) -> float:
    """The evidence (nats) of about what noise of thermometers leaves of a fit, in the noise of another fit.

    From one more reading of smooth temperatures, with as much noise as their thermometers have, and what it changes in
    their rates of change; and in themselves where the fit has them smooth.

    Args:
        estimate: the fit.
        as_read: its record with thermometers as they were read.
        noise: a fit of the same data whose noise is the gyro's.
    """
    smooth, rng, rows = with_smooth_thermometers(as_read), np.random.default_rng(0), as_read.rows
    before, again = estimate.record.signals, dict(estimate.record.signals)
    own = smoothed(estimate.record, as_read)
    for name in thermometers(as_read.signals):
        true, read, used = (np.asarray(s[name])[:rows] for s in (smooth.signals, as_read.signals, before))
        other = true + _noise_of(read, true, as_read.run[:rows]) * rng.standard_normal(rows)
        new = smooth_thermometer(as_read, other) if own else (used, thermometer_rate(as_read, other))
        again |= laid_under(before, name, *new)
    change = np.asarray(estimate.model.predict(again) - estimate.model.predict(before))
    present = np.asarray(estimate.record.sampling.present)
    # The correlated noise of a fit of smooth temperatures is in part what is left of theirs.
    ratios = NoiseRatios(np.zeros(()), np.zeros(())) if own else noise.ratios
    whitened = whiten_columns(filter_of(estimate.record, ratios), np.where(present, change, 0.0)[:, None])
    each = np.asarray(whitened)[present]
    return 0.5 * len(each) * float(np.log1p(np.mean(each**2) / noise.white_variance))


def _noise_of(read: np.ndarray, smooth: np.ndarray, run: np.ndarray) -> float:
    """Standard deviation of a thermometer's noise: what is fast in it, and no more than what smoothing takes away."""
    second = np.diff(read, 2)[(run[2:] == run[:-2])]
    fast = np.median(np.abs(second)) / (0.6745 * np.sqrt(6.0)) if len(second) else np.inf
    return float(min(fast, np.std(read - smooth)))
