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


def relative_variance(ratio: float, level: Level, values: np.ndarray) -> np.ndarray:
    """White variance at values of a level's column, over that halfway; beyond its ends as there.

    ln σ is linear from end to end, and `ratio` is σ at the one over σ at the other.
    """
    share = np.clip((FORMS[level.driver](values) - level.low) / (level.high - level.low), 0.0, 1.0)
    return ratio ** (2.0 * share - 1.0)


def with_stated_level(record: Record, model: GyroModel) -> Record:
    """The record with the relative white variance of each sample that the model states, if it states one.

    Raises:
        ModelError: a value of the column is missing where there is an output.
    """
    level, ratio = model.level, model.noise.get("noise_heteroscedastic")
    if level is None or ratio is None:
        return record
    if level.driver not in record.signals:
        raise ModelError(f"noise_heteroscedastic follows {level.driver}, which the campaign lacks")
    values = np.asarray(record.signals[level.driver])
    known = np.isfinite(values)
    if not known[: record.rows][record.present].all():
        raise ModelError(f"noise_heteroscedastic follows {level.driver}, which lacks values where there is an output")
    factor = np.where(known, relative_variance(float(ratio), level, np.where(known, values, level.low)), 1.0)
    return record._replace(sampling=record.sampling._replace(white=jnp.asarray(record.sampling.white * factor)))


def with_level(model: GyroModel, ratio: float, level: Level) -> GyroModel:
    """The model with a level that its noise follows, beside one of the same column that it states already.

    One of another column stays as it is, as one alone can be stated.
    """
    stated = model.level
    if stated is not None and stated.driver != level.driver:
        return model
    if stated is not None:
        steeper = float(model.noise["noise_heteroscedastic"]) ** ((level.high - level.low) / (stated.high - stated.low))
        ratio *= steeper
    return replace(model, noise={**model.noise, "noise_heteroscedastic": jnp.asarray(ratio)}, level=level)
