"""What is found out about a task, in a process of its own, because this imports JAX, or code of the user.

`descriptions` describe a task such as `brax:ant` or `package.module:Class`. A task of Python objects then has a short
trial: does an episode repeat itself?

`examiner` tries a task for longer: whether its numbers are finite, whether its descriptor tells episodes apart, and one
of Python objects or a function whether it repeats and how fast. `es-service doctor TASK` runs it in two processes and
compares their hashes.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import time
from collections.abc import Callable, Mapping
from copy import copy
from dataclasses import asdict, dataclass, field, replace
from types import MappingProxyType
from typing import Any

import numpy as np

from es_service.protocol.machine import peak_memory_mib
from es_service.protocol.messages import NO_CHOICES, HostChoices, PolicySpec, TaskSpec, WorkerSpec
from es_service.protocol.noise import NORMAL_STD, Domain, evaluation_reset_keys, normal_integers, stream_keys
from es_service.protocol.options import OptionValue, option_values
from es_service.protocol.rollouts import choose
from es_service.protocol.sources import SUITES
from workers.environments import TaskError, choices_of, describe_environment, make_function_task, make_host_task
from workers.environments.host_task import HostEnvironment, HostTask
from workers.policy import initial_parameters
from workers.rollouts import BACKENDS

TRIAL_STEPS = 60
"""Most steps of an episode that is tried."""
TRIAL_S = 0.5
"""Time after which a trial does no further step, so that a slow simulator is described soon."""
SEED, OTHER_SEED = 1, 2
MOST_STEPS = 200
"""Most steps of an episode that is compared."""
BESIDE = 3
"""Objects that step beside the first."""
TRIED = 8
"""Random policies that are tried."""
EXTREME = np.float32(30.0)
"""Factor of the parameters of initial policies with which their actions are both small and great."""
ALONE = "alone"
"""Name of the first episode among the hashes; the others are to equal it."""


def _random_actions(made: HostTask, task: TaskSpec, steps: int) -> Any:
    """Actions of an episode [T, ...], the same in every process."""
    coordinates, key = np.arange(steps * task.action_size, dtype=np.uint32), stream_keys(0, Domain.ACTION_NOISE, 0, 0)
    action_T_A = np.clip(normal_integers(np, key, coordinates) / 32.0, -1.0, 1.0).astype(np.float32)
    return made.actions(action_T_A.reshape(steps, task.action_size))


def does_not_repeat(task: TaskSpec, options: Mapping[str, OptionValue], choices: HostChoices = NO_CHOICES) -> str:
    """Where the episode of a seed has other numbers than in a new object, in words; empty if nowhere.

    Tried are the same episode in an object that has had another one before, and in another new object. What is equal
    here may still differ in a longer episode, or in another process, which `es-service doctor TASK` tries.
    """
    made = make_host_task(task.name, options, choices, len(task.descriptor_names))
    actions_T = _random_actions(made, task, TRIAL_STEPS)

    def episode(environment: HostEnvironment, seed: int) -> list[bytes]:
        """Results of the steps, as far as there was time."""
        until, said = time.monotonic() + TRIAL_S, [environment.reset(seed).tobytes()]
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


def members(suite: str) -> Callable[[str], str]:
    """Function that answers "" with the names of a suite's environments, as JSON, and `SUITE:NAME` with the fields of
    its TaskSpec; either way, with {"problem": text} if it cannot. Whether simd can compile it is not tried."""
    from workers.environments.suite_task import adapter

    def answer(name: str) -> str:
        try:
            if not name:
                return json.dumps({"names": adapter(suite).names()})
            return json.dumps({"task": dataclasses.asdict(describe_environment(name))})
        except TaskError as error:
            return json.dumps({"problem": str(error)})

    return answer


@dataclass(frozen=True)
class Examined:
    """Findings about a task."""

    hashes: dict[str, str]
    """Trial -> hash of all that the object returned: ALONE in a new object, and then the same once more after
    another episode, and beside other objects. Empty for tasks in JAX."""
    steps_per_second: float
    """Steps of one core, or calls of a function; 0 for tasks in JAX."""
    peak_mib: int
    """Most memory of the process, in MiB."""
    fault: str = ""
    """What is not finite in the first such episode of random policies, with its reset; empty if all is."""
    same_descriptor_B: list[float] = field(default_factory=list)
    """Descriptor of all of these episodes, if they have the same one; else empty, and for functions."""
    step: dict[str, Any] = field(default_factory=dict)
    """Of a task in JAX: the fields of `workers.step_checks.StepCost`."""


def examine(task: TaskSpec, options: Mapping[str, OptionValue], choices: HostChoices, seconds: float) -> Examined:
    """Examine a task that is described as `task`, with these options and choices; at least one step is measured.

    Raises whatever the code of the task raises.
    """
    if task.parameters is not None:
        function = make_function_task(task.name, options)
        start_D = task.parameters.first(0, 0)

        def call(seed: int) -> str:
            return _hash([function(start_D, seed)])

        hashes = {ALONE: call(SEED), "after another call": (call(OTHER_SEED), call(SEED))[1]}
        return _measured(hashes, lambda: (call(SEED), 1)[1], seconds)
    if task.kind == "jax":
        from workers.step_checks import step_cost

        fault, same_B = _tried(task, options, choices)
        step = {} if fault else asdict(step_cost(task, options, seconds))
        return Examined({}, 0.0, peak_memory_mib(), fault, same_B, step)
    made = make_host_task(task.name, options, choices, len(task.descriptor_names))
    actions_T = _random_actions(made, task, MOST_STEPS)

    def episodes(environments: list[HostEnvironment], seeds: list[int]) -> tuple[str, int]:
        """(hash of the first episode, steps of all) of episodes that step side by side."""
        first_L = [environment.reset(seed) for environment, seed in zip(environments, seeds, strict=True)]
        said: list[Any] = [first_L[0]]
        steps, running = 0, list(range(len(environments)))
        for action in actions_T[: min(MOST_STEPS, task.episode_steps)]:
            done = set()
            for lane in running:
                result = environments[lane].step(copy(action))  # an object may change its array
                steps += 1
                if lane == 0:
                    said.append((*result, environments[0].descriptor()))
                if result[2]:
                    done.add(lane)
            running = [lane for lane in running if lane not in done]
            if not running:
                break
        return _hash(said), steps

    environment = HostEnvironment(made)
    hashes = {ALONE: episodes([environment], [SEED])[0]}
    episodes([environment], [OTHER_SEED])
    hashes["after another episode"] = episodes([environment], [SEED])[0]
    several = [HostEnvironment(made) for _ in range(1 + BESIDE)]
    hashes["beside other objects"] = episodes(several, [SEED, *range(OTHER_SEED, OTHER_SEED + BESIDE)])[0]
    measured = _measured(hashes, lambda: episodes([environment], [SEED])[1], seconds)
    fault, same_B = _tried(task, options, choices)
    return replace(measured, fault=fault, same_descriptor_B=same_B)


def _tried(task: TaskSpec, options: Mapping[str, OptionValue], choices: HostChoices) -> tuple[str, list[float]]:
    """`fault` and `same_descriptor_B` of `Examined`. The episodes are those of a worker, which knows what makes an
    episode invalid."""
    policy = PolicySpec((task.observation_size, 16, task.action_size))
    rollout = choose(BACKENDS, task, policy, gpu=False, here=True)
    spec = WorkerSpec(
        seed=SEED,
        environment=task.name,
        environment_options=dict(options),
        choices=choices,
        descriptor_size=0 if choices.descriptor is None else len(task.descriptor_names),
        policy=policy,
        episode_steps=min(MOST_STEPS, task.episode_steps),
        fitness="sum",
        episodes_per_member=1,
        observation_clip=None,
        action_noise=0.0,
        common_random_numbers=True,
        chunk_pairs=1,
        rollout_block_pairs=1,
        gradient_block_pairs=1,
        rollout=rollout,
        allow_infeasible=True,
    )
    initial_L_D = np.stack([initial_parameters(policy, "unit_columns", SEED, lane) for lane in range(TRIED)])
    keys_L = stream_keys(SEED, Domain.PARAMETER_NOISE, 0, np.arange(TRIED)).T[:, :, None]
    noise_L_D = normal_integers(np, keys_L, np.arange(initial_L_D.shape[1], dtype=np.uint32)) / NORMAL_STD
    parameters_L_D = (EXTREME * initial_L_D + noise_L_D).astype(np.float32)  # initial biases are 0
    mean_L_O, std_L_O = (np.full((TRIED, task.observation_size), value, np.float32) for value in (0.0, 1.0))
    keys_L_4 = evaluation_reset_keys(SEED, 0, np.arange(TRIED), 0)
    function = BACKENDS[rollout].chunk_functions(spec).policies
    episodes = function([parameters_L_D], mean_L_O, std_L_O, np.arange(TRIED), keys_L_4)
    descriptor_L_B = np.asarray(episodes.descriptor)
    is_same = (descriptor_L_B == descriptor_L_B[0]).all()
    return episodes.failures[0].text if episodes.failures else "", descriptor_L_B[0].tolist() if is_same else []


def _measured(hashes: dict[str, str], work: Callable[[], int], seconds: float) -> Examined:
    steps, started = 0, time.perf_counter()
    while not steps or time.perf_counter() - started < seconds:
        steps += work()
    rate = steps / (time.perf_counter() - started)
    return Examined(hashes, round(rate, 1), peak_memory_mib())


def _hash(said: list[Any]) -> str:
    """Hash of observations, rewards, ends and descriptors, bit for bit."""
    hasher = hashlib.sha256()
    for record in said:
        for part in record if isinstance(record, tuple) else (record,):
            hasher.update(np.asarray(part).tobytes())
    return hasher.hexdigest()


def examiner(name: str, settings: Mapping[str, Any]) -> Callable[[float], dict[str, Any]]:
    """Function from the seconds to measure to the fields of `Examined`; see `workers.describe` for the arguments."""
    task = described(name, settings)
    options = option_values(task.options, settings.get("options", {}))
    return lambda seconds: asdict(examine(task, options, choices_of(settings), seconds))
