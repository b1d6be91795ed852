"""What the study's records come to: shares against the levels to reach, with intervals of the binomial law."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import beta, binom, kstest

from .campaigns import TESTABLE
from .gains import true_gain
from .noise import FAMILY, OUTSIDE
from .study import SLOW, Record
from .verdicts import Score, allowed

TAIL = 0.0062  # beyond 2.5 standard errors
# What the method would like to reach, by row and what it must.
GOALS = {
    ("1", 0.02): 0.012, ("2", 0.04): 0.02, ("5", 0.55): 0.65, ("5", 0.92): 0.97, ("5", 0.99): 0.998, ("6", 0.01): 0.003,
    ("6", 0.04): 0.02, ("7", 0.95): 0.97, ("8", 0.85): 0.95, ("8", 0.97): 1.0, ("8", 0.80): 0.92, ("9", 0.02): 0.005,
    ("10", 0.88): 0.95, ("10", 0.80): 0.92, ("12", 0.90): 0.97, ("12", 0.80): 0.90, ("13", 0.97): 0.99,
    ("14", 0.75): 0.85, ("15", 0.05): 0.03, ("15", 0.88): 0.92, ("15", 0.99): 0.98, ("16", 0.90): 0.93,
    ("16", 0.92): 0.94, ("17", 0.95): 0.98,
}  # fmt: skip


@dataclass(frozen=True)
class Level:
    """A measured share against the level it must reach (`at_least`) or stay under."""

    row: str
    measure: str
    prototype: str
    must: float
    at_least: bool
    count: int
    total: int

    @property
    def share(self) -> float:
        return self.count / self.total if self.total else float("nan")

    @property
    def interval(self) -> tuple[float, float]:
        """95 % Clopper-Pearson interval."""
        k, n = self.count, self.total
        low = beta.ppf(0.025, k, n - k + 1) if k else 0.0
        high = beta.ppf(0.975, k + 1, n - k) if k < n else 1.0
        return float(low), float(high)

    @property
    def verdict(self) -> str:
        """Met by the share itself, open where it is not but the interval does not exclude the level, or missed."""
        low, high = self.interval
        if not self.total:
            return "not measured"
        if self.share >= self.must if self.at_least else self.share <= self.must:
            return "met"
        return "open" if (high >= self.must if self.at_least else low <= self.must) else "missed"

    @property
    def wanted(self) -> Level | None:
        """The same measure against its goal."""
        goal = GOALS.get((self.row, self.must))
        if self.row == "4":
            goal = self.must * next(_GOAL4[size] / must for size, must in _ROW4.items() if f"{size:g}×" in self.measure)
        return None if goal is None else replace(self, must=goal)

    @property
    def plausible(self) -> bool:
        """Not worse than the level loosened by 2.5 standard errors: for small samples."""
        return self.count >= self.limit if self.at_least else self.count <= self.limit

    @property
    def limit(self) -> int:
        """The least, or the most, that is plausible."""
        return int(binom.ppf(TAIL if self.at_least else 1 - TAIL, self.total, self.must))

    @property
    def can_fail(self) -> bool:
        """Whether a share half as good as the level, or false alarms in a third of the cases, would mostly fail."""
        if self.at_least:
            return bool(binom.cdf(self.limit - 1, self.total, 0.5 * self.must) > 0.5)
        return bool(binom.sf(self.limit, self.total, 1 / 3) > 0.5)


def _scores(records: list[Record]) -> list[Score]:
    return [r.score for r in records if r.score]


def _level(row: str, measure: str, prototype: str, must: float, at_least: bool, flags: list[bool]) -> Level:
    return Level(row, measure, prototype, must, at_least, sum(flags), len(flags))


def pooled(levels: list[Level]) -> list[Level]:
    """One level for each row, and each direction of it: the counts together, against the mean of what they must reach.

    The scatter is then no larger than that of the binomial law.
    """
    groups = defaultdict(list)
    for v in levels:
        groups[v.row, v.at_least].append(v)
    found = []
    for (row, at_least), group in groups.items():
        total = sum(v.total for v in group)
        must = sum(v.must * v.total for v in group) / max(total, 1)
        measure = "; ".join(dict.fromkeys(v.measure for v in group))
        found.append(Level(row, measure, "", must, at_least, sum(v.count for v in group), total))
    return found


def null_levels(records: list[Record]) -> list[Level]:
    """Rows 1 and 2 from campaigns with nothing hidden."""
    everywhere = "false extension, all noises and designs pooled"
    levels = [_level("1", everywhere, "0-1.2 %", 0.02, False, [s.detected for s in _scores(records)])]
    for noise in (*FAMILY, *OUTSIDE):
        flags = [r.score.detected for r in records if r.score and r.case.noise == noise]
        if flags:
            levels.append(_level("2", f"false extension, {noise.replace('_', ' ')}", "≤ 7.8 %", 0.04, False, flags))
    return levels


def claim_level(forced: list[Record]) -> Level:
    """Row 15: the best candidate added whatever its evidence where nothing is hidden, and what it then gains."""
    claimed = [s.gain_claimed for s in _scores(forced)]
    return _level("15", "gain claimed for the best candidate, nothing hidden", "1-2.5 %", 0.05, False, claimed)


def oracle_right(record: Record) -> bool:
    """Whether the oracle's name is right, by the rule that the engine is judged by."""
    return record.oracle_first in allowed(str(record.case.effect), record.case.design)[0]


def told_right(record: Record, said: tuple[str, ...]) -> bool:
    """Whether what was said of a campaign is one name, and right."""
    return len(said) == 1 and said[0] in allowed(str(record.case.effect), record.case.design)[0]


def oracle_names(records: list[Record]) -> tuple[int, int]:
    """What bounds row 5: campaigns where the oracle's name is right and firm, and of how many."""
    group = alone(records)
    return sum(r.oracle_firm and oracle_right(r) for r in group), len(group)


def told_first(records: list[Record]) -> tuple[int, int]:
    """Row 5 with rivals beside: campaigns where something is told of and the right name comes first; of how many."""
    scores = _scores(alone(records))
    return sum(s.detected and s.first_right for s in scores), len(scores)


def surpassed(records: list[Record]) -> tuple[int, int]:
    """Campaigns where only the engine's first name was right, and those where only the oracle's was."""
    pairs = [(r.score.first_right, oracle_right(r)) for r in _contested(records) if r.score]
    return sum(e and not o for e, o in pairs), sum(o and not e for e, o in pairs)


def _contested(records: list[Record]) -> list[Record]:
    """Isolable campaigns of effects that noise does not imitate, where the oracle has more than one name."""
    return [r for r in alone(records) if len(TESTABLE[r.case.design]) > 1]


def alone(records: list[Record]) -> list[Record]:
    """Isolable campaigns of effects that noise does not imitate: those of row 5."""
    return [r for r in records if r.isolable and r.case.effect not in SLOW]


_ROW4, _GOAL4 = {1.0: 0.93, 3.0: 0.97}, {1.0: 0.97, 3.0: 0.99}
_ROW5 = {1.0: 0.55, 3.0: 0.92, 10.0: 0.99}


def effect_levels(records: list[Record]) -> list[Level]:
    """Rows 4, 5, 6, 7 and 9 from catalogue effects; rows 4 and 5 on isolable campaigns, each row by size."""
    levels = []
    for size in sorted({r.case.times_mde for r in records}):
        group = [r for r in records if r.case.times_mde == size and r.score]
        at = f"{size:g}×"
        if size in _ROW4:
            knew = [oracle_right(r) for r in _contested(group)]
            found = [s.first_right for s in _scores(_contested(group))]
            must = _ROW4[size] * float(np.mean(knew)) if knew else 0.0
            levels.append(
                _level("4", f"first name right ÷ oracle ({_mean(knew):.3f}), {at}", ".97-1", must, True, found)
            )
        if size in _ROW5:
            named = [s.named for s in _scores(alone(group))]
            measure = f"detected and named, isolable, not slow in time, {at}"
            levels.append(_level("5", measure, ".56-.76/.92-.99/1", _ROW5[size], True, named))
        if size == 3.0:
            scores = _scores(group)
            levels += [
                _level("6", "firm and wrong, catalogue, 3×", "≤ .3 %", 0.01, False, [s.firm_and_wrong for s in scores]),
                _level(
                    "7", "95 % set holds the truth, 3×", ".992-1", 0.95, True, [s.in_set for s in scores if s.detected]
                ),
                _level("5+", "right verdict, every effect, 3×", "–", 0.92, True, [s.right for s in scores]),
            ]
        levels.append(
            _level(
                "9",
                f"catalogue effect called unknown, {at}",
                "≤ .2 %",
                0.02,
                False,
                [s.called_unknown for s in _scores(group)],
            )
        )
    return levels


def outside_levels(records: list[Record]) -> list[Level]:
    """Catalogue effects in noise of other kinds than those fitted, against what rows 5+ and 6 ask in those."""
    scores = _scores(records)
    return [
        _level("5+", "right verdict, 3×, noise outside the family", "–", 0.92, True, [s.right for s in scores]),
        _level("6", "firm and wrong, catalogue, 3×, noise outside the family", "–", 0.01, False,
               [s.firm_and_wrong for s in scores]),
    ]  # fmt: skip


def other_levels(records: list[Record]) -> list[Level]:
    """Rows 5, 5+, 6 and 9 of effects that show in what few campaigns log, by size."""
    levels, of = [], "of what few campaigns log"
    for size in sorted({r.case.times_mde for r in records}):
        group = [r for r in records if r.case.times_mde == size]
        scores = _scores(group)
        named = [s.named for s in _scores(alone(group))]
        levels += [
            _level("5", f"detected and named, isolable, {of}, {size:g}×", "–", _ROW5[size], True, named),
            _level("5+", f"right verdict, {of}, {size:g}×", "–", 0.92, True, [s.right for s in scores]),
            _level("6", f"firm and wrong, {of}, {size:g}×", "–", 0.01, False, [s.firm_and_wrong for s in scores]),
            _level("9", f"called unknown, {of}, {size:g}×", "–", 0.02, False, [s.called_unknown for s in scores]),
        ]
    return levels


def superfluous_levels(nothing: list[Record], hidden: list[Record]) -> list[Level]:
    """Rows 1, 5+ and 6 where the simulation has effects that the gyro has not; a refusal is not a right answer."""
    beside = "one to four effects simulated that are not there"
    right = [bool(r.score and r.score.right) for r in hidden]
    wrong = [bool(r.score and r.score.firm_and_wrong) for r in hidden]
    said = [not (r.score and r.score.right) for r in nothing]
    return [
        _level("1", f"false extension, {beside}", "–", 0.02, False, said),
        _level("5+", f"right verdict, 10×, {beside}", "–", 0.92, True, right),
        _level("6", f"firm and wrong, 10×, {beside}", "–", 0.01, False, wrong),
    ]


def _mean(values: list[bool]) -> float:
    return float(np.mean(values)) if values else float("nan")


SET_SIZE = 1.5


def mean_set_size(records: list[Record]) -> tuple[float, float]:
    """Row 7: mean size of the credible set at 3 x MDE, isolable campaigns, and its standard error."""
    at_three = [r for r in records if r.isolable and r.case.times_mde == 3.0]
    sizes = [s.set_size for s in _scores(at_three) if s.detected]
    if len(sizes) < 2:
        return float("nan"), float("nan")
    return float(np.mean(sizes)), float(np.std(sizes, ddof=1) / np.sqrt(len(sizes)))


def ambiguity_levels(inseparable: list[Record], drifts: list[Record]) -> list[Level]:
    """Rows 12 (first half) and 13."""
    said = [r.score.right and r.answer.verdict == "ambiguous" for r in inseparable if r.score and r.answer]
    return [
        _level("12", "campaign that cannot separate: ambiguous with the truth", "–", 0.90, True, said),
        _level(
            "13",
            "drift against random walk: not firmly named",
            "79/80",
            0.97,
            True,
            [r.answer.verdict != "named" for r in drifts if r.answer],
        ),
    ]


def pair_levels(records: list[Record]) -> list[Level]:
    """Row 10: two causes, both isolable, named exactly."""
    levels = []
    for label, must in (("white noise", 0.80), ("correlated noise", 0.88)):
        group = [r for r in records if r.isolable and (r.case.noise == "white") == (label == "white noise")]
        prototype = ".90" if label == "white noise" else ".98"
        exact = [s.named for s in _scores(group)]
        levels.append(_level("10", f"two causes, exact set, 3×, {label}", prototype, must, True, exact))
    return levels


NOISE_KINDS = {
    "white": "noise_white",
    "flicker": "noise_white + noise_flicker",
    "random_walk": "noise_white + noise_random_walk",
    "flicker_and_walk": "noise_white + noise_flicker + noise_random_walk",
}


def noise_level(records: list[Record]) -> Level:
    """Row 14: what the noise is made of, where it is of the fitted kinds."""
    named = [r.answer.noise == NOISE_KINDS[r.case.noise] for r in records if r.answer and r.case.noise in NOISE_KINDS]
    return _level("14", "noise class named", ".79-.91", 0.75, True, named)


# Effects whose first parameter is the simulator's amplitude, and by how much it is more.
SIZED = {"bias": 0.0, "scale_factor": 1.0} | dict.fromkeys(
    ("scale_asymmetry", "scale_temperature", "bias_temperature", "bias_drift", "bias_step", "bias_supply_voltage",
     "bias_pressure", "bias_laser_current"), 0.0
)  # fmt: skip


def amplitude_levels(records: list[Record]) -> list[Level]:
    """Row 16: 95 % intervals of the size of an effect that was found and named."""
    levels = []
    for times, must in ((1.0, 0.90), (3.0, 0.92)):
        hits = []
        for r in records:
            name = str(r.case.effect)
            # Coloured noise does not begin with the record: what it has come to by then is bias.
            if name not in SIZED or (name == "bias" and r.case.noise in FAMILY[1:]):
                continue
            if r.case.times_mde == times and r.answer and r.score and r.score.named:
                low, high = r.answer.sizes[name]
                hits.append(bool(low <= SIZED[name] + r.truth.amplitude <= high))
        levels.append(_level("16", f"95 % interval of the size, after selection, {times:g}×", "–", must, True, hits))
    return levels


def adequacy_level(records: list[Record]) -> Level:
    """Row 17: the extended model lacks nothing."""
    after = [r.answer.adequate_after for r in records if r.answer]
    measure = "extended model, diagnosed again, is adequate, of those named or ambiguous, 3×"
    return _level("17", measure, "–", 0.95, True, [a for a in after if a is not None])


def settled_level(inseparable: list[Record]) -> Level:
    """Row 12 (second half): after the test asked for, the truth is in the set and its rival is not."""
    rivals = {"bias_temperature", "bias_drift"}
    resolved = [
        rivals & set(r.answer.settled or ()) == {r.case.effect}
        for r in inseparable
        if r.answer and r.answer.verdict == "ambiguous"
    ]
    return _level("12", "next test, simulated, resolves it", "–", 0.80, True, resolved)


def uniform_p_values(records: list[Record]) -> tuple[float, float, int]:
    """Row 3: p of a Kolmogorov-Smirnov test of the nulls' p-values, the share of them in the lowest tenth, how many."""
    p = np.array([r.answer.p_value for r in records if r.answer and r.answer.p_value is not None])
    return float(kstest(p, "uniform").pvalue), float(np.mean(p <= 0.1)), len(p)


# Where positions are held out, the errors of their means count, not those of samples.
POSITIONED = ("tumble", "one_axis_tumble")


def gain_coverage(records: list[Record]) -> list[Level]:
    """Row 15: whether the interval of the gain holds what adding the right effect gains on average in white noise."""
    hits = []
    for r in records:
        white = r.case.noise == "white" and r.case.design not in POSITIONED
        if r.answer and r.score and r.score.named and white:
            _, low, high = r.answer.gain_ratio
            hits.append(bool(low <= true_gain(r.case) <= high))
    measure = "gain interval covers the true gain, white noise"
    return [_level("15", measure, "–", 0.88, True, hits), _level("15", measure, "–", 0.99, False, hits)]


def unknown_levels(records: list[Record]) -> list[Level]:
    """Rows 6 and 8 from effects that no catalogue has."""
    levels = []
    for size, must in ((3.0, 0.85), (10.0, 0.97)):
        group = _scores([r for r in records if r.case.times_mde == size])
        if group:
            flagged = [s for s in group if s.called_unknown]
            levels.append(
                _level(
                    "8",
                    f"unknown effect flagged, {size:g}×",
                    ".94-.98 / 1",
                    must,
                    True,
                    [s.called_unknown for s in group],
                )
            )
            levels.append(
                _level("8", f"driver right, {size:g}×", ".93-1", 0.80, True, [s.driver_right for s in flagged])
            )
        if group and size == 3.0:
            wrong = [s.firm_and_wrong for s in group]
            levels.append(_level("6", "firm and wrong, unknown effect, 3×", "2-3 %", 0.04, False, wrong))
    return levels
