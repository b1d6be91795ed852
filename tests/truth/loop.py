"""A platform's axis on a vibration table, as differential equations solved in time (`scipy.signal.lsim`).

States: base angle and rate on a spring and damper, body angle and rate, gyro, two integrals of the correction network,
motor, and a delay as the (3, 3) Padé approximation.
"""

from __future__ import annotations

import numpy as np
from scipy.signal import StateSpace, lsim, tf2ss

STEP, SETTLING = 1e-4, 1.2


def equations(
    *,
    inertia: float,
    amplifier: float,
    correction: float,
    corner: float,
    second_corner: float,
    motor: float,
    motor_lag: float,
    gyro_lag: float,
    control_delay: float,
    friction: float,
    natural: float = 1e4,
    damping: float = 0.7,
    grounded: float = 0.0,
) -> StateSpace:
    """From table angle and rate to base and body angle, and the integral of the gyro."""
    # e^(−x) in units of the delay.
    late = [np.atleast_2d(m) for m in tf2ss([-1 / 120, 1 / 10, -1 / 2, 1], [1 / 120, 1 / 10, 1 / 2, 1])]
    late[:2] = late[0] / control_delay, late[1] / control_delay
    size = 8 + len(late[0])
    a, b = np.zeros((size, size)), np.zeros((size, 2))
    base, base_rate, body, body_rate, gyro, once, twice, torque = range(8)
    own = slice(8, size)
    a[base, base_rate] = a[body, body_rate] = 1.0
    a[base_rate, [base, base_rate]] = -(natural**2), -2 * damping * natural
    b[base_rate] = natural**2, 2 * damping * natural * (1 - grounded)
    a[body_rate, [base_rate, body_rate, torque]] = np.array([friction, -friction, -1.0]) / inertia
    a[gyro, [body_rate, gyro]] = 1 / gyro_lag, -1 / gyro_lag
    a[once, gyro] = a[twice, once] = 1.0
    command = np.zeros(size)
    command[[gyro, once, twice]] = correction * np.array([1.0, corner + second_corner, corner * second_corner])
    a[own, own] = late[0]
    a[own] += late[1] @ command[None]
    a[torque, torque] = -1 / motor_lag
    a[torque] += amplifier * motor / motor_lag * (late[3] @ command[None])[0]
    a[torque, own] += amplifier * motor / motor_lag * late[2][0]
    out = np.zeros((3, size))
    out[[0, 1, 2], [base, body, once]] = 1.0
    return StateSpace(a, b, out, np.zeros((3, 2)))


def ratio(system: StateSpace, frequency: float, time_offset: float = 0.0, integrated: float = 0.0) -> complex:
    """Measured base angle over table angle once it has settled: gimbal angle, and the gyro's integral."""
    time = np.arange(int((SETTLING + 2 * 2 * np.pi / frequency) / STEP)) * STEP
    table = np.stack([np.sin(frequency * time), frequency * np.cos(frequency * time)], 1)
    _, angles, _ = lsim(system, table, time)
    measured = angles[:, 0] - angles[:, 1] + integrated * angles[:, 2]
    settled = time > SETTLING
    stamp = time[settled] + time_offset
    columns = np.stack([np.sin(frequency * stamp), np.cos(frequency * stamp), np.ones(len(stamp))], 1)
    sine, cosine, _ = np.linalg.lstsq(columns, measured[settled], rcond=None)[0]
    return complex(sine, cosine)


def settled_ratio(system: StateSpace, frequency: float, time_offset: float = 0.0) -> complex:
    """The same without its transient, by solving the equations at one frequency."""
    s = 1j * frequency
    states = np.linalg.solve(s * np.eye(len(system.A)) - system.A, system.B @ np.array([1.0, s]))
    angles = system.C @ states
    return complex((angles[0] - angles[1]) * np.exp(-s * time_offset))
