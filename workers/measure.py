"""Measure the speed of a task on one core, in a separate process that `es-service bench rollouts` starts.

    python -m workers.measure JSON      # the arguments of `measure`

Prints one line of JSON.
"""

from __future__ import annotations

import json
import resource
import sys
import time
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from es_service.protocol.messages import PolicyShape, WorkerSpec
from es_service.protocol.noise import NORMAL_STD, Domain, normal_integers, stream_keys
from workers.environments import SHIPPED, Environment, describe_environment, make_environment
from workers.policy import initial_parameters
from workers.rollout import make_training_rollout
from workers.simd.backend.target import NoVectorsError
from workers.simd.episodes import rollout as simd_rollout
from workers.simd.episodes.kernel import compile_kernel
from workers.simd.graph.unsupported import UnsupportedError

STEPS, STEPS_WITH_POLICY = 50, 200
"""Control steps of one call, without and with a policy.

With a policy, each call also makes the noise of its members, as a chunk of a run does.
"""


def measure(
    task: str,
    options: Mapping[str, str],
    hidden: list[int],
    policy: bool,
    batch: int,
    seconds: float,
    rollout: str = "xla",
) -> dict:
    """Environment steps per second of one process, without the time for compilation.

    Args:
        task, options: name and options of the task, as in a config.
        hidden: widths of the policy's hidden layers.
        policy: whether to run a policy, with noise and statistics and with different weights for each member; if false,
            actions are random.
        batch: number of episodes that step together; with a policy they are both members of batch / 2 pairs.
        seconds: duration of the measurement.
        rollout: what computes the steps, "xla" or "simd".

    Returns:
        steps_per_second, compile_seconds (without a policy this excludes resets) and peak_mib; or only `problem`, if
        simd cannot compile the task or cannot run on this processor.
    """
    size = SHIPPED[task] if task in SHIPPED else describe_environment(task)
    environment = make_environment(task, options)
    shape = PolicyShape((size.observation_size, *hidden, size.action_size))
    states = None if policy else _after_reset(environment, batch)
    started = time.perf_counter()
    try:
        if policy:
            call = _with_policy(environment, shape, task, batch, rollout)
        else:
            call = _without_policy(environment, shape, states, rollout)
        call(0)  # the first call compiles
    except (UnsupportedError, NoVectorsError) as error:
        return {"problem": str(error.__cause__ or error)}  # the message of the cause contains no advice about runs
    ready = time.perf_counter()
    steps = calls = 0
    while (now := time.perf_counter()) - ready < seconds or calls == 0:
        steps += call(calls := calls + 1)
    return {
        "steps_per_second": round(steps / (now - ready)),
        "compile_seconds": round(ready - started, 2),
        "peak_mib": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024),
    }


def _with_policy(environment: Environment, shape: PolicyShape, task: str, batch: int, rollout: str) -> Any:
    """Function that runs training episodes with a policy and returns the number of steps."""
    pairs = batch // 2
    spec = WorkerSpec(
        seed=0,
        environment=task,
        environment_options={},
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
    )
    make = simd_rollout.make_training_rollout if rollout == "simd" else make_training_rollout
    episodes = make(environment, spec)
    centre_D = initial_parameters(shape, "unit_columns", 0)
    mean_O, std_O = np.zeros(shape.widths[0], np.float32), np.ones(shape.widths[0], np.float32)

    def call(number: int) -> int:
        noise_keys_P = stream_keys(0, Domain.PARAMETER_NOISE, number, np.arange(pairs))
        keys_P_S_E = np.broadcast_to(noise_keys_P[:, None, None], (pairs, 2, 1, 4))
        unit = np.float32(0.02 / NORMAL_STD)
        return int(np.sum(episodes(centre_D, unit, mean_O, std_O, noise_keys_P, keys_P_S_E, keys_P_S_E).steps))

    return call


def _after_reset(environment: Environment, batch: int) -> Any:
    """States [batch, ...] after a reset."""
    keys = stream_keys(0, Domain.TRAINING_RESET, 0, np.arange(batch))
    return jax.block_until_ready(jax.jit(jax.vmap(environment.reset))(keys))


def _without_policy(environment: Environment, shape: PolicyShape, states: Any, rollout: str) -> Any:
    """Function that runs STEPS control steps with random actions and returns the number of steps."""
    batch = len(jax.tree.leaves(states)[0])
    coordinates_A = jnp.arange(shape.widths[-1], dtype=jnp.uint32)

    def episode(key: Any, state: Any) -> Any:
        def step(number: Any, carry: tuple[Any, Any]) -> tuple[Any, Any]:
            state, total = carry
            noise_A = normal_integers(jnp, key, number.astype(jnp.uint32) * 1024 + coordinates_A)
            state, reward, _ = environment.step(state, jnp.clip(noise_A.astype(jnp.float32) / NORMAL_STD, -1.0, 1.0))
            return state, total + reward + environment.observe(state).sum()

        return lax.fori_loop(0, STEPS, step, (state, jnp.float32(0.0)))[1]

    if rollout == "xla":
        episodes = jax.jit(jax.vmap(episode))
    else:
        one_state = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape[1:], x.dtype), states)
        episodes = compile_kernel(episode, jax.ShapeDtypeStruct((4,), jnp.uint32), one_state)

    def call(number: int) -> int:
        jax.block_until_ready(episodes(stream_keys(0, Domain.TRAINING_RESET, number, np.arange(batch)), states))
        return batch * STEPS

    return call


def main(arguments: str) -> None:
    """Print the result of `measure` for arguments in JSON."""
    print(json.dumps(measure(**json.loads(arguments))))


if __name__ == "__main__":
    main(sys.argv[1])
