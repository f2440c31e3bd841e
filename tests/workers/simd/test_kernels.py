"""Machine code has the bits of its NumPy reference at every width, whatever lanes, blocks and threads there are."""

from __future__ import annotations

import ctypes
import functools
import platform
import threading
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from tests.workers.simd.rollouts import every_target
from workers.environments import make_environment
from workers.simd.backend import emit, native, target
from workers.simd.backend.native import aligned, pack
from workers.simd.backend.target import Target, host_target
from workers.simd.episodes.kernel import Kernel, compile_kernel
from workers.simd.episodes.noise_kernels import gradient_module
from workers.simd.frontend.trace import jaxpr_digest, trace_jaxpr
from workers.simd.graph.operations import OPERATIONS
from workers.simd.graph.schedule import evaluate

LANES = 100


def step_of(name: str):
    """(one step of a task with all it gives, states and actions [lane, ...])."""
    environment = make_environment(name, {})
    keys = np.random.default_rng(0).integers(0, 2**32, (LANES, 4), dtype=np.uint32)
    states = jax.tree.map(np.asarray, jax.jit(jax.vmap(environment.reset))(keys))
    actions = np.random.default_rng(1).uniform(-1, 1, (LANES, 2 if name == "point_maze" else 8)).astype(np.float32)

    def step(state, action):
        after, reward, done = environment.step(state, action)
        return after, reward, done, environment.observe(after), environment.descriptor(after)

    return step, states, actions


def one_of(tree):
    return jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape[1:], x.dtype), tree)


def words_of(tree) -> list[np.ndarray]:
    return [np.asarray(leaf) for leaf in jax.tree.leaves(tree)]


@functools.cache
def reference_of(name: str) -> list[np.ndarray]:
    """The words of `step_of` in NumPy; of the ants they take seconds."""
    step, states, actions = step_of(name)
    graph, _, outputs = trace_jaxpr(jax.make_jaxpr(step)(one_of(states), one_of(actions)))
    leaves = [np.ascontiguousarray(leaf.reshape(LANES, -1).T).view(np.uint32) for leaf in words_of((states, actions))]
    return [np.asarray(value) for value in evaluate(graph, outputs, np.concatenate(leaves))]


@pytest.mark.parametrize("target", every_target(), ids=lambda target: target.isa)
@pytest.mark.parametrize(
    "name",
    [
        "point_maze",
        *(pytest.param(name, marks=pytest.mark.long) for name in ("ant_trap", "ant_maze")),
    ],
)
def test_bits_are_the_references_on_every_target(name: str, target: Target) -> None:
    step, states, actions = step_of(name)
    kernel = compile_kernel(step, one_of(states), one_of(actions), target=target)
    found = np.concatenate([leaf.reshape(LANES, -1) for leaf in words_of(kernel(states, actions))], axis=1).T
    for number, (one, other) in enumerate(zip(found, reference_of(name), strict=True)):
        np.testing.assert_array_equal(one, other.astype(one.dtype), err_msg=f"word {number}")


@pytest.mark.parametrize("target", every_target(), ids=lambda target: target.isa)
def test_operations_are_the_references_for_special_values_too(target: Target) -> None:
    rng = np.random.default_rng(0)
    pool = np.array([0.0, -0.0, 1.0, -1.0, 0.3, np.inf, -np.inf, np.nan, 1e-30, 3e38, 2.5, 8388609.0], np.float32)
    a, b, c = (rng.choice(pool, 64) for _ in range(3))
    i, j = (rng.integers(0, 2**32, 64, dtype=np.uint32).view(np.int32) for _ in range(2))

    def function(a, b, c, i, j):
        return (
            a + b, a - b, a * b, a / b, -a, jnp.abs(a), jnp.sqrt(a), jnp.floor(a), jnp.ceil(a), jnp.round(a),
            a == b, a != b, a < b, a <= b, jnp.where(a < b, a, c), a * b + c, c - a * b, a * b - c,
            i + j, i - j, i * j, i & j, i | j, i ^ j, i << 3, i >> 3, lax.shift_right_logical(i, 3), i == j, i < j,
            i.astype(jnp.float32), lax.bitcast_convert_type(i, jnp.uint32).astype(jnp.float32), (a < b) ^ (b < c),
            lax.population_count(i), jnp.where(a < b, i, j), jnp.where(a < b, b < c, i < j),
            lax.bitcast_convert_type(i, jnp.float32),
            lax.div(i, j), lax.rem(i, j), *(divide(*(lax.bitcast_convert_type(x, jnp.uint32) for x in (i, j)))
                                            for divide in (lax.div, lax.rem)),
        )  # fmt: skip

    arguments = (a, b, c, i, j)
    graph, _, outputs = trace_jaxpr(jax.make_jaxpr(function)(*(x[0] for x in arguments)))
    used = {graph.keys[node][0] for node in range(len(graph.keys))}
    assert set(OPERATIONS) - used <= {"fma", "bits", "int_of_float", "int_of_bool", "ult", "unbits"}
    reference = evaluate(graph, outputs, np.array([np.asarray(x).view(np.uint32) for x in arguments]))
    found = compile_kernel(function, *(one_of(x) for x in arguments), target=target)(*arguments)
    for one, other in zip(found, reference, strict=True):
        np.testing.assert_array_equal(one, np.asarray(other).astype(one.dtype))


def halved(x):
    """As many halvings as a number needs to become small."""
    return lax.while_loop(lambda x: jnp.abs(x).max() > 0.01, lambda x: x * 0.5 - 1e-4 * jnp.sin(x[::-1]), x)


def swing(x):
    return lax.fori_loop(0, 500, lambda _, x: x - 0.01 * jnp.sin(x[::-1]), x)


@pytest.mark.parametrize("target", every_target(), ids=lambda target: target.isa)
def test_long_code_in_parts_has_the_same_bits(target: Target, tmp_path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With loops among its parts, one of which reads what was computed before it."""

    def function(x):
        y = jnp.sin(x) * x[::-1] + jnp.cumsum(x)
        z = lax.fori_loop(0, 400, lambda _, z: jnp.where(z > 3, z * 0.5 + y, z - y * y), y)
        return jnp.cumsum(z * y) - jnp.exp(-(z * z))

    x = np.random.default_rng(0).normal(0, 1, (LANES, 12)).astype(np.float32)
    monkeypatch.setattr(emit.Writer, "part", 10**9)
    whole = compile_kernel(function, one_of(x), target=target, folder=tmp_path / "whole")
    monkeypatch.setattr(emit.Writer, "part", 7)
    graph, inputs, outputs = trace_jaxpr(jax.make_jaxpr(function)(one_of(x)))
    assert emit.emit(graph, outputs, inputs, target).count("_never:") > 20
    parts = compile_kernel(function, one_of(x), target=target, folder=tmp_path / "parts")
    assert parts(x).tobytes() == whole(x).tobytes()


@pytest.mark.parametrize("function", [swing, halved])
def test_a_lane_does_not_know_its_neighbours(function: Callable) -> None:
    x = np.random.default_rng(0).normal(size=(LANES, 3)).astype(np.float32)
    kernel = compile_kernel(function, one_of(x))
    whole = kernel(x)
    for lanes in (1, 3, 17):
        np.testing.assert_array_equal(kernel(x[:lanes]), whole[:lanes])
    order = np.random.default_rng(1).permutation(LANES)
    np.testing.assert_array_equal(kernel(x[order]), whole[order])
    poisoned = x.copy()
    poisoned[::2] = np.nan
    np.testing.assert_array_equal(kernel(poisoned)[1::2], whole[1::2])


def test_threads_share_a_kernel_and_release_the_lock() -> None:
    x = np.random.default_rng(0).normal(size=(2**17, 3)).astype(np.float32)
    kernel = compile_kernel(swing, one_of(x))
    words = pack([x], kernel.target.width)
    outs = [aligned((len(words), kernel.words_out, kernel.target.width)) for _ in range(3)]
    kernel.run(words, outs[0])
    threads = [threading.Thread(target=kernel.run, args=(words, out)) for out in outs[1:]]
    for thread in threads:
        thread.start()
    turns = 0
    while any(thread.is_alive() for thread in threads):
        turns += 1
    assert turns > 1000, "this thread went on while each of the others was in one call"
    for out in outs[1:]:
        np.testing.assert_array_equal(out, outs[0])


def control_word() -> int:
    """The processor's floating-point settings, as they are in this thread."""
    text = """define i32 @kernel() {
      %word = alloca i32
      call void @llvm.x86.sse.stmxcsr(ptr %word)
      %value = load i32, ptr %word
      ret i32 %value
    }
    declare void @llvm.x86.sse.stmxcsr(ptr)"""
    address, alive = native.load_object(native.compile_object(text, host_target()), host_target())
    found = ctypes.CFUNCTYPE(ctypes.c_uint32)(address)()
    del alive
    return found


@pytest.mark.skipif(platform.machine() != "x86_64", reason="reads MXCSR; for Arm arm_driver.c reads FPCR")
def test_denormal_numbers_are_zeros_inside_and_settings_are_restored() -> None:
    before = control_word() & 0xFFC0  # without the flags of what happened
    kernel = compile_kernel(lambda x: (x * 0.5, x + x), jax.ShapeDtypeStruct((), jnp.float32))
    halves, doubles = kernel(np.array([1.2e-38, 1e-39, 1.0], np.float32))
    np.testing.assert_array_equal(halves, np.array([0.0, 0.0, 0.5], np.float32))
    np.testing.assert_array_equal(doubles, np.array([2.4e-38, 0.0, 2.0], np.float32))
    assert control_word() & 0xFFC0 == before
    assert np.float32(1.2e-38) * np.float32(0.5) != 0.0


def test_wrong_arguments_are_refused() -> None:
    kernel = compile_kernel(lambda x: x * 2.0, jax.ShapeDtypeStruct((3,), jnp.float32))
    with pytest.raises(ValueError, match="must not be called with these arrays"):
        kernel(np.zeros((5, 2), np.float32))
    with pytest.raises(ValueError, match="must not be called with these arrays"):
        kernel(np.zeros((5, 3), np.float64))
    with pytest.raises(ValueError, match="must not be called with these arrays"):
        kernel.run(aligned((1, 2, kernel.target.width)), aligned((1, 3, kernel.target.width)))


def test_outputs_may_be_inputs_constants_or_nothing() -> None:
    kernel = compile_kernel(lambda x: (x, jnp.float32(3.0), x[:0], x[1]), jax.ShapeDtypeStruct((2,), jnp.float32))
    x = np.arange(10, dtype=np.float32).reshape(5, 2)
    same, three, nothing, second = kernel(x)
    np.testing.assert_array_equal(same, x)
    np.testing.assert_array_equal(three, np.full(5, 3.0))
    assert nothing.shape == (5, 0)
    np.testing.assert_array_equal(second, x[:, 1])


def test_a_narrow_processor_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    triple, cpu, features = target._host()
    monkeypatch.setattr(target, "_host", lambda: (triple, cpu, features | {"avx2": False, "fma": False}))
    with pytest.raises(target.NoVectorsError, match="has no AVX2 and no FMA"):
        host_target()
    monkeypatch.setattr(target, "_host", lambda: (triple, cpu, features | {"avx512f": False}))
    assert host_target().isa == "avx2"
    with pytest.raises(target.NoVectorsError, match="has no AVX-512"):
        host_target("avx512")


def test_the_host_may_be_a_mac_or_something_unknown(monkeypatch: pytest.MonkeyPatch) -> None:
    """LLVM does not say what features the processor of a Mac has; all have NEON."""
    monkeypatch.setattr(target, "_host", lambda: ("arm64-apple-darwin24.0.0", "apple-m1", {}))
    mac = host_target()
    assert (mac.isa, mac.width, mac.features) == ("neon", 4, "")
    assert mac.describe() == "apple-m1, NEON, 4 lanes"
    code = native.compile_object(gradient_module(mac), mac)
    assert code.startswith(b"\xcf\xfa\xed\xfe"), "an object file of macOS"
    with pytest.raises(target.NoVectorsError, match="AVX2 was requested, which arm64 does not have"):
        host_target("avx2")
    monkeypatch.setattr(target, "_host", lambda: ("riscv64-unknown-linux-gnu", "generic", {}))
    with pytest.raises(target.NoVectorsError, match="no code for the architecture riscv64, only for x86_64, aarch64"):
        host_target()


def test_digests_tell_functions_apart_and_know_them_again() -> None:
    def digest(function, shape: tuple[int, ...] = (3,)) -> str:
        return jaxpr_digest(jax.make_jaxpr(function)(np.zeros(shape, np.float32)))

    table = np.arange(3, dtype=np.float32)
    same = [digest(lambda x: jnp.sin(x) * table), digest(lambda y: jnp.sin(y) * np.arange(3, dtype=np.float32))]
    assert same[0] == same[1]
    others = {
        digest(lambda x: jnp.cos(x) * table),
        digest(lambda x: jnp.sin(x) * (table + 1)),
        digest(lambda x: jnp.sin(x) * table, (3, 1)),
        digest(lambda x: table * jnp.sin(x)),
        digest(lambda x: jax.jit(jnp.sin)(x) * table),
        digest(lambda x: (jnp.sin(x) * table)[::-1]),
        digest(lambda x: (jnp.sin(x) * table)[:2]),
    }
    assert len(others | set(same)) == 8


def test_facts_say_what_compiling_took(tmp_path) -> None:
    first = compile_kernel(swing, jax.ShapeDtypeStruct((5,), jnp.float32), folder=tmp_path).facts
    assert not first.cached
    assert first.computed > 0
    assert first.code_bytes > 0
    again: Kernel = compile_kernel(swing, jax.ShapeDtypeStruct((5,), jnp.float32), folder=tmp_path)
    assert again.facts.cached
    assert again.facts.code_bytes == first.code_bytes
