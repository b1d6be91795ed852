"""What is said of a finished search besides names: what was given up, left out, held, nearly as likely, or left."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from scipy.stats import binom

from gyromodel._checks import listed, thermometers
from gyromodel.campaign import Campaign
from gyromodel.diagnosis._drivers import CLOCK_DRIVER, RECOVERY_DRIVER, driver_names, kind_of, proportion
from gyromodel.diagnosis._evidence import log_sum
from gyromodel.diagnosis._lines import lines_of
from gyromodel.diagnosis._ranking import Ranking, is_driver, is_noise, special_cases
from gyromodel.diagnosis._result import CREDIBLE, VAGUE
from gyromodel.diagnosis._scan import Scanner
from gyromodel.diagnosis._selection import Selection
from gyromodel.diagnosis._smooths import recoveries
from gyromodel.diagnosis._steps import Found, Steps
from gyromodel.effects import Effect
from gyromodel.effects.acceleration import BiasAccelerationSquared
from gyromodel.effects.drivers import BiasPeriodic, BiasStep
from gyromodel.effects.geometry import Misalignment, TableHarmonic
from gyromodel.effects.thermometer import TemperatureLag
from gyromodel.estimate import Estimate
from gyromodel.model import effect_class
from gyromodel.signals import Record

# Parts of an interval by which samples may be off a regular grid before they tell a line from its aliases.
IRREGULAR = 0.01
# Of a gyro that is turned over a bias from one acceleration follows the Earth's rate too, vertical or northern.
UNDER_EARTH = "bias_acceleration_"
# Gross errors that are listed by row.
ROWS_TOLD = 12
# By how much the lags searched are apart, within which one is known.
BETWEEN_LAGS = 2.0**0.5
# By how many nats (ln B) a random walk may lead what it may be instead, names that share what it is, and how many.
LIKELY, ALIKE, MOST_NAMES = -1.0, 2.0, 3
# Chance below which they lie right after changes of the rate for a reason.
BY_CHANCE = 1e-4


def told(
    steps: Steps, selection: Selection, extended: Estimate, searched: Sequence[tuple[Campaign, bool]], edges: bool
) -> Iterator[str]:
    """Sentences on the extension as a whole, whatever the verdict; `edges`: samples on the other side of a step's."""
    what = "given up, as they may be at edges of steps" if edges else "given up, not modelled"
    yield from (f"{line}: {what}." for line in _given_up(steps, selection, searched))
    yield from _after_changes(steps, selection)
    found = selection.found
    for one, other in zip(selection.path, selection.path[1:], strict=False):
        names, alone = {one.name, other.name}, one.ranking
        hardly = all(alone.statistic.get(name, -np.inf) < steps.least(alone, name) for name in names)
        if one.paired and hardly and names <= {step.name for step in found}:
            yield (
                f"{one.name} and {other.name} show together and hardly alone: much alike on this campaign, they all "
                "but cancel."
            )
    # Lines that are none are told of otherwise.
    kept = {*(step.name for step in found), "bias_periodic"}
    if found and (gone := [name for name in dict.fromkeys(f.name for f in selection.path) if name not in kept]):
        were = "was" if len(gone) == 1 else "were"
        yield f"{listed(gone)} {were} added on the way, and given up beside what was found."
    for step in (f for f in found if f.rows and not f.points):
        were = (
            "samples next to gaps or the record's ends were" if len(step.rows) > 1 else "sample at a gap or an end was"
        )
        yield f"{len(step.rows)} {were} left out beside {step.name}: what was not recorded still shows there."
    yield from (line for step in found if (line := _in_campaign(step.effect)))
    if any(isinstance(step.effect, BiasPeriodic) for step in found) and (also := _aliases(extended)):
        yield also
    held: dict[str, list[str]] = {}
    labels = {step.effect.label for step in found if step.effect is not None}
    for label, shape in sorted(extended.model.fixed - steps.baseline.model.fixed):
        if label in labels:
            held.setdefault(label, []).append(shape)
    for label, shapes in held.items():
        yield (
            f"{' and '.join(shapes)} of {label} stayed where the search had put them, as they could not be estimated: "
            "the other uncertainties are those for just these values."
        )


def told_of_cause(steps: Steps, step: Found, extended: Estimate, known: set[str]) -> Iterator[str]:
    """Sentences on one cause; `known` are the names told of anyway."""
    name, model = step.name, steps.baseline.model
    if name in model.wholly_fixed() and effect_class(name).scan:
        yield f"{name} of the simulation is fixed: it was set free beside the one that was found."
    elif name in model.wholly_fixed():
        yield f"{name} is fixed in the simulation at a value that the data contradict: it was set free."
    elif step.effect is not None and (had := sorted({*step.effect.supersedes} & model.wholly_fixed())):
        yield f"{listed(had)} of the simulation is fixed: as a part of {name} it was set free."
    elif step.grows and name in model.labels:
        yield f"{name} is in the simulation, but not in this form: the extended model has it whole."
    if name == "scale_factor":
        yield "A scale error of the rate table would look the same: check it against a second reference."
    late = [e.late for e in extended.model.effects if isinstance(e, TemperatureLag) and e.label == name]
    yield from (f"As {name} it is the {part} that is late, of thermometer and coil." for part in late)
    yield from _of_columns(steps.scanner.record, step.effect)
    orders = [o for e in extended.model.effects if isinstance(e, TableHarmonic) and e.label == name for o in e.orders]
    yield from [f"It returns {listed([str(o) for o in orders])} times a turn of the table."] if orders else []
    for effect in (e for e in extended.model.effects if e.label == name):
        if isinstance(effect, Misalignment):
            yield f"Angles of {name}, in this order: about {listed(effect.about)}."
        elif isinstance(effect, BiasAccelerationSquared):
            yield f"Coefficients of {name}, in this order: of {listed(effect.products)}."
    squared = isinstance(step.effect, BiasAccelerationSquared)
    if name.startswith(UNDER_EARTH) and not squared and "rate" not in steps.scanner.record.units:
        yield (
            "No reference rate is given: where the Earth's is in the output, biases from acceleration hold up to 15.04 "
            "deg/h per g of it, which a column rate in inertial space (rate_frame: inertial) would take out."
        )
    if (odds := -steps.scanner.bank.price(name)) > 0.0:
        yield f"Of the evidence for {name}, {odds:.1f} nats are prior odds: every gyro has one."
    if close := _close_rival(step, known):
        yield close


def _of_columns(record: Record, effect: Effect | None) -> Iterator[str]:
    """Which thermometers an effect is of, where there are several, and which columns may stand for its own."""
    own = effect.columns_needed if effect is not None else ()
    if effect is not None and len(thermometers(record.signals)) > 1 and (of := thermometers(own)):
        yield f"The thermometer{'s' * (len(of) > 1)} of {effect.label}: {listed(of)}."
    for a in own:
        for b in driver_names(record):
            if b in own or a not in record.signals or kind_of(record, a) != kind_of(record, b):
                continue
            one, other = (np.asarray(record.signals[n])[: record.rows][record.present] for n in (a, b))
            if proportion(one, other) is not None:
                yield f"{a} and {b} go in proportion here: which of them it follows, this campaign cannot tell."


def told_of_walk(steps: Steps, last: Ranking) -> Iterator[str]:
    """A sentence where what was taken for a random walk may be an effect, which the walk keeps from being accepted."""
    walks, still = ([g for g, walks in last.walks.items() if walks is there] for there in (True, False))
    if steps.scanner.record.domain != "gyro" or steps.baseline.noise_given or not walks or not still:
        return

    def weight(cells: Sequence[int], name: str = "") -> float:
        each = (last.results[g].log_likelihood + last.log_prior[g] for g in cells)
        own = (last.results[g].evidence.get(name, -np.inf) if name else 0.0 for g in cells)
        return log_sum([one + other for one, other in zip(each, own, strict=True)])

    walk, nothing = weight(walks), weight(still)
    kept = [k for k, score in last.statistic.items() if score < steps.least(last, k)]
    effects = [k for k in kept if not (is_driver(k) or is_noise(k) or k == "outliers")]
    lead = {k: weight(still, k) - walk for k in effects}
    top = max(lead.values(), default=-np.inf)
    if not (walk > nothing and top > LIKELY and top + walk - nothing > steps.threshold):
        return
    near = {k for k, v in lead.items() if v > top - ALIKE}
    own = (k for k in near if (near - {k}).isdisjoint(special_cases(k)))
    names = sorted(own, key=lambda k: -lead[k])[:MOST_NAMES]
    yield (
        f"What was taken for a random walk of the bias may as well be {' or '.join(names)} (ln B {top:.1f} against the "
        "walk, which would have to be ruled out): repeat the run, as noise does not come back."
    )


def told_of_rest(selection: Selection, extended: Estimate) -> str:
    """A sentence on what is still significant and was not added."""
    return (
        f"More remains than was named: {selection.remains} is still significant (ln B = "
        f"{selection.last.statistic.get(selection.remains, np.nan):.0f}) and was not added. All values are those "
        f"without it{_moved(extended, selection.beside_it)}."
    )


def _given_up(steps: Steps, selection: Selection, searched: Sequence[tuple[Campaign, bool]]) -> Iterator[str]:
    """Dwells and single samples that no model holds; test points are told of as a cause."""
    if steps.scanner.by_points:
        return
    dwells, errors = _dwells_and_errors(steps, selection)
    if dwells:
        what = f"{len(dwells)} whole dwells, which begin" if len(dwells) > 1 else "A whole dwell, which begins"
        yield f"{what} {places([int(d[0]) for d in dwells], searched)}"
    if errors:
        what = f"{len(errors)} gross errors" if len(errors) > 1 else "A gross error"
        yield f"{what} {places(errors, searched)}"


def _dwells_and_errors(steps: Steps, selection: Selection) -> tuple[list[np.ndarray], list[int]]:
    """Rows of each whole dwell, and the single rows beside, that no model holds."""
    given_up = sorted({row for step in selection.found for row in step.points})
    dwells = steps.scanner.points_among(given_up)
    of_dwells = {int(row) for dwell in dwells for row in dwell}
    return dwells, [row for row in given_up if row not in of_dwells]


def _after_changes(steps: Steps, selection: Selection) -> Iterator[str]:
    """A sentence where gross errors are the first samples of new rates."""
    scanner = steps.scanner
    signals, rows = scanner.record.signals, scanner.record.rows
    if scanner.by_points or "rate" not in signals:
        return
    changed = np.diff(np.asarray(signals["rate"])[:rows], prepend=np.asarray(signals["rate"])[0]) != 0
    changed &= ~np.asarray(scanner.record.sampling.restart)[:rows]
    _, errors = _dwells_and_errors(steps, selection)
    on = int(changed[errors].sum())
    if on and binom.sf(on - 1, len(errors), changed.mean()) < BY_CHANCE:
        yield (
            f"{on} of {len(errors)} gross errors are the first sample after a change of the rate: the gyro's or the "
            "reference's delay."
        )


def told_of_driver(scanner: Scanner, selection: Selection, driver: str) -> Iterator[str]:
    """A delay that grows, and the time constant of what follows the rate through a lag."""
    if driver == CLOCK_DRIVER:
        yield "A delay that grows with time does so: the clocks of gyro and reference may run apart."
    if driver != RECOVERY_DRIVER:
        return
    along = scanner.bank.blocks[int(np.asarray(selection.last.best_form(driver)[0]))].along
    assert along is not None
    for lag in (lag for lag, late in recoveries(scanner.record) if np.array_equal(late, along)):
        yield (
            "After each change of the rate the error recovers in proportion to it, with a time constant of some "
            f"{lag / BETWEEN_LAGS:.2g} to {lag * BETWEEN_LAGS:.2g} s."
        )
        if lag < scanner.record.interval:
            yield "That is less than a sample: the times of gyro and reference may be apart."


def _in_campaign(effect: Effect | None) -> str:
    """Which of several campaigns a step or lines are in."""
    if isinstance(effect, BiasStep) and effect.campaign:
        return f"The step found is in campaign {effect.campaign}."
    if isinstance(effect, BiasPeriodic) and effect.campaigns:
        if len(set(effect.campaigns)) == 1:
            lines = "line found is" if len(effect.campaigns) == 1 else "lines found are"
            return f"The {lines} in campaign {effect.campaigns[0]}."
        return f"The lines found are in campaigns {', '.join(map(str, effect.campaigns))}, in this order."
    return ""


def _aliases(estimate: Estimate) -> str:
    """Where else lines may lie that regular samples show at these frequencies: the nearest two places of each."""
    record = estimate.record
    time = np.asarray(record.signals["time"])[: record.rows]
    steps = np.diff(time)[np.diff(record.run[: record.rows]) == 0]
    if np.abs(steps / record.interval - np.round(steps / record.interval)).max() > IRREGULAR:
        return ""
    sampled = 1.0 / record.interval
    lines = sorted({line.frequency for line in lines_of(estimate.model)})
    each = [f"{f:.4g} Hz ({sampled - f:.4g}, {sampled + f:.4g} Hz, …)" for f in lines]
    told = f"every {record.interval:.4g} s cannot tell a line from its aliases: {listed(each)}"
    if "_averaged" not in record.signals or np.asarray(record.signals["_averaged"]).max() < 2:
        return f"Rows {told}."
    seen = 0.5 / float(np.median(np.asarray(record.signals["_step"])[: record.rows]))
    return f"Means {told}; the rows that they are of tell those below {seen:.4g} Hz apart."


def _moved(estimate: Estimate, other: Estimate | None) -> str:
    """What other values another fit has, of those that it moves by more than chance."""
    there = {(r.effect, r.name): r for r in other.table()} if other else {}
    pairs = [(r, there[r.effect, r.name]) for r in estimate.table() if (r.effect, r.name) in there]
    said = [
        f"{r.name} of {r.effect} would be ({o.value:.5g} ± {o.std:.2g}) {o.unit}"
        for r, o in pairs
        if r.std and abs(o.value - r.value) > VAGUE * r.std
    ]
    return f"; with it {listed(said)}" if said else ""


def places(rows: Sequence[int], searched: Sequence[tuple[Campaign, bool]]) -> str:
    """Where rows of the record are in the files: by row, or by time where rows were left out or averaged."""
    begins = np.cumsum([0, *(len(c) for c, _ in searched)])
    stretches: list[list[int]] = []
    for row in rows:
        if stretches and row == stretches[-1][1] + 1 and row not in begins:
            stretches[-1][1] = row
        else:
            stretches.append([row, row])
    by_row, some = all(as_given for _, as_given in searched), []
    for ends in stretches[:ROWS_TOLD]:
        i = int(np.searchsorted(begins, ends[0], side="right")) - 1
        campaign, own = searched[i][0], [end - int(begins[i]) for end in ends]
        told = [f"{end + 1}" if by_row else f"{campaign.columns['time'][end]:.10g}" for end in own]
        unit = "" if by_row else f" {campaign.units['time']}"
        some.append(" to ".join(dict.fromkeys(told)) + unit + (f" of {campaign.name}" if len(searched) > 1 else ""))
    how = "at" if not by_row else "in data rows" if len(rows) > 1 else "in data row"
    return f"{how} {', '.join(some)}{'…' if len(stretches) > ROWS_TOLD else ''}"


def _close_rival(step: Found, told: set[str]) -> str | None:
    """A sentence where a name that is not told was nearly as likely at first, and a later step ruled it out."""
    statistic = step.ranking.statistic
    rivals = {k: v for k, v in statistic.items() if k not in (step.name, "outliers") and not is_driver(k)}
    rival = max(rivals, key=lambda k: rivals[k], default=None)
    if rival is None or rival in told or step.name in special_cases(rival) or rival in special_cases(step.name):
        return None
    lead = statistic.get(step.name, np.inf) - rivals[rival]
    if not 0 <= lead < -np.log(1.0 / CREDIBLE - 1.0):
        return None
    return f"When it was added, {step.name} led {rival} by {lead:.1f} nats only; later terms ruled {rival} out."
