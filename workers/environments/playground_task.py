"""Environments of MuJoCo Playground 0.2 as tasks, such as `playground:CartpoleBalance`, computed by MJX in JAX.

They are Playground's own: its models, with the iterations of the solver and the limits of contacts that it sets. The
tasks of the DM Control suite are part of its package. Those of locomotion and manipulation need the models of
mujoco_menagerie, which Playground clones by git into its own folder when such an environment is made for the first
time.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import jax.numpy as jnp
import numpy as np

from es_service.protocol.messages import TaskSpec
from es_service.protocol.options import OptionValue, choice
from workers.environments import Environment, TaskError
from workers.environments.brax_task import quietly
from workers.environments.suite_task import (
    Actuators,
    Suite,
    describe_suite,
    make_suite,
    require_known,
    suite_package,
)

WAY = "pip install playground==0.2.0 (about 400 MB with Warp)"
OBSERVATIONS = ("state", "privileged_state")
"""What environments observe that have observations of several kinds, the default first."""


def names() -> tuple[str, ...]:
    """Names of the environments, those of the DM Control suite first."""
    registry = _registry()
    of_suites = (registry.dm_control_suite, registry.locomotion, registry.manipulation)
    return tuple(name for suite in of_suites for name in suite.ALL_ENVS)


def describe(name: str, given: Mapping[str, OptionValue] = MappingProxyType({})) -> TaskSpec:
    """Description of Playground's environment `name` as a task; `given` are values of options.

    Raises:
        TaskError: Playground is not installed, has no such environment, or cannot load its models.
    """
    environment = _loaded(name)
    options = {"observation": choice(*OBSERVATIONS)} if _has_kinds(environment) else {}
    kind = str(given.get("observation", OBSERVATIONS[0]))
    return describe_suite(_suite(name, environment, kind), options, given)


def make(name: str, descriptor: Any = None, observation: str = OBSERVATIONS[0]) -> Environment:
    """Functions of Playground's environment `name`."""
    return make_suite(_suite(name, _loaded(name), observation), descriptor)


def _registry() -> Any:
    suite_package("mujoco_playground", WAY)
    return suite_package("mujoco_playground._src.registry", WAY)


def _loaded(name: str) -> Any:
    registry = _registry()
    require_known("playground", name, names())
    try:
        with quietly():
            settings = registry.get_default_config(name)
            settings.impl = "jax"  # the default, Warp, needs a GPU
            return registry.load(name, config=settings)
    except Exception as error:  # git, the network, or a folder that cannot be written
        raise TaskError(
            f"playground:{name} cannot be loaded ({type(error).__name__}: {error}); if it needs the models of "
            "mujoco_menagerie, load it once where there is a network and git, and copy the folder of the package"
        ) from error


def _has_kinds(environment: Any) -> bool:
    with quietly():
        return isinstance(environment.observation_size, Mapping)


def _suite(name: str, environment: Any, kind: str) -> Suite:
    has_kinds = _has_kinds(environment)

    def observed(state: Any) -> Any:
        return state.obs[kind] if has_kinds else state.obs

    def reset(key: Any) -> tuple[Any, Any]:
        state = environment.reset(key)
        return state, observed(state)

    def step(key: Any, state: Any, action: Any) -> tuple[Any, Any, Any, Any]:
        after = environment.step(state, action)  # its key is in state.info
        return after, observed(after), after.reward, jnp.asarray(after.done) > 0.5

    size = int(environment.action_size)
    return Suite(
        f"playground:{name}",
        reset,
        step,
        Actuators(np.full(size, -1.0), np.ones(size)),
        int(environment._config.episode_length),
    )
