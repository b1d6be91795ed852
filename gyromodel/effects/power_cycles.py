"""Effects that differ from one power cycle to the next."""

from __future__ import annotations

import dataclasses
from typing import Self

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from gyromodel.effects._base import Effect, Signals, parameter

# More runs than this are a curve over the run number.
MOST_RUNS = 40


class BiasTurnOn(Effect):
    """D += D_k in power cycle k, 0 in the first: a bias of its own after every turn-on.

    Cycles are told by the column `run`, else by the campaigns that are read together; where several campaigns share the
    number of a run, their runs are counted on.
    """

    id = "bias_turn_on"
    site = "rate"
    needs = ("run",)
    cause = "Every turn-on leaves the source, the electronics or the mechanics at another working point."
    test = "Switch off and on again without moving or heating the gyro: ageing and temperature leave the bias as it is."
    held = ("runs",)
    untested = f"has no second run, or more than {MOST_RUNS}"

    offsets: Float[Array, " run"] = parameter("deg/h", 1.0, "bias of each later run less that of the first", default=())
    runs: Float[Array, " run"] = parameter("1", 1.0, "the numbers of these runs", linear=False, default=())

    def __check_init__(self) -> None:
        if self.offsets.shape != self.runs.shape:
            raise ValueError("every offset has the number of its run")

    def columns(self, signals: Signals) -> Float[Array, "sample coefficient"]:
        """One in each later run."""
        return (cycles(signals)[:, None] == self.runs).astype(float)

    def prepared(self, signals: Signals) -> Self:
        """Take the runs that the campaign has."""
        if self.runs.size:
            return self
        numbers = np.asarray(cycles(signals))
        later = np.unique(numbers[np.isfinite(numbers) & (numbers != numbers[0])])
        return dataclasses.replace(self, offsets=np.zeros(len(later)), runs=later)

    @classmethod
    def candidates(cls, signals: Signals) -> list[Self]:
        """All runs, where there are not too many."""
        effect = cls().prepared(signals)
        return [effect] if 0 < effect.runs.size < MOST_RUNS else []


def cycles(signals: Signals) -> Float[Array, " sample"]:
    """Number of the power cycle."""
    return signals["run"] if "run" in signals else signals.get("campaign", jnp.ones_like(signals["time"]))
