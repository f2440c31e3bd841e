"""Calls of functions that are tasks: one for each lane, one after another. A call that fails is an invalid episode.

A `Caller` has a process of its own for the calls, which is killed when one takes too long, and which one may end.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from es_service.protocol.child import Child, NoAnswerError
from es_service.protocol.episodes import INFEASIBLE, METRICS
from es_service.protocol.messages import FloatArray, WorkerSpec
from es_service.protocol.noise import seed_of
from es_service.protocol.options import OptionValue
from es_service.protocol.process_environment import same_imports
from es_service.protocol.user_code import RaisedError, raised
from workers import progress
from workers.environments import make_function_task
from workers.environments.function_task import FunctionTask
from workers.reports import Tail
from workers.rollouts.backend import Episodes, FailedEpisode

if TYPE_CHECKING:  # it imports the rollouts, which import this module
    from workers.host.episodes import Watched

PRINTED_BYTES = 500
"""At most this many bytes of what a call has printed are told if it ends its process, or takes too long."""
START_S = 120.0
"""Longest time in which the process of a function must have imported it."""
SHOWN = 12
"""Most parameters that a failure names in the driver's log; the output of the worker has all of them."""
LONGEST = 1000
"""Longest reason of a failure there, in characters."""
POINTS = 2
"""Points of a trace, of an episode with one step."""
TaskCall = Callable[[FloatArray, int], tuple[float, Any, Any]]
"""Function (parameters [D], seed) -> (fitness, descriptor [B], metrics [M])."""


class CallFailedError(Exception):
    """A call has no result; the message says why."""


class Caller:
    """A function whose calls run in a process of their own, one after another, each with a limit of time."""

    def __init__(self, name: str, options: Mapping[str, OptionValue], limit_s: float) -> None:
        """The process starts with the first call.

        Args:
            name, options: of the task, as for `make_function_task`.
        """
        self.task: FunctionTask = make_function_task(name, options)
        """The function as this process has it, for what is known without a call."""
        self._given, self._limit_s = (name, dict(options)), limit_s
        self._child: Child | None = None
        self._printed = Tail(2)

    def start(self) -> None:
        """Start the process if there is none. Raises CallFailedError if the function cannot be imported there."""
        if self._child is not None and not self._child.is_ended:
            return
        self._child = Child("workers.environments:make_function_task", os.environ | same_imports(), None)
        try:
            self._answer(self._given, START_S)
        except CallFailedError:
            self.close()
            raise

    def __call__(self, parameters_D: FloatArray, seed: int) -> tuple[float, Any, Any]:
        """(fitness, descriptor [B], metrics [M]). Raises CallFailedError if the call raised, ended its process, or took
        too long."""
        self.start()
        return self._answer((parameters_D, seed), self._limit_s, " (task.time_limit_s)")

    def close(self) -> None:
        """End the process, and those that it has started."""
        if self._child is not None:
            self._child.end()

    def _answer(self, request: tuple[Any, ...], limit_s: float, key: str = "") -> Any:
        assert self._child is not None, "the process has been started"
        self._printed.skip()
        try:
            return self._child.call(*request, limit_s=limit_s)
        except NoAnswerError as error:
            printed = self._printed.new(PRINTED_BYTES)
            said = f"; it has printed: {' / '.join(printed.splitlines())}" if printed else ""
            raise CallFailedError(f"its process {error}{key if error.is_late else ''}{said}") from None
        except RaisedError as error:
            raise CallFailedError(error.message) from None


def run_calls(
    task: FunctionTask,
    called: TaskCall,
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
    """One call for each lane that runs, in their order.

    Args:
        called: calls the task, here or in another process.
        others: those of `workers.host.episodes.run_episodes`. Keys of the noise only tell training from evaluation, and
            a call takes a seed in any case.

    A call whose fitness or descriptor is not finite, or that raises, makes the episode invalid, and says so on stderr,
    unless it says by -inf that a point is infeasible, and that is allowed.
    """
    lanes, failures = len(reset_keys_L_4), []
    fitness_L = np.zeros(lanes, np.float32)
    descriptor_L_B = np.zeros((lanes, task.descriptor_size), np.float32)
    metrics_L_M = np.zeros((lanes, task.metrics), np.float32)
    for lane in range(lanes):
        if runs_L is None or runs_L[lane]:
            seed = seed_of(reset_keys_L_4[lane])
            result = _called(task, called, parameters_L_D[lane], seed, allow_infeasible=spec.allow_infeasible)
            fitness_L[lane], descriptor_L_B[lane], metrics_L_M[lane], why = result
            progress.moved()
            if why:
                named = task.parameters.text(parameters_L_D[lane])
                print(f"{task.name} failed with {named} (seed {seed}): {why}", file=sys.stderr, flush=True)
                short = task.parameters.text(parameters_L_D[lane], SHOWN)
                reason = "; ".join(line.strip() for line in why.splitlines())[:LONGEST]
                failures.append(FailedEpisode(lane, f"with {short} (seed {seed}): {reason}"))
    if watched is not None:
        watched.descriptors.extend([descriptor_L_B[watched.lane]] * 2)
        watched.returns.extend([0.0, fitness_L[watched.lane]])
    sums_L_O = np.zeros((lanes, 0 if action_keys_L_4 is None else 1), np.float32)
    points = POINTS if action_keys_L_4 is None else 0
    return Episodes(
        fitness=fitness_L,
        returns=fitness_L,
        descriptor=descriptor_L_B,
        steps=np.ones(lanes, np.int32),
        goal_distance=np.full((lanes, 2), np.nan, np.float32),
        shifted_sum_O=sums_L_O,
        shifted_square_sum_O=sums_L_O,
        trace_T_B=np.repeat(descriptor_L_B[:, None], points, axis=1),
        outputs={name: _output(name, fitness_L, metrics_L_M) for name in spec.outputs},
        of_steps={},
        failures=tuple(failures),
    )


def _called(
    task: FunctionTask,
    called: TaskCall,
    parameters_D: FloatArray,
    seed: int,
    *,
    allow_infeasible: bool = False,
) -> tuple[float, Any, Any, str]:
    """(fitness, descriptor, metrics, empty text) of a call; if it fails, NaN and the reason."""
    try:
        with np.errstate(over="ignore"):  # beyond float32 is infinite, and invalid
            fitness, descriptor_B, metrics_M = called(parameters_D, seed)
            is_finite, is_place = np.isfinite(np.float32(fitness)), np.isfinite(descriptor_B).all()
            if (is_finite and is_place) or (allow_infeasible and fitness == -np.inf):
                return fitness, descriptor_B, metrics_M, ""
        wrong = [] if is_finite else [f"the fitness {fitness:g} is no finite number that float32 holds"]
        wrong += (
            [] if is_place else [f"the descriptor {descriptor_B.tolist()} has numbers that are not finite in float32"]
        )
        why = " and ".join(wrong) + (f"; {INFEASIBLE}" if fitness == -np.inf else "")
    except CallFailedError as error:
        why = str(error)
    except (Exception, SystemExit) as error:  # the user's code can raise anything
        why = raised(error, task.name).message
    no_descriptor, no_metrics = (np.full(size, np.nan, np.float32) for size in (task.descriptor_size, task.metrics))
    return np.nan, no_descriptor, no_metrics, why


def _output(name: str, fitness_L: FloatArray, metrics_L_M: FloatArray) -> Any:
    """The outputs of a call that `protocol.episodes` names."""
    if name == "last_reward":
        return fitness_L
    if name == METRICS:
        return metrics_L_M
    raise ValueError(f"a function has no output {name!r}, since it has no policy and no steps")
