"""Campaigns side by side, and the compiled program that searches the minimum of one after the other."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from gyromodel._compiling import former_fusions
from gyromodel._model_units import check_units
from gyromodel._noise_level import with_stated_level
from gyromodel.estimate._blocks import BLOCK, Blocks, gram_of, in_turn
from gyromodel.estimate._fit import check_enough, given_ratios
from gyromodel.model import GyroModel, ModelError
from gyromodel.noise import NoiseRatios, markov_sum
from gyromodel.numerics.compiled_least_squares import Search, search_minimum
from gyromodel.numerics.state_space import Sampling, build_filter
from gyromodel.signals import Record

# Vectors as wide as the processor has them: XLA by itself takes half of that.
OPTIONS = former_fusions() and former_fusions() | {"xla_cpu_prefer_vector_width": 512}
# Campaigns handed to the compiled program in one call.
TOGETHER = 32
# Distance from the minimum, in standard deviations of the parameters, at which a search ends with one more step.
PRECISION = 1e-5
# Rows for each parameter that a block must have for a search to begin on no more.
LEAST_THIN = 8
# Decrease of the cost, as a part of it, at which a search on a sample of the rows ends: a standard deviation there.
THIN_TOLERANCE = 1.0 / BLOCK


class Prepared(NamedTuple):
    """A model, its free parameters, its structure with the shapes of its arrays, and units that are known to suit."""

    model: GyroModel
    start: np.ndarray
    structure: tuple
    suit: set[tuple]


def described(model: GyroModel) -> Prepared:
    """A model beside what is asked of it for each campaign."""
    leaves, structure = jax.tree.flatten(model)
    return Prepared(model, np.asarray(model.vector()), (structure, tuple(np.shape(leaf) for leaf in leaves)), set())


class Waiting(NamedTuple):
    """One that waits to be fitted: where it stands, its data, and its prepared model."""

    place: int
    record: Record
    model: GyroModel
    start: np.ndarray
    structure: tuple
    ratios: NoiseRatios | None


Memory = dict[tuple[str, int, np.dtype], np.ndarray]


def ready(place: int, record: Record, given: Prepared) -> Waiting:
    """The campaign with its prepared model; ModelError or EstimateError where it cannot be fitted."""
    units = record.output_unit, *record.units.items()
    if units not in given.suit:
        check_units(given.model, record.output_unit, record.units)
        given.suit.add(units)
    if given.model.reading is not None:
        raise ModelError("an output that is read in steps is fitted one campaign at a time, by fit")
    model = GyroModel.prepared(given.model, record.signals)
    prepared = given if model is given.model else described(model)
    check_enough(record, len(prepared.start))
    record, ratios = with_stated_level(record, model), given_ratios(record, model)
    coloured = ratios is not None and any(float(r) > 0 for r in (*ratios[:3], *ratios.each()[4:]))
    return Waiting(place, record, model, prepared.start, prepared.structure, ratios if coloured else None)


def kind_of(campaign: Waiting) -> tuple:
    """What must be alike for one program: blocks (a power of two), model structure, signals, colour of the noise."""
    blocks = 2 ** max(int(np.ceil(np.log2(campaign.record.rows / BLOCK))), 0)
    noise = 0 if campaign.ratios is None else len(campaign.ratios.each())
    return blocks, campaign.structure, tuple(sorted(campaign.record.signals)), noise


class _Noise(NamedTuple):
    """Coloured noise of a campaign: ratios, longest time constant (s), and the sampling."""

    ratios: NoiseRatios
    longest: Any
    sampling: Sampling


class SideBySide(NamedTuple):
    """Campaigns side by side, the first axis of every array."""

    models: GyroModel
    signals: Mapping[str, Any]
    weight: Float[np.ndarray, "campaign block sample"]
    used: Int[np.ndarray, " campaign"]
    noise: _Noise | None
    interval: Float[np.ndarray, " campaign"]
    freedom: Float[np.ndarray, " campaign"]


def side_by_side(campaigns: list[Waiting], blocks: int, memory: Memory) -> SideBySide:
    """Arrays of a fixed size, whatever the number of campaigns; the model of the first stands in where some lack.

    Samples lie in `memory`, where those of the campaigns before were; where some lack nothing is written.
    """
    own = [c.record for c in campaigns]
    campaigns = [*campaigns, *campaigns[:1] * (TOGETHER - len(campaigns))]
    records = [c.record for c in campaigns]

    def padded(name: str, each: Iterable[Any], beyond: float | None = None) -> np.ndarray:
        """Each continued by its last value, or by what is given."""
        first, *others = (np.asarray(values) for values in each)
        key = name, blocks, first.dtype
        if key not in memory:
            memory[key] = _aligned((TOGETHER, blocks, BLOCK), first.dtype)
        together = memory[key]
        flat = together.reshape(TOGETHER, -1)
        for row, values, record in zip(flat, (first, *others), own, strict=False):
            row[: record.rows] = values[: record.rows]
            row[record.rows :] = values[record.rows - 1] if beyond is None else beyond
        return together

    signals = {name: padded(name, (r.signals[name] for r in own)) for name in own[0].signals}
    weight = padded("_weight", (r.sampling.present / np.sqrt(r.sampling.white) for r in own), 0.0)
    used = np.array([-(-r.rows // BLOCK) for r in records])
    noise = None
    if campaigns[0].ratios is not None:
        flat = (TOGETHER, blocks * BLOCK)
        interval = padded("_interval", (r.sampling.interval for r in own)).reshape(flat)
        restart = padded("_restart", (r.sampling.restart for r in own)).reshape(flat)
        white = padded("_white", (r.sampling.white for r in own)).reshape(flat)
        present = padded("_present", (r.sampling.present for r in own), 0.0).reshape(flat)
        ratios = [c.ratios for c in campaigns if c.ratios is not None]
        longest = [float(r.longest(record.span)) for r, record in zip(ratios, records, strict=True)]
        parts: list[Any] = [interval, restart, present, white]
        noise = _Noise(_stacked(ratios), np.array(longest), Sampling(*parts))
    return SideBySide(
        _stacked([c.model for c in campaigns]),
        signals,
        weight,
        used,
        noise,
        np.array([r.interval for r in records]),
        np.array([float(r.present.sum() - len(c.start)) for r, c in zip(records, campaigns, strict=True)]),
    )


def _aligned(shape: tuple[int, ...], dtype: np.dtype) -> np.ndarray:
    """Memory that JAX on a processor reads where it is, as it begins at a multiple of 64 bytes."""
    size = int(np.prod(shape)) * dtype.itemsize
    whole = np.empty(size + 64, np.uint8)
    first = -whole.ctypes.data % 64
    return whole[first : first + size].view(dtype).reshape(shape)


def _stacked(each: Sequence[Any]) -> Any:
    """Trees of arrays as one whose arrays have a first axis more."""
    leaves = [[np.asarray(leaf) for leaf in jax.tree.leaves(tree)] for tree in {id(e): e for e in each}.values()]
    order = list({id(e): None for e in each})
    numbers = [order.index(id(e)) for e in each]
    return jax.tree.unflatten(
        jax.tree.structure(each[0]), [np.stack(leaf)[numbers] for leaf in zip(*leaves, strict=True)]
    )


@partial(jax.jit, compiler_options=OPTIONS)
def search(data: SideBySide, campaign, start, most, thin) -> tuple[Search, Float[Array, " task"], Bool[Array, " task"]]:
    """One search after the other, each of a campaign from a start.

    Returns:
        Where they end; the white variance expected there; and whether they began at the minimum of a sample of the
        rows, found in at most `thin` points.
    """

    def one(task):
        campaign, start, most, thin = task
        # The samples are read where they are.
        model, used, noise, interval, freedom = jax.tree.map(
            lambda values: values[campaign], (data.models, data.used, data.noise, data.interval, data.freedom)
        )
        blocks = Blocks(data.signals, data.weight, campaign, used, None)
        if noise is not None:
            filter = build_filter(markov_sum(noise.ratios, interval, noise.longest), noise.sampling)
            blocks = blocks._replace(filter=jax.tree.map(lambda v: v.reshape(-1, BLOCK, *v.shape[1:]), filter))
        linear = np.array([slot.linear for slot in model.slots()], bool)
        gram = gram_of(model, blocks)
        thinned = jnp.asarray(False)
        if not linear.all() and len(linear) * LEAST_THIN <= BLOCK and blocks.thinnable(model):
            begin = search_minimum(gram_of(model, blocks.thinned()), start, linear, THIN_TOLERANCE, thin)
            start, thinned = jnp.where(begin.converged, begin.x, start), begin.converged
        found = search_minimum(gram, start, linear, PRECISION**2 / freedom, most, thinned)
        if model.noise:
            return found, model.noise["noise_white"] ** 2 / interval * model.with_vector(found.x).gain() ** 2, thinned
        return found, found.gram[-1, -1] / 2 / jnp.maximum(in_turn(blocks.weight[campaign]).sum(), 1), thinned

    return jax.lax.map(one, (campaign, start, most, thin))


def searches(
    data: SideBySide, tasks: Sequence[tuple[int, np.ndarray]], most: int, thin: int = 0
) -> tuple[Search, Float[np.ndarray, " task"], Bool[np.ndarray, " task"]]:
    """Searches of campaigns from starts, so many in a call that its arrays have a fixed size."""
    found = []
    for first in range(0, len(tasks), TOGETHER):
        some = tasks[first : first + TOGETHER]
        lack = TOGETHER - len(some)
        campaign = np.array([i for i, _ in some] + [0] * lack)
        start = np.stack([x for _, x in some] + [some[0][1]] * lack)
        points = np.array([[most] * len(some) + [0] * lack, [thin] * len(some) + [0] * lack])
        found.append(jax.tree.map(np.asarray, search(data, campaign, start, *points)))
    return jax.tree.map(lambda *parts: np.concatenate(parts)[: len(tasks)], *found)
