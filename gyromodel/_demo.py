"""The demonstration: both examples copied from the package or simulated, and diagnosed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from gyromodel._atomic import write_text
from gyromodel._console import print_paths, read_campaigns
from gyromodel._diagnose_files import REPORTS, diagnose_to
from gyromodel.files import write_campaign
from gyromodel.model_files import read_model
from gyromodel.plan import read_plan
from gyromodel.simulation import simulate

DATA = Path(__file__).parent / "data"
TITLES = {
    "ring_laser": "Ring laser gyro on a rate table, published data:",
    "fiber_optic": "Fiber-optic gyro over temperature, simulated from truth.yaml:",
}


def run_demo(quiet: bool) -> dict[str, Any]:
    """Both diagnoses as plain data, by example; printed one by one unless quiet."""
    folders = {"ring_laser": Path("gyromodel-demo"), "fiber_optic": Path("gyromodel-demo", "fiber_optic")}
    table, thermal = folders.values()
    copies = {
        "ring_laser_table.csv": table / "campaign.csv",
        "ring_laser_model.yaml": table / "simulation.yaml",
        "fiber_optic_plan.yaml": thermal / "plan.yaml",
        "fiber_optic_truth.yaml": thermal / "truth.yaml",
        "fiber_optic_model.yaml": thermal / "simulation.yaml",
    }
    for source, target in copies.items():
        write_text(target, (DATA / source).read_text(encoding="utf-8"))
    simulated = simulate(read_model(thermal / "truth.yaml"), read_plan(thermal / "plan.yaml"), seed=0)
    write_campaign(simulated, thermal / "campaign.csv")
    found = {}
    for name, folder in folders.items():
        measured = read_campaigns([folder / "campaign.csv"], None)
        diagnosis, verdict = diagnose_to(measured, folder / "simulation.yaml", folder)
        found[name] = diagnosis.to_dict() | {"model": "model.yaml"}
        if not quiet:
            print(f"{TITLES[name]}\n{verdict}")
            print_paths(folder, *REPORTS)
            print()
    return found
