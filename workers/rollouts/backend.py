"""Interface of a rollout where it runs: the functions of a worker, recordings and measurements.

A rollout is one object of this protocol in the registry of `workers.rollouts`. No other module knows it by name.

Here are also the results of chunks from their episodes: means over a member's episodes, and the moments of its
observations.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple, Protocol

import numpy as np

from es_service.protocol.messages import EpisodesResult, Moments, TaskSpec, WorkerSpec
from es_service.protocol.options import OptionValue
from es_service.protocol.policies import FloatArray, Recipes
from es_service.protocol.recordings import Recordings, RecordRequest
from es_service.protocol.rollouts import Rollout
from workers.compiling import Compilable

_LANE = "_es_service_lane"
"""Attribute of an exception that was raised in an episode."""


BAD_REWARD, NO_FAULT = 2**31 - 2, 2**31 - 1
"""Second numbers of `Episodes.fault`, greater than that of any observation."""


class FailedEpisode(NamedTuple):
    """Why an episode is invalid."""

    lane: int
    """Place of its policy in the chunk: of a training chunk 2 p + s for member s of pair p, of others the slot."""
    text: str
    """Text after the name of the member: the seed or key of its reset, the reason, and its parameters if known."""


class Episodes(NamedTuple):
    """Results of an episode, or of a batch of episodes with the leading axes of the caller.

    Those before `goal_distance` are finite in an episode without a fault.
    """

    fitness: Any
    returns: Any
    descriptor: Any
    steps: Any
    shifted_sum_O: Any
    """Sum over counted steps of (observation - mean of the statistics), float32; empty in evaluations, which do not
    update the statistics.

    It is accurate enough for one episode if that mean is close to the mean of the observations. Where no statistics
    exist yet (in generation 1, or in blocks with an elite's statistics from random weights) the mean of the
    observations must be less than a thousand of their standard deviations from 0."""
    shifted_square_sum_O: Any
    """Sum over counted steps of (observation - mean of the statistics) squared, float32; empty in evaluations."""
    goal_distance: Any
    """[..., 2]: distance to the goal at the end, and the least distance during the episode; NaN without a goal."""
    trace_T_B: Any
    """Descriptor along an evaluation episode; empty in training. Point k is the descriptor after k / (points - 1) of
    the episode's maximal number of steps, or at its end if it ended before."""
    outputs: dict[str, Any]
    """Outputs that the run names, by name (`protocol.episodes.AT_THE_END`)."""
    of_steps: dict[str, Any]
    """Outputs of each step that the run names, by name, [..., T, ...] (`protocol.episodes.OF_STEPS`). Rows from `steps`
    on may be anything."""
    fault: Any = None
    """[..., 2] int32 of a JAX task: the step, counted from 1, in which something first was not finite, and what: the
    number of the observation on which the policy acted, or else BAD_REWARD for the return; NO_FAULT if nothing was
    before the last step. None if the rollout has looked itself, or if no result calls for a look."""
    failures: tuple[FailedEpisode, ...] = ()
    """Invalid episodes by name."""

    def map(self, function: Callable[[Any], Any]) -> Episodes:
        """The episodes with a function of each array in its place."""
        *arrays, at_the_end, of_steps, fault, failures = self
        named = ({name: function(array) for name, array in of.items()} for of in (at_the_end, of_steps))
        return Episodes._make([*map(function, arrays), *named, None if fault is None else function(fault), failures])

    def part(self, of: slice) -> Episodes:
        """Those in a slice of the first axis, which names its start and end, with the failures among them."""
        lanes = 1 if self.fitness.ndim == 1 else self.fitness.shape[1]  # of the members of a pair
        first, end = of.start * lanes, of.stop * lanes
        failures = (failed for failed in self.failures if first <= failed.lane < end)
        part = self.map(lambda array: array[of])
        return part._replace(failures=tuple(FailedEpisode(lane - first, text) for lane, text in failures))

    def with_steps(self, of_steps: Mapping[str, Any]) -> Episodes:
        """The episodes with these values of all steps, in place of those after the newest."""
        return self._replace(
            outputs={name: array for name, array in self.outputs.items() if name not in of_steps},
            of_steps=dict(of_steps),
        )


def no_faults(lanes: int) -> np.ndarray:
    """`Episodes.fault` [L, 2] of episodes without one."""
    return np.tile(np.array([0, NO_FAULT], np.int32), (lanes, 1))


def observation_text(number: int, step: int) -> str:
    """An observation on which the policy acted in a step, counted from 1, in words."""
    return f"observation[{number}] of {'the reset' if step == 1 else f'step {step - 1}'}"


def raised_in_lane(error: BaseException, lane: int) -> None:
    """Note at an exception in which lane of a chunk it was raised, for `lane_of`."""
    setattr(error, _LANE, lane)


def lane_of(error: BaseException) -> int | None:
    """The lane of a chunk in which an exception was raised, as in `FailedEpisode`; None if it is not known."""
    return getattr(error, _LANE, None)


class Examination(NamedTuple):
    """What a rollout finds of a task that is no shipped one, in sentences; empty where there is nothing to say."""

    unsupported: str = ""
    """Reason why it cannot compute its episodes."""
    hidden: str = ""
    """Where it computes a number and JAX, which defines the task, has NaN or an infinity."""
    notes: tuple[str, ...] = ()
    """What its author probably did not intend."""


class ChunkFunctions(NamedTuple):
    """How a worker computes the chunks of a run; several threads may call these functions if the rollout declares so.

    Keys are stream keys (uint32 [4]), arrays are NumPy's; `mean` and `std` are the observation statistics. Results are
    pure functions of the arguments. `compile` of each is called before the first chunk of its kind, and computes no
    episode. If the rollout takes chunks together, the leading axis may have that of several chunks in a row.
    """

    training: Compilable
    """Function (centre_D, unit, mean_O, std_O, noise_keys_P_4, reset_keys_P_S_E_4, action_keys_P_S_E_4) -> Episodes
    with leading axes [P, S, E], of the members centre + sign * unit * noise with action noise; `unit` is
    sigma / NORMAL_STD, and the noise is that of `protocol.low_rank.noise_integers`."""
    evaluation: Compilable
    """Function (centre_D, mean_O, std_O, reset_keys_E_4, wanted_E) -> Episodes with leading axis [E], without action
    noise. Those that are not wanted need not be computed, and their results may be anything."""
    policies: Compilable
    """Function (policies, mean_L_O, std_L_O, policy_L, reset_keys_L_4) -> Episodes with leading axis [L], without
    action noise. The policies are a list of parameters [N, D] and of recipes with their parents; policy_L is the number
    of each lane's policy among all."""
    gradient_sum: Compilable
    """Function (weights_P, noise_keys_P_4) -> sum over pairs of weight x the noise with standard deviation 1, [D]. How
    the pairs of a block are added depends on nothing but their number, and so do the float32 bits."""


class RolloutBackend(Rollout, Protocol):
    """A rollout, as the processes see it that compute with it. They import JAX only if these functions do."""

    def examine(self, task: TaskSpec, options: Mapping[str, OptionValue]) -> Examination:
        """What it finds of a task that is no shipped one with these options.

        Called where the task is described, in a process of its own; the answer is kept in the `TaskSpec`, so that the
        driver need not find it.
        """
        return Examination()

    def device(self) -> str:
        """Kind of the GPU that it computes on, which belongs to a worker's platform; called only where there is one."""
        return ""

    @abstractmethod
    def chunk_functions(self, spec: WorkerSpec) -> ChunkFunctions:
        """The functions of a worker; makes the task."""
        raise NotImplementedError

    def made(self, recipes: Recipes) -> FloatArray:
        """The parameters of policies, [N, D], with the bits of `Recipes.made`."""
        return recipes.made()

    @abstractmethod
    def record(self, spec: WorkerSpec, requests: Sequence[RecordRequest]) -> Recordings:
        """Recordings of evaluation episodes, in the order of the requests, with the bits of a worker's own."""
        raise NotImplementedError

    @abstractmethod
    def random_steps(
        self, task: TaskSpec, options: Mapping[str, OptionValue], batch: int, steps: int
    ) -> Callable[[int], int]:
        """For measurements: function from the number of a call to the number of environment steps that it did.

        Each call does `steps` steps with random actions in a batch of environments, which have been reset before, and
        computes observations and rewards; the first call may compile.
        """
        raise NotImplementedError


def training_result(episodes: Episodes, shift_O: Any) -> EpisodesResult:
    """Results of a training chunk's members from their episodes [P, S, E].

    They are means over the episodes, except the least goal distance, which is the minimum, and the steps, which are the
    sum. Outputs of steps are those of all episodes.
    """
    host = episodes.map(np.asarray)

    def mean(x_P_S_E: Any) -> Any:
        return x_P_S_E.mean(axis=2) if x_P_S_E.shape[2] > 1 else x_P_S_E[:, :, 0].copy()

    distance_P_S_E = host.goal_distance
    return EpisodesResult(
        fitness=mean(host.fitness),
        returns=mean(host.returns),
        descriptor=mean(host.descriptor),
        steps=host.steps.sum(axis=2, dtype=np.int32),
        goal_distance=np.stack([mean(distance_P_S_E[..., 0]), distance_P_S_E[..., 1].min(axis=2)], axis=-1),
        moments=_moments(host, shift_O),
        outputs={name: mean(array.astype(np.float32)) for name, array in host.outputs.items()},
        of_steps=_valid_steps(host),
    )


def evaluation_result(episodes: Episodes, wanted: int, first: int = 0) -> EpisodesResult:
    """Results of each of `wanted` evaluation episodes, from the episode `first` on, and the trace of that one."""
    result = _episodes_result(episodes.map(lambda array: np.asarray(array)[first : first + wanted]))
    return replace(result, trace_T_B=np.asarray(episodes.trace_T_B)[first].copy())


def policies_result(episodes: Episodes, traced_L: Any) -> EpisodesResult:
    """Results of each episode of a policy chunk [L], with the traces of those in `traced_L` unless that is None."""
    result = _episodes_result(episodes)
    return result if traced_L is None else replace(result, trace_T_B=np.array(episodes.trace_T_B)[traced_L])


def _episodes_result(episodes: Episodes) -> EpisodesResult:
    """Results of single episodes without traces; arrays are copied out of JAX's memory."""
    host = episodes.map(np.array)
    return EpisodesResult(
        fitness=host.fitness,
        returns=host.returns,
        descriptor=host.descriptor,
        steps=host.steps,
        goal_distance=host.goal_distance,
        moments=None,
        outputs=host.outputs,
        of_steps=_valid_steps(host),
    )


def _valid_steps(host: Episodes) -> dict[str, Any]:
    """Outputs of the valid steps of all episodes, [K, ...]: all steps of the first episode, then of the second, ..."""

    def valid(array: Any) -> Any:
        return array[np.arange(array.shape[host.steps.ndim]) < host.steps[..., None]]

    return {name: valid(array) for name, array in host.of_steps.items()}


def _moments(host: Episodes, shift_O: Any) -> Moments:
    """Moments of the observations of all counted steps in valid episodes.

    An episode is invalid if its sums, fitness or descriptor are not finite. All of its observations are left out,
    because they may have been arbitrarily large before.
    """
    size = host.shifted_sum_O.shape[-1]
    sums, squares = (x.reshape(-1, size).astype(np.float64) for x in (host.shifted_sum_O, host.shifted_square_sum_O))
    said = (sums, squares, host.fitness.reshape(-1, 1), host.descriptor.reshape(len(sums), -1))
    valid = np.isfinite(np.concatenate(said, axis=1)).all(axis=1)
    count = float(host.steps.reshape(-1)[valid].sum())
    if count == 0.0:
        return Moments(0.0, np.zeros(size), np.zeros(size))
    mean_O = sums[valid].sum(axis=0) / count
    m2_O = np.maximum(squares[valid].sum(axis=0) - count * np.square(mean_O), 0.0)
    return Moments(count, mean_O + shift_O, m2_O)
