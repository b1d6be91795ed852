"""A candidate that the search has chosen, as what is added to the model: its best form at the sizes that fit best."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from gyromodel.diagnosis._evidence import log_evidence_ratio
from gyromodel.diagnosis._lines import RESOLVED, Line, lines_of
from gyromodel.diagnosis._ranking import Ranking, is_noise
from gyromodel.diagnosis._scan import Scanner
from gyromodel.diagnosis._tangents import Tangent
from gyromodel.effects import Effect
from gyromodel.effects.converter import BiasReadoutCode
from gyromodel.effects.drivers import BiasPeriodic, BiasStep
from gyromodel.estimate import Estimate
from gyromodel.model import GyroModel
from gyromodel.signals import Record

# More lines than this in each run are a spectrum that nobody explains by naming each.
MAXIMUM_LINES = 6
# A further line found in the same pass must exceed the leakage of stronger ones this many times.
ABOVE_LEAKAGE = 4.0
# … and have this evidence (nats) by itself, the search over frequencies paid for.
LINE_MARGIN = 8.0
# Harmonics of twice a ramp, the evidence (nats) of a higher one by itself with the search paid for, and by how many
# steps of the record's resolution it may not be off: of 33 shares of that, the middle ones.
HARMONICS, HARMONIC_MARGIN, DETUNED, MIDDLE = 256, 4.0, 2.0, range(13, 20)
# A wave is one where its cosine and sine enclose this part of what those of others do.
LEAST_DISTINCT = 1e-9
# A fit with a gain smaller than this part of the simulation's is none.
LEAST_GAIN = 0.01
# Part of the samples that may be given up because an effect does not know what was before them.
MOST_UNKNOWN = 0.25


def addition(
    scanner: Scanner,
    estimate: Estimate,
    ranking: Ranking,
    name: str,
    pulses: tuple[int, ...],
    other: int | None = None,
) -> tuple[Effect | None, tuple[int, ...]]:
    """A named candidate as an effect at its best form, or another, and the rows given up with it.

    Rows alone for gross errors; neither for noise that is not stated.
    """
    if is_noise(name):
        return None, ()
    form = ranking.best_form(name)[0] if other is None else other
    if name == "outliers":
        rows = form if isinstance(form, tuple) else (form,)
        return None, tuple(int(r) for r in rows)
    assert isinstance(form, int)
    if name in ranking.tangents:
        return _grown(scanner, estimate, ranking.tangents[name], ranking.best_cell(name), pulses), ()
    fixed = [e for e in estimate.model.effects if e.label == name in estimate.model.wholly_fixed() and not e.scan]
    effect = fixed[0] if fixed else form_effect(scanner, name, form)
    assert effect is not None
    if isinstance(effect, BiasReadoutCode):
        effect = _with_harmonics(scanner, estimate, effect, ranking.best_cell(name), pulses)
    if isinstance(effect, BiasPeriodic):
        effect = periodic([*lines_of(estimate.model), *_lines(scanner, ranking, estimate.model)])
    for held in estimate.model.effects:
        effect = effect.joined(held) if held.label in effect.supersedes and held not in fixed else effect
    apart = tuple({*pulses, *not_known(scanner, effect)})
    effect = _solved(scanner, estimate, effect, ranking.best_cell(name), apart).settled()
    return effect, not_known(scanner, effect)


def not_known(scanner: Scanner, effect: Effect) -> tuple[int, ...]:
    """The rows to be given up because an effect does not know what was before them, if they are few enough."""
    rows = np.flatnonzero(scanner.present & np.asarray(effect.unknown(scanner.record.signals)))
    return tuple(map(int, rows)) if len(rows) < MOST_UNKNOWN * scanner.present.sum() else ()


def _with_harmonics(
    scanner: Scanner, estimate: Estimate, effect: BiasReadoutCode, g: int, pulses: tuple[int, ...]
) -> BiasReadoutCode:
    """The error of a code with the higher harmonics that stand out, each of which is a line where the rate is constant.

    One that a slightly other frequency would explain better is a line of its own.
    """
    signals = scanner.record.signals
    time, ramp = np.asarray(signals["time"]), np.asarray(signals["feedback_ramp"])
    numbers = effect.harmonics or range(1, 1 + effect.cosine.size)
    # All of them in one series, where the form found is a part of it.
    parts = 2.0 * np.ptp(ramp[scanner.present]) / float(effect.period)
    whole = round(parts) if np.isclose(parts, round(parts)) else 1
    series = replace(effect, period=effect.period * whole)
    numbers = [whole * k for k in numbers]
    waves = series.with_harmonics(range(1, 1 + HARMONICS)).columns(signals)
    w = _whitened(scanner, estimate.model, waves, g, pulses)
    own, pairs, rest = np.split(w, [w.shape[1] - 1 - 2 * HARMONICS, w.shape[1] - 1], axis=1)
    phasors = np.asarray(waves[:, :HARMONICS] + 1j * waves[:, HARMONICS:])
    turns = 2.0 * np.pi * np.linspace(-DETUNED, DETUNED, 33) / np.ptp(time[scanner.present])
    held, further = list(numbers), [k for k in range(1, 1 + HARMONICS) if k not in numbers]
    known = [*(k - 1 for k in held), *(HARMONICS + k - 1 for k in held)]
    taken = np.linalg.qr(np.column_stack([own, pairs[:, known]]))[0]
    pairs, left = _without(taken, pairs), _without(taken, rest[:, 0])
    while further:
        which = np.array(further) - 1
        explained = _explained(pairs[:, which], pairs[:, HARMONICS + which], left)
        best = int(explained.argmax())
        freedom = scanner.degrees_of_freedom - taken.shape[1]
        evidence = log_evidence_ratio(explained, float(np.sum(left**2)), freedom, 2)[best]
        if evidence < np.log(len(further)) + HARMONIC_MARGIN:
            break
        k = further.pop(best)
        near = phasors[:, [k - 1]] * np.exp(1j * np.outer(time, turns))
        cosines, sines = (_without(taken, scanner.cells.whiten(g, part)) for part in (np.real(near), np.imag(near)))
        if _explained(cosines, sines, left).argmax() in MIDDLE:
            held.append(k)
            pair = np.linalg.qr(pairs[:, [k - 1, HARMONICS + k - 1]])[0]
            pairs, left = _without(pair, pairs), _without(pair, left)
            taken = np.column_stack([taken, pair])
    if len(held) == len(numbers):
        return effect
    common = math.gcd(*held)
    return replace(series, period=series.period / common).with_harmonics(sorted(k // common for k in held))


def _without(taken: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """What orthonormal columns leave of others."""
    return columns - taken @ (taken.T @ columns)


def _explained(cosines: np.ndarray, sines: np.ndarray, left: np.ndarray) -> np.ndarray:
    """What each wave explains of what is left: nothing where its cosine and sine are all but one column."""
    cc, ss, cs = np.sum(cosines**2, axis=0), np.sum(sines**2, axis=0), np.sum(cosines * sines, axis=0)
    c, s = cosines.T @ left, sines.T @ left
    own = cc * ss - cs**2
    distinct = own > LEAST_DISTINCT * np.max(cc * ss)
    return np.where(distinct, (ss * c**2 - 2.0 * cs * c * s + cc * s**2) / np.where(distinct, own, 1.0), 0.0)


def periodic(lines: Sequence[Line]) -> BiasPeriodic:
    """Lines of no size."""
    frequencies, campaigns = zip(*sorted(lines, key=lambda line: line.campaign), strict=True)
    none = jnp.zeros(len(lines))
    return BiasPeriodic(
        cosine=none, sine=none, frequency=jnp.asarray(frequencies), campaigns=campaigns if any(campaigns) else ()
    )


def _lines(scanner: Scanner, ranking: Ranking, model: GyroModel) -> list[Line]:
    """The best line and others in the same pass that stand by themselves: ahead of all that may explain them."""
    assert scanner.lines is not None
    result = ranking.results[ranking.best_cell("bias_periodic")]
    form, explained, _ = result.best["bias_periodic"]
    assert isinstance(form, int)
    chosen = {form: explained}
    count, nu = len(scanner.lines.unseen), scanner.degrees_of_freedom
    rival = max((v for k, v in result.evidence.items() if k not in ("bias_periodic", "outliers")), default=0.0)
    for k, t in sorted(result.peaks.items(), key=lambda item: -item[1]):
        if min(abs(k - j) for j in chosen) < RESOLVED:
            continue
        # A line leaks as the square of 1/(π × its distance in steps of the record's resolution, a quarter of which
        # is the grid's).
        leakage = sum(other / (0.25 * np.pi * abs(k - j)) ** 2 for j, other in chosen.items())
        alone = float(log_evidence_ratio(np.array(t), result.rss, nu, 2)) - np.log(count)
        if alone > LINE_MARGIN + max(rival, 0.0) and t > ABOVE_LEAKAGE * leakage:
            chosen[k] = t
    room = max(MAXIMUM_LINES * scanner.runs - len(lines_of(model)), 1)
    return [scanner.lines.line(k) for k in list(chosen)[:room]]


def step_at(record: Record, row: int) -> BiasStep:
    """A step just before a sample."""
    time = np.asarray(record.signals["time"])
    return BiasStep(
        epoch=jnp.asarray(float(time[row] + time[row - 1]) / 2), campaign=record.run_numbers[record.run[row]]
    )


def form_effect(scanner: Scanner, name: str, form: int) -> Effect | None:
    """The effect behind a form number."""
    if name == "bias_step":
        return step_at(scanner.record, form)
    if name == "bias_periodic":
        assert scanner.lines is not None
        return periodic([scanner.lines.line(form)])
    return scanner.bank.blocks[form].effect


def _solved(scanner: Scanner, estimate: Estimate, effect: Effect, g: int, pulses: tuple[int, ...]) -> Effect:
    """The effect at the coefficients that fit best beside the baseline, in one noise cell."""
    model = estimate.model
    model = replace(model, effects=tuple(e for e in model.effects if e.label not in effect.supersedes), noise={})
    if effect.site == "gain":
        return effect
    columns = model.columns_at(scanner.record.signals)(effect)
    return effect.with_linear(_coefficients(scanner, model, columns, g, pulses))


def _grown(scanner: Scanner, estimate: Estimate, tangent: Tangent, g: int, pulses: tuple[int, ...]) -> Effect:
    """An effect that continues others, at the amplitude that fits best beside them."""
    effect, column = tangent.effect, tangent.column[:, None] * float(estimate.model.gain())
    best = _coefficients(scanner, estimate.model, column, g, pulses)
    amplitude = jnp.clip(best[0], -effect.reach, effect.reach)
    while True:
        try:
            return effect.grown_by(amplitude)
        except ValueError:  # beyond what the effect can be, which it is at none
            amplitude = 0.5 * amplitude


def _coefficients(
    scanner: Scanner, model: GyroModel, columns: Array | np.ndarray, g: int, pulses: tuple[int, ...]
) -> Float[Array, " coefficient"]:
    """The coefficients of columns that fit best beside a model, in one noise cell."""
    w = _whitened(scanner, model, columns, g, pulses)
    norm = np.linalg.norm(w[:, :-1], axis=0)
    norm[norm == 0] = 1.0
    solution = np.linalg.lstsq(w[:, :-1] / norm, w[:, -1], rcond=1e-9)[0] / norm
    own = model.vector()
    # Beside what was missing, the gain may be another, in proportion to which the columns are.
    gain = model.with_vector(own + solution[: len(own)]).gain() / model.gain()
    return jnp.asarray(solution[-columns.shape[1] :]) / jnp.where(jnp.abs(gain) > LEAST_GAIN, gain, 1.0)


def _whitened(
    scanner: Scanner, model: GyroModel, columns: Array | np.ndarray, g: int, pulses: tuple[int, ...]
) -> np.ndarray:
    """What a model's parameters and gross errors add, some columns, and its residual, white in one noise cell."""
    record = scanner.record
    predicted, jacobian = model.linearise(record.signals)
    residual = np.where(scanner.present, np.asarray(record.signals["output"]) - predicted, 0.0)
    marks = np.zeros((len(residual), len(pulses)))
    marks[list(pulses), np.arange(len(pulses))] = 1.0
    return scanner.cells.whiten(g, np.column_stack([jacobian, marks, columns, residual]))
