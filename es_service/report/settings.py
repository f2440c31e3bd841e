"""The settings of a run that differ from the defaults of its task, its algorithm and its preset."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

from es_service.config.fields import TASK_OPTIONS
from es_service.config.loading import load_config
from es_service.config.methods import search_fields
from es_service.config.model import flat
from es_service.config.options import options_of
from es_service.config.resolution import LEFT_OPEN
from es_service.config.search import SearchConfig
from es_service.config.tasks import ROLLOUTS
from es_service.config.yaml_text import in_line
from es_service.errors import ConfigError
from es_service.protocol.messages import UNBOUNDED, TaskSpec
from es_service.protocol.options import defaults_of
from es_service.search.algorithms import OURS
from es_service.search.algorithms.settings import UndeclaredSettings

SHOWN_ELSEWHERE = ("task.environment", "search.algorithm", "seed", "budget.", "compute.workers", "compute.engine")
"""Keys, or beginnings of keys, that a report shows in any case."""
PRESET = "search.preset"


class _Keys(NamedTuple):
    """A method of which only the keys are known."""

    settings: type[SearchConfig]


class Setting(NamedTuple):
    """A setting as text in YAML."""

    key: str
    value: str
    default: str
    """The default; empty if it is not known."""


def changed_settings(config: Mapping[str, Any], task: TaskSpec) -> list[Setting]:
    """Settings whose values differ from those that a config with only the task, the algorithm and the preset gets.

    A value that follows from others, such as `compute.chunk_pairs` from `search.pairs`, counts as its default. If the
    defaults cannot be found, because the config is of another version, all settings are returned.

    Args:
        config: resolved config of a run, as its store has it.
        task: the task as the run knows it, so that the task's package need not be installed.
    """
    values = flat(config)
    defaults = _defaults(config, values, task)
    return [
        Setting(key, in_line(value), in_line(defaults[key]) if key in defaults else "")
        for key, value in values.items()
        if not key.startswith(SHOWN_ELSEWHERE) and (key not in defaults or _plain(defaults[key]) != _plain(value))
    ]


def _defaults(config: Mapping[str, Any], values: Mapping[str, Any], task: TaskSpec) -> dict[str, Any]:
    environment, algorithm = values["task.environment"], values["search.algorithm"]
    least = {
        "task": {"environment": environment, "options": options_of(values)},
        "search": {"algorithm": algorithm, "preset": values.get(PRESET, "literature")},
        "budget": config["budget"],
    }
    if UNBOUNDED in task.descriptor_bounds and values.get("map.enabled"):
        least["map"] = {"bounds": values["map.bounds"]}  # which have no default
    method = OURS.get(algorithm, _Keys(UndeclaredSettings))  # a search of the user is not imported
    unknown = {key for key in values if key.startswith("search.") and ":" in algorithm} - search_fields(
        method.settings
    ).keys()
    following = {key: values[key] for key in values if key not in LEFT_OPEN and key not in unknown}
    try:
        known: dict[str, Any] = {"tasks": {environment: task}, "algorithms": {algorithm: method}, "rollouts": ROLLOUTS}
        plain, followed = (
            flat(load_config(source, overrides, **known, new=False).model_dump(mode="json"))
            for source, overrides in ((least, {}), (least, following))
        )
    except ConfigError:
        return {}
    first = {TASK_OPTIONS + name: default for name, default in defaults_of(task.options).items()}
    fields = search_fields(method.settings)  # a key of a part's kind that is not the default has a default of its own
    kinds = {key: fields[key].default for key in values.keys() & fields.keys() if not fields[key].is_required()}
    return kinds | plain | {key: followed[key] for key in LEFT_OPEN} | first | {PRESET: "literature"}


def _plain(value: Any) -> Any:
    """A value with lists in place of tuples, as JSON has it."""
    return [_plain(item) for item in value] if isinstance(value, list | tuple) else value
