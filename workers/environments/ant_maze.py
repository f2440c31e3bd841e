"""AntMaze: an ant must go round three walls to a goal 60 m away; the direct path ends in a pocket.

The arena, episode length and descriptor are those of the benchmark paper (Chalumeau et al. 2022); the inner walls, the
start and the goal are those of the original ME-ES task (Colas et al. 2020).
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp

from workers.environments import SHIPPED, Environment
from workers.environments.ant import AntState, ant_viewer, make_ant, observe

WALLS = SHIPPED["ant_maze"].walls or ()
LOW, HIGH = SHIPPED["ant_maze"].descriptor_bounds[0]
"""Bounds of the arena in x and in y; it is a square."""
START = (-25.0, -25.0)
GOAL = (35.0, -25.0)
NEAR = 5.0
"""Distance from the goal, in metres, within which an episode that ends there succeeds."""
MIDDLE, HALF = (LOW + HIGH) / 2.0, (HIGH - LOW) / 2.0
"""Middle of the arena and half of its side; they scale positions in observations to [-1, 1]."""


def make() -> Environment:
    """Functions of AntMaze, which has no options."""
    ant = make_ant(WALLS)

    def step(state: AntState, action: Any) -> tuple[AntState, Any, Any]:
        state = ant.step(state, action)
        return state, -_goal_distance(state), jnp.array(False)

    def reset(key: Any) -> AntState:
        return ant.reset(key, START)

    return Environment(reset, _observe, step, _position, _goal_distance, _near_goal, ant_viewer(ant.system))


def _position(state: AntState) -> Any:
    return state.q[:2]


def _observe(state: AntState) -> Any:
    return jnp.concatenate([(_position(state) - MIDDLE) / HALF, observe(state)])


def _goal_distance(state: AntState) -> Any:
    dx, dy = state.q[0] - GOAL[0], state.q[1] - GOAL[1]
    return jnp.sqrt(dx * dx + dy * dy)


def _near_goal(state: AntState, before: Any) -> Any:
    return _goal_distance(state) <= NEAR
