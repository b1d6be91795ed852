"""What all units of an archive say together of effects that no campaign shows by itself.

An effect is in a share π of the units, with coefficients N(0, t²σ²(AᵀA)⁻¹) of one t in all of them; evidence is
averaged over π, uniform, and t. Where few units have it, the others do not speak against it.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import pyarrow as pa
from scipy.special import expit, logsumexp

from gyromodel.batch._units import Spread, copies, spread_of
from gyromodel.diagnosis import UNLISTED, special_cases

SHARES = (np.arange(50) + 0.5) / 50
# Least ln B of an effect that is pooled: an archive is asked of every effect on every axis.
POOLED_THRESHOLD = 4.0
# Of the posterior, that of a name which stands alone.
CERTAIN = 0.95


class PooledEffect(NamedTuple):
    """One candidate over an archive.

    effect, axis: which; evidence: ln B of its being in some of the units; posterior: against the other candidates, if
    there is but one; share: of the units that could show it, those that have it; alone: how many of these name it by
    themselves; probability: that a unit has it, by serial, given all of them.
    """

    effect: str
    axis: str
    evidence: float
    posterior: float
    share: Spread
    alone: int
    probability: dict[str, float]

    def to_dict(self) -> dict[str, Any]:
        """JSON-ready."""
        return self._asdict() | {"share": self.share._asdict()}


def pooled_effects(results: pa.Table) -> list[PooledEffect]:
    """Every candidate of a diagnosed archive, by the evidence of all units together, the strongest first.

    Campaigns of one `serial` are of one unit, and share what it has; `copies` count once.

    Args:
        results: as `run_batch` writes them; campaigns that were only fitted say nothing.

    Returns:
        Entries by axis; none where fewer than two campaigns were diagnosed.
    """
    frame = results.select(["campaign", "axis", "serial", "verdict", "causes", "evidence"]).to_pandas()
    frame = frame[frame["evidence"].notna() & ~frame["campaign"].isin(copies(results))]
    frame["axis"] = frame["axis"].fillna("")
    frame["serial"] = frame["serial"].where(frame["serial"].notna(), frame["campaign"])
    frame = frame.drop_duplicates(["campaign", "axis"])
    return [
        effect for axis, part in frame.groupby("axis", sort=False) if len(part) > 1 for effect in _of(str(axis), part)
    ]


def _of(axis: str, campaigns: pd.DataFrame) -> list[PooledEffect]:
    names: dict[str, None] = {}
    units: dict[str, dict[str, np.ndarray]] = {}
    named: dict[str, set[str]] = {}
    columns = (campaigns[name] for name in ("serial", "verdict", "causes", "evidence"))
    for serial, verdict, causes, evidence in zip(*columns, strict=True):
        unit, held = units.setdefault(serial, {}), causes.split(", ")
        logs = {name: np.array(each) for name, each in json.loads(evidence).items()}
        for name, each in logs.items():
            names.setdefault(name)
            # What was told beside its special case is that and more.
            within = [logs[s] for s in special_cases(name) if s in held and s in logs and name not in held]
            unit[name] = unit.get(name, 0.0) + each + (np.max(within, axis=0) if within else 0.0)
        if verdict == "named":
            for name in held:
                named.setdefault(name, set()).add(serial)
    found = [_pooled(name, axis, units, len(named.get(name, ()))) for name in names]
    weight = np.array([e.evidence - UNLISTED * e.effect.startswith("smooth(") for e in found])
    # A special case that does as well is enough.
    of = dict(zip(names, weight, strict=True))
    enough = [any(s != name and of.get(s, -np.inf) >= of[name] for s in special_cases(name)) for name in names]
    weight[enough] = -np.inf
    posterior = np.exp(weight - logsumexp(weight)) if len(found) else weight
    order = np.argsort(-weight, kind="stable")
    return [found[i]._replace(posterior=float(posterior[i])) for i in order]


def _pooled(name: str, axis: str, units: dict[str, dict[str, np.ndarray]], alone: int) -> PooledEffect:
    who = [unit for unit, has in units.items() if name in has]
    logs = np.array([units[unit][name] for unit in who])
    # By unit, share and size.
    odds = np.log(SHARES / (1 - SHARES))[:, None] + logs[:, None, :]
    each = (np.log1p(-SHARES)[:, None] + np.logaddexp(0.0, odds)).sum(axis=0)
    evidence = float(logsumexp(each) - np.log(each.size))
    weight = np.exp(each - logsumexp(each))
    has = (expit(odds) * weight).sum(axis=(1, 2))
    return PooledEffect(
        name, axis, evidence, 0.0, spread_of(SHARES, weight.sum(axis=1)), alone,
        dict(zip(who, map(float, has), strict=True)),
    )  # fmt: skip


def leading(effects: Sequence[PooledEffect]) -> list[str]:
    """Names of one axis that hold 95 % of the posterior; none where the first has too little evidence."""
    if not effects or effects[0].evidence < POOLED_THRESHOLD:
        return []
    held = np.cumsum([e.posterior for e in effects])
    return [e.effect for e in effects[: int(np.searchsorted(held, CERTAIN)) + 1]]


def pooled_sentences(effects: Sequence[PooledEffect]) -> Iterator[str]:
    """What the units lack together, by axis; what came of it is a reason to extend the model and go on."""
    for axis in dict.fromkeys(e.axis for e in effects):
        mine = [e for e in effects if e.axis == axis]
        yield f"{f'Axis {axis}: ' if axis else ''}{_sentence(mine)}"


def _sentence(effects: Sequence[PooledEffect]) -> str:
    top = effects[0]
    alike = leading(effects)
    if not alike:
        return (
            f"All units together show nothing that was searched: the strongest is {top.effect}, with ln B = "
            f"{top.evidence:.1f} of the {POOLED_THRESHOLD:g} needed."
        )
    share = f"{top.share.value:.0%} ({top.share.low:.0%} to {top.share.high:.0%}) of {len(top.probability)} units"
    if len(alike) > 1:
        return (
            f"In {share} something is missing that {' or '.join(alike)} explains (ln B = {top.evidence:.1f} of "
            f"{top.effect}, over all units together): these campaigns do not tell which."
        )
    if top.effect.startswith("smooth("):
        return (
            f"In {share} the error follows {top.effect.removeprefix('smooth')} as no effect of the catalogue does "
            f"(ln B = {top.evidence:.1f} over all units together)."
        )
    by_itself = {0: "none shows it by itself", 1: "one names it by itself"}.get(
        top.alone, f"{top.alone} name it by themselves"
    )
    return (
        f"The simulation lacks {top.effect} in {share}: ln B = {top.evidence:.1f} over all units together; "
        f"{by_itself}. What else they lack shows once the model has it."
    )
