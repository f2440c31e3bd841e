"""A task that our compiler cannot compile, because it sorts: it runs on xla."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp

from es_service.protocol.noise import uniforms


class Sorting:
    """three numbers are to come near to each other; the reward sorts them"""

    observation_size = 3
    action_size = 3
    episode_steps = 20
    descriptor_names = ("least", "greatest")
    descriptor_bounds = ((-2.0, 2.0), (-2.0, 2.0))

    def reset(self, key: Any) -> Any:
        return 2.0 * uniforms(key, jnp.arange(3, dtype=jnp.uint32)) - 1.0

    def observe(self, state: Any) -> Any:
        return state

    def step(self, state: Any, action: Any) -> tuple[Any, Any, Any]:
        state = jnp.clip(state + 0.1 * action, -2.0, 2.0)
        in_order = jnp.sort(state)
        return state, in_order[0] - in_order[2], jnp.array(False)

    def descriptor(self, state: Any) -> Any:
        return jnp.stack([state.min(), state.max()])
