"""A graph of scalar operations. Nodes are numbers, in an order in which they can be computed.

Equal expressions are one node (hash-consing); a + b and b + a are two, because of the rule in `schedule.py`. The graph
that simplifies while it is built is in `folding.py`.

A loop is a `Loop`: its carries are nodes ("carry") that its body hangs on, its results nodes ("result") that what comes
after hangs on. What hangs on no carry lies outside by itself.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from workers.simd.graph.operations import NUMPY_DTYPES, OPERATIONS

Key = tuple


@dataclass
class Loop:
    """Repeated `trips` times, at least once: carry k starts as inits[k], and is outs[k] at the end of each trip."""

    number: int
    trips: int
    inits: list[int]
    carries: list[int]
    outs: list[int] = field(default_factory=list)
    results: list[int] = field(default_factory=list)


class Graph:
    """Append-only; `keys[node]` is what a node is: (operation, *argument nodes), or

    ("const", dtype, bits), ("input", dtype, position), ("carry", dtype, loop, position), ("result", dtype, loop, position).
    """

    def __init__(self) -> None:
        self.keys: list[Key] = []
        self.dtypes: list[str] = []
        self.loops: list[Loop] = []
        self._known: dict[Key, int] = {}

    def const(self, dtype: str, value: float | int | bool) -> int:
        """A constant."""
        array = np.asarray(value, NUMPY_DTYPES[dtype])
        bits = int(array.view(np.int32)) if dtype == "f" else int(array)
        return self._node(("const", dtype, bits), dtype)

    def f(self, value: float) -> int:
        """A float32 constant."""
        return self.const("f", value)

    def i(self, value: int) -> int:
        """An integer constant; numbers of 2^31 and more are those of the same bits."""
        return self.const("i", (value + 2**31) % 2**32 - 2**31)

    def input(self, dtype: str, position: int) -> int:
        """The kernel's input word at a position."""
        return self._node(("input", dtype, position), dtype)

    def constant(self, node: int) -> Any:
        """The value of a constant node, a NumPy scalar; else None."""
        key = self.keys[node]
        if key[0] != "const":
            return None
        array = np.array(key[2], np.int32 if key[1] == "f" else NUMPY_DTYPES[key[1]])
        return array.view(np.float32)[()] if key[1] == "f" else array[()]

    def arguments(self, node: int) -> tuple[int, ...]:
        """Nodes that an operation is applied to; nothing for other nodes."""
        key = self.keys[node]
        return key[1:] if key[0] in OPERATIONS else ()

    def needs(self, node: int) -> tuple[int, ...]:
        """Nodes that a node cannot do without: a result its carry, a carry its start and its end."""
        key = self.keys[node]
        match key[0]:
            case "result":
                return (self.loops[key[2]].carries[key[3]],)
            case "carry":
                loop = self.loops[key[2]]
                return (loop.inits[key[3]], loop.outs[key[3]]) if loop.outs else (loop.inits[key[3]],)
        return self.arguments(node)

    def loop(self, trips: int, inits: list[int]) -> Loop:
        """Open a loop; its body is whatever is then built on its carries. Close it with `close`."""
        number = len(self.loops)
        dtypes = [self.dtypes[node] for node in inits]
        carries = [self._node(("carry", dtype, number, k), dtype) for k, dtype in enumerate(dtypes)]
        self.loops.append(Loop(number, trips, list(inits), carries))
        return self.loops[-1]

    def close(self, loop: Loop, outs: list[int]) -> list[int]:
        """Give a loop its ends; returns its results."""
        loop.outs = list(outs)
        for k, out in enumerate(outs):
            assert self.dtypes[out] == self.dtypes[loop.carries[k]], "a loop carries values of one dtype"
        dtypes = [self.dtypes[node] for node in outs]
        loop.results = [self._node(("result", dtype, loop.number, k), dtype) for k, dtype in enumerate(dtypes)]
        return loop.results

    def op(self, name: str, *arguments: int) -> int:
        """The node of an operation on nodes."""
        operation = OPERATIONS[name]
        if operation.commutes and arguments[0] > arguments[1]:
            arguments = (arguments[1], arguments[0])
        known = self._known.get((name, *arguments))
        if known is not None:
            return known
        assert "".join(self.dtypes[a] for a in arguments) == operation.takes, (name, arguments)
        node = self._known[(name, *arguments)] = self.build(name, arguments)
        return node

    def build(self, name: str, arguments: tuple[int, ...]) -> int:
        """The node of an operation that was not asked for before. For `op` alone."""
        return self._node((name, *arguments), OPERATIONS[name].gives)

    def _node(self, key: Key, dtype: str) -> int:
        known = self._known.get(key)
        if known is None:
            known = self._known[key] = len(self.keys)
            self.keys.append(key)
            self.dtypes.append(dtype)
        return known


def live(graph: Graph, outputs: Iterable[int]) -> set[int]:
    """Nodes that outputs hang on. A loop's carry is among them only where somebody needs it."""
    return reached(outputs, graph.needs)


def reached(starts: Iterable[int], needs: Callable[[int], Iterable[int]]) -> set[int]:
    """Nodes that some nodes hang on, themselves among them."""
    found: set[int] = set()
    waiting = list(starts)
    while waiting:
        node = waiting.pop()
        if node not in found:
            found.add(node)
            waiting += needs(node)
    return found


def depending(graph: Graph, loop: Loop) -> set[int]:
    """Nodes of a loop's body: what is made of its carries, but for its results and what comes after."""
    found = set(loop.carries)
    size = 0
    while len(found) != size:  # an inner loop's carries come before their ends: look again
        size = len(found)
        for node in range(min(found, default=0), len(graph.keys)):
            if node not in found and not found.isdisjoint(graph.needs(node)):
                key = graph.keys[node]
                if key[0] != "result" or key[2] != loop.number:
                    found.add(node)
        # A loop is inside with all its carries, or not at all.
        numbers = {graph.keys[node][2] for node in found if graph.keys[node][0] == "carry"}
        found.update(carry for number in numbers for carry in graph.loops[number].carries)
    return found
