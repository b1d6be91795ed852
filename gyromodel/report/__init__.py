"""The report room: the verdict in a sentence, a page with the figures and tables behind it, and deviations drawn."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from gyromodel.report._isolation import isolability_rows, parted_words
from gyromodel.report._numbers import number, with_uncertainty
from gyromodel.report._page import write_report
from gyromodel.report._sentence import sentence

if TYPE_CHECKING:
    from gyromodel.report._deviation import deviation_figure, noise_rows
    from gyromodel.report._study import (
        disagreements,
        history_figure,
        outcome_rows,
        parameter_rows,
        plan_sentence,
        sobol_rows,
        test_rows,
        tornado_figure,
    )
    from gyromodel.report._vibration import vibration_figures
    from gyromodel.report._vibration_page import vibration_page
    from gyromodel.report._vibration_words import vibration_words

__all__ = [
    "deviation_figure",
    "disagreements",
    "history_figure",
    "isolability_rows",
    "noise_rows",
    "number",
    "outcome_rows",
    "parameter_rows",
    "parted_words",
    "plan_sentence",
    "sentence",
    "sobol_rows",
    "test_rows",
    "tornado_figure",
    "vibration_figures",
    "vibration_page",
    "vibration_words",
    "with_uncertainty",
    "write_report",
]


def __getattr__(name: str) -> Any:
    """What needs NumPy and JAX is imported when it is used: a sentence does not."""
    if name not in __all__:
        raise AttributeError(f"module 'gyromodel.report' has no attribute {name!r}")
    rooms = {"noise_rows": "_deviation", "deviation_figure": "_deviation"}
    rooms |= {"vibration_figures": "_vibration", "vibration_words": "_vibration_words"}
    rooms["vibration_page"] = "_vibration_page"
    return getattr(import_module(f"gyromodel.report.{rooms.get(name, '_study')}"), name)
