"""A vibration test in words and figures: responses with their limits, what explains them, the loop that was assumed."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from gyromodel._checks import listed
from gyromodel.platform import EXCLUDED, Points, assumed_loop, margins, parameters, predicted
from gyromodel.report import _drawing as draw
from gyromodel.report._numbers import with_uncertainty

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from gyromodel.platform import Explanation, Loop, Response, VibrationTest

_COLOURS = {"X": draw.AFTER, "Y": draw.MARK, "Z": draw.INK}
_MARKERS = {"X": "o", "Y": "s", "Z": "^"}
_DASHES = ("-", (0, (5, 2)), (0, (1.5, 1.5)))
# Explanations whose curves are drawn, rad/s up to which, and by how many spans of the points they may leave the frame.
_DRAWN, _HIGHEST, _BEYOND = 3, 140.0, 3.0
_QUANTITIES = ("gain", "phase")
_LABELS = ("amplitude ratio (dB)", "phase (deg)")


class Words(NamedTuple):
    """A table of runs and sentences below it."""

    head: tuple[str, ...]
    runs: list[tuple[str, ...]]
    lines: list[str]


def vibration_words(test: VibrationTest) -> Words:
    """What a terminal shows."""
    head = ("run", "axis", "rad/s", "dB", "", "deg", "", "arccos, deg", "cross axes, %")
    return Words(head, [_run(response) for response in test.responses], _lines(test))


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


def _lines(test: VibrationTest) -> list[str]:
    lines = [
        "± are 95 % intervals in noise of the colour that each run shows; a negative phase is late.",
        "arccos is the published estimator: without sign, and the noise makes it larger.",
        "Limits are those published for 1, 10, 20 and 30 rad/s; at other frequencies there are none.",
    ]
    lines += [f"Note: {remark}." for remark in test.remarks]
    if not test.explanations:
        return [*lines, "", "The runs are too few to explain them together."]
    judged = "the standard errors above" if test.scatter_stated else "the scatter each leaves"
    excluded = "" if test.scatter_stated else " (the standard errors above exclude every explanation offered here)"
    lines.append("")
    if test.left_out:
        lines.append(
            f"Axis {test.left_out[0]} is left out below: with it the standard errors above exclude every explanation "
            "offered here, without it they do not. A shaft that sticks makes such an axis."
        )
    runs = "the other runs" if test.left_out else "all runs"
    lines.append(f"What explains {runs}, judged by {judged}{excluded}:")
    for name in test.supported:
        lines.append(f"- {name}: {_values(test.explanations[name])}.")
    rest = len(test.explanations) - len(test.supported)
    lines.append(f"{rest} others are {'excluded or ' if test.scatter_stated else ''}far less likely (vibration.json).")
    if test.series is not None:
        axes = listed([axis for axis in test.sticking if axis not in test.left_out])
        without = f", without axis {axes}, where something sticks," if axes else ""
        if test.series.probability < EXCLUDED:
            lines.append("Overtones in the angles exclude the first of these: something sticks, or is not of one size.")
        else:
            lines.append(f"From the angles themselves, overtones included{without} the first: {_values(test.series)}.")
    lines.append("Values hold for the loop that each explanation assumes, the first one's in loop.svg.")
    if test.next_test:
        apart = f"{test.further[test.next_test]:.1f} standard deviations apart (3.3 are enough)"
        lines.append(f"These cannot be told apart. One more test, {test.next_test}, all axes, sets them {apart}.")
    elif len(test.supported) > 1:
        lines.append("These cannot be told apart, nor by any further test tried.")
    return lines


def _values(found: Explanation) -> str:
    rows = [f"{row.name} {with_uncertainty(row.value, row.std, row.unit)}" for row in parameters(found)]
    return ", ".join(rows) or "nothing of it is seen"


def vibration_figures(test: VibrationTest) -> dict[str, str]:
    """SVG by name: the responses with their limits, the explanations, the loop assumed."""
    with draw.style():
        figures = {"responses": _responses(test)}
        if test.explanations:
            figures |= {"explanations": _explanations(test), "loop": _loop(test)}
        return figures


def _two(width: float, height: float, columns: int = 1) -> tuple[Figure, np.ndarray]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    return figure, figure.subplots(2, columns, sharex=True, sharey="row", squeeze=False)


def _points(axes: Axes, runs: list[Response], quantity: str, colour: str, shift: float = 1.0) -> None:
    values, ends = ([getattr(r, name) for r in runs] for name in (quantity, f"{quantity}_interval"))
    axes.errorbar(
        [shift * r.frequency for r in runs],
        values,
        np.abs(np.transpose(ends) - values),
        color=colour,
        linestyle="none",
        marker=_MARKERS[runs[0].axis],
        markersize=5,
        capsize=3,
        elinewidth=1.2,
        label=f"axis {runs[0].axis}",
        zorder=5,
    )


def _by_axis(test: VibrationTest) -> dict[str, list[Response]]:
    return {axis: runs for axis in _COLOURS if (runs := [r for r in test.responses if r.axis == axis])}


def _responses(test: VibrationTest) -> str:
    figure, grid = _two(6.6, 5.6)
    runs = _by_axis(test)
    best = next(iter(test.explanations.values()), None)
    # Axes side by side, where their intervals would cover each other.
    shifts = dict(zip(runs, 1.03 ** (np.arange(len(runs)) - 0.5 * (len(runs) - 1)), strict=True))
    for k, axes in enumerate(grid[:, 0]):
        for axis, own in runs.items():
            _points(axes, own, _QUANTITIES[k], _COLOURS[axis], shifts[axis])
            if best is not None:
                _curve(axes, best, own, k, test.integrated, _COLOURS[axis], "-")
        limited = {r.limits: r.frequency for r in test.responses if r.limits}
        for limits, w in limited.items():
            for end in (limits[0], -limits[0]) if k == 0 else (limits[1],):
                axes.plot([w / 1.2, w * 1.2], [end, end], color=draw.MUTED, linewidth=2.0, zorder=3)
        if limited:
            axes.plot([], [], color=draw.MUTED, linewidth=2.0, label="limit")
        axes.set_xscale("log")
        axes.set_ylabel(_LABELS[k])
        axes.margins(x=0.08)
        axes.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
        axes.xaxis.set_minor_formatter("")
    frequencies = sorted({round(r.frequency, 2) for r in test.responses})
    if len(frequencies) <= 8:
        grid[1, 0].set_xticks(frequencies, [f"{w:g}" for w in frequencies])
    grid[1, 0].set_xlabel("frequency (rad/s)")
    draw.legend(grid[0, 0], 4)
    return draw.rendered(figure, "responses")


def _curve(
    axes: Axes, found: Explanation, runs: list[Response], quantity: int, integrated: bool, colour: str, dashes: Any,
    highest: float = 0.0, label: str | None = None,
) -> None:  # fmt: skip
    """An explanation over the frequencies of an axis, or up to a higher one."""
    low, high = min(r.frequency for r in runs), max(highest, *(r.frequency for r in runs))
    grid = np.geomspace(low, max(high, 1.01 * low), 200)
    ones, amplitude = np.ones_like(grid), np.deg2rad(np.mean([r.amplitude for r in runs]))
    number = np.full(len(grid), "XYZ".index(runs[0].axis))
    curve = predicted(found, Points(number, grid, ones, integrated * ones, amplitude * ones))
    axes.plot(grid, curve[quantity], color=colour, linestyle=dashes, linewidth=1.3, alpha=0.8, label=label, zorder=4)


def _explanations(test: VibrationTest) -> str:
    runs = _by_axis(test)
    figure, grid = _two(2.2 + 2.6 * len(runs), 5.6, len(runs))
    colours = (draw.AFTER, draw.MARK, draw.BEFORE)
    shown = list(test.explanations)[:_DRAWN]
    for (axis, own), column in zip(runs.items(), grid.T, strict=True):
        for k, axes in enumerate(column):
            for name, colour, dashes in zip(shown, colours, _DASHES, strict=False):
                _curve(axes, test.explanations[name], own, k, test.integrated, colour, dashes, _HIGHEST, name)
            _points(axes, own, _QUANTITIES[k], draw.INK)
            axes.set_xscale("log")
        column[0].set_title(f"axis {axis}", fontsize=10.5, color=draw.INK)
        column[1].set_xlabel("frequency (rad/s)")
        column[1].xaxis.set_major_formatter(lambda value, _: f"{value:g}")
    for k, quantity in enumerate(_QUANTITIES):
        ends = np.array([getattr(r, f"{quantity}_interval") for r in test.responses])
        room = _BEYOND * np.ptp(ends)
        grid[k, 0].set_ylim(ends.min() - room, ends.max() + room)
        grid[k, 0].set_ylabel(_LABELS[k])
    handles, labels = grid[0, 0].get_legend_handles_labels()
    figure.legend(handles[: len(shown)], labels[: len(shown)], loc="outside upper left", ncols=1, frameon=False)
    return draw.rendered(figure, "explanations")


def _loop(test: VibrationTest) -> str:
    loop: Loop = assumed_loop(next(iter(test.explanations.values())))
    grid = np.geomspace(3.0, 3e3, 400)
    response = np.asarray(loop.open_loop(jnp.asarray(grid)))
    size, phase = 20 * np.log10(np.abs(response)), np.rad2deg(np.unwrap(np.angle(response)))
    phase -= 360 * np.round((phase[0] + 180) / 360)
    figure, panels = _two(6.6, 5.2)
    top, bottom = panels[:, 0]
    for axes, curve, level, label in (
        (top, size, 0.0, "open loop (dB)"),
        (bottom, phase, -180.0, "open loop (deg)"),
    ):
        axes.plot(grid, curve, color=draw.AFTER, linewidth=1.8)
        axes.axhline(level, color=draw.MUTED, linewidth=0.9)
        axes.set_ylabel(label)
        axes.set_xscale("log")
    bottom.set_xlabel("frequency (rad/s)")
    bottom.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
    try:
        found = margins(loop)
    except ValueError:
        top.set_title("loop assumed: it has no margins", fontsize=10.5, color=draw.INK)
        return draw.rendered(figure, "loop")
    turning, marked = grid[np.argmax(size < -found.gain)], {"color": draw.MARK, "linewidth": 2}
    top.plot([turning] * 2, [0, -found.gain], label=f"gain margin {found.gain:.0f} dB", **marked)
    ends = [-180, found.phase - 180]
    bottom.plot([found.crossover] * 2, ends, label=f"phase margin {found.phase:.0f}°", **marked)
    read = f"crossover {found.crossover:.0f}, bandwidth {found.bandwidth:.0f} rad/s"
    top.set_title(f"loop assumed: {read}", fontsize=10.5, color=draw.INK)
    for axes in (top, bottom):
        axes.axvline(found.crossover, color=draw.MUTED, linewidth=0.9, linestyle=(0, (4, 3)))
        axes.legend(loc="lower left", frameon=False)
    return draw.rendered(figure, "loop")
