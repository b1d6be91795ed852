"""A JAX function of scalars and small arrays as C99 statements, one scalar operation each.

The function's jaxpr is walked with the names of C variables in place of numbers: what moves data moves names, what
computes writes a statement, and what depends on no argument is computed here.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import reduce
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn, Literal

# C99 for the primitives of JAX that compute each element by itself; NaN goes through all of them as in JAX.
_ELEMENTWISE = {
    "add": "{0} + {1}",
    "add_any": "{0} + {1}",
    "sub": "{0} - {1}",
    "mul": "{0} * {1}",
    "div": "{0} / {1}",
    "neg": "-{0}",
    "square": "{0} * {0}",
    "max": "({0} > {1} || {0} != {0}) ? {0} : {1}",
    "min": "({0} < {1} || {0} != {0}) ? {0} : {1}",
    "clamp": "({1} < {0}) ? {0} : ({1} > {2}) ? {2} : {1}",
    "abs": "fabs({0})",
    "sign": "({0} != {0}) ? {0} : (double)(({0} > 0.0) - ({0} < 0.0))",
    "pow": "pow({0}, {1})",
    "atan2": "atan2({0}, {1})",
    "rsqrt": "1.0 / sqrt({0})",
    "logistic": "1.0 / (1.0 + exp(-{0}))",
    "lt": "{0} < {1}",
    "le": "{0} <= {1}",
    "gt": "{0} > {1}",
    "ge": "{0} >= {1}",
    "eq": "{0} == {1}",
    "ne": "{0} != {1}",
    "and": "{0} && {1}",
    "or": "{0} || {1}",
    "not": "!{0}",
    "select_n": "{0} ? {2} : {1}",
    "is_finite": "isfinite({0}) != 0",
    "copy": "{0}",
} | {
    name: f"{name}({{0}})"
    for name in (
        *("exp", "exp2", "expm1", "log", "log1p", "sqrt", "cbrt", "floor", "ceil", "erf", "erfc"),
        *("sin", "cos", "tan", "asin", "acos", "atan", "sinh", "cosh", "tanh", "asinh", "acosh", "atanh"),
    )
}  # fmt: skip
# What a statement may yield; whole numbers are computed here or not at all.
_REAL = "float64"
_TYPES = {_REAL: "double", "bool": "int"}
_REDUCTIONS = {"reduce_sum": "add", "reduce_prod": "mul", "reduce_max": "max", "reduce_min": "min"}
_MOVES = {"reshape", "broadcast_in_dim", "squeeze", "expand_dims", "transpose", "slice", "dynamic_slice", "gather"}
_MOVES |= {"concatenate", "stack", "split", "rev", "pad", "tile"}
_CALLS = {"jit", "closed_call", "custom_jvp_call"}


class NoCForm(ValueError):
    """A function uses a primitive that has no form as a few C statements; the message names it."""


class Statements:
    """C statements of a function.

    Args:
        function: of pytrees of arrays, traceable by JAX.
        arguments: example arguments; only shapes and types count.
        names: a C expression for each element, by leaf of the arguments.

    Attributes:
        outputs: the C expressions of the function's results, by leaf.

    Raises:
        NoCForm: the function uses a primitive that is not known here.
    """

    def __init__(self, function: Callable[..., Any], arguments: Sequence[Any], names: Sequence[np.ndarray]) -> None:
        self._right: dict[str, tuple[str, tuple[str, ...]]] = {}
        self._known: dict[str, str] = {}
        results = self._walk(jax.make_jaxpr(function)(*arguments), list(names))
        self.outputs = [result if result.dtype == object else _literals(result) for result in results]

    def needed(self, *results: str) -> tuple[list[str], set[str]]:
        """The statements that some results need, in order, and every expression that they read."""
        reached: set[str] = set()
        waiting = list(results)
        while waiting:
            name = waiting.pop()
            if name not in reached:
                reached.add(name)
                waiting += self._right[name][1] if name in self._right else ()
        return [line for name, (line, _) in self._right.items() if name in reached], reached

    def _walk(self, closed: ClosedJaxpr, arguments: list[np.ndarray]) -> list[np.ndarray]:
        jaxpr: Jaxpr = closed.jaxpr
        values = dict(zip(jaxpr.constvars, map(np.asarray, closed.consts), strict=True))
        values |= dict(zip(jaxpr.invars, arguments, strict=True))

        def read(atom):
            return np.asarray(atom.val) if isinstance(atom, Literal) else values[atom]

        for equation in jaxpr.eqns:
            results = self._apply(equation, [read(atom) for atom in equation.invars])
            values |= dict(zip(equation.outvars, results, strict=True))
        return [read(atom) for atom in jaxpr.outvars]

    def _apply(self, equation: JaxprEqn, operands: list[np.ndarray]) -> list[np.ndarray]:
        name, parameters = equation.primitive.name, equation.params
        if name in _CALLS:
            return self._walk(parameters["jaxpr" if name == "jit" else "call_jaxpr"], operands)
        if all(operand.dtype != object for operand in operands):
            return _bound(equation, operands)
        kind = str(equation.outvars[0].aval.dtype)  # type: ignore[union-attr]
        if kind not in _TYPES:
            raise NoCForm(f"{name} to {kind}")
        if name in _MOVES:
            return _moved(equation, operands)
        operands = [operand if operand.dtype == object else _literals(operand) for operand in operands]
        if name == "convert_element_type":
            return [self._each("(double){0}" if kind == _REAL else "{0} != 0.0", kind, *operands)]
        if name in _ELEMENTWISE:
            return [self._each(_ELEMENTWISE[name], kind, *operands)]
        if name == "integer_pow":
            return [self._power(operands[0], parameters["y"])]
        if name in _REDUCTIONS:
            axes = parameters["axes"]
            rows = np.moveaxis(operands[0], axes, range(len(axes)))
            return [self._folded(_REDUCTIONS[name], kind, rows.reshape(-1, *rows.shape[len(axes) :]))]
        if name == "dot_general" and parameters["dimension_numbers"][1] == ((), ()):
            (left, right), _ = parameters["dimension_numbers"]
            return [self._dot(operands[0], operands[1], left, right)]
        raise NoCForm(name)

    def _each(self, template: str, kind: str, *operands: np.ndarray) -> np.ndarray:
        """One statement for each element."""
        result = np.empty(np.broadcast_shapes(*(o.shape for o in operands)), object)
        spread = np.broadcast_arrays(*operands)
        for place in np.ndindex(result.shape):
            result[place] = self._write(template, kind, *(str(o[place]) for o in spread))
        return result

    def _write(self, template: str, kind: str, *atoms: str) -> str:
        if template == _ELEMENTWISE["mul"] and "1.0" in atoms:
            return atoms[1 - atoms.index("1.0")]
        text = template.format(*atoms)
        if text not in self._known:
            name = self._known[text] = f"t{len(self._known)}"
            self._right[name] = (f"const {_TYPES[kind]} {name} = {text};", atoms)
        return self._known[text]

    def _power(self, base: np.ndarray, exponent: int) -> np.ndarray:
        """Repeated squaring."""
        result, square, left = None, base, abs(exponent)
        while left:
            if left & 1:
                result = square if result is None else self._each(_ELEMENTWISE["mul"], _REAL, result, square)
            left >>= 1
            square = self._each(_ELEMENTWISE["mul"], _REAL, square, square) if left else square
        result = _literals(np.ones(base.shape)) if result is None else result
        return self._each("1.0 / {0}", _REAL, result) if exponent < 0 else result

    def _dot(self, a: np.ndarray, b: np.ndarray, left: Sequence[int], right: Sequence[int]) -> np.ndarray:
        """A product of matrices: the contracted axes of both come first, then they are one."""
        a, b = (np.moveaxis(x, axes, range(len(axes))) for x, axes in ((a, left), (b, right)))
        shape = (*a.shape[len(left) :], *b.shape[len(right) :])
        terms = math.prod(a.shape[: len(left)])
        a, b = a.reshape(terms, -1), b.reshape(terms, -1)
        products = self._each(_ELEMENTWISE["mul"], _REAL, a[:, :, None], b[:, None, :])
        return self._folded("add", _REAL, products).reshape(shape)

    def _folded(self, name: str, kind: str, rows: np.ndarray) -> np.ndarray:
        """One array from several, two at a time."""
        each = (rows[i, ...] for i in range(len(rows)))
        return reduce(lambda x, y: self._each(_ELEMENTWISE[name], kind, x, y), each)


def _bound(equation: JaxprEqn, operands: Sequence[np.ndarray]) -> list[np.ndarray]:
    """The primitive computed."""
    results = equation.primitive.bind(*map(jnp.asarray, operands), **equation.params)
    return [np.asarray(r) for r in (results if equation.primitive.multiple_results else [results])]


def _moved(equation: JaxprEqn, operands: Sequence[np.ndarray]) -> list[np.ndarray]:
    """A primitive that only moves data, applied to numbers that stand for its elements."""
    atoms: list[Any] = []
    numbered = []
    for operand in operands:
        if operand.dtype.kind in "iu":  # where to, rather than what
            numbered.append(operand)
            continue
        numbered.append(np.arange(len(atoms), len(atoms) + operand.size).reshape(operand.shape))
        atoms += np.ravel(operand if operand.dtype == object else _literals(operand)).tolist()
    return [np.asarray(np.array(atoms, object)[numbers], object) for numbers in _bound(equation, numbered)]


def _literals(values: np.ndarray) -> np.ndarray:
    """Numbers as C literals that read back exactly."""
    result = np.empty(values.shape, object)
    for place in np.ndindex(values.shape):
        result[place] = literal(float(values[place]))
    return result


def literal(value: float) -> str:
    """A number as a C expression that is exactly it."""
    if math.isnan(value):
        return "NAN"
    text = "INFINITY" if math.isinf(value) else repr(abs(value))
    return f"(-{text})" if value < 0 or (value == 0 and math.copysign(1.0, value) < 0) else text
