"""The Gram matrix of whitened columns, taken in pieces, against the columns whitened whole and the dense inverse."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gyromodel.numerics.state_space import (
    GRAM_ROWS,
    SHORT,
    Filter,
    MarkovSum,
    Sampling,
    build_filter,
    whiten,
    whitened_gram,
)

NOISE = MarkovSum(jnp.array([0.0, 0.5, 0.01]), jnp.array([1e-3, 0.2, 3.0]))

gram = jax.jit(whitened_gram)


def sampling(rows: int, rng: np.random.Generator) -> Sampling:
    """Unequal steps, missing samples, a second record and unequal white variances."""
    return Sampling(
        jnp.asarray(rng.uniform(0.1, 3.0, rows)),
        jnp.isin(jnp.arange(rows), jnp.array([0, rows // 3])),
        jnp.asarray(rng.random(rows) < 0.8),
        jnp.asarray(rng.uniform(0.2, 5.0, rows)),
    )


def build(rows: int, rng: np.random.Generator) -> Filter:
    return jax.jit(build_filter)(NOISE, sampling(rows, rng))


@pytest.mark.parametrize(
    "rows",
    [1, GRAM_ROWS, SHORT - 1, SHORT, SHORT + 1, SHORT + GRAM_ROWS - 1, 3 * SHORT],
)
@pytest.mark.parametrize("width", [0, 1, 5])
def test_equals_the_product_of_whitened_columns(rows: int, width: int, rng: np.random.Generator):
    filter = build(rows, rng)
    columns = jnp.asarray(rng.standard_normal((rows, width)))
    whole = np.asarray(whiten(filter, columns))
    assert np.asarray(gram(filter, columns)) == pytest.approx(whole.T @ whole, rel=1e-11, abs=1e-11 * rows)


def test_equals_the_dense_inverse(rng: np.random.Generator):
    """A walk and a Markov process sampled evenly; V written down from their definitions."""
    rows = SHORT + 100
    noise = MarkovSum(jnp.array([0.0, 0.01]), jnp.array([1e-3, 3.0]))
    even = Sampling(jnp.ones(rows), jnp.arange(rows) == 0, jnp.ones(rows, bool), jnp.ones(rows))
    time = np.arange(rows)
    walk = 1e-3 * np.minimum.outer(time, time)
    dense = np.eye(rows) + walk + 3.0 * np.exp(-0.01 * np.abs(np.subtract.outer(time, time)))
    columns = rng.standard_normal((rows, 3))
    expected = columns.T @ np.linalg.solve(dense, columns)
    found = np.asarray(gram(jax.jit(build_filter)(noise, even), jnp.asarray(columns)))
    assert found == pytest.approx(expected, rel=1e-9, abs=1e-9)


def test_values_of_missing_samples_do_not_matter(rng: np.random.Generator):
    rows = SHORT + 7
    filter = build(rows, rng)
    columns = rng.standard_normal((rows, 2))
    holes = np.where(np.asarray(filter.present)[:, None], columns, np.nan)
    assert np.array_equal(gram(filter, jnp.asarray(holes)), gram(filter, jnp.asarray(columns)))


def test_many_filters_at_once(rng: np.random.Generator):
    """Mapped over noise cells, as the restricted likelihood uses it."""
    rows = SHORT + 300
    sampled = sampling(rows, rng)
    columns = jnp.asarray(rng.standard_normal((rows, 3)))
    levels = jnp.array([0.0, 1.0, 10.0])

    def one(level: jax.Array) -> jax.Array:
        return whitened_gram(build_filter(NOISE._replace(variance=level * NOISE.variance), sampled), columns)

    together = jax.jit(jax.vmap(one))(levels)
    for level, found in zip(levels, together, strict=True):
        assert np.asarray(found) == pytest.approx(np.asarray(jax.jit(one)(level)), rel=1e-10, abs=1e-8)


def test_long_record_needs_no_room_for_the_whitened_columns():
    """The compiled program's own memory, beside its arguments, does not grow with the record."""
    rows, width = 200_000, 40
    shapes = jax.eval_shape(lambda: (jnp.zeros((rows, 3)), jnp.zeros(rows), jnp.zeros(rows, bool)))
    filter = Filter(shapes[0], shapes[0], shapes[1], shapes[2])
    columns = jax.ShapeDtypeStruct((rows, width), float)
    memory = gram.lower(filter, columns).compile().memory_analysis()
    if memory is None:
        pytest.skip("this backend does not report a program's memory")
    assert memory.temp_size_in_bytes < rows * width * 8 / 100
