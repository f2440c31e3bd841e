"""A task that our compiler cannot compile, because it has a Fourier transform: it runs on xla."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp

from es_service.protocol.noise import uniforms


class Fourier:
    """three numbers are to come near to each other; the reward is the amplitude of what they have not in common"""

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
        amplitude = jnp.abs(jnp.fft.rfft(state)[1])
        return state, -amplitude, jnp.array(False)

    def descriptor(self, state: Any) -> Any:
        return jnp.stack([state.min(), state.max()])
