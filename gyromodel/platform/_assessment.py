"""A logged vibration test, whole: the response of each run, what explains them together, and which test would tell."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import norm

from gyromodel._checks import CampaignError, listed
from gyromodel.campaign import Campaign
from gyromodel.estimate import EstimateError
from gyromodel.platform._acceptance import AXES
from gyromodel.platform._explanations import (
    ALTERNATIVES,
    ENTRIES,
    Explanation,
    Points,
    assumed_loop,
    explain,
    points,
    separation,
)
from gyromodel.platform._loop import Loop
from gyromodel.platform._motion import BaseMotion, base_motion
from gyromodel.platform._responses import LEVEL, Response, responses
from gyromodel.platform._series import fit_series

# Entries that are viscous friction.
FRICTION = [ENTRIES.index(f"friction {axis}") for axis in AXES]
# Below this probability of its sum of squares an explanation is excluded.
EXCLUDED = 0.01
# Akaike's criterion above the best up to which an explanation is supported: one twentieth as likely.
SUPPORTED = 6.0
# Supported explanations, the best first, between which further tests are looked for, and rad/s of such tests.
RIVALS = 3
FURTHER = (40.0, 60.0, 80.0, 100.0, 140.0)
# Standard deviations between predictions with which 5 % of repetitions at most prefer the wrong one.
TOLD_APART, USELESS = 3.3, 0.05


@dataclass(frozen=True, eq=False)
class VibrationTest:
    """What a vibration test says.

    Attributes:
        responses: of each run that has one.
        remarks: on runs that have none, or need a second look.
        integrated: whether navigation integrated the rates of the platform.
        explanations: every alternative that the test determines, best first.
        scatter_stated: whether explanations were judged by the responses' own standard errors; where these exclude
            every one, whichever axis is left out, the scatter is what each of them leaves of all axes.
        left_out: the axis without which they do not: friction that sticks makes one such.
        supported: explanations that are not excluded and not far behind, best first.
        further: of further tests of all axes, the least separation of any two of the first supported ones, in standard
            deviations.
        series: the first supported one fitted to the angles themselves, overtones included, where they determine it.
        sticking: axes that this fit leaves out, as overtones exclude it with them, the one left out before included.
    """

    responses: tuple[Response, ...]
    remarks: tuple[str, ...]
    integrated: bool
    explanations: dict[str, Explanation] = field(repr=False)
    scatter_stated: bool
    left_out: tuple[str, ...]
    supported: tuple[str, ...]
    further: dict[str, float]
    series: Explanation | None = field(default=None, repr=False)
    sticking: tuple[str, ...] = ()

    @property
    def next_test(self) -> str | None:
        """The first further test that tells the supported explanations apart, else the one that comes nearest."""
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
            "further_tests": self.further,
            "next_test": self.next_test,
            "series": self.series
            and {
                "probability": self.series.probability,
                "axes_left_out": list(self.sticking),
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
    """The numbers of an explanation: offsets, friction over inertia of the default loop, natural frequencies, lag."""
    size, rows = float(norm.ppf(0.5 + LEVEL / 2)), []
    inertia = float(Loop().inertia)
    units = {"offset": (1e3, "ms"), "friction": (1 / inertia, "1/s"), "lag": (1e3, "ms"), "corner": (1.0, "rad/s")}
    units |= {"compliance": (1e6, "1e-6 s^2"), "dry friction": (1 / inertia, "rad/s^2")}
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
    explanations, scatter_stated, left_out = _judged(found, integrated)
    order = sorted(explanations, key=lambda name: explanations[name].criterion)
    explanations = {name: explanations[name] for name in order}
    supported = tuple(
        name
        for name, e in explanations.items()
        if e.criterion - explanations[order[0]].criterion <= SUPPORTED
        and not (scatter_stated and e.probability < EXCLUDED)
    )
    tell("fitting the series", 0.6)
    used = [r for r in found if r.axis not in left_out]
    series, sticking = _of_series(motion, used, supported, integrated)
    tell("looking for further tests", 0.8)
    further = _further({name: explanations[name] for name in supported[:RIVALS]}, _at(found, integrated), integrated)
    return VibrationTest(
        tuple(found), tuple(remarks), integrated, explanations, scatter_stated, left_out, supported, further, series,
        left_out + sticking,
    )  # fmt: skip


def _judged(found: list[Response], integrated: bool) -> tuple[dict[str, Explanation], bool, tuple[str, ...]]:
    """Explanations, whether they were judged by stated errors, and the axis left out as these exclude all with it."""
    axes = sorted({r.axis for r in found})
    best: tuple[float, dict[str, Explanation], tuple[str, ...]] = 0.0, {}, ()
    for left_out in ((), *((axis,) for axis in axes if len(axes) > 1)):
        used = [r for r in found if r.axis not in left_out]
        stated = _explained(_at(used, integrated), used, known=True)
        probability = max((e.probability for e in stated.values()), default=0.0)
        if probability >= max(EXCLUDED, best[0]):
            best = probability, stated, left_out
        if not left_out and best[1]:
            break
    _, stated, left_out = best
    return (stated, True, left_out) if stated else (_explained(_at(found, integrated), found, known=False), False, ())


def _at(found: list[Response], integrated: bool) -> Points:
    axis = np.array([AXES.index(r.axis) for r in found])
    frequency, amplitude = (np.array([getattr(r, name) for r in found]) for name in ("frequency", "amplitude"))
    ones = np.ones(len(found))
    return Points(axis, frequency, ones, integrated * ones, np.deg2rad(amplitude))


def _of_series(
    motion: BaseMotion, found: list[Response], supported: tuple[str, ...], integrated: bool
) -> tuple[Explanation | None, tuple[str, ...]]:
    """The fit of the series, without one axis where all together exclude it and the others do not."""
    axes = sorted({r.axis for r in found})
    without = [(), *((axis,) for axis in axes if len(axes) > 1)]
    fits: list[tuple[Explanation, tuple[str, ...]]] = []
    for left_out in without if supported else ():
        try:
            runs = [r for r in found if r.axis not in left_out]
            fits.append((fit_series(motion, runs, ALTERNATIVES[supported[0]], integrated), left_out))
        except EstimateError:
            continue
        if not left_out and fits[0][0].probability >= EXCLUDED:
            break
    return max(fits, key=lambda fit: fit[0].probability, default=(None, ()))


def _explained(at: Points, found: list[Response], known: bool) -> dict[str, Explanation]:
    gain, phase = (np.array([getattr(r, name) for r in found]) for name in ("gain", "phase"))
    # A squared normal error over an estimated variance is ν/(ν − 2) on average.
    loose = np.sqrt([r.degrees_of_freedom / (r.degrees_of_freedom - 2) for r in found])
    stds = [loose * np.array([getattr(r, name) for r in found]) for name in ("gain_std", "phase_std")]
    gain_std, phase_std = stds if known and np.min(stds) > 0 else (None, None)
    explanations = {}
    for name, alternative in ALTERNATIVES.items():
        try:
            explanations[name] = explain(alternative, at, gain, phase, phase_std=phase_std, gain_std=gain_std)
        except EstimateError:
            continue  # too few points for it
    return {name: e for name, e in explanations.items() if e.degrees_of_freedom > 0 and _held(e)}


def _held(found: Explanation) -> bool:
    """Whether the loop holds the body more than friction drags it: else the two make a delay, and no platform."""
    loop = assumed_loop(found)
    return float(found.value[FRICTION].max()) < float(loop.amplifier * loop.correction * loop.motor)


def _further(rivals: dict[str, Explanation], at: Points, integrated: bool) -> dict[str, float]:
    if len(rivals) < 2:
        return {}
    tests = {"the same again": at}
    tests |= {
        f"{w:g} rad/s": points(np.array([w]), 1.0, float(integrated), float(at.amplitude.mean()))
        for w in FURTHER
        if w > at.frequency.max()
    }
    tests["the same at half the amplifier gain"] = at._replace(amplifier=0.5 * at.amplifier)
    if not integrated:
        tests["the same, gyros logged"] = at._replace(integrated=np.ones_like(at.integrated))
    return {
        name: min(_apart(*pair, at, test) for pair in combinations(rivals.values(), 2)) for name, test in tests.items()
    }


def _apart(one: Explanation, other: Explanation, at: Points, test: Points) -> float:
    """By how much either misses the other; one that contains the other, or that stays undetermined, never misses it."""
    found = [0.0]
    for a, b in ((one, other), (other, one)):
        with suppress(EstimateError):
            found.append(separation(a, b.alternative, at, test, signed=True))
    return max(found)
