"""An error budget as rows of tables, sentences and two figures: a tornado of each outcome, and the angle over time."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from gyromodel.report import _drawing as draw
from gyromodel.report._numbers import number, percent, unit_text, with_uncertainty
from gyromodel.study import REPEATED

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from gyromodel.study import Budget, PlanChoice, Result, Sensitivity

# Bars of a tornado, lines of a history, shares that are named in one row, tests that are told.
BARS, LINES, NAMED, TOLD = 8, 4, 3, 8
_NOISE = {
    "noise_white": "white noise",
    "noise_flicker": "flicker",
    "noise_random_walk": "random walk",
    "noise_markov": "Markov noise",
    "noise_quantisation": "counts of the angle",
}


def outcome_rows(found: Sensitivity) -> list[tuple[str, ...]]:
    """A row an outcome: name, calibration's part, with noise and instruments, drawn, unit, what it comes from."""
    rows = []
    for result in found.results:
        budget, drawn = result.budget, result.drawn
        most = [f"{row.name} {percent(row.share)}" for row in budget.rows[:NAMED] if row.share > 0.01]
        std, _ = _with_error(drawn.std, drawn.std_error)
        rows.append(
            (budget.outcome, f"{drawn.linear:.3g}", f"{budget.total:.3g}" if _adds(budget) else "–", std,
             unit_text(budget.unit), ", ".join(most))
        )  # fmt: skip
    return rows


def _adds(budget: Budget) -> bool:
    return bool(budget.noise or budget.instruments) and budget.outcome != "peak"


def parameter_rows(budget: Budget) -> list[tuple[str, ...]]:
    """A row a parameter of one outcome's budget, then kinds of noise and instruments: all in the outcome's unit."""
    rows = []
    for row in budget.rows:
        below = unit_text(row.unit)
        slope = (
            f"{unit_text(budget.unit)} per ({below})" if "/" in below else f"{unit_text(budget.unit)} per {below or 1}"
        )
        rows.append(
            (row.name, with_uncertainty(row.value, row.std, row.unit), f"{number(row.sensitivity, 3)} {slope}",
             number(row.alone, 3), f"{100 * row.share:.1f} %")
        )  # fmt: skip
    rows += [(_NOISE[name], "", "", number(std, 3), "") for name, std in budget.noise.items()]
    rows += [(f"error of {name}", "", "", number(std, 3), "") for name, std in budget.instruments.items()]
    return rows


def sobol_rows(result: Result) -> list[tuple[str, ...]]:
    """A row a parameter: first-order and total index with half their 95 % intervals."""
    return [
        (i.name, " ± ".join(_with_error(i.first, i.first_conf)), " ± ".join(_with_error(i.total, i.total_conf)))
        for i in result.sobol
    ]


def test_rows(found: Sensitivity) -> list[tuple[str, ...]]:
    """What to do next and what it leaves of the first outcome: standard uncertainty, sentence."""
    budget = found.results[0].budget
    told = [t for i, t in enumerate(found.tests) if i < TOLD or t.sentence == REPEATED]
    return [(f"{t.std[budget.outcome]:.3g}", t.sentence) for t in told]


test_rows.__test__ = False  # pyright: ignore[reportFunctionMemberAccess]  pytest takes the name for a test's


def disagreements(found: Sensitivity) -> list[str]:
    """Outcomes whose draws the first order does not bear out, a sentence each."""
    return [
        f"{r.budget.outcome}: {r.drawn.draws} draws have {r.drawn.std:.3g} {unit_text(r.budget.unit)} where the first "
        f"order has {r.drawn.linear:.3g}, more than their number explains: go by the draws."
        for r in found.results
        if not r.drawn.agrees
    ]


def plan_sentence(choice: PlanChoice, outcome: str) -> str:
    """The best plan in words; the outcome's name for a plan that is best for it."""
    parts = ", ".join(f"{count} × {name}" for name, count in choice.best.times.items())
    best = f"Best plan ({choice.best.duration / 3600:.3g} h): {parts}."
    if choice.gain < 1.0:
        return f"{best} Each part as often, in shares, would tell more."
    what = {
        "parameters": "Intervals of the parameters are {:.2f} times narrower",
        "outcome": f"The interval of {outcome} is {{:.2f}} times narrower",
        "discrimination": "The rivals, of typical size, lie {apart:.3g} standard deviations apart, {:.2f} times as far",
    }[choice.criterion].format(choice.gain, apart=choice.best.separation)
    than = "than" if choice.criterion != "discrimination" else "as"
    return f"{best} {what} {than} by each part as often."


def _with_error(value: float, error: float) -> tuple[str, str]:
    """A value and its standard error to the same digit."""
    if not error > 0:
        return f"{value:.3g}", "0"
    digits = max(1 - int(np.floor(np.log10(error))), 0)
    return f"{value:.{digits}f}", f"{error:.{digits}f}"


def tornado_figure(found: Sensitivity) -> str:
    """What each parameter, kind of noise and instrument adds to each outcome, alone and at ±1 standard uncertainty."""
    with draw.style():
        figure, _ = draw.blank()
        figure.clear()
        shown = [r.budget for r in found.results if _bars(r.budget)]
        if not shown:
            figure.text(0.5, 0.5, "No error of the calibration reaches these outcomes.", ha="center", va="center")
            return draw.rendered(figure, "tornado")
        counts = [len(_bars(budget)) for budget in shown]
        figure.set_size_inches(6.6, 0.3 + sum(0.28 * n + 0.85 for n in counts))
        panels = figure.subplots(len(shown), 1, squeeze=False, height_ratios=[n + 2 for n in counts])[:, 0]
        for panel, budget in zip(panels, shown, strict=True):
            _tornado(panel, budget)
        for colour, text in (
            (draw.AFTER, "parameter larger"),
            (draw.BEFORE_DOT, "smaller"),
            (draw.BEFORE, "either way"),
        ):
            panels[0].barh(0, 0.0, color=colour, label=text)
        draw.legend(panels[0], 3)
        return draw.rendered(figure, "tornado")


def _bars(budget: Budget) -> list[tuple[str, float, int]]:
    """Names, sizes and signs of the bars, the largest first."""
    sign = np.sign if len(budget.jacobian) == 1 else lambda _: 0
    bars = [(row.name, row.alone, int(sign(row.sensitivity))) for row in budget.rows]
    if budget.outcome != "peak":
        bars += [(_NOISE[name], std, 0) for name, std in budget.noise.items()]
        bars += [(f"error of {name}", std, 0) for name, std in budget.instruments.items()]
    return sorted((bar for bar in bars if bar[1] > 0), key=lambda bar: -bar[1])[:BARS]


def _tornado(axes: Axes, budget: Budget) -> None:
    bars = _bars(budget)
    power = draw.power_of_ten(max(size for _, size, _ in bars))
    for place, (_, size, sign) in enumerate(bars):
        size = size / 10.0**power
        # What an increase of a parameter does, where that has one sign.
        right, left = (draw.AFTER, draw.BEFORE_DOT)[:: -1 if sign < 0 else 1] if sign else (draw.BEFORE,) * 2
        axes.barh(place, size, color=right, height=0.62)
        axes.barh(place, -size, color=left, height=0.62)
    axes.set_yticks(range(len(bars)), [name.replace("_", " ") for name, _, _ in bars])
    axes.set_ylim(len(bars) - 0.4, -0.6)
    axes.axvline(0.0, color=draw.INK, linewidth=0.8)
    axes.grid(visible=False, axis="y")
    title = budget.outcome.replace("_", " ")
    axes.locator_params(axis="x", nbins=7)
    axes.set_xlabel(draw.axis_label(f"{title} at ±1 standard uncertainty", budget.unit, power), loc="right")


def history_figure(found: Sensitivity) -> str:
    """The angle's standard uncertainty over the mission, of three axes that of x, in all and by leading parameters."""
    with draw.style():
        figure, axes = draw.blank()
        figure.set_size_inches(6.6, 3.6)
        history = found.history
        hours = history.time[-1] > 3600
        time = history.time / (3600.0 if hours else 1.0)
        power = draw.power_of_ten(float(np.max([history.std.max(), *(a.max() for a in history.alone.values())])))
        scale = 10.0**-power
        # Parameters of three gyros are told by axis; the history is of the first.
        three = any(name.startswith("y ") for name in history.alone)
        alone = {name: std for name, std in history.alone.items() if not three or name.startswith("x ")}
        whose = f"all{' of axis x' * three}, with their correlations"
        axes.plot(time, history.std * scale, color=draw.INK, linewidth=2.2, label=whose, zorder=5)
        leading = sorted(alone.items(), key=lambda item: -float(item[1].max()))[:LINES]
        colours = (draw.AFTER, draw.MARK, draw.BEFORE, draw.AFTER_DOT)
        for (name, std), colour, dash in zip(leading, colours, ("-", "--", "-.", ":"), strict=False):
            axes.plot(time, std * scale, dash, color=colour, linewidth=1.5, label=f"{name.replace('_', ' ')} alone")
        axes.set_xlabel(draw.axis_label("time of the mission", "h" if hours else "s", 0))
        axes.set_ylabel(draw.axis_label(f"angle{' about x' * three}, standard uncertainty", "deg", power))
        axes.set_ylim(bottom=0.0)
        axes.set_xlim(0.0, float(time[-1]))
        draw.legend(axes, 2)
        return draw.rendered(figure, "budget")
