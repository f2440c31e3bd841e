"""Elementary functions made of the graph's operations, so that their bits depend on no library and no machine.

Polynomials are weighted minimax fits, rounded to float32. Errors are in units in the last place (ulp) against float64,
and tests hold each function to what its docstring says. NaN gives NaN. Denormal numbers are zeros, in and out.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from workers.simd.graph.graph import Graph

SIN = (-0.16666655242443085, 0.008332177996635437, -0.0001951729936990887)
"""(sin x - x) / x^3 in x^2, |x| <= pi/4."""
COS = (0.04166664555668831, -0.001388736767694354, 2.4438451873720624e-05)
"""(cos x - 1 + x^2 / 2) / x^4 in x^2, |x| <= pi/4."""
ATAN = (-0.33333152532577515, 0.19993773102760315, -0.14211055636405945, 0.10666004568338394, -0.07552213966846466,
        0.04321185126900673, -0.016367923468351364, 0.0029206909239292145)  # fmt: skip
"""(atan x - x) / x^3 in x^2, |x| <= 1."""
ASIN = (0.16666753590106964, 0.07495241612195969, 0.04547709971666336, 0.024147599935531616, 0.042218565940856934)
"""(asin x - x) / x^3 in x^2, |x| <= 1/2."""
EXPM1 = (0.5, 0.1666654348373413, 0.04166628047823906, 0.00836657639592886, 0.0013946436811238527)
"""(e^x - 1 - x) / x^2 in x, |x| <= log(2) / 2."""
LOG1P = (0.3333333134651184, -0.2500081956386566, 0.20001226663589478, -0.16623356938362122, 0.14201757311820984,
         -0.13160182535648346, 0.1276157647371292, -0.07634496688842773)  # fmt: skip
"""(log(1 + x) - x + x^2 / 2) / x^3 in x, sqrt(1/2) <= 1 + x <= sqrt(2)."""
TANH = ((1.0, 0.13383980095386505, 0.0034989959094673395, 2.066126216959674e-05, 1.3419821698335e-08),
        (1.0, 0.4671730101108551, 0.025890206918120384, 0.00032910381560213864, 7.804729307281377e-07))  # fmt: skip
"""(tanh x) / x as a fraction in x^2, |x| <= 9, beyond which tanh is 1 but for a last bit."""
ROUNDER = 1.5 * 2**23
"""x + ROUNDER - ROUNDER is x rounded to a whole number, and the lowest bits of x + ROUNDER are that number."""
HALF_PI = (1.5707963705062866, -4.371139000186241e-08, -1.7151245100058784e-15)
"""pi / 2 as a sum of floats."""
LOG_2 = (0.693359375, -0.00021219444170128554)
"""log 2 as a sum of floats, the first of few bits."""
ANGLE_LIMIT = 1e6
"""Of sin, cos and tan; beyond it they are NaN."""


def _horner(g: Graph, x: int, coefficients: Sequence[float]) -> int:
    total = g.f(coefficients[-1])
    for coefficient in reversed(coefficients[:-1]):
        total = g.op("fma", total, x, g.f(coefficient))
    return total


def _clipped(g: Graph, x: int, most: float) -> int:
    """x between -most and most; NaN stays."""
    x = g.op("select", g.op("lt", g.f(most), x), g.f(most), x)
    return g.op("select", g.op("lt", x, g.f(-most)), g.f(-most), x)


def with_sign_of(g: Graph, size: int, sign: int) -> int:
    """|size| with the sign bit of another."""
    magnitude = g.op("iand", g.op("bits", size), g.i(0x7FFFFFFF))
    return g.op("unbits", g.op("ior", magnitude, g.op("iand", g.op("bits", sign), g.i(0x80000000))))


def _nan_where_nan(g: Graph, x: int, y: int) -> int:
    return g.op("select", g.op("ne", x, x), x, y)


def _quarter_turn(g: Graph, x: int) -> tuple[int, int, int]:
    """(sine, cosine) of what is left of x after whole quarter turns, and an integer whose low bits count those."""
    turns = g.op("fma", x, g.f(2.0 / math.pi), g.f(ROUNDER))
    whole = g.op("neg", g.op("sub", turns, g.f(ROUNDER)))
    rest = x
    for part in HALF_PI:
        rest = g.op("fma", whole, g.f(part), rest)
    rest = g.op("select", g.op("le", g.op("abs", x), g.f(ANGLE_LIMIT)), rest, g.f(math.nan))
    square = g.op("mul", rest, rest)
    sine = g.op("fma", g.op("mul", rest, square), _horner(g, square, SIN), rest)
    cosine = g.op("fma", square, g.op("fma", square, _horner(g, square, COS), g.f(-0.5)), g.f(1.0))
    return sine, cosine, g.op("bits", turns)


def _turned(g: Graph, even: int, odd: int, quarters: int, sign_from: int) -> int:
    """`even` or `odd`, as the quarters are; negative where the second bit of `sign_from` is set."""
    is_even = g.op("ieq", g.op("iand", quarters, g.i(1)), g.i(0))
    chosen = g.op("select", is_even, even, odd)
    sign = g.op("shl", g.op("iand", sign_from, g.i(2)), g.i(30))
    return g.op("unbits", g.op("ixor", g.op("bits", chosen), sign))


def sin(g: Graph, x: int) -> int:
    """Within 2 ulp, or 1e-7 near zeros, for |x| <= 100; an absolute error of 1e-7 up to 10^5. NaN beyond 10^6."""
    sine, cosine, quarters = _quarter_turn(g, x)
    return _turned(g, sine, cosine, quarters, quarters)


def cos(g: Graph, x: int) -> int:
    """As sin."""
    sine, cosine, quarters = _quarter_turn(g, x)
    return _turned(g, cosine, sine, quarters, g.op("iadd", quarters, g.i(1)))


def tan(g: Graph, x: int) -> int:
    """sin / cos: within 5 ulp for |x| <= 100."""
    return g.op("div", sin(g, x), cos(g, x))


def atan2(g: Graph, y: int, x: int) -> int:
    """Within 3 ulp. Zeros and infinities have signs and quadrants as in IEEE 754."""
    size_x, size_y = g.op("abs", x), g.op("abs", y)
    steep = g.op("lt", size_x, size_y)
    less, more = g.op("select", steep, size_x, size_y), g.op("select", steep, size_y, size_x)
    ratio = g.op("div", less, g.op("select", g.op("eq", more, g.f(0.0)), g.f(1.0), more))
    ratio = g.op("select", g.op("eq", less, g.f(math.inf)), g.f(1.0), ratio)
    square = g.op("mul", ratio, ratio)
    angle = g.op("fma", g.op("mul", ratio, square), _horner(g, square, ATAN), ratio)
    angle = g.op("select", steep, g.op("sub", g.f(math.pi / 2), angle), angle)
    leftward = g.op("slt", g.op("bits", x), g.i(0))
    angle = g.op("select", leftward, g.op("sub", g.f(math.pi), angle), angle)
    angle = with_sign_of(g, angle, y)
    return _nan_where_nan(g, x, _nan_where_nan(g, y, angle))


def atan(g: Graph, x: int) -> int:
    """Within 3 ulp."""
    return atan2(g, x, g.f(1.0))


def _asin_parts(g: Graph, x: int) -> tuple[int, int, int]:
    """(whether |x| > 1/2, asin of the small argument, |x|): sqrt((1 - |x|) / 2) takes the place of a great |x|."""
    size = g.op("abs", x)
    great = g.op("lt", g.f(0.5), size)
    half_rest = g.op("fma", size, g.f(-0.5), g.f(0.5))
    square = g.op("select", great, half_rest, g.op("mul", size, size))
    root = g.op("select", great, g.op("sqrt", half_rest), size)
    return great, g.op("fma", g.op("mul", root, square), _horner(g, square, ASIN), root), size


def asin(g: Graph, x: int) -> int:
    """Within 3 ulp; NaN beyond [-1, 1]."""
    great, small, _ = _asin_parts(g, x)
    angle = g.op("select", great, g.op("fma", g.f(-2.0), small, g.f(math.pi / 2)), small)
    return _nan_where_nan(g, angle, with_sign_of(g, angle, x))


def acos(g: Graph, x: int) -> int:
    """Within 3 ulp; NaN beyond [-1, 1]."""
    great, small, _ = _asin_parts(g, x)
    double = g.op("add", small, small)
    negative = g.op("lt", x, g.f(0.0))
    for_great = g.op("select", negative, g.op("sub", g.f(math.pi), double), double)
    signed = g.op("select", negative, g.op("neg", small), small)
    return g.op("select", great, for_great, g.op("sub", g.f(math.pi / 2), signed))


def _exp_parts(g: Graph, x: int) -> tuple[int, int]:
    """(e^rest - 1, an integer whose low bits are k), where x = k log 2 + rest."""
    powers = g.op("fma", x, g.f(1.0 / math.log(2.0)), g.f(ROUNDER))
    whole = g.op("neg", g.op("sub", powers, g.f(ROUNDER)))
    rest = g.op("fma", whole, g.f(LOG_2[1]), g.op("fma", whole, g.f(LOG_2[0]), x))
    return g.op("fma", g.op("mul", rest, rest), _horner(g, rest, EXPM1), rest), g.op("bits", powers)


def _times_half_power(g: Graph, x: int, powers: int) -> int:
    """x 2^(k - 1), for k from -125 to 128 and x near 1; 1/2 spares the greatest powers from overflow."""
    return g.op("unbits", g.op("iadd", g.op("bits", x), g.op("shl", g.op("isub", powers, g.i(1)), g.i(23))))


def exp(g: Graph, x: int) -> int:
    """Within 2 ulp; infinite from 88.7228 on, 0 below -86.6."""
    less_one, powers = _exp_parts(g, x)
    half = _times_half_power(g, g.op("add", less_one, g.f(1.0)), powers)
    return _within_range(g, x, g.op("add", half, half), g.f(0.0))


def expm1(g: Graph, x: int) -> int:
    """Within 3 ulp; infinite from 88.7228 on, -1 below -86.6."""
    less_one, powers = _exp_parts(g, x)
    half_power = _times_half_power(g, g.f(1.0), powers)
    half = g.op("fma", half_power, less_one, g.op("sub", half_power, g.f(0.5)))
    return _within_range(g, x, g.op("add", half, half), g.f(-1.0))


def _within_range(g: Graph, x: int, y: int, below: int) -> int:
    y = g.op("select", g.op("lt", x, g.f(-86.6)), below, y)
    y = g.op("select", g.op("lt", g.f(88.72283), x), g.f(math.inf), y)
    return _nan_where_nan(g, x, y)


def exp2(g: Graph, x: int) -> int:
    """2^x, within 2 ulp; infinite from 128 on, 0 below -125."""
    powers = g.op("add", x, g.f(ROUNDER))
    rest = g.op("mul", g.op("sub", x, g.op("sub", powers, g.f(ROUNDER))), g.f(math.log(2.0)))
    less_one = g.op("fma", g.op("mul", rest, rest), _horner(g, rest, EXPM1), rest)
    half = _times_half_power(g, g.op("add", less_one, g.f(1.0)), g.op("bits", powers))
    found = g.op("select", g.op("lt", x, g.f(-125.0)), g.f(0.0), g.op("add", half, half))
    found = g.op("select", g.op("le", g.f(128.0), x), g.f(math.inf), found)
    return _nan_where_nan(g, x, found)


def log(g: Graph, x: int) -> int:
    """Within 2 ulp; -inf at 0, NaN below."""
    bits = g.op("bits", x)
    power = g.op("ashr", g.op("isub", bits, g.i(0x3F3504F3)), g.i(23))  # 0x3F3504F3 are the bits of sqrt(1/2)
    mantissa = g.op("unbits", g.op("isub", bits, g.op("shl", power, g.i(23))))
    rest, k = g.op("sub", mantissa, g.f(1.0)), g.op("float_of_int", power)
    square = g.op("mul", rest, rest)
    curve = g.op("mul", g.op("mul", rest, square), _horner(g, rest, LOG1P))
    curve = g.op("fma", k, g.f(LOG_2[1]), curve)
    curve = g.op("fma", square, g.f(-0.5), curve)
    found = g.op("fma", k, g.f(LOG_2[0]), g.op("add", rest, curve))
    found = g.op("select", g.op("lt", x, g.f(math.inf)), found, x)  # infinity and NaN are their own logarithms
    found = g.op("select", g.op("lt", x, g.f(0.0)), g.f(math.nan), found)
    return g.op("select", g.op("lt", g.op("abs", x), g.f(1.1754944e-38)), g.f(-math.inf), found)


def log1p(g: Graph, x: int) -> int:
    """Within 3 ulp; -inf at -1, NaN below."""
    one_more = g.op("add", x, g.f(1.0))
    lost = g.op("sub", x, g.op("sub", one_more, g.f(1.0)))
    found = g.op("add", log(g, one_more), g.op("div", lost, one_more))
    found = g.op("select", g.op("lt", one_more, g.f(math.inf)), found, one_more)
    found = g.op("select", g.op("eq", one_more, g.f(0.0)), g.f(-math.inf), found)
    return g.op("select", g.op("lt", g.op("abs", x), g.f(1e-7)), x, found)


def tanh(g: Graph, x: int) -> int:
    """Within 6 ulp, half of them in the fraction's two roundings; never beyond 1. As good as XLA's, and cheap."""
    bounded = _clipped(g, x, 9.0)
    square = g.op("mul", bounded, bounded)
    above, below = (_horner(g, square, coefficients) for coefficients in TANH)
    return _clipped(g, g.op("div", g.op("mul", bounded, above), below), 1.0)


def logistic(g: Graph, x: int) -> int:
    """1 / (1 + e^-x), within 4 ulp; 0 below -88."""
    return g.op("div", g.f(1.0), g.op("add", exp(g, g.op("neg", x)), g.f(1.0)))


def rsqrt(g: Graph, x: int) -> int:
    """1 / sqrt(x), both rounded: within 2 ulp."""
    return g.op("div", g.f(1.0), g.op("sqrt", x))


def whole_power(g: Graph, x: int, exponent: int) -> int:
    """x to a whole number, by squaring: within as many ulp as the exponent."""
    if exponent < 0:
        return g.op("div", g.f(1.0), whole_power(g, x, -exponent))
    found, square = g.f(1.0), x
    while exponent:
        if exponent & 1:
            found = g.op("mul", found, square)
        exponent >>= 1
        if exponent:
            square = g.op("mul", square, square)
    return found


def pow(g: Graph, x: int, y: int) -> int:
    """x^y. By squaring for a constant whole y up to 64 in size, sqrt for 1/2; else e^(y log x), within
    3 + 2 |y log x| ulp. NaN where x is negative, -inf too, unless y is whole, and infinities count as even; zeros count
    as +0."""
    exponent = g.constant(y)
    if exponent is not None and float(exponent).is_integer() and abs(exponent) <= 64:
        return whole_power(g, x, int(exponent))
    if exponent is not None and exponent == 0.5:
        return g.op("sqrt", x)
    size = exp(g, g.op("mul", y, log(g, g.op("abs", x))))
    size = g.op("select", g.op("eq", y, g.f(0.0)), g.f(1.0), size)
    size = g.op("select", g.op("eq", g.op("abs", x), g.f(1.0)), g.f(1.0), size)
    is_whole = g.op("eq", g.op("round", y), y)
    half = g.op("mul", y, g.f(0.5))
    is_odd = g.op("ne", g.op("round", half), half)
    signed = g.op("select", is_odd, g.op("neg", size), size)
    of_negative = g.op("select", is_whole, signed, g.f(math.nan))
    return g.op("select", g.op("lt", x, g.f(0.0)), of_negative, size)


def round_half_away(g: Graph, x: int) -> int:
    """The nearest whole number, halves away from zero. Exact."""
    size = g.op("abs", x)
    below = g.op("floor", size)
    goes_up = g.op("le", g.f(0.5), g.op("sub", size, below))
    return with_sign_of(g, g.op("select", goes_up, g.op("add", below, g.f(1.0)), below), x)


def int_of_float(g: Graph, x: int) -> int:
    """Rounded towards zero, as JAX: what does not fit becomes the nearest integer that does, NaN becomes 0."""
    fits = g.op("lt", g.op("abs", x), g.f(2.0**31))
    converted = g.op("int_of_float", g.op("select", fits, x, g.f(0.0)))
    great = g.op("iselect", g.op("lt", x, g.f(0.0)), g.i(-(2**31)), g.i(2**31 - 1))
    outside = g.op("iselect", g.op("ne", x, x), g.i(0), great)
    return g.op("iselect", fits, converted, outside)
