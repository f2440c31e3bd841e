"""Environments of Jumanji 1.1 as tasks, such as `jumanji:Snake-v1`.

They are Jumanji's own. A mask of allowed actions is part of the observation and holds for what is chosen. Rewards of
several agents are added, since one policy chooses for all. Numbers among the extras of a time step are measures. An
environment that always ends by itself has no limit in Jumanji; here it is LIMIT.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from es_service.protocol.options import OptionValue
from workers.environments.suite_task import Actuators, Choices, Package, Suite, suite_module

PACKAGE = Package("jumanji", "es-service with its extra, 80 MB,")
LIMIT = 1000
"""Steps after which an episode ends at the latest where Jumanji has no limit."""


def names() -> tuple[str, ...]:
    """Names of the environments, those apart that download data when they are made."""
    registered = suite_module("jumanji", PACKAGE).registered_environments()
    return tuple(sorted(registered - {"Sokoban-v0"}))


def suite(name: str, given: Mapping[str, OptionValue]) -> Suite:
    """Jumanji's environment `name`."""
    environment = suite_module("jumanji", PACKAGE).make(name)

    def after(state: Any, timestep: Any) -> tuple[Any, Any]:
        """State of the adapter and observation."""
        return (state, getattr(timestep.observation, "action_mask", None), timestep.extras), timestep.observation

    def reset(key: Any) -> tuple[Any, Any]:
        return after(*environment.reset(key))

    def step(key: Any, state: Any, action: Any) -> tuple[Any, Any, Any, Any]:
        own, timestep = environment.step(state[0], action.astype(environment.action_spec.dtype))
        return *after(own, timestep), jnp.sum(timestep.reward), timestep.last()

    mask = jax.eval_shape(reset, jax.ShapeDtypeStruct((2,), jnp.uint32))[0][1]
    return Suite(
        f"jumanji:{name}",
        reset,
        step,
        _actions(environment.action_spec, () if mask is None else mask.shape),
        int(getattr(environment, "time_limit", LIMIT)),
        mask=None if mask is None else lambda state: state[1],
        measures=lambda state: state[2],
    )


def _actions(spec: Any, mask_shape: tuple[int, ...]) -> Choices | Actuators:
    """Actions of a specification of Jumanji's, with a mask of this shape or with none."""
    specs = suite_module("jumanji", PACKAGE, "jumanji.specs")
    if isinstance(spec, specs.DiscreteArray):
        return Choices((int(spec.num_values),))
    if isinstance(spec, specs.MultiDiscreteArray):
        counts = tuple(np.ravel(spec.num_values).tolist())
        return Choices(counts, single=False, together=mask_shape == counts)
    if np.issubdtype(spec.dtype, np.integer):  # a mask tells how many choices each has
        return Choices((mask_shape[-1],) * mask_shape[0], single=False)
    return Actuators(*(np.broadcast_to(np.asarray(x, np.float32), spec.shape) for x in (spec.minimum, spec.maximum)))
