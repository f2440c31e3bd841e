"""Paths of elites go round walls where they are drawn: cases worked out by hand, and all elites of a PointMaze run."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from matplotlib.figure import Figure

from es_service import api, plots
from es_service.protocol.messages import TRACE_POINTS
from es_service.report import maps
from es_service.report.data import read_run
from es_service.report.floor import crosses, detours, plan_frame
from es_service.runs.snapshot import acting
from tests.references import point_maze
from workers.environments import SHIPPED

pytestmark = pytest.mark.usefixtures("workers_here")

POINT, TRAP = SHIPPED["point_maze"], SHIPPED["ant_trap"]
BOUNDS = ((-2.0, 2.0), (-2.0, 2.0))
UPRIGHT = ((0.0, -1.0), (0.0, 1.0))


def ways(path, *walls, bounds=BOUNDS, task_bounds=BOUNDS, clearance=0.0):
    task = replace(POINT, walls=walls, wall_clearance=clearance, descriptor_bounds=task_bounds)
    return {
        at: [tuple(place) for place in way.round(6).tolist()]
        for at, way in detours(np.array(path), task, bounds).items()
    }


def test_only_a_line_through_a_wall_is_replaced_and_by_the_shortest_way():
    """The plane is 4 wide, so a way goes 0.04 beside the corner of a wall without a width."""
    path = [(-1.0, -1.5), (-1.0, 0.5), (1.2, 0.5), (1.2, 1.5), (-1.0, 1.5)]
    assert ways(path, UPRIGHT) == {1: [(0.04, 1.04)]}
    assert ways(path[::-1], UPRIGHT) == {2: [(0.04, 1.04)]}
    assert ways(path, UPRIGHT, clearance=0.3) == {1: [(0.3, 1.3)]}
    assert ways([(x, -y) for x, y in path], UPRIGHT) == {1: [(0.04, -1.04)]}
    assert ways(path) == {}


def test_a_line_that_touches_the_end_of_a_wall_crosses_it():
    assert ways([(-1.0, 1.0), (1.2, 1.0)], UPRIGHT) == {0: [(0.04, 1.04)]}
    assert ways([(-1.0, 1.001), (1.2, 1.001)], UPRIGHT) == {}


@pytest.mark.parametrize("narrow", ["bounds", "task_bounds"])
def test_no_way_leaves_the_plane_that_is_drawn_or_that_of_the_task(narrow):
    """The way above is 2.5 long, the way below 3.8."""
    path: list = [(-1.0, 0.5), (1.2, 0.5)]
    region: dict = {narrow: ((-2.0, 2.0), (-2.0, 1.0))}
    assert ways(path, UPRIGHT, **region) == {0: []}
    assert ways([*path, (1.2, -2.1)], UPRIGHT, **region) == {0: [(-0.04, -1.04), (0.04, -1.04)]}


def test_a_way_goes_over_both_sides_of_a_pocket():
    """It does not slip through a corner, where two walls only touch."""
    pocket = (((-0.5, -1.0), (-0.5, 0.0)), ((-0.5, -1.0), (0.5, -1.0)), ((0.5, -1.0), (0.5, 0.0)))
    assert ways([(0.0, -0.2), (0.8, -0.2), (0.8, -1.0)], *pocket) == {0: [(0.46, 0.04)]}
    assert ways([(0.25, -0.75), (1.0, -1.5), (4.0, -1.5)], *pocket) == {0: [(0.46, 0.04), (0.54, 0.04)]}
    assert ways([(-0.7, -0.1), (0.7, -0.1)], *pocket) == {0: [(-0.46, 0.04), (0.46, 0.04)]}


def test_an_opening_that_is_too_narrow_is_not_passed():
    """An ant does not fit between back wall and arm of its trap, so it has left the trap by the arm's open end."""
    out, thin = TRAP.wall_clearance, replace(TRAP, wall_clearance=0.0)
    round_ = [(7.0 - out, 3.0 - out), (7.0 - out, 3.0 + out), (12.0 + out, 3.0 + out)]
    for end, expected in (((13.0, 2.0), round_), ((13.0, 3.2), round_[:2])):  # the line goes beside the back wall
        found = detours(np.array([(11.0, 1.5), end, (29.0, 2.0)]), TRAP, TRAP.descriptor_bounds)
        np.testing.assert_allclose(found[0], expected)
    found = detours(np.array([(11.0, 1.5), (13.0, 2.0)]), thin, TRAP.descriptor_bounds)
    np.testing.assert_allclose(found[0], [(12.3, 2.3)])


def test_what_no_way_leads_to_and_what_is_too_far_is_left_open():
    """The other lines of a path say how far an episode comes from one point to the next."""
    corners = [(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0), (-1.0, -1.0)]
    assert ways([(0.0, 0.0), (1.5, 0.0)], *pairwise(corners)) == {0: []}
    assert ways([(-1.0, 0.0), (1.0, 0.0)], ((0.0, -2.0), (0.0, 2.0))) == {0: []}
    through = [(-0.1, 0.0), (0.1, 0.0)]  # the way round the wall is 2.09 long
    assert ways([*through, (1.5, 0.0)], UPRIGHT) == {0: []}
    assert ways([*through, (1.6, 0.0)], UPRIGHT) != {0: []}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """PointMaze and MAP-Elites: after 30 generations, every third elite has passed the lower wall."""
    config = {
        "task": {"environment": "point_maze"},
        "policy": {"observation_normalization": False},
        "search": {"algorithm": "map_elites", "batch": 64, "iso_sigma": 0.1, "line_sigma": 0.2},
        "budget": {"generations": 30},
        "compute": {"engine": "inline", "workers": 1},
    }
    return api.run(config, tmp_path_factory.mktemp("detours") / "run").run.folder


def lines_of(path_T_2, around):
    """All lines that are drawn of a path, [N, 2, 2]."""
    found = []
    for at in range(len(path_T_2) - 1):
        places = around.get(at)
        if places is None or len(places):
            way = np.concatenate([path_T_2[at, None], *([] if places is None else [places]), path_T_2[at + 1, None]])
            found += [*pairwise(way)]
    return np.array(found, float)


def episode(run, elite):
    """All steps of an elite's stored episode, by the reference implementation, [T, 2]."""
    policy = acting(run.meta, elite)
    place, done = tuple(map(float, elite.trace_T_B[0])), False
    path = [place]
    while len(path) <= POINT.episode_steps:
        if not done:
            *place, _, done = point_maze.step(*place, policy(np.array(place, np.float32)))
        path.append(tuple(place))
    return np.array(path)


def test_no_path_of_an_elite_crosses_a_wall_and_dashed_ways_are_near_those_of_the_episodes(folder):
    run, walls = api.open_run(folder), POINT.walls or ()
    stored = np.arange(TRACE_POINTS) * POINT.episode_steps // (TRACE_POINTS - 1)
    straight, round_, known = 0, 0, 0
    for elite in run.elites()[1].values():
        path_T_2 = elite.trace_T_B
        straight += crosses(path_T_2[:-1], path_T_2[1:], walls).any()
        around = detours(path_T_2, POINT, POINT.descriptor_bounds)
        start_N_2, end_N_2 = lines_of(path_T_2, around).swapaxes(0, 1)
        assert not crosses(start_N_2, end_N_2, walls).any()
        steps_T_2 = episode(run, elite)
        if np.abs(steps_T_2[stored] - path_T_2).max() > 1e-3 or crosses(steps_T_2[:-1], steps_T_2[1:], walls).any():
            continue  # rounding made it another episode, or it slipped into a wall at its end, which is not solid
        known += 1
        for at, places in around.items():
            assert len(places), "an episode that went round is drawn"
            round_ += 1
            way_N_2 = np.concatenate([path_T_2[at, None], places, path_T_2[at + 1, None]])
            dense_2 = [a + share * (b - a) for a, b in pairwise(way_N_2) for share in np.linspace(0, 1, 50)]
            apart = np.linalg.norm(steps_T_2[stored[at] : stored[at + 1] + 1, None] - np.array(dense_2), axis=-1)
            assert apart.min(axis=1).max() < 0.12, "a step is 0.1 along an axis"
    assert straight > 10, "the run shows nothing"
    assert round_ > 10
    assert known > 0.9 * len(run.map)


def test_the_page_and_the_plot_draw_these_ways(folder):
    data, run = read_run(folder), api.open_run(folder)
    assert data.map is not None
    frame, cells = plan_frame(data.bounds), maps.path_lines(data)
    cell = next(cell for cell, ways in cells["detours"].items() if len(ways) == 1 and ways[0][1])
    path_T_2 = data.paths[int(cell)].astype(float)
    [(at, places)] = detours(path_T_2, POINT, data.bounds).items()
    drawn = zip(frame.across(places[:, 0]), frame.down(places[:, 1]), strict=True)
    text = "".join(f"L{x:.1f} {y:.1f}" for x, y in drawn)
    assert cells["detours"][cell] == [[at, text]]
    axes = Figure().subplots()
    plots.trajectory(run, axes, data.map.geometry.index_of(int(cell)), color="blue", label="path")
    line, dashed = (one for one in axes.lines if one.get_color() == "blue")
    np.testing.assert_array_equal(line.get_xydata(), np.insert(path_T_2, at + 1, np.nan, axis=0))
    np.testing.assert_array_equal(dashed.get_xydata(), [path_T_2[at], *places, path_T_2[at + 1]])
    assert dashed.get_linestyle() == "--"
    assert axes.get_legend_handles_labels()[1] == ["path"]
