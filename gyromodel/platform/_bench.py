"""A vibration test of a simulated platform, as its log has it."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from gyromodel.campaign import AXES, Campaign
from gyromodel.numerics.rotations import exponential, product
from gyromodel.platform._earth import earth_rate
from gyromodel.platform._gimbals import GimbalErrors, euler_attitude, harmonics
from gyromodel.platform._motion import GIMBALS, TABLE
from gyromodel.platform._simulation import Platform, simulate_platform
from gyromodel.units import from_internal

# Between two runs in the log, s.
PAUSE = 5.0
# Of the search for what encoders read of true angles, which their harmonics turn by little.
READINGS = 8


class Bench(NamedTuple):
    """The table that shakes a platform, and what records both.

    step: of mechanics and loop, s; period: between two records, s; isolator: natural angular rate (rad/s) and damping
    ratio, not of one, of a spring and a damper that carry the base, which is fixed without; late: by how much the
    platform's records are late, s; quantum: of all encoders, rad; scatter: standard deviation of their readings, rad;
    drift: what the gyros read of nothing, rad/s; walk: N_0, root of the density of their white noise, rad/s/√Hz; gyros:
    whether their rates are logged; latitude: rad.
    """

    step: float = 5e-4
    period: float = 0.01
    isolator: tuple[float, float] | None = None
    late: float = 0.0
    quantum: float = 0.0
    scatter: float = 0.0
    drift: tuple[float, float, float] = (0.0, 0.0, 0.0)
    walk: float = 0.0
    gyros: bool = False
    latitude: float = 0.7


@jax.jit
def base_on_table(
    amplitude: Float[Array, " 3"],
    frequency: Float[Array, " 3"],
    time: Float[Array, " epoch"],
    isolator: tuple[Array | float, Array | float] | None,
    latitude: Array | float,
) -> Float[Array, "epoch 4"]:
    """Attitude of a base whose table begins at time zero to turn by amplitude · sin(frequency · t) about X, Y, Z.

    With an isolator each angle x follows that of the table, y: ẍ + 2ζω (ẋ − ẏ) + ω² (x − y) = 0, from rest.

    Args:
        amplitude: of X, Y, Z, which are roll, azimuth and pitch, rad.
        frequency: of each, rad/s.
        time: s.
        isolator: ω, rad/s, and ζ, not one; without, the base is fixed to the table.
        latitude: geodetic, rad.

    Returns:
        Quaternions in inertial axes that are north, up and east at time zero.
    """
    s, at = 1j * frequency, time[:, None]
    response, modes, sizes = jnp.ones(3), jnp.zeros(2, complex), jnp.zeros((3, 2))
    if isolator is not None:
        natural, damping = isolator
        response = (2 * damping * natural * s + natural**2) / (s**2 + 2 * damping * natural * s + natural**2)
        modes = natural * (-damping + jnp.array([1.0, -1.0]) * jnp.sqrt(damping**2 - 1.0 + 0.0j))
        # Both parts of what starts from rest: neither angle nor rate at time zero.
        angle, rate = -jnp.imag(response), -jnp.imag(response * s)
        sizes = jnp.stack([rate - modes[1] * angle, modes[0] * angle - rate], axis=1) / (modes[0] - modes[1])
    forced = jnp.imag(response * jnp.exp(s * at))
    free = jnp.real(jnp.einsum("am,em->ea", sizes, jnp.exp(modes * at)))
    roll, azimuth, pitch = (amplitude * (forced + free)).T
    return product(
        exponential(at * earth_rate(jnp.asarray(latitude))), euler_attitude(jnp.stack([azimuth, pitch, roll], axis=1))
    )


def simulate_vibration_test(
    platform: Platform,
    amplitude: Float[np.ndarray, "run 3"],
    frequency: Float[np.ndarray, "run 3"],
    duration: float,
    bench: Bench | None = None,
    *,
    skip: float = 0.0,
    seed: int = 0,
) -> Campaign:
    """Runs on a vibration table one after another, each from rest, as `gyromodel vibration` reads their log.

    Args:
        platform: what is shaken.
        amplitude: of X, Y, Z, rad.
        frequency: of each, rad/s.
        duration: of each run, s.
        bench: table and records.
        skip: what is not logged of the beginning of each run, s.
        seed: of the gyros' and the encoders' noise.

    Raises:
        ValueError: records before the table moves are asked for.
    """
    bench = Bench() if bench is None else bench
    if not skip >= bench.late:
        raise ValueError(f"records that are late by {bench.late:g} s need as much to be skipped, not {skip:g} s")
    steps = int(np.ceil((duration - min(bench.late, 0.0) + bench.period) / bench.step))
    time = bench.step * np.arange(steps + 1)
    rng = np.random.default_rng(seed)
    noise = bench.walk / np.sqrt(bench.step) * rng.standard_normal((len(amplitude), len(time), 3))
    base = jax.vmap(base_on_table, (0, 0, None, None, None))(
        jnp.asarray(amplitude), jnp.asarray(frequency), jnp.asarray(time), bench.isolator, bench.latitude
    )
    history = jax.vmap(partial(simulate_platform, step=bench.step), (None, 0, 0))(
        platform, base, jnp.asarray(np.array(bench.drift) + noise)
    )

    begin = int(np.ceil(skip / bench.period))
    logged = bench.period * np.arange(begin, int(np.ceil(duration / bench.period)))
    moved = amplitude[:, None] * np.sin(frequency[:, None] * logged[:, None])
    gimbals = _between(logged - bench.late, time, np.asarray(history.gimbals))
    encoders = np.concatenate([moved, np.asarray(_read(jnp.asarray(gimbals), platform.errors))], axis=2)
    encoders = encoders + bench.scatter * rng.standard_normal(encoders.shape)
    if bench.quantum:
        encoders = np.round(encoders / bench.quantum) * bench.quantum

    runs = np.arange(len(amplitude))
    starts = runs * (len(logged) * bench.period + PAUSE)
    columns = {"time": (starts[:, None] + logged - logged[0]).ravel(), "segment": np.repeat(runs + 1.0, len(logged))}
    units = {"time": "s", "segment": ""}
    for name, angle in zip((*TABLE, *GIMBALS), encoders.reshape(-1, 7).T, strict=True):
        columns[name], units[name] = from_internal(angle, "deg"), "deg"
    metadata: dict[str, str | float] = {"latitude_deg": float(np.rad2deg(bench.latitude))}
    if bench.gyros:
        # Means over a period about the time of the record: differences of what they sum up to.
        turned = np.cumsum(bench.step * np.asarray(history.sensed), axis=1)
        ends = (_between(logged - bench.late + side * 0.5 * bench.period, time, turned) for side in (1, -1))
        rates = np.subtract(*ends) / bench.period
        for axis, rate in zip(AXES, rates.reshape(-1, 3).T, strict=True):
            columns[f"output_{axis}"], units[f"output_{axis}"] = from_internal(rate, "deg/s"), "deg/s"
        metadata["kind"] = "rate"
    return Campaign(columns, units, metadata)


def _between(when: np.ndarray, time: np.ndarray, history: np.ndarray) -> np.ndarray:
    """Between two epochs, by a line."""
    k = np.clip((when / time[1]).astype(int), 0, len(time) - 2)
    part = (when / time[1] - k)[:, None]
    return (1 - part) * history[:, k] + part * history[:, k + 1]


def _read(angles: jax.Array, errors: GimbalErrors | None) -> jax.Array:
    """What encoders read of angles: r with r − Σ (c_k cos kr + s_k sin kr) = β, by iteration."""
    read = angles
    if errors is not None:
        for _ in range(READINGS):
            read = angles + harmonics(read, errors.encoder_harmonic)
    return read
