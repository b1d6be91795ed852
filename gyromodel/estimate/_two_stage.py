"""Two-stage fits: the uncertainty of what an earlier fit found, carried into a later one that held it fixed."""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp

from gyromodel.estimate._estimate import Estimate, EstimateError
from gyromodel.estimate._fit import filter_of
from gyromodel.estimate._optimistix import response_to_held
from gyromodel.model import GyroModel
from gyromodel.noise import NoiseRatios


def two_stage(first: Estimate, second: Estimate) -> Estimate:
    """The second fit with its covariance widened by that of the parameters it took from the first.

    Args:
        first: a fit of other data, independent of those of the second.
        second: a fit whose model holds some parameters of the first fixed, at the values found there.

    Returns:
        The second fit; its covariance is C₂ + J C₁ Jᵀ, J the derivative of its parameters by those held (implicit
        function theorem at the minimum), C₁ their covariance in the first fit.

    Raises:
        EstimateError: the second fit holds no parameter that the first one fitted.
    """
    of_first = [(first.model.labels[s.effect], s.field, s.index) for s in first.model.slots()]
    taken = {(label, field) for label, field, _ in of_first} & second.model.fixed
    others = frozenset((e.label, name) for e in second.model.effects for name in e.declared()) - taken
    held = GyroModel(second.model.effects, second.model.noise, others, second.model.gyro)
    of_held = [(held.labels[s.effect], s.field, s.index) for s in held.slots()]
    if not of_held:
        raise EstimateError("the second fit holds no parameter that the first one fitted: fix it in the second model")
    order = [of_first.index(slot) for slot in of_held]
    white = NoiseRatios(jnp.zeros(()), jnp.zeros(()))
    filter = filter_of(second.record, white if second.ordinary else second.ratios)
    response = response_to_held(second.model, held, second.record.signals, filter)
    carried = response @ first.covariance[order][:, order] @ response.T
    return replace(second, covariance=second.covariance + carried)
