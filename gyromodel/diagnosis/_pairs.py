"""Two effects that show together and not alone: of opposite signs, and much alike on this campaign."""

from __future__ import annotations

from collections import Counter
from collections.abc import Container
from itertools import combinations

import numpy as np

from gyromodel.diagnosis._bank import Bank, Block
from gyromodel.diagnosis._evidence import log_evidence_ratio, log_sum
from gyromodel.diagnosis._ranking import Ranking, is_driver, special_cases
from gyromodel.diagnosis._scan import Scanner
from gyromodel.diagnosis._tangents import VANISHED

# Coefficients of each of the two, at most: what has more can follow what is left of any other.
WIDEST = 2
# So many forms of one structure are all tried.
FEW_FORMS = 8


def best_pair(scanner: Scanner, ranking: Ranking, but: Container[str] = ()) -> tuple[tuple[str, str] | None, float]:
    """The two effects, none of `but`, with the most evidence together, the likelier one alone first; and that (ln B).

    Each stands at the form that is best alone, of each structure that it may have, or at any where they are few, as of
    products of accelerations; the choice of forms and of a partner is paid for.
    """
    bank = scanner.bank
    forms = Counter(b.name for b in bank.blocks)
    names, blocks = [], []
    for name in sorted(ranking.statistic, key=lambda k: -ranking.statistic[k]):
        if forms[name] and not is_driver(name) and name not in but:
            form = ranking.best_form(name)[0]
            if isinstance(form, int) and bank.blocks[form].width <= WIDEST:
                each = _forms(bank, ranking, name)
                names += [name] * len(each)
                blocks += each
    # What contains another as a special case is one cause with it.
    own = [{name, *special_cases(name)} for name in names]
    two = combinations(range(len(names)), 2)
    pairs = np.array([(i, j) for i, j in two if names[i] not in own[j] and names[j] not in own[i]])
    if not len(pairs):
        return None, -np.inf
    columns = np.zeros((len(bank.columns), len(names), WIDEST))
    for i, b in enumerate(blocks):
        columns[:, i, : b.width] = bank.columns[:, b.start : b.start + b.width]
    base, p = ranking.baseline_columns, ranking.baseline_columns.shape[1]
    data = np.column_stack([base, columns.reshape(len(columns), -1), ranking.residual])
    data = np.where(scanner.present[:, None], data, 0.0)
    each = np.array([np.log(forms[name]) + bank.price(name) for name in names])
    price = np.log((len(set(names)) - 1) / 2) + each[pairs].sum(axis=1)
    nu = scanner.degrees_of_freedom - p
    by_cell = []
    for g, result in ranking.results.items():
        t, q = _explained(scanner.cells.whiten(g, data), p, pairs)
        by_cell.append(result.log_likelihood + ranking.log_prior[g] + log_evidence_ratio(t, result.rss, nu, q))
    null = log_sum([r.log_likelihood + ranking.log_prior[g] for g, r in ranking.results.items()])
    together = np.array([log_sum(of_pair) for of_pair in np.array(by_cell).T]) - null - price
    top = int(np.argmax(together))
    first, second = pairs[top]
    return (names[first], names[second]), float(together[top])


def _forms(bank: Bank, ranking: Ranking, name: str) -> list[Block]:
    """Forms of an effect that a pair may have."""
    explained, of = ranking.results[ranking.best_cell(name)].explained, dict[str, list[int]]()
    for i, block in enumerate(bank.blocks):
        if block.name == name and block.width <= WIDEST:
            of.setdefault(block.structure, []).append(i)
    each = (forms if len(forms) <= FEW_FORMS else [max(forms, key=lambda i: explained[i])] for forms in of.values())
    return [bank.blocks[i] for forms in each for i in forms]


def _explained(w: np.ndarray, p: int, pairs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What pairs of blocks explain of the last column beside the first p, and with how many coefficients.

    Pairs in which a column has vanished beside the others explain nothing.
    """
    norm = np.linalg.norm(w[:, :-1], axis=0)
    unit = w[:, :-1] / np.where(norm > 0, norm, 1.0)
    basis = np.linalg.qr(unit[:, :p])[0]
    rest = np.column_stack([unit[:, p:], w[:, -1]])
    rest -= basis @ (basis.T @ rest)
    gram = rest.T @ rest
    here = (WIDEST * pairs[:, :, None] + np.arange(WIDEST)).reshape(len(pairs), -1)
    values, vectors = np.linalg.eigh(gram[here[:, :, None], here[:, None, :]])
    keep = values > VANISHED
    along = np.einsum("pij,pi->pj", vectors, gram[here, -1])
    t = np.sum(np.where(keep, along**2 / np.where(keep, values, 1.0), 0.0), axis=1)
    q, coefficients = keep.sum(axis=1), (norm[p:] > 0)[here].sum(axis=1)
    return np.where(q == coefficients, t, 0.0), coefficients
