"""Drawing on small SVG figures: points, means with error bars, bands; colours that a page can restyle."""

from __future__ import annotations

import io
import re
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from gyromodel.report._numbers import count, unit_text
from gyromodel.report._series import Bins, thinned

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

INK, MUTED, GRID, PAPER = "#1f2a37", "#5b6675", "#e4e8ee", "#ffffff"
BEFORE, BEFORE_DOT, AFTER, AFTER_DOT, MARK = "#6b7686", "#b9c1cc", "#1463b8", "#8dbbe9", "#b93a0b"
# Parts of a set of points, from the least to the greatest; seen on light and on dark.
PARTS = ("#2f74c0", "#2aa198", "#c27f16", "#c8402f")
# Style-sheet variables that replace the colours inside the page, so that figures follow its light or dark theme.
VARIABLES = {
    INK: "--ink",
    MUTED: "--muted",
    GRID: "--grid",
    PAPER: "--card",
    BEFORE: "--before",
    BEFORE_DOT: "--before-dot",
    AFTER: "--after",
    AFTER_DOT: "--after-dot",
    MARK: "--mark",
}
_STYLE: dict[Any, Any] = {
    "font.family": "sans-serif",
    "font.size": 10.5,
    "axes.edgecolor": MUTED,
    "axes.labelcolor": INK,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.linewidth": 0.8,
    "axes.facecolor": "none",
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.unicode_minus": True,
    "axes.formatter.useoffset": False,
    "grid.color": GRID,
    "grid.linewidth": 0.8,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "text.color": INK,
    "figure.facecolor": PAPER,
    "legend.frameon": False,
    "svg.fonttype": "none",
    "path.simplify": False,
    "text.parse_math": False,  # a column name may hold dollar signs
}
SIZE = (4.6, 3.1)  # small, so that text drawn at 10.5 pt is still readable on a phone


@dataclass(frozen=True)
class Layer:
    """One series of a figure: its values per row, its means over bins and how it looks."""

    label: str
    values: np.ndarray
    means: Bins
    colour: str
    dot: str
    marker: str


def style() -> AbstractContextManager[None]:
    """The report's style, for the time of drawing."""
    import matplotlib

    return matplotlib.rc_context(_STYLE)


def blank() -> tuple[Figure, Axes]:
    """An empty figure."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=SIZE, layout="constrained")
    return figure, figure.add_subplot()


def rendered(figure: Figure, name: str) -> str:
    """The figure as SVG text with short numbers and ids that are unique in the page."""
    import matplotlib

    buffer = io.StringIO()
    with matplotlib.rc_context({"svg.hashsalt": name}):
        figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None})
    svg = re.sub(r"<[^>]*>", lambda tag: re.sub(r"(\d\.\d\d)\d+", r"\1", tag[0]), buffer.getvalue())
    # A dot is a line of no length with a round end: the shortest way to write one.
    svg = re.sub(r"M (\S+ \S+) \nL \1 \n", r"M\1h0", svg)
    svg = re.sub(r'(\sid="|"#|url\(#)', rf"\g<1>{name}-", svg)
    return svg[svg.index("<svg") :]


def inline(svg: str) -> str:
    """The figure for the page: sized and coloured by the page's style sheet."""
    head, body = svg.split(">", 1)
    head = re.sub(r'\s(width|height)="[^"]*"', "", head)
    body = re.sub(r"<metadata>.*?</metadata>", "", body, flags=re.DOTALL)
    for colour, variable in VARIABLES.items():
        body = body.replace(colour, f"var({variable},{colour})")
    return f'{head} aria-hidden="true">{body}'


def power_of_ten(size: float) -> int:
    """The power of ten to take out of an axis that reaches this size."""
    if not np.isfinite(size) or size <= 0.0:
        return 0
    exponent = int(np.floor(np.log10(size)))
    return 0 if -2 <= exponent <= 4 else exponent


def axis_label(text: str, unit: str, power: int) -> str:
    """An axis label with its unit and the power of ten taken out."""
    superscript = str(power).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))
    parts = " ".join(p for p in (f"10{superscript}" if power else "", unit_text(unit)) if p)
    return f"{text} ({parts})" if parts else text


def dots(axes: Axes, x: np.ndarray, y: np.ndarray, colour: str, size: float) -> None:
    """Points as one path, a few bytes each."""
    from matplotlib.patches import PathPatch
    from matplotlib.path import Path

    corners = np.repeat(np.column_stack([x, y]), 2, axis=0)
    codes = np.tile([Path.MOVETO, Path.LINETO], x.size)
    style = {"fill": False, "edgecolor": colour, "linewidth": size, "capstyle": "round", "alpha": 0.75, "zorder": 2}
    axes.add_artist(PathPatch(Path(corners, codes), **style))


def overlay(axes: Axes, x: np.ndarray, layers: list[Layer], points: int, scale: float, always: np.ndarray) -> list[str]:
    """Draw layers over each other, points first, and set limits that show the means.

    Args:
        axes: where.
        x: abscissa, one value per row.
        layers: what, bottom first.
        points: how many points all layers may draw together.
        scale: divides all values.
        always: values that must be inside the frame.

    Returns:
        Remarks for the caption: thinned, left out or clipped points.
    """
    low, high = _frame_of_means(layers)
    bottom, top = _frame_of_points(layers)
    scattered = top - bottom > 4.0 * (high - low) > 0.0 and any(map(_structured, layers))
    remarks, beyond, rows_drawn, rows_there = [], 0, 0, 0
    if not scattered:
        low, high = min(low, bottom), max(high, top)
    always = always[np.isfinite(always)]
    low, high = min([low, *always]), max([high, *always])
    pad = 0.07 * (high - low) or 1.0
    low, high = low - pad, high + pad
    for order, layer in enumerate(layers):
        if not scattered:
            rows = thinned(x, layer.values, points // len(layers))
            inside = rows[(layer.values[rows] >= low) & (layer.values[rows] <= high)]
            size = 5.0 if rows.size < 100 else (3.6 if rows.size < 600 else 2.4)
            dots(axes, x[inside], layer.values[inside] / scale, layer.dot, size)
            beyond += rows.size - inside.size
            rows_drawn += rows.size
            rows_there += int(np.count_nonzero(np.isfinite(x) & np.isfinite(layer.values)))
        means = layer.means
        style = {"color": layer.colour, "marker": layer.marker, "markersize": 4.2, "linewidth": 1.3, "elinewidth": 1.2}
        axes.errorbar(means.x, means.mean / scale, means.error / scale, label=layer.label, zorder=4 + order, **style)
    if scattered:
        remarks.append("Single points scatter far beyond this frame; only means are drawn.")
    elif rows_drawn < rows_there:
        remarks.append(f"{count(rows_drawn)} of {count(rows_there)} points are drawn, evenly thinned.")
    if beyond:
        remarks.append(f"{beyond} drawn point{'s' * (beyond > 1)} lie{'s' * (beyond == 1)} outside the frame.")
    axes.set_ylim(low / scale, high / scale)
    known = x[np.isfinite(x)]
    if np.ptp(known) > 0.0:
        axes.set_xlim(known.min() - 0.03 * np.ptp(known), known.max() + 0.03 * np.ptp(known))
    return remarks


def legend(axes: Axes, columns: int) -> None:
    """A legend above the frame."""
    axes.legend(
        loc="lower left",
        bbox_to_anchor=(-0.02, 1.0),
        ncols=columns,
        borderaxespad=0.2,
        handletextpad=0.5,
        columnspacing=1.4,
        labelcolor=INK,
    )


def _structured(layer: Layer) -> bool:
    """Whether the means differ by clearly more than their errors."""
    means = layer.means
    good = means.error > 0.0
    if not np.any(good):
        return False
    z = (means.mean[good] - np.average(means.mean[good], weights=means.error[good] ** -2.0)) / means.error[good]
    return float(np.mean(z**2)) > 3.0


def _frame_of_means(layers: list[Layer]) -> tuple[float, float]:
    edges = [b.mean + side * b.error for b in (layer.means for layer in layers) for side in (-1.0, 1.0)]
    finite = [e[np.isfinite(e)] for e in edges if np.any(np.isfinite(e))]
    return (float(min(e.min() for e in finite)), float(max(e.max() for e in finite))) if finite else (0.0, 0.0)


def _frame_of_points(layers: list[Layer]) -> tuple[float, float]:
    """Most points of every layer: all but the outermost half percent on each side."""
    edges = [np.quantile(v, [0.005, 0.995]) for layer in layers if (v := layer.values[np.isfinite(layer.values)]).size]
    return (float(min(e[0] for e in edges)), float(max(e[1] for e in edges))) if edges else (0.0, 0.0)
