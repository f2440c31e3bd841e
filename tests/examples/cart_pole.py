"""A task with two actions, of which a policy chooses one: a pole on a cart is to be balanced.

es-service run my_config.yaml --set task.environment=cart_pole:CartPole --set policy.output=categorical
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np

from es_service.protocol.noise import uniforms

GRAVITY, CART, POLE, HALF_LENGTH, FORCE, STEP_S = 9.8, 1.0, 0.1, 0.5, 10.0, 0.02
MOST_PLACE, MOST_ANGLE = 2.4, np.deg2rad(12.0)


class CartPole:
    """a pole on a cart is to be balanced by pushes to the left or to the right; the episode ends when it falls"""

    observation_size, action_size, episode_steps = 4, 2, 200
    descriptor_names, descriptor_bounds = ("place", "angle"), ((-2.4, 2.4), (-0.21, 0.21))
    least_reward = 0.0

    def reset(self, key: Any) -> Any:
        return 0.1 * uniforms(key, jnp.arange(4, dtype=jnp.uint32)) - 0.05

    def observe(self, state: Any) -> Any:
        return state

    def step(self, state: Any, action: Any) -> tuple[Any, Any, Any]:
        """Source: CartPole-v1 of Gymnasium, after Barto, Sutton and Anderson 1983."""
        _, speed, angle, turning = state
        force = FORCE * (action[1] - action[0])  # the action that is chosen is 1, the other 0
        sine, cosine, mass = jnp.sin(angle), jnp.cos(angle), CART + POLE
        pushed = (force + POLE * HALF_LENGTH * turning * turning * sine) / mass
        angular = (GRAVITY * sine - cosine * pushed) / (HALF_LENGTH * (4.0 / 3.0 - POLE * cosine * cosine / mass))
        linear = pushed - POLE * HALF_LENGTH * angular * cosine / mass
        state = state + STEP_S * jnp.stack([speed, linear, turning, angular])
        fallen = (jnp.abs(state[0]) > MOST_PLACE) | (jnp.abs(state[2]) > MOST_ANGLE)
        return state, jnp.float32(1.0), fallen

    def descriptor(self, state: Any) -> Any:
        return jnp.stack([state[0], state[2]])
