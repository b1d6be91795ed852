"""Outputs read in steps: what the search says of simulated campaigns, and what fits beside rounding know.

    python -m benchmarks.quantisation --workers 2

writes benchmarks/results/quantisation.md.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass, replace
from functools import partial
from unittest.mock import patch

import numpy as np

from benchmarks._measure import share, table, write_result
from tests.truth import study
from tests.truth.memory import rounded
from tests.truth.verdicts import Score, judge

STEPS = (1.0, 2.0, 3.0, 5.0, 10.0)
TIMES, CAMPAIGNS = 3.0, 18
NAME = "quantisation"
# Fits: rates of a table, visits to each and samples of a visit, draws.
RATES, VISITS, HOLD, DRAWS = 25, 4, 4, 100


@dataclass(frozen=True)
class Said:
    """Whether the steps were a cause, and the score of all else that was said."""

    told: bool
    score: Score | None


def said(case: study.Case, steps: float, blind: bool) -> Said:
    """What the search says of an output in steps of so many standard deviations of its noise from sample to sample.

    `blind`: with all of rounding taken for noise.
    """
    from gyromodel._checks import CampaignError
    from gyromodel.diagnosis._readings import Readings

    built = study.build(case)
    noise = np.rad2deg(built.truth.noise)
    step = steps * np.diff(noise).std() / np.sqrt(2.0)
    built = replace(built, columns=built.columns | {"output": rounded(built.columns["output"], step)})
    try:
        with patch("gyromodel.diagnosis._data.readings_of", lambda *_: Readings()) if blind else patch.dict({}):
            answer = study.run_engine(built)
    except CampaignError:  # all of the output is one value
        return Said(False, None)
    told = NAME in answer.causes
    causes, credible = (
        tuple(n for n in names if n != NAME or answer.verdict == "ambiguous")
        for names in (answer.causes, answer.credible)
    )
    only = answer.verdict == "named" and not causes
    answer = replace(answer, causes=causes, credible=credible, verdict="adequate" if only else answer.verdict)
    isolable = case.effect is None or study.run_case(case, engine=False).isolable
    return Said(told, judge(built.truth, case.design, answer, isolable))


def fits(steps: float, seed: int) -> list[list[str]]:
    """Errors of a bias over what rounding leaves, and how often 95 % intervals hold scale factor and bias."""
    import gyromodel as gm

    rng, noise = np.random.default_rng(seed), 0.002
    off: dict[str, list[np.ndarray]] = {"": [], NAME: []}
    std: dict[str, list[np.ndarray]] = {"": [], NAME: []}
    for _ in range(DRAWS):
        rates = rng.permutation(np.repeat(rng.uniform(-8.0, 8.0, RATES), VISITS))
        rate = np.repeat(rates, HOLD)
        output = rounded(1.0003 * rate + 0.01 + noise * rng.standard_normal(len(rate)), steps * noise)
        columns = {"time": np.arange(float(len(rate))), "rate": rate, "output": output}
        campaign = gm.Campaign(columns, {"time": "s", "rate": "deg/s", "output": "deg/s"}, {"kind": "rate"})
        for more in off:
            estimate = gm.fit(campaign, gm.model_from_effects(["scale_factor", "bias", *[more] * bool(more)]))
            off[more].append(np.asarray(estimate.model.vector()) - np.array([1.0003, np.deg2rad(0.01)]))
            std[more].append(estimate.std)
    row = [f"{steps:g}"]
    rms = {more: np.sqrt(np.mean(np.square(each), axis=0))[1] for more, each in off.items()}
    for more in off:
        inside = np.abs(np.array(off[more])) < 1.96 * np.array(std[more])
        row += [f"{np.rad2deg(rms[more]) * 3600:.2f}", f"{100 * inside.mean():.0f} %"]
    return [[*row, f"{rms[''] / rms[NAME]:.2f}"]]


def main(argv: list[str] | None = None) -> None:
    argv = sys.argv[1:] if argv is None else argv
    parser = argparse.ArgumentParser(description="Outputs that are read in steps.")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args(argv)
    kinds = ("white", "flicker")
    nothing = study.null_cases(CAMPAIGNS, arguments.seed, kinds)
    hidden = study.effect_cases(CAMPAIGNS, arguments.seed + 1, TIMES, kinds)
    rows = []
    for steps in STEPS:
        for what, cases in (("nothing", nothing), (f"an effect at {TIMES:g}×", hidden)):
            for blind in (False, True):
                run = partial(said, steps=steps, blind=blind)
                answers = study.in_processes(run, cases, arguments.workers)
                scored = [(a.told, a.score) for a in answers if a.score]
                scores = [s for _, s in scored]
                right = [s.right for s in scores]
                told = share([told for told, _ in scored])
                wrong = sum(s.firm_and_wrong or (s.called_unknown and cases is nothing) for s in scores)
                among = str(sum(s.in_set and not s.named for s in scores)) if cases is hidden else ""
                knows = "no" if blind else "yes"
                unknown = sum(s.called_unknown for s in scores)
                rows.append([f"{steps:g}", what, knows, told, share(right), among, str(wrong), str(unknown)])
                print(*rows[-1], sep=" | ", flush=True)
    fitted = [row for steps in (0.5, *STEPS, 30.0) for row in fits(steps, arguments.seed)]
    lines = [
        f"{CAMPAIGNS} campaigns of the study with nothing hidden and as many with an effect at {TIMES:g} times",
        "its minimal detectable size, in white noise and flicker, their output rounded to steps of so many standard",
        'deviations of the noise from sample to sample. "Knows of steps": the search as it is; the other is the same',
        "search with all of rounding taken for noise. A verdict is right as in the study, once the steps are taken off",
        "it. Campaigns whose output is one value throughout are left out.",
        "",
        *table(
            [
                "step, σ",
                "hidden",
                "knows of steps",
                "steps are a cause",
                "right verdict of all else",
                "in a set with others",
                "firm and wrong, or unknown with nothing hidden",
                "unknown",
            ],
            rows,
        ),
        "",
        f"Fits of a scale factor and a bias to {RATES} rates of a table, {VISITS} visits of {HOLD} samples, {DRAWS}",
        "draws: the rms error of the bias and how often the two 95 % intervals hold the truth, with all of rounding",
        "taken for noise, and beside its mean.",
        "",
        *table(
            [
                "step, σ",
                "noise alone: error, deg/h",
                "intervals hold",
                "beside rounding: error, deg/h",
                "intervals hold",
                "error ÷ error",
            ],
            fitted,
        ),
    ]
    write_result("quantisation", "Outputs read in steps", "quantisation", argv, lines)


if __name__ == "__main__":
    main()
