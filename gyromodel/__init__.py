"""What a gyro simulation gets wrong, why, and the model that gets it right.

Importing this package switches JAX to float64, here and nowhere else. Names are imported when first used, so that
the package itself, and commands that compute nothing, load neither JAX nor pandas.
"""

from __future__ import annotations

import os
import sys

# Not from typing, which would be the first thing that a command waits for.
TYPE_CHECKING = False
if TYPE_CHECKING:
    from gyromodel._checks import CampaignError as CampaignError
    from gyromodel.campaign import Campaign as Campaign
    from gyromodel.compensation import compensate as compensate
    from gyromodel.diagnosis import Diagnosis as Diagnosis
    from gyromodel.diagnosis import diagnose as diagnose
    from gyromodel.diagnosis import isolability as isolability
    from gyromodel.effects import CATALOGUE as CATALOGUE
    from gyromodel.effects import Effect as Effect
    from gyromodel.estimate import Calibration as Calibration
    from gyromodel.estimate import Estimate as Estimate
    from gyromodel.estimate import fit as fit
    from gyromodel.estimate import fit_function as fit_function
    from gyromodel.estimate import two_stage as two_stage
    from gyromodel.export import export_calibration as export_calibration
    from gyromodel.files import read_campaign as read_campaign
    from gyromodel.files import write_campaign as write_campaign
    from gyromodel.model import GyroModel as GyroModel
    from gyromodel.model import model_from_effects as model_from_effects
    from gyromodel.model_files import read_calibration as read_calibration
    from gyromodel.model_files import read_model as read_model
    from gyromodel.model_files import write_model as write_model
    from gyromodel.noise_analysis import analyse_noise as analyse_noise
    from gyromodel.numerics.uncertain import Uncertain as Uncertain
    from gyromodel.numerics.uncertain import together as together
    from gyromodel.report import write_report as write_report
    from gyromodel.simulation import simulate as simulate
    from gyromodel.units import UnitError as UnitError

__version__ = "0.1.0"

_MODULE_OF = {
    "CATALOGUE": "effects",
    "Calibration": "estimate",
    "Campaign": "campaign",
    "CampaignError": "_checks",
    "Diagnosis": "diagnosis",
    "Effect": "effects",
    "Estimate": "estimate",
    "GyroModel": "model",
    "Uncertain": "numerics.uncertain",
    "UnitError": "units",
    "compensate": "compensation",
    "analyse_noise": "noise_analysis",
    "diagnose": "diagnosis",
    "export_calibration": "export",
    "fit": "estimate",
    "fit_function": "estimate",
    "isolability": "diagnosis",
    "model_from_effects": "model",
    "read_calibration": "model_files",
    "read_campaign": "files",
    "read_model": "model_files",
    "simulate": "simulation",
    "together": "numerics.uncertain",
    "two_stage": "estimate",
    "write_campaign": "files",
    "write_model": "model_files",
    "write_report": "report",
}
__all__ = ["__version__", *_MODULE_OF]  # pyright: ignore[reportUnsupportedDunderAll]

# JAX reads the variable when it is imported; a process that imported JAX before this package is switched directly.
if "jax" in sys.modules:
    sys.modules["jax"].config.update("jax_enable_x64", True)
else:
    os.environ["JAX_ENABLE_X64"] = "1"


def __getattr__(name: str) -> object:
    from importlib import import_module

    if name not in _MODULE_OF:
        raise AttributeError(f"module 'gyromodel' has no attribute {name!r}")
    value = getattr(import_module(f"gyromodel.{_MODULE_OF[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
