"""Configs checked against all known tasks and searches, including those of the user.

A config that its search refuses fails here, before a folder is created or a worker is started.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from es_service.config import changes
from es_service.config.changes import changed_constants
from es_service.config.given import Overrides, Source
from es_service.config.keys import search_fields
from es_service.config.loading import Known, read
from es_service.config.model import RunConfig
from es_service.config.parts import TASK_OPTIONS
from es_service.config.tasks import ROLLOUTS, TASKS, task_of
from es_service.protocol.options import defaults_of
from es_service.search.algorithms import ALGORITHMS

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
