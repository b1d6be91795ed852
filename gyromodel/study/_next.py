"""What to measure next: what one more test, less noise or a better instrument leaves of an outcome's uncertainty."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from gyromodel._checks import NUMBERED
from gyromodel._model_units import check_units
from gyromodel._noise_level import with_stated_level
from gyromodel.averages import average
from gyromodel.campaign import Campaign
from gyromodel.diagnosis import added_tests
from gyromodel.effects import Effect
from gyromodel.estimate import as_read, check_covariates, filter_of, given_ratios, step_of, whiten_columns
from gyromodel.model import GyroModel, ModelError
from gyromodel.signals import OFF, read_signals, with_columns_known
from gyromodel.study._budget import Budget
from gyromodel.study._instruments import Instrument, output_by_column
from gyromodel.study._known import Known
from gyromodel.study._mission import LONGEST, with_known_output
from gyromodel.units import factor, internal_unit

# The campaign that others are held against, and what an improvement leaves of an error.
REPEATED, IMPROVED = "Repeat the run.", 0.5


class NextTest(NamedTuple):
    """One thing to do next.

    Args:
        sentence: what to do.
        kind: whether it is another test, or the same with less "noise" or a better "instrument".
        std: standard uncertainty of each outcome by its name after that, in its field unit, less the mission's noise.
    """

    sentence: str
    kind: str
    std: dict[str, float]


def information(
    model: GyroModel,
    campaign: Campaign,
    instruments: Mapping[str, Instrument] | None = None,
    noise: float = 1.0,
    rivals: Sequence[Effect] = (),
    *,
    shared: bool = False,
) -> Float[np.ndarray, "parameter parameter"]:
    """Jᵀ V⁻¹ J of a planned campaign: what it says of the model's free parameters, internal units.

    V is the model's noise and the instruments' errors; the independent ones add to the white noise of each sample.

    Args:
        model: with its values and its noise.
        campaign: the output is not used.
        instruments: errors of columns.
        noise: times the model's noise.
        rivals: effects whose linear coefficients follow on the model's parameters, were they added.
        shared: whether the instruments' errors of a whole campaign, in standard errors, are further parameters, as
            where they are those of other campaigns too: see `without_shared`.

    Raises:
        ModelError: the model states no noise, or needs a column that is not there.
    """
    if not model.noise:
        raise ModelError("what a test can tell depends on the noise: state noise_white and the rest in the model")
    averaged, together = average(with_known_output(campaign), LONGEST)
    record = with_stated_level(with_columns_known(read_signals(averaged))[0], model)
    model = model.prepared(record.signals)
    check_covariates(record, model)
    check_units(model, record.output_unit, record.units)
    model = as_read(model, record, step_of(model, record))
    ratios = given_ratios(record, model)
    assert ratios is not None
    std = noise * float(model.noise["noise_white"]) / np.sqrt(record.interval) * abs(float(model.gain()))
    signals = record.signals
    white, common = np.array(record.sampling.white), []
    for name, instrument in (instruments or {}).items():
        if name in signals:
            change = output_by_column(model, signals, name) / std
            values = np.asarray(signals[name])
            common += [change * error for error in instrument.all_along(values)]
            white += (change * instrument.of_each(values)) ** 2 / together
    record = record._replace(sampling=record.sampling._replace(white=jnp.asarray(white)))
    added = list(map(model.columns_at(signals), rivals))
    jacobian = np.column_stack([np.asarray(model.linearise(signals)[1]), *added]) / std
    columns = np.column_stack([jacobian, *common])
    padded = jnp.asarray(np.pad(columns, ((0, 0), (0, -columns.shape[1] % 16))))
    whitened = np.asarray(whiten_columns(filter_of(record, ratios), padded))[record.present.nonzero()[0]]
    if not np.isfinite(whitened).all():
        raise ModelError(f"the model has no finite derivative by its parameters on {campaign.name}")
    j, c = np.split(whitened[:, : columns.shape[1]], [jacobian.shape[1]], axis=1)
    if not shared:
        # As `without_shared`, by orthogonal steps: little may be left of much.
        prior = np.eye(len(common), len(common) + j.shape[1])
        left = np.asarray(np.linalg.qr(np.concatenate([np.column_stack([c, j]), prior]), mode="r"))[len(common) :]
        return left[:, len(common) :].T @ left[:, len(common) :]
    seen = np.column_stack([j, c])
    return seen.T @ seen


def without_shared(told: np.ndarray, count: int) -> np.ndarray:
    """Information, or a stack of it, less its last so many parameters, of each of which a standard error of 1 is known.

    Information adds up before these are left out, where they are the same in all of it.
    """
    if not count:
        return told
    cross, own = told[..., -count:, :-count], told[..., -count:, -count:] + np.eye(count)
    return told[..., :-count, :-count] - np.swapaxes(cross, -1, -2) @ np.linalg.solve(own, cross)


def covariance_after(
    errors: Float[np.ndarray, "parameter error"], told: Float[np.ndarray, "parameter parameter"]
) -> Float[np.ndarray, "parameter parameter"]:
    """(Σ⁻¹ + M)⁻¹ of Σ = A Aᵀ, as A (1 + Aᵀ M A)⁻¹ Aᵀ: a singular Σ is no harm.

    Args:
        errors: A.
        told: information M of the new data.
    """
    # By eigenvalues: beside what new data tell of a vague prior, the 1 may be lost in rounding.
    values, vectors = np.linalg.eigh(errors.T @ told @ errors)
    turned = errors @ vectors
    return (turned / (1.0 + np.maximum(values, 0.0))) @ turned.T


def outcome_std(budget: Budget, covariance: Float[np.ndarray, "parameter parameter"]) -> float:
    """Standard uncertainty of an outcome under another covariance of the parameters, in its field unit."""
    variances = np.einsum("ij,jk,ik->i", budget.jacobian, covariance, budget.jacobian)
    return float(np.sqrt(np.maximum(variances, 0.0).mean())) * factor(internal_unit(budget.unit), budget.unit)


def blocks(parts: Sequence[np.ndarray]) -> np.ndarray:
    """Matrices along a diagonal."""
    size = sum(len(part) for part in parts)
    matrix, start = np.zeros((size, size)), 0
    for part in parts:
        matrix[start : start + len(part), start : start + len(part)] = part
        start += len(part)
    return matrix


def slower(campaign: Campaign) -> Campaign:
    """Everything a campaign does at half the speed: soaks and ramps twice as long, gaps as they are."""
    time = campaign.columns["time"]
    steps = np.diff(time)
    usual = float(np.median(steps)) if len(steps) else 1.0
    gap = steps > OFF * usual
    # Each row, and one half-way to the next or, before a gap, the same again.
    steps = np.column_stack([np.where(gap, usual, steps), steps]).ravel()
    rows = np.arange(2 * len(campaign))
    at = rows / 2.0 - 0.5 * np.append(np.column_stack([np.zeros_like(gap), gap]).ravel(), [0, 0])
    columns = {name: values[rows // 2] for name, values in campaign.columns.items()}
    for name in campaign.covariates:
        if name not in NUMBERED:
            columns[name] = np.interp(at, np.arange(len(campaign)), campaign.columns[name])
    columns["time"] = time[0] + np.cumsum([0.0, *steps, usual])
    return Campaign(columns, campaign.units, campaign.metadata, campaign.name)


def next_tests(
    known: Known,
    pairs: Sequence[tuple[Known, Budget]],
    design: Campaign,
    instruments: Mapping[str, Instrument],
) -> tuple[NextTest, ...]:
    """What each further test would leave of some outcomes' uncertainties; the one that helps the first most leads.

    Each follows the calibration and has its parameters; a test that lacks a column for the model is left out.

    Args:
        known: the calibrated gyros.
        pairs: budgets, each with the gyros that it is of.
        design: the campaign that tests are variants of.
        instruments: errors of its columns.
    """
    design = with_known_output(design)
    tried: list[tuple[str, str, Campaign, Mapping[str, Instrument], float]] = [
        (test.sentence, "test", test.campaign, instruments, 1.0) for test in added_tests(design)
    ]
    tried.append(
        ("Do everything at half the speed: soaks and ramps twice as long.", "test", slower(design), instruments, 1.0)
    )
    tried.append(("Repeat the run with half the noise.", "noise", design, instruments, IMPROVED))
    for name, instrument in instruments.items():
        what = "reference rate" if name == "rate" else name
        better = {**instruments, name: instrument.improved(IMPROVED)}
        tried.append((f"Repeat the run with half the error of the {what}.", "instrument", design, better, 1.0))
    found, problem = [], None
    for sentence, kind, campaign, errors, noise in tried:
        try:
            told = [information(model, campaign, errors, noise) for model in known.models]
        except ModelError as error:
            problem = error
            continue
        std = {}
        for gyros, budget in pairs:
            each = told * (len(gyros.models) // len(told))
            std[budget.outcome] = outcome_std(budget, covariance_after(gyros.factor, blocks(each)))
        found.append(NextTest(sentence, kind, std))
    if not found and problem is not None:
        raise problem
    leading = pairs[0][1].outcome
    return tuple(sorted(found, key=lambda test: test.std[leading]))
