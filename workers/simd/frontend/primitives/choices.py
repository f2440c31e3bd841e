"""Rules of comparisons, choices between values, and conversions between dtypes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from workers.simd.frontend.dtypes import bits_of, dtype_in, graph_dtype, is_signed
from workers.simd.frontend.primitives.registry import primitive
from workers.simd.frontend.tracer import Nodes, Tracer
from workers.simd.graph import elementary
from workers.simd.graph.graph import Graph
from workers.simd.graph.unsupported import UnsupportedError


@primitive("eq", "ne", "lt", "le", "gt", "ge")
def _compare(t: Tracer, equation: Any, a: Nodes, b: Nodes) -> Nodes:
    name, dtype = equation.primitive.name, dtype_in(equation)
    if name in ("gt", "ge"):
        name, a, b = {"gt": "lt", "ge": "le"}[name], b, a
    node_dtype = graph_dtype(dtype)
    if node_dtype == "f":
        return t.ops(name, a, b)
    if node_dtype == "k":
        same = t.ops("and", *np.moveaxis(t.ops("ieq", t.words(a), t.words(b)), -1, 0))
        return same if name == "eq" else _not(t, same)
    less = "slt" if is_signed(dtype) else "ult"
    if node_dtype == "b":
        if name not in ("eq", "ne"):
            raise UnsupportedError(f"{name} of bool")
        different = t.ops("xor", a, b)
        return different if name == "ne" else _not(t, different)
    match name:
        case "eq":
            return t.ops("ieq", a, b)
        case "ne":
            return _not(t, t.ops("ieq", a, b))
        case "lt":
            return t.ops(less, a, b)
        case _:
            return _not(t, t.ops(less, b, a))


def _not(t: Tracer, x: Nodes) -> Nodes:
    """Negation of bool nodes."""
    return t.map(lambda n: t.graph.op("xor", t.graph.const("b", True), n), x)


@primitive("not")
def _not_primitive(t: Tracer, equation: Any, x: Nodes) -> Nodes:
    return _not(t, x) if graph_dtype(dtype_in(equation)) == "b" else t.ops("ixor", x, t.constants(np.int32(-1)))


@primitive("is_finite")
def _is_finite(t: Tracer, equation: Any, x: Nodes) -> Nodes:
    return t.map(lambda n: t.graph.op("lt", t.graph.op("abs", n), t.graph.f(np.inf)), x)


@primitive("max", "min")
def _extreme(t: Tracer, equation: Any, a: Nodes, b: Nodes) -> Nodes:
    return t.map(extreme_of(t.graph, equation.primitive.name, dtype_in(equation)), a, b)


def extreme_of(g: Graph, name: str, dtype: str) -> Callable[[int, int], int]:
    """Function that gives the greater ("max") or the lesser ("min") of two nodes, or NaN if either is NaN.

    Of two zeros with different signs it may give either.
    """
    node_dtype = graph_dtype(dtype)
    if node_dtype == "b":
        return lambda a, b: g.op("or" if name == "max" else "and", a, b)
    if node_dtype == "i":
        less = "slt" if is_signed(dtype) else "ult"
        return lambda a, b: g.op("iselect", g.op(less, a, b), *((b, a) if name == "max" else (a, b)))

    def extreme(a: int, b: int) -> int:
        if a == b:
            return a
        if g.constant(b) is not None:
            a, b = b, a
        first = g.op("lt", b, a) if name == "max" else g.op("lt", a, b)
        selected = g.op("select", first, a, b)  # b if either is NaN: one instruction
        constant = g.constant(a)
        if constant is not None and not np.isnan(constant):
            return selected
        return g.op("select", g.op("ne", a, a), a, selected)

    return extreme


@primitive("clamp")
def _clamp(t: Tracer, equation: Any, low: Nodes, x: Nodes, high: Nodes) -> Nodes:
    dtype = str(equation.invars[1].aval.dtype)
    greater, lesser = extreme_of(t.graph, "max", dtype), extreme_of(t.graph, "min", dtype)
    return t.map(lambda lo, n, hi: lesser(greater(n, lo), hi), low, x, high)


def select(t: Tracer, dtype: str, which: Nodes, cases: Sequence[Sequence[Nodes]]) -> list[Nodes]:
    """Arrays of the case that `which` names, element by element; numbers out of range name the first or last case."""
    g, is_bool, chosen = t.graph, graph_dtype(dtype) == "b", list(cases[-1])

    def choice(mask: int, early: int, late: int) -> int:
        return g.choose(mask, late, early) if is_bool else g.choose(mask, early, late)

    for number, case in reversed(list(enumerate(cases[:-1]))):
        mask = which if is_bool else t.map(lambda n, end=number + 1: g.op("slt", n, g.i(end)), which)
        chosen = [t.map(choice, mask, early, late) for early, late in zip(case, chosen, strict=True)]
    return chosen


@primitive("select_n")
def _select_n(t: Tracer, equation: Any, which: Nodes, *cases: Nodes) -> list[Nodes]:
    return select(t, dtype_in(equation), which, [[case] for case in cases])


@primitive("convert_element_type")
def _convert(t: Tracer, equation: Any, x: Nodes) -> Nodes:
    g = t.graph
    source, target = dtype_in(equation), str(equation.params["new_dtype"])
    match graph_dtype(source), graph_dtype(target):
        case same, also if same == also:
            return x
        case "b", "i":
            return t.ops("int_of_bool", x)
        case "i", "b":
            return _not(t, t.map(lambda n: g.op("ieq", n, g.i(0)), x))
        case "f", "b":
            return t.map(lambda n: g.op("ne", n, g.f(0.0)), x)
        case _, "f":
            return to_float(t, source, x)
    if target != "int32":
        raise UnsupportedError(f"conversion of {source} to {target}")
    return t.map(lambda n: elementary.int_of_float(g, n), x)


def to_float(t: Tracer, dtype: str, x: Nodes) -> Nodes:
    """Nodes of any JAX dtype converted to floats."""
    match graph_dtype(dtype):
        case "b":
            return t.map(lambda n: t.graph.op("select", n, t.graph.f(1.0), t.graph.f(0.0)), x)
        case "i":
            return t.ops("float_of_uint" if dtype == "uint32" else "float_of_int", x)
    return x


@primitive("bitcast_convert_type")
def _bitcast(t: Tracer, equation: Any, x: Nodes) -> Nodes:
    if equation.outvars[0].aval.shape != x.shape:
        raise UnsupportedError(f"bitcast of {dtype_in(equation)} to {equation.params['new_dtype']}, of another size")
    match graph_dtype(dtype_in(equation)), graph_dtype(equation.params["new_dtype"]):
        case "f", "i":
            return t.ops("bits", x)
        case "i", "f":
            return t.ops("unbits", x)
        case "i", "i":
            return x
    raise UnsupportedError(f"bitcast of {dtype_in(equation)} to {equation.params['new_dtype']}")


@primitive("shift_left", "shift_right_logical", "shift_right_arithmetic")
def _shift(t: Tracer, equation: Any, a: Nodes, b: Nodes) -> Nodes:
    """Shifts by any numbers: all bits are shifted out by as many as there are, or more, or by a negative number."""
    g, dtype, name = t.graph, dtype_in(equation), equation.primitive.name
    bits = bits_of(dtype)
    if name == "shift_right_logical" and is_signed(dtype) and bits < 32:
        a = t.wrapped(a, f"u{dtype}")
    if name == "shift_right_arithmetic" and not is_signed(dtype) and bits < 32:
        a = t.wrapped(a, dtype[1:])

    def shift(n: int, by: int) -> int:
        within = g.op("ult", by, g.i(bits))
        if name == "shift_right_arithmetic":
            return g.op("ashr", n, g.op("iselect", within, by, g.i(31)))
        shifted = g.op("shl" if name == "shift_left" else "lshr", n, g.op("iselect", within, by, g.i(0)))
        return g.op("iselect", within, shifted, g.i(0))

    return t.map(shift, a, b)
