"""The units that a model's parameters have, and whether they suit those of a campaign."""

from __future__ import annotations

from collections.abc import Mapping

from gyromodel._checks import of_usual_unit, usual_unit
from gyromodel.effects import Effect
from gyromodel.effects._base import Domain
from gyromodel.effects.converter import Quantisation
from gyromodel.effects.drivers import BiasColumn
from gyromodel.model import OF, GyroModel, ModelError
from gyromodel.signals import domain_of
from gyromodel.units import convertible


def parameter_unit(effect: Effect, field: str, output_unit: str, units: Mapping[str, str]) -> str:
    """The unit a parameter is reported in.

    A gain's and a readout's follow the output, a linear driver's its column (file units).
    """
    if effect.site == "readout":
        own = getattr(effect, "unit", "")
        return own if own not in ("", "1") else "deg/s" if output_unit == "rad/s" else output_unit
    if effect.site == "gain":
        if output_unit == "rad/s":
            return "1"
        return f"{output_unit[:-2]}/deg" if output_unit.endswith("/s") else f"{output_unit}/(deg/s)"
    unit = effect.declared()[field].unit
    if isinstance(effect, BiasColumn):
        column = units.get(effect.column, "")
        return f"{unit}/({column})" if column not in ("", "1") else unit
    return unit


def check_domain(model: GyroModel, domain: Domain) -> None:
    """Refuse a model of a gyro for a platform, and the other way round."""
    if model.domain not in (domain, None):
        named = f"effect {model.effects[0].label}" if model.effects else "the noise of the model"
        raise ModelError(f"{named} is of {OF[model.domain]}, but the campaign is of {OF[domain]}")


def check_reading(reading: Quantisation | None, unit: str) -> None:
    """Refuse steps in a unit other than that of the output they are of."""
    if reading is not None and reading.unit and not convertible(reading.unit, unit):
        given = "a plain number" if reading.unit == "1" else f"in {reading.unit}"
        raise ModelError(f"{reading.label} is {given}, but the output is in [{unit}]: expected {unit}")


def check_units(model: GyroModel, output_unit: str, units: Mapping[str, str]) -> None:
    """Refuse a scale factor or a driver's coefficient that was written in a unit which does not suit the campaign.

    Counts may leave out "per second", in the output as in the scale factor: count/deg and count/(deg/s) mean the same.
    """
    check_domain(model, domain_of(output_unit))
    if output_unit not in ("rad/s", "rad") and not any(e.site == "gain" for e in model.effects):
        raise ModelError(f"the output is in [{output_unit}], which is no angular rate: the model needs a scale_factor")
    for effect in model.effects:
        foreign = [n for n in effect.columns_needed if n in units and not of_usual_unit(n, units[n])]
        if foreign and not isinstance(effect, BiasColumn):
            raise ModelError(
                f"{effect.label} needs {foreign[0]} in a unit like {usual_unit(foreign[0])}, but it is in "
                f"[{units[foreign[0]]}]"
            )
        written = getattr(effect, "unit", "")
        if not written:
            continue
        name = next(iter(effect.declared()))
        what = f"the output is in [{output_unit}]"
        accepted = [] if effect.site == "readout" else [parameter_unit(effect, name, output_unit, units)]
        if isinstance(effect, BiasColumn):
            what = f"column {effect.column} is in [{units.get(effect.column, '')}]"
        if effect.site == "gain":
            raw = output_unit.removesuffix("/s")
            accepted = [f"{raw}/deg", f"{raw}/(deg/s)"] if raw in ("count", "bit") else accepted
        if effect.site == "readout":  # of increments and angles it is the angle that is read
            accepted = [output_unit, output_unit.removesuffix("/s")]
        if not any(convertible(written, unit) for unit in accepted):
            given = "a plain number" if written == "1" else f"in {written}"
            expected = " or ".join("a plain number" if unit == "1" else unit for unit in accepted)
            raise ModelError(f"{effect.label} is {given}, but {what}: expected {expected}")
