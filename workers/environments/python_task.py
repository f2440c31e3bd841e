"""Classes of users that simulate in Python, as tasks named `python:package.module:Class`. Such a class must have:

    class Class:
        observation_size: int
        action_size: int
        episode_steps: int

        def reset(self, seed): ...     # whole number below 2^31 -> observation [observation_size]
        def step(self, action): ...    # float32 [action_size] -> (observation, reward, done)

`reset` starts an episode that depends only on the seed, and `step` continues it. They may also return what those of
Gymnasium return: (observation, info), and (observation, reward, terminated, truncated, info). A class may also have:

- `descriptor(self)`: the descriptor of an episode that ends now, with the attributes `descriptor_names` and
  `descriptor_bounds`, tuples as in `workers.environments.user_task`. Without it, the descriptor is the number of steps;
- `action_bounds`: (low, high) of every action, or a tuple of such pairs, one for each. Actions -1 and 1 of a policy
  then become the bounds, and what is beyond is clipped; without them, `step` gets what the policy puts out;
- `discrete_actions = True`: `step` gets the number of one of `action_size` actions, which the policy chooses;
- `goal_distance(self)` and `success(self)`, of an episode that ends now; without the latter, an episode succeeds if the
  `info` of its last step has a true `is_success`, where the first steps have one;
- `metric_names`, a tuple of names, and `metrics(self)`, as many numbers of an episode that ends now, which the run
  records as columns `metric_NAME` of its history (means over the evaluation episodes); NaN is no number. `task.metrics`
  of a config adds values of `info` to them;
- `final_fitness`, `options`, `walls`, `wall_clearance`, `goal`, `least_reward` and a docstring, as in
  `workers.environments.user_task`.

A worker makes several objects of the class and uses each for one episode after another. Several processes do so at the
same time, and a chunk that was lost is computed again: an object must not write to files that others use.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import Any

import numpy as np

from es_service.protocol.episodes import METRIC_FORM, TAKEN, wrong_metric_names
from es_service.protocol.messages import NO_CHOICES, HostChoices, TaskSpec
from es_service.protocol.options import OptionValue, declared_options, option_values
from workers.environments import TaskError
from workers.environments.declared import (
    KEPT_ATTRIBUTES,
    OF_EVERY_CLASS,
    are_finite,
    construct,
    describe_descriptor,
    import_named,
    missing_names,
    task_of_class,
    unknown_attributes,
    wrong_pairs,
    wrong_values,
)
from workers.environments.host_task import (
    LENGTH,
    HostEpisode,
    HostTask,
    action_bounds,
    chosen,
    length,
    no_metrics,
    said_success,
    success_in_words,
    try_out,
    unchanged,
    with_choices,
    within_bounds,
)

SIZES = ("observation_size", "action_size", "episode_steps")
METHODS = ("reset", "step")
DESCRIPTOR = ("descriptor_names", "descriptor_bounds")
KNOWN = (*SIZES, *METHODS, *DESCRIPTOR, *OF_EVERY_CLASS, "descriptor", "action_bounds", "discrete_actions")
KEPT = (*SIZES, *DESCRIPTOR, "action_bounds", "discrete_actions", *KEPT_ATTRIBUTES)
"""Attributes that a constructor must not change."""
PREFIX = "python:"
_OF_VALUES: Mapping[str, Callable[[Any], Any]] = {
    "last": lambda values: values[-1],
    "sum": np.sum,
    "mean": np.mean,
    "min": np.min,
    "max": np.max,
}
assert (*_OF_VALUES,) == TAKEN


def describe(
    path: str, choices: HostChoices = NO_CHOICES, given: Mapping[str, OptionValue] = MappingProxyType({})
) -> TaskSpec:
    """Description of a user's class as a task.

    Args:
        choices: what the config chooses.
        given: values of options that are not the defaults, with which its methods are tried.

    Raises:
        TaskError: the class cannot be imported, its attributes or methods are missing or wrong, or they do not fit.
    """
    task, name = import_named(path), PREFIX + path
    needed = (*SIZES, *METHODS, *(DESCRIPTOR if hasattr(task, "descriptor") else ()))
    lists = "workers/environments/python_task.py lists what such a task must have"
    if missing := missing_names(task, needed, lists):
        raise TaskError(f"{name}{missing}")
    wrong = [
        f"{attribute} = {getattr(task, attribute)!r} is not of type int"
        for attribute in SIZES
        if type(getattr(task, attribute)) is not int
    ]
    names, bounds = descriptor_of(task)
    wrong += [
        f"{attribute} = {value!r} is not of type tuple"
        for attribute, value in zip(DESCRIPTOR, (names, bounds), strict=True)
        if not isinstance(value, tuple)
    ]
    options, wrong_options = declared_options(task)
    wrong += wrong_options
    if not wrong:
        wrong += wrong_values(task, names, bounds, SIZES) + _wrong_actions(task)
    if wrong:
        raise TaskError(f"{name}: {'; '.join(wrong)}")
    spec = task_of_class(name, task, "python", (names, bounds), options)
    made = with_metrics(with_choices(make(path, option_values(options, given)), choices), choices)
    told = try_out(made, task.action_size)
    success, about_success = success_in_words(choices, told, spec.success)
    if choices.descriptor is not None:
        no_bounds = [(-math.inf, math.inf)] * task.observation_size
        names, bounds = describe_descriptor(made, choices.descriptor, no_bounds, task.action_size)
        spec = replace(spec, descriptor_names=names, descriptor_bounds=bounds)
    notes = (*unknown_attributes(name, task, KNOWN), *about_success, *missing_metrics(made, told))
    limits = getattr(task, "action_bounds", None)
    return replace(
        spec,
        discrete_actions=bool(getattr(task, "discrete_actions", False)),
        action_bounds=() if limits is None else action_bounds(limits, task.action_size),
        success=success,
        notes=notes,
        metric_names=made.metric_names,
    )


def descriptor_of(task: Any) -> tuple[Any, Any]:
    """Names and bounds of the descriptor that a class declares; those of the length of an episode if it has none."""
    if hasattr(task, "descriptor"):
        return tuple(getattr(task, attribute) for attribute in DESCRIPTOR)
    return (LENGTH,), ((0.0, float(task.episode_steps)),)


def make(path: str, options: Mapping[str, OptionValue]) -> HostTask:
    """A user's class as a task, whose objects are constructed with the task's options."""
    kind, name = import_named(path), PREFIX + path

    def make_object() -> Any:
        environment = construct(kind, options)
        for attribute in KEPT:
            of_class, of_object = getattr(kind, attribute, None), getattr(environment, attribute, None)
            if repr(of_class) != repr(of_object):
                raise TaskError(
                    f"{name}: its constructor changes {attribute} ({of_class!r} -> {of_object!r}), but a run uses the "
                    "value of the class; options may change only what the methods compute"
                )
        return environment

    actions = unchanged
    if getattr(kind, "discrete_actions", False):
        actions = chosen
    elif getattr(kind, "action_bounds", None) is not None:
        actions = within_bounds(kind.action_bounds)
    has_descriptor = hasattr(kind, "descriptor")
    return HostTask(
        name=name,
        make=make_object,
        observation_size=kind.observation_size,
        flat=lambda observation: observation,
        actions=actions,
        descriptor_size=len(descriptor_of(kind)[0]),
        descriptor=(lambda episode: episode.environment.descriptor()) if has_descriptor else length,
        success=(lambda episode: episode.environment.success()) if hasattr(kind, "success") else said_success,
        goal_distance=(lambda episode: episode.environment.goal_distance()) if hasattr(kind, "goal_distance") else None,
        metric_names=getattr(kind, "metric_names", ()),
        metrics=(lambda episode: episode.environment.metrics()) if hasattr(kind, "metric_names") else no_metrics,
    )


def _wrong_actions(task: Any) -> list[str]:
    """Problems of what a class says of its actions."""
    bounds, size = getattr(task, "action_bounds", None), task.action_size
    if getattr(task, "discrete_actions", False):
        if bounds is not None:
            return [f"action_bounds = {bounds!r} has no meaning with discrete_actions"]
        return [] if size > 1 else [f"discrete_actions with action_size = {size}: there must be several to choose from"]
    if bounds is None:
        return []
    if not isinstance(bounds, tuple):
        return [f"action_bounds = {bounds!r} is not a tuple"]
    pairs = (bounds,) if are_finite(bounds) else bounds
    wrong = wrong_pairs("action_bounds", pairs)
    if not wrong and len(pairs) not in (1, size):
        wrong.append(f"action_bounds has {len(pairs)} pairs, but action_size is {size}")
    return wrong


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
