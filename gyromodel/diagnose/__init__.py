"""What a simulation gets wrong: evidence, unknown drivers, extension, held-out gain and verdict."""

from gyromodel.diagnose._diagnose import SAFE_THRESHOLD, diagnose
from gyromodel.diagnose._result import Candidate, Cause, Confuser, Diagnosis, Driver, Gain, ParameterValue, Round, Verdict

__all__ = [
    "SAFE_THRESHOLD", "Candidate", "Cause", "Confuser", "Diagnosis", "Driver", "Gain", "ParameterValue", "Round", "Verdict",
    "diagnose",
]  # fmt: skip
