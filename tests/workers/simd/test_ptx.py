"""Code for GPUs: on this processor its functions of single lanes have the bits of kernels, and ptxas accepts it."""

from __future__ import annotations

import re
import shutil
import subprocess
from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from tests.benchmarks.gpu.kernels import (
    FIVE,
    division_functions,
    function_of,
    operation_arguments,
    operation_functions,
    operations,
    physics_functions,
    physics_of,
)
from tests.workers.simd.host_gpu import on_host, single_lanes
from workers.simd.backend.native import pack
from workers.simd.backend.ptx import Pointer, StepCall, lane_function, ptx
from workers.simd.backend.target import Target, target_of
from workers.simd.episodes.kernel import compile_kernel
from workers.simd.frontend.trace import trace_jaxpr
from workers.simd.graph.operations import compute
from workers.simd.graph.schedule import evaluate

LANES = 21
NAN = np.uint32(0x7FC00000)


@pytest.fixture
def one() -> Iterator[Target]:
    """Target of this processor with vectors of one lane."""
    with single_lanes() as target:
        yield target


def without_nans(words: np.ndarray) -> np.ndarray:
    return np.where(np.isnan(words.view(np.float32)), NAN, words)


def words_of(tree) -> np.ndarray:
    """Words [word, lane] of arrays [lane, ...]."""
    leaves = jax.tree.leaves(tree)
    return np.ascontiguousarray(pack(leaves, len(leaves[0]))[0])


@pytest.mark.parametrize(
    ("task", "quick"),
    [
        ("point_maze", False),
        ("point_maze", True),
        pytest.param("ant_trap", False, marks=pytest.mark.long),
        pytest.param("ant_trap", True, marks=pytest.mark.long),
    ],
)
def test_steps_of_single_lanes_have_the_bits_of_kernels(task: str, quick: bool, one: Target) -> None:
    physics, functions = physics_of(task), physics_functions(physics_of(task), one, quick=quick)
    rng, steps = np.random.default_rng(0), 5
    keys = rng.integers(0, 2**32, (LANES, 4), dtype=np.uint32)
    actions = rng.uniform(-1, 1, (steps, LANES, *physics.action.shape)).astype(np.float32)
    carry = compile_kernel(physics.begin, jax.ShapeDtypeStruct((4,), np.uint32))(keys)
    states = np.zeros((len(words_of(carry)), LANES), np.uint32)
    on_host(functions, "begin")(np.ascontiguousarray(keys.T), states, LANES, 1)
    np.testing.assert_array_equal(states, words_of(carry))
    kernel = compile_kernel(physics.step, physics.carry, physics.action)
    for action in actions:
        carry = kernel(carry, action)
    on_host(functions, "physics")(states, np.ascontiguousarray(actions.transpose(0, 2, 1)), LANES, steps)
    np.testing.assert_array_equal(without_nans(states), without_nans(words_of(carry)))


@pytest.mark.parametrize("quick", [False, True])
def test_loops_that_data_ends_have_the_bits_of_kernels_for_single_lanes(quick: bool, one: Target) -> None:
    def function(x):
        def trip(carry):
            number, x = carry
            return number + 1, lax.while_loop(lambda x: jnp.abs(x).max() > 0.1, lambda x: jnp.sin(x[::-1]) / 1.7, x * 9)

        return lax.while_loop(lambda carry: carry[0] < jnp.abs(x[0]) * 9, trip, (0, x))[1]

    x = np.random.default_rng(0).normal(size=(LANES, 2)).astype(np.float32)
    of = jax.ShapeDtypeStruct((2,), np.float32)
    made = function_of("f", function, [("x", of)], "found", one, quick=quick)
    pointers = [Pointer("x"), Pointer("found")]
    found = np.zeros((2, LANES), np.uint32)
    on_host([*made, lane_function("k", pointers, [StepCall(made[-1], ("x", "found"))], one)], "k")(
        np.ascontiguousarray(x.T), found, LANES, 1
    )
    np.testing.assert_array_equal(found, words_of(compile_kernel(function, of)(x)))
    made = function_of("f", function, [("x", of)], "found", target_of("ptx"), quick=quick)
    assert ptx([*made, lane_function("k", pointers, [StepCall(made[-1], ("x", "found"))], target_of("ptx"))])


@pytest.mark.parametrize("quick", [False, True])
def test_operations_of_single_lanes_have_the_bits_of_the_reference(quick: bool, one: Target) -> None:
    graph, _, outputs = trace_jaxpr(jax.make_jaxpr(operations)(*FIVE))
    given = operation_arguments()
    with np.errstate(invalid="ignore"):
        wanted = [np.asarray(x) for x in evaluate(graph, outputs, given)]
    found = np.zeros((len(wanted), given.shape[1]), np.uint32)
    on_host(operation_functions(one, quick=quick), "operations")(given, found, given.shape[1], 1)
    for number, (ours, theirs) in enumerate(zip(found, wanted, strict=True)):
        theirs = theirs.astype(np.uint32) if theirs.dtype == bool else theirs
        np.testing.assert_array_equal(ours.view(theirs.dtype), theirs, err_msg=f"result {number}")


def test_quick_quotients_and_roots_are_rounded_correctly_everywhere(one: Target) -> None:
    rng = np.random.default_rng(0)
    words = rng.integers(0, 2**32, (3, 100_000), dtype=np.uint32)  # every exponent, infinities and NaN
    words[:, ::3] = rng.normal(size=words[:, ::3].shape).astype(np.float32).view(np.uint32)
    words[:2, ::7] = rng.choice(np.array([0.0, -0.0, 1.0, -3.0], np.float32), words[:2, ::7].shape).view(np.uint32)
    found = np.zeros((2, words.shape[1]), np.uint32)
    on_host(division_functions(one), "division")(words, found, words.shape[1], 1)
    a, b, c = words.view(np.float32)
    with np.errstate(invalid="ignore"):
        wanted = np.stack([compute("div", [a, b]), compute("sqrt", [c])])
    np.testing.assert_array_equal(without_nans(found), without_nans(wanted.view(np.uint32)))


@pytest.mark.parametrize("quick", [False, True])
def test_every_float_instruction_rounds_to_nearest_and_flushes_denormal_numbers(quick: bool) -> None:
    text = ptx(operation_functions(target_of("ptx"), quick=quick))
    names = {match[1] for match in re.finditer(r"^\s+(?:@!?%p\d+ )?([a-z][\w.]*\.f32)\b", text, re.MULTILINE)}
    arithmetic = {
        name
        for name in names
        if name.split(".")[0] in ("add", "sub", "mul", "fma", "div", "sqrt", "rcp") and "approx" not in name
    }
    assert {name.split(".")[0] for name in arithmetic} >= {"add", "sub", "mul", "fma", "div", "sqrt"}
    assert all(name.split(".")[1:] == ["rn", "ftz", "f32"] for name in arithmetic)
    others = {name for name in names - arithmetic if name.split(".")[0] in ("setp", "cvt", "neg", "abs")}
    assert all("ftz" in name for name in others if name.count("f32") == 2 or not name.startswith("cvt"))
    approximate = {name for name in names if "approx" in name}
    assert approximate == ({"rcp.approx.ftz.f32", "rsqrt.approx.ftz.f32"} if quick else set())


def test_a_product_and_a_sum_are_fused_only_where_the_graph_says() -> None:
    float_ = jax.ShapeDtypeStruct((), np.float32)
    arguments = [("given", float_)] * 3

    def text(function) -> str:
        (made,) = function_of("f", function, arguments, "found", target_of("ptx"))
        pointers = [Pointer("given"), Pointer("found")]
        return ptx([made, lane_function("k", pointers, [StepCall(made, ("given", "found"))], target_of("ptx"))])

    fused, apart = text(lambda a, b, c: a * b + c), text(lambda a, b, c: (a * b, a * b * c))
    assert fused.count("fma.rn.ftz.f32") == 1
    assert "mul.rn" not in fused
    assert apart.count("mul.rn.ftz.f32") == 2
    assert "fma" not in apart


def test_loops_keep_their_carries_in_registers() -> None:
    text = ptx(physics_functions(physics_of("point_maze"), target_of("ptx")))
    assert ".local" not in text
    assert "__local_depot" not in text


@pytest.mark.skipif(not shutil.which("ptxas"), reason="ptxas is not installed")
def test_ptxas_accepts_a_task(tmp_path) -> None:
    (tmp_path / "k.ptx").write_text(ptx(physics_functions(physics_of("point_maze"), target_of("ptx"))))
    command = ["ptxas", "-v", "-arch=sm_90a", str(tmp_path / "k.ptx"), "-o", str(tmp_path / "k.cubin")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "0 bytes spill stores" in done.stderr
