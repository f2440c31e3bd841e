"""An expression is rounded the same wherever it stands: which products are fused depends on the expression alone.

The kernels of a task compute different things of the same states: training sums observations, evaluations keep traces,
and kernels may omit inputs that are always zero. None of that may change what they have in common.
"""

from __future__ import annotations

import ctypes
from typing import Any
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from es_service.protocol.messages import PolicySpec
from es_service.protocol.noise import Domain, stream_keys, uniforms
from tests.helpers import spec
from workers.environments import SHIPPED, describe_environment, make_environment
from workers.policy import initial_parameters
from workers.simd.backend.emit import emit
from workers.simd.backend.native import aligned, load_compiled, pack
from workers.simd.backend.target import host_target
from workers.simd.episodes.compiled import compile_episodes
from workers.simd.episodes.kernel import compile_kernel
from workers.simd.episodes.rollout import always_zero
from workers.simd.frontend.trace import trace_jaxpr
from workers.simd.graph import loops
from workers.simd.graph.folding import FoldingGraph
from workers.simd.graph.loops import build_loop
from workers.simd.graph.operations import compute
from workers.simd.graph.schedule import Region, evaluate, schedule

PAIRS, STEPS = 24, 25
COMPARED = ("fitness", "returns", "descriptor", "steps", "goal_distance")


class Products:
    """every number is a product, or a sum of two, of numbers that others are made of as well"""

    observation_size, action_size, episode_steps = 4, 2, STEPS
    descriptor_names, descriptor_bounds = ("x", "y"), ((-2.0, 2.0), (-2.0, 2.0))
    final_fitness = True

    def reset(self, key: Any) -> Any:
        return 0.3 + uniforms(key, jnp.arange(4, dtype=jnp.uint32))

    def observe(self, state: Any) -> Any:
        a, b, c, d = state
        return jnp.stack([a * b, c * d + a * b, 0.0 * a, b * c - a * d])

    def step(self, state: Any, action: Any) -> tuple[Any, Any, Any]:
        def swing(_: Any, at: Any) -> Any:
            a, b, c, d = at
            turn = jnp.stack([a * b - c * d, c * d + a * b, a * d + b * c + a * b, b * c - a * d])
            return jnp.sin(3.0 * at + turn + force)  # chaotic: a last bit is soon seen

        a, b, c, d = state
        force = jnp.stack([a * b + action[0], c * d + a * b, b * c - action[1], a * d - b * c])
        state = jax.lax.fori_loop(0, 60, swing, state)
        a, b, c, d = state
        return state, (a * b) * (c + a * d), a * b + c * d > 1.6

    def descriptor(self, state: Any) -> Any:
        a, b, c, d = state
        return jnp.stack([a * b, a * d - b * c])

    def goal_distance(self, state: Any) -> Any:
        a, b, c, d = state
        return a * b + c * d


@pytest.mark.parametrize(
    ("task", "fitness"),
    [
        (f"{__name__}:Products", "sum"),
        (f"{__name__}:Products", "final"),
        ("point_maze", "sum"),
        ("point_maze", "final"),
        pytest.param("ant_trap", "sum", marks=pytest.mark.long),
        pytest.param("ant_maze", "final", marks=pytest.mark.long),
        pytest.param("brax:hopper", "sum", marks=pytest.mark.long),
    ],
)
def test_training_evaluation_and_omitted_zero_inputs_agree_on_every_bit(task: str, fitness: str) -> None:
    size = SHIPPED[task] if task in SHIPPED else describe_environment(task)
    environment = make_environment(task, {})
    worker_spec = spec(
        environment=task,
        policy=PolicySpec((size.observation_size, 16, size.action_size)),
        episode_steps=STEPS,
        fitness=fitness,
        action_noise=0.0,
    )
    zero_O = always_zero(environment)
    rng = np.random.default_rng(0)
    mean_O = np.where(zero_O, 0.0, rng.normal(0.0, 0.1, zero_O.size)).astype(np.float32)
    std_O = rng.uniform(0.5, 2.0, zero_O.size).astype(np.float32)
    centre_D = 2.0 * initial_parameters(worker_spec.policy, "unit_columns", 5)
    noise_keys_P = stream_keys(1, Domain.PARAMETER_NOISE, 1, np.arange(PAIRS))
    keys_L = stream_keys(1, Domain.EVALUATION_RESET, 1, np.arange(2 * PAIRS))
    found = {}
    for omit_zero_inputs, inputs_O in {False: np.arange(zero_O.size), True: np.flatnonzero(~zero_O)}.items():
        for training in (True, False):
            if omit_zero_inputs and not zero_O.any():
                continue
            kernel = compile_episodes(environment, worker_spec, inputs_O, training=training)
            noise = noise_keys_P if training else None
            weights = kernel.network.pack(centre_D)
            found[omit_zero_inputs, training] = kernel.run(weights, 0.0, mean_O, std_O, noise, keys_L, keys_L)
    first = found[False, True]
    assert len(np.unique(first.returns)) > PAIRS
    for kernel, episodes in found.items():
        for leaf in COMPARED:
            np.testing.assert_array_equal(getattr(episodes, leaf), getattr(first, leaf), err_msg=f"{kernel} {leaf}")


X = np.random.default_rng(0).normal(size=(6, 64)).astype(np.float32)


def inputs_and_product() -> tuple[FoldingGraph, list[int], int]:
    """(a graph, inputs a, b, c, d, e, f, the product a b)."""
    graph = FoldingGraph()
    nodes = [graph.input("f", k) for k in range(6)]
    return graph, nodes, graph.op("mul", nodes[0], nodes[1])


def computed(graph: FoldingGraph, outputs: list[int]) -> list[np.ndarray]:
    """Outputs by machine code, which are the reference implementation's."""
    target = host_target()
    text = emit(graph, outputs, len(X), target)
    native = load_compiled(text, lambda: text, target)
    words = pack(list(X.T[:, :, None].transpose(1, 0, 2)), target.width)
    out = aligned((len(words), len(outputs), target.width))
    call = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_int64)(native.address)
    call(words.ctypes.data, out.ctypes.data, len(words))
    found = list(out.transpose(1, 0, 2).reshape(len(outputs), -1)[:, : X.shape[1]].view(np.float32))
    for one, reference in zip(found, evaluate(graph, outputs, X.view(np.uint32)), strict=True):
        np.testing.assert_array_equal(one, reference)
    return found


def fma(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    return compute("fma", (a, b, c))


def test_a_product_is_taken_in_by_all_its_sums_and_not_computed_besides() -> None:
    graph, (_, _, c, d, e, _), product = inputs_and_product()
    outputs = [graph.op("add", product, c), graph.op("sub", d, product), graph.op("sub", product, e)]
    order = schedule(graph, outputs)
    assert order.fused == dict.fromkeys(outputs, product)
    assert order.region.steps == outputs
    a, b, c, d, e, _ = X
    for found, wanted in zip(computed(graph, outputs), (fma(a, b, c), fma(-a, b, d), fma(a, b, -e)), strict=True):
        np.testing.assert_array_equal(found, wanted)


@pytest.mark.parametrize("user", ["output", "factor", "choice"])
def test_a_product_that_something_else_needs_is_there_too(user: str) -> None:
    graph, (_, _, c, d, _, _), product = inputs_and_product()
    total = graph.op("add", product, c)
    other = {
        "output": product,
        "factor": graph.op("mul", product, d),
        "choice": graph.op("select", graph.op("lt", d, c), product, d),
    }[user]
    order = schedule(graph, [total, other])
    assert order.fused == {total: product}
    assert product in order.region.steps
    a, b, c, d, _, _ = X
    wanted = {"output": a * b, "factor": a * b * d, "choice": np.where(d < c, a * b, d)}[user]
    for found, value in zip(computed(graph, [total, other]), (fma(a, b, c), wanted), strict=True):
        np.testing.assert_array_equal(found, value)


def test_products_inside_of_a_loop_and_from_before_it() -> None:
    """What a loop starts from and ends with is needed itself; what is computed before it is not taken in inside."""
    graph, (_, _, c, _, _, _), before = inputs_and_product()
    loop = graph.loop(3, [before, c])
    first, second = loop.carries
    inside = graph.op("mul", first, second)
    total = graph.op("add", inside, before)
    results = graph.close(loop, [inside, graph.op("mul", total, graph.f(0.5))])
    after = graph.op("add", c, before)
    order = schedule(graph, [*results, after])
    assert order.fused == {total: inside, after: before}
    (region,) = (step for step in order.region.steps if isinstance(step, Region))
    assert inside in region.steps
    assert before in order.region.steps
    assert before in order.region.wanted_inside
    a, b, c, _, _, _ = X
    x, y = a * b, c
    for _ in range(3):
        x, y = compute("mul", (x, y)), compute("mul", (fma(x, y, a * b), np.float32(0.5)))
    for found, wanted in zip(computed(graph, [*results, after]), (x, y, fma(a, b, c)), strict=True):
        np.testing.assert_array_equal(found, wanted)


@pytest.mark.parametrize("first_built", ["ab", "cd"])
@pytest.mark.parametrize("name", ["add", "sub"])
def test_of_two_products_the_second_is_fused_whichever_was_built_first(name: str, first_built: str) -> None:
    graph = FoldingGraph()
    nodes = [graph.input("f", k) for k in range(6)]
    factors = {"ab": nodes[:2], "cd": nodes[2:4]}
    graph.op("mul", *factors[first_built])
    total = graph.op(name, graph.op("mul", *factors["ab"]), graph.op("mul", *factors["cd"]))
    turned = graph.op(name, graph.op("mul", *factors["cd"]), graph.op("mul", *factors["ab"]))
    a, b, c, d, _, _ = X
    sign = 1 if name == "add" else -1
    found = computed(graph, [total, turned])
    np.testing.assert_array_equal(found[0], fma(sign * c, d, a * b))
    np.testing.assert_array_equal(found[1], fma(sign * a, b, c * d))


def test_what_is_subtracted_from_itself_leaves_nothing_and_negatives_are_exact() -> None:
    graph, (_, _, c, d, _, _), product = inputs_and_product()
    difference = graph.op("sub", product, graph.op("mul", c, d))
    outputs = [graph.op("sub", product, product), graph.op("add", product, product)]
    nothing, twice, one, minus = computed(graph, [*outputs, difference, graph.op("neg", difference)])
    np.testing.assert_array_equal(nothing, 0.0)
    np.testing.assert_array_equal(twice, 2 * (X[0] * X[1]))
    np.testing.assert_array_equal(one, -minus)


@pytest.mark.parametrize("operations", [8, 9])
def test_whether_a_loop_is_straight_code_does_not_depend_on_what_was_built_before(
    operations: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(loops, "UNROLLED_OPERATIONS", 8 * 4)

    def loops_in(graph: FoldingGraph) -> int:
        x, gain = graph.input("f", 0), graph.input("f", 1)

        def body(carries: list[int]) -> list[int]:
            (at,) = carries
            for _ in range(operations):
                at = graph.op("mul", at, graph.op("sqrt", gain))
            return [at]

        outputs = build_loop(graph, 4, body, [x])
        return sum(isinstance(step, Region) for step in schedule(graph, outputs).region.steps)

    fresh, used = FoldingGraph(), FoldingGraph()
    used.op("sqrt", used.input("f", 1))
    assert loops_in(fresh) == loops_in(used) == (operations > 8)


NUMBER = st.integers(0, 99)
OPERATIONS_OF = {
    "add": lambda a, b: a + b,
    "sub": lambda a, b: a - b,
    "mul": lambda a, b: a * b,
    "max": jnp.maximum,
    "neg": lambda a, _: -a,
    "fold": lambda a, _: jnp.abs(a - jnp.round(a)),
}


def programs(depth: int) -> st.SearchStrategy[list]:
    """Operations on two of the values before, and loops whose trips are such programs."""
    one = st.tuples(st.sampled_from([*OPERATIONS_OF, "mul", "mul"]), NUMBER, NUMBER)
    if depth:
        one |= st.tuples(programs(depth - 1), NUMBER, NUMBER)
    return st.lists(one, min_size=2, max_size=7)


def run(program: list, values: list[Any]) -> list[Any]:
    """The values, and one for each operation or two for each loop of a program."""
    values = list(values)
    for what, i, j in program:
        a, b = values[i % len(values)], values[j % len(values)]
        if isinstance(what, str):
            values.append(OPERATIONS_OF[what](a, b))
        else:
            shared = values[-2:]
            values += jax.lax.fori_loop(
                0, 4, lambda _, at, what=what, shared=shared: tuple(run(what, [*shared, *at])[-2:]), (a, b)
            )
    return values


def same_bits(program: list, before: list, after: list) -> None:
    """Hold a program alone against the same program among others."""

    def bits(function: Any, *words: np.ndarray) -> list[np.ndarray]:
        graph, _, outputs = trace_jaxpr(jax.make_jaxpr(function)(*(jnp.zeros(len(rows)) for rows in words)))
        return [np.asarray(value) for value in evaluate(graph, outputs, np.concatenate(words).view(np.uint32))]

    def alone(x: Any) -> Any:
        return run(program, list(x))[-2:]

    def beside(y: Any, x: Any) -> Any:
        products = [x[i] * x[j] for i in reversed(range(len(x))) for j in range(i)]
        first = run([*before, *program[:-1], *after], [*x, *y, *products])
        return run(program, list(x))[-2:], first, run(after, run(program, list(x)))

    with mock.patch.object(loops, "UNROLLED_OPERATIONS", 24):
        wanted, found = bits(alone, X), bits(beside, X[:2] + 1, X)
    for one, other in zip(wanted, found, strict=False):
        is_number = ~np.isnan(one)
        np.testing.assert_array_equal(one.view(np.uint32)[is_number], other.view(np.uint32)[is_number])


@pytest.mark.slow
@settings(max_examples=40, deadline=None)
@given(programs(2), programs(1), programs(1))
def test_bits_do_not_depend_on_what_else_a_kernel_computes(program: list, before: list, after: list) -> None:
    """Neither on what was built before, nor on what else uses the same values, nor on where inputs lie."""
    same_bits(program, before, after)


@pytest.mark.long
@settings(max_examples=500, deadline=None)
@given(programs(2), programs(1), programs(1))
def test_nor_do_those_of_many_programs(program: list, before: list, after: list) -> None:
    same_bits(program, before, after)


def test_sums_are_added_one_by_one():
    x = np.tile(np.float32([1e8, 1.0, -1e8, 1.0]), (16, 1))
    ones = np.ones_like(x)
    of = jax.ShapeDtypeStruct((4,), np.float32)
    for function, arguments in (
        (lambda a: a.sum(), [x]),
        (lambda a, b: a @ b, [x, ones]),
    ):
        kernel = compile_kernel(function, *[of] * len(arguments))
        np.testing.assert_array_equal(kernel(*arguments), np.ones(16, np.float32))  # a tree: 0; two halves: 2
