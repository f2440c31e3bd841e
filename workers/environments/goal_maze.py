"""Mazes of JaxGCRL (Bortkiewicz et al. 2025): an ant must reach a goal that is drawn in each episode, or chosen.

The cells, the start, the goals, the rewards, the ends and the length of an episode are those of its `ant_maze.py`; the
ant and its physics are those of AntMaze here, which are Brax's springs with the same steps. What differs: walls are
infinitely high (there 2 m, which ends an episode first), only the torso and the lower legs meet them, the start has no
noise on the pose of the torso, and places in the observation are scaled to [-1, 1].
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from es_service.protocol.noise import uniforms
from workers.environments import Environment
from workers.environments.ant import make_ant, observe
from workers.environments.ant_tasks import (
    DRAWN,
    HEALTHY_Z,
    JOINTS,
    NEAR_M,
    START,
    STEP_S,
    bounds_of,
    cells_of,
    goals_of,
    place,
    walls_of,
)
from workers.viewer import Viewer

WALLS_MET = 4
"""Most walls that an ant can meet in a control step: two at a corner, and what it comes to on its way of 0.2 m."""
DENSE_SPEED, DENSE_ALIVE, DENSE_CONTROL = 10.0, 1.0, 0.5
"""Weights of the dense reward: of the speed towards the goal in m/s, of a step, and of the squares of the actions."""


class GoalState(NamedTuple):
    """State between two control steps."""

    ant: Any
    goal_2: Any
    """Where the goal of the episode is, in metres."""


def make(maze: str, goal: str = DRAWN, reward: str = "at_goal", observation: str = "with_goal") -> Environment:
    """Functions of a maze.

    Args:
        maze: the name of the task.
        goal: `drawn`, or the goal of every episode, ROW-COLUMN.
        reward: `at_goal`, 1 for each step that ends within 0.5 m of the goal, else 0; or `dense`.
        observation: `with_goal`, or `without_goal`, which has zeros in its place: a policy of an archive, which is for
            one goal, then acts the same whatever the goal of the episode is.
    """
    ant = make_ant(walls_of(maze), near=WALLS_MET)
    goals = goals_of(maze)
    place_G_2 = np.array(list(goals.values()) if goal == DRAWN else [goals[goal]], np.float32)
    (start,) = cells_of(maze, START)
    low_2, high_2 = np.array(bounds_of(maze), np.float32).T
    middle_2, half_2 = (low_2 + high_2) / 2, (high_2 - low_2) / 2

    def reset(key: Any) -> GoalState:
        u = uniforms(key, jnp.arange(2 * JOINTS, 2 * JOINTS + 1, dtype=jnp.uint32))[0]  # after those of the joints
        drawn = jnp.minimum((u * len(place_G_2)).astype(jnp.int32), len(place_G_2) - 1)
        return GoalState(ant.reset(key, place(start)), jnp.asarray(place_G_2)[drawn])

    def distance(state: GoalState) -> Any:
        away_2 = state.ant.q[:2] - state.goal_2
        return jnp.sqrt((away_2 * away_2).sum())

    def observe_all(state: GoalState) -> Any:
        here_2, goal_2 = ((xy - middle_2) / half_2 for xy in (state.ant.q[:2], state.goal_2))
        if observation == "without_goal":
            goal_2 = jnp.zeros_like(goal_2)
        return jnp.concatenate([here_2, observe(state.ant), goal_2])

    def step(state: GoalState, action: Any) -> tuple[GoalState, Any, Any]:
        new = GoalState(ant.step(state.ant, action), state.goal_2)
        z = new.ant.q[2]
        done = (z < HEALTHY_Z[0]) | (z > HEALTHY_Z[1])
        if reward == "dense":
            control = jnp.sum(jnp.clip(action, -1.0, 1.0) ** 2)
            speed = (distance(state) - distance(new)) / STEP_S
            return new, DENSE_SPEED * speed + DENSE_ALIVE - DENSE_CONTROL * control, done
        return new, (distance(new) < NEAR_M).astype(jnp.float32), done

    def success(state: GoalState, before: Any) -> Any:
        return before | (distance(state) < NEAR_M)

    viewer = Viewer(ant.viewer.model, lambda state: ant.viewer.poses(state.ant), STEP_S)
    return Environment(reset, observe_all, step, lambda state: state.ant.q[:2], distance, success, viewer)
