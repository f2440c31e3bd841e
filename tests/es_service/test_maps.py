"""The behaviour map: cells of grids and centroids, what enters, what is counted and stored, what can be reached."""

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from es_service.api import load_config
from es_service.maps.behaviour_map import (
    GEOMETRY_PART,
    BehaviourMap,
    Elite,
    cell_part,
    elite_from_arrays,
    elite_part,
    elite_to_arrays,
    empty_map,
    insert,
    map_columns,
    map_from_parts,
    map_to_parts,
    with_score,
)
from es_service.maps.geometry import (
    Cvt,
    Grid,
    geometry_from_arrays,
    geometry_to_arrays,
    make_geometry,
    reachable_cells,
)
from tests.twins import behaviour_map as twin
from workers.environments import ANT_CLEARANCE, TASKS, ant_maze, ant_trap, point_maze
from workers.environments.ant import TORSO_RADIUS
from workers.environments.walls import WALL_RADIUS

PLANE = Grid(((0.0, 6.0), (0.0, 2.0)), (3, 4))
"""Cells of 2 by 0.5."""
SQUARE, OBLONG = ((-1.0, 1.0), (-1.0, 1.0)), ((0.0, 30.0), (-8.0, 8.0))


def map_config(task="point_maze", **settings):
    return load_config(
        {
            "task": {"environment": task},
            "search": {"algorithm": "es"},
            "map": settings,
            "budget": {"generations": 1},
        }
    ).map


# Grids


@pytest.mark.parametrize(
    ("descriptor", "index"),
    [
        ((0.0, 0.0), (0, 0)),
        ((1.99, 0.49), (0, 0)),
        ((2.0, 0.5), (1, 1)),  # an edge belongs to the upper cell
        ((4.0, 1.5), (2, 3)),
        ((6.0, 2.0), (2, 3)),  # but for the last one
        ((-0.1, 9.0), (0, 3)),  # outside: the border cell
        ((1e300, -1e300), (2, 0)),
        ((3.0, 1.0), (1, 2)),
    ],
)
def test_cells_of_a_grid_by_hand(descriptor, index):
    assert PLANE.index_of(int(PLANE.cells_of([descriptor])[0])) == index
    assert twin.grid_index(PLANE.bounds, PLANE.shape, descriptor) == index


def test_edges_by_hand():
    assert [edges.tolist() for edges in PLANE.edges] == [[0.0, 2.0, 4.0, 6.0], [0.0, 0.5, 1.0, 1.5, 2.0]]
    assert Grid(((-0.3, 0.1),), (7,)).edges[0][-1] == 0.1


finite = st.floats(-100.0, 100.0)
bounds_and_cells = st.lists(
    st.tuples(finite, st.floats(1e-3, 200.0), st.integers(1, 12)).map(lambda x: ((x[0], x[0] + x[1]), x[2])),
    min_size=1,
    max_size=3,
)


@given(bounds_and_cells, st.data())
def test_grids_equal_the_twin_on_any_descriptor_and_on_every_edge(sides, data):
    bounds, shape = zip(*sides, strict=True)
    grid = Grid(bounds, shape)
    descriptors = [
        [data.draw(st.sampled_from(edges.tolist()) | st.floats(-400.0, 400.0)) for edges in grid.edges]
        for _ in range(5)
    ]
    expected = [twin.cell_number(shape, twin.grid_index(bounds, shape, descriptor)) for descriptor in descriptors]
    assert grid.cells_of(descriptors).tolist() == expected


def test_five_thousand_descriptors_equal_the_twin():
    grid = Grid(((-35.0, 40.0), (-1.0, 0.1)), (20, 7))
    descriptors = np.random.default_rng(0).uniform([-40, -1.2], [45, 0.3], (5000, 2))
    expected = [twin.cell_number(grid.shape, twin.grid_index(grid.bounds, grid.shape, d)) for d in descriptors]
    assert grid.cells_of(descriptors).tolist() == expected
    assert len(set(expected)) == grid.size


def test_cells_are_numbered_with_the_last_dimension_fastest():
    assert [PLANE.index_of(cell) for cell in (0, 1, 3, 4, 11)] == [(0, 0), (0, 1), (0, 3), (1, 0), (2, 3)]
    assert all(PLANE.cell_at(PLANE.index_of(cell)) == cell for cell in range(PLANE.size))
    assert all(twin.cell_number(PLANE.shape, PLANE.index_of(cell)) == cell for cell in range(PLANE.size))


@pytest.mark.parametrize("index", [(3, 0), (0, 4), (-1, 0), (0,), (0, 0, 0), ()])
def test_there_is_no_cell_outside_the_grid(index):
    assert PLANE.cell_at(index) is None


# Centroids


@pytest.mark.parametrize("bounds", [SQUARE, OBLONG])
def test_centroids_are_the_same_for_every_call_and_their_cells_are_alike(bounds):
    config = map_config(kind="cvt", cells=[256], bounds=[list(pair) for pair in bounds])
    cvt, again = make_geometry(config), make_geometry(config)
    assert isinstance(cvt, Cvt)
    assert isinstance(again, Cvt)
    assert cvt.centroid_C_B.tobytes() == again.centroid_C_B.tobytes()
    low, high = np.array(bounds).T
    places = np.random.default_rng(0).uniform(low, high, (100_000, 2))
    size = np.bincount(cvt.cells_of(places), minlength=256) / (100_000 / 256)
    assert 0.25 < size.min() <= size.max() < 2.5
    np.testing.assert_array_equal(cvt.cells_of(cvt.centroid_C_B), np.arange(256))


def test_centroids_lie_in_the_middle_of_their_cells():
    cvt = make_geometry(map_config(kind="cvt", cells=[16]))
    assert isinstance(cvt, Cvt)
    places = np.random.default_rng(1).uniform(-1.0, 1.0, (50_000, 2))
    cell = cvt.cells_of(places)
    middle = np.array([places[cell == c].mean(axis=0) for c in range(16)])
    assert np.abs(middle - cvt.centroid_C_B).max() < 0.1  # a cell is half as wide as the square is high


def test_the_nearest_centroid_and_of_equally_near_ones_the_first():
    cvt = Cvt(SQUARE, np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 0.0], [0.0, 1.0]]))
    assert cvt.cells_of([[0.4, 0.1], [0.5, 0.0], [1.0, 0.0], [0.5, 0.5], [-9.0, 9.0]]).tolist() == [0, 0, 1, 0, 3]


def test_many_descriptors_equal_the_twin():
    rng = np.random.default_rng(0)
    cvt = Cvt(((0.0, 1.0),) * 3, rng.integers(0, 5, (40, 3)) / 4)  # many are equally near
    descriptors = rng.integers(-1, 10, (500, 3)) / 8
    assert cvt.cells_of(descriptors).tolist() == [twin.nearest_centroid(cvt.centroid_C_B, d) for d in descriptors]


def test_descriptors_do_not_depend_on_how_many_are_asked_together():
    rng = np.random.default_rng(0)
    cvt = Cvt(SQUARE, rng.uniform(-1, 1, (5000, 2)))
    descriptors = rng.uniform(-1, 1, (450, 2))  # more than are compared at once
    assert cvt.cells_of(descriptors).tolist() == [int(cvt.cells_of(one[None])[0]) for one in descriptors]


def test_a_centroid_s_place_is_its_number():
    cvt = Cvt(SQUARE, np.zeros((5, 2)))
    assert (cvt.size, cvt.shape, cvt.index_of(3)) == (5, (5,), (3,))
    assert [cvt.cell_at(index) for index in ((4,), (5,), (-1,), (0, 0))] == [4, None, None, None]


def test_geometries_come_back_as_they_were():
    grid = make_geometry(map_config(cells=[7, 3], bounds=[[-1, 2.5], [0.1, 0.3]]))
    assert grid == Grid(((-1.0, 2.5), (0.1, 0.3)), (7, 3)) == geometry_from_arrays(geometry_to_arrays(grid))
    cvt = make_geometry(map_config(kind="cvt", cells=[9]))
    again = geometry_from_arrays(geometry_to_arrays(cvt))
    assert isinstance(cvt, Cvt)
    assert isinstance(again, Cvt)
    assert again.bounds == cvt.bounds == SQUARE
    np.testing.assert_array_equal(again.centroid_C_B, cvt.centroid_C_B)


# Insertion


def filled(*offers, geometry=PLANE):
    """The map after these offers of (descriptor, fitness); generations 0, 1, ..., scores 100, 101, ..."""
    map_ = empty_map(geometry)
    for generation, (descriptor, fitness) in enumerate(offers):
        map_, _, _ = insert(map_, np.array(descriptor, float), fitness, generation, 0, 100.0 + generation)
    return map_


def columns_of(map_):
    return {field.name: getattr(map_, field.name) for field in dataclasses.fields(map_) if field.name != "geometry"}


def assert_same_map(map_, other):
    assert map_.geometry == other.geometry
    for name, values in columns_of(map_).items():
        np.testing.assert_array_equal(values, getattr(other, name))
        assert values.dtype == getattr(other, name).dtype


def test_an_empty_cell_is_entered_and_a_fitter_one_replaces_while_an_equal_one_does_not():
    first = filled(((1.0, 0.1), 5.0))
    equal, cell, entered = insert(first, np.array([1.5, 0.2]), 5.0, 1, 0, 7.0)
    assert (cell, entered) == (0, False)
    assert_same_map(equal, first)
    worse, cell, entered = insert(first, np.array([1.5, 0.2]), -9.0, 1, 0, 7.0)
    assert (cell, entered) == (0, False)
    assert_same_map(worse, first)
    better, cell, entered = insert(first, np.array([1.5, 0.2]), np.nextafter(5.0, 6.0), 8, 3, 7.0)
    assert (cell, entered, better.size) == (0, True, 1)
    assert better.descriptor_N_B.tolist() == [[1.5, 0.2]]
    assert (better.generation_N[0], better.member_N[0], better.score_N[0]) == (8, 3, 7.0)


def test_cells_stay_in_the_order_of_their_discovery():
    map_ = filled(((5.0, 1.9), 1.0), ((0.0, 0.0), 1.0), ((3.0, 1.0), 1.0), ((5.5, 1.8), 2.0), ((0.1, 0.1), 2.0))
    assert map_.cell_N.tolist() == [11, 0, 6]
    assert map_.generation_N.tolist() == [3, 4, 2]
    assert [map_.row_of(cell) for cell in (11, 0, 6, 5)] == [0, 1, 2, None]


def test_insertion_and_scores_leave_the_old_map_as_it_was():
    map_ = filled(((1.0, 0.1), 5.0), ((5.0, 1.9), 1.0))
    before = {name: values.copy() for name, values in columns_of(map_).items()}
    for values in columns_of(map_).values():
        values.setflags(write=False)
    insert(map_, np.array([1.0, 0.1]), 6.0, 2, 0, 0.0)
    insert(map_, np.array([3.0, 0.1]), 6.0, 2, 0, 0.0)
    with_score(map_, 11, 0, 9.0)
    for name, values in columns_of(map_).items():
        np.testing.assert_array_equal(values, before[name])


def test_a_score_is_changed_where_the_member_has_an_elite():
    map_ = filled(((1.0, 0.1), 5.0), ((5.0, 1.9), 1.0))
    assert with_score(map_, 11, 0, -3.0).score_N.tolist() == [100.0, -3.0]
    assert with_score(map_, 5, 0, -3.0) is map_
    assert with_score(map_, 11, 1, -3.0) is map_, "it is another member's by now"


def test_coverage_of_reachable_cells_knows_the_border_and_gives_up_on_too_many():
    maze = TASKS["ant_maze"]
    narrow = Grid(((-10.0, 0.0), (-10.0, 0.0)), (4, 4))  # inside the arena; whatever ends beyond counts to its border
    found = reachable_cells(narrow, maze)
    assert found is not None
    assert found.all()
    assert reachable_cells(Grid(maze.descriptor_bounds, (2, 5_000_000)), maze) is None
    long = reachable_cells(Grid(TASKS["point_maze"].descriptor_bounds, (20, 5000)), TASKS["point_maze"])
    assert long is not None
    assert long.all()


def test_cells_of_a_cvt_are_even_in_oblong_bounds_too():
    geometry = make_geometry(map_config(kind="cvt", cells=[64], bounds=[[0, 1], [0, 100]]))
    places = np.random.default_rng(0).uniform((0, 0), (1, 100), (64_000, 2))
    counts = np.bincount(geometry.cells_of(places), minlength=64)
    assert counts.min() > 400
    assert counts.max() < 2000


@given(
    st.lists(
        st.tuples(st.integers(-1, 8).map(float), st.integers(-2, 10).map(lambda x: x / 4), st.integers(0, 4)),
        max_size=30,
    )
)
def test_any_offers_give_the_twin_s_map_and_never_a_worse_one(offers):
    map_, other = empty_map(PLANE), twin.GridMap(PLANE.bounds, PLANE.shape)
    worst = np.full(PLANE.size, -np.inf)
    for generation, (x, y, fitness) in enumerate(offers):
        map_, cell, entered = insert(map_, np.array([x, y]), float(fitness), generation, 0, math.nan)
        index = other.insert(twin.Elite(float(fitness), (x, y), generation, math.nan))
        assert entered == (index is not None)
        assert not entered or PLANE.index_of(cell) == index
        fitness_C = np.full(PLANE.size, -np.inf)
        fitness_C[map_.cell_N] = map_.fitness_N
        assert (fitness_C >= worst).all()
        worst = fitness_C
    assert [PLANE.index_of(cell) for cell in map_.cell_N] == list(other.elites)
    assert map_.fitness_N.tolist() == [elite.fitness for elite in other.elites.values()]
    assert map_.generation_N.tolist() == [elite.generation for elite in other.elites.values()]
    columns = map_columns(map_, -2.0, None)
    assert columns["coverage"] == twin.coverage(other.elites, 12)
    assert columns["qd_score"] == twin.qd_score(other.elites, -2.0)


# Metrics


def test_metrics_by_hand():
    map_ = filled(((1.0, 0.1), -5.0), ((5.0, 1.9), -1.5), ((3.0, 0.0), -20.0))
    reachable = np.ones(12, bool)
    reachable[[0, 2, 3]] = False  # of 9 reachable cells 2 are filled; the first is out of reach
    assert map_columns(map_, -100.0, reachable) == {
        "map_cells": 3,
        "coverage": 0.25,
        "coverage_reachable": pytest.approx(2 / 9),
        "map_fitness_max": -1.5,
        "qd_score": 95.0 + 98.5 + 80.0,
    }


def test_metrics_of_an_empty_map():
    assert map_columns(empty_map(PLANE), -100.0, None) == {
        "map_cells": 0,
        "coverage": 0.0,
        "coverage_reachable": None,
        "map_fitness_max": None,
        "qd_score": 0.0,
    }


def test_the_qd_score_does_not_depend_on_the_order_of_its_terms():
    offers = [((1.0, 0.1), 1e16), ((5.0, 1.9), 1.0), ((3.0, 0.0), -1e16), ((3.0, 1.9), 1.0)]
    scores = {map_columns(filled(*order), 0.0, None)["qd_score"] for order in (offers, offers[::-1])}
    assert scores == {2.0}


# In the store


def test_a_map_comes_back_from_its_parts():
    map_ = filled(((5.0, 1.9), 1.0), ((0.0, 0.0), -2.5), ((3.0, 1.0), 1e-300), ((5.5, 1.8), 2.0))
    map_ = with_score(map_, 0, 0, math.nan)
    parts = map_to_parts(map_, None)
    assert set(parts) == {GEOMETRY_PART, cell_part(11), cell_part(0), cell_part(6)}
    others = {"member_0": {"cell": np.asarray(3)}, elite_part(4): {"centre_D": np.zeros(1)}}
    again = map_from_parts(dict(reversed((parts | others).items())))
    assert isinstance(again, BehaviourMap)
    assert_same_map(again, map_)


def test_an_empty_map_comes_back_and_no_map_stays_none():
    again = map_from_parts(map_to_parts(empty_map(PLANE), None))
    assert isinstance(again, BehaviourMap)
    assert_same_map(again, empty_map(PLANE))
    assert map_from_parts({"member_0": {}}) is None


def test_only_rows_that_changed_are_written():
    map_ = filled(((5.0, 1.9), 1.0), ((0.0, 0.0), -2.5), ((3.0, 1.0), 3.0))
    map_ = with_score(map_, 0, 0, math.nan)
    assert map_to_parts(map_, map_) == {}
    assert map_to_parts(with_score(map_, 0, 0, math.nan), map_) == {}
    assert set(map_to_parts(with_score(map_, 0, 0, 4.0), map_)) == {cell_part(0)}
    assert set(map_to_parts(with_score(map_, 11, 0, math.nan), map_)) == {cell_part(11)}
    new, _, _ = insert(map_, np.array([0.0, 1.9]), 0.0, 3, 0, math.nan)
    assert set(map_to_parts(new, map_)) == {cell_part(3)}
    replaced, _, _ = insert(with_score(map_, 11, 0, 7.0), np.array([3.0, 1.0]), 4.0, 3, 0, 102.0)
    assert set(map_to_parts(replaced, map_)) == {cell_part(11), cell_part(6)}
    assert set(map_to_parts(map_, empty_map(PLANE))) == {cell_part(cell) for cell in (11, 0, 6)}


def test_parts_written_one_change_at_a_time_give_the_last_map():
    rng = np.random.default_rng(0)
    map_ = empty_map(PLANE)
    stored = map_to_parts(map_, None)
    for generation in range(60):
        before = map_
        if map_.size and rng.random() < 0.5:
            map_ = with_score(map_, int(rng.choice(map_.cell_N)), 0, rng.normal())
        map_, _, _ = insert(map_, rng.uniform([0, 0], [6, 2]), rng.normal(), generation, 0, rng.normal())
        stored |= map_to_parts(map_, before)
    again = map_from_parts(stored)
    assert isinstance(again, BehaviourMap)
    assert_same_map(again, map_)
    assert map_.size == 12


def test_an_elite_comes_back_from_its_arrays():
    rng = np.random.default_rng(0)
    elite = Elite(*(rng.normal(size=shape).astype(np.float32) for shape in (7, 3, 3, (64, 2))))
    again = elite_from_arrays(elite_to_arrays(elite))
    for field in dataclasses.fields(Elite):
        np.testing.assert_array_equal(getattr(again, field.name), getattr(elite, field.name))


# What can be reached


def blocked_cells(grid, task):
    """Indices of the cells out of reach."""
    reachable = reachable_cells(grid, TASKS[task])
    assert reachable is not None
    return {grid.index_of(int(cell)) for cell in np.flatnonzero(~reachable)}


def wholly_at_a_wall(grid, task):
    """Indices of the cells all of whose corners are too near to one and the same wall; walls are along the axes."""
    x, y = np.meshgrid(*grid.edges, indexing="ij")
    found = np.zeros(grid.shape, bool)
    for (x0, y0), (x1, y1) in TASKS[task].walls or ():
        away = np.hypot(np.maximum(np.maximum(x0 - x, x - x1), 0.0), np.maximum(np.maximum(y0 - y, y - y1), 0.0))
        near = away < ANT_CLEARANCE
        found |= near[:-1, :-1] & near[1:, :-1] & near[:-1, 1:] & near[1:, 1:]
    return set(zip(*(axis.tolist() for axis in np.nonzero(found)), strict=True))


def test_every_cell_of_the_point_maze_can_be_reached():
    reachable = reachable_cells(make_geometry(map_config()), TASKS["point_maze"])
    assert reachable is not None
    assert reachable.shape == (400,)
    assert reachable.all()
    of_centroids = reachable_cells(make_geometry(map_config(kind="cvt", cells=[100])), TASKS["point_maze"])
    assert of_centroids is not None
    assert of_centroids.all()


def test_cells_of_the_ant_maze_out_of_reach_are_those_at_its_walls():
    grid = Grid(TASKS["ant_maze"].descriptor_bounds, (150, 150))  # cells of half a metre; 70 of them end at 0
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
    grid = Grid(TASKS["ant_trap"].descriptor_bounds, (60, 32))  # cells of half a metre
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
    task = TASKS["point_maze"]
    assert reachable_cells(Grid(SQUARE, (20, 20)), dataclasses.replace(task, walls=None)) is None
    assert reachable_cells(Grid(SQUARE[:1], (20,)), task) is None


# What the task table says of walls and rewards


def test_walls_of_the_table_are_those_of_the_tasks():
    assert TASKS["ant_maze"].walls == ant_maze.WALLS
    assert TASKS["ant_trap"].walls == ant_trap.WALLS
    assert TASKS["ant_trap"].descriptor_bounds == ant_trap.DESCRIPTOR_BOUNDS
    lower, upper = (sum(faces) / 2 for faces in (point_maze.LOWER_WALL, point_maze.UPPER_WALL))
    expected = [
        [[point_maze.LOWER_WALL_FROM_X, lower], [1.0, lower]],
        [[-1.0, upper], [point_maze.UPPER_WALL_TO_X, upper]],
    ]
    np.testing.assert_allclose(np.array(TASKS["point_maze"].walls), expected, rtol=1e-12)


def test_an_ant_comes_as_near_to_a_wall_as_both_are_thick_less_what_the_wall_gives():
    assert pytest.approx(WALL_RADIUS + TORSO_RADIUS - 0.1) == ANT_CLEARANCE
    clearance = [TASKS[name].wall_clearance for name in ("point_maze", "ant_maze", "ant_trap")]
    assert clearance == [0.0, ANT_CLEARANCE, ANT_CLEARANCE]


@pytest.mark.parametrize(
    ("name", "goal", "within"), [("point_maze", point_maze.GOAL, 1e-4), ("ant_maze", ant_maze.GOAL, 0.1)]
)
def test_the_least_reward_of_a_maze_is_that_of_its_farthest_corner(name, goal, within):
    (x_low, x_high), (y_low, y_high) = TASKS[name].descriptor_bounds
    farthest = max(math.dist(goal, (x, y)) for x in (x_low, x_high) for y in (y_low, y_high))
    least = TASKS[name].least_reward
    assert least is not None
    assert 0.0 <= -least - farthest < within
