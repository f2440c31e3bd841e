"""Rules of factorisations and of solves with triangular matrices.

Matrices are small and written out, one operation for each product. An element that is known to be 0 (a structural zero)
costs nothing, since products with it fold.

A solve with both triangles of a factor, L' x = L^-1 b, is one with the matrix L L'. It is computed with the unknowns
in another order if that takes fewer operations, which the structural zeros of the matrix decide. In the inertia of a
robot, joints of different limbs have zeros: from the ends of the limbs to the trunk none of them is lost, and from the
trunk to the ends all of them are. The factor in its own order is then not computed, unless something else needs it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from workers.simd.frontend.tracer import Nodes, Tracer, primitive
from workers.simd.graph.graph import Graph

Matrix = list[list[int]]
"""Rows of nodes."""


@primitive("cholesky")
def _cholesky(t: Tracer, equation: Any, a: Nodes) -> Nodes:
    """Lower factors of matrices, of which only the lower triangle is read, column by column.

    If a pivot is negative, what depends on it is NaN; in JAX the whole factor is. If one is 0, what lies below it is
    infinite or NaN.
    """
    factors = []
    for given in a.reshape(int(np.prod(a.shape[:-2])), *a.shape[-2:]).tolist():
        matrix = [[_one_half(t, node) for node in row[:number]] for number, row in enumerate(given, 1)]
        rows = _factor(t, matrix)
        t.remembered["factored", _lower(rows)] = matrix
        factors.append(rows)
    return np.array(factors, np.int64).reshape(a.shape)


def _one_half(t: Tracer, node: int) -> int:
    """Node of x, for an element (x + y) / 2 of a matrix made symmetric whose halves differ by rounding alone.

    Such are the elements of J' D J above and below its diagonal: the same sums, of which the factors have another
    order. One of them is enough. Any other node is returned as it is.
    """
    g, key = t.graph, t.graph.keys[node]
    for factor, total in ((key[1], key[2]), (key[2], key[1])) if key[0] == "mul" else ():
        if g.constant(factor) == 0.5 and g.keys[total][0] == "add":
            x, y = g.arguments(total)
            return x if _terms(g, x) == _terms(g, y) else node
    return node


MOST_FACTORS = 32
"""Most factors of products that are compared."""


def _terms(g: Graph, node: int, depth: int = 3) -> tuple[Any, ...]:
    """Terms of a sum in their order, with the factors of each in an order that does not depend on the expression."""
    terms: list[Any] = []
    while depth and g.keys[node][0] in ("add", "sub"):
        name, node, last = g.keys[node]
        terms.append((name, _terms(g, last, depth - 1)))
    negative, factors, waiting = False, [], [node]
    while waiting:
        key = g.keys[waiting[-1]]
        if key[0] not in ("mul", "neg"):
            factors.append(waiting.pop())
            continue
        negative ^= key[0] == "neg"
        waiting[-1:] = key[1:]
        if len(waiting) + len(factors) > MOST_FACTORS:
            return (*terms, node)
    return (*terms, negative, *sorted(factors))


def _factor(t: Tracer, matrix: Matrix) -> Matrix:
    """Lower factor of a matrix, of which only the lower triangle is read."""
    op, n = t.graph.op, len(matrix)
    rows = [[t.graph.f(0.0)] * n for _ in range(n)]
    for j in range(n):
        for i in range(j, n):
            rest = matrix[i][j]
            for k in range(j):
                rest = op("sub", rest, op("mul", rows[i][k], rows[j][k]))
            rows[i][j] = op("sqrt", rest) if i == j else op("mul", rest, _reciprocal(t, rows[j][j]))
    return rows


def _lower(matrix: Matrix) -> tuple[int, ...]:
    """Nodes of the lower triangle of a matrix."""
    return tuple(node for number, row in enumerate(matrix, 1) for node in row[:number])


def _reciprocal(t: Tracer, pivot: int) -> int:
    """Node of 1 / pivot. Factorisations and solves multiply by it: the quotient of each pivot is computed once."""
    return t.graph.op("div", t.graph.f(1.0), pivot)


@primitive("triangular_solve")
def _triangular_solve(t: Tracer, equation: Any, a: Nodes, b: Nodes) -> Nodes:
    """Solutions by substitution; only the named triangle of each matrix is read."""
    params, left = equation.params, equation.params["left_side"]
    transposed = params["transpose_a"] == left  # x a = b is a' x' = b'
    b = b if left else np.swapaxes(b, -1, -2)
    a = np.swapaxes(a, -1, -2) if transposed else a
    forwards = params["lower"] != transposed
    rights = np.moveaxis(b.reshape(-1, *b.shape[-2:]), -1, 1)
    solutions = np.empty(rights.shape, np.int64)
    for matrix, columns, found in zip(a.reshape(-1, *a.shape[-2:]), rights, solutions, strict=True):
        for number, column in enumerate(columns.tolist()):
            found[number] = _solve(t, matrix.tolist(), column, forwards, params["unit_diagonal"])
    solutions = np.moveaxis(solutions, 1, -1).reshape(b.shape)
    return solutions if left else np.swapaxes(solutions, -1, -2)


def _solve(t: Tracer, matrix: Matrix, right: list[int], forwards: bool, unit_diagonal: bool) -> list[int]:
    """Solution of a triangular system, the second of a factored one in the better order of elimination."""
    lower = _lower(matrix if forwards else [list(column) for column in zip(*matrix, strict=True)])
    factored = None if unit_diagonal else t.remembered.get(("factored", lower))
    if factored and not forwards and (given := t.remembered.get(("solved", lower, *right))):
        if ("in order", lower) not in t.remembered:
            t.remembered["in order", lower] = _factor_in_order(t, factored)
        if in_order := t.remembered["in order", lower]:
            order, factor = in_order
            return _solve_in_order(t, order, factor, given)
    found = _substitute(t, matrix, right, forwards, unit_diagonal)
    if factored and forwards:
        t.remembered["solved", lower, *found] = right
    return found


def _factor_in_order(t: Tracer, matrix: Matrix) -> tuple[list[int], Matrix] | None:
    """(a better order of the unknowns, lower factor of the matrix in this order); None if there is none."""
    order = better_order([[t.graph.constant(node) != 0.0 for node in row] for row in matrix])
    if order is None:
        return None
    return order, _factor(t, [[matrix[max(i, j)][min(i, j)] for j in order] for i in order])


def _solve_in_order(t: Tracer, order: Sequence[int], factor: Matrix, right: Sequence[int]) -> list[int]:
    """Solution of a positive definite system by the factor of its matrix in an order."""
    half = _substitute(t, factor, [right[i] for i in order], True, False)
    transposed = [list(column) for column in zip(*factor, strict=True)]
    found = dict(zip(order, _substitute(t, transposed, half, False, False), strict=True))
    return [found[i] for i in range(len(order))]


def better_order(nonzero: Sequence[Sequence[bool]]) -> list[int] | None:
    """An order of elimination that takes fewer operations than the order of the rows; None if the rule finds none.

    The next unknown is the one with the fewest neighbours that are left (minimum degree), of several the last: links
    are numbered from the trunk outwards. Eliminating an unknown makes its neighbours neighbours of each other.

    Args:
        nonzero: for each element of a symmetric matrix whether it may differ from 0; only the lower triangle is read.
    """
    natural, _ = _eliminate(nonzero, lambda near: min(near))
    fewest, order = _eliminate(nonzero, lambda near: min(near, key=lambda i: (len(near[i]), -i)))
    return order if fewest < natural else None


def _eliminate(
    nonzero: Sequence[Sequence[bool]], following: Callable[[dict[int, set[int]]], int]
) -> tuple[int, list[int]]:
    """(number of operations of a factorisation and a solve, order), if `following` names the next unknown."""
    near = {
        i: {j for j in range(len(nonzero)) if i != j and nonzero[max(i, j)][min(i, j)]} for i in range(len(nonzero))
    }
    operations, order = 0, []
    while near:
        order.append(following(near))
        neighbours = near.pop(order[-1])
        operations += len(neighbours) * (len(neighbours) + 7) // 2
        for i in neighbours:
            near[i] = (near[i] | neighbours) - {i, order[-1]}
    return operations, order


def _substitute(t: Tracer, matrix: Matrix, right: list[int], forwards: bool, unit_diagonal: bool) -> list[int]:
    """Solution of a triangular system, from the first unknown on if the matrix is a lower triangle (`forwards`)."""
    op, n = t.graph.op, len(right)
    found = list(right)
    for i in range(n) if forwards else reversed(range(n)):
        for k in range(i) if forwards else range(i + 1, n):
            found[i] = op("sub", found[i], op("mul", matrix[i][k], found[k]))
        if not unit_diagonal:
            found[i] = op("mul", found[i], _reciprocal(t, matrix[i][i]))
    return found
