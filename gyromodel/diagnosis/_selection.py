"""What a search has found and where it ended."""

from __future__ import annotations

from dataclasses import dataclass, field

from gyromodel.diagnosis._ranking import Ranking
from gyromodel.diagnosis._steps import FURTHER, Found
from gyromodel.estimate import Estimate

MAXIMUM_ROUNDS = 12


@dataclass(frozen=True)
class Selection:
    """Where the rounds ended: the extended fit, what was added, and the ranking in which no more was significant.

    `left_out` holds rankings beside everything found except one, where the search has made them; `remains` names what
    was still significant and not added, `beside_it` is the fit with it where there is one, and `unresolved` says why if
    it is too small. `alone` is the ranking beside the simulation where the path begins beside a driver's function.
    `rival` is a driver that explains more than the names do, but not by enough to take their place. `either` is a
    name that was found and another, which it hardly leads with what was found beside it.
    """

    estimate: Estimate
    found: tuple[Found, ...]
    path: tuple[Found, ...]
    last: Ranking
    estimates: tuple[Estimate, ...]
    driver: str | None
    left_out: dict[int, Ranking] = field(default_factory=dict, repr=False)
    remains: str = ""
    unresolved: str = ""
    beside_it: Estimate | None = field(default=None, repr=False)
    alone: Ranking | None = field(default=None, repr=False)
    rival: str | None = None
    either: tuple[str, str] | None = None

    @property
    def first(self) -> Ranking:
        """All candidates beside the simulation as it was given."""
        return self.alone or (self.path[0].ranking if self.path else self.last)

    @property
    def unfinished(self) -> bool:
        """Whether structure is left that would pass for a kind of noise."""
        return self.driver is not None or bool(self.remains)

    @property
    def followed(self) -> float:
        """The evidence (nats) of what follows the driver; none without one."""
        return self.last.statistic[self.driver] if self.driver else 0.0


def significant_driver(ranking: Ranking, threshold: float, further: bool) -> str | None:
    """The leading smooth driver, if it is significant, `further` to something that was found."""
    driver, score = ranking.best(drivers=True)
    return driver if driver and score >= threshold + ranking.more_needed(driver) + FURTHER * further else None
