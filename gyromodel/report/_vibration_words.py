"""A vibration test in words: a headline, the table of runs, and what explains them."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from gyromodel._checks import listed
from gyromodel.platform import EXCLUDED, assumed_loop, margins, parameters
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
    lines = [*notes(test), *remarks, "", *explained_lines(test)]
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
    if len(test.supported) > 1:
        return f"{limits}; {len(test.supported)} explanations of them cannot be told apart."
    name = test.possible[0]
    rows = parameters(test.explanations[name])[:1]
    first = "".join(f" ({row.name} {with_uncertainty(row.value, row.std, row.unit)})" for row in rows)
    return f"{limits}; what explains them is {name}{first}."


def notes(test: VibrationTest) -> list[str]:
    """How to read the numbers of the runs."""
    return [
        "± are 95 % intervals in noise of the colour that each run shows; a negative phase is late.",
        "arccos is the published estimator: without sign, and the noise makes it larger.",
        "Limits are those published for 1, 10, 20 and 30 rad/s; at other frequencies there are none.",
    ]


def explained_lines(test: VibrationTest) -> list[str]:
    """What explains the runs together, what of the loop they tell, and which test would tell more."""
    if not test.possible:
        return ["The runs are too few to explain them together.", _next(test)]
    judged = "the standard errors above" if test.scatter_stated else "the scatter each leaves"
    excluded = "" if test.scatter_stated else " (the standard errors above exclude every explanation offered here)"
    outs = {test.explanations[name].left_out for name in test.possible}
    lines = []
    if outs == {test.left_out} and test.left_out:
        lines.append(
            f"Axis {test.left_out[0]} is left out below: with it the standard errors above exclude what is offered "
            "here, or make it far less likely. A shaft that sticks makes such an axis."
        )
    elif len(outs) > 1:
        lines.append("Which axis, if any, is to be left out, as one that sticks is, these runs do not tell.")
    if test.few:
        lines.append(f"The runs are too few to name one explanation. These would do, judged by {judged}{excluded}:")
    else:
        runs = "the other runs" if outs == {test.left_out} and test.left_out else "all runs"
        lines.append(f"What explains {runs}, judged by {judged}{excluded}:")
    shown = test.possible[:_SHOWN]
    lines += [f"- {name}: {_values(test.explanations[name])}." for name in shown]
    rest = len(test.explanations) - len(shown)
    lines.append(
        f"{rest} others are {'excluded, ' if test.scatter_stated else ''}far less likely, or only add to these what is "
        "not seen (vibration.json)."
    )
    if test.series is not None:
        axes = [axis for axis in test.sticking if axis not in test.left_out]
        without = f", without axis {listed(axes)}, where something sticks" if axes else ""
        if test.series.probability < EXCLUDED:
            lines.append("Overtones in the angles exclude the first of these: something sticks, or is not of one size.")
        else:
            lines.append(f"The first from the angles themselves, overtones included{without}: {_values(test.series)}.")
    lines += loop_lines(test)
    return [*lines, *([_next(test)] if len(test.possible) > 1 or test.few else [])]


def loop_lines(test: VibrationTest) -> list[str]:
    """What of the loop the runs determine, and what is assumed."""
    best = test.best
    if best is None or "friction" not in best.alternative.kinds:
        return ["No friction shows, and without it nothing of the loop does."]
    known = (
        "Angles tell a loop's friction and gain over its inertia, c/J and K/J; J itself takes a torque or an inertia "
        "that is known."
    )
    if test.crossover is not None:
        crossover = with_uncertainty(test.crossover.value, test.crossover.std, test.crossover.unit)
        fitted = "" if "crossover" in best.alternative.kinds else " where it is fitted besides"
        return [f"The loop's crossover is {crossover}{fitted}; its lags are assumed.", known]
    assumed = f"{margins(assumed_loop(best)).crossover:.0f} rad/s"
    return [
        f"The loop's crossover is not determined by these runs: {assumed} is assumed, and friction over inertia goes "
        "with it. Runs up to the crossover would tell it.",
        known,
    ]


def _next(test: VibrationTest) -> str:
    if test.few:
        return f"Next test: {test.next_test}."
    if test.next_test:
        apart = f"{test.further[test.next_test]:.1f} standard deviations apart (3.3 are enough)"
        return f"These cannot be told apart. One more test, {test.next_test}, all axes, sets them {apart}."
    return "These cannot be told apart, nor by any further test tried."


def _values(found: Explanation) -> str:
    rows = [f"{row.name} {with_uncertainty(row.value, row.std, row.unit)}" for row in parameters(found)]
    return ", ".join(rows) or "the base follows the table as recorded"
