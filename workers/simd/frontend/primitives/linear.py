"""Rules of factorisations and of solves with triangular matrices.

Matrices are small and written out, one operation for each product. An element that is known to be 0 (a structural zero)
costs nothing, since products with it fold.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from workers.simd.frontend.primitives.registry import primitive
from workers.simd.frontend.tracer import Nodes, Tracer


@primitive("cholesky")
def _cholesky(t: Tracer, equation: Any, a: Nodes) -> Nodes:
    """Lower factors of matrices, of which only the lower triangle is read, column by column.

    If a pivot is negative, what depends on it is NaN; in JAX the whole factor is. If one is 0, what lies below it is
    infinite or NaN.
    """
    g, op, n = t.graph, t.graph.op, a.shape[-1]
    factors = np.full((a.size // max(n * n, 1), n, n), g.f(0.0), np.int64)
    for factor, matrix in zip(factors, a.reshape(factors.shape), strict=True):
        rows, given = factor.tolist(), matrix.tolist()
        for j in range(n):
            for i in range(j, n):
                rest = given[i][j]
                for k in range(j):
                    rest = op("sub", rest, op("mul", rows[i][k], rows[j][k]))
                rows[i][j] = op("sqrt", rest) if i == j else op("mul", rest, _reciprocal(t, rows[j][j]))
        factor[:] = rows
    return factors.reshape(a.shape)


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
            found[number] = _substitute(t, matrix.tolist(), column, forwards, params["unit_diagonal"])
    solutions = np.moveaxis(solutions, 1, -1).reshape(b.shape)
    return solutions if left else np.swapaxes(solutions, -1, -2)


def _substitute(t: Tracer, matrix: list[list[int]], right: list[int], forwards: bool, unit_diagonal: bool) -> list[int]:
    """Solution of a triangular system, from the first unknown on if the matrix is a lower triangle (`forwards`)."""
    op, n = t.graph.op, len(right)
    found = list(right)
    for i in range(n) if forwards else reversed(range(n)):
        for k in range(i) if forwards else range(i + 1, n):
            found[i] = op("sub", found[i], op("mul", matrix[i][k], found[k]))
        if not unit_diagonal:
            found[i] = op("mul", found[i], _reciprocal(t, matrix[i][i]))
    return found
