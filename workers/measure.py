"""Measure the speed of a task on one core, in a separate process that `es-service bench rollouts` starts."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from es_service.protocol.machine import peak_memory_mib
from es_service.protocol.messages import PolicySpec, TaskSpec, WorkerSpec
from es_service.protocol.noise import NORMAL_STD, Domain, stream_keys
from es_service.protocol.rollouts import why_not
from workers.describe import described
from workers.environments import SHIPPED
from workers.policy import initial_parameters
from workers.rollouts import BACKENDS
from workers.rollouts.backend import RolloutBackend

STEPS, STEPS_WITH_POLICY = 50, 200
"""Control steps of one call, without and with a policy.

With a policy, each call also makes the noise of its members, as a chunk of a run does.
"""


def measure(
    task: str, options: Mapping[str, str], hidden: list[int], policy: bool, batch: int, seconds: float, rollout: str
) -> dict:
    """Environment steps per second of one process, without the time for compilation.

    Args:
        task, options: name and options of the task, as in a config.
        hidden: widths of the policy's hidden layers.
        policy: whether to run a policy, with noise and statistics and with different weights for each member; if false,
            actions are random.
        batch: number of episodes that step together; with a policy they are both members of batch / 2 pairs.
        seconds: duration of the measurement.
        rollout: what computes the steps, a name in `workers.rollouts.BACKENDS`.

    Returns:
        steps_per_second, compile_seconds (without a policy this excludes resets) and peak_mib; or only `problem`, if
        the rollout cannot compute the task or cannot run on this machine.
    """
    size = SHIPPED[task] if task in SHIPPED else described(task, {"options": options})
    shape, backend = PolicySpec((size.observation_size, *hidden, size.action_size)), BACKENDS[rollout]
    if problem := why_not(backend, size, shape, here=True):
        return {"problem": problem}
    if policy:
        call = _with_policy(backend, shape, size, options, batch)
    else:
        call = backend.random_steps(size, options, batch, STEPS)
    started = time.perf_counter()
    call(0)  # the first call compiles
    ready = time.perf_counter()
    steps = calls = 0
    while (now := time.perf_counter()) - ready < seconds or calls == 0:
        steps += call(calls := calls + 1)
    return {
        "steps_per_second": round(steps / (now - ready)),
        "compile_seconds": round(ready - started, 2),
        "peak_mib": peak_memory_mib(),
    }


def _with_policy(
    backend: RolloutBackend, shape: PolicySpec, task: TaskSpec, options: Mapping[str, str], batch: int
) -> Callable[[int], int]:
    """Function that runs training episodes with a policy and returns the number of steps."""
    pairs = batch // 2
    spec = WorkerSpec(
        seed=0,
        environment=task.name,
        environment_options=dict(options),
        episode_steps=STEPS_WITH_POLICY,
        fitness="sum",
        episodes_per_member=1,
        policy=shape,
        observation_clip=5.0,
        action_noise=0.01,
        common_random_numbers=True,
        chunk_pairs=pairs,
        rollout_block_pairs=pairs,
        gradient_block_pairs=pairs,
        rollout=backend.name,
    )
    episodes = backend.chunk_functions(spec).training
    centre_D = initial_parameters(shape, "unit_columns", 0)
    mean_O, std_O = np.zeros(shape.widths[0], np.float32), np.ones(shape.widths[0], np.float32)

    def call(number: int) -> int:
        noise_keys_P = stream_keys(0, Domain.PARAMETER_NOISE, number, np.arange(pairs))
        keys_P_S_E = np.broadcast_to(noise_keys_P[:, None, None], (pairs, 2, 1, 4))
        unit = np.float32(0.02 / NORMAL_STD)
        return int(np.sum(episodes(centre_D, unit, mean_O, std_O, noise_keys_P, keys_P_S_E, keys_P_S_E).steps))

    return call


def measurer(task: str, given: Mapping[str, Any]) -> Callable[[], dict]:
    """Function that measures, for a child process; `given`: the other arguments of `measure`."""
    return lambda: measure(task, **given)
