"""The settings of a run that differ from the defaults of its task, its algorithm and its preset."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

from es_service.config.keys import search_fields
from es_service.config.loading import Known, read
from es_service.config.model import flat, nested
from es_service.config.search import SearchConfig
from es_service.config.tasks import ROLLOUTS
from es_service.config.text import in_line
from es_service.protocol.messages import TaskSpec
from es_service.search.algorithms import OURS
from es_service.search.algorithms.settings import UndeclaredSettings

SHOWN_ELSEWHERE = ("task.environment", "search.algorithm", "seed", "budget.", "compute.workers", "compute.engine")
"""Keys, or beginnings of keys, that a report shows in any case."""
_NONE = object()
"""No default."""


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
    """Settings that would have another value if the config did not give them.

    A value that follows from others, such as `compute.chunk_pairs` from `search.pairs`, is its default. If the defaults
    cannot be found, because the config is of another version, all settings are returned.

    Args:
        config: resolved config of a run, as its store has it.
        task: the task as the run knows it, so that the task's package need not be installed.
    """
    values = flat(config)
    shown = {key: value for key, value in values.items() if not key.startswith(SHOWN_ELSEWHERE)}
    environment, algorithm = values["task.environment"], values["search.algorithm"]
    method = OURS.get(algorithm, _Keys(UndeclaredSettings))  # a search of the user is not imported
    is_unknown = {key: key.startswith("search.") and key not in search_fields(method.settings) for key in shown}
    known = {key: value for key, value in values.items() if ":" not in algorithm or not is_unknown.get(key)}
    reading = read(nested(known), {}, Known({environment: task}, {algorithm: method}, ROLLOUTS), new=False)
    changed = []
    for key, value in shown.items():
        others = {name: other for name, other in reading.values.given.items() if name != key}
        default = _NONE if reading.problems else reading.values.of(others).get(key, _NONE)
        if default is _NONE:
            changed.append(Setting(key, in_line(value), ""))
        elif _plain(default) != _plain(value) and not (key == "map.bounds" and default is None):  # which have none
            changed.append(Setting(key, in_line(value), in_line(default)))
    return changed


def _plain(value: Any) -> Any:
    """A value with lists in place of tuples, as JSON has it."""
    return [_plain(item) for item in value] if isinstance(value, list | tuple) else value
