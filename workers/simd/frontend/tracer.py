"""Evaluation of jaxprs on nodes: each array is replaced by an array of node numbers.

Operations that only move values (slices, gathers, transposes) are done while tracing, on the node numbers, and cost the
kernel nothing. Arithmetic adds nodes.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jax.extend import source_info_util
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal
from numpy.typing import NDArray

from es_service.protocol.raised import is_users_file
from workers.simd.frontend.dtypes import check_bytes, graph_dtype
from workers.simd.graph.folding import FoldingGraph
from workers.simd.graph.loops import build_loop, build_while
from workers.simd.graph.unsupported import UnsupportedError, refusing, way_round

Nodes = NDArray[np.int64]
"""Node numbers, in the shape of the array that they represent."""
Rule = Callable[..., Any]
"""Rule of a primitive for arrays of nodes: f(tracer, equation, *arrays) -> an array, or a list of arrays."""
GRAPH_LIMIT = 2_000_000
"""Most nodes of a graph; a greater one would take too long to compile."""


class Place(NamedTuple):
    """Where an equation comes from."""

    source: source_info_util.SourceInfo
    outer: Place | None
    """The equation whose function contains it."""


def line_of(place: Place | None) -> str:
    """The innermost line of the user's files, as "file:line (function)"; without one, that of a library."""
    sources = []
    while place is not None:
        sources.append(place.source)
        place = place.outer
    for source in sources:
        for frame in source.traceback.frames if source.traceback is not None else ():
            if is_users_file(frame.file_name):
                return f"{frame.file_name}:{frame.line_num} ({frame.function_name})"
    return next(filter(None, map(source_info_util.summarize, sources)), "")


class Tracer:
    """Evaluator of jaxprs by the rules of their primitives; its methods make the nodes for these rules."""

    def __init__(self, graph: FoldingGraph, rules: Mapping[str, Rule]) -> None:
        self.graph, self.rules = graph, rules
        self.remembered: dict[Any, Any] = {}
        """What one rule notes of nodes for another."""
        self.lanes: int | None = None
        """Bool node: the lanes whose values are needed where the tracer is. None if those of all lanes are, as outside
        of branches and loops that depend on data."""

    def closed(self, closed: ClosedJaxpr, inputs: Sequence[Nodes]) -> list[Nodes]:
        """Outputs of a jaxpr that comes with its constants."""
        constants = [self.constants(np.asarray(value)) for value in closed.consts]
        return self.jaxpr(closed.jaxpr, constants, inputs)

    def jaxpr(self, jaxpr: Jaxpr, constants: Sequence[Nodes], inputs: Sequence[Nodes]) -> list[Nodes]:
        """Outputs of a jaxpr for given constants and inputs."""
        values: dict[Any, Nodes] = dict(zip([*jaxpr.constvars, *jaxpr.invars], [*constants, *inputs], strict=True))

        def read(atom: Any) -> Nodes:
            aval: Any = atom.aval
            return self.constants(np.asarray(atom.val, aval.dtype)) if isinstance(atom, Literal) else values[atom]

        outer = self.graph.place
        for equation in jaxpr.eqns:
            self.graph.place = Place(equation.source_info, outer)
            rule = self.rules.get(equation.primitive.name)
            try:
                if rule is None:
                    name = equation.primitive.name
                    raise UnsupportedError(f"the primitive {name}", advice=way_round(name))
                check_bytes(equation)
                with refusing():
                    outputs = rule(self, equation, *map(read, equation.invars))
                if len(self.graph.keys) > GRAPH_LIMIT:
                    raise UnsupportedError(f"more than {GRAPH_LIMIT:,} operations")
            except UnsupportedError as error:
                where = line_of(self.graph.place)
                if where and not error.place:
                    raise UnsupportedError(error.message, place=where, advice=error.advice) from None
                raise
            if not isinstance(outputs, list):
                outputs = [outputs]
            for variable, nodes in zip(equation.outvars, outputs, strict=True):
                aval: Any = variable.aval
                assert nodes.shape == aval.shape, (equation.primitive.name, nodes.shape, aval)
                dtypes = {self.graph.dtypes[node] for node in nodes.reshape(-1).tolist()}
                assert dtypes <= {graph_dtype(aval.dtype)}, (equation.primitive.name, dtypes, aval)
                values[variable] = nodes
        self.graph.place = outer
        return [read(atom) for atom in jaxpr.outvars]

    def constants(self, numbers: Any) -> Nodes:
        """Nodes of constants, for an array of numbers."""
        array = np.asarray(numbers)
        node_dtype = graph_dtype(array.dtype)
        made = self.graph.i if node_dtype == "i" else lambda value: self.graph.const(node_dtype, value)
        return np.array([made(value) for value in array.reshape(-1).tolist()], np.int64).reshape(array.shape)

    def values(self, nodes: Nodes) -> NDArray | None:
        """Values of an array of nodes if all of them are constants, else None."""
        constants = [self.graph.constant(node) for node in nodes.reshape(-1).tolist()]
        if any(value is None for value in constants):
            return None
        return np.array(constants).reshape(nodes.shape)

    def map(self, function: Callable[..., int], *arrays: Nodes) -> Nodes:
        """Array of a function's results for each element of the arrays, whose shapes are equal or ()."""
        shape = arrays[0].shape
        if any(array.shape != shape for array in arrays):
            shape = np.broadcast_shapes(*(array.shape for array in arrays))
            arrays = tuple(np.broadcast_to(array, shape) for array in arrays)
        flat = [array.reshape(-1).tolist() for array in arrays]
        return np.array([function(*nodes) for nodes in zip(*flat, strict=True)], np.int64).reshape(shape)

    def ops(self, name: str, *arrays: Nodes) -> Nodes:
        """Array of an operation's results, element by element."""
        return self.map(lambda *nodes: self.graph.op(name, *nodes), *arrays)

    @contextlib.contextmanager
    def within(self, mask: int) -> Iterator[None]:
        """Context manager of a branch or trip that only the lanes need for which a bool node is true."""
        outer, self.lanes = self.lanes, mask if self.lanes is None else self.graph.op("and", self.lanes, mask)
        try:
            yield
        finally:
            self.lanes = outer

    def keep_loop(self, trips: int, body: Callable[[list[Nodes]], list[Nodes]], carry: list[Nodes]) -> list[Nodes]:
        """Values of `carry` after `trips` trips through `body`, which does not depend on the number of the trip."""
        shaped = _shaping(carry)
        results = build_loop(self.graph, trips, lambda nodes: _flat(body(shaped(nodes))), _flat(carry), self.lanes)
        return shaped(results)

    def keep_while(
        self, condition: Callable[[list[Nodes]], Nodes], body: Callable[[list[Nodes]], list[Nodes]], carry: list[Nodes]
    ) -> list[Nodes]:
        """Values of `carry` after trips through `body` for as long as `condition`, one bool, holds."""
        shaped = _shaping(carry)

        def trip(nodes: list[int], active: int) -> list[int]:
            with self.within(active):
                return _flat(body(shaped(nodes)))

        def holds(nodes: list[int]) -> int:
            return int(condition(shaped(nodes))[()])

        return shaped(build_while(self.graph, holds, trip, _flat(carry), self.lanes))


def _flat(arrays: Sequence[Nodes]) -> list[int]:
    """Nodes of arrays in one list."""
    return [node for nodes in arrays for node in nodes.reshape(-1).tolist()]


def _shaping(arrays: Sequence[Nodes]) -> Callable[[Sequence[int]], list[Nodes]]:
    """Function that gives nodes in one list the shapes of some arrays."""
    shapes = [nodes.shape for nodes in arrays]
    ends = np.cumsum([nodes.size for nodes in arrays], dtype=np.int64)

    def shaped(nodes: Sequence[int]) -> list[Nodes]:
        parts = np.split(np.array(nodes, np.int64), ends)[:-1]
        return [part.reshape(shape) for part, shape in zip(parts, shapes, strict=True)]

    return shaped
