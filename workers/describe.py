"""Describe a task such as `brax:ant` or `package.module:Class`, in a separate process because this imports JAX, or code
of the user.

    python -m workers.describe NAME SETTINGS ANSWER

SETTINGS is JSON, what `describe_environment` of `workers.environments` takes.
Writes JSON to the file ANSWER: {"task": fields of a TaskSpec} or {"problem": text}.
"""

from __future__ import annotations

import dataclasses
import json
import sys
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

from es_service.protocol.messages import TaskSpec
from es_service.protocol.options import option_values
from es_service.protocol.parent import end_soon, write_answer
from es_service.protocol.sources import SUITES
from workers.environments import TaskError, choices_of, describe_environment
from workers.host.repeats import tried_apart
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


def main(name: str, settings: str, file: str) -> None:
    """Write the description of a task, or the problem with it, as JSON to a file."""
    try:
        given = json.loads(settings)
        task = described(name, given)
        if task.kind == "python":
            options = option_values(task.options, given.get("options", {}))
            task = dataclasses.replace(task, does_not_repeat=tried_apart(task, options, choices_of(given)))
        elif task.kind == "jax" and name.partition(":")[0] not in ("brax", "mujoco", *SUITES):
            from workers.traces import require_pure

            require_pure(task, option_values(task.options, given.get("options", {})))
        answer = {"task": dataclasses.asdict(task)}
    except TaskError as error:
        answer = {"problem": str(error)}
    write_answer(file, json.dumps(answer).encode())


if __name__ == "__main__":
    main(*sys.argv[1:])
    end_soon()
