"""Bias effects of time, of a ring laser's beam monitors and of any other measured column."""

from __future__ import annotations

from typing import Self

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from gyromodel.effects._base import CATALOGUE, EVERY_GYRO, Effect, Signals, parameter, setting, stack


class Bias(Effect):
    """D += D_F: constant bias."""

    id = "bias"
    site = "rate"
    needs = ()
    cause = "The gyro reads a rate at rest."
    odds = EVERY_GYRO
    test = "Any covariate that stays constant looks the same: vary it."

    value: Float[Array, ""] = parameter("deg/h", 1.0, "output at rest, as a rate")

    def columns(self, signals: Signals) -> Float[Array, "sample coefficient"]:
        """Ones."""
        return stack(jnp.ones_like(signals["time"]))


class BiasDrift(Effect):
    """D += R t: bias drifting in proportion to time."""

    id = "bias_drift"
    site = "rate"
    needs = ("time",)
    cause = "Ageing, outgassing or slow relaxation."
    test = "Repeat the run: a drift returns with the same slope, a random walk does not."

    slope: Float[Array, ""] = parameter("deg/h/h", 0.1, "bias change per unit of time")

    def columns(self, signals: Signals) -> Float[Array, "sample coefficient"]:
        """Time since the start."""
        return stack(signals["time"])


class BiasStep(Effect):
    """D += Δ·1(t ≥ t_k): the bias jumps once.

    Of several campaigns it is `campaign` (counted from 1) in which it does; 0 stands for any.
    """

    id = "bias_step"
    site = "rate"
    needs = ("time",)
    cause = "A mode hop, a range switch or a mechanical shift."
    test = "Repeat the run and look for the same event in a monitor channel: a random walk leaves none."

    held = ("epoch",)
    scan = "step"
    size: Float[Array, ""] = parameter("deg/h", 1.0, "bias after minus before")
    epoch: Float[Array, ""] = parameter("s", 1.0, "when it happens, from the start", linear=False, default=0.0)
    campaign: int = eqx.field(static=True, default=0)

    def columns(self, signals: Signals) -> Float[Array, "sample coefficient"]:
        """One from the epoch on."""
        after = stack((signals["time"] >= self.epoch).astype(float))
        return after * _within(signals, (self.campaign,))

    @classmethod
    def candidates(cls, signals: Signals) -> list[Self]:
        """Scanned at every epoch by the search."""
        return []


class BiasPeriodic(Effect):
    """D += Σ A_j cos 2πf_j t + B_j sin 2πf_j t: lines at unknown frequencies.

    Of several campaigns `campaigns` says which each line is in (counted from 1), as every start has a phase of its own;
    0 is all of them, as are all lines where it is empty.
    """

    id = "bias_periodic"
    site = "rate"
    needs = ("time",)
    cause = "Aliased dither, mains pick-up, chamber cycling or table harmonics."
    test = "Change the sample rate: an alias moves; log the chamber's cycle: its line is coherent with temperature."

    supersedes = ("bias_periodic",)
    scan = "line"
    cosine: Float[Array, " line"] = parameter("deg/h", 1.0, "in-phase amplitude of each line", default=(0.0,))
    sine: Float[Array, " line"] = parameter("deg/h", 1.0, "quadrature amplitude of each line", default=(0.0,))
    frequency: Float[Array, " line"] = parameter("Hz", 0.01, "their frequencies", linear=False, default=(0.01,))
    campaigns: tuple[int, ...] = eqx.field(static=True, default=())

    def __check_init__(self) -> None:
        if not jnp.shape(self.cosine) == jnp.shape(self.sine) == jnp.shape(self.frequency):
            raise ValueError("every line needs a cosine, a sine and a frequency")
        if self.campaigns and len(self.campaigns) != jnp.size(self.frequency):
            raise ValueError("every line needs a campaign, or none")

    def columns(self, signals: Signals) -> Float[Array, "sample coefficient"]:
        """The cosines, then the sines."""
        phase = 2.0 * jnp.pi * signals["time"][:, None] * self.frequency
        kept = _kept(signals, self.frequency)
        waves = jnp.concatenate([kept * jnp.cos(phase), kept * jnp.sin(phase)], axis=1)
        return waves * _within(signals, self.campaigns * 2) if self.campaigns else waves

    def shape_derivatives(self, signals: Signals) -> Float[Array, "sample shape"]:
        """2πt (B cos 2πft − A sin 2πft), one a line: a jvp would compute every line for each.

        What means keep hardly changes within the resolution of a record.
        """
        turn = 2.0 * jnp.pi * signals["time"][:, None] * _kept(signals, self.frequency)
        phase = 2.0 * jnp.pi * signals["time"][:, None] * self.frequency
        moved = turn * (self.sine * jnp.cos(phase) - self.cosine * jnp.sin(phase))
        return moved * _within(signals, self.campaigns) if self.campaigns else moved

    @classmethod
    def candidates(cls, signals: Signals) -> list[Self]:
        """Scanned at every frequency by the search."""
        return []


def _kept(signals: Signals, frequency: Float[Array, " *line"]) -> Float[Array, "sample line"] | float:
    """What is left of a line in the mean of n samples, Δ apart: sin(πfnΔ)/(n sin(πfΔ)); all of it in samples."""
    if "_averaged" not in signals:
        return 1.0
    many, turn = signals["_averaged"][:, None], jnp.pi * frequency * signals["_step"][:, None]
    below = many * jnp.sin(turn)
    still = jnp.abs(below) < 1e-9
    return jnp.where(still, 1.0, jnp.sin(many * turn) / jnp.where(still, 1.0, below))


def _within(signals: Signals, campaigns: tuple[int, ...]) -> Float[Array, "sample campaign"]:
    """One where a sample is of a campaign, else zero; 0 is of any, and of one campaign alone all are of the first."""
    number, of = signals.get("campaign", jnp.ones_like(signals["time"])), jnp.array(campaigns)
    return ((number[:, None] == of) | (of == 0)).astype(float)


class BiasColumn(Effect):
    """D += D_X (X − X0): bias proportional to another measured column X; its id is bias_<column>.

    `unit` is what the coefficient was written in; empty, it follows the column.
    """

    id = "bias_column"
    site = "rate"
    needs = ()
    cause = "Supply, pressure, magnetic field or whatever the column measures leaks into the output."
    test = "Step that column alone, all others held."

    coefficient: Float[Array, ""] = parameter("deg/h", 1.0, "bias per unit of the column, in the column's unit")
    column: str = eqx.field(static=True, default="")
    unit: str = eqx.field(static=True, default="")
    reference: Float[Array, ""] = setting()

    @property
    def label(self) -> str:
        """bias_<column>; bias_column_<column> where that would be another effect's id."""
        plain = f"bias_{self.column}"
        taken = plain in CATALOGUE or self.column.startswith("column_")
        return f"bias_column_{self.column}" if taken else plain

    @property
    def columns_needed(self) -> tuple[str, ...]:
        """The driving column."""
        return (self.column,)

    def columns(self, signals: Signals) -> Float[Array, "sample coefficient"]:
        """X − X0."""
        return stack(signals[self.column] - self.reference)

    def prepared(self, signals: Signals) -> Self:
        """Refer to the column's mean."""
        if np.isfinite(float(self.reference)):
            return self
        return eqx.tree_at(lambda e: e.reference, self, jnp.nanmean(signals[self.column]))


class BiasBackscatter(BiasColumn):
    """D += D_B (B − B0): bias proportional to the light that the mirrors of a ring laser scatter back, as monitored.

    Far from rest coupled beams beat slower by ω_L²/2ω, with ω_L² proportional to the scattered power.
    """

    id = "bias_backscatter"
    needs = ("backscatter",)
    cause = "Light that the mirrors scatter back couples the two beams of a ring laser, and slows their beat."
    test = (
        "Step the path-length control from mode to mode at constant temperature: backscatter moves, the rest does not."
    )

    column: str = eqx.field(static=True, default="backscatter")

    @property
    def label(self) -> str:
        """The catalogue's id."""
        return self.id


class BiasNullShift(BiasColumn):
    """D += D_N (N − N0): bias proportional to a monitor of how unequal the two beams of a ring laser are."""

    id = "bias_null_shift"
    needs = ("null_shift",)
    cause = "Unequal discharge currents, losses or intensities of the two beams shift their frequencies apart at rest."
    test = "Unbalance the discharge currents on purpose, at constant temperature: a bias over temperature stays."

    column: str = eqx.field(static=True, default="null_shift")

    @property
    def label(self) -> str:
        """The catalogue's id."""
        return self.id
