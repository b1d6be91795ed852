"""The figure of an Allan deviation: measured points with their band, the fitted model, and its terms by name."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from gyromodel.noise_analysis import SYMBOLS
from gyromodel.report import _drawing as draw
from gyromodel.report._numbers import unit_text

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from gyromodel.noise_analysis import NoiseAnalysis

_NAMES = {
    "noise_white": "white",
    "noise_quantisation": "quantisation",
    "noise_flicker": "flicker",
    "noise_random_walk": "random walk",
    "noise_markov": "Markov",
    "noise_rate_ramp": "ramp",
    "lines": "lines",
}


# Part of the model's deviation that a term has where its name stands, and the digits of powers of ten.
_BESIDE = 0.6
# Room for a name, in parts of the frame: to its edges, and to other names.
_MARGIN, _APART = np.array([0.1, 0.04]), np.array([0.25, 0.07])
_SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def noise_rows(analysis: NoiseAnalysis) -> list[tuple[str, ...]]:
    """Rows of a table: noise, symbol, value, limits, unit, verdict in words."""
    rows = []
    for key, term in analysis.noise.terms.items():
        size, unit = analysis.scale_of(key), unit_text(analysis.unit_of(key))
        value, low, high = (f"{x * size:.3g}" for x in (term.value, term.low, term.high))
        verdict = term.verdict
        if verdict == "not identifiable":
            value, low = "–", "–"
            limits = [f"{b * size:.3g} for {c:g} s" for c, b in term.bounds] or [high]
            verdict, high = f"not identifiable: below {', '.join(limits)} (95 %)", "–"
        elif verdict == "ambiguous" and term.alternatives:
            verdict = f"ambiguous: this or {' or '.join(_NAMES[name] for name in term.alternatives)}"
        elif verdict == "doubtful":
            verdict = "doubtful: the spectrum contradicts it"
        if key == "noise_markov" and term.in_model:
            verdict += f", time constant {term.time_constant:.3g} s"
        rows.append((_NAMES[key], SYMBOLS[key], value, low, high, unit, verdict))
    for line in analysis.noise.lines:
        limits = (max(line.amplitude + side * 1.96 * line.std, 0.0) for side in (-1.0, 1.0))
        value, low, high = (f"{x * analysis.scale:.3g}" for x in (line.amplitude, *limits))
        rows.append((f"line at {line.frequency:.6g} Hz", "", value, low, high, unit_text(analysis.unit), "found"))
    return rows


def deviation_figure(analysis: NoiseAnalysis) -> str:
    """The Allan deviation over averaging time as SVG, on logarithmic axes."""
    with draw.style():
        return _drawn(analysis)


def _drawn(analysis: NoiseAnalysis) -> str:
    seen, scale = analysis.deviations["allan"], analysis.scale
    figure, axes = draw.blank()
    figure.set_size_inches(6.6, 4.4)
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.fill_between(seen.tau, seen.low * scale, seen.high * scale, color=draw.BEFORE_DOT, alpha=0.45, linewidth=0)
    dots = {"linestyle": "none", "marker": "o", "markersize": 3.6, "color": draw.INK, "zorder": 6}
    axes.plot(seen.tau, seen.deviation * scale, label="measured, 95 % band", **dots)
    low = 0.4 * float(seen.deviation.min()) * scale
    high = 1.5 * float(seen.deviation.max()) * scale
    axes.set_ylim(low, high)
    shares = analysis.noise.allan_variance(seen.tau)
    total = np.sqrt(sum(shares.values())) * scale
    if shares:
        axes.plot(seen.tau, total, color=draw.AFTER, linewidth=2.0, label="fitted model", zorder=4)
    taken: list[np.ndarray] = []
    for name, variance in shares.items():
        term = np.sqrt(variance) * scale
        axes.plot(seen.tau, term, color=draw.MARK, linewidth=1.0, linestyle=(0, (5, 3)), zorder=3)
        _name(axes, name, seen.tau, term, total, taken)
    axes.set_xlabel(draw.axis_label("averaging time", "s", 0))
    axes.set_ylabel(draw.axis_label("Allan deviation", analysis.unit, 0))
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter(lambda value, _: _power(value))
        axis.set_minor_formatter("")
    draw.legend(axes, 2)
    return draw.rendered(figure, "allan")


def _name(axes: Axes, name: str, tau: np.ndarray, term: np.ndarray, total: np.ndarray, taken: list[np.ndarray]) -> None:
    """Write a term's name on its line, where it has left the model's curve and no other name stands."""
    places = axes.transAxes.inverted().transform(axes.transData.transform(np.column_stack([tau, term])))
    inner = np.flatnonzero((places > _MARGIN).all(axis=1) & (places < 1.0 - _MARGIN).all(axis=1))
    if not len(inner):
        return
    cost = np.abs(np.log(term[inner] / total[inner]) - np.log(_BESIDE))
    for other in taken:
        cost += 10.0 * (np.abs(places[inner] - other) < _APART).all(axis=1)
    at = inner[np.argmin(cost)]
    taken.append(places[at])
    text = f"{_NAMES[name]} {SYMBOLS[name]}" if name in SYMBOLS else _NAMES[name]
    axes.annotate(
        text,
        (tau[at], term[at]),
        (0, 0 if term[at] < 0.8 * total[at] else -16),
        textcoords="offset points",
        color=draw.MARK,
        ha="center",
        va="center",
        fontsize=9.5,
        zorder=5,
        bbox={"facecolor": draw.PAPER, "edgecolor": "none", "pad": 1.0},
    )


def _power(value: float) -> str:
    """A power of ten as a label, without the mathematics that other texts of the figure might trigger."""
    exponent = round(np.log10(value))
    return f"{value:g}" if -3 <= exponent <= 4 else f"10{str(exponent).translate(_SUPERSCRIPTS)}"
