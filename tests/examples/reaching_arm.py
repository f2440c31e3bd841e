"""A model of MuJoCo as a task of one's own: an arm must reach a target behind a wall.

    es-service run my_config.yaml --set task.environment=reaching_arm:ReachingArm      # where both files lie

The model is reaching_arm.xml; these functions say what is rewarded, and what tells two behaviours apart.
"""

from typing import Any

import jax.numpy as jnp

from es_service.protocol.noise import uniforms
from es_service.protocol.options import Option


class ReachingArm:
    """An arm must reach a target behind a wall; the straight way ends at the wall."""

    model = "reaching_arm.xml"
    frame_skip = 10  # steps of 0.005 s in a control step
    episode_steps = 100
    descriptor_names = ("x", "y")  # where the hand is when the episode ends
    descriptor_bounds = ((-0.9, 0.9), (-0.9, 0.9))
    goal = (0.55, 0.02)
    walls = (((0.35, -0.3), (0.35, 0.1)),)
    mj_model: Any  # the compiled model, which is there when these functions are called
    options = {"noise": Option(0.02, low=0.0)}  # noqa: RUF012

    def __init__(self, noise: float = 0.02) -> None:
        self.noise = noise

    def reset(self, key):
        """The arm hangs down, with a little noise: positions and velocities."""
        return self.noise * (2.0 * uniforms(key, jnp.arange(3, dtype=jnp.uint32)) - 1.0), jnp.zeros(3)

    def reward(self, data):
        return -self.goal_distance(data)

    def descriptor(self, data):
        return data.site_xpos[self.mj_model.site("hand").id, :2]

    def goal_distance(self, data):
        places = data.site_xpos[jnp.array([self.mj_model.site(name).id for name in ("hand", "target")])]
        return jnp.sqrt(jnp.sum((places[0] - places[1]) ** 2) + 1e-12)

    def success(self, data, before):
        """The hand is within 8 cm of the target at the end."""
        return self.goal_distance(data) < 0.08
