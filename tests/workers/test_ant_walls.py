"""Ants pushed into walls: from every side, into corners, along them, and up."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from es_service.protocol.noise import Domain, stream_keys
from tests.wall_watch import WALLS, Walls, colliders, crosses, depth, inside_the_maze, places_beside_walls
from workers.environments import ant_maze
from workers.environments.ant import STEP_S, make_ant

pytestmark = [
    pytest.mark.slow,
    pytest.mark.filterwarnings("ignore:Accessing .* directly from .Data. is deprecated"),  # Brax, on its own
]
ANTS_PUSHED = 300


@pytest.fixture(scope="module", params=list(WALLS))
def pushed(request):
    """(task, its walls, a compiled watch over ants that are pushed while every motor is turned fully to and fro).

    The watch is f(states, push [N, 3] as an acceleration of every link, m/s2, keys) -> depth in a wall, whether a way
    crossed one, torso position, whether all is finite; [N, steps].
    """
    walls = WALLS[request.param]
    ant = make_ant(walls)

    def watch(state, push_3, key):
        def body(state, step):
            action = jnp.sign(jax.random.uniform(jax.random.fold_in(key, step // 10), (8,)) - 0.5)
            vel = state.motion.vel + push_3 * STEP_S
            moved = ant.step(state._replace(motion=state.motion.replace(vel=vel)), action)
            deep = depth(colliders(ant.system, moved), walls)
            return moved, (deep, crosses(state.q[:2], moved.q[:2], walls), moved.q[:3], jnp.isfinite(moved.q).all())

        return jax.lax.scan(body, state, jnp.arange(100))[1]

    watches = jax.jit(jax.vmap(watch))

    def run(places, pushes):
        count = len(places)
        rows = np.arange(ANTS_PUSHED) % count  # of one number, for one compilation
        return tuple(x[:count] for x in run_padded(places[rows], pushes[rows]))

    def run_padded(places, pushes):
        count = len(places)
        keys = stream_keys(0, Domain.TRAINING_RESET, 0, np.arange(count))
        state = jax.vmap(lambda key, xy: ant.reset(key, (xy[0], xy[1])))(keys, jnp.asarray(places, jnp.float32))
        split = jax.random.split(jax.random.PRNGKey(1), count)
        return tuple(np.asarray(x) for x in watches(state, jnp.asarray(pushes, jnp.float32), split))

    return request.param, walls, run


def ways_into_walls(name: str, walls: Walls) -> tuple[np.ndarray, np.ndarray]:
    """Starts and unit vectors: straight at each wall from both sides, slantwise, along it, and into every corner."""
    places, ways = [], []
    for start, end in np.array(walls):
        along = (end - start) / np.linalg.norm(end - start)
        across = np.array([-along[1], along[0]])
        for side in (across, -across):
            for way in (-side, along - side, -along - side, along - 0.2 * side, -along - 0.2 * side):
                for share in (0.1, 0.3, 0.5, 0.7, 0.9):
                    places.append(start + share * (end - start) + 2.2 * side)
                    ways.append(way / np.linalg.norm(way))
    corners = {tuple(corner) for wall in walls for corner in wall} | {(10.0, -15.0), (10.0, -35.0)}
    for corner in sorted(corners):
        for diagonal in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
            places.append(np.array(corner) + 2.5 * np.array(diagonal))
            ways.append(-np.array(diagonal) / np.sqrt(2.0))
    places, ways = np.array(places), np.array(ways)
    free = np.asarray(jax.vmap(lambda xy: depth(jnp.tile(xy, (9, 1)), walls))(places)) < -1.0
    if name == "ant_maze":
        free &= inside_the_maze(places)
    return places[free], ways[free]


def test_walls_hold_from_every_side(pushed):
    """With its own weight behind it an ant gives way by less than a tenth of a metre."""
    name, walls, run = pushed
    places, ways = ways_into_walls(name, walls)
    assert len(places) > 130
    deepest, crossed, _, finite = run(places, np.pad(10.0 * ways, ((0, 0), (0, 1))))
    assert finite.all()
    assert not crossed.any()
    assert deepest.max() < 0.1
    assert (deepest.max(1) > -0.01).mean() > 0.7, "most of them must have come to a wall"


def test_nothing_climbs_a_wall(pushed):
    """Pushed with twice their weight and nearly lifted off: they fly, higher than a wall is drawn, but not across."""
    name, walls, run = pushed
    places, ways = ways_into_walls(name, walls)
    _, crossed, position, finite = run(places, np.pad(20.0 * ways, ((0, 0), (0, 1)), constant_values=6.0))
    assert finite.all()
    assert not crossed.any()
    assert position[..., 2].max() > 2.0
    if name == "ant_maze":
        assert np.abs(position[..., :2] - ant_maze.MIDDLE).max() < ant_maze.HALF


def test_walls_hold_wherever_an_ant_is_pushed(pushed):
    """In any direction, from anywhere beside a wall. Whole episodes, without a push: `tests.benchmarks.walls_hold`."""
    name, _, run = pushed
    places = places_beside_walls(name, ANTS_PUSHED, seed=1)
    angles = np.random.default_rng(2).uniform(0, 2 * np.pi, ANTS_PUSHED)
    deepest, crossed, position, finite = run(places, np.stack([8 * np.cos(angles), 8 * np.sin(angles), 0 * angles], 1))
    assert finite.all()
    assert not crossed.any()
    assert deepest.max() < 0.1
    assert (deepest.max(1) > 0).mean() > 0.4, "most of them must have touched a wall"
    if name == "ant_maze":
        assert np.abs(position[..., :2] - ant_maze.MIDDLE).max() < ant_maze.HALF
