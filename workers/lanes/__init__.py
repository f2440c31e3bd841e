"""Environments of one task side by side, each in a lane: of the code that simd compiles, or else of xla's.

`blocks` has what is computed for a lane, and the lanes of xla.

A lane of simd has the same bits whatever the number of lanes, the threads and the width of the processor's vectors: its
step depends on its own state and action alone, and the code of all widths computes the same operations.

Axes: N lanes, O observation, A action, B descriptor.
"""

from __future__ import annotations

import functools
import os
import warnings
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from typing import NamedTuple, NoReturn

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from es_service.protocol.child import require_same_process
from es_service.protocol.messages import TaskSpec, with_options
from es_service.protocol.noise import KEY_WORDS, Domain, stream_keys
from es_service.protocol.options import OptionValue, allowed_text, allowed_value, option_values
from es_service.protocol.sources import SUITES
from workers.environments import (
    SHIPPED,
    TaskError,
    describe_environment,
    is_function_task,
    is_host_task,
    make_environment,
)
from workers.lanes.blocks import BLOCK, Blocks, LaneResults, lane_functions
from workers.simd.backend.native import ALIGNMENT, Words, aligned, pack, unpack, words_of
from workers.simd.backend.target import NoVectorsError
from workers.simd.episodes.check import LANES, check_kernel, check_resets, reset_keys
from workers.simd.episodes.kernel import Kernel, compile_kernel
from workers.simd.graph.graph import Graph, UnsupportedError

__all__ = ["LaneResults", "Lanes", "LanesState", "task_named"]
LaneResets = Callable[[NDArray[np.intp], NDArray[np.uint32]], tuple[NDArray[np.uint32], LaneResults]]
"""Function of lanes and their reset keys [M, 4] -> (words of their carries [M, words], what is seen in them)."""


class LanesState(NamedTuple):
    """State of all lanes, which can be pickled and given to lanes on another machine."""

    words_N: NDArray[np.uint32]
    """[N, words]: bits of the states of the task."""
    seed_N: NDArray[np.uint64]
    episode_N: NDArray[np.int64]
    steps_N: NDArray[np.int64]


def task_named(name: str, options: Mapping[str, OptionValue]) -> TaskSpec:
    """Description of a task: a shipped one, `brax:NAME`, `mujoco:ID`, or module:Class of a class in JAX.

    Raises:
        TaskError: there is no such task, it has no such option, or it is of a kind that is no such environment.
    """
    if not isinstance(name, str) or (":" not in name and name not in SHIPPED):
        others = f"brax:NAME, mujoco:ID, {', '.join(f'{suite}:NAME' for suite in SUITES)} or module:Class"
        raise TaskError(f"task = {name!r} is not shipped; choose among {', '.join(SHIPPED)}, {others}")
    if is_host_task(name):
        raise TaskError(f"task = {name!r} is a Python object, no task in JAX; step it by itself")
    if is_function_task(name):
        raise TaskError(f"task = {name!r} is a function of parameters, which has no steps")
    task = SHIPPED[name] if name in SHIPPED else describe_environment(name)
    return with_options(task, options_of(task, options))


def options_of(task: TaskSpec, given: Mapping[str, OptionValue]) -> dict[str, OptionValue]:
    """Value of every option of a task. Raises TaskError if the task has no such option, or a value is not allowed."""
    if not isinstance(given, Mapping):
        raise TaskError(f"task_options = {given!r} is no mapping from names of options to their values")
    options = option_values(task.options, {})
    for name, value in given.items():
        if (option := task.options.get(name)) is None:
            known = ", ".join(task.options) or "none"
            raise TaskError(f"task_options: {task.name} has no option {name!r}; its options: {known}")
        if (allowed := allowed_value(option, value)) is None:
            raise TaskError(f"task_options: {name} = {value!r} is not allowed; must be {allowed_text(option)}")
        options[name] = allowed
    return options


class Lanes:
    """N environments of a task. Their resets are addressed by the seed of the lane and the number of its episode."""

    def __init__(
        self, name: str, options: Mapping[str, OptionValue], lanes: int, threads: int = 1, *, first: int = 0
    ) -> None:
        """Compile the step, or take it from the cache.

        A lane has the same bits whatever the number of lanes and threads. What simd cannot compile xla computes, and
        then the bits of a lane also depend on its number modulo BLOCK, and on the kind of the processor. A warning says
        once why that is so.

        Args:
            threads: with xla, it is processes.
            first: number of the first lane.

        Raises:
            TaskError: as `task_named`, or the task cannot be computed.
        """
        self.task = task_named(name, options)
        chosen = options_of(self.task, options)
        begin, step, lacks = kernels(name, tuple(sorted(chosen.items())), self.task.action_size)
        if lacks:
            _say_once(name, lacks, whole=step is None)
        self.lanes, self._blocks = lanes, None
        if begin is None:
            processes = threads if step is None else 1
            self._blocks = Blocks(name, chosen, lanes, processes, first=first % BLOCK)
            resets = self._blocks.resets
        else:
            resets = compiled_resets(begin)
        if step is None:
            assert self._blocks is not None, "a kernel of the reset alone is of no use"
            self._lanes = self._blocks
        else:
            self._lanes = CompiledLanes(step, resets, lanes, self.task.action_size, threads)
        self.seed_N, self.episode_N = np.zeros(lanes, np.uint64), np.full(lanes, -1)
        self.steps_N = np.zeros(lanes, np.int64)
        """Steps since the reset of each lane."""

    def reset(self, lane_M: NDArray[np.intp], keys_M: NDArray[np.uint32] | None = None) -> LaneResults:
        """Begin the next episode in some lanes, in increasing order; returns what is seen in these, [M].

        Args:
            keys_M: keys of the resets [M, 4]; None for those of the lanes' seeds and episodes.
        """
        self.episode_N[lane_M] += 1
        self.steps_N[lane_M] = 0
        if keys_M is None:
            keys_M = stream_keys(0, Domain.ENVIRONMENT_RESET, 0, self.seed_N[lane_M], self.episode_N[lane_M])
        return self._lanes.begin(lane_M, keys_M)

    def step(self, action_N_A: NDArray[np.float32]) -> LaneResults:
        """Step all lanes; actions outside of [-1, 1] are clipped by the task."""
        self.steps_N += 1
        return self._lanes.step(action_N_A)

    def state(self) -> LanesState:
        """The state of all lanes, as copies."""
        return LanesState(self._lanes.words(), self.seed_N.copy(), self.episode_N.copy(), self.steps_N.copy())

    def set_state(self, state: LanesState) -> None:
        """Continue from the state of lanes of the same task and number.

        Raises:
            ValueError: it is that of others.
        """
        words_N, mine = np.asarray(state.words_N, np.uint32), self._lanes.words()
        if words_N.shape != mine.shape:
            raise ValueError(
                f"state has words of shape {words_N.shape}, but {self.lanes} environments of {self.task.name} have "
                f"{mine.shape}"
            )
        self._lanes.put(np.arange(self.lanes), words_N)
        for mine, given in (
            (self.seed_N, state.seed_N),
            (self.episode_N, state.episode_N),
            (self.steps_N, state.steps_N),
        ):
            mine[:] = given

    def __reduce__(self) -> NoReturn:
        raise TypeError(
            f"environments of {self.task.name} hold machine code or processes, which cannot be copied or pickled; make "
            "others, and give them with set_state what get_state returns"
        )

    def close(self) -> None:
        """End the threads and processes."""
        self._lanes.close()
        if self._blocks is not None:
            self._blocks.close()


@functools.cache
def _say_once(name: str, lacks: str, *, whole: bool) -> None:
    """Warn that lanes are slower than those of other tasks, and have the bits of this kind of processor."""
    what = "computes it" if whole else "computes its resets"
    warnings.warn(f"{name}: xla {what} in a process of its own, since simd cannot compile {lacks}", stacklevel=4)


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
