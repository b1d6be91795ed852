"""Effects hidden in the noise of real gyros: static logs as they are, with simulated campaigns laid over them.

    python -m benchmarks.real_noise --workers 2

writes benchmarks/results/real_noise.md. The logs are read from the folder that GYROMODEL_DATA names, or ../shared/data;
they are not part of the project. Each is averaged to the length of a design, and taken as it is and with its sign
turned; its scale in time is the design's.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cache, partial

import numpy as np

from benchmarks._measure import DATA, share, table, write_result
from tests.truth import study
from tests.truth.campaigns import TESTABLE, A, B, C
from tests.truth.designs import Design
from tests.truth.noise import Noise
from tests.truth.verdicts import Score, allowed, judge

# File, and the axis of it; none: its only one.
LOGS = {
    **{f"mems {run} {axis}": (f"mems_static_long/{run}.nc", axis) for run in ("run1", "run2") for axis in "xyz"},
    **{f"rlg {axis}": ("rlg_static/campaign.csv.gz", axis) for axis in "xyz"},
    "fog": ("fog_closed_loop_ramp/campaign.csv.gz", ""),
}
# Logs that hold lines, of the dither and of the feedback ramp (docs/cases), which a diagnosis is to find as well.
WITH_LINES = ("rlg", "fog")
TURNED = "turned "
HEAD = ["log", "design", "hidden", "size", "said"]
TIMES = (None, 1.0, 3.0, 10.0)


@dataclass(frozen=True)
class Measured(Noise):
    """A measured series, beside the law that is fitted to it: what sizes are reckoned by."""

    series: np.ndarray = field(default_factory=lambda: np.zeros(0))

    def sample(self, design: Design, rng: np.random.Generator) -> np.ndarray:
        """The series at the rows of the design, whatever the generator."""
        return self.series[design.index]


@cache
def _log(name: str) -> np.ndarray:
    import gyromodel

    file, axis = LOGS[name]
    campaign = gyromodel.read_campaign(DATA / file)
    column = f"output_{axis}" if axis else "output"
    return np.asarray(campaign.columns[column]) * gyromodel.units.factor(campaign.units[column], "rad/s")


def measured(name: str, design: Design) -> Noise:
    """A log as the noise of a design."""
    import gyromodel

    rows = int(design.index[-1]) + 1
    log = _log(name.removeprefix(TURNED))
    series = log[: len(log) // rows * rows].reshape(rows, -1).mean(axis=1)
    series = (series - series.mean()) * (-1.0 if name.startswith(TURNED) else 1.0)
    columns = {"time": np.arange(rows) * design.step, "output": np.rad2deg(series)}
    record = gyromodel.Campaign(columns, {"time": "s", "output": "deg/s"}, {"kind": "rate"})
    noise = gyromodel.fit(record, gyromodel.model_from_effects(["bias"])).model.noise
    coloured = {1.0: float(noise.get("noise_flicker", 0.0)), 2.0: float(noise.get("noise_random_walk", 0.0))}
    markov = None
    if float(noise.get("noise_markov", 0.0)):
        markov = float(noise["noise_markov"]), float(noise["noise_markov_time"])
    fractional = {power: size for power, size in coloured.items() if size}
    return Measured(name, float(noise["noise_white"]), fractional, markov, series=series)


def cases(times_mde: float | None, seed: int, logs: list[str]) -> Iterator[study.Case]:
    """Each log and its mirror on each design, with an effect drawn for it or none."""
    rng = np.random.default_rng(seed)
    for name in (turn + log for turn in ("", TURNED) for log in logs):
        for design in (A, B, C):
            effects = [e for e in TESTABLE[design] if e not in study.SLOW]
            case = study.Case(int(rng.integers(2**52)), design, name)
            yield case if times_mde is None else replace(case, effect=str(rng.choice(effects)), times_mde=times_mde)


def judged(record: study.Record) -> Score:
    """The score of an answer, lines that its log has left out of what was said."""
    answer = record.answer
    assert answer is not None
    if record.case.noise.removeprefix(TURNED).startswith(WITH_LINES):
        causes, credible = (
            tuple(name for name in names if name != "bias_periodic") for names in (answer.causes, answer.credible)
        )
        only = not causes and not answer.driver and not credible
        answer = replace(answer, causes=causes, credible=credible, verdict="adequate" if only else answer.verdict)
    return judge(record.truth, record.case.design, answer, record.isolable or record.case.effect is None)


def _beside_dither(record: study.Record) -> bool | None:
    """Of an answer that is unknown in the noise of a dither, whether what it names is right; none of others."""
    answer = record.answer
    if answer is None or answer.verdict != "unknown" or "rlg" not in record.case.noise:
        return None
    return len(answer.causes) == 1 and answer.causes[0] in allowed(str(record.case.effect), record.case.design)[0]


def main(argv: list[str] | None = None) -> None:
    argv = sys.argv[1:] if argv is None else argv
    parser = argparse.ArgumentParser(description="Effects hidden in the noise of real gyros.")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args(argv)
    logs = [name for name, (file, _) in LOGS.items() if (DATA / file).exists()]
    if not logs:
        print("no logs found; GYROMODEL_DATA names the folder of the measured data", file=sys.stderr)
        return
    run = partial(study.run_cases, workers=arguments.workers, noise_of=measured)
    rows, wrong = [], []
    for i, times in enumerate(TIMES):
        drawn = list(cases(times, arguments.seed + i, logs))
        records = run(drawn, controls=("least_squares_f", "stepwise_bic") if times is None else ())
        scores = [judged(r) for r in records]
        if times is None:
            rows.append(["nothing hidden: something found", share([s.detected for s in scores])])
            for control, name in (("least_squares_f", "an F-test of each candidate"), ("stepwise_bic", "stepwise BIC")):
                rows.append([f"the same by {name}", share([bool(r.controls[control].added) for r in records])])
        else:
            rows.append([f"{times:g}×: right verdict", share([s.right for s in scores])])
            alone = [s.named for r, s in zip(records, scores, strict=True) if r.isolable]
            rows.append([f"{times:g}×, isolable: named, and nothing else", share(alone)])
            rows.append([f"{times:g}×: firm and wrong", share([s.firm_and_wrong for s in scores])])
            beside = [_beside_dither(r) for r in records]
            rows.append([f"{times:g}×: unknown, in the ring laser's log", share([b is not None for b in beside])])
            rows.append([f"{times:g}×: of these, the right name and no other stands beside", str(beside.count(True))])
        for r, s in zip(records, scores, strict=True):
            if r.answer and (s.firm_and_wrong or (times is None and s.detected)):
                said = f"{r.answer.verdict}: {', '.join(r.answer.causes or r.answer.driver)}"
                wrong.append([r.case.noise, r.case.design, str(r.case.effect), f"{times or 0:g}", said])
        print(*rows[-5:], sep="\n", flush=True)
    lines = [
        f"{len(logs)} series of static logs (a MEMS triad twice for 10 000 s, a dithered ring laser triad for 300 s,",
        "a closed-loop fiber-optic gyro for 180 s), averaged to the rows of three simulated designs",
        "(`tests/truth/designs.py`), each also with its sign turned. Effects are drawn from those that a design can",
        "show and slow noise does not imitate; their sizes are multiples of what is detectable in the noise that is",
        "fitted to the series. Lines of the ring laser's dither and of the fiber-optic gyro's feedback are in their",
        "logs: naming them, or telling of them, is not judged here (`docs/cases`). One log in three designs is not",
        "three logs: the 95 % intervals are too narrow.",
        "",
        *table(["measure", "campaigns"], rows),
        "",
        *(["Found with nothing hidden, or firm and wrong:", "", *table(HEAD, wrong)] if wrong else []),
    ]
    write_result("real_noise", "Effects in the noise of real gyros", "real_noise", argv, lines)


if __name__ == "__main__":
    main()
