"""Errors of a platform's gimbals, axes and encoders, in the angle of its base that they give.

Signals of an underscore are as in `platform`: what the base's angle about the axis of a row changes by with each.
"""

from __future__ import annotations

from typing import Self

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from gyromodel.effects._base import Effect, Signals, parameter, stack
from gyromodel.effects.platform import OfPlatform

# Gimbals whose encoders are read, and the orders of errors that are searched.
ENCODERS = ("gimbal_y_outer", "gimbal_x", "gimbal_y", "gimbal_z")
ORDERS = (1, 2, 3, 4)
# What each gimbal's axis may have besides its direction: of the other two of x, y, z.
TILTS = tuple(
    f"{gimbal}/{axis}" for gimbal, axes in zip(ENCODERS, ("xz", "yz", "xz", "xy"), strict=True) for axis in axes
)
# Columns that keep less than this part of their length beside others cannot be seen beside them.
SEEN = 0.02


def _independent(columns: dict[str, np.ndarray]) -> tuple[str, ...]:
    """Names of columns of which none is (nearly) a sum of others, the longest first."""
    left, chosen = {name: np.asarray(c, float) for name, c in columns.items()}, []
    length = {name: float(np.linalg.norm(c)) for name, c in left.items()}
    most = max(length.values(), default=0.0)
    while left:
        norms = {name: float(np.linalg.norm(c)) for name, c in left.items()}
        name = max(norms, key=lambda n: norms[n])
        if norms[name] <= SEEN * most:
            break
        axis = left.pop(name) / norms[name]
        left = {n: c - axis * (axis @ c) for n, c in left.items()}
        left = {n: c for n, c in left.items() if np.linalg.norm(c) > SEEN * length[n]}
        chosen.append(name)
    return tuple(n for n in columns if n in chosen)


class GimbalNonorthogonality(OfPlatform):
    """θ −= Σ ∂θ/∂τ τ: each gimbal's axis is tilted by small angles τ towards the other axes of its frame.

    Named by gimbal and axis; those that a test cannot show beside the others are left out. The angle that a tilt adds
    to the mean of a run is part of the alignment, which is not known.
    """

    id = "gimbal_nonorthogonality"
    needs = ("table_<axis>", "gimbal_<axis>")
    cause = "Gimbal axes are not at right angles, or the base is turned on the table."
    test = "Turn the base on the table by 90° and repeat: tilts of the gimbals turn with it, those of the table stay."
    untested = "no motion is large enough to show a tilt"

    supersedes = ("gimbal_nonorthogonality",)
    tilt: Float[Array, " tilt"] = parameter("arcsec", 20.0, "of each of `tilts`", default=())
    tilts: tuple[str, ...] = eqx.field(static=True, default=())

    def __check_init__(self) -> None:
        if unknown := set(self.tilts) - set(TILTS):
            raise ValueError(f"{min(unknown)} is no tilt: these are {', '.join(TILTS)}")
        if np.shape(self.tilt) != (len(self.tilts),):
            raise ValueError("tilt takes one angle for each of the tilts")

    def joined(self, held: Effect) -> Self:
        """The tilts of both."""
        tilts = tuple(n for n in TILTS if n in (*self.tilts, *held.tilts))  # type: ignore[attr-defined]
        return type(self)(jnp.zeros(len(tilts)), tilts)

    def columns(self, signals: Signals) -> Float[Array, "sample coefficient"]:
        """−∂θ/∂τ of each."""
        return stack(*(signals[f"_{name}"] for name in self.tilts))

    def prepared(self, signals: Signals) -> Self:
        """Every tilt that shows, unless they are set."""
        if self.tilts:
            return self
        tilts = _independent({name: np.asarray(signals[f"_{name}"]) for name in TILTS})
        return type(self)(jnp.zeros(len(tilts)), tilts)

    @classmethod
    def candidates(cls, signals: Signals) -> list[Self]:
        """All that show, together and one by one."""
        whole = cls().prepared(signals)
        each = [cls(jnp.zeros(1), (name,)) for name in whole.tilts]
        return [whole, *each] if len(each) > 1 else each


class EncoderHarmonic(OfPlatform):
    """θ += Σ ∂θ/∂β (c_k cos kβ + s_k sin kβ): encoders of gimbals read too much, by the angle that they read.

    Named by gimbal and order k; those that a test cannot show beside the others are left out.
    """

    id = "encoder_harmonic"
    needs = ("table_<axis>", "gimbal_<axis>")
    cause = "The disc of an encoder is off centre, or its two signals are unlike."
    test = "Oscillate by tens of degrees about other mean angles: the error keeps to the angle of the gimbal."
    untested = "no gimbal turns far enough"

    supersedes = ("encoder_harmonic",)
    cosine: Float[Array, " term"] = parameter("arcsec", 10.0, "c_k of each of `terms`", default=())
    sine: Float[Array, " term"] = parameter("arcsec", 10.0, "s_k of each of `terms`", default=())
    terms: tuple[str, ...] = eqx.field(static=True, default=())

    def __check_init__(self) -> None:
        known = [f"{gimbal}/{k}" for gimbal in ENCODERS for k in ORDERS]
        if unknown := set(self.terms) - set(known):
            raise ValueError(f"{min(unknown)} is no term: these are {', '.join(known)}")
        if not np.shape(self.cosine) == np.shape(self.sine) == (len(self.terms),):
            raise ValueError("cosine and sine take one angle for each of the terms")

    def joined(self, held: Effect) -> Self:
        """The terms of both."""
        terms = tuple(dict.fromkeys((*held.terms, *self.terms)))  # type: ignore[attr-defined]
        return type(self)(jnp.zeros(len(terms)), jnp.zeros(len(terms)), terms)

    def columns(self, signals: Signals) -> Float[Array, "sample coefficient"]:
        """∂θ/∂β cos kβ of each term, then ∂θ/∂β sin kβ."""
        return stack(*(signals[f"_{term}_{part}"] for part in ("cosine", "sine") for term in self.terms))

    def prepared(self, signals: Signals) -> Self:
        """The first orders of every gimbal that turns far enough, unless they are set."""
        if self.terms:
            return self
        forms = type(self)._shown(signals)
        most = max(forms, key=len, default=())
        return type(self)(jnp.zeros(len(most)), jnp.zeros(len(most)), most)

    @classmethod
    def _shown(cls, signals: Signals) -> list[tuple[str, ...]]:
        """Sets of terms that show: each order of each gimbal, the first two, and those of all gimbals together."""
        found: list[tuple[str, ...]] = []
        pairs: list[str] = []
        for gimbal in ENCODERS:
            orders = [(f"{gimbal}/{k}",) for k in ORDERS if _shows(signals, (f"{gimbal}/{k}",))]
            found += orders
            both = (f"{gimbal}/1", f"{gimbal}/2")
            if _shows(signals, both):
                found.append(both)
                pairs += both
        return [*found, tuple(pairs)] if len(pairs) > 2 and _shows(signals, tuple(pairs)) else found

    @classmethod
    def candidates(cls, signals: Signals) -> list[Self]:
        """Terms of one gimbal, and of all."""
        return [cls(jnp.zeros(len(t)), jnp.zeros(len(t)), t) for t in cls._shown(signals)]


def _shows(signals: Signals, terms: tuple[str, ...]) -> bool:
    """Whether cosines and sines of some terms are told apart."""
    names = [f"_{term}_{part}" for part in ("cosine", "sine") for term in terms]
    columns = {name: np.asarray(signals[name]) for name in names}
    return len(_independent(columns)) == len(names)
