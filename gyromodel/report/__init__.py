"""The report room: the verdict in a sentence, a page with the figures and tables behind it, and deviations drawn."""

from typing import TYPE_CHECKING, Any

from gyromodel.report._isolation import isolability_rows, parted_words
from gyromodel.report._numbers import with_uncertainty
from gyromodel.report._page import write_report
from gyromodel.report._sentence import sentence

if TYPE_CHECKING:
    from gyromodel.report._deviation import deviation_figure, noise_rows
    from gyromodel.report._vibration import vibration_figures, vibration_words

__all__ = [
    "deviation_figure",
    "isolability_rows",
    "noise_rows",
    "parted_words",
    "sentence",
    "vibration_figures",
    "vibration_words",
    "with_uncertainty",
    "write_report",
]


def __getattr__(name: str) -> Any:
    """What needs NumPy and JAX is imported when it is used: a sentence does not."""
    if name in ("deviation_figure", "noise_rows"):
        from gyromodel.report import _deviation as module
    elif name in ("vibration_figures", "vibration_words"):
        from gyromodel.report import _vibration as module
    else:
        raise AttributeError(f"module 'gyromodel.report' has no attribute {name!r}")
    return getattr(module, name)
