"""Whether a task repeats itself: equal seeds and actions have equal results, bit for bit, wherever it runs."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from es_service.config.model import RunConfig
from es_service.config.tasks import task_of
from es_service.protocol.child import NoAnswerError, answer_of
from es_service.protocol.raised import RaisedError
from es_service.runs.view import Run
from workers.environments import settings_of_description

ALONE = "alone"
"""Name of the first episode among the hashes of `workers.host.examine`."""
LONGEST_S = 600.0
"""Longest time of each of the two processes; functions may take long."""


def examined(name: str, settings: Mapping[str, Any], seconds: float) -> dict[str, Any]:
    """What `workers.host.examine` finds of a task of Python objects or a function in a process of its own.

    Args:
        settings: see `settings_of_description`.
        seconds: duration of its measurement.
    """
    try:
        return answer_of("workers.host.examine", name, settings, request=(seconds,), limit_s=LONGEST_S)
    except RaisedError as error:
        return {"problem": error.message}
    except NoAnswerError as error:
        return {"problem": f"it could not be examined: its process {error}", "is_lost": True}


def compared(first: Mapping[str, Any], second: Mapping[str, Any]) -> tuple[list[str], list[str]]:
    """(where a task was tried again, where it has not repeated itself) by two results of `examined`."""
    same = {**first["hashes"], "in another process": second["hashes"][ALONE]}
    tried = [where for where in same if where != ALONE]
    return tried, [where for where in tried if same[where] != same[ALONE]]


def why_not_repeatable(run: Run, config: RunConfig) -> str:
    """Where the task of a run does not repeat itself, in words: as the run has recorded, or else as examined now.

    Empty if it repeats itself, as far as can be found, and for tasks in JAX.
    """
    return run.meta.task.get("does_not_repeat") or why_task_does_not_repeat(config)


def why_task_does_not_repeat(config: RunConfig) -> str:
    """As `why_not_repeatable`, for the task of a config as it is examined now."""
    task = task_of(config)
    if task.kind not in ("python", "function"):
        return ""
    options = config.task.options
    settings = settings_of_description(config.task.environment, options, config.task.choices) | {"options": options}
    answers = [examined(config.task.environment, settings, 0.0) for _ in range(2)]
    if any("problem" in answer for answer in answers):
        return ""
    return " and ".join(compared(*answers)[1])
