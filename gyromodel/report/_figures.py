"""The report's figures: measured against simulated, residuals over each driver, the function an unknown follows."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from gyromodel.declarations import BEHIND, RATE_OF
from gyromodel.report import _drawing as draw
from gyromodel.report._numbers import number, percent, unit_text
from gyromodel.report._sentence import followed
from gyromodel.report._series import (
    POINTS,
    Abscissa,
    abscissae,
    bins,
    explained,
    follows,
    key_of,
    spread,
    swept,
    time_axis,
    varies,
)
from gyromodel.report._words import driven, listed

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from gyromodel.diagnosis._result import Diagnosis, Driver

# Patterns of the names of all figures.
FIGURES = ("measured-simulated-*", "residual-*", "driver")
_LABELLED = 6
_MEASURED = "measured − model"


@dataclass(frozen=True)
class Drawn:
    """A finished figure; `alt` says in words what it shows."""

    name: str
    title: str
    caption: str
    alt: str
    svg: str
    cause: bool = False


@dataclass(frozen=True)
class Figures:
    """All figures of a report by section, and the columns that have none, with the reason."""

    compared: list[Drawn]
    driver: list[Drawn]
    residuals: list[Drawn]
    left_out: list[str]

    def all(self) -> list[Drawn]:
        """Every figure in page order."""
        return [*self.compared, *self.driver, *self.residuals]


def extended(diagnosis: Diagnosis) -> bool:
    """Whether the diagnosis changed the simulation at all."""
    before, after = diagnosis.residual_before, diagnosis.residual_after
    return not np.allclose(before, after, rtol=1e-9, atol=0.0, equal_nan=True)


def figures(diagnosis: Diagnosis) -> Figures:
    """Draw everything."""
    with draw.style():
        return _figures(diagnosis)


def _figures(diagnosis: Diagnosis) -> Figures:
    drivers, left_out = abscissae(diagnosis)
    known = {a.key: a for a in drivers}
    causes = {key for cause in diagnosis.causes for key in follows(cause.effect, known)}
    causes |= {key_of(column) for column in followed(diagnosis)}
    moved = swept(diagnosis.campaign, diagnosis.residual_before, diagnosis.rate_unit)
    if moved:
        rate = Abscissa("rate", "input rate", diagnosis.campaign.units["rate"], diagnosis.campaign.columns["rate"])
        compared = [_deviation(diagnosis, a) for a in (rate, time_axis(diagnosis.campaign))]
    elif diagnosis.campaign.metadata.get("kind", "rate") == "rate":
        compared = [_output(diagnosis), _deviation(diagnosis, time_axis(diagnosis.campaign))]
    else:  # the models predict rates, which angles and increments only become after differencing
        compared = [_deviation(diagnosis, time_axis(diagnosis.campaign))]
    return Figures(
        compared,
        [_found(diagnosis, known)] if _drawable(diagnosis) else [],
        [_residual(diagnosis, a, name, a.key in causes) for a, name in zip(drivers, _names(drivers), strict=True)],
        left_out,
    )


def _names(drivers: list[Abscissa]) -> list[str]:
    """File names that any system takes, each once."""
    names: list[str] = []
    for x in drivers:
        name = f"residual-{re.sub(r'[^a-z0-9]+', '-', x.key.lower()).strip('-')[:60]}".rstrip("-")
        names.append(name if name not in names else f"{name}-{len(names) + 1}")
    return names


def apart(diagnosis: Diagnosis) -> np.ndarray:
    """Rows that a cause names one by one."""
    rows = [row for cause in diagnosis.causes for row in cause.points]
    return np.unique(np.asarray(rows, int))


def _deviation(diagnosis: Diagnosis, x: Abscissa) -> Drawn:
    """Measured and extended simulation, both as deviation from the original simulation."""
    skip = apart(diagnosis)
    timed = x.key == "time"
    measured = diagnosis.residual_before
    layers = [_layer("measured", measured, x, skip, draw.BEFORE, draw.BEFORE_DOT, "s")]
    if extended(diagnosis):
        change = measured - diagnosis.residual_after
        layers.append(_layer("extended", change, x, skip, draw.AFTER, draw.AFTER_DOT, "o"))
    figure, axes, remarks = _panel(diagnosis, x, layers, "deviation from simulation")
    axes.axhline(0.0, color=draw.INK, linewidth=1.1, linestyle=(0, (4, 3)), zorder=3, label="simulation")
    draw.legend(axes, len(layers) + 1)
    what = "The dashed zero line is your simulation. Where the extended simulation is right it lies on the measurement."
    if len(layers) == 1:
        what = "The dashed zero line is your simulation, which was not extended."
    caption = " ".join([what, *remarks])
    name = f"measured-simulated-{'time' if timed else 'rate'}"
    title = f"Measured minus simulated, over {x.label}"
    return Drawn(name, title, caption, _described(layers, diagnosis.rate_unit), draw.rendered(figure, name))


def _output(diagnosis: Diagnosis) -> Drawn:
    """Raw output over time with both simulations."""
    campaign = diagnosis.campaign
    column = campaign.outputs[0]
    unit = campaign.units.get(column, "")
    x, skip = time_axis(campaign), apart(diagnosis)
    output = np.asarray(campaign.columns[column], float)
    before, after = diagnosis.predicted_before, diagnosis.predicted_after
    finite = output[np.isfinite(output)]
    centre = float(np.median(finite)) if finite.size else 0.0
    offset = float(f"{centre:.6g}") if abs(centre) > 20.0 * spread(output) > 0.0 else 0.0
    layer = _layer("measured", output - offset, x, skip, draw.BEFORE, draw.BEFORE_DOT, "s")
    figure, axes = draw.blank()
    frame = np.concatenate([v[np.isfinite(v)] for v in (layer.means.mean, before - offset, after - offset)])
    scale = 10.0 ** draw.power_of_ten(float(np.max(np.abs(frame))) if frame.size else 0.0)
    power = round(np.log10(scale))
    remarks = draw.overlay(axes, x.values, [layer], POINTS // 2, scale, frame)
    lines: list[tuple[str, np.ndarray, str, Any]] = [("simulation", before, draw.INK, (0, (4, 3)))]
    if extended(diagnosis):
        lines.append(("extended", after, draw.AFTER, "-"))
    rows = np.unique(np.linspace(0, output.size - 1, min(output.size, 900)).astype(int))
    breaks = np.flatnonzero(np.diff(x.values[rows]) > 20.0 * np.median(np.diff(x.values[rows])))
    for label, values, colour, dash in lines:
        line = np.insert((values[rows] - offset) / scale, breaks + 1, np.nan)
        at = np.insert(x.values[rows], breaks + 1, np.nan)
        axes.plot(at, line, color=colour, linestyle=dash, linewidth=1.7, label=label, zorder=6)
    axes.set_xlabel(draw.axis_label(x.label, x.unit, 0))
    apart_from = f" {'+' if offset < 0 else '−'} {abs(offset):g} {unit_text(unit)}".rstrip() if offset else ""
    axes.set_ylabel(draw.axis_label(f"output{apart_from}", unit, power))
    draw.legend(axes, len(lines) + 1)
    caption = " ".join(["Squares: means of the measured output with their standard error.", *remarks])
    alt = f"Measured output over time with {' and '.join(label for label, *_ in lines)}."
    svg = draw.rendered(figure, "measured-simulated-output")
    return Drawn("measured-simulated-output", "Measured and simulated output over time", caption, alt, svg)


def _residual(diagnosis: Diagnosis, x: Abscissa, name: str, cause: bool) -> Drawn:
    """Residual over one driver, before and after."""
    skip = apart(diagnosis)
    before, after = diagnosis.residual_before, diagnosis.residual_after
    changed = extended(diagnosis)
    layers = [_layer("before" if changed else "residual", before, x, skip, draw.BEFORE, draw.BEFORE_DOT, "s")]
    if changed:
        layers.append(_layer("after", after, x, skip, draw.AFTER, draw.AFTER_DOT, "o"))
    figure, axes, remarks = _panel(diagnosis, x, layers, _MEASURED)
    axes.axhline(0.0, color=draw.INK, linewidth=0.9, zorder=3)
    draw.legend(axes, 2)
    shares = [percent(explained(x.values, layer.values, skip)) for layer in layers]
    when = f" before, {shares[1]} after" if changed else ""
    share = f"Explains {shares[0]} of the variance of the residual{when}."
    alt = f"{_described(layers, diagnosis.rate_unit)} {share}"
    title = x.label[:1].upper() + x.label[1:]
    return Drawn(name, title, " ".join([share, *remarks]), alt, draw.rendered(figure, name), cause)


def _drawable(diagnosis: Diagnosis) -> bool:
    """Whether there is a function to draw."""
    driver = diagnosis.driver
    return driver is not None and bool(np.any(np.isfinite(driver.y + driver.std)))


def _found(diagnosis: Diagnosis, known: dict[str, Abscissa]) -> Drawn:
    """The function that an unknown discrepancy follows, with its band, over the means of the residual."""
    driver = diagnosis.driver
    assert driver is not None
    figure, axes = draw.blank()
    order = np.argsort(driver.x)
    x, y, std = driver.x[order], driver.y[order], driver.std[order]
    power = draw.power_of_ten(float(np.nanmax(np.abs(y) + 2.0 * std)))
    scale = 10.0**power
    first, *more = followed(diagnosis)
    # A response depends on what the rate was before and after as well.
    if more or first in (RATE_OF.format("rate"), BEHIND.format("rate")):
        caption = f"Points: the function found, which depends on more than {driven(first)}, where it was measured"
        caption += f", in parts by {driven(more[0])}" if driver.second.size else ""
        caption += "; bars: two standard errors."
        for rows, colour, name in _parts(driver, more, order):
            axes.errorbar(
                x[rows],
                y[rows] / scale,
                2.0 * std[rows] / scale,
                fmt=".",
                color=colour,
                markersize=5.0,
                elinewidth=0.8,
                zorder=5,
                label=name,
            )
    else:
        for width, alpha in ((2.0, 0.16), (1.0, 0.26)):
            lower, upper = (y - width * std) / scale, (y + width * std) / scale
            axes.fill_between(x, lower, upper, color=draw.AFTER, alpha=alpha, linewidth=0.0, zorder=2)
        axes.plot(x, y / scale, color=draw.AFTER, linewidth=2.0, zorder=5, label="function found")
        caption = "Line: the function found; bands: one and two standard errors."
    at = _column(diagnosis, known)
    if at is not None:
        means = bins(at, diagnosis.residual_before * _factor(diagnosis.rate_unit, driver.y_unit), apart(diagnosis))
        if means.x.size:
            shift = float(np.nanmean(np.interp(means.x, x, y)) - np.nanmean(means.mean))
            axes.errorbar(
                means.x,
                (means.mean + shift) / scale,
                means.error / scale,
                fmt="s",
                color=draw.BEFORE,
                markersize=4.2,
                elinewidth=1.2,
                zorder=4,
                label="residual before",
            )
            caption += " Squares: means of the residual before, moved to the level of the curve."
    label = listed([driven(column) for column in (first, *more)])
    across = "time since the start" if first == "time" else driven(first)
    axes.set_xlabel(draw.axis_label(across, driver.unit, 0))
    axes.set_ylabel(draw.axis_label("error of the simulation", driver.y_unit, power))
    draw.legend(axes, 2)
    reach = f"{number(float(np.nanmin(y)))} to {number(float(np.nanmax(y)))} {unit_text(driver.y_unit)}"
    alt = f"The error of the simulation as a smooth function of {label}, from {reach}."
    return Drawn("driver", f"What the error does over {label}", caption, alt, draw.rendered(figure, "driver"), True)


def _parts(driver: Driver, more: list[str], order: np.ndarray) -> list[tuple[np.ndarray, str, str]]:
    """The points of a driver's function in parts by its second column: which, their colour, and what they are."""
    if not driver.second.size:
        return [(np.arange(len(order)), draw.AFTER, "function found")]
    second = driver.second[order]
    edges = np.unique(np.quantile(second, np.linspace(0.0, 1.0, len(draw.PARTS) + 1)))
    part = np.clip(np.searchsorted(edges, second, "right") - 1, 0, max(len(edges) - 2, 0))
    unit, found = unit_text(driver.second_unit), []
    for k in np.unique(part):
        inside = second[part == k]
        ends = dict.fromkeys(number(float(end), 3).replace("-", "−") for end in (inside.min(), inside.max()))
        found.append((np.flatnonzero(part == k), draw.PARTS[k], f"{' to '.join(ends)} {unit}".rstrip()))
    return found


def _panel(diagnosis: Diagnosis, x: Abscissa, layers: list[draw.Layer], text: str) -> tuple[Figure, Axes, list[str]]:
    """Axes with the layers drawn over one abscissa, and points that stand apart ringed."""
    rows = apart(diagnosis)
    if x.key != "rate" and text == _MEASURED:
        rows = rows[:0]  # rings shrink all the rest: they are drawn where they tell most
    figure, axes = draw.blank()
    reach = [np.quantile(np.abs(v), 0.99) for layer in layers if (v := layer.values[np.isfinite(layer.values)]).size]
    power = draw.power_of_ten(float(max(reach, default=0.0)))
    scale = 10.0**power
    across = draw.power_of_ten(float(np.nanmax(np.abs(x.values))))
    x = replace(x, values=x.values / 10.0**across)
    layers = [replace(layer, means=replace(layer.means, x=layer.means.x / 10.0**across)) for layer in layers]
    aside = diagnosis.residual_before[rows]
    remarks = draw.overlay(axes, x.values, layers, POINTS, scale, np.append(aside, 0.0))
    if rows.size:
        _ring(axes, diagnosis, x, aside / scale, rows)
        stand = "points that stand" if rows.size > 1 else "point that stands"
        remarks.append(f"Ringed: {rows.size} {stand} apart, left out of the means.")
    axes.set_xlabel(draw.axis_label(x.label, x.unit, across))
    axes.set_ylabel(draw.axis_label(text, diagnosis.rate_unit, power))
    return figure, axes, remarks


def _ring(axes: Axes, diagnosis: Diagnosis, x: Abscissa, y: np.ndarray, rows: np.ndarray) -> None:
    """Ring the rows, and write their rate beside the farthest of each level."""
    axes.plot(x.values[rows], y, "o", mfc="none", mec=draw.MARK, mew=1.4, markersize=8, zorder=8)
    if "rate" not in diagnosis.campaign.columns:
        return
    rate = np.asarray(diagnosis.campaign.columns["rate"], float)
    if not varies(rate):
        return
    level = np.round(rate[rows] / (0.01 * np.nanmax(np.abs(rate))))
    order = np.argsort(-np.abs(y), kind="stable")
    farthest = [order[level[order] == step][0] for step in dict.fromkeys(level[order])]
    middle = 0.5 * sum(axes.get_xlim())
    for i in farthest[:_LABELLED]:
        left = x.values[rows[i]] > middle
        axes.annotate(
            f"{number(float(rate[rows[i]]), 3)} {unit_text(diagnosis.campaign.units['rate'])}".replace("-", "−"),
            (x.values[rows[i]], y[i]),
            xytext=(-9 if left else 9, 0),
            textcoords="offset points",
            ha="right" if left else "left",
            va="center",
            color=draw.MARK,
            bbox={"facecolor": "white", "edgecolor": "none", "pad": 0.6, "alpha": 0.85},
            zorder=9,
        )


def _described(layers: list[draw.Layer], unit: str) -> str:
    """The reach of each layer's means, in words."""
    parts = []
    for layer in layers:
        mean = layer.means.mean[np.isfinite(layer.means.mean)]
        if mean.size:
            reach = f"{number(float(mean.min()))} to {number(float(mean.max()))} {unit_text(unit)}"
            parts.append(f"{layer.label}: means from {reach}")
    return f"{'; '.join(parts)}." if parts else "No finite points."


def _column(diagnosis: Diagnosis, known: dict[str, Abscissa]) -> np.ndarray | None:
    """The driver's column in the driver's unit, if it was recorded or can be computed."""
    driver, campaign = diagnosis.driver, diagnosis.campaign
    assert driver is not None
    if driver.column == "time":  # as it was searched: of each campaign from its own start
        record = diagnosis.extended.record
        return np.asarray(record.signals["time"])[: record.rows] * _factor("s", driver.unit)
    if driver.column in campaign.columns:
        return np.asarray(campaign.in_unit(driver.column, driver.unit), float)
    computed = known.get(key_of(driver.column))
    return None if computed is None else computed.values * _factor(computed.unit, driver.unit)


def _factor(unit: str, wanted: str) -> float:
    if unit == wanted:
        return 1.0
    from gyromodel.units import factor

    return factor(unit, wanted)


def _layer(
    label: str,
    values: np.ndarray,
    x: Abscissa,
    skip: np.ndarray,
    colour: str,
    dot: str,
    marker: str,
) -> draw.Layer:
    """A series without the rows that stand apart, which are ringed instead."""
    values = np.array(values, float)
    values[skip] = np.nan
    means = bins(x.values, values, equal_width=x.key == "time")
    return draw.Layer(label, values, means, colour, dot, marker)
