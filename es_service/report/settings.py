"""The settings of a run that differ from the defaults of its task, its algorithm and its preset."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

from es_service.config.keys import KIND, search_fields
from es_service.config.loading import Known, read
from es_service.config.model import flat
from es_service.config.parts import TASK_OPTIONS
from es_service.config.resolution import LEFT_OPEN, options_of
from es_service.config.search import SearchConfig
from es_service.config.tasks import ROLLOUTS
from es_service.config.text import in_line
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
    known = Known({environment: task}, {algorithm: method}, ROLLOUTS)
    plain, followed = (read(least, overrides, known, new=False) for overrides in ({}, following))
    if plain.problems or followed.problems:
        return {}
    kinds = {key: value for key, value in values.items() if key.endswith(f".{KIND}")}  # a key of a part is one of its
    of_parts = plain.values.of({**plain.values.given, **kinds}).known()
    changed = {key: plain.values[key] for key in kinds if key in plain.values}
    first = {TASK_OPTIONS + name: default for name, default in defaults_of(task.options).items()}
    return of_parts | changed | {key: followed.values[key] for key in LEFT_OPEN} | first | {PRESET: "literature"}


def _plain(value: Any) -> Any:
    """A value with lists in place of tuples, as JSON has it."""
    return [_plain(item) for item in value] if isinstance(value, list | tuple) else value
