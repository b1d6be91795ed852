"""The normal equations of one campaign inside a compiled program, gathered block by block.

Rows are parameters and run along the samples, so that they are whole vectors for the processor; a block of them stays
in cache, the Jacobian as a whole is never stored, and what is padded behind the last sample costs nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import block_diag
from jaxtyping import Array, Bool, Float

from gyromodel.effects import Effect, Signals
from gyromodel.model import LATER, GyroModel
from gyromodel.numerics.state_space import Filter, at_rest, whiten_on

BLOCK = 512
# Of one effect: a row for each linear coefficient, and one for each nonlinear parameter; None where there is none free.
Rows = tuple[Float[Array, "*block coefficient sample"], Float[Array, "*block shape sample"] | None]


class Blocks(NamedTuple):
    """A campaign's samples in blocks, among those of others.

    Of signals and `weight` the axes are campaign, block and sample. `weight` is one over the white noise relative to
    its unit, zero where there is no sample; `used` counts the blocks of this campaign that hold samples; with `filter`,
    its own, the noise is coloured.
    """

    signals: Mapping[str, Any]
    weight: Any
    campaign: Any
    used: Any
    filter: Filter | None

    def part(self, block: Any) -> tuple[dict[str, Any], Any]:
        """Signals and weight of one block."""
        return {name: v[self.campaign, block] for name, v in self.signals.items()}, self.weight[self.campaign, block]

    def thinnable(self, model: GyroModel) -> bool:
        """Whether samples may be left out."""
        return self.filter is None and self.weight.shape[1] >= 4 and not any(e.remembers for e in model.effects)

    def thinned(self) -> Blocks:
        """One block, of one sample out of as many as there are blocks, by chance, as regular ones may fit a period."""
        every = self.weight.shape[1]
        chosen = every * np.arange(BLOCK) + np.random.default_rng(0).integers(every, size=BLOCK)
        places = self.campaign, *np.divmod(chosen, BLOCK)
        signals, weight = jax.tree.map(lambda values: values[places][None, None], (self.signals, self.weight))
        return Blocks(signals, weight, 0, jnp.minimum(self.used, 1), None)


Vector = Float[Array, " parameter"]


def gram_of(model: GyroModel, data: Blocks) -> Callable[[Vector], Float[Array, "column column"]]:
    """[J, r]ᵀ[J, r] of the whitened residual r as a function of the free parameters, one more row and column behind it.

    In these the sum of squares of r's successive differences within blocks stands by itself. Rows that no nonlinear
    parameter shapes are computed once.
    """
    free = _free(model)

    def rows_of(effect: Effect, names: tuple[str, ...]) -> Rows:
        """Zero where there is no sample, and what is read there may not be a number."""
        if effect.remembers:  # it looks at neighbouring samples, and must see all of them
            whole = {name: values[data.campaign].ravel() for name, values in data.signals.items()}
            rows = jax.tree.map(_in_blocks, _rows(effect, whole, names))
            return jax.tree.map(lambda values: jnp.where(data.weight[data.campaign][:, None] > 0, values, 0.0), rows)
        return _over_blocks(lambda part: _rows(effect, part, names), data)

    steady = {
        i: rows_of(effect, ())
        for i, effect in enumerate(model.effects)
        if effect.site not in LATER and not _shaped(effect, free.get(i, ()))
    }

    def gram(x: Vector) -> Float[Array, "column column"]:
        now = model.with_vector(x)
        others = {i: e for i, e in enumerate(now.effects) if e.site not in LATER and i not in steady}
        known = steady | {i: rows_of(e, free[i]) for i, e in others.items() if e.remembers}

        def add(block, carry):
            state, total, rough = carry
            signals, weight = data.part(block)
            rows, filter = jax.tree.map(lambda values: values[block], (known, data.filter))

            def shaped():
                found = {i: _rows(e, signals, free[i]) for i, e in others.items() if not e.remembers}
                return jax.tree.map(lambda values: jnp.where(weight > 0, values, 0.0), found)

            # Under a condition that always holds: the compiler would compute an exponential again for each row with it.
            nothing = jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), jax.eval_shape(shaped))
            rows = rows | jax.lax.cond(block < data.used, shaped, lambda: nothing)
            stacked = _stacked(now, signals, rows, free, weight if filter is None else jnp.sign(weight))
            if filter is not None:
                state, white = whiten_on(state, filter, stacked.T)
                stacked = white.T
            rough += jnp.sum(jnp.where(in_turn(weight), jnp.diff(stacked[-1]), 0.0) ** 2)
            return state, total + stacked @ stacked.T, rough

        width = x.shape[0] + 1
        state = jnp.zeros(0)
        if data.filter is not None:
            state = at_rest(jax.tree.map(lambda values: values[0], data.filter), width)
        _, total, rough = jax.lax.fori_loop(0, data.used, add, (state, jnp.zeros((width, width)), jnp.zeros(())))
        return block_diag(total, rough)

    return gram


def in_turn(weight: Float[Array, "*block sample"]) -> Bool[Array, "*block pair"]:
    """Which samples and those after them in their block are both there."""
    return (weight[..., 1:] > 0) & (weight[..., :-1] > 0)


def _over_blocks(rows: Callable[[Signals], Rows], data: Blocks) -> Rows:
    """Rows of every block that holds samples, zeros elsewhere."""
    shapes = jax.eval_shape(lambda: rows(data.part(0)[0]))
    blocks = data.weight.shape[1]

    def put(block, found):
        signals, weight = data.part(block)
        return jax.tree.map(lambda all, one: all.at[block].set(jnp.where(weight > 0, one, 0.0)), found, rows(signals))

    return jax.lax.fori_loop(0, data.used, put, jax.tree.map(lambda s: jnp.zeros((blocks, *s.shape), s.dtype), shapes))


def _in_blocks(rows: Float[Array, "row sample"]) -> Float[Array, "block row part"]:
    """Rows cut into blocks."""
    return rows.reshape(len(rows), -1, BLOCK).swapaxes(0, 1)


def _free(model: GyroModel) -> dict[int, tuple[str, ...]]:
    """Free fields by the place of their effect."""
    fields: dict[int, tuple[str, ...]] = {}
    for slot in model.slots():
        names = fields.get(slot.effect, ())
        fields[slot.effect] = names if slot.field in names else (*names, slot.field)
    return fields


def _shaped(effect: Effect, free: tuple[str, ...]) -> bool:
    return any(not effect.declared()[name].linear for name in free)


def _rows(effect: Effect, signals: Signals, free: tuple[str, ...]) -> Rows:
    """What is fixed of the shapes is left out before rows are made of them: its derivatives are not computed then."""
    if not _shaped(effect, free):
        return effect.columns(signals).T, None
    places, start = [], 0
    for name in (k for k, declared in effect.declared().items() if not declared.linear):
        size = np.size(getattr(effect, name))
        places += range(start, start + size) if name in free else ()
        start += size
    derivatives = effect.shape_derivatives(signals)
    return effect.columns(signals).T, jnp.stack([derivatives[:, k] for k in places])


def _stacked(
    model: GyroModel,
    signals: Signals,
    known: Mapping[int, Rows],
    free: Mapping[int, tuple[str, ...]],
    weight: Float[Array, " sample"],
) -> Float[Array, "row sample"]:
    """The derivative of the output by each free parameter, and last predicted minus measured output, weighted.

    The weight goes into what each row is multiplied by anyway; where it is zero, so is what rows have not set to zero.
    """
    rate = signals.get("rate", jnp.zeros_like(signals["time"]))
    scale = jnp.ones_like(rate)
    for i, effect in enumerate(model.effects):
        if effect.site in LATER:
            continue
        term = effect.linear() @ known[i][0]
        rate, scale = (rate + term, scale) if effect.site == "rate" else (rate, scale + term)
    by = {"rate": scale, "scale": rate}
    told = rate * scale
    ends = {i: e for i, e in enumerate(model.effects) if e.site == "output"}
    if ends:
        by = {site: v * model.passed(told, signals) for site, v in by.items()} | {"output": jnp.ones_like(told)}
        known = {**known, **{i: _rows(e, {**signals, "rate": told}, free.get(i, ())) for i, e in ends.items()}}
        told = model.told(told, signals)
    by = {site: jnp.where(weight > 0, weight * model.gain() * v, 0.0) for site, v in by.items()}
    prediction = jnp.where(weight > 0, weight * model.gain() * told, 0.0)
    stacked = []
    for i, names in free.items():
        effect = model.effects[i]
        if effect.site == "gain":
            stacked.append((prediction / effect.value)[None])  # type: ignore[attr-defined]
            continue
        for name in names:
            linear = effect.declared()[name].linear
            alike = [k for k, d in effect.declared().items() if d.linear == linear and (linear or k in names)]
            start = sum(np.size(getattr(effect, k)) for k in alike[: alike.index(name)])
            part = known[i][0 if linear else 1]
            stacked.append(by[effect.site] * part[start : start + np.size(getattr(effect, name))])  # type: ignore[index]
    measured = jnp.where(weight > 0, weight * signals["output"], 0.0)
    return jnp.concatenate([*stacked, (prediction - measured)[None]])
