"""The runs of a logged vibration test: amplitude and phase of the base against the table, with intervals that hold.

Source: Zhang, Jiang, Jing and Wang, doi:10.19306/j.cnki.2095-8110.2022.06.009, 2022, for what is measured and its
limits. Standard errors are those of least squares in noise of any colour that the record shows near the frequency.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.optimize import minimize_scalar
from scipy.stats import t as student

from gyromodel.platform._acceptance import AXES, judge_gain, judge_phase, limits_at
from gyromodel.platform._motion import GIMBALS, BaseMotion
from gyromodel.platform._vibration import DECIBELS, published_response

# Largest degree of the drift, and most sines of a run: its own and overtones of friction and geometry.
DEGREE, HARMONICS = 3, 3
# Cosines that tell the noise, those nearest to the frequency, half a cycle of the record apart; and steps of its fit.
MODES, STEPS = 120, 200
# Frequencies tried on either side of a peak, in quarters of a cycle of the record.
TRIED = 8
# Degrees of freedom that an interval has at least; with kinds of noise that cannot be told apart the estimate is lower.
LEAST_FREEDOM = 4.0
# Samples that a sine, its overtones and a drift leave enough of.
LEAST_SAMPLES = 60
# Standard errors above which a sine is a vibration: the highest peak of noise stays below five.
CLEAR = 10.0
AT_REST = "left out, the table is at rest, or moves by no sine"
LEVEL = 0.95
# Part of the amplitude that other motion of the table may have before a remark says so.
OTHER_MOTION = 0.02
# Gimbals whose turns add up to roll, azimuth and pitch near zero, as `GIMBALS` counts them.
TURNING = ((3,), (0, 2), (1,))


@dataclass(frozen=True, eq=False)
class Response:
    """Amplitude and phase of one run.

    Attributes:
        run: its number in the log, from 1.
        axis: of the table that moved, "X", "Y" or "Z".
        frequency: rad/s, found in the data; frequency_std: its standard error.
        amplitude: of the table, deg.
        periods: in the record.
        gain: dB; phase: deg, negative where the base is late; gain_std, phase_std: standard errors.
        degrees_of_freedom: behind the standard errors.
        colour: standard error of the phase over what it would be in white noise of the same power.
        published: gain (dB) and phase without sign (deg) as published, over whole periods, noise not taken off.
        cross: of either other axis, the amplitude of what the base does there and the table does not, over the
            table's, with its standard error.
        limits: of |gain| and phase; none but at the published frequencies.
    """

    run: int
    axis: str
    frequency: float
    frequency_std: float
    amplitude: float
    periods: float
    gain: float
    phase: float
    gain_std: float
    phase_std: float
    degrees_of_freedom: float
    colour: float
    published: tuple[float, float]
    cross: dict[str, tuple[float, float]]
    limits: tuple[float, float] | None

    @property
    def quantile(self) -> float:
        """Standard errors from a value to either end of its 95 % interval."""
        return float(student.ppf(0.5 + LEVEL / 2, self.degrees_of_freedom))

    @property
    def gain_interval(self) -> tuple[float, float]:
        """95 % interval, dB."""
        return self.gain - self.quantile * self.gain_std, self.gain + self.quantile * self.gain_std

    @property
    def phase_interval(self) -> tuple[float, float]:
        """95 % interval, deg."""
        return self.phase - self.quantile * self.phase_std, self.phase + self.quantile * self.phase_std

    @property
    def verdicts(self) -> tuple[str, str]:
        """Of gain and phase: "pass", "fail", "cannot tell" where a limit lies in the interval, or "no limit"."""
        if self.limits is None:
            return "no limit", "no limit"
        gain, phase = judge_gain(*self.gain_interval, self.limits[0]), judge_phase(*self.phase_interval, self.limits[1])
        return str(gain), str(phase)

    def to_dict(self) -> dict[str, Any]:
        """Everything by name, units in the names."""
        gain_limit, phase_limit = self.limits or (None, None)
        return {
            "run": self.run,
            "axis": self.axis,
            "frequency_rad_s": self.frequency,
            "frequency_std_rad_s": self.frequency_std,
            "amplitude_deg": self.amplitude,
            "periods": self.periods,
            "gain_db": self.gain,
            "gain_std_db": self.gain_std,
            "gain_interval_db": self.gain_interval,
            "gain_limit_db": gain_limit,
            "gain_verdict": self.verdicts[0],
            "phase_deg": self.phase,
            "phase_std_deg": self.phase_std,
            "phase_interval_deg": self.phase_interval,
            "phase_limit_deg": phase_limit,
            "phase_verdict": self.verdicts[1],
            "degrees_of_freedom": self.degrees_of_freedom,
            "colour": self.colour,
            "published_gain_db": self.published[0],
            "published_phase_without_sign_deg": self.published[1],
            "cross_axes": {axis: {"ratio": ratio, "std": std} for axis, (ratio, std) in self.cross.items()},
        }


def responses(motion: BaseMotion) -> tuple[list[Response], list[str]]:
    """The response of each run, and remarks on runs that have none or need a second look.

    The axis is that of the table's largest sine, the frequency where its spectrum peaks, refined with both signals.
    """
    found, remarks = [], []
    # The coarsest step of an encoder of the table and of the gimbals.
    steps = max(map(_quantum, motion.gimbals.T)), max(map(_quantum, motion.table.T))
    for k in range(int(motion.segment[-1]) + 1):
        rows = np.flatnonzero(motion.segment == k)
        response, remark = _response(k + 1, motion.time[rows], motion.base[rows], motion.table[rows], steps)
        found += [response] if response else []
        remarks += [f"run {k + 1}: {remark}"] if remark else []
    return found, remarks + _still(found, motion)


def _response(
    run: int, time: np.ndarray, base: np.ndarray, table: np.ndarray, steps: tuple[float, float]
) -> tuple[Response | None, str]:
    if len(time) < LEAST_SAMPLES:
        return None, f"left out, {len(time)} samples are fewer than the {LEAST_SAMPLES} that a response takes"
    time = time - time[0]
    peaks = [_peak(time, y) for y in table.T]
    axis = int(np.argmax([size for size, _ in peaks]))
    x, y = base[:, axis], table[:, axis]
    if not np.ptp(y) > 0:
        return None, AT_REST
    step = float(np.median(np.diff(time)))
    start, length = peaks[axis][1], float(time[-1]) + step
    degree = int(np.clip(start * length / (2 * np.pi), 1, DEGREE))
    # At two samples a period or fewer a sine is one of any frequency.
    harmonics = int(np.clip(0.9 * np.pi / step / start, 1, HARMONICS))
    w, frequency_std = _frequency(time, y, start, length, degree, harmonics)
    periods = w * length / (2 * np.pi)
    if periods < 1:
        return None, f"left out, {length:.3g} s are less than a period at {w:.3g} rad/s"

    columns = _columns(time, w, degree, harmonics)
    others = [k for k in range(3) if k != axis]
    # Of the base alone on the axes that should not move, and of x less y: what both have in common is no noise of it.
    signals = np.column_stack([x, y, *(base[:, k] - table[:, k] for k in others)])
    sines = np.linalg.lstsq(columns, signals, rcond=None)[0]
    left = signals - columns @ sines
    size, phases = np.hypot(*sines[:2, :2]), np.arctan2(sines[1, :2], sines[0, :2])
    noise = np.sqrt(np.sum(left**2, axis=0) / (len(time) - columns.shape[1]))[:2]
    if not size[1] > CLEAR * noise[1] * np.sqrt(2 / len(time)):
        return None, AT_REST
    covariance, freedom = _sine_covariance(time, columns, left[:, 0] - size[0] / size[1] * left[:, 1], periods)
    sine, cosine = sines[:2, 0]
    turned = np.array([[sine, cosine], [-cosine, sine]]) / size[0] ** 2
    log_gain, angle = np.sqrt(np.diag(turned @ covariance @ turned.T))
    white = np.hypot(*(noise / size)) * np.sqrt(2 / len(time))
    plain = np.sqrt(np.maximum(noise**2 - np.square(steps) / 12, 0.0))
    rounding = [_rounding(*each) / each[0] for each in zip(size, steps, plain, strict=True)]
    cross = {}
    for k, (name, residual) in enumerate(zip([AXES[k] for k in others], left[:, 2:].T, strict=True)):
        spread = np.sqrt(0.5 * np.trace(_sine_covariance(time, columns, residual, periods)[0]))
        cross[name] = (float(np.hypot(*sines[:2, 2 + k]) / size[1]), float(spread / size[1]))
    found = Response(
        run=run,
        axis=AXES[axis],
        frequency=w,
        frequency_std=frequency_std,
        amplitude=float(np.rad2deg(size[1])),
        periods=periods,
        gain=float(DECIBELS * np.log(size[0] / size[1])),
        phase=float(np.rad2deg((phases[0] - phases[1] + np.pi) % (2 * np.pi) - np.pi)),
        gain_std=DECIBELS * float(np.hypot(log_gain, np.hypot(*rounding))),
        phase_std=float(np.rad2deg(angle)),
        degrees_of_freedom=freedom,
        colour=float(angle / white),
        published=_published(time, x, y, w),
        cross=cross,
        limits=limits_at(w),
    )
    moves = {AXES[k]: np.std(table[:, k]) * np.sqrt(2) / size[1] for k in others}
    also = [f"{name} ({100 * part:.0f} %)" for name, part in moves.items() if part > OTHER_MOTION]
    remarks = [f"the table moves about {' and '.join(also)} too"] if also else []
    # White noise shows in differences, a motion does not.
    rest = left[:, 1] + columns[:, 2 : 2 * harmonics] @ sines[2 : 2 * harmonics, 1]
    part = np.sqrt(2 * max(np.mean(rest**2) - 0.5 * np.mean(np.diff(rest) ** 2), 0.0)) / size[1]
    if part > OTHER_MOTION:
        remarks.append(
            f"the table moves by {100 * part:.0f} % of this sine besides, most at {_peak(time, rest)[1]:.3g} rad/s: "
            "the response is that at one frequency of a motion that has others"
        )
    return found, "; ".join(remarks)


def _still(found: list[Response], motion: BaseMotion) -> list[str]:
    """What to say of gimbals that read one value in all runs about an axis that they turn about."""
    remarks = []
    for row, axis in zip(motion.mounting, AXES, strict=True):
        runs = [r.run - 1 for r in found if r.axis == axis]
        for gimbal in TURNING[int(np.argmax(np.abs(row)))]:
            readings = motion.gimbals[np.isin(motion.segment, runs), gimbal]
            if len(readings) and not np.ptp(readings) > 0:
                remarks.append(
                    f"{GIMBALS[gimbal]} reads one value while the table moves about {axis}: what the base does there "
                    "is wrong if its encoder is dead"
                )
    return remarks


def _frequency(
    time: np.ndarray, y: np.ndarray, start: float, length: float, degree: int, harmonics: int
) -> tuple[float, float]:
    """Of least squares of the table alone, which no drift of gyros disturbs, and its standard error."""

    def left(w: float, degree: int = degree, harmonics: int = harmonics) -> np.ndarray:
        columns = _columns(time, w, degree, harmonics)
        return y - columns @ np.linalg.lstsq(columns, y, rcond=None)[0]

    # First without overtones, whose presence would let a fraction of the frequency pass for it.
    tried = start + np.pi / (2 * length) * np.arange(-TRIED, TRIED + 1)
    tried = tried[tried > 0.5 * np.pi / length]
    start = tried[np.argmin([np.sum(left(w, 1, 1) ** 2) for w in tried])]
    near = max(start - 0.5 * np.pi / length, 0.5 * start), start + 0.5 * np.pi / length
    options = {"xatol": 1e-8 / length}
    found: Any = minimize_scalar(lambda w: np.sum(left(w) ** 2), bounds=near, method="bounded", options=options)
    w, nudge = float(found.x), 1e-3 / length
    # The residual by ω.
    slope = (left(w + nudge) - left(w - nudge)) / (2 * nudge)
    variance = float(found.fun) / (len(time) - 2 * harmonics - degree - 2)
    return w, float(np.sqrt(variance / np.sum(slope**2)))


def _peak(time: np.ndarray, y: np.ndarray) -> tuple[float, float]:
    """Size and frequency of the largest sine, near enough for a fit; a line taken off."""
    even = np.linspace(time[0], time[-1], len(time))
    y = np.interp(even, time, y)
    y = y - np.polyval(np.polyfit(even, y, 1), even)
    padded = 4 * len(y)
    spectrum = np.abs(np.fft.rfft(y * np.hanning(len(y)), padded))
    # From half a cycle of the record up: less is drift.
    spectrum[:2] = 0
    at = int(np.argmax(spectrum))
    return float(spectrum[at]), 2 * np.pi * at / (padded * (even[1] - even[0]))


def _columns(time: np.ndarray, w: float, degree: int, harmonics: int) -> np.ndarray:
    """Sine, cosine, their overtones, powers of time."""
    middle = time - 0.5 * (time[0] + time[-1])
    waves = [wave(k * w * middle) for k in range(1, harmonics + 1) for wave in (np.sin, np.cos)]
    return np.column_stack([*waves, np.polynomial.legendre.legvander(2 * middle / np.ptp(time), degree)])


def _sine_covariance(
    time: np.ndarray, columns: np.ndarray, residual: np.ndarray, periods: float
) -> tuple[Float[np.ndarray, "2 2"], float]:
    """Covariance of the first two coefficients of a least-squares fit, and its degrees of freedom.

    The noise is white, with a random walk and the integral of one, as those of encoders, of the angle of gyros and of
    their rate are. Each has the part that makes the cosine transform of the residual likeliest near the frequency.
    """
    n = len(time)
    modes = np.arange(1, n)
    modes = modes[np.argsort(np.abs(modes - 2 * periods), kind="stable")[:MODES]]
    waves = np.sqrt(2 / n) * np.cos(np.pi / n * np.outer(np.arange(n) + 0.5, modes))
    q, r = np.linalg.qr(columns)
    estimator = q @ np.linalg.inv(r).T[:, :2]
    parts = [_passed(time, waves - q @ (q.T @ waves)), _passed(time, estimator)]
    power = (waves.T @ residual) ** 2
    if not power.any():
        return np.zeros((2, 2)), float(len(modes))
    # Units in which all parts are of one size.
    seen = np.stack([np.sum(x**2, axis=0) for x in parts[0]])
    scale = seen.mean(axis=1)
    share, seen = np.full(len(scale), power.mean() / len(scale)), seen / scale[:, None]
    # Each step raises the likelihood of variances that add up (Hunter and Lange 2004).
    for _ in range(STEPS):
        variance = share @ seen
        share = share * np.sqrt((seen @ (power / variance**2)) / (seen @ (1 / variance)))
    covariances = np.stack([x.T @ x / s for x, s in zip(parts[1], scale, strict=True)])
    total = np.trace(covariances, axis1=1, axis2=2)
    active = share * total > 1e-6 * (share @ total)
    information = 0.5 * (seen / variance**2) @ seen.T
    spread = np.linalg.pinv(information[np.ix_(active, active)])
    freedom = 2 * (share @ total) ** 2 / (total[active] @ spread @ total[active])
    return np.tensordot(share, covariances, 1), max(float(freedom), LEAST_FREEDOM)


def _passed(time: np.ndarray, weights: np.ndarray) -> list[np.ndarray]:
    """What weighted sums of samples weigh of white noise, of the steps of a walk, and of those of a walk of rates."""
    steps = np.diff(time, prepend=2 * time[0] - time[1])[:, None]
    later = np.cumsum(weights[::-1], axis=0)[::-1]
    last = np.cumsum((steps * later)[::-1], axis=0)[::-1]
    return [weights, np.sqrt(steps) * later, np.sqrt(steps) * last]


def _quantum(angles: np.ndarray) -> float:
    """Step of an encoder: the smallest difference of its readings, if all are multiples of it; else zero."""
    steps = np.diff(np.unique(np.round(angles, 12)))
    if not len(steps):
        return 0.0
    # Written with few digits, steps differ a little.
    parts = steps[steps < 10 * steps.min()] / steps.min()
    return float(steps.min()) if np.abs(parts - np.round(parts)).max() < 0.1 else 0.0


def _rounding(amplitude: float, quantum: float, noise: float) -> float:
    """Standard deviation of the amplitude of a sine that an encoder rounds, over the phases of its steps.

    A sine rounded to steps q has the amplitude A + (2q/π) Σ (−1)^k J_1(2πkA/q)/k cos(2πkm/q) e^(−2π²k²σ²/q²), with the
    mean m; J_1² is 1/(πz) on average. The cosine is taken for one, as it is where encoders start from zero.
    """
    if not quantum:
        return 0.0
    k = np.arange(1, 6)
    each = quantum / (2 * np.pi**2 * k**3 * amplitude) * np.exp(-((2 * np.pi * k * noise / quantum) ** 2))
    return float(2 * quantum / np.pi * np.sqrt(each.sum()))


def _published(time: np.ndarray, x: np.ndarray, y: np.ndarray, w: float) -> tuple[float, float]:
    """Equations (8)-(29) over the whole periods there are, means taken off."""
    step = np.median(np.diff(time))
    whole = 2 * np.pi / w * np.floor(w * (time[-1] + step) / (2 * np.pi) + 1e-9)
    inside = time < whole - 1e-9
    base, table = (jnp.asarray(s[inside] - s[inside].mean()) for s in (x, y))
    found = published_response(base, table)
    return float(found.gain), float(found.phase)
