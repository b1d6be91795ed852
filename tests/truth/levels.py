"""What the study's records come to: shares against the levels to reach, with intervals of the binomial law."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import beta, binom, kstest

from .noise import FAMILY, OUTSIDE
from .study import SLOW, Record
from .verdicts import Score


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
    def met(self) -> bool:
        """The interval does not exclude the level."""
        return self.interval[1] >= self.must if self.at_least else self.interval[0] <= self.must

    @property
    def plausible(self) -> bool:
        """Not worse than the level loosened by 2.5 standard errors: for small samples."""
        tail = 0.0062
        if self.at_least:
            return bool(self.count >= binom.ppf(tail, self.total, self.must))
        return bool(self.count <= binom.ppf(1 - tail, self.total, self.must))


def _scores(records: list[Record]) -> list[Score]:
    return [r.score for r in records if r.score]


def _level(row: str, measure: str, prototype: str, must: float, at_least: bool, flags: list[bool]) -> Level:
    return Level(row, measure, prototype, must, at_least, sum(flags), len(flags))


def null_levels(records: list[Record]) -> list[Level]:
    """Rows 1, 2 and 15 from campaigns with nothing hidden."""
    family = [r for r in records if r.case.noise in FAMILY]
    levels = [
        _level("1", "false extension, all noises pooled", "0-1.2 %", 0.02, False, [s.detected for s in _scores(family)])
    ]
    for noise in (*FAMILY, *OUTSIDE):
        flags = [r.score.detected for r in records if r.score and r.case.noise == noise]
        if flags:
            levels.append(_level("2", f"false extension, {noise.replace('_', ' ')}", "≤ 7.8 %", 0.04, False, flags))
    claimed = [s.gain_claimed for s in _scores(records)]
    return [*levels, _level("15", "gain claimed with nothing hidden", "1-2.5 %", 0.05, False, claimed)]


_ROW4 = {1.0: 0.93, 3.0: 0.97}
_ROW5 = {1.0: 0.55, 3.0: 0.92, 10.0: 0.99}


def effect_levels(records: list[Record]) -> list[Level]:
    """Rows 4, 5, 6, 7 and 9 from catalogue effects; rows 4 and 5 on isolable campaigns, each row by size."""
    levels = []
    for size in sorted({r.case.times_mde for r in records}):
        group = [r for r in records if r.case.times_mde == size and r.score]
        alone = [r for r in group if r.isolable and r.case.effect not in SLOW]
        at = f"{size:g}×"
        if size in _ROW4:
            knew = [r.oracle_first == r.case.effect for r in alone]
            found = [r.score.first_right for r in alone if r.score]
            must = _ROW4[size] * float(np.mean(knew)) if knew else 0.0
            levels.append(
                _level("4", f"first name right ÷ oracle ({np.mean(knew):.3f}), {at}", ".97-1", must, True, found)
            )
        if size in _ROW5:
            named = [r.score.named for r in alone if r.score]
            levels.append(
                _level("5", f"detected and named, isolable, {at}", ".56-.76/.92-.99/1", _ROW5[size], True, named)
            )
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


def mean_set_size(records: list[Record]) -> float:
    """Row 7: mean size of the credible set at 3 x MDE, isolable campaigns (must be under 1.5)."""
    sizes = [
        r.score.set_size for r in records if r.score and r.isolable and r.case.times_mde == 3.0 and r.score.detected
    ]
    return float(np.mean(sizes)) if sizes else float("nan")


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
            [not s.named for s in _scores(drifts)],
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
            if r.case.times_mde == times and r.answer and r.score and r.score.named and name in SIZED:
                value, std = r.answer.sizes[name]
                hits.append(bool(abs(value - SIZED[name] - r.truth.amplitude) <= 1.96 * std))
        levels.append(_level("16", f"95 % interval of the size, after selection, {times:g}×", "–", must, True, hits))
    return levels


def adequacy_level(records: list[Record]) -> Level:
    """Row 17: the extended model lacks nothing."""
    after = [r.answer.adequate_after for r in records if r.answer and r.score and r.score.named]
    return _level("17", "extended model is adequate, 3×", "–", 0.95, True, [a for a in after if a is not None])


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


def gain_coverage(records: list[Record]) -> Level:
    """Row 15: in white noise the residual falls by sqrt(1 + lambda^2/n) when the right effect is added."""
    hits = []
    for r in records:
        if r.answer and r.score and r.score.named and r.case.noise == "white":
            _, low, high = r.answer.gain_ratio
            hits.append(low <= np.sqrt(1 + r.size**2 / len(r.truth.noise)) <= high)
    return _level("15", "gain interval covers the true gain, white noise (must: 88-99 %)", "–", 0.88, True, hits)


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
