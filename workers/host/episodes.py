"""Episodes in lanes that step side by side, each with an environment of its own.

Axes: L lanes, O observation, A action, B descriptor, T points of a trace.

OUTPUTS are computed only if a run names them; `es_service/protocol/episodes.py` has their names.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from math import inf, isfinite
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from es_service.protocol.episodes import AT_THE_END, INFEASIBLE, METRICS, OF_STEPS
from es_service.protocol.messages import TRACE_POINTS, FloatArray, WorkerSpec
from es_service.protocol.noise import seed_of
from workers import progress
from workers.environments.host_task import HostEnvironment, HostTask
from workers.policy import LanePolicies
from workers.rollouts.backend import Episodes, FailedEpisode, observation_text, raised_in_lane


class HostStep(NamedTuple):
    environment: HostEnvironment
    """The environment after the step."""
    before_O: FloatArray
    """Observation on which the policy acted."""
    action_A: FloatArray
    """Action of the policy, with its noise."""
    observation_O: FloatArray
    reward: float
    done: bool


class HostOutput(NamedTuple):
    """An output as functions of a step. The result of an episode has the value of its last step, or of each one."""

    size: Callable[[WorkerSpec, HostTask], tuple[int, ...]]
    """Function from the run to the shape of the value."""
    dtype: type
    of: Callable[[HostStep], Any]


def _scalar(spec: WorkerSpec, task: HostTask) -> tuple[int, ...]:
    return ()


def _observation(spec: WorkerSpec, task: HostTask) -> tuple[int, ...]:
    return (task.observation_size,)


OUTPUTS: Mapping[str, HostOutput] = {
    "success": HostOutput(_scalar, bool, lambda step: step.environment.success()),
    "last_reward": HostOutput(_scalar, np.float32, lambda step: step.reward),
    METRICS: HostOutput(
        lambda spec, task: (len(task.metric_names),), np.float32, lambda step: step.environment.metrics()
    ),
    "first_observation": HostOutput(_observation, np.float32, lambda step: step.environment.first_observation_O),
    "last_observation": HostOutput(_observation, np.float32, lambda step: step.observation_O),
    "observation": HostOutput(_observation, np.float32, lambda step: step.before_O),
    "action": HostOutput(lambda spec, task: (spec.policy.widths[-1],), np.float32, lambda step: step.action_A),
    "reward": HostOutput(_scalar, np.float32, lambda step: step.reward),
    "done": HostOutput(_scalar, bool, lambda step: step.done),
    "step_descriptor": HostOutput(
        lambda spec, task: (task.descriptor_size,), np.float32, lambda step: step.environment.descriptor()
    ),
}
assert {*OUTPUTS} == {*AT_THE_END, *OF_STEPS}, "each name of protocol/episodes.py has its functions here"


class Outputs:
    """The outputs that a run names, of episodes in lanes; values of lanes that do not run, and after the end, are 0."""

    def __init__(self, names: Sequence[str], spec: WorkerSpec, task: HostTask, lanes: int) -> None:
        """Begin with values of 0. Raises ValueError for a name that no output has."""
        if unknown := sorted({*names} - {*OUTPUTS}):
            raise ValueError(f"no output of episodes has the name {unknown[0]!r}; choose among {', '.join(OUTPUTS)}")
        self._named = {name: OUTPUTS[name] for name in names}

        def zeros(name: str, *axes: int) -> Any:
            return np.zeros((*axes, *OUTPUTS[name].size(spec, task)), OUTPUTS[name].dtype)

        self.at_the_end = {name: zeros(name, lanes) for name in names if name not in OF_STEPS}
        """[L, ...]"""
        self.of_steps = {name: zeros(name, lanes, spec.episode_steps) for name in names if name in OF_STEPS}
        """[L, T, ...]"""

    def __bool__(self) -> bool:
        return bool(self._named)

    def note(self, lane: int, number: int, step: HostStep, *, is_last: bool) -> None:
        """Keep the outputs of a step; steps are counted from 0."""
        for name, kept in self.of_steps.items():
            kept[lane, number] = self._named[name].of(step)
        if is_last:
            for name, kept in self.at_the_end.items():
                kept[lane] = self._named[name].of(step)


SHOWN = 4
"""Parameters of a policy that a message shows."""


class Watched(NamedTuple):
    """What is kept of one lane for a replay, from the reset on."""

    lane: int
    descriptors: list[FloatArray]
    returns: list[float]


class EnvironmentPool:
    """The environments of a worker's lanes, made when they are first needed and used for one episode after another."""

    def __init__(self, task: HostTask) -> None:
        self.task = task
        self._environments: dict[int, HostEnvironment] = {}

    def of(self, lanes: Iterable[int]) -> list[tuple[int, HostEnvironment]]:
        """These lanes, each with its environment; those that are missing are made, in this order."""
        wanted = list(lanes)
        for lane in progress.counted("making", [lane for lane in wanted if lane not in self._environments]):
            self._environments[lane] = HostEnvironment(self.task)
        return [(lane, self._environments[lane]) for lane in wanted]


def run_episodes(
    lanes: EnvironmentPool,
    spec: WorkerSpec,
    parameters_L_D: FloatArray,
    mean: FloatArray,
    std: FloatArray,
    reset_keys_L_4: NDArray[np.uint32],
    action_keys_L_4: NDArray[np.uint32] | None = None,
    *,
    runs_L: NDArray[np.bool_] | None = None,
    watched: Watched | None = None,
    keyed: bool = False,
) -> Episodes:
    """One episode in each lane, all of a policy of its own.

    Lanes whose episode has ended, and those that do not run, keep their policy with an observation that does not
    change, so that the shapes of all products stay the same.

    Args:
        mean, std: observation statistics, [O] of all lanes or [L, O].
        action_keys_L_4: stream keys of the action noise of training episodes, which have sums of observations, shifted
            by `mean`; None for evaluations, which have traces.
        runs_L: which lanes run; None for all. The results of the others are 0.
        watched: filled with the episode of one lane.
        keyed: whether the environments draw their starts with the noise of their reset keys, as far as they can.

    Returns:
        Episodes with leading axis [L].
    """
    count, size, task, training = len(reset_keys_L_4), spec.policy.widths[0], lanes.task, action_keys_L_4 is not None
    policies = LanePolicies(spec, parameters_L_D, mean, std, action_keys_L_4)
    alive_L = np.ones(count, bool) if runs_L is None else runs_L.copy()
    running = lanes.of(np.flatnonzero(alive_L).tolist())
    points = min(TRACE_POINTS, spec.episode_steps + 1)
    last_steps_T = np.arange(points) * spec.episode_steps // (points - 1)
    traced = frozenset() if training else frozenset(last_steps_T.tolist())

    observation_L_O = np.zeros((count, size), np.float32)
    returns_L, reward_L, steps_L = np.zeros(count), np.zeros(count), np.zeros(count, np.int32)
    descriptor_L_B = np.zeros((count, task.descriptor_size), np.float32)
    goal_distance_L_2 = np.full((count, 2), np.nan, np.float32)
    sum_L_O, square_L_O = np.zeros((2, count, size if training else 0), np.float32)
    trace_L_T_B = np.zeros((count, 0 if training else points, task.descriptor_size), np.float32)
    outputs = Outputs(spec.outputs, spec, task, count)
    bad_observation_L: dict[int, str] = {}  # lane -> the first observation on which no policy can act
    is_bad = np.isnan if spec.observation_clip is not None else lambda array: ~np.isfinite(array)
    bad_reward_L: dict[int, str] = {}  # lane -> its first reward that is not finite

    def watch(lane: int, environment: HostEnvironment) -> None:
        if watched is not None and watched.lane == lane:
            watched.descriptors.append(environment.descriptor())
            watched.returns.append(returns_L[lane])

    lane = step = 0
    try:
        for lane, environment in progress.counted("resetting", running):
            key_4 = reset_keys_L_4[lane]
            observation_L_O[lane] = environment.reset(seed_of(key_4), key_4 if keyed else None)
            if not training:
                trace_L_T_B[lane] = environment.descriptor()
            watch(lane, environment)
        for step in range(1, spec.episode_steps + 1):
            if not running:
                break
            action_L_A = policies(observation_L_O, step - 1)
            is_bad_L_O = is_bad(observation_L_O)
            if is_bad_L_O.any():
                for bad, number in np.argwhere(is_bad_L_O & alive_L[:, None]).tolist():
                    value = observation_L_O[bad, number]
                    bad_observation_L.setdefault(bad, f"{observation_text(number, step)} is {value:g}")
            actions_L = task.actions(action_L_A)
            if training:
                with np.errstate(over="ignore", invalid="ignore"):
                    shifted_L_O = np.where(alive_L[:, None], observation_L_O - mean, np.float32(0.0))
                    sum_L_O += shifted_L_O
                    square_L_O += shifted_L_O * shifted_L_O
            still = []
            for lane, environment in running:
                seen_O, reward, done = environment.step(actions_L[lane])
                progress.moved()
                is_last = done or step == spec.episode_steps
                if outputs:
                    now = HostStep(environment, observation_L_O[lane], action_L_A[lane], seen_O, reward, done)
                    outputs.note(lane, step - 1, now, is_last=is_last)
                observation_L_O[lane] = seen_O
                reward_L[lane], steps_L[lane] = reward, step
                returns_L[lane] += reward
                if not isfinite(reward):
                    hint = f"; {INFEASIBLE}" if reward == -inf else ""
                    bad_reward_L.setdefault(lane, f"the reward of step {step} is {reward:g}{hint}")
                if task.goal_distance is not None:
                    distance = environment.goal_distance()
                    goal_distance_L_2[lane] = distance, np.fmin(goal_distance_L_2[lane, 1], distance)
                if is_last or step in traced:
                    descriptor_L_B[lane] = environment.descriptor()
                    if not training:
                        trace_L_T_B[lane, last_steps_T >= step] = descriptor_L_B[lane]
                watch(lane, environment)
                if is_last:
                    alive_L[lane] = False
                else:
                    still.append((lane, environment))
            running = still
    except BaseException as error:
        place = f"step {step}" if step else "the reset"
        seed, shown = seed_of(reset_keys_L_4[lane]), shown_parameters(parameters_L_D[lane])
        error.add_note(f"raised in {place} of the episode whose reset has the seed {seed}; its policy has {shown}")
        raised_in_lane(error, lane)
        raise
    for trace_T_B in trace_L_T_B:
        known_from_the_start(trace_T_B)
    with np.errstate(over="ignore", invalid="ignore"):  # beyond float32 is infinite, which makes the episode invalid
        returns_L, reward_L = returns_L.astype(np.float32), reward_L.astype(np.float32)
    returns_L[[*bad_observation_L]] = reward_L[[*bad_observation_L]] = np.nan
    failures = []
    for lane in np.flatnonzero(steps_L > 0).tolist():
        fitness = reward_L[lane] if spec.fitness == "final" else returns_L[lane]
        if spec.allow_infeasible and fitness == -np.inf:
            continue
        why = bad_observation_L.get(lane) or bad_reward_L.get(lane)
        if why := why or _why_invalid(returns_L[lane], descriptor_L_B[lane]):
            shown = shown_parameters(parameters_L_D[lane])
            failures.append(
                FailedEpisode(lane, f"(seed {seed_of(reset_keys_L_4[lane])}): {why}; its policy has {shown}")
            )
    return Episodes(
        fitness=reward_L if spec.fitness == "final" else returns_L,
        returns=returns_L,
        descriptor=descriptor_L_B,
        steps=steps_L,
        goal_distance=goal_distance_L_2,
        shifted_sum_O=sum_L_O,
        shifted_square_sum_O=square_L_O,
        trace_T_B=trace_L_T_B,
        outputs=outputs.at_the_end,
        of_steps=outputs.of_steps,
        failures=tuple(failures),
    )


def _why_invalid(returns: np.float32, descriptor_B: FloatArray) -> str:
    """What is not finite among the results of an episode; empty if all are."""
    if not np.isfinite(returns):
        return f"the sum of its rewards is {returns:g}, beyond what float32 holds"
    if not np.isfinite(descriptor_B).all():
        return f"its descriptor is {descriptor_B.tolist()}"
    return ""


def shown_parameters(parameters_D: FloatArray) -> str:
    """The parameters of a policy in few words: the first ones, and how many there are."""
    shown = ", ".join(f"{value:.6g}" for value in parameters_D[:SHOWN])
    if len(parameters_D) <= SHOWN:
        return f"the parameters {shown}"
    return f"{len(parameters_D):,} parameters, {shown}, ..."


def known_from_the_start(descriptor_T_B: FloatArray) -> None:
    """Give the first points of a path the first known descriptor, since some are known only after a step."""
    unknown_T = np.asarray(np.isnan(descriptor_T_B).any(axis=1))
    if unknown_T[:1].any() and not unknown_T.all():
        first = int(np.argmin(unknown_T))
        descriptor_T_B[:first] = descriptor_T_B[first]
