"""What noise of thermometers may pass for beside a cause that follows them: further names, which explain it."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from gyromodel._checks import listed, thermometers
from gyromodel.diagnosis._drivers import smooth_columns
from gyromodel.diagnosis._ranking import is_noise
from gyromodel.diagnosis._search import Selection, significant_driver
from gyromodel.diagnosis._session import Session
from gyromodel.diagnosis._steps import Found, quality, rows_of
from gyromodel.estimate import Estimate, filter_of, whiten_columns
from gyromodel.signals import Record, thermometer_rate, with_smooth_thermometers

# Evidence (nats) that such noise must be able to make from which on it is asked for.
SHOWS = 3.0


def within_thermometers(session: Session, selection: Selection, measured: Record) -> Selection:
    """What was found, less further names that explain no more than noise of thermometers may leave of the strongest.

    A rate of change, above all, is known no better than its thermometer is read: beside a large error that follows it,
    what that leaves is more than the gyro's noise, follows other thermal names by a part, and is in no fit. What
    follows a column that is no thermometer stays, and so does what explains more than all of it.

    Args:
        session: the search.
        selection: what it found.
        measured: the record with thermometers as they were read.
    """
    name, found, steps = selection.first.best(drivers=False)[0], selection.found, session.steps
    if session.record.domain != "gyro" or not found or name is None or is_noise(name) or name == "outliers":
        return selection
    first = next((f for f in selection.path[:1] if f.name == name), None)
    strongest = first or steps.step([], session.baseline, selection.first, name)
    alone = selection.estimates[1] if first else steps.fit([strongest])
    others = [f for f in found if f.name != name and f.follows and not any(thermometers(f.follows))]
    given_up = Found("", None, rows_of([*found, strongest]), selection.first)
    for before, kept in ((session.baseline, others), (alone, [strongest, *others])):
        if before is None or not (len(kept) < len(found) or selection.driver):
            continue
        left = left_by_thermometers(before, measured, selection.estimate)
        if left < SHOWS:
            continue
        fewer, whole = steps.fit([*kept, given_up]), steps.fit([*found, given_up])
        if fewer and whole and quality(whole) - quality(fewer) + selection.followed <= left:
            return _only(session, selection, tuple(kept), left)
    return selection


def _only(session: Session, selection: Selection, kept: tuple[Found, ...], left: float) -> Selection:
    """A selection of a part of what was found, where the rest may be what thermometers leave (nats)."""
    steps, estimates = session.steps, [session.baseline]
    for i in range(len(kept)):
        after = steps.fit(kept[: i + 1])
        if after is None:
            return selection
        estimates.append(after)
    last = steps.rank(estimates[-1], kept)
    driver = significant_driver(last, steps.threshold)
    rest = sorted({f.name for f in selection.found} - {f.name for f in kept})
    rest += [f"what follows {' and '.join(smooth_columns(selection.driver))}"] if selection.driver else []
    beside = f" beside {listed([f.name for f in kept])}" if kept else ""
    return Selection(
        estimates[-1],
        kept,
        kept,
        last,
        tuple(estimates),
        driver if driver and last.statistic[driver] > left else None,
        unresolved=f"Not named{beside}: {listed(rest)}. All of it together explains no more than noise of the "
        "thermometers may leave: less of it, or the temperature changed more slowly, would tell.",
    )


def left_by_thermometers(estimate: Estimate, measured: Record, whole: Estimate) -> float:
    """The evidence (nats) at most of what noise of thermometers leaves of a fit, in the noise of another fit.

    From one more reading of smooth temperatures with as much noise as their thermometers have; `measured` is the record
    with temperatures as they were read.
    """
    smooth, signals = with_smooth_thermometers(measured), dict(measured.signals)
    rng, rows = np.random.default_rng(0), measured.rows
    for name in thermometers(measured.signals):
        true, read = (np.asarray(r.signals[name])[:rows] for r in (smooth, measured))
        again = true + np.std(read - true) * rng.standard_normal(rows)
        for column, values in ((name, again), (f"{name}_rate", thermometer_rate(measured, again))):
            if column in signals:
                signals[column] = jnp.asarray(np.pad(values, (0, len(signals[column]) - rows), mode="edge"))
    change = np.asarray(estimate.model.predict(signals) - estimate.model.predict(smooth.signals))
    present = np.asarray(estimate.record.sampling.present)
    whitened = whiten_columns(filter_of(estimate.record, whole.ratios), np.where(present, change, 0.0)[:, None])
    each = np.asarray(whitened)[present]
    return 0.5 * len(each) * float(np.log1p(np.mean(each**2) / whole.white_variance))
