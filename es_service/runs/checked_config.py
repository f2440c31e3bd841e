"""Configs checked against all known tasks and searches, including those of the user, and against a run that is to go on
with them: cores of this machine, constants of the run, its task, the columns of its tables, and if asked for its code.

A config that its search refuses fails here, before a folder is created or a worker is started.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from typing import Any

from es_service.config import changes
from es_service.config.changes import changed_constants, refused_changes
from es_service.config.given import Overrides, Source
from es_service.config.keys import search_fields
from es_service.config.loading import Known, read
from es_service.config.model import RunConfig
from es_service.config.parts import TASK_OPTIONS
from es_service.config.tasks import CALLER, ROLLOUTS, TASKS, task_of
from es_service.config.text import show
from es_service.dispatch.engine import Engine
from es_service.errors import ConfigError, StoreError, WayOut
from es_service.loop.budget import REACHED, limits_of, raised
from es_service.loop.history import LATER, Column, evaluated_columns, history_columns
from es_service.loop.state import Generation
from es_service.protocol.episodes import METRIC_FORM, wrong_metric_names
from es_service.protocol.machine import CODE, computed_on, is_mixed, platform_info, without_code
from es_service.protocol.messages import TaskSpec
from es_service.protocol.options import defaults_of
from es_service.protocol.sources import Sources, driver_sources, in_words, other_files, worker_sources
from es_service.runs.run_status import RunStatus, read_status
from es_service.runs.view import open_run
from es_service.runs.worker_count import require_cores
from es_service.search.algorithms import ALGORITHMS
from es_service.store.folder import CONFIG
from es_service.store.schema import RunMeta
from es_service.store.writer import RunStore

KNOWN = Known(TASKS, ALGORITHMS, ROLLOUTS)
"""All tasks, searches and rollouts that a config may name."""


def load_config(
    source: Source, overrides: Overrides = (), *, new: bool = True, searches: bool = True, name: str = "config"
) -> RunConfig:
    """Read a YAML file (or a mapping like one), apply overrides such as "search.sigma=0.05", resolve and check it all.

    Args:
        new: whether a run is about to start with it on this machine; the folder of `search.init_from` must then exist.
        searches: whether a search uses it; if none does, `search.algorithm` and the budget may be left out.
        name: what an error calls a `source` that is no file.

    Raises:
        ConfigError: lists every problem found.
    """
    return accepted(read(source, overrides, KNOWN, new=new, searches=searches, name=name).config())


def changed_config(
    source: Source, overrides: Overrides = (), *, given: Mapping[str, Any] | None = None, name: str = "config"
) -> RunConfig:
    """The config of a run that exists, with some keys changed; see `changes.changed_config`.

    Raises:
        ConfigError: lists every problem found.
    """
    return accepted(changes.changed_config(source, overrides, KNOWN, given=given, name=name))


def changes_from(constants: Mapping[str, Any], config: RunConfig) -> list[tuple[str, Any, Any]]:
    """What a config would change of the constants of a run, as `changed_constants` returns it."""
    fields = search_fields(type(config.search))
    defaults = {key: field.default for key, field in fields.items() if not field.is_required()}
    options = {TASK_OPTIONS + name: default for name, default in defaults_of(task_of(config).options).items()}
    return changed_constants(constants, config.constants(), defaults | options)


def accepted(config: RunConfig) -> RunConfig:
    """Return the config if its search accepts it; otherwise raise the ConfigError of the search."""
    ALGORITHMS[config.search.algorithm](config)
    return config


KEPT_OF_A_TASK = ("observation_size", "action_size", "descriptor_names", "has_goal", "metric_names")
"""Fields of a task that the policies and the history of a run depend on."""


def require_resumable(store: RunStore, config: RunConfig, asked: Mapping[str, Any], *, strict: bool) -> None:
    """Raise an error if a run cannot be continued with a config on this machine.

    Args:
        asked: settings of the call, which ways out repeat.
        strict: whether to refuse other code, other packages and another kind of processor, too.

    Raises:
        ConfigError: a constant of the run would change (all are listed), the task has changed, the workers are too many
            for the cores of this machine, or `strict` is set and something has changed. StoreError: the run has other
            columns than this version writes.
    """
    folder = store.folder
    require_cores(config, WayOut("resume", "", str(folder), asked))
    if changes := changes_from(store.meta.constants, config):
        refusal = refused_changes(folder, changes, ALGORITHMS, _budget_of_a_fork(config, read_status(open_run(folder))))
        if config.task.environment == CALLER:
            refusal.ways_out = (WayOut("ask_tell", "begin another run with these settings", "ANOTHER_FOLDER"),)
        elif store.generation is None:
            purpose = (
                "begin another run with these settings, since this one has no generation that a fork could continue"
            )
            refusal.ways_out = (WayOut("run", purpose, settings=asked, config=str(folder / CONFIG)),)
        raise refusal
    task = task_of(config)
    if other := _other_task(store.meta.task, task):
        raise ConfigError(
            f"{folder}: the task {config.task.environment} has changed since the run was created ({other}), so the "
            "run's data do not fit it; undo the change, or start a new run",
            field="task.environment",
            value=config.task.environment,
            run=folder,
        )
    if not _fits(store.meta, *columns(config, task)):
        raise StoreError(
            f"{folder} was written by a version of es-service with other history columns; continue it with that "
            "version",
            run=folder,
            ways_out=[WayOut("fork", "continue from its state in a new run", str(folder))],
        )
    if strict:
        require_unchanged(store, config)


def columns(config: RunConfig, task: TaskSpec) -> tuple[tuple[Column, ...], tuple[Column, ...]]:
    """The columns of a run's history, and those of its evaluated centres."""
    has_map, corrects = config.map.enabled, config.map.correct_every is not None
    metrics = sorted(ALGORITHMS[config.search.algorithm](config).metrics)
    if wrong := wrong_metric_names(metrics) or wrong_metric_names([*task.metric_names, *metrics]):
        raise ConfigError(
            f"search.algorithm: {config.search.algorithm} has a metric {wrong[-1]}; its name must be of {METRIC_FORM}, "
            "and no other metric of the search or of the task may have it",
            field="search.algorithm",
            value=wrong[-1],
        )
    history = history_columns(task, has_map, corrects, config.search.allow_infeasible, metrics)
    return history, evaluated_columns(task, has_map)


def _budget_of_a_fork(config: RunConfig, status: RunStatus) -> dict[str, Any]:
    """Budget settings that a fork needs besides the changed keys: the limits in `config` that differ from those of the
    run, and larger limits where they are already spent."""
    limits = limits_of(config.budget)
    wanted = {key: limits.get(key) for key in REACHED if limits.get(key) != status.limits.get(key)}
    wanted |= raised(limits, status.row) if status.row else {}
    return {f"budget.{key}": value for key, value in wanted.items()}


def _other_task(recorded: Mapping[str, Any], task: TaskSpec) -> str:
    """Differences between the recorded task and the present one that the run's data depend on; empty if none."""
    lists = {name: list(getattr(task, name)) for name in ("descriptor_names", "metric_names")}
    present, before = asdict(task) | lists, {"metric_names": [], **recorded}  # which older versions did not record
    values = [(name, before[name], present[name]) for name in KEPT_OF_A_TASK]
    return ", ".join(f"{name}: {show(old)} -> {show(new)}" for name, old, new in values if old != new)


def _fits(meta: RunMeta, history: tuple[Column, ...], evaluations: tuple[Column, ...]) -> bool:
    """Whether this version can continue the tables of a run, whose history may lack columns of LATER."""
    expected = tuple(column for column in history if column in meta.columns or column.name not in LATER)
    return meta.columns == expected and meta.evaluation_columns == evaluations


# What computes a run, its platform and its code: recorded with the generations, compared when the run continues.

MIXED = "Its digest is now marked `mixed`."


def code_of(config: RunConfig) -> Sources:
    """Hashes of all code that computes a run, that of the driver and that of its workers."""
    return worker_sources(*config.task.code) | driver_sources(config.search.algorithm)


def platform_changes(before: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    """Differences between two recorded platforms in words, without those of the code: "jax 0.10.1 -> 0.10.2"."""
    old, new = without_code(before), without_code(now)
    return [
        f"{name} {old.get(name, 'none')} -> {new.get(name, 'none')}"
        for name in {**old, **new}
        if old.get(name) != new.get(name)
    ]


def code_changes(before: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    """Files of the code that differ between two recorded platforms; empty if one of them has no record of its code."""
    return other_files(before[CODE], now[CODE]) if CODE in before and CODE in now else []


def changes_since(then: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    """What has changed since generations were computed, in words; for workers on other platforms than their driver, of
    each of them.

    Args:
        then: the recorded platform.
        now: `platform_info` and `code_of` of this process.
    """
    *workers, driver_then = [*then.get("workers", ()), {**then, "workers": None}]
    changes = platform_changes(driver_then, {**now, "workers": None})
    changes += [f"worker's {change}" for worker in workers for change in platform_changes(worker, now)]
    if CODE not in then:
        return [*changes, "the code of that time was not recorded"]
    return changes + [f"other code in {file}" for file in code_changes(then, now)]


def tell_of_other_code(store: RunStore, code: Sources, on_notice: Callable[[str], None]) -> None:
    """Give a notice if the run continues with other code than that of its newest generation."""
    before, generation = _newest(store)
    if before is not None and (files := code_changes(before, {CODE: code})):
        on_notice(
            f"from generation {generation} on, this run is computed with other code: {in_words(files)} changed. {MIXED}"
        )


def require_unchanged(store: RunStore, config: RunConfig) -> None:
    """Raise ConfigError if this driver is not on the platform of the run's newest generation, or has other code.

    Code that an older version did not record counts as other code.
    """
    before, _ = _newest(store)
    if before is None:
        return
    now = {**platform_info(), CODE: code_of(config)}
    changes = platform_changes({**before, "workers": None}, {**now, "workers": None}) + code_changes(before, now)
    if changes or CODE not in before:
        raise _refusal(store, in_words(changes) or "an older version, which did not record its code, computed the run")


def _newest(store: RunStore) -> tuple[dict[str, Any] | None, int]:
    """The platform of the newest generation, and the number of the generation after it."""
    generation = 0 if store.generation is None else store.generation + 1
    return store.platform_before(generation), generation


def _refusal(store: RunStore, changes: str) -> ConfigError:
    folder = str(store.folder)
    return ConfigError(
        f"{folder}: strict was asked for, but not everything is as it was when the run was computed: {changes}",
        field="strict",
        value=True,
        run=folder,
        ways_out=[WayOut("resume", "continue nevertheless, with a digest marked `mixed`", folder)],
    )


class Recorder:
    """Commits the generations of a run, and records before that what has computed them."""

    def __init__(
        self,
        store: RunStore,
        engine: Engine[Any] | None,
        platform: Mapping[str, Any],
        code: Sources,
        on_notice: Callable[[str], None],
        *,
        strict: bool,
    ) -> None:
        """Record in a store.

        Args:
            engine: the engine, which knows the platforms of its workers; None: the caller computes the episodes.
            platform: `platform_info` of this driver.
            code: `code_of` the run.
            strict: whether workers on another platform are an error instead of a notice.
        """
        self._store, self._engine, self._on_notice, self._strict = store, engine, on_notice, strict
        self._driver, self._code = platform, dict(code)
        self._workers: frozenset[str] | None = None

    def workers(self) -> frozenset[str]:
        """Platforms of the workers that there are now."""
        return frozenset() if self._engine is None else self._engine.platforms

    def commit(self, workers: frozenset[str], generations: Sequence[Generation]) -> None:
        """Record the platform if it has changed, with a notice if the run becomes mixed by that; then commit.

        Args:
            workers: `workers` when the generations were finished.

        Raises:
            ConfigError: the run would become mixed, but `strict` is set. Otherwise as `RunStore.commit`.
        """
        if workers != self._workers:
            generation = generations[0].number
            platform = {**computed_on(self._driver, workers), CODE: self._code}
            before = self._store.platform_before(generation)
            if before is None:
                changes = ["workers of several kinds"] if is_mixed([platform]) else []
            else:
                changes = platform_changes(before, platform)
            if changes and self._strict:
                raise _refusal(self._store, in_words(changes))
            self._store.record_platform(generation, platform)
            self._workers = workers
            if changes:
                self._on_notice(
                    f"from generation {generation} on, this run is computed on another platform, or on several: "
                    f"{in_words(changes)}. {MIXED}"
                )
        self._store.commit(generations)
