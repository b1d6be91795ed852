"""What a simulation gets wrong: evidence, unknown drivers, extension, held-out gain and verdict."""

from gyromodel.diagnosis._added_tests import AddedTest, added_tests
from gyromodel.diagnosis._diagnose import diagnose
from gyromodel.diagnosis._evidence import SAFE_THRESHOLD
from gyromodel.diagnosis._isolation import Isolability, Size, isolability
from gyromodel.diagnosis._ranking import UNLISTED, special_cases
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
    "UNLISTED",
    "AddedTest",
    "Candidate",
    "Cause",
    "Confuser",
    "Diagnosis",
    "Driver",
    "Gain",
    "Isolability",
    "ParameterValue",
    "Round",
    "Size",
    "Verdict",
    "added_tests",
    "diagnose",
    "isolability",
    "special_cases",
]
