"""Steps of a search chosen again, each beside all the others."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations, permutations

import numpy as np

from gyromodel.diagnosis._apart import like
from gyromodel.diagnosis._forms import periodic
from gyromodel.diagnosis._lines import lines_of, near
from gyromodel.diagnosis._misfit import changed, lines_of_noise, unsteady_lines
from gyromodel.diagnosis._ranking import SLOW_IN_TIME, Ranking, is_driver, is_noise
from gyromodel.diagnosis._steps import BETWEEN, EXCHANGE, Found, Steps, quality, standing
from gyromodel.effects.drivers import BiasPeriodic
from gyromodel.estimate import Estimate

# Lines that lead every other name by this much (nats) are not chosen again.
LINE_LEAD = 20.0
# The lead (nats) that a further cause must have over more of one found before: with less, neither is likely enough.
DOUBT = 3.0
# The lead (nats) over a random walk at which what it imitates is put beside it: the walk alone is one in twenty.
SLOW_LEAD = float(np.log(19.0))


def exchanged(steps: Steps, found: list[Found], estimate: Estimate) -> tuple[list[Found], Estimate, dict[int, Ranking]]:
    """Choose each addition again given all the others, and drop those that the others have made needless.

    Returns:
        What stands, its fit, and the rankings beside all but one that speak of it.
    """
    while True:
        found, estimate, rankings = _chosen_again(steps, found, estimate)
        if fewer := _one_for_two(steps, found, estimate, rankings):
            found, estimate = fewer
            continue
        own = {i: r.statistic[found[i].name] for i, r in rankings.items() if found[i].name in r.statistic}
        needless = [i for i, v in own.items() if v < _least(steps, rankings[i], found[i].name)]
        for i in sorted(needless, key=lambda i: own[i]) if len(found) > 1 else ():
            fewer = found[:i] + found[i + 1 :]
            after = steps.fit(fewer)
            if after is None:
                return found, estimate, rankings
            hidden = _hidden(steps, found, i, estimate, after)
            if hidden is None:
                break
            rankings[i] = hidden
        else:
            return found, estimate, rankings
        found, estimate = fewer, after


def _hidden(steps: Steps, found: list[Found], i: int, estimate: Estimate, without: Estimate) -> Ranking | None:
    """All candidates beside the others as they are with item i, where these stand for it in the fit without.

    None where they have not: it is needless.
    """
    step, others = found[i], [*found[:i], *found[i + 1 :]]
    shapes = any(not slot.linear for slot in without.model.slots())
    if step.effect is None or step.rows or not shapes or step.effect.label not in estimate.model.labels:
        return None
    beside = estimate.model.without(step.effect.label)
    if {*beside.labels} != {*without.model.labels}:
        return None
    gain = quality(estimate) - quality(without)
    if not gain >= steps.least(step.ranking, step.name):
        return None
    ranking = steps.rank(replace(estimate, model=beside), others)
    own = ranking.statistic.get(step.name, -np.inf)
    return ranking if own >= _least(steps, ranking, step.name) else None


def _one_for_two(
    steps: Steps, found: list[Found], estimate: Estimate, rankings: dict[int, Ranking]
) -> tuple[list[Found], Estimate] | None:
    """What was found less an addition that another one, which it led by little, makes needless in a wider form.

    `rankings` are those beside all but one. Two names have to do better than the one by the odds of a firm name.
    """
    for i, j in permutations(range(len(found)), 2):
        step, other = found[i], found[j]
        own = step.ranking.statistic.get(step.name, -np.inf)
        led_by = own - step.ranking.statistic.get(other.name, -np.inf)
        # As much as a shape between those searched may lose is no lead.
        led = not np.isfinite(own) or led_by > max(DOUBT, BETWEEN * own)
        if led or step.effect is None or other.effect is None or step.name == other.name or j not in rankings:
            continue
        others = [f for k, f in enumerate(found) if k not in (i, j)]
        base = steps.fit(others)
        if base is None:
            continue
        ranking = steps.rank(base, others)
        if ranking.statistic.get(other.name, -np.inf) < steps.least(ranking, other.name):
            continue
        one, after = steps.add(others, steps.step(others, base, ranking, other.name))
        if after is None or unresolved(after, one, steps.scanner.step):
            continue
        # In one noise, as another would take up a part.
        if replace(steps, noise=(estimate.ratios,)).fits_better([*others, one], found, -DOUBT):
            return [*others, one], after
    return None


def _least(steps: Steps, ranking: Ranking, name: str) -> float:
    """The evidence beside all others with which an addition stays: less for what a random walk is put beside."""
    slow = steps.scanner.runs < 2 and like(steps.scanner, ranking, name, SLOW_IN_TIME)
    return SLOW_LEAD if slow or name in SLOW_IN_TIME else steps.least(ranking, name)


def _chosen_again(
    steps: Steps, found: list[Found], estimate: Estimate
) -> tuple[list[Found], Estimate, dict[int, Ranking]]:
    """One pass: each addition exchanged for a better one given all the others, but for noise, which only may go.

    A better one may be another form of the same: which was best had been judged with less beside it.
    """
    rankings: dict[int, Ranking] = {}
    for i in range(len(found) if len(found) > 1 else 0):
        if not found[i].weighed or uncontested(found[i]) or (rest := steps.all_but(found, i)) is None:
            continue
        base, rankings[i] = rest
        if found[i].effect is None:
            continue
        ranking, others = rankings[i], found[:i] + found[i + 1 :]
        # Further lines would come on top of the others, not in the place of this one.
        lines = any(f.name == "bias_periodic" for f in others)
        name, score = ranking.best(drivers=False, but=("bias_periodic",) if lines else ())
        own = ranking.statistic.get(found[i].name, -np.inf)
        reshaped = name == found[i].name and steps.scanner.bank.structures(found[i].name) > 1
        if (
            name is None
            # It went with what it grew from, which the others do not hold.
            or found[i].name not in ranking.statistic
            or is_noise(name)
            or name == "outliers"
            or not (reshaped or score >= max(own + EXCHANGE, steps.least(ranking, name)))
        ):
            continue
        step = steps.step(others, base, ranking, name)
        again = [*others[:i], step, *others[i:]]
        if len(standing(again)) < len(again):
            continue
        after = steps.fit(again)
        if (
            after is None
            or not steps.keeps(base, step, after)
            or not steps.fits_better(again, found, EXCHANGE * reshaped)
        ):
            continue
        if not unresolved(after, step, steps.scanner.step):
            found, estimate, rankings = again, after, {i: ranking}
    return found, estimate, rankings


def steady(steps: Steps, found: list[Found], estimate: Estimate) -> tuple[list[Found], Estimate, str]:
    """What was found less the lines that change or are noise of a band, its fit, and what is said of the first.

    Where these are the stronger, no line stands: the others may be parts of the same.
    """
    given, far = lines_of(steps.baseline.model), 1.0 / estimate.record.span
    changing, weaker = list[float](), list[float]()
    while any(f.name == "bias_periodic" for f in found):
        lines, effect = lines_of(estimate.model), estimate.model.effects[estimate.model.labels.index("bias_periodic")]
        assert isinstance(effect, BiasPeriodic)
        own = np.array([not any(near(line, g, far) for g in given) for line in lines])
        noise = np.array(lines_of_noise(estimate))
        bad = flagged = own & (noise | np.array(unsteady_lines(estimate)))
        power = np.asarray(effect.cosine**2 + effect.sine**2)
        if power[bad].sum() > power[own & ~bad].sum():
            bad = own
        kept = [line for line, b in zip(lines, bad, strict=True) if not b]
        last = [f for f in found if f.name == "bias_periodic"][-1]
        others = [f for f in found if f.name != "bias_periodic"]
        others += [replace(last, effect=periodic(kept))] if (own & ~bad).any() else []
        after = steps.fit(others) if bad.any() else None
        if after is None:
            break
        found, estimate = others, after
        changing += [line.frequency for line, b in zip(lines, flagged & ~noise, strict=True) if b]
        weaker += [line.frequency for line, b in zip(lines, bad & ~flagged, strict=True) if b]
    if not changing:
        changing, weaker = weaker, []
    return found, estimate, changed(estimate.record, changing, weaker) if changing else ""


def uncontested(step: Found) -> bool:
    """Whether it is lines that led every other name by far when they were added: nothing else makes a line."""
    rivals = [v for k, v in step.ranking.statistic.items() if k not in (step.name, "outliers") and not is_driver(k)]
    own = step.ranking.statistic.get(step.name, -np.inf)
    return step.name == "bias_periodic" and own > max(rivals, default=-np.inf) + LINE_LEAD


def unresolved(estimate: Estimate, step: Found, reading: float) -> str:
    """Why an effect says nothing, as it is nowhere larger than what passes for it; `reading`: the step of readings.

    Readings of what moves within a step stand still, and a still reading of a moving thing is an error that follows
    the motion: it is not the noise that the evidence weighs. Nor is what another effect may leave. Lines that a fit
    moves together are one that is not steady.
    """
    model, record = estimate.model, estimate.record
    pairs = combinations(lines_of(model), 2)
    if step.name == "bias_periodic" and any(near(one, other, 0.5 / record.span) for one, other in pairs):
        return f"{step.name} would have lines that the record cannot resolve: one that is not steady, and is not named."
    if record.domain == "gyro" or step.effect is None or step.effect.label not in model.labels:
        return ""
    effect = model.effects[model.labels.index(step.effect.label)]
    size = float(np.abs(np.asarray(effect.contribution(record.signals))[: record.rows]).max())
    left = {e.label: e.leaves(record.signals) for e in model.effects if e.label != effect.label}
    other = max(left, key=lambda label: left[label], default="")
    if reading and size < 0.5 * reading:
        within = f"half a step of the encoders ({np.rad2deg(reading):.2g} deg)"
        passes = "readings that stand still pass"
    elif other and size < left[other]:
        within = f"{np.rad2deg(left[other]):.2g} deg"
        passes = f"what sticks, which {other} leaves out, passes"
    else:
        return ""
    return f"{step.name} would be within {within} throughout, where {passes} for it: not named."
