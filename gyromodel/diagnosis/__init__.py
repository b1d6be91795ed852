"""What a simulation gets wrong: evidence, unknown drivers, extension, held-out gain and verdict."""

from gyromodel.diagnosis._diagnose import SAFE_THRESHOLD, diagnose
from gyromodel.diagnosis._result import (
    Candidate,
    Cause,
    Confuser,
    Diagnosis,
    Driver,
    Gain,
    ParameterValue,
    Round,
    Verdict,
)

__all__ = [
    "SAFE_THRESHOLD",
    "Candidate",
    "Cause",
    "Confuser",
    "Diagnosis",
    "Driver",
    "Gain",
    "ParameterValue",
    "Round",
    "Verdict",
    "diagnose",
]
