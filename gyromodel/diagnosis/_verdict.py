"""From rankings to a verdict: which names the data support, which they cannot tell apart, and what would settle it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from gyromodel._checks import thermometers
from gyromodel.campaign import Campaign
from gyromodel.diagnosis._apart import like, rests_on_one, shows, twins
from gyromodel.diagnosis._beside import UNKNOWN_EVIDENCE
from gyromodel.diagnosis._causes import cause_of
from gyromodel.diagnosis._drivers import smooth_columns
from gyromodel.diagnosis._exchange import uncontested
from gyromodel.diagnosis._judgement import Judgement, also_held, as_set
from gyromodel.diagnosis._next_tests import test_of_driver, test_of_names
from gyromodel.diagnosis._points import levels
from gyromodel.diagnosis._ranking import SLOW_IN_TIME, TIME_MARGIN, Ranking, is_driver, is_noise, special_cases
from gyromodel.diagnosis._result import CREDIBLE, VAGUE, Cause, ParameterValue, Verdict
from gyromodel.diagnosis._rounded import curve_of_rounding, no_farther, no_larger, of_rounding
from gyromodel.diagnosis._said import places, told, told_of_cause, told_of_driver, told_of_rest, told_of_walk
from gyromodel.diagnosis._scan import Scanner
from gyromodel.diagnosis._selection import Selection
from gyromodel.diagnosis._shapes import remaining
from gyromodel.diagnosis._steps import BETWEEN, Found, Steps
from gyromodel.effects._shapes import beyond_earth
from gyromodel.effects.drivers import BiasPeriodic
from gyromodel.estimate import Estimate
from gyromodel.model import effect_class

# Where the noise is slow even with them, these have no edge that a random walk could not make, whatever their lead.
NO_EDGE = ("bias_drift", "bias_warmup")
# Nats below which a cause is faint, and times that by which a stronger one of the same thermometer outdoes it.
FAINT, OUTDONE = 10.0, 10.0
# What makes lines at each harmonic of a ramp, of which its form holds a few.
CODES = "bias_readout_code"
# Dwells of a series that may be anomalous each for itself: so many, or this part of all.
FEW_APART, MANY_APART = 4, 0.1
# A driver that names leave with more than this share of the structure makes the discrepancy unknown.
UNKNOWN_SHARE = 0.05


def credible(
    scanner: Scanner, ranking: Ranking, name: str, statistic: float, *, beside: frozenset[str] = frozenset()
) -> dict[str, float]:
    """The smallest set of names with 95 % of the posterior, for the cause found as `name`; forms of a family merged.

    Names in `beside` come on top of this cause, not in its place.
    """
    # A step at the edge of the record is a gross error as well.
    apart = beside | (set() if name in ("outliers", "bias_step") else {"outliers"})
    # What explains the data worse than nothing at all is no explanation of what was found.
    own = {k: v for k, v in ranking.statistic.items() if k == name or not (v < 0.0 or is_driver(k) or k in apart)}
    hidden = like(scanner, ranking, name, NO_EDGE) and ranking.slow[ranking.best_cell(name)]
    too_close = statistic < TIME_MARGIN and ranking.slow_noise and like(scanner, ranking, name, SLOW_IN_TIME)
    if name not in ("outliers", "bias_step", "bias_periodic") and not is_noise(name):
        # Only the number of forms and coefficients sets them apart, which is no evidence.
        of_data = own[name] + scanner.bank.price(name)
        same = {k: of_data - scanner.bank.price(k) for k in twins(scanner, ranking, name) - apart}
        own |= {k: max(own.get(k, 0.0), value) for k, value in same.items()}
    # A drift comes back with the next run, a warm-up with the next power-on, and a step does not.
    since_on = np.asarray(scanner.record.signals.get("time_on", np.zeros(1)))[: scanner.record.rows]
    again = name == "bias_warmup" and bool((np.diff(since_on) < 0).any())
    once = scanner.runs < 2 and not again
    if (once or name == "bias_step") and (hidden or too_close):
        own["noise_random_walk"] = max(0.0, statistic - 1.0)
    top = max(own.values())
    weight = {k: float(np.exp(v - top)) for k, v in own.items()}
    total = sum(weight.values())
    chosen: dict[str, float] = {}
    for k in sorted(weight, key=lambda k: -weight[k]):
        chosen[k] = weight[k] / total
        if sum(chosen.values()) >= CREDIBLE:
            break
    # A special case that does as well is enough. Where what was found contains it and does better, but not surely, both
    # stand: whether there is more than the special case is then not known.
    for k in list(chosen):
        general = next((m for m in chosen if m not in (k, name) and k in special_cases(m)), None)
        if general and k in chosen:
            loser = min((k, general), key=lambda n: (n == name, chosen[n]))
            chosen[general if loser == k else k] += chosen.pop(loser)
    # What was added and is not among the likeliest is in doubt with them.
    return chosen if name in chosen else chosen | {name: weight[name] / total}


def judge(
    steps: Steps,
    selection: Selection,
    extended: Estimate,
    trials: int,
    null_scores: np.ndarray,
    searched: Sequence[tuple[Campaign, bool]],
    saw_tooth: float = 0.0,
    stated: bool = False,
) -> Judgement:
    """The verdict on a finished search.

    `searched`: the record's campaigns, and whether they are as given; `saw_tooth`: what rounding may have left in the
    output, peak to peak in its unit; `stated`: whether the simulation reads the output in the same steps.
    """
    scanner, last = steps.scanner, selection.last
    findings = list(told(steps, selection, extended, searched, saw_tooth > 0.0))
    causes, sets = [], []
    for i, step in enumerate(selection.found):
        ranking = _ranking_of(steps, selection, i)
        members = _members(steps, selection, extended, step, ranking, saw_tooth)
        if stated and "quantisation" in members:
            findings.append(f"{step.name} is no larger than what rounding makes: finer steps of the output would tell.")
            continue
        if not members:
            continue
        beside = {f.name for f in selection.found if f is not step}
        findings += told_of_cause(steps, step, extended, {*members, *beside})
        turn = sum(f.name == step.name for f in selection.found[i:])
        least, statistic = steps.least(ranking, step.name) + step.more, ranking.statistic[step.name]
        held = {r.name: r.value for r in steps.baseline.table() if r.effect == step.name and not r.std > 0.0}
        cause = cause_of(scanner, extended, step, turn, ranking, members, statistic, trials, null_scores, least, held)
        causes.append(replace(cause, places=places(sorted(step.points), searched)) if step.points else cause)
        sets.append(members)
    simulated, contained = steps.baseline.model, selection.first.contained
    hidden = [
        not (c.points or is_noise(c.effect) or shows(extended, c.effect, simulated, contained.get(c.effect, 0)))
        for c in causes
    ]
    sets = _with_doubts(causes, sets, extended, hidden)
    named_too = [c for c, not_seen in zip(causes, hidden, strict=True) if not not_seen]
    # Dwells of a series that are anomalous hide nothing else.
    aside = [c.effect == "outliers" and not scanner.by_points for c in causes]
    order = sorted(range(len(causes)), key=lambda i: (aside[i], -causes[i].statistic))
    causes, sets = [causes[i] for i in order], [sets[i] for i in order]
    if selection.remains and not selection.unresolved:
        findings.append(told_of_rest(selection, extended))
    findings += told_of_walk(steps, last)
    driver, share = remaining(scanner, steps.baseline, selection)
    if driver and curve_of_rounding(steps, selection, driver, saw_tooth):
        findings.append(
            f"What follows {' and '.join(smooth_columns(driver))} is no larger than what rounding makes: finer steps "
            "of the output would tell."
        )
        driver = None
    findings += told_of_driver(scanner, selection, driver) if driver else ()
    unexplained = {" and ".join(smooth_columns(driver)): share} if driver else {}

    def judged(verdict: Verdict, causes: Sequence[Cause], credible: dict[str, float], **more: str | None) -> Judgement:
        what = {"driver": None, "next_test": None} | more
        once = tuple(dict.fromkeys(findings))
        return Judgement(verdict, tuple(causes), credible, unexplained=unexplained, findings=once, **what)

    effects = [c for c in causes if scanner.by_points or c.effect != "outliers"]
    strongest = max((c.statistic for c in effects), default=0.0)
    if driver and (share > UNKNOWN_SHARE or last.statistic[driver] > UNKNOWN_EVIDENCE * strongest):
        if any(f.beside for f in selection.found):
            findings.append(
                "Sizes of names beside it are fitted with what has no name as noise, as their uncertainties say."
            )
        return judged("unknown", named_too, {driver: 1.0}, driver=driver, next_test=test_of_driver(driver))
    if not saw_tooth and _outweighed(effects, selection, scanner.record.domain):
        # A name holds less of what is there than it leaves, in a form that it cannot have; or all of them do.
        driver, score = last.best(drivers=True)
        driver = driver if score > steps.threshold else None
        return judged("unknown", named_too, {driver or str(selection.remains): 1.0}, driver=driver)
    # Single gross errors are no cause, however many of them a search did not come to.
    if not effects and selection.remains and not saw_tooth and (scanner.by_points or selection.remains != "outliers"):
        return judged("unknown", causes, {selection.remains: 1.0})
    if not causes:
        return judged("adequate", (), {})
    apart = sum(len(scanner.points_among(c.points)) for c in causes if c.effect == "outliers")
    if not scanner.by_points and apart > max(FEW_APART, MANY_APART * len(scanner.points)):
        findings.append(
            f"{apart} of {len(scanner.points)} dwells stand apart from all that was found: so many are no gross errors."
        )
        test = "Repeat these dwells in another order: gross errors do not come back, what the gyro does there does."
        return judged("unknown", causes, {"outliers": 1.0}, next_test=test)
    named = [c for c, s in zip(causes, sets, strict=True) if len(s) == 1]
    doubt = _left_open(sets, {c.effect for c in named})
    for i, (cause, members) in enumerate(zip(causes, sets, strict=True)):
        if len(members) > 1 and i != doubt:
            findings.append(also_held(cause.effect, members))
    if doubt is None:
        return judged("named", named, sets[0])
    cause, members = causes[doubt], sets[doubt]
    firm = [c for c in named if c.effect not in members]
    test = test_of_names(list(members), scanner.record, cause)
    return judged("ambiguous", (*as_set(cause, members), *firm), members, next_test=test)


def _left_open(sets: Sequence[dict[str, float]], firm: set[str]) -> int | None:
    """The first of some causes' sets of names that leaves open what is missing; none where all are firm.

    What may be noise, rounding or a part of a firm cause need not be anything else: only as the strongest is it open.
    """
    taken = firm | {"quantisation"}
    open_to = (i for i, s in enumerate(sets) if len(s) > 1 and not (taken & s.keys() or any(map(is_noise, s))))
    return 0 if len(sets[0]) > 1 else next(open_to, None)


def _ranking_of(steps: Steps, selection: Selection, i: int) -> Ranking:
    """The ranking that judges what was found i-th: beside all the rest, if that may differ from when it was added."""
    found, step, ranking = selection.found, selection.found[i], selection.left_out.get(i)
    # What grew is judged whole.
    grew = sum(f.name == step.name for f in selection.path) > sum(f.name == step.name for f in found)
    if ranking is None and (len(found) > 1 or grew) and not uncontested(step):
        rest = steps.all_but(list(found), i)
        ranking = rest[1] if rest else None
    return ranking if ranking is not None and step.name in ranking.statistic else step.ranking


def _members(
    steps: Steps, selection: Selection, extended: Estimate, step: Found, ranking: Ranking, saw_tooth: float
) -> dict[str, float]:
    """The names that may stand for what was found, with their shares; none where it is no cause."""
    scanner, name = steps.scanner, step.name
    # What was not added may stand in the place of this.
    beside = frozenset(f.name for f in selection.found if f is not step) - {selection.remains}
    members = credible(scanner, ranking, name, ranking.statistic[name], beside=beside)
    if name == "outliers":
        bad = np.array([np.isin(p, step.points).all() for p in scanner.points], bool)
        in_a_row = not scanner.by_points and (bad[:-2] & bad[1:-1] & bad[2:]).any()
        doubts = {"scale_spline": _unrepeated(scanner, bad), "bias_step": in_a_row and scanner.steps}
        rivals = [k for k, possible in doubts.items() if possible]
        if not rivals:
            return members if scanner.by_points or bad.any() else {}
        own = {k: 0.5 * share for k, share in members.items()}
        members = own | {k: 0.5 / len(rivals) + own.get(k, 0.0) for k in rivals}
    if step.effect is not None and name not in SLOW_IN_TIME and rests_on_one(extended, name):
        members = {k: 0.5 * share for k, share in members.items()} | {"outliers": 0.5}
    if isinstance(step.effect, BiasPeriodic) and of_rounding(extended):
        members = {k: 0.5 * share for k, share in members.items()} | {"noise_quantisation": 0.5}
    if saw_tooth and step.points and no_farther(extended, step.points, saw_tooth):
        return {}
    if saw_tooth and step.effect is not None and no_larger(extended, name, saw_tooth):
        members = {k: 0.5 * share for k, share in members.items()} | {"quantisation": 0.5}
    return members


def _with_doubts(
    causes: Sequence[Cause], sets: Sequence[dict[str, float]], extended: Estimate, hidden: Sequence[bool]
) -> list[dict[str, float]]:
    """Each cause's names, with those that a vague, a faint or a hidden one may be another's part of."""
    # Of these only something in common has a size: which of them it is, this campaign cannot tell.
    sizes = [_fitted(c) for c in causes]
    vague = [c.effect for c, s in zip(causes, sizes, strict=True) if any(p.std for p in s) and not any(map(_sized, s))]
    shared = dict.fromkeys(vague, 1.0 / len(vague)) if len(vague) > 1 else {}
    together = [s | shared if c.effect in vague else s for c, s in zip(causes, sets, strict=True)]
    return [
        members | (_left_by(c, causes, extended, c.effect in vague) or (_slow_noise(extended) if not_seen else {}))
        if len(members) == 1
        else members
        for c, members, not_seen in zip(causes, together, hidden, strict=True)
    ]


def _slow_noise(estimate: Estimate) -> dict[str, float]:
    """The slow noise that may be all of a cause which has no size beside it that shows."""
    of = {"noise_random_walk": "walk", "noise_flicker": "flicker", "noise_markov": "markov"}
    return next(({name: 0.5} for name, ratio in of.items() if float(getattr(estimate.ratios, ratio)) > 0), {})


def _outweighed(causes: Sequence[Cause], selection: Selection, domain: str) -> bool:
    """Whether what was not added has more evidence than the name it goes by, or than all that was named."""
    more = selection.last.statistic.get(selection.remains or "", -np.inf)
    # What encoders of a platform pass for is no cause.
    all_of_them = max((c.statistic for c in causes), default=0.0) if domain == "gyro" else np.inf
    least = min((c.statistic for c in causes if c.effect == selection.remains), default=all_of_them)
    # Nor are gross errors.
    return bool(causes and selection.remains != "outliers" and more > least)


def _left_by(cause: Cause, causes: Sequence[Cause], estimate: Estimate, vague: bool) -> dict[str, float]:
    """The stronger cause that may leave a faint or a vague one, by its form or a thermometer's noise.

    Thermal ones leave thermal ones, a converter's codes leave lines. Beside a vague one it need not be far stronger.
    """
    if is_noise(cause.effect):
        return {}
    if form := _left_by_form(cause, causes, estimate):
        return {form: 0.5}
    if cause.statistic > FAINT and not vague:
        return {}
    needs = {e.label: set(thermometers(e.columns_needed)) for e in estimate.model.effects}
    own = needs.get(cause.effect, set())
    if cause.effect == "bias_periodic":
        # A chamber's pace is a line, and so is each further harmonic of a ramp's codes.
        needs |= {CODES: {CODES}}
        own = set().union(*needs.values())
    least = (1.0 if vague else OUTDONE) * cause.statistic
    others = [c for c in causes if c.statistic > least and own & needs.get(c.effect, set())]
    return {max(others, key=lambda c: c.statistic).effect: 0.5} if others else {}


def _left_by_form(cause: Cause, causes: Sequence[Cause], estimate: Estimate) -> str:
    """The cause of a gyro, if any, that may leave another as much: it has a shape, which may not be quite its own."""
    if estimate.record.domain != "gyro":
        return ""
    effects = {e.label: e for e in estimate.model.effects}
    follows = {label: {*e.columns_needed} - {"time"} for label, e in effects.items()}
    shaped = {label for label, e in effects.items() if not all(p.linear for p in e.declared().values())}
    larger = [c for c in causes if c.effect in shaped and cause.statistic < BETWEEN * c.statistic]
    own = follows.get(cause.effect, set())
    larger = [
        c for c in larger if follows[c.effect] and (cause.effect == "outliers" or (own and own <= follows[c.effect]))
    ]
    return max(larger, key=lambda c: c.statistic).effect if larger else ""


def _fitted(cause: Cause) -> list[ParameterValue]:
    """Parameters that a fit has estimated: an epoch is none, however well it is known."""
    held = () if cause.points or is_noise(cause.effect) else effect_class(cause.effect).held
    return [p for p in cause.parameters if p.name not in held]


def _sized(parameter: ParameterValue) -> bool:
    return bool(0.0 < VAGUE * parameter.std < abs(parameter.value))


def _unrepeated(scanner: Scanner, bad: np.ndarray) -> bool:
    """Whether some anomalous point's rate has fewer than two good points, so that a curve through it is possible."""
    if "rate" not in scanner.record.signals or not beyond_earth(scanner.record.signals):
        return False
    level = levels(scanner.record, scanner.points)
    return any(np.sum(level[~bad] == own) < 2 for own in level[bad])
