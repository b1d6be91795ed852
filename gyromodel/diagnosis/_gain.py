"""Held-out error: blocks left out, predicted by a model fitted without them, selection repeated without each."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy import stats

from gyromodel.diagnosis._result import Gain
from gyromodel.estimate import Estimate, EstimateError, filter_of, fit_record, pad_columns, whiten_columns
from gyromodel.model import GyroModel
from gyromodel.signals import Record

# Ordinary weights replace the noise model's where they lower the held-out rms to less than this part.
ORDINARY_MARGIN = 0.9
# Blocks that are positions.
POSITIONS = "positions"
# The whole search is repeated for each fold: more would tell little more.
MOST_FOLDS = 10
# Of each run, where none can be left out whole.
PARTS = 5
# Times that a parameter's uncertainty grows without some rows where these alone tell it, and no number is left.
ALONE = 1e9


def with_predictable_blocks(record: Record, model: GyroModel) -> Record:
    """The record with blocks that can be left out: where every run has a bias of its own, parts of runs."""
    if "bias_turn_on" not in model.labels:
        return record
    number = np.unique(record.blocks, return_inverse=True)[1]
    blocks = PARTS * number
    for k in range(number.max() + 1):
        rows = np.flatnonzero(number == k)
        blocks[rows] += np.arange(len(rows)) * PARTS // len(rows)
    return record._replace(blocks=blocks, block_scheme=f"fifths of {record.block_scheme}")


def folds_of(record: Record) -> tuple[list[np.ndarray], str]:
    """Rows of each fold that has outputs, and what a fold is: a block, or several where there are more than ten.

    Blocks are dealt out at random, always alike, so that folds follow no order of the test.
    """
    present, scheme = record.present, record.block_scheme
    number = np.unique(record.blocks, return_inverse=True)[1]
    blocks = number.max() + 1
    if blocks > MOST_FOLDS:
        number = (np.random.default_rng(0).permutation(blocks) % MOST_FOLDS)[number]
        scheme = f"groups of {scheme}"
    scheme += " left out" + (", errors of their means" if record.block_scheme == POSITIONS else "")
    found = [np.flatnonzero((number == k) & present) for k in range(number.max() + 1)]
    return [rows for rows in found if len(rows)], scheme


def fit_without(record: Record, estimate: Estimate, rows: np.ndarray) -> Estimate:
    """A model fitted without some rows, in the same noise.

    Raises:
        EstimateError: it cannot be, or these rows alone tell a parameter.
    """
    train = fit_record(record.without(rows), estimate.model_as_given(), ratios=estimate.ratios)
    if train.std.shape == estimate.std.shape and (train.std > ALONE * estimate.std).any():
        raise EstimateError("the rows left out alone tell a parameter")
    return train


def held_out(record: Record, train: Estimate, rows: np.ndarray) -> tuple[np.ndarray, float]:
    """Errors of a fold (as a rate) by a model fitted without it, and its log score given the other folds.

    What a position tells is in its mean, so that of positions the error of each mean counts. The score allows for what
    the other folds leave open of the parameters: a block that alone tells a friction about its axis is then a wide
    prediction, and no failed one.
    """
    predicted, jacobian = (np.asarray(part) for part in train.model.linearise(record.signals))
    slope = np.asarray(train.model.slope(record.signals))
    residual = np.asarray(record.signals["output"]) - predicted
    columns = np.column_stack([jacobian, residual])
    with_fold = _log_density(record, columns, train)
    others = _log_density(record.without(rows), columns, train)
    errors = residual[rows] / slope[rows]
    if record.block_scheme == POSITIONS:
        number = np.unique(record.blocks[rows], return_inverse=True)[1]
        errors = np.bincount(number, errors) / np.bincount(number)
    return errors, with_fold - others


def _log_density(record: Record, columns: np.ndarray, estimate: Estimate) -> float:
    """ln ∫ p(output | θ) dθ but for a constant, of a Jacobian and a residual side by side, in the estimate's noise."""
    filter = filter_of(record, estimate.ratios)
    present = np.asarray(record.sampling.present)
    whitened = whiten_columns(filter, pad_columns(np.where(present[:, None], columns, 0.0)))
    w = np.asarray(whitened)[present, : columns.shape[1]]
    # Of the triangle that is left, the last entry is the rest that no parameters take up, the others their precision.
    *precision, rest = np.abs(np.diag(np.linalg.qr(w, mode="r")))
    variance = estimate.white_variance
    return float(
        -0.5 * rest**2 / variance
        - np.sum(np.log(precision))
        - 0.5 * filter.log_determinant
        - 0.5 * len(w) * np.log(2 * np.pi * variance)
    )


def ladder_error(record: Record, estimate: Estimate) -> tuple[float, float, bool]:
    """Held-out error of one model structure, refitted without each block.

    Returns:
        rms (rad/s), log score, and whether ordinary least squares left an rms smaller by a tenth or more; NaN where
        some block cannot be predicted, so that structures are compared on the same blocks.
    """
    errors: dict[bool, list[np.ndarray]] = {False: [], True: []}
    score = 0.0
    for rows in folds_of(record)[0]:
        try:
            train = fit_without(record, estimate, rows)
            # From the other solution it is a step or two.
            again = fit_record(train.record, train.model_as_given(), ratios=estimate.ratios, ordinary=True)
        except EstimateError:
            return np.nan, -np.inf, False
        for ordinary, fitted in ((False, train), (True, again)):
            error, log_score = held_out(record, fitted, rows)
            errors[ordinary].append(error)
            score += 0.0 if ordinary else log_score
    rms = {k: float(np.sqrt(np.mean(np.concatenate(v) ** 2))) for k, v in errors.items()}
    better = rms[True] < ORDINARY_MARGIN * rms[False]
    return rms[better], score, better


def nested_gain(
    record: Record,
    baseline: Estimate,
    select: Callable[[np.ndarray, Estimate], Estimate],
    unit: str,
    scale: float,
    ordinary: tuple[bool, bool],
    progress: Callable[[int, int], None] | None = None,
) -> Gain:
    """Gain on blocks that neither the parameters nor the selection saw; noise ratios are those of the whole record.

    Args:
        record: the data.
        baseline: the fitted simulation.
        select: repeats the whole selection on the record without some rows, from the simulation fitted there.
        unit: reporting unit of the errors.
        scale: reporting units per rad/s.
        ordinary: whether the model before and the one after are used with ordinary weights.
        progress: called with folds done and in all.
    """
    before, after, scores, sizes = [], [], [], []
    folds, scheme = folds_of(record)
    for k, rows in enumerate(folds):
        try:
            base = fit_without(record, baseline, rows)
            extended = select(rows, base)
            e0, s0 = _errors(record, base, rows, ordinary[0])
            e1, s1 = _errors(record, extended, rows, ordinary[1])
        except EstimateError:
            continue
        before.append(np.mean(e0**2))
        after.append(np.mean(e1**2))
        scores.append(s1 - s0)
        sizes.append(len(e0))
        if progress:
            progress(k + 1, len(folds))
    if lost := len(folds) - len(scores):
        scheme += f" ({lost} more could not be predicted)"
    return _summary(np.array(before), np.array(after), np.array(scores), np.array(sizes), scheme, unit, scale)


def _errors(record: Record, train: Estimate, rows: np.ndarray, ordinary: bool) -> tuple[np.ndarray, float]:
    errors, score = held_out(record, train, rows)
    if ordinary:
        again = fit_record(train.record, train.model_as_given(), ratios=train.ratios, ordinary=True)
        errors, _ = held_out(record, again, rows)
    return errors, score


def _summary(
    before: np.ndarray, after: np.ndarray, scores: np.ndarray, sizes: np.ndarray, scheme: str, unit: str, scale: float
) -> Gain:
    """The gain of folds: their mean squares before and after, gains in log score, and numbers of errors."""
    folds = len(scores)
    if folds < 2:
        return Gain(
            np.nan,
            np.nan,
            unit,
            1.0,
            (0.0, np.inf),
            "no two blocks can be left out and predicted",
            folds,
            0.0,
            (-np.inf, np.inf),
        )
    rms = tuple(float(np.sqrt(np.average(each, weights=sizes)) * scale) for each in (before, after))
    ratio = rms[0] / rms[1] if min(rms) > 0 else 1.0
    # Jackknife over blocks for the ratio, Student's t over blocks for the log score; few blocks may be alike by chance,
    # so neither is taken to be known better than white noise of that many errors leaves it.
    totals = np.stack([before, after]) * sizes
    others = totals.sum(axis=1, keepdims=True) - totals
    spread = np.inf  # Where one block holds all errors there are, as of outputs that hardly leave a step.
    if np.all(others > 0.0):
        logs = 0.5 * np.log(np.divide(*others))
        spread = np.sqrt((folds - 1) / folds * np.sum((logs - logs.mean()) ** 2))
    t, z = float(stats.t.ppf(0.975, folds - 1)), float(stats.norm.ppf(0.975))
    total, error = float(scores.sum()), float(np.sqrt(folds) * scores.std(ddof=1))
    beside = max(t * error, z * np.sqrt(2.0 * abs(total)))
    half = max(t * spread, z * np.sqrt(-np.expm1(-4.0 * abs(np.log(ratio))) / (2.0 * sizes.sum())))
    interval = (float(ratio * np.exp(-half)), float(ratio * np.exp(half)))
    return Gain(
        rms[0],
        rms[1],
        unit,
        ratio,
        interval,
        f"nested, one of {folds} {scheme}",
        folds,
        total,
        (total - beside, total + beside),
    )


def no_gain(record: Record, error: float, unit: str) -> Gain:
    """The gain of an unchanged model: its held-out error, twice."""
    folds, scheme = folds_of(record)
    return Gain(
        error,
        error,
        unit,
        1.0,
        (1.0, 1.0),
        f"one of {len(folds)} {scheme}",
        len(folds),
        0.0,
        (0.0, 0.0),
    )


def not_measured(unit: str) -> Gain:
    """The gain where no block was held out."""
    return Gain(np.nan, np.nan, unit, np.nan, (np.nan, np.nan), "not measured", 0, np.nan, (np.nan, np.nan))
