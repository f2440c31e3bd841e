"""Descriptors that a config chooses for a task of Python objects: `task.descriptor`."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import replace
from typing import Any

import numpy as np

from es_service.protocol.messages import UNBOUNDED, Bounds, DescriptorChoice
from es_service.protocol.raised import users_error
from workers.environments import TaskError
from workers.environments.declared import clashes, import_named, wrong_pairs
from workers.environments.host_task import HostEnvironment, HostEpisode, HostTask

SOME_STEPS = 20
"""Steps within which a key of `info` must be known, and a descriptor be computed, to see how many numbers it has."""


def with_descriptor(task: HostTask, choice: DescriptorChoice | None, size: int | None = None) -> HostTask:
    """The task with the descriptor that a config chooses.

    Args:
        size: how many numbers it has; None: any number.

    Raises:
        TaskError: there is no such descriptor.
    """
    if choice is None:
        return task
    if isinstance(choice, tuple):
        wrong = [index for index in choice if not 0 <= index < task.observation_size]
        if wrong or not choice:
            raise TaskError(
                f"task.descriptor = {list(choice)}: observations of {task.name} have {task.observation_size} numbers, "
                f"which are named 0 to {task.observation_size - 1}"
            )
        indices_B = np.array(choice)
        return replace(task, descriptor=lambda episode: episode.observation_O[indices_B], descriptor_size=len(choice))
    if ":" in choice:
        function = import_named(choice, "function")
        return replace(task, descriptor=function, descriptor_size=size or 0, keeps_all=True)
    return replace(task, descriptor=_of_info(choice, size or 1), descriptor_size=size or 0)


def describe_descriptor(
    task: HostTask, choice: DescriptorChoice, bounds_O: Sequence[tuple[float, float]], action_size: int
) -> tuple[tuple[str, ...], Bounds]:
    """(names, bounds) of the dimensions of a descriptor that a config chooses.

    Args:
        bounds_O: of the numbers of an observation; infinite where there are none.

    Raises:
        TaskError: there is no such descriptor, or what it declares does not fit.
    """
    task = with_descriptor(task, choice)
    if isinstance(choice, tuple):
        names = tuple(f"observation_{index}" for index in choice)
        return names, tuple(finite_bounds(*bounds_O[index]) for index in choice)
    try:
        size = _size(task, choice, action_size)
    except TaskError:
        raise
    except Exception as error:  # the user's function can raise anything
        raise TaskError(f"task.descriptor = {choice}: {users_error(error, choice) or error}") from None
    name = choice.rpartition(":")[2]
    names = (name,) if size == 1 else tuple(f"{name}_{index}" for index in range(size))
    bounds: Any = (UNBOUNDED,) * size
    if ":" in choice:
        function = import_named(choice, "function")
        names = tuple(map(str, getattr(function, "descriptor_names", names)))
        bounds = getattr(function, "descriptor_bounds", bounds)
    wrong = wrong_pairs("descriptor_bounds", bounds)
    if {len(names), len(bounds)} != {size}:
        wrong.append(f"{size} numbers, but {len(names)} descriptor_names and {len(bounds)} descriptor_bounds")
    wrong += clashes(names)
    if wrong:
        raise TaskError(f"task.descriptor = {choice}: {'; '.join(wrong)}")
    return names, tuple((float(low), float(high)) for low, high in bounds)


def _of_info(key: str, size: int) -> Callable[[HostEpisode], Any]:
    """The newest value of a key of `info` in the episode; NaN before the first."""
    return lambda episode: episode.said.get(key, np.full(size, np.nan))


def _size(task: HostTask, choice: str, action_size: int) -> int:
    """How many numbers a descriptor has, from some steps."""
    environment = HostEnvironment(task)
    (action,) = task.actions(np.zeros((1, action_size), np.float32))
    environment.reset(0)
    for _ in range(SOME_STEPS):
        done = environment.step(copy(action))[2]
        if ":" in choice or choice in environment.info:
            return environment.measured_size()
        if done:
            environment.reset(0)
    known = ", ".join(map(str, environment.info)) or "no keys"
    raise TaskError(f"task.descriptor = {choice}: the info of {task.name} has {known} after {SOME_STEPS} steps")


def finite_bounds(low: float, high: float) -> tuple[float, float]:
    """Bounds as a description has them: UNBOUNDED if one is infinite, or so large that it says nothing."""
    return (low, high) if math.isfinite(low) and math.isfinite(high) and abs(low) + abs(high) < 1e6 else UNBOUNDED
