"""Environments of one task side by side, each in a lane of the compiled step.

Lane i has the same bits whatever the number of lanes, the threads and the width of the processor's vectors: a lane's
step depends on its own state and action alone, and the code of all widths computes the same operations.

Axes: N lanes, O observation, A action, B descriptor.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from es_service.protocol.messages import TaskSpec, with_options
from es_service.protocol.noise import KEY_WORDS, Domain, stream_keys
from es_service.protocol.options import OptionValue
from workers.environments import SHIPPED, Environment, TaskError, is_host_task, make_environment, user_task
from workers.simd.backend.target import NoVectorsError
from workers.simd.backend.words import ALIGNMENT, Words, aligned, pack, unpack, words_of
from workers.simd.episodes.check import LANES, check_kernel, check_resets, reset_keys
from workers.simd.episodes.kernel import Kernel, compile_kernel
from workers.simd.graph.graph import Graph
from workers.simd.graph.unsupported import UnsupportedError


class Seen(NamedTuple):
    """What a reset or a step shows of each lane."""

    observation: Any
    """[N, O] float32, neither normalised nor clipped."""
    reward: Any
    """[N] float32; 0 after a reset."""
    done: Any
    """[N] bool: whether the task has ended the episode."""
    descriptor: Any
    """[N, B] float32, in the units of the task."""
    goal_distance: Any
    """[N] float32; NaN if the task has no goal."""
    success: Any
    """[N] bool: whether the episode would have succeeded if it ended here; False if the task does not say."""


class _Carry(NamedTuple):
    """What a lane remembers."""

    state: Any
    success: Any


class LanesState(NamedTuple):
    """State of all lanes, which can be pickled and given to lanes on another machine."""

    words_N: NDArray[np.uint32]
    """[N, words]: bits of the states of the task."""
    seed_N: NDArray[np.uint64]
    episode_N: NDArray[np.int64]
    steps_N: NDArray[np.int64]


def task_named(name: str, options: Mapping[str, OptionValue]) -> TaskSpec:
    """Description of a task: a shipped one, or module:Class of a class in JAX.

    Raises:
        TaskError: there is no such task, it has no such option, or it is of a kind that is no such environment.
    """
    if ":" not in name and name not in SHIPPED:
        raise TaskError(f"task = {name!r} is not shipped; choose among {', '.join(SHIPPED)}, or module:Class")
    if is_host_task(name) or name.startswith("brax:"):
        raise TaskError(f"task = {name!r} is an environment of another library; use that library's own")
    task = user_task.describe(name) if ":" in name else SHIPPED[name]
    if unknown := sorted({*options} - {*task.options}):
        known = ", ".join(task.options) or "none"
        raise TaskError(f"task_options: {name} has no option {unknown[0]!r}; its options: {known}")
    return with_options(task, options)


class Lanes:
    """N environments of a task. Their resets are addressed by the seed of the lane and the number of its episode."""

    def __init__(self, name: str, options: Mapping[str, OptionValue], lanes: int, threads: int = 1) -> None:
        """Compile the step, or take it from the cache.

        Raises:
            TaskError: as `task_named`, or the compiler cannot compile the task, or it cannot run on this machine.
        """
        self.task = task_named(name, options)
        chosen = {key: option.default for key, option in self.task.options.items()} | dict(options)
        try:
            self._begin, self._step = _kernels(name, tuple(sorted(chosen.items())), self.task.action_size)
        except (UnsupportedError, NoVectorsError) as error:
            raise TaskError(f"{name} cannot be compiled: {error}") from error
        self.lanes, self._width = lanes, self._step.target.width
        blocks = -(-lanes // self._width)
        self._carry_words = self._step.words_in - self.task.action_size
        self._seen_avals = self._begin.out_avals[-len(Seen._fields) :]
        self._words = aligned((blocks, self._step.words_in, self._width))
        self._words[:] = 0
        self._out = aligned((blocks, self._step.words_out, self._width))
        together = max(1, ALIGNMENT // (4 * self._width))  # blocks, so that the memory of each thread is aligned
        share = -(-blocks // (threads * together)) * together
        self._shares = [slice(first, first + share) for first in range(0, blocks, share)]
        self._pool = ThreadPoolExecutor(len(self._shares)) if len(self._shares) > 1 else None
        self.seed_N, self.episode_N = np.zeros(lanes, np.uint64), np.full(lanes, -1)
        self.steps_N = np.zeros(lanes, np.int64)
        """Steps since the reset of each lane."""

    def reset(self, lane_M: NDArray[np.intp]) -> Seen:
        """Begin the next episode in some lanes; returns what is seen in these, [M]."""
        self.episode_N[lane_M] += 1
        self.steps_N[lane_M] = 0
        keys_M = stream_keys(0, Domain.ENVIRONMENT_RESET, 0, self.seed_N[lane_M], self.episode_N[lane_M])
        keys = pack([keys_M], self._width)
        out = aligned((len(keys), self._begin.words_out, self._width))
        self._begin.run(keys, out)
        self._put(lane_M, _by_lane(out[:, : self._carry_words])[: len(lane_M)])
        return self._seen(out, len(lane_M))

    def step(self, action_N_A: NDArray[np.float32]) -> Seen:
        """Step all lanes; actions outside of [-1, 1] are clipped by the task."""
        self._words[:, self._carry_words :] = pack([action_N_A], self._width)
        if self._pool is None:
            self._step.run(self._words, self._out)
        else:
            list(self._pool.map(lambda of: self._step.run(self._words[of], self._out[of]), self._shares))
        self._words[:, : self._carry_words] = self._out[:, : self._carry_words]
        self.steps_N += 1
        return self._seen(self._out, self.lanes)

    def state(self) -> LanesState:
        """The state of all lanes, as copies."""
        words_N = _by_lane(self._words[:, : self._carry_words])[: self.lanes].copy()
        return LanesState(words_N, self.seed_N.copy(), self.episode_N.copy(), self.steps_N.copy())

    def set_state(self, state: LanesState) -> None:
        """Continue from the state of lanes of the same task and number.

        Raises:
            ValueError: it is that of others.
        """
        words_N = np.asarray(state.words_N, np.uint32)
        if words_N.shape != (self.lanes, self._carry_words):
            raise ValueError(
                f"state has words of shape {words_N.shape}, but {self.lanes} environments of {self.task.name} have "
                f"{(self.lanes, self._carry_words)}"
            )
        self._put(np.arange(self.lanes), words_N)
        for mine, given in (
            (self.seed_N, state.seed_N),
            (self.episode_N, state.episode_N),
            (self.steps_N, state.steps_N),
        ):
            mine[:] = given

    def close(self) -> None:
        """End the threads."""
        if self._pool is not None:
            self._pool.shutdown()

    def _put(self, lane_M: NDArray[np.intp], words_M: NDArray[np.uint32]) -> None:
        self._words[lane_M // self._width, : self._carry_words, lane_M % self._width] = words_M

    def _seen(self, out: Words, lanes: int) -> Seen:
        return Seen(*unpack(out[:, self._carry_words :], self._seen_avals, lanes))


@functools.cache
def _kernels(name: str, options: tuple[tuple[str, OptionValue], ...], actions: int) -> tuple[Kernel, Kernel]:
    """The compiled reset and the compiled step of a task."""
    environment = make_environment(name, dict(options))

    def seen(carry: _Carry, reward: Any, done: Any) -> Seen:
        return Seen(
            jnp.asarray(environment.observe(carry.state), jnp.float32),
            jnp.asarray(reward, jnp.float32),
            jnp.asarray(done, bool),
            jnp.asarray(environment.descriptor(carry.state), jnp.float32),
            jnp.asarray(environment.goal_distance(carry.state), jnp.float32),
            carry.success,
        )

    def begin(key: Any) -> tuple[_Carry, Seen]:
        carry = _carry(environment, environment.reset(key), jnp.array(False))
        return carry, seen(carry, 0.0, False)

    def step(carry: _Carry, action_A: Any) -> tuple[_Carry, Seen]:
        state, reward, done = environment.step(carry.state, action_A)
        after = _carry(environment, state, carry.success)
        return after, seen(after, reward, done)

    def check_step(kernel: Kernel, graph: Graph, outputs: list[int]) -> None:
        actions_L_A = np.random.default_rng(0).uniform(-1.0, 1.0, (LANES, actions)).astype(np.float32)
        states_L = [np.asarray(leaf) for leaf in jax.tree.leaves(begun(reset_keys())[0])]
        given_L = _by_lane(pack([*states_L, actions_L_A], kernel.target.width))[:LANES]
        check_kernel(kernel, graph, outputs, given_L, f"a step of {name}")

    with jax.enable_x64(False):  # the caller may have another mode, but bits must not depend on it
        key = jax.ShapeDtypeStruct((KEY_WORDS,), jnp.uint32)
        begun = compile_kernel(begin, key, check=functools.partial(check_resets, environment=name))
        carry, _ = jax.eval_shape(begin, key)
        action = jax.ShapeDtypeStruct((actions,), jnp.float32)
        stepped = compile_kernel(step, carry, action, check=check_step)
    if stepped.words_in - actions != sum(map(words_of, jax.tree.leaves(carry))):
        raise TaskError(f"{name}: step returns a state of other shapes than reset")
    return begun, stepped


def _carry(environment: Environment, state: Any, before: Any) -> _Carry:
    return _Carry(state, jnp.asarray(environment.success(state, before), bool))


def _by_lane(words: Words) -> NDArray[np.uint32]:
    """Words [block, word, lane] as [lane, word]."""
    return words.transpose(0, 2, 1).reshape(-1, words.shape[1])
