"""One session of a run: start the engine, and run generations until the budget is spent or a stop is requested."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from es_service.config.model import RunConfig, policy_shape, worker_spec
from es_service.config.parallel import chunks_at_once, parallel_sentence
from es_service.config.tasks import task_of
from es_service.dispatch.cores import cores
from es_service.dispatch.dispatch_log import Committed, Log, dispatch_log, no_log
from es_service.dispatch.engine import Engine
from es_service.dispatch.events import Limits
from es_service.dispatch.inline_engine import inline_engine
from es_service.errors import EvaluationError, WayOut
from es_service.logs import in_generation, logger
from es_service.loop import driver
from es_service.loop.parts import Arrays, moments_from_arrays
from es_service.protocol.machine import computed_on, is_mixed, platform_info
from es_service.protocol.messages import FloatArray, Moments
from es_service.runs.signals import stop_on_signals
from es_service.runs.view import Run, open_run
from es_service.search.algorithms import ALGORITHMS
from es_service.search.observation_statistics import no_observations
from es_service.store.writer import RunStore
from workers.actor import WorkerActor
from workers.policy import initial_parameters

_LOG = logger(__name__)
LIMIT_NAMES = {
    "start_deadline_s": "half of compute.no_worker_timeout_s",
    "first_deadline_s": "compute.compile_timeout_s",
    "min_deadline_s": "at least compute.chunk_timeout_s",
    "place_timeout_s": "compute.place_timeout_s",
    "no_worker_timeout_s": "compute.no_worker_timeout_s",
}
"""Config keys that set the engine's time limits, as its messages name them."""

OnGeneration = Callable[[Mapping[str, Any]], None]
"""Called with each history row after its generation is committed."""
OnNotice = Callable[[str], None]
"""Called with each notice for the user, such as a repair of the run or a lost worker."""


@dataclass(frozen=True)
class Outcome:
    """How a session of a run ended."""

    run: Run
    reason: str
    """Which part of the budget is spent, in words."""


def work(config: RunConfig, store: RunStore, on_generation: OnGeneration, on_notice: OnNotice) -> Outcome:
    """Run generations until the budget is spent."""
    task = task_of(config)
    told = 0

    def tell(notice: str) -> None:
        _LOG.warning(notice)
        on_notice(notice)

    def tell_notices() -> None:
        nonlocal told
        for notice in store.notices[told:]:
            tell(notice)
        told = len(store.notices)

    def tell_wait(shortage: str) -> None:
        store.lock.say(waiting=bool(shortage))
        limit_s = config.compute.place_timeout_s
        until = "until there is one" if limit_s is None else f"at most {limit_s:g} s (compute.place_timeout_s)"
        waits = f"no worker has a place in the cluster; the run waits {until}. {shortage}"
        tell(waits if shortage else "a worker has a place in the cluster; the run begins")

    tell_notices()
    state = driver.stored_state(store, task)
    if state is not None and (reason := driver.spent(config.budget, state)) is not None:
        return Outcome(open_run(store.folder), reason)  # no engine needs to start
    search = driver.Search(
        config=config,
        algorithm=ALGORITHMS[config.search.algorithm](config),
        initial=lambda: _initial(config, store),
        task=task,
    )
    in_generation(0 if store.generation is None else store.generation + 1)
    compute, most = config.compute, chunks_at_once(config)
    _LOG.info("working on %s: engine %s, rollout %s", store.folder, compute.engine, compute.rollout)
    _LOG.info(parallel_sentence(config))
    if compute.workers != "auto" and compute.workers > most:
        tell(f"compute.workers: {compute.workers} workers start, but {parallel_sentence(config)}")
    with (
        _naming_the_run(store.folder),
        dispatch_log(store.folder, store.generation, enabled=config.compute.dispatch_log) as log,
        stop_on_signals() as should_stop,
        make_engine(config, should_stop, log, tell_wait) as engine,
    ):

        def after_generation(row: Mapping[str, Any]) -> None:
            log(Committed(row["generation"]))
            tell_notices()
            if lost := row["lost_workers"]:
                who = "a worker" if lost == 1 else f"{lost} workers"
                tell(f"generation {row['generation']}: lost {who}; {engine.last_loss}")
            on_generation(row)
            _LOG.info(
                "centre fitness %.6g, best %.6g, env steps %d, steps/s %.3g",
                row["centre_fitness_mean"],
                row["best_fitness"],
                row["env_steps"],
                row["steps_per_second"],
            )
            in_generation(row["generation"] + 1)

        engine.wait_for_place()  # before the loop, whose time is that of the run and of its budget
        _, reason = driver.run(search, engine, _OnPlatforms(store, engine, tell), state, after_generation)
        _LOG.info("the session ends: %s", reason)
    return Outcome(open_run(store.folder), reason)


class _OnPlatforms:
    """The run's store for the loop, which records the platform of a generation before it commits the generation."""

    def __init__(self, store: RunStore, engine: Engine[Any], on_notice: OnNotice) -> None:
        self._store, self._engine, self._on_notice = store, engine, on_notice
        self._driver = platform_info()
        self._workers: frozenset[str] | None = None
        self.part = store.part

    def commit(
        self,
        generation: int,
        parts: Mapping[str, Arrays],
        history: driver.HistoryRow,
        evaluations: Sequence[driver.HistoryRow],
    ) -> None:
        """Record the platform if it has changed, with a notice if the run becomes mixed by that; then commit."""
        workers = self._engine.platforms
        if workers != self._workers:
            platform = computed_on(self._driver, workers)
            is_other = self._store.record_platform(generation, platform)
            if is_other and (generation or is_mixed([platform])):
                self._on_notice(
                    f"from generation {generation} on, this run is computed on another platform, or on several: "
                    f"{platform}. Its digest is now marked `mixed`."
                )
            self._workers = workers
        self._store.commit(generation, parts, history, evaluations)


@contextmanager
def _naming_the_run(folder: Path) -> Iterator[None]:
    """Add to an error of the rollouts the run's folder, and resuming the run as a way out."""
    try:
        yield
    except EvaluationError as error:
        run = str(folder)
        resume = WayOut("resume", "continue from the last finished generation after the cause is fixed", run)
        ways_out = [replace(way, run=way.run or run) for way in error.ways_out]
        error.run, error.ways_out = run, (*ways_out, resume)
        raise


def dispatch_limits(config: RunConfig, most: int | None = None) -> Limits:
    """The engine's number of workers and time limits."""
    compute = config.compute
    return Limits(
        workers=worker_count(config, most),
        max_attempts=compute.max_attempts,
        start_deadline_s=compute.no_worker_timeout_s / 2,  # so that two attempts fit into it
        first_deadline_s=compute.compile_timeout_s,
        min_deadline_s=compute.chunk_timeout_s,
        place_timeout_s=math.inf if compute.place_timeout_s is None else compute.place_timeout_s,
        no_worker_timeout_s=compute.no_worker_timeout_s,
        names=LIMIT_NAMES,
    )


def make_engine(
    config: RunConfig,
    should_stop: Callable[[], int | None] = lambda: None,
    log: Log = no_log,
    on_wait: Callable[[str], None] = lambda shortage: None,
    *,
    at_once: int | None = None,
) -> Engine[Any]:
    """The configured engine, whose workers are starting.

    Args:
        should_stop, log, on_wait: as in `Engine`.
        at_once: number of chunks that can be computed at the same time; None: as in a generation of a run.
    """
    spec, compute = worker_spec(config, task_of(config)), config.compute
    at_once = chunks_at_once(config) if at_once is None else at_once
    limits = dispatch_limits(config, at_once)
    if compute.engine == "inline":
        return inline_engine(spec, limits, should_stop, threads=compute.inline_workers == "threads", log=log)
    from es_service.dispatch.ray_engine import ray_engine

    return ray_engine(
        spec,
        limits,
        should_stop,
        actor=WorkerActor,
        address=compute.address,
        cpus=None if compute.worker_resources.cpu == "auto" else compute.worker_resources.cpu,
        gpus=compute.worker_resources.gpu,
        most=at_once if compute.workers == "auto" else None,
        log=log,
        on_wait=on_wait,
    )


def _initial(config: RunConfig, store: RunStore) -> tuple[list[FloatArray], Moments]:
    """The initial centres and observation statistics: random centres without statistics, or copies of the policy of
    `search.init_from` with its statistics."""
    task, centres = task_of(config), range(config.search.centres)
    if store.start is not None:
        return [store.start["centre_D"] for _ in centres], moments_from_arrays(store.start)
    return [initial_policy(config, centre) for centre in centres], no_observations(task.observation_size)


def initial_policy(config: RunConfig, centre: int) -> FloatArray:
    """Random parameters [D] with which a centre of a run begins, by `policy.init` and the seed."""
    return initial_parameters(policy_shape(config, task_of(config)), config.policy.init, config.seed, centre)


def worker_count(config: RunConfig, most: int | None = None) -> int:
    """Number of workers: as configured, or one per core that this process may use, as far as there is work for them.

    Args:
        most: number of workers for which there is work; None: as in a generation of a run.
    """
    workers = config.compute.workers
    if workers != "auto":
        return workers
    return max(1, min(cores(), chunks_at_once(config) if most is None else most))
