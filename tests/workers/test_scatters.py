"""Functions without scatters that add compute the same sums."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from workers.environments import make_environment
from workers.rollouts.jax_tasks import without_scatters

IDS = np.array([2, 0, -1, 2, 3, 9, 0])
"""Rows of three: with one twice, and with those that JAX drops (in `segment_sum` also -1)."""


def sums(rows):
    """Sums of the rows by index, as NumPy would have them."""
    found = np.zeros((3, *rows.shape[1:]), np.float32)
    for index, row in zip(IDS, rows, strict=True):
        if 0 <= index < 3:
            found[index] += row
    return found


def segment_sums(x):
    return jax.ops.segment_sum(x, jnp.asarray(IDS), 3)


def added(x):
    return jnp.zeros((3, *x.shape[1:])).at[jnp.asarray(np.where(IDS < 0, 7, IDS))].add(x)


with_derivative = jax.custom_jvp(segment_sums)
with_derivative.defjvps(lambda x_dot, y, x: x_dot)
INSIDE = {
    "a call": jax.jit(segment_sums),
    "a branch": lambda x: lax.cond(x.sum() < 1e9, segment_sums, lambda x: jnp.zeros((3, *x.shape[1:])), x),
    "a loop": lambda x: lax.fori_loop(0, 1, lambda _, carry: carry + segment_sums(x), jnp.zeros((3, *x.shape[1:]))),
    "a scan": lambda x: lax.scan(lambda carry, _: (carry, segment_sums(carry)), x, None, 1)[1][0],
    "a loop with an end": lambda x: lax.while_loop(
        lambda at: at[0] < 1, lambda at: (at[0] + 1, segment_sums(x)), (0, jnp.ones((3, *x.shape[1:])))
    )[1],
    "a custom derivative": with_derivative,
    "at": added,
}


@pytest.mark.parametrize("name", INSIDE)
@pytest.mark.parametrize("shape", [(7,), (7, 4), (7, 2, 3)])
def test_sums_of_rows_are_those_of_numpy(name, shape):
    rows = np.random.default_rng(0).integers(-50, 50, (5, *shape)).astype(np.float32)  # sums of integers are exact
    dense = without_scatters(INSIDE[name])
    assert not scatters(dense, rows[0])
    np.testing.assert_array_equal(jax.jit(jax.vmap(dense))(rows), np.stack([sums(one) for one in rows]))


def test_constant_results_keep_their_dtypes():
    found = without_scatters(lambda x: (segment_sums(x), False, 3))(np.ones(7, np.float32))
    assert [one.dtype for one in found] == [np.float32, np.bool_, np.int32]


@pytest.mark.parametrize("change", ["set", "max", "multiply", "add"])
def test_other_scatters_stay_and_drop_what_they_should(change):
    def changed(x):
        first, second = jnp.asarray([0, 1, 3, 1, 0]), jnp.asarray([2, 4, 1, 0, 9])  # the second to the fourth fit
        return getattr(jnp.full((2, 4, 2), 2.0).at[first, second], change)(x)

    rows = np.random.default_rng(0).normal(size=(3, 5, 2)).astype(np.float32)
    dense = without_scatters(changed)
    assert scatters(dense, rows[0]) == scatters(changed, rows[0])
    np.testing.assert_array_equal(jax.vmap(dense)(rows), jax.vmap(changed)(rows))


def test_sums_clip_indices_and_keep_narrow_dtypes_as_jax_does():
    ids = np.array([9, 1])
    for function in (
        lambda x: x.at[ids].add(jnp.ones(2), mode="clip"),
        lambda x: x.astype(jnp.int8).at[ids].add(jnp.int8(100)).at[ids].add(jnp.int8(100)),
    ):
        found, wanted = without_scatters(function)(jnp.arange(4.0)), function(jnp.arange(4.0))
        assert found.dtype == wanted.dtype
        np.testing.assert_array_equal(found, wanted)


@pytest.mark.long
@pytest.mark.parametrize("task", ["ant_maze", "brax:halfcheetah"])
def test_a_step_of_physics_has_none_and_is_the_same(task):
    environment = make_environment(task, {})
    state = jax.jit(environment.reset)(np.arange(4, dtype=np.uint32))
    action = np.linspace(-1.0, 1.0, 6 if "half" in task else 8, dtype=np.float32)
    dense = without_scatters(environment.step)
    assert "scatter-add" in scatters(environment.step, state, action)
    assert "scatter-add" not in scatters(dense, state, action)
    same = jax.jit(lambda state, action: (environment.step(state, action), dense(state, action)))
    for _ in range(5):  # more would show chaos
        (state, *_), (other, *_) = same(state, action)
        for one, two in zip(jax.tree.leaves(state), jax.tree.leaves(other), strict=True):
            np.testing.assert_allclose(one, two, rtol=1e-4, atol=1e-4)


def scatters(function: Any, *arguments: Any) -> set[str]:
    """Names of the scatters in a function, also inside of its loops and calls."""

    def names(jaxpr: Any) -> set[str]:
        found = {str(one.primitive) for one in jaxpr.eqns if str(one.primitive).startswith("scatter")}
        for equation in jaxpr.eqns:
            for value in jax.tree.leaves(list(equation.params.values()), is_leaf=lambda x: hasattr(x, "eqns")):
                inner = getattr(value, "jaxpr", value)
                found |= names(inner) if hasattr(inner, "eqns") else set()
        return found

    return names(jax.make_jaxpr(function)(*arguments).jaxpr)
