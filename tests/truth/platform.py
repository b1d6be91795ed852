"""A gyro-stabilised platform in four gimbals on a moving base, as rigid bodies with one centre, in numpy and scipy.

Lagrange's equations in the gimbal angles, M(β) β̈ = τ − c(β, β̇, base): body j turns at ω_j = ω_b + Σ a_k β̇_k over the
axes up to its own. Friction of the shafts is implicit in the new rates, sticking included. A step of the loop is a step
of the mechanics; gyros give the mean rate over it and the torque acts at its end, which is a delay of half a step.
Frames and signs are those of Zhang, Jiang, Jing and Wang, 2022: n is north-up-east, gimbals from the outermost to the
innermost turn their inside about −y, −x, −y, +z, table X, Y, Z is roll (+z), azimuth (−y) and pitch (−x) of the base.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.signal import TransferFunction, cont2discrete, lsim
from scipy.spatial.transform import Rotation

Array = np.ndarray

AXES = np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, 1.0]])
OMEGA = 7.292115e-5


class Loop(NamedTuple):
    """Figure 2, per axis: rate → G_fog → W_c → K_0 → W_m → torque.

    Crossover is the angular rate at which the open loop has the gain one. With the default design the closed loop has a
    bandwidth (−3 dB) of 247 rad/s, a phase margin of 84° and a gain margin of 16 dB, the sampling's delay included.
    """

    crossover: float = 220.0
    gyro_lag: float = 0.8e-3
    motor_lag: float = 0.6e-3
    integral: float = 30.0
    lead: float = 400.0
    lag: float = 2000.0

    def torque(self, inertia: float) -> TransferFunction:
        """Torque (N m) over body rate (rad/s): W_c = (1 + w_i/s)(1 + s/w_1)/(1 + s/w_2), two lags, K_0 by crossover."""
        over = np.polymul([1.0, self.integral], [1 / self.lead, 1.0])
        under = np.polymul(np.polymul([1.0, 0.0], [1 / self.lag, 1.0]), [self.gyro_lag, 1.0])
        under = np.polymul(under, [self.motor_lag, 1.0])
        s = 1j * self.crossover
        gain = abs(s * inertia * np.polyval(under, s) / np.polyval(over, s))
        return TransferFunction(gain * over, under)


class Platform(NamedTuple):
    """What is simulated; SI units, gimbals outermost first."""

    inertias: Array = np.array([[0.2, 0.15, 0.2], [0.1, 0.15, 0.12], [0.06, 0.05, 0.08], [0.4, 0.5, 0.45]])
    """Principal ones of what each gimbal carries inside, the platform body last; rings of a thousandth of it make the
    redundant gimbal too fast for the step."""
    viscous: Array = np.array([1.0, 1.0, 1.0, 1.0])
    coulomb: Array = np.array([0.01, 0.01, 0.01, 0.01])
    loop: Loop | None = Loop()
    step: float = 1 / 2000
    follow: float = 60.0
    """Natural angular rate at which the outermost gimbal keeps β_y at zero; without a loop, none."""
    isolator: tuple[float, float] | None = None
    """Natural angular rate and damping ratio of the base on the table; without, it is fixed."""
    noise: float = 0.0
    """N_0: root of the two-sided density of the gyros' white noise, rad/s/√Hz."""
    drift: Callable[[Array], Array] = lambda time: np.zeros((len(time), 3))
    """What the gyros read of nothing at some times, rad/s; run axes may stand in front."""
    tilts: Array = np.zeros((4, 3))
    """What each gimbal axis has besides its nominal direction."""
    harmonics: Array = np.zeros((4, 1, 2))
    """c_k and s_k of what encoders read too much, by the angle they read."""
    quantum: float = 0.0
    """Of encoders on gimbals and table, rad."""
    offset: float = 0.0
    """By how much the gimbals' clock is late: a record of time t is of t + offset, s."""
    log: float = 0.01
    latitude: float = 0.7
    earth: float = OMEGA

    def carried(self) -> Array:
        """Inertia that the motors of body axes x, y, z turn at zero angles."""
        i = self.inertias
        return np.array([i[1:, 0].sum(), i[2:, 1].sum(), i[3, 2]])


class Run(NamedTuple):
    """Records, behind an axis of runs."""

    time: Array
    table: Array
    """X, Y, Z as its encoders read them, at `time`."""
    gimbals: Array
    """As their encoders read them, at time + offset."""
    angles: Array
    """True gimbal angles, then."""
    base: Array
    """True C_b^n, then."""
    platform: Array
    """True C_p^n, then."""


def simulate(
    design: Platform, amplitude: Array, frequency: Array, duration: float,
    start: Array | None = None, level: Array | None = None, rates: Array | None = None, seed: int = 0,
) -> Run:  # fmt: skip
    """Runs side by side with the table on amplitude · sin(frequency · t).

    Args:
        design: of all runs.
        amplitude: run by X, Y, Z, rad.
        frequency: likewise, rad/s.
        duration: s.
        start: gimbal angles.
        level: X, Y, Z about which the table moves.
        rates: of the gimbals at the start; without, the platform stands still in inertial space.
        seed: of the gyros' noise.
    """
    step = design.step
    time = np.arange(round((duration + abs(design.offset)) / step) + 3) * step
    level = np.zeros(3) if level is None else level
    moved = amplitude[:, None] * np.sin(frequency[:, None] * time[:, None])
    base = level + (moved if design.isolator is None else _isolated(design.isolator, moved, time))
    frames, turning = _base(design, base, time)
    gaining = np.gradient(turning, step, axis=1)
    history = _gimbals(design, frames, turning, gaining, time, (np.zeros(4) if start is None else start, rates), seed)

    logged = np.arange(round(duration / design.log)) * design.log
    late = np.clip(logged + design.offset, 0.0, None)
    angles, base = (_at(late, time, x) for x in (history, base))
    table = level + amplitude[:, None] * np.sin(frequency[:, None] * logged[:, None])
    attitude = _euler(base)
    inner = np.stack([_chain(design, a).as_matrix() for a in angles])
    records = (_quantised(x, design.quantum) for x in (table, _read(angles, design.harmonics)))
    return Run(logged, *records, angles, attitude, attitude @ inner)


def _gimbals(
    design: Platform, frames: Array, turning: Array, gaining: Array, time: Array, start: tuple[Array, Array | None],
    seed: int,
) -> Array:  # fmt: skip
    """History of the gimbal angles, run by time by gimbal."""
    runs, step = len(frames), design.step
    axes = AXES + design.tilts
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    skew = -np.einsum("ijk,gk->gij", _levi_civita(), axes)
    square, inertia = skew @ skew, np.stack([np.diag(i) for i in design.inertias])
    error = np.broadcast_to(design.drift(time), (runs, len(time), 3))
    rng = np.random.default_rng(seed)
    error = error + design.noise / np.sqrt(step) * rng.standard_normal(error.shape)
    A, B, C, D = _controller(design)
    servo = design.inertias[:2, 1].sum() * np.array([design.follow**2, 1.6 * design.follow])

    angles = np.tile(start[0], (runs, 1)).astype(float)
    state, sliding, rates, body = np.zeros((runs, 3, A.shape[1])), np.zeros((runs, 4)), None, None
    history = np.empty((len(time), runs, 4))
    for k in range(len(time)):
        history[k] = angles
        turned = np.eye(3) + np.sin(angles)[..., None, None] * skew + (1 - np.cos(angles))[..., None, None] * square
        carried, frame = [], frames[:, k]
        for g in range(4):
            frame = frame @ turned[:, g]
            carried.append(frame)
        before, body = frame if body is None else body, frame
        inside = np.stack(carried, axis=1)
        a = _times(inside, axes)
        if rates is None:
            still = -_times(np.linalg.pinv(a.transpose(0, 2, 1)), turning[:, k])
            rates = previous = still if start[1] is None else np.tile(start[1], (runs, 1))

        # Rates are those of the middle of the step before; gyroscopic torques take them half a step on.
        spun = (1.5 * rates - 0.5 * previous)[..., None] * a
        omega = turning[:, k, None] + np.cumsum(spun, axis=1)
        alpha = gaining[:, k, None] + np.cumsum(_cross(omega - spun, spun), axis=1)
        tensor = inside @ inertia @ inside.transpose(0, 1, 3, 2)
        torque = _times(tensor, alpha) + _cross(omega, _times(tensor, omega))
        resisting = np.sum(a * np.cumsum(torque[:, ::-1], axis=1)[:, ::-1], axis=2)
        upper = np.triu(a @ _times(np.cumsum(tensor[:, ::-1], axis=1)[:, ::-1], a).transpose(0, 2, 1))
        mass = upper + np.triu(upper, 1).transpose(0, 2, 1)

        motor = np.zeros((runs, 4))
        if design.loop is not None:
            turn = before.transpose(0, 2, 1) @ body
            seen = (turn[:, [2, 0, 1], [1, 2, 0]] - turn[:, [1, 2, 0], [2, 0, 1]]) / (2 * step) + error[:, k]
            wanted = -(np.sum(C * state, axis=2) + D * seen)
            state = _times(A, state) + B * seen[..., None]
            motor = _times(a, _times(body, wanted))
            motor[:, 0] = np.sign(np.cos(angles[:, 1])) * (servo[0] * angles[:, 2] + servo[1] * rates[:, 2])
        previous, known = rates, _times(mass, rates) + step * (motor - resisting)
        rates, sliding = _slide(mass + step * np.diag(design.viscous), known, step * design.coulomb, sliding)
        angles = angles + step * rates
    return history.transpose(1, 0, 2)


def _slide(mass: Array, known: Array, friction: Array, sliding: Array) -> tuple[Array, Array]:
    """Rates v with mass·v + friction·sign(v) = known, |what holds them| ≤ friction where v = 0; the signs."""
    for _ in range(12):
        stuck = sliding == 0
        square = np.where(stuck[..., None], np.eye(4), mass)
        rates = np.linalg.solve(square, np.where(stuck, 0.0, known - friction * sliding)[..., None])[..., 0]
        over = known - _times(mass, rates)
        held = np.where(np.abs(over) > friction, np.sign(over), 0.0)
        signs = np.where(stuck, held, np.where(rates * sliding < 0, 0.0, sliding))
        if np.array_equal(signs, sliding):
            break
        sliding = signs
    return rates, sliding


def _controller(design: Platform) -> tuple[Array, Array, Array, Array]:
    """The loops of the three body axes, each by the bilinear rule."""
    if design.loop is None:
        return np.zeros((3, 1, 1)), np.zeros((3, 1)), np.zeros((3, 1)), np.zeros(3)
    parts = [cont2discrete(_balanced(design.loop.torque(i)), design.step, "bilinear")[:4] for i in design.carried()]
    A, B, C, D = (np.stack(x) for x in zip(*parts, strict=True))
    return A, B[..., 0], C[:, 0], D[:, 0, 0]


def _balanced(system: TransferFunction) -> tuple[Array, Array, Array, Array]:
    ss = system.to_ss()
    return ss.A, ss.B, ss.C, ss.D


def _isolated(mode: tuple[float, float], moved: Array, time: Array) -> Array:
    """Each angle of the base on a spring and a damper: x¨ + 2ζw (x˙ − y˙) + w² (x − y) = 0, at rest before."""
    w, zeta = mode
    system = TransferFunction([2 * zeta * w, w * w], [1, 2 * zeta * w, w * w])
    flat = moved.transpose(0, 2, 1).reshape(-1, len(time))
    return np.stack([lsim(system, y, time)[1] for y in flat]).reshape(len(moved), 3, -1).transpose(0, 2, 1)


def _base(design: Platform, base: Array, time: Array) -> tuple[Array, Array]:
    """Cosines from the base to inertial axes (n at time zero) and its rate there."""
    roll, azimuth, pitch = np.moveaxis(np.gradient(base, design.step, axis=1, edge_order=2), -1, 0)[..., None]
    inner = Rotation.from_euler("YX", -base[..., 1:].reshape(-1, 2)).as_matrix().reshape(*base.shape[:2], 3, 3)
    rate = -azimuth * np.array([0.0, 1.0, 0.0]) - pitch * _heading(base) + roll * inner[..., 2]
    earth = design.earth * np.array([np.cos(design.latitude), np.sin(design.latitude), 0.0])
    turned = Rotation.from_rotvec(np.outer(time, earth)).as_matrix()
    return turned @ _euler(base), earth + _times(turned, rate)


def _heading(base: Array) -> Array:
    """The axis x after azimuth alone: (cos ψ, 0, sin ψ)."""
    return np.stack([np.cos(base[..., 1]), 0 * base[..., 1], np.sin(base[..., 1])], axis=-1)


def _euler(base: Array) -> Array:
    """C_b^n of X = roll, Y = azimuth, Z = pitch."""
    angles = base.reshape(-1, 3)[:, [1, 2, 0]] * [-1.0, -1.0, 1.0]
    return Rotation.from_euler("YXZ", angles).as_matrix().reshape(*base.shape[:-1], 3, 3)


def _chain(design: Platform, angles: Array) -> Rotation:
    """C_p^b of some gimbal angles."""
    axes = AXES + design.tilts
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    total = Rotation.identity(len(angles))
    for k in range(4):
        total = total * Rotation.from_rotvec(np.outer(angles[:, k], axes[k]))
    return total


def _read(angles: Array, harmonics: Array) -> Array:
    """What encoders read of angles: r = β + e(r), by iteration."""
    order, read = np.arange(1, harmonics.shape[1] + 1), angles
    for _ in range(8):
        turns = read[..., None] * order
        read = angles + np.sum(harmonics[..., 0] * np.cos(turns) + harmonics[..., 1] * np.sin(turns), axis=-1)
    return read


def _quantised(x: Array, quantum: float) -> Array:
    return np.round(x / quantum) * quantum if quantum else x


def _at(when: Array, time: Array, x: Array) -> Array:
    """Between two steps, by a line."""
    k = np.clip((when / (time[1] - time[0])).astype(int), 0, len(time) - 2)
    part = ((when - time[k]) / (time[1] - time[0]))[:, None]
    return (1 - part) * x[:, k] + part * x[:, k + 1]


def _times(matrix: Array, vector: Array) -> Array:
    return (matrix @ vector[..., None])[..., 0]


def _cross(a: Array, b: Array) -> Array:
    one, two = [1, 2, 0], [2, 0, 1]
    return a[..., one] * b[..., two] - a[..., two] * b[..., one]


def _levi_civita() -> Array:
    epsilon = np.zeros((3, 3, 3))
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        epsilon[i, j, k], epsilon[j, i, k] = 1.0, -1.0
    return epsilon
