"""A run's policies in another task, which may be another simulator: its config, and whether it fits the policies.

Axes: A actions.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from es_service.config.given import Overrides, parse_overrides
from es_service.config.model import COMPUTE_CONSTANTS, RunConfig
from es_service.config.parts import TASK_OPTIONS
from es_service.config.tasks import TASKS, settings_of_task, task_of
from es_service.config.text import show
from es_service.errors import ConfigError, Problem
from es_service.protocol.messages import EpisodesResult, TaskSpec
from es_service.protocol.options import OptionValue, allowed_value, option_values
from es_service.runs.certified import Elsewhere
from es_service.runs.checked_config import load_config
from es_service.runs.selection import kept

ENVIRONMENT = "task.environment"
MAY_SET = ("task.descriptor", "task.time_limit_s", "compute.rollout")
"""Keys of the other task that may be set besides its options. All else is as in the run."""
OBSERVATION = ("observation", "contact_force")
"""What the names of options say that change what a policy sees, in Gymnasium's environments and ours."""


FIRST_OBSERVATION = "first_observation"
SAME = 1e-5
"""First observations are equal within this, relative to the greater of 1 and their size: other simulators may compute
in another precision."""


@dataclass(frozen=True)
class OtherTask:
    """Another task, as the policies of a run are evaluated in it."""

    config: RunConfig
    """Of the run, with the other task."""
    task: TaskSpec
    options: Mapping[str, Any]
    """Options that were set, or taken over from the run."""
    differences: tuple[str, ...]
    """What it lacks of the run's task, and options of both whose defaults differ, in words."""


def other_task(config: RunConfig, name: str, overrides: Overrides = ()) -> OtherTask:
    """Another task for the policies of a run, with an episode as long as in the run.

    Options that the run has changed from their defaults are those of the other task, too, if it has options of the same
    names and allows the values.

    Args:
        config: that of the run.
        name: the task, as `task.environment` of a config.
        overrides: options of the other task, such as "task.options.frame_skip=5", and the keys MAY_SET.

    Raises:
        ConfigError: the task does not exist or cannot be used here, a key may not be set, or a size, the bounds of the
            actions, or an option of the observations is another one than in the run.
    """
    given, problems = parse_overrides(overrides)
    allowed = f"{TASK_OPTIONS}NAME, {', '.join(MAY_SET)}"
    problems += [
        Problem(f"{key}: cannot be set for another task, in which all else is as in the run; set {allowed}", key, value)
        for key, value in given.items()
        if not key.startswith(TASK_OPTIONS) and key not in MAY_SET
    ]
    if problems:
        raise ConfigError.listing(f"the task {name}", problems)
    here, declared, wanted = task_of(config), _described(name, given), given
    if declared is not None:
        changed = {
            f"{TASK_OPTIONS}{option}": value
            for option, value in config.task.options.items()
            if option in declared.options and value != here.options[option].default
            if allowed_value(declared.options[option], value) == value
        }
        wanted = {**changed, **given}
        there = _described(name, wanted) or declared
        if unequal := _unequal(config, here, there, options_in(there, wanted)):
            raise ConfigError.listing(f"the policies of {here.name} cannot run in {name}", unequal)
    loaded = load_config(_config(config, name, declared), wanted, new=False, searches=False, name=f"the task {name}")
    there, options = task_of(loaded), loaded.task.options
    were_set = {option: value for option, value in options.items() if f"{TASK_OPTIONS}{option}" in wanted}
    return OtherTask(loaded, there, were_set, _differences(config, here, loaded, there, given))


def stored_task(config: RunConfig, elsewhere: Elsewhere) -> OtherTask:
    """The task of a stored certification; arguments and errors as of `other_task`."""
    options = {f"{TASK_OPTIONS}{name}": value for name, value in elsewhere.options.items()}
    others = {"task.descriptor": elsewhere.descriptor, "compute.rollout": elsewhere.rollout}
    return other_task(config, elsewhere.task, options | others)


def elsewhere_of(other: OtherTask, here: EpisodesResult, there: EpisodesResult) -> Elsewhere:
    """What is kept of the episodes [E] of a policy in another task.

    Args:
        here: episodes with the same resets in the run's task.
    """
    settings = other.config.task
    first = [result.outputs.get(FIRST_OBSERVATION, np.zeros(0)) for result in (here, there)]
    paired = np.allclose(*first, rtol=SAME, atol=SAME)
    descriptor = list(settings.descriptor) if isinstance(settings.descriptor, tuple) else settings.descriptor
    rollout = other.config.compute.rollout
    return Elsewhere(other.task.name, other.options, descriptor, rollout, bool(paired), kept(there))


def _described(name: str, wanted: Mapping[str, Any]) -> TaskSpec | None:
    """A task with what is set of it; None if there is none of this name, which loading a config says in full."""
    try:
        return TASKS.chosen(name, **settings_of_task(wanted))
    except KeyError:
        return None


def options_in(task: TaskSpec, wanted: Mapping[str, Any]) -> dict[str, OptionValue]:
    """Values of all options of a task that have one, of which some are set by dotted keys."""
    given = {key.removeprefix(TASK_OPTIONS): value for key, value in wanted.items() if key.startswith(TASK_OPTIONS)}
    return option_values(task.options, given)


def _config(config: RunConfig, name: str, declared: TaskSpec | None) -> dict[str, Any]:
    """What another task has of the config of a run."""
    sections = config.model_dump(mode="json")
    compute = {key: value for key, value in sections["compute"].items() if key not in COMPUTE_CONSTANTS}
    of_objects = ("success", "new_object_each_episode") if declared and declared.kind == "python" else ()
    return {
        "task": {"environment": name, **{key: sections["task"][key] for key in ("episode_steps", *of_objects)}},
        "policy": sections["policy"],
        "map": {"enabled": False},
        "compute": {**compute, "inline_workers": "processes", "worker_resources": {}},
        "seed": config.seed,
    }


def _unequal(config: RunConfig, here: TaskSpec, there: TaskSpec, options: Mapping[str, OptionValue]) -> list[Problem]:
    """What must be equal for a policy to run in both tasks, and is not."""
    seen: dict[str, tuple[Any, Any]] = {
        f"{TASK_OPTIONS}{option}": (config.task.options.get(option, here.options[option].default), value)
        for option, value in options.items()
        if option in here.options and any(part in option for part in OBSERVATION)
    }
    compared: dict[str, tuple[Any, Any]] = {
        "the parameters and their bounds": (_parameters(here), _parameters(there)),
        "the size of an action": (here.action_size, there.action_size),
        "the bounds of the actions": (_bounds(here), _bounds(there)),
    }
    if all(of_run == other for of_run, other in seen.values()):  # else they are the reason for another size
        compared["the size of an observation"] = here.observation_size, there.observation_size
    return [
        Problem(f"{what}: {show(of_run)} in {here.name}, but {show(other)} in {there.name}", ENVIRONMENT, there.name)
        for what, (of_run, other) in (compared | seen).items()
        if of_run != other
    ]


def _parameters(task: TaskSpec) -> dict[str, list[float]]:
    """The bounds of the parameters of a function by name; none of a task with policies."""
    spec = task.parameters
    return {} if spec is None else dict(zip(spec.names, map(list, spec.bounds), strict=True))


def _bounds(task: TaskSpec) -> list[list[float]]:
    """What the actions -1 and 1 become, [A, 2]; one pair if all are equal."""
    pairs = [list(pair) for pair in task.action_bounds or [(-1.0, 1.0)]]
    return pairs[:1] if all(pair == pairs[0] for pair in pairs) else pairs


def _differences(
    config: RunConfig, here: TaskSpec, other: RunConfig, there: TaskSpec, given: Mapping[str, Any]
) -> tuple[str, ...]:
    """See `OtherTask.differences`; those of `given` options are meant."""
    names = here.descriptor_names, there.descriptor_names
    lacks = [
        *(["which episodes succeed"] if here.success and not there.success else []),
        *(["a distance to the goal"] if here.has_goal and not there.has_goal else []),
        *([f"the descriptor ({', '.join(names[0])})"] if names[0] != names[1] else []),
    ]
    differences = [f"{there.name} does not tell {' or '.join(lacks)}; the return is what counts"] if lacks else []
    for option, value in other.task.options.items():
        mine, key = config.task.options.get(option, value), f"{TASK_OPTIONS}{option}"
        if mine != value and key not in given:
            differences.append(f"{key} is {show(mine)} in {here.name}, and {show(value)} in {there.name}")
    return tuple(differences)
