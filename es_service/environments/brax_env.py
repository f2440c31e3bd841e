"""Our tasks as environments of Brax; `workers/brax_view.py` has the classes, since only workers import JAX.

from brax.training.agents.es.train import train
from es_service.environments.brax_env import TaskBraxEnv, wrap
train(TaskBraxEnv("point_maze"), wrap_env_fn=wrap, episode_length=200, num_timesteps=1_000_000)
"""

from workers.brax_view import RandomResets, TaskBraxEnv, wrap

__all__ = ["RandomResets", "TaskBraxEnv", "wrap"]
