"""A calibration applied: the input rate of each sample from the output, with its standard uncertainty.

The model predicts the output from the rate; here the equation is solved for the rate, sample by sample.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from scipy import stats

from gyromodel._checks import listed, thermometers
from gyromodel._model_units import check_domain, check_units
from gyromodel._noise_level import level_of
from gyromodel._output_rate import rate_output
from gyromodel.attitude import with_reference_rates
from gyromodel.averages import MEAN_OF_ATTITUDE, average
from gyromodel.campaign import Campaign
from gyromodel.effects import Signals
from gyromodel.effects.power_cycles import BiasTurnOn, cycles
from gyromodel.estimate import Calibration, check_covariates, step_of, validity_unit
from gyromodel.model import GyroModel, ModelError
from gyromodel.signals import Record, read_signals
from gyromodel.units import from_internal

# Newton's steps shrink quadratically: after one of this relative size the next would be lost in rounding.
TOLERANCE = 1e-9
# Newton needs 3 to 6 steps; next to a fold or a jump of the model, halving takes up to 60.
MOST_STEPS = 64
# A slope this small, of the gain, is level: the dead band of a lock-in, which has rates of equal output and is no fold.
LEVEL = 1e-3
# Rates between rest and the answer at which the output must rise, or the answer lies on another branch.
WAYPOINTS = 8
# A rate lies outside the calibration beyond this many of its standard uncertainties: of a million, none by chance.
SURELY = 6.0
# Ranges in files are rounded to ten digits.
ROUNDING = 1e-9
# A campaign with a reference rate is judged by so many parts of equal length.
PARTS = 10


def compensate(campaign: Campaign, calibration: Calibration) -> Campaign:
    """The campaign with its input rate estimated from the output and the covariates.

    Adds `rate_estimated` and its standard uncertainty `rate_estimated_std` (deg/s). The uncertainty holds the
    covariance of the fitted parameters and the white noise of one sample, as far as the calibration knows them
    (metadata `rate_estimated_std_holds`); not flicker and random walk, nor that of parameters held fixed. Both columns
    are NaN where the output is missing, or where the model gives it, or what is within two standard deviations of its
    noise, at no rate on the branch through rest. Such samples, those outside the calibrated ranges and what else a user
    must know are counted in the metadata `rate_estimated_note`. A column `rate` is not needed and not used. Rates about
    the other axes that the model needs and the campaign lacks are those of its attitude; where that is missing, so is
    the estimate.

    Args:
        campaign: one axis, with the covariates that the model needs.
        calibration: of `Estimate.calibration` or `read_calibration`; its reference points are used, not the campaign's.

    Raises:
        CampaignError: the campaign has several axes.
        ModelError: the model needs a column that the campaign lacks, is of other units, or an effect depends on the
            rates of other samples.
    """
    needed = {name for effect in calibration.model.effects for name in effect.columns_needed}
    turned = needed & {"rate_x", "rate_y", "rate_z"} - set(campaign.columns)
    rated = with_reference_rates(campaign)[0] if turned else campaign
    known = np.isin(campaign.columns["time"], rated.columns["time"])
    compensated, counts = apply_calibration(campaign, read_signals(rated), calibration, known)
    numbers = {*np.unique(campaign.columns.get("campaign", np.ones(1))).tolist()}
    return compensated.with_metadata(told(calibration, campaign, counts, numbers))


def apply_calibration(
    campaign: Campaign, record: Record, calibration: Calibration, known: np.ndarray | None = None
) -> tuple[Campaign, Counter[str]]:
    """The campaign with its rates estimated, and how many samples `told` has to tell of.

    Args:
        campaign: what gets the columns.
        record: its signals.
        calibration: as of `compensate`.
        known: which of its rows the record has; all of them without.
    """
    record = record._replace(signals=record.signals | {"rate": jnp.zeros_like(record.signals["time"])})
    check_domain(calibration.model, record.domain)
    # What the calibration leaves open, such as which thermometers, is the campaign's; what it states stays.
    model = calibration.model.prepared(record.signals)
    if late := next((e.label for e in model.effects if e.remembers and "rate" in e.columns_needed), None):
        raise ModelError(f"{late} depends on the rates around a sample, and one output tells one rate: leave it out")
    calibration = replace(calibration, model=model)
    check_covariates(record, model)
    check_units(model, record.output_unit, record.units)
    rate, variance = _estimate(calibration, record)
    counts = _counts(calibration, record, rate, np.sqrt(variance))
    for name, values in (("rate_estimated", rate), ("rate_estimated_std", np.sqrt(variance))):
        column = np.full(len(campaign), np.nan)
        column[slice(None) if known is None else known] = from_internal(values, "deg/s")
        campaign = campaign.with_column(name, column, "deg/s")
    return campaign, counts


class ErrorAgainstReference(NamedTuple):
    """Rms error of the estimated rate and of the output as it is, against a reference rate (deg/s).

    `worse` says that the estimate errs more: one-sided t-test, 5 %, of the mean squares over ten parts of the campaign.
    """

    compensated: float
    as_measured: float
    worse: bool


def reference_error(compensated: Campaign) -> ErrorAgainstReference | None:
    """What a calibration does on a campaign that knows its rate; None where that or the output as a rate is not known.

    Args:
        compensated: what `compensate` returned.
    """
    # A navigated attitude is made of the outputs, and holds the rates against themselves.
    rated = compensated if "navigated" in compensated.metadata else with_reference_rates(compensated)[0]
    compensated, _ = average(rated, len(rated), MEAN_OF_ATTITUDE * (rated is not compensated))
    errors = reference_errors(compensated)
    if errors is None or errors.shape[1] < 2 * PARTS:
        return None
    parts = np.array_split(errors, PARTS, axis=1)
    return judged(np.array([np.sum(part**2, axis=1) for part in parts]), np.array([part.shape[1] for part in parts]))


def reference_errors(compensated: Campaign) -> Float[np.ndarray, "estimate sample"] | None:
    """Errors (deg/s) of the estimated rate and of the output as it is, where both are known; None without a rate."""
    output, unit = rate_output(compensated)
    if "rate" not in compensated.columns or unit != "rad/s":
        return None
    rate = compensated.in_unit("rate", "deg/s")
    errors = np.array([compensated.in_unit("rate_estimated", "deg/s") - rate, from_internal(output, "deg/s") - rate])
    return errors[:, np.isfinite(errors).all(axis=0)]


def judged(sums: Float[np.ndarray, "part estimate"], counts: Int[np.ndarray, " part"]) -> ErrorAgainstReference:
    """The verdict on sums of squares of `reference_errors`, and how many there are in each part."""
    after, before = np.sqrt(sums.sum(axis=0) / counts.sum())
    excess = (sums[:, 0] - sums[:, 1]) / counts
    worse = np.mean(excess) > float(stats.t.ppf(0.95, PARTS - 1)) * np.std(excess, ddof=1) / np.sqrt(PARTS)
    return ErrorAgainstReference(float(after), float(before), bool(worse))


def _held(calibration: Calibration) -> list[str]:
    """What the standard uncertainty is made of."""
    fitted = calibration.covariance is not None
    return ["parameter covariance"] * fitted + ["white noise of one sample"] * bool(calibration.model.noise)


def _estimate(calibration: Calibration, record: Record) -> tuple[np.ndarray, np.ndarray]:
    """Rate and its variance, of real rows; the variance is NaN where neither covariance nor noise is known."""
    model, covariance = calibration.model, calibration.covariance
    needed = {name for effect in model.effects for name in effect.columns_needed}
    names = {"time", "time_on", "rate", "campaign", *needed, *(f"{name}_rate" for name in thermometers(needed))}
    signals = {name: values for name, values in record.signals.items() if name in names}
    output = jnp.where(record.sampling.present, record.signals["output"], jnp.nan)
    white = jnp.asarray(model.noise.get("noise_white", 0.0)) ** 2 / record.interval
    # Of an angle's and of an output's steps, which have one level.
    steps = 2.0 * (model.noise.get("noise_quantisation", 0.0) / record.interval) ** 2
    if model.noise:
        steps += (step_of(model, record) / model.gain()) ** 2 / 12.0
    spread = np.zeros((len(model.slots()),) * 2) if covariance is None else covariance
    # The whole record at once: effects may look at what came before.
    found = _solve(model, jnp.asarray(spread), jnp.full(output.shape, white + steps), signals, output)
    if model.level is not None:
        # A level that follows the rate follows that which was found. Where it is not known the rate is.
        rated = record._replace(signals={**record.signals, "rate": found[0]})
        level = level_of(rated if model.level.driver == "rate" else record, model)
        found = found[0], _solve(model, jnp.asarray(spread), white * level + steps, signals, output)[1]
    rate, variance = (np.asarray(values)[: record.rows] for values in found)
    return rate, variance if _held(calibration) else np.full_like(variance, np.nan)


def _counts(calibration: Calibration, record: Record, rate: np.ndarray, std: np.ndarray) -> Counter[str]:
    """Samples that `told` tells of: what has no rate, lies outside of a calibrated range, or is of another run."""
    present = record.present
    counts = Counter(present=int(present.sum()), lost=int((present & np.isnan(rate)).sum()))
    for name, (low, high) in calibration.validity.items():
        if name != "rate" and name not in record.signals:
            continue
        values = rate if name == "rate" else np.asarray(record.signals[name])[: record.rows]
        margin = SURELY * np.nan_to_num(std) if name == "rate" else ROUNDING * max(abs(low), abs(high))
        counts[name] += int((present & ((values < low - margin) | (values > high + margin))).sum())
    for i, effect in enumerate(calibration.model.effects):
        if isinstance(effect, BiasTurnOn):
            run = np.asarray(cycles(record.signals))[: record.rows]
            counts[f"run {i}"] += int((present & ~np.isin(run, np.asarray(effect.runs))).sum())
    return counts


def told(
    calibration: Calibration, campaign: Campaign, counts: Counter[str], numbers: set[float]
) -> dict[str, str | None]:
    """Metadata of a compensated campaign: what its uncertainty holds, and what a user must know, a sentence each.

    Args:
        calibration: that was applied.
        campaign: its columns.
        counts: see `_counts`.
        numbers: of the campaigns that the data are of.
    """
    model, notes, present = calibration.model, [], counts["present"]
    if lost := counts["lost"]:
        notes.append(
            f"{lost} of {present} samples have no estimated rate: on its branch through rest the model gives "
            "their output, or what two standard deviations of noise make of it, at no rate."
        )
    for name, (low, high) in calibration.validity.items():
        unit = validity_unit(name)
        limits = f"{from_internal(low, unit):.6g} to {from_internal(high, unit):.6g} {unit}"
        if name != "rate" and name not in campaign.columns:
            notes.append(f"There is no column {name} to hold against the calibrated range of {limits}.")
        elif outside := counts[name]:
            notes.append(f"{outside} of {present} samples lie outside the calibrated range of {name}, {limits}.")
    for i, effect in enumerate(model.effects):
        if other := counts[f"run {i}"]:
            known = ", ".join(f"{r:g}" for r in np.asarray(effect.runs))  # type: ignore[attr-defined]
            notes.append(
                f"{other} of {present} samples are of other runs than {known} and take the first run's bias: "
                "what turn-ons differ by is not in rate_estimated_std."
            )
    for effect in model.effects:
        of = {*getattr(effect, "campaigns", ()), getattr(effect, "campaign", 0)} - {0}
        if of - numbers:
            others = listed(sorted(map(str, of - numbers)))
            notes.append(
                f"{effect.label} was in campaign {others} of those that were fitted, and is not taken here: data of it "
                "need a column 'campaign []' that holds its number."
            )
    if timed := [e.label for e in model.effects if "time" in e.columns_needed]:
        notes.append(f"Time in {', '.join(dict.fromkeys(timed))} counts from the start of this campaign.")
    if calibration.covariance is None and model.slots():
        notes.append("The model was not fitted: rate_estimated_std leaves out the uncertainty of its parameters.")
    if not model.noise:
        notes.append("The model states no noise: rate_estimated_std leaves it out.")
    return {
        "rate_estimated_std_holds": ", ".join(_held(calibration)) or "nothing",
        "rate_estimated_note": " ".join(notes) or None,
    }


@eqx.filter_jit
def _solve(
    model: GyroModel,
    covariance: Float[Array, "parameter parameter"],
    white: Float[Array, " sample"],
    signals: Signals,
    output: Float[Array, " sample"],
) -> tuple[Float[Array, " sample"], Float[Array, " sample"]]:
    rate = invert(model, signals, output)
    signals = {**signals, "rate": rate}
    gain, (_, slope) = model.gain(), output_and_slope(model, signals)
    slope = jnp.where(slope / gain > LEVEL, slope, gain)
    # Implicit function theorem: ∂rate/∂parameter = −(∂output/∂parameter)/(∂output/∂rate).
    jacobian = model.linearise(signals)[1] / slope[:, None]
    # Where the output jumps or hardly follows the rate, no slope says how far noise reaches. Where that is beyond all
    # that the model gives, as at the limit of a saturated output, the rate may be any.
    noise = jnp.sqrt(white) * gain
    reach = (invert(model, signals, output + 2 * noise, rate) - invert(model, signals, output - 2 * noise, rate)) / 4
    rate = jnp.where(jnp.isfinite(reach), rate, jnp.nan)
    variance = jnp.sum((jacobian @ covariance) * jacobian, axis=1) + reach**2
    return rate, jnp.where(jnp.isfinite(rate), variance, jnp.nan)


def output_and_slope(model: GyroModel, signals: Signals) -> tuple[Float[Array, " sample"], Float[Array, " sample"]]:
    """The model's output, and its derivative by the rate of the same sample."""
    rate = signals["rate"]
    return jax.jvp(lambda r: model.predict({**signals, "rate": r}), (rate,), (jnp.ones_like(rate),))


class _Search(NamedTuple):
    """Rates under trial, the bracket around each answer, and whether its ends have the output below and above them."""

    rate: Array
    low: Array
    high: Array
    below: Array
    above: Array
    found: Array
    running: Array
    steps: Array


def invert(
    model: GyroModel, signals: Signals, output: Float[Array, " sample"], near: Float[Array, " sample"] | None = None
) -> Float[Array, " sample"]:
    """The rate (rad/s) at which the model gives an output, on the branch through rest.

    Newton's method, kept between the rates already known to lie below and above the answer. A rate at which the output
    falls lies beyond a fold, and becomes a wall. Where the output jumps over the measured value, the answer is the rate
    of the jump; where it is level and equal to it, any of those rates.

    Args:
        model: its output depends on the rate of the same sample only.
        signals: covariates in internal units; a `rate` is not used.
        output: internal unit; NaN where missing.
        near: where to begin; output/gain if not given.

    Returns:
        The rates; NaN where there is none.
    """
    gain = model.gain()
    target = output / gain

    def advance(s: _Search) -> _Search:
        value, slope = output_and_slope(model, {**signals, "rate": s.rate})
        excess, slope = value / gain - target, slope / gain
        rising, steep = slope > -LEVEL, slope > LEVEL
        short, wall = rising & (excess < 0), ~rising
        over = rising & ~short
        low = jnp.where(short | (wall & (s.rate <= 0)), s.rate, s.low)
        high = jnp.where(over | (wall & (s.rate > 0)), s.rate, s.high)
        below = jnp.where(low == s.low, s.below, short)
        above = jnp.where(high == s.high, s.above, over)
        # On level ground twice as far out each time.
        far = jnp.sign(excess) * jnp.maximum(jnp.abs(excess), jnp.abs(s.rate))
        newton = s.rate - jnp.where(steep, excess / slope, far)
        size = TOLERANCE * (jnp.abs(s.rate) + jnp.abs(target))
        # Level ground is far out soon, where a tolerance of the rate's would let any output pass for the level's.
        close = rising & (jnp.abs(newton - s.rate) <= size) & (steep | (jnp.abs(excess) <= TOLERANCE * jnp.abs(target)))
        shut = high - low <= size
        middle = jnp.where(jnp.isfinite(low) & jnp.isfinite(high), (low + high) / 2, s.rate / 2)
        inside = rising & (newton > low) & (newton < high)
        rate = jnp.where(close | inside, newton, middle)
        found = close | (shut & below & above)
        going = s.running & ~close & ~shut
        return _Search(
            jnp.where(s.running, rate, s.rate), low, high, below, above, jnp.where(s.running, found, s.found), going,
            s.steps + 1,
        )  # fmt: skip

    never = jnp.zeros(target.shape, bool)
    begin = target if near is None else near
    start = _Search(
        begin, jnp.full_like(target, -jnp.inf), jnp.full_like(target, jnp.inf), never, never, never,
        jnp.isfinite(target) & jnp.isfinite(begin), jnp.zeros((), int),
    )  # fmt: skip
    end = jax.lax.while_loop(lambda s: jnp.any(s.running) & (s.steps < MOST_STEPS), advance, start)

    def climb(k, rising):
        part = end.rate * k / (WAYPOINTS + 1)
        return rising & (output_and_slope(model, {**signals, "rate": part})[1] / gain > -LEVEL)

    return jnp.where(jax.lax.fori_loop(1, WAYPOINTS + 1, climb, end.found), end.rate, jnp.nan)
