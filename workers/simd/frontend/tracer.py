"""Evaluation of jaxprs on nodes: each array is replaced by an array of node numbers.

Operations that only move values (slices, gathers, transposes) are done while tracing, on the node numbers, and cost the
kernel nothing. Arithmetic adds nodes.

The modules of `primitives/` register their rules here, by the names of primitives. `graph_dtype` says which dtypes of
JAX are supported.
"""

from __future__ import annotations

import contextlib
import functools
import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.extend import source_info_util
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal
from numpy.typing import NDArray

from es_service.protocol.user_code import is_users_file
from workers.simd.graph.folding import FoldingGraph
from workers.simd.graph.graph import UnsupportedError, refusing, way_round
from workers.simd.graph.loops import build_loop, build_while


@functools.cache
def graph_dtype(dtype: Any) -> str:
    """Dtype of the graph nodes that represent values of a JAX dtype: "f", "i", "b" or, of JAX's threefry keys, "k".

    Integers of 8 and 16 bits are 32-bit integers of the same value; see `overflows`.

    Raises:
        UnsupportedError: the dtype is any other.
    """
    match str(dtype):
        case "float32":
            return "f"
        case "int32" | "uint32" | "int16" | "uint16" | "int8" | "uint8":
            return "i"
        case "bool":
            return "b"
        case "key<fry>":
            return "k"
    advice = way_round("random_bits") if str(dtype).startswith("key<") else ""
    raise UnsupportedError(
        f"values of type {dtype}: simd supports float32, integers of 8, 16 and 32 bits, bool and threefry keys",
        advice=advice,
    )


def is_signed(dtype: str) -> bool:
    return dtype.startswith("int")


def bits_of(dtype: str) -> int:
    return 8 * np.dtype(dtype).itemsize


NARROW = {"int8", "int16", "uint8", "uint16"}
MOVES = {"broadcast_in_dim", "reshape", "squeeze", "slice", "transpose", "concatenate", "stack", "unstack", "copy",
         "select_n", "gather", "dynamic_slice", "dynamic_update_slice", "scatter", "jit", "while", "scan", "cond",
         "random_bits"}  # fmt: skip
"""Primitives that only move or choose integers, or whose parts reduce them."""


def overflows(equation: Any) -> list[str]:
    """For each output of an equation, the dtype of 8 or 16 bits to whose range it must be reduced, or ""."""
    moves = equation.primitive.name in MOVES
    dtypes = [str(variable.aval.dtype) for variable in equation.outvars]
    return ["" if moves or dtype not in NARROW else dtype for dtype in dtypes]


def dtype_in(equation: Any, position: int = 0) -> str:
    """Name of the JAX dtype of one input of an equation."""
    return str(equation.invars[position].aval.dtype)


Nodes = NDArray[np.int64]
"""Node numbers, in the shape of the array that they represent."""
PrimitiveRule = Callable[..., Any]
"""Rule of a primitive for arrays of nodes: f(tracer, equation, *arrays) -> an array, or a list of arrays."""
GRAPH_LIMIT = 3_000_000
"""Most nodes of a graph; a greater one would take too long to compile."""
PRIMITIVES: dict[str, PrimitiveRule] = {}
"""Rules by the name of JAX's primitive."""


def primitive(*names: str) -> Callable[[PrimitiveRule], PrimitiveRule]:
    """Decorator that registers a rule under the names of primitives."""

    def enter(rule: PrimitiveRule) -> PrimitiveRule:
        PRIMITIVES.update(dict.fromkeys(names, rule))
        return rule

    return enter


class EquationPlace(NamedTuple):
    """Where an equation comes from."""

    source: source_info_util.SourceInfo
    outer: EquationPlace | None
    """The equation whose function contains it."""


def line_of(place: EquationPlace | None) -> str:
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

    def __init__(self, graph: FoldingGraph) -> None:
        self.graph = graph
        self.remembered: dict[Any, Any] = {}
        """What one rule notes of nodes for another."""
        self.lanes: int | None = None
        """Bool node: the lanes whose values are needed where the tracer is. None if those of all lanes are, as outside
        of branches and loops that depend on data."""

    def closed(self, closed: ClosedJaxpr, inputs: Sequence[Nodes]) -> list[Nodes]:
        """Outputs of a jaxpr that comes with its constants."""
        constants = [self.constants(value) for value in closed.consts]
        return self.jaxpr(closed.jaxpr, constants, inputs)

    def jaxpr(self, jaxpr: Jaxpr, constants: Sequence[Nodes], inputs: Sequence[Nodes]) -> list[Nodes]:
        """Outputs of a jaxpr for given constants and inputs."""
        values: dict[Any, Nodes] = dict(zip([*jaxpr.constvars, *jaxpr.invars], [*constants, *inputs], strict=True))

        def read(atom: Any) -> Nodes:
            aval: Any = atom.aval
            return self.constants(np.asarray(atom.val, aval.dtype)) if isinstance(atom, Literal) else values[atom]

        outer = self.graph.place
        for equation in jaxpr.eqns:
            self.graph.place = EquationPlace(equation.source_info, outer)
            rule = PRIMITIVES.get(equation.primitive.name)
            try:
                if rule is None:
                    name = equation.primitive.name
                    raise UnsupportedError(f"the primitive {name}", advice=way_round(name))
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
            outputs = [
                self.wrapped(nodes, dtype) if dtype else nodes
                for nodes, dtype in zip(outputs, overflows(equation), strict=True)
            ]
            for variable, nodes in zip(equation.outvars, outputs, strict=True):
                aval: Any = variable.aval
                assert nodes.shape == aval.shape, (equation.primitive.name, nodes.shape, aval)
                dtypes = {self.graph.dtypes[node] for node in nodes.reshape(-1).tolist()}
                assert dtypes <= {graph_dtype(aval.dtype)}, (equation.primitive.name, dtypes, aval)
                values[variable] = nodes
        self.graph.place = outer
        return [read(atom) for atom in jaxpr.outvars]

    def constants(self, numbers: Any) -> Nodes:
        """Nodes of constants, for an array of numbers or of JAX's keys."""
        if graph_dtype(getattr(numbers, "dtype", np.dtype(bool))) == "k":
            return self.keys(self.constants(np.asarray(jax.random.key_data(numbers))))
        array = np.asarray(numbers)
        node_dtype = graph_dtype(array.dtype)
        made = self.graph.i if node_dtype == "i" else lambda value: self.graph.const(node_dtype, value)
        return np.array([made(value) for value in array.reshape(-1).tolist()], np.int64).reshape(array.shape)

    def keys(self, words: Nodes) -> Nodes:
        """Nodes of JAX's keys, for an array [..., 2] of their words."""
        pairs = words.reshape(-1, 2).tolist()
        return np.array([self.graph.pair(*pair) for pair in pairs], np.int64).reshape(words.shape[:-1])

    def words(self, keys: Nodes) -> Nodes:
        """Nodes of the words of JAX's keys [...], as an array [..., 2]."""
        rows = [self.graph.words(node) for node in keys.reshape(-1).tolist()]
        return np.array(rows, np.int64).reshape(*keys.shape, 2)

    def wrapped(self, nodes: Nodes, dtype: str) -> Nodes:
        """Integers reduced to the range of a dtype of 8 or 16 bits, as that dtype wraps around."""
        if not is_signed(dtype):
            return self.ops("iand", nodes, self.constants(np.int32(2 ** bits_of(dtype) - 1)))
        by = self.constants(np.int32(32 - bits_of(dtype)))
        return self.ops("ashr", self.ops("shl", nodes, by), by)

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
        shaped, flat = _shaping(self, carry), self.flat
        results = build_loop(self.graph, trips, lambda nodes: flat(body(shaped(nodes))), flat(carry), self.lanes)
        return shaped(results)

    def keep_while(
        self, condition: Callable[[list[Nodes]], Nodes], body: Callable[[list[Nodes]], list[Nodes]], carry: list[Nodes]
    ) -> list[Nodes]:
        """Values of `carry` after trips through `body` for as long as `condition`, one bool, holds."""
        shaped = _shaping(self, carry)

        def trip(nodes: list[int], active: int) -> list[int]:
            with self.within(active):
                return self.flat(body(shaped(nodes)))

        def holds(nodes: list[int]) -> int:
            return int(condition(shaped(nodes))[()])

        return shaped(build_while(self.graph, holds, trip, self.flat(carry), self.lanes))

    def flat(self, arrays: Sequence[Nodes]) -> list[int]:
        """Nodes of arrays in one list, of a key those of its words."""
        return [word for nodes in arrays for node in nodes.reshape(-1).tolist() for word in self.graph.words(node)]


def _shaping(t: Tracer, arrays: Sequence[Nodes]) -> Callable[[Sequence[int]], list[Nodes]]:
    """Function that gives nodes in one list, as `Tracer.flat` makes it, the shapes of some arrays."""
    of_keys = [bool(nodes.size) and t.graph.dtypes[nodes.flat[0]] == "k" for nodes in arrays]
    shapes = [(*nodes.shape, 2) if keys else nodes.shape for keys, nodes in zip(of_keys, arrays, strict=True)]
    ends = np.cumsum([math.prod(shape) for shape in shapes], dtype=np.int64)

    def shaped(nodes: Sequence[int]) -> list[Nodes]:
        parts = np.split(np.array(nodes, np.int64), ends)[:-1]
        shaped = [part.reshape(shape) for part, shape in zip(parts, shapes, strict=True)]
        return [t.keys(part) if keys else part for keys, part in zip(of_keys, shaped, strict=True)]

    return shaped
