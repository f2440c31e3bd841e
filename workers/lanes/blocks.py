"""Lanes that xla computes, in child processes with the settings of workers, since simd cannot compile their task.

XLA may give other bits for another shape, another number of threads, or another place in a batch. So lanes are computed
in blocks of 16, padded, with one thread, and lane i is always in place i modulo 16 of its block: its bits depend on
that and on its own state and action, and not on the number of lanes or processes. The settings are those of a process
before it loads JAX, and the caller has loaded it in its own way.

`lane_functions` are the reset and the step of one lane, which simd compiles and xla maps over blocks of lanes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from es_service.protocol.child import Child, NoAnswerError
from es_service.protocol.noise import KEY_WORDS
from es_service.protocol.options import OptionValue
from es_service.protocol.process_environment import child_environment
from es_service.protocol.user_code import RaisedError
from workers.compiling import xla_cache_settings
from workers.environments import Environment, TaskError, make_environment


class LaneResults(NamedTuple):
    """Results of a reset or a step in each lane."""

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


class LaneCarry(NamedTuple):
    state: Any
    success: Any


class LaneFunctions(NamedTuple):
    begin: Callable[[Any], tuple[LaneCarry, LaneResults]]
    """Function of the stream key of a reset."""
    step: Callable[[LaneCarry, Any], tuple[LaneCarry, LaneResults]]
    """Function of a carry and an action [A]."""


def lane_functions(environment: Environment) -> LaneFunctions:
    """The functions of a lane of a task."""

    def carried(state: Any, before: Any) -> LaneCarry:
        return LaneCarry(state, jnp.asarray(environment.success(state, before), bool))

    def seen(carry: LaneCarry, reward: Any, done: Any) -> LaneResults:
        return LaneResults(
            jnp.asarray(environment.observe(carry.state), jnp.float32),
            jnp.asarray(reward, jnp.float32),
            jnp.asarray(done, bool),
            jnp.asarray(environment.descriptor(carry.state), jnp.float32),
            jnp.asarray(environment.goal_distance(carry.state), jnp.float32),
            carry.success,
        )

    def begin(key: Any) -> tuple[LaneCarry, LaneResults]:
        carry = carried(environment.reset(key), jnp.array(False))
        return carry, seen(carry, 0.0, False)

    def step(carry: LaneCarry, action_A: Any) -> tuple[LaneCarry, LaneResults]:
        state, reward, done = environment.step(carry.state, action_A)
        after = carried(state, carry.success)
        return after, seen(after, reward, done)

    return LaneFunctions(begin, step)


BLOCK = 16
"""Lanes that xla computes together."""


class Blocks:
    """Lanes in blocks, divided among child processes."""

    def __init__(
        self, name: str, options: Mapping[str, OptionValue], lanes: int, processes: int = 1, *, first: int = 0
    ) -> None:
        """Start the processes, which compile the functions of the task or take them from the cache.

        Args:
            processes: most processes; each has whole blocks.
            first: place in its block of the first lane.

        Raises:
            TaskError: the task cannot be computed.
        """
        blocks = -(-(first + lanes) // BLOCK)
        share = -(-blocks // processes) * BLOCK
        bounds = [0, *range(share - first, lanes, share), lanes]
        self._bounds = np.array(bounds)
        """Lanes of process p are those from bounds[p] to bounds[p + 1]."""
        self._name = name
        self._children: list[Child] = []
        environment = child_environment() | xla_cache_settings()
        try:
            requests = []
            for start, end in pairwise(bounds):
                self._children.append(Child("workers.lanes.blocks:lanes_of", environment, None))
                requests.append((self._children[-1], (name, dict(options), end - start, first if start == 0 else 0)))
            self._answers(requests)
        except BaseException:
            self.close()
            raise

    def begin(self, lane_M: NDArray[np.intp], keys_M: NDArray[np.uint32]) -> LaneResults:
        """Reset some lanes; returns what is seen in these."""
        return self.resets(lane_M, keys_M)[1]

    def resets(self, lane_M: NDArray[np.intp], keys_M: NDArray[np.uint32]) -> tuple[NDArray[np.uint32], LaneResults]:
        """Reset some lanes, in increasing order; returns the words of their carries, and what is seen in them."""
        return _joined(self._shared("resets", lane_M, keys_M))

    def step(self, action_N_A: NDArray[np.float32]) -> LaneResults:
        places = zip(self._children, pairwise(self._bounds), strict=True)
        return _joined(self._answers([(child, ("step", action_N_A[slice(*place)])) for child, place in places]))

    def words(self) -> NDArray[np.uint32]:
        """Words of the carries of all lanes, [N, words]."""
        return _joined(self._answers([(child, ("words",)) for child in self._children]))

    def put(self, lane_M: NDArray[np.intp], words_M: NDArray[np.uint32]) -> None:
        """Set the carries of some lanes, in increasing order."""
        self._shared("put", lane_M, words_M)

    def close(self) -> None:
        for child in self._children:
            child.end()

    def _shared(self, kind: str, lane_M: NDArray[np.intp], given_M: NDArray) -> list[Any]:
        """Answers of the processes that have some of the lanes."""
        cuts = np.searchsorted(lane_M, self._bounds)
        requests = []
        for child, start, low, high in zip(self._children, self._bounds[:-1], cuts[:-1], cuts[1:], strict=True):
            if low < high:
                requests.append((child, (kind, lane_M[low:high] - start, given_M[low:high])))
        return self._answers(requests)

    def _answers(self, requests: Sequence[tuple[Child, tuple[Any, ...]]]) -> list[Any]:
        """Answers of processes to one request each. Raises TaskError with what the task's code raised, or
        NoAnswerError; the processes have ended then, and after an interruption."""
        try:
            for child, request in requests:
                child.ask(*request)
            return [child.answer() for child, _ in requests]
        except BaseException as error:
            self.close()
            if isinstance(error, RaisedError):
                raise TaskError(error.message) from None
            if isinstance(error, NoAnswerError):
                what = f"the process in which xla computes {self._name} {error}"
                raise NoAnswerError(f"{what}; make the environments anew") from None
            raise


def _joined(answers: list[Any]) -> Any:
    """Arrays [M, ...] of several processes as one each."""
    if len(answers) == 1:
        return answers[0]
    if isinstance(answers[0], np.ndarray):
        return np.concatenate(answers)
    parts = [_joined(list(part)) for part in zip(*answers, strict=True)]
    return LaneResults(*parts) if isinstance(answers[0], LaneResults) else tuple(parts)


class BlockLanes:
    """The lanes of this process, in blocks."""

    def __init__(self, name: str, options: Mapping[str, OptionValue], lanes: int, first: int) -> None:
        """Compile the reset. Arguments are those of `workers.lanes.blocks.Blocks`."""
        begin, step = lane_functions(make_environment(name, options))
        key = jax.ShapeDtypeStruct((KEY_WORDS,), jnp.uint32)
        tree = jax.tree.structure(jax.eval_shape(lambda key: begin(key)[0], key))

        def begun(key: Any) -> tuple[list[Any], LaneResults]:
            carry, seen = begin(key)
            return jax.tree.leaves(carry), seen

        def stepped(arrays: Sequence[Any], action_A: Any) -> tuple[list[Any], LaneResults]:
            carry, seen = step(jax.tree.unflatten(tree, arrays), action_A)
            return jax.tree.leaves(carry), seen

        self._begin, self._step = jax.jit(jax.vmap(begun)), jax.jit(jax.vmap(stepped))
        self._first, self._places = first, np.arange(first, first + lanes)
        blocks = -(-(first + lanes) // BLOCK)
        padding, _ = self._begin(np.zeros((BLOCK, KEY_WORDS), np.uint32))
        self._arrays = [np.concatenate([array] * blocks) for array in map(np.asarray, padding)]
        """Arrays of the carries, [16 * blocks, ...]; those of no lane are some reset."""

    def resets(self, lane_M: NDArray[np.intp], keys_M: NDArray[np.uint32]) -> tuple[NDArray[np.uint32], LaneResults]:
        place_M, seen_by_block = self._first + lane_M, []
        for block in np.unique(place_M // BLOCK):
            is_here_M = place_M // BLOCK == block
            here = place_M[is_here_M] % BLOCK
            keys = np.zeros((BLOCK, KEY_WORDS), np.uint32)
            keys[here] = keys_M[is_here_M]
            arrays, seen = self._begin(keys)
            for kept, array in zip(self._arrays, arrays, strict=True):
                kept[place_M[is_here_M]] = np.asarray(array)[here]
            seen_by_block.append([np.asarray(array)[here] for array in seen])
        return self._words_of(place_M), LaneResults(
            *(np.concatenate(arrays) for arrays in zip(*seen_by_block, strict=True))
        )

    def step(self, action_N_A: NDArray[np.float32]) -> LaneResults:
        actions = np.zeros((len(self._arrays[0]), action_N_A.shape[1]), np.float32)
        actions[self._places] = action_N_A
        seen_by_block = []
        for start in range(0, len(actions), BLOCK):
            of = slice(start, start + BLOCK)
            arrays, seen = self._step([array[of] for array in self._arrays], actions[of])
            for kept, array in zip(self._arrays, arrays, strict=True):
                kept[of] = array
            seen_by_block.append(seen)
        return LaneResults(*(np.concatenate(arrays)[self._places] for arrays in zip(*seen_by_block, strict=True)))

    def words(self) -> NDArray[np.uint32]:
        return self._words_of(self._places)

    def put(self, lane_M: NDArray[np.intp], words_M: NDArray[np.uint32]) -> None:
        end = 0
        for kept in self._arrays:
            start, end = end, end + _as_words(kept[:1]).shape[1]
            words = np.ascontiguousarray(words_M[:, start:end])
            of_size = words if kept.itemsize >= 4 else words.astype(f"u{kept.itemsize}")
            kept[self._first + lane_M] = of_size.view(kept.dtype).reshape(len(lane_M), *kept.shape[1:])

    def _words_of(self, place_M: NDArray[np.intp]) -> NDArray[np.uint32]:
        return np.concatenate([_as_words(kept[place_M]) for kept in self._arrays], axis=1)


def _as_words(array_M: NDArray) -> NDArray[np.uint32]:
    """The bits of an array [M, ...] as words [M, words], one for each number of less than 32 bits, as in simd."""
    rows = np.ascontiguousarray(array_M).reshape(len(array_M), -1)
    return rows.view(np.uint32) if rows.itemsize >= 4 else rows.view(f"u{rows.itemsize}").astype(np.uint32)


def lanes_of(name: str, *given: Any) -> Any:
    """The function that answers the parent: values of the lanes, by name of the method."""
    lanes = BlockLanes(name, *given)
    return lambda kind, *arguments: getattr(lanes, kind)(*arguments)
