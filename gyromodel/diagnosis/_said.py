"""What is said of a finished search besides names: what was given up, left out, held, nearly as likely, or left."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from gyromodel._checks import listed
from gyromodel.campaign import Campaign
from gyromodel.diagnosis._lines import lines_of
from gyromodel.diagnosis._ranking import is_driver, special_cases
from gyromodel.diagnosis._result import CREDIBLE, VAGUE
from gyromodel.diagnosis._search import Selection
from gyromodel.diagnosis._steps import Found, Steps
from gyromodel.effects import Effect
from gyromodel.effects.drivers import BiasPeriodic, BiasStep
from gyromodel.effects.geometry import TableHarmonic
from gyromodel.effects.thermometer import TemperatureLag
from gyromodel.estimate import Estimate

# Parts of an interval by which samples may be off a regular grid before they tell a line from its aliases.
IRREGULAR = 0.01
# Of a gyro that is turned over these follow the Earth's rate too: its vertical part the first, its northern all.
UNDER_EARTH = ("bias_acceleration_input", "bias_acceleration_output", "bias_acceleration_spin")
# Gross errors that are listed by row.
ROWS_TOLD = 12


def told(
    steps: Steps, selection: Selection, extended: Estimate, searched: Sequence[tuple[Campaign, bool]], edges: bool
) -> Iterator[str]:
    """Sentences on the extension as a whole, whatever the verdict; `edges`: samples on the other side of a step's."""
    what = "given up, as they may be at edges of steps" if edges else "given up, not modelled"
    yield from (f"{line}: {what}." for line in _given_up(steps, selection, searched))
    found = selection.found
    for one, other in zip(selection.path, selection.path[1:], strict=False):
        if one.paired and {one.name, other.name} <= {step.name for step in found}:
            yield (
                f"{one.name} and {other.name} show together and hardly alone: much alike on this campaign, they all "
                "but cancel."
            )
    for step in (f for f in found if f.rows and not f.points):
        yield (
            f"{len(step.rows)} samples next to gaps or the record's ends were left out beside {step.name}: what was "
            "not recorded still shows there."
        )
    yield from (line for step in found if (line := _in_campaign(step.effect)))
    if any(isinstance(step.effect, BiasPeriodic) for step in found) and (also := _aliases(extended)):
        yield also
    held: dict[str, list[str]] = {}
    for label, shape in sorted(extended.model.fixed - steps.baseline.model.fixed):
        held.setdefault(label, []).append(shape)
    for label, shapes in held.items():
        yield (
            f"{' and '.join(shapes)} of {label} stayed where the search had put them, as they could not be estimated: "
            "the other uncertainties are those for just these values."
        )


def told_of_cause(steps: Steps, step: Found, extended: Estimate, known: set[str]) -> Iterator[str]:
    """Sentences on one cause; `known` are the names told of anyway."""
    name, model = step.name, steps.baseline.model
    if name in model.wholly_fixed():
        yield f"{name} is fixed in the simulation at a value that the data contradict: it was set free."
    elif step.grows and name in model.labels:
        yield f"{name} is in the simulation, but not in this form: the extended model has it whole."
    if name == "scale_factor":
        yield "A scale error of the rate table would look the same: check it against a second reference."
    late = [e.late for e in extended.model.effects if isinstance(e, TemperatureLag) and e.label == name]
    yield from (f"Of thermometer and coil the {part} is late." for part in late)
    orders = [o for e in extended.model.effects if isinstance(e, TableHarmonic) and e.label == name for o in e.orders]
    yield from [f"It returns {listed([str(o) for o in orders])} times a turn of the table."] if orders else []
    if name in UNDER_EARTH and "rate" not in steps.scanner.record.units:
        yield (
            "No reference rate is given: where the Earth's is in the output, biases from acceleration hold up to 15.04 "
            "deg/h per g of it, which a column rate in inertial space (rate_frame: inertial) would take out."
        )
    if (odds := -steps.scanner.bank.price(name)) > 0.0:
        yield f"Of the evidence for {name}, {odds:.1f} nats are prior odds: every gyro has one."
    if close := _close_rival(step, known):
        yield close


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
    given_up = sorted(row for step in selection.found for row in step.points)
    dwells = steps.scanner.points_among(given_up)
    if dwells:
        what = f"{len(dwells)} whole dwells, which begin" if len(dwells) > 1 else "A whole dwell, which begins"
        yield f"{what} {places([int(d[0]) for d in dwells], searched)}"
    of_dwells = {int(row) for dwell in dwells for row in dwell}
    errors = [row for row in given_up if row not in of_dwells]
    if errors:
        what = f"{len(errors)} gross errors" if len(errors) > 1 else "A gross error"
        yield f"{what} {places(errors, searched)}"


def _in_campaign(effect: Effect | None) -> str:
    """Which of several campaigns a step or lines are in."""
    if isinstance(effect, BiasStep) and effect.campaign:
        return f"The step found is in campaign {effect.campaign}."
    if isinstance(effect, BiasPeriodic) and effect.campaigns:
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
    return f"Rows every {record.interval:.4g} s cannot tell a line from its aliases: {listed(each)}."


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
