"""How three sensing axes lie: turned as a whole, which is the mounting, or not at right angles, which is the unit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.stats import chi2

from gyromodel.attitude import with_reference_rates
from gyromodel.campaign import AXES, Campaign
from gyromodel.effects.geometry import Misalignment
from gyromodel.estimate import Estimate, EstimateError, fit
from gyromodel.model import ModelError
from gyromodel.units import factor

# A rotation or a deviation from right angles is one beyond this chance.
SIGNIFICANT = 1e-3
# Part of the fastest rotation (rms) below which that about another direction is hardly one: what a reference errs by
# goes with the fastest, moves with it as no noise does, and is then as large as what leans are told by.
HARDLY = 0.1
# Pairs of axes as deviations from right angles are listed: xy, yz, zx.
PAIRS = ((0, 1), (1, 2), (2, 0))


@dataclass(frozen=True)
class Triad:
    """A unit's three sensing axes against those of its reference rates (rad).

    Attributes:
        rotation: by which the three axes are turned together about x, y and z: what another mounting takes away.
        squareness: by how much less than a right angle x and y, y and z, z and x enclose: what no mounting changes.
        not_told: why the covariances are not to be believed; empty where they are.
        left_out: how many campaigns do not count, as their unit hardly turned about some direction.
    """

    rotation: Float[np.ndarray, " axis"]
    rotation_covariance: Float[np.ndarray, "axis axis"]
    squareness: Float[np.ndarray, " axis"]
    squareness_covariance: Float[np.ndarray, "axis axis"]
    not_told: str = ""
    left_out: int = 0

    @property
    def turned(self) -> bool:
        """Whether the axes are turned together, beyond what noise makes."""
        return not self.not_told and _stands_out(self.rotation, self.rotation_covariance)

    @property
    def oblique(self) -> bool:
        """Whether they are not at right angles, beyond what noise makes."""
        return not self.not_told and _stands_out(self.squareness, self.squareness_covariance)

    def sentence(self) -> str:
        """What the axes say together."""
        few = "a campaign" if self.left_out == 1 else f"{self.left_out} campaigns"
        return self._told() + (f" Without {few} that hardly turned about some direction." if self.left_out else "")

    def _told(self) -> str:
        if self.not_told:
            return f"How the axes lie together is not told: {self.not_told}."
        turned = f"turned as a whole by {_listed(self.rotation, self.rotation_covariance, 'xyz')}"
        oblique = f"short of right angles by {_listed(self.squareness, self.squareness_covariance, ('xy', 'yz', 'zx'))}"
        if self.turned and self.oblique:
            return f"The three axes are {turned}, which is the mounting, and {oblique}, which is the unit."
        if self.turned:
            return f"The three axes are {turned}: the mounting; they are at right angles within the noise."
        if self.oblique:
            return f"The three axes are {oblique}, which no mounting changes; they are not turned as a whole."
        return "The three axes lie along those of the reference rates within the noise."

    def to_dict(self) -> dict[str, Any]:
        """Everything as plain data, in arcsec."""
        scale = factor("rad", "arcsec")

        def part(values: np.ndarray, covariance: np.ndarray, names: Sequence[str], found: bool) -> dict[str, Any]:
            std = np.sqrt(np.diag(covariance))
            each = {n: {"value": v * scale, "std": s * scale} for n, v, s in zip(names, values, std, strict=True)}
            return {"significant": found, "unit": "arcsec", **each}

        return {
            "not_told": self.not_told or None,
            "campaigns_left_out": self.left_out,
            "rotation": part(self.rotation, self.rotation_covariance, "xyz", self.turned),
            "squareness": part(self.squareness, self.squareness_covariance, ("xy", "yz", "zx"), self.oblique),
        }


def triad(campaigns: Sequence[Campaign], extended: Mapping[str, Estimate]) -> Triad | None:
    """The lie of three axes, each fitted with leans towards both others beside what it lacked; None if one is unknown.

    Args:
        campaigns: three-axis campaigns of one unit, with reference rates about all axes.
        extended: the extended fit of each axis, by its letter.
    """
    rated = [with_reference_rates(c)[0] for c in campaigns]
    if any(set(AXES) - set(extended) or not {f"rate_{a}" for a in AXES} <= set(c.columns) for c in rated):
        return None
    # Beside campaigns that turn about every axis, one that does not would add its reference's errors as leans.
    used = [k for k, c in enumerate(rated) if not _hardly_turned([c])] or list(range(len(rated)))
    lean, covariance = np.zeros((3, 3)), np.zeros((9, 9))
    for i, axis in enumerate(AXES):
        others = [j for j in range(3) if j != i]
        about = tuple(f"rate_{AXES[j]}" for j in others)
        model = extended[axis].model_as_given()
        if "misalignment" in model.labels:
            model = model.without("misalignment")
        try:
            fitted = fit([campaigns[k].axis(axis) for k in used], model.with_effect(Misalignment(about=about)))
        except (EstimateError, ModelError):
            return None
        angles = fitted.propagate(lambda m: m.effects[m.labels.index("misalignment")].linear())
        lean[i, others] = angles.value
        where = [3 * i + j for j in others]
        covariance[np.ix_(where, where)] = angles.covariance
    turn, square = np.zeros((3, 9)), np.zeros((3, 9))
    for k, (i, j) in enumerate(PAIRS):
        # Sensed is (1 − [φ×]) ω: of axis i towards the next one, φ about the third.
        turn[3 - i - j, [3 * i + j, 3 * j + i]] = 0.5, -0.5
        square[k, [3 * i + j, 3 * j + i]] = 1.0
    flat = lean.ravel()
    return Triad(
        turn @ flat,
        turn @ covariance @ turn.T,
        square @ flat,
        square @ covariance @ square.T,
        _hardly_turned([rated[k] for k in used]),
        len(rated) - len(used),
    )


def _hardly_turned(rated: Sequence[Campaign]) -> str:
    """Which direction the unit hardly turned about, beside another; empty where there is none."""
    rates = np.stack([np.concatenate([c.si(f"rate_{a}") for c in rated]) for a in AXES])
    rates = rates[:, np.isfinite(rates).all(axis=0)]
    # Of the principal directions, which no mounting moves.
    square, directions = np.linalg.eigh(rates @ rates.T / max(rates.shape[1], 1))
    size = np.sqrt(np.maximum(square, 0.0)) * factor("rad/s", "deg/s")
    if size[0] > HARDLY * size[-1]:
        return ""
    least, most = (AXES[int(np.abs(directions[:, k]).argmax())] for k in (0, -1))
    return (
        f"the rotation about a direction near {least} ({size[0]:.2g} deg/s rms) is a tenth or less of that about one "
        f"near {most} ({size[-1]:.2g} deg/s), so that errors of the reference pass for leans; turn the unit about all "
        "three axes"
    )


def _stands_out(values: np.ndarray, covariance: np.ndarray) -> bool:
    return bool(chi2.sf(values @ np.linalg.solve(covariance, values), 3) < SIGNIFICANT)


def _listed(values: np.ndarray, covariance: np.ndarray, names: Sequence[str]) -> str:
    scale, std = factor("rad", "arcsec"), np.sqrt(np.diag(covariance))
    # To the second digit of the least certain.
    digits = max(0, 1 - int(np.floor(np.log10(max(std.max() * scale, 1e-9)))))
    each = [
        f"{v * scale:z.{digits}f} ± {s * scale:.{digits}f} ({n})" for n, v, s in zip(names, values, std, strict=True)
    ]
    return f"{', '.join(each)} arcsec"
