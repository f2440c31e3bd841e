"""A task for policies with a memory: a pendulum is to be swung up and held there, and its velocity is not observed.

es-service run my_config.yaml --set task.environment=swing_up:SwingUp --set policy.memory=8    # where this file lies
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from es_service.protocol.noise import uniforms

GRAVITY, TORQUE, STEP_S = 10.0, 5.0, 0.05
"""The torque lifts the pendulum by 30 degrees only, so it must be swung. Nothing damps it."""


class Pendulum(NamedTuple):
    """Angle from the upright and its velocity, in radians and seconds."""

    angle: Any
    velocity: Any


class SwingUp:
    """a pendulum, anywhere at first, is to be swung up and held upright; only its direction is observed"""

    observation_size, action_size, episode_steps = 2, 1, 100
    descriptor_names, descriptor_bounds = ("height", "side"), ((-1.0, 1.0), (-1.0, 1.0))
    least_reward = 0.0

    def reset(self, key: Any) -> Pendulum:
        angle, velocity = 2.0 * uniforms(key, jnp.arange(2, dtype=jnp.uint32)) - 1.0
        return Pendulum(np.float32(np.pi) * angle, velocity)

    def observe(self, state: Pendulum) -> Any:
        return jnp.stack([jnp.cos(state.angle), jnp.sin(state.angle)])

    def step(self, state: Pendulum, action: Any) -> tuple[Pendulum, Any, Any]:
        torque = TORQUE * jnp.clip(action[0], -1.0, 1.0)
        velocity = jnp.clip(state.velocity + STEP_S * (GRAVITY * jnp.sin(state.angle) + torque), -10.0, 10.0)
        angle = state.angle + STEP_S * velocity
        return Pendulum(angle, velocity), 0.5 + 0.5 * jnp.cos(angle), jnp.array(False)

    def descriptor(self, state: Pendulum) -> Any:
        return self.observe(state)

    def success(self, state: Pendulum, before: Any) -> Any:
        """within 20 degrees of the upright at the end"""
        return jnp.cos(state.angle) > np.float32(np.cos(np.deg2rad(20.0)))
