"""Graphs of scalar operations. Nodes are numbered in an order in which they can be computed.

Equal expressions are one node (hash-consing). a + b and b + a are two nodes, because the rule of fusing in
`schedule.py` depends on the order of the arguments. The graph that simplifies while it is built is in `folding.py`.

A loop is a `Loop`, of a known number of trips or until no lane needs another one. Its carries are nodes ("carry") on
which its body depends, and its results are nodes ("result") on which the code after the loop depends. A node that
depends on no carry lies outside of the loop.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from workers.simd.graph.operations import NUMPY_DTYPES, OPERATIONS

NodeKey = tuple
SELECTS = {"f": "select", "i": "iselect", "b": "bselect"}
"""Operation that chooses between two values, by their dtype."""


@dataclass
class Loop:
    """A loop in which carry k starts as inits[k] and becomes outs[k] at the end of each trip."""

    number: int
    trips: int | None
    """Most trips, at least one; None if only `active` ends the loop."""
    inits: list[int]
    carries: list[int]
    outs: list[int] = field(default_factory=list)
    results: list[int] = field(default_factory=list)
    active: int | None = None
    """Position of the carry that says whether a lane needs another trip; None if all lanes make all trips.

    Where it is false, a trip changes nothing. So the loop ends as soon as it is false in all lanes of a vector, and
    the result of a lane still depends on no other lane.
    """


class Graph:
    """An append-only graph. `keys[node]` defines a node: (operation, *argument nodes), or one of

    ("const", dtype, bits), ("input", dtype, position),
    ("carry", dtype, loop, position), ("result", dtype, loop, position), ("pair", node, node).

    A dtype is "f" (float32), "i" (32-bit integer), "b" (bool) or "k" (a pair).
    """

    def __init__(self) -> None:
        self.keys: list[NodeKey] = []
        self.dtypes: list[str] = []
        self.loops: list[Loop] = []
        self.place: Any = None
        """Where the nodes that are added next come from, as whoever adds them says."""
        self.places: list[Any] = []
        """`place` when each node was added."""
        self._known: dict[NodeKey, int] = {}
        self._arguments: list[tuple[int, ...]] = []
        """Argument nodes of each node; empty for nodes that are no operations."""
        self._constants: dict[int, Any] = {}
        """Value of each constant node as a NumPy scalar."""

    def const(self, dtype: str, value: float | int | bool) -> int:
        array = np.asarray(value, NUMPY_DTYPES[dtype])
        bits = int(array.view(np.int32)) if dtype == "f" else int(array)
        node = self._node(("const", dtype, bits), dtype)
        self._constants[node] = array[()]
        return node

    def f(self, value: float) -> int:
        return self.const("f", value)

    def i(self, value: int) -> int:
        """Node of an integer constant; a number from 2^31 on stands for the int32 with the same bits."""
        return self.const("i", (value + 2**31) % 2**32 - 2**31)

    def input(self, dtype: str, position: int) -> int:
        """Node of the kernel's input word at a position."""
        return self._node(("input", dtype, position), dtype)

    def constant(self, node: int) -> Any:
        """Value of a constant node as a NumPy scalar; None for other nodes."""
        return self._constants.get(node)

    def arguments(self, node: int) -> tuple[int, ...]:
        """Argument nodes of an operation; empty for nodes that are no operations."""
        return self._arguments[node]

    def needs(self, node: int) -> tuple[int, ...]:
        """Nodes on which a node depends directly: a result on its carry, a carry on its start and its end."""
        if arguments := self._arguments[node]:
            return arguments
        key = self.keys[node]
        match key[0]:
            case "result":
                return (self.loops[key[2]].carries[key[3]],)
            case "carry":
                loop = self.loops[key[2]]
                return (loop.inits[key[3]], loop.outs[key[3]]) if loop.outs else (loop.inits[key[3]],)
        return ()

    def loop(self, trips: int | None, inits: list[int]) -> Loop:
        """Open a loop whose body is built next from its carries; `close` ends it."""
        number = len(self.loops)
        dtypes = [self.dtypes[node] for node in inits]
        carries = [self._node(("carry", dtype, number, k), dtype) for k, dtype in enumerate(dtypes)]
        self.loops.append(Loop(number, trips, list(inits), carries))
        return self.loops[-1]

    def pair(self, first: int, second: int) -> int:
        """Node that stands for the two words of a key of JAX while tracing; no operation takes it."""
        return self._node(("pair", first, second), "k")

    def words(self, node: int) -> tuple[int, ...]:
        """The nodes of the words for which a node stands: itself, or the two of a pair."""
        return self.keys[node][1:] if self.dtypes[node] == "k" else (node,)

    def choose(self, mask: int, if_true: int, if_false: int) -> int:
        """Node that chooses between two nodes of the same dtype by a bool node."""
        if self.dtypes[if_true] == "k":
            words = zip(self.words(if_true), self.words(if_false), strict=True)
            return self.pair(*(self.choose(mask, *both) for both in words))
        return self.op(SELECTS[self.dtypes[if_true]], mask, if_true, if_false)

    def close(self, loop: Loop, outs: list[int]) -> list[int]:
        """Set the nodes that the carries become at the end of a trip; returns the loop's results."""
        loop.outs, loop.active = list(outs), self.ending(loop, outs)
        assert loop.trips is not None or loop.active is not None, "a loop ends"
        for k, out in enumerate(outs):
            assert self.dtypes[out] == self.dtypes[loop.carries[k]], "a loop carries values of one dtype"
        dtypes = [self.dtypes[node] for node in outs]
        loop.results = [self._node(("result", dtype, loop.number, k), dtype) for k, dtype in enumerate(dtypes)]
        return loop.results

    def ending(self, loop: Loop, outs: Sequence[int]) -> int | None:
        """Position of the carry without which a trip changes nothing (see `Loop.active`), or None if there is none.

        It becomes itself and something else, and every other carry is chosen by it or never changes.
        """

        def kept_without(active: int, carry: int, out: int) -> bool:
            key = self.keys[out]
            return out == carry or (key[0] in SELECTS.values() and key[1] == active and key[3] == carry)

        for k, active in enumerate(loop.carries):
            key = self.keys[outs[k]]
            is_over = self.dtypes[outs[k]] == "b" and self.constant(outs[k]) is not None and not self.constant(outs[k])
            if is_over or (key[0] == "and" and active in key[1:]):
                others = (pair for j, pair in enumerate(zip(loop.carries, outs, strict=True)) if j != k)
                if all(kept_without(active, carry, out) for carry, out in others):
                    return k
        return None

    def op(self, name: str, *arguments: int) -> int:
        """Node of an operation on nodes."""
        operation = OPERATIONS[name]
        if operation.commutes and arguments[0] > arguments[1]:
            arguments = (arguments[1], arguments[0])
        key = (name, *arguments)
        node = self._known.get(key)
        if node is None:
            assert "".join([self.dtypes[a] for a in arguments]) == operation.takes, key
            node = self._known[key] = self.build(name, arguments)
        return node

    def build(self, name: str, arguments: tuple[int, ...]) -> int:
        """Node of an operation that does not exist yet; only `op` calls this."""
        return self._node((name, *arguments), OPERATIONS[name].gives, arguments)

    def _node(self, key: NodeKey, dtype: str, arguments: tuple[int, ...] = ()) -> int:
        known = self._known.get(key)
        if known is None:
            known = self._known[key] = len(self.keys)
            self.keys.append(key)
            self.dtypes.append(dtype)
            self.places.append(self.place)
            self._arguments.append(arguments)
        return known


def live(graph: Graph, outputs: Iterable[int]) -> set[int]:
    """Nodes on which outputs depend. A loop's carry is among them only if it is needed."""
    return reached(outputs, graph.needs)


def reached(starts: Iterable[int], needs: Callable[[int], Iterable[int]]) -> set[int]:
    """All nodes that can be reached from `starts` through `needs`, including `starts`."""
    nodes: set[int] = set()
    waiting = list(starts)
    while waiting:
        node = waiting.pop()
        if node not in nodes:
            nodes.add(node)
            waiting += needs(node)
    return nodes


def depending(graph: Graph, loop: Loop) -> set[int]:
    """Nodes of a loop's body: all nodes that depend on its carries, except its results and their dependents.

    An inner loop is inside with all of its carries or with none.
    """
    body, results = set(loop.carries), set(loop.results)
    fresh = loop.carries
    while fresh:
        for node in range(min(fresh), len(graph.keys)):
            if node not in body and not body.isdisjoint(graph.needs(node)) and node not in results:
                body.add(node)
        # All but the carries of inner loops have greater numbers than what they depend on, so one pass finds the rest.
        fresh = []
        for inner in graph.loops[loop.number + 1 :]:
            if not body.isdisjoint((*inner.carries, *inner.outs)):
                fresh += [carry for carry in inner.carries if carry not in body]
        body.update(fresh)
    return body


# The error for functions that this compiler does not support; xla computes them instead.

_UNIFORMS = (
    "draw by JAX's own generator, threefry2x32, or by es_service.protocol.noise.uniforms(key, counters), with the key "
    "of reset and a counter in the state"
)
_ONE_HOT = (
    "instead of array[index] write jax.nn.one_hot(index, len(array)) @ array, or with policy.output = argmax, whose "
    "action is such a vector, action @ array"
)
_UPDATE = "instead of array.at[index].set(x) write jnp.where(jnp.arange(len(array)) == index, x, array)"
_FORMULA = (
    "factor positive definite matrices by jnp.linalg.cholesky, write other small systems out, or solve them by a fixed "
    "number of iterations"
)
_FEWER = "sort fewer numbers in a row; the least and the greatest are jnp.min and jnp.max"
WAYS_ROUND = {
    "gather": _ONE_HOT,
    "dynamic_slice": _ONE_HOT,
    "dynamic_update_slice": _UPDATE,
    "scatter": _UPDATE,
    "scatter-add": _UPDATE.replace(".set(x)", ".add(x)").replace("x, array", "array + x, array"),
    "scatter-mul": _UPDATE.replace(".set(x)", ".multiply(x)").replace("x, array", "array * x, array"),
    "sort": _FEWER,
    "top_k": _FEWER,
    **dict.fromkeys(("lu", "qr", "eigh", "svd"), _FORMULA),
}
"""Primitive that is not supported, or not for arrays as large -> what a task can do instead."""


def way_round(primitive: str) -> str:
    """What a task can do instead of a primitive that is not supported; empty if nothing is known."""
    if primitive.startswith(("random_", "threefry", "rng_")):
        return _UNIFORMS
    return WAYS_ROUND.get(primitive, "")


class UnsupportedError(Exception):
    """A function cannot be compiled; the message names the unsupported part, where it comes from and a way round."""

    def __init__(self, message: str, *, place: str = "", advice: str = "") -> None:
        """`place` is the line of the task that has the unsupported part, and `advice` what it can do instead, if that
        is known."""
        super().__init__(message + (f" (at {place})" if place else "") + (f"; {advice}" if advice else ""))
        self.message, self.place, self.advice = message, place, advice


@contextlib.contextmanager
def refusing() -> Iterator[None]:
    """Context manager that turns exceptions into UnsupportedError, since no rule foresees all that JAX can trace.

    It is only for code whose success depends on the compiled function alone: either every worker falls back to JAX or
    none does.
    """
    try:
        yield
    except (UnsupportedError, MemoryError):
        raise
    except Exception as error:
        raise UnsupportedError(fault(error)) from error


def fault(error: Exception) -> str:
    """Text of an exception that no rule foresaw: not a task that is not supported, but a fault of this compiler."""
    return f"a fault of es-service's compiler, please report it ({type(error).__name__}: {error})"
