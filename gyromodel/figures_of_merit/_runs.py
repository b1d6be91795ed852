"""Figures of merit of measured runs, each with a standard uncertainty, beside its modern counterpart."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, Self

import jax
import jax.numpy as jnp
import numpy as np
from scipy.stats import f as fisher

from gyromodel._checks import MISSING_STEP
from gyromodel._output_rate import rate_scale
from gyromodel.campaign import Campaign
from gyromodel.effects.drivers import Bias
from gyromodel.estimate import Estimate, EstimateError, filter_of, fit_record, with_noise_intervals
from gyromodel.figures_of_merit._published import (
    angle_random_walk,
    bias,
    bias_repeatability,
    bias_stability,
    bias_temperature_sensitivity,
    powers,
    random_walk_coefficients,
    stability_squares,
)
from gyromodel.model import GyroModel
from gyromodel.noise import deviation, with_gaps
from gyromodel.noise_analysis import AT_REST
from gyromodel.numerics.state_space import colour
from gyromodel.signals import Record, read_signals
from gyromodel.units import UnitError, factor, internal_unit

# A run counts as at one temperature, and runs as at the same one, within this (°C).
STEADY = 1.0
# Blocks that every averaging time leaves, and averaging times that three coefficients and a test of their fit need.
FEWEST_BLOCKS, FEWEST_TIMES = 20, 5
# Samples below which noise cannot be told white or not.
FEWEST_SAMPLES = FEWEST_BLOCKS * 2 ** (FEWEST_TIMES - 1)
# Significance at which a condition is broken, in standard deviations and as a probability; and how much of the variance
# may be other than white before it matters.
BROKEN, BROKEN_PROBABILITY, IMMATERIAL = 3.5, 1e-3, 0.05
# Draws of the fitted noise behind the uncertainty of Bs and RWC: their own scatter is 4 %. Fewer of very long runs.
DRAWS, FEWEST_DRAWS, MOST_DRAWN = 400, 64, 4_000_000
# The floor of the Allan deviation of flicker noise over its coefficient, √(2 ln 2/π).
FLICKER_FLOOR = 0.664


@dataclass(frozen=True)
class Figure:
    """One figure of merit in its unit; a published value whose conditions fail is NaN, and `refused` says why.

    `counterpart` says what the modern value is.
    """

    symbol: str
    run: str
    published: float
    published_std: float
    modern: float
    modern_std: float
    unit: str
    counterpart: str
    refused: str = ""


class FiguresOfMerit(NamedTuple):
    """All figures of one unit."""

    figures: tuple[Figure, ...]

    def table(self) -> str:
        """Published and modern values side by side, one figure a line."""
        head = ("figure", "run", "published", "modern", "unit", "modern value is")
        rows = [head, *((f.symbol, f.run, *_texts(f), f.unit, f.counterpart) for f in self.figures)]
        width = [max(len(row[i]) for row in rows) for i in range(len(head))]
        lines = ["  ".join(cell.ljust(w) for cell, w in zip(row, width, strict=True)).rstrip() for row in rows]
        refused = [f"{f.symbol} {f.run} refused: {f.refused}" for f in self.figures if f.refused]
        return "\n".join([*lines, *refused])


def figures_of_merit(
    campaigns: Campaign | Sequence[Campaign],
    *,
    scale_factor: str | None = None,
    room_temperature: float = 25.0,
    bandwidth: float | None = None,
) -> FiguresOfMerit:
    """Every figure of merit of runs at rest: B0, Bs, ARW and RWC of each run, Br and Bt of all.

    Standard uncertainties: B0 of the plain mean under the run's fitted noise (white, flicker, random walk from its
    start), not s/√n; Bs and ARW by χ² with the degrees of freedom that the fitted noise leaves; RWC from the covariance
    of Bs²(τ) at all τ together, on draws of the fitted noise; Br by χ² with Q − 1; Bt of the ratio it comes from, which
    as the largest of several leans upwards.

    Args:
        campaigns: runs of one unit, each at one temperature.
        scale_factor: nominal, with its unit, such as "0.09 bit/(deg/h)"; by default the metadata nominal_scale_factor;
            not needed where the output is an angular rate.
        room_temperature: Bt is relative to the runs nearest to it (°C).
        bandwidth: W of the angle random walk (Hz); 1/τ1 by default.

    Raises:
        EstimateError: no scale factor, or a run too short to fit at all.
    """
    runs = [campaigns] if isinstance(campaigns, Campaign) else list(campaigns)
    found = [_Run.of(run, str(i + 1), scale_factor) for i, run in enumerate(runs)]
    figures = [figure for run in found for figure in run.figures(bandwidth)]
    points = _points(found)
    return FiguresOfMerit((*figures, _repeatability(points), _sensitivity(points, room_temperature)))


@dataclass(frozen=True)
class _Run:
    """One run: its rate (rad/s), interval, both estimates of its bias, and what is wrong with it as a run at rest."""

    name: str
    rate: np.ndarray
    interval: float
    record: Record
    estimate: Estimate
    mean_std: float
    temperature: float
    unsteady: str
    gap: str

    @classmethod
    def of(cls, campaign: Campaign, name: str, scale_factor: str | None) -> Self:
        record, model = _as_rate(campaign, scale_factor), GyroModel((Bias(),))
        estimate = with_noise_intervals(fit_record(record, model))
        plain = fit_record(record, model, ratios=estimate.ratios, ordinary=True)
        rate = np.where(record.present, np.asarray(record.signals["output"])[: record.rows], np.nan)
        temperature, unsteady = np.nan, ""
        if "rate" in record.signals:
            turning = np.asarray(record.signals["rate"])[: record.rows][record.present]
            turned = np.rad2deg(np.ptp(turning))
            rate = rate - turning.mean()
            if not turned <= AT_REST:
                changed = f"changed by {turned:.3g} deg/s" if np.isfinite(turned) else "is not known"
                unsteady = f"the reference rate {changed} during the run; hold the gyro still"
        if "temperature" in record.signals:
            values = np.asarray(record.signals["temperature"])[: record.rows]
            temperature = float(np.nanmean(values)) if np.isfinite(values).any() else np.nan
            tenths = [part[np.isfinite(part)] for part in np.array_split(values, 10)]
            moved = float(np.ptp([part.mean() for part in tenths if len(part)] or [0.0]))
            if moved > STEADY and not unsteady:
                unsteady = f"the temperature moved by {moved:.1f} °C during the run; hold it within {STEADY:g} °C"
        # The first row of angles has no rate: only what is missing between the first and the last one is a gap.
        ends = np.flatnonzero(record.present)[[0, -1]]
        step = np.diff(np.asarray(record.signals["time"])[ends[0] : ends[1] + 1])
        missing = int((~record.present[ends[0] : ends[1]]).sum() + (step > MISSING_STEP * record.interval).sum())
        gap = f"the run has {missing} gaps or missing samples; use a stretch without" if missing else ""
        return cls(name, rate, record.interval, record, estimate, float(plain.std[0]), temperature, unsteady, gap)

    @property
    def bias(self) -> float:
        return bias(self.rate[np.isfinite(self.rate)])

    def figures(self, bandwidth: float | None) -> list[Figure]:
        """B0, Bs, ARW and RWC of the run."""
        rate = self.rate[np.isfinite(self.rate)]
        squares, lengths = self._squares()
        drawn = self._drawn(lengths)
        stability = bias_stability(rate)
        # s² has the mean and variance of χ² with ν degrees of freedom, u(s)/s = 1/√(2ν).
        relative = float(np.std(drawn[:, 0]) / np.mean(drawn[:, 0])) / 2.0
        gls = float(self.estimate.model.vector()[0])
        low, high = self.estimate.noise_interval["noise_white"]
        white, white_std = float(self.estimate.model.noise["noise_white"]), (high - low) / 3.92
        floor, floor_std, floor_name = self._floor()
        walk = angle_random_walk(rate, bandwidth or 1.0 / self.interval)
        coefficient, coefficient_std, reason = _random_walk(lengths * self.interval, squares, drawn)
        return [
            self._figure(
                "B0", self.bias, self.mean_std, gls, float(self.estimate.std[0]), "generalised least squares", ""
            ),
            self._figure("Bs", stability, stability * relative, floor, floor_std, floor_name, ""),
            self._figure(
                "ARW", walk, walk * relative, white, white_std, "N by likelihood", self.gap or self._coloured()
            ),
            self._figure("RWC", coefficient, coefficient_std, white, white_std, "N by likelihood", self.gap or reason),
        ]

    def _floor(self) -> tuple[float, float, str]:
        """Bias instability off the lowest Allan deviation, its standard uncertainty, and where it was read."""
        time = np.asarray(self.record.signals["time"])[: self.record.rows]
        allan = deviation(with_gaps(self.rate, time, self.interval), self.interval)
        if len(allan.tau) < 3:
            return np.nan, np.nan, "Allan floor: too few samples between gaps"
        at = int(np.argmin(allan.deviation))
        floor = float(allan.deviation[at]) / FLICKER_FLOOR
        # The local slope, on which those degrees of freedom rest, is poor at the end: at most one an averaging time.
        freedom = min(allan.degrees_of_freedom[at], len(self.rate) * self.interval / allan.tau[at])
        name = f"Allan floor at {allan.tau[at]:.3g} s / 0.664"
        name += "" if at < len(allan.tau) - 2 else ", not reached: upper limit"
        return floor, floor / float(np.sqrt(2.0 * freedom)), name

    def _figure(self, symbol: str, value: float, std: float, modern: float, modern_std: float, name: str, why: str):
        unit = "deg/sqrt(h)" if symbol in ("ARW", "RWC") else "deg/h"
        return _figure(symbol, self.name, (value, std, modern, modern_std), unit, name, self.unsteady or why)

    def _squares(self) -> tuple[np.ndarray, np.ndarray]:
        rate = self.rate[np.isfinite(self.rate)]
        lengths = 2 ** np.arange(max(int(np.log2(max(len(rate) / FEWEST_BLOCKS, 1))) + 1, 1))
        return stability_squares(rate, lengths), lengths

    def _drawn(self, lengths: np.ndarray) -> np.ndarray:
        """Bs²(τ) of draws of the fitted noise, missing samples left out."""
        rows = len(self.record.sampling.present)
        count = int(np.clip(MOST_DRAWN // rows, FEWEST_DRAWS, DRAWS))
        white = np.random.default_rng(0).standard_normal((count, rows))
        scale = np.sqrt(self.estimate.white_variance)
        noise = _colour_all(filter_of(self.record, self.estimate.ratios), jnp.asarray(white))
        return stability_squares(scale * np.asarray(noise)[:, : self.record.rows][:, self.record.present], lengths)

    def _coloured(self) -> str:
        """Why the noise is not white: its variance is not that of its successive differences (von Neumann's ratio)."""
        rate = self.rate[np.isfinite(self.rate)]
        n = len(rate)
        if n < FEWEST_SAMPLES:
            return f"{n} samples cannot show that the noise is white; take {FEWEST_SAMPLES}"
        excess = float(np.var(rate, ddof=1) / (0.5 * np.mean(np.diff(rate) ** 2)) - 1.0)
        if abs(excess) < max(BROKEN / np.sqrt(n), IMMATERIAL):
            return ""
        return f"the noise is not white: its variance is {1 + excess:.2f} times that of white noise with these steps"


_colour_all = jax.jit(jax.vmap(colour, (None, 0)))


def _as_rate(campaign: Campaign, scale_factor: str | None) -> Record:
    """The run's signals, its output divided by the nominal scale factor unless it is a rate already."""
    record = read_signals(campaign)
    if record.output_unit == "rad/s":
        return record
    text = scale_factor or campaign.metadata.get("nominal_scale_factor")
    example = f"0.09 {record.output_unit}/(deg/h)"
    said = f"{campaign.name}: the output is in [{record.output_unit}]: "
    if text is None:
        raise EstimateError(f"{said}state the nominal scale factor, such as {example}")
    try:
        scale = rate_scale(str(text), record.output_unit)
    except UnitError as error:
        raise EstimateError(f"{said}a scale factor of {text} does not give that, {example} would") from error
    output = record.signals["output"] / scale
    return record._replace(signals={**record.signals, "output": output}, output_unit="rad/s")


def _random_walk(times: np.ndarray, squares: np.ndarray, drawn: np.ndarray) -> tuple[float, float, str]:
    """RWC, its standard uncertainty, and why there is none: Bs²(τ) not of the form, or a1 not above zero."""
    if len(times) < FEWEST_TIMES:
        return np.nan, np.nan, f"fewer than {FEWEST_TIMES} averaging times; take {FEWEST_SAMPLES} samples"
    covariance = np.cov(drawn.T)
    a1 = float(random_walk_coefficients(times, squares)[1])
    row = np.linalg.pinv(powers(times))[1]
    a1_std = float(np.sqrt(row @ covariance @ row))
    # Hotelling's test of the fit: the covariance is known from a number of draws.
    root = np.linalg.cholesky(covariance)
    left = np.linalg.solve(root, squares)
    design = np.linalg.solve(root, powers(times))
    rest = left - design @ np.linalg.lstsq(design, left, rcond=None)[0]
    free, draws = len(times) - 3, len(drawn)
    p = float(fisher.sf(rest @ rest * (draws - free) / (free * (draws - 1)), free, draws - free))
    if p < BROKEN_PROBABILITY:
        return np.nan, np.nan, f"Bs²(τ) is not of the form a0 + a1/τ + a2/τ² (p = {p:.1g}); use the Allan deviation"
    if a1 < 2.0 * a1_std:
        return np.nan, np.nan, f"a1 is not above zero: {a1 / a1_std:.1f} standard uncertainties; take a longer run"
    return float(np.sqrt(a1)), a1_std / (2.0 * float(np.sqrt(a1))), ""


class _Point(NamedTuple):
    """The biases of the runs at one temperature and their standard uncertainties."""

    temperature: float
    biases: np.ndarray
    stds: np.ndarray


def _points(runs: list[_Run]) -> list[_Point]:
    """Steady runs by temperature, those without a thermometer left out; all together where no run has one."""
    steady = [r for r in runs if not r.unsteady]
    known = sorted((r for r in steady if np.isfinite(r.temperature)), key=lambda r: r.temperature)
    steady = known or steady
    groups: list[list[_Run]] = []
    for run in steady:
        if groups and not run.temperature - groups[-1][0].temperature > STEADY:
            groups[-1].append(run)
        else:
            groups.append([run])
    return [
        _Point(
            float(np.mean([r.temperature for r in g])), np.array([r.bias for r in g]), np.array([r.mean_std for r in g])
        )
        for g in groups
    ]


def _repeatability(points: list[_Point]) -> Figure:
    """Br of the temperature with the most runs, beside the part of it that the runs' own noise does not explain."""
    name = "scatter between runs beyond their noise"
    best = max(points, key=lambda p: len(p.biases), default=None)
    if best is None or len(best.biases) < 2:
        return _figure("Br", "all", (np.nan,) * 4, "deg/h", name, "needs two runs or more at one temperature")
    q, published = len(best.biases), bias_repeatability(best.biases)
    between = float(np.sqrt(max(published**2 - np.mean(best.stds**2), 0.0)))
    std = published / np.sqrt(2.0 * (q - 1))
    between_std = published * std / between if between > 0 else published
    return _figure("Br", f"{q} runs", (published, std, between, min(between_std, published)), "deg/h", name, "")


def _sensitivity(points: list[_Point], room_temperature: float) -> Figure:
    """Bt, beside the steeper side of two lines that meet at room temperature, by weighted least squares."""
    name = "steeper of two lines joined at room temperature"
    temperature = np.array([p.temperature for p in points])
    if len(points) < 2 or not np.isfinite(temperature).all():
        return _figure(
            "Bt", "all", (np.nan,) * 4, "deg/h/degC", name, f"needs runs that differ by more than {STEADY:g} °C"
        )
    biases = np.array([p.biases.mean() for p in points])
    variance = np.array([(p.stds**2).mean() / len(p.biases) for p in points])
    room = int(np.argmin(np.abs(temperature - room_temperature)))
    published, at = bias_temperature_sensitivity(biases, temperature, room)
    std = np.sqrt(variance[at] + variance[room]) / abs(temperature[at] - temperature[room])
    change = temperature - temperature[room]
    sides = [side for side in (np.minimum(change, 0.0), np.maximum(change, 0.0)) if side.any()]
    design = np.stack([np.ones(len(points)), *sides], axis=1) / np.sqrt(variance)[:, None]
    solution, misfit, _, _ = np.linalg.lstsq(design, biases / np.sqrt(variance), rcond=None)
    inflation = max(1.0, float(misfit[0]) / (len(points) - design.shape[1])) if misfit.size else 1.0
    stds = np.sqrt(np.diag(np.linalg.inv(design.T @ design)) * inflation)
    steepest = 1 + int(np.argmax(np.abs(solution[1:])))
    values = (published, std, abs(solution[steepest]), stds[steepest])
    return _figure("Bt", f"{len(points)} temperatures", values, "deg/h/degC", name, "")


def _figure(symbol: str, run: str, values: tuple[float, ...], unit: str, counterpart: str, refused: str) -> Figure:
    """A figure in its unit, from internal values."""
    scale = factor(internal_unit(unit), unit)
    published, std, modern, modern_std = (float(v) * scale for v in values)
    if refused:
        published = std = float("nan")
    return Figure(symbol, run, published, std, modern, modern_std, unit, counterpart, refused)


def _texts(figure: Figure) -> tuple[str, str]:
    """Both values with their uncertainties, to two digits of these."""
    published = "refused" if figure.refused else _rounded(figure.published, figure.published_std)
    return published, _rounded(figure.modern, figure.modern_std)


def _rounded(value: float, std: float) -> str:
    if not np.isfinite(value):
        return "–"
    digits = max(0, 1 - int(np.floor(np.log10(std)))) if np.isfinite(std) and std > 0 else 4
    return f"{value:.{digits}f} ± {std:.{digits}f}"
