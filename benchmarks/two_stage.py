"""Coverage of 95 % intervals behind a calibrated thermometer: naive, carried through, and one joint fit.

python -m benchmarks.two_stage [CAMPAIGNS]
"""

from __future__ import annotations

import sys
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks._measure import table, timed, write_result
from gyromodel.multiposition import rate_table, six_positions
from gyromodel.numerics.uncertain import Uncertain, together
from gyromodel.temperature_models import Soaks, ThermistorReadings, fit_currents, fit_jointly
from gyromodel.thermometry import fit_thermistor
from gyromodel.units import factor
from tests.truth import rate_integrating as truth

WAYS = ("(i) naive", "(ii) carried through", "(iii) joint")
QUANTITIES = ("SF", "Df", "Di", "Ds")
PARAMETERS = [f"{q} {part}" for q in QUANTITIES for part in ("at 0 °C", "slope")]
# From rad/s and A to the units of the source, in the order of the fitted values.
UNITS = np.repeat([factor("rad/s/A", "deg/h/mA"), *[factor("rad/s", "deg/h")] * 3], 2)
DESIGNS = {
    "Currents with the scatter of the source's table": truth.SOURCE,
    "Currents to 5 ppm, scale factor −0.11 %/°C": truth.PRECISE,
    "The same, a thermistor that no cubic in ln R meets": truth.replace(truth.PRECISE, law="beta"),
}


class Campaign(NamedTuple):
    """What the fits take, in internal units."""

    soaks: Soaks
    calibration: ThermistorReadings
    reading: Uncertain


def prepared(unit: truth.Unit, rng: np.random.Generator) -> Campaign:
    """One simulated campaign."""
    found = truth.simulate(unit, rng)
    runs = [rate_table(np.radians([30.0, -30.0]), unit.latitude), six_positions(unit.latitude)]
    currents = np.concatenate([found.table_currents, found.position_currents], axis=1) / 1e3
    soaks = Soaks(
        currents,
        jax.tree.map(lambda *parts: jnp.concatenate(parts), *runs),
        np.array([10.0] * 2 + [1e-4] * 6),
        np.array([0] * 2 + [1] * 6),
        ("table currents", "position currents"),
    )
    calibration = ThermistorReadings(found.calibration_resistance, found.calibration_temperature, found.soak_resistance)
    reading = Uncertain.stated(jnp.zeros(len(currents)), unit.reading_noise**2, "resistance reading")
    return Campaign(soaks, calibration, reading)


def three_ways(campaign: Campaign, joint: float = 0.0) -> tuple[Uncertain, Uncertain, Uncertain]:
    """Lines of scale factor and drifts by each way."""
    soaks, calibration, reading = campaign
    thermometry = fit_thermistor(calibration.resistance, calibration.temperature, joint=joint, name="thermometry")
    resistance = jnp.asarray(calibration.soaks)
    temperature = together(thermometry.parameters, reading).propagate(
        lambda v: v[0].temperature(resistance * jnp.exp(-v[1]))
    )
    naive = fit_currents(soaks, temperature.value)
    carried = fit_currents(soaks, temperature)
    whole = fit_jointly(soaks, calibration, thermometry, reading)
    return naive.parameters, carried.parameters, whole.parameters.propagate(lambda v: v[1])


def true_values(unit: truth.Unit) -> np.ndarray:
    """In the units of the source."""
    return np.ravel(truth.unit_lines(unit))


def study(unit: truth.Unit, campaigns: int) -> dict[str, np.ndarray]:
    """Over campaigns: whether each interval covers (way × parameter), budgets, and how (ii) and (iii) differ."""
    value = true_values(unit) / UNITS
    covered, share, apart, error = [], [], [], []
    for seed in range(campaigns):
        ways = three_ways(prepared(unit, np.random.default_rng(seed)))
        ends = [w.interval() for w in ways]
        covered.append([(low <= value) & (value <= high) for low, high in ends])
        share.append([w.budget()["thermometry"] for w in ways[1:]])
        apart.append((ways[1].vector - ways[2].vector) / ways[2].std)
        error.append([[w.vector - value, w.std] for w in ways])
    return {k: np.array(v) for k, v in (("covered", covered), ("share", share), ("apart", apart), ("error", error))}


def section(title: str, unit: truth.Unit, campaigns: int) -> list[str]:
    """One design's tables."""
    found, took = timed(lambda: study(unit, campaigns))
    coverage = 100 * found["covered"].mean(axis=0)
    scatter, stated = found["error"][:, :, 0].std(axis=0), np.sqrt((found["error"][:, :, 1] ** 2).mean(axis=0))
    share = 100 * found["share"].mean(axis=0)
    rows = []
    for k, name in enumerate(PARAMETERS):
        ratios = [f"{stated[w, k] / scatter[w, k]:.2f}" for w in range(3)]
        rows.append([name, *(f"{c:.1f}" for c in coverage[:, k]), *ratios, *(f"{share[w, k]:.2g}" for w in range(2))])
    head = ["parameter", *(f"{w} covers, %" for w in WAYS), *(f"{w.split()[0]} stated/true" for w in WAYS)]
    head += ["thermometry in (ii), %", "in (iii), %"]
    far = np.abs(found["apart"])
    return [
        f"## {title}",
        "",
        *table(head, rows),
        "",
        f"(ii) and (iii) differ by {np.median(far):.2g} standard uncertainties in the median, {far.max():.2g} at most. "
        f"{took['wall'] / campaigns * 1e3:.0f} ms a campaign.",
        "",
    ]


def main(argv: list[str]) -> None:
    campaigns = int(argv[0]) if argv else 1000
    lines = [
        f"{campaigns} campaigns of each design: a thermistor calibrated every 5 °C from −40 to 60 °C and back with the "
        "source's scatter (0.0159 °C below and 0.0076 °C above 0 °C), eleven soaks, in each of which currents are read "
        "at ±30 deg/s and in six positions. Lines over temperature of all four parameters, by (i) taking temperatures "
        "as known, (ii) carrying the calibration's covariance through, (iii) fitting resistances and currents in one "
        "problem. All standard deviations are estimated but for that of a resistance reading. With intervals that are "
        f"right, coverage of one parameter scatters by {100 * np.sqrt(0.95 * 0.05 / campaigns):.1f} %. "
        '"stated/true" is the rms standard uncertainty over the scatter of the estimates.',
        "",
    ]
    for title, unit in DESIGNS.items():
        lines += section(title, unit, campaigns)
    write_result("two_stage", "Two-stage error of a gyro over temperature", "two_stage", argv, lines)


if __name__ == "__main__":
    main(sys.argv[1:])
