"""Factorisations and solves: which operations they consist of, by the zeros that a matrix is known to have."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from workers.simd.episodes.kernel import compile_kernel
from workers.simd.frontend.primitives.linear import better_order
from workers.simd.frontend.trace import trace_jaxpr
from workers.simd.graph.graph import live

ARMS = np.array(
    [
        [1, 1, 1, 1, 1],  # the trunk, and two arms of two links each
        [1, 1, 0, 1, 0],
        [1, 0, 1, 0, 1],
        [1, 1, 0, 1, 0],
        [1, 0, 1, 0, 1],
    ]
)


def operations(function: Any, *shapes: tuple[int, ...]) -> list[str]:
    """Operations of a function of arrays."""
    graph, _, outputs = trace_jaxpr(jax.make_jaxpr(function)(*(jnp.zeros(shape) for shape in shapes)))
    return [graph.keys[node][0] for node in live(graph, outputs) if graph.arguments(node)]


def solve(a: Any, b: Any) -> Any:
    return jax.scipy.linalg.cho_solve(jax.scipy.linalg.cho_factor(a), b)


def test_a_dense_solve_has_one_quotient_for_each_pivot_and_a_product_for_each_element():
    found = operations(solve, (3, 3), (3,))
    assert found.count("div") == found.count("sqrt") == 3
    assert found.count("mul") == 3 + 4 + 2 * (3 + 3), "below the diagonal, of the factor's sums, of two substitutions"


def test_a_tree_is_solved_from_its_leaves_without_a_product_more_than_its_elements_need():
    """By hand: a leaf has 2 neighbours, then its link 1, so 2 (2 + 1) elements of the factor are below its diagonal;
    each leaf has 3 products in sums of the factor, each link 1."""
    found = operations(lambda a, b: solve(jnp.where(ARMS, a, 0.0), b), (5, 5), (5,))
    assert found.count("div") == found.count("sqrt") == 5
    assert found.count("mul") == 6 + 2 * (3 + 1) + 2 * (6 + 5)


def test_arms_are_eliminated_from_their_ends_and_the_trunk_comes_last():
    assert better_order(ARMS.tolist()) == [4, 2, 3, 1, 0]
    assert better_order(ARMS[::-1, ::-1].tolist()) is None, "this is the order of the rows"
    assert better_order(np.ones((4, 4)).tolist()) is None
    assert better_order([]) is None


def test_a_factor_that_is_seen_is_in_the_order_of_the_rows():
    def function(a: Any, b: Any) -> Any:
        factor = jnp.linalg.cholesky(jnp.where(ARMS, a, 0.0))
        return factor, jax.scipy.linalg.cho_solve((factor, True), b)

    rng = np.random.default_rng(0)
    a = np.where(ARMS, rng.uniform(-0.2, 0.2, (5, 5)), 0.0).astype(np.float32)
    a, b = a + a.T + 2.0 * np.eye(5, dtype=np.float32), rng.normal(size=5).astype(np.float32)
    factor, found = (x[0] for x in compile_kernel(function, jnp.zeros((5, 5)), jnp.zeros(5))(a[None], b[None]))
    np.testing.assert_allclose(factor, np.linalg.cholesky(a), rtol=0, atol=3e-7)
    np.testing.assert_allclose(found, np.linalg.solve(a.astype(np.float64), b), rtol=0, atol=1e-6)


def test_of_a_product_that_is_symmetric_but_for_rounding_one_triangle_is_computed():
    """J' D J as MJX makes it symmetric: 6 of its 9 elements, of 4 products each, and the 12 elements of J' D."""

    def factor(j: Any, d: Any) -> Any:
        h = jnp.eye(3) + (j.T * d) @ j
        return jax.scipy.linalg.cho_factor((h + h.T) * 0.5)[0]

    found = operations(factor, (4, 3), (4,))
    assert found.count("mul") == 12 + 6 * 4 + 3 + 4
    other = operations(lambda j, k, d: factor(j, d) + jnp.linalg.cholesky((j.T * d) @ k), (4, 3), (4, 3), (4,))
    assert other.count("mul") > found.count("mul") + 9 * 4, "J' D K is not symmetric"


def test_a_matrix_that_is_not_symmetric_is_halved_with_its_transpose():
    rng = np.random.default_rng(0)
    a = (rng.uniform(-0.2, 0.2, (4, 3, 3)) + 2.0 * np.eye(3)).astype(np.float32)
    b = np.ones((4, 3), np.float32)
    kernel = compile_kernel(lambda a, b: jnp.linalg.cholesky(a * b * b[:, None]), jnp.zeros((3, 3)), jnp.zeros(3))
    np.testing.assert_allclose(kernel(a, b), np.linalg.cholesky((a + a.swapaxes(1, 2)) / 2.0), rtol=0, atol=3e-7)
