"""Outputs that are read in steps: what rounding adds to them on the average, and the steps as a cause."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np

from gyromodel.campaign import Campaign
from gyromodel.diagnosis._noise_causes import as_cause
from gyromodel.diagnosis._result import Cause, ParameterValue
from gyromodel.effects.converter import Quantisation
from gyromodel.estimate import (
    Estimate,
    Unrounded,
    as_read,
    fit_record,
    step_of,
    unrounded,
    widened,
    with_step_of,
)
from gyromodel.estimate._rounding import SAME, SMEARED, common_step, saw_tooth
from gyromodel.model import GyroModel
from gyromodel.numerics.rounding import noise_before
from gyromodel.signals import Record
from gyromodel.units import from_internal

# Steps that an output of its inputs' grid moves over, and the part of one by which it then errs.
FEWEST, TRUE = 2.0, 0.05
# What each sample on a grid is worth (nats): as if it might have been written with one digit more.
WORTH = float(np.log(10.0))
# Differences of samples of this order hold noise and no motion; the sum of squares of their coefficients.
ORDER, SQUARES = 3, 20.0


@dataclass(frozen=True)
class Readings:
    """How a gyro's output is read.

    Attributes:
        step: of the grid that it lies on, internal unit, the coarsest of several; zero where it lies on none.
        scatter: from sample to sample, where means are searched or steps differ; zero else.
        unit: of the output in its file.
        untested: why steps are not searched; empty where they are.
    """

    step: float = 0.0
    scatter: float = 0.0
    unit: str = ""
    untested: str = ""

    def beside(self, record: Record, estimate: Estimate) -> Unrounded:
        """A fit's data less what rounding adds to them on the average, `record` being as it was read."""

        def refit(data: Record) -> Estimate:
            return fit_record(data, estimate.model_as_given(), ratios=estimate.ratios, solver="levenberg_marquardt")

        if not self.step or self.scatter or self.untested:
            return Unrounded(record, estimate, saw_tooth=self._left_in_means())
        return unrounded(_as_read(record, estimate), estimate, self.step, refit)

    def _left_in_means(self) -> float:
        """What rounding may leave in means of samples, or where campaigns have steps of their own, peak to peak."""
        if not (self.step and self.scatter):
            return 0.0
        noise = noise_before((self.scatter / self.step) ** 2)
        return self.step * saw_tooth(noise) if noise < SMEARED else 0.0

    def widened(self, record: Record, estimate: Estimate, found: Unrounded) -> Estimate:
        """The fit with the covariance that steps leave it."""
        if not (found.changed or found.stuck):
            return estimate
        return widened(_as_read(record, estimate), estimate, self.step, found.stuck)

    def told(self, found: Unrounded) -> str:
        """What was done about steps that are a cause, in a sentence."""
        step = f"steps of {float(from_internal(self.step, self.unit)):.5g} {self.unit}"
        if found.changed:
            return (
                f"The output is read in {step}: what rounding adds on the average was taken away for the search and "
                "its errors, and the rest counts as white noise."
            )
        if found.stuck:
            return (
                f"The output is read in {step}, and moves over too few for the noise to tell more: what is smaller "
                "than one may be rounding."
            )
        if found.saw_tooth:
            return f"The output is read in {step}, and its means may follow them: what is smaller may be rounding."
        return f"The output is read in {step}: rounding counts as white noise."

    def coarse_beside(self, record: Record, estimate: Estimate) -> bool:
        """Whether the steps are as large as what a fit leaves from sample to sample, or larger."""
        return self.step > 0.0 and not self.untested and bool(self.step >= self._scatter(record, estimate))

    def mirrors(self, record: Record, estimate: Estimate) -> bool:
        """Whether the grid is that of the inputs: an output that moves over steps and errs by next to none of one."""
        moved = np.ptp(np.asarray(estimate.model.predict(record.signals))[: record.rows][record.present])
        return bool(moved > FEWEST * self.step and self._scatter(record, estimate) < TRUE * self.step)

    def _scatter(self, record: Record, estimate: Estimate) -> float:
        """From sample to sample, of the output as it was read beside a fit: slow noise is none of it."""
        if self.scatter:
            return self.scatter
        data = _as_read(record, estimate)
        left = np.asarray(data.signals["output"] - estimate.model.predict(data.signals))[: data.rows]
        together = data.present[1:] & data.present[:-1] & (np.diff(data.run[: data.rows]) == 0)
        apart = np.diff(left)[together]
        return float(np.sqrt(np.mean(apart**2) / 2.0)) if len(apart) else float(np.sqrt(estimate.white_variance))

    def bare(
        self, model: GyroModel, campaigns: Sequence[Campaign], record: Record
    ) -> tuple[GyroModel, Quantisation | None]:
        """A model of what is read, and how the model reads it: in the data's steps where it leaves them open."""
        if model.reading is None:
            return model, None
        model = with_step_of(model, campaigns).prepared(record.signals)
        step = step_of(model, record) if self.same_as(model.reading) else 0.0
        return as_read(model, record, step), model.reading

    def least(self, record: Record, estimate: Estimate) -> float:
        """The smallest step that would be told, in the unit of the file."""
        return float(from_internal(self._scatter(record, estimate), self.unit))

    def same_as(self, reading: Quantisation | None) -> bool:
        """Whether a model's reading is this one."""
        return reading is not None and bool(abs(float(reading.step) - self.step) < SAME * self.step)

    def as_effect(self) -> Quantisation:
        """These steps in a model."""
        return Quantisation(step=jnp.asarray(self.step), unit=self.unit)

    def as_cause(self, samples: int) -> Cause:
        """These steps as what a simulation lacks, on so many samples."""
        step = ParameterValue("step", float(from_internal(self.step, self.unit)), 0.0, self.unit)
        return as_cause("quantisation", samples * WORTH, step)


def _as_read(record: Record, estimate: Estimate) -> Record:
    """The data of a fit with the output as it was read."""
    return estimate.record._replace(signals=estimate.record.signals | {"output": record.signals["output"]})


def readings_of(campaigns: Sequence[Campaign], searched: Sequence[Campaign]) -> Readings:
    """How the output of one gyro's campaigns is read, of which these or means of them are searched."""
    unit = campaigns[0].units["output"]
    if any(c.metadata["kind"] != "rate" for c in campaigns):
        return Readings(untested="the output is no rate: an angle that is rounded is noise_quantisation")
    step, alike = common_step(campaigns)
    means = any(len(s) < len(c) for c, s in zip(campaigns, searched, strict=True))
    scatter = max(map(_of_samples, campaigns)) if means or not alike else 0.0
    return Readings(step, scatter, unit, "" if alike else "campaigns are read in different steps")


def _of_samples(campaign: Campaign) -> float:
    """Scatter of an output from sample to sample, less motion: of what its high differences leave beside the rate's."""
    output = np.diff(campaign.si("output"), ORDER)
    rate = np.diff(campaign.si("rate"), ORDER) if "rate" in campaign.columns else np.zeros_like(output)
    known = np.isfinite(output) & np.isfinite(rate)
    output, rate = output[known], rate[known]
    slope = float(rate @ output) / max(float(rate @ rate), np.finfo(float).tiny)
    return float(np.sqrt(np.mean((output - slope * rate) ** 2) / SQUARES)) if known.any() else np.inf
