"""The Python interface, and with the command line the one place that joins the driver's side and the workers' side."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any
from uuid import uuid4

from es_service import digest, driver
from es_service.algorithms import ALGORITHMS
from es_service.config import loading
from es_service.config.model import RunConfig, changed_constants, describe_changes, worker_spec
from es_service.dispatch.inline_engine import InlineEngine
from es_service.dispatch.messages import Policy as SchedulingPolicy
from es_service.errors import ConfigError
from es_service.history import history_columns
from es_service.platform_info import platform_info
from es_service.protocol import FloatArray, Moments
from es_service.run_view import Run, open_run
from es_service.signals import stop_on_signals
from es_service.statistics import no_observations
from es_service.store.writer import RunMeta, RunStore, no_hook
from workers.environments import TASKS
from workers.policy import initial_parameters, policy_shape

RUNS_FOLDER = Path("runs")
"""Where runs go unless told otherwise, relative to the current folder."""


@dataclass(frozen=True)
class Outcome:
    """How a session of a run ended."""

    run: Run
    reason: str
    """Which budget was spent, in words."""
    notices: tuple[str, ...]
    """What had to be repaired or should be known, in words."""


def load_config(source: loading.Source, overrides: Iterable[str] = ()) -> RunConfig:
    """Read a YAML file (or a mapping like one), apply overrides such as "search.sigma=0.05", resolve and check it all.

    Raises:
        ConfigError: lists every problem found.
    """
    return loading.load_config(source, overrides, tasks=TASKS, algorithms=ALGORITHMS)


def run(
    config: RunConfig | loading.Source,
    out: str | os.PathLike[str] | None = None,
    *,
    on_generation: Callable[[Mapping[str, Any]], None] = lambda row: None,
    hook: Callable[[str], None] = no_hook,
) -> Outcome:
    """Start a run and work until its budget is spent.

    Args:
        out: folder of the run, new or empty; default runs/<environment>_<algorithm>_seed<seed>_<time>.
        on_generation: called with each history row once it is safe.
        hook: called at the store's named points; for tests that kill the process there.

    Raises:
        ConfigError, StoreError, EvaluationError; Interrupted after SIGINT or SIGTERM. Committed generations are safe.
    """
    if not isinstance(config, RunConfig):
        config = load_config(config)
    parent = _parent(config.search.init_from) if config.search.init_from else None
    with RunStore.create(_new_folder(config, out), config.resolved_yaml(), _meta(config, parent), hook=hook) as store:
        return _work(config, store, on_generation)


def resume(
    folder: str | os.PathLike[str],
    overrides: Iterable[str] = (),
    *,
    on_generation: Callable[[Mapping[str, Any]], None] = lambda row: None,
    hook: Callable[[str], None] = no_hook,
) -> Outcome:
    """Go on with a run from its last committed generation; it ends with the same bits as if never interrupted.

    Args:
        overrides: only budget, engine, workers and time limits may change.

    Raises:
        ConfigError: a constant of the run would change (all are listed). Otherwise as `run`.
    """
    folder = Path(folder)
    with RunStore.open(folder, hook=hook) as store:
        edited = folder / "config.yaml"
        source = edited if edited.exists() else store.meta.config
        config = loading.resume_config(source, overrides, tasks=TASKS, algorithms=ALGORITHMS)
        if changes := changed_constants(store.meta.constants, config.constants()):
            raise ConfigError(f"{folder}: {describe_changes(changes, str(folder))}")
        return _work(config, store, on_generation)


def fork(
    parent: str | os.PathLike[str],
    overrides: Iterable[str] = (),
    *,
    generation: int | None = None,
    out: str | os.PathLike[str] | None = None,
    on_generation: Callable[[Mapping[str, Any]], None] = lambda row: None,
) -> Outcome:
    """Start a new run from another run's state (the newest, or that of `generation` if it is kept), settings changed.

    The history up to there comes along and generations count on, so a fork that changes nothing ends with the same
    bits as its parent would.

    Raises:
        ConfigError: a change that the state does not fit (another task, network or algorithm). StoreError: the
            generation is not kept. Otherwise as `run`.
    """
    origin, config = open_run(parent), fork_config(parent, overrides)
    at, parts = origin.parts(generation)
    history = [row for row in origin.history_rows() if row["generation"] <= at]
    lineage = {"run_id": origin.run_id, "folder": str(origin.folder), "generation": at, "digest": origin.digest()}
    with RunStore.create(_new_folder(config, out), config.resolved_yaml(), _meta(config, lineage)) as store:
        store.adopt(history, parts)
        return _work(config, store, on_generation)


def fork_config(parent: str | os.PathLike[str], overrides: Iterable[str] = ()) -> RunConfig:
    """The config of a fork: the parent's resolved one with overrides.

    Raises:
        ConfigError: as `load_config`, or the parent's state does not fit the changes.
    """
    origin = open_run(parent)
    overrides = list(overrides)
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
    fixed = ("task.environment", "policy.hidden", "search.algorithm")
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


def _new_folder(config: RunConfig, out: str | os.PathLike[str] | None) -> Path:
    folder = Path(out) if out is not None else default_folder(config)
    if folder.parent == RUNS_FOLDER:
        RUNS_FOLDER.mkdir(exist_ok=True)
    return folder


def worker_count(config: RunConfig) -> int:
    """Workers to start: as configured, or one per core this process may use."""
    workers = config.compute.workers
    return len(os.sched_getaffinity(0)) if workers == "auto" else workers


def _work(config: RunConfig, store: RunStore, on_generation: Callable[[Mapping[str, Any]], None]) -> Outcome:
    """Run the loop on the inline engine until the budget is spent."""
    notices = list(store.notices)
    platform = platform_info()
    first = 0 if store.generation is None else store.generation + 1
    if store.record_platform(first, platform) and first:
        notices.append(
            f"from generation {first} on this run has another platform: {platform}. Its digest now says `mixed`."
        )
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
        algorithm=ALGORITHMS[config.search.algorithm](config.search),
        initial=partial(_initial, config),
        descriptor_names=TASKS[config.task.environment].descriptor_names,
    )
    with stop_on_signals() as should_stop, InlineEngine(worker_spec(config), scheduling, should_stop) as engine:
        _, reason = driver.run(search, engine, store, on_generation)
    return Outcome(open_run(store.folder), reason, tuple(notices))


def _initial(config: RunConfig) -> tuple[FloatArray, Moments]:
    """The first centre with its observation statistics: random with none, or those of the run in `search.init_from`."""
    task = TASKS[config.task.environment]
    shape = policy_shape(task.observation_size, config.policy.hidden, task.action_size)
    if config.search.init_from is None:
        centre_D = initial_parameters(shape, config.policy.init, config.seed)
        return centre_D, no_observations(task.observation_size)
    origin = open_run(config.search.init_from)
    if origin.policy_shape != shape:
        raise ConfigError(
            f"search.init_from: the policy of {origin.folder} has layers {list(origin.policy_shape.widths)}, "
            f"this run's has {list(shape.widths)}; use the same task and policy.hidden"
        )
    return origin.centre(), origin.observations()


def _parent(folder: str) -> dict[str, Any]:
    """What a run records of the one its centre came from."""
    origin = open_run(folder)
    return {
        "run_id": origin.run_id,
        "folder": str(origin.folder),
        "generation": origin.generation,
        "digest": digest.digest(origin.folder),
    }


def _meta(config: RunConfig, parent: dict[str, Any] | None) -> RunMeta:
    return RunMeta(
        run_id=uuid4().hex,
        created=datetime.now(UTC).isoformat(timespec="seconds"),
        config=config.model_dump(mode="json"),
        constants=config.constants(),
        columns=history_columns(TASKS[config.task.environment].descriptor_names),
        parent=parent,
    )
