"""The mazes of JaxGCRL: maps, walls, goals, rewards and ends, by hand and by brute force."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from es_service import load_config
from es_service.errors import ConfigError
from es_service.protocol.noise import Domain, stream_keys
from tests.workers.steps import carried, of_many, resets_of
from workers.environments import make_environment
from workers.environments.ant import make_ant
from workers.environments.ant_tasks import (
    BLOCK,
    CELL_M,
    MAZES,
    WALL_RADIUS,
    bounds_of,
    cells_of,
    goals_of,
    is_free,
    walls_of,
)
from workers.environments.goal_maze import WALLS_MET, GoalState
from workers.environments.walls import wall_rows, walls_near
from workers.simd.episodes.kernel import compile_kernel

COUNTS = {"ant_u_maze": (6, 18), "ant_big_maze": (25, 38), "ant_hardest_maze": (45, 62)}
"""Goals and blocks, as the paper's code has them."""
ROUNDING_M = 0.5 * (np.sqrt(2.0) - 1.0)
"""How far the rounded edge of a wall is from that of its block."""


def free_places(maze: str, step: float = 0.2) -> np.ndarray:
    """Places of a grid in free cells, [N, 2]."""
    (x0, x1), (y0, y1) = bounds_of(maze)
    grid = np.stack(np.meshgrid(np.arange(x0, x1, step), np.arange(y0, y1, step), indexing="ij"), -1).reshape(-1, 2)
    return grid[[is_free(maze, *xy) for xy in grid]]


def gaps(places_N_2: np.ndarray, maze: str) -> np.ndarray:
    """[N, W] metres from places to the middle lines of walls."""
    ends = np.array(walls_of(maze))
    start, way = ends[:, 0], ends[:, 1] - ends[:, 0]
    share = np.clip(((places_N_2[:, None] - start) * way).sum(-1) / (way**2).sum(-1), 0, 1)
    return np.linalg.norm(places_N_2[:, None] - start - share[..., None] * way, axis=-1)


@pytest.mark.parametrize("maze", MAZES)
def test_maps_have_the_goals_and_the_blocks_of_the_paper_s_code(maze):
    assert (len(goals_of(maze)), len(cells_of(maze, BLOCK))) == COUNTS[maze]
    assert cells_of(maze, "S") == [(1, 1)]
    assert {row[0] + row[-1] for row in MAZES[maze]} == {BLOCK * 2}
    assert set(MAZES[maze][0] + MAZES[maze][-1]) == {BLOCK}


def test_goals_are_the_middles_of_their_cells():
    assert goals_of("ant_u_maze") == {
        "1-2": (4.0, 8.0), "1-3": (4.0, 12.0), "2-3": (8.0, 12.0), "3-1": (12.0, 4.0), "3-2": (12.0, 8.0),
        "3-3": (12.0, 12.0),
    }  # fmt: skip


@pytest.mark.parametrize("maze", MAZES)
def test_walls_are_where_the_blocks_are(maze):
    """The distance from each free place to the nearest wall is that to the nearest block, but for rounded edges."""
    places, blocks = free_places(maze), CELL_M * np.array(cells_of(maze, BLOCK))
    beyond = np.maximum(np.abs(places[:, None] - blocks) - CELL_M / 2, 0.0)
    excess = gaps(places, maze).min(1) - WALL_RADIUS - np.linalg.norm(beyond, axis=-1).min(1)
    assert excess.min() > -1e-9
    assert excess.max() < ROUNDING_M + 1e-9
    assert (excess < 1e-9).mean() > 0.7


@pytest.mark.parametrize("maze", MAZES)
def test_an_ant_reaches_no_more_walls_than_it_looks_at(maze):
    """From its torso, its feet reach 0.93 m, and in a control step it comes no further than 0.3 m."""
    assert (gaps(free_places(maze), maze) < WALL_RADIUS + 0.93 + 0.3).sum(1).max() <= WALLS_MET


def test_the_nearest_walls_are_those_of_brute_force():
    maze = "ant_big_maze"
    places = np.random.default_rng(0).uniform(2, 26, (50, 2)).astype(np.float32)
    rows = wall_rows(walls_of(maze))
    near = jax.vmap(lambda xy: walls_near(rows, xy, WALLS_MET))(places)
    ends = np.array(walls_of(maze), np.float32)
    for number, order in enumerate(np.sort(gaps(places, maze), axis=1)):
        found = [[start.tolist(), end.tolist()] for start, end in zip(near[0][number], near[1][number], strict=True)]
        assert all(one in ends.tolist() for one in found)
        shown = np.array([gaps(places[number : number + 1], maze)[0][ends.tolist().index(one)] for one in found])
        np.testing.assert_allclose(shown, order[:WALLS_MET], atol=1e-5)


@pytest.mark.long
def test_an_ant_that_looks_at_few_walls_moves_as_one_that_looks_at_all():
    walls = walls_of("ant_u_maze")
    few, every = (make_ant(walls, near=near) for near in (WALLS_MET, None))
    keys = stream_keys(0, Domain.TRAINING_RESET, 0, np.arange(64))
    states = jax.vmap(lambda key: every.reset(key, (2.9, 4.0)))(keys)  # beside a wall, which legs touch
    actions = np.sign(np.random.default_rng(0).normal(size=(20, 64, 8))).astype(np.float32)
    one = other = states
    for action in actions:
        one, other = of_many(few.step)(one, action), of_many(every.step)(other, action)
    np.testing.assert_allclose(one.q, other.q, atol=1e-3)
    assert np.abs(np.asarray(one.push.vel)[:, :, 0]).max() > 0.1


def episode(options, place_2, *, goal_2=(8.0, 12.0), height=0.55, action=0.0):
    """(environment, state, action) of an ant of the U maze that was carried somewhere."""
    environment = make_environment("ant_u_maze", options)
    states = resets_of("ant_u_maze")(stream_keys(0, Domain.EVALUATION_RESET, 0, np.arange(1)))
    way = np.array([[*place_2, height]]) - np.asarray(states.ant.q[:, :3])
    ant = jax.tree.map(lambda leaf: jnp.asarray(leaf[0]), carried(states.ant, way))
    return environment, GoalState(ant, jnp.array(goal_2)), jnp.full(8, action)


@pytest.mark.slow
def test_success_distance_and_observation_by_hand():
    environment, state, _ = episode({}, (8.0, 11.7))
    assert environment.goal_distance(state) == pytest.approx(0.3, abs=1e-5)
    assert environment.success(state, False)
    _, far, _ = episode({}, (8.0, 11.4))
    assert not environment.success(far, False)
    assert environment.success(far, True), "it has been there"
    observation = np.asarray(environment.observe(state))
    assert observation.shape == (31,)
    np.testing.assert_allclose(observation[[0, 1, -2, -1]], [0.0, (11.7 - 8) / 6, 0.0, 4 / 6], rtol=1e-5)
    np.testing.assert_allclose(observation[2:15], state.ant.q[2:])
    np.testing.assert_allclose(environment.descriptor(state), [8.0, 11.7])


@pytest.mark.slow
def test_goals_are_drawn_evenly_and_can_be_chosen():
    keys = stream_keys(3, Domain.EVALUATION_RESET, 0, np.arange(600))
    drawn = np.asarray(resets_of("ant_u_maze")(keys).goal_2)
    places, counts = np.unique(drawn, axis=0, return_counts=True)
    assert places.tolist() == sorted(map(list, goals_of("ant_u_maze").values()))
    assert counts.min() > 60
    chosen = compile_kernel(make_environment("ant_u_maze", {"goal": "3-1"}).reset, keys[0])
    assert chosen(keys[:5]).goal_2.tolist() == [[12.0, 4.0]] * 5


@pytest.mark.slow
def test_rewards_and_ends_by_hand():
    """With an ant that falls where it is put, the distance hardly changes in a step."""
    environment, before, action = episode({}, (8.0, 11.8))
    step = compile_kernel(environment.step, before, action)
    for goal, height, reward, ends in ((12.0, 0.55, 1.0, False), (14.0, 0.55, 0.0, False), (12.0, 1.5, 1.0, True)):
        _, before, action = episode({}, (8.0, 11.8), goal_2=(8.0, goal), height=height)
        after, given, done = step(*(one_of(x) for x in (before, action)))
        assert (given[0], done[0]) == (reward, ends), after.ant.q
    environment, before, action = episode({"reward": "dense"}, (8.0, 11.0), action=0.5)
    after, given, _ = compile_kernel(environment.step, before, action)(*(one_of(x) for x in (before, action)))
    gone = environment.goal_distance(before) - np.linalg.norm(after.ant.q[0, :2] - before.goal_2)
    assert given[0] == pytest.approx(10.0 * float(gone) / 0.05 + 1.0 - 0.5 * 8 * 0.25, abs=1e-3)


def one_of(tree):
    """A tree of arrays with an axis for a single environment."""
    return jax.tree.map(lambda leaf: np.asarray(leaf)[None], tree)


def test_a_goal_that_is_no_cell_is_refused_with_the_cells():
    with pytest.raises(ConfigError, match=r"task.options.goal.*2-2.*drawn, '?1-2'?, .*3-3"):
        load_config({"task": {"environment": "ant_u_maze", "options": {"goal": "2-2"}}})
