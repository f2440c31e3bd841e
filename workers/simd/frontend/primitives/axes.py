"""Rules of sums, products and other combinations along axes, which combine elements one by one in their order, and
of sorting, by networks of comparators: which pairs are compared does not depend on the numbers.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from workers.simd.frontend.primitives.elementwise import extreme_of, to_float
from workers.simd.frontend.tracer import (
    PRIMITIVES,
    Nodes,
    PrimitiveRule,
    Tracer,
    dtype_in,
    graph_dtype,
    is_signed,
    primitive,
)
from workers.simd.graph.graph import Graph, UnsupportedError, way_round


def _reduce(combine: Callable[[Tracer, Any], Callable[[int, int], int]]) -> PrimitiveRule:
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


def _cumulate(combine: Callable[[Tracer, Any], Callable[[int, int], int]]) -> PrimitiveRule:
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


MOST_COMPARATORS = 20_000
"""Most comparators of a row that is sorted (about ten operations each): 128 numbers need 1,471, a thousand 23,521."""
LAST = 2**31 - 1
"""The integer key that comes after all others: that of NaN."""


@primitive("sort")
def _sort(t: Tracer, equation: Any, *arrays: Nodes) -> list[Nodes]:
    """Rows in ascending order of the first `num_keys` arrays; equal rows stay in their order (stable).

    Zeros are equal whatever their signs are, and NaN is greater than all numbers, as in JAX.
    """
    axis, count = equation.params["dimension"], equation.params["num_keys"]
    dtypes = [dtype_in(equation, k) for k in range(len(arrays))]
    keys = [_keys(t, dtype, x, signed_zeros=False) for dtype, x in zip(dtypes, arrays[:count], strict=False)]
    # If integers and bools are all that is sorted, equal rows are the same, and their order cannot be seen.
    if len(arrays) > count or any(graph_dtype(dtype) == "f" for dtype in dtypes):
        keys.append(_positions(t, arrays[0].shape, axis))
    return _by_keys(t, equation, axis, keys, list(arrays))


@primitive("top_k")
def _top_k(t: Tracer, equation: Any, x: Nodes) -> list[Nodes]:
    """The k greatest numbers along an axis and their positions; of equal ones the first comes first.

    NaN is greater than all numbers, and 0 is greater than -0, as in JAX (where a negative NaN is the least of all; here
    the sign of a NaN does not count).
    """
    k, axis, dtype = equation.params["k"], equation.params.get("axis", x.ndim - 1), dtype_in(equation)
    positions = _positions(t, x.shape, axis)
    keys = t.ops("ixor", _keys(t, dtype, x, signed_zeros=True), t.constants(np.int32(-1)))  # the greatest comes first
    found = _by_keys(t, equation, axis, [keys, positions], [x, positions])
    return [np.take(rows, range(k), axis) for rows in found]


@primitive("lt_to", "le_to")
def _total_order(t: Tracer, equation: Any, a: Nodes, b: Nodes) -> Nodes:
    """Comparisons in a total order, in which -0 comes before 0, and NaN, whatever its sign, after all numbers."""
    a, b = (_keys(t, dtype_in(equation), x, signed_zeros=True) for x in (a, b))
    if equation.primitive.name == "lt_to":
        return t.ops("slt", a, b)
    return t.map(lambda n: t.graph.op("xor", t.graph.const("b", True), n), t.ops("slt", b, a))


def _positions(t: Tracer, shape: tuple[int, ...], axis: int) -> Nodes:
    along = np.arange(shape[axis], dtype=np.int32)
    return np.broadcast_to(t.constants(along).reshape([-1 if k == axis else 1 for k in range(len(shape))]), shape)


def _keys(t: Tracer, dtype: str, x: Nodes, *, signed_zeros: bool) -> Nodes:
    """Integers (int32) in the order of numbers of a JAX dtype.

    Args:
        signed_zeros: whether -0 comes before 0; otherwise they are equal.
    """
    g = t.graph
    match graph_dtype(dtype), dtype:
        case "b", _:
            return t.ops("int_of_bool", x)
        case _, "uint32":
            return t.ops("ixor", x, t.constants(np.int32(-(2**31))))
        case "i", _:
            return x

    def key(node: int) -> int:
        """The bits of a float as an integer; those of a negative one, which fall as it rises, inverted."""
        number = node if signed_zeros else g.op("select", g.op("eq", node, g.f(0.0)), g.f(0.0), node)
        bits = g.op("bits", number)
        ordered = g.op("ixor", bits, g.op("iand", g.op("ashr", bits, g.i(31)), g.i(2**31 - 1)))
        return g.op("iselect", g.op("ne", node, node), g.i(LAST), ordered)

    return t.map(key, x)


def _by_keys(t: Tracer, equation: Any, axis: int, keys: list[Nodes], arrays: list[Nodes]) -> list[Nodes]:
    """Arrays with the rows along an axis in ascending order of integer keys, the first of which counts most."""
    n = arrays[0].shape[axis]
    if n < 2:
        return arrays
    if len(pairs := network(n)) > MOST_COMPARATORS:
        name = equation.primitive.name
        raise UnsupportedError(
            f"{name} of {n:,} numbers, by {len(pairs):,} comparisons (at most {MOST_COMPARATORS:,})",
            advice=way_round(name),
        )
    columns = [np.moveaxis(x, axis, -1).reshape(-1, n) for x in (*keys, *arrays)]
    in_order = np.empty((len(arrays), *columns[0].shape), np.int64)
    for number in range(len(columns[0])):
        rows = [[int(node) for node in row] for row in zip(*(column[number] for column in columns), strict=True)]
        known = t.values(np.array(rows)[:, : len(keys)])
        if known is None:
            _compare_and_exchange(t, rows, len(keys), pairs)
        else:  # constants are sorted while tracing
            rows = [rows[k] for k in np.lexsort(known.T[::-1])]
        in_order[:, number] = np.array(rows).T[len(keys) :]
    shape = np.moveaxis(arrays[0], axis, -1).shape
    return [np.moveaxis(x.reshape(shape), -1, axis) for x in in_order]


def _compare_and_exchange(t: Tracer, rows: list[list[int]], keys: int, pairs: list[tuple[int, int]]) -> None:
    """Send rows of nodes, which begin with `keys` keys, through a network of comparators."""
    g = t.graph
    for i, j in pairs:
        goes_first = g.const("b", False)  # whether row j goes before row i
        for a, b in reversed(list(zip(rows[j][:keys], rows[i][:keys], strict=True))):
            goes_first = g.op("or", g.op("slt", a, b), g.op("and", g.op("ieq", a, b), goes_first))
        both = list(zip(rows[i], rows[j], strict=True))
        rows[i] = [g.choose(goes_first, b, a) for a, b in both]
        rows[j] = [g.choose(goes_first, a, b) for a, b in both]


def network(n: int) -> list[tuple[int, int]]:
    """Comparators of Batcher's odd-even merge sort of n elements: pairs of positions, the lesser first.

    K. E. Batcher, Sorting networks and their applications, AFIPS 1968; for any n, those of the next power of two whose
    positions exist.
    """
    pairs, half = [], 1
    while half < n:
        step = half
        while step >= 1:
            for start in range(step % half, n - step, 2 * step):
                ends = range(start, min(start + step, n - step))
                pairs += [(i, i + step) for i in ends if i // (2 * half) == (i + step) // (2 * half)]
            step //= 2
        half *= 2
    return pairs
