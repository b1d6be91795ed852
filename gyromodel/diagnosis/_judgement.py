"""A verdict with everything that goes with it, and what is found after a search and changes it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from gyromodel.diagnosis._ranking import Ranking, is_driver, is_noise
from gyromodel.diagnosis._result import Cause, Verdict


@dataclass(frozen=True)
class Judgement:
    """A verdict with everything that goes with it."""

    verdict: Verdict
    causes: tuple[Cause, ...]
    credible_set: dict[str, float]
    driver: str | None
    next_test: str | None
    unexplained: dict[str, float]
    findings: tuple[str, ...]


def structured(judgement: Judgement, ranking: Ranking, column: str) -> Judgement:
    """The judgement where what passes for noise at one end of a column has a structure that nothing searched has."""
    name = f"smooth({column})"
    driver = name if name in ranking.statistic else None
    test = f"Repeat the campaign over that end of {column} alone, sampled more densely: what returns there is no noise."
    return replace(judgement, verdict="unknown", credible_set={name: 1.0}, driver=driver, next_test=test)


def undecided(judgement: Judgement, name: str, rival: str, test: str) -> Judgement:
    """The judgement where what was found as `name` may as well be `rival`, until a test tells."""
    cause = next((c for c in judgement.causes if c.effect == name), None)
    if cause is None or judgement.verdict not in ("named", "ambiguous"):
        return judgement
    if judgement.verdict == "ambiguous":
        # What else is in doubt stays the set.
        tests = " ".join(filter(None, (judgement.next_test, test)))
        if name in judgement.credible_set:
            return replace(judgement, next_test=tests)
        firm = tuple(c for c in judgement.causes if c is not cause)
        said = (*judgement.findings, also_held(name, (name, rival)))
        return replace(judgement, causes=firm, findings=said, next_test=tests)
    shares = {name: 0.5, rival: 0.5}
    # A function of a column is no cause with a name.
    members = {k: v for k, v in shares.items() if not is_driver(k)}
    pair = as_set(replace(cause, posterior=0.5), members)
    rest = tuple(c for c in judgement.causes if c.effect not in members)
    return replace(judgement, verdict="ambiguous", causes=(*pair, *rest), credible_set=shares, next_test=test)


def with_steps(judgement: Judgement, steps: Cause) -> Judgement:
    """The judgement with steps of the output beside what else the simulation lacks."""
    if judgement.verdict == "adequate":
        return replace(judgement, verdict="named", causes=(steps,), credible_set={steps.effect: 1.0})
    if judgement.verdict == "named":
        return replace(judgement, causes=tuple(sorted((*judgement.causes, steps), key=lambda c: -c.statistic)))
    others = tuple(c for c in judgement.causes if c.effect != steps.effect)
    return replace(judgement, causes=(*others, steps))


def with_noise(judgement: Judgement, beyond: Sequence[Cause], trials: int) -> Judgement:
    """The judgement with kinds of noise that the simulation lacks beside what else it lacks."""
    if not beyond:
        return judgement
    beyond = [replace(c, p_adjusted=min(1.0, c.p_value * trials)) for c in beyond]
    regular = [c for c in beyond if c.posterior < 1.0]
    if regular:
        # Hops at a regular pace, which something that switches makes as well.
        rival = Cause("bias_periodic", (), regular[0].statistic, regular[0].p_value, regular[0].p_adjusted, 0.5)
        others = [c for c in beyond if c not in regular]
        test = "Log again with what switches nearby (chamber, heater, pump) off: hops of the gyro itself go on."
        shares = {c.effect: c.posterior for c in (*regular, rival)}
        return replace(
            judgement,
            verdict="ambiguous",
            causes=(*regular, rival, *judgement.causes, *others),
            credible_set=shares,
            next_test=test,
        )
    if judgement.verdict == "adequate":
        judgement = replace(judgement, verdict="named", credible_set={beyond[0].effect: 1.0})
    causes = (*judgement.causes, *beyond)
    if judgement.verdict == "named":
        causes = tuple(sorted(causes, key=lambda c: -c.statistic))
    return replace(judgement, causes=causes)


def also_held(name: str, members: Iterable[str]) -> str:
    """What is said of a further cause that is in doubt with others."""
    members = list(members)
    again = " Repeat the run: noise does not come back." if any(map(is_noise, members)) else ""
    return (
        f"The extended model also holds {name}, which this campaign cannot tell from the others of: "
        f"{' or '.join(members)}.{again}"
    )


def as_set(cause: Cause, members: dict[str, float]) -> tuple[Cause, ...]:
    """A cause and those that it cannot be told from, as causes; shares of the posterior by name."""
    # A share may be too small for a number.
    share = {k: max(v, np.finfo(float).tiny) for k, v in members.items()}
    others = [
        Cause(
            k,
            (),
            cause.statistic + float(np.log(share[k]) - np.log(share.get(cause.effect, share[k]))),
            cause.p_value,
            cause.p_adjusted,
            v,
        )
        for k, v in members.items()
        if k != cause.effect
    ]
    return (cause, *others)
