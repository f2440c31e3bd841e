"""Rules of sorting, by networks of comparators: which pairs are compared does not depend on the numbers."""

from __future__ import annotations

from typing import Any

import numpy as np

from workers.simd.frontend.dtypes import dtype_in, graph_dtype
from workers.simd.frontend.primitives.registry import primitive
from workers.simd.frontend.tracer import Nodes, Tracer
from workers.simd.graph.unsupported import UnsupportedError, way_round

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
    """Nodes of the position of each element along an axis."""
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
