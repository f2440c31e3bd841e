"""Translation of a jaxpr to a scalar graph, by the tracer with the rules of all primitives; and hashes of jaxprs, by
which compiled kernels are found in the cache on disk."""

from __future__ import annotations

import hashlib
import itertools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal

import workers.simd.frontend.primitives  # noqa: F401 - registers the rules
from workers.simd.frontend.primitives.random import partitionable
from workers.simd.frontend.tracer import Tracer, graph_dtype
from workers.simd.graph.folding import FoldingGraph
from workers.simd.graph.graph import UnsupportedError, refusing


def draws(closed: ClosedJaxpr) -> bool:
    """Whether a function uses keys of JAX or what their bits are made of."""
    waiting: list[Any] = [closed.jaxpr]
    while waiting:
        for equation in waiting.pop().eqns:
            if equation.primitive.name.startswith(("random_", "threefry")):
                return True
            values = jax.tree.leaves(list(equation.params.values()), is_leaf=lambda value: hasattr(value, "eqns"))
            waiting += [getattr(value, "jaxpr", value) for value in values if hasattr(value, "eqns")]
    return False


@refusing()
def trace_jaxpr(
    closed: ClosedJaxpr, *, folds_zeros: bool = True, lanes_word: int | None = None
) -> tuple[FoldingGraph, int, list[int]]:
    """Graph of a function of one lane, as (graph, number of input words, output nodes).

    Each element of each input array is an input of the graph, in order, and each element of each output array an
    output.

    Args:
        folds_zeros: see `FoldingGraph`.
        lanes_word: number of the input word, a bool, that says whether a lane's results are needed. Loops whose ends
            depend on data make no trips for the others. Those of all lanes are needed if None.

    Raises:
        UnsupportedError: the function cannot be compiled.
    """
    graph = FoldingGraph(folds_zeros=folds_zeros)
    words = itertools.count()
    inputs = []
    for variable in closed.jaxpr.invars:
        node_dtype = graph_dtype(variable.aval.dtype)
        if node_dtype == "k":
            raise UnsupportedError("a key of JAX as an argument; pass jax.random.key_data(key)")
        nodes = [graph.input(node_dtype, next(words)) for _ in range(int(np.prod(variable.aval.shape)))]
        inputs.append(np.array(nodes, np.int64).reshape(variable.aval.shape))
    tracer = Tracer(graph)
    tracer.lanes = None if lanes_word is None else graph.input("b", lanes_word)
    outputs = tracer.closed(closed, inputs)
    return graph, next(words), tracer.flat(outputs)


@refusing()
def jaxpr_digest(closed: ClosedJaxpr) -> str:
    """Hash of everything that a jaxpr computes: its equations, their parameters and its constants.

    Names of variables do not change it.

    Raises:
        UnsupportedError: the text of a parameter or constant is not the same in every process.
    """
    digests: dict[int, str] = {}

    def of_closed(closed_jaxpr: ClosedJaxpr) -> str:
        hasher = hashlib.sha256(of_jaxpr(closed_jaxpr.jaxpr).encode())
        for constant in closed_jaxpr.consts:
            hasher.update(of_value(constant).encode())
        return hasher.hexdigest()

    def of_jaxpr(jaxpr: Jaxpr) -> str:
        if id(jaxpr) in digests:
            return digests[id(jaxpr)]
        numbers: dict[Any, int] = {}

        def name(atom: Any) -> str:
            if isinstance(atom, Literal):
                return f"{of_value(atom.val)}:{atom.aval}"
            return f"{numbers.setdefault(atom, len(numbers))}:{atom.aval}"

        lines = [" ".join(map(name, [*jaxpr.constvars, *jaxpr.invars]))]
        for equation in jaxpr.eqns:
            parameters = [f"{key}={of_value(value)}" for key, value in sorted(equation.params.items()) if key != "name"]
            if equation.primitive.name.startswith("random_"):
                parameters.append(f"partitionable={partitionable()}")
            lines.append(f"{list(map(name, equation.outvars))} {equation.primitive.name} {parameters} "
                         f"{list(map(name, equation.invars))}")  # fmt: skip
        lines.append(" ".join(map(name, jaxpr.outvars)))
        digests[id(jaxpr)] = hashlib.sha256("\n".join(lines).encode()).hexdigest()
        return digests[id(jaxpr)]

    def of_value(value: Any) -> str:
        if isinstance(value, ClosedJaxpr):
            return of_closed(value)
        if isinstance(value, Jaxpr):
            return of_jaxpr(value)
        if isinstance(value, tuple | list):
            return f"({','.join(map(of_value, value))})"
        if isinstance(value, np.ndarray | np.generic | jax.Array):
            if jnp.issubdtype(value.dtype, jax.dtypes.prng_key):
                return f"{value.dtype}{of_value(jax.random.key_data(jnp.asarray(value)))}"
            array = np.asarray(value)
            return f"{array.dtype}{array.shape}{hashlib.sha256(array.tobytes()).hexdigest()}"
        if callable(value):
            return ""  # a rule for derivatives, which kernels do not use
        if " at 0x" in (text := repr(value)):
            raise ValueError(f"a parameter whose text contains an address and differs between processes: {text}")
        return text

    return of_closed(closed)
