"""Compilation of a JAX function of one environment to a kernel for many, through all stages, with a cache."""

from __future__ import annotations

import ctypes
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from es_service.protocol.noise import KEY_WORDS
from workers.compiling import Compilable, jitted
from workers.simd.backend.emit import emit
from workers.simd.backend.native import (
    ALIGNMENT,
    Native,
    Words,
    aligned,
    load_compiled,
    pack,
    require,
    unpack,
    words_of,
)
from workers.simd.backend.target import Target, host_target
from workers.simd.frontend.trace import draws, jaxpr_digest, trace_jaxpr
from workers.simd.graph.graph import Graph, UnsupportedError, live
from workers.simd.graph.operations import OPERATIONS

DRAWN = "random numbers of JAX in a reset, which JAX draws itself"


class Facts(NamedTuple):
    jaxpr_s: float
    """Seconds of JAX's own tracing, which xla needs as well."""
    computed: int
    """Number of scalar operations after folding, with each loop body counted once; 0 if the code was cached."""
    code_bytes: int
    cached: bool
    """Whether the code came from the cache."""


@dataclass(frozen=True)
class Kernel:
    """A compiled function. Several threads may call it at the same time: calls hold no lock and keep no state."""

    target: Target
    in_tree: Any
    in_avals: tuple[Any, ...]
    out_tree: Any
    out_avals: tuple[Any, ...]
    facts: Facts
    _function: Callable[[Words, Words, int], None]

    @property
    def words_in(self) -> int:
        """Number of input words of a lane: all elements of all leaves."""
        return sum(map(words_of, self.in_avals))

    @property
    def words_out(self) -> int:
        """Number of output words of a lane."""
        return sum(map(words_of, self.out_avals))

    def run(self, words: Words, out: Words) -> None:
        """Compute `out` [block, words_out, width] from `words` [block, words_in, width].

        Both must be aligned to 64 bytes, as `aligned` makes them. The call releases the GIL.
        """
        blocks = len(words)
        require(
            words.shape == (blocks, self.words_in, self.target.width)
            and out.shape == (blocks, self.words_out, self.target.width),
            f"shapes {words.shape} and {out.shape}",
        )
        for array in (words, out):
            require(
                array.dtype == np.uint32
                and array.flags.c_contiguous
                and (array.size == 0 or array.ctypes.data % ALIGNMENT == 0),
                "they must be aligned, contiguous and of dtype uint32",
            )
        require(out.flags.writeable and words is not out, "the results need an array of their own")
        self._function(words, out, blocks)

    def __call__(self, *arguments: Any) -> Any:
        """Apply the function to pytrees whose leaves have a leading axis of lanes; returns NumPy arrays."""
        leaves, tree = jax.tree.flatten(arguments)
        require(tree == self.in_tree, f"the arguments are {tree}, but the kernel was compiled for {self.in_tree}")
        lanes = len(leaves[0]) if leaves else 1
        for leaf, aval in zip(leaves, self.in_avals, strict=True):
            array = np.asarray(leaf)
            given = array.dtype == aval.dtype and array.shape == (lanes, *aval.shape)
            require(given, f"an argument is {array.dtype}{array.shape}, but the kernel takes {aval} of each lane")
        words = pack(leaves, self.target.width)
        out = aligned((len(words), self.words_out, self.target.width))
        self.run(words, out)
        return jax.tree.unflatten(self.out_tree, unpack(out, self.out_avals, lanes))


Check = Callable[[Kernel, Graph, list[int]], object]
"""Function of a kernel, its graph and the outputs of the graph, which raises an exception if the code is wrong."""


def no_check(kernel: Kernel, graph: Graph, outputs: list[int]) -> None:
    """Trust the code."""


def compile_kernel(
    function: Callable[..., Any],
    *arguments: Any,
    target: Target | None = None,
    folder: Path | None = None,
    check: Check = no_check,
    may_draw: bool = True,
) -> Kernel:
    """Compile a pure JAX function of one environment.

    Args:
        function: the function of one environment.
        arguments: pytrees of arrays or ShapeDtypeStructs, without the axis of lanes.
        target: processor and instruction set; the widest vectors of this machine if None.
        folder: folder of the cache; the user's cache if None.
        check: check of new code, which is not kept if it is wrong; see check.py.
        may_draw: whether random numbers of JAX are compiled.

    Raises:
        UnsupportedError: the function contains something that cannot be compiled.
        NoVectorsError: this processor lacks the vector instructions.
    """
    target = target or host_target()
    started = time.perf_counter()
    closed, shape = jax.make_jaxpr(function, return_shape=True)(*arguments)
    jaxpr_s = time.perf_counter() - started
    if not may_draw and draws(closed):
        raise UnsupportedError(DRAWN)
    leaves, out_tree = jax.tree.flatten(shape)
    traced: list[tuple[Graph, list[int]]] = []  # empty if the code was cached

    def text() -> str:
        graph, inputs, outputs = trace_jaxpr(closed)
        traced.append((graph, outputs))
        return emit(graph, outputs, inputs, target)

    def kernel(native: Native) -> Kernel:
        computed = sum(graph.keys[node][0] in OPERATIONS for graph, outputs in traced for node in live(graph, outputs))
        return Kernel(
            target=target,
            in_tree=jax.tree.structure(arguments),
            in_avals=tuple(variable.aval for variable in closed.jaxpr.invars),
            out_tree=out_tree,
            out_avals=tuple(leaves),
            facts=Facts(jaxpr_s, computed, native.code_bytes, native.cached),
            _function=native.function(ctypes.c_void_p, ctypes.c_void_p, ctypes.c_int64),
        )

    name = jaxpr_digest(closed)
    return kernel(load_compiled(name, text, target, folder, lambda native: check(kernel(native), *traced[0])))


def compile_resets(
    begin: Callable[[Any], Any],
    target: Target,
    folder: Path | None,
    lanes: int,
    check: Check = no_check,
    *,
    may_draw: bool = False,
) -> Compilable:
    """Function from reset keys [lane, 4] to words of carries, compiled here by simd if possible and otherwise by JAX.

    Resets of Brax's own environments, for example, are JAX's. Resets are few compared with steps, but the bits of those
    that JAX compiles may differ between processors.

    Args:
        may_draw: see `Environment.compiles_drawn_resets`.
        lanes: number of resets that JAX computes at a time, that of one chunk. Their bits depend on it, and must not
            depend on how many chunks a worker computes together; another number would also have to be compiled.
    """
    key = jax.ShapeDtypeStruct((KEY_WORDS,), jnp.uint32)
    try:
        kernel = compile_kernel(begin, key, target=target, folder=folder, check=check, may_draw=may_draw)
    except UnsupportedError:
        resets = jitted(jax.vmap(begin))

        def packed(keys_L: np.ndarray) -> np.ndarray:
            rows = np.arange(-(-len(keys_L) // lanes) * lanes).reshape(-1, lanes) % len(keys_L)
            parts = [jax.tree.leaves(resets(keys_L[row])) for row in rows]
            leaves = [np.concatenate(leaf)[: len(keys_L)] for leaf in zip(*parts, strict=True)]
            return pack(leaves, target.width)

        return Compilable(packed, lambda keys_L: resets.compile(np.zeros((lanes, KEY_WORDS), np.uint32)))

    def words(keys_L: np.ndarray) -> np.ndarray:
        keys = pack([keys_L], target.width)
        out = aligned((len(keys), kernel.words_out, target.width))
        kernel.run(keys, out)
        return out

    return Compilable(words, lambda keys_L: None)
