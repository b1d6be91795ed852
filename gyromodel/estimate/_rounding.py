"""Fits of an output that is read in steps: what rounding adds on the average is taken away, and the rest is noise."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from gyromodel._model_units import check_reading
from gyromodel.campaign import Campaign
from gyromodel.effects.converter import Quantisation
from gyromodel.estimate._estimate import Estimate, EstimateError
from gyromodel.model import GyroModel, ModelError
from gyromodel.noise import NoiseRatios
from gyromodel.numerics.rounding import grid_step, noise_at, noise_before, rounded_variance, staircase
from gyromodel.signals import Record
from gyromodel.units import convertible, factor, internal_unit

# Noise (steps) that leaves next to nothing of the saw tooth of rounding; steps that an output must move over, as what
# is read within one is the same wherever the gyro is, and places (apart by the noise) that it must stand at.
SMEARED, FEWEST_STEPS, FEWEST_PLACES = 0.5, 4.0, 12
# Noise (steps) and places from which on what rounding adds is told well enough for nothing of it to be left.
SHARP, MANY_PLACES = 0.12, 40
OPEN = "the output comes in no steps: give quantisation a step, or leave it out"
# How well the places of what is read must agree for it to be on a grid; one is perfectly.
ON_GRID = 0.95
# Residuals (steps) of a wider range are of three levels or more.
TWO_LEVELS = 2.0
# Turns of fit and rounding, and the part of a standard deviation at which parameters are settled.
TURNS, SETTLED = 12, 0.05
# Steps that differ by less than this part are one.
SAME = 0.01
# Samples from which on an output shows its steps, and the part of a step by which fewer may lie beside them.
ENOUGH_ROWS, NEAR_GRID = 50, 0.1
# Least noise before rounding that is told, in steps: zero is none that could be stated.
LEAST_NOISE = 0.01
# Places closer than this many steps are one however little noise there is; least slope of the staircase that a
# parameter's error is told by; places that narrow it down like one that shows the edge of a step.
CLOSE, LEAST_SLOPE, PLACES = 0.02, 0.3, 3.0


class Unrounded(NamedTuple):
    """A record less what rounding adds to it on the average, and the last fit to it, at the noise it began with.

    `record` and `estimate` are as they were where rounding adds noise alone, or cannot be told.

    Attributes:
        changed: whether they are not.
        stuck: whether rounding cannot be told.
        saw_tooth: peak to peak, in the output's unit, of what rounding adds that may be left, as the output stands at
            few places or has next to no noise; zero where it stands at many.
    """

    record: Record
    estimate: Estimate
    changed: bool = False
    stuck: bool = False
    saw_tooth: float = 0.0


def unrounded(record: Record, estimate: Estimate, step: float, refit: Callable[[Record], Estimate]) -> Unrounded:
    """A fit beside the mean of rounding, from a fit that took all of rounding for noise.

    The mean of what is read of an output with noise is a staircase with rounded edges. Over outputs that lie anywhere
    within steps its slope is one, so that what it adds is taken away at the fitted output, in turns with the fit. Where
    the output stands at few places, or within a step or two, `stuck`: it is left as it is.

    Args:
        record: as it was read.
        estimate: the fit to it.
        step: of the readings, in the output's unit.
        refit: the same model's fit to other data.
    """
    first, step, present = estimate, float(step), np.asarray(record.sampling.present)
    output, offset = np.asarray(record.signals["output"]) / step, _offset(record, step)
    if offset is None:
        return Unrounded(record, first)
    added, last, plain = np.zeros_like(output), None, np.inf
    for turn in range(TURNS):
        at = np.where(present, np.asarray(estimate.model.predict(record.signals)) / step - offset, 0.0)
        variance = float(np.mean((output - offset - at - added)[present] ** 2))
        plain = variance if last is None else plain
        noise = noise_before(variance) if last is None else noise_at(at[present], variance)
        if noise > SMEARED:
            return Unrounded(record, first)
        places = len(np.unique(_places(at[present], noise)))
        if np.ptp(at[present]) < FEWEST_STEPS or places < FEWEST_PLACES:
            left = (output - offset - at)[present]
            return Unrounded(
                record, first, stuck=True, saw_tooth=step * saw_tooth(noise if np.ptp(left) > TWO_LEVELS else 0.0)
            )
        # Half of the way: where an edge is steep, the whole way there would be too far.
        added = staircase(at, noise) if last is None else 0.5 * (added + staircase(at, noise))
        corrected = record._replace(signals=record.signals | {"output": jnp.asarray((output - added) * step)})
        before = np.asarray(estimate.model.vector())
        try:
            last = refit(corrected)
        except EstimateError:
            return Unrounded(record, first)
        moved = np.abs(np.asarray(last.model.vector()) - before)
        estimate = last
        if turn and (moved <= SETTLED * last.std).all():
            break
    at = np.where(present, np.asarray(estimate.model.predict(record.signals)) / step - offset, 0.0)
    if np.mean((output - offset - at - added)[present] ** 2) >= plain:  # rounded otherwise than sample by sample
        return Unrounded(record, first)
    few = bool(noise < SHARP or places < MANY_PLACES)
    return Unrounded(corrected, estimate, changed=True, saw_tooth=step * saw_tooth(noise) if few else 0.0)


def fit_readings(
    record: Record, model: GyroModel, reading: Quantisation, ratios: NoiseRatios | None, fit: Callable[..., Estimate]
) -> Estimate:
    """As `fit_record`, of a model that reads its output in steps; `fit` fits one that does not."""
    step = step_of(model, record)
    step = step if step and _offset(record, step) is not None else 0.0
    record = record._replace(in_steps=step > 0.0)
    bare = as_read(model, record, step)
    estimate = fit(record, bare, ratios=ratios)

    def refit(data: Record) -> Estimate:
        return fit(data, estimate.model_as_given(), ratios=estimate.ratios)

    if step:
        found = unrounded(record, estimate, step, refit)
        if found.changed:
            estimate = fit(found.record, replace(found.estimate.model, noise=bare.noise), ratios=ratios)
        if found.changed or found.stuck:
            estimate = widened(record, estimate, step, found.stuck)
    return with_reading(estimate, reading, model, record)


def widened(record: Record, estimate: Estimate, step: float, stuck: bool) -> Estimate:
    """A fit beside rounding with the covariance that steps leave it, `record` being as it was read.

    Samples that stand at one place tell together where in its step that is, and nothing where they read the same.
    Where all are stuck, the error of rounding is the same for all, at its worst.
    """
    if not estimate.model.slots():
        return estimate
    present = np.asarray(record.sampling.present)
    predicted, jacobian = (np.asarray(part)[present] / step for part in estimate.model.linearise(record.signals))
    residual, read = (np.asarray(r.signals["output"])[present] / step for r in (estimate.record, record))
    residual = residual - predicted
    size = np.maximum(np.linalg.norm(jacobian, axis=0), np.finfo(float).tiny)
    jacobian = jacobian / size
    inverse = np.linalg.pinv(jacobian.T @ jacobian)
    plain = np.diag(inverse) * np.mean(residual**2)
    noise = max(noise_before(float(np.mean(residual**2))), LEAST_NOISE)
    # Variance of what rounding adds on the average, over places anywhere within steps. Two levels at a place may be
    # those on either side of an edge, and tell nothing of the noise.
    tooth = noise**2 + 1.0 / 12.0 - rounded_variance(noise)
    if stuck:
        tooth = tooth if np.ptp(residual) > TWO_LEVELS else 1.0 / 12.0
        wide = plain + np.sum(np.abs(inverse @ jacobian.T), axis=1) ** 2 * tooth
    else:
        at = predicted - (_offset(record, step) or 0.0)
        slope = 1.0 + (staircase(at + LEAST_NOISE, noise) - staircase(at - LEAST_NOISE, noise)) / (2.0 * LEAST_NOISE)
        bread = np.linalg.pinv(jacobian.T @ (np.maximum(slope, LEAST_SLOPE)[:, None] * jacobian))
        meat = jacobian * residual[:, None]
        _, place, count = np.unique(_places(at, noise), return_inverse=True, return_counts=True)
        together = np.stack([np.bincount(place, column) for column in jacobian.T], axis=1)
        spread = inverse @ (together.T @ together) @ inverse * tooth
        ends = [np.full(len(count), end) for end in (np.inf, -np.inf)]
        np.minimum.at(ends[0], place, read)
        np.maximum.at(ends[1], place, read)
        same = np.mean(ends[1] - ends[0] < 0.5)
        wide = np.maximum(plain, np.diag(bread @ (meat.T @ meat) @ bread))
        wide = wide + np.diag(spread) * min(1.0, PLACES / len(count)) * same**2
    own = np.diag(estimate.covariance) * size**2
    factor = np.sqrt(1.0 + np.maximum(wide - plain, 0.0) / own)
    return replace(estimate, covariance=estimate.covariance * np.outer(factor, factor))


def _offset(record: Record, step: float) -> float | None:
    """Where the grid lies on which an output was read, in steps from zero; None where it lies on none."""
    output = np.asarray(record.signals["output"])[np.asarray(record.sampling.present)] / step
    turns = np.exp(2j * np.pi * output).mean()
    return float(np.angle(turns)) / (2.0 * np.pi) if np.abs(turns) > ON_GRID else None


def saw_tooth(noise: float) -> float:
    """Peak to peak, in steps, of what rounding adds on the average."""
    return float(np.ptp(staircase(np.linspace(0.0, 1.0, 201), noise)))


def _places(at: np.ndarray, noise: float) -> np.ndarray:
    """Numbers of places in steps, alike where they are as close as the noise."""
    return np.round(at / max(noise, CLOSE))


def step_of(model: GyroModel, record: Record) -> float:
    """The step (output unit) in which a model reads a record's output; zero where it is an angle that is read.

    Raises:
        ModelError: it states none.
    """
    reading = model.reading
    if reading is None or (reading.unit and not convertible(reading.unit, record.output_unit)):
        return 0.0
    if not np.isfinite(float(reading.step)):
        raise ModelError(OPEN)
    return float(reading.step)


def with_step_of(model: GyroModel, campaigns: Sequence[Campaign]) -> GyroModel:
    """The model with the steps of the campaigns' output where it leaves them open.

    Raises:
        ModelError: they show none or different ones, or the model states them in a unit other than the output's.
    """
    reading, unit = model.reading, campaigns[0].units.get("output", "")
    if reading is None:
        return model
    if np.isfinite(float(reading.step)):
        if unit:
            check_reading(reading, unit)
        return model
    step, alike = common_step(campaigns) if all("output" in c.columns for c in campaigns) else (0.0, True)
    if not step:
        raise ModelError(OPEN)
    if not alike:
        raise ModelError("the campaigns are read in different steps: fit them apart, or leave quantisation out")
    return model.with_effect(replace(reading, step=jnp.asarray(step), unit=unit))


def common_step(campaigns: Sequence[Campaign]) -> tuple[float, bool]:
    """The coarsest step of the campaigns' outputs, internal unit (zero: none), and whether it is that of all.

    A few samples lie on the grid of the others, or not: what is between them is no step that they are read in.
    """
    many = [c for c in campaigns if len(c) >= ENOUGH_ROWS]
    few, many = ([c for c in campaigns if len(c) < ENOUGH_ROWS], many) if many else ([], list(campaigns))
    scales = [factor(c.units["output"], internal_unit(c.units["output"])) for c in many]
    steps = [float((grid_step(c.columns["output"]) or 0.0) * scale) for c, scale in zip(many, scales, strict=True)]
    step = max(steps)
    alike = min(steps) >= (1.0 - SAME) * step
    for campaign in few if step else []:
        output = campaign.si("output")
        output = output[np.isfinite(output)]
        places = (output - output[:1]) / step
        alike &= bool((np.abs(places - np.round(places)) < NEAR_GRID).all())
    return step, alike


def as_read(model: GyroModel, record: Record, step: float) -> GyroModel:
    """The model of what is read: without its reading, and rounding counted as noise where it states that."""
    if model.reading is None:
        return model
    model = model.without(model.reading.label)
    if "noise_white" not in model.noise or not step:
        return model
    unit = _unit(model, record, step)
    white = unit * np.sqrt(rounded_variance(float(model.noise["noise_white"]) / unit))
    return replace(model, noise={**model.noise, "noise_white": jnp.asarray(white)})


def with_reading(estimate: Estimate, reading: Quantisation, stated: GyroModel, record: Record) -> Estimate:
    """The fit with its model read in steps again; its noise is the one before rounding.

    Args:
        estimate: of a model without it.
        reading: the steps.
        stated: the model whose noise was stated, if it was, and which has the reading at its place, if it has.
        record: as it was read.
    """
    model = estimate.model
    place = stated.labels.index(reading.label) if reading.label in stated.labels else len(model.effects)
    effects = (*model.effects[:place], reading, *model.effects[place:])
    model = replace(model, effects=effects, noise=dict(stated.noise) if estimate.noise_given else model.noise)
    estimate = replace(estimate, model=model)
    if estimate.noise_given:
        return estimate
    step, means = step_of(model, record), "_step" in record.signals
    offset = _offset(record, step) if step and not means else 0.0
    if not step or offset is None:  # what is not read so has no noise before
        return estimate
    unit, present = _unit(model, record, step), np.asarray(record.sampling.present)
    variance = (float(model.noise["noise_white"]) / unit) ** 2
    at = np.asarray(model.predict(record.signals))[present] / step - offset
    before = unit * max(noise_before(variance) if means else noise_at(at, variance), LEAST_NOISE)
    model = replace(model, noise={**model.noise, "noise_white": jnp.asarray(before)})
    interval = dict(estimate.noise_interval)
    estimate = replace(estimate, model=model)
    if interval:
        interval["noise_white"] = white_before(estimate, interval["noise_white"])
    return replace(estimate, noise_interval=interval)


def white_before(estimate: Estimate, interval: tuple[float, float]) -> tuple[float, float]:
    """The interval of the white noise before the output is read in steps, of that as it is read (as input rates)."""
    step = step_of(estimate.model, estimate.record)
    if not step:
        return interval
    unit = _unit(estimate.model, estimate.record, step)
    gain, time = abs(float(estimate.model.gain())), estimate.record.interval
    # Of places anywhere within steps, in proportion to what those of the record tell.
    white = np.sqrt(estimate.white_variance * time) / gain
    low, own, high = (max(noise_before((v / unit) ** 2), LEAST_NOISE) for v in (interval[0], white, interval[1]))
    told = float(estimate.model.noise["noise_white"])
    if np.isclose(told, white, rtol=1e-9):  # it is not read so
        return interval
    return told * low / own, told * high / own


def _unit(model: GyroModel, record: Record, step: float) -> float:
    """White noise (as an input rate) of a step of a sample; records of means are of several samples each."""
    interval = float(record.signals["_step"][0]) if "_step" in record.signals else record.interval
    return step * np.sqrt(interval) / abs(float(model.gain()))
