"""Environments of gymnax as tasks, such as `gymnax:CartPole-v1`.

They are gymnax's own, by `reset_env` and `step_env`, which do not reset by themselves. The length of an episode is
`max_steps_in_episode` of the default parameters; the other parameters that are single numbers are options.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from es_service.protocol.messages import Bounds
from es_service.protocol.options import OptionValue
from workers.environments import TaskError
from workers.environments.declared import finite_bounds
from workers.environments.suite_task import Actuators, Choices, Package, Suite, parameters_with, suite_module

PACKAGE = Package(
    "gymnax",
    "it without its dependencies, of which it asks for an older gymnasium (a few MB):",
    "pip install --no-deps gymnax==1.0.1 gymnasium",
)
LENGTH = "max_steps_in_episode"


def names() -> tuple[str, ...]:
    """Names of the environments, those apart that download data when they are made."""
    registered = suite_module("gymnax", PACKAGE).registered_envs
    return tuple(name for name in registered if name != "MNISTBandit-bsuite")


def suite(name: str, given: Mapping[str, OptionValue]) -> Suite:
    """gymnax's environment `name`, with values of its parameters that are not the defaults.

    Raises:
        TaskError: its actions cannot be those of a task.
    """
    environment, defaults = suite_module("gymnax", PACKAGE).make(name)
    options, parameters = parameters_with(defaults, LENGTH, given)

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
        options,
        _bounds(environment.observation_space(parameters)),
    )


def _bounds(space: Any) -> Bounds:
    if not hasattr(space, "low"):
        return ()
    low, high = (np.broadcast_to(np.asarray(x, np.float64), space.shape).reshape(-1) for x in (space.low, space.high))
    return tuple(finite_bounds(float(a), float(b)) for a, b in zip(low, high, strict=True))
