"""Rules of what works element by element: arithmetic, elementary functions, comparisons, choices, conversions."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from jax import lax

from workers.simd.frontend.tracer import (
    PRIMITIVES,
    Nodes,
    PrimitiveRule,
    Tracer,
    bits_of,
    dtype_in,
    graph_dtype,
    is_signed,
    primitive,
)
from workers.simd.graph import elementary
from workers.simd.graph.graph import Graph, UnsupportedError


def _by_dtype(floats: str | None, integers: str | None, booleans: str | None = None) -> PrimitiveRule:
    """Rule that applies one operation of the graph for each dtype; None means that the dtype is not supported."""

    def rule(t: Tracer, equation: Any, *arrays: Nodes) -> Nodes:
        node_dtype = graph_dtype(dtype_in(equation))
        name = {"f": floats, "i": integers, "b": booleans}[node_dtype]
        if name is None:
            raise UnsupportedError(f"{equation.primitive.name} of {dtype_in(equation)}")
        return t.ops(name, *arrays)

    return rule


PRIMITIVES["add"] = PRIMITIVES["add_any"] = _by_dtype("add", "iadd")  # add_any adds the terms of a gradient
PRIMITIVES["sub"] = _by_dtype("sub", "isub")
PRIMITIVES["mul"] = _by_dtype("mul", "imul")
PRIMITIVES["sqrt"] = _by_dtype("sqrt", None)
PRIMITIVES["floor"] = _by_dtype("floor", None)
PRIMITIVES["ceil"] = _by_dtype("ceil", None)
PRIMITIVES["and"] = _by_dtype(None, "iand", "and")
PRIMITIVES["or"] = _by_dtype(None, "ior", "or")
PRIMITIVES["xor"] = _by_dtype(None, "ixor", "xor")


@primitive("div", "rem")
def _divide(t: Tracer, equation: Any, a: Nodes, b: Nodes) -> Nodes:
    is_quotient, dtype = equation.primitive.name == "div", dtype_in(equation)
    if graph_dtype(dtype) == "f":
        return t.ops("div", a, b) if is_quotient else t.map(lambda x, y: elementary.remainder(t.graph, x, y), a, b)
    divide = elementary.whole_quotient if is_quotient else elementary.whole_remainder
    return t.map(lambda x, y: divide(t.graph, x, y, "int32" if is_signed(dtype) else "uint32"), a, b)


@primitive("neg")
def _neg(t: Tracer, equation: Any, x: Nodes) -> Nodes:
    return t.ops("neg", x) if graph_dtype(dtype_in(equation)) == "f" else t.ops("isub", t.constants(np.int32(0)), x)


@primitive("abs")
def _abs(t: Tracer, equation: Any, x: Nodes) -> Nodes:
    if graph_dtype(dtype_in(equation)) == "f":
        return t.ops("abs", x)
    return t.map(
        lambda n: t.graph.op("iselect", t.graph.op("slt", n, t.graph.i(0)), t.graph.op("isub", t.graph.i(0), n), n), x
    )


@primitive("sign")
def _sign(t: Tracer, equation: Any, x: Nodes) -> Nodes:
    g = t.graph
    if graph_dtype(dtype_in(equation)) == "i":
        zero, is_other = t.constants(np.int32(0)), "slt" if is_signed(dtype_in(equation)) else "ult"
        above, below = t.ops(is_other, zero, x), t.ops(is_other, x, zero)
        return t.ops("isub", t.ops("int_of_bool", above), t.ops("int_of_bool", below))
    if graph_dtype(dtype_in(equation)) != "f":
        raise UnsupportedError(f"sign of {dtype_in(equation)}")

    def sign(n: int) -> int:
        negative = g.op("select", g.op("lt", n, g.f(0.0)), g.f(-1.0), n)  # a zero or NaN is its own sign
        return g.op("select", g.op("lt", g.f(0.0), n), g.f(1.0), negative)

    return t.map(sign, x)


@primitive("population_count", "clz")
def _count(t: Tracer, equation: Any, x: Nodes) -> Nodes:
    """Number of bits that are 1, or of leading bits that are 0."""
    dtype, counts_ones = dtype_in(equation), equation.primitive.name == "population_count"
    x = t.wrapped(x, dtype.replace("int", "uint") if is_signed(dtype) else dtype) if bits_of(dtype) < 32 else x
    if counts_ones:
        return t.ops("popcount", x)
    for by in (1, 2, 4, 8, 16):  # ones from the first one on
        x = t.ops("ior", x, t.ops("lshr", x, t.constants(np.int32(by))))
    return t.ops("isub", t.constants(np.int32(bits_of(dtype))), t.ops("popcount", x))


@primitive("square")
def _square(t: Tracer, equation: Any, x: Nodes) -> Nodes:
    return t.ops("mul" if graph_dtype(dtype_in(equation)) == "f" else "imul", x, x)


@primitive("integer_pow")
def _integer_pow(t: Tracer, equation: Any, x: Nodes) -> Nodes:
    exponent = equation.params["y"]
    if graph_dtype(dtype_in(equation)) == "f":
        return t.map(lambda n: elementary.whole_power(t.graph, n, exponent), x)
    power, square = t.constants(np.ones(x.shape, np.int32)), x
    while exponent:
        power = t.ops("imul", power, square) if exponent & 1 else power
        square, exponent = t.ops("imul", square, square), exponent >> 1
    return power


@primitive("round")
def _round(t: Tracer, equation: Any, x: Nodes) -> Nodes:
    if equation.params["rounding_method"] == lax.RoundingMethod.TO_NEAREST_EVEN:
        return t.ops("round", x)
    return t.map(lambda n: elementary.round_half_away(t.graph, n), x)


def _elementary(function: Callable[..., int]) -> PrimitiveRule:
    """Rule that applies a function of `elementary.py` to float32 nodes."""

    def rule(t: Tracer, equation: Any, *arrays: Nodes) -> Nodes:
        if any(str(variable.aval.dtype) != "float32" for variable in equation.invars):
            raise UnsupportedError(f"{equation.primitive.name} of {[str(v.aval.dtype) for v in equation.invars]}")
        return t.map(lambda *nodes: function(t.graph, *nodes), *arrays)

    return rule


for _name in ("sin", "cos", "tan", "asin", "acos", "atan", "atan2", "exp", "exp2", "expm1", "log", "log1p", "tanh",
              "logistic", "rsqrt", "erf_inv"):  # fmt: skip
    PRIMITIVES[_name] = _elementary(getattr(elementary, _name))


@primitive("pow")
def _pow(t: Tracer, equation: Any, x: Nodes, exponent: Nodes) -> Nodes:
    """A whole exponent is converted, as XLA does."""
    base, power = (str(variable.aval.dtype) for variable in equation.invars)
    if base != "float32" or power not in ("float32", "int32"):
        raise UnsupportedError(f"pow of {[base, power]}")
    return t.map(lambda *nodes: elementary.pow(t.graph, *nodes), x, to_float(t, power, exponent))


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
