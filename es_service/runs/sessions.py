"""The sessions of a run: it is created, or opened, checked and continued, until its budget is spent."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any
from uuid import uuid4

from es_service.config.changes import again_with
from es_service.config.model import RunConfig
from es_service.config.tasks import require_same_task, task_of
from es_service.config.workload import require_episodes
from es_service.dispatch import dispatch_log
from es_service.errors import StartError, WayOut
from es_service.logs import in_run
from es_service.protocol.evaluator import Session
from es_service.protocol.process_environment import require_no_import_of_a_task
from es_service.runs import targets
from es_service.runs.certified import target_reached
from es_service.runs.checked_config import accepted, columns, require_resumable
from es_service.runs.session import OnGeneration, OnNotice, Outcome, work
from es_service.runs.view import open_run
from es_service.runs.waiting import telling_once, when_free
from es_service.runs.worker_count import require_cores
from es_service.store.beginning import Beginning
from es_service.store.create import remove_run_folder
from es_service.store.folder import CONFIG, explained, write_config
from es_service.store.schema import RunMeta
from es_service.store.writer import RunStore, no_hook


@dataclass(frozen=True)
class Listener:
    """Functions that a session calls; `api.run` describes them."""

    shown: Callable[[Path], AbstractContextManager[OnGeneration]]
    """Function from a run's folder to a context manager with what is called with each history row."""
    on_notice: OnNotice
    on_compile: OnNotice
    on_output: OnNotice
    hook: Callable[[str], None] = no_hook
    asks_caller: bool = False
    """Whether the caller computes the episodes, to whom the sessions yield their work."""


def create_run(
    config: RunConfig,
    folder: Path,
    parent: dict[str, Any] | None,
    beginning: Beginning,
    again: WayOut,
    listener: Listener,
) -> Session[Outcome]:
    """Create a run and work on it; yields as `session.work`. If no worker can be started, there is no run afterwards.

    Args:
        again: the call that was made, which ways out repeat with other settings.
    """
    require_no_import_of_a_task()
    require_cores(config, again)
    require_same_task(config)
    is_new, task = not folder.exists(), task_of(accepted(config))
    require_episodes(task, asks_caller=listener.asks_caller)
    history, evaluations = columns(config, task)
    meta = RunMeta(
        run_id=uuid4().hex,
        created=datetime.now(UTC).isoformat(timespec="seconds"),
        config=config.model_dump(mode="json"),
        given=dict(config.made.given),
        constants=config.constants(),
        task=asdict(task),
        columns=history,
        evaluation_columns=evaluations,
        parent=parent,
    )
    with (
        RunStore.create(folder, config.resolved_yaml(), meta, beginning, hook=listener.hook) as store,
        in_run(meta.run_id),
        listener.shown(folder) as on_generation,
    ):
        begun = store.generation
        try:
            until = targets.until_due(on_generation, targets.due(folder, config))
            told = listener.on_notice, listener.on_compile, listener.on_output
            outcome = yield from work(config, store, until, *told, asks_caller=listener.asks_caller)
        except StartError as error:
            if store.generation != begun:
                raise  # of something else that the caller started in a callback: this run has computed generations
            store.close()
            (folder / dispatch_log.FILE).unlink(missing_ok=True)
            remove_run_folder(folder, whole=is_new)
            error.run = None
            error.ways_out = tuple(
                again_with(again, way.purpose, way.settings) if way.action == "resume" else way
                for way in error.ways_out
                if way.action != "resume" or way.settings
            )
            raise
    return (yield from _to_target(config, outcome, listener))


def continue_run(
    folder: Path,
    make_config: Callable[[RunStore], RunConfig],
    listener: Listener,
    asked: Mapping[str, Any] = MappingProxyType({}),
    *,
    strict: bool = False,
) -> Session[Outcome]:
    """Continue a run, in as many sessions as `budget.target_certified` makes of it; yields as `session.work`.

    Args:
        asked: settings of the call, which ways out repeat.
    """
    config, outcome = yield from _session(folder, make_config, listener, asked, strict=strict)
    return (yield from _to_target(config, outcome, listener, strict=strict))


def outcome_of(session: Session[Outcome]) -> Outcome:
    """What a session returns, for which an engine computes."""
    try:
        next(session)
    except StopIteration as end:
        return end.value
    raise AssertionError("a session with an engine has asked its caller")


def _to_target(config: RunConfig, outcome: Outcome, listener: Listener, *, strict: bool = False) -> Session[Outcome]:
    """Certify the best centre whenever a session has ended for that, and continue: if it reaches the target, no longer
    than until the next session has opened the run."""
    while outcome.reason == targets.TO_CERTIFY:
        targets.certify_best(outcome.run.folder, config, listener.on_notice, listener.on_output)
        _, outcome = yield from _session(outcome.run.folder, lambda store: config, listener, strict=strict)
    return outcome


def _session(
    folder: Path,
    make_config: Callable[[RunStore], RunConfig],
    listener: Listener,
    asked: Mapping[str, Any] = MappingProxyType({}),
    *,
    strict: bool = False,
) -> Session[tuple[RunConfig, Outcome]]:
    """Open a run, check that the config of this session fits it, and work on it."""
    opened = when_free(partial(RunStore.open, folder, hook=listener.hook), telling_once(folder, listener.on_notice))
    with opened as store, in_run(store.meta.run_id):
        # Repairs remain even if the config is refused below, so they are reported now; `work` reports later notices.
        for notice in store.notices:
            listener.on_notice(notice)
        store.notices.clear()
        config = make_config(store)
        require_same_task(config)
        require_episodes(task_of(config), asks_caller=listener.asks_caller)
        require_resumable(store, config, asked, strict=strict)
        try:
            write_config(folder, config.resolved_yaml())
        except OSError as error:
            raise explained(error, folder, f"writing {CONFIG}") from error
        if reason := target_reached(folder, config.budget.target_certified, config.task.fitness):
            return config, Outcome(open_run(folder), reason, is_finished=True)
        if (is_due := targets.due(folder, config))(store.last_history()):
            return config, Outcome(open_run(folder), targets.TO_CERTIFY, is_finished=False)
        with listener.shown(folder) as on_generation:
            until = targets.until_due(on_generation, is_due)
            told = listener.on_notice, listener.on_compile, listener.on_output
            outcome = yield from work(config, store, until, *told, strict=strict, asks_caller=listener.asks_caller)
            return config, outcome
