"""Archives: every campaign fitted or diagnosed, into one table that can be trusted, and what it says of the units."""

from gyromodel.batch._archive import Entry, entries
from gyromodel.batch._effects import PooledEffect, leading, pooled_effects, pooled_sentences
from gyromodel.batch._results import read_results, write_table
from gyromodel.batch._run import Batch, run_batch
from gyromodel.batch._units import Drift, Outlier, Parameter, Spread, copies, pooled_table, unit_statistics

__all__ = [
    "Batch",
    "Drift",
    "Entry",
    "Outlier",
    "Parameter",
    "PooledEffect",
    "Spread",
    "copies",
    "entries",
    "leading",
    "pooled_effects",
    "pooled_sentences",
    "pooled_table",
    "read_results",
    "run_batch",
    "unit_statistics",
    "write_table",
]
