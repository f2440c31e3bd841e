"""Folding: which identities hold for which values, and that nothing else is touched."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from workers.simd.graph.folding import FoldingGraph
from workers.simd.graph.operations import OPERATIONS, compute
from workers.simd.graph.schedule import evaluate

SPECIAL = np.array([0.0, -0.0, 1.0, -1.0, 2.5, -3.5, math.inf, -math.inf, math.nan, 1e-38, 3e38], np.float32)


def lanes(*columns: np.ndarray) -> np.ndarray:
    return np.array([np.asarray(column).view(np.uint32) for column in columns])


def folded(name: str, build) -> tuple[FoldingGraph, int, bool]:
    """(graph, node, whether it is a simpler one) of an operation on what `build` makes of x, the input."""
    graph = FoldingGraph()
    arguments = build(graph, graph.input("f", 0))
    node = graph.op(name, *arguments)
    return graph, node, graph.keys[node] not in ((name, *arguments), (name, *reversed(arguments)))


EXACT = {
    "x * 1": (("mul", lambda g, x: (x, g.f(1.0))), lambda x: x),
    "1 * x": (("mul", lambda g, x: (g.f(1.0), x)), lambda x: x),
    "x * -1": (("mul", lambda g, x: (x, g.f(-1.0))), lambda x: -x),
    "x / 1": (("div", lambda g, x: (x, g.f(1.0))), lambda x: x),
    "x - 0": (("sub", lambda g, x: (x, g.f(0.0))), lambda x: x - np.float32(0)),
    "x + -0": (("add", lambda g, x: (x, g.f(-0.0))), lambda x: x + np.float32(-0.0)),
    "-0 - x": (("sub", lambda g, x: (g.f(-0.0), x)), lambda x: np.float32(-0.0) - x),
    "-(-x)": (("neg", lambda g, x: (g.op("neg", x),)), lambda x: x),
    "|-x|": (("abs", lambda g, x: (g.op("neg", x),)), np.abs),
    "||x||": (("abs", lambda g, x: (g.op("abs", x),)), np.abs),
    "x < x": (("lt", lambda g, x: (x, x)), lambda x: x < x),
    "x / 4": (("div", lambda g, x: (x, g.f(4.0))), lambda x: x / np.float32(4)),
    "2 + (-x)": (("add", lambda g, x: (g.f(2.0), g.op("neg", x))), lambda x: np.float32(2) - x),
    "2 - (-x)": (("sub", lambda g, x: (g.f(2.0), g.op("neg", x))), lambda x: np.float32(2) + x),
    "(-x) * x": (("mul", lambda g, x: (g.op("neg", x), x)), lambda x: -(x * x)),
    "(-x) * (-x)": (("mul", lambda g, x: (g.op("neg", x), g.op("neg", x))), lambda x: x * x),
    "choice of equals": (("select", lambda g, x: (g.op("lt", x, g.f(0.0)), x, x)), lambda x: x),
}


@pytest.mark.parametrize("case", EXACT)
def test_these_identities_hold_for_every_value(case: str) -> None:
    (name, build), meaning = EXACT[case]
    graph, node, is_simpler = folded(name, build)
    assert is_simpler
    with np.errstate(all="ignore"):
        wanted = np.asarray(meaning(SPECIAL))
    (found,) = evaluate(graph, [node], lanes(SPECIAL))
    tiny = np.abs(wanted.astype(np.float32)) < np.finfo(np.float32).tiny  # flushed to zero, whatever was folded
    np.testing.assert_array_equal(np.where(tiny, 0, found), np.where(tiny, 0, wanted))
    if wanted.dtype == np.float32:
        is_number = ~np.isnan(wanted)
        np.testing.assert_array_equal(np.signbit(found[is_number]), np.signbit(wanted[is_number]))


@pytest.mark.parametrize(
    ("name", "build", "meaning"),
    [
        ("add", lambda g, x: (x, g.f(0.0)), lambda x: x + np.float32(0)),
        ("sub", lambda g, x: (x, g.f(-0.0)), lambda x: x - np.float32(-0.0)),
        ("neg", lambda g, x: (g.op("sub", x, g.f(2.5)),), lambda x: -(x - np.float32(2.5))),
        ("sub", lambda g, x: (g.op("neg", x), g.f(1.0)), lambda x: -x - np.float32(1)),
        ("abs", lambda g, x: (g.op("sqrt", x),), lambda x: np.abs(np.sqrt(np.where(np.abs(x) < 1e-37, 0 * x, x)))),
    ],
)
def test_these_hold_but_for_the_sign_of_zero(name: str, build, meaning) -> None:
    graph, node, is_simpler = folded(name, build)
    assert is_simpler
    (found,) = evaluate(graph, [node], lanes(SPECIAL))
    with np.errstate(all="ignore"):
        wanted = meaning(SPECIAL)
    tiny = np.abs(wanted) < np.finfo(np.float32).tiny
    np.testing.assert_array_equal(np.where(tiny, 0, found), np.where(tiny, 0, wanted))
    differs = np.signbit(found) != np.signbit(wanted)
    assert (differs & (wanted == 0)).any(), "else it is exact, and belongs above"
    assert not (differs & ~tiny & ~np.isnan(wanted)).any()


def test_zero_times_anything_is_zero_and_the_factor_is_still_seen_elsewhere() -> None:
    graph = FoldingGraph()
    x = graph.input("f", 0)
    product = graph.op("mul", x, graph.f(0.0))
    assert graph.constant(product) == 0.0
    assert not np.signbit(graph.constant(product)), "also of a negative factor, of which JAX has -0"
    total = graph.op("add", product, x)
    (found,) = evaluate(graph, [total], lanes(SPECIAL))
    np.testing.assert_array_equal(np.isfinite(found), np.isfinite(SPECIAL))


@pytest.mark.parametrize(
    ("name", "build"),
    [
        ("div", lambda g, x: (g.f(0.0), x)),
        ("div", lambda g, x: (x, x)),
        ("sub", lambda g, x: (x, x)),
        ("sub", lambda g, x: (g.f(0.0), x)),
        ("eq", lambda g, x: (x, x)),
        ("ne", lambda g, x: (x, x)),
        ("le", lambda g, x: (x, x)),
        ("div", lambda g, x: (x, g.f(3.0))),
    ],
)
def test_what_not_a_number_would_change_is_left_alone(name: str, build) -> None:
    assert not folded(name, build)[2]


def test_equal_expressions_are_one_node_and_factors_may_change_places() -> None:
    graph = FoldingGraph()
    x, y = graph.input("f", 0), graph.input("f", 1)
    assert graph.op("mul", x, y) == graph.op("mul", y, x)
    assert graph.op("add", x, y) == graph.op("add", x, y)
    assert graph.op("add", x, y) != graph.op("add", y, x), "of two products the second is fused"
    assert graph.op("sub", x, y) != graph.op("sub", y, x)
    assert graph.f(0.0) != graph.f(-0.0)
    assert graph.f(math.nan) == graph.f(math.nan)


def test_constants_fold_as_the_kernels_compute() -> None:
    graph = FoldingGraph()
    assert graph.constant(graph.op("add", graph.f(0.1), graph.f(0.2))) == np.float32(0.1) + np.float32(0.2)
    assert graph.constant(graph.op("mul", graph.f(1e-30), graph.f(1e-10))) == 0.0, "denormal results are zeros"
    assert graph.constant(graph.op("bits", graph.op("unbits", graph.i(5)))) == 5, "bits are only moved"
    assert graph.constant(graph.op("iadd", graph.i(2**31 - 1), graph.i(1))) == -(2**31)
    assert graph.constant(graph.op("lshr", graph.i(-1), graph.i(31))) == 1
    assert graph.constant(graph.op("ult", graph.i(1), graph.i(-1)))


def test_fused_operation_rounds_once() -> None:
    rng = np.random.default_rng(0)
    a, b, c = (rng.normal(size=20_000).astype(np.float32) for _ in range(3))
    c[::2] = -(a * b)[::2] * (1 + rng.integers(-2, 3, 10_000) * np.float32(2**-23))
    exact = a.astype(np.longdouble) * b.astype(np.longdouble) + c.astype(np.longdouble)
    np.testing.assert_array_equal(compute("fma", (a, b, c)), exact.astype(np.float32))
    # Half-way cases that rounding twice would get wrong: 1 + 2^-24 and a little more, or a little less.
    one, half = np.float32(1.0), np.float32(2.0**-24)
    little = np.float32(2.0**-30)
    assert compute("fma", (little, little, one)) == one
    assert compute("fma", (np.float32(1 + 2**-23), half, one)) == np.nextafter(one, np.float32(2))
    assert compute("fma", (np.float32(1 - 2**-24), half, one)) == one


NAMES = [name for name, operation in OPERATIONS.items() if set(operation.takes) <= {"f"} and operation.gives == "f"]


@st.composite
def expressions(draw) -> list[tuple[str, tuple[int, ...]]]:
    """Operations on numbers of what came before: 0, 1, 2 are inputs, 3 to 6 are constants."""
    size = 7
    found = []
    for _ in range(draw(st.integers(1, 25))):
        name = draw(st.sampled_from(NAMES))
        found.append((name, tuple(draw(st.integers(0, size - 1)) for _ in OPERATIONS[name].takes)))
        size += 1
    return found


@settings(max_examples=200, deadline=None)
@given(expressions(), st.integers(0, 2**32 - 1))
def test_folded_expressions_equal_those_computed_one_by_one(expression, seed: int) -> None:
    """For finite values: where every step is finite, folding changes no bit but signs of zeros."""
    x = np.random.default_rng(seed).normal(size=(3, 32)).astype(np.float32)
    constants = [0.0, 1.0, -1.0, 0.5]
    graph = FoldingGraph()
    nodes = [graph.input("f", k) for k in range(3)] + [graph.f(value) for value in constants]
    plain = [*x, *(np.full(32, value, np.float32) for value in constants)]
    finite = np.ones(32, bool)
    for name, arguments in expression:
        nodes.append(graph.op(name, *(nodes[k] for k in arguments)))
        with np.errstate(all="ignore"):
            value = np.asarray(OPERATIONS[name].meaning(*(plain[k] for k in arguments)), np.float32)
        finite &= np.isfinite(value) & ~((np.abs(value) < 1e-30) & (value != 0))
        plain.append(value)
    found = evaluate(graph, nodes, x.view(np.uint32), fuse=False)
    for one, other in zip(found, plain, strict=True):
        np.testing.assert_array_equal(np.asarray(one)[finite], other[finite])
