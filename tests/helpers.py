"""A small good campaign that tests bend, and ways to damage a file."""

from __future__ import annotations

from typing import Any

import numpy as np
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st

from gyromodel.campaign import Campaign

COLUMNS = {
    "time": np.array([0.0, 0.1, 0.2, 0.3, 0.4, 0.5]),
    "rate": np.array([0.0, 10.0, -10.0, 20.0, -20.0, 1 / 3]),
    "temperature": np.array([25.0, 25.5, np.nan, 26.5, 27.0, -0.0]),
    "output": np.array([3.0, 1003.25, -997.0, 2003.0, np.nan, 1e-300]),
}
UNITS = {"time": "s", "rate": "deg/s", "temperature": "degC", "output": "count"}
METADATA: dict[str, str | int | float] = {"gyro": "fog", "kind": "rate", "serial": "007", "run_number": 7, "drift": 2.0}


def small_campaign(
    columns: dict[str, Any] | None = None, units: dict[str, str] | None = None, **metadata: Any
) -> Campaign:
    """Six rows of a rate test, with columns, units and metadata added or replaced; a metadata value of None removes."""
    kept = {key: value for key, value in {**METADATA, **metadata}.items() if value is not None}
    return Campaign({**COLUMNS, **(columns or {})}, {**UNITS, **(units or {})}, kept, "small")


# Examples of one test write to the same temporary folder.
SHARED_FOLDER = settings(suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow])
MUTANTS = st.lists(
    st.tuples(
        st.sampled_from(["flip", "cut", "insert", "delete", "repeat", "number"]),
        st.integers(0, 10**6),
        st.integers(1, 40),
        st.binary(max_size=8),
    ),
    min_size=1,
    max_size=4,
)


def mutated(data: bytes, changes: list[tuple[str, int, int, bytes]]) -> bytes:
    for kind, place, length, junk in changes:
        at = place % (len(data) + 1)
        if kind == "flip":
            data = data[:at] + bytes(b ^ (1 << (length % 8)) for b in data[at : at + 1]) + data[at + 1 :]
        elif kind == "cut":
            data = data[:at]
        elif kind == "insert":
            data = data[:at] + junk + data[at:]
        elif kind == "delete":
            data = data[:at] + data[at + length :]
        elif kind == "repeat":
            data = data[:at] + data[max(0, at - length) :]
        else:
            data = data[:at] + [b"1e308", b"-inf", b"nan", b",", b"\r", b'"', b"\n#", b"[]"][length % 8] + data[at:]
    return data
