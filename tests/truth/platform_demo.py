"""The embedded log of a vibration test: a simulated platform whose records are late and whose shafts rub.

    python -m tests.truth.platform_demo

writes gyromodel/data/platform_vibration.csv.gz again.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gyromodel.campaign import Campaign
from gyromodel.files import write_campaign
from tests.truth.platform import Platform
from tests.truth.platform_campaign import vibration_test

FREQUENCIES = (1.0, 10.0, 20.0, 30.0)
QUANTUM = 2 * np.pi / 2**20
DIGITS = 5
DESIGN = Platform(
    viscous=np.full(4, 0.5),
    coulomb=np.full(4, 0.002),
    noise=np.deg2rad(0.002) / 60,
    drift=lambda time: np.deg2rad(np.array([0.02, -0.03, 0.01]) / 3600) * np.ones((len(time), 1)),
    offset=-0.002,
    quantum=QUANTUM,
    log=0.02,
)


def demo_log(seed: int = 1) -> Campaign:
    """Twelve runs of 14 s: X, Y and Z at 1, 10, 20 and 30 rad/s, 0.15 deg; `seed` of the noise."""
    amplitude = np.deg2rad(0.15) * np.repeat(np.eye(3), 4, axis=0)
    frequency = np.tile(FREQUENCIES, 3)[:, None] * np.ones(3)
    log = vibration_test(DESIGN, amplitude, frequency, 15.0, skip=1.0, seed=seed)
    for name in log.columns:
        log = log.with_column(name, np.round(log.columns[name], DIGITS), log.units[name])
    return log.with_metadata({"test": "angular vibration, simulated"})


if __name__ == "__main__":
    path = Path(__file__).parents[2] / "gyromodel" / "data" / "platform_vibration.csv.gz"
    write_campaign(demo_log(), path)
    print(f"{path.stat().st_size} bytes")
