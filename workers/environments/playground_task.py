"""Environments of MuJoCo Playground 0.2 as tasks, such as `playground:CartpoleBalance`, computed by MJX in JAX.

They are Playground's own: its models, with the iterations of the solver and the limits of contacts that it sets. The
tasks of the DM Control suite are part of its package. Those of locomotion and manipulation need the models of
mujoco_menagerie, which Playground clones by git into its own folder when such an environment is made for the first
time. Measures are its metrics, and `position_NAME`, the place of each body that has a name.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np

from es_service.protocol.options import OptionValue, choice
from workers.environments.suite_task import Actuators, Package, Suite, suite_module

PACKAGE = Package("mujoco_playground", "es-service with its extra, 490 MB with Warp,")
OBSERVATIONS = ("state", "privileged_state")
"""What environments observe that have observations of several kinds, the default first."""


def names() -> tuple[str, ...]:
    """Names of the environments, those of the DM Control suite first."""
    registry = _registry()
    of_suites = (registry.dm_control_suite, registry.locomotion, registry.manipulation)
    return tuple(name for suite in of_suites for name in suite.ALL_ENVS)


def suite(name: str, given: Mapping[str, OptionValue]) -> Suite:
    """Playground's environment `name`."""
    settings = _registry().get_default_config(name)
    settings.impl = "jax"  # the default, Warp, needs a GPU
    environment = _registry().load(name, config=settings)
    has_kinds = isinstance(environment.observation_size, Mapping)
    kind = given.get("observation", OBSERVATIONS[0])

    def observed(state: Any) -> Any:
        return state.obs[kind] if has_kinds else state.obs

    def reset(key: Any) -> tuple[Any, Any]:
        state = environment.reset(key)
        return state, observed(state)

    def step(key: Any, state: Any, action: Any) -> tuple[Any, Any, Any, Any]:
        after = environment.step(state, action)  # its key is in state.info
        return after, observed(after), after.reward, jnp.asarray(after.done) > 0.5

    bodies = {environment.mj_model.body(number).name: number for number in range(1, environment.mj_model.nbody)}
    bodies.pop("", None)

    def measures(state: Any) -> dict[str, Any]:
        return {**state.metrics, **{f"position_{name}": state.data.xpos[number] for name, number in bodies.items()}}

    size = int(environment.action_size)
    return Suite(
        f"playground:{name}",
        reset,
        step,
        Actuators(np.full(size, -1.0), np.ones(size)),
        int(environment._config.episode_length),
        {"observation": choice(*OBSERVATIONS)} if has_kinds else {},
        measures=measures,
    )


def _registry() -> Any:
    suite_module("playground", PACKAGE)
    return suite_module("playground", PACKAGE, "mujoco_playground._src.registry")
