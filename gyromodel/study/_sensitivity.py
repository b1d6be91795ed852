"""`sensitivity`: what a calibration's errors do to a mission, what they come from, and what to measure next."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from gyromodel.campaign import Campaign
from gyromodel.estimate import validity_unit
from gyromodel.model import ModelError
from gyromodel.study._budget import Budget, budget
from gyromodel.study._draws import BASE, Drawn, Indices, indices, monte_carlo
from gyromodel.study._instruments import Instrument
from gyromodel.study._known import Calibrated, Known, known, models_at
from gyromodel.study._mission import OUTCOMES, USUAL, Mission, Outcome, offered, read_mission
from gyromodel.study._next import REPEATED, NextTest, next_tests
from gyromodel.units import from_internal

# Parts of the mission at which the history of the angle's uncertainty is told.
EPOCHS = 120
# Ranges in files are rounded to ten digits.
ROUNDING = 1e-9


@dataclass(frozen=True)
class Result:
    """One outcome: its budget, what draws say of it, and its Sobol indices where they were asked for or needed."""

    budget: Budget
    drawn: Drawn
    sobol: tuple[Indices, ...]


@dataclass(frozen=True)
class History:
    """The angle's standard uncertainty (deg) over the mission, in all and by parameter alone, at times (s)."""

    time: Float[np.ndarray, " epoch"]
    std: Float[np.ndarray, " epoch"]
    alone: Mapping[str, Float[np.ndarray, " epoch"]]


@dataclass(frozen=True)
class Sensitivity:
    """The error budget of a mission.

    Attributes:
        results: by outcome, the first one leading.
        history: of the angle.
        tests: what to do next, the most helpful for the first outcome leading; empty where the model states no noise.
        warnings: sentences.
    """

    results: tuple[Result, ...]
    history: History
    tests: tuple[NextTest, ...]
    warnings: tuple[str, ...]

    def to_dict(self) -> dict[str, Any]:
        """Everything as plain data."""
        outcomes = {}
        for result in self.results:
            found = result.budget
            outcomes[found.outcome] = {
                "unit": found.unit,
                "value": found.value,
                "std": found.std,
                "std_with_noise_and_instruments": found.total,
                "parameters": [row._asdict() for row in found.rows],
                "stages": dict(found.stages),
                "noise": dict(found.noise),
                "instruments": dict(found.instruments),
                "monte_carlo": result.drawn._asdict(),
                "sobol": [index._asdict() for index in result.sobol],
            }
        return {
            "outcomes": outcomes,
            "angle_history": {"time": self.history.time.tolist(), "std": self.history.std.tolist(), "unit": "deg"},
            "next_tests": [test._asdict() for test in self.tests],
            "warnings": list(self.warnings),
        }

    def instrument_to_improve(self) -> str | None:
        """Which improvement buys most for the first outcome, in a sentence; None where none was tried or helps."""
        name, unit = self.results[0].budget.outcome, self.results[0].budget.unit
        as_is = next((t.std[name] for t in self.tests if t.sentence == REPEATED), None)
        better = [t for t in self.tests if t.kind != "test"]
        if as_is is None or not better or not better[0].std[name] < (1 - 1e-3) * as_is:
            return None
        what = better[0].sentence.removeprefix("Repeat the run with ").rstrip(".")
        return (
            f"Of what can be improved, {what} buys most: {better[0].std[name]:.3g} instead of {as_is:.3g} {unit} once "
            "the run is repeated."
        )


def sensitivity(
    calibrated: Calibrated | Sequence[Calibrated],
    mission: Campaign,
    outcomes: Sequence[str | Outcome] = (),
    *,
    design: Campaign | None = None,
    instruments: Mapping[str, Instrument] | None = None,
    design_instruments: Mapping[str, Instrument] | None = None,
    draws: int = 2000,
    sobol: bool = False,
    base: int = BASE,
    seed: int = 0,
) -> Sensitivity:
    """The error budget of calibrated gyros over a mission, checked by draws, and what to measure next.

    Args:
        calibrated: one gyro or three for the axes x, y and z. One alone stands for three alike where a mission is
            navigated.
        mission: its profile, such as `read_plan` makes; the output is not used. With metadata latitude_deg it is
            navigated too, from a start at rest.
        outcomes: names of `OUTCOMES` or outcomes of one's own; by default the usual ones that the mission has. The
            first leads.
        design: the campaign whose variants are tried as the next test; the mission by default.
        instruments: errors of the mission's columns.
        design_instruments: errors of the design's columns; those of the mission where that is the design.
        draws: of all parameters for each outcome.
        sobol: whether Sobol indices are computed also where the first order is borne out.
        base: their base samples, a power of two.
        seed: of all draws.

    Raises:
        ModelError: a model has no covariance, or cannot be evaluated on the mission or any test.
        ValueError: an outcome is not known or not offered by the mission.
    """
    gyros = known(calibrated)
    single, record = read_mission(mission, gyros.models)
    gyros = gyros._replace(models=single.models)
    has = offered(single)
    chosen = [_outcome(outcome, has) for outcome in outcomes] or [OUTCOMES[name] for name in USUAL if name in has]
    instruments = dict(instruments or {})
    tripled: tuple[Known, Mission] | None = None
    if len(gyros.models) == 1 and any(outcome.name in ("attitude", "position") for outcome in chosen):
        three = gyros.tripled()
        tripled = (
            three,
            single._replace(
                models=three.models,
                output=jnp.repeat(single.output, 3, axis=0),
                slope=jnp.repeat(single.slope, 3, axis=0),
            ),
        )
    rng, results, pairs = np.random.default_rng(seed), [], []
    for outcome in chosen:
        which, flown = tripled if tripled and outcome.name in ("attitude", "position") else (gyros, single)
        found = budget(outcome, which, flown, record, instruments)
        drawn = monte_carlo(outcome, found, which, flown, draws, rng)
        wanted = sobol or outcome.size == "peak" or not drawn.agrees
        results.append(Result(found, drawn, indices(outcome, which, flown, base, seed) if wanted else ()))
        pairs.append((which, found))
    warnings = _outside(gyros, single, record.rows)
    if single.together > 1:
        warnings.append(
            f"The mission was averaged by {single.together:g} samples: of errors that change sign within so many, as "
            "those of a scale factor do with the rate, only the means count."
        )
    tests: tuple[NextTest, ...] = ()
    if all(model.noise for model in gyros.models):
        errors = instruments if design is None else dict(design_instruments or {})
        tests = next_tests(gyros, pairs, mission if design is None else design, errors)
    else:
        warnings.append(
            "The model states no noise: the budget leaves it out, and what a next test would tell is not known."
        )
    return Sensitivity(tuple(results), _history(gyros, single), tests, tuple(warnings))


def _outcome(given: str | Outcome, has: Sequence[str]) -> Outcome:
    if isinstance(given, Outcome):
        return given
    if given not in OUTCOMES:
        raise ModelError(f"no outcome is called {given}; there are {', '.join(OUTCOMES)}")
    if given not in has:
        needs = "latitude_deg" if given in ("attitude", "position") else "a temperature that changes and matters"
        needs = "a rate that changes" if given == "scale_nonlinearity" else needs
        raise ModelError(
            f"this mission has no outcome {given}: it needs {needs}"
            + ", and a model without memory" * (given not in ("attitude", "position"))
        )
    return OUTCOMES[given]


def _outside(gyros: Known, mission: Mission, rows: int) -> list[str]:
    """Where a mission leaves the ranges of the calibration."""
    said = []
    for name, (low, high) in gyros.validity.items():
        if name not in mission.signals:
            continue
        values, unit = np.asarray(mission.signals[name])[:rows], validity_unit(name)
        margin = ROUNDING * max(abs(low), abs(high))
        if values.min() < low - margin or values.max() > high + margin:
            reached, valid = (
                f"{from_internal(a, unit):.6g} to {from_internal(b, unit):.6g}"
                for a, b in ((values.min(), values.max()), (low, high))
            )
            said.append(
                f"The mission's {name} goes from {reached} {unit}, the calibration only from {valid} {unit}: what the "
                "model errs beyond is not in the budget."
            )
    return said


@eqx.filter_jit
def _angles(models, vector: Array, mission: Mission) -> tuple[Array, Array]:
    """Derivative of the running angle's error by the parameters, of the first axis, and when each sample ends."""

    def running(v):
        return jnp.cumsum(mission.errors(models_at(models, v))[0] * mission.duration)

    return jax.jacfwd(running)(vector), jnp.cumsum(mission.duration)


def _history(gyros: Known, mission: Mission) -> History:
    """The angle's standard uncertainty over the mission, of the first axis."""
    jacobian, time = (np.asarray(x) for x in _angles(mission.models, jnp.asarray(gyros.vector), mission))
    last = int(mission.last)
    at = np.unique(np.linspace(0, last, min(EPOCHS, last + 1)).round().astype(int))
    jacobian = np.rad2deg(jacobian[at])
    covariance = gyros.covariance
    std = np.sqrt(np.maximum(np.einsum("ij,jk,ik->i", jacobian, covariance, jacobian), 0.0))
    own = np.sqrt(np.diag(covariance))
    alone = {p.name: np.abs(jacobian[:, i]) * own[i] for i, p in enumerate(gyros.parameters())}
    return History(time[at], std, alone)
