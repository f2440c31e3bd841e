"""Options in a config: their values, below `task.options`, against what the task declares."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from es_service.config.fields import TASK_OPTIONS
from es_service.config.problems import nearest, one_of, problem_of, wrong_value
from es_service.config.yaml_text import in_line, show
from es_service.errors import Problem
from es_service.protocol.messages import TaskSpec
from es_service.protocol.options import Option, OptionValue, allowed_text, allowed_value, defaults_of, is_plain


def settings_of_task(values: Mapping[str, Any], wanted: Mapping[str, Any]) -> dict[str, Any]:
    """What a config chooses for its task besides its name, as arguments of `Tasks.chosen`.

    Values of types that no task takes are left out; they are reported elsewhere.

    Args:
        values: those of the file.
        wanted: those of overrides. If they choose another task, what the file says of its own is left out.
    """
    name = "task.environment"
    chosen = dict(wanted) if name in wanted and wanted[name] != values.get(name) else {**values, **wanted}
    descriptor = chosen.get("task.descriptor")
    if isinstance(descriptor, list):
        descriptor = tuple(descriptor)
    is_chosen = descriptor and (isinstance(descriptor, str) or all(type(index) is int for index in descriptor))
    options = {key: value for key, value in options_of(chosen).items() if is_plain(value)}
    return {"options": options, "descriptor": descriptor if is_chosen else None}


def options_of(values: Mapping[str, Any]) -> dict[str, Any]:
    """The options of the task among flat values: name -> value."""
    return {key.removeprefix(TASK_OPTIONS): value for key, value in values.items() if key.startswith(TASK_OPTIONS)}


def read_options(values: Mapping[str, Any], task: TaskSpec) -> tuple[dict[str, OptionValue], list[Problem]]:
    """Value of every option that a task declares by its key, and the problems of the given values."""
    declared = task.options
    options = {f"{TASK_OPTIONS}{name}": default for name, default in defaults_of(declared).items()}
    problems = []
    for name, value in options_of(values).items():
        key = f"{TASK_OPTIONS}{name}"
        if name not in declared:
            known = f"{task.name} has {one_of(declared) if declared else 'none'}"
            meant = nearest(name, declared)
            hint = f"; did you mean {meant}?" if meant else ""
            problems.append(problem_of(key, value, f"unknown option; {known}{hint}", suggestion=meant))
        elif (read := _read(declared[name], value)) is None:
            problems.append(wrong_value(key, value, allowed_text(declared[name], show), declared[name].choices))
        else:
            options[key] = read
    return options, problems


def _read(option: Option, value: Any) -> OptionValue | None:
    """A value of a config as a value of the option; None if it is not allowed."""
    if isinstance(option.default, str) and option.choices and type(value) in (bool, int, float):
        value = in_line(value)  # YAML reads a choice such as 10 as a number
    return allowed_value(option, value)
