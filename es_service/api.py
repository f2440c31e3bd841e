"""The Python interface: start a run, go on with it, fork it."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Mapping
from dataclasses import asdict
from datetime import UTC, datetime
from itertools import count
from pathlib import Path
from typing import Any
from uuid import uuid4

from es_service.config.changes import changed_constants, refused_changes
from es_service.config.keys import Overrides
from es_service.config.loading import Source
from es_service.config.model import RunConfig
from es_service.config.tasks import task_of
from es_service.config.yaml_text import show
from es_service.errors import ConfigError, StoreError, WayOut
from es_service.logs import in_run
from es_service.loop.budget import REACHED, limits_of, raised
from es_service.loop.history import history_columns
from es_service.protocol.messages import TaskSpec
from es_service.runs.checked_config import changed_config, load_config
from es_service.runs.lineage import fork_config, forked, started
from es_service.runs.session import OnGeneration, OnNotice, Outcome, work
from es_service.runs.standing import Standing, look
from es_service.runs.view import open_run
from es_service.store.beginning import Beginning
from es_service.store.folder import CONFIG, explained, holds_run, write_config
from es_service.store.schema import RunMeta
from es_service.store.writer import RunStore, no_hook

RUNS_FOLDER = Path("runs")
"""Where runs go unless told otherwise, relative to the current folder."""


_KEPT_OF_A_TASK = ("observation_size", "action_size", "descriptor_names", "has_goal")
"""What policies and history of a run depend on."""


def _ignore(row: Mapping[str, Any]) -> None:
    """Nothing to do for a generation."""


def _warn(notice: str) -> None:
    warnings.warn(notice, RuntimeWarning, stacklevel=2)


def run(
    config: RunConfig | Source,
    out: str | os.PathLike[str] | None = None,
    *,
    on_generation: OnGeneration = _ignore,
    on_notice: OnNotice = _warn,
    hook: Callable[[str], None] = no_hook,
) -> Outcome:
    """Start a run and work until its budget is spent.

    Args:
        out: folder of the run, new or empty, made with its parents; default
            runs/<environment>_<algorithm>_seed<seed>_<time>-<process>.
        hook: called at the store's named points; for tests that kill the process there.

    Raises:
        ConfigError, StoreError, EvaluationError; Interrupted after SIGINT or SIGTERM. Committed generations are safe.
    """
    if not isinstance(config, RunConfig):
        config = load_config(config)
    parent, beginning = None, Beginning()
    if config.search.init_from is not None:
        parent, beginning = started(config, config.search.init_from, on_notice)
    return _create_and_work(config, out, parent, beginning, on_generation, on_notice, hook)


def resume(
    folder: str | os.PathLike[str],
    overrides: Overrides = (),
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
        # All of the file, unlike `Run.present_config`: whoever has edited a constant there is to be told, not ignored.
        recorded = store.folder / CONFIG
        source = recorded if recorded.exists() else store.meta.config
        return changed_config(source, overrides)

    return _go_on(Path(folder), changed, on_generation, on_notice, hook)


def run_or_resume(
    config: RunConfig | Source,
    out: str | os.PathLike[str],
    *,
    on_generation: OnGeneration = _ignore,
    on_notice: OnNotice = _warn,
) -> Outcome:
    """Start a run, or go on with it if the folder holds it already: the same call again after whatever happened.

    Raises:
        ConfigError: the folder's run has other constants than `config` (all are listed). Otherwise as `run`.
    """
    begun = holds_run(Path(out))
    wanted = config if isinstance(config, RunConfig) else load_config(config, new=not begun)
    if not begun:
        return run(wanted, out, on_generation=on_generation, on_notice=on_notice)
    return _go_on(Path(out), lambda store: wanted, on_generation, on_notice)


def _go_on(
    folder: Path,
    make_config: Callable[[RunStore], RunConfig],
    on_generation: OnGeneration,
    on_notice: OnNotice,
    hook: Callable[[str], None] = no_hook,
) -> Outcome:
    """Open a run, make sure that the config for this session is its own, and work."""
    with RunStore.open(folder, hook=hook) as store, in_run(store.meta.run_id):
        # What opening has repaired stays so, whatever is refused now. Told once: `work` tells what is there later.
        for notice in store.notices:
            on_notice(notice)
        store.notices.clear()
        config = make_config(store)
        if changes := changed_constants(store.meta.constants, config.constants()):
            besides = _budget_of_a_fork(config, look(open_run(folder)))
            raise refused_changes(folder, changes, besides)
        task = task_of(config)
        if other := _other_task(store.meta.task, task):
            raise ConfigError(
                f"{folder}: the task {config.task.environment} is not what it was ({other}), so what the run has kept "
                "does not fit it; undo that, or start a new run",
                field="task.environment",
                value=config.task.environment,
                run=folder,
            )
        if store.meta.columns != history_columns(task, config.map.enabled):
            raise StoreError(
                f"{folder} was written by a version of es-service with other history columns; continue it with that "
                "version",
                run=folder,
                ways_out=[WayOut("fork", "go on from its state in a new run", str(folder))],
            )
        try:
            write_config(folder, config.resolved_yaml())
        except OSError as error:
            raise explained(error, folder, f"writing {CONFIG}") from error
        return work(config, store, on_generation, on_notice)


def _budget_of_a_fork(config: RunConfig, standing: Standing) -> dict[str, Any]:
    """The keys of the budget that a fork has to set besides those that are to change: what it would not take over from
    the run, and what it would find spent."""
    limits = limits_of(config.budget)
    wanted = {key: limits.get(key) for key in REACHED if limits.get(key) != standing.limits.get(key)}
    wanted |= raised(limits, standing.row) if standing.row else {}
    return {f"budget.{key}": value for key, value in wanted.items()}


def _other_task(recorded: Mapping[str, Any], task: TaskSpec) -> str:
    """Where a task, a user's that was edited, has other policies or another history than it had; empty if nowhere."""
    present = asdict(task) | {"descriptor_names": list(task.descriptor_names)}
    values = [(name, recorded[name], present[name]) for name in _KEPT_OF_A_TASK]
    return ", ".join(f"{name}: {show(old)} -> {show(new)}" for name, old, new in values if old != new)


def fork(
    parent: str | os.PathLike[str],
    overrides: Overrides = (),
    *,
    generation: int | None = None,
    out: str | os.PathLike[str] | None = None,
    on_generation: OnGeneration = _ignore,
    on_notice: OnNotice = _warn,
    hook: Callable[[str], None] = no_hook,
) -> Outcome:
    """Start a new run from another run's state (the newest, or that of `generation` if it is kept), settings changed.

    The history up to there comes along and generations count on, so a fork that changes nothing ends with the same
    bits as its parent would. Where a setting changes what an evaluation means, of the task or of how observations are
    normalised, no fitness seen so far counts any more: the best centre, nsra_es's record and the map begin anew; the
    weight of fitness stays as it is. From one of ns_es, nsr_es and nsra_es a fork may go to another, whose weight of
    fitness then begins anew. A generation's number alone says what me_es does in it, so that other blocks
    (`search.block_generations`, `mode`, `first_block`, `alternation`) count at once, also in the middle of one.

    Raises:
        ConfigError: a change that the state does not fit (another task, descriptor, network, algorithm or map), or that
            a fork has no use for. StoreError: the generation is not kept. Otherwise as `run`.
    """
    config = fork_config(parent, overrides)
    lineage, beginning = forked(open_run(parent), config, generation)
    outcome = _create_and_work(config, out, lineage, beginning, on_generation, on_notice, hook)
    if outcome.run.generation == (begun := lineage["generation"]):
        on_notice(
            f"nothing was run: {outcome.reason} at generation {begun} already, where this fork begins; resume it with "
            "a larger budget"
        )
    return outcome


def default_folder(config: RunConfig) -> Path:
    """A new folder name under `runs/` that says what the run is and when it began; runs begun together have their
    process's number besides, so that none is refused the other's folder."""
    when = datetime.now().strftime("%Y%m%d-%H%M%S")
    name = f"{config.task.environment}_{config.search.algorithm}_seed{config.seed}_{when}-{os.getpid()}"
    names = (name if number == 1 else f"{name}-{number}" for number in count(1))
    return next(RUNS_FOLDER / name for name in names if not (RUNS_FOLDER / name).exists())


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
    task = task_of(config)
    meta = RunMeta(
        run_id=uuid4().hex,
        created=datetime.now(UTC).isoformat(timespec="seconds"),
        config=config.model_dump(mode="json"),
        constants=config.constants(),
        task=asdict(task),
        columns=history_columns(task, config.map.enabled),
        parent=parent,
    )
    with RunStore.create(folder, config.resolved_yaml(), meta, beginning, hook=hook) as store, in_run(meta.run_id):
        return work(config, store, on_generation, on_notice)
