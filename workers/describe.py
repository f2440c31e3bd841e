"""Describe a task such as `brax:ant` or `package.module:Class`, in a separate process because this imports JAX, or code
of the user.

A task of Python objects then has a short trial: does an episode repeat itself?
"""

from __future__ import annotations

import dataclasses
import json
import time
from collections.abc import Callable, Mapping
from copy import copy
from types import MappingProxyType
from typing import Any

import numpy as np

from es_service.protocol.messages import NO_CHOICES, HostChoices, TaskSpec
from es_service.protocol.noise import Domain, normal_integers, stream_keys
from es_service.protocol.options import OptionValue, option_values
from es_service.protocol.sources import SUITES
from workers.environments import TaskError, choices_of, describe_environment, make_host_task
from workers.environments.host_task import HostEnvironment
from workers.rollouts import BACKENDS

STEPS = 60
"""Most steps of an episode that is tried."""
LONGEST_S = 0.5
"""Time after which a trial does no further step, so that a slow simulator is described soon."""
SEED, OTHER_SEED = 1, 2


def does_not_repeat(task: TaskSpec, options: Mapping[str, OptionValue], choices: HostChoices = NO_CHOICES) -> str:
    """Where the episode of a seed has other numbers than in a new object, in words; empty if nowhere.

    Tried are the same episode in an object that has had another one before, and in another new object. What is equal
    here may still differ in a longer episode, or in another process, which `es-service doctor TASK` tries.
    """
    made = make_host_task(task.name, options, choices, len(task.descriptor_names))
    coordinates, key = np.arange(STEPS * task.action_size, dtype=np.uint32), stream_keys(0, Domain.ACTION_NOISE, 0, 0)
    action_T_A = np.clip(normal_integers(np, key, coordinates) / 32.0, -1.0, 1.0).astype(np.float32)
    actions_T = made.actions(action_T_A.reshape(STEPS, task.action_size))

    def episode(environment: HostEnvironment, seed: int) -> list[bytes]:
        """Results of the steps, as far as there was time."""
        until, said = time.monotonic() + LONGEST_S, [environment.reset(seed).tobytes()]
        for action in actions_T[: task.episode_steps]:
            observation_O, reward, done = environment.step(copy(action))  # an object may change its array
            said.append(np.array([*observation_O, reward, done], np.float64).tobytes())
            if done or time.monotonic() > until:
                break
        return said

    def differs(first: list[bytes], second: list[bytes]) -> bool:
        return any(step != other for step, other in zip(first, second, strict=False))

    used = HostEnvironment(made)
    alone = episode(used, SEED)
    episode(used, OTHER_SEED)
    differences = {
        "after another episode": differs(alone, episode(used, SEED)),
        "in another object": differs(alone, episode(HostEnvironment(made), SEED)),
    }
    return " and ".join(where for where, is_other in differences.items() if is_other)


def described(name: str, settings: Mapping[str, Any] = MappingProxyType({})) -> TaskSpec:
    """Description of a task that is no shipped one, with the reasons of the rollouts that cannot run it.

    Args:
        settings: see `describe_environment`.

    Raises:
        TaskError: the task does not exist or cannot be used.
    """
    task = describe_environment(name, settings)
    options = option_values(task.options, settings.get("options", {}))
    able = {name: backend for name, backend in BACKENDS.items() if task.kind in backend.task_kinds}
    examined = {name: backend.examine(task, options) for name, backend in able.items()}
    return dataclasses.replace(
        task,
        unsupported={name: found.unsupported for name, found in examined.items() if found.unsupported},
        hidden={name: found.hidden for name, found in examined.items() if found.hidden},
        notes=(*task.notes, *(note for found in examined.values() for note in found.notes)),
    )


def descriptions(name: str, settings: Mapping[str, Any]) -> Callable[[str], Any]:
    """Function that answers "task" with the fields of a TaskSpec as JSON, which needs no class of the user's, or
    {"problem": text}; and then "repeats" with where a task of Python objects was found not to repeat itself.

    Args:
        name, settings: see `describe_environment`.
    """
    task: TaskSpec | None = None

    def options() -> Mapping[str, OptionValue]:
        assert task is not None, "it has been described"
        return option_values(task.options, settings.get("options", {}))

    def answer(question: str) -> str:
        nonlocal task
        if question == "repeats":
            assert task is not None, "it has been described"
            return does_not_repeat(task, options(), choices_of(settings))
        try:
            task = described(name, settings)
            if task.kind == "jax" and name.partition(":")[0] not in ("brax", "mujoco", *SUITES):
                from workers.step_checks import require_pure

                require_pure(task, options())
            return json.dumps({"task": dataclasses.asdict(task)})
        except TaskError as error:
            return json.dumps({"problem": str(error)})

    return answer
