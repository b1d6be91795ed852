"""Which explanations a logged vibration test supports, and which further test would tell those apart.

All compete by one number, Akaike's criterion, as far as the angles themselves do not exclude them. Where few or none of
them hold, those that leave an axis out compete too, as a shaft that sticks makes one that nothing here describes: each
number left out counts as a parameter that takes it up.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import replace
from itertools import combinations
from typing import NamedTuple

import numpy as np

from gyromodel.estimate import EstimateError
from gyromodel.platform._acceptance import AXES
from gyromodel.platform._alternatives import ENTRIES, OFFERED, Alternative
from gyromodel.platform._explanations import Explanation, Points, assumed_loop, beginning, explain, points, separation
from gyromodel.platform._responses import Response

# Entries by kind.
KINDS = {kind: [i for i, name in enumerate(ENTRIES) if name.rstrip(" XYZ") == kind]
         for kind in ("offset", "friction", "dry friction", "compliance", "lag", "corner", "crossover")}  # fmt: skip
# Below this probability of its sum of squares an explanation is excluded, and below this of the best of them axes are
# left out as well; they are, too, where the angles exclude all.
EXCLUDED, DOUBTED = 1e-3, 0.05
# Akaike's criterion above the best up to which an explanation is supported: one twentieth as likely.
SUPPORTED = 6.0
# Degrees of freedom that a supported explanation has at least: four runs fit what is wrong as well.
LEAST_FREEDOM = 5
# Supported explanations, the best first, between which further tests are looked for, and rad/s of such tests.
RIVALS = 3
FURTHER = (40.0, 60.0, 80.0, 100.0, 140.0)


class Judgement(NamedTuple):
    """What becomes of the explanations.

    explanations: by name, best first; stated: whether the responses' own standard errors judged them; possible: those
    that are not excluded, not far behind and add nothing but what is seen, best first; few: whether one of these is
    left too few degrees of freedom, or the numbers of none are determined; held: whether the angles hold them too.
    """

    explanations: dict[str, Explanation]
    stated: bool
    possible: tuple[str, ...]
    few: bool
    held: bool


def judged(found: list[Response], integrated: bool, holds: Callable[[Explanation], bool] = lambda e: True) -> Judgement:
    """Fit and compare everything that is offered; `holds`: whether the angles of the runs do not exclude it."""
    axes = sorted({r.axis for r in found})
    explanations = _explained(found, integrated)
    possible = _possible(explanations, EXCLUDED, holds)
    if len(axes) > 1 and (not possible or _likeliest(explanations.values()) < DOUBTED):
        for axis in axes:
            others = _explained(found, integrated, (axis,)).items()
            explanations |= {f"{n}, without axis {axis}": e for n, e in others if e.probability >= EXCLUDED}
        possible = _possible(explanations, EXCLUDED, holds)
    stated, held = _likeliest(explanations.values()) >= EXCLUDED, bool(possible)
    if not stated:
        explanations = _explained(found, integrated, known=False)
    possible = possible or _possible(explanations, EXCLUDED if stated else 0.0)
    few = not possible or any(explanations[name].degrees_of_freedom < LEAST_FREEDOM for name in possible)
    explanations = dict(sorted(explanations.items(), key=lambda item: item[1].criterion))
    return Judgement(explanations, stated, tuple(possible), few, held)


def _possible(
    explanations: dict[str, Explanation], least: float, holds: Callable[[Explanation], bool] = lambda e: True
) -> list[str]:
    """Those of some probability that hold, nearly as good as the best of them, that add nothing but what is seen."""
    chosen: dict[str, Explanation] = {}
    for name, e in sorted(explanations.items(), key=lambda item: item[1].criterion):
        best = min((other.criterion for other in chosen.values()), default=e.criterion)
        if e.probability < least or e.criterion - best > SUPPORTED or not _sized(e):
            continue
        if not any(_within(smaller, e) for smaller in chosen.values()) and holds(e):
            chosen[name] = e
    return list(chosen)


def _likeliest(explanations: Iterable[Explanation]) -> float:
    return max((e.probability for e in explanations), default=0.0)


def _within(smaller: Explanation, larger: Explanation) -> bool:
    """Whether the larger explanation only adds to the smaller."""
    return set(smaller.left_out) <= set(larger.left_out) and smaller.alternative.within(larger.alternative)


def _sized(found: Explanation) -> bool:
    """Whether a number of each kind that is fitted exceeds its standard uncertainty."""
    kinds = {"offset" if kind == "offsets" else kind for kind in found.alternative.kinds}
    return all((np.abs(found.value[KINDS[k]]) > found.std[KINDS[k]]).any() for k in kinds)


def _plausible(found: Explanation) -> bool:
    """Whether the loop holds the body more than friction drags it, and the mount is damped less than critically.

    Else friction and loop make a delay and no platform; and 2ζ/ω_n above 2/ω_n leaves no resonance.
    """
    loop, value = assumed_loop(found), found.value
    holds = value[KINDS["friction"]].max() < float(loop.amplifier * loop.correction * loop.motor)
    return bool(holds and value[KINDS["lag"]][0] <= 2 * np.sqrt(value[KINDS["compliance"]].max()))


def under(found: list[Response], integrated: bool) -> Points:
    """Under what each response was measured."""
    axis = np.array([AXES.index(r.axis) for r in found])
    frequency, amplitude = (np.array([getattr(r, name) for r in found]) for name in ("frequency", "amplitude"))
    ones = np.ones(len(found))
    return Points(axis, frequency, ones, integrated * ones, np.deg2rad(amplitude))


def explained(
    alternative: Alternative, found: list[Response], integrated: bool, left_out: tuple[str, ...] = (),
    known: bool = True, smaller: Iterable[Explanation] = (),
) -> Explanation:  # fmt: skip
    """An alternative fitted to responses, but for those of some axes.

    Args:
        alternative: to fit.
        found: the responses.
        integrated: whether navigation integrated the rates of the platform.
        left_out: axes whose numbers each cost a parameter instead.
        known: whether the standard errors of the responses are taken for known.
        smaller: explanations within it, at the best of which the fit begins once more: from afar it may end in a
            place that has more friction, or less than none.

    Raises:
        EstimateError: they do not determine it.
    """
    used = [r for r in found if r.axis not in left_out]
    gain, phase = (np.array([getattr(r, name) for r in used]) for name in ("gain", "phase"))
    # A squared normal error over an estimated variance is ν/(ν − 2) on average.
    loose = np.sqrt([r.degrees_of_freedom / (r.degrees_of_freedom - 2) for r in used])
    stds = [loose * np.array([getattr(r, name) for r in used]) for name in ("gain_std", "phase_std")]
    gain_std, phase_std = stds if known and np.min(stds) > 0 else (None, None)
    near = min(smaller, key=lambda e: e.criterion, default=None)
    fits = []
    for start in (None, *([beginning(near)] if near else [])):
        with suppress(EstimateError):
            at = under(used, integrated)
            fits.append(explain(alternative, at, gain, phase, True, phase_std, gain_std, start))
    if not fits:
        raise EstimateError("the points of the vibration test do not determine this explanation")
    fit = min(fits, key=lambda e: e.criterion)
    return replace(fit, criterion=fit.criterion + 4 * (len(found) - len(used)), left_out=left_out)


def _explained(
    found: list[Response], integrated: bool, left_out: tuple[str, ...] = (), known: bool = True
) -> dict[str, Explanation]:
    explanations: dict[str, Explanation] = {}
    for name, alternative in sorted(OFFERED.items(), key=lambda item: len(item[1].kinds)):
        smaller = [e for e in explanations.values() if e.alternative.within(alternative)]
        with suppress(EstimateError):  # too few points for it
            e = explained(alternative, found, integrated, left_out, known, smaller)
            if e.degrees_of_freedom > 0 and _plausible(e):
                explanations[name] = e
    return explanations


def further(possible: list[Explanation], found: list[Response], integrated: bool) -> dict[str, float]:
    """Of further tests of all axes, the least separation of any two of the first explanations, in standard errors."""
    if len(possible) < 2:
        return {}
    at = under(found, integrated)
    tests = {"the same again": at}
    tests |= {
        f"{w:g} rad/s": points(np.array([w]), 1.0, float(integrated), float(at.amplitude.mean()))
        for w in FURTHER
        if w > at.frequency.max()
    }
    tests["the same at half the amplifier gain"] = at._replace(amplifier=0.5 * at.amplifier)
    if not integrated:
        tests["the same, gyros logged"] = at._replace(integrated=np.ones_like(at.integrated))
    pairs = list(combinations(possible[:RIVALS], 2))
    return {name: min(_apart(*pair, at, test) for pair in pairs) for name, test in tests.items()}


def _apart(one: Explanation, other: Explanation, at: Points, test: Points) -> float:
    """By how much either misses the other; one that contains the other, or that stays undetermined, never misses it."""
    # Of an axis that one of them leaves out nothing is predicted.
    out = [AXES.index(axis) for axis in (*one.left_out, *other.left_out)]
    if set(at.axis) <= set(out):
        return 0.0
    before, after = (Points(*(np.asarray(x)[~np.isin(p.axis, out)] for x in p)) for p in (at, test))
    found = [0.0]
    for a, b in ((one, other), (other, one)):
        with suppress(EstimateError):
            found.append(separation(a, b.alternative, before, after, signed=True))
    return max(found)
