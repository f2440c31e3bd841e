"""One session of a run: start the engine, and run generations until the budget is spent or a stop is requested."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, replace
from typing import Any

from es_service.config.map_rules import placing_seconds
from es_service.config.model import RunConfig
from es_service.config.sections import MapConfig
from es_service.config.tasks import task_of
from es_service.config.workload import parallel_sentence, policy_spec
from es_service.dispatch.events import Committed, dispatch_log
from es_service.errors import (
    Action,
    ConfigError,
    EvaluationError,
    Interrupted,
    ServiceError,
    StoreError,
    WayOut,
    counted,
)
from es_service.logs import in_generation, logger
from es_service.loop import driver
from es_service.loop.history import METRIC, evaluated_word
from es_service.loop.state import Observer, Stop, no_observations
from es_service.protocol.episodes import METRIC_FORM, DispatchCounts, OverlappedRequests, wrong_metric_names
from es_service.protocol.machine import platform_info
from es_service.protocol.messages import FloatArray, Moments, TaskSpec
from es_service.runs.checked_config import Recorder, code_of, tell_of_other_code
from es_service.runs.engine import make_engine, reader_of_reports
from es_service.runs.signals import stop_on_signals
from es_service.runs.snapshot import require_sound_state
from es_service.runs.view import Run, open_run
from es_service.runs.waiting import patient_store
from es_service.search.algorithms import ALGORITHMS
from es_service.store.codec import Part
from es_service.store.create import SEVERAL
from es_service.store.lock import RunLock
from es_service.store.schema import RunMeta
from es_service.store.writer import RunStore
from workers.policy import initial_parameters

_LOG = logger(__name__)
LONG_PLACING_S = 2.0
"""Time from which on it is said that centroids are placed."""
TO_CERTIFY = "the best centre may have reached budget.target_certified"
"""Reason why a session ends before a certification."""
ALIKE_GENERATIONS = 20
"""Generation at which a run says that all its centres have had the same descriptor."""
OnGeneration = Callable[[Mapping[str, Any]], object]
"""Called with each history row after its generation is committed, or has begun to wait for that (`runs/waiting.py`). A
`Stop` that it returns ends the session, and numbers by name are recorded; see `metrics_of`."""
Told = Callable[[], Mapping[str, float]]
"""Returns the metrics that a caller has told of the generation that is being stored, in whose transaction they are."""
OnNotice = Callable[[str], None]
"""Called with each notice for the user, such as a repair of the run or a lost worker."""


def show_notice(notice: str) -> None:
    """Print a notice as a line on stderr, as the command line does; the default for `on_notice`."""
    print(f"note: {notice}", file=sys.stderr, flush=True)


@dataclass(frozen=True)
class Outcome:
    """How a session of a run ended."""

    run: Run
    reason: str
    """Which part of the budget is spent, in words; or the reason of the `Stop` that `on_generation` returned."""
    is_finished: bool
    """Whether the budget is spent or a target reached; False after a `Stop`, and if starting took all of
    `budget.wall_clock_s`, so that the run has no generation."""


def work(
    config: RunConfig,
    store: RunStore,
    on_generation: OnGeneration,
    on_notice: OnNotice,
    on_compile: OnNotice,
    on_output: OnNotice,
    *,
    strict: bool = False,
    told: Told | None = None,
    is_due: Callable[[Mapping[str, Any]], bool] = lambda row: False,
) -> OverlappedRequests[Outcome]:
    """Run generations until the budget is spent or `on_generation` returns a `Stop`. The configured engine computes
    their work, so that nothing is yielded, unless the caller does.

    Args:
        on_compile: called with a sentence when workers compile, or make or reset environments, for some time, and
            before centroids are placed for some time.
        on_output: called with each line that a worker prints, after the worker.
        strict: whether workers on another platform than the run's are an error.
        told: metrics of the caller, to whom work is yielded because the task has no episodes of its own; None: an
            engine computes.
        is_due: returns whether the best centre is to be certified, by its `best_fitness` in a row of the history; the
            session then ends after this generation.
    """
    task, asks_caller = task_of(config), told is not None
    # Only what is computed again with the same bits may be lost, and only who cannot stop a run is shown several rows.
    may_group = task.kind == "jax" and isinstance(on_generation, Observer)
    store.keep_every = config.store.keep_every
    notices, said_failed = 0, False

    def tell(notice: str) -> None:
        _LOG.warning(notice)
        on_notice(notice)

    def tell_notices() -> None:
        nonlocal notices
        for notice in store.notices[notices:]:
            tell(notice)
        notices = len(store.notices)

    def tell_wait(shortage: str) -> None:
        store.lock.say(waiting=bool(shortage))
        limit_s = config.compute.place_timeout_s
        until = "until there is one" if limit_s is None else f"at most {limit_s:g} s (compute.place_timeout_s)"
        waits = f"no worker has a place in the cluster; the run waits {until}. {shortage}"
        tell(waits if shortage else "a worker has a place in the cluster; the run begins")

    def tell_compiling(sentence: str) -> None:
        store.lock.say(doing=sentence)
        if sentence:
            _LOG.info(sentence)
            on_compile(sentence)

    tell_notices()
    for note in task.notes if store.generation is None else ():
        tell(note)
    if store.generation is None and task.does_not_repeat:
        tell(
            f"{task.name} does not repeat itself: with the same seed and actions it returns other numbers "
            f"{task.does_not_repeat}. So neither does the run: with other workers or after a resume it has other "
            "numbers, and `verify` cannot judge it. The run records this. `doctor` tries whether "
            "task.new_object_each_episode mends it"
        )
    require_sound_state(store)
    state = driver.stored_state(store)
    if state is not None and (reason := driver.spent(config.budget, state)) is not None:
        return Outcome(open_run(store.folder), reason, driver.is_finished(config.budget, state))  # without an engine
    search = driver.Search(
        config=config,
        algorithm=ALGORITHMS[config.search.algorithm](config),
        initial=lambda: initial_centres(config, store.start),
        task=task,
        statistics=lambda: initial_statistics(store.start),
    )
    code = code_of(config)
    tell_of_other_code(store, code, tell)
    in_generation(0 if store.generation is None else store.generation + 1)
    compute = config.compute
    _LOG.info("working on %s: engine %s, rollout %s", store.folder, compute.engine, compute.rollout)
    _LOG.info(parallel_sentence(config))
    with (
        _noting_the_end(store.lock),
        _naming_the_run(store, "ask_tell" if asks_caller else "resume"),
        dispatch_log(store.folder, store.generation, enabled=config.compute.dispatch_log) as log,
        nullcontext(lambda: None) if asks_caller else stop_on_signals() as should_stop,
        nullcontext()
        if asks_caller
        else make_engine(
            config,
            should_stop,
            log,
            tell_wait,
            tell,
            tell_compiling,
            on_report=reader_of_reports(tell, on_output, store.lock),
        ) as engine,
    ):

        def tell_failed(failures: Sequence[str]) -> None:
            nonlocal said_failed
            for text in failures:
                _LOG.warning("%s failed: %s", config.task.environment, text)
            if not said_failed:
                said_failed = True
                on_notice(
                    f"{config.task.environment} failed, which makes the member invalid: {failures[0]}. Later failures "
                    "are in the log (--log-level warning)"
                )

        alike = alike_centres(config, task) if state is None else lambda row: ""

        def after_generation(row: Mapping[str, Any]) -> object:
            tell_notices()
            if said_alike := alike(row):
                tell(said_alike)
            if engine is not None and (lost := row["lost_workers"]):
                who = "a worker" if lost == 1 else counted(lost, "worker")
                tell(engine.last_loss(f"generation {row['generation']}: lost {who}; "))
            answer = on_generation(dict(row))
            given = answer.metrics if isinstance(answer, Stop) else answer
            if isinstance(given, Mapping) and given:
                kept.record(row["generation"], checked_metrics(given, store.meta, "on_generation"))
            if not isinstance(answer, Stop) and is_due(row):
                answer = Stop(TO_CERTIFY)
            _LOG.info(
                "%s fitness %.6g, best %.6g, env steps %d, steps/s %.3g",
                evaluated_word(row),
                row["centre_fitness_mean"],
                row["best_fitness"],
                row["env_steps"],
                row["steps_per_second"],
            )
            return answer

        if engine is not None:
            if compute.workers != "auto" and (count := engine.counts.workers) < compute.workers:
                tell(f"compute.workers: {count} of {compute.workers} start, since {parallel_sentence(config)}")
            engine.wait_for_place()  # before the loop, whose time is that of the run and of its budget
        recorder = Recorder(store, engine, platform_info(), code, tell, strict=strict)
        if state is None and (placing := _placing_sentence(config.map)):
            _LOG.info(placing)
            on_compile(placing)
        listening = should_stop, tell, lambda stored: log(Committed(stored))
        with patient_store(store, recorder, *listening, told or dict) as kept:
            counts = (lambda: DispatchCounts(workers=1)) if engine is None else lambda: engine.counts
            interval_s = config.store.commit_interval_s if may_group else 0.0
            session = driver.run(
                search,
                kept,
                state,
                after_generation,
                tell_failed,
                counts,
                interval_s,
                lambda state: is_due({"best_fitness": state.best.fitness}),
            )
            state, reason = (yield from session) if engine is None else driver.drive(session, engine)
        _LOG.info("the session ends: %s", reason)
        store.lock.note_end("" if driver.spent(config.budget, state) else reason)
    return Outcome(open_run(store.folder), reason, driver.is_finished(config.budget, state))


def checked_metrics(given: Mapping[str, Any], meta: RunMeta, field: str) -> dict[str, float]:
    """Metrics that a caller records, as numbers.

    Args:
        field: function or argument that they come from.

    Raises ConfigError for a name that no metric can have, or that is one of the search or of the task, and for a value
    that is no number.
    """
    of_run = [column.name.removeprefix(METRIC) for column in meta.columns if column.name.startswith(METRIC)]
    if wrong := wrong_metric_names(given) or wrong_metric_names([*of_run, *given]):
        raise ConfigError(
            f"{field}: a metric is named {wrong[-1]}; its name must be of {METRIC_FORM}, and no metric of the search "
            "or of the task may have it",
            field=field,
            value=wrong[-1],
        )
    metrics = {}
    for name, value in given.items():
        try:
            metrics[name] = math.nan if value is None else float(value)
        except (TypeError, ValueError, OverflowError):
            raise ConfigError(
                f"{field}: the metric {name} is {value!r}; it must be a number (NaN for none)",
                field=field,
                value=value,
                allowed="a number",
            ) from None
    return metrics


def alike_centres(config: RunConfig, task: TaskSpec) -> Callable[[Mapping[str, Any]], str]:
    """Function of each history row of a new run that says, at `ALIKE_GENERATIONS`, if all evaluations so far had the
    same descriptor. Else it returns "", and always for a search that looks at fitness alone."""
    columns = [f"centre_{name}" for name in task.descriptor_names]
    needs_descriptor, is_same, first_B = bool(config.search.needs_map), True, []

    def sentence(row: Mapping[str, Any]) -> str:
        nonlocal needs_descriptor, is_same, first_B
        descriptor_B = [row[column] for column in columns]
        first_B = first_B or descriptor_B
        is_same &= descriptor_B == first_B and not any(row[f"{column}_std"] for column in columns)
        needs_descriptor |= row["fitness_weight"] < 1.0
        is_due = row["generation"] == ALIKE_GENERATIONS
        where = f"all evaluations of {ALIKE_GENERATIONS} generations"
        return same_descriptor(task, first_B, where) if is_due and is_same and needs_descriptor else ""

    return sentence


def same_descriptor(task: TaskSpec, descriptor_B: Sequence[float], where: str) -> str:
    """That a descriptor was the same in these episodes, what follows from it, and what can be done."""
    values = ", ".join(f"{name} = {value:g}" for name, value in zip(task.descriptor_names, descriptor_B, strict=True))
    return (
        f"the descriptor was the same in {where}: {values}. As long as it is, a search for novelty or with a behaviour "
        "map cannot tell one policy from another. Choose another descriptor (`task.descriptor` with gymnasium:ID, "
        "`task.options.descriptor` with other suites, `descriptor(self)` in a class of your own), or a method that "
        "needs none"
    )


def _placing_sentence(config: MapConfig) -> str:
    """That centroids of the map are placed, if this takes long; else empty."""
    if not config.enabled or config.kind != "cvt":
        return ""
    cells, dimensions = config.cells[0], len(config.bounds)
    seconds = placing_seconds(cells, dimensions, config.centroids)
    about = f"{counted(cells, 'cell')} in {counted(dimensions, 'dimension')}, about {seconds:.0f} s"
    return f"placing the centroids of the map ({about})" if seconds >= LONG_PLACING_S else ""


@contextmanager
def _noting_the_end(lock: RunLock) -> Iterator[None]:
    """Keep what ends a session, for whoever asks later why the run stands still."""
    try:
        yield
    except Interrupted as stop:
        lock.note_end(str(stop))
        raise
    except SystemExit as stop:
        code = "" if stop.code is None else repr(stop.code)
        lock.note_end(f"the program that ran it has ended it with sys.exit({code}), as tuners end their trials")
        raise
    except GeneratorExit:
        lock.note_end("its caller has left the block of ask_tell")
        raise
    except ServiceError as error:
        lock.note_end(" ".join(f"{type(error).__name__}: {error.sentence}".split()))
        raise
    except BaseException as error:
        lock.note_end(": ".join([type(error).__name__, *filter(None, [" ".join(str(error).split())])]))
        raise


@contextmanager
def _naming_the_run(store: RunStore, action: Action) -> Iterator[None]:
    """Add to an error of the rollouts the run's folder, and as a way out what continues the run."""
    try:
        yield
    except EvaluationError as error:
        run = str(store.folder)
        where = "from the last finished generation" if store.generation is not None else "with its first generation"
        resume = WayOut(action, f"continue {where} after the cause is fixed", run)
        ways_out = [replace(way, run=way.run or run) for way in error.ways_out]
        error.run, error.ways_out = run, (*ways_out, resume)
        raise


def initial_centres(config: RunConfig, start: Part | None) -> tuple[list[FloatArray], Moments]:
    """The initial centres and observation statistics: random centres without statistics, or copies of the policy of
    `search.init_from` with its statistics, or several policies, which the run has stored as its start.

    Raises StoreError if the run should have a start and has none.
    """
    if start is None and config.search.init_from is not None:
        raise StoreError(
            f"the run starts from a policy of {config.search.init_from}, which it has lost; start it again in a new "
            "folder"
        )
    task, centres = task_of(config), range(config.search.centres)
    if start is not None:
        several = start.get(SEVERAL)
        points = list(several) if several is not None else [start["centre_D"] for _ in centres]
        return points, Moments(float(start["count"]), start["mean_O"], start["m2_O"])
    return [initial_policy(config, centre) for centre in centres], no_observations(task.observation_size)


def initial_statistics(start: Part | None) -> list[tuple[FloatArray, FloatArray]]:
    """Observation statistics of each initial centre that starts from one of several policies; else none."""
    if start is None or SEVERAL not in start:
        return []
    return list(zip(start["mean_K_O"], start["std_K_O"], strict=True))


def initial_policy(config: RunConfig, centre: int) -> FloatArray:
    """Parameters [D] with which a centre of a run begins: those of a policy are random, by `policy.init` and the seed;
    those of a function begin at its start."""
    if (parameters := task_of(config).parameters) is not None:
        return parameters.first(config.seed, centre)
    return initial_parameters(policy_spec(config, task_of(config)), config.policy.init, config.seed, centre)
