"""Descriptions of tasks by name, for the driver.

Shipped tasks are in a table. All others are described by a child process, because this imports JAX and Brax, or code of
the user; a task is described again only if its code has changed.
"""

from __future__ import annotations

import dataclasses
import json
import re
import sys
from collections.abc import Iterator, Mapping
from functools import cache
from typing import Any

from es_service.config.caller import CALLER, caller_task
from es_service.config.model import RunConfig
from es_service.config.yaml_text import show
from es_service.errors import ConfigError
from es_service.protocol.messages import DescriptorChoice, TaskSpec, with_options
from es_service.protocol.options import Option, OptionValue, choice, option_values
from es_service.protocol.parameters import ParameterSpec
from es_service.protocol.parent import answer_of
from es_service.protocol.process_environment import require_no_import_of_a_task
from es_service.protocol.rollouts import Rollouts
from es_service.protocol.sources import task_code, user_sources
from workers import environments
from workers.rollouts import BACKENDS

DESCRIBE_S = 120.0
"""Longest wait for a description, in seconds; the first import of Brax from a slow disk can take long."""


class Tasks(Mapping[str, TaskSpec]):
    """Tasks by name. Iteration yields the shipped tasks; lookup also finds `brax:NAME`, `mujoco:ID`,
    `gymnasium:ID`, `module:Class`, `python:module:Class` and `function:module:name`."""

    def __getitem__(self, name: str) -> TaskSpec:
        """Raises KeyError for a plain name that is not shipped, ConfigError for another that cannot be described."""
        return self.chosen(name, {}, None)

    def chosen(self, name: str, options: Mapping[str, OptionValue], descriptor: DescriptorChoice | None) -> TaskSpec:
        """The task with options and a descriptor. Raises as a lookup.

        What is found by a trial (shapes, the rollouts that can run it, whether it repeats itself) holds for the
        options, so a task of which some are not the defaults is described twice.
        """
        if name == CALLER:
            return caller_task(options)
        if ":" not in name:
            return environments.SHIPPED[name]
        require_no_import_of_a_task()
        settings = environments.settings_of_description(name, options, descriptor)
        code = tuple(user_sources(*task_code(name, descriptor)).items())

        def described(settings: Mapping[str, Any]) -> TaskSpec:
            return _described(name, json.dumps(settings, sort_keys=True), code)

        task, values = described(settings), {}
        if "options" not in settings:
            values = option_values(task.options, options)
        others = {option: value for option, value in values.items() if value != task.options[option].default}
        return described({**settings, "options": others}) if others else task

    def __iter__(self) -> Iterator[str]:
        return iter(environments.SHIPPED)

    def __len__(self) -> int:
        return len(environments.SHIPPED)


TASKS = Tasks()
"""Tasks of the command line and the Python interface; the workers' own table has only the shipped tasks."""
ROLLOUTS: Rollouts = BACKENDS
"""Rollouts that `compute.rollout` may name."""


def task_of(config: RunConfig) -> TaskSpec:
    """The task of a run, with the descriptor that its options choose.

    Raises ConfigError if the task has changed since its values were filled into the config, such as its episode length:
    the run would have some values of the old task and some of the new one.
    """
    settings, before = config.task, config.resolved_with
    task = TASKS.chosen(settings.environment, settings.options, settings.descriptor)
    changes = [] if before is None else _changes(before, task)
    if changes:
        raise ConfigError(
            f"the task {task.name} has changed since this config was loaded ({', '.join(changes)}); load the config "
            "again",
            field="task.environment",
            value=task.name,
        )
    return with_options(task, config.task.options)


def _changes(before: TaskSpec, now: TaskSpec) -> list[str]:
    """Differences between two descriptions of a task, apart from the line that is only shown."""
    values = [
        (field.name, getattr(before, field.name), getattr(now, field.name)) for field in dataclasses.fields(TaskSpec)
    ]
    return [f"{name}: {show(old)} -> {show(new)}" for name, old, new in values if name != "summary" and old != new]


@cache
def _described(name: str, settings: str, code: tuple[tuple[str, str], ...]) -> TaskSpec:
    """Description of a task whose code has these hashes.

    Args:
        settings: what a config chooses for it, as JSON.
    """
    told = answer_of([sys.executable, "-m", "workers.describe", name, settings], DESCRIBE_S)
    if told.content is None:
        if told.code is None:
            raise ConfigError(f"{name} could not be imported and described within {DESCRIBE_S:g} s")
        raise ConfigError(f"{name} could not be imported or described:\n{told.errors}")
    answer = json.loads(told.content)
    if "problem" in answer:
        problem = answer["problem"]
        named = re.match(r"(task\.(?:descriptor|options\.\w+)) = ", problem)
        raise ConfigError(problem, field=named and named[1])
    return task_from_fields(answer["task"])


def task_from_fields(fields: Mapping[str, Any]) -> TaskSpec:
    """A TaskSpec from its fields as JSON has them, also those that a run stores, with tuples in place of lists.

    Fields that only older versions had are left out.
    """
    known = {field.name for field in dataclasses.fields(TaskSpec)}

    def bounds(pairs: list) -> tuple[tuple[float, float], ...]:
        return tuple((float(low), float(high)) for low, high in pairs)

    def option(stored: Mapping[str, Any] | list) -> Option:
        if isinstance(stored, list):  # as versions up to 0.11 stored the allowed values
            return choice(*stored)
        return Option(**{**stored, "choices": tuple(stored["choices"])})

    return TaskSpec(
        **{name: value for name, value in fields.items() if name in known}
        | {
            "descriptor_names": tuple(fields["descriptor_names"]),
            "descriptor_bounds": bounds(fields["descriptor_bounds"]),
            "action_bounds": bounds(fields.get("action_bounds", ())),
            "walls": None if fields.get("walls") is None else tuple(bounds(wall) for wall in fields["walls"]),
            "notes": tuple(fields.get("notes", ())),
            "goal": None if fields.get("goal") is None else tuple(fields["goal"]),
            "parameters": None
            if fields.get("parameters") is None
            else ParameterSpec.from_fields(*fields["parameters"]),
            "options": {name: option(stored) for name, stored in fields.get("options", {}).items()},
            "descriptors": {
                name: (tuple(names), bounds(pairs)) for name, (names, pairs) in fields.get("descriptors", {}).items()
            },
        }
    )
