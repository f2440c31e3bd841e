"""Evaluation as a service: episodes of policies from an optimiser of the caller's own.

The policies run on the workers of a run, with the same engines and the same handling of faults. Axes: N policies,
E episodes, D policy parameters, O observation, A action, B descriptor dimensions, K steps of all episodes.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import partial
from threading import RLock
from typing import Any, Literal, NoReturn

import numpy as np
from numpy.typing import ArrayLike, NDArray

from es_service.config.given import Source
from es_service.config.model import RunConfig, implied_by
from es_service.config.tasks import require_same_task, task_of
from es_service.config.workload import ANY_NUMBER, policy_spec
from es_service.dispatch.engine import Engine
from es_service.errors import ConfigError, EvaluationError
from es_service.logs import logger
from es_service.loop.checks import valid_members
from es_service.loop.contents import no_statistics, policy_work
from es_service.protocol.child import require_same_process
from es_service.protocol.episodes import TRANSITIONS, gathered
from es_service.protocol.messages import EpisodesResult, FloatArray, TaskSpec
from es_service.runs.checked_config import changed_config, load_config
from es_service.runs.engine import make_engine, reader_of_reports
from es_service.runs.session import initial_policy

_LOG = logger(__name__)
LARGEST = 2**63 - 1


@dataclass(frozen=True)
class Transitions:
    """The valid steps of all episodes: those of policy 0 in episode 0, of policy 0 in episode 1, and so on.

    The observation after a step is that of the next row, and that after an episode's last step is in
    `last_observation`.
    """

    observation: FloatArray
    """[K, O]: what the policy saw, neither normalised nor clipped."""
    action: FloatArray
    """[K, A]: what it did."""
    reward: FloatArray
    """[K]"""
    done: NDArray[np.bool_]
    """[K]: whether the task ended the episode with the step. An episode that reaches `task.episode_steps` without that
    has no such step."""
    descriptor: FloatArray
    """[K, B]: descriptor after the step."""
    last_observation: FloatArray
    """[N, E, O]: observation after the last step of an episode."""
    steps: NDArray[np.int32]
    """[N, E]: number of steps of an episode."""

    def rows(self, policy: int, episode: int = 0) -> slice:
        before = self.steps[:policy].sum(dtype=np.int64) + self.steps[policy, :episode].sum(dtype=np.int64)
        return slice(int(before), int(before + self.steps[policy, episode]))

    def next_observation(self) -> FloatArray:
        """[K, O]: the observation after each step, as a new array."""
        following = np.roll(self.observation, -1, axis=0)
        following[np.cumsum(self.steps.reshape(-1), dtype=np.int64) - 1] = self.last_observation.reshape(
            -1, self.observation.shape[1]
        )
        return following


@dataclass(frozen=True)
class PolicyEvaluations:
    """Results of E episodes of each of N policies."""

    fitness: FloatArray
    """[N, E]: return of an episode, or with `task.fitness: final` the reward of its last step. It is maximised."""
    returns: FloatArray
    """[N, E]: sum of the rewards of an episode."""
    descriptor: FloatArray
    """[N, E, B]: descriptor at the end of an episode, in the units of the task."""
    steps: NDArray[np.int32]
    """[N, E]: number of environment steps, up to and including `done`."""
    valid: NDArray[np.bool_]
    """[N, E]: whether fitness and descriptor are finite."""
    success: NDArray[np.bool_] | None
    """[N, E]: whether an episode succeeded, as the task declares it; None if the task declares nothing."""
    transitions: Transitions | None = None
    """All steps, if the evaluator was made with `transitions=True`."""


class PolicyEvaluator:
    """Callable that evaluates policies; `evaluator` makes one. Calls from several threads wait for each other."""

    def __init__(self, config: RunConfig, task: TaskSpec, start: Callable[[], Engine[Any]]) -> None:
        self.config = config
        self.task = task
        """The task, with `descriptor_names` and `descriptor_bounds`."""
        self.parameters = policy_spec(config, self.task).parameters
        """Number of parameters of a policy, D."""
        self._start = start
        self._engine: Engine[Any] | None = start()
        """None after an error of the rollouts, until the next call starts another one."""
        self._closed = ""
        self._maker = os.getpid()
        self._in_turn = RLock()  # an error during a call closes the evaluator in its turn

    def initial(self, number: int = 0) -> FloatArray:
        """Parameters [D] with which a run of this config would begin, those of centre `number`: see `policy.init`."""
        return initial_policy(self.config, whole("number", number, 0))

    def __call__(
        self,
        parameters: ArrayLike,
        *,
        episodes: int = 1,
        seed: int | None = None,
        generation: int = 0,
        observation_mean: ArrayLike | None = None,
        observation_std: ArrayLike | None = None,
    ) -> PolicyEvaluations:
        """Run episodes of policies without noise in parameters or actions.

        Equal arguments give equal bits, whatever the workers and whatever happened to them. Episode e of policy n
        begins with a reset that depends on seed, generation, n and e alone; give another generation in each iteration
        to have new ones.

        Args:
            parameters: policies [N, D]; they are converted to float32.
            episodes: number of episodes of each policy.
            seed: from 0 to 2**63 - 1; None: the seed of the config.
            generation: from 0 to 2**63 - 1.
            observation_mean, observation_std: statistics with which observations are normalised, [O] or [N, O]; None:
                0 and 1.

        Raises:
            ConfigError: an argument is wrong; `field` names it.
            EvaluationError: the rollouts cannot continue, such as after an error in the code of the task, and the
                workers have ended; the next call starts others. Or the evaluator is closed.
            ForkedError: this process was forked from the one that made the evaluator.
        """
        policies_N_D = policies_of(self.config, self.task, parameters)
        statistics = statistics_of(self.task, len(policies_N_D), observation_mean, observation_std)
        asked = policy_work(
            policies_N_D,
            statistics,
            whole("episodes", episodes, 1),
            seed=self.config.seed if seed is None else whole("seed", seed, 0),
            generation=whole("generation", generation, 0),
        )
        require_same_process(self._maker, "this evaluator", "make another one here with es_service.evaluator")
        with self._in_turn:
            if self._closed:
                raise EvaluationError(f"{self._closed}; make another one with es_service.evaluator")
            self._engine = engine = self._engine or self._start()
            try:
                answers = engine.evaluate(asked.work)
            except Exception:  # the engine may have stopped at any point
                self._engine = None
                engine.close()
                raise
            except BaseException as error:  # an interrupt ends whatever uses the evaluator
                self.close(f"this evaluator was closed by an error during a call ({type(error).__name__}: {error})")
                raise
        (result,) = gathered([asked.shape], [answer for answer in answers if isinstance(answer, EpisodesResult)])
        return PolicyEvaluations(
            result.fitness,
            result.returns,
            result.descriptor,
            result.steps,
            valid_members(result),
            result.outputs.get("success"),
            transitions_of(result) if result.of_steps else None,
        )

    def close(self, why: str = "this evaluator is closed") -> None:
        """End the workers, after the call of another thread if there is one. Later calls, also those that wait, raise
        an EvaluationError that begins with `why`. In a process that was forked, the workers go on."""
        if os.getpid() != self._maker:  # where another thread may have had its turn for ever
            return
        with self._in_turn:
            if not self._closed:
                self._closed = why
                if self._engine is not None:
                    self._engine.close()


class Evaluating(AbstractContextManager[PolicyEvaluator]):
    """What `evaluator` returns: a context manager of a PolicyEvaluator."""

    def __init__(self, start: Callable[[], PolicyEvaluator]) -> None:
        self._start = start

    def __enter__(self) -> PolicyEvaluator:
        self._made = self._start()
        return self._made

    def __exit__(self, *raised: object) -> None:
        self._made.close()

    def __call__(self, *arguments: object, **named: object) -> NoReturn:
        """Say how it is meant."""
        raise TypeError("workers start in a with block: `with evaluator(...) as evaluate: evaluate(parameters)`")


def evaluator(
    config: RunConfig | Source,
    *,
    workers: int | Literal["auto"] | None = None,
    engine: Literal["inline", "ray"] | None = None,
    address: str | None = None,
    transitions: bool = False,
    on_output: Callable[[str], None] = lambda line: None,
) -> Evaluating:
    """Start the workers of a config and evaluate policies with them; at the end of the block, the workers end.

        with evaluator("point_maze_es.yaml") as evaluate:
            result = evaluate(parameters_N_D, episodes=4, seed=0, generation=7)

    Task, policy, seed and `compute` of the config are used. The search is not, except that its preset and its algorithm
    fill in keys of the policy that are left out; neither are `novelty`, `map`, `budget` and `store`. Whatever the
    config says must be valid nevertheless.

    Args:
        config: a RunConfig, or what `load_config` accepts, and then `search.algorithm` and the budget may be left out.
        workers, engine, address: as `--workers`, `--engine` and `--address` of the command line: number of workers
            ("auto": one for each core of the machine or the cluster), "inline" or "ray", and the Ray cluster to join;
            None: as configured.
        transitions: whether results have all steps of the episodes. They travel from the workers and stay in memory:
            4 (O + A + B + 1) + 1 bytes for each step: 497 of AntTrap, 29 of PointMaze.
        on_output: called with the lines that workers print, during calls; see `run`.

    Raises:
        ConfigError: the config is wrong. EvaluationError: the workers cannot be started.
    """
    return Evaluating(lambda: _started(config, workers, engine, address, transitions, on_output))


def transitions_of(result: EpisodesResult) -> Transitions:
    steps = result.of_steps
    return Transitions(
        observation=steps["observation"],
        action=steps["action"],
        reward=steps["reward"],
        done=steps["done"],
        descriptor=steps["step_descriptor"],
        last_observation=result.outputs["last_observation"],
        steps=result.steps,
    )


def policies_of(config: RunConfig, task: TaskSpec, parameters: ArrayLike) -> FloatArray:
    """The argument `parameters` as policies, float32 [N, D]. Raises ConfigError if it is wrong."""
    size = policy_spec(config, task).parameters
    allowed = f"an array of numbers of shape (policies, {size}), with at least one policy"
    policies_N_D = _floats("parameters", parameters, allowed)
    if policies_N_D.ndim != 2 or not len(policies_N_D) or policies_N_D.shape[1] != size:
        raise _wrong("parameters", f"has the shape {policies_N_D.shape}", policies_N_D.shape, allowed)
    wrong = np.flatnonzero(~np.isfinite(policies_N_D).all(axis=1))
    if wrong.size:
        which = f"{wrong.size} of {len(policies_N_D)} policies, the first of which is policy {wrong[0]}"
        raise _wrong("parameters", f"has NaN or infinite float32 numbers in {which}", None, "finite numbers")
    return policies_N_D


def statistics_of(
    task: TaskSpec, policies: int, mean: ArrayLike | None, std: ArrayLike | None
) -> tuple[FloatArray, FloatArray]:
    """The arguments `observation_mean` and `observation_std` for each policy, [N, O]; 0 and 1 for None. Raises
    ConfigError if one is wrong."""
    size = task.observation_size
    if mean is None and std is None:
        return no_statistics(policies, size)
    statistics = []
    for name, given in (("observation_mean", mean), ("observation_std", std)):
        allowed = f"an array of shape ({size},) or ({policies}, {size}), or None for both statistics"
        if given is None:
            raise _wrong(name, "is None, but the other statistic is given", None, allowed)
        array = _floats(name, given, allowed)
        if array.shape not in ((size,), (policies, size)):
            raise _wrong(name, f"has the shape {array.shape}", array.shape, allowed)
        if not np.isfinite(array).all():
            raise _wrong(name, "has NaN or infinite float32 numbers", None, "finite numbers")
        statistics.append(np.ascontiguousarray(np.broadcast_to(array, (policies, size))))
    if not (statistics[1] > 0.0).all():
        raise _wrong("observation_std", "has numbers that are not positive", None, "positive numbers")
    return statistics[0], statistics[1]


def _started(
    config: RunConfig | Source,
    workers: int | str | None,
    engine: str | None,
    address: str | None,
    transitions: bool,
    on_output: Callable[[str], None],
) -> PolicyEvaluator:
    config = evaluating_config(config, workers, engine, address)
    task = task_of(config)
    outputs = (*("success",) * bool(task.success), *TRANSITIONS * transitions)
    start = partial(
        make_engine,
        config,
        on_wait=_tell_wait,
        on_refusal=_LOG.warning,
        on_report=reader_of_reports(_LOG.warning, on_output),
        at_once=ANY_NUMBER,
        outputs=outputs,
    )
    return PolicyEvaluator(config, task, start)


def evaluating_config(
    config: RunConfig | Source, workers: int | str | None, engine: str | None, address: str | None
) -> RunConfig:
    """The config with which policies are evaluated; arguments and errors as `evaluator`."""
    given = {"compute.workers": workers, "compute.engine": engine, "compute.address": address}
    overrides = implied_by(engine, address) | {key: value for key, value in given.items() if value is not None}
    if not isinstance(config, RunConfig):
        return load_config(config, overrides, new=False, searches=False)
    require_same_task(config)
    return changed_config(config.model_dump(mode="json"), overrides, given=config.made.given) if overrides else config


def _tell_wait(shortage: str) -> None:
    if shortage:
        _LOG.warning("no worker has a place in the cluster; the evaluation waits until there is one. %s", shortage)


def _floats(name: str, given: ArrayLike, allowed: str) -> FloatArray:
    try:
        array = np.asarray(given)
        if array.dtype.kind not in "fiu":
            holds_policies = hasattr(next(iter(array.flat), None), "parameters_D")
            hint = "; give the parameters_D of each policy" if holds_policies else ""
            raise ValueError(f"its type is {array.dtype}{hint}")
    except (TypeError, ValueError) as error:
        raise _wrong(name, f"is no array of numbers ({error})", None, allowed) from error
    with np.errstate(over="ignore"):
        return np.ascontiguousarray(array, dtype=np.float32)


def whole(name: str, given: int, least: int) -> int:
    """An argument that must be an integer from `least` on. Raises ConfigError if it is not."""
    if isinstance(given, bool) or not isinstance(given, int | np.integer) or not least <= given <= LARGEST:
        raise _wrong(name, f"is {given!r}", given, f"an integer from {least} to 2**63 - 1")
    return int(given)


def _wrong(name: str, what: str, value: object, allowed: str) -> ConfigError:
    return ConfigError(f"{name} {what}; must be {allowed}", field=name, value=value, allowed=allowed)
