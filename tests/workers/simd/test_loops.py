"""Loops: kept, cut down, nested, or made straight, they give what JAX gives."""

from __future__ import annotations

import collections
from collections.abc import Callable
from typing import Any
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from jax import lax

from workers.simd.episodes.kernel import compile_kernel
from workers.simd.frontend.trace import trace_jaxpr
from workers.simd.graph import loops
from workers.simd.graph.graph import Graph, depending, live
from workers.simd.graph.operations import compute
from workers.simd.graph.schedule import Region, evaluate, schedule

X = np.random.default_rng(0).uniform(-1, 1, (40, 3)).astype(np.float32)


@pytest.fixture(autouse=True)
def keep_all_loops(monkeypatch: pytest.MonkeyPatch) -> None:
    """Short as they are."""
    monkeypatch.setattr(loops, "UNROLLED_OPERATIONS", 0)


def regions(function: Callable[..., Any], *arguments: Any) -> list[Region]:
    """Loops that are computed, outer ones first."""
    graph, _, outputs = trace_jaxpr(jax.make_jaxpr(function)(*arguments))
    return found(schedule(graph, outputs).region)


def found(region: Region) -> list[Region]:
    """Loops of a region, outer ones first."""
    inner = [step for step in region.steps if isinstance(step, Region)]
    return [*inner, *(deeper for one in inner for deeper in found(one))]


def check(function: Callable[..., Any]) -> None:
    kernel = compile_kernel(function, jax.ShapeDtypeStruct((3,), jnp.float32))
    wanted = jax.jit(jax.vmap(function))(X)
    for one, other in zip(jax.tree.leaves(kernel(X)), jax.tree.leaves(wanted), strict=True):
        np.testing.assert_allclose(one, other, rtol=2e-5, atol=1e-5)


def check_built_again(function: Callable[..., Any]) -> None:
    """The operations and the bits are those of bodies that are always built again from what they carry."""
    closed = jax.make_jaxpr(function)(X[0])
    operations, results = [], []
    for is_long in (loops._is_long, lambda graph, nodes: False):
        with mock.patch.object(loops, "_is_long", is_long):
            graph, _, outputs = trace_jaxpr(closed)
        names = (graph.keys[node][0] for node in live(graph, outputs))
        operations.append(collections.Counter(names))
        results.append(np.array(evaluate(graph, outputs, np.ascontiguousarray(X[:8].T).view(np.uint32))).tobytes())
    assert operations[0] == operations[1]
    assert results[0] == results[1]


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


@pytest.mark.parametrize(("start", "carried"), [(derived, 3), (lambda x: x[0] * 0.5, 4)])
def test_a_function_of_other_carries_is_carried_only_where_it_did_not_start_as_that(start, carried: int) -> None:
    def function(x):
        def trip(_, carry):
            x, size = carry
            x = settle(x) / (1.0 + size)
            return x, derived(x)

        return lax.fori_loop(0, 20, trip, (x, start(x)))

    (loop,) = regions(function, X[0])
    assert len(loop.carried) == carried
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

    assert len(regions(function, X[0])) == 2
    check(function)


def test_an_inner_loop_that_starts_from_constants_belongs_to_the_outer_one() -> None:
    def function(x):
        def outer(_, x):
            swing = lax.fori_loop(0, 4, lambda _, c: (c[0] * 0.5 + x[0], c[1] + c[0]), (1.0, 0.0))
            return settle(x) + 0.01 * swing[1]

        return lax.fori_loop(0, 5, outer, x)

    check(function)


def test_the_body_of_a_loop_is_built_once_if_trips_read_nothing_that_is_not_carried() -> None:
    """Twice at each level would be 32 times in the fifth."""

    def nested(depth: int, x):
        def trip(_, carry):
            x, _ = carry
            x = nested(depth - 1, x) if depth > 1 else settle(x)
            return x, jnp.sin(derived(x))

        x, seen = lax.fori_loop(0, 3, trip, (x, x[0]))
        return x + 0.1 * seen

    graph, _, outputs = trace_jaxpr(jax.make_jaxpr(lambda x: nested(5, x))(X[0]))
    assert len(graph.loops) == 5
    assert [len(region.carried) for region in found(schedule(graph, outputs).region)] == [3] * 5
    check_built_again(lambda x: nested(3, x))


def test_a_loop_whose_unread_carry_begins_with_a_value_of_the_outer_one_stays_outside() -> None:
    """What it gives is the same in all trips of the outer loop, and so it is computed once."""

    def function(x):
        def inner(_, carry):
            z = settle(carry[0])
            return z, jnp.sin(derived(z))

        def outer(_, y):
            z, size = lax.fori_loop(0, 4, inner, (x, y[0]))
            return settle(y) + 0.1 * z + size

        return lax.fori_loop(0, 5, outer, x)

    graph, _, outputs = trace_jaxpr(jax.make_jaxpr(function)(X[0]))
    first, second = (step for step in schedule(graph, outputs).region.steps if isinstance(step, Region))
    assert (len(first.carried), len(second.carried)) == (3, 3)
    check_built_again(function)
    check(function)


def test_one_loop_after_another_and_products_from_before_them() -> None:
    def function(x):
        scaled = x * 0.3
        first = lax.fori_loop(0, 5, lambda _, y: settle(y) + scaled, x)
        return lax.fori_loop(0, 5, lambda _, y: settle(y) + scaled * first, first)

    check(function)


def test_a_product_from_before_a_loop_is_not_fused_with_a_sum_inside() -> None:
    def function(x):
        product = jnp.sin(x) * jnp.cos(x)
        return lax.fori_loop(0, 5, lambda _, y: settle(y) + product, x)

    check(function)


def test_conditions_are_carried() -> None:
    def function(x):
        def trip(number, carry):
            x, alive, steps = carry
            alive &= jnp.abs(x).max() < 2.5
            return jnp.where(alive, settle(x) * 1.05, x), alive, steps + alive

        return lax.fori_loop(0, 20, trip, (x, x[0] > -1.0, jnp.int32(0)))

    check(function)


def test_a_late_carry_s_start_says_nothing_about_what_it_is() -> None:
    def function(x):
        def trip(_, carry):
            x, double, size = carry
            x = 0.9 * x + 0.1 * jnp.abs(size)
            double = x * 2.0
            return x, double, jnp.abs(double) + 1.0

        start = x[0] * 3.0
        return lax.fori_loop(0, 3, trip, (x[1], start, jnp.abs(start) + 1.0))

    check(function)


def test_an_inner_loop_s_carry_may_hang_on_nothing_outside() -> None:
    def gain(x):
        def outer(_, x):
            y, gain = lax.fori_loop(0, 5, lambda _, c: (c[0] - 0.01 * jnp.sin(c[0]) * c[1], c[1] * 0.99), (x, 1.0))
            return y * gain

        return lax.fori_loop(0, 4, outer, x[0])

    def counter(x):
        def inner(number, z):
            return z * 0.5 + jnp.sin(jnp.cos(number.astype(jnp.float32)))

        return lax.fori_loop(0, 5, lambda _, y: 0.9 * lax.fori_loop(0, 4, inner, y), x[0])

    check(gain)
    check(counter)


def test_the_number_of_a_trip_may_be_an_index() -> None:
    table = np.array([0.5, -1.0, 2.0], np.float32)

    def function(x):
        return lax.fori_loop(0, 3, lambda number, c: c.at[number].add(jnp.asarray(table)[number] * c[2 - number]), x)

    check(function)


def test_a_loop_may_carry_nothing() -> None:
    check(lambda x: lax.scan(lambda c, _: (c, None), x, None, length=3)[0])


LEAVES = 4
STEPS = ("add", "mul", "sin", "half", "abs")


def check_random_loop(data: st.DataObject) -> None:
    """Bodies of random operations on carries with random starts and ends; one inside another now and then.

    Values stay bounded but are not damped, so that a wrong first trip is seen at the end.
    """

    def body(depth: int):
        program = data.draw(st.lists(st.tuples(st.sampled_from(STEPS), st.integers(0, 99), st.integers(0, 99)),
                                     min_size=2, max_size=7))  # fmt: skip
        ends = data.draw(st.lists(st.integers(0, 99), min_size=LEAVES, max_size=LEAVES))
        inner = body(depth - 1) if depth and data.draw(st.booleans()) else None

        def run(carry: tuple) -> tuple:
            values = list(carry)
            if inner is not None:
                values += lax.fori_loop(0, 3, lambda _, c: inner(c), (values[0], values[1], *starts_inside(values)))
            for name, one, other in program:
                a, b = values[one % len(values)], values[other % len(values)]
                values.append({
                    "add": lambda a=a, b=b: jnp.sin(a + b), "mul": lambda a=a, b=b: jnp.cos(a * b),
                    "sin": lambda a=a: jnp.sin(2.0 * a), "half": lambda a=a: a * 0.5 + 0.25,
                    "abs": lambda a=a: jnp.abs(a),
                }[name]())  # fmt: skip
            return tuple(values[end % len(values)] for end in ends)

        return run

    def starts_inside(values: list) -> tuple:
        return (values[2], jnp.float32(0.3))

    run = body(1)
    start_ends = data.draw(st.booleans())

    def function(x):
        start = (x[0], x[1], x[2], x[0] * 2.0)
        if start_ends:
            start = run(start)  # so that some carries are derived
        return lax.fori_loop(0, 4, lambda _, c: run(c), start)

    check_built_again(function)
    check(function)


@pytest.mark.slow
@settings(max_examples=10, deadline=None, suppress_health_check=list(HealthCheck))
@given(data=st.data())
def test_random_loops_are_jaxs(data: st.DataObject) -> None:
    check_random_loop(data)


@pytest.mark.long
@settings(max_examples=200, deadline=None, suppress_health_check=list(HealthCheck))
@given(data=st.data())
def test_so_are_many(data: st.DataObject) -> None:
    check_random_loop(data)


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
    assert depending(graph, loop) == {loop.carries[0], inside}
    assert {x, inside, outside, after, result, loop.carries[0]} == live(graph, [after])


def trips_made(function: Callable[..., Any], x: np.ndarray, alive: np.ndarray | None = None) -> list[tuple[int, int]]:
    """(loop, how often its first operation was computed) of each loop.

    `x` [lane, 3] are all lanes, of which only those that are alive need results, if that is given.
    """
    words, avals = np.ascontiguousarray(x.T).view(np.uint32), [jnp.zeros(3)]
    if alive is not None:
        words, avals = np.concatenate([words, alive[None].astype(np.uint32)]), [*avals, jnp.array(True)]
    closed = jax.make_jaxpr(lambda x, *_: function(x))(*avals)
    graph, _, outputs = trace_jaxpr(closed, lanes_word=None if alive is None else 3)
    first = {region.loop.number: next(step for step in region.steps if isinstance(step, int))
             for region in found(schedule(graph, outputs).region) if region.loop}  # fmt: skip
    computed: collections.Counter[int] = collections.Counter()

    def operation(node: int, arguments: Any) -> Any:
        computed[node] += 1
        return compute(graph.keys[node][0], arguments)

    evaluate(graph, outputs, words, operation, fuse=False)
    return [(number, computed[node]) for number, node in sorted(first.items())]


HALVES = np.float32([[2.0**-k, 1.0, 1.0] for k in range(6)])
"""Lanes that need 0 to 5 doublings until x[0] is 1."""


def doubled(x):
    return lax.while_loop(lambda x: x[0] < 1.0, lambda x: x * 2.0, x)


def doubled_by_a_scan(x):
    def trip(carry, _):
        return lax.cond(carry[1], lambda x: (x * 2.0, x[0] * 2.0 < 1.0), lambda x: (x, False), carry[0]), None

    return lax.scan(trip, (x, x[0] < 1.0), None, length=100)[0][0]


@pytest.mark.parametrize("function", [doubled, doubled_by_a_scan])
def test_a_loop_ends_as_soon_as_no_lane_needs_another_trip(function: Callable[..., Any]) -> None:
    assert [times for _, times in trips_made(function, HALVES)] == [5]
    assert [times for _, times in trips_made(function, HALVES[:3])] == [2]
    assert [times for _, times in trips_made(function, HALVES[:1])] == [0]
    kernel = compile_kernel(function, jax.ShapeDtypeStruct((3,), jnp.float32))
    np.testing.assert_array_equal(kernel(HALVES), [2.0**k * row for k, row in enumerate(HALVES)])


def test_a_loop_over_no_elements_makes_no_trip() -> None:
    def function(x: Any) -> Any:
        return jnp.concatenate([jax.vmap(doubled)(x[:0].reshape(0, 1)).ravel(), x])

    x = np.float32([0.5, 2.0])
    np.testing.assert_array_equal(compile_kernel(function, jax.ShapeDtypeStruct((2,), jnp.float32))(x[None])[0], x)


def test_no_trip_of_an_inner_loop_is_made_for_lanes_that_do_not_need_it() -> None:
    def by_branches(x):
        return lax.cond(x[1] > 0, doubled, lambda x: x, x)

    def by_loops(x):
        """As many trips as x[2] says; in each, x[0] is halved 3 times more often than before, and doubled again."""

        def outer(carry):
            number, x = carry
            return number + 1.0, doubled(x * jnp.array([0.125, 1.0, 1.0]))

        return lax.while_loop(lambda carry: carry[0] < x[2], outer, (0.0, x))[1]

    x = HALVES * np.float32([1, -1, 1])
    assert [times for _, times in trips_made(by_branches, x)] == [0]
    x[2] = HALVES[2]
    assert [times for _, times in trips_made(by_branches, x)] == [2]
    assert trips_made(doubled, HALVES, np.arange(6) < 3)[0][1] == 2  # of an episode that is over
    lanes = np.float32([[1, 0, 1], [2.0**-20, 0, 0]])  # the second lane would need 23 doublings
    outer, inner = trips_made(by_loops, lanes)
    assert (outer[1], inner[1]) == (1, 3)


def test_a_short_loop_whose_end_depends_on_data_becomes_straight_code(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(loops, "UNROLLED_OPERATIONS", 2000)

    def bounded(x):
        return lax.while_loop(lambda c: (c[0] < 5) & (c[1][0] < 1.0), lambda c: (c[0] + 1, settle(c[1])), (0, x))

    assert regions(bounded, X[0]) == []
    check(bounded)
    assert len(regions(doubled, X[0])) == 1  # without a bound


def test_a_branch_with_loops_that_few_lanes_need_is_a_loop_of_one_trip() -> None:
    """Its code is outside of the vectors that do not need it, which `cond` computes but for its loops."""

    def function(x):
        def once(carry):
            return False, lax.fori_loop(0, 20, lambda _, x: settle(x), carry[1])

        return lax.while_loop(lambda carry: carry[0], once, (x[0] > 0.5, x))[1]

    outer, inner = regions(function, X[0])
    assert outer.loop is not None
    assert outer.loop.active is not None
    assert inner.loop is not None
    assert inner.loop.trips == 20
    assert 0 < (X[:, 0] > 0.5).sum() < len(X)
    check(function)
    assert [times for _, times in trips_made(function, np.minimum(X, 0.5))] == [0, 0]


def check_random_while(data: st.DataObject) -> None:
    """Loops that end by their carries, with random bodies, one inside another now and then."""
    inner_too, most = data.draw(st.booleans()), data.draw(st.floats(0.5, 2.0))
    steps = data.draw(st.lists(st.sampled_from(STEPS), min_size=1, max_size=4))

    def moved(x):
        for step in steps:
            x = {"add": lambda x: x + x[::-1] * 0.3, "mul": lambda x: x * jnp.cos(x[::-1]), "sin": jnp.sin,
                 "half": lambda x: x * 0.5 + 0.25, "abs": jnp.abs}[step](x)  # fmt: skip
        return x

    def loop(x, depth, bound):
        def body(carry):
            number, _, x = carry
            x = moved(x)
            if depth:
                x = x + 0.1 * loop(x * 0.7, depth - 1, 5)[2]
            return number + 1, jnp.abs(x).sum(), x

        return lax.while_loop(lambda c: (c[0] < bound) & (c[1] < most), body, (0, jnp.abs(x).sum() * 0.1, x))

    check(lambda x: loop(x, int(inner_too), 9))


@pytest.mark.slow
@settings(max_examples=6, deadline=None, suppress_health_check=list(HealthCheck))
@given(data=st.data())
def test_random_loops_that_data_ends_are_jaxs(data: st.DataObject) -> None:
    check_random_while(data)


@pytest.mark.long
@settings(max_examples=200, deadline=None, suppress_health_check=list(HealthCheck))
@given(data=st.data())
def test_so_are_many_that_data_ends(data: st.DataObject) -> None:
    check_random_while(data)
