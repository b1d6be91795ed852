"""Errors of the instruments that a plan's columns come from: thermometers, the rate table, and others."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from gyromodel._checks import CampaignError
from gyromodel.campaign import Campaign
from gyromodel.model import GyroModel
from gyromodel.plan import read_yaml
from gyromodel.study._mission import Mission
from gyromodel.units import UnitError, convertible, factor, internal_unit, quantity

KINDS = ("common", "independent")


class Instrument(NamedTuple):
    """Standard errors of a column, internal units: one error all along, and one of its own for each sample.

    Each is a size, or a part of the column's value.
    """

    common: float = 0.0
    independent: float = 0.0
    common_part: float = 0.0
    independent_part: float = 0.0

    def all_along(self, values: np.ndarray) -> np.ndarray:
        """What each error that is one all along makes of some values of the column: a part of it has their sign."""
        both = (self.common, np.full(len(values), self.common)), (self.common_part, self.common_part * values)
        return np.array([error for size, error in both if size]).reshape(-1, len(values))

    def of_each(self, values: np.ndarray) -> np.ndarray:
        """Standard errors that each of some values has for itself."""
        return np.hypot(self.independent, self.independent_part * values)

    def improved(self, part: float) -> Instrument:
        """The same with a part of its errors."""
        return Instrument(*(part * size for size in self))


def read_instruments(path: str | Path, campaign: Campaign) -> dict[str, Instrument]:
    """Errors that a plan's file states of its columns, as `instruments: {temperature: 0.05 degC}`.

    A quantity is one error all along; `{common: 0.05 degC, independent: 0.01 degC}` tells both kinds. A plain number or
    ppm is a part of the column's value.

    Args:
        path: the plan.
        campaign: what `read_plan` made of it.

    Raises:
        CampaignError: a column is not there, or an error is none.
    """
    stated: Any = read_yaml(Path(path)).get("instruments") or {}
    if not isinstance(stated, Mapping):
        raise CampaignError(f"{campaign.name}: instruments maps columns to errors, such as {{temperature: 0.05 degC}}")
    found = {}
    for name, given in stated.items():
        if name not in campaign.columns or name == "time":
            raise CampaignError(f"{campaign.name}: instruments names {name}, which is no column of the plan")
        sizes = given if isinstance(given, Mapping) else {"common": given}
        if unknown := set(sizes) - set(KINDS):
            raise CampaignError(f"{campaign.name}: an instrument's error is common or independent, not {min(unknown)}")
        errors = {}
        for kind, text in sizes.items():
            try:
                value, unit = quantity(str(text))
            except UnitError as error:
                raise CampaignError(f"{campaign.name}: instruments, {name}: {error}") from None
            own = campaign.units[name]
            relative = convertible(unit, "1") and not convertible(own, "1")
            if value < 0 or not (relative or convertible(unit, own)):
                raise CampaignError(
                    f"{campaign.name}: the {kind} error of {name} is {text}, no size in a unit like {own}"
                )
            if relative:
                errors[f"{kind}_part"] = value * factor(unit or "1", "1")
            else:
                errors[kind] = value * _interval(unit)
        found[name] = Instrument(**errors)
    return found


def _interval(unit: str) -> float:
    """Internal units in one of a unit, of differences: 1 K is 1 °C."""
    return factor(unit, internal_unit(unit))


@eqx.filter_jit
def _along(model: GyroModel, signals: dict[str, Array], name: str) -> Float[Array, " sample"]:
    values = signals[name]
    return jax.jvp(lambda v: model.predict({**signals, name: v}), (values,), (jnp.ones_like(values),))[1]


def output_by_column(model: GyroModel, signals: Mapping[str, Array], name: str) -> np.ndarray:
    """Change of the output by a small shift of a whole column: a thermometer's rate stays."""
    return np.asarray(_along(model, dict(signals), name))


def by_column(mission: Mission, name: str) -> Float[np.ndarray, "axis sample"]:
    """Change of the rate that each calibrated gyro tells by a small shift of a whole column."""
    changes = np.stack([output_by_column(model, mission.signals, name) for model in mission.models])
    return np.where(np.asarray(mission.duration) > 0, changes / np.asarray(mission.slope), 0.0)
