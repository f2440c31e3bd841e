"""Environments of gymnax as tasks, such as `gymnax:CartPole-v1`.

They are gymnax's own, by `reset_env` and `step_env`, which do not reset by themselves. The length of an episode is
`max_steps_in_episode` of the default parameters; the other parameters that are single numbers are options.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from es_service.protocol.messages import Bounds, TaskSpec
from es_service.protocol.options import Option, OptionValue
from workers.environments import Environment, TaskError
from workers.environments.brax_task import quietly
from workers.environments.declared import finite_bounds
from workers.environments.suite_task import (
    Actuators,
    Choices,
    Suite,
    describe_suite,
    make_suite,
    require_known,
    suite_package,
)

WAY = "pip install --no-deps gymnax==1.0.1 gymnasium (a few MB; without --no-deps it asks for an older gymnasium)"
LENGTH = "max_steps_in_episode"


def names() -> tuple[str, ...]:
    """Names of the environments, those apart that download data when they are made."""
    registered = suite_package("gymnax", WAY).registered_envs
    return tuple(name for name in registered if name != "MNISTBandit-bsuite")


def describe(name: str, given: Mapping[str, OptionValue] = MappingProxyType({})) -> TaskSpec:
    """Description of gymnax's environment `name` as a task; `given` are values of options that are not the defaults.

    Raises:
        TaskError: gymnax is not installed, has no such environment, or one that cannot be a task.
    """
    environment, parameters = _made(name)
    defaults = {
        field.name: value
        for field in dataclasses.fields(parameters)
        if field.name != LENGTH and type(value := getattr(parameters, field.name)) in (bool, int, float)
    }
    options = {key: Option(value) for key, value in defaults.items()}
    changed = parameters.replace(**{key: value for key, value in given.items() if key in defaults})
    return describe_suite(_suite(name, environment, changed), options, given)


def make(name: str, descriptor: Any = None, **parameters: Any) -> Environment:
    """Functions of gymnax's environment `name`, with values of its parameters that are not the defaults."""
    environment, defaults = _made(name)
    return make_suite(_suite(name, environment, defaults.replace(**parameters)), descriptor)


def _made(name: str) -> tuple[Any, Any]:
    """gymnax's environment and its default parameters."""
    gymnax = suite_package("gymnax", WAY)
    require_known("gymnax", name, names())
    with quietly():
        return gymnax.make(name)


def _suite(name: str, environment: Any, parameters: Any) -> Suite:
    def step(key: Any, state: Any, action: Any) -> tuple[Any, Any, Any, Any]:
        key, _ = jax.random.split(key)  # as gymnax's own step, whose second key is that of a reset
        observation, state, reward, terminated, _ = environment.step_env(key, state, action, parameters)
        return state, observation, reward, jnp.logical_or(terminated, environment.is_truncated(state, parameters))

    def reset(key: Any) -> tuple[Any, Any]:
        observation, state = environment.reset_env(key, parameters)
        return state, observation

    space = environment.action_space(parameters)
    if hasattr(space, "n"):
        actions: Any = Choices((int(space.n),))
    elif hasattr(space, "low"):
        actions = Actuators(*(np.broadcast_to(np.asarray(x, np.float32), space.shape) for x in (space.low, space.high)))
    else:
        raise TaskError(f"gymnax:{name} has actions of {type(space).__name__}; Discrete and Box are supported")
    return Suite(
        f"gymnax:{name}",
        reset,
        step,
        actions,
        int(getattr(parameters, LENGTH)),
        _bounds(environment.observation_space(parameters)),
    )


def _bounds(space: Any) -> Bounds:
    if not hasattr(space, "low"):
        return ()
    low, high = (np.broadcast_to(np.asarray(x, np.float64), space.shape).reshape(-1) for x in (space.low, space.high))
    return tuple(finite_bounds(float(a), float(b)) for a, b in zip(low, high, strict=True))
