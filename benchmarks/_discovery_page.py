"""The page of the hidden-effect study: levels with their intervals, checks, other methods, figures, and all misses."""

from __future__ import annotations

import random
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import binomtest

from benchmarks._discovery_figures import draw_confusion, draw_power
from benchmarks._kept import Kept, code
from tests.truth import levels, study
from tests.truth.campaigns import HOMES, MOTION, TESTABLE
from tests.truth.laws import NEEDED, Told
from tests.truth.noise import FAMILY
from tests.truth.other_designs import OTHER_DESIGNS
from tests.truth.verdicts import Score, allowed

# In multiples of the minimal detectable size.
SIZES = (0.5, 1.0, 2.0, 3.0, 10.0)
# Channels that a campaign measures, of those that unknown effects follow.
MEASURED = ("temperature", "rate", "supply_voltage", "pressure")
WALK = "noise_random_walk"
# Row 18: processor seconds that must do, and seconds that are wished for.
MUST_SECONDS, GOAL_SECONDS = 60.0, 10.0
TIMED_DRAWS = 2000  # of the calibration of a diagnosis that is timed
HEAD = [
    "| row | measure | prototype | must | measured (95 % interval) | n | | goal |",
    "|---|---|---|---|---|---|---|---|",
]


def write_page(output: Path, whole: list[Kept]) -> None:
    """Make the page of the kept parts of whole studies, by seed, and its figures beside it."""
    parts = {label: [r for k in whole for r in k.parts[label]] for label in whole[0].parts}
    nulls, outside = parts["nothing"] + parts["nothing, moving"], parts["nothing, outside"]
    sized = {size: parts[f"effects {size:g}"] + parts[f"effects {size:g}, white"] for size in SIZES}
    unknown = {size: parts[f"unknown {size:g}"] + parts[f"unknown {size:g}, moving"] for size in (3.0, 10.0)}
    main_sizes = [r for size in (1.0, 3.0, 10.0) for r in sized[size]]
    uncatalogued = [r for records in unknown.values() for r in records]
    reached = levels.null_levels(nulls + outside) + levels.effect_levels(main_sizes)
    reached += levels.outside_levels(parts["effects 3, outside"])
    reached += levels.unknown_levels(uncatalogued) + levels.pair_levels(parts["pairs"] + parts["pairs, moving"])
    reached += levels.amplitude_levels(main_sizes) + levels.ambiguity_levels(parts["inseparable"], parts["drifts"])
    few_log = parts["effects 3, other"] + parts["effects 10, other"]
    reached += levels.other_levels(few_log)
    reached += levels.superfluous_levels(parts["nothing, superfluous"], parts["effects 10, superfluous"])
    reached += [levels.settled_level(parts["inseparable"]), levels.noise_level(nulls)]
    reached += [levels.adequacy_level(sized[3.0]), levels.claim_level(parts["forced"])]
    reached += levels.gain_coverage(sized[3.0])
    reached.sort(key=lambda v: (float(v.row.rstrip("+")), v.measure))
    uniform, lowest, count = levels.uniform_p_values(parts["calibrated"])
    size, error = levels.mean_set_size(sized[3.0])
    at_three = sum(r.isolable for r in sized[3.0])
    told = {label: [t for k in whole for t in k.oracle.get(label, [])] for label in parts}
    controls, control_checks = _controls(nulls, sized[3.0], parts["unknown 3"])
    tenth = binomtest(round(lowest * count), count, 0.1).pvalue > 0.05
    small, three = size - 1.96 * error <= levels.SET_SIZE, f"{size:.2f} ± {error:.2f}"
    mutants, mutant_checks = _mutants(parts)
    checks = [
        _check("3", "p-values uniform: Kolmogorov-Smirnov", "p > 0.01", f"p = {uniform:.2g}", count, uniform > 0.01),
        _check("3", "p-values in the lowest tenth", "10 %", f"{100 * lowest:.1f} %", count, tenth),
        _check("7", "mean size of the 95 % set, isolable, 3×", f"≤ {levels.SET_SIZE}", three, at_three, small),
        _spent(whole[-1].seconds, whole[-1].timed),
        *(_leak(sized[s], s) for s in (1.0, 3.0)),
        *_beside_names(sized[1.0]),
        *_wrong_too({"catalogue": sized[3.0] + sized[10.0], "of what few campaigns log": few_log}),
        *_bounds(parts, told),
        *control_checks,
        *mutant_checks,
    ]
    figures = {k: output.with_name(f"{output.stem}_{k}.png") for k in ("confusion", "power")}
    commands = [f"    python -m benchmarks.discovery --seed {k.path.stem[5:-5]} --scale {k.scale:g}" for k in whole]
    made = ", ".join(dict.fromkeys(k.code for k in whole))
    other = "" if made.endswith(code()) else f", before that of today's checkout, {code()}"
    lines = [
        "# Hidden-effect study",
        "",
        f"{sum(map(len, parts.values()))} campaigns, by the engine {made}{other} (digests: `benchmarks/_kept.py`; of",
        "several, each made some of the parts).",
        *_still(whole),
        "Made by",
        "",
        *commands,
        "",
        "Sizes are multiples of the minimal detectable size, by a dense oracle that knows the noise, but no larger",
        "than the physics allows. A level is met by the measured share, open where it is not and the 95 %",
        "Clopper-Pearson interval does not exclude it: few campaigns (n) leave much open. 5+",
        "counts every effect, isolable or not; confusions that nothing can resolve are accepted",
        "(`tests/truth/verdicts.py`). Row 4 leaves out designs where the oracle has but one name to choose; rows 4 and",
        "5 leave out drift, step and warm-up, which noise imitates. Row 15 is of the best candidate added whatever its",
        "evidence, and its coverage, of what least squares gains on the same blocks, of designs without positions.",
        "Nulls, unknown effects and effects in coloured noise are diagnosed without hold-out. All noise is simulated,",
        "and what nothing can separate is hidden in one design, a static log on one ramp. Row 11 has",
        "[a page of its own](isolability.md), and noise of real",
        "gyros [another](real_noise.md).",
        "",
        f"Never hidden here: {', '.join(_never_hidden())}.",
        "",
        *HEAD,
        *map(_row, reached),
        "",
        "## Checks of the study and of single numbers",
        "",
        *HEAD,
        *checks,
        "",
        "## With nothing hidden, by design and noise",
        "",
        *_false_extensions(nulls + outside),
        "",
        "## More evidence than the threshold",
        "",
        *_thresholds(nulls + outside, sized[1.0], sized[3.0], parts["inseparable"]),
        "",
        "## Other methods on the same campaigns",
        "",
        *controls,
        "",
        "## Safeguards switched off",
        "",
        *mutants,
        "",
        "## Power, and p-values with nothing hidden",
        "",
        f"![share named over size; p-values against uniform]({figures['power'].name})",
        "",
        "## What is said of what was hidden, at 3×",
        "",
        f"![confusion matrix]({figures['confusion'].name})",
        "",
        *_missed([
            r for label, records in parts.items() for r in records
            if label.startswith(("nothing", "unknown", "pairs", "inseparable", "drifts", "effects 3", "effects 10"))
        ]),
    ]  # fmt: skip
    output.parent.mkdir(parents=True, exist_ok=True)
    output.write_text("\n".join(lines), encoding="utf-8")
    draw_confusion(sized[3.0] + unknown[3.0], figures["confusion"])
    p_values = np.array([r.answer.p_value for r in parts["calibrated"] if r.answer])
    draw_power([r for records in sized.values() for r in records], p_values, figures["power"])


def _still(whole: list[Kept]) -> list[str]:
    """How many answers are still those of an engine that came later."""
    return [
        f"Of {total} of those diagnosed without a gain, drawn at random and diagnosed again by {engine}, {other} have "
        "another answer (verdict, names or column)."
        for engine, total, other in (k.again for k in whole if k.again)
    ]


def _row(v: levels.Level) -> str:
    low, high = v.interval
    must = f"{'≥' if v.at_least else '≤'} {100 * v.must:.1f} %"
    measured = f"{100 * v.share:.1f} % ({100 * low:.1f}-{100 * high:.1f})"
    verdict = v.verdict.replace("missed", "**missed**")
    wanted = f"{100 * w.must:.1f} %: {w.verdict}" if (w := v.wanted) else "–"
    return f"| {v.row} | {v.measure} | {v.prototype} | {must} | {measured} | {v.total} | {verdict} | {wanted} |"


def _check(row: str, measure: str, must: str, measured: str, count: int, met: Any) -> str:
    return f"| {row} | {measure} | – | {must} | {measured} | {count} | {'met' if met else '**missed**'} | |"


def _false_extensions(nulls: list[study.Record]) -> list[str]:
    """How often something is said where nothing is hidden: pooled noises hide which designs are worse."""
    lines = [
        "| design | noise without a walk | noise with a walk | of these, a set that holds the walk |",
        "|---|---|---|---|",
    ]
    designs = list(dict.fromkeys(r.case.design for r in nulls))
    for name, of in [*((d, [d]) for d in designs), ("**all**", designs)]:
        cells = []
        for walk in (False, True):
            group = [r for r in nulls if r.case.design in of and ("walk" in r.case.noise) == walk]
            said = [r.answer for r in group if r.score and r.score.detected and r.answer]
            cells.append(f"{len(said)} of {len(group)}")
        held = sum(WALK in answer.credible for answer in said)
        lines.append(f"| {name} | {' | '.join(cells)} | {held} |")
    return lines


def _thresholds(
    nulls: list[study.Record], one: list[study.Record], three: list[study.Record], inseparable: list[study.Record]
) -> list[str]:
    """Rows 1, 5, 6 and 12 if what comes first needed more than it does: what a higher threshold would win and lose."""
    measures: dict[str, tuple[list[study.Record], Callable[[Score, str], bool]]] = {
        "something said, nothing hidden": (nulls, lambda score, verdict: score.detected),
        "named, isolable, not slow in time, 1×": (levels.alone(one), lambda score, verdict: score.named),
        "firm and wrong, 3×": (three, lambda score, verdict: score.firm_and_wrong),
        "cannot separate: ambiguous with the truth": (
            inseparable, lambda score, verdict: score.right and verdict == "ambiguous",
        ),
    }  # fmt: skip
    head = [f"{measure} (n = {len(records)})" for measure, (records, _) in measures.items()]
    lines = [f"| nats more | {' | '.join(head)} |", "|---|" + "---|" * len(measures)]
    for more in (0.0, 0.25, 0.5, 1.0, 2.0):
        shares = []
        for records, flag in measures.values():
            said = [(r.score, r.answer) for r in records if r.score and r.answer]
            shares.append(
                np.mean([flag(score, answer.verdict) and (not more or answer.margin >= more) for score, answer in said])
            )
        lines.append(f"| {more:g} | {' | '.join(f'{100 * share:.1f} %' for share in shares)} |")
    return lines


def _right(name: str, record: study.Record) -> bool:
    """Whether one name is right, by the rule that every method is judged by."""
    return name in allowed(str(record.case.effect), record.case.design)[0]


def _driver(record: study.Record) -> str:
    return " and ".join(record.truth.driver or ())


def _controls(
    nulls: list[study.Record], effects: list[study.Record], unknown: list[study.Record]
) -> tuple[list[str], list[str]]:
    """What each control and practitioner's method says at 3 x MDE, and the engine against shuffled truths.

    Drivers are asked for where they are a measured column: the other methods know no derived ones and no pairs.
    Returns the table, and the checks of what controls must do.
    """
    truths = [r.case.effect for r in effects]
    most = Counter(truths).most_common(1)[0][0]
    unknown = [r for r in unknown if _driver(r) in MEASURED]
    lines = [
        f"| method | extension with nothing hidden (n = {len(nulls)}) | exact name, 3× (n = {len(effects)}) | "
        f"measured column of an unknown effect, 3× (n = {len(unknown)}) |",
        "|---|---|---|---|",
    ]
    checks = []

    def line(name: str, false: float, exact: float, driver: float, bold: str = "") -> None:
        cells = " | ".join(f"{bold}{100 * share:.1f} %{bold}" for share in (false, exact, driver))
        lines.append(f"| {bold}{name}{bold} | {cells} |")

    def fails(name: str, false: float, exact: float) -> None:
        shares, far = f"{100 * false:.0f} %, {100 * exact:.0f} %", false > 0.10 or exact < 0.75
        must = "> 10 % or < 75 %"
        checks.append(_check("1, 5", f"{name} fails: false extension, name", must, shares, len(nulls), far))

    for name in study.CONTROLS if nulls[0].controls else ():
        added = [(r, r.controls[name].added) for r in effects]
        false = float(np.mean([bool(r.controls[name].added) for r in nulls]))
        exact = float(np.mean([len(names) == 1 and _right(names[0], r) for r, names in added]))
        driver = float(np.mean([r.controls[name].added == (f"smooth({_driver(r)})",) for r in unknown]))
        line(name.replace("_", " "), false, exact, driver)
        fails(name.replace("_", " "), false, exact)
    share = float(np.mean([t == most for t in truths]))
    line("always none", 0.0, 0.0, 0.0)
    line(f"most frequent name ({most})", 1.0, share, 0.0)
    fails("always none", 0.0, 0.0)
    fails("most frequent name", 1.0, share)
    lines.append(
        "| oracle: noise and size known, an effect is there | – | "
        f"{100 * np.mean([levels.oracle_right(r) for r in effects]):.1f} % | – |"
    )
    line(
        "gyromodel",
        float(np.mean([s.detected for r in nulls if (s := r.score)])),
        float(np.mean([s.named for r in effects if (s := r.score)])),
        float(np.mean([s.driver_right for r in unknown if (s := r.score)])),
        "**",
    )
    shuffled = random.Random(0).sample(truths, len(truths))
    hits = sum(r.answer is not None and r.answer.causes == (t,) for r, t in zip(effects, shuffled, strict=True))
    measured, chance = (
        f"{100 * hits / len(truths):.1f} %",
        sum((n / len(truths)) ** 2 for n in Counter(truths).values()),
    )
    lines.append(f"| gyromodel against shuffled truths | – | {measured} | – |")
    fair = bool(binomtest(hits, len(truths), chance, alternative="greater").pvalue > 0.01)
    must = f"chance: {100 * chance:.1f} %"
    checks.append(_check("5", "shuffled truths give chance", must, measured, len(truths), fair))
    return lines, checks


def _leak(records: list[study.Record], size: float) -> str:
    """The oracle bounds row 4: an engine that is right much oftener where the two differ has seen the truth."""
    engine, oracle = levels.surpassed(records)
    fair = engine + oracle == 0 or binomtest(engine, engine + oracle, 0.5, alternative="greater").pvalue > 0.01
    measured = f"{engine} against {oracle}"
    return _check("4", f"first name right where the oracle's is not, and the reverse: no leak, {size:g}×", "not more",
                  measured, len(records), bool(fair))  # fmt: skip


def _beside_names(records: list[study.Record]) -> list[str]:
    """Row 5 of an oracle that knows noise and size, and is as sure as the engine; and with rivals beside the name."""
    counted = {
        "what bounds it: named by the oracle as firmly, 1×": levels.oracle_names(records),
        "detected, and the right name first, alone or in a set, 1×": levels.told_first(records),
    }
    return [f"| 5 | {k} | – | – | {100 * n / max(m, 1):.1f} % | {m} | – | |" for k, (n, m) in counted.items()]


def _wrong_too(groups: dict[str, list[study.Record]]) -> list[str]:
    """Row 6 of an oracle that knows noise and size: where it is as sure of what is firm and wrong here."""
    rows = []
    for measure, records in groups.items():
        wrong = [r for r in records if r.score and r.score.firm_and_wrong and r.answer]
        too = sum(r.oracle_firm and r.oracle_first in r.answer.causes for r in wrong if r.answer)
        shown = f"what bounds it: of what is firm and wrong here, 3× and 10×, {measure}, named by the oracle as firmly"
        rows += [f"| 6 | {shown} | – | – | {100 * too / len(wrong):.1f} % | {len(wrong)} | – | |"] if wrong else []
    return rows


def asked(label: str, records: list[study.Record]) -> list[study.Record]:
    """The campaigns of a part that the oracle is asked about: of effects those that the engine has not told right.

    At the detectable size those called unknown, and a part of all that it could name.
    """
    scored = [(r, s) for r in records if (s := r.score)]
    if label.startswith("unknown 10"):
        return [r for r, score in scored if not score.called_unknown]
    if label.startswith("effects 10"):
        return [r for r in levels.alone(records) if r.score and not r.score.named]
    if label.startswith("effects 1"):
        return [r for r, score in scored if score.called_unknown or _shown(r)]
    return records


def _shown(record: study.Record) -> bool:
    """Whether a campaign of row 5 is one of those that an oracle is shown at the detectable size."""
    return bool(levels.alone([record])) and record.case.seed % study.SOME == 0


def _bounds(parts: dict[str, list[study.Record]], told: dict[str, list[Told]]) -> list[str]:
    """Rows of an oracle that knows how levels are drawn, as sure as the engine, on the same data."""
    both = {label: list(zip(asked(label, parts[label]), told[label], strict=True)) for label in told if told[label]}
    nulls = both.get("nothing", []) + both.get("nothing, moving", [])
    counted = {("1", "something said, nothing hidden, noise of the family"): [bool(t.said) for _, t in nulls]}
    for noise in FAMILY:
        said = [bool(t.said) for r, t in nulls if r.case.noise == noise]
        counted["2", f"something said, {noise.replace('_', ' ')}"] = said
    if "unknown 10" in both:
        missed = both["unknown 10"] + both.get("unknown 10, moving", [])
        counted["8", "flagged of those not flagged here, 10×, told the column but not its function"] = _ahead(missed)
    asked_all = both.get("effects 1", []) + both.get("effects 1, white", [])
    mistaken = [(r, t) for r, t in asked_all if r.score and r.score.called_unknown]
    counted["9", "flagged of those called unknown here, 1×, told the column that was named"] = _ahead(mistaken)
    not_named = both.get("effects 10", []) + both.get("effects 10, white", [])
    besides = "something said besides of those not named here, 10×, told the hidden effect but not its size"
    counted["5", besides] = [bool(t.said) for _, t in not_named]
    counted["5", f"{besides}, of what few campaigns log"] = [bool(t.said) for _, t in both.get("effects 10, other", [])]
    shown = [(r, t) for r, t in asked_all if _shown(r)]
    here = 100 * np.mean([bool(r.score and r.score.named) for r, _ in shown]) if shown else 0.0
    named = [levels.told_right(r, t.said) for r, t in shown]
    counted["5", f"detected and named, 1×, where {here:.0f} % are named here"] = named
    inseparable = [len(t.said) > 1 and r.case.effect in t.said for r, t in both.get("inseparable", [])]
    counted["12", "ambiguous with the truth"] = inseparable
    counted["14", "noise class"] = [max(t.kinds, key=t.kinds.__getitem__) == r.case.noise for r, t in nulls]
    anyhow = [(r, t.anyhow) for r, t in nulls if t.anyhow]
    here = 100 * np.mean([r.answer and r.answer.noise == levels.NOISE_KINDS[r.case.noise] for r, _ in anyhow] or [0.0])
    classed = [max(kinds, key=kinds.__getitem__) == r.case.noise for r, kinds in anyhow]
    counted["14", f"noise class, with nothing known of levels, where {here:.0f} % are right here"] = classed
    rows = []
    for (row, measure), flags in counted.items():
        knows = "" if "nothing known of levels" in measure else " that knows how levels are drawn"
        shown = f"what bounds it: {measure}, by an exact oracle{knows}"
        rows += [f"| {row} | {shown} | – | – | {100 * np.mean(flags):.1f} % | {len(flags)} | – | |"] if flags else []
    return rows


def _ahead(both: list[tuple[study.Record, Told]]) -> list[bool]:
    """Where an oracle tells of a function of the column ahead of every name, of campaigns where it knows the column."""
    known = [t.evidence for _, t in both if "smooth" in t.evidence]
    return [evidence["smooth"] == max(evidence.values()) >= NEEDED for evidence in known]


def _mutants(parts: dict[str, list[study.Record]]) -> tuple[list[str], list[str]]:
    """Rows 1, 5 and 15 with a safeguard off, beside the same campaigns with it on: the table, and that each breaks."""
    lines, checks = ["| switched off | measure | with it | without |", "|---|---|---|---|"], []
    measures = {
        "1": ("extension with nothing hidden", 0.02, False, "detected"),
        "5": ("named, 3×", 0.92, True, "named"),
        "15": ("held-out score rises with the best candidate, nothing hidden", 0.5, False, "gain_shown"),
    }
    for off, row, on, mutant in (
        ("whitening", "1", "broken", "no_whitening"),
        ("price of the search", "1", "broken", "no_look_elsewhere"),
        ("projection", "5", "unbroken", "no_projection"),
        ("nesting", "15", "forced", "forced_no_nesting"),
    ):
        measure, must, at_least, flag = measures[row]
        both = []
        for label in (on, mutant):
            flags = [getattr(r.score, flag) for r in parts[label]]
            both.append(levels.Level(row, measure, "", must, at_least, sum(flags), len(flags)))
        lines.append(f"| {off} | {measure} | {100 * both[0].share:.0f} % | {100 * both[1].share:.0f} % |")
        broken, share = both[1].verdict == "missed", f"{100 * both[1].share:.1f} %"
        checks.append(_check(row, f"without {off}: {measure}", "fails the row", share, both[1].total, broken))
    return lines, checks


def _spent(seconds: Sequence[tuple[str, int, float, float, float, float]], by: str) -> str:
    """Row 18 of what was timed, by an engine."""
    each = ", ".join(
        f"{name} ({rows} rows) {one:.0f} ({clock:.0f}) and {two:.0f} ({again:.0f})"
        for name, rows, one, two, clock, again in seconds
    )
    first, then, _, clock = (max(row[i] for row in seconds) for i in (2, 3, 4, 5))
    measure = (
        f"processor seconds (and by the clock) with {TIMED_DRAWS} draws and hold-out, the first time and compiled "
    )
    measure += f"before: {each}{f' (by {by})' if by else ''}"
    must = "met" if first <= MUST_SECONDS else "**missed**"
    goal, by_clock = ("met" if seconds <= GOAL_SECONDS else "missed" for seconds in (then, clock))
    return (
        f"| 18 | {measure} | 6 s | ≤ {MUST_SECONDS:g} s | {first:.0f} s, then {then:.0f} ({clock:.0f}) s | "
        f"{len(seconds)} | {must} | {GOAL_SECONDS:g} s, compiled before: {goal}, by the clock {by_clock} |"
    )


def _never_hidden() -> list[str]:
    """Catalogue effects of a gyro that the study does not hide."""
    from gyromodel.declarations import declarations

    hidden = {e for d in (*HOMES, *MOTION, "static_ramp", *OTHER_DESIGNS) for e in TESTABLE[d]}
    return sorted({e for e, of in declarations().items() if of.domain == "gyro"} - hidden - {"bias_column"})


def _missed(records: list[study.Record]) -> list[str]:
    """Every campaign of some that was not answered right, to draw it again."""
    wrong = [r for r in records if not (r.score and r.score.right)]
    lines = [
        "## Answers that were not right",
        "",
        "| seed | design | noise | hidden | isolable | said |",
        "|---|---|---|---|---|---|",
    ]
    for r in sorted(wrong, key=lambda r: (str(r.case.effect), r.case.design)):
        told = r.answer and (r.answer.verdict, ", ".join(r.answer.causes) or " and ".join(r.answer.driver))
        said, isolable = " ".join(told or ("refused",)), "yes" if r.isolable else "no"
        hidden = ", simulated beside ".join(filter(None, (r.case.effect or "–", ", ".join(r.case.superfluous))))
        lines.append(f"| {r.case.seed} | {r.case.design} | {r.case.noise} | {hidden} | {isolable} | {said} |")
    return [*lines, ""]
