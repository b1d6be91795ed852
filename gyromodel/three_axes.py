"""How three sensing axes lie: turned as a whole, which is the mounting, or not at right angles, which is the unit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.stats import chi2

from gyromodel.attitude import with_reference_rates
from gyromodel.campaign import AXES, Campaign
from gyromodel.effects.geometry import Misalignment
from gyromodel.estimate import Estimate, fit
from gyromodel.model import GyroModel
from gyromodel.numerics.rotations import from_matrix, logarithm
from gyromodel.numerics.uncertain import Uncertain
from gyromodel.units import factor

# A rotation or a deviation from right angles is one beyond this chance.
SIGNIFICANT = 1e-3
# Part of the fastest rotation (rms) below which that about another direction is hardly one: what a reference errs by
# goes with the fastest, moves with it as no noise does, and is then as large as what leans are told by.
HARDLY = 0.1
UNLIKE = (
    "no campaign turns about all three directions by itself, and what differs between campaigns, as a mounting or the "
    "reference does, passes for leans; turn the unit about all three axes in one campaign"
)
DIFFER = (
    "the axes lie otherwise against the reference in one campaign than in another, as where one of the two was mounted "
    "anew; diagnose campaigns of one mounting together"
)
# Pairs of axes as deviations from right angles are listed: xy, yz, zx.
PAIRS = ((0, 1), (1, 2), (2, 0))
# Newton's steps to the nearest orthogonal matrix, each of which squares the error: axes 20° askew take four.
STEPS = 12
# Of variances, the part of the greatest that is rounding.
ROUNDING = 1e-12


@dataclass(frozen=True)
class Triad:
    """A unit's three sensing axes against those of its reference rates (rad).

    Attributes:
        rotation: vector of the rotation that turns the axes of the reference into those at right angles which lie
            nearest to the three: what another mounting takes away.
        squareness: by how much less than a right angle x and y, y and z, z and x enclose: what no mounting changes.
        not_told: why the covariances are not to be believed; empty where they are.
        left_out: how many campaigns have leans of their own, as their unit hardly turned about some direction.
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
        return self._told() + (
            f" Leans of {few} that hardly turned about some direction do not count." if self.left_out else ""
        )

    def _told(self) -> str:
        if self.not_told:
            return f"How the axes lie together is not told: {self.not_told}."
        turned = f"turned as a whole by {_listed(self.rotation, self.rotation_covariance, 'xyz')}"
        oblique = f"short of right angles by {_listed(self.squareness, self.squareness_covariance, ('xy', 'yz', 'zx'))}"
        if self.turned and self.oblique:
            return f"The three axes are {turned}, which is the mounting, and {oblique}, which is the unit."
        if self.turned:
            within = _within_noise(self.squareness_covariance)
            return f"The three axes are {turned}: the mounting; they are at right angles {within}."
        if self.oblique:
            within = _within_noise(self.rotation_covariance)
            return f"The three axes are {oblique}, which no mounting changes; as a whole they are not turned {within}."
        within = _within_noise(self.rotation_covariance, self.squareness_covariance)
        return f"The three axes lie along those of the reference rates {within}."

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

    Raises:
        EstimateError, ModelError: an axis cannot be fitted with leans.
    """
    rated = [with_reference_rates(c)[0] for c in campaigns]
    if any(set(AXES) - set(extended) or not {f"rate_{a}" for a in AXES} <= set(c.columns) for c in rated):
        return None
    # Beside campaigns that turn about every axis, one that does not would add its reference's errors as leans.
    reasons = [_hardly_turned(c) for c in rated]
    still = [k for k, reason in enumerate(reasons) if reason]
    not_told = reasons[0] if len(rated) == 1 else UNLIKE if len(still) == len(rated) else ""
    full = [k for k in range(len(rated)) if k not in still]
    lean, covariance = np.zeros((3, 3)), np.zeros((9, 9))
    misfit, freedom = 0.0, 0
    for i, axis in enumerate(AXES):
        others = [j for j in range(3) if j != i]
        about = tuple(f"rate_{AXES[j]}" for j in others)
        model = extended[axis].model_as_given()
        if "misalignment" in model.labels:
            model = model.without("misalignment")
        measured, own = list(campaigns), ()
        if not not_told:
            # Mounted otherwise, what it senses about the axis itself is another part as well.
            every = tuple(f"rate_{a}" for a in AXES)
            measured, own = _with_own_leans(campaigns, rated, every, still)
        angles = _leans(measured, axis, model, (*about, *own))
        if full[1:]:
            apart, more = _with_own_leans(measured, rated, about, full[1:])
            each = _leans(apart, axis, model, (*more, *about, *own), len(more))
            # What is known far better than the rest is known no better than rounding lets it be.
            variance, along = np.linalg.eigh(each.covariance)
            misfit += float(np.sum((along.T @ each.value) ** 2 / np.maximum(variance, ROUNDING * variance[-1])))
            freedom += len(more)
        lean[i, others] = angles.value
        where = [3 * i + j for j in others]
        covariance[np.ix_(where, where)] = angles.covariance
    if freedom and chi2.sf(misfit, freedom) < SIGNIFICANT:
        not_told = DIFFER
    rotation, squareness = np.asarray(_together(jnp.asarray(lean)))
    by_lean = np.asarray(jax.jacfwd(_together)(jnp.asarray(lean))).reshape(2, 3, 9)
    covariances = by_lean @ covariance @ by_lean.transpose(0, 2, 1)
    return Triad(rotation, covariances[0], squareness, covariances[1], not_told, left_out=0 if not_told else len(still))


def _together(lean: Float[Array, "axis axis"]) -> Float[Array, "part axis"]:
    """Rotation and squareness of three axes by the lean of each (rows) towards the others."""
    # A lean is a part of what is sensed about the axis itself: the gain is of both.
    axes = jnp.eye(3) + lean
    axes = axes / jnp.linalg.norm(axes, axis=1, keepdims=True)
    nearest = axes
    for _ in range(STEPS):
        nearest = 0.5 * (nearest + jnp.linalg.inv(nearest).T)
    # Square axes sense exp(−[φ×]) ω.
    short = [jnp.arcsin(axes[i] @ axes[j]) for i, j in PAIRS]
    return jnp.stack([logarithm(from_matrix(nearest.T)), jnp.stack(short)])


def _leans(
    campaigns: Sequence[Campaign], axis: str, model: GyroModel, about: tuple[str, ...], count: int = 2
) -> Uncertain:
    """The first few leans of an axis in a fit with leans about some columns."""
    fitted = fit([c.axis(axis) for c in campaigns], model.with_effect(Misalignment(about=about)))
    return fitted.propagate(lambda m: m.effects[m.labels.index("misalignment")].linear()[:count])


def _with_own_leans(
    campaigns: Sequence[Campaign], rated: Sequence[Campaign], about: Sequence[str], which: Sequence[int]
) -> tuple[list[Campaign], tuple[str, ...]]:
    """Campaigns with columns of the rates of some of them alone, one for each direction; and their names."""
    with_them, names = list(campaigns), []
    for k in which:
        cross = np.column_stack([rated[k].si(name) for name in about])
        known = cross[np.isfinite(cross).all(axis=1)]
        square, directions = np.linalg.eigh(known.T @ known)
        # Rates of an attitude are missing in some of its rows.
        rows = np.isin(campaigns[k].columns["time"], rated[k].columns["time"])
        for m in np.flatnonzero(square > 1e-12 * max(square[-1], 1e-300)):
            taken, name = {n for c in with_them for n in c.columns}, f"lean_{k + 1}_{m + 1}"
            while name in taken:
                name += "_"
            names.append(name)
            its = np.full(len(rows), np.nan)
            its[rows] = cross @ directions[:, m]
            with_them = [
                c.with_column(names[-1], its if i == k else np.zeros(len(c)), "rad/s") for i, c in enumerate(with_them)
            ]
    return with_them, tuple(names)


def _hardly_turned(rated: Campaign) -> str:
    """Which direction the unit hardly turned about, beside another; empty where there is none."""
    rates = np.stack([rated.si(f"rate_{a}") for a in AXES])
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
    digits = _digits(std.max() * scale)
    each = [
        f"{v * scale:z.{digits}f} ± {s * scale:.{digits}f} ({n})" for n, v, s in zip(names, values, std, strict=True)
    ]
    return f"{', '.join(each)} arcsec"


def _within_noise(*covariances: np.ndarray) -> str:
    std = max(np.sqrt(np.diag(covariance).max()) for covariance in covariances)
    unit = "deg" if std >= np.deg2rad(1.0) else "arcsec"
    std *= factor("rad", unit)
    return f"within the noise (standard uncertainties up to {std:.{_digits(std)}f} {unit})"


def _digits(std: float) -> int:
    """Decimals up to the second digit of the largest standard uncertainty."""
    return max(0, 1 - int(np.floor(np.log10(max(std, 1e-9)))))
