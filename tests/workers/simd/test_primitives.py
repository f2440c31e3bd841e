"""Each primitive against JAX, with shapes, axes and values drawn by hypothesis."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from jax import lax

from tests.workers.simd.primitive_cases import CASES
from workers.simd.episodes.kernel import compile_kernel
from workers.simd.frontend.tracer import PRIMITIVES
from workers.simd.graph.graph import UnsupportedError


def check(function: Callable, arguments: list[np.ndarray]) -> None:
    kernel = compile_kernel(function, *(jax.ShapeDtypeStruct(x.shape[1:], x.dtype) for x in arguments))
    found, wanted = kernel(*arguments), jax.jit(jax.vmap(function))(*arguments)
    for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True):
        other = np.asarray(other)
        assert one.dtype == other.dtype
        assert one.shape == other.shape
        if one.dtype == np.float32:
            np.testing.assert_allclose(one, other, rtol=3e-6, atol=3e-6)
        else:
            np.testing.assert_array_equal(one, other)


SLOW = [HealthCheck.too_slow, HealthCheck.data_too_large, HealthCheck.function_scoped_fixture]


@pytest.mark.slow  # all of them together
@pytest.mark.parametrize("name", CASES)
@settings(max_examples=3, deadline=None, suppress_health_check=SLOW)
@given(data=st.data())
def test_a_primitive_is_jaxs(name: str, data: st.DataObject) -> None:
    check(*CASES[name](data.draw))


@pytest.mark.long
@pytest.mark.parametrize("name", CASES)
@settings(max_examples=50, deadline=None, suppress_health_check=SLOW)
@given(data=st.data())
def test_so_it_is_for_more_shapes_and_values(name: str, data: st.DataObject) -> None:
    check(*CASES[name](data.draw))


def primitives_of(jaxpr: Any) -> set[str]:
    found = {equation.primitive.name for equation in jaxpr.eqns}
    for equation in jaxpr.eqns:
        inner = jax.tree.leaves(list(equation.params.values()), is_leaf=lambda value: hasattr(value, "eqns"))
        found = found.union(*(primitives_of(one) for one in inner if hasattr(one, "eqns")))
    return found


@pytest.mark.slow
def test_every_primitive_has_a_case() -> None:
    tested: set[str] = set()

    @settings(max_examples=15, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
    @given(data=st.data())
    def collect(data: st.DataObject) -> None:
        for case in CASES.values():
            function, arguments = case(data.draw)
            tested.update(primitives_of(jax.make_jaxpr(function)(*(x[0] for x in arguments))))

    collect()
    newer = {"stack", "unstack"} if jax.__version_info__ < (0, 10, 1) else set()
    newer |= {"empty"} if jax.__version_info__ < (0, 12) else set()
    assert set(PRIMITIVES) - tested == newer


@pytest.mark.parametrize(
    ("function", "says"),
    [
        (lambda x: jnp.linalg.inv(jnp.outer(x, x)), "the primitive lu"),
        (
            lambda x: jnp.take(jnp.tile(x, 171), x[0].astype(jnp.int32)),
            r"gather with indices that depend on the state, among 513 places \(at most 512\)",
        ),
        (
            lambda x: jnp.zeros((30, 30)).at[x[0].astype(jnp.int32), x[1].astype(jnp.int32)].add(x[2]),
            r"scatter-add with indices that depend on the state, among 900 places \(at most 512\)",
        ),
        (lambda x: jnp.sort(jnp.tile(x, 300)), r"sort of 900 numbers, by 20,958 comparisons \(at most 20,000\)"),
        (lambda x: x.at[1].apply(jnp.sin), r"a function of single places, as by x.at\[i\].apply\(f\)"),
        (lambda x: x.astype(jnp.float16).astype(jnp.float32), "values of type float16"),
        (lambda x: jax.random.uniform(jax.random.key(0, impl="rbg"), x.shape), "values of type key<rbg>"),
        (
            lambda x: lax.while_loop(lambda c: c[0] < 10**6, lambda c: (c[0] + 1, c[1]), (0, x))[1],
            "a while loop of more",
        ),
    ],
)
def test_what_cannot_be_compiled_is_named_with_where_it_comes_from(function: Callable, says: str) -> None:
    with pytest.raises(UnsupportedError, match=rf"(?s){says}.*\(at .*test_primitives.py:[0-9]+"):
        compile_kernel(function, jax.ShapeDtypeStruct((3,), jnp.float32))


@pytest.mark.parametrize("dtype", [bool, np.int32])
def test_a_choice_of_one_case_is_that_case(dtype: type) -> None:
    check(lax.select_n, [np.zeros(5, dtype), np.arange(5, dtype=np.float32)])
