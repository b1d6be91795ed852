"""A logged vibration test, whole: the response of each run, what explains them together, and which test would tell."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.stats import norm

from gyromodel._checks import CampaignError, listed
from gyromodel.campaign import Campaign
from gyromodel.estimate import EstimateError
from gyromodel.platform._acceptance import AXES
from gyromodel.platform._alternatives import ENTRIES, Alternative
from gyromodel.platform._explanations import Explanation
from gyromodel.platform._judgement import EXCLUDED, explained, further, judged
from gyromodel.platform._loop import Loop
from gyromodel.platform._motion import BaseMotion, base_motion
from gyromodel.platform._responses import LEVEL, Response, responses
from gyromodel.platform._series import fit_series

# Standard deviations between predictions with which 5 % of repetitions at most prefer the wrong one.
TOLD_APART, USELESS = 3.3, 0.05
# Standard uncertainties that a crossover which the runs determine is worth.
DETERMINED = 5.0
# What tells more where runs are too few.
MORE = "more frequencies about each axis"
# Periods of a run that its history has at least, where there is one, and shows at most.
LEAST_PERIODS, MOST_PERIODS = 3.0, 8.0


class History(NamedTuple):
    """The beginning of a run: time from its start, s; angle of the table and that of the base by navigation, rad."""

    run: int
    frequency: float
    time: Float[np.ndarray, " sample"]
    table: Float[np.ndarray, " sample"]
    base: Float[np.ndarray, " sample"]


@dataclass(frozen=True, eq=False)
class VibrationTest:
    """What a vibration test says.

    Attributes:
        responses: of each run that has one.
        remarks: on runs that have none, or need a second look.
        integrated: whether navigation integrated the rates of the platform.
        explanations: every alternative that the test determines, best first; those that leave an axis out are among
            them where the others hardly pass, by names that say so: friction that sticks makes such an axis.
        scatter_stated: whether explanations were judged by the responses' own standard errors; where these exclude
            every one, whichever axis is left out, the scatter is what each of them leaves of all axes.
        possible: explanations that are not excluded, not far behind, and add nothing but what is seen, best first.
        few: whether the runs are too few to name one: some of these are left too few degrees of freedom, or there is
            none whose numbers are determined.
        held: whether the angles, overtones included, do not exclude the possible ones; where they exclude all, nothing
            offered explains the runs.
        further: of further tests of all axes, the least separation of any two of the first possible ones, in standard
            deviations.
        crossover: of the loop, where the runs determine it beside the rest of the first possible one.
        histories: of one run of each axis.
        series: the first supported one fitted to the angles themselves, overtones included, where they determine it.
    """

    responses: tuple[Response, ...]
    remarks: tuple[str, ...]
    integrated: bool
    explanations: dict[str, Explanation] = field(repr=False)
    scatter_stated: bool
    possible: tuple[str, ...]
    few: bool
    held: bool
    further: dict[str, float]
    crossover: Row | None = None
    histories: dict[str, History] = field(default_factory=dict, repr=False)
    series: Explanation | None = field(default=None, repr=False)

    @property
    def supported(self) -> tuple[str, ...]:
        """The possible explanations, none where the runs are too few."""
        return () if self.few else self.possible

    @property
    def best(self) -> Explanation | None:
        """The first possible explanation."""
        return self.explanations[self.possible[0]] if self.possible else None

    @property
    def firm(self) -> bool:
        """Whether one explanation alone is supported, by the runs' own errors and by the angles, which determine it."""
        return len(self.supported) == 1 and self.scatter_stated and self.held and self.series is not None

    @property
    def left_out(self) -> tuple[str, ...]:
        """Axes that every supported explanation leaves out."""
        outs = {self.explanations[name].left_out for name in self.supported}
        return outs.pop() if len(outs) == 1 else ()

    @property
    def next_test(self) -> str | None:
        """The first further test that tells possible explanations apart, else the one that comes nearest."""
        if self.few:
            return MORE
        enough = [name for name, apart in self.further.items() if apart >= TOLD_APART]
        best = max(self.further, key=lambda name: self.further[name], default=None)
        return next(iter(enough), best if best and self.further[best] > USELESS else None)

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        best = min((e.criterion for e in self.explanations.values()), default=0.0)
        return {
            "gyros_integrated": self.integrated,
            "runs": [response.to_dict() for response in self.responses],
            "remarks": list(self.remarks),
            "explanations": [
                {
                    "name": name,
                    "supported": name in self.supported,
                    "excluded": self.scatter_stated and e.probability < EXCLUDED,
                    "axes_left_out": list(e.left_out),
                    "criterion_above_best": e.criterion - best,
                    "sum_of_squares": e.sum_of_squares if self.scatter_stated else None,
                    "degrees_of_freedom": e.degrees_of_freedom,
                    "probability": e.probability if self.scatter_stated else None,
                    "scatter": {"gain_db": e.scatter[0], "phase_deg": e.scatter[1]},
                    "parameters": [row._asdict() for row in parameters(e)],
                }
                for name, e in self.explanations.items()
            ],
            "scatter_stated": self.scatter_stated,
            "axes_left_out": list(self.left_out),
            "supported": list(self.supported),
            "possible": list(self.possible),
            "too_few_runs": self.few,
            "held_by_angles": self.held,
            "firm": self.firm,
            "crossover": self.crossover and self.crossover._asdict(),
            "further_tests": self.further,
            "next_test": self.next_test,
            "series": self.series
            and {
                "probability": self.series.probability,
                "parameters": [row._asdict() for row in parameters(self.series)],
            },
        }


class Row(NamedTuple):
    """A fitted number in the unit of reports, with its standard uncertainty and 95 % interval."""

    name: str
    value: float
    std: float
    low: float
    high: float
    unit: str


def parameters(found: Explanation) -> list[Row]:
    """The numbers of an explanation: offsets, friction over inertia of the default loop, compliance, lag, loop."""
    size, rows = float(norm.ppf(0.5 + LEVEL / 2)), []
    inertia = float(Loop().inertia)
    units = {"offset": (1e3, "ms"), "friction": (1 / inertia, "1/s"), "lag": (1e3, "ms")}
    units |= {"corner": (1.0, "rad/s"), "crossover": (1.0, "rad/s")}
    units |= {"compliance": (1e6, "ms^2"), "dry friction": (1 / inertia, "rad/s^2")}
    same = "offset" in found.alternative.kinds
    for name, value, std in zip(ENTRIES, found.value, found.std, strict=True):
        kind, axis = (name[:-2], name[-1]) if name[-1] in AXES else (name, "")
        if not std or (kind == "offset" and same and axis != AXES[0]):
            continue
        scale, unit = units[kind]
        value, std = scale * float(value), scale * float(std)
        low = value - size * std if kind == "offset" else max(value - size * std, 0.0)
        label = {
            "offset": "time offset",
            "friction": "friction over inertia",
            "dry friction": "dry friction over inertia",
        }.get(kind, kind)
        shown = label if kind == "offset" and same else f"{label} {axis}".strip()
        rows.append(Row(shown, value, std, low, value + size * std, unit))
    return rows


def vibration_test(campaign: Campaign, progress: Callable[[str, float], None] | None = None) -> VibrationTest:
    """Navigate, fit every run, judge it by the published limits, and explain all runs together.

    Args:
        campaign: what `base_motion` takes, runs of one axis and one frequency each.
        progress: told what is being done and the share done.

    Raises:
        CampaignError: something is missing, or no run vibrates.
    """
    tell = progress or (lambda text, share: None)
    tell("navigating", 0.0)
    motion = base_motion(campaign)
    tell("fitting runs", 0.1)
    found, remarks = responses(motion)
    if not found:
        raise CampaignError(f"{campaign.name}: no run has a vibration: {listed(remarks)}")
    integrated = any(name.startswith("output_") for name in campaign.columns)
    tell("explaining", 0.3)
    fits: dict[Explanation, Explanation | None] = {}

    def by_angles(e: Explanation) -> Explanation | None:
        if e not in fits:
            fits[e] = _of_series(motion, [r for r in found if r.axis not in e.left_out], e, integrated)
        return fits[e]

    def holds(e: Explanation) -> bool:
        return (fit := by_angles(e)) is None or fit.probability >= EXCLUDED

    verdict = judged(found, integrated, holds)
    possible = [verdict.explanations[name] for name in verdict.possible]
    tell("looking for further tests", 0.8)
    return VibrationTest(
        responses=tuple(found),
        remarks=tuple(remarks),
        integrated=integrated,
        explanations=verdict.explanations,
        scatter_stated=verdict.stated,
        possible=verdict.possible,
        few=verdict.few,
        held=verdict.held,
        further=further(possible, found, integrated),
        crossover=None if verdict.few else _crossover(possible[0], found, integrated, verdict.stated),
        histories=_histories(motion, found),
        series=None if verdict.few else by_angles(possible[0]),
    )


def _crossover(best: Explanation, found: list[Response], integrated: bool, known: bool) -> Row | None:
    """The crossover fitted beside the rest of an explanation, where the runs determine it."""
    alternative = best.alternative
    if "crossover" not in alternative.kinds:
        alternative = Alternative((*alternative.kinds, "crossover"), alternative.loop, alternative.grounded)
    with suppress(EstimateError):
        row = parameters(explained(alternative, found, integrated, best.left_out, known, [best]))[-1]
        return row if row.name == "crossover" and row.value > DETERMINED * row.std else None
    return None


def _of_series(motion: BaseMotion, runs: list[Response], found: Explanation, integrated: bool) -> Explanation | None:
    """An explanation fitted to the angles of some runs, where they determine it."""
    with suppress(EstimateError):
        return fit_series(motion, runs, found.alternative, integrated, found.value)
    return None


def _histories(motion: BaseMotion, found: list[Response]) -> dict[str, History]:
    """Of each axis the slowest run that has some periods, else the one that has most."""
    histories = {}
    for axis in sorted({r.axis for r in found}):
        runs = [r for r in found if r.axis == axis]
        long = [r for r in runs if r.periods >= LEAST_PERIODS]
        chosen = min(long, key=lambda r: r.frequency) if long else max(runs, key=lambda r: r.periods)
        rows = np.flatnonzero(motion.segment == chosen.run - 1)
        time = motion.time[rows] - motion.time[rows[0]]
        rows = rows[time <= MOST_PERIODS * 2 * np.pi / chosen.frequency]
        angles = (x[rows, AXES.index(axis)] for x in (motion.table, motion.base))
        histories[axis] = History(chosen.run, chosen.frequency, time[: len(rows)], *angles)
    return histories
