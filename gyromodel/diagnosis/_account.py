"""The account of a search that a diagnosis keeps: its rounds, evidence at sizes, p-value, what a name needed more."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np

from gyromodel.diagnosis._ranking import Ranking, is_driver, is_noise
from gyromodel.diagnosis._result import Candidate, Round
from gyromodel.diagnosis._search import Selection
from gyromodel.diagnosis._session import Session
from gyromodel.diagnosis._steps import Found
from gyromodel.estimate import Estimate


def rounds_of(session: Session, selection: Selection, scale: float, hold_out: bool) -> tuple[Round, ...]:
    """What each round of the search ranked and added, and the held-out error after it: NaN where none is asked for."""
    steps: list[tuple[Found | None, Ranking, Estimate]] = [
        (f, f.ranking, e) for f, e in zip(selection.path, selection.estimates[1:], strict=False)
    ]
    rounds = []
    unknown = (np.nan, np.nan, False)
    before = session.ladder(selection.estimates[0]) if hold_out else unknown
    rounds.append(
        Round(
            None,
            0.0,
            _ranking(selection.path[0].ranking if selection.path else selection.last),
            before[0] * scale,
            before[1],
        )
    )
    for step, ranking, estimate in steps:
        assert step is not None
        rms, score, _ = session.ladder(estimate) if hold_out else unknown
        rounds.append(Round(step.name, ranking.statistic[step.name], _ranking(ranking), rms * scale, score))
    return tuple(rounds)


def evidence_at_sizes(selection: Selection, alike: Mapping[str, float]) -> dict[str, tuple[float, ...]]:
    """ln B at each of the prior's sizes beside all that was found; of that, and of what is alike, as it was added.

    Gross errors are a campaign's own.
    """
    of = dict.fromkeys(selection.last.statistic, selection.last)
    for f in reversed(selection.found):
        rivals = alike if f.name in alike else ()
        of |= {name: f.ranking for name in (*rivals, f.name) if name in f.ranking.statistic}
    return {name: ranking.at_sizes(name) for name, ranking in sorted(of.items()) if name != "outliers"}


def p_value_of(selection: Selection, nulls: np.ndarray) -> float:
    """Share of campaigns with nothing hidden whose best candidate has as much evidence; this one is counted."""
    first = selection.path[0].ranking if selection.path else selection.last
    return float((1 + np.sum(nulls >= first.significance)) / (1 + len(nulls)))


def more_needed(first: Ranking, path: Sequence[Found]) -> float:
    """Nats that the first name, or the leading one where none was added, needed more."""
    name = path[0].name if path else first.best(drivers=False)[0]
    return first.more_needed(name) if name else 0.0


def _ranking(ranking: Ranking) -> tuple[Candidate, ...]:
    order = sorted(ranking.statistic, key=lambda k: -ranking.statistic[k])[:12]
    return tuple(Candidate(str(k), ranking.statistic[k], ranking.posterior[k], _kind(k)) for k in order)


def _kind(name: str) -> Literal["effect", "driver", "noise"]:
    return "driver" if is_driver(name) else "noise" if is_noise(name) else "effect"
