"""What computes a run, its platform and its code: recorded with the generations, compared when the run continues."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from es_service.config.model import RunConfig
from es_service.dispatch.engine import Engine
from es_service.errors import ConfigError, WayOut
from es_service.loop.state import Generation
from es_service.protocol.machine import CODE, computed_on, is_mixed, platform_info, without_code
from es_service.protocol.sources import Sources, driver_sources, in_words, other_files, worker_sources
from es_service.store.writer import RunStore

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
