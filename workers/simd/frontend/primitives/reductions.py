"""Rules of sums, products and other combinations along axes, which combine elements one by one in their order."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from workers.simd.frontend.dtypes import dtype_in, graph_dtype, is_signed
from workers.simd.frontend.primitives.choices import extreme_of, to_float
from workers.simd.frontend.primitives.registry import PRIMITIVES, primitive
from workers.simd.frontend.tracer import Nodes, Rule, Tracer
from workers.simd.graph.graph import Graph
from workers.simd.graph.unsupported import UnsupportedError


def _reduce(combine: Callable[[Tracer, Any], Callable[[int, int], int]]) -> Rule:
    """Rule that combines the elements along axes one by one in their order."""

    def rule(t: Tracer, equation: Any, x: Nodes) -> Nodes:
        axes = tuple(int(axis) for axis in equation.params["axes"])
        kept = [axis for axis in range(x.ndim) if axis not in axes]
        shape = tuple(x.shape[axis] for axis in kept)
        rows = np.transpose(x, [*kept, *axes]).reshape(int(np.prod(shape)), int(np.prod([x.shape[a] for a in axes])))
        function = combine(t, equation)
        totals = []
        for row in rows.tolist():
            total = row[0] if row else _of_nothing(t, equation)
            for node in row[1:]:
                total = function(total, node)
            totals.append(total)
        return np.array(totals, np.int64).reshape(shape)

    return rule


def _of_nothing(t: Tracer, equation: Any) -> int:
    """Node of the result of a reduction of no elements."""
    name, node_dtype = equation.primitive.name, graph_dtype(dtype_in(equation))
    neutral = {"reduce_sum": 0, "reduce_prod": 1, "reduce_and": True, "reduce_or": False}
    if node_dtype == "f":
        neutral |= {"reduce_max": -np.inf, "reduce_min": np.inf}
    if name not in neutral:
        raise UnsupportedError(f"{name} of an empty array of {dtype_in(equation)}")
    return t.graph.const(node_dtype, neutral[name])


def _numbers(name: str) -> Callable[[Tracer, Any], Callable[[int, int], int]]:
    """Combination of floats or integers by an operation, as an argument of `_reduce`."""

    def combine(t: Tracer, equation: Any) -> Callable[[int, int], int]:
        own = name if graph_dtype(dtype_in(equation)) == "f" else f"i{name}"
        return lambda a, b: t.graph.op(own, a, b)

    return combine


def _logic(name: str) -> Callable[[Tracer, Any], Callable[[int, int], int]]:
    """Combination of bools by an operation, as an argument of `_reduce`."""

    def combine(t: Tracer, equation: Any) -> Callable[[int, int], int]:
        if graph_dtype(dtype_in(equation)) != "b":
            raise UnsupportedError(f"{equation.primitive.name} of {dtype_in(equation)}")
        return lambda a, b: t.graph.op(name, a, b)

    return combine


PRIMITIVES["reduce_sum"] = _reduce(_numbers("add"))
PRIMITIVES["reduce_prod"] = _reduce(_numbers("mul"))
PRIMITIVES["reduce_max"] = _reduce(lambda t, equation: extreme_of(t.graph, "max", dtype_in(equation)))
PRIMITIVES["reduce_min"] = _reduce(lambda t, equation: extreme_of(t.graph, "min", dtype_in(equation)))
PRIMITIVES["reduce_and"] = _reduce(_logic("and"))
PRIMITIVES["reduce_or"] = _reduce(_logic("or"))


@primitive("argmin", "argmax")
def _arg_extreme(t: Tracer, equation: Any, x: Nodes) -> Nodes:
    """Index of the first extreme, or of the first NaN if there is one."""
    g = t.graph
    (axis,) = equation.params["axes"]
    if str(equation.params["index_dtype"]) != "int32":
        raise UnsupportedError(
            f"{equation.primitive.name} with indices of type {equation.params['index_dtype']}; simd supports int32"
        )
    goes_ahead = _beats(g, equation.primitive.name, dtype_in(equation))
    rows = np.moveaxis(x, axis, -1)
    indices = []
    for row in rows.reshape(-1, x.shape[axis]).tolist():
        best, at = row[0], g.i(0)
        for number, node in enumerate(row[1:], 1):
            ahead = goes_ahead(node, best)
            best = g.choose(ahead, node, best)
            at = g.op("iselect", ahead, g.i(number), at)
        indices.append(at)
    return np.array(indices, np.int64).reshape(rows.shape[:-1])


def _beats(g: Graph, name: str, dtype: str) -> Callable[[int, int], int]:
    """Function that tells whether a node is more extreme than the best before it, as a bool node."""
    node_dtype = graph_dtype(dtype)
    less = {"f": "lt", "i": "slt" if is_signed(dtype) else "ult"}.get(node_dtype)

    def beats(node: int, best: int) -> int:
        low, high = (node, best) if name == "argmin" else (best, node)
        if less is None:
            return g.op("and", g.op("xor", g.const("b", True), low), high)
        ahead = g.op(less, low, high)
        if node_dtype == "f":
            ahead = g.op("or", ahead, g.op("and", g.op("ne", node, node), g.op("eq", best, best)))
        return ahead

    return beats


def _cumulate(combine: Callable[[Tracer, Any], Callable[[int, int], int]]) -> Rule:
    """Rule that combines each element along an axis with all elements before it, one by one."""

    def rule(t: Tracer, equation: Any, x: Nodes) -> Nodes:
        function = combine(t, equation)
        rows = np.moveaxis(x, equation.params["axis"], 0)
        rows = rows[::-1] if equation.params["reverse"] else rows
        if not len(rows):
            return x
        totals = [rows[0]]
        for row in rows[1:]:
            totals.append(t.map(function, totals[-1], row))
        stacked = np.stack(totals[::-1] if equation.params["reverse"] else totals)
        return np.moveaxis(stacked, 0, equation.params["axis"])

    return rule


PRIMITIVES["cumsum"] = _cumulate(_numbers("add"))
PRIMITIVES["cumprod"] = _cumulate(_numbers("mul"))
PRIMITIVES["cummax"] = _cumulate(lambda t, equation: extreme_of(t.graph, "max", dtype_in(equation)))
PRIMITIVES["cummin"] = _cumulate(lambda t, equation: extreme_of(t.graph, "min", dtype_in(equation)))


@primitive("dot_general")
def _dot_general(t: Tracer, equation: Any, a: Nodes, b: Nodes) -> Nodes:
    """Sums of products in the order of the contracted axes, in float32 whatever precision is requested."""
    if str(equation.outvars[0].aval.dtype) != "float32":
        raise UnsupportedError(f"dot_general with results of type {equation.outvars[0].aval.dtype}, not float32")
    a, b = (to_float(t, dtype_in(equation, k), operand) for k, operand in enumerate((a, b)))
    (contract_a, contract_b), (batch_a, batch_b) = equation.params["dimension_numbers"]
    free_a = [axis for axis in range(a.ndim) if axis not in (*contract_a, *batch_a)]
    free_b = [axis for axis in range(b.ndim) if axis not in (*contract_b, *batch_b)]
    shape = [a.shape[axis] for axis in (*batch_a, *free_a)] + [b.shape[axis] for axis in free_b]
    batch = int(np.prod([a.shape[axis] for axis in batch_a]))
    inner = int(np.prod([a.shape[axis] for axis in contract_a]))
    rows_a, rows_b = (
        np.transpose(x, (*first, *free, *last)).reshape(batch, int(np.prod([x.shape[axis] for axis in free])), inner)
        for x, first, free, last in ((a, batch_a, free_a, contract_a), (b, batch_b, free_b, contract_b))
    )
    g, totals = t.graph, []
    for left, right in zip(rows_a.tolist(), rows_b.tolist(), strict=True):
        for row in left:
            for column in right:
                total = g.f(0.0)
                for x, y in zip(row, column, strict=True):
                    total = g.op("add", total, g.op("mul", x, y))
                totals.append(total)
    return np.array(totals, np.int64).reshape(shape)
