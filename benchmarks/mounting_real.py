"""Mounting against angles that are not right, on a wand under optical attitude.

    python -m benchmarks.mounting_real

writes benchmarks/results/mounting_real.md. The data are read from the folder that GYROMODEL_DATA names, or
../shared/data; they are not part of the project.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from scipy.stats import chi2

import gyromodel
from benchmarks._measure import DATA, table, write_result
from benchmarks.attitude_real import BEFOREHAND, SESSIONS, fitted, windows_of
from benchmarks.cases import AXES, BIAS, causes, command
from gyromodel.attitude import COLUMNS
from gyromodel.model import model_from_effects
from gyromodel.numerics.rotations import exponential, product
from gyromodel.three_axes import PAIRS, triad

LABELS = ("TStick 04", "TStick 02")
ARCSEC = 3600 * 180 / np.pi
# By which the reference is turned about x, y and z before it is used: a mounting of known size (deg).
TURNS = (0.0, 1.0, 5.0)
# A lean is believed as far as the mounting is (rad), so that what is known beforehand decides nothing between them.
ALIKE = BEFOREHAND | {"lean": 0.05, "turn": 0.05}
MODEL = f"{BIAS}  - effect: scale_factor\n"


def turned(campaign: gyromodel.Campaign, angle: float) -> gyromodel.Campaign:
    """The campaign with its reference axes turned by `angle` (deg) about x, y and z each, as another mounting would."""
    attitude = np.column_stack([campaign.columns[name] for name in COLUMNS])
    turned_by = product(jnp.asarray(attitude), exponential(jnp.full(3, np.deg2rad(angle))))
    for name, values in zip(COLUMNS, np.asarray(turned_by).T, strict=True):
        campaign = campaign.without(name).with_column(name, values, "")
    return campaign


def listed(values: np.ndarray, covariance: np.ndarray) -> str:
    """Three angles with their standard uncertainties, in arcsec."""
    std = np.sqrt(np.diag(covariance))
    return ", ".join(f"{v * ARCSEC:.0f} ± {s * ARCSEC:.0f}" for v, s in zip(values, std, strict=True))


def chance(values: np.ndarray, covariance: np.ndarray) -> str:
    """How likely noise alone makes three values as far from zero."""
    return f"{chi2.sf(values @ np.linalg.solve(covariance, values), 3):.1g}"


def by_rates(campaigns: list[gyromodel.Campaign]) -> list[list[str]]:
    """What `triad` says of sessions of the unit as they are, and with a mounting added."""
    rows = []
    for angle in TURNS:
        use = [turned(campaign, angle) for campaign in campaigns]
        model = model_from_effects(["bias", "scale_factor"], gyro="mems")
        found = triad(use, {axis: gyromodel.fit([c.axis(axis) for c in use], model) for axis in AXES})
        if found is None:
            raise SystemExit("no lie of the axes")
        rotation, square = found.rotation_covariance, found.squareness_covariance
        said = [w for w, yes in (("mounting", found.turned), ("non-orthogonality", found.oblique)) if yes]
        told = "not told" if found.not_told else " and ".join(said) or "neither"
        rows.append([
            f"{angle:g} deg", listed(found.rotation, rotation), chance(found.rotation, rotation),
            listed(found.squareness, square), chance(found.squareness, square), told,
        ])  # fmt: skip
    return rows


def by_integrator(label: str) -> list[str]:
    """Rotation and squareness in the sense of `triad`, by a fit to where windows of the session end."""
    found = fitted(windows_of(label, DATA / "mems_attitude"), known=ALIKE)
    names = [name for name in sorted(found.value) for _ in range(np.size(found.value[name]))]
    turn, lean = ([i for i, n in enumerate(names) if n == name] for name in ("turn", "lean"))
    covariance = np.asarray(found.covariance)
    # The matrix takes outputs back to rates, so that a lean is half of what an angle is short of a right one, negated.
    rotation, square = covariance[np.ix_(turn, turn)], 4 * covariance[np.ix_(lean, lean)]
    angles, short = np.asarray(found.value["turn"]), -2 * np.asarray(found.value["lean"])
    return [
        "0 deg, through the integrator", listed(angles, rotation), chance(angles, rotation), listed(short, square),
        chance(short, square), "–",
    ]  # fmt: skip


def commanded(path: Path, folder: Path) -> list[str]:
    """What `diagnose` answers of each axis and of all three."""
    folder.mkdir()
    (folder / "simulation.yaml").write_text(MODEL)
    result, seconds, refusal = command("diagnose", path, "--model", folder / "simulation.yaml", "-o", folder)
    if not result:
        raise SystemExit(refusal)
    lie = result["triad"]
    words = (
        "not told"
        if lie is None or lie["not_told"]
        else str({part: lie[part]["significant"] for part in ("rotation", "squareness")})
    )
    return [*(causes(result["axes"][axis]) for axis in AXES), words, f"{seconds:.0f}"]


def main() -> None:
    pairs = ", ".join(AXES[i] + AXES[j] for i, j in PAIRS)
    head = ["mounting added", "rotation x, y, z", "chance", "squareness xy, yz, zx", "chance", "told"]
    lines = [
        "Whether a mounting is taken for axes that are not at right angles. *Rotation* is that of the three axes "
        f"together about x, y, z; *squareness* what {pairs} lack of a right angle; arcsec with standard uncertainties, "
        "and the chance that noise alone does as much (3 degrees of freedom; below 1e-3 it is told). Each axis has a "
        "bias, a scale factor and leans towards both others. Where the unit turns about some direction at a tenth or "
        "less of its fastest rate, neither is told, and beside a session that turns about all three it has leans of "
        "its own, which do not count. "
        "*Mounting added*: the reference turned by this much about x, y and z each, which takes "
        "about as much from the rotation and leaves the squareness. "
        "The last row of a session has the same angles from another fit, through the integrator to where windows end "
        f"(`attitude_real`), leans and mounting within {ALIKE['lean']:g} rad alike.",
        "",
    ]
    campaigns, verdicts = [], []
    for label in LABELS:
        path = DATA / f"mems_attitude/{SESSIONS[label][0]}.csv.gz"
        campaigns.append(gyromodel.read_campaign(path))
        rates = [np.rad2deg(campaigns[-1].si(f"output_{axis}").std()) for axis in AXES]
        lines += [f"{label}: turned with rms {' / '.join(f'{r:.1f}' for r in rates)} deg/s about x / y / z.", ""]
        lines += [*table(head, [*by_rates(campaigns[-1:]), by_integrator(label)]), ""]
        with tempfile.TemporaryDirectory() as folder:
            verdicts.append([label, *commanded(path, Path(folder, "results"))])
    lines += [
        f"Both sessions as those of one unit, where leans of {LABELS[1]} do not count beside those of {LABELS[0]}:",
        "",
    ]
    lines += [*table(head, by_rates(campaigns)), ""]
    said = "`gyromodel diagnose` without `--axis`, from bias and scale factor, verdicts with ln B:"
    lines += [said, "", *table(["session", "x", "y", "z", "the axes together", "s"], verdicts)]
    write_result("mounting_real", "Mounting or non-orthogonality, measured", "mounting_real", sys.argv[1:], lines)


if __name__ == "__main__":
    main()
