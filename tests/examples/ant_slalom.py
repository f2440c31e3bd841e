"""A task of one's own: an ant must run a slalom. Start from this file.

    es-service run my_config.yaml --set task.environment=ant_slalom:AntSlalom      # where ant_slalom.py lies

All methods are pure functions of one ant's state that JAX can trace; they are batched and compiled for you.
"""

import jax.numpy as jnp

from es_service.protocol.options import Option
from workers.environments.ant import make_ant, observe

# Axes of the walls, in metres; each is thickened by half a metre and cannot be climbed.
GATES = (
    ((6.0, -10.0), (6.0, 1.0)),  # pass on the left,
    ((14.0, -1.0), (14.0, 10.0)),  # then on the right
)


class AntSlalom:
    """Run far along +x, around two walls that stand in the way."""

    observation_size = 29  # the ant's 27, and where it is
    action_size = 8
    episode_steps = 500  # control steps of 0.05 s
    # What tells two behaviours apart: where the ant is when the episode ends.
    descriptor_names = ("x", "y")
    descriptor_bounds = ((-5.0, 25.0), (-12.0, 12.0))
    # Settings by name, task.options in the config: allowed values, of which the first is the default; or any number.
    options = {"walls": ("both", "first"), "finish": Option(20.0, low=1.0)}  # noqa: RUF012

    def __init__(self, walls: str = "both", finish: float = 20.0) -> None:
        self.finish = finish
        self.ant = make_ant(GATES if walls == "both" else GATES[:1])

    def reset(self, key):
        """A new episode; all randomness comes from the key."""
        return self.ant.reset(key, (0.0, 0.0))

    def observe(self, state):
        position = state.q[:2] / 10.0
        return jnp.concatenate([position, observe(state)])

    def step(self, state, action):
        """The state a control step later, the reward for it, and whether the episode ends."""
        new = self.ant.step(state, action)
        reward = new.q[0] - state.q[0]
        fallen = (new.q[2] < 0.2) | (new.q[2] > 1.0)
        return new, reward, fallen | (new.q[0] > self.finish)

    def descriptor(self, state):
        return state.q[:2]

    def success(self, state, before):
        """The ant has passed the finish."""
        return state.q[0] > self.finish

    def viewer(self):
        """What `es-service report` replays episodes with."""
        return self.ant.viewer
