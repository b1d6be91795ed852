"""Archives: every campaign fitted or diagnosed, into one table that can be trusted."""

from gyromodel.batch._archive import Entry, entries
from gyromodel.batch._run import Batch, run_batch

__all__ = ["Batch", "Entry", "entries", "run_batch"]
