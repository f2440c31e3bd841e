"""Environments of one task side by side, each in a lane: of the code that simd compiles, or else of xla's.

`functions` has what is computed for a lane, `compiled` the lanes of simd, `blocks` and `process` those of xla.

Axes: N lanes, O observation, A action, B descriptor.
"""

from __future__ import annotations

import functools
import warnings
from collections.abc import Mapping
from typing import NamedTuple, NoReturn

import numpy as np
from numpy.typing import NDArray

from es_service.protocol.messages import TaskSpec, with_options
from es_service.protocol.noise import Domain, stream_keys
from es_service.protocol.options import OptionValue, allowed_text, allowed_value, option_values
from workers.environments import SHIPPED, TaskError, describe_environment, is_function_task, is_host_task
from workers.lanes.blocks import BLOCK, Blocks, LaneResults
from workers.lanes.compiled import CompiledLanes, compiled_resets, kernels

__all__ = ["LaneResults", "Lanes", "LanesState", "task_named"]


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
        others = "brax:NAME, mujoco:ID, gymnax:NAME, playground:NAME or module:Class"
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
