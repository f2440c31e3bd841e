"""A graph that simplifies while it is built: operations on constants become constants, and identities are applied.

With regard to NaN, infinities and signed zeros, there are three classes of identities:

* Exact for every value: x * 1, x / 1, x / 2^k = x * 2^-k, x - 0, x + (-0), -0 - x, -(-x), |-x|, ||x||,
  a + (-b) = a - b, a - (-b) = a + b, (-a) * b = -(a * b), (-a) * (-b) = a * b, a choice between equal nodes or by a
  constant, x < x (false for NaN as well), logic with constants.
* Exact except for the sign of a zero: x + 0 = x, x - (-0) = x, -(a - b) = b - a unless a and b are both products,
  (-a) - b = -(a + b), |sqrt x| = sqrt x. Only a division by that zero, atan2 (whose angle then differs by 2 pi) and
  operations on bits can show the difference.
* Exact for finite values except for the sign of a zero: x * 0 = 0. Brax's constant joint frames contain many such
  products; without this identity an ant has twice as many operations. Where a factor is infinite or NaN, JAX computes
  NaN and the graph 0. The factor keeps its value in every other expression; only what depends on this product alone
  differs. `is_finite` is computed, never assumed.

Not applied: 0 / x, x / x, x - x, x == x (all of them differ for NaN), reassociation, approximations.

A rule is f(graph, arguments, their values where constant) -> a simpler node with the same value, or None.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from workers.simd.graph.graph import Graph
from workers.simd.graph.operations import OPERATIONS, compute


class FoldingGraph(Graph):
    """A graph whose `op` may return a simpler node with the same value; tracing builds this graph."""

    def __init__(self, *, folds_zeros: bool = True) -> None:
        """`folds_zeros`: whether x * 0 is 0, which is the only rule that replaces what is not finite by a number."""
        super().__init__()
        self.folds_zeros = folds_zeros

    def build(self, name: str, arguments: tuple[int, ...]) -> int:
        """Node of an operation that does not exist yet, or of a constant or simpler operation with the same value."""
        values = [self.constant(a) for a in arguments]
        if values[0] is not None and all(value is not None for value in values):
            return self.const(OPERATIONS[name].gives, compute(name, values))
        rule = RULES.get(name)
        folded = rule(self, arguments, values) if rule else None
        return super().build(name, arguments) if folded is None else folded

    def negated(self, node: int) -> int | None:
        """The node whose negative this node is, or None if it is no negation."""
        key = self.keys[node]
        return key[1] if key[0] == "neg" else None


FoldingRule = Callable[[FoldingGraph, tuple[int, ...], list[Any]], int | None]


def _is(value: Any, number: float) -> bool:
    return value is not None and value == number


def _fold_add(g: FoldingGraph, args: tuple[int, ...], values: list[Any]) -> int | None:
    a, b = args
    for x, value in ((b, values[0]), (a, values[1])):
        if _is(value, 0.0):
            return x
    if (minus := g.negated(b)) is not None:
        return g.op("sub", a, minus)
    if (minus := g.negated(a)) is not None:
        return g.op("sub", b, minus)
    return None


def _fold_sub(g: FoldingGraph, args: tuple[int, ...], values: list[Any]) -> int | None:
    a, b = args
    if _is(values[1], 0.0):
        return a
    if _is(values[0], 0.0) and np.signbit(values[0]):
        return g.op("neg", b)
    if (minus := g.negated(b)) is not None:
        return g.op("add", a, minus)
    if (minus := g.negated(a)) is not None:
        return g.op("neg", g.op("add", minus, b))
    return None


def _fold_mul(g: FoldingGraph, args: tuple[int, ...], values: list[Any]) -> int | None:
    a, b = args
    for x, value in ((b, values[0]), (a, values[1])):
        if _is(value, 1.0):
            return x
        if _is(value, -1.0):
            return g.op("neg", x)
        if _is(value, 0.0) and g.folds_zeros:
            return g.f(0.0)
    minus_a, minus_b = g.negated(a), g.negated(b)
    if minus_a is not None and minus_b is not None:
        return g.op("mul", minus_a, minus_b)
    if minus_a is not None:
        return g.op("mul", minus_a, g.op("neg", b)) if values[1] is not None else g.op("neg", g.op("mul", minus_a, b))
    if minus_b is not None:
        return g.op("mul", minus_b, g.op("neg", a)) if values[0] is not None else g.op("neg", g.op("mul", a, minus_b))
    return None


def _fold_div(g: FoldingGraph, args: tuple[int, ...], values: list[Any]) -> int | None:
    a, _ = args
    if _is(values[1], 1.0):
        return a
    if values[1] is not None and np.isfinite(values[1]) and values[1] != 0.0:
        mantissa, exponent = np.frexp(abs(float(values[1])))
        if mantissa == 0.5 and abs(exponent) < 100:  # the reciprocal of a power of two is exact
            return g.op("mul", a, g.f(1.0 / float(values[1])))
    return None


def _fold_neg(g: FoldingGraph, args: tuple[int, ...], values: list[Any]) -> int | None:
    key = g.keys[args[0]]
    if key[0] == "neg":
        return key[1]
    if key[0] != "sub" or all(g.keys[argument][0] == "mul" for argument in key[1:]):
        return None  # a difference of two products is fused with the second, so p - q and q - p round differently
    return g.op("sub", key[2], key[1])


def _fold_abs(g: FoldingGraph, args: tuple[int, ...], values: list[Any]) -> int | None:
    key = g.keys[args[0]]
    if key[0] in ("abs", "sqrt"):
        return args[0]
    return g.op("abs", key[1]) if key[0] == "neg" else None


def _fold_less(g: FoldingGraph, args: tuple[int, ...], values: list[Any]) -> int | None:
    return g.const("b", False) if args[0] == args[1] else None


def _fold_signed_less(g: FoldingGraph, args: tuple[int, ...], values: list[Any]) -> int | None:
    key = g.keys[args[0]]
    if key[0] == "int_of_bool" and _is(values[1], 1):
        return g.op("xor", g.const("b", True), key[1])
    return _fold_less(g, args, values)


def _fold_select(g: FoldingGraph, args: tuple[int, ...], values: list[Any]) -> int | None:
    mask, a, b = args
    if a == b:
        return a
    if values[0] is not None:
        return a if values[0] else b
    key = g.keys[mask]
    for argument, other in ((key[1], key[2]), (key[2], key[1])) if key[0] == "xor" else ():
        if _is(g.constant(argument), True):  # the mask is the negation of `other`
            return g.choose(other, b, a)
    return g.op("and", mask, a) if g.dtypes[b] == "b" and values[2] is not None and not values[2] else None


def _fold_logic(neutral: bool, absorbing: bool) -> FoldingRule:
    def fold(g: FoldingGraph, args: tuple[int, ...], values: list[Any]) -> int | None:
        a, b = args
        for x, value in ((b, values[0]), (a, values[1])):
            if value is not None:
                return x if bool(value) is neutral else g.const("b", absorbing)
        return a if a == b else None

    return fold


def _fold_xor(g: FoldingGraph, args: tuple[int, ...], values: list[Any]) -> int | None:
    a, b = args
    for argument, other, value in ((a, b, values[0]), (b, a, values[1])):
        if value is not None and not value:
            return other
        key = g.keys[other]
        if value is not None and key[0] == "xor" and argument in key[1:]:
            return key[2] if key[1] == argument else key[1]  # not (not x)
    return None


def _fold_by_zero(g: FoldingGraph, args: tuple[int, ...], values: list[Any]) -> int | None:
    """The integer x for x + 0, x - 0, x | 0, x ^ 0 and shifts by 0."""
    return args[0] if _is(values[1], 0) else None


def _fold_by_zero_either(g: FoldingGraph, args: tuple[int, ...], values: list[Any]) -> int | None:
    return args[1] if _is(values[0], 0) else _fold_by_zero(g, args, values)


RULES: dict[str, FoldingRule] = {
    "add": _fold_add,
    "sub": _fold_sub,
    "mul": _fold_mul,
    "div": _fold_div,
    "neg": _fold_neg,
    "abs": _fold_abs,
    "lt": _fold_less,
    "slt": _fold_signed_less,
    "ult": _fold_less,
    "select": _fold_select,
    "iselect": _fold_select,
    "bselect": _fold_select,
    "and": _fold_logic(neutral=True, absorbing=False),
    "or": _fold_logic(neutral=False, absorbing=True),
    "xor": _fold_xor,
    "iadd": _fold_by_zero_either,
    "ior": _fold_by_zero_either,
    "ixor": _fold_by_zero_either,
    "isub": _fold_by_zero,
    "shl": _fold_by_zero,
    "lshr": _fold_by_zero,
    "ashr": _fold_by_zero,
}
"""Folding rules by the name of their operation."""
