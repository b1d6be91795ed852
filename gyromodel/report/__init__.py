"""The report room: the verdict in a sentence, and a page with the figures and tables behind it."""

from gyromodel.report._deviation import deviation_figure, noise_rows
from gyromodel.report._numbers import with_uncertainty
from gyromodel.report._page import write_report
from gyromodel.report._sentence import sentence

__all__ = ["deviation_figure", "noise_rows", "sentence", "with_uncertainty", "write_report"]
