"""Effects too weak for one campaign, in archives of units that share them: what `units` names of all together.

    python -m benchmarks.pooled_effects --workers 2

writes benchmarks/results/pooled_effects.md. Each archive has one campaign each of eight units, of one design and one
kind of noise, all or half of them with the same effect hidden at 0.7 times the minimal detectable size, with a sign and
a shape of its own in each; the others, and the archives with nothing hidden, hold noise alone.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa

from benchmarks._measure import table, write_result
from tests.truth import mde, study
from tests.truth.campaigns import TESTABLE, A, B, C
from tests.truth.noise import FAMILY, OUTSIDE
from tests.truth.verdicts import allowed

COLUMNS = ("campaign", "axis", "serial", "verdict", "causes", "evidence", "data_hash")
SCHEMA = pa.schema([(name, pa.string()) for name in COLUMNS])
UNITS, TIMES, NOISES = 8, 0.7, FAMILY[:3]
COUNTS = (2, 4, 8)
WITH = {"in all units": 1.0, "in half of the units": 0.5, "nothing hidden": 0.0}


class Archive(NamedTuple):
    """Units of one design, noise and effect."""

    design: str
    noise: str
    effect: str
    share: float
    seed: int

    def cases(self) -> list[study.Case]:
        """One campaign a unit, those without the effect between the others."""
        with_it = np.diff(np.floor(self.share * np.arange(UNITS + 1))) > 0
        seeds = np.random.SeedSequence(self.seed).generate_state(UNITS, np.uint64) >> np.uint64(12)
        return [
            study.Case(int(s), self.design, self.noise, *((self.effect, TIMES) if w else (None, 0.0)))
            for s, w in zip(seeds, with_it, strict=True)
        ]


def archives(count: int, seed: int, share: float) -> list[Archive]:
    """Archives of effects that one run tells from noise, in an order of the seed."""
    rng = np.random.default_rng(seed)
    noises = NOISES if share else (*FAMILY, *OUTSIDE)
    cells = [
        (d, n, e) for d in (A, B, C) for n in noises for e in TESTABLE[d]
        if e not in (*study.SLOW, "bias", "scale_factor") and not (n == "grows_with_rate" and d == B)
    ]  # fmt: skip
    return [
        Archive(*cells[i], share, int(s))
        for i, s in zip(rng.permutation(len(cells))[:count], rng.integers(2**31, size=count), strict=True)
    ]


def diagnosed(case: study.Case, baseline: tuple[str, ...]) -> dict[str, Any]:
    """The row of results that `batch --diagnose` has of one campaign, against one model for all of an archive."""
    import gyromodel

    built = study.build(case)
    campaign = gyromodel.Campaign(columns=built.columns, units=built.units, metadata=built.metadata)
    found = gyromodel.diagnose(campaign, gyromodel.model_from_effects(list(baseline)), hold_out=False)
    return {
        "campaign": str(case.seed),
        "axis": None,
        "serial": None,
        "verdict": found.verdict,
        "causes": ", ".join(c.effect for c in found.causes),
        "evidence": json.dumps(found.evidence),
        "data_hash": str(case.seed),
    }


def work(archive: Archive) -> list[dict[str, Any]]:
    """Rows of all units of an archive."""
    baseline = mde.baseline(study.build(archive.cases()[0]).design, archive.effect)
    return [diagnosed(case, baseline) for case in archive.cases()]


def alone(row: dict[str, Any]) -> str:
    """What one campaign names; "?" where it says that something is there, and does not name it."""
    return {"adequate": "", "named": row["causes"]}.get(row["verdict"], "?")


def together(rows: list[dict[str, Any]]) -> str:
    """As `alone`, of several units."""
    from gyromodel.batch import leading, pooled_effects

    names = leading(pooled_effects(pa.Table.from_pylist(rows, SCHEMA)))
    return names[0] if len(names) == 1 and not names[0].startswith("smooth(") else "?" if names else ""


def counts(archives: list[Archive], answers: list[str]) -> str:
    """Right, not named, and wrong, in percent; of archives with nothing hidden, how many show something."""
    if not archives[0].share:
        return f"{sum(map(bool, answers))} of {len(answers)}"
    right = [a in allowed(x.effect, x.design)[0] for x, a in zip(archives, answers, strict=True)]
    wrong = [bool(a) and a != "?" and not r for a, r in zip(answers, right, strict=True)]
    return f"{np.mean(right):.0%}, {np.mean([a == '?' for a in answers]):.0%}, {np.mean(wrong):.0%}"


def main() -> None:
    """Run and write the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--archives", type=int, default=24)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    os.environ |= {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    drawn = {name: archives(options.archives, options.seed + i, s) for i, (name, s) in enumerate(WITH.items())}
    with ProcessPoolExecutor(options.workers, mp_context=get_context("spawn")) as pool:
        rows = {name: list(pool.map(work, those)) for name, those in drawn.items()}
    lines = []
    for name, those in drawn.items():
        singly = [(x, row) for x, of in zip(those, rows[name], strict=True) for row in of]
        first = counts([x for x, _ in singly], [alone(row) for _, row in singly])
        lines.append([name, first, *(counts(those, [together(of[:n]) for of in rows[name]]) for n in COUNTS)])
    head = ["effect", "each unit by itself", *(f"{n} units" for n in COUNTS)]
    text = [
        f"{options.archives} archives a row. Of those with an effect: named rightly, shown and not named, named "
        "wrongly; of the others, how many show something.",
        "",
        *table(head, lines),
    ]
    write_result("pooled_effects", "Effects of an archive's units together", "pooled_effects", sys.argv[1:], text)


if __name__ == "__main__":
    main()
