"""Errors that remember, belong to a power cycle or sit in the readout, from parts that do each of it.

Hysteresis is a sum of relays (Preisach), of friction elements whose yields scatter; a late thermometer is a node of a
thermal network, and a coil one of many layers; a converter clips and rounds; a ramp converter has a table of one error
a code.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from .designs import RAMP_CODES, Design

Array = np.ndarray
RELAYS = 400  # across the range of the driver, for each element
LAYERS = 24  # of the coil in the heat-diffusion model
YIELDS = (0.85, 0.95, 1.05, 1.15)  # of the friction elements, over the mean


def dragged(driver: Array, half_width: Array) -> Array:
    """What a driver drags along through dry friction: relays that switch up at c + w and down at c − w, summed over c.

    One column for each half width. All start as if the driver had come to rest where it starts.
    """
    width = np.asarray(half_width)[:, None]
    low, high = driver.min() - width, driver.max() + width
    spacing = (high - low) / RELAYS
    centre = low + spacing * (np.arange(RELAYS) + 0.5)
    # A relay half switched at the start holds the part of the spacing below the driver.
    state = np.clip((driver[0] - centre) / spacing + 0.5, 0.0, 1.0)
    total = np.empty((len(driver), len(width)))
    for i, x in enumerate(driver):
        up = np.clip((x - width - centre) / spacing + 0.5, 0.0, 1.0)
        down = np.clip((x + width - centre) / spacing + 0.5, 0.0, 1.0)
        state = np.minimum(np.maximum(state, up), down)
        total[i] = state.sum(axis=1)
    return low[:, 0] + spacing[:, 0] * total


def friction(driver: Array, half_width: float | Array) -> Array:
    """Mean force of elements that slip at ±1, each driven through its own yield; a column for each half width."""
    each = np.multiply.outer(np.asarray(half_width), YIELDS)
    moved = dragged(driver, each.ravel()).reshape(len(driver), *each.shape)
    return np.mean((driver[(slice(None), *[None] * each.ndim)] - moved) / each, axis=-1)


def bias_thermal_hysteresis(design: Design, amplitude: float, half_width: float) -> Array:
    """Bias from parts that temperature strains until they slip."""
    return amplitude * friction(design.true["temperature"], half_width)


def rate_hysteresis(design: Design, amplitude: float, half_width: float) -> Array:
    """Error from parts that the rate drags along; the table goes straight from rate to rate."""
    return amplitude * friction(design.true["rate"], half_width)


def bias_turn_on(design: Design, amplitude: float, offsets: Array) -> Array:
    """Every power cycle has its own bias."""
    return amplitude * offsets[design.true["run"].astype(int) - 1]


def scale_drift(design: Design, amplitude: float) -> Array:
    """Scale error that grows with time."""
    return amplitude * design.true["time"] * design.true["rate"]


def bias_readout_code(design: Design, amplitude: float, table: Array) -> Array:
    """The ramp converter's error at each code, turned into a rate by the loop."""
    return amplitude * table[design.true["feedback_ramp"].astype(int)]


def coil_temperature_rate(time: Array, surface: Array, tau: float) -> Array:
    """Rate of the coil's mean temperature, heat diffusing in from one face (implicit Euler).

    A slab of LAYERS cells, the other face insulated, diffusion time tau = thickness^2 / diffusivity. On a steady
    ramp the mean lags the face by tau/3, so the rate tends to that of the face.
    """
    dt = time[1] - time[0]
    k = dt / tau * LAYERS**2
    diffusion = np.diag(np.full(LAYERS, 2.0)) - np.eye(LAYERS, k=1) - np.eye(LAYERS, k=-1)
    diffusion[0, 0], diffusion[-1, -1] = 3.0, 1.0  # the face is half a cell away; nothing crosses the other side
    advance = np.linalg.inv(np.eye(LAYERS) + k * diffusion)
    layers = np.full(LAYERS, surface[0])
    mean = np.full_like(surface, surface[0])
    for i in range(1, len(surface)):
        layers[0] += 2 * k * surface[i]
        layers = advance @ layers
        mean[i] = layers.mean()
    return np.gradient(mean, dt)


def late(time: Array, node: Array, tau: float) -> Array:
    """Temperature of a thermometer behind a thermal resistance: τ dT/dt = node − T (implicit Euler)."""
    share = (time[1] - time[0]) / tau
    shown = np.empty_like(node)
    shown[0] = node[0]
    for i in range(1, len(node)):
        shown[i] = (shown[i - 1] + share * node[i]) / (1 + share)
    return shown


def with_late_thermometer(design: Design, tau: float, rng: np.random.Generator) -> Design:
    """The design measured by a thermometer that is τ behind the coil, whose temperature is then `coil`."""
    time, coil = design.thermal
    shown = np.interp(design.true["time"], time, late(time, coil, tau))
    noise = 2e-3 * rng.standard_normal(len(shown))
    return dataclasses.replace(
        design,
        columns=design.columns | {"temperature": shown + noise},
        true=design.true | {"coil": design.true["temperature"], "temperature": shown},
    )


def two_nodes(time: Array, chamber: Array, taus: tuple[float, float], share: float) -> tuple[Array, Array]:
    """Temperatures of a case that the chamber heats and of a sensor on it, which holds back what it takes up.

    C1 dT1/dt = G0 (chamber − T1) + G (T2 − T1), C2 dT2/dt = G (T1 − T2), by implicit Euler.

    Args:
        time: evenly spaced, s.
        chamber: its temperature.
        taus: C1/G0 and C2/G, s.
        share: C2/C1.
    """
    dt = time[1] - time[0]
    outside, inside = dt / taus[0], dt / taus[1]
    advance = np.linalg.inv(np.array([[1 + outside + share * inside, -share * inside], [-inside, 1 + inside]]))
    nodes = np.full((len(time), 2), chamber[0])
    for i in range(1, len(time)):
        nodes[i] = advance @ (nodes[i - 1] + [outside * chamber[i], 0.0])
    return nodes[:, 0], nodes[:, 1]


def on_a_case(design: Design, tau: float, rng: np.random.Generator) -> Design:
    """The design in whose temperature a case stands, which is `coil`, measured by a sensor of a third of its heat."""
    time, chamber = design.thermal
    case, shown = (np.interp(design.true["time"], time, node) for node in two_nodes(time, chamber, (300.0, tau), 0.3))
    return dataclasses.replace(
        design,
        columns=design.columns | {"temperature": shown + 2e-3 * rng.standard_normal(len(shown))},
        true=design.true | {"coil": case, "temperature": shown},
    )


def clipped(rate: Array, limit: float) -> Array:
    """A converter that ends at ± its limit."""
    return np.where(rate > limit, limit, np.where(rate < -limit, -limit, rate))


def rounded(output: Array, quantum: float) -> Array:
    """A converter of whole numbers."""
    return np.floor(output / quantum + 0.5) * quantum


def draw_hysteresis(driver: Array, rng: np.random.Generator) -> dict[str, Any]:
    """A loop that closes."""
    return {"half_width": rng.uniform(0.04, 0.2) * np.ptp(driver)}


def draw_table(rng: np.random.Generator) -> dict[str, Any]:
    """One error a code, of unit size: a bow over the ramp, steps where a bit switches, and scatter."""
    code = np.arange(RAMP_CODES)
    table = np.sin(np.pi * code / RAMP_CODES) * rng.normal() + 0.2 * rng.standard_normal(RAMP_CODES)
    for bit in range(1, 5):
        table += 0.7 * rng.normal() * ((code * 2**bit // RAMP_CODES) % 2)
    table -= table.mean()
    return {"table": table / table.std()}
