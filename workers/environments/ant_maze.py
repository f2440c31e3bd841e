"""AntMaze: an ant must go round three walls to a goal 60 m away; the direct path ends in a pocket.

The arena, episode length and descriptor are those of the benchmark paper (Chalumeau et al. 2022); the inner walls, the
start and the goal are those of the original ME-ES task (Colas et al. 2020).
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp

from workers.environments import SHIPPED, Environment
from workers.environments.ant import ant_in, observe
from workers.environments.ant_tasks import MAZE_BOUNDS, MAZE_GOAL, MAZE_NEAR, MAZE_START

WALLS = SHIPPED["ant_maze"].walls or ()
LOW, HIGH = MAZE_BOUNDS
MIDDLE, HALF = (LOW + HIGH) / 2.0, (HIGH - LOW) / 2.0
"""Middle of the arena and half of its side; they scale positions in observations to [-1, 1]."""


def make(physics: str = "spring") -> Environment:
    """Functions of AntMaze.

    Args:
        physics: see `ant_in`.
    """
    ant = ant_in(physics, WALLS)

    def step(state: Any, action: Any) -> tuple[Any, Any, Any]:
        state = ant.step(state, action)
        return state, -_goal_distance(state), jnp.array(False)

    def reset(key: Any) -> Any:
        return ant.reset(key, MAZE_START)

    return Environment(reset, _observe, step, _position, _goal_distance, _near_goal, ant.viewer)


def _position(state: Any) -> Any:
    return state.q[:2]


def _observe(state: Any) -> Any:
    return jnp.concatenate([(_position(state) - MIDDLE) / HALF, observe(state)])


def _goal_distance(state: Any) -> Any:
    dx, dy = state.q[0] - MAZE_GOAL[0], state.q[1] - MAZE_GOAL[1]
    return jnp.sqrt(dx * dx + dy * dy)


def _near_goal(state: Any, before: Any) -> Any:
    return _goal_distance(state) <= MAZE_NEAR
