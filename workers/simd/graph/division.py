"""Remainders of floats, quotients and remainders of integers, made of the graph's operations."""

from __future__ import annotations

import math

from workers.simd.graph.elementary import with_sign_of
from workers.simd.graph.graph import Graph

QUOTIENT_LIMIT = 2.0**48
"""Of |x / y| in `remainder`; beyond it, it is NaN."""
DIVISOR_LIMIT = 1e-30
"""Of |y| in `remainder`, so that no remainder on the way is a denormal number; NaN for less."""


def remainder(g: Graph, x: int, y: int) -> int:
    """x less as many whole y as fit, with the sign of x: C's fmod, to the bit. x where |x| < |y|.

    NaN where fmod is, for y = 0 or an infinite x, and where |x / y| > 2^48 or |y| < 1e-30 otherwise.
    """
    rest = size = g.op("abs", x)
    step = g.op("abs", y)
    # What a rounded quotient leaves of a number is a float, so each trip is exact. The first leaves at most 2^-24 of x
    # or 3/4 of y, whichever is more, and so the second at most 3/4 of y, above zero or below.
    for _ in range(2):
        times = g.op("round", g.op("div", rest, step))
        rest = g.op("fma", g.op("neg", times), step, rest)
    rest = g.op("select", g.op("lt", rest, g.f(0.0)), g.op("add", rest, step), rest)
    few = g.op("le", size, g.op("mul", step, g.f(QUOTIENT_LIMIT)))
    rest = g.op("select", g.op("and", few, g.op("le", g.f(DIVISOR_LIMIT), step)), rest, g.f(math.nan))
    return with_sign_of(g, g.op("select", g.op("lt", size, step), size, rest), x)


def whole_quotient(g: Graph, a: int, b: int, dtype: str) -> int:
    """a / b of integers, rounded towards zero as in JAX: a / 0 has all bits set, the least integer / -1 is itself."""
    found = g.op("sdiv" if dtype == "int32" else "udiv", a, _safe_divisor(g, a, b, dtype))
    return found if _is_constant_but_zero(g, b) else g.op("iselect", g.op("ieq", b, g.i(0)), g.i(-1), found)


def whole_remainder(g: Graph, a: int, b: int, dtype: str) -> int:
    """What `whole_quotient` leaves of a; all of it where b is 0."""
    found = g.op("srem" if dtype == "int32" else "urem", a, _safe_divisor(g, a, b, dtype))
    return found if _is_constant_but_zero(g, b) else g.op("iselect", g.op("ieq", b, g.i(0)), a, found)


def _is_constant_but_zero(g: Graph, node: int) -> bool:
    value = g.constant(node)
    return value is not None and value != 0


def _safe_divisor(g: Graph, a: int, b: int, dtype: str) -> int:
    """b, but 1 where processors would stop: for 0, and for the least integer by -1, which 1 divides alike."""
    if _is_constant_but_zero(g, b) and (dtype != "int32" or g.constant(b) != -1):
        return b
    stops = g.op("ieq", b, g.i(0))
    if dtype == "int32":
        overflows = g.op("and", g.op("ieq", a, g.i(-(2**31))), g.op("ieq", b, g.i(-1)))
        stops = g.op("or", stops, overflows)
    return g.op("iselect", stops, g.i(1), b)
