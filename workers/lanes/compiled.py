"""Lanes whose steps simd compiles, and whose resets too where it can: all lanes in one call.

A lane has the same bits whatever the number of lanes, the threads and the width of the processor's vectors: its step
depends on its own state and action alone, and the code of all widths computes the same operations.
"""

from __future__ import annotations

import functools
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from es_service.protocol.child import require_same_process
from es_service.protocol.noise import KEY_WORDS
from es_service.protocol.options import OptionValue
from workers.environments import TaskError, make_environment
from workers.lanes.blocks import Blocks, LaneResults, lane_functions
from workers.simd.backend.native import ALIGNMENT, Words, aligned, pack, unpack, words_of
from workers.simd.backend.target import NoVectorsError
from workers.simd.episodes.check import LANES, check_kernel, check_resets, reset_keys
from workers.simd.episodes.kernel import Kernel, compile_kernel
from workers.simd.graph.graph import Graph, UnsupportedError

LaneResets = Callable[[NDArray[np.intp], NDArray[np.uint32]], tuple[NDArray[np.uint32], LaneResults]]
"""Function of lanes and their reset keys [M, 4] -> (words of their carries [M, words], what is seen in them)."""


class Kernels(NamedTuple):
    """Compiled functions of a task."""

    begin: Kernel | None
    step: Kernel | None
    """None: xla has to compute it, and then the reset too."""
    lacks: str
    """Why `begin` or `step` is None, as the end of a sentence; else empty."""


class CompiledLanes:
    """Lanes that a kernel steps."""

    def __init__(self, step: Kernel, resets: LaneResets, lanes: int, actions: int, threads: int) -> None:
        self.lanes, self._step, self._resets, self._width = lanes, step, resets, step.target.width
        self._carry_words = step.words_in - actions
        blocks = -(-lanes // self._width)
        self._words = aligned((blocks, step.words_in, self._width))
        self._words[:] = 0
        self._out = aligned((blocks, step.words_out, self._width))
        together = max(1, ALIGNMENT // (4 * self._width))  # blocks, so that the memory of each thread is aligned
        share = -(-blocks // (threads * together)) * together
        self._shares = [slice(first, first + share) for first in range(0, blocks, share)]
        self._maker = os.getpid()
        self._pool = ThreadPoolExecutor(len(self._shares)) if len(self._shares) > 1 else None

    def begin(self, lane_M: NDArray[np.intp], keys_M: NDArray[np.uint32]) -> LaneResults:
        """Reset some lanes; returns what is seen in these."""
        words_M, seen = self._resets(lane_M, keys_M)
        self.put(lane_M, words_M)
        return seen

    def step(self, action_N_A: NDArray[np.float32]) -> LaneResults:
        self._words[:, self._carry_words :] = pack([action_N_A], self._width)
        if self._pool is None:
            self._step.run(self._words, self._out)
        else:
            require_same_process(self._maker, "a vector environment with threads", "make another one in that process")
            list(self._pool.map(lambda of: self._step.run(self._words[of], self._out[of]), self._shares))
        self._words[:, : self._carry_words] = self._out[:, : self._carry_words]
        return _seen(self._step, self._out, self._carry_words, self.lanes)

    def words(self) -> NDArray[np.uint32]:
        """Words of the carries of all lanes, [N, words]."""
        return _by_lane(self._words[:, : self._carry_words])[: self.lanes].copy()

    def put(self, lane_M: NDArray[np.intp], words_M: NDArray[np.uint32]) -> None:
        self._words[lane_M // self._width, : self._carry_words, lane_M % self._width] = words_M

    def close(self) -> None:
        if self._pool is not None:
            self._pool.shutdown()


def compiled_resets(begin: Kernel) -> LaneResets:
    def resets(lane_M: NDArray[np.intp], keys_M: NDArray[np.uint32]) -> tuple[NDArray[np.uint32], LaneResults]:
        keys, width = pack([keys_M], begin.target.width), begin.target.width
        out = aligned((len(keys), begin.words_out, width))
        begin.run(keys, out)
        carry_words = begin.words_out - sum(map(words_of, begin.out_avals[-len(LaneResults._fields) :]))
        return _by_lane(out[:, :carry_words])[: len(lane_M)], _seen(begin, out, carry_words, len(lane_M))

    return resets


@functools.cache
def kernels(name: str, options: tuple[tuple[str, OptionValue], ...], actions: int) -> Kernels:
    """The compiled reset and the compiled step of a task, as far as simd can compile them on this machine."""
    environment = make_environment(name, dict(options))
    begin, step = lane_functions(environment)

    def resets_to_check(begun: Kernel | None) -> NDArray[np.uint32]:
        lane_L, keys_L = np.arange(LANES), reset_keys()
        if begun is not None:
            return compiled_resets(begun)(lane_L, keys_L)[0]
        with closing(Blocks(name, dict(options), LANES)) as blocks:
            return blocks.resets(lane_L, keys_L)[0]

    def check_step(kernel: Kernel, graph: Graph, outputs: list[int]) -> None:
        actions_L_A = np.random.default_rng(0).uniform(-1.0, 1.0, (LANES, actions)).astype(np.float32)
        given_L = np.concatenate([resets_to_check(begun), actions_L_A.view(np.uint32)], axis=1)
        check_kernel(kernel, graph, outputs, given_L, f"a step of {name}")

    begun, lacks = None, ""
    with jax.enable_x64(False), jax.threefry_partitionable(True):  # bits must not depend on the caller's modes
        key = jax.ShapeDtypeStruct((KEY_WORDS,), jnp.uint32)
        try:
            check, may_draw = functools.partial(check_resets, environment=name), environment.compiles_drawn_resets
            begun = compile_kernel(begin, key, check=check, may_draw=may_draw)
        except UnsupportedError as error:
            lacks = f"its reset: {error}"
        except NoVectorsError as error:
            return Kernels(None, None, f"anything here: {error}")
        carry, _ = jax.eval_shape(begin, key)
        action = jax.ShapeDtypeStruct((actions,), jnp.float32)
        try:
            stepped = compile_kernel(step, carry, action, check=check_step)
        except UnsupportedError as error:
            return Kernels(None, None, f"its step: {error}")
    if stepped.words_in - actions != sum(map(words_of, jax.tree.leaves(carry))):
        raise TaskError(f"{name}: step returns a state of other shapes than reset")
    return Kernels(begun, stepped, lacks)


def _seen(kernel: Kernel, out: Words, carry_words: int, lanes: int) -> LaneResults:
    return LaneResults(*unpack(out[:, carry_words:], kernel.out_avals[-len(LaneResults._fields) :], lanes))


def _by_lane(words: Words) -> NDArray[np.uint32]:
    """Words [block, word, lane] as [lane, word]."""
    return words.transpose(0, 2, 1).reshape(-1, words.shape[1])
