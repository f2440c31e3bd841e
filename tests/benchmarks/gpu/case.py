"""One measurement in a process of its own: steps a second of a population's training episodes, or their returns."""

from __future__ import annotations

import fcntl
import gzip
import hashlib
import json
import os
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from es_service.api import load_config
from es_service.config.tasks import task_of
from es_service.config.workload import worker_spec
from es_service.protocol.messages import WorkerSpec
from es_service.protocol.noise import NORMAL_STD, Domain, normal_integers, stream_keys
from tests.benchmarks.gpu.policies import WAYS, Way
from workers import environments
from workers.episode import episode_steps
from workers.policy import initial_parameters
from workers.rollouts.jax_tasks import without_scatters
from workers.worker import episode_keys
from workers.xla import make_training_rollout

SIGMA = 0.02


def spec_of(case: dict[str, Any]) -> WorkerSpec:
    """Constants of a run on the task with as many members as the case has, which all step together."""
    pairs = case["members"] // 2
    config = load_config(
        {
            "task": {"environment": case["task"], "episode_steps": case["steps"]},
            "search": {"algorithm": "es", "pairs": pairs, "sigma": SIGMA, "noise": case.get("noise", {"kind": "full"})},
            "policy": {"hidden": case["hidden"], "action_noise": 0.01},
            "compute": {"rollout": "xla", "chunk_pairs": pairs, "rollout_block_pairs": pairs},
        },
        searches=False,
    )
    return worker_spec(config, task_of(config))


def rollout_of(spec: WorkerSpec, way: Way | None, *, scatters: bool = False) -> Callable[..., Any]:
    """Function of the arguments of `ChunkFunctions.training` that runs one episode of all members side by side.

    Args:
        way: how the policies are computed; None: the rollout as workers with a GPU run it.
        scatters: whether scatters of the task stay, which workers do without.
    """
    environment = environments.make_environment(spec.environment, spec.environment_options)
    if not scatters:
        reset, step = without_scatters(environment.reset), without_scatters(environment.step)
        environment = replace(environment, reset=reset, step=step)
    if way is None:
        return make_training_rollout(environment, spec, in_pairs=True).run
    steps = episode_steps(environment, spec, training=True)
    coordinates_D = np.arange(spec.policy.parameters, dtype=np.uint32)
    observations = jax.vmap(steps.normalised_observation, in_axes=(0, None, None))
    advance = jax.vmap(steps.advance, in_axes=(0, None, 0, 0))

    def rollout(centre_D, unit, mean_O, std_O, noise_keys_P, reset_keys_P_S_E, action_keys_P_S_E):
        noise_P_D = jax.vmap(lambda key: normal_integers(jnp, key, coordinates_D))(noise_keys_P)
        prepared = way.prepare(spec.policy, centre_D, unit, noise_P_D)
        reset_keys_M, action_keys_M = (keys.reshape(-1, 4) for keys in (reset_keys_P_S_E, action_keys_P_S_E))

        def body(at):
            step, carry = at
            outputs_M_A = way.outputs(spec.policy, prepared, observations(carry, mean_O, std_O))
            return step + 1, advance(carry, mean_O, outputs_M_A, action_keys_M)

        def unfinished(at):
            return (at[0] < spec.episode_steps) & at[1].alive.any()

        _, end = lax.while_loop(unfinished, body, (jnp.int32(0), jax.vmap(steps.begin)(reset_keys_M)))
        return end.episode

    return rollout


def arguments_of(spec: WorkerSpec) -> tuple[Any, ...]:
    """Arguments of a rollout of generation 0 around a random centre."""
    pairs_P = np.arange(spec.chunk_pairs)
    observations = spec.policy.widths[0]
    return (
        initial_parameters(spec.policy, "unit_columns", 0),
        np.float32(SIGMA / NORMAL_STD),
        np.zeros(observations, np.float32),
        np.ones(observations, np.float32),
        stream_keys(spec.seed, Domain.PARAMETER_NOISE, 0, pairs_P),
        *episode_keys(spec, 0, pairs_P, ()),
    )


def measure(case: dict[str, Any], out: Path, lock: Path) -> dict[str, Any]:
    """Compile, and then, when no other case computes, run twice; the second time counts."""
    spec = spec_of(case)
    given = arguments_of(spec)
    rollout = jax.jit(rollout_of(spec, WAYS.get(case["way"]), scatters=case.get("scatters", False)))
    began = time.perf_counter()
    compiled = rollout.lower(*given).compile()
    row = {**case, "compile_s": round(time.perf_counter() - began, 1)}
    if case.get("keep_program"):
        with gzip.open(out / f"program_{case['way']}_{case['task'].replace(':', '_')}.txt.gz", "wt") as file:
            file.write(compiled.as_text() or "")
    with lock.open("a") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        timed = [_timed(compiled, given) for _ in range(3)]
    episodes, seconds, digests = timed[-1][1], [timing[0] for timing in timed], [digest(timing[1]) for timing in timed]
    steps = int(episodes.steps.sum())
    stats = jax.devices()[0].memory_stats() or {}
    if case.get("keep_returns"):
        name = case["task"].replace(":", "_")
        np.savez(
            out / f"returns_{name}_{case['way']}.npz",
            returns=episodes.returns,
            descriptor=episodes.descriptor,
            steps=episodes.steps,
        )
    return row | {
        "device": jax.devices()[0].device_kind,
        "env_steps": steps,
        "seconds": [round(s, 3) for s in seconds],
        "steps_per_second": round(steps / min(seconds[1:])),
        "ms_per_step": round(1e3 * min(seconds[1:]) / int(episodes.steps.max()), 3),
        "peak_gib": round(stats.get("peak_bytes_in_use", 0) / 2**30, 2),
        "digest": digests[0],
        "repeats": len(set(digests)) == 1,
        "mean_return": float(np.mean(episodes.returns)),
    }


def _timed(compiled: Callable[..., Any], given: tuple[Any, ...]) -> tuple[float, Any]:
    """Seconds of a call, and the results as arrays of NumPy."""
    began = time.perf_counter()
    episodes = jax.tree.map(np.asarray, jax.block_until_ready(compiled(*given)))
    return time.perf_counter() - began, episodes


def digest(episodes: Any) -> str:
    """Hash of all results."""
    return hashlib.sha256(b"".join(np.asarray(x).tobytes() for x in jax.tree.leaves(episodes))).hexdigest()[:16]


if __name__ == "__main__":
    given_case = json.loads(sys.argv[1])
    try:
        answer = measure(given_case, Path(sys.argv[2]), Path(sys.argv[3]))
    except Exception as error:
        answer = given_case | {"error": f"{type(error).__name__}: {str(error)[:300]}"}
    print(json.dumps(answer), flush=True)
    os._exit(0)
