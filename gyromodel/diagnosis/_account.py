"""The account of a search that a diagnosis keeps: its rounds, evidence at sizes, p-value, what a name needed more."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np

from gyromodel.diagnosis._ranking import Ranking, is_driver, is_noise
from gyromodel.diagnosis._result import Candidate, Round
from gyromodel.diagnosis._selection import Selection
from gyromodel.diagnosis._session import Session
from gyromodel.diagnosis._steps import Found


def rounds_of(session: Session, selection: Selection, scale: float, hold_out: bool) -> tuple[Round, ...]:
    """The simulation as given, then each addition: all candidates ranked beside it, and the held-out error with it.

    The error is NaN where none is asked for.
    """
    rankings = [*(f.ranking for f in selection.path), selection.last]
    added = [(None, 0.0), *((f.name, f.ranking.statistic[f.name]) for f in selection.path)]
    besides = [*(f.beside for f in selection.path), ""]
    rounds = []
    for (name, evidence), ranking, beside, estimate in zip(added, rankings, besides, selection.estimates, strict=True):
        rms, score, _ = session.ladder(estimate) if hold_out else (np.nan, np.nan, False)
        rounds.append(Round(name, evidence, _ranking(ranking), rms * scale, score, beside or None))
    return tuple(rounds)


def evidence_at_sizes(selection: Selection, alike: Mapping[str, float]) -> dict[str, tuple[float, ...]]:
    """ln B at each of the prior's sizes beside all that was found; of that, and of what is alike, as it was added.

    Gross errors are a campaign's own.
    """
    of = dict.fromkeys(selection.last.statistic, selection.last) | as_added(selection, alike)
    return {name: ranking.at_sizes(name) for name, ranking in sorted(of.items()) if name != "outliers"}


def as_added(selection: Selection, alike: Mapping[str, float]) -> dict[str, Ranking]:
    """The ranking in which each name that was found was added, and what is alike with it."""
    of: dict[str, Ranking] = {}
    for f in reversed(selection.found):
        rivals = alike if f.name in alike else ()
        of |= {name: f.ranking for name in (*rivals, f.name) if name in f.ranking.statistic}
    return of


def p_value_of(selection: Selection, nulls: np.ndarray) -> float:
    """Share of campaigns with nothing hidden whose best effect or driver has as much evidence; this one is counted."""
    return float((1 + np.sum(nulls >= selection.first.significance)) / (1 + len(nulls)))


def more_needed(first: Ranking, path: Sequence[Found]) -> float:
    """Nats that the first name, or the leading one where none was added, needed more."""
    name = path[0].name if path else first.best(drivers=False)[0]
    return first.more_needed(name) if name else 0.0


def _ranking(ranking: Ranking) -> tuple[Candidate, ...]:
    order = sorted(ranking.statistic, key=lambda k: -ranking.statistic[k])[:12]
    return tuple(Candidate(str(k), ranking.statistic[k], ranking.posterior[k], _kind(k)) for k in order)


def _kind(name: str) -> Literal["effect", "driver", "noise"]:
    return "driver" if is_driver(name) else "noise" if is_noise(name) else "effect"
