"""A vibration test in words: a headline, the table of runs, and what explains them."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from gyromodel._checks import listed
from gyromodel.platform import assumed_loop, margins, parameters
from gyromodel.report._numbers import with_uncertainty

if TYPE_CHECKING:
    from gyromodel.platform import Explanation, Response, VibrationTest

# Explanations that a terminal shows of runs that are too few.
_SHOWN = 6


class Words(NamedTuple):
    """A table of runs and sentences below it."""

    head: tuple[str, ...]
    runs: list[tuple[str, ...]]
    lines: list[str]


def vibration_words(test: VibrationTest) -> Words:
    """What a terminal shows."""
    head = ("run", "axis", "rad/s", "dB", "", "deg", "", "arccos, deg", "cross axes, %")
    remarks = [f"Note: {remark}." for remark in test.remarks]
    told = explained(test)
    lines = [*notes(test), *remarks, "", *told.lead, *(f"- {item}" for item in told.items), *told.rest]
    lines += [f"Next test: {told.next}" if test.few else told.next] if told.next else []
    return Words(head, [_run(response) for response in test.responses], lines)


def _run(found: Response) -> tuple[str, ...]:
    half = found.quantile
    gain, phase = (
        f"{value:+.4f} ± {half * std:.4f}".replace("-", "−")
        for value, std in ((found.gain, found.gain_std), (found.phase, found.phase_std))
    )
    cross = ", ".join(f"{axis} {100 * ratio:.2f}" for axis, (ratio, _) in sorted(found.cross.items()))
    verdicts = found.verdicts
    return (
        str(found.run), found.axis, f"{found.frequency:.4f}", gain, verdicts[0], phase, verdicts[1],
        f"{found.published[1]:.3f}", cross,
    )  # fmt: skip


def vibration_sentence(test: VibrationTest) -> str:
    """The outcome in plain words: limits, and what explains the runs."""
    verdicts = [verdict for response in test.responses for verdict in response.verdicts if verdict != "no limit"]
    failed = sum("fail" in response.verdicts for response in test.responses)
    unclear = sum("fail" not in r.verdicts and "cannot tell" in r.verdicts for r in test.responses)
    count = f"{len(test.responses)} run{'s' * (len(test.responses) != 1)}"
    if not verdicts:
        limits = f"{count}, at frequencies without a published limit"
    elif failed or unclear:
        parts = [
            f"{n} {what}" for n, what in ((failed, "beyond a published limit"), (unclear, "too near to tell")) if n
        ]
        limits = f"{count}, {listed(parts)}"
    else:
        limits = f"{count}, all within the limits where these are published"
    if test.few:
        return f"{limits}; they are too few to name what explains them."
    if not (test.scatter_stated and test.held):
        return f"{limits}; nothing that is offered explains them within their errors."
    if len(test.supported) == 1 and not test.firm:
        return f"{limits}; the angles do not determine the one explanation that is not excluded."
    if not test.firm:
        return f"{limits}; {len(test.supported)} explanations of them cannot be told apart."
    name = test.possible[0]
    rows = parameters(test.explanations[name])[:1]
    first = "".join(f" ({row.name} {with_uncertainty(row.value, row.std, row.unit)})" for row in rows)
    return f"{limits}; what explains them is {name}{first}."


def notes(test: VibrationTest) -> list[str]:
    """How to read the numbers of the runs."""
    return [
        "± are 95 % intervals in noise of the colour that each run shows, in what explains the runs standard "
        "uncertainties; a negative phase is late.",
        "arccos is the published estimator: without sign, and the noise makes it larger.",
        "Limits are those published for 1, 10, 20 and 30 rad/s; at other frequencies there are none.",
    ]


class Explained(NamedTuple):
    """What explains the runs together: sentences, explanations, sentences on them, and which test would tell more."""

    lead: list[str]
    items: list[str]
    rest: list[str]
    next: str | None


def explained(test: VibrationTest) -> Explained:
    """In words."""
    if not test.possible:
        lead = ["The runs determine no explanation that they do not exclude."]
        return Explained(lead, [], [], f"{test.next_test}.".capitalize())
    lead = []
    if test.left_out:
        lead.append(
            f"Axis {test.left_out[0]} is left out below: with it what is offered here is excluded by the standard "
            "errors above or by the angles, or far less likely. A shaft that sticks makes such an axis."
        )
    elif len({test.explanations[name].left_out for name in test.possible}) > 1:
        lead.append("Which axis, if any, is to be left out, as one that sticks is, these runs do not tell.")
    judged = "the standard errors above" if test.scatter_stated else "the scatter each leaves"
    if not test.scatter_stated:
        lead.append("The standard errors above exclude every explanation offered here.")
    elif not test.held:
        lead.append("The angles, overtones included, exclude what the standard errors do not: something sticks.")
    if test.few:
        lead.append("The runs are too few to name one explanation.")
    which = "What comes nearest"
    if test.scatter_stated and test.held:
        which = "These would do" if test.few else f"What explains {'the other' if test.left_out else 'all'} runs"
    lead.append(f"{which}, judged by {judged}:")
    shown = test.possible[:_SHOWN]
    items = [f"{name}: {_values(test.explanations[name])}." for name in shown]
    others = (
        f"{len(test.explanations) - len(shown)} others are {'excluded, ' if test.scatter_stated else ''}less likely"
    )
    rest = [f"{others}, or only add to these what is not seen (vibration.json)."]
    if test.series is not None and test.held:
        rest.append(f"The first from the angles themselves, overtones included: {_values(test.series)}.")
    return Explained(lead, items, rest + loop_lines(test), _next(test) if len(test.possible) > 1 or test.few else None)


def loop_lines(test: VibrationTest) -> list[str]:
    """What of the loop the runs determine, and what is assumed."""
    best = test.best
    if best is None or test.few:
        return []
    if not any("friction" in test.explanations[name].alternative.kinds for name in test.possible):
        return ["No friction shows, and without it nothing of the loop does."]
    known = (
        "Angles tell a loop's friction and gain over its inertia, c/J and K/J; J itself takes a torque or an inertia "
        "that is known."
    )
    if test.crossover is not None:
        crossover = with_uncertainty(test.crossover.value, test.crossover.std, test.crossover.unit)
        fitted = "" if "crossover" in best.alternative.kinds else " where it is fitted besides"
        return [f"The loop's crossover is {crossover}{fitted}; its lags are assumed.", known]
    return [
        f"The loop's gain is not determined by these runs: it is assumed, which puts the crossover at "
        f"{margins(assumed_loop(best)).crossover:.0f} rad/s, and friction over inertia goes with it. Runs up to the "
        "crossover would tell it.",
        known,
    ]


def _next(test: VibrationTest) -> str:
    if test.few:
        return f"{test.next_test}.".capitalize()
    if test.next_test:
        apart = f"{test.further[test.next_test]:.1f} standard deviations apart (3.3 are enough)"
        return f"These cannot be told apart. One more test, {test.next_test}, all axes, sets them {apart}."
    return "These cannot be told apart, nor by any further test tried."


def _values(found: Explanation) -> str:
    rows = [f"{row.name} {with_uncertainty(row.value, row.std, row.unit)}" for row in parameters(found)]
    return ", ".join(rows) or "the base follows the table as recorded"
