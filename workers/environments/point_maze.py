"""PointMaze: a point in the square [-1, 1]^2 must pass two walls to reach a goal in the upper left corner.

The lower wall leaves a gap on the left and the upper wall one on the right, so the reward, the negative distance to the
goal, leads straight into a dead end. Kinematics and numbers are those of the published QDax environment (v0.3.0),
including its peculiarities: walls act on y only, so the point slides along them, and the ends of walls are not solid.
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp

from es_service.protocol.noise import uniforms
from workers.environments import Environment

GOAL = (-0.5, 0.8)
GOAL_HALF_SIDE = 0.05
STEP = 0.1
"""Greatest movement along an axis in one step."""
LOWER_WALL = (-0.50, -0.49)
"""y of the lower wall's lower and upper face; the wall extends over x >= LOWER_WALL_FROM_X."""
LOWER_WALL_FROM_X = -0.5
UPPER_WALL = (0.20, 0.21)
"""y of the upper wall's lower and upper face; the wall extends over x <= UPPER_WALL_TO_X."""
UPPER_WALL_TO_X = 0.5
START_X = (-0.1, 0.1)
START_Y = (-1.0, -0.7)
CORNER = (0.9, -0.9)
"""Start with the option `start="corner"`."""


def point_maze(start: str = "default") -> Environment:
    """Functions of PointMaze, with the published random start or, for `start="corner"`, the fixed start (0.9, -0.9)."""
    reset = _reset_corner if start == "corner" else _reset
    return Environment(reset, _observe, _step, _observe, _goal_distance, lambda position, before: _at_goal(position))


def _reset(key: Any) -> Any:
    u = uniforms(key, jnp.arange(2, dtype=jnp.uint32))
    low = jnp.array([START_X[0], START_Y[0]], jnp.float32)
    high = jnp.array([START_X[1], START_Y[1]], jnp.float32)
    return low + u * (high - low)


def _reset_corner(key: Any) -> Any:
    return jnp.array(CORNER, jnp.float32)


def _observe(position: Any) -> Any:
    return position


def _goal_distance(position: Any) -> Any:
    dx, dy = position[0] - GOAL[0], position[1] - GOAL[1]
    return jnp.sqrt(dx * dx + dy * dy)


def _step(position: Any, action: Any) -> tuple[Any, Any, Any]:
    moved = position + jnp.clip(action, -1.0, 1.0) * STEP
    position = jnp.clip(jnp.stack([moved[0], _stopped_by_walls(position, moved)]), -1.0, 1.0)
    return position, -_goal_distance(position), _at_goal(position)


def _at_goal(position: Any) -> Any:
    inside = jnp.abs(position[0] - GOAL[0]) <= GOAL_HALF_SIDE
    return inside & (jnp.abs(position[1] - GOAL[1]) <= GOAL_HALF_SIDE)


def _stopped_by_walls(old: Any, new: Any) -> Any:
    """y at the end of the movement from old to new, stopped by the walls.

    Whether a wall is hit depends on x at its lower face, for both directions of movement.
    """
    rise = new[1] - old[1]
    slope = (new[0] - old[0]) / jnp.where(rise == 0.0, 1.0, rise)  # a movement without rise crosses no wall
    y = new[1]

    below, above = LOWER_WALL
    hits = old[0] + slope * (below - old[1]) >= LOWER_WALL_FROM_X
    y = jnp.where(hits & (old[1] <= below) & (new[1] > below), below, y)
    y = jnp.where(hits & (old[1] >= above) & (old[1] < UPPER_WALL[0]) & (new[1] < above), above, y)

    below, above = UPPER_WALL
    hits = old[0] + slope * (below - old[1]) <= UPPER_WALL_TO_X
    from_above = hits & (old[1] >= above) & (y < above)
    from_below = hits & (old[1] > LOWER_WALL[0]) & (old[1] <= below) & (y > below)
    return jnp.where(from_above, above, jnp.where(from_below, below, y))
