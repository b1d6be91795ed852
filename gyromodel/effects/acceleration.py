"""Bias effects of specific force, vibration and two simultaneous rates: mass unbalance, its kin, and anisoinertia.

Source of the model form: IEEE Std 813 and 529 (single-degree-of-freedom rate-integrating gyros), in rate: D_I a_I, …
"""

from __future__ import annotations

import itertools
from typing import Self

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from gyromodel._checks import accelerations
from gyromodel.effects._base import Effect, Signals, parameter, stack

# A sum of squares that varies less than this part of its mean is that of gravity at every orientation: a constant.
TRACE_VARIES = 0.02


class _Acceleration(Effect):
    """A bias proportional to one component of specific force, as an accelerometer reads it: +1 g upwards."""

    coefficient: Float[Array, ""] = parameter("deg/h/g", 1.0, "bias per unit of specific force")

    def columns(self, signals: Signals) -> Float[Array, "sample coefficient"]:
        """The specific force."""
        return stack(signals[self.needs[0]])


class BiasAccelerationInput(_Acceleration):
    """D += D_I a_I: bias proportional to specific force along the input axis."""

    id = "bias_acceleration_input"
    site = "rate"
    needs = ("acceleration_input",)
    cause = "A mass unbalance along the spin axis turns the float, or the force strains coil, path or resonator."
    test = "Add positions at other azimuths: an axis misaligned to the Earth's rate follows north too, this does not."


class BiasAccelerationSpin(_Acceleration):
    """D += D_S a_S: bias proportional to specific force along the spin axis."""

    id = "bias_acceleration_spin"
    site = "rate"
    needs = ("acceleration_spin",)
    cause = "A mass unbalance along the input axis turns the float, or the force strains coil, path or resonator."
    test = "Add positions at other azimuths: an axis misaligned to the Earth's rate follows north too, this does not."


class BiasAccelerationOutput(_Acceleration):
    """D += D_O a_O: bias proportional to specific force along the output axis."""

    id = "bias_acceleration_output"
    site = "rate"
    needs = ("acceleration_output",)
    cause = "Flex leads, pivots or the path of light yield under a force along the output axis."
    test = "Add positions at other azimuths: an axis misaligned to the Earth's rate follows north too, this does not."


class BiasAccelerationSquared(Effect):
    """D += Σ D_ij a_i a_j: bias proportional to products of specific forces.

    At rest a_I² + a_S² + a_O² is 1 g² at every orientation, the same as a bias: one square is then left out, and the
    others are relative to it. `products` names the columns, as acceleration_input*acceleration_spin; if empty, they are
    all that the campaign has.
    """

    id = "bias_acceleration_squared"
    site = "rate"
    needs = ("acceleration_<axis>",)
    cause = "Unequal compliance: a force displaces the suspended mass, and acts on it at the displaced place."
    test = "A centrifuge or vibration: beyond 1 g the squares grow faster than a mass unbalance, and part from a bias."
    untested = "no product of two specific forces varies"

    coefficients: Float[Array, " product"] = parameter("deg/h/g^2", 0.1, "bias per unit of each product", default=())
    products: tuple[str, ...] = eqx.field(static=True, default=("",))

    def __post_init__(self) -> None:
        if np.size(self.coefficients) == 0:
            self.coefficients = jnp.zeros(len(self.products))

    def __check_init__(self) -> None:
        if self.coefficients.shape != (len(self.products),):
            raise ValueError(f"{len(self.products)} products need as many coefficients")
        if any(self.products) and any(len(p.split("*")) != 2 for p in self.products):
            raise ValueError("a product names two columns, as acceleration_input*acceleration_spin")

    @property
    def columns_needed(self) -> tuple[str, ...]:
        """The factors."""
        named = dict.fromkeys(name for p in self.products for name in p.split("*"))
        return tuple(named) if any(self.products) else self.needs

    def columns(self, signals: Signals) -> Float[Array, "sample coefficient"]:
        """The products."""
        return stack(*(signals[a] * signals[b] for a, b in (p.split("*") for p in self.products)))

    def prepared(self, signals: Signals) -> Self:
        """Take all products that vary, less one square where their sum does not."""
        return self if any(self.products) else type(self)(products=_all_products(signals) or _products(signals)[:1])

    @classmethod
    def hidden(cls, signals: Signals) -> str:
        """The sum of the squares at rest."""
        at_rest = _trace_is_constant(signals)
        return "equal parts of all squares are a bias at 1 g: needs a centrifuge or vibration" if at_rest else ""

    @classmethod
    def candidates(cls, signals: Signals) -> list[Self]:
        """Every product that varies, every two of them, and all."""
        each = [p for p in _products(signals) if _varies(signals, p)]
        sets = {(p,): None for p in each} | dict.fromkeys(itertools.combinations(each, 2))
        whole = _all_products(signals)
        return [cls(products=s) for s in (sets | {whole: None} if whole else sets)]


def _products(signals: Signals) -> tuple[str, ...]:
    names = accelerations(signals)
    return tuple(f"{a}*{b}" for a, b in itertools.combinations_with_replacement(names, 2))


def _varies(signals: Signals, product: str) -> bool:
    a, b = product.split("*")
    return bool(np.ptp(np.asarray(signals[a] * signals[b])) > 0)


def _trace_is_constant(signals: Signals) -> bool:
    trace = np.asarray(sum(signals[n] ** 2 for n in accelerations(signals)))
    return bool(np.std(trace) < TRACE_VARIES * np.mean(trace))


def _all_products(signals: Signals) -> tuple[str, ...]:
    """Products that vary, less the last square where the sum of the squares is a constant."""
    kept = [p for p in _products(signals) if _varies(signals, p)]
    squares = [p for p in kept if len(set(p.split("*"))) == 1]
    if len(squares) > 1 and _trace_is_constant(signals):
        kept.remove(squares[-1])
    return tuple(kept)


class BiasVibration(Effect):
    """D += D_v ⟨a²⟩: bias proportional to the mean square of a vibration."""

    id = "bias_vibration"
    site = "rate"
    needs = ("vibration",)
    cause = "Vibration is rectified: compliance and force oscillate in step, and their product has a mean."
    test = "Two vibration levels at one position: a static force of the same kind does not change with the level."

    coefficient: Float[Array, ""] = parameter("deg/h/g^2", 0.1, "bias per unit of mean square acceleration")

    def columns(self, signals: Signals) -> Float[Array, "sample coefficient"]:
        """The mean square."""
        return stack(signals["vibration"])


class BiasAnisoinertia(Effect):
    """D += c ω_I ω_S: bias proportional to the product of the rates about input and spin axis."""

    id = "bias_anisoinertia"
    site = "rate"
    needs = ("rate", "rate_spin")
    cause = "The float's moments of inertia about input and spin axis differ, which makes a torque of both rates."
    test = "Reverse one of the two rates: this changes sign with either, a misalignment with the cross rate alone."

    coefficient: Float[Array, ""] = parameter("deg/h/(deg/s)^2", 0.01, "bias per unit of each rate")

    def columns(self, signals: Signals) -> Float[Array, "sample coefficient"]:
        """The product of the rates."""
        return stack(signals["rate"] * signals["rate_spin"])
