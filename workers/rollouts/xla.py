"""The rollout `xla`: JAX runs a task's functions, on CPUs and GPUs. It is the reference, and runs every JAX task."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

from es_service.protocol.messages import TaskSpec, WorkerSpec
from es_service.protocol.options import OptionValue
from es_service.protocol.process_environment import on_gpu
from es_service.protocol.recordings import Recordings, RecordRequest
from workers import environments
from workers.rollouts.backend import ChunkFunctions, RolloutBackend


class Xla(RolloutBackend):
    """Batched episodes compiled by XLA (`workers/xla.py`)."""

    name = "xla"
    runs_on_gpus = True
    compile_s = (15, 6)

    def device(self) -> str:
        import jax

        return jax.devices()[0].device_kind

    def chunk_functions(self, spec: WorkerSpec) -> ChunkFunctions:
        from workers import xla
        from workers.rollouts.jax_tasks import judged, without_scatters

        environment = environments.make_environment(spec.environment, spec.environment_options)
        if gpu := on_gpu():
            reset, step = without_scatters(environment.reset), without_scatters(environment.step)
            environment = replace(environment, reset=reset, step=step)
        functions = ChunkFunctions(
            xla.make_training_rollout(environment, spec, in_pairs=gpu),
            xla.make_evaluation_rollout(environment, spec),
            xla.make_policy_rollout(environment, spec),
            xla.make_low_rank_gradient_sum(spec.policy, spec.noise_rank)
            if spec.noise_rank
            else xla.make_gradient_sum(spec.policy.parameters),
        )
        return judged(functions, spec)

    def record(self, spec: WorkerSpec, requests: Sequence[RecordRequest]) -> Recordings:
        """Recordings by the loop of the evaluations, in the slots of whole chunks."""
        from workers.rollouts.jax_tasks import record
        from workers.xla import make_watched_rollout

        return record(make_watched_rollout, spec, requests)

    def random_steps(
        self, task: TaskSpec, options: Mapping[str, OptionValue], batch: int, steps: int
    ) -> Callable[[int], int]:
        import jax

        from workers.rollouts.jax_tasks import random_steps

        return random_steps(lambda episode, *_: jax.jit(jax.vmap(episode)), task, options, batch, steps)
