"""C from JAX functions, compiled by the system's compiler and run beside JAX itself on random numbers."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gyromodel.numerics.c_code import NoCForm, Statements, literal

CC = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
STRICT = ("-std=c99", "-pedantic", "-Wall", "-Wextra", "-Werror")
SIZE = 3
needs_compiler = pytest.mark.skipif(CC is None, reason="no C compiler on this machine")

FUNCTIONS: dict[str, Callable] = {
    "arithmetic": lambda x: (x + 2.0) * x - x / 3.0 + (-x),
    "powers": lambda x: jnp.stack([x**2, x**3, x**7, x**-2, x**0, jnp.abs(x) ** 1.7, jnp.square(x)]).sum(axis=0),
    "functions": lambda x: jnp.exp(-x) + jnp.sin(x) * jnp.cos(x) + jnp.tanh(x) + jnp.arctan2(x, 0.3) + jnp.cbrt(x),
    "logarithms": lambda x: jnp.log(1 + x**2) + jnp.log1p(x**2) + jnp.expm1(x) + jnp.sqrt(jnp.abs(x)),
    "inverse": lambda x: jnp.arcsin(x / 9) + jnp.arccos(x / 9) + jnp.arctan(x) + jax.lax.rsqrt(1 + x**2),
    "special": lambda x: jax.scipy.special.erf(x) + jax.nn.sigmoid(x) + jnp.arcsinh(x) + jnp.exp2(x),
    "steps": lambda x: jnp.sign(x) + jnp.floor(x) + jnp.ceil(x) + jnp.maximum(x, 0.2) - jnp.minimum(x, -0.1),
    "clipping": lambda x: jnp.clip(x, -0.5, 0.7),
    "choices": lambda x: jnp.where((x > 0) & ~(x >= 1) | (x == -1.0), jnp.sinc(x), jnp.where(x != 2, x, jnp.nan)),
    "finiteness": lambda x: jnp.where(jnp.isfinite(x), x, -1.0) + (x < 0.5).astype(float),
    "products": lambda x: jnp.outer(x, x) @ x + jnp.linspace(0.0, 1.0, SIZE) * (x @ x) + jnp.tensordot(x, x, 1),
    "reductions": lambda x: jnp.stack([x.sum(), jnp.max(x), jnp.min(x) * jnp.prod(x)]),
    "moves": lambda x: jnp.concatenate([x[1:], x[:1]])[::-1] + jnp.tile(x, 2).reshape(2, SIZE).T[:, 1] + x[x.size - 1],
    "gathers": lambda x: x[jnp.array([2, 0, 1])] + jnp.pad(x, 1)[:SIZE] + jnp.repeat(x[1], SIZE),
    "derivatives": lambda x: jax.jvp(lambda y: jnp.maximum(y, 0.0) ** 3 / (1 + y**2), (x,), (jnp.ones(SIZE),))[1],
    "constants": lambda x: jnp.where(x > 9, -jnp.inf, jnp.full(SIZE, 0.1 + 0.2) * jnp.arange(SIZE) + x * 1.0),
}


def built(source: str, folder: Path) -> ctypes.CDLL:
    """A shared library of a C source that must compile without a warning."""
    (folder / "code.c").write_text(source, encoding="utf-8")
    library = folder / "code.so"
    command = [str(CC), *STRICT, "-O1", "-shared", "-fPIC", "-o", str(library), str(folder / "code.c"), "-lm"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return ctypes.CDLL(str(library))


@needs_compiler
def test_statements_compute_what_jax_computes(tmp_path: Path, rng: np.random.Generator):
    names = np.array([f"x[{i}]" for i in range(SIZE)], object)
    source = ["#include <math.h>"]
    for name, function in FUNCTIONS.items():
        code = Statements(function, [jnp.zeros(SIZE)], [names])
        lines, _ = code.needed(*code.outputs[0])
        stores = [f"y[{i}] = {atom};" for i, atom in enumerate(code.outputs[0])]
        source += [f"void {name}(const double *x, double *y) {{ (void)x;", *lines, *stores, "}"]
    library = built("\n".join(source), tmp_path)
    special = np.array([[0.0, -1.0, 2.0], [1.0, -0.0, 9.5], [np.nan, 0.5, -0.5]])
    points = [*rng.uniform(-2, 2, (50, SIZE)), *special]
    for name, function in FUNCTIONS.items():
        call, compiled = getattr(library, name), jax.jit(function)
        for x in points:
            y = np.empty(SIZE)
            call(*(ctypes.c_void_p(array.ctypes.data) for array in (np.ascontiguousarray(x), y)))
            expected = np.asarray(compiled(jnp.asarray(x)))
            np.testing.assert_allclose(y, expected, rtol=1e-13, atol=1e-13, err_msg=f"{name} at {x}")


@pytest.mark.parametrize(
    ("function", "primitive"),
    [
        (jnp.cumsum, "cumsum"),
        (jnp.sort, "sort"),
        (lambda x: jax.lax.fori_loop(0, 3, lambda i, y: y * x, x), "scan|while"),
        (lambda x: x.astype(int) * 1.0, "convert_element_type to int64"),
        (lambda x: x.astype(jnp.float32), "convert_element_type to float32"),
    ],
)
def test_what_has_no_c_form_is_named(function: Callable, primitive: str):
    with pytest.raises(NoCForm, match=primitive):
        Statements(function, [jnp.zeros(SIZE)], [np.array(["a", "b", "c"], object)])


def test_only_what_a_result_needs_is_written():
    code = Statements(lambda x: x * x + jnp.sin(x[0]), [jnp.zeros(2)], [np.array(["a", "b"], object)])
    lines, reached = code.needed(code.outputs[0][1])
    assert "b * b" in " ".join(lines)
    assert "a * a" not in " ".join(lines)
    assert {"a", "b"} <= reached
    whole = Statements(lambda x: x * 2.0, [jnp.zeros(2)], [np.array(["a", "b"], object)])
    assert "a" not in whole.needed(whole.outputs[0][1])[1]


@pytest.mark.parametrize("value", [0.1, 1e300, 5e-324, 2.0, 1e22, 123456789.0])
def test_literals_are_exact(value: float):
    assert float(literal(value)) == value
    assert literal(-value) == f"(-{literal(value)})"
    assert "." in literal(value) or "e" in literal(value)


def test_literals_of_no_number():
    assert [literal(x) for x in (np.nan, np.inf, -np.inf, -0.0)] == ["NAN", "INFINITY", "(-INFINITY)", "(-0.0)"]
