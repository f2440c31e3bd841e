"""A short trial of a task of Python objects, when it is described: does an episode repeat itself?"""

from __future__ import annotations

import multiprocessing
import os
import time
from multiprocessing.connection import Connection

import numpy as np

from es_service.protocol.messages import TaskSpec
from es_service.protocol.noise import Domain, normal_integers, stream_keys
from workers.environments import make_host_task
from workers.environments.host_task import HostEnvironment

STEPS = 60
"""Most steps of an episode that is tried."""
LONGEST_S = 0.5
"""Time after which a trial does no further step, so that a slow simulator is described soon."""
WAIT_S = 5.0
"""Longest wait for the whole trial."""
SEED, OTHER_SEED = 1, 2


def tried(task: TaskSpec) -> str:
    """`does_not_repeat` in a process of its own; empty as well if that ends, raises or hangs, as a simulator may.

    What is wrong then is told where episodes are run.
    """
    processes = multiprocessing.get_context("fork")  # of a process that has imported no JAX and has no threads
    here, there = processes.Pipe(duplex=False)
    child = processes.Process(target=_tell, args=(there, task))
    child.start()
    there.close()
    try:
        return here.recv() if here.poll(WAIT_S) else ""
    except EOFError:
        return ""
    finally:
        child.kill()
        child.join()


def _tell(there: Connection, task: TaskSpec) -> None:
    nowhere = os.open(os.devnull, os.O_WRONLY)
    for output in (1, 2):  # what a simulator prints is not the description
        os.dup2(nowhere, output)
    there.send(does_not_repeat(task))


def does_not_repeat(task: TaskSpec) -> str:
    """Where the episode of a seed has other numbers than in a new object, in words; empty if nowhere.

    Tried are the same episode in an object that has had another one before, and in another new object. What is equal
    here may still differ in a longer episode, or in another process, which `es-service doctor TASK` tries.
    """
    made = make_host_task(task.name, {name: option.default for name, option in task.options.items()})
    coordinates, key = np.arange(STEPS * task.action_size, dtype=np.uint32), stream_keys(0, Domain.ACTION_NOISE, 0, 0)
    action_T_A = np.clip(normal_integers(np, key, coordinates) / 32.0, -1.0, 1.0).astype(np.float32)
    actions_T = made.actions(action_T_A.reshape(STEPS, task.action_size))

    def episode(environment: HostEnvironment, seed: int) -> list[bytes]:
        """What each step has returned, as far as there was time."""
        until, said = time.monotonic() + LONGEST_S, [environment.reset(seed).tobytes()]
        for action in actions_T[: task.episode_steps]:
            observation_O, reward, done = environment.step(action)
            said.append(np.array([*observation_O, reward, done], np.float64).tobytes())
            if done or time.monotonic() > until:
                break
        return said

    def differs(first: list[bytes], second: list[bytes]) -> bool:
        return any(one != other for one, other in zip(first, second, strict=False))

    used = HostEnvironment(made)
    alone = episode(used, SEED)
    episode(used, OTHER_SEED)
    found = {
        "after another episode": differs(alone, episode(used, SEED)),
        "in another object": differs(alone, episode(HostEnvironment(made), SEED)),
    }
    return " and ".join(where for where, is_other in found.items() if is_other)
