"""What counts as a right answer about a hidden effect.

ACCEPTED lists every answer other than the effect's own name that is right, with the reason. Where the campaign cannot
isolate the effect at its size (the oracle's principal angles say so), an ambiguous set that holds it is right too.
Nothing else is accepted.
"""

from __future__ import annotations

from dataclasses import dataclass

from .campaigns import Truth, known
from .mde import parts


@dataclass(frozen=True)
class Accepted:
    """`stand_ins` may be named firmly instead of the truth; `ambiguous` accepts an ambiguous set that holds it."""

    truth: str
    stand_ins: frozenset[str]
    ambiguous: bool
    reason: str
    designs: tuple[str, ...] = ()  # empty: all


_SLOW = "one run cannot tell a slow change of bias from random walk or flicker"
ACCEPTED = (
    Accepted("bias_drift", frozenset(), True, _SLOW),
    Accepted("bias_step", frozenset(), True, _SLOW),
    Accepted("bias_warmup", frozenset(), True, _SLOW),
    Accepted("scale_sagnac_sine", frozenset({"scale_nonlinearity"}), True, "a sine equals a cubic to third order"),
    Accepted("bias_temperature", frozenset(), True, "temperature is a line in time on one ramp", ("static_ramp",)),
    *(
        Accepted(
            e,
            frozenset(),
            True,
            "beside scale factor and bias one direction in the plane is left",
            ("one_axis_tumble",),
        )
        for e in ("misalignment", "bias_acceleration_input", "bias_acceleration_spin")
    ),
    *(
        Accepted(e, frozenset(), True, "each is one turn of the same angle", ("one_field",))
        for e in ("table_tilt", "bias_magnetic", "table_harmonic")
    ),
)


@dataclass(frozen=True)
class Answer:
    """What the engine said, as plain values."""

    verdict: str
    causes: tuple[str, ...]
    first: str  # top of the first round's ranking, whatever the verdict
    sizes: dict[str, tuple[float, float]]  # 95 % interval of each cause's first parameter, in SI
    noise: str  # the likeliest make-up of the noise
    p_value: float | None  # of the campaign as one with nothing hidden, where that was simulated
    adequate_after: bool | None  # whether the extended model, diagnosed again, lacks nothing
    settled: tuple[str, ...] | None  # credible set after the further test that was asked for
    credible: tuple[str, ...]
    driver: tuple[str, ...]
    gain_ratio: tuple[float, float, float]  # value, low, high
    gain_score: tuple[float, float, float]  # nats: value, low, high
    margin: float = float("-inf")  # evidence (nats) of what comes first, but gross errors, over what it needs


@dataclass(frozen=True)
class Score:
    """One case judged."""

    right: bool
    detected: bool
    named: bool  # firmly named, and nothing else
    firm_and_wrong: bool
    in_set: bool
    set_size: int
    called_unknown: bool
    first_right: bool
    driver_right: bool
    gain_claimed: bool  # its interval is above zero
    gain_shown: bool


def allowed(truth: str, design: str) -> tuple[frozenset[str], bool]:
    """The names that are right for a hidden effect, and whether a set that holds it is right on any campaign."""
    rows = [a for a in ACCEPTED if a.truth == truth and (not a.designs or design in a.designs)]
    return frozenset({truth}).union(*(a.stand_ins for a in rows)), any(a.ambiguous for a in rows)


def judge(truth: Truth, design: str, answer: Answer, isolable: bool = True) -> Score:
    """Judge an answer against what was hidden; `isolable`: whether every rival separates from it on this campaign."""
    detected, firm = answer.verdict != "adequate", answer.verdict == "named"
    names = frozenset(answer.causes)
    # The set is that of the strongest cause: of two hidden effects the other is among the causes.
    members = frozenset(answer.credible) | (names if len(parts(truth.effect)) > 1 else frozenset())
    driver_right = answer.verdict == "unknown" and set(answer.driver) == set(truth.driver or ())
    exact = in_set = False
    if truth.effect is None:
        ours, right = frozenset(), not detected
    elif not known(truth.effect):
        ours, right = frozenset(), driver_right
    else:
        each = [allowed(part, design) for part in parts(truth.effect)]
        ours, tolerant = frozenset().union(*(names for names, _ in each)), any(t for _, t in each)
        exact = firm and len(names) == len(each) and names <= ours and all(names & a for a, _ in each)
        in_set = all(a & members for a, _ in each)
        right = exact or (
            (tolerant or not isolable) and answer.verdict == "ambiguous" and members >= set(parts(truth.effect))
        )
    return Score(
        right=right,
        detected=detected,
        named=exact,
        firm_and_wrong=firm and not names <= ours,
        in_set=in_set,
        set_size=max(len(answer.credible), 1),
        called_unknown=answer.verdict == "unknown",
        first_right=answer.first in ours,
        driver_right=driver_right,
        gain_claimed=answer.gain_score[1] > 0,
        gain_shown=answer.gain_score[0] > 0,
    )
