"""Translation of a jaxpr to a scalar graph, by the tracer with the rules of all primitives."""

from __future__ import annotations

import itertools
from typing import Any

import jax
import numpy as np
from jax.extend.core import ClosedJaxpr

from workers.simd.frontend.dtypes import graph_dtype
from workers.simd.frontend.primitives import PRIMITIVES
from workers.simd.frontend.tracer import Tracer
from workers.simd.graph.folding import FoldingGraph
from workers.simd.graph.unsupported import UnsupportedError, refusing


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
    tracer = Tracer(graph, PRIMITIVES)
    tracer.lanes = None if lanes_word is None else graph.input("b", lanes_word)
    outputs = tracer.closed(closed, inputs)
    return graph, next(words), tracer.flat(outputs)
