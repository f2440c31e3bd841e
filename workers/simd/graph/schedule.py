"""The order in which a graph is computed, the loop of each node, and the products that are fused with their sums; and
its results in this order, in NumPy.

Fusing depends on the expression alone. A sum or difference of floats is fused with a product among its arguments, or
with the second if both are products, no matter what else uses that product. The product is also computed separately
only if something other than sums needs it. So an expression has the same bits in every kernel that contains it,
whatever else that kernel computes.

`evaluate` gives what machine code must give, bit for bit. A worker compares code that is new to its machine with this,
and tests do.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from workers.simd.graph.graph import Graph, Loop, depending, live, reached
from workers.simd.graph.operations import NUMPY_DTYPES
from workers.simd.graph.operations import compute as compute_operation


@dataclass
class Region:
    """Straight code with loops in it: a whole kernel or the body of a loop."""

    loop: Loop | None
    carried: list[int] = field(default_factory=list)
    """Positions of the loop's carries that are needed."""
    steps: list[int | Region] = field(default_factory=list)
    """Nodes to compute and loops to run, in this order; products that are only fused with sums are not included."""
    wanted_inside: set[int] = field(default_factory=set)
    """Nodes computed in this region that a loop in this region reads."""


class Schedule(NamedTuple):
    """The order of a graph's operations and the products that are fused."""

    region: Region
    fused: dict[int, int]
    """Sum or difference -> the product it is fused with; both become one operation, which is rounded once."""


def schedule(graph: Graph, outputs: Sequence[int]) -> Schedule:
    """Schedule of a graph in which each node is computed as late as possible, just before its first use."""
    alive = live(graph, outputs)
    numbers = sorted({graph.keys[node][2] for node in alive if graph.keys[node][0] == "carry"})
    bodies = {number: depending(graph, graph.loops[number]) & alive for number in numbers}
    home: dict[int, int | None] = dict.fromkeys(alive)
    for number in sorted(numbers, key=lambda number: -len(bodies[number])):
        home.update(dict.fromkeys(bodies[number], number))
    fused = _fused(graph, alive, home)

    def needs(node: int) -> tuple[int, ...]:
        """As `graph.needs`, but with a fused product replaced by its factors."""
        product = fused.get(node)
        if product is None:
            return graph.needs(node)
        first, second = graph.arguments(node)
        factors = graph.arguments(product)
        return (*factors, second) if product == first else (first, *factors)

    needed = reached(outputs, needs)
    outside = {number: _outside(graph.loops[number], bodies[number] & needed, needed, needs) for number in numbers}

    done = {node for node in alive if graph.keys[node][0] in ("const", "input", "carry")}  # no instruction or loop

    def build(number: int | None, targets: Sequence[int]) -> Region:
        """Region of the loop with a number, or of the whole kernel if None, that computes the targets."""
        region = Region(None if number is None else graph.loops[number])
        if region.loop is not None:
            region.carried = [k for k, carry in enumerate(region.loop.carries) if carry in needed]
            targets = [region.loop.outs[k] for k in region.carried]
        waiting = list(reversed(targets))
        while waiting:
            node = waiting[-1]
            if node in done or home[node] != number:
                waiting.pop()
                continue
            key = graph.keys[node]
            first = outside[key[2]] if key[0] == "result" else needs(node)
            missing = [need for need in first if need not in done and home[need] == number]
            if missing:
                waiting += reversed(missing)
                continue
            waiting.pop()
            if key[0] == "result":
                inner = graph.loops[key[2]]
                region.steps.append(build(inner.number, ()))
                region.wanted_inside.update(need for need in outside[key[2]] if home[need] == number)
                done.update(inner.results)
            else:
                region.steps.append(node)
                done.add(node)
        return region

    return Schedule(build(None, outputs), fused)


def _outside(loop: Loop, body: set[int], needed: set[int], needs: Callable[[int], tuple[int, ...]]) -> list[int]:
    """Nodes outside of a loop that the loop or a loop inside it reads or starts from."""
    sources = {need for node in body for need in needs(node)}
    sources.update(loop.inits[k] for k, carry in enumerate(loop.carries) if carry in needed)
    return sorted(sources - body)


def _fused(graph: Graph, nodes: Collection[int], home: Mapping[int, int | None]) -> dict[int, int]:
    """Sums and differences that are fused with a product -> that product.

    A product from outside of the loop that contains the sum is not fused: it is computed once and not in every trip.
    (A node is in a loop if it depends on the loop's carries, so this depends on the expression alone as well.) A sum
    whose arguments are the same node is not fused either, so that x - x is 0.
    """
    fused = {}
    for node in nodes:
        if graph.keys[node][0] in ("add", "sub"):
            first, second = graph.arguments(node)
            for argument in (second, first):
                if graph.keys[argument][0] == "mul" and home[argument] == home[node] and first != second:
                    fused[node] = argument
                    break
    return fused


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
