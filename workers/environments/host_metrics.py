"""Metrics that a config chooses for a task of Python objects: keys of its `info`, by `task.metrics`."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from es_service.protocol.episodes import METRIC_FORM, TAKEN, wrong_metric_names
from es_service.protocol.messages import HostChoices
from workers.environments import TaskError
from workers.environments.host_task import HostEpisode, HostTask

_OF_VALUES: Mapping[str, Callable[[Any], Any]] = {
    "last": lambda values: values[-1],
    "sum": np.sum,
    "mean": np.mean,
    "min": np.min,
    "max": np.max,
}
assert (*_OF_VALUES,) == TAKEN


def with_metrics(task: HostTask, choices: HostChoices) -> HostTask:
    """The task with the metrics that a config chooses, after its own.

    Raises:
        TaskError: two metrics have one name.
    """
    if not choices.metrics:
        return task
    chosen = [(key, taken or "last") for key, _, taken in (text.partition(":") for text in choices.metrics)]
    names = (*task.metric_names, *(key for key, _ in chosen))
    if wrong := wrong_metric_names(names):
        raise TaskError(
            f"task.metrics = {list(choices.metrics)}: metrics of {task.name} would be named {', '.join(wrong)}; each "
            f"name must be different and of {METRIC_FORM}"
        )

    def metrics(episode: HostEpisode) -> list[Any]:
        values = ((episode.counted.get(key), taken) for key, taken in chosen)
        return [*task.metrics(episode), *(_OF_VALUES[taken](of_key) if of_key else np.nan for of_key, taken in values)]

    return replace(task, metric_names=names, metrics=metrics, counted=tuple(key for key, _ in chosen))


def missing_metrics(task: HostTask, told: Collection[str]) -> tuple[str, ...]:
    """What the author of a config should know of its metrics, in sentences.

    Args:
        told: keys of the `info` of the first steps.
    """
    has = ", ".join(map(str, sorted(told, key=str))) or "no keys"
    return tuple(
        f"task.metrics: the info of the first steps has {has}; in an episode without {key}, this metric has no value"
        for key in task.counted
        if key not in told
    )
