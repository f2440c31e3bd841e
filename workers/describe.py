"""Describe a task such as `brax:ant` or `package.module:Class`, in a separate process because this imports JAX, or code
of the user.

    python -m workers.describe DESCRIPTOR     # run by `es_service.protocol.child`
"""

from __future__ import annotations

import dataclasses
import json
import sys
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any

from es_service.protocol.child import answer_parent
from es_service.protocol.messages import TaskSpec
from es_service.protocol.options import OptionValue, option_values
from es_service.protocol.sources import SUITES
from workers.environments import TaskError, choices_of, describe_environment
from workers.host.repeats import does_not_repeat
from workers.rollouts import BACKENDS


def described(name: str, settings: Mapping[str, Any] = MappingProxyType({})) -> TaskSpec:
    """Description of a task that is no shipped one, with the reasons of the rollouts that cannot run it.

    Args:
        settings: see `describe_environment`.

    Raises:
        TaskError: the task does not exist or cannot be used.
    """
    task = describe_environment(name, settings)
    options = option_values(task.options, settings.get("options", {}))
    able = {name: backend for name, backend in BACKENDS.items() if task.kind in backend.task_kinds}
    examined = {name: backend.examine(task, options) for name, backend in able.items()}
    return dataclasses.replace(
        task,
        unsupported={name: found.unsupported for name, found in examined.items() if found.unsupported},
        hidden={name: found.hidden for name, found in examined.items() if found.hidden},
        notes=(*task.notes, *(note for found in examined.values() for note in found.notes)),
    )


def descriptions(name: str, settings: Mapping[str, Any]) -> Callable[[str], Any]:
    """Function that answers "task" with the fields of a TaskSpec as JSON, which needs no class of the user's, or
    {"problem": text}; and then "repeats" with where a task of Python objects was found not to repeat itself.

    Args:
        name, settings: see `describe_environment`.
    """
    task: TaskSpec | None = None

    def options() -> Mapping[str, OptionValue]:
        assert task is not None, "it has been described"
        return option_values(task.options, settings.get("options", {}))

    def answer(question: str) -> str:
        nonlocal task
        if question == "repeats":
            assert task is not None, "it has been described"
            return does_not_repeat(task, options(), choices_of(settings))
        try:
            task = described(name, settings)
            if task.kind == "jax" and name.partition(":")[0] not in ("brax", "mujoco", *SUITES):
                from workers.traces import require_pure

                require_pure(task, options())
            return json.dumps({"task": dataclasses.asdict(task)})
        except TaskError as error:
            return json.dumps({"problem": str(error)})

    return answer


if __name__ == "__main__":
    answer_parent(int(sys.argv[1]), descriptions)
