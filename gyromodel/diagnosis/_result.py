"""What a diagnosis found, in reporting units; `Diagnosis.to_dict` is the public `diagnosis.json`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

import numpy as np

from gyromodel.campaign import Campaign
from gyromodel.estimate import Estimate

# Share of the posterior that the credible set holds.
CREDIBLE = 0.95
# Standard uncertainties from which on a parameter has a size.
VAGUE = 2.0

Verdict = Literal["adequate", "named", "ambiguous", "unknown"]


@dataclass(frozen=True)
class ParameterValue:
    """A fitted parameter in its declared unit; `ci95` where that is not 1.96 `std` to either side.

    As noise may have helped it to be told, being large, or as it is an epoch.
    """

    name: str
    value: float
    std: float
    unit: str
    ci95: tuple[float, float] | None = None


@dataclass(frozen=True)
class Confuser:
    """Another effect that looks alike on this campaign; separation 0 is indistinguishable, 1 is orthogonal."""

    effect: str
    separation: float


@dataclass(frozen=True)
class Cause:
    """A discrepancy's cause: its evidence (ln of the evidence ratio), parameters, and what it could be mistaken for.

    Points that are given up are rows of what was searched, from 0, and `places` says where they are in the files.
    """

    effect: str
    parameters: tuple[ParameterValue, ...]
    statistic: float
    p_value: float
    p_adjusted: float
    posterior: float
    confusers: tuple[Confuser, ...] = ()
    points: tuple[int, ...] = ()
    places: str = ""


@dataclass(frozen=True)
class Candidate:
    """One entry of a round's ranking."""

    effect: str
    statistic: float
    posterior: float
    kind: Literal["effect", "driver", "noise"]


@dataclass(frozen=True)
class Round:
    """One step of the ladder: what was added, on what evidence, and the error on data not seen.

    The first adds nothing. `ranking` is of what could be added next, beside all that was added so far, and beside any
    function of the driver `beside` if there is one.
    """

    added: str | None
    statistic: float
    ranking: tuple[Candidate, ...]
    held_out: float
    log_score: float
    beside: str | None = None


@dataclass(frozen=True)
class Gain:
    """Held-out error before and after the extension, selected anew without each fold; `ratio` above 1 is better."""

    before: float
    after: float
    unit: str
    ratio: float
    ci95: tuple[float, float]
    scheme: str
    folds: int
    log_score: float
    log_score_ci95: tuple[float, float]


@dataclass(frozen=True)
class Driver:
    """The smooth function of one column (or of time) that an unknown discrepancy follows, with its standard error.

    `column` is a column a, d(a)/dt (its rate of change) or a[earlier] (its value some time before, of the rate its root
    mean square, which warms a torquer); rate[behind] is the rate some time before, less the rate. `nearest` is the
    catalogue effect that comes closest, `nearest_share` what part of the curve's work it does, `behind` by how many
    nats of evidence it is beaten. Of a function of two columns, `x` is the first and `second` the other there.
    """

    column: str
    unit: str
    x: np.ndarray
    y: np.ndarray
    std: np.ndarray
    y_unit: str
    nearest: str = ""
    nearest_share: float = 0.0
    behind: float = 0.0
    second: np.ndarray = field(default_factory=lambda: np.zeros(0))
    second_unit: str = ""


@dataclass(frozen=True)
class Diagnosis:
    """The whole answer; arrays have one entry per campaign row, residuals are measured minus model as a rate.

    `noise_kinds` is the posterior over what the noise is made of, "noise_white" alone or more joined by " + "; empty
    where the model states it. `evidence` is ln B of each candidate beside what was found, and of what was found and
    what is alike as it was added, less what a random walk would take of it, for coefficients of √10, 10, √1000 and
    100 standard errors: an archive adds it up over its units. `p_value` is the chance that a campaign of this design
    with nothing hidden shows as much evidence of an effect or of a driver as this one; None if the threshold was not
    calibrated.
    """

    verdict: Verdict
    causes: tuple[Cause, ...]
    driver: Driver | None
    gain: Gain
    next_test: str | None
    minimum_detectable: Mapping[str, tuple[float, str]]
    not_testable: Mapping[str, str]
    noise: Mapping[str, Mapping[str, float | str]]
    noise_kinds: Mapping[str, float]
    evidence: Mapping[str, tuple[float, ...]]
    rounds: tuple[Round, ...]
    credible_set: Mapping[str, float]
    unexplained: Mapping[str, float]
    findings: tuple[str, ...]
    threshold: float
    threshold_kind: Literal["safe", "calibrated"]
    p_value: float | None
    searched: tuple[str, ...]
    campaign: Campaign = field(repr=False)
    predicted_before: np.ndarray = field(repr=False)
    predicted_after: np.ndarray = field(repr=False)
    residual_before: np.ndarray = field(repr=False)
    residual_after: np.ndarray = field(repr=False)
    rate_unit: str = "deg/s"
    baseline: Estimate = field(repr=False, default=None)  # type: ignore[assignment]
    extended: Estimate = field(repr=False, default=None)  # type: ignore[assignment]

    def to_dict(self) -> dict[str, Any]:
        """The public, JSON-ready form."""
        driver = None
        if self.driver is not None:
            d = self.driver
            shape = {"x": d.x.tolist(), "y": d.y.tolist(), "std": d.std.tolist(), "x_unit": d.unit, "y_unit": d.y_unit}
            if d.second.size:
                shape |= {"second": d.second.tolist(), "second_unit": d.second_unit}
            nearest = {"effect": d.nearest, "share": d.nearest_share, "behind": d.behind} if d.nearest else None
            driver = {"column": d.column, "shape": shape, "nearest": nearest}
        return {
            "verdict": self.verdict,
            "causes": [asdict(c) for c in self.causes],
            "driver": driver,
            "gain": asdict(self.gain),
            "next_test": self.next_test,
            "minimum_detectable": {k: {"size": s, "unit": u} for k, (s, u) in self.minimum_detectable.items()},
            "not_testable": dict(self.not_testable),
            "noise": {k: dict(v) for k, v in self.noise.items()},
            "noise_kinds": dict(self.noise_kinds),
            "evidence": {k: list(v) for k, v in self.evidence.items()},
            "credible_set": dict(self.credible_set),
            "unexplained": dict(self.unexplained),
            "findings": list(self.findings),
            "rounds": [asdict(r) for r in self.rounds],
            "threshold": self.threshold,
            "threshold_kind": self.threshold_kind,
            "p_value": self.p_value,
            "searched": list(self.searched),
        }
