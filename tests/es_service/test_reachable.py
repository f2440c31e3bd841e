"""Which cells of a task's map can be reached, and where its walls are."""

import dataclasses
import math

import numpy as np
import pytest

from es_service.search.maps.geometry import Grid, make_geometry, reachable_cells
from tests.es_service.map_examples import SQUARE, map_config
from workers.environments import SHIPPED, ant_tasks, point_maze
from workers.environments.ant import TORSO_RADIUS
from workers.environments.ant_tasks import ANT_CLEARANCE, WALL_RADIUS


def test_coverage_of_reachable_cells_knows_the_border_and_gives_up_on_too_many():
    maze = SHIPPED["ant_maze"]
    narrow = Grid(((-10.0, 0.0), (-10.0, 0.0)), (4, 4))  # inside the arena; whatever ends beyond counts to its border
    found = reachable_cells(narrow, maze)
    assert found is not None
    assert found.all()
    assert reachable_cells(Grid(maze.descriptor_bounds, (2, 5_000_000)), maze) is None
    long = reachable_cells(Grid(SHIPPED["point_maze"].descriptor_bounds, (20, 5000)), SHIPPED["point_maze"])
    assert long is not None
    assert long.all()


def blocked_cells(grid, task):
    """Indices of the cells out of reach."""
    reachable = reachable_cells(grid, SHIPPED[task])
    assert reachable is not None
    return {grid.index_of(int(cell)) for cell in np.flatnonzero(~reachable)}


def wholly_at_a_wall(grid, task):
    """Indices of the cells all of whose corners are too near to one and the same wall; walls are along the axes."""
    x, y = np.meshgrid(*grid.edges, indexing="ij")
    found = np.zeros(grid.shape, bool)
    for (x0, y0), (x1, y1) in SHIPPED[task].walls or ():
        away = np.hypot(np.maximum(np.maximum(x0 - x, x - x1), 0.0), np.maximum(np.maximum(y0 - y, y - y1), 0.0))
        near = away < ANT_CLEARANCE
        found |= near[:-1, :-1] & near[1:, :-1] & near[:-1, 1:] & near[1:, 1:]
    return set(zip(*(axis.tolist() for axis in np.nonzero(found)), strict=True))


def test_every_cell_of_the_point_maze_can_be_reached():
    reachable = reachable_cells(make_geometry(map_config()), SHIPPED["point_maze"])
    assert reachable is not None
    assert reachable.shape == (400,)
    assert reachable.all()
    of_centroids = reachable_cells(make_geometry(map_config(kind="cvt", cells=[100])), SHIPPED["point_maze"])
    assert of_centroids is not None
    assert of_centroids.all()


def test_cells_of_the_ant_maze_out_of_reach_are_those_at_its_walls():
    grid = Grid(SHIPPED["ant_maze"].descriptor_bounds, (150, 150))  # cells of half a metre; 70 of them end at 0
    blocked = blocked_cells(grid, "ant_maze")
    assert {(0, 0), (0, 75), (149, 20), (75, 0), (75, 149)} <= blocked  # border: up to 0.65 m
    assert not {(1, 75), (148, 20), (75, 1), (75, 148)} & blocked
    assert {(39, 76), (40, 143)} <= blocked  # the wall at x = -15 from y = 3 to 37
    assert not {(38, 76), (41, 143), (39, 75), (39, 144)} & blocked
    assert not {(20, 20), (120, 20), (100, 30)} & blocked  # start, goal, the pocket
    assert blocked == wholly_at_a_wall(grid, "ant_maze")
    ring, inner, shared = 4 * 149, 2 * (68 + 52 + 70), 2 + 2  # two at the border, two where two inner walls meet
    assert len(blocked) == ring + inner - shared


def test_the_ant_maze_s_own_map_has_no_cell_out_of_reach():
    assert not blocked_cells(make_geometry(map_config("ant_maze")), "ant_maze")


def test_cells_of_the_ant_trap_out_of_reach_are_those_at_its_walls():
    grid = Grid(SHIPPED["ant_trap"].descriptor_bounds, (60, 32))  # cells of half a metre
    blocked = blocked_cells(grid, "ant_trap")
    back = {(i, j) for i in (23, 24) for j in range(12, 20)}  # x = 12, y from -2 to 2
    arms = {(i, j) for i in range(14, 24) for j in (9, 10, 21, 22)}  # x from 7 to 12, y = -3 and 3
    assert back | arms == wholly_at_a_wall(grid, "ant_trap")
    # Between the ends of an arm and the back wall, a metre apart, cells that both cover together.
    assert blocked == back | arms | {(23, 11), (23, 20)}


def test_places_outside_the_task_s_bounds_are_out_of_reach():
    blocked = blocked_cells(Grid(((-2.0, 2.0), (-2.0, 2.0)), (20, 20)), "point_maze")
    inside = range(5, 15)
    assert blocked == {(i, j) for i in range(20) for j in range(20) if not (i in inside and j in inside)}


def test_without_walls_or_a_plane_nobody_knows():
    task = SHIPPED["point_maze"]
    assert reachable_cells(Grid(SQUARE, (20, 20)), dataclasses.replace(task, walls=None)) is None
    assert reachable_cells(Grid(SQUARE[:1], (20,)), task) is None


# What the task table says of walls and rewards


def test_walls_of_the_table_are_those_of_the_maze():
    lower, upper = (sum(faces) / 2 for faces in (point_maze.LOWER_WALL, point_maze.UPPER_WALL))
    expected = [
        [[point_maze.LOWER_WALL_FROM_X, lower], [1.0, lower]],
        [[-1.0, upper], [point_maze.UPPER_WALL_TO_X, upper]],
    ]
    np.testing.assert_allclose(np.array(SHIPPED["point_maze"].walls), expected, rtol=1e-12)


def test_an_ant_comes_as_near_to_a_wall_as_both_are_thick_less_what_the_wall_gives():
    assert pytest.approx(WALL_RADIUS + TORSO_RADIUS - 0.1) == ANT_CLEARANCE
    clearance = [SHIPPED[name].wall_clearance for name in ("point_maze", "ant_maze", "ant_trap")]
    assert clearance == [0.0, ANT_CLEARANCE, ANT_CLEARANCE]


@pytest.mark.parametrize(
    ("name", "goal", "within"), [("point_maze", point_maze.GOAL, 1e-4), ("ant_maze", ant_tasks.MAZE_GOAL, 0.1)]
)
def test_the_least_reward_of_a_maze_is_that_of_its_farthest_corner(name, goal, within):
    assert SHIPPED[name].goal == goal
    (x_low, x_high), (y_low, y_high) = SHIPPED[name].descriptor_bounds
    farthest = max(math.dist(goal, (x, y)) for x in (x_low, x_high) for y in (y_low, y_high))
    least = SHIPPED[name].least_reward
    assert least is not None
    assert 0.0 <= -least - farthest < within
