"""The rollout `host`: environments that are Python objects, stepped by their own code, and policies in NumPy."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial

import numpy as np

from es_service.protocol.messages import EVALUATION_EPISODES_PER_CHUNK, TaskSpec, WorkerSpec
from es_service.protocol.noise import NORMAL_STD, Domain, normal_integers, seed_of, stream_keys
from es_service.protocol.options import OptionValue
from es_service.protocol.policies import POLICY_SLOTS, explicit
from es_service.protocol.recordings import Recording, Recordings, RecordRequest
from workers import progress
from workers.compiling import Compilable
from workers.environments import is_function_task, make_function_task, make_host_task
from workers.host import episodes as host_episodes  # modules, which import `rollouts.backend` in turn
from workers.host import functions as host_functions
from workers.policy import gradient_summer, members
from workers.rollouts.backend import ChunkFunctions, Episodes, RolloutBackend


class Host(RolloutBackend):
    """The environments of a chunk step side by side; those of a worker are used again for its next chunk.

    An episode's bits depend on its address and its policy, as far as the environments keep nothing from one episode to
    the next and repeat themselves.
    """

    name = "host"
    task_kinds = ("python", "function")
    compile_s = (0, 0)
    chunk_pairs = (8, 8)
    copies_late_items = False
    shares_processes = False

    def pair_limits(self, task: TaskSpec) -> tuple[int, int]:
        """One pair of calls, which may take long, or as many environments as an evaluation has."""
        return (1, 1) if task.kind == "function" else self.chunk_pairs

    def episodes_together(self, task: TaskSpec) -> int | None:
        """One call of a function, which may take long."""
        return 1 if task.kind == "function" else None

    def chunk_functions(self, spec: WorkerSpec) -> ChunkFunctions:
        """Functions that share the environments of a worker."""
        (run, prepare), count = make_runner(spec), spec.policy.parameters

        def training(centre_D, unit, mean_O, std_O, noise_keys_P, reset_keys_P_S_E, action_keys_P_S_E):
            parameters_L_D = members(spec, centre_D, unit, noise_keys_P).reshape(-1, count)
            keys_E_L = (_by_episode(keys) for keys in (reset_keys_P_S_E, action_keys_P_S_E))
            by_episode = [run(parameters_L_D, mean_O, std_O, *keys) for keys in zip(*keys_E_L, strict=True)]
            return _stacked(by_episode).map(lambda array: array.reshape(len(noise_keys_P), 2, *array.shape[1:]))

        def evaluation(centre_D, mean_O, std_O, reset_keys_E, wanted_E):
            return run(_in_lanes(centre_D, len(reset_keys_E)), mean_O, std_O, reset_keys_E, runs_L=wanted_E)

        def policies(given, mean_L_O, std_L_O, policy_L, reset_keys_L):
            return run(explicit(given)[policy_L], mean_L_O, std_L_O, reset_keys_L, keyed=spec.keyed_resets)

        return ChunkFunctions(
            Compilable(training, lambda *given: prepare(range(2 * len(given[4])))),
            Compilable(evaluation, lambda *given: prepare(np.flatnonzero(given[-1]).tolist())),
            Compilable(policies, lambda *given: prepare(range(len(given[-1])))),
            Compilable(gradient_summer(spec), lambda *_: None),
        )

    def record(self, spec: WorkerSpec, requests: Sequence[RecordRequest]) -> Recordings:
        """Recordings by the loop of the evaluations, in the slots of whole chunks."""
        run, _ = make_runner(spec)
        return Recordings(tuple(_recording(run, request) for request in requests), None)

    def random_steps(
        self, task: TaskSpec, options: Mapping[str, OptionValue], batch: int, steps: int
    ) -> Callable[[int], int]:
        """Steps of each environment of the batch in turn; one that ends is reset."""
        made = make_host_task(task.name, options)
        lanes = [environment for _, environment in host_episodes.EnvironmentPool(made).of(range(batch))]
        coordinates_A = np.arange(task.action_size, dtype=np.uint32)
        reset_keys_L_4 = stream_keys(0, Domain.TRAINING_RESET, 0, np.arange(batch))
        for lane in range(batch):
            lanes[lane].reset(seed_of(reset_keys_L_4[lane]))

        def call(number: int) -> int:
            key = stream_keys(0, Domain.TRAINING_RESET, number, np.arange(batch)).T[:, :, None]
            for step in range(steps):
                noise_L_A = normal_integers(np, key, coordinates_A + np.uint32(step * 1024)).astype(np.float32)
                actions_L = made.actions(np.clip(noise_L_A / np.float32(NORMAL_STD), -1.0, 1.0))
                for lane in range(batch):
                    if lanes[lane].step(actions_L[lane])[2]:
                        lanes[lane].reset(seed_of(reset_keys_L_4[lane]))
            return batch * steps

        return call


def make_runner(spec: WorkerSpec) -> tuple[Callable[..., Episodes], Callable[[Iterable[int]], object]]:
    """`run_episodes` with the environments of a worker, or `run_calls` with its function; and a function that makes
    what runs in some lanes and is missing, which takes time but does not change what a run gives."""
    if is_function_task(spec.environment):
        given = spec.environment, spec.environment_options
        (function,) = [make_function_task(*given) for _ in progress.counted("making", given[:1])]
        if spec.time_limit_s is None:
            return partial(host_functions.run_calls, function, function, spec), lambda lanes: None
        caller = host_functions.Caller(*given, spec.time_limit_s)
        return partial(host_functions.run_calls, function, caller, spec), lambda lanes: caller.start()
    described = spec.environment, spec.environment_options, spec.choices, spec.descriptor_size
    (task,) = [make_host_task(*described) for _ in progress.counted("making", described[:1])]
    lanes = host_episodes.EnvironmentPool(task)
    return partial(host_episodes.run_episodes, lanes, spec), lanes.of


def _by_episode(keys_P_S_E_4: np.ndarray) -> np.ndarray:
    """Keys of the episodes of a chunk's members as [E, L, 4], where both members of a pair are neighbours."""
    return np.moveaxis(keys_P_S_E_4, 2, 0).reshape(keys_P_S_E_4.shape[2], -1, keys_P_S_E_4.shape[-1])


def _in_lanes(array: np.ndarray, lanes: int) -> np.ndarray:
    return np.broadcast_to(array, (lanes, *array.shape))


def _stacked(by_episode: Sequence[Episodes]) -> Episodes:
    """Episodes [L] of each of a member's episodes as [L, E]."""
    columns = (np.stack(arrays, axis=1) for arrays in zip(*(episodes[:-4] for episodes in by_episode), strict=True))
    named = (
        {name: np.stack([values[name] for values in each], axis=1) for name in each[0]}
        for each in ([episodes.outputs for episodes in by_episode], [episodes.of_steps for episodes in by_episode])
    )
    failures = tuple(failed for episodes in by_episode for failed in episodes.failures)
    return Episodes._make([*columns, *named, None, failures])


def _recording(run: Callable[..., Episodes], request: RecordRequest) -> Recording:
    centre, slot = request.centre, request.slot
    count = EVALUATION_EPISODES_PER_CHUNK if request.policy is None else POLICY_SLOTS
    key = request.reset_key
    watched = host_episodes.Watched(slot, [], [])
    episodes = run(
        _in_lanes(centre.parameters_D, count),
        centre.observation_mean_O,
        centre.observation_std_O,
        _in_lanes(key, count),
        runs_L=np.arange(count) == slot,
        watched=watched,
        keyed=request.domain == Domain.OTHER_TASK_RESET,
    )
    descriptor_T_B = np.stack(watched.descriptors)
    host_episodes.known_from_the_start(descriptor_T_B)
    return Recording(
        descriptor_T_B=descriptor_T_B,
        returns_T=np.array(watched.returns, np.float32),
        poses_T_L_7=None,
        fitness=float(episodes.fitness[slot]),
        trace_T_B=episodes.trace_T_B[slot],
    )
