"""`Uncertain`: oracles are closed forms, Monte Carlo, and the end gauge of the GUM (JCGM 100:2008, H.1)."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import norm
from scipy.stats import t as student

from gyromodel.numerics.uncertain import Source, Uncertain, factor_of, together


def test_a_linear_function_carries_its_covariance():
    covariance = np.array([[4.0, 1.0, 0.0], [1.0, 2.0, 0.5], [0.0, 0.5, 1.0]])
    value = Uncertain.stated({"a": jnp.array([1.0, 2.0]), "b": jnp.asarray(3.0)}, covariance, "bench")
    matrix = np.array([[1.0, -1.0, 2.0], [0.0, 3.0, 1.0]])
    found = value.propagate(lambda v: jnp.asarray(matrix) @ jnp.append(v["a"], v["b"]))
    assert np.asarray(found.value) == pytest.approx(matrix @ [1, 2, 3])
    assert found.covariance == pytest.approx(matrix @ covariance @ matrix.T)
    assert found.budget()["bench"] == pytest.approx([1, 1])


def test_a_curved_function_is_carried_as_monte_carlo_says(rng: np.random.Generator):
    """exp(x) y with small errors: the first order leaves out terms of the relative variance, 1e-4."""
    covariance = 1e-4 * np.array([[1.0, 0.6], [0.6, 2.0]])
    value = Uncertain.stated(jnp.array([0.5, 2.0]), covariance, "x and y")
    draws = 20_000
    x, y = rng.multivariate_normal([0.5, 2.0], covariance, draws).T
    found = value.propagate(lambda v: jnp.stack([jnp.exp(v[0]) * v[1], v[0] - v[1]]))
    sample = np.cov([np.exp(x) * y, x - y])
    size = np.sqrt(np.outer(np.diag(sample), np.diag(sample)))
    assert sample / size == pytest.approx(found.covariance / size, abs=5 * np.sqrt(2 / draws) + 1e-3)


def test_a_shared_source_cancels_in_a_difference():
    standard = Uncertain.stated(jnp.asarray(10.0), 0.04, "standard")
    first = together(standard, Uncertain.stated(jnp.asarray(1.0), 0.01, "first")).propagate(lambda v: v[0] + v[1])
    second = together(standard, Uncertain.stated(jnp.asarray(3.0), 0.02, "second")).propagate(lambda v: v[0] + v[1])
    both = together(first, second)
    assert both.covariance == pytest.approx(np.array([[0.05, 0.04], [0.04, 0.06]]))
    difference = both.propagate(lambda v: v[1] - v[0])
    assert difference.covariance == pytest.approx(np.array([[0.03]]))
    assert difference.budget()["standard"] == pytest.approx([0.0], abs=1e-12)
    assert difference.budget()["second"] == pytest.approx([2 / 3])
    assert together(first, first).propagate(lambda v: v[0] - v[1]).std == pytest.approx([0.0], abs=1e-12)


def test_the_end_gauge_of_the_gum():
    """H.1: standard uncertainties in nm (table H.1), together 32 nm, 16 degrees of freedom, U99 = 93 nm (H.1.6)."""
    parts = {"standard": (25, 18), "repeats": (5.8, 24), "random": (3.9, 5), "systematic": (6.7, 8)}
    parts |= {"expansion": (2.9, 50), "temperature": (16.6, 2)}
    inputs = [Uncertain.stated(jnp.asarray(0.0), u**2, name, float(nu)) for name, (u, nu) in parts.items()]
    length = together(*inputs).propagate(lambda v: 50e6 + 838 + sum(v))
    assert length.std[0] == pytest.approx(32, abs=0.5)
    assert int(length.degrees_of_freedom[0]) == 16
    assert length.degrees_of_freedom[0] == pytest.approx(16.7, abs=0.15)
    low, high = length.interval(0.99)
    # The guide truncates the degrees of freedom to 16.
    assert (high - low)[0] / 2 == pytest.approx(93, abs=1.3)
    assert sum(length.budget().values())[0] == pytest.approx(1)


def test_intervals_are_students_and_the_normal_ones_without_doubt():
    few = Uncertain.stated(jnp.array([1.0, 2.0]), np.array([4.0, 9.0]), "few repeats", 3.0)
    low, high = few.interval(0.9)
    assert (high - low) / 2 == pytest.approx(student.ppf(0.95, 3) * np.array([2, 3]))
    exact = Uncertain.stated(jnp.array([1.0, 2.0]), 4.0, "certificate")
    assert exact.interval()[1] - exact.vector == pytest.approx(2 * norm.ppf(0.975))
    assert np.isinf(exact.degrees_of_freedom).all()


def test_sources_of_one_name_count_together_in_a_budget():
    parts = [Uncertain.stated(jnp.asarray(0.0), v, name) for v, name in ((1.0, "meter"), (3.0, "meter"), (4.0, "bath"))]
    total = together(*parts).propagate(lambda v: v[0] + v[1] + v[2])
    assert {k: v[0] for k, v in total.budget().items()} == pytest.approx({"meter": 0.5, "bath": 0.5})


def test_what_has_no_error_has_no_budget():
    exact = Uncertain.stated(jnp.asarray(2.0), 0.0, "nothing")
    assert exact.std.tolist() == [0.0]
    assert exact.budget()["nothing"].tolist() == [0.0]
    assert exact.interval()[0].tolist() == [2.0]


def test_a_singular_covariance_is_factored():
    column = np.array([1.0, 1e6, -2e-3])
    found = factor_of(np.outer(column, column))
    assert found @ found.T == pytest.approx(np.outer(column, column), rel=1e-7)


@pytest.mark.parametrize(
    ("covariance", "message"),
    [
        (np.array([[1.0, 2.0], [2.0, 1.0]]), "no negative eigenvalues, but this one has -1"),
        (np.ones(3), r"mass: a covariance of shape \(3,\) does not fit a value of 2 entries"),
    ],
)
def test_impossible_covariances_are_refused(covariance: np.ndarray, message: str):
    with pytest.raises(ValueError, match=message):
        Uncertain.stated(jnp.zeros(2), covariance, "mass")


def test_sources_are_told_apart_by_what_they_are_and_not_by_their_name():
    assert Source("meter") != Source("meter")


@pytest.mark.parametrize("covariance", [[[1, 0.9], [0, 1]], [-1e-12, 1.0], [np.nan, 1.0], [[0.0, 1e-9], [1e-9, 1.0]]])
def test_what_is_no_covariance_is_refused(covariance: list):
    with pytest.raises(ValueError, match="a covariance is finite and symmetric"):
        Uncertain.stated(jnp.zeros(2), covariance, "stated")


def test_whole_numbers_are_values():
    assert Uncertain.stated(300, 4.0, "stated").propagate(lambda x: 2.0 * x).std == pytest.approx([4.0])
