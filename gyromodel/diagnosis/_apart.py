"""How far apart candidates lie on a campaign, and which of them are the same there."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import stats

from gyromodel.diagnosis._forms import form_effect
from gyromodel.diagnosis._ranking import Ranking, is_driver
from gyromodel.diagnosis._scan import Scanner
from gyromodel.estimate import Estimate, filter_of, whiten_columns
from gyromodel.model import GyroModel, effect_class

# Candidates whose sums of squares differ by less than this part of the noise variance have the same signal …
ALIKE = 0.2
# … and by less than this part (one nat) what one of them is, the other may be.
CLOSE = 2.0
# … where their columns lie no farther apart than this sine: among many lines one explains as much by chance.
HELD = 0.5
# Chance below which a size shows, and part of what an effect explains that one sample alone may tell.
NOTHING_SHOWS, ONE_SAMPLE = 0.05, 0.8


def twins(scanner: Scanner, ranking: Ranking, name: str, alike: float = ALIKE) -> set[str]:
    """Effects whose signals hold a candidate's, with at most one coefficient more.

    No size of it would tell them apart on this campaign. A form that contains another which was searched is no twin: it
    follows whatever that one leaves. Nor is a step one of a bias, which it becomes at an end of the record; fits tell
    what the shapes searched cannot.
    """
    if name in ranking.fitted:
        return set()
    result = ranking.results[ranking.best_cell(name)]
    _, explained, q = result.best[name]
    least = explained - alike * (result.rss - explained) / ranking.samples
    near = {
        k
        for k, (_, t, width) in result.best.items()
        if k not in (name, "outliers", "bias_step" if name == "bias" else "")
        and k in ranking.statistic and not is_driver(k)
        and width <= q + 1 and t >= least
        and not result.best.keys() & set(effect_class(k).supersedes) - {k}
    }  # fmt: skip
    return {k for k in near if (apart := separation(scanner, ranking, name, k)) is not None and apart <= HELD}


def like(scanner: Scanner, ranking: Ranking, name: str, others: Sequence[str]) -> bool:
    """Whether a candidate is one of some names, or has much the same signal as one that does nearly as well."""
    if name in others or name == "outliers" or name not in ranking.results[ranking.best_cell(name)].best:
        return name in others
    return not twins(scanner, ranking, name, CLOSE).isdisjoint(others)


def columns_of_best(scanner: Scanner, ranking: Ranking, name: str) -> np.ndarray | None:
    """Columns of a candidate's best form; none where it was not searched."""
    if name not in ranking.results[ranking.best_cell(name)].best:
        return None
    form, _, _ = ranking.best_form(name)
    if name == "outliers":
        rows = form if isinstance(form, tuple) else (form,)
        marks = np.zeros((len(scanner.present), len(rows)))
        marks[list(rows), np.arange(len(rows))] = 1.0
        return marks
    if name in ranking.tangents:
        return ranking.tangents[name].column[:, None]
    assert isinstance(form, int)
    effect = form_effect(scanner, name, form)
    if name in ("bias_step", "bias_periodic"):
        assert effect is not None
        return np.asarray(effect.columns(scanner.record.signals))
    block = scanner.bank.blocks[form]
    return scanner.bank.columns[:, block.start : block.start + block.width]


def separation(scanner: Scanner, ranking: Ranking, a: str, b: str) -> float | None:
    """Sine of the smallest angle between two candidates' whitened, projected columns, in the noise of the first."""
    first, second = columns_of_best(scanner, ranking, a), columns_of_best(scanner, ranking, b)
    if first is None or second is None:
        return None
    g = ranking.best_cell(a)
    w = scanner.cells.whiten(g, np.concatenate([ranking.baseline_columns, first, second], axis=1))
    p = ranking.baseline_columns.shape[1]
    base = w[:, :p] / np.maximum(np.linalg.norm(w[:, :p], axis=0), 1e-300)
    rest = w[:, p:] - base @ np.linalg.lstsq(base, w[:, p:], rcond=1e-10)[0]
    qa, qb = (_basis(x) for x in (rest[:, : first.shape[1]], rest[:, first.shape[1] :]))
    if not qa.shape[1] or not qb.shape[1]:
        return None
    # The smaller space measured against the larger one.
    cosine = np.linalg.svd(qa.T @ qb, compute_uv=False)
    return float(np.sqrt(max(0.0, 1.0 - min(1.0, cosine[: min(qa.shape[1], qb.shape[1])].max()) ** 2)))


def _basis(x: np.ndarray) -> np.ndarray:
    u, s, _ = np.linalg.svd(x / np.maximum(np.linalg.norm(x, axis=0), 1e-300), full_matrices=False)
    return u[:, s > 1e-5]


def shows(estimate: Estimate, name: str, before: GyroModel, contained: int = 0) -> bool:
    """Whether what was added of an effect, taken together, differs in a fit from what the simulation has (5 %).

    Args:
        estimate: the fit of the extended model.
        name: the effect.
        before: the simulation.
        contained: how many of the effect's coefficients are free in the simulation, under this or another name; taken
            to be its first, as the terms of a curve are.
    """
    slots, stated = estimate.model.slots(), dict(zip(before.labels, before.effects, strict=True))
    free = {(before.labels[s.effect], s.field, s.index) for s in before.slots()}
    linear = _linear(estimate, name)
    added = [i for i in linear if (name, slots[i].field, slots[i].index) not in free]
    added = added[max(contained - (len(linear) - len(added)), 0) :]
    if not (len(added) and estimate.std[added].any()):
        return True
    nothing = np.zeros(len(added))
    for k, i in enumerate(added):
        effect, field, index, _ = slots[i]
        was = np.ravel(getattr(stated[name], field)) if name in stated else ()
        # A scale factor that a simulation lacks is one; a wider form's further coefficients are none.
        nothing[k] = was[index] if index < len(was) else float(estimate.model.effects[effect].site == "gain")
    std = np.where(estimate.std > 0.0, estimate.std, 1.0)[added]
    correlation = estimate.covariance[np.ix_(added, added)] / np.outer(std, std)
    z = (np.asarray(estimate.model.vector())[added] - nothing) / std
    return bool(stats.chi2.sf(z @ np.linalg.pinv(correlation, hermitian=True) @ z, len(added)) < NOTHING_SHOWS)


def rests_on_one(estimate: Estimate, name: str) -> bool:
    """Whether what the rest of a fitted model leaves of an effect is, in its noise, nearly that of one wrong sample."""
    linear, record = _linear(estimate, name), estimate.record
    if not linear:
        return False
    columns = np.asarray(estimate.model.linearise(record.signals)[1])

    def white(values: np.ndarray) -> np.ndarray:
        return np.asarray(whiten_columns(filter_of(record, estimate.ratios), values))[: record.rows][record.present]

    whitened = white(columns)
    others = np.delete(whitened, linear, axis=1)

    def left(values: np.ndarray) -> np.ndarray:
        return values - others @ np.linalg.lstsq(others, values, rcond=1e-10)[0]

    own = left(whitened[:, linear] @ np.asarray(estimate.model.vector())[linear])
    largest = np.flatnonzero(record.present)[np.argmax(np.abs(own))]
    pulse = left(white((np.arange(len(columns)) == largest)[:, None].astype(float))[:, 0])
    return bool((own @ pulse) ** 2 > ONE_SAMPLE * (own @ own) * (pulse @ pulse))


def _linear(estimate: Estimate, name: str) -> list[int]:
    """The places of an effect's free coefficients among a model's parameters."""
    model = estimate.model
    return [i for i, slot in enumerate(model.slots()) if slot.linear and model.labels[slot.effect] == name]
