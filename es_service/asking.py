"""Ask and tell: our method, map, store and reports, and the caller's episodes. The mirror image of `evaluator`.

The session of the run is a generator: what it yields are the chunks that workers would otherwise compute. Their rows
are handed to the caller. Gradients are computed here, since they need no episodes.

Axes: N rows, D policy parameters, O observation, A action, B descriptor dimensions.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext, suppress
from contextvars import copy_context
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from es_service.api import begin_or_resume
from es_service.config.given import Source
from es_service.config.model import RunConfig
from es_service.config.tasks import CALLER, task_of
from es_service.config.workload import worker_spec
from es_service.errors import ConfigError, EvaluationError, ForkedError
from es_service.protocol.child import require_same_process
from es_service.protocol.episodes import OverlappedRequests
from es_service.protocol.machine import given_path
from es_service.protocol.messages import (
    ChunkResult,
    EpisodesResult,
    FloatArray,
    GradientChunk,
    Moments,
    Work,
    WorkerSpec,
)
from es_service.runs.checked_config import load_config
from es_service.runs.session import OnNotice, Outcome, checked_metrics, show_notice
from es_service.runs.sessions import Listener
from es_service.runs.view import Run, open_run
from es_service.store.folder import holds_run
from workers.asked_rows import Rows, gradients, results_of, rows_of
from workers.policy import LanePolicies

MOST_STEPS = 2**31 - 1
LEFT = "the block of ask_tell was left; make the same call again to go on"


@dataclass(frozen=True, order=True)
class Token:
    """Identity of what a run asks, which is the same in every session that asks it."""

    run: str
    """Id of the run."""
    generation: int
    request: int
    """Number of the request in its generation, from 0. Most generations have two: members, and then the new centres."""

    def __str__(self) -> str:
        return f"request {self.request} of generation {self.generation}"


@dataclass(frozen=True)
class Asked:
    """Episodes that the caller is to compute, one for each row. It can be pickled. Its arrays cannot be written."""

    token: Token
    """What their results are told by."""
    parameters: FloatArray
    """[N, D]: the policies, or the parameters of what has no policy; members of populations have their noise."""
    observation_mean: FloatArray
    observation_std: FloatArray
    """[N, O]: statistics with which each policy's observations are normalised; 0 and 1 if there are none."""
    seed: NDArray[np.int64]
    """[N]: seed of each episode, from 0 to 2**31 - 1. Members of a pair share it unless the config says otherwise."""
    trains: NDArray[np.bool_]
    """[N]: whether it is an episode of a member, whose observations update the statistics."""
    _rows: Rows
    _spec: WorkerSpec

    @property
    def generation(self) -> int:
        return self.token.generation

    def __len__(self) -> int:
        return len(self.parameters)

    def __getstate__(self) -> dict[str, Any]:
        """Without what `act` makes of the arrays, which would have another layout, and so other last bits."""
        return {name: value for name, value in vars(self).items() if name != "_policies"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        for value in state.values():
            if isinstance(value, np.ndarray):
                value.setflags(write=False)
        vars(self).update(state)

    def __repr__(self) -> str:
        return f"<{len(self)} episodes: {self.token}, {self.parameters.shape[1]:,} parameters each>"

    def act(self, observation: ArrayLike, step: int) -> FloatArray:
        """Actions [N, A] of the policies, each for its own observation, with the action noise of those that train.

        Args:
            observation: [N, O], neither normalised nor clipped.
            step: number of the step in its episode, from 0; call it for each step in turn, so that a memory goes on.

        Raises ConfigError for observations of another shape.
        """
        seen_N_O = np.asarray(observation, np.float32)
        if seen_N_O.shape != self.observation_mean.shape:
            what = f"observations must have the shape {list(self.observation_mean.shape)}; got {list(seen_N_O.shape)}"
            raise ConfigError(what, field="observation", value=list(seen_N_O.shape))
        quiet, noisy = self._policies
        actions = quiet(seen_N_O, step) if quiet is not None else None
        if noisy is None:
            assert actions is not None
            return actions
        with_noise = noisy(seen_N_O, step)
        return with_noise if actions is None else np.where(self.trains[:, None], with_noise, actions)

    @cached_property
    def _policies(self) -> tuple[LanePolicies | None, LanePolicies | None]:
        """Without and with noise, as far as a row needs them."""
        arrays = self._spec, self.parameters, self.observation_mean, self.observation_std
        return (
            None if self.trains.all() else LanePolicies(*arrays),
            LanePolicies(*arrays, self._rows.action_keys_N_4) if self.trains.any() else None,
        )


class AskTell:
    """A run whose episodes the caller computes; `ask_tell` makes one. To be used from one thread."""

    def __init__(
        self,
        folder: Path,
        spec: WorkerSpec,
        dimensions: int,
        session: OverlappedRequests[Outcome],
        metrics: dict[str, float],
    ) -> None:
        """Begin nothing yet.

        Args:
            metrics: gets those that are told; the session takes them when the generation is stored.
            dimensions: those of the descriptor.
            session: of the run, whose work is the caller's.
        """
        self.folder = folder
        self.outcome: Outcome | None = None
        """How the run ended; None while it goes on."""
        self._session, self._spec, self._dimensions = session, spec, dimensions
        self._context, self._maker = copy_context(), os.getpid()  # the log's records of the caller are not the run's
        self._work: Sequence[Work] = ()
        self._metrics = metrics
        self._asked: Asked | None = None
        self._last: Token | None = None
        """Of what was asked last."""
        self._error: BaseException | None = None
        """What has ended the run before its budget was spent; raised again by every later call."""

    @property
    def run(self) -> Run:
        """The run as it is stored, with what `tell` has told."""
        return open_run(self.folder)

    def ask(self) -> Asked | None:
        """What is to be computed next; the same until it is told; None once the budget is spent.

        Raises what `run` raises, if the run cannot continue, and ForkedError in a process that was forked.
        """
        require_same_process(self._maker, "this ask_tell", "have that one tell what is computed here")
        if self._asked is None and self.outcome is None:
            self._go_on()
        return self._asked

    def tell(
        self,
        asked: Asked,
        fitness: ArrayLike,
        descriptor: ArrayLike | None = None,
        *,
        valid: ArrayLike | None = None,
        steps: ArrayLike | None = None,
        moments: tuple[float, ArrayLike, ArrayLike] | None = None,
        metrics: Mapping[str, float] = MappingProxyType({}),
    ) -> None:
        """Tell the results of what was asked, in the order of its rows; when it returns, a generation that is complete
        has been committed, or waits for another program that holds the database, which a notice says. Results are told
        once: a second call for the same rows is refused.

        Args:
            asked: what `ask` returned.
            fitness: [N], maximised: the return of each episode. NaN: the episode is invalid; so is -inf, unless
                `search.allow_infeasible` says that it is infeasible.
            descriptor: [N, B]; None: the first B parameters of each row.
            valid: [N] of bools, false for episodes that failed.
            steps: [N], environment steps of each, from 1 to 2**31 - 1; None: 1 each.
            moments: (count, mean [O], sum of squared deviations [O]) of all observations in the rows that train, for
                the statistics with which observations are normalised; None: they stay.
            metrics: numbers that are recorded with the generation to which these rows belong, by name, as those that
                `on_generation` of `run` returns.

        Raises:
            ConfigError: an argument is wrong; `field` names it. Otherwise as `ask`.
        """
        now = self.ask()
        if now is None:
            raise EvaluationError("the run has ended, so nothing is asked; resume it with a larger budget")
        _require_same(asked, now.token)
        count, size = len(asked), asked.observation_mean.shape[1]
        fitness_N = _array("fitness", fitness, (count,)).astype(np.float32)
        is_valid_N = np.ones(count, bool) if valid is None else _array("valid", valid, (count,))
        if not np.isin(is_valid_N, (0, 1)).all():
            raise ConfigError("valid has numbers other than 0 and 1; must be bools", field="valid", allowed="bools")
        fitness_N = np.where(is_valid_N.astype(bool), fitness_N, np.float32(np.nan))
        if descriptor is None:
            descriptor = asked.parameters[:, : self._dimensions]
        descriptor_N_B = _array("descriptor", descriptor, (count, self._dimensions)).astype(np.float32)
        steps_N = np.ones(count, np.int64) if steps is None else _array("steps", steps, (count,))
        if (wrong := steps_N[~((steps_N >= 1) & (steps_N <= MOST_STEPS) & (steps_N % 1 == 0))]).size:
            allowed = f"whole numbers from 1 to {MOST_STEPS:,}"
            raise ConfigError(f"steps has {wrong[0]}; must be {allowed}", field="steps", allowed=allowed)
        observed = Moments(0.0, np.zeros(size), np.zeros(size))
        if moments is not None:
            try:
                number, mean, m2 = moments
                number = float(number)
            except (TypeError, ValueError) as error:
                allowed = f"(count, mean [{size}], sum of squared deviations [{size}])"
                raise ConfigError(f"moments must be {allowed}: {error}", field="moments", allowed=allowed) from error
            mean_O, m2_O = (_array("moments", array, (size,)).astype(np.float64) for array in (mean, m2))
            if not (np.isfinite([number, *mean_O, *m2_O]).all() and number >= 0.0 and (m2_O >= 0.0).all()):
                allowed = "finite numbers, and neither the count nor a square negative"
                raise ConfigError(f"moments must be {allowed}", field="moments", allowed=allowed)
            observed = Moments(number, mean_O, m2_O)
        if metrics:
            self._metrics |= checked_metrics(metrics, self.run.meta, "metrics")
        self._asked = None
        distance_N_2 = np.full((count, 2), np.nan, np.float32)
        steps_N = steps_N.astype(np.int32)
        told = EpisodesResult(fitness_N, fitness_N, descriptor_N_B, steps_N, distance_N_2, observed)
        self._go_on(results_of(self._spec, self._work, told))

    def _go_on(self, results: list[ChunkResult] | None = None) -> None:
        """Let the run go on until it asks, or ends. When it asks, the generation before has been committed."""
        if self._error is not None:
            raise self._error
        try:
            while True:
                work = self._context.run(self._session.send, results)
                assert isinstance(work, Sequence)
                self._context.run(next, self._session)
                if not isinstance(work[0][1], GradientChunk):
                    break
                results = gradients(self._spec, work)
        except StopIteration as end:
            self.outcome = end.value
            return
        except BaseException as error:
            self._error = error
            raise
        rows, generation = rows_of(self._spec, work), work[0][1].generation
        shown = rows.parameters_N_D, rows.mean_N_O, rows.std_N_O, rows.seed_N, rows.is_noisy_N
        for array in shown:
            array.setflags(write=False)  # `ask` returns the same ones again
        last = self._last or Token(self.run.meta.run_id, generation, -1)
        request = last.request + 1 if generation == last.generation else 0
        self._last = Token(last.run, generation, request)
        self._work, self._asked = work, Asked(self._last, *shown, rows, self._spec)

    def _leave(self) -> None:
        """End the session. In a process that was forked, the run goes on in the other one."""
        self._asked = None
        if self.outcome is None and self._error is None:
            self._error = EvaluationError(LEFT)
        with suppress(ForkedError):
            self._context.run(self._session.close)


@contextmanager
def ask_tell(
    config: RunConfig | Source, out: str | os.PathLike[str], *, on_notice: OnNotice = show_notice
) -> Iterator[AskTell]:
    """Begin or resume a run whose episodes the caller computes.

        with ask_tell("my_config.yaml", "runs/mine") as search:
            while (asked := search.ask()) is not None:
                fitness, descriptor = simulate(asked.parameters)      # arrays [N] and [N, B]
                search.tell(asked, fitness, descriptor)

    The task of the config is `caller`. Its options are either `parameters`, the number of parameters, or
    `observation_size` and `action_size` of a policy, and `descriptor_size`. If the block is left before the end, the
    call goes on from the last committed generation when it is made again, and asks the same; it ends with the same bits
    if the caller's numbers are the same. `resume`, `evaluate`, `verify` and replays of the run say that its episodes
    are the caller's; `status`, `report` and `export` know it like any other.

    Args:
        config: a RunConfig, or what `load_config` accepts.
        out: folder of the run; one that holds this run is resumed.
        on_notice: as for `run`.

    Raises:
        ConfigError: the config is wrong, its task is not `caller`, or the folder's run has other constants.
    """
    folder = given_path(out)
    wanted = config if isinstance(config, RunConfig) else load_config(config, new=not holds_run(folder))
    if wanted.task.environment != CALLER:
        raise ConfigError(
            f"task.environment is {wanted.task.environment}; must be {CALLER}, since the caller computes the episodes",
            field="task.environment",
            value=wanted.task.environment,
            allowed=CALLER,
        )
    task = task_of(wanted)
    metrics: dict[str, float] = {}

    def told() -> dict[str, float]:
        """The metrics that were told since the last generation."""
        given = dict(metrics)
        metrics.clear()
        return given

    listener = Listener(
        lambda folder: nullcontext(lambda row: None),
        on_notice,
        lambda sentence: None,
        lambda line: None,
        told=told,
    )
    session = begin_or_resume(wanted, folder, listener)
    spec = worker_spec(wanted, task, asks_caller=True)
    search = AskTell(folder, spec, len(task.descriptor_names), session, metrics)
    try:
        yield search
    finally:
        search._leave()


def _require_same(asked: object, now: Token) -> None:
    """Raise ConfigError unless `asked` is what the run asks now."""
    if not isinstance(asked, Asked):
        raise ConfigError(
            f"asked is of the type {type(asked).__name__}; must be what `ask` returned, as in "
            "search.tell(asked, fitness, descriptor)",
            field="asked",
            allowed="what `ask` returned",
        )
    if asked.token != now:
        when = "have been told already" if asked.token < now else "are not wanted yet"
        what = f"is {asked.token}, whose results {when}" if asked.token.run == now.run else "belongs to another run"
        raise ConfigError(
            f"asked {what}; this run waits for the results of {now}, which `ask` returns",
            field="asked",
            value=asked.token,
            allowed="what `ask` returns now",
        )


def _array(name: str, given: ArrayLike, shape: tuple[int, ...]) -> np.ndarray:
    """An argument as an array of a shape. Raises ConfigError if it is none."""
    try:
        array = np.asarray(given)
    except ValueError:  # a list of lists of different lengths
        array = np.asarray(given, object)
    if array.shape != shape or array.dtype.kind not in "fiub":
        raise ConfigError(
            f"{name} has the shape {array.shape} and the type {array.dtype}; must be numbers of shape {shape}",
            field=name,
            value=array.shape,
            allowed=f"numbers of shape {shape}",
        )
    return array
