"""A vibration test in figures: angles over time, responses with their limits, what explains them, the loop."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import jax.numpy as jnp
import numpy as np

from gyromodel.platform import ENTRIES, Points, assumed_loop, margins, predicted
from gyromodel.report import _drawing as draw

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


def vibration_figures(test: VibrationTest) -> dict[str, str]:
    """SVG by name: the angles over time, the responses with their limits, the explanations, the loop."""
    with draw.style():
        figures = {"attitude": _attitude(test), "responses": _responses(test)}
        if test.best:
            figures |= {"explanations": _explanations(test), "loop": _loop(test, test.best)}
        return {name: draw.rendered(figure, name) for name, figure in figures.items()}


def _attitude(test: VibrationTest) -> Figure:
    """As figure 5 of the source: base attitude from navigation beside the table; below it what differs."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(2.0 + 3.4 * len(test.histories), 5.0), layout="constrained")
    grid = figure.subplots(2, len(test.histories), squeeze=False, sharex="col", height_ratios=(3, 2))
    for (axis, run), (top, bottom) in zip(test.histories.items(), grid.T, strict=True):
        table, base = np.rad2deg(run.table), np.rad2deg(run.base)
        top.plot(run.time, table, color=draw.BEFORE_DOT, linewidth=3.6, label="table")
        top.plot(run.time, base, color=draw.AFTER, linewidth=1.2, label="base, from navigation")
        bottom.plot(run.time, 1e3 * (base - table), color=draw.MARK, linewidth=1.0)
        top.set_title(f"axis {axis}, run {run.run}: {run.frequency:.3g} rad/s", fontsize=10.5, color=draw.INK)
        bottom.set_xlabel("time (s)")
    grid[0, 0].set_ylabel("angle (deg)")
    grid[1, 0].set_ylabel("base − table\n(10⁻³ deg)")
    figure.legend(*grid[0, 0].get_legend_handles_labels(), loc="outside upper left", ncols=2, frameon=False)
    return figure


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


def _responses(test: VibrationTest) -> Figure:
    figure, grid = _two(6.6, 5.6)
    runs = _by_axis(test)
    best = test.best
    # Axes side by side, where their intervals would cover each other.
    shifts = dict(zip(runs, 1.03 ** (np.arange(len(runs)) - 0.5 * (len(runs) - 1)), strict=True))
    for k, axes in enumerate(grid[:, 0]):
        for axis, own in runs.items():
            _points(axes, own, _QUANTITIES[k], _COLOURS[axis], shifts[axis])
            if best is not None and axis not in best.left_out:
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
    return figure


def _curve(
    axes: Axes, found: Explanation, runs: list[Response], quantity: int, integrated: bool, colour: str, dashes: Any,
    highest: float = 0.0,
) -> None:  # fmt: skip
    """An explanation over the frequencies of an axis, or up to a higher one."""
    low, high = min(r.frequency for r in runs), max(highest, *(r.frequency for r in runs))
    grid = np.geomspace(low, max(high, 1.01 * low), 200)
    ones, amplitude = np.ones_like(grid), np.deg2rad(np.mean([r.amplitude for r in runs]))
    number = np.full(len(grid), "XYZ".index(runs[0].axis))
    curve = predicted(found, Points(number, grid, ones, integrated * ones, amplitude * ones))
    axes.plot(grid, curve[quantity], color=colour, linestyle=dashes, linewidth=1.3, alpha=0.8, zorder=4)


def _drawn(test: VibrationTest) -> list[str]:
    """The possible explanations, and up to as many as are drawn the next best."""
    rest = [name for name in test.explanations if name not in test.possible]
    return [*test.possible, *rest][:_DRAWN]


def _explanations(test: VibrationTest) -> Figure:
    from matplotlib.lines import Line2D

    runs = _by_axis(test)
    figure, grid = _two(2.2 + 2.6 * len(runs), 5.6, len(runs))
    colours = (draw.AFTER, draw.MARK, draw.BEFORE)
    shown = _drawn(test)
    for (axis, own), column in zip(runs.items(), grid.T, strict=True):
        for k, axes in enumerate(column):
            for name, colour, dashes in zip(shown, colours, _DASHES, strict=False):
                if axis not in (found := test.explanations[name]).left_out:
                    _curve(axes, found, own, k, test.integrated, colour, dashes, _HIGHEST)
            _points(axes, own, _QUANTITIES[k], draw.INK)
            axes.set_xscale("log")
        unexplained = all(axis in test.explanations[name].left_out for name in shown)
        column[0].set_title(f"axis {axis}{', left out' * unexplained}", fontsize=10.5, color=draw.INK)
        column[1].set_xlabel("frequency (rad/s)")
        column[1].xaxis.set_major_formatter(lambda value, _: f"{value:g}")
    for k, quantity in enumerate(_QUANTITIES):
        ends = np.array([getattr(r, f"{quantity}_interval") for r in test.responses])
        room = _BEYOND * np.ptp(ends)
        grid[k, 0].set_ylim(ends.min() - room, ends.max() + room)
        grid[k, 0].set_ylabel(_LABELS[k])
    handles = [
        Line2D([], [], color=colour, linestyle=dashes, label=name if name in test.possible else f"{name} (less likely)")
        for name, colour, dashes in zip(shown, colours, _DASHES, strict=False)
    ]
    figure.legend(handles=handles, loc="outside upper left", ncols=1, frameon=False)
    return figure


def _loop(test: VibrationTest, best: Explanation) -> Figure:
    loop: Loop = assumed_loop(best)
    parts = [part for part in ("corner", "crossover") if part in best.alternative.kinds]
    whose = f"loop, {' and '.join(parts)} fitted" if parts else "loop assumed, nothing of it fitted"
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
        top.set_title(f"{whose}:\nit has no margins", fontsize=10.5, color=draw.INK)
        return figure
    turning, marked = grid[np.argmax(size < -found.gain)], {"color": draw.MARK, "linewidth": 2}
    top.plot([turning] * 2, [0, -found.gain], label=f"gain margin {found.gain:.0f} dB", **marked)
    ends = [-180, found.phase - 180]
    bottom.plot([found.crossover] * 2, ends, label=f"phase margin {found.phase:.0f}°", **marked)
    std = best.std[ENTRIES.index("crossover")]
    read = f"crossover {found.crossover:.0f}{f' ± {std:.1f}' if std else ''}, bandwidth {found.bandwidth:.0f} rad/s"
    top.set_title(f"{whose}:\n{read}", fontsize=10.5, color=draw.INK)
    for axes in (top, bottom):
        axes.axvline(found.crossover, color=draw.MUTED, linewidth=0.9, linestyle=(0, (4, 3)))
        axes.legend(loc="lower left", frameon=False)
    return figure
