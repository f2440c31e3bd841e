"""Remainders of floats and quotients and remainders of integers, built from the graph's operations."""

from __future__ import annotations

import math

from workers.simd.graph.elementary import with_sign_of
from workers.simd.graph.graph import Graph

QUOTIENT_LIMIT = 2.0**48
"""Greatest |x / y| for which `remainder` gives a number; it gives NaN for greater ones."""
DIVISOR_LIMIT = 1e-30
"""Least |y| for which `remainder` gives a number, so that no intermediate remainder is a denormal number; it gives NaN
for smaller ones."""


def remainder(g: Graph, x: int, y: int) -> int:
    """Remainder of x / y with the sign of x, with the same bits as C's fmod; it is x where |x| < |y|.

    The result is NaN where that of fmod is (y = 0 or an infinite x), and otherwise where |x / y| > 2^48 or |y| < 1e-30.
    """
    rest = size = g.op("abs", x)
    step = g.op("abs", y)
    # The difference between a number and a rounded quotient times the divisor is a float, so each trip is exact. After
    # the first trip at most the greater of 2^-24 |x| and 3/4 |y| remains, and after the second at most 3/4 |y|, with
    # either sign.
    for _ in range(2):
        times = g.op("round", g.op("div", rest, step))
        rest = g.op("fma", g.op("neg", times), step, rest)
    rest = g.op("select", g.op("lt", rest, g.f(0.0)), g.op("add", rest, step), rest)
    few = g.op("le", size, g.op("mul", step, g.f(QUOTIENT_LIMIT)))
    rest = g.op("select", g.op("and", few, g.op("le", g.f(DIVISOR_LIMIT), step)), rest, g.f(math.nan))
    return with_sign_of(g, g.op("select", g.op("lt", size, step), size, rest), x)


def whole_quotient(g: Graph, a: int, b: int, dtype: str) -> int:
    """Quotient a / b of integers, rounded towards zero as in JAX.

    a / 0 has all bits set, and the least integer divided by -1 is itself.
    """
    quotient = g.op("sdiv" if dtype == "int32" else "udiv", a, _safe_divisor(g, a, b, dtype))
    return quotient if _is_constant_but_zero(g, b) else g.op("iselect", g.op("ieq", b, g.i(0)), g.i(-1), quotient)


def whole_remainder(g: Graph, a: int, b: int, dtype: str) -> int:
    """Remainder a - b * (a / b) of integers, with the quotient rounded towards zero; it is a where b is 0."""
    rest = g.op("srem" if dtype == "int32" else "urem", a, _safe_divisor(g, a, b, dtype))
    return rest if _is_constant_but_zero(g, b) else g.op("iselect", g.op("ieq", b, g.i(0)), a, rest)


def _is_constant_but_zero(g: Graph, node: int) -> bool:
    value = g.constant(node)
    return value is not None and value != 0


def _safe_divisor(g: Graph, a: int, b: int, dtype: str) -> int:
    """The divisor b, replaced by 1 where the processor would raise an exception.

    That is where b is 0, and where the least integer is divided by -1; dividing it by 1 gives the same result.
    """
    if _is_constant_but_zero(g, b) and (dtype != "int32" or g.constant(b) != -1):
        return b
    stops = g.op("ieq", b, g.i(0))
    if dtype == "int32":
        overflows = g.op("and", g.op("ieq", a, g.i(-(2**31))), g.op("ieq", b, g.i(-1)))
        stops = g.op("or", stops, overflows)
    return g.op("iselect", stops, g.i(1), b)
