"""A short trial of a task of Python objects, when it is described: does an episode repeat itself?"""

from __future__ import annotations

import time
from collections.abc import Mapping
from copy import copy

import numpy as np

from es_service.protocol.messages import NO_CHOICES, HostChoices, TaskSpec
from es_service.protocol.noise import Domain, normal_integers, stream_keys
from es_service.protocol.options import OptionValue
from workers.environments import make_host_task
from workers.environments.host_task import HostEnvironment

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
