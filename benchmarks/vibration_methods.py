"""Four ways to a platform's amplitude and phase from one log, under drift: gimbal angles or navigation attitude.

    python -m benchmarks.vibration_methods

writes benchmarks/results/vibration_methods.md. The platform is the rigid-body one of the tests, without friction, so
that its base does what the table does: 0 dB and 0 deg.
"""

from __future__ import annotations

import sys

import numpy as np
from scipy.signal import butter, filtfilt

from benchmarks._measure import table, write_result

FREQUENCIES, DRIFTS, DURATIONS, SEEDS = (1.0, 10.0, 30.0), (0.0, 1.0, 10.0), (20.0, 60.0), 4
AMPLITUDE, NOISE = 0.15, 1.0
# Gimbal angles of a platform that was started some hours ago.
TURNED = np.deg2rad([25.0, -20.0, 0.0, 30.0])
HEAD = [
    "rad/s",
    "s",
    "drift, deg/h",
    "trend off gimbals",
    "band-pass of gimbals",
    "navigation, published",
    "navigation, ours",
]


def campaigns(start, drifts, duration):
    """(frequency, drift, campaign) of every run about Z, the horizontal axis to the north."""
    from gyromodel.campaign import Campaign
    from tests.truth import platform
    from tests.truth.platform_campaign import GIMBALS

    cases = [(w, d) for w in FREQUENCIES for d in drifts for _ in range(SEEDS)]
    rates = np.deg2rad(np.array([d for _, d in cases])) / 3600

    def drift(time):
        # Grows by its first value in 20 s.
        return rates[:, None, None] * (1 + time[:, None] / 20) * np.array([1.0, -0.6, 0.8])

    design = platform.Platform(
        viscous=np.zeros(4), coulomb=np.zeros(4), drift=drift, noise=np.deg2rad(0.005) / 60, quantum=2 * np.pi / 2**20
    )
    amplitude = np.tile(np.deg2rad([0.0, 0.0, AMPLITUDE]), (len(cases), 1))
    frequency = np.array([w for w, _ in cases])[:, None] * np.ones(3)
    run, rng = platform.simulate(design, amplitude, frequency, duration, start), np.random.default_rng(0)
    names = ["time", "table_x", "table_y", "table_z", *GIMBALS]
    for k, (w, d) in enumerate(cases):
        angles = np.rad2deg(np.concatenate([run.table[k], run.gimbals[k]], axis=1))
        angles = angles + NOISE / 3600 * rng.standard_normal(angles.shape)
        columns = dict(zip(names, [run.time, *angles.T], strict=True))
        units = {"time": "s"} | dict.fromkeys(names[1:], "deg")
        yield w, d, Campaign(columns, units, {"latitude_deg": float(np.rad2deg(design.latitude))})


def estimates(campaign, w):
    """Gain (dB) and phase (deg) by each method: method by two."""
    import jax.numpy as jnp

    from gyromodel.platform import base_motion, fit_sines, responses

    motion = base_motion(campaign)
    time, y = motion.time, motion.table[:, 2]
    # The gimbal that moves most at the frequency, counted in the table's sense.
    basis = np.column_stack([np.sin(w * time), np.cos(w * time), time, np.ones_like(time)])
    waves = np.linalg.lstsq(basis, np.column_stack([y, motion.gimbals]), rcond=None)[0][:2]
    most = int(np.argmax(np.hypot(*waves[:, 1:])))
    gimbal = motion.gimbals[:, most] * np.sign(waves[:, 0] @ waves[:, 1 + most])
    trend = gimbal - np.polyval(np.polyfit(time, gimbal, 2), time)
    step = time[1] - time[0]
    passed = [filtfilt(*butter(2, np.array([0.5, 2.0]) * w * step / np.pi, "band"), s) for s in (gimbal, y)]

    def plain(x, y):
        fit = fit_sines(jnp.asarray(time), jnp.asarray(x), jnp.asarray(y), w, degree=0)
        return float(fit.gain), float(fit.phase)

    [found], _ = responses(motion)
    return [plain(trend, y), plain(*passed), found.published, (found.gain, found.phase)]


def rows(start, drifts, durations):
    """Root mean square errors of each method."""
    made = []
    runs = list(campaigns(start, drifts, max(durations)))
    for length in durations:
        errors = {}
        for w, d, campaign in runs:
            part = campaign.select(campaign.columns["time"] < length)
            errors.setdefault((w, d), []).append(estimates(part, w))
            print(w, length, d, file=sys.stderr)
        for (w, d), each in errors.items():
            rms = np.sqrt(np.mean(np.square(each), axis=0))
            cells = [f"{gain:.3g} dB, {phase:.3g}°" for gain, phase in rms]
            made.append([f"{w:g}", f"{length:g}", f"{d:g}", *cells])
    return made


def main() -> None:
    argv = sys.argv[1:]
    lines = [
        f"A platform without friction on a table at ±{AMPLITUDE}° about Z, to the north, so that the response is 0 "
        f"dB and 0°. At 100 Hz, encoders of 20 bit with {NOISE:g} arcsec of noise besides, gyros of 0.005 deg/√h, "
        f"latitude 40°. Root mean square errors of {SEEDS} runs. Drift is that of the gyros at the start, and grows"
        " by as much in 20 s; it is not logged. Trend: a parabola is taken off the angle of the gimbal that moves "
        "most, then sines are fitted. Band-pass: Butterworth of second order from half to twice the frequency, "
        "forth and back, on that gimbal and the table. Navigation: base angles of `base_motion`, by the published "
        "correlations over whole periods, and as `gyromodel vibration` does.",
        "",
        "## Gimbals near zero",
        "",
        *table(HEAD, rows(None, DRIFTS, DURATIONS)),
        "",
        "## Gimbals at 25°, −20°, 0° and 30°",
        "",
        *table(HEAD, rows(TURNED, (1.0,), (20.0,))),
    ]
    write_result("vibration_methods", "Methods for angular vibration", "vibration_methods", argv, lines)


if __name__ == "__main__":
    main()
