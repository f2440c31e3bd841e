"""Elementary functions, remainders and whole quotients built from the graph's operations, so that their bits depend on
no library and no machine.

The polynomials are weighted minimax fits whose coefficients are rounded to float32. Errors are stated in units in the
last place (ulp) relative to float64, and tests check the statement of each docstring. NaN gives NaN. Denormal arguments
and results count as zero.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from workers.simd.graph.graph import Graph

SIN = (-0.16666655242443085, 0.008332177996635437, -0.0001951729936990887)
"""Coefficients of (sin x - x) / x^3 as a polynomial in x^2, for |x| <= pi/4."""
COS = (0.04166664555668831, -0.001388736767694354, 2.4438451873720624e-05)
"""Coefficients of (cos x - 1 + x^2 / 2) / x^4 as a polynomial in x^2, for |x| <= pi/4."""
ATAN = (-0.33333152532577515, 0.19993773102760315, -0.14211055636405945, 0.10666004568338394, -0.07552213966846466,
        0.04321185126900673, -0.016367923468351364, 0.0029206909239292145)  # fmt: skip
"""Coefficients of (atan x - x) / x^3 as a polynomial in x^2, for |x| <= 1."""
ASIN = (0.16666753590106964, 0.07495241612195969, 0.04547709971666336, 0.024147599935531616, 0.042218565940856934)
"""Coefficients of (asin x - x) / x^3 as a polynomial in x^2, for |x| <= 1/2."""
EXPM1 = (0.5, 0.1666654348373413, 0.04166628047823906, 0.00836657639592886, 0.0013946436811238527)
"""Coefficients of (e^x - 1 - x) / x^2 as a polynomial in x, for |x| <= log(2) / 2."""
LOG1P = (0.3333333134651184, -0.2500081956386566, 0.20001226663589478, -0.16623356938362122, 0.14201757311820984,
         -0.13160182535648346, 0.1276157647371292, -0.07634496688842773)  # fmt: skip
"""Coefficients of (log(1 + x) - x + x^2 / 2) / x^3 as a polynomial in x, for sqrt(1/2) <= 1 + x <= sqrt(2)."""
TANH = ((1.0, 0.13383980095386505, 0.0034989959094673395, 2.066126216959674e-05, 1.3419821698335e-08),
        (1.0, 0.4671730101108551, 0.025890206918120384, 0.00032910381560213864, 7.804729307281377e-07))  # fmt: skip
"""Coefficients (numerator, denominator) of (tanh x) / x as a rational function of x^2, for |x| <= 9.

For greater |x|, |tanh x| differs from 1 by at most the last bit.
"""
LOG = (3.3333331174e-1, -2.4999993993e-1, 2.0000714765e-1, -1.6668057665e-1, 1.4249322787e-1, -1.2420140846e-1,
       1.1676998740e-1, -1.1514610310e-1, 7.0376836292e-2)  # fmt: skip
"""As LOG1P, but of Cephes (S. Moshier, 1989), whose logarithms XLA computes; for `erf_inv`."""
LOG1P_RATIO = ((2.0039553499201281e1, 5.7112963590585538e1, 6.0949667980987788e1, 2.9911919328553073e1,
                6.5787325942061045, 4.9854102823193376e-1, 4.5270000862445200e-5),
               (6.0118660497603844e1, 2.1642788614495948e2, 3.0909872225312060e2, 2.2176239823732856e2,
                8.3047565967967210e1, 1.5062909083469192e1, 1.0))  # fmt: skip
"""As LOG, as a rational function (numerator, denominator), for |x| < sqrt(2) - 1."""
ERF_INV = ((1.50140941, 0.246640727, -0.00417768164, -0.00125372503, 0.00021858087, -4.39150654e-06, -3.5233877e-06,
            3.43273939e-07, 2.81022636e-08),
           (2.83297682, 1.00167406, 0.00943887047, -0.0076224613, 0.00573950773, -0.00367342844, 0.00134934322,
            0.000100950558, -0.000200214257))  # fmt: skip
"""Coefficients of (inverse of erf) / x as polynomials in w - 5/2, for w = -log(1 - x^2) < 5, and in sqrt(w) - 3.

M. Giles, Approximating the erfinv function, GPU Computing Gems 2 (2011); XLA has the same.
"""
ROUNDER = 1.5 * 2**23
"""Number whose addition rounds to integers.

x + ROUNDER - ROUNDER is x rounded to a whole number, and the lowest bits of x + ROUNDER are that number.
"""
HALF_PI = (1.5707963705062866, -4.371139000186241e-08, -1.7151245100058784e-15)
"""Floats whose sum is pi / 2."""
LOG_2 = (0.693359375, -0.00021219444170128554)
"""Floats whose sum is log 2; the first has few significant bits."""
ANGLE_LIMIT = 1e6
"""Greatest |x| for which sin, cos and tan give numbers; they give NaN for greater ones."""


def _horner(g: Graph, x: int, coefficients: Sequence[float]) -> int:
    """Value at x of the polynomial with these coefficients, the constant first."""
    total = g.f(coefficients[-1])
    for coefficient in reversed(coefficients[:-1]):
        total = g.op("fma", total, x, g.f(coefficient))
    return total


def _clipped(g: Graph, x: int, most: float) -> int:
    """x clipped to [-most, most]; NaN stays NaN."""
    x = g.op("select", g.op("lt", g.f(most), x), g.f(most), x)
    return g.op("select", g.op("lt", x, g.f(-most)), g.f(-most), x)


def with_sign_of(g: Graph, size: int, sign: int) -> int:
    """|size| with the sign bit of `sign`."""
    magnitude = g.op("iand", g.op("bits", size), g.i(0x7FFFFFFF))
    return g.op("unbits", g.op("ior", magnitude, g.op("iand", g.op("bits", sign), g.i(0x80000000))))


def _nan_where_nan(g: Graph, x: int, y: int) -> int:
    return g.op("select", g.op("ne", x, x), x, y)


def _quarter_turn(g: Graph, x: int) -> tuple[int, int, int]:
    """(sine, cosine, turns) of x reduced by whole quarter turns; the low bits of `turns` count the quarter turns."""
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
    """`even` or `odd` by the parity of `quarters`; the sign is flipped where the second bit of `sign_from` is set."""
    is_even = g.op("ieq", g.op("iand", quarters, g.i(1)), g.i(0))
    chosen = g.op("select", is_even, even, odd)
    sign = g.op("shl", g.op("iand", sign_from, g.i(2)), g.i(30))
    return g.op("unbits", g.op("ixor", g.op("bits", chosen), sign))


def sin(g: Graph, x: int) -> int:
    """Sine of x.

    For |x| <= 100 the error is within 2 ulp, or 1e-7 near the zeros; up to 10^5 the absolute error is within 1e-7.
    Beyond 10^6 the result is NaN.
    """
    sine, cosine, quarters = _quarter_turn(g, x)
    return _turned(g, sine, cosine, quarters, quarters)


def cos(g: Graph, x: int) -> int:
    """Cosine of x, with the errors and limits of `sin`."""
    sine, cosine, quarters = _quarter_turn(g, x)
    return _turned(g, cosine, sine, quarters, g.op("iadd", quarters, g.i(1)))


def tan(g: Graph, x: int) -> int:
    """Tangent of x as sin x / cos x, within 5 ulp for |x| <= 100."""
    return g.op("div", sin(g, x), cos(g, x))


def atan2(g: Graph, y: int, x: int) -> int:
    """Angle of the point (x, y), within 3 ulp. Zeros and infinities have the signs and quadrants of IEEE 754."""
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
    """Arc tangent of x, within 3 ulp."""
    return atan2(g, x, g.f(1.0))


def _asin_parts(g: Graph, x: int) -> tuple[int, int, int]:
    """(whether |x| > 1/2, arc sine of the reduced argument, |x|).

    The reduced argument is |x| itself, or sqrt((1 - |x|) / 2) where |x| > 1/2.
    """
    size = g.op("abs", x)
    great = g.op("lt", g.f(0.5), size)
    half_rest = g.op("fma", size, g.f(-0.5), g.f(0.5))
    square = g.op("select", great, half_rest, g.op("mul", size, size))
    root = g.op("select", great, g.op("sqrt", half_rest), size)
    return great, g.op("fma", g.op("mul", root, square), _horner(g, square, ASIN), root), size


def asin(g: Graph, x: int) -> int:
    """Arc sine of x, within 3 ulp; NaN outside [-1, 1]."""
    great, small, _ = _asin_parts(g, x)
    angle = g.op("select", great, g.op("fma", g.f(-2.0), small, g.f(math.pi / 2)), small)
    return _nan_where_nan(g, angle, with_sign_of(g, angle, x))


def acos(g: Graph, x: int) -> int:
    """Arc cosine of x, within 3 ulp; NaN outside [-1, 1]."""
    great, small, _ = _asin_parts(g, x)
    double = g.op("add", small, small)
    negative = g.op("lt", x, g.f(0.0))
    for_great = g.op("select", negative, g.op("sub", g.f(math.pi), double), double)
    signed = g.op("select", negative, g.op("neg", small), small)
    return g.op("select", great, for_great, g.op("sub", g.f(math.pi / 2), signed))


def _exp_parts(g: Graph, x: int) -> tuple[int, int]:
    """(e^rest - 1, an integer whose low bits are k) for the decomposition x = k log 2 + rest."""
    powers = g.op("fma", x, g.f(1.0 / math.log(2.0)), g.f(ROUNDER))
    whole = g.op("neg", g.op("sub", powers, g.f(ROUNDER)))
    rest = g.op("fma", whole, g.f(LOG_2[1]), g.op("fma", whole, g.f(LOG_2[0]), x))
    return g.op("fma", g.op("mul", rest, rest), _horner(g, rest, EXPM1), rest), g.op("bits", powers)


def _times_half_power(g: Graph, x: int, powers: int) -> int:
    """x 2^(k - 1), for k from -125 to 128 and x near 1. The factor 1/2 keeps the greatest powers from overflowing."""
    return g.op("unbits", g.op("iadd", g.op("bits", x), g.op("shl", g.op("isub", powers, g.i(1)), g.i(23))))


def exp(g: Graph, x: int) -> int:
    """e^x, within 2 ulp; infinite from 88.7228 on, 0 below -86.6."""
    less_one, powers = _exp_parts(g, x)
    half = _times_half_power(g, g.op("add", less_one, g.f(1.0)), powers)
    return _within_range(g, x, g.op("add", half, half), g.f(0.0))


def expm1(g: Graph, x: int) -> int:
    """e^x - 1, within 3 ulp; infinite from 88.7228 on, -1 below -86.6."""
    less_one, powers = _exp_parts(g, x)
    half_power = _times_half_power(g, g.f(1.0), powers)
    half = g.op("fma", half_power, less_one, g.op("sub", half_power, g.f(0.5)))
    return _within_range(g, x, g.op("add", half, half), g.f(-1.0))


def _within_range(g: Graph, x: int, y: int, below: int) -> int:
    """y, replaced by `below` for x < -86.6, by infinity where e^x overflows, and by NaN where x is NaN."""
    y = g.op("select", g.op("lt", x, g.f(-86.6)), below, y)
    y = g.op("select", g.op("lt", g.f(88.72283), x), g.f(math.inf), y)
    return _nan_where_nan(g, x, y)


def exp2(g: Graph, x: int) -> int:
    """2^x, within 2 ulp; infinite from 128 on, 0 below -125."""
    powers = g.op("add", x, g.f(ROUNDER))
    rest = g.op("mul", g.op("sub", x, g.op("sub", powers, g.f(ROUNDER))), g.f(math.log(2.0)))
    less_one = g.op("fma", g.op("mul", rest, rest), _horner(g, rest, EXPM1), rest)
    half = _times_half_power(g, g.op("add", less_one, g.f(1.0)), g.op("bits", powers))
    exponential = g.op("select", g.op("lt", x, g.f(-125.0)), g.f(0.0), g.op("add", half, half))
    exponential = g.op("select", g.op("le", g.f(128.0), x), g.f(math.inf), exponential)
    return _nan_where_nan(g, x, exponential)


def _mantissa_and_power(g: Graph, x: int) -> tuple[int, int]:
    """(rest, k) with x = (1 + rest) 2^k, where 1 + rest is from sqrt(1/2) to sqrt(2)."""
    bits = g.op("bits", x)
    power = g.op("ashr", g.op("isub", bits, g.i(0x3F3504F3)), g.i(23))  # 0x3F3504F3 are the bits of sqrt(1/2)
    mantissa = g.op("unbits", g.op("isub", bits, g.op("shl", power, g.i(23))))
    return g.op("sub", mantissa, g.f(1.0)), g.op("float_of_int", power)


def log(g: Graph, x: int) -> int:
    """Natural logarithm of x, within 2 ulp; -inf at 0, NaN below."""
    rest, k = _mantissa_and_power(g, x)
    square = g.op("mul", rest, rest)
    curve = g.op("mul", g.op("mul", rest, square), _horner(g, rest, LOG1P))
    curve = g.op("fma", k, g.f(LOG_2[1]), curve)
    curve = g.op("fma", square, g.f(-0.5), curve)
    logarithm = g.op("fma", k, g.f(LOG_2[0]), g.op("add", rest, curve))
    logarithm = g.op("select", g.op("lt", x, g.f(math.inf)), logarithm, x)  # infinity and NaN are their own logarithms
    logarithm = g.op("select", g.op("lt", x, g.f(0.0)), g.f(math.nan), logarithm)
    return g.op("select", g.op("lt", g.op("abs", x), g.f(1.1754944e-38)), g.f(-math.inf), logarithm)


def log1p(g: Graph, x: int) -> int:
    """log(1 + x), within 3 ulp; -inf at -1, NaN below."""
    one_more = g.op("add", x, g.f(1.0))
    lost = g.op("sub", x, g.op("sub", one_more, g.f(1.0)))
    logarithm = g.op("add", log(g, one_more), g.op("div", lost, one_more))
    logarithm = g.op("select", g.op("lt", one_more, g.f(math.inf)), logarithm, one_more)
    logarithm = g.op("select", g.op("eq", one_more, g.f(0.0)), g.f(-math.inf), logarithm)
    return g.op("select", g.op("lt", g.op("abs", x), g.f(1e-7)), x, logarithm)


def _log1p_of_cephes(g: Graph, x: int) -> int:
    """log(1 + x) with the roundings of XLA's, which `erf_inv` shows near -1 and 1."""
    square = g.op("mul", x, x)
    above, below = (_horner(g, x, coefficients) for coefficients in LOG1P_RATIO)
    curve = g.op("mul", g.op("mul", x, square), g.op("div", above, below))
    near = g.op("add", x, g.op("fma", square, g.f(-0.5), curve))
    rest, k = _mantissa_and_power(g, g.op("add", x, g.f(1.0)))
    square = g.op("mul", rest, rest)
    cube = g.op("mul", square, rest)
    low, middle, high = (_horner(g, rest, LOG[start : start + 3]) for start in (0, 3, 6))
    curve = g.op("mul", g.op("fma", g.op("fma", high, cube, middle), cube, low), cube)
    curve = g.op("add", g.op("fma", square, g.f(-0.5), rest), g.op("fma", k, g.f(LOG_2[1]), curve))
    far = g.op("fma", k, g.f(LOG_2[0]), curve)
    return g.op("select", g.op("lt", g.op("abs", x), g.f(math.sqrt(2.0) - 1.0)), near, far)


def erf_inv(g: Graph, x: int) -> int:
    """The number whose erf is x, within 2 ulp of XLA's; infinite at -1 and 1, NaN beyond.

    The square is rounded, as in XLA: it is not fused with the difference from 1.
    """
    square = g.op("unbits", g.op("bits", g.op("mul", x, x)))
    w = g.op("neg", _log1p_of_cephes(g, g.op("neg", square)))
    is_central = g.op("lt", w, g.f(5.0))
    at = g.op("select", is_central, g.op("sub", w, g.f(2.5)), g.op("sub", g.op("sqrt", w), g.f(3.0)))
    total = g.f(0.0)
    for central, tail in zip(*map(reversed, ERF_INV), strict=True):
        total = g.op("fma", total, at, g.op("select", is_central, g.f(central), g.f(tail)))
    far = g.op("unbits", g.op("ior", g.i(0x7F800000), g.op("iand", g.op("bits", x), g.i(0x80000000))))
    inside = g.op("select", g.op("lt", g.op("abs", x), g.f(1.0)), g.op("mul", total, x), g.f(math.nan))
    return g.op("select", g.op("eq", g.op("abs", x), g.f(1.0)), far, inside)


def tanh(g: Graph, x: int) -> int:
    """Hyperbolic tangent of x, within 6 ulp and within [-1, 1].

    Half of the error comes from the two roundings of the fraction. It is as accurate as that of XLA, and cheap.
    """
    bounded = _clipped(g, x, 9.0)
    square = g.op("mul", bounded, bounded)
    above, below = (_horner(g, square, coefficients) for coefficients in TANH)
    return _clipped(g, g.op("div", g.op("mul", bounded, above), below), 1.0)


def logistic(g: Graph, x: int) -> int:
    """1 / (1 + e^-x), within 4 ulp; 0 below -88."""
    return g.op("div", g.f(1.0), g.op("add", exp(g, g.op("neg", x)), g.f(1.0)))


def rsqrt(g: Graph, x: int) -> int:
    """1 / sqrt(x), within 2 ulp: the root and the quotient are rounded separately."""
    return g.op("div", g.f(1.0), g.op("sqrt", x))


def whole_power(g: Graph, x: int, exponent: int) -> int:
    """x to a whole power, by squaring; the error in ulp is at most |exponent|."""
    if exponent < 0:
        return g.op("div", g.f(1.0), whole_power(g, x, -exponent))
    power, square = g.f(1.0), x
    while exponent:
        if exponent & 1:
            power = g.op("mul", power, square)
        exponent >>= 1
        if exponent:
            square = g.op("mul", square, square)
    return power


def pow(g: Graph, x: int, y: int) -> int:
    """x^y.

    A constant whole y with |y| <= 64 is computed by squaring, y = 1/2 by sqrt, and every other y as e^(y log x), within
    3 + 2 |y log x| ulp. The result is NaN where x is negative (-inf included) and y is not whole; an infinite y counts
    as even. A zero x counts as +0.
    """
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
    """Nearest whole number to x, exactly; halves are rounded away from zero."""
    size = g.op("abs", x)
    below = g.op("floor", size)
    goes_up = g.op("le", g.f(0.5), g.op("sub", size, below))
    return with_sign_of(g, g.op("select", goes_up, g.op("add", below, g.f(1.0)), below), x)


def int_of_float(g: Graph, x: int) -> int:
    """x converted to int32 as JAX does: rounded towards zero and clipped to the range of int32; NaN becomes 0."""
    fits = g.op("lt", g.op("abs", x), g.f(2.0**31))
    converted = g.op("int_of_float", g.op("select", fits, x, g.f(0.0)))
    great = g.op("iselect", g.op("lt", x, g.f(0.0)), g.i(-(2**31)), g.i(2**31 - 1))
    outside = g.op("iselect", g.op("ne", x, x), g.i(0), great)
    return g.op("iselect", fits, converted, outside)


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
