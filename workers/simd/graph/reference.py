"""A graph computed in NumPy, node after node: what its machine code must give, bit for bit.

A worker compares code that is new to its machine with this, and tests do.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from workers.simd.graph.graph import Graph
from workers.simd.graph.operations import NUMPY_DTYPES
from workers.simd.graph.operations import compute as compute_operation
from workers.simd.graph.schedule import Region, schedule


def evaluate(
    graph: Graph,
    outputs: Sequence[int],
    words: np.ndarray,
    operation: Callable[[int, Sequence[Any]], Any] | None = None,
    *,
    fuse: bool = True,
) -> list[np.ndarray]:
    """Values of outputs over lanes.

    Args:
        words: uint32 [input word, lane].
        operation: function (node, arguments) -> result of an operation that is not fused, each time it is computed;
            None for the results with the bits of kernels.
        fuse: products with their sums, as kernels do.
    """
    order = schedule(graph, outputs)
    operation = operation or (lambda node, arguments: compute_operation(graph.keys[node][0], arguments))
    values: dict[int, np.ndarray] = {}
    given: dict[int, np.ndarray] = {}

    def value(node: int) -> np.ndarray:
        if node in values:
            return values[node]
        key = graph.keys[node]
        if key[0] not in ("const", "input"):
            return computed(node)  # a product that only sums take in
        if node not in given and key[0] == "const":
            given[node] = np.full(words.shape[1], graph.constant(node))
        elif node not in given:
            word = words[key[2]]
            given[node] = word != 0 if key[1] == "b" else word.view(NUMPY_DTYPES[key[1]])
        return given[node]

    def computed(node: int) -> np.ndarray:
        product = order.fused.get(node) if fuse else None
        arguments = [value(argument) for argument in graph.arguments(node)]
        if product is None:
            return operation(node, arguments)
        left, right = graph.arguments(node)
        a, b = (value(argument) for argument in graph.arguments(product))
        if graph.keys[node][0] == "sub" and product == right:
            return compute_operation("fma", [-a, b, value(left)])
        if graph.keys[node][0] == "sub":
            return compute_operation("fma", [a, b, -value(right)])
        return compute_operation("fma", [a, b, value(right if product == left else left)])

    def run(region: Region) -> None:
        for step in region.steps:
            if not isinstance(step, Region):
                values[step] = computed(step)
                continue
            loop = step.loop
            assert loop is not None
            carried = {k: value(loop.inits[k]) for k in step.carried}
            for _ in itertools.count() if loop.trips is None else range(loop.trips):
                if loop.active is not None and not carried[loop.active].any():
                    break
                values.update({loop.carries[k]: array for k, array in carried.items()})
                run(step)
                carried = {k: value(loop.outs[k]) for k in step.carried}
            values.update({loop.results[k]: array for k, array in carried.items()})

    run(order.region)
    return [value(node) for node in outputs]
