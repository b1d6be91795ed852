"""Campaigns side by side, and the compiled program that searches the minimum of one after the other."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from gyromodel._compiling import former_fusions
from gyromodel.estimate._blocks import BLOCK, Blocks, gram_and_roughness
from gyromodel.estimate._fit import check_enough, given_ratios
from gyromodel.model import GyroModel, check_units, record_span
from gyromodel.noise import NoiseRatios, markov_sum
from gyromodel.numerics.compiled_least_squares import Search, search_minimum
from gyromodel.numerics.state_space import Sampling, build_filter
from gyromodel.signals import Record

# Campaigns handed to the compiled program in one call.
TOGETHER = 16
# Distance from the minimum, in standard deviations of the parameters, at which a search ends with one more step.
PRECISION = 1e-5


class Waiting(NamedTuple):
    """One that waits to be fitted: where it stands, its data, and its prepared model."""

    place: int
    record: Record
    model: GyroModel
    start: np.ndarray
    ratios: NoiseRatios | None


def ready(place: int, record: Record, model: GyroModel, given: np.ndarray) -> Waiting:
    """The campaign with its prepared model; ModelError or EstimateError where it cannot be fitted."""
    check_units(model, record.output_unit, record.units)
    prepared = model.prepared(record.signals)
    start = given if prepared is model else np.asarray(prepared.vector())
    check_enough(record, len(start))
    ratios = given_ratios(record, prepared)
    coloured = ratios is not None and any(float(r) > 0 for r in ratios[:3])
    return Waiting(place, record, prepared, start, ratios if coloured else None)


def kind_of(campaign: Waiting) -> tuple:
    """What must be alike for one program: blocks (a power of two), model structure, signals, colour of the noise."""
    blocks = 2 ** max(int(np.ceil(np.log2(campaign.record.rows / BLOCK))), 0)
    leaves, structure = jax.tree.flatten(campaign.model)
    shapes = tuple(np.shape(leaf) for leaf in leaves)
    return blocks, structure, shapes, tuple(sorted(campaign.record.signals)), campaign.ratios is None


class _Noise(NamedTuple):
    """Coloured noise of a campaign: ratios, longest time constant (s), and the sampling."""

    ratios: NoiseRatios
    longest: Any
    sampling: Sampling


class SideBySide(NamedTuple):
    """Campaigns side by side, the first axis of every array."""

    models: GyroModel
    blocks: Blocks
    noise: _Noise | None
    interval: Float[np.ndarray, " campaign"]
    freedom: Float[np.ndarray, " campaign"]


def side_by_side(campaigns: list[Waiting], blocks: int) -> SideBySide:
    """Arrays of a fixed size, whatever the number of campaigns: the first stands in for those that lack."""
    campaigns = [*campaigns, *campaigns[:1] * (TOGETHER - len(campaigns))]
    records = [c.record for c in campaigns]

    def padded(each: Iterable[Any]) -> np.ndarray:
        """Each continued by its last value."""
        first, *others = (np.asarray(values) for values in each)
        together = np.empty((TOGETHER, blocks * BLOCK), first.dtype)
        for row, values, record in zip(together, (first, *others), records, strict=True):
            row[: record.rows] = values[: record.rows]
            row[record.rows :] = values[record.rows - 1]
        return together.reshape(TOGETHER, blocks, BLOCK)

    rows = np.arange(blocks * BLOCK).reshape(blocks, BLOCK) < np.array([r.rows for r in records])[:, None, None]
    signals = {name: padded(r.signals[name] for r in records) for name in records[0].signals}
    present = padded(r.sampling.present for r in records) & rows
    weight = present / np.sqrt(padded(r.sampling.white for r in records))
    used = np.array([-(-r.rows // BLOCK) for r in records])
    noise = None
    if campaigns[0].ratios is not None:
        flat = (TOGETHER, blocks * BLOCK)
        interval = padded(r.sampling.interval for r in records).reshape(flat)
        restart = padded(r.sampling.restart for r in records).reshape(flat)
        white = padded(r.sampling.white for r in records).reshape(flat)
        ratios = [c.ratios for c in campaigns if c.ratios is not None]
        longest = [float(r.longest(record_span(record))) for r, record in zip(ratios, records, strict=True)]
        parts: list[Any] = [interval, restart, present.reshape(flat), white]
        noise = _Noise(_stacked(ratios), np.array(longest), Sampling(*parts))
    return SideBySide(
        _stacked([c.model for c in campaigns]),
        Blocks(signals, weight, used, None),
        noise,
        np.array([r.interval for r in records]),
        np.array([float(r.present.sum() - len(c.start)) for r, c in zip(records, campaigns, strict=True)]),
    )


def _stacked(each: Sequence[Any]) -> Any:
    """Trees of arrays as one whose arrays have a first axis more."""
    leaves = [[np.asarray(leaf) for leaf in jax.tree.leaves(tree)] for tree in {id(e): e for e in each}.values()]
    order = list({id(e): None for e in each})
    numbers = [order.index(id(e)) for e in each]
    return jax.tree.unflatten(
        jax.tree.structure(each[0]), [np.stack(leaf)[numbers] for leaf in zip(*leaves, strict=True)]
    )


@partial(jax.jit, compiler_options=former_fusions())
def search(data: SideBySide, campaign, start, most, thin) -> tuple[Search, Float[Array, " task"]]:
    """One search after the other, each of a campaign from a start; and the white variance expected where they end.

    A search may begin on a sample of the rows, with at most `thin` points.
    """

    def one(task):
        campaign, start, most, thin = task
        model, blocks, noise, interval, freedom = jax.tree.map(lambda values: values[campaign], data)
        if noise is not None:
            filter = build_filter(markov_sum(noise.ratios, interval, noise.longest), noise.sampling)
            blocks = blocks._replace(filter=jax.tree.map(lambda v: v.reshape(-1, BLOCK, *v.shape[1:]), filter))
        linear = np.array([slot.linear for slot in model.slots()], bool)
        gram, roughness = gram_and_roughness(model, blocks)
        solved = False
        if len(linear) * 8 <= BLOCK and blocks.thinnable(model):
            coarse, _ = gram_and_roughness(model, blocks.thinned())
            begin = search_minimum(coarse, start, linear, 1.0 / BLOCK, thin)
            start, solved = jnp.where(begin.converged, begin.x, start), begin.converged
        found = search_minimum(gram, start, linear, PRECISION**2 / freedom, most, solved)
        if not model.noise:
            return found, roughness(found.x)
        return found, model.noise["noise_white"] ** 2 / interval * model.with_vector(found.x).gain() ** 2

    return jax.lax.map(one, (campaign, start, most, thin))


def searches(
    data: SideBySide, tasks: Sequence[tuple[int, np.ndarray]], most: int, thin: int = 0
) -> list[tuple[Search, float]]:
    """Searches of campaigns from starts, so many in a call that its arrays have a fixed size."""
    found = []
    for first in range(0, len(tasks), TOGETHER):
        some = tasks[first : first + TOGETHER]
        lack = TOGETHER - len(some)
        campaign = np.array([i for i, _ in some] + [0] * lack)
        start = np.stack([x for _, x in some] + [some[0][1]] * lack)
        points = np.array([[most] * len(some) + [0] * lack, [thin] * len(some) + [0] * lack])
        results = jax.tree.map(np.asarray, search(data, campaign, start, *points))
        found += [jax.tree.map(lambda values, k=k: values[k], results) for k in range(len(some))]
    return found
