"""`Uncertain`: a value with the independent sources of its error, kept through all that is computed from it.

Two results that share a source are correlated by it, however many fits lie between: the law of propagation of
uncertainty to first order (GUM, JCGM 100:2008, 5.2), kept source by source.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Self

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float
from scipy.stats import t as student


@dataclass(frozen=True, eq=False)
class Source:
    """One origin of error: a fit's own data, a stated standard; the same object wherever the same errors enter."""

    name: str
    degrees_of_freedom: float = np.inf


@dataclass(frozen=True, eq=False)
class Uncertain:
    """A value, any tree of arrays, and what independent unit errors of each source would change in it.

    Args:
        vector: the uncertain entries of the value, flattened.
        build: makes the value from the vector.
        sources: for each source a factor, one row an entry and one column an independent error of unit variance.
    """

    vector: Float[np.ndarray, " entry"]
    build: Callable[[Any], Any] = field(repr=False)
    sources: Mapping[Source, Float[np.ndarray, "entry error"]] = field(repr=False)

    @classmethod
    def stated(cls, value: Any, covariance: Any, name: str, degrees_of_freedom: float = np.inf) -> Self:
        """A value whose covariance is known.

        Args:
            value: a tree of arrays.
            covariance: of its entries, flattened in the order of the tree; a vector or a number holds variances.
            name: what the source is called in budgets.
            degrees_of_freedom: behind the covariance; infinite if it is known exactly.

        Raises:
            ValueError: the covariance has another size than the value, or is none.
        """
        vector, build = ravel_pytree(jax.tree.map(lambda leaf: jnp.asarray(leaf, float), value))
        size, covariance = len(vector), np.asarray(covariance, float)
        if covariance.shape not in {(), (size,), (size, size)}:
            raise ValueError(f"{name}: a covariance of shape {covariance.shape} does not fit a value of {size} entries")
        matrix = covariance if covariance.ndim == 2 else np.diag(np.broadcast_to(covariance, size))
        largest = np.sqrt(np.abs(np.outer(np.diag(matrix), np.diag(matrix))))
        usable = np.isfinite(matrix).all() and (np.diag(matrix) >= 0).all() and not matrix[largest == 0].any()
        if not usable or (np.abs(matrix - matrix.T) > 1e-9 * largest).any():
            raise ValueError(
                f"{name}: a covariance is finite and symmetric, and nothing varies with what does not vary"
            )
        return cls(np.asarray(vector), build, {Source(name, degrees_of_freedom): factor_of(matrix)})

    @property
    def value(self) -> Any:
        """The value itself."""
        return self.build(jnp.asarray(self.vector))

    @property
    def covariance(self) -> Float[np.ndarray, "entry entry"]:
        """Covariance of the flattened entries, all sources together."""
        size = len(self.vector)
        return sum((a @ a.T for a in self.sources.values()), np.zeros((size, size)))

    @property
    def std(self) -> Float[np.ndarray, " entry"]:
        """Standard uncertainty of each flattened entry."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def degrees_of_freedom(self) -> Float[np.ndarray, " entry"]:
        """Effective degrees of freedom of each standard uncertainty (Welch-Satterthwaite; GUM G.4.1)."""
        parts = {source: np.sum(a**2, axis=1) for source, a in self.sources.items()}
        doubt = sum((u**2 / s.degrees_of_freedom for s, u in parts.items()), np.zeros(len(self.vector)))
        return np.divide(np.diag(self.covariance) ** 2, doubt, out=np.full(len(doubt), np.inf), where=doubt > 0)

    def interval(self, level: float = 0.95) -> tuple[Float[np.ndarray, " entry"], Float[np.ndarray, " entry"]]:
        """Lower and upper end of each entry's confidence interval, by Student's t."""
        half = student.ppf(0.5 + level / 2, self.degrees_of_freedom) * self.std
        return self.vector - half, self.vector + half

    def budget(self) -> dict[str, Float[np.ndarray, " entry"]]:
        """The part of each entry's variance that comes from each source; sources of one name count together."""
        total = np.diag(self.covariance)
        parts: dict[str, np.ndarray] = {}
        for source, a in self.sources.items():
            share = np.divide(np.sum(a**2, axis=1), total, out=np.zeros(len(total)), where=total > 0)
            parts[source.name] = parts.get(source.name, 0.0) + share
        return parts

    def propagate(self, function: Callable[[Any], Any]) -> Uncertain:
        """A differentiable function of the value, its errors carried to first order.

        Args:
            function: maps the value to any tree of arrays.
        """
        result, build = ravel_pytree(function(self.value))
        jacobian = np.asarray(jax.jacfwd(lambda v: ravel_pytree(function(self.build(v)))[0])(jnp.asarray(self.vector)))
        return Uncertain(np.asarray(result), build, {s: jacobian @ a for s, a in self.sources.items()})


def together(*parts: Uncertain) -> Uncertain:
    """Several uncertain values as one, a tuple of them, with what their errors have in common."""
    sources: dict[Source, np.ndarray] = {}
    for source in dict.fromkeys(s for p in parts for s in p.sources):
        width = next(p.sources[source].shape[1] for p in parts if source in p.sources)
        rows = [p.sources.get(source, np.zeros((len(p.vector), width))) for p in parts]
        sources[source] = np.concatenate(rows)
    # Equal for equal shapes, so that what is compiled for one value serves the next.
    build = jax.tree_util.Partial(_split, tuple(p.build for p in parts), tuple(len(p.vector) for p in parts))
    return Uncertain(np.concatenate([p.vector for p in parts]), build, sources)


def _split(builds: tuple[Callable[[Any], Any], ...], sizes: tuple[int, ...], vector: Array) -> tuple[Any, ...]:
    ends = np.cumsum(sizes)
    return tuple(build(vector[end - size : end]) for build, size, end in zip(builds, sizes, ends, strict=True))


def factor_of(covariance: Float[np.ndarray, "entry entry"]) -> Float[np.ndarray, "entry error"]:
    """A with A Aᵀ = covariance, singular ones included."""
    size = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    scale = np.where(size > 0, size, 1.0)
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    if len(values) and values[0] < -1e-8 * max(float(values[-1]), 1.0):
        raise ValueError(f"a covariance has no negative eigenvalues, but this one has {values[0]:.3g} (scaled)")
    return scale[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))
