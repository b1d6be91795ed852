"""A calibration as C99 source.

The model is lowered from the very JAX function that `compensate` inverts, so that no equation is written twice.
"""

from __future__ import annotations

import re
import textwrap
from collections.abc import Iterable
from pathlib import Path
from string import Template

import jax
import jax.numpy as jnp
import numpy as np

from gyromodel import __version__
from gyromodel._checks import thermometers, usual_unit
from gyromodel.compensation import LEVEL, MOST_STEPS, TOLERANCE, WAYPOINTS, output_and_slope
from gyromodel.effects.drivers import BiasColumn
from gyromodel.estimate import Calibration
from gyromodel.export._tables import FORMULA, column_unit, entries, shown_names, validity
from gyromodel.model import GyroModel, ModelError
from gyromodel.numerics.c_code import NoCForm, Statements, literal
from gyromodel.units import internal_unit

TEMPLATE = Path(__file__).with_name("template.h")
SIGNAL_MEANINGS = {
    "output": "measured",
    "time": "since the start of the run",
    "time_on": "since power-on",
}
# Three samples are lowered and the middle one is written: what stands for its neighbours must not be needed.
NEIGHBOUR = "neighbour"
# Samples that rounding is tried on, and how many of them the file holds; where they lie, if no range is calibrated.
TRIALS, TESTS = 200, 8
SPANS = {"time": (0.0, 3600.0), "time_on": (0.0, 3600.0), "temperature": (0.0, 40.0)}
RATES = (-0.02, 0.02)


def as_c(calibration: Calibration) -> str:
    """One self-contained C99 file.

    Raises:
        ModelError: an effect looks at other samples, or computes what a few C statements cannot.
    """
    model = calibration.model
    members = _members(model)
    for effect in model.effects:
        try:
            reached = {NEIGHBOUR} if effect.remembers else _lowered(GyroModel((effect,)), members)[1]
        except NoCForm as problem:
            raise ModelError(
                f"effect {effect.label} cannot be exported to C, which has no short form of {problem}"
            ) from None
        if NEIGHBOUR in reached:
            raise ModelError(f"effect {effect.label} cannot be exported to C: it looks at other samples than its own")
    statements, reached, output, slope = _lowered(model, members)
    meanings = SIGNAL_MEANINGS | {
        f"{name}_rate": "of a smoothing spline through the thermometer's whole record" for name in thermometers(members)
    }
    fields = [
        f"    double {member};" + (f" /* {meanings[name]} */" if name in meanings else "")
        for name, member in members.items()
        if name == "output" or f"x->{member}" in reached
    ]
    return Template(TEMPLATE.read_text(encoding="utf-8")).substitute(
        about=_about(calibration, _rounding(calibration, members)),
        members="\n".join(fields),
        constants="\n".join(f"    {line}" for line in _constants(calibration, reached)),
        statements="\n".join(f"    {line}" for line in statements),
        output=output,
        slope=slope,
        gain=literal(float(model.gain())),
        measured=members["output"],
        steps=MOST_STEPS,
        waypoints=WAYPOINTS,
        tolerance=literal(TOLERANCE),
        level=literal(LEVEL),
        tests=_tests(calibration, members, [n for n, m in members.items() if n == "output" or f"x->{m}" in reached]),
    )


def _trials(calibration: Calibration, names: Iterable[str]) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Samples all over the calibrated ranges, by name and without their output, and the rates that they are of."""
    rng = np.random.default_rng(0)
    low, high = calibration.validity.get("rate", (-1.0, 1.0))
    rate = np.concatenate([np.linspace(low, high, TRIALS // 2), rng.uniform(low, high, TRIALS // 2)])
    signals = {}
    for name in set(names) - {"output"}:
        ends = calibration.validity.get(name, SPANS.get(name, (0.0, 1.0)))
        signals[name] = rng.uniform(*(RATES if name.endswith("_rate") else ends), TRIALS)
    return signals, rate


@jax.jit
def _output_and_slope(model: GyroModel, signals: dict[str, jax.Array]) -> tuple[jax.Array, jax.Array]:
    output, slope = output_and_slope(model, signals)
    return output, slope / model.gain()


def _at(model: GyroModel, signals: dict[str, np.ndarray], rate: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Output, and its slope over the gain."""
    output, slope = _output_and_slope(model, jax.tree.map(jnp.asarray, signals | {"rate": rate}))
    return np.asarray(output), np.asarray(slope)


def _tests(calibration: Calibration, names: Iterable[str], written: list[str]) -> str:
    """Samples with their rates, as initialisers in C."""
    model = calibration.model
    signals, rate = _trials(calibration, names)
    output, slope = _at(model, signals, rate)
    # Where the output rises all the way from rest, and steeply enough there to tell the rate.
    known = slope > 1e-3
    for part in np.arange(WAYPOINTS + 1) / (WAYPOINTS + 1):
        known &= _at(model, signals, part * rate)[1] > -LEVEL
    rows = {**signals, "output": output}
    chosen = np.flatnonzero(known)
    chosen = chosen[:: max(len(chosen) // TESTS, 1)][:TESTS]
    lines = [", ".join(literal(float(rows[n][i])) for n in written) + f"}}, {literal(float(rate[i]))}" for i in chosen]
    return "\n".join(f"        {{{{{line}}}," for line in lines) or "        {{0}, NAN},"


def _rounding(calibration: Calibration, names: Iterable[str]) -> tuple[float, float]:
    """Largest error of a rate whose sample and constants are rounded: to single precision, to 32-bit fixed point."""
    signals, rate = _trials(calibration, names)
    output, slope = _at(calibration.model, signals, rate)

    def fixed(x: np.ndarray) -> np.ndarray:
        largest = np.abs(x).max(initial=0.0)
        unit = 2.0 ** (np.ceil(np.log2(largest)) - 31) if largest > 0 else 1.0
        return np.asarray(np.round(x / unit) * unit)

    errors = []
    for rounded in (lambda x: np.asarray(x.astype(np.float32), float), fixed):
        model = jax.tree.map(lambda x, f=rounded: jnp.asarray(f(np.asarray(x, float))), calibration.model)
        made = _at(model, {name: rounded(x) for name, x in signals.items()}, rate)[0]
        error = (rounded(output) - made)[slope > 0.1] / float(model.gain()) / slope[slope > 0.1]
        errors.append(float(np.abs(error).max(initial=0.0)))
    return errors[0], errors[1]


def _members(model: GyroModel) -> dict[str, str]:
    """What the model may read of a sample, with the name and unit that it has in C."""
    units = {"output": _output_unit(model), "time": "s", "time_on": "s"}
    for effect in model.effects:
        for name in effect.columns_needed:
            if isinstance(effect, BiasColumn):
                units[name] = column_unit(effect)
            units.setdefault(name, usual_unit(name))
    units |= {f"{name}_rate": "degC/s" for name in thermometers(units)}
    units.pop("rate", None)
    members = {name: _identifier(name, unit) for name, unit in units.items()}
    for name, member in members.items():
        if twin := next((other for other in members if other != name and members[other] == member), None):
            raise ModelError(f"columns {twin} and {name} would both be called {member} in C; rename one")
    return members


def _output_unit(model: GyroModel) -> str:
    """Internal unit of the output, from the units of the gains."""
    return internal_unit(" ".join(f"({e.unit or 1})" for e in model.effects if e.site == "gain") + " deg/s")  # type: ignore[attr-defined]


def _identifier(name: str, unit: str) -> str:
    """A name that says its unit, and so is no keyword: temperature_degC, pressure_Pa, segment_number."""
    unit = unit.replace("/", "_per_") or "number"
    text = re.sub(r"[^A-Za-z0-9]+", "_", f"{name}_{unit}").strip("_")
    return text if text[0].isalpha() else f"column_{text}"


def _lowered(model: GyroModel, members: dict[str, str]) -> tuple[list[str], set[str], str, str]:
    """C statements of the model, what they read, and the names of the output and of its derivative by the rate."""
    signals = {name: jnp.zeros(3) for name in (*members, "rate")}
    atoms = {name: f"x->{member}" for name, member in members.items()} | {"rate": "rate"}
    names = []
    for path, leaf in jax.tree_util.tree_flatten_with_path((model, signals))[0]:
        if path[0].idx == 1:
            names.append(np.array([NEIGHBOUR, atoms[path[1].key], NEIGHBOUR], object))
        elif path[1].name == "effects":
            names.append(_names(model, path[2].idx, path[3].name))
        else:
            names.append(np.full(leaf.shape, "noise", object))
    lowered = Statements(output_and_slope, (model, signals), names)
    output, slope = (result[1] for result in lowered.outputs)
    return *lowered.needed(output, slope), output, slope


def _names(model: GyroModel, i: int, field: str) -> np.ndarray:
    """C names of a field's numbers."""
    values = np.asarray(getattr(model.effects[i], field))
    names = [_name(model, i, shown) for shown in shown_names(field, values.size)]
    return np.array(names, object).reshape(values.shape)


def _name(model: GyroModel, i: int, shown: str) -> str:
    """bias_value, scale_spline_coefficients_0; bias_step_2_size of the second step."""
    label = model.labels[i]
    again = model.labels[:i].count(label)
    return re.sub(r"[^A-Za-z0-9]+", "_", f"{label}_{again + 1}_{shown}" if again else f"{label}_{shown}").strip("_")


def _constants(calibration: Calibration, reached: set[str]) -> list[str]:
    """The numbers that the model needs, in internal units; beside them those of the file."""
    lines, taken = [], set()
    for i, effect in enumerate(entries(calibration)):
        for entry in effect:
            name = _name(calibration.model, i, entry.name)
            if name in reached and name in taken:
                raise ModelError(f"two numbers would be called {name} in C; rename the columns of {entry.effect}")
            taken.add(name)
            if name in reached:
                spread = f" +/- {entry.std:.2g}" if entry.std > 0 else ""
                comment = f"{entry.value:.10g}{spread} {entry.unit}".rstrip()
                lines.append(f"const double {name} = {literal(entry.internal)}; /* {comment} */")
    return lines


def _about(calibration: Calibration, rounding: tuple[float, float]) -> str:
    """The comment that opens the file."""
    model = calibration.model
    lines = [f"Rate of a gyro from its output, written by gyromodel {__version__}.", ""]
    lines += textwrap.wrap(f"Solves {FORMULA}, with:", 100)
    lines += [f"  {label}" for label in model.labels]
    lines += ["", "Values are in s, rad, degC and the units in the names; angular rates in rad/s."]
    lines += [
        f"Calibrated from {low:.6g} to {high:.6g} {unit} of {name}."
        for name, (low, high, unit) in validity(calibration).items()
    ]
    lines += [
        f"Samples and constants in single precision make errors of {np.rad2deg(rounding[0]):.2g} deg/s at most,",
        f"in 32-bit fixed point, each with its own binary point, of {np.rad2deg(rounding[1]):.2g} deg/s.",
    ]
    if calibration.data_hash:
        lines.append(f"SHA-256 of the calibration's data: {calibration.data_hash}")
    # A text of the user's must not end the comment, nor open another.
    return "\n".join(lines).replace("*/", "* /").replace("/*", "/ *")
