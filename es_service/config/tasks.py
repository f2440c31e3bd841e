"""Descriptions of tasks by name, for the driver.

Shipped tasks are in a table. All others are described by a child process, because this imports JAX and Brax, or code of
the user; a task is described again only if its code has changed. What libraries define is remembered on disk, since to
describe MuJoCo's robots takes a quarter of a minute.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import cache
from typing import Any, TypeGuard

from pydantic import TypeAdapter

from es_service.config.model import RunConfig
from es_service.config.parts import LARGEST, TASK_OPTIONS, as_tuple
from es_service.config.resolution import options_of
from es_service.config.text import in_line, nearest, one_of, problem_of, show, wrong_value
from es_service.errors import ConfigError, Problem
from es_service.protocol.child import END_S, Child, NoAnswerError
from es_service.protocol.episodes import CHOSEN_METRIC
from es_service.protocol.machine import platform_info
from es_service.protocol.messages import NO_CHOICES, UNBOUNDED, HostChoices, TaskSpec, with_options
from es_service.protocol.options import (
    FREE,
    Option,
    OptionValue,
    ParameterSpec,
    allowed_text,
    allowed_value,
    defaults_of,
    is_plain,
    option_values,
)
from es_service.protocol.process_environment import child_environment, require_no_import_of_a_task
from es_service.protocol.rollouts import Rollouts
from es_service.protocol.sources import SUITES, task_code, user_sources, worker_sources
from es_service.protocol.user_code import RaisedError
from workers import environments
from workers.rollouts import BACKENDS
from workers.simd.backend import cache as kernels

CALLER = "caller"
"""Name of the task, and its kind."""
OPTIONS = {
    "observation_size": Option(0, low=0, high=1_000_000),
    "action_size": Option(0, low=0, high=1_000_000),
    "parameters": Option(0, low=0, high=10_000_000),
    "start": Option(None),
    "descriptor_size": Option(2, low=1, high=1000),
    "episode_steps": Option(1, low=1),
}
"""Either the sizes of a policy, or the number of parameters of something else and where the search starts, a list with
a value for each (zeros if there is none); and the dimensions of the descriptor."""


def caller_task(options: Mapping[str, OptionValue]) -> TaskSpec:
    """Description of the task with these options; those that are left out or not allowed have their defaults."""
    values = option_values(OPTIONS, options)
    given = values.pop("start", ())
    observations, actions, parameters, dimensions, steps = (int(str(value)) for value in values.values())
    names = tuple(f"p{index}" for index in range(parameters))
    start = tuple(map(float, given)) if is_start(given, parameters) else (0.0,) * parameters
    return TaskSpec(
        name=CALLER,
        observation_size=1 if parameters else max(1, observations),
        action_size=parameters or max(1, actions),
        episode_steps=max(1, steps),
        descriptor_names=tuple(f"d{index}" for index in range(max(1, dimensions))),
        descriptor_bounds=(UNBOUNDED,) * max(1, dimensions),
        final_fitness=False,
        has_goal=False,
        options=dict(OPTIONS),
        summary="episodes that the program computes which asks the search",
        kind=CALLER,
        parameters=ParameterSpec(names, (FREE,) * parameters, start) if parameters else None,
    )


CHOICES = ("task.descriptor", "task.success", "task.new_object_each_episode", "task.metrics")
"""Keys of `HostChoices`."""
OTHER_TASKS = (
    f"brax:NAME, mujoco:ID, gymnasium:ID, {', '.join(f'{suite}:NAME' for suite in SUITES)}, python:module:Class, "
    "function:module:name, or module:Class"
)
"""Names of tasks that are not shipped, in words."""
DESCRIBE_S = 300.0
"""Longest wait for a description, in seconds: for the first time, to see whether simd can compile a humanoid of MuJoCo
takes a minute of a processor, and longer on a busy machine."""
REMEMBERED = ("brax", "mujoco", *SUITES)
"""Kinds of tasks that libraries define as pure functions: their descriptions depend on versions, this project's code
and what the config chooses, and are kept in the cache of kernels."""
REPEATS_S = 20.0
"""Longest time of a trial whether it repeats itself."""


def is_start(given: object, parameters: int) -> TypeGuard[list[float]]:
    """Whether a value is a list with a number for each parameter."""
    return (
        isinstance(given, list)
        and len(given) == parameters
        and all(type(value) in (int, float) and abs(value) < LARGEST for value in given)
    )


class Tasks(Mapping[str, TaskSpec]):
    """Tasks by name. Iteration yields the shipped tasks; lookup also finds OTHER_TASKS."""

    def __getitem__(self, name: str) -> TaskSpec:
        """Raises KeyError for a plain name that is not shipped, ConfigError for another that cannot be described."""
        return self.chosen(name, {}, NO_CHOICES)

    def chosen(self, name: str, options: Mapping[str, OptionValue], choices: HostChoices) -> TaskSpec:
        """The task with options and what else a config chooses of it. Raises as a lookup.

        What is found by a trial (shapes, the rollouts that can run it, whether it repeats itself) holds for the
        options, so a task of which some are not the defaults is described twice.
        """
        if name == CALLER:
            return caller_task(options)
        if ":" not in name:
            return environments.SHIPPED[name]
        require_no_import_of_a_task()
        settings = environments.settings_of_description(name, options, choices)
        code = tuple(user_sources(*task_code(name, choices.descriptor, options)).items())

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
    """The task of a run, with the descriptor that its options choose, as it was when the config was loaded."""
    return config.made.task


def require_same_task(config: RunConfig) -> None:
    """Raise ConfigError if the task has changed since its values were filled into the config, such as its episode
    length: the run would have some values of the old task and some of the new one."""
    settings, before = config.task, config.made.task
    now = TASKS.chosen(settings.environment, settings.options, settings.choices)
    task = with_options(now, settings.options)
    if changes := _changes(before, task):
        raise ConfigError(
            f"the task {task.name} has changed since this config was loaded ({', '.join(changes)}); load the config "
            "again",
            field="task.environment",
            value=task.name,
        )


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
    folder, key = kernels.cache_folder(), ""
    if name.partition(":")[0] in REMEMBERED and folder is not None and kernels.trusted(folder):
        depends_on = [name, settings, code, worker_sources(), platform_info()]
        key = hashlib.sha256(json.dumps(depends_on, sort_keys=True).encode()).hexdigest()
        if (remembered := kernels.load(folder, key)) is not None:
            return task_from_fields(json.loads(remembered))
    fields = _ask_for_description(name, settings)
    if key and folder is not None:
        kernels.save(folder, key, json.dumps(fields).encode())
    return task_from_fields(fields)


def _ask_for_description(name: str, settings: str) -> dict[str, Any]:
    """The fields of a TaskSpec, found by a child process; arguments as of `_described`."""
    with Child("workers.describe:descriptions", child_environment()) as child:
        try:
            child.call(name, json.loads(settings), limit_s=DESCRIBE_S)
            answer = json.loads(child.call("task", limit_s=DESCRIBE_S))
        except NoAnswerError as error:
            raise ConfigError(f"{name} could not be imported and described: its process {error}") from None
        except RaisedError as error:
            raise ConfigError(f"{name} could not be imported or described:\n{error}") from None
        if answer.get("task", {}).get("kind") == "python":
            with suppress(NoAnswerError, RaisedError):  # a simulator may end its process or make it wait
                answer["task"]["does_not_repeat"] = child.call("repeats", limit_s=REPEATS_S)
        child.end(END_S)
    if "problem" in answer:
        problem = answer["problem"]
        named = re.match(r"(task\.(?:\w+|options\.\w+)) = ", problem)
        raise ConfigError(problem, field=named and named[1])
    return answer["task"]


def tasks_of_suite(suite: str, on_names: Callable[[Sequence[str]], None]) -> Iterator[tuple[str, TaskSpec | str]]:
    """Name of each environment of a suite, and its description, or why it cannot be a task.

    Args:
        suite: one of `sources.SUITES`.
        on_names: is called with all names before the first description, which may take seconds.

    Raises:
        ConfigError: the suite is not installed, or its process ended.
    """
    with Child("workers.describe:members", child_environment()) as child:
        try:
            child.call(suite, limit_s=DESCRIBE_S)
            listed = json.loads(child.call("", limit_s=DESCRIBE_S))
            if "problem" in listed:
                raise ConfigError(listed["problem"])
            names = [f"{suite}:{name}" for name in listed["names"]]
            on_names(names)
            for name in names:
                answer = json.loads(child.call(name, limit_s=DESCRIBE_S))
                yield name, answer.get("problem") or task_from_fields(answer["task"])
        except (NoAnswerError, RaisedError) as error:
            raise ConfigError(f"the environments of {suite} could not be described: {error}") from None
        child.end(END_S)


_TASK = TypeAdapter(TaskSpec)


def task_from_fields(fields: Mapping[str, Any]) -> TaskSpec:
    """A TaskSpec from its fields as JSON has them, also those that a run stores, with tuples in place of lists.

    Fields that only older versions had are left out.
    """
    return _TASK.validate_python(fields)


def settings_of_task(values: Mapping[str, Any]) -> dict[str, Any]:
    """What a config chooses for its task besides its name, as arguments of `Tasks.chosen`.

    Values of types that no task takes are left out; they are reported elsewhere.
    """
    descriptor = as_tuple(values.get("task.descriptor"))
    is_chosen = descriptor and (isinstance(descriptor, str) or all(type(index) is int for index in descriptor))
    success = values.get("task.success")
    choices = HostChoices(
        descriptor if is_chosen else None,
        success if isinstance(success, str) and success else None,
        values.get("task.new_object_each_episode") is True,
        chosen_metrics(values.get("task.metrics")),
    )
    options = {key: value for key, value in options_of(values).items() if is_plain(value)}
    return {"options": options, "choices": choices}


def chosen_metrics(given: object) -> tuple[str, ...]:
    """The metrics that a config chooses; none if the value is no list of such."""
    keys = given if isinstance(given, list | tuple) else ()
    are_valid = all(isinstance(key, str) and re.match(CHOSEN_METRIC, key) for key in keys)
    return tuple(keys) if are_valid else ()


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
