"""What tests and benchmarks watch of ants among walls: how deep they are in one, whether their way crosses one."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from es_service.protocol.messages import Segment
from workers.environments import ant, ant_tasks
from workers.environments.ant import LEG_LENGTH, LEG_RADIUS, LOWER_LEGS, TORSO_RADIUS
from workers.environments.ant_tasks import WALL_RADIUS
from workers.environments.brax_task import Transform

Walls = tuple[Segment, ...]
WALLS: dict[str, Walls] = {
    "ant_maze": ant.MAZE_WALLS,
    "ant_trap": ant.TRAP_WALLS,
    **{maze: ant_tasks.walls_of(maze) for maze in ant_tasks.MAZES},
}
CLEAR_M = 1.0
"""Between a start and the nearest wall's surface: no leg of an ant reaches further from its torso's surface."""


def colliders(x: Transform) -> jax.Array:
    """Torso and both ends of every lower leg in the plane, [9, 2].

    Args:
        x: where the torso and then the bodies of each leg are, of Brax's ant [9] or of MuJoCo's [13].
    """
    points, bodies = [x.pos[0]], (len(x.pos) - 1) // len(LOWER_LEGS)
    for leg, (_, sign_x, sign_y) in enumerate(LOWER_LEGS, start=1):
        end = jnp.array([sign_x * LEG_LENGTH, sign_y * LEG_LENGTH, 0.0])
        points += [x.pos[leg * bodies], x.take(leg * bodies).do(Transform.create(pos=end)).pos]
    return jnp.stack(points)[:, :2]


def depth(points: jax.Array, walls: Walls) -> jax.Array:
    """Metres by which the deepest of nine collider points is inside a wall; negative outside."""
    radii = jnp.array([TORSO_RADIUS] + [LEG_RADIUS] * 8)
    deepest = jnp.array(-jnp.inf)
    for start, end in walls:
        a, b = jnp.array(start), jnp.array(end)
        along = jnp.clip((points - a) @ (b - a) / jnp.sum((b - a) ** 2), 0, 1)
        gap = jnp.linalg.norm(points - a - along[:, None] * (b - a), axis=-1)
        deepest = jnp.maximum(deepest, (WALL_RADIUS + radii - gap).max())
    return deepest


def crosses(before_2: Any, after_2: Any, walls: Walls) -> jax.Array:
    """Whether a way crosses the middle of a wall."""

    def side(p, q, r):
        return (q[0] - p[0]) * (r[1] - p[1]) - (q[1] - p[1]) * (r[0] - p[0])

    crossed = jnp.array(False)
    for start, end in walls:
        a, b = jnp.array(start), jnp.array(end)
        apart = side(a, b, before_2) * side(a, b, after_2) < 0
        crossed |= apart & (side(before_2, after_2, a) * side(before_2, after_2, b) < 0)
    return crossed


def inside_the_maze(place_2: Any) -> np.ndarray:
    """Whether a place is in the arena, clear of its borders."""
    reach = ant.HALF - WALL_RADIUS - TORSO_RADIUS - CLEAR_M
    return np.abs(np.asarray(place_2) - ant.MIDDLE).max(-1) < reach


def places_beside_walls(name: str, count: int, seed: int) -> np.ndarray:
    """Starts within three metres of some wall of a task, clear of all of them: [count, 2]."""
    rng, walls = np.random.default_rng(seed), WALLS[name]
    ends = np.array(walls)[rng.integers(len(walls), size=20 * count)]
    tries = ends[:, 0] + rng.uniform(size=(20 * count, 1)) * (ends[:, 1] - ends[:, 0])
    tries += rng.uniform(-3, 3, tries.shape)
    free = np.asarray(jax.jit(jax.vmap(lambda xy: depth(jnp.tile(xy, (9, 1)), walls)))(tries)) < -CLEAR_M
    if name == "ant_maze":
        free &= inside_the_maze(tries)
    elif name in ant_tasks.MAZES:
        free &= np.array([ant_tasks.is_free(name, *xy) for xy in tries])
    chosen = tries[free][:count].astype(np.float32)
    assert len(chosen) == count
    return chosen
