"""Rules of arithmetic and elementary functions, which work element by element."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from jax import lax

from workers.simd.frontend.dtypes import bits_of, dtype_in, graph_dtype, is_signed
from workers.simd.frontend.primitives.registry import PRIMITIVES, primitive
from workers.simd.frontend.tracer import Nodes, Rule, Tracer
from workers.simd.graph import division, elementary
from workers.simd.graph.unsupported import UnsupportedError


def _by_dtype(floats: str | None, integers: str | None, booleans: str | None = None) -> Rule:
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
        return t.ops("div", a, b) if is_quotient else t.map(lambda x, y: division.remainder(t.graph, x, y), a, b)
    divide = division.whole_quotient if is_quotient else division.whole_remainder
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


def _elementary(function: Callable[..., int]) -> Rule:
    """Rule that applies a function of `elementary.py` to float32 nodes."""

    def rule(t: Tracer, equation: Any, *arrays: Nodes) -> Nodes:
        if any(str(variable.aval.dtype) != "float32" for variable in equation.invars):
            raise UnsupportedError(f"{equation.primitive.name} of {[str(v.aval.dtype) for v in equation.invars]}")
        return t.map(lambda *nodes: function(t.graph, *nodes), *arrays)

    return rule


for _name in ("sin", "cos", "tan", "asin", "acos", "atan", "atan2", "exp", "exp2", "expm1", "log", "log1p", "tanh",
              "logistic", "rsqrt", "pow", "erf_inv"):  # fmt: skip
    PRIMITIVES[_name] = _elementary(getattr(elementary, _name))
