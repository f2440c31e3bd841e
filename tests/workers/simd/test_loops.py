"""Loops: kept, cut down, nested, or made straight, they give what JAX gives."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from workers.simd import loops
from workers.simd.graph import Graph
from workers.simd.kernel import compile_kernel
from workers.simd.schedule import Region, schedule
from workers.simd.trace import trace_jaxpr

X = np.random.default_rng(0).uniform(-1, 1, (40, 3)).astype(np.float32)


@pytest.fixture(autouse=True)
def keep_all_loops(monkeypatch: pytest.MonkeyPatch) -> None:
    """Short as they are."""
    monkeypatch.setattr(loops, "UNROLLED_OPERATIONS", 0)


def regions(function: Callable[..., Any], *arguments: Any) -> list[Region]:
    """Loops that are computed, outer ones first."""
    graph, _, outputs = trace_jaxpr(jax.make_jaxpr(function)(*arguments))

    def inside(region: Region) -> list[Region]:
        inner = [step for step in region.steps if isinstance(step, Region)]
        return [*inner, *(deeper for one in inner for deeper in inside(one))]

    return inside(schedule(graph, outputs).region)


def check(function: Callable[..., Any]) -> None:
    kernel = compile_kernel(function, jax.ShapeDtypeStruct((3,), jnp.float32))
    wanted = jax.jit(jax.vmap(function))(X)
    for one, other in zip(jax.tree.leaves(kernel(X)), jax.tree.leaves(wanted), strict=True):
        np.testing.assert_allclose(one, other, rtol=2e-5, atol=1e-5)


def settle(x):
    """A step of a damped swing."""
    return 0.9 * x - 0.1 * x[::-1] * x


def test_a_loop_carries_what_its_trips_look_at() -> None:
    def function(x):
        return lax.fori_loop(0, 20, lambda _, x: settle(x), x)

    (loop,) = regions(function, X[0])
    assert len(loop.carried) == 3
    assert loop.loop is not None
    assert loop.loop.trips == 20
    check(function)


def derived(x):
    return jnp.sum(x * x)


def test_what_is_a_function_of_other_carries_is_not_carried() -> None:
    def function(x):
        def trip(_, carry):
            x, size = carry
            x = settle(x) / (1.0 + size)
            return x, derived(x)

        return lax.fori_loop(0, 20, trip, (x, derived(x)))

    (loop,) = regions(function, X[0])
    assert len(loop.carried) == 3
    check(function)


def test_it_is_carried_where_it_did_not_start_as_that_function() -> None:
    def function(x):
        def trip(_, carry):
            x, size = carry
            x = settle(x) / (1.0 + size)
            return x, derived(x)

        return lax.fori_loop(0, 20, trip, (x, x[0] * 0.5))

    (loop,) = regions(function, X[0])
    assert len(loop.carried) == 4
    check(function)


def test_what_only_comes_after_the_loop_needs_is_computed_after_it() -> None:
    def function(x):
        def trip(_, carry):
            x, _ = carry
            x = settle(x)
            return x, jnp.sin(derived(x))

        return lax.fori_loop(0, 20, trip, (x, x[0]))

    (loop,) = regions(function, X[0])
    assert len(loop.carried) == 3
    check(function)


def test_what_nobody_needs_and_what_never_changes_is_not_carried() -> None:
    def function(x):
        def trip(_, carry):
            x, gain, idle, count = carry
            return settle(x) * gain, gain, idle * 1.5, count + 1

        x, _, _, _ = lax.fori_loop(0, 20, trip, (x, x[0] * 0.1 + 0.9, x[1], 0))
        return x

    (loop,) = regions(function, X[0])
    assert len(loop.carried) == 3
    check(function)


def test_carries_that_change_places() -> None:
    def function(x):
        return lax.fori_loop(0, 7, lambda _, c: (c[1], c[2], c[0] + 0.5 * c[1]), (x[0], x[1], x[2]))

    assert len(regions(function, X[0])[0].carried) == 3
    check(function)


def test_two_carries_that_become_the_same() -> None:
    def function(x):
        def trip(_, carry):
            a, b, x = carry
            new = settle(x) + 0.01 * (a - b)
            return new[0], new[0], new

        return lax.fori_loop(0, 9, trip, (x[0], x[1], x))

    check(function)


def test_loops_inside_loops() -> None:
    def function(x):
        def inner(number, carry):
            x, total = carry
            return settle(x) + 0.01 * total, total + x.sum() * number.astype(jnp.float32) * 0.01

        def outer(number, carry):
            x, total = carry
            x, from_zero = lax.fori_loop(0, 4, inner, (x, 0.0))
            return x, 0.9 * total + from_zero * 0.1 + number.astype(jnp.float32)

        return lax.fori_loop(0, 5, outer, (x, x[0]))

    found = regions(function, X[0])
    assert len(found) == 2
    check(function)


def test_an_inner_loop_that_starts_from_constants_belongs_to_the_outer_one() -> None:
    def function(x):
        def outer(_, x):
            swing = lax.fori_loop(0, 4, lambda _, c: (c[0] * 0.5 + x[0], c[1] + c[0]), (1.0, 0.0))
            return settle(x) + 0.01 * swing[1]

        return lax.fori_loop(0, 5, outer, x)

    check(function)


def test_one_loop_after_another_and_products_from_before_them() -> None:
    def function(x):
        scaled = x * 0.3
        first = lax.fori_loop(0, 5, lambda _, y: settle(y) + scaled, x)
        return lax.fori_loop(0, 5, lambda _, y: settle(y) + scaled * first, first)

    check(function)


def test_conditions_are_carried() -> None:
    def function(x):
        def trip(number, carry):
            x, alive, steps = carry
            alive &= jnp.abs(x).max() < 2.5
            return jnp.where(alive, settle(x) * 1.05, x), alive, steps + alive

        return lax.fori_loop(0, 20, trip, (x, x[0] > -1.0, jnp.int32(0)))

    check(function)


def test_short_loops_become_straight_code(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(loops, "UNROLLED_OPERATIONS", 2000)

    def function(x):
        return lax.fori_loop(0, 5, lambda number, x: settle(x) * number.astype(jnp.float32), x)

    assert regions(function, X[0]) == []
    check(function)


def test_depending_nodes_are_those_of_the_body() -> None:
    graph = Graph()
    x = graph.input("f", 0)
    loop = graph.loop(3, [x])
    inside = graph.op("add", loop.carries[0], x)
    outside = graph.op("mul", x, x)
    (result,) = graph.close(loop, [inside])
    after = graph.op("add", result, outside)
    assert loops.depending(graph, loop) == {loop.carries[0], inside}
    assert {x, inside, outside, after, result, loop.carries[0]} == loops.live(graph, [after])
