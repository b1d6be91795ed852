"""Scale factor and drifts over temperature: lines, hinges, and fits of all currents that carry the thermometry along.

Source: Xu, Deng, Zhang, Zhu, Lü, Gyroscope temperature test and modelling, Journal of Astronautics 1999(2), equations
(9)-(16).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from itertools import product
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from scipy.stats import f as fisher

from gyromodel.estimate import EstimateError, FunctionFit, fit_function
from gyromodel.multiposition import Conditions, StaticModel
from gyromodel.numerics.uncertain import Uncertain
from gyromodel.thermometry import thermistor

Form = Literal["line", "split", "hinge"]
Temperature = Uncertain | Float[Array | np.ndarray, " soak"]

# A corner is rounded over this much, °C: no chamber holds a soak closer, and a sharp corner at one has no derivative.
CORNER = 0.5
# Places tried for a breakpoint between the outer soaks, of one and of several, and how often its interval is looked at
# more closely.
PLACES, FEWER, ZOOMS = 121, 30, 4


class Row(NamedTuple):
    """One line of the table of a temperature model."""

    quantity: str
    segment: str
    at_zero: float
    at_zero_std: float
    slope: float
    slope_std: float
    scatter: float
    relative: float


@dataclass(frozen=True, eq=False)
class TemperatureModel:
    """Quantities over temperature: what `fit_temperature_model` found.

    Attributes:
        form: one line; two lines that part at `split`; or a line with hinges.
        names: of the quantities.
        fit: its value is a tuple: lines (quantity × segment × (A0, A1)), changes of slope and breakpoints (both
            quantity × hinge).
        breakpoint_interval: 95 % likelihood-ratio interval of each breakpoint, (quantity × hinge × end), °C.
    """

    form: Form
    names: tuple[str, ...]
    split: float
    fit: FunctionFit
    breakpoint_interval: Float[np.ndarray, "quantity hinge 2"] = field(repr=False)

    def predict(self, temperature: Float[Array, " sample"]) -> Uncertain:
        """All quantities at some temperatures, (quantity × sample)."""
        segment = jnp.where((temperature >= self.split) & (self.form == "split"), 1, 0)
        return self.fit.parameters.propagate(lambda value: _curves(value, segment, temperature))

    def table(self) -> tuple[Row, ...]:
        """A0 at 0 °C, slope A1, residual standard deviation S and S/|A0|, as the source prints them, a row a segment.

        With hinges, A0 and A1 are those of the line below the first breakpoint.
        """
        value, std = self.fit.value, self.fit.parameters.build(jnp.asarray(self.fit.parameters.std))
        segments = [f"below {self.split:g} °C", f"above {self.split:g} °C"] if self.form == "split" else ["all"]
        rows, scatter = [], self.fit.scatter.reshape(len(self.names), -1)
        for i, name in enumerate(self.names):
            for j, segment in enumerate(segments):
                a, u, s = value[0][i, j], std[0][i, j], float(scatter[i, j])
                numbers = (float(a[0]), float(u[0]), float(a[1]), float(u[1]), s, s / abs(float(a[0])))
                rows.append(Row(name, segment, *numbers))
        return tuple(rows)

    def __str__(self) -> str:
        lines = [f"{'':16}{'segment':14}{'A0':>12}{'±':>10}{'A1':>12}{'±':>10}{'S':>11}{'S/|A0|':>10}"]
        for r in self.table():
            numbers = f"{r.at_zero:12.5g}{r.at_zero_std:10.2g}{r.slope:12.4g}{r.slope_std:10.2g}"
            lines.append(f"{r.quantity:16}{r.segment:14}{numbers}{r.scatter:11.4g}{r.relative:10.5f}")
        _, changes, breaks = (np.asarray(v) for v in self.fit.value)
        for i, j in np.ndindex(*breaks.shape):
            low, high = self.breakpoint_interval[i, j]
            turn = f"slope changes by {changes[i, j]:.4g} at {breaks[i, j]:.1f} °C (95 %: {low:.1f} to {high:.1f})"
            lines.append(f"{self.names[i]:16}{turn}")
        return "\n".join(lines)


def fit_temperature_model(
    quantities: Mapping[str, Float[Array | np.ndarray, " soak"]],
    temperature: Temperature,
    form: Form = "line",
    *,
    split: float = 0.0,
    hinges: int = 1,
    name: str = "soaks",
) -> TemperatureModel:
    """Fit quantities measured at temperature soaks together, equations (9)-(12).

    Args:
        quantities: values at each soak by name, each of one scatter (and of one a segment with "split").
        temperature: of the soaks, °C; an uncertain one enters all quantities with the same errors.
        form: "line" A0 + A1 t; "split", two of them that part at `split`; "hinge", A0 + A1 t + Σ h max(t − b, 0), whose
            breakpoints b are estimated (the corner rounded over half a degree).
        split: °C.
        hinges: of each quantity, with "hinge".
        name: what these measurements are called in budgets.

    Raises:
        EstimateError: too few soaks for the form.
    """
    values = np.stack([np.asarray(v, float) for v in quantities.values()])
    known = isinstance(temperature, Uncertain)
    t = np.asarray(temperature.value if known else temperature, float)
    if not (np.isfinite(values).all() and np.isfinite(t).all()):
        raise EstimateError(f"{name}: a soak has a value or a temperature that is not a number: leave it out")
    segments, count = 2 if form == "split" else 1, hinges if form == "hinge" else 0
    # A soak keeps its side, wherever in its uncertainty the fit puts its temperature.
    segment = (t >= split).astype(int) if form == "split" else np.zeros(len(t), int)
    if np.bincount(segment, minlength=segments).min() < 3 + 2 * count:
        raise EstimateError(f"{name}: {form} needs {3 + 2 * count} soaks or more in each segment")
    lines = [[np.polyfit(t[segment == s], y[segment == s], 1)[::-1] for s in range(segments)] for y in values]
    changes, breaks = np.zeros((len(values), count)), np.zeros((len(values), count))
    for i, y in enumerate(values if count else ()):
        ordered = np.sort(t)
        tried = _tried(t, [(ordered[1], ordered[-2])] * count)
        if not len(tried):
            raise EstimateError(f"{count} hinges do not fit between {len(t)} soaks: ask for fewer")
        breaks[i] = tried[np.argmin(_misfits(t, y, np.eye(len(t)), tried))]
        solution = np.linalg.lstsq(_columns(t, breaks[i]), y, rcond=None)[0]
        lines[i], changes[i] = [solution[:2]], solution[2:]
    start = tuple(jnp.asarray(v) for v in (lines, changes, breaks))
    groups = (np.arange(len(values))[:, None] * segments + segment).ravel()
    data = (jnp.asarray(segment), None if known else jnp.asarray(t))
    given = temperature if known else None
    fit = fit_function(_quantities, start, values.ravel(), data, given=given, groups=groups, name=name)
    interval = _breakpoint_interval(fit, t, values, given)
    return TemperatureModel(form, tuple(quantities), split, fit, interval)


def _quantities(value: Any, data: tuple[Any, Any], temperature: Array | None = None) -> Array:
    segment, plugged = data
    return _curves(value, segment, plugged if temperature is None else temperature)


def _curves(value: tuple[Array, Array, Array], segment: Any, t: Array) -> Array:
    """All quantities at temperatures, (quantity × sample)."""
    lines, changes, breaks = value
    chosen = lines[:, segment]
    return chosen[..., 0] + chosen[..., 1] * t + jnp.einsum("qh,qhs->qs", changes, _corner(t - breaks[..., None]))


def _corner(x: Any) -> Any:
    """max(x, 0), its corner rounded."""
    return (x + (x**2 + CORNER**2) ** 0.5) / 2


def _columns(t: np.ndarray, breaks: np.ndarray) -> np.ndarray:
    return np.column_stack([np.ones(len(t)), t, *(_corner(t - b) for b in breaks)])


def _tried(t: np.ndarray, spans: list[tuple[float, float]]) -> np.ndarray:
    """Sets of breakpoints, each on a grid over its span, a soak apart."""
    grids = [np.linspace(low, high, PLACES if len(spans) == 1 else FEWER) for low, high in spans]
    apart = np.diff(np.sort(t)).max()
    sets = [b for b in product(*grids) if (np.diff(b) > apart).all()]
    return np.reshape(sets, (-1, len(spans)))


def _misfits(t: np.ndarray, y: np.ndarray, whitening: np.ndarray, tried: np.ndarray) -> np.ndarray:
    """The least sum of squares with each set of breakpoints."""
    columns = [whitening @ _columns(t, b) for b in tried]
    y = whitening @ y
    return np.array([np.sum((y - c @ np.linalg.lstsq(c, y, rcond=None)[0]) ** 2) for c in columns])


def _breakpoint_interval(fit: FunctionFit, t: np.ndarray, values: np.ndarray, given: Uncertain | None) -> np.ndarray:
    """Breakpoints that a likelihood ratio does not reject, for each quantity by itself, temperature errors included."""
    count = fit.value[2].shape[1]
    interval = np.zeros((len(values), count, 2))
    thermometry = np.zeros((len(t), len(t))) if given is None else given.covariance
    # The temperature of a soak changes the values at this soak alone.
    slopes = np.asarray(
        jax.jvp(lambda x: _curves(fit.value, np.zeros(len(t), int), x), (jnp.asarray(t),), (jnp.ones(len(t)),))[1]
    )
    freedom = len(t) - 2 - 2 * count
    for i, y in enumerate(values if count else ()):
        covariance = fit.scatter[i] ** 2 * np.eye(len(t)) + slopes[i][:, None] * thermometry * slopes[i]
        whitening = np.linalg.inv(np.linalg.cholesky(covariance))
        ordered, best = np.sort(t), np.sort(fit.value[2][i])
        spans = [(ordered[1], ordered[-2])] * count
        for _ in range(ZOOMS):
            tried = np.concatenate([best[None], _tried(t, spans)])
            misfit = _misfits(t, y, whitening, tried)
            kept = tried[misfit <= misfit.min() * (1 + fisher.ppf(0.95, 1, freedom) / freedom)]
            # As far as the first place on either side that is rejected.
            step = np.array([(high - low) / (PLACES if count == 1 else FEWER) for low, high in spans])
            low, high = kept.min(axis=0) - step, kept.max(axis=0) + step
            spans = list(zip(np.maximum(low, ordered[1]), np.minimum(high, ordered[-2]), strict=True))
        interval[i] = spans
    return interval


class Soaks(NamedTuple):
    """Currents of one gyro in the same runs at every soak.

    Attributes:
        currents: A.
        conditions: of the runs.
        std: standard deviation of the current of each run, but for the unknown factor of its group.
        groups: number of each run's group from 0, by where its noise comes from.
        names: of the groups.
    """

    currents: Float[Array | np.ndarray, "soak run"]
    conditions: Conditions
    std: Float[Array | np.ndarray, " run"]
    groups: Int[np.ndarray, " run"]
    names: tuple[str, ...]


class ThermistorReadings(NamedTuple):
    """Readings of a thermistor (ohm) beside a reference thermometer (°C), and in the soaks of a gyro."""

    resistance: Float[Array | np.ndarray, " point"]
    temperature: Float[Array | np.ndarray, " point"]
    soaks: Float[Array | np.ndarray, " soak"]


def fit_currents(soaks: Soaks, temperature: Temperature) -> FunctionFit:
    """Lines A0 + A1 t of scale factor and drifts, equations (9)-(12), from all currents through equation (1).

    Args:
        soaks: the currents.
        temperature: of the soaks, °C: known, or with the uncertainty of the stage before, which then enters all four
            quantities with the same errors.

    Returns:
        The fit; its value is a `StaticModel` whose fields hold (A0, A1).

    Raises:
        EstimateError: the currents do not determine the lines, or the fit did not converge.
    """
    known = isinstance(temperature, Uncertain)
    t = np.asarray(temperature.value if known else temperature, float)
    data = (soaks.conditions, None if known else jnp.asarray(t))
    return fit_function(
        _predicted_currents,
        _start(soaks, t),
        np.ravel(soaks.currents),
        data,
        given=temperature if known else None,
        std=np.tile(soaks.std, len(t)),
        groups=np.tile(soaks.groups, len(t)),
        name=soaks.names,
    )


def fit_jointly(
    soaks: Soaks,
    readings: ThermistorReadings,
    start: FunctionFit,
    given: Uncertain | None = None,
    name: str = "thermometry",
) -> FunctionFit:
    """Thermistor and lines in one problem: resistances, table rates and six positions together.

    Args:
        soaks: the currents.
        readings: the resistances.
        start: `fit_thermistor` of the calibration, whose segments and continuity are kept.
        given: errors of ln R in the soaks, values of zero with their uncertainty.
        name: what the calibration is called in budgets.

    Returns:
        The fit; its value is the `Thermistor` and a `StaticModel` of lines.

    Raises:
        EstimateError: the readings do not determine the coefficients, or the fit did not converge.
    """
    terms = start.value.terms
    points, segments = len(readings.resistance), terms[1].shape[0]
    t = np.asarray(start.value.temperature(jnp.asarray(readings.soaks)))
    segment = segments - 1 - (np.asarray(readings.resistance) > float(start.value.reference)) * (segments - 1)
    data = (start.value.reference, *(jnp.asarray(r) for r in (readings.resistance, readings.soaks)))
    fit = fit_function(
        _predicted_readings,
        (terms, _start(soaks, t)),
        np.concatenate([readings.temperature, np.ravel(soaks.currents)]),
        (data, soaks.conditions),
        given=given,
        std=np.concatenate([np.ones(points), np.tile(soaks.std, len(t))]),
        groups=np.concatenate([segment, segments + np.tile(soaks.groups, len(t))]),
        name=(*[name] * segments, *soaks.names),
    )
    return replace(fit, parameters=fit.parameters.propagate(lambda v: (thermistor(v[0], data[0]), v[1])))


def _predicted_currents(lines: StaticModel, data: tuple[Conditions, Array | None], given: Array | None = None) -> Array:
    conditions, plugged = data
    t = plugged if given is None else given
    return jax.tree.map(lambda a: a[0] + a[1] * t, lines).current(conditions)


def _predicted_readings(value: Any, data: Any, errors: Array | float = 0.0) -> Array:
    terms, lines = value
    (reference, resistance, soaks), conditions = data
    thermometer = thermistor(terms, reference)
    t = thermometer.temperature(soaks * jnp.exp(-jnp.asarray(errors)))
    return jnp.concatenate(
        [thermometer.temperature(resistance), jnp.ravel(_predicted_currents(lines, (conditions, t)))]
    )


def _start(soaks: Soaks, t: np.ndarray) -> StaticModel:
    """Lines by SF·I − Df − Di a_i − Ds a_s = ω, which is linear in them."""
    currents = np.asarray(soaks.currents)
    acceleration_input, acceleration_spin, rate = (np.asarray(c) for c in soaks.conditions)
    one = np.ones(currents.shape)
    columns = np.stack([currents, -one, -acceleration_input * one, -acceleration_spin * one], axis=-1)
    columns = np.concatenate([columns, columns * t[:, None, None]], axis=-1) / soaks.std[:, None]
    columns = columns.reshape(-1, 8)
    norm = np.linalg.norm(columns, axis=0)
    scale = np.where(norm > 0, norm, 1.0)
    solution = np.linalg.lstsq(columns / scale, (rate / soaks.std * one).ravel(), rcond=None)[0] / scale
    return StaticModel(*jnp.asarray(solution.reshape(2, 4).T))
