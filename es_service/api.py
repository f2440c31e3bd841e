"""The Python interface, and with the command line the one place that joins the driver's side and the workers' side."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any
from uuid import uuid4

import numpy as np

from es_service import driver
from es_service.algorithms import ALGORITHMS
from es_service.config import loading
from es_service.config.model import RunConfig, changed_constants, describe_changes, policy_shape, worker_spec
from es_service.dispatch.dispatch_log import Committed, Log, dispatch_log
from es_service.dispatch.engine import Engine
from es_service.dispatch.inline_engine import inline_engine
from es_service.dispatch.messages import Policy as SchedulingPolicy
from es_service.errors import ConfigError, StoreError
from es_service.history import history_columns
from es_service.platform_info import platform_info
from es_service.protocol import FloatArray, Moments, TaskSpec
from es_service.run_state import moments_from_arrays, moments_to_arrays
from es_service.run_view import Run, open_run
from es_service.signals import stop_on_signals
from es_service.statistics import no_observations
from es_service.store import reader
from es_service.store.beginning import Beginning
from es_service.store.folder import DATABASE, explained, write_config
from es_service.store.schema import RunMeta
from es_service.store.writer import RunStore, no_hook
from es_service.tasks import Tasks, with_options
from workers.actor import WorkerActor
from workers.policy import initial_parameters

RUNS_FOLDER = Path("runs")
"""Where runs go unless told otherwise, relative to the current folder."""

OnGeneration = Callable[[Mapping[str, Any]], None]
"""Called with each history row once it is safe."""
OnNotice = Callable[[str], None]
"""Called with what had to be repaired, or what the user should know, as soon as it is known."""


TASKS = Tasks()


def _ignore(row: Mapping[str, Any]) -> None:
    """Nothing to do for a generation."""


def _warn(notice: str) -> None:
    warnings.warn(notice, RuntimeWarning, stacklevel=2)


@dataclass(frozen=True)
class Outcome:
    """How a session of a run ended."""

    run: Run
    reason: str
    """Which budget was spent, in words."""


def load_config(source: loading.Source, overrides: Iterable[str] = (), *, new: bool = True) -> RunConfig:
    """Read a YAML file (or a mapping like one), apply overrides such as "search.sigma=0.05", resolve and check it all.

    Args:
        new: whether a run is to be started with it here and now, so that the run it starts from must be there.

    Raises:
        ConfigError: lists every problem found.
    """
    return loading.load_config(source, overrides, tasks=TASKS, algorithms=ALGORITHMS, new=new)


def run(
    config: RunConfig | loading.Source,
    out: str | os.PathLike[str] | None = None,
    *,
    on_generation: OnGeneration = _ignore,
    on_notice: OnNotice = _warn,
    hook: Callable[[str], None] = no_hook,
) -> Outcome:
    """Start a run and work until its budget is spent.

    Args:
        out: folder of the run, new or empty; default runs/<environment>_<algorithm>_seed<seed>_<time>.
        hook: called at the store's named points; for tests that kill the process there.

    Raises:
        ConfigError, StoreError, EvaluationError; Interrupted after SIGINT or SIGTERM. Committed generations are safe.
    """
    if not isinstance(config, RunConfig):
        config = load_config(config)
    parent, beginning = None, Beginning()
    if config.search.init_from is not None:
        parent, beginning = _start_from(config, config.search.init_from)
    return _create_and_work(config, out, parent, beginning, on_generation, on_notice, hook)


def resume(
    folder: str | os.PathLike[str],
    overrides: Iterable[str] = (),
    *,
    on_generation: OnGeneration = _ignore,
    on_notice: OnNotice = _warn,
    hook: Callable[[str], None] = no_hook,
) -> Outcome:
    """Go on with a run from its last committed generation; it ends with the same bits as if never interrupted.

    Args:
        overrides: only budget, engine, workers and time limits may change; the run's `config.yaml` then says so.

    Raises:
        ConfigError: a constant of the run would change (all are listed). Otherwise as `run`.
    """

    def changed(store: RunStore) -> RunConfig:
        recorded = store.folder / "config.yaml"
        source = recorded if recorded.exists() else store.meta.config
        return loading.resume_config(source, overrides, tasks=TASKS, algorithms=ALGORITHMS)

    return _go_on(Path(folder), changed, on_generation, on_notice, hook)


def run_or_resume(
    config: RunConfig | loading.Source,
    out: str | os.PathLike[str],
    *,
    on_generation: OnGeneration = _ignore,
    on_notice: OnNotice = _warn,
    hook: Callable[[str], None] = no_hook,
) -> Outcome:
    """Start a run, or go on with it if the folder holds it already: the same call again after whatever happened.

    Raises:
        ConfigError: the folder's run has other constants than `config` (all are listed). Otherwise as `run`.
    """
    begun = (Path(out) / DATABASE).exists()
    wanted = config if isinstance(config, RunConfig) else load_config(config, new=not begun)
    if not begun:
        return run(wanted, out, on_generation=on_generation, on_notice=on_notice, hook=hook)
    return _go_on(Path(out), lambda store: wanted, on_generation, on_notice, hook)


def _go_on(
    folder: Path,
    make_config: Callable[[RunStore], RunConfig],
    on_generation: OnGeneration,
    on_notice: OnNotice,
    hook: Callable[[str], None],
) -> Outcome:
    """Open a run, make sure that the config for this session is its own, and work."""
    with RunStore.open(folder, hook=hook) as store:
        config = make_config(store)
        if changes := changed_constants(store.meta.constants, config.constants()):
            raise ConfigError(f"{folder}: {describe_changes(changes, str(folder))}")
        if store.meta.columns != history_columns(_task(config)):
            raise StoreError(
                f"{folder} was written by a version of es-service with other history columns; continue it with that "
                f"version, or go on from its state in a new run: es-service fork {folder}"
            )
        try:
            write_config(folder, config.resolved_yaml())
        except OSError as error:
            raise explained(error, folder, "writing config.yaml") from error
        return _work(config, store, on_generation, on_notice)


def fork(
    parent: str | os.PathLike[str],
    overrides: Iterable[str] = (),
    *,
    generation: int | None = None,
    out: str | os.PathLike[str] | None = None,
    on_generation: OnGeneration = _ignore,
    on_notice: OnNotice = _warn,
    hook: Callable[[str], None] = no_hook,
) -> Outcome:
    """Start a new run from another run's state (the newest, or that of `generation` if it is kept), settings changed.

    The history up to there comes along and generations count on, so a fork that changes nothing ends with the same
    bits as its parent would. Where a setting of the task changes, fitness no longer means the same, so the best centre
    so far no longer counts as one.

    Raises:
        ConfigError: a change that the state does not fit (another task, network or algorithm). StoreError: the
            generation is not kept. Otherwise as `run`.
    """
    origin, config = open_run(parent), fork_config(parent, overrides)
    at, parts = origin.parts(generation)
    if any(name.startswith("task.") for name, _, _ in changed_constants(origin.constants, config.constants())):
        parts["best"] = parts["best"] | {"fitness": np.asarray(-np.inf)}
    history = [row for row in origin.history_rows() if row["generation"] <= at]
    platforms = [(first, platform) for first, platform in reader.read_platforms(origin.folder) if first <= at]
    lineage = _lineage(origin, at)
    return _create_and_work(config, out, lineage, Beginning(history, parts, platforms), on_generation, on_notice, hook)


def fork_config(parent: str | os.PathLike[str], overrides: Iterable[str] = ()) -> RunConfig:
    """The config of a fork: the parent's resolved one with overrides.

    Raises:
        ConfigError: as `load_config`, or the parent's state does not fit the changes.
    """
    origin = open_run(parent)
    overrides = [overrides] if isinstance(overrides, str) else list(overrides)
    keys = [override.partition("=")[0].strip() for override in overrides]
    if "search.preset" in keys:
        raise ConfigError(
            "search.preset: a fork has every key from its parent, so a preset would fill in nothing; set the keys "
            "themselves (`es-service list` shows what a preset stands for)"
        )
    mapping = {name: dict(section) if isinstance(section, dict) else section for name, section in origin.config.items()}
    mapping["search"]["init_from"] = None  # it has the parent's state instead
    if "search.pairs" in keys:
        for shape in ("chunk_pairs", "rollout_block_pairs", "gradient_block_pairs"):
            mapping["compute"][shape] = "auto"
    config = loading.load_config(mapping, overrides, tasks=TASKS, algorithms=ALGORITHMS)
    fixed = ("task.environment", "policy.hidden", "search.algorithm", "search.members")
    if unfit := [change for change in changed_constants(origin.constants, config.constants()) if change[0] in fixed]:
        listed = "\n".join(f"  {name}: {old} -> {new}" for name, old, new in unfit)
        raise ConfigError(
            f"{origin.folder}: its state does not fit these changes:\n{listed}\n"
            f"to start afresh from its centre (same task and network): "
            f"es-service run CONFIG --set search.init_from={origin.folder}"
        )
    return config


def default_folder(config: RunConfig) -> Path:
    """A new folder name under `runs/` that says what the run is and when it began."""
    when = datetime.now().strftime("%Y%m%d-%H%M%S")
    name = f"{config.task.environment}_{config.search.algorithm}_seed{config.seed}_{when}"
    taken = len(list(RUNS_FOLDER.glob(f"{name}*")))
    return RUNS_FOLDER / (f"{name}-{taken + 1}" if taken else name)


def worker_count(config: RunConfig) -> int:
    """Workers to start: as configured, or one per core this process may use."""
    workers = config.compute.workers
    return len(os.sched_getaffinity(0)) if workers == "auto" else workers


def _create_and_work(
    config: RunConfig,
    out: str | os.PathLike[str] | None,
    parent: dict[str, Any] | None,
    beginning: Beginning,
    on_generation: OnGeneration,
    on_notice: OnNotice,
    hook: Callable[[str], None],
) -> Outcome:
    folder = Path(out) if out is not None else default_folder(config)
    if folder.parent == RUNS_FOLDER:
        try:
            RUNS_FOLDER.mkdir(exist_ok=True)
        except OSError as error:
            raise StoreError(
                f"cannot create the folder {RUNS_FOLDER} in {Path.cwd()}: {error.strerror}; choose another --out"
            ) from error
    task = _task(config)
    meta = RunMeta(
        run_id=uuid4().hex,
        created=datetime.now(UTC).isoformat(timespec="seconds"),
        config=config.model_dump(mode="json"),
        constants=config.constants(),
        task=asdict(task),
        columns=history_columns(task),
        parent=parent,
    )
    with RunStore.create(folder, config.resolved_yaml(), meta, beginning, hook=hook) as store:
        return _work(config, store, on_generation, on_notice)


def _work(config: RunConfig, store: RunStore, on_generation: OnGeneration, on_notice: OnNotice) -> Outcome:
    """Run the loop until the budget is spent."""
    task = _task(config)
    told = 0

    def tell_notices() -> None:
        nonlocal told
        for notice in store.notices[told:]:
            on_notice(notice)
        told = len(store.notices)

    tell_notices()
    platform = platform_info()
    if config.compute.worker_resources.gpu:
        platform |= {"device": "gpu"}  # whose bits are others
    first = 0 if store.generation is None else store.generation + 1
    if store.record_platform(first, platform) and first:
        on_notice(f"from generation {first} on this run has another platform: {platform}. Its digest now says `mixed`.")
    compute = config.compute
    scheduling = SchedulingPolicy(
        workers=worker_count(config),
        max_attempts=compute.max_attempts,
        start_deadline_s=compute.no_worker_timeout_s / 2,  # two tries fit in
        first_deadline_s=compute.compile_timeout_s,
        min_deadline_s=compute.chunk_timeout_s,
        no_worker_timeout_s=compute.no_worker_timeout_s,
    )
    search = driver.Search(
        config=config,
        algorithm=ALGORITHMS[config.search.algorithm](config),
        initial=lambda: _initial(config, store),
        task=task,
    )
    with (
        dispatch_log(store.folder, store.generation, enabled=compute.dispatch_log) as log,
        stop_on_signals() as should_stop,
        _engine(config, scheduling, should_stop, log) as engine,
    ):

        def after_generation(row: Mapping[str, Any]) -> None:
            log(Committed(row["generation"]))
            tell_notices()
            if lost := row["lost_workers"]:
                who = "a worker" if lost == 1 else f"{lost} workers"
                on_notice(f"generation {row['generation']}: lost {who}; {engine.last_loss}")
            on_generation(row)

        _, reason = driver.run(search, engine, store, after_generation)
    return Outcome(open_run(store.folder), reason)


def _engine(
    config: RunConfig, scheduling: SchedulingPolicy, should_stop: Callable[[], int | None], log: Log
) -> Engine[Any]:
    """What runs the workers, as configured; they are starting."""
    spec, compute = worker_spec(config, _task(config)), config.compute
    if compute.engine == "inline":
        return inline_engine(spec, scheduling, should_stop, log=log)
    from es_service.dispatch.ray_cluster import Claim
    from es_service.dispatch.ray_engine import ray_engine

    return ray_engine(
        spec,
        scheduling,
        should_stop,
        actor=WorkerActor,
        address=compute.address,
        claim=Claim(compute.worker_resources.cpu, compute.worker_resources.gpu),
        elastic=compute.workers == "auto",
        log=log,
    )


def _task(config: RunConfig) -> TaskSpec:
    return with_options(TASKS[config.task.environment], config.task.options)


def _initial(config: RunConfig, store: RunStore) -> tuple[list[FloatArray], Moments]:
    """Each member's first centre, and the observation statistics: random ones with none, or all of them the one that
    the run was created with."""
    task, members = _task(config), range(config.search.members)
    if store.start is not None:
        return [store.start["centre_D"] for _ in members], moments_from_arrays(store.start)
    shape = policy_shape(config, task)
    centres = [initial_parameters(shape, config.policy.init, config.seed, member) for member in members]
    return centres, no_observations(task.observation_size)


def _start_from(config: RunConfig, folder: str) -> tuple[dict[str, Any], Beginning]:
    """What a run records and keeps of the one whose newest centre it starts from; all of one generation."""
    origin, shape = open_run(folder), policy_shape(config, _task(config))
    if origin.policy_shape != shape:
        raise ConfigError(
            f"search.init_from: the policy of {origin.folder} has layers {list(origin.policy_shape.widths)}, "
            f"this run's has {list(shape.widths)}; use the same task and policy.hidden"
        )
    at, parts = origin.parts()
    start = {
        "centre_D": origin.newest_centre(at, parts),
        **moments_to_arrays(moments_from_arrays(parts["observations"])),
    }
    return _lineage(origin, at), Beginning(start=start)


def _lineage(origin: Run, generation: int) -> dict[str, Any]:
    return {
        "run_id": origin.run_id,
        "folder": str(origin.folder.absolute()),
        "generation": generation,
        "digest": origin.digest(),
    }
