"""The rollout `simd`: our compiler makes machine code of a task's functions (`workers/simd`), for CPUs and GPUs."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from es_service.protocol.episodes import OF_STEPS
from es_service.protocol.messages import TaskSpec, WorkerSpec
from es_service.protocol.options import OptionValue
from es_service.protocol.policies import FloatArray, Recipes
from es_service.protocol.policy_spec import PolicySpec
from es_service.protocol.process_environment import on_gpu
from es_service.protocol.recordings import Recordings, RecordRequest
from workers import environments
from workers.rollouts.backend import ChunkFunctions, Examination, RolloutBackend


class Simd(RolloutBackend):
    """Whole episodes as vector code, in which each lane is one environment.

    A worker with a GPU computes training episodes there, one environment a thread, and all else on its core: the bits
    are the same.
    """

    name = "simd"
    runs_in_threads = True
    runs_on_gpus = True
    gpus_only_train = True
    takes_chunks_together = True
    compile_s = (10, 4)

    def why_not(self, task: TaskSpec, policy: PolicySpec) -> str:
        """A memory of the policy, or the reason in the description of the task."""
        if policy.memory:
            return "its code of a policy has no memory (policy.memory)"
        return super().why_not(task, policy)

    def why_not_here(self) -> str:
        from workers.simd.backend.target import NoVectorsError, host_target

        try:
            host_target()
        except NoVectorsError as error:
            return str(error)
        return ""

    def examine(self, task: TaskSpec, options: Mapping[str, OptionValue]) -> Examination:
        """Why the task's steps cannot be compiled, and what a short trial of them finds."""
        from workers.simd.episodes.trial import examine

        return examine(task, options)

    def chunk_functions(self, spec: WorkerSpec) -> ChunkFunctions:
        from workers.rollouts.jax_tasks import judged
        from workers.simd.episodes import low_rank, rollout

        gpu = on_gpu()
        if gpu:
            import jax

            jax.config.update("jax_platforms", "cpu")  # JAX only traces here, and need not know the GPU
        environment = environments.make_environment(spec.environment, spec.environment_options)
        elsewhere = None
        # The code for GPUs keeps no outputs of steps, and has no noise of low rank.
        if gpu and not set(spec.outputs) & set(OF_STEPS) and not spec.noise_rank:
            from workers.simd.gpu.training import episodes_on_gpu

            elsewhere = episodes_on_gpu(environment, spec)
        functions = ChunkFunctions(
            rollout.make_training_rollout(environment, spec, elsewhere),
            rollout.make_evaluation_rollout(environment, spec),
            rollout.make_policy_rollout(environment, spec),
            low_rank.make_low_rank_gradient_sum(spec.policy, spec.noise_rank)
            if spec.noise_rank
            else rollout.make_gradient_sum(spec.policy.parameters),
        )
        return judged(functions, spec)

    def device(self) -> str:
        from workers.simd.gpu.cuda import the_gpu

        return the_gpu().name

    def made(self, recipes: Recipes) -> FloatArray:
        from workers.simd.episodes.noise_kernels import make_variation

        return make_variation()(recipes)

    def record(self, spec: WorkerSpec, requests: Sequence[RecordRequest]) -> Recordings:
        from workers.rollouts.jax_tasks import record
        from workers.simd.episodes.rollout import make_watched_rollout

        return record(make_watched_rollout, spec, requests)

    def random_steps(
        self, task: TaskSpec, options: Mapping[str, OptionValue], batch: int, steps: int
    ) -> Callable[[int], int]:
        from workers.rollouts.jax_tasks import random_steps
        from workers.simd.episodes.kernel import compile_kernel

        return random_steps(compile_kernel, task, options, batch, steps)
