"""What is drawn: the columns a residual may follow, its means over each, and few enough points to look at."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from gyromodel.declarations import RATE_OF, column_of, measured
from gyromodel.report._sentence import followed
from gyromodel.report._words import spoken

if TYPE_CHECKING:
    from gyromodel.campaign import Campaign
    from gyromodel.diagnosis._result import Diagnosis

POINTS = 3000
PANELS = 10
_HOUSEKEEPING = ("run", "position")
_BY_RATE = ("scale_",)
_BY_TIME = ("bias_drift", "bias_step", "bias_warmup", "noise_random_walk")
_BY_NAME = {
    "bias_periodic": "phase",
    "sync_delay": "table_rate",
    "shaft_friction": "table_rate",
    "loop_dynamics": "table_rate",
    "loop_resonance": "table",
    "platform_drift": "time",
    "bias_temperature_rate": "temperature:rate",
    "bias_temperature_curve": "temperature",
    "bias_temperature_gradient": "temperature:difference",
    "scale_temperature": "temperature:product",
    "scale_temperature_curve": "temperature:product",
}


@dataclass(frozen=True)
class Abscissa:
    """Something the residual is drawn against; `derived` ones are computed here from a measured column."""

    key: str
    label: str
    unit: str
    values: np.ndarray
    derived: bool = False


@dataclass(frozen=True)
class Bins:
    """Means of a series over bins of another, with the standard error of points taken as independent."""

    x: np.ndarray
    mean: np.ndarray
    error: np.ndarray


def abscissae(diagnosis: Diagnosis) -> tuple[list[Abscissa], list[str]]:
    """Everything the residual is drawn against, most telling first, and the columns left out with the reason."""
    campaign = diagnosis.campaign
    found = {"time": time_axis(campaign)}
    left_out = []
    for name in campaign.columns:
        if name in ("time", *campaign.outputs, *_HOUSEKEEPING):
            continue
        values = np.asarray(campaign.columns[name], float)
        if not varies(values):
            left_out.append(f"{spoken(name)} (constant)")
            continue
        label = {"rate": "input rate"}.get(name, spoken(name))
        found[name] = Abscissa(name, label, campaign.units.get(name, ""), values)
    found |= _derived(campaign, found) | _folded(diagnosis)
    causes = [key for cause in diagnosis.causes for key in follows(cause.effect, found)]
    causes += [key_of(column) for column in followed(diagnosis)]
    if any(cause.points for cause in diagnosis.causes):
        causes.append("rate")
    shares = {key: explained(a.values, diagnosis.residual_before) for key, a in found.items()}
    order = sorted(found, key=lambda key: (key not in causes, found[key].derived, -shares[key]))
    measured = max((shares[key] for key in found if not found[key].derived), default=0.0)
    # A computed column earns its place only by showing what no measured one does.
    order = [k for k in order if k in causes or not found[k].derived or shares[k] > max(0.1, 1.3 * measured)]
    left_out += [f"{found[key].label} (nothing stands out)" for key in order[PANELS:]]
    return [found[key] for key in order[:PANELS]], left_out


def follows(effect: str, known: Mapping[str, Abscissa]) -> list[str]:
    """Keys of what the effect's error is expected to follow."""
    if effect in _BY_NAME:
        keys = [_BY_NAME[effect]]
    elif effect.startswith(_BY_RATE):
        keys = ["rate"]
    elif effect.startswith(_BY_TIME):
        keys = ["time"]
    else:
        keys = [column_of(effect)]
    return [key for key in known if key in keys or any(key.startswith(f"{k}:") for k in keys if ":" in k)]


def key_of(column: str) -> str:
    """The key of a driver's column, which may be a rate of change computed by the search."""
    base, form = measured(column)
    return f"{base}:rate" if form == RATE_OF else column


def time_axis(campaign: Campaign) -> Abscissa:
    """Time in the unit that suits its span."""
    seconds = np.asarray(campaign.in_unit("time", "s"), float)
    span = float(np.ptp(seconds)) if seconds.size else 0.0
    unit, size = next(((u, s) for u, s in (("h", 3600.0), ("min", 60.0)) if span > 2.0 * s), ("s", 1.0))
    return Abscissa("time", "time", unit, seconds / size)


def swept(campaign: Campaign, residual: np.ndarray, unit: str) -> bool:
    """Whether the input rate moves so far that a plot of the raw output hides the residual."""
    if "rate" not in campaign.columns:
        return False
    rate = np.asarray(campaign.in_unit("rate", unit), float)
    return varies(rate) and float(np.nanstd(rate)) > 3.0 * spread(residual)


def varies(values: np.ndarray) -> bool:
    """Whether a column takes more than one value."""
    finite = values[np.isfinite(values)]
    return finite.size > 2 and float(np.ptp(finite)) > 1e-9 * float(np.max(np.abs(finite)))


def bins(x: np.ndarray, y: np.ndarray, skip: np.ndarray | None = None, equal_width: bool = False) -> Bins:
    """Mean and standard error of y over bins of x.

    Args:
        x: abscissa; one bin per level where it is stepped, else bins of equal count.
        y: values; missing ones are left out.
        skip: rows to leave out.
        equal_width: bins of equal width, for time.
    """
    good = np.isfinite(x) & np.isfinite(y)
    if skip is not None:
        good[skip] = False
    x, y = x[good], y[good]
    if x.size < 6:
        return Bins(x[:0], y[:0], y[:0])
    group = _groups(x, equal_width)
    count = np.bincount(group).astype(float)
    enough = count >= max(1 if x.size < 60 else 2, 0.1 * float(np.median(count[count > 0])))
    with np.errstate(invalid="ignore", divide="ignore"):
        centre = np.bincount(group, x) / count
        mean = np.bincount(group, y) / count
        variance = np.bincount(group, (y - mean[group]) ** 2) / (count - 1.0)
        error = np.sqrt(variance / count)
    pooled = math.sqrt(float(np.nanmean(variance[count > 1]))) if np.any(count > 1) else 0.0
    error = np.where(count > 2, error, pooled / np.sqrt(np.maximum(count, 1.0)))
    if equal_width:  # an empty stretch breaks the line through the means
        centre[~enough] = mean[~enough] = error[~enough] = np.nan
        enough[:] = True
    return Bins(centre[enough], mean[enough], error[enough])


def explained(x: np.ndarray, y: np.ndarray, skip: np.ndarray | None = None) -> float:
    """Share of the variance of y between bins of x, corrected for the number of bins; never below zero."""
    good = np.isfinite(x) & np.isfinite(y)
    if skip is not None:
        good[skip] = False
    x, y = x[good], y[good]
    if x.size < 12:
        return 0.0
    group = _groups(x, False)
    count = np.bincount(group).astype(float)
    mean = np.bincount(group, y) / np.maximum(count, 1.0)
    total = float(np.sum((y - y.mean()) ** 2))
    freedom = x.size - np.count_nonzero(count)
    if total <= 0.0 or freedom <= 0:
        return 0.0
    within = float(np.sum((y - mean[group]) ** 2))
    return max(0.0, 1.0 - within / freedom / (total / (x.size - 1)))


def thinned(x: np.ndarray, y: np.ndarray, points: int) -> np.ndarray:
    """Rows to draw: at most so many, evenly along x (evenly by row would alias with a repeated rate sequence)."""
    rows = np.flatnonzero(np.isfinite(x) & np.isfinite(y))
    if rows.size <= points:
        return rows
    order = rows[np.argsort(x[rows], kind="stable")]
    return order[np.linspace(0, order.size - 1, points).astype(int)]


def _groups(x: np.ndarray, equal_width: bool) -> np.ndarray:
    """Bin number of each value."""
    if equal_width:
        edges = np.linspace(float(x.min()), float(x.max()), min(40, max(6, x.size // 10)) + 1)
        return np.searchsorted(edges[1:-1], x, side="right")
    order = np.sort(x)
    gaps = np.flatnonzero(np.diff(order) > 0.004 * (order[-1] - order[0]))
    starts, ends = np.r_[0, gaps + 1], np.r_[gaps, order.size - 1]
    narrow = np.all(order[ends] - order[starts] <= 0.05 * (order[-1] - order[0]))
    if 2 <= starts.size <= min(60, x.size // 2) and narrow:
        return np.searchsorted(order[starts[1:]], x, side="right")
    edges = np.unique(np.quantile(x, np.linspace(0.0, 1.0, min(24, max(5, x.size // 12)) + 1)))
    return np.searchsorted(edges[1:-1], x, side="right")


def _derived(campaign: Campaign, found: dict[str, Abscissa]) -> dict[str, Abscissa]:
    """Rates of change, temperature differences and rate times temperature."""
    made = {}
    seconds = np.asarray(campaign.in_unit("time", "s"), float)
    thermometers = [key for key in found if key == "temperature" or key.startswith("temperature_")]
    blocks = _blocks(campaign, seconds)
    for name in [*thermometers[:2], *(["rate"] if "rate" in found else [])]:
        slope = 60.0 * _slope(seconds, found[name].values, blocks)
        if varies(slope):
            label, unit = f"rate of change of {found[name].label}", f"{found[name].unit}/min"
            made[f"{name}:rate"] = Abscissa(f"{name}:rate", label, unit, slope, True)
    for name in thermometers[1:3]:
        difference = found[thermometers[0]].values - campaign.in_unit(name, found[thermometers[0]].unit)
        label = f"{found[thermometers[0]].label} minus {found[name].label}"
        made[f"temperature:difference:{name}"] = Abscissa(
            f"temperature:difference:{name}", label, found[thermometers[0]].unit, difference, True
        )
    if "rate" in found and thermometers:
        heat = found[thermometers[0]]
        product = found["rate"].values * (heat.values - np.nanmean(heat.values))
        unit = f"{heat.unit}*{found['rate'].unit}"
        made["temperature:product"] = Abscissa("temperature:product", "rate × temperature change", unit, product, True)
    return made


def _folded(diagnosis: Diagnosis) -> dict[str, Abscissa]:
    """The phase of a periodic bias that was found, over which it shows as one wave."""
    from gyromodel.effects.drivers import BiasPeriodic
    from gyromodel.units import factor

    for cause in diagnosis.causes:
        for p in cause.parameters:
            if cause.effect == "bias_periodic" and p.name in ("frequency", "frequency[0]") and p.value > 0.0:
                seconds = np.asarray(diagnosis.campaign.in_unit("time", "s"), float)
                phase = np.mod((seconds - seconds[0]) * p.value * factor(p.unit, "Hz"), 1.0)
                label = "phase of the period that was found"
                if (number := diagnosis.campaign.columns.get("campaign")) is not None:
                    first = next(e for e in diagnosis.extended.model.effects if isinstance(e, BiasPeriodic)).campaigns[
                        :1
                    ]
                    phase[~np.isin(number, first or number)] = np.nan
                    label += "".join(f", campaign {own}" for own in first)
                return {"phase": Abscissa("phase", label, "1", phase, True)}
    return {}


def _blocks(campaign: Campaign, seconds: np.ndarray) -> list[np.ndarray]:
    """Rows without a long gap or a change of segment or run between them."""
    step = np.diff(seconds)
    if not step.size:
        return [np.arange(seconds.size)]
    broken = step > 20.0 * float(np.median(step))
    for name in ("segment", "run"):
        if name in campaign.columns:
            broken |= np.diff(np.asarray(campaign.columns[name], float)) != 0
    cuts = np.flatnonzero(broken) + 1
    return np.split(np.arange(seconds.size), cuts if cuts.size < 5000 else [])


def _slope(seconds: np.ndarray, values: np.ndarray, blocks: list[np.ndarray]) -> np.ndarray:
    """Rate of change, smoothed over a 200th of the rows of each block; NaN where a block is too short."""
    slope = np.full(values.size, np.nan)
    for rows in blocks:
        half = rows.size // 400
        if rows.size < 5:
            continue
        known = np.isfinite(values[rows])
        if np.count_nonzero(known) < 2:
            continue
        filled = np.interp(rows, rows[known], values[rows[known]])
        total = np.cumsum(np.insert(filled - filled.mean(), 0, 0.0))
        smooth = (total[2 * half + 1 :] - total[: -(2 * half + 1)]) / (2 * half + 1)
        inner = rows[half : rows.size - half]
        slope[inner] = np.gradient(smooth, seconds[inner])
    return slope


def spread(values: np.ndarray) -> float:
    """Standard deviation of the finite values; zero of none."""
    finite = values[np.isfinite(values)]
    return float(np.std(finite)) if finite.size else 0.0
