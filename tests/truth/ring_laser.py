"""A ring laser by its beat-phase equation, integrated and counted.

dψ/dt = K(ω + dθ/dt − ω_L sin ψ), K = 2π/S: the phase of the beat, the case turning at ω and dithered by θ(t).
Integrated as φ = ψ − Kθ, which the fast dither leaves smooth, by classical Runge-Kutta steps. All lanes (rates, or
repetitions of one) run side by side. Angles in rad, rates in rad/s.
"""

from __future__ import annotations

import numpy as np

Array = np.ndarray
ARCSEC = np.pi / 180 / 3600


def sinusoidal_dither(amplitude: float, frequency: float, periods: int, steps: int) -> tuple[Array, float]:
    """Case angle at half steps, one lane for all, and the step: whole periods of a sine."""
    turn = np.pi * np.arange(2 * periods * steps + 1) / steps
    return amplitude * np.sin(turn)[:, None], 1 / (frequency * steps)


def random_dither(
    amplitude: float, spread: float, frequency: float, periods: int, steps: int, lanes: int, rng: np.random.Generator
) -> tuple[Array, float]:
    """As `sinusoidal_dither`, the amplitude of each half swing drawn within 1 ± spread of it, each lane by itself."""
    swing = amplitude * rng.uniform(1 - spread, 1 + spread, (2 * periods, lanes))
    # From one turning point to the next: ±(1 − cos) of its own amplitude on top of where the last swing ended.
    shape = (1 - np.cos(np.pi * np.arange(1, steps + 1) / steps))[:, None]
    sign = np.where(np.arange(2 * periods) % 2, -1.0, 1.0)[:, None]
    ends = np.cumsum(2 * sign * swing, axis=0)
    starts = np.vstack([np.zeros((1, lanes)), ends[:-1]])
    theta = (starts[:, None] + sign[:, None] * swing[:, None] * shape).reshape(-1, lanes)
    return np.vstack([np.zeros((1, lanes)), theta]), 1 / (frequency * steps)


def counted_rate(
    rate: Array, lock_in_rate: float, fringe: float, step: float, theta: Array, rng: np.random.Generator
) -> Array:
    """Fringes counted over the whole record, as a mean rate less that of the dither, one a lane.

    The first tenth, in which a locked phase settles, is not counted; the phase starts anywhere.
    """
    k = 2 * np.pi / fringe
    phase = rng.uniform(0, 2 * np.pi, len(rate))
    dither = k * theta
    steps = (len(theta) - 1) // 2
    begin = steps // 10
    started = phase

    def slope(phase: Array, dither: Array) -> Array:
        return k * (rate - lock_in_rate * np.sin(phase + dither))

    for i in range(steps):
        if i == begin:
            started = phase
        now, middle, end = dither[2 * i], dither[2 * i + 1], dither[2 * i + 2]
        a = slope(phase, now)
        b = slope(phase + 0.5 * step * a, middle)
        c = slope(phase + 0.5 * step * b, middle)
        d = slope(phase + step * c, end)
        phase = phase + step / 6 * (a + 2 * b + 2 * c + d)
    return (phase - started) / (k * step * (steps - begin))


def resting_case(duration: float, steps: int) -> tuple[Array, float]:
    """As `sinusoidal_dither`, without dither."""
    return np.zeros((2 * steps + 1, 1)), duration / steps
