"""A campaign as a model would have measured it, with its noise."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from gyromodel._checks import CampaignError
from gyromodel._model_units import check_reading, check_units
from gyromodel._noise_level import with_stated_level
from gyromodel.campaign import Campaign
from gyromodel.effects.converter import Quantisation
from gyromodel.model import GyroModel, ModelError
from gyromodel.noise import TELEGRAPH_TIMES, NoiseRatios, check_stated, markov_sum, stated_ratios
from gyromodel.numerics.state_space import build_filter, colour
from gyromodel.signals import Record, read_signals
from gyromodel.units import from_internal


def simulate(model: GyroModel, campaign: Campaign, seed: int = 0) -> Campaign:
    """The campaign with its output replaced by the model's, with a draw of the noise that the model states, if any.

    Args:
        model: with the values of all effects.
        campaign: time, columns and the output's unit and kind; without an output, a rate in deg/s.
        seed: of the noise.

    Raises:
        CampaignError: it is no campaign of one gyro.
        ModelError: the model misses a value or a column, or a column that an effect needs one in some row, or what the
            model states of the noise is none.
    """
    if not campaign.outputs and any(name.startswith("gimbal_") for name in campaign.columns):
        raise CampaignError(f"{campaign.name}: is of a platform, and a model is simulated for a gyro")
    if not campaign.outputs:
        campaign = campaign.with_column("output", np.arange(len(campaign), dtype=float), "deg/s")
    elif "output" in campaign.columns:  # every row gets one, whatever was missing
        campaign = campaign.with_column("output", np.arange(len(campaign), dtype=float), campaign.units["output"])
    record = read_signals(campaign)
    reading = model.reading
    unset = [e.label for e in model.effects if not np.isfinite(np.asarray(e.linear())).all()]
    if reading is not None and not np.isfinite(float(reading.step)):
        unset.append(reading.label)
    if unset:
        raise ModelError(f"effect {unset[0]} has no value; fit the model or write one to simulate")
    check_units(model, record.output_unit, record.units)
    model = model.prepared(record.signals)
    _refuse_missing(model, record)
    output = np.asarray(model.predict(record.signals))[: record.rows]
    output = output + draw_noise(model, with_stated_level(record, model), np.random.default_rng(seed))
    kind = campaign.metadata.get("kind", "rate")
    if kind != "rate":
        step = np.diff(campaign.si("time"))
        output = output * np.concatenate([[np.median(step)], step])
        output = np.cumsum(output) if kind == "angle" else output
    unit = campaign.units["output"]
    output = from_internal(output, unit)
    if reading is not None:
        output = _read(output, reading, unit, str(kind))
    return campaign.with_column("output", output, unit)


def _refuse_missing(model: GyroModel, record: Record) -> None:
    """Refuse columns that an effect needs where a row misses its value."""
    for effect in model.effects:
        for name in sorted({*model.columns_needed(effect)} & {*record.signals}):
            rows = np.flatnonzero(~np.isfinite(np.asarray(record.signals[name])[: record.rows])) + 1
            if rows.size:
                some = ", ".join(map(str, rows[:5])) + "…" * (rows.size > 5)
                raise ModelError(f"effect {effect.label} needs column {name}, which is NaN in data rows {some}")


def _read(output: np.ndarray, reading: Quantisation, unit: str, kind: str) -> np.ndarray:
    """The output in whole steps; of increments what is left of one is counted in the next."""
    check_reading(reading, unit)
    step = float(from_internal(np.asarray(reading.step), unit))
    whole = np.round((np.cumsum(output) if kind == "increment" else output) / step) * step
    return np.diff(whole, prepend=0.0) if kind == "increment" else whole


def draw_noise(model: GyroModel, record: Record, rng: np.random.Generator) -> np.ndarray:
    """One draw of the model's noise in output units, through the same state-space form that whitens it."""
    if not model.noise:
        return np.zeros(record.rows)
    hopping = "noise_telegraph" in model.noise
    try:
        check_stated(model.noise)
        beside = {name: value for name, value in model.noise.items() if not name.startswith("noise_telegraph")}
        ratios = stated_ratios(beside, record.interval)
    except ValueError as problem:
        raise ModelError(str(problem)) from None
    variance = float(model.noise["noise_white"]) ** 2 / record.interval
    draws = jnp.asarray(rng.standard_normal(len(record.sampling.present)))
    sampling = record.sampling._replace(present=jnp.ones_like(record.sampling.present))
    longest = float(ratios.longest(record.span))
    noise = _realise(ratios, record.interval, longest, sampling, draws)
    rate = np.asarray(noise)[: record.rows] * np.sqrt(variance)
    if hopping:
        low, high = (float(model.noise[name]) for name in TELEGRAPH_TIMES)
        rate += _hops(record, float(model.noise["noise_telegraph"]), low, high, rng)
    return rate * abs(float(model.gain()))


def _hops(record: Record, size: float, low: float, high: float, rng: np.random.Generator) -> np.ndarray:
    """A bias that hops between two levels `size` apart, of mean zero, each held for an exponential time of its mean.

    Each run begins in either.
    """
    time, share = np.asarray(record.signals["time"])[: record.rows], high / (low + high)
    hops = np.empty(record.rows)
    for run in np.split(np.arange(record.rows), np.flatnonzero(np.diff(record.run[: record.rows])) + 1):
        upper, ends, values = bool(rng.random() < share), [time[run[0]]], []
        while ends[-1] <= time[run[-1]]:
            values.append(upper - share)
            ends.append(ends[-1] + rng.exponential(high if upper else low))
            upper = not upper
        hops[run] = np.array(values)[np.searchsorted(ends, time[run], side="right") - 1]
    return size * hops


@jax.jit
def _realise(ratios: NoiseRatios, interval, longest, sampling, draws):
    return colour(build_filter(markov_sum(ratios, interval, longest), sampling), draws)
