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
from workers.simd.graph.operations import NUMPY_DTYPES, OPERATIONS
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


def schedule(graph: Graph, outputs: Sequence[int], *, fuse: bool = True) -> Schedule:
    """Schedule of a graph in which each node is computed as late as possible, just before its first use.

    Args:
        fuse: products with their sums.
    """
    alive = live(graph, outputs)
    numbers = sorted({graph.keys[node][2] for node in alive if graph.keys[node][0] == "carry"})
    bodies = {number: depending(graph, graph.loops[number]) & alive for number in numbers}
    home: dict[int, int | None] = dict.fromkeys(alive)
    for number in sorted(numbers, key=lambda number: -len(bodies[number])):
        home.update(dict.fromkeys(bodies[number], number))
    fused = _fused(graph, alive, home) if fuse else {}

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


class _Group(NamedTuple):
    """Equal operations that need no result of each other."""

    name: str
    negated: int | None
    """Which argument is taken with the other sign; None for a plain operation."""
    nodes: list[int]
    arguments: list[tuple[int, ...]]
    """Argument nodes of each node."""


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
        operation: function (node, arguments) -> result of an operation, each time it is computed; None for the results
            with the bits of kernels. It needs products that are not fused.
        fuse: products with their sums, as kernels do.
    """
    assert operation is None or not fuse
    order = schedule(graph, outputs, fuse=fuse)
    alive = sorted(live(graph, outputs))
    row_of = np.full(len(graph.keys), -1)
    row_of[alive] = np.arange(len(alive))
    words_N_L = np.zeros((len(alive), words.shape[1]), np.uint32)
    for row, key in enumerate(graph.keys[node] for node in alive):
        if key[0] == "const":
            words_N_L[row] = as_words(np.asarray(graph.constant(alive[row])))
        elif key[0] == "input":
            words_N_L[row] = words[key[2]]

    def rows(nodes: Sequence[Any]) -> np.ndarray:
        found = row_of[np.array(nodes, np.intp)]
        assert (found >= 0).all(), "only nodes on which outputs depend have values"
        return found

    def values(at: Any, dtype: str) -> np.ndarray:
        found = words_N_L[at]
        return found != 0 if dtype == "b" else found.view(NUMPY_DTYPES[dtype])

    def straight(steps: Sequence[Any]) -> Callable[[], None]:
        """Function that computes nodes, equal operations together."""
        groups = [
            (group, OPERATIONS[group.name].takes, rows(group.nodes), rows(group.arguments).T)
            for group in _groups(graph, order.fused, steps)
        ]

        def run() -> None:
            for group, takes, nodes, arguments in groups:
                if operation is not None:
                    for number, node in enumerate(group.nodes):
                        given = [values(at[number], dtype) for at, dtype in zip(arguments, takes, strict=True)]
                        words_N_L[nodes[number]] = as_words(operation(node, given))
                    continue
                given = [values(at, dtype) for at, dtype in zip(arguments, takes, strict=True)]
                if group.negated is not None:
                    given[group.negated] = -given[group.negated]
                words_N_L[nodes] = as_words(compute_operation(group.name, given))

        return run

    def repeated(region: Region) -> Callable[[], None]:
        """Function that runs a loop."""
        loop, body = region.loop, planned(region)
        assert loop is not None
        starts, carries, outs = (
            rows([nodes[k] for k in region.carried]) for nodes in (loop.inits, loop.carries, loop.outs)
        )
        read = [k for k in region.carried if row_of[loop.results[k]] >= 0]
        results, ends = (rows([nodes[k] for k in read]) for nodes in (loop.results, loop.carries))
        active = None if loop.active is None else rows([loop.carries[loop.active]])

        def run() -> None:
            words_N_L[carries] = words_N_L[starts]
            for _ in itertools.count() if loop.trips is None else range(loop.trips):
                if active is not None and not words_N_L[active].any():
                    break
                body()
                words_N_L[carries] = words_N_L[outs]
            words_N_L[results] = words_N_L[ends]

        return run

    def planned(region: Region) -> Callable[[], None]:
        """Function that computes a region once."""
        parts: list[Callable[[], None]] = []
        begin = 0
        for end, step in enumerate([*region.steps, None]):
            if not isinstance(step, int):
                parts.append(straight(region.steps[begin:end]))
                begin = end + 1
            if isinstance(step, Region):
                parts.append(repeated(step))

        def run() -> None:
            for part in parts:
                part()

        return run

    planned(order.region)()
    return [values(row, graph.dtypes[node]) for row, node in zip(rows(outputs), outputs, strict=True)]


def as_words(values: Any) -> np.ndarray:
    """Values as words of 32 bits; a bool is 0 or 1."""
    return values.astype(np.uint32) if values.dtype == bool else values.view(np.uint32)


def _groups(graph: Graph, fused: Mapping[int, int], steps: Sequence[int]) -> list[_Group]:
    """The operations of straight code in an order in which each has its arguments, with equal ones together."""
    depth: dict[int, int] = {}
    found: dict[tuple[int, str, int | None], _Group] = {}
    for node in steps:
        name, negated, arguments = graph.keys[node][0], None, graph.arguments(node)
        product = fused.get(node)
        if product is not None:
            first, second = arguments
            if name == "sub":
                negated = 0 if product == second else 2
            name, arguments = "fma", (*graph.arguments(product), first if product == second else second)
        depth[node] = 1 + max((depth.get(argument, 0) for argument in arguments), default=0)
        group = found.setdefault((depth[node], name, negated), _Group(name, negated, [], []))
        group.nodes.append(node)
        group.arguments.append(arguments)
    return [found[key] for key in sorted(found, key=lambda key: key[0])]
