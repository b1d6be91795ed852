"""A noise level that follows rate, temperature, its rate or time, as a model states it (`noise_heteroscedastic`)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import jax.numpy as jnp
import numpy as np

from gyromodel.model import GyroModel, Level, ModelError
from gyromodel.signals import Record

# The form of each column that a level follows.
FORMS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "rate": np.abs,
    "temperature": np.asarray,
    "temperature_rate": np.abs,
    "time": np.asarray,
}

# Values of a column at which two laws of its levels are joined.
JOINED = 201


def relative_variance(level: Level, values: np.ndarray) -> np.ndarray:
    """White variance at values of a level's column, over that halfway; beyond its ends as there.

    ln σ is linear from end to end.
    """
    share = np.clip((FORMS[level.driver](values) - level.low) / (level.high - level.low), 0.0, 1.0)
    return level.ratio ** (2.0 * share - 1.0)


def level_of(record: Record, model: GyroModel) -> np.ndarray:
    """The relative white variance of each sample that a model states; NaN where what it follows is missing."""
    level = model.level
    if level is None:
        return np.ones(len(record.sampling.present))
    if level.driver not in record.signals:
        return np.full(len(record.sampling.present), np.nan)
    return relative_variance(level, np.asarray(record.signals[level.driver]))


def with_stated_level(record: Record, model: GyroModel) -> Record:
    """The record with the relative white variance of each sample that the model states, if it states one.

    Raises:
        ModelError: a value of the column is missing where there is an output.
    """
    if model.level is None:
        return record
    if model.level.driver not in record.signals:
        raise ModelError(f"noise_heteroscedastic follows {model.level.driver}, which the campaign lacks")
    factor = level_of(record, model)
    if not np.isfinite(factor[: record.rows][record.present]).all():
        raise ModelError(
            f"noise_heteroscedastic follows {model.level.driver}, which lacks values where there is an output"
        )
    white = record.sampling.white * np.where(np.isfinite(factor), factor, 1.0)
    return record._replace(sampling=record.sampling._replace(white=jnp.asarray(white)))


def with_level(model: GyroModel, level: Level) -> tuple[GyroModel, float]:
    """A fitted model with a level found beside the one it may have already, and by what its white noise is multiplied.

    Of one column both are one law over the range that was found; of another only one can be stated, and that stays.
    """
    had = model.level
    if had is None:
        return replace(model, level=level), 1.0
    if had.driver != level.driver:
        return model, 1.0
    # The straight line through the sum of both; where the first ends within the range it is nearly one.
    at = np.linspace(level.low, level.high, JOINED)
    log = 0.5 * np.log(relative_variance(had, at) * relative_variance(level, at))
    slope, middle = np.polyfit(at - 0.5 * (level.low + level.high), log, 1)
    noise, more = dict(model.noise), float(np.exp(middle))
    if "noise_white" in noise:
        noise["noise_white"] = noise["noise_white"] * more
    ratio = float(np.exp(slope * (level.high - level.low)))
    return replace(model, level=level._replace(ratio=ratio), noise=noise), more
