"""Outputs of episodes that are computed only if a run names them; `es_service/protocol/outputs.py` has their names."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from es_service.protocol.messages import FloatArray, WorkerSpec
from es_service.protocol.outputs import AT_THE_END, OF_STEPS
from workers.environments.host_task import HostEnvironment, HostTask


class Step(NamedTuple):
    """One step of an episode."""

    environment: HostEnvironment
    """The environment after the step."""
    before_O: FloatArray
    """Observation on which the policy acted."""
    action_A: FloatArray
    """Action of the policy, with its noise."""
    observation_O: FloatArray
    reward: float
    done: bool


class Output(NamedTuple):
    """An output as functions of a step. The result of an episode has the value of its last step, or of each one."""

    size: Callable[[WorkerSpec, HostTask], tuple[int, ...]]
    """Function from the run to the shape of the value."""
    dtype: type
    of: Callable[[Step], Any]


def _scalar(spec: WorkerSpec, task: HostTask) -> tuple[int, ...]:
    return ()


def _observation(spec: WorkerSpec, task: HostTask) -> tuple[int, ...]:
    return (task.observation_size,)


OUTPUTS: Mapping[str, Output] = {
    "success": Output(_scalar, bool, lambda step: step.environment.success()),
    "last_reward": Output(_scalar, np.float32, lambda step: step.reward),
    "first_observation": Output(_observation, np.float32, lambda step: step.environment.first_observation_O),
    "last_observation": Output(_observation, np.float32, lambda step: step.observation_O),
    "observation": Output(_observation, np.float32, lambda step: step.before_O),
    "action": Output(lambda spec, task: (spec.policy.widths[-1],), np.float32, lambda step: step.action_A),
    "reward": Output(_scalar, np.float32, lambda step: step.reward),
    "done": Output(_scalar, bool, lambda step: step.done),
    "step_descriptor": Output(
        lambda spec, task: (task.descriptor_size,), np.float32, lambda step: step.environment.descriptor()
    ),
}
"""All outputs by name."""
assert {*OUTPUTS} == {*AT_THE_END, *OF_STEPS}


class Outputs:
    """The outputs that a run names, of episodes in lanes; values of lanes that do not run, and after the end, are 0."""

    def __init__(self, names: Sequence[str], spec: WorkerSpec, task: HostTask, lanes: int) -> None:
        """Begin with values of 0. Raises ValueError for a name that no output has."""
        if unknown := sorted({*names} - {*OUTPUTS}):
            raise ValueError(f"no output of episodes has the name {unknown[0]!r}; choose among {', '.join(OUTPUTS)}")
        self._named = {name: OUTPUTS[name] for name in names}

        def zeros(name: str, *axes: int) -> Any:
            return np.zeros((*axes, *OUTPUTS[name].size(spec, task)), OUTPUTS[name].dtype)

        self.at_the_end = {name: zeros(name, lanes) for name in names if name not in OF_STEPS}
        """[L, ...]"""
        self.of_steps = {name: zeros(name, lanes, spec.episode_steps) for name in names if name in OF_STEPS}
        """[L, T, ...]"""

    def __bool__(self) -> bool:
        return bool(self._named)

    def note(self, lane: int, number: int, step: Step, *, is_last: bool) -> None:
        """Keep the outputs of a step; steps are counted from 0."""
        for name, kept in self.of_steps.items():
            kept[lane, number] = self._named[name].of(step)
        if is_last:
            for name, kept in self.at_the_end.items():
                kept[lane] = self._named[name].of(step)
