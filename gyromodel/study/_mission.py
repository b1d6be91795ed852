"""What a calibrated gyro is used for, and the outcomes of it that its errors reach.

With e(t; p) = (output at p − output at p̂)/slope at p̂, the rate error that the calibration p̂ makes if the truth is p.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from gyromodel._model_units import check_units
from gyromodel.averages import MAXIMUM_ROWS, average
from gyromodel.campaign import Campaign
from gyromodel.estimate import check_covariates
from gyromodel.model import GyroModel, ModelError
from gyromodel.platform import Navigation, drift_errors, navigate, pushes_at_rest
from gyromodel.signals import Record, read_signals

# Outcomes that are told where none is named, if a mission has them.
USUAL = ("rate", "angle", "peak", "bias_temperature", "attitude", "position")
# Longer missions and tests are averaged to so many rows; those that are navigated sooner.
LONGEST = 200_000
# Temperatures (°C) at which the bias is taken for its temperature sensitivity, apart by so much, and the room's.
TEMPERATURE_STEP, ROOM = 1.0, 25.0


class Flight(NamedTuple):
    """Where a navigation begins, what ideal accelerometers sense in each step (m/s) of a length (s), and its course."""

    start: Navigation
    velocities: Float[Array, "sample 3"]
    step: Float[Array, ""]
    ideal: Navigation


class Mission(NamedTuple):
    """A mission as its outcomes see it, padded as signals are.

    Args:
        models: the calibrated gyros, one or those of the axes x, y and z; all see the same signals.
        signals: columns in internal units.
        duration: time that each sample stands for, s; zero in padding.
        last: row of the last sample.
        output: of each model, noise-free.
        slope: of each model.
        flight: where the mission is navigated.
        together: samples of the mission in each of these, which are their means.
    """

    models: tuple[GyroModel, ...]
    signals: dict[str, Float[Array, " sample"]]
    duration: Float[Array, " sample"]
    last: Int[Array, ""]
    output: Float[Array, "axis sample"]
    slope: Float[Array, "axis sample"]
    flight: Flight | None = None
    together: float = 1.0

    def errors(self, models: tuple[GyroModel, ...]) -> Float[Array, "axis sample"]:
        """Rate errors (rad/s) where the truth is other models than the calibrated ones; zero in padding."""
        output = jnp.stack([model.predict(self.signals) for model in models])
        return jnp.where(self.duration > 0, (output - self.output) / self.slope, 0.0)


@dataclass(frozen=True)
class Outcome:
    """One thing that matters of a mission, as a differentiable function.

    Attributes:
        name: what it is called.
        unit: in which it is reported; the function's values are in the internal unit of that.
        function: of the mission and the rate errors (axis, sample), or of the mission and the models; gives an array.
        of: which of the two.
        size: what its uncertainty is told by: the rms over its entries, or the largest of them.
        samples: whether its entries are those of the errors, so that padding is left out.
        entries: those that count, where not all do.
    """

    name: str
    unit: str
    function: Callable[..., Float[Array, ...]]
    of: Literal["errors", "models"] = "errors"
    size: Literal["rms", "peak"] = "rms"
    samples: bool = False
    entries: slice = field(default_factory=lambda: slice(None))

    def of_models(self, mission: Mission, models: tuple[GyroModel, ...]) -> Float[Array, " entry"]:
        """All of the function's entries where the truth is some models."""
        given = (mission.errors(models),) if self.of == "errors" else models
        return jnp.ravel(self.function(mission, *given))


def rate(mission: Mission, errors: Float[Array, "axis sample"]) -> Float[Array, "axis sample"]:
    """The rate error of each sample (rad/s)."""
    return errors


def angle(mission: Mission, errors: Float[Array, "axis sample"]) -> Float[Array, " axis"]:
    """∫e dt over the mission (rad)."""
    return errors @ mission.duration


def navigation(mission: Mission, errors: Float[Array, "axis sample"]) -> Float[Array, " 5"]:
    """Errors at the end of a space-stabilised platform that started at rest, its height known from an altimeter.

    Of the attitude (rad about north, up, east), then of the position (m, north and east).
    """
    assert mission.flight is not None
    start, velocities, step, ideal = mission.flight
    # What a gyro shows too much, its loop takes away; a height without an altimeter is lost within the hour.
    made = drift_errors(-errors.T, start, velocities, step, level=True, ideal=ideal)
    return jnp.concatenate([made.attitude[mission.last], made.position[mission.last][jnp.array([0, 2])]])


def bias_temperature(mission: Mission, *models: GyroModel) -> Float[Array, " axis"]:
    """Bt = max_i |B(T_i) − B(T_m)|/|T_i − T_m| over the mission's temperatures (rad/s per °C), T_m nearest to 25 °C.

    B is the steady bias: at rest, all other columns at their means over the mission.
    """
    return jnp.stack([_slope(mission, lambda at, m=m: m.predict(at) / m.slope(at)) for m in models])


def scale_temperature(mission: Mission, *models: GyroModel) -> Float[Array, " axis"]:
    """St = max_i |K(T_i)/K(T_m) − 1|/|T_i − T_m| (1/°C), K the scale factor at rest, as `bias_temperature`."""
    return jnp.stack([_slope(mission, lambda at, m=m: m.slope(at), relative=True) for m in models])


def scale_factor(mission: Mission, *models: GyroModel) -> Float[Array, " axis"]:
    """Relative error of the local scale factor, its mean over the mission."""
    slopes = jnp.stack([model.slope(mission.signals) for model in models])
    return jnp.mean(slopes / mission.slope - 1.0, axis=1, where=mission.duration > 0)


def scale_nonlinearity(mission: Mission, *models: GyroModel) -> Float[Array, " axis"]:
    """Kn = max_i |F(Ω_i) − line|/|K (Ω_max − Ω_min)| over the mission's rates Ω, K the slope of the line.

    The line is that of least squares; all other columns are at their means over the mission.
    """
    rates = _grid(mission, "rate")
    centred = rates - jnp.mean(rates)
    found = []
    for model in models:
        output = model.predict(_steady(mission) | {"rate": rates})
        slope = jnp.sum(centred * output) / jnp.sum(centred**2)
        off = output - jnp.mean(output) - slope * centred
        found.append(jnp.max(jnp.abs(off)) / jnp.abs(slope * (rates[-1] - rates[0])))
    return jnp.stack(found)


def _slope(mission: Mission, of: Callable[[dict[str, Array]], Array], relative: bool = False) -> Array:
    """Largest ratio of a steady quantity's change to that of the temperature, from the one nearest to the room's."""
    grid = _grid(mission, "temperature")
    at = _steady(mission)
    at |= {name: grid for name in at if name.startswith("temperature") and not name.endswith("_rate")}
    change = grid - (middle := jnp.clip(ROOM, grid[0], grid[-1]))
    far = jnp.abs(change) >= jnp.minimum(TEMPERATURE_STEP, 0.5 * (grid[-1] - grid[0]))
    values = of(at)
    room = jnp.interp(middle, grid, values)
    ratio = jnp.abs(values / room - 1.0 if relative else values - room) / jnp.where(far, jnp.abs(change), 1.0)
    return jnp.max(jnp.where(far, ratio, 0.0))


def _grid(mission: Mission, name: str) -> Float[Array, " sample"]:
    """Values of a column, evenly from the lowest to the highest of the mission."""
    known, values = mission.duration > 0, mission.signals[name]
    ends = jnp.min(values, where=known, initial=jnp.inf), jnp.max(values, where=known, initial=-jnp.inf)
    return jnp.linspace(*ends, len(values))


def _steady(mission: Mission) -> dict[str, Float[Array, " sample"]]:
    """At rest, nothing changing, all columns at their means over the mission."""
    known = mission.duration > 0
    return {
        name: jnp.full_like(v, 0.0 if name == "rate" or name.endswith("_rate") else jnp.mean(v, where=known))
        for name, v in mission.signals.items()
    }


OUTCOMES = {
    outcome.name: outcome
    for outcome in (
        Outcome("rate", "deg/h", rate, samples=True),
        Outcome("angle", "deg", angle),
        Outcome("peak", "deg/h", rate, size="peak", samples=True),
        Outcome("bias_temperature", "deg/h/degC", bias_temperature, of="models"),
        Outcome("scale_factor", "ppm", scale_factor, of="models"),
        Outcome("scale_temperature", "ppm/degC", scale_temperature, of="models"),
        Outcome("scale_nonlinearity", "ppm", scale_nonlinearity, of="models"),
        Outcome("attitude", "arcmin", navigation, entries=slice(0, 3)),
        Outcome("position", "m", navigation, entries=slice(3, 5)),
    )
}


def with_known_output(campaign: Campaign, number: int = 0) -> Campaign:
    """A planned campaign as if each sample had an output: what it is does not matter."""
    name = campaign.outputs[0]
    return campaign.with_column(name, np.arange(len(campaign), dtype=float) + number, campaign.units[name])


def read_mission(campaign: Campaign, models: tuple[GyroModel, ...]) -> tuple[Mission, Record]:
    """A campaign as a mission of some calibrated gyros, and its signals.

    Where its metadata have a latitude_deg it is navigated too, from a start at rest; long ones are averaged.

    Raises:
        ModelError: a model needs a column that the mission lacks, or that is of another unit.
    """
    most = MAXIMUM_ROWS if "latitude_deg" in campaign.metadata else LONGEST
    averaged, together = average(with_known_output(campaign), most)
    record = read_signals(averaged)
    models = tuple(model.prepared(record.signals) for model in models)
    for model in models:
        check_covariates(record, model)
        check_units(model, record.output_unit, record.units)
    step = np.diff(np.asarray(record.signals["time"]), append=0.0)
    # A sample stands for the time to the next one, at most two intervals where some are missing.
    step = np.where((step > 0) & (step < 2 * record.interval), step, record.interval)
    duration = np.where(np.arange(len(step)) < record.rows, step, 0.0)
    output = jnp.stack([m.predict(record.signals) for m in models])
    slope = jnp.stack([m.slope(record.signals) for m in models])
    if not bool(jnp.isfinite(output[:, : record.rows]).all()):
        raise ModelError(f"{campaign.name}: the model has no finite output on this mission")
    mission = Mission(
        models,
        record.signals,
        jnp.asarray(duration),
        jnp.asarray(record.rows - 1),
        output,
        slope,
        _flight(campaign, record),
        float(together),
    )
    return mission, record


def _flight(campaign: Campaign, record: Record) -> Flight | None:
    latitude = campaign.metadata.get("latitude_deg")
    if latitude is None:
        return None
    start = Navigation(
        jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.zeros(3), jnp.array([np.deg2rad(float(latitude)), 0.0, 0.0])
    )
    step = jnp.asarray(record.interval)
    pushes = _pushes(start, len(record.sampling.present), step)
    return Flight(start, pushes, step, navigate(start, jnp.zeros_like(pushes), pushes, step, level=True))


_pushes = jax.jit(pushes_at_rest, static_argnums=1)


def offered(mission: Mission) -> list[str]:
    """Outcomes that a mission has, by name."""
    names = ["rate", "angle", "peak", "scale_factor"]
    needed = {name for model in mission.models for effect in model.effects for name in effect.columns_needed}
    late = any(effect.remembers for model in mission.models for effect in model.effects)
    spans = {} if late else {n: float(jnp.ptp(v[mission.duration > 0])) for n, v in mission.signals.items()}
    if spans.get("rate", 0.0) > 0:
        names.append("scale_nonlinearity")
    if any(name.startswith("temperature") for name in needed) and spans.get("temperature", 0.0) > TEMPERATURE_STEP:
        names += ["bias_temperature", "scale_temperature"]
    if mission.flight is not None:
        names += ["attitude", "position"]
    return names
