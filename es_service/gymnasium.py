"""Our tasks as environments of Gymnasium; importing this module registers them.

    import gymnasium
    envs = gymnasium.make_vec("es_service.gymnasium:es_service/AntTrap-v0", num_envs=256)
    env = gymnasium.make("es_service.gymnasium:es_service/AntTrap-v0")

It has an id for each shipped task, and `es_service/Task-v0` for one of your own: `task="my_module:Class"`. The classes
are `environments.vector.TaskVectorEnv` and `environments.vector.TaskEnv`. `es_service/AntMazeMujoco-v0` and
`es_service/AntTrapMujoco-v0` are the ants with `physics: mujoco` in C MuJoCo itself, which our step by MJX is compared
with; `workers/environments/ant_gymnasium.py` has their classes. It needs the extra `gymnasium`.
"""

from __future__ import annotations

import gymnasium

from workers.environments import SHIPPED

SINGLE = "es_service.environments.vector:TaskEnv"
VECTOR = "es_service.environments.vector:TaskVectorEnv"


def id_of(task: str) -> str:
    """Gymnasium's id of a shipped task: that of `ant_trap` is `es_service/AntTrap-v0`."""
    return f"es_service/{task.title().replace('_', '')}-v0"


gymnasium.register("es_service/Task-v0", SINGLE, vector_entry_point=VECTOR)
for _name, _task in SHIPPED.items():
    _limit, _given = _task.episode_steps, {"task": _name}
    gymnasium.register(id_of(_name), SINGLE, vector_entry_point=VECTOR, max_episode_steps=_limit, kwargs=_given)
for _name, _entry in (("ant_maze", "AntMazeEnv"), ("ant_trap", "AntTrapEnv")):
    _limit = SHIPPED[_name].episode_steps
    _id = id_of(_name).replace("-v0", "Mujoco-v0")
    gymnasium.register(_id, f"workers.environments.ant_gymnasium:{_entry}", max_episode_steps=_limit)
