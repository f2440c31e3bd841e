"""A task in JAX that computes in double precision, which importing this module turns on in the whole process."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from es_service.protocol.noise import uniforms

jax.config.update("jax_enable_x64", True)


class Cart:
    """a cart is to come to a place; its state, and so its observation and its reward, have double precision"""

    observation_size, action_size, episode_steps = 2, 1, 50
    descriptor_names, descriptor_bounds = ("x", "v"), ((-3.0, 3.0), (-3.0, 3.0))

    def reset(self, key):
        return jnp.asarray(uniforms(key, jnp.arange(2, dtype=jnp.uint32)), jnp.float64) * 0.2 - 0.1

    def observe(self, state):
        return state

    def step(self, state, action):
        x, v = state
        v = v + 0.1 * jnp.clip(action[0], -1, 1)
        x = x + 0.1 * v
        return jnp.stack([x, v]), -((x - 1.0) ** 2), jnp.abs(x) > 3.0

    def descriptor(self, state):
        return state
