"""The package's own fit of any function on the NIST reference problems, against their certified values.

Certified parameters and standard deviations stand in the data files, with two starts each: one far, one near.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from gyromodel.estimate import fit_function
from tests.truth import nist


@pytest.mark.parametrize("name", sorted(nist.MODELS))
def test_certified_digits(name: str, measured_data: Callable[[str], Path]):
    problem = nist.read(measured_data(f"nist_strd/{name}.dat"))
    for start in problem.starts:
        found = fit_function(problem.model, jnp.asarray(start), problem.response, jnp.asarray(problem.predictor))
        freedom = len(problem.response) - len(start)
        assert nist.digits(found.parameters.vector, problem.certified) >= 6
        assert found.degrees_of_freedom == freedom
        if name != nist.WITHOUT_ERRORS:
            assert nist.digits(found.parameters.std, problem.deviations) >= 5
            spread = np.sqrt(found.residual @ found.residual / freedom)
            assert found.scatter == pytest.approx([spread], rel=1e-9)
