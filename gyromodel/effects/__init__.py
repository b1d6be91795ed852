"""The effect catalogue: every class in this folder's modules is found by its definition."""

import importlib
import pkgutil

from gyromodel.effects._base import CATALOGUE, Effect, Parameter, Signals, parameter

for _module in pkgutil.iter_modules(__path__):
    if not _module.name.startswith("_"):
        importlib.import_module(f"{__name__}.{_module.name}")

__all__ = ["CATALOGUE", "Effect", "Parameter", "Signals", "parameter"]
