"""Studies of a calibration in use: error budgets of a mission, what to measure next, and the best test plan."""

from gyromodel.plan import seconds
from gyromodel.study._budget import Budget, Row
from gyromodel.study._draws import Drawn, Indices, sobol_indices, symmetric_factor
from gyromodel.study._instruments import Instrument, read_instruments
from gyromodel.study._known import Known, known
from gyromodel.study._mission import OUTCOMES, Mission, Outcome
from gyromodel.study._next import REPEATED, NextTest, covariance_after, information
from gyromodel.study._plan import Part, PlanChoice, TestPlan, best_plan, read_candidates
from gyromodel.study._sensitivity import History, Result, Sensitivity, sensitivity

__all__ = [
    "OUTCOMES",
    "REPEATED",
    "Budget",
    "Drawn",
    "History",
    "Indices",
    "Instrument",
    "Known",
    "Mission",
    "NextTest",
    "Outcome",
    "Part",
    "PlanChoice",
    "Result",
    "Row",
    "Sensitivity",
    "TestPlan",
    "best_plan",
    "covariance_after",
    "information",
    "known",
    "read_candidates",
    "read_instruments",
    "seconds",
    "sensitivity",
    "sobol_indices",
    "symmetric_factor",
]
