"""The Python interface: start, resume and fork runs, and evaluate policies of your own."""

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

from es_service.config.changes import refused_changes
from es_service.config.keys import Overrides
from es_service.config.loading import Source
from es_service.config.model import RunConfig
from es_service.config.tasks import task_of
from es_service.config.yaml_text import show
from es_service.errors import ConfigError, StoreError, WayOut
from es_service.logs import in_run
from es_service.loop.budget import REACHED, limits_of, raised
from es_service.loop.history import Column, evaluated_columns, history_columns
from es_service.protocol.messages import TaskSpec
from es_service.runs.checked_config import changed_config, changes_from, load_config
from es_service.runs.evaluator import evaluator as evaluator
from es_service.runs.identity import require_unchanged
from es_service.runs.lineage import fork_config, forked, started
from es_service.runs.session import OnGeneration, OnNotice, Outcome, work
from es_service.runs.standing import Standing, look
from es_service.runs.view import open_run
from es_service.store.beginning import Beginning
from es_service.store.folder import CONFIG, explained, holds_run, write_config
from es_service.store.schema import RunMeta
from es_service.store.writer import RunStore, no_hook

RUNS_FOLDER = Path("runs")
"""Default parent folder of runs, relative to the current folder."""


_KEPT_OF_A_TASK = ("observation_size", "action_size", "descriptor_names", "has_goal")
"""Fields of a task that the policies and the history of a run depend on."""


def _ignore(row: Mapping[str, Any]) -> None:
    """Do nothing; the default for `on_generation`."""


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
    """Start a run and continue it until its budget is spent.

    Args:
        config: a RunConfig, or what `load_config` accepts.
        out: folder of the run, new or empty, which is created with its parents; default
            runs/<environment>_<algorithm>_seed<seed>_<time>-<process>.
        on_generation: called with the history row of each generation after it is committed.
        on_notice: called with each notice for the user; by default, notices are RuntimeWarnings.
        hook: called with the name of each point of the store that is passed; for tests that kill the process there.

    Raises:
        ConfigError: the config is wrong. StoreError: the folder cannot be used. EvaluationError: the rollouts cannot
            continue. Interrupted: SIGINT or SIGTERM arrived. Committed generations are safe in every case.
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
    strict: bool = False,
    on_generation: OnGeneration = _ignore,
    on_notice: OnNotice = _warn,
    hook: Callable[[str], None] = no_hook,
) -> Outcome:
    """Continue a run from its last committed generation; its result has the same bits as without an interruption.

    Args:
        overrides: only budget, engine, workers and time limits may change; the run's `config.yaml` records the change.
        strict: whether to refuse to continue with other code, other packages or another kind of processor than those
            that computed the newest generation. If not, this is a notice, and the digest is marked `mixed`.

    Raises:
        ConfigError: a constant of the run would change (all are listed), or `strict` is set and something has changed.
            Otherwise as `run`.
    """

    def changed(store: RunStore) -> RunConfig:
        # The whole file, unlike `Run.present_config`: a constant that was edited there must be refused, not ignored.
        recorded = store.folder / CONFIG
        source = recorded if recorded.exists() else store.meta.config
        return changed_config(source, overrides)

    return _go_on(Path(folder), changed, on_generation, on_notice, hook, strict=strict)


def run_or_resume(
    config: RunConfig | Source,
    out: str | os.PathLike[str],
    *,
    on_generation: OnGeneration = _ignore,
    on_notice: OnNotice = _warn,
) -> Outcome:
    """Start a run, or resume it if the folder already holds it; the same call can be repeated after any interruption.

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
    *,
    strict: bool = False,
) -> Outcome:
    """Open a run, check that the config of this session fits it, and continue it."""
    with RunStore.open(folder, hook=hook) as store, in_run(store.meta.run_id):
        # Repairs remain even if the config is refused below, so they are reported now; `work` reports later notices.
        for notice in store.notices:
            on_notice(notice)
        store.notices.clear()
        config = make_config(store)
        if changes := changes_from(store.meta.constants, config):
            besides = _budget_of_a_fork(config, look(open_run(folder)))
            raise refused_changes(folder, changes, besides)
        task = task_of(config)
        if other := _other_task(store.meta.task, task):
            raise ConfigError(
                f"{folder}: the task {config.task.environment} has changed since the run was created ({other}), so the "
                "run's data do not fit it; undo the change, or start a new run",
                field="task.environment",
                value=config.task.environment,
                run=folder,
            )
        if (store.meta.columns, store.meta.evaluation_columns) != _columns(config, task):
            raise StoreError(
                f"{folder} was written by a version of es-service with other history columns; continue it with that "
                "version",
                run=folder,
                ways_out=[WayOut("fork", "continue from its state in a new run", str(folder))],
            )
        if strict:
            require_unchanged(store, config)
        try:
            write_config(folder, config.resolved_yaml())
        except OSError as error:
            raise explained(error, folder, f"writing {CONFIG}") from error
        return work(config, store, on_generation, on_notice, strict=strict)


def _budget_of_a_fork(config: RunConfig, standing: Standing) -> dict[str, Any]:
    """Budget settings that a fork needs besides the changed keys: the limits in `config` that differ from those of the
    run, and larger limits where they are already spent."""
    limits = limits_of(config.budget)
    wanted = {key: limits.get(key) for key in REACHED if limits.get(key) != standing.limits.get(key)}
    wanted |= raised(limits, standing.row) if standing.row else {}
    return {f"budget.{key}": value for key, value in wanted.items()}


def _other_task(recorded: Mapping[str, Any], task: TaskSpec) -> str:
    """Differences between the recorded task and the present one that the run's data depend on; empty if none."""
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
    """Start a new run from another run's state, with changed settings.

    The new run copies the history and continues the numbering of generations, so a fork without changes ends with the
    same bits as its parent. If a setting changes the meaning of an evaluation (the task, or how observations are
    normalised), all past fitness is discarded: the best centre, nsra_es's record and the map start again; the weight
    of fitness is kept. A fork may change between ns_es, nsr_es and nsra_es; its weight of fitness then starts again.
    me_es derives its blocks from the generation's number alone, so changes of `search.block_generations`, `mode`,
    `first_block` and `alternation` take effect at once, also in the middle of a block.

    Args:
        generation: one whose state the parent keeps: one of its last two, or of `store.keep_every`; None: the newest.

    Raises:
        ConfigError: the state does not fit a change (another task, descriptor, network, algorithm or map), or a key
            would have no effect. StoreError: the generation is not kept. Otherwise as `run`.
    """
    config = fork_config(parent, overrides)
    lineage, beginning = forked(open_run(parent), config, generation)
    outcome = _create_and_work(config, out, lineage, beginning, on_generation, on_notice, hook)
    if outcome.run.generation == (begun := lineage["generation"]):
        on_notice(
            f"no generation was run: {outcome.reason} already at generation {begun}, where this fork begins; resume it "
            "with a larger budget"
        )
    return outcome


def default_folder(config: RunConfig, which: str = "") -> Path:
    """A new folder under `runs/`, named after task, algorithm, `which` or the seed, time and process id, so that runs
    that start at the same time get different folders. Colons become underscores, because scp and others read HOST:PATH.
    """
    when = datetime.now().strftime("%Y%m%d-%H%M%S")
    kind = f"{config.task.environment}_{config.search.algorithm}".replace(":", "_")
    name = f"{kind}_{which or f'seed{config.seed}'}_{when}-{os.getpid()}"
    names = (name if number == 1 else f"{name}-{number}" for number in count(1))
    return next(RUNS_FOLDER / name for name in names if not (RUNS_FOLDER / name).exists())


def _columns(config: RunConfig, task: TaskSpec) -> tuple[tuple[Column, ...], tuple[Column, ...]]:
    """The columns of a run's history, and those of its evaluated centres."""
    return history_columns(task, config.map.enabled), evaluated_columns(task, config.map.enabled)


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
    columns, evaluation_columns = _columns(config, task)
    meta = RunMeta(
        run_id=uuid4().hex,
        created=datetime.now(UTC).isoformat(timespec="seconds"),
        config=config.model_dump(mode="json"),
        constants=config.constants(),
        task=asdict(task),
        columns=columns,
        evaluation_columns=evaluation_columns,
        parent=parent,
    )
    with RunStore.create(folder, config.resolved_yaml(), meta, beginning, hook=hook) as store, in_run(meta.run_id):
        return work(config, store, on_generation, on_notice)
