"""What an archive says of its units: how they spread, which stand out, which drift, and what all tell of each.

A parameter of campaign j of unit i is θ_ij = μ + u_i + c_ij, u_i ~ N(0, τ²) from unit to unit and c_ij ~ N(0, κ²) from
campaign to campaign, and its estimate has the standard uncertainty of its fit. τ and κ have a uniform prior (Gelman,
Bayesian Analysis 1, 2006) and are summed over a grid, so that few units give wide intervals instead of wrong ones.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import pyarrow as pa
from jaxtyping import Float, Int
from scipy import stats
from scipy.special import ndtr

# Levels of each spread, and how far beyond the scatter of the estimates they reach.
LEVELS, BEYOND = 40, 6.0
# Chance that an archive without outlying units, or drifts, shows one; and below which chances are not told apart.
FALSE_ALARM, RAREST = 0.01, 1e-6
# Units so many robust standard deviations from the median are suspect, and only these are held against the others.
SUSPECT = 2.0
# Of a normal distribution: standard deviations in a median absolute deviation.
MAD = 1.4826
# Campaigns that show a drift.
FEWEST = 3


class Spread(NamedTuple):
    """A spread: posterior median and 95 % interval."""

    value: float
    low: float
    high: float


UNKNOWN = Spread(np.nan, np.nan, np.nan)


class Outlier(NamedTuple):
    """A unit that the others do not lead to expect: its value, theirs and by how many standard deviations it is off."""

    unit: str
    value: float
    expected: float
    std: float
    deviations: float


class Drift(NamedTuple):
    """How a parameter of one unit changes per day, or from campaign to campaign where a date is missing."""

    unit: str
    rate: float
    std: float
    per: str


class Parameter(NamedTuple):
    """One parameter over an archive.

    parameter, axis, unit: as in the results; mean, mean_std: μ; between, within: τ and κ, NaN where only one unit, or
    no unit twice, was measured; units, campaigns: how many; outliers, drifts: those beyond chance; pooled: indices of
    the results' rows, and value and standard deviation and 95 % interval of θ_ij from all of the archive.
    """

    parameter: str
    axis: str
    unit: str
    mean: float
    mean_std: float
    between: Spread
    within: Spread
    units: int
    campaigns: int
    outliers: tuple[Outlier, ...]
    drifts: tuple[Drift, ...]
    pooled: dict[str, np.ndarray]

    def sentences(self) -> Iterator[str]:
        """What stands out."""
        name = f"{self.parameter} {self.axis}".strip()
        for o in self.outliers:
            chance = 2.0 * float(stats.norm.sf(abs(o.deviations)))
            share = f"one in {float(f'{1 / max(chance, RAREST):.2g}'):,.0f}"
            share = share if chance > RAREST else f"less than {share}"
            yield (
                f"Unit {o.unit} stands out: its {name} is {o.value:.4g} {self.unit}, where the others lead to expect "
                f"({o.expected:.4g} ± {o.std:.2g}) {self.unit}; of such units {share} would be as far off."
            )
        for d in self.drifts:
            yield f"Unit {d.unit} drifts: its {name} changes by ({d.rate:.3g} ± {d.std:.2g}) {self.unit} per {d.per}."

    def to_dict(self) -> dict[str, Any]:
        """JSON-ready, without the pooled values."""
        entries = self._asdict() | {"between": self.between._asdict(), "within": self.within._asdict()}
        entries["outliers"] = [o._asdict() for o in self.outliers]
        entries["drifts"] = [d._asdict() for d in self.drifts]
        return {key: value for key, value in entries.items() if key != "pooled"}


def pooled_table(results: pa.Table, statistics: Sequence[Parameter]) -> pa.Table:
    """The results' campaigns and parameters with what the whole archive says of each.

    Returns:
        campaign, axis, parameter, unit, value and std as fitted, and pooled_value, pooled_std, pooled_low, pooled_high.
    """
    head = results.select(["campaign", "axis", "parameter", "unit", "value", "std"])
    rows = np.concatenate([s.pooled["row"] for s in statistics]) if statistics else np.zeros(0, int)
    table = head.take(rows)
    for name in ("value", "std", "low", "high"):
        whole = np.concatenate([s.pooled[name] for s in statistics]) if statistics else np.zeros(0)
        table = table.append_column(f"pooled_{name}", pa.array(whole))
    return table.take(np.argsort(rows))


def unit_statistics(results: pa.Table) -> list[Parameter]:
    """Statistics of every parameter with standard uncertainties in a table of results.

    Campaigns of one `serial` are of one unit, and one without is of a unit of its own. `copies` count once, and rows
    with a `reason` not.

    Args:
        results: as `run_batch` writes them.

    Returns:
        One entry for each parameter, and axis, that two campaigns or more have.
    """
    return [found for rows in _by_parameter(results) if (found := _statistics(rows)) is not None]


def copies(results: pa.Table) -> list[str]:
    """Campaigns that hold the very data of one before them, metadata included, as copies of a file do."""
    first: dict[str, str] = {}
    each = dict(zip(results["campaign"].to_pylist(), results["data_hash"].to_pylist(), strict=True))
    return [name for name, digest in each.items() if digest and first.setdefault(digest, name) != name]


class _Rows(NamedTuple):
    """Rows of one parameter: values and standard uncertainties, and which unit each is of."""

    parameter: str
    axis: str
    unit_text: str
    index: Int[np.ndarray, " campaign"]
    value: Float[np.ndarray, " campaign"]
    std: Float[np.ndarray, " campaign"]
    unit: Int[np.ndarray, " campaign"]
    names: list[str]
    days: Float[np.ndarray, " campaign"]


def _by_parameter(results: pa.Table) -> Iterator[_Rows]:
    frame = results.select(
        ["campaign", "axis", "parameter", "value", "std", "unit", "serial", "date", "reason"]
    ).to_pandas()
    usable = frame["reason"].isna() & (frame["std"] > 0) & np.isfinite(frame["value"])
    frame = frame[usable & ~frame["campaign"].isin(copies(results))]
    frame["serial"] = frame["serial"].where(frame["serial"].notna(), frame["campaign"])
    frame["axis"] = frame["axis"].fillna("")
    for (parameter, axis, unit_text), part in frame.groupby(["parameter", "axis", "unit"], sort=False):
        part = part.sort_values("serial", kind="stable")
        names, unit = np.unique(part["serial"].to_numpy(str), return_inverse=True)
        dates = pd.to_datetime(part["date"], errors="coerce", utc=True, format="ISO8601")
        yield _Rows(
            str(parameter), str(axis), str(unit_text), part.index.to_numpy(),
            part["value"].to_numpy(float), part["std"].to_numpy(float), unit, [str(n) for n in names],
            ((dates - pd.Timestamp(0, tz="UTC")) / pd.Timedelta(days=1)).to_numpy(float),
        )  # fmt: skip


class _Posterior(NamedTuple):
    """On the grid of spreads (last axis): weights, and mean and variance of μ."""

    between: np.ndarray
    within: np.ndarray
    weight: np.ndarray
    mean: np.ndarray
    variance: np.ndarray


def _posterior(value: np.ndarray, std: np.ndarray, unit: np.ndarray) -> _Posterior:
    count = np.bincount(unit)
    reach = BEYOND * max(np.std(value), np.median(std) / len(value))
    levels = reach * np.linspace(0.0, 1.0, LEVELS) ** 2
    # What nothing shows is not there: of one unit, or of units measured once.
    between, within = (levels if several else np.zeros(1) for several in (len(count) > 1, count.max() > 1))
    # Each cell of the grid counts by its area, as levels are not even.
    area = np.outer(*(np.gradient(x) if len(x) > 1 else np.ones(1) for x in (between, within))).ravel()
    between, within = (part.ravel() for part in np.meshgrid(between, within, indexing="ij"))
    mean, variance, misfit = _of_units(value, std, unit, within)
    total = between**2 + variance
    precision = (1 / total).sum(0)
    centre = (mean / total).sum(0) / precision
    log = misfit - 0.5 * (np.log(total) + (mean - centre) ** 2 / total).sum(0) - 0.5 * np.log(precision)
    weight = area * np.exp(log - log.max())
    return _Posterior(between, within, weight / weight.sum(), centre, 1 / precision)


def _of_units(value: np.ndarray, std: np.ndarray, unit: np.ndarray, within: np.ndarray):
    """Weighted mean of each unit's campaigns (unit by cell), its variance, ln likelihood of the scatter about it.

    Campaigns of one unit stand together.
    """
    v = std[:, None] ** 2 + within**2
    first = np.flatnonzero(np.diff(unit, prepend=-1))
    precision = np.add.reduceat(1 / v, first)
    mean = np.add.reduceat(value[:, None] / v, first) / precision
    scatter = (value[:, None] - mean[unit]) ** 2 / v
    return mean, 1 / precision, -0.5 * (np.log(v) + scatter).sum(0) - 0.5 * np.log(precision).sum(0)


def _statistics(rows: _Rows) -> Parameter | None:
    if len(rows.value) < 2:
        return None
    # Sizes of one, so that no square overflows.
    scale = float(max(np.std(rows.value), np.median(rows.std)))
    shift = float(np.median(rows.value))
    value, std = (rows.value - shift) / scale, rows.std / scale
    p = _posterior(value, std, rows.unit)
    mean = float(p.weight @ p.mean)
    mean_std = float(np.sqrt(p.weight @ (p.variance + (p.mean - mean) ** 2)))
    pooled = {name: x * scale + shift * (name != "std") for name, x in _pooled(value, std, rows.unit, p).items()}
    return Parameter(
        rows.parameter, rows.axis, rows.unit_text, mean * scale + shift, mean_std * scale,
        spread_of(p.between * scale, p.weight) if len(rows.names) > 1 else UNKNOWN,
        spread_of(p.within * scale, p.weight) if len(rows.names) < len(value) else UNKNOWN,
        len(rows.names), len(value),
        tuple(_outliers(rows, value, std, scale, shift)), tuple(_drifts(rows)),
        {"row": rows.index, **pooled},
    )  # fmt: skip


def spread_of(levels: np.ndarray, weight: np.ndarray) -> Spread:
    """Median and 95 % interval of weighted levels."""
    order = np.argsort(levels)
    total = np.cumsum(weight[order])
    low, middle, high = (float(levels[order][np.searchsorted(total, q * total[-1])]) for q in (0.025, 0.5, 0.975))
    return Spread(middle, low, high)


def _pooled(value: np.ndarray, std: np.ndarray, unit: np.ndarray, p: _Posterior) -> dict[str, np.ndarray]:
    """θ_ij given all campaigns: mean, standard deviation and 95 % interval of a mixture of normals over the grid."""
    kept = p.weight > 1e-4 * p.weight.max()
    between, within, weight = p.between[kept] ** 2, p.within[kept], p.weight[kept] / p.weight[kept].sum()
    mean, variance, _ = _of_units(value, std, unit, within)
    # Of the unit given μ, then with that of μ.
    share = variance / (between + variance)
    own = share * p.mean[kept] + (1 - share) * mean
    spread = between * share + share**2 * p.variance[kept]
    # Of the campaign given its unit, then with that of the unit.
    share = std[:, None] ** 2 / (within**2 + std[:, None] ** 2)
    each = share * own[unit] + (1 - share) * value[:, None]
    scatter = np.sqrt(within**2 * share + share**2 * spread[unit])
    centre = each @ weight
    total = np.sqrt((scatter**2 + (each - centre[:, None]) ** 2) @ weight)
    low, high = (_quantile(q, each, scatter, weight, centre, total) for q in (0.025, 0.975))
    return {"value": centre, "std": total, "low": low, "high": high}


def _quantile(
    q: float, mean: np.ndarray, std: np.ndarray, weight: np.ndarray, centre: np.ndarray, total: np.ndarray
) -> np.ndarray:
    """Of mixtures of normals, by halving."""
    low, high = centre - 12 * total, centre + 12 * total
    std = np.maximum(std, 1e-12 * total[:, None])
    for _ in range(30):
        middle = 0.5 * (low + high)
        above = ndtr((middle[:, None] - mean) / std) @ weight > q
        low, high = np.where(above, low, middle), np.where(above, middle, high)
    return 0.5 * (low + high)


def _outliers(rows: _Rows, value: np.ndarray, std: np.ndarray, scale: float, shift: float) -> Iterator[Outlier]:
    """Units that the posterior of all others makes improbable."""
    units = len(rows.names)
    if units < FEWEST + 1:
        return
    whole = _posterior(value, std, rows.unit)
    means = _of_units(value, std, rows.unit, np.array([whole.weight @ whole.within]))[0][:, 0]
    far = np.abs(means - np.median(means)) > SUSPECT * MAD * stats.median_abs_deviation(means)
    for k in np.flatnonzero(far):
        others = rows.unit != k
        p = _posterior(value[others], std[others], np.unique(rows.unit[others], return_inverse=True)[1])
        own = ~others
        mean, variance, _ = _of_units(value[own], std[own], np.zeros(own.sum(), int), p.within)
        scatter = np.sqrt(p.between**2 + variance[0] + p.variance)
        # Two-sided chance of a value so far out, over the grid; that few units were there is in the grid's weights.
        chance = p.weight @ (2 * ndtr(-np.abs(mean[0] - p.mean) / scatter))
        if chance * units < FALSE_ALARM:
            expected = float(p.weight @ p.mean)
            total = float(np.sqrt(p.weight @ (p.between**2 + p.variance + (p.mean - expected) ** 2)))
            seen = float(p.weight @ mean[0])
            deviations = float(stats.norm.isf(chance / 2)) * np.sign(seen - expected)
            place = expected * scale + shift, total * scale, float(deviations)
            yield Outlier(rows.names[k], seen * scale + shift, *place)


def _drifts(rows: _Rows) -> Iterator[Drift]:
    """Units whose campaigns follow a line in time, against the scatter that they leave about it."""
    dated = bool(np.isfinite(rows.days).all())
    lines = []
    for k, name in enumerate(rows.names):
        own = np.flatnonzero(rows.unit == k)
        time = rows.days[own] if dated else np.arange(len(own), dtype=float)
        if len(own) >= FEWEST and np.ptp(time) > 0:
            lines.append((name, rows.value[own, None], rows.std[own, None] ** 2, time[:, None]))
    if not lines:
        return
    # κ is that of what all lines leave.
    levels = BEYOND * max(np.std(y - y.mean()) for _, y, _, _ in lines) * np.linspace(0.0, 1.0, LEVELS) ** 2
    log, slopes, errors = np.zeros(LEVELS), [], []
    for _, y, variance, time in lines:
        weight = 1 / (variance + levels**2)
        x = time - (weight * time).sum(0) / weight.sum(0)
        y = y - (weight * y).sum(0) / weight.sum(0)
        information = (weight * x**2).sum(0)
        slope = (weight * x * y).sum(0) / information
        misfit = (weight * (y - slope * x) ** 2).sum(0)
        log += 0.5 * (np.log(weight).sum(0) - np.log(weight.sum(0)) - np.log(information) - misfit)
        slopes.append(slope)
        errors.append(1 / np.sqrt(information))
    chance = np.gradient(levels) * np.exp(log - log.max())
    chance /= chance.sum()
    for (name, *_), slope, error in zip(lines, slopes, errors, strict=True):
        if chance @ (2 * ndtr(-np.abs(slope) / error)) * len(lines) < FALSE_ALARM:
            mean = float(chance @ slope)
            std = float(np.sqrt(chance @ (error**2 + (slope - mean) ** 2)))
            yield Drift(name, mean, std, "day" if dated else "campaign")
