"""Ants pushed into walls: from every side, into corners, along them, and up."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from es_service.protocol.noise import Domain, stream_keys
from tests.wall_watch import WALLS, Walls, colliders, crosses, depth, inside_the_maze, places_beside_walls
from tests.workers.steps import carried, kernel_of, of_many, pushed, resets_of, system_of
from workers.environments import ant
from workers.environments.ant import ant_viewer
from workers.environments.ant_tasks import STEP_S

pytestmark = [
    pytest.mark.slow,
    pytest.mark.filterwarnings("ignore:Accessing .* directly from .Data. is deprecated"),  # Brax, on its own
]
ANTS_PUSHED, STEPS = 300, 100
TURN = 10
"""Steps after which a motor may turn round."""


@pytest.fixture(scope="module", params=["ant_trap", pytest.param("ant_maze", marks=pytest.mark.long)])
def watched(request):
    """(task, its walls, a watch over ants that are pushed while every motor is turned fully to and fro).

    The watch is f(places [N, 2], push [N, 3] as an acceleration of every link, m/s2) -> depth in a wall, whether a way
    crossed one, torso position, whether all is finite; [N, STEPS].
    """
    name, walls, viewer = request.param, WALLS[request.param], ant_viewer(system_of(request.param))
    step, begin = kernel_of(name), resets_of(name)
    look = of_many(
        lambda before_2, state: (depth(colliders(viewer.poses(state)), walls), crosses(before_2, state.q[:2], walls))
    )

    def watch(places, pushes):
        count, found = len(places), []
        state = begin(stream_keys(0, Domain.TRAINING_RESET, 0, np.arange(count)))
        state = carried(state, places - state.q[:, :2])
        for at in range(STEPS):
            if at % TURN == 0:
                action = motors(at // TURN)[:count]
            before = state.q[:, :2]
            state, *_ = step(pushed(state, pushes * STEP_S), action)
            found.append((*look(before, state), state.q[:, :3], np.isfinite(state.q).all(1)))
        return tuple(np.stack(one, axis=1) for one in zip(*found, strict=True))

    return name, walls, watch


def motors(turn: int) -> np.ndarray:
    """Motors [ANTS_PUSHED, 8], each turned fully to one side."""
    keys = jax.random.split(jax.random.PRNGKey(1), ANTS_PUSHED)
    drawn = jax.vmap(lambda key: jax.random.uniform(jax.random.fold_in(key, turn), (8,)))(keys)
    return np.sign(np.asarray(drawn) - 0.5)


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


def test_walls_hold_from_every_side(watched):
    """With its own weight behind it an ant gives way by less than a tenth of a metre."""
    name, walls, run = watched
    places, ways = ways_into_walls(name, walls)
    assert len(places) > 130
    deepest, crossed, _, finite = run(places, np.pad(10.0 * ways, ((0, 0), (0, 1))))
    assert finite.all()
    assert not crossed.any()
    assert deepest.max() < 0.1
    assert (deepest.max(1) > -0.01).mean() > 0.7, "most of them must have come to a wall"


def test_nothing_climbs_a_wall(watched):
    """Pushed with twice their weight and nearly lifted off: they fly, higher than a wall is drawn, but not across."""
    name, walls, run = watched
    places, ways = ways_into_walls(name, walls)
    _, crossed, position, finite = run(places, np.pad(20.0 * ways, ((0, 0), (0, 1)), constant_values=6.0))
    assert finite.all()
    assert not crossed.any()
    assert position[..., 2].max() > 2.0
    if name == "ant_maze":
        assert np.abs(position[..., :2] - ant.MIDDLE).max() < ant.HALF


def test_walls_hold_wherever_an_ant_is_pushed(watched):
    """In any direction, from anywhere beside a wall. Whole episodes, without a push: `tests.benchmarks.walls_hold`."""
    name, _, run = watched
    places = places_beside_walls(name, ANTS_PUSHED, seed=1)
    angles = np.random.default_rng(2).uniform(0, 2 * np.pi, ANTS_PUSHED)
    deepest, crossed, position, finite = run(places, np.stack([8 * np.cos(angles), 8 * np.sin(angles), 0 * angles], 1))
    assert finite.all()
    assert not crossed.any()
    assert deepest.max() < 0.1
    assert (deepest.max(1) > 0).mean() > 0.4, "most of them must have touched a wall"
    if name == "ant_maze":
        assert np.abs(position[..., :2] - ant.MIDDLE).max() < ant.HALF
