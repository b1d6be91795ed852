"""What noise of thermometers may pass for beside a cause that follows their rate of change: further thermal names."""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
import numpy as np

from gyromodel._checks import listed, thermometers
from gyromodel.declarations import measured as base_of
from gyromodel.diagnosis._drivers import smooth_columns
from gyromodel.diagnosis._ranking import Ranking, is_noise
from gyromodel.diagnosis._selection import FURTHER, Selection, significant_driver
from gyromodel.diagnosis._steps import Found, Steps, quality, rows_of
from gyromodel.estimate import Estimate, filter_of, whiten_columns
from gyromodel.model import effect_class
from gyromodel.signals import Record, thermometer_rate, with_smooth_thermometers

# Evidence (nats) that such noise must be able to make from which on it is asked for.
SHOWS = 3.0


def within_thermometers(steps: Steps, selection: Selection, as_read: Record) -> tuple[Selection, str]:
    """What was found, less further thermal names that explain no more than noise of thermometers leaves of the largest.

    A rate of change is known no better than its thermometer is read: beside a large error that follows it, what that
    leaves is more than the gyro's noise, follows other thermal names by a part, and is in no fit. What follows no
    thermometer stays, and so does all where it explains more.

    Args:
        steps: of the search.
        selection: what it found.
        as_read: the record with thermometers as they were read.

    Returns:
        The selection, and what is to be said of names that it no longer has.
    """
    found, first, driver = selection.found, selection.first, selection.driver
    thermal_driver = driver is not None and _thermal(*(base_of(c)[0] for c in smooth_columns(driver)))
    if steps.scanner.record.domain != "gyro" or not (thermal_driver or any(_thermal(*f.follows) for f in found)):
        return selection, ""
    others = [f for f in found if not _thermal(*f.follows)]
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
        if not (len(kept) < len(found) or thermal_driver):
            continue
        left = left_by_thermometers(base, as_read, selection.estimate)
        if left < SHOWS:
            continue
        given_up = Found("", None, rows_of([*found, *kept]), first)
        fewer, whole = steps.fit([*kept, given_up]), steps.fit([*found, given_up])
        if fewer is None or whole is None:
            continue
        if quality(whole) - quality(fewer) + selection.followed * thermal_driver <= left:
            return _only(steps, selection, kept, left, thermal_driver)
    return selection, ""


def _thermal(*columns: str) -> bool:
    return bool(thermometers(columns))


def _only(
    steps: Steps, selection: Selection, kept: list[Found], left: float, thermal_driver: bool
) -> tuple[Selection, str]:
    """A selection of a part of what was found, each ranked beside those before it; the rest is what is left (nats)."""
    path, estimates = list[Found](), [steps.baseline]
    for step in kept:
        ranking = steps.rank(estimates[-1], path)
        if not step.points and ranking.statistic.get(step.name, -np.inf) < _least(steps, ranking, step, bool(path)):
            continue
        path.append(replace(step, ranking=ranking, paired=False))
        after = steps.fit(path)
        if after is None:
            return selection, ""
        estimates.append(after)
    last = steps.rank(estimates[-1], path)
    driver, more = significant_driver(last, steps.threshold), selection.remains
    if driver and _thermal(*(base_of(c)[0] for c in smooth_columns(driver))):
        if last.statistic[driver] > left:
            return selection, ""
        driver = None
    shows = more in last.statistic and last.statistic[more] >= steps.least(last, more)
    more = more if shows and not _thermal(*_needs(more)) else ""
    rest = sorted({f.name for f in selection.found} - {f.name for f in path})
    if thermal_driver:
        rest.append(f"what follows {' and '.join(smooth_columns(str(selection.driver)))}")
    beside = f" beside {listed([f.name for f in path])}" if path else ""
    said = (
        f"Not named{beside}: {listed(rest)}. Together they explain no more than about what noise of the thermometers "
        "leaves: less of it, or the temperature changed more slowly, would tell."
    )
    fewer = Selection(
        estimates[-1],
        tuple(path),
        tuple(path),
        last,
        tuple(estimates),
        driver,
        remains=more,
        unresolved=selection.unresolved,
    )
    return fewer, said


def _needs(name: str) -> tuple[str, ...]:
    return () if name == "outliers" or is_noise(name) else effect_class(name).needs


def _least(steps: Steps, ranking: Ranking, step: Found, further: bool) -> float:
    return steps.least(ranking, step.name) + step.more + FURTHER * further


def left_by_thermometers(estimate: Estimate, as_read: Record, noise: Estimate) -> float:
    """The evidence (nats) of about what noise of thermometers leaves of a fit, in the noise of another fit.

    From one more reading of smooth temperatures, with as much noise as their thermometers have, and what it changes in
    their rates of change. Temperatures themselves are searched smooth where their noise shows.

    Args:
        estimate: the fit.
        as_read: its record with thermometers as they were read.
        noise: a fit of the same data whose noise is the gyro's.
    """
    smooth, rng, rows = with_smooth_thermometers(as_read), np.random.default_rng(0), as_read.rows
    before, again = estimate.record.signals, dict(estimate.record.signals)
    for name in thermometers(as_read.signals):
        if f"{name}_rate" in before:
            true, read = (np.asarray(r.signals[name])[:rows] for r in (smooth, as_read))
            other = true + _noise_of(read, true, as_read.run[:rows]) * rng.standard_normal(rows)
            rate = thermometer_rate(as_read, other)
            again[f"{name}_rate"] = jnp.asarray(np.pad(rate, (0, len(before[name]) - rows), mode="edge"))
    change = np.asarray(estimate.model.predict(again) - estimate.model.predict(before))
    present = np.asarray(estimate.record.sampling.present)
    whitened = whiten_columns(filter_of(estimate.record, noise.ratios), np.where(present, change, 0.0)[:, None])
    each = np.asarray(whitened)[present]
    return 0.5 * len(each) * float(np.log1p(np.mean(each**2) / noise.white_variance))


def _noise_of(read: np.ndarray, smooth: np.ndarray, run: np.ndarray) -> float:
    """Standard deviation of a thermometer's noise: what is fast in it, and no more than what smoothing takes away."""
    second = np.diff(read, 2)[(run[2:] == run[:-2])]
    fast = np.median(np.abs(second)) / (0.6745 * np.sqrt(6.0)) if len(second) else np.inf
    return float(min(fast, np.std(read - smooth)))
