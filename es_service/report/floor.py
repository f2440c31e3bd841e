"""The floor plan of a two-dimensional descriptor, its walls and its goal, and the paths of elites round the walls."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cache
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from es_service.protocol.messages import Bounds, Segment, TaskSpec
from es_service.report.markup import Frame, Markup, joined, tag, tick_text, ticks
from es_service.search.maps.behaviour_map import BehaviourMap
from es_service.search.maps.geometry import Grid

WIDTH = 520
MOST_HEIGHT, LEAST_HEIGHT = 560.0, 120.0
LEFT, TOP, RIGHT, BOTTOM = 52, 8, 10, 40

Range = tuple[float, float]


def plan_frame(bounds: Bounds, width: float = WIDTH) -> Frame:
    """Frame of a plane, with the same scale along both dimensions unless it would be too flat or too high."""
    (x_low, x_high), (y_low, y_high) = bounds
    inner = width - LEFT - RIGHT
    height = inner * (y_high - y_low) / (x_high - x_low)
    if not LEAST_HEIGHT <= height <= MOST_HEIGHT:
        height = inner * 0.75  # the dimensions are of different kinds
    return Frame((x_low, x_high), (y_low, y_high), LEFT, TOP, inner, height)


def size(frame: Frame) -> tuple[float, float]:
    """Width and height of the figure that holds a frame and the labels of its axes."""
    return frame.left + frame.width + RIGHT, frame.top + frame.height + BOTTOM


def ground(frame: Frame, names: Sequence[str]) -> Markup:
    """The plane itself and its axes, to be drawn first."""
    bottom = frame.top + frame.height
    content = [tag("rect", x=frame.left, y=frame.top, width=frame.width, height=frame.height, class_="ground")]
    for values, horizontal in ((ticks(*frame.x), True), (ticks(*frame.y), False)):
        step = values[1] - values[0] if len(values) > 1 else 1.0
        for value in values:
            text = tick_text(value, step)
            if horizontal:
                x = f"{float(frame.across(value)):.1f}"
                content.append(tag("text", text, x=x, y=bottom + 16, class_="tick middle"))
            else:
                y = f"{float(frame.down(value)):.1f}"
                content.append(tag("text", text, x=frame.left - 6, y=y, dy="0.32em", class_="tick end"))
    middle = frame.top + frame.height / 2
    content += [
        tag("text", names[0], x=frame.left + frame.width / 2, y=bottom + 33, class_="label middle"),
        tag("text", names[1], transform=f"translate(8 {middle:.1f}) rotate(-90)", class_="label middle"),
    ]
    return joined(content)


def walls_and_goal(frame: Frame, task: TaskSpec) -> Markup:
    """The walls and the goal of a task whose descriptor is a position, to be drawn above the cells."""
    content = []
    for (x0, y0), (x1, y1) in task.walls or ():
        ends = [f"{float(at):.1f}" for at in (*frame.across([x0, x1]), *frame.down([y0, y1]))]
        content.append(tag("line", x1=ends[0], x2=ends[1], y1=ends[2], y2=ends[3], class_="wall"))
    if task.goal is not None:
        x, y = float(frame.across(task.goal[0])), float(frame.down(task.goal[1]))
        content.append(tag("circle", cx=f"{x:.1f}", cy=f"{y:.1f}", r=7, class_="goal-under"))
        content.append(tag("circle", tag("title", "goal"), cx=f"{x:.1f}", cy=f"{y:.1f}", r=7, class_="goal"))
        content.append(tag("circle", cx=f"{x:.1f}", cy=f"{y:.1f}", r=2, class_="goal-middle"))
    return joined(content)


def beside_walls(map_: BehaviourMap, task: TaskSpec) -> dict[int, tuple[Range, Range]]:
    """Cells of a grid in the plane that a wall divides: cell -> the part on the side of its elite.

    At least three tenths of the cell's extent is drawn: a place on an edge belongs to the upper or right cell, so an
    elite that ended under a wall may be in a cell that lies nearly all behind it. Walls along an axis only.
    """
    geometry = map_.geometry
    if not isinstance(geometry, Grid) or len(geometry.bounds) != 2:
        return {}
    parts = {}
    for cell, place_2 in zip(map_.cell_N.tolist(), map_.descriptor_N_B.tolist(), strict=True):
        index = geometry.index_of(cell)
        extents = [(edges[at], edges[at + 1]) for edges, at in zip(geometry.edges, index, strict=True)]
        for (start, end), (across, along) in product(task.walls or (), ((0, 1), (1, 0))):
            (low, high), wall = extents[across], start[across]
            beside = min(start[along], end[along]) <= place_2[along] <= max(start[along], end[along])
            if wall == end[across] and beside and low <= wall <= high:
                least = 0.3 * (high - low)
                below = place_2[across] <= wall
                extents[across] = (min(low, wall - least), wall) if below else (wall, max(high, wall + least))
                parts[cell] = (extents[0], extents[1])
    return parts


def is_plan(task: TaskSpec, names: Sequence[str]) -> bool:
    """Whether the descriptor is a position on the floor, as far as the task says so."""
    return len(names) == 2 and (bool(task.walls) or task.goal is not None)


# How the path of an elite is drawn where a wall is between two of its stored points.
#
# A run stores at most 64 points of an episode (`TRACE_POINTS`). A straight line between two of them may therefore cross
# a wall that the episode went round, and would show what has not happened. Such a line is not drawn. In its place, the
# shortest way round the walls is drawn dashed, because what the episode did there is unknown. A gap is left if there is
# no such way, or if it is so long that the episode cannot have taken it.
#
# Storing more points instead would change the digest of every run, and would not help runs that exist. This way the
# stored points stay what they are, no episode is computed again, and a run can also be drawn where its task is missing.
# A replay shows all steps of an episode.
#
# Axes: T stored points, W walls, C places beside the corners of walls.

Places = NDArray[np.float64]
MARGIN = 0.01
"""How far beyond and beside the end of a wall a way goes round it, as a share of the longer side of the plane; farther
if the task has a larger `wall_clearance`."""
LONGEST = 1.5
"""A way round is drawn if it is at most this many times as long as the longest straight line of the path. Stored points
are equally many steps apart, so that line says how far the episode came in these steps, if not how far it could."""


def detours(path_T_2: NDArray[Any], task: TaskSpec, bounds: Bounds) -> dict[int, Places]:
    """Lines of a path that are not drawn straight, because they would cross a wall.

    Args:
        path_T_2: positions in the plane, as they are drawn.
        bounds: the part of the plane that is drawn.

    Returns:
        number of a point -> the places, [N, 2], by which the way to the next point goes round walls. None (N = 0): no
        way is drawn.
    """
    if not task.walls:
        return {}
    path_T_2, walls = np.asarray(path_T_2, np.float64), _closed(task.walls, task.wall_clearance)
    crossing = np.flatnonzero(crosses(path_T_2[:-1], path_T_2[1:], walls))
    if not crossing.size:
        return {}
    longest = LONGEST * float(np.linalg.norm(np.diff(path_T_2, axis=0), axis=1).max())
    inside = tuple(
        (max(low, task_low), min(high, task_high))
        for (low, high), (task_low, task_high) in zip(bounds, task.descriptor_bounds, strict=True)
    )
    plan = walls, task.wall_clearance, inside
    return {int(at): _way_round(path_T_2[at], path_T_2[at + 1], longest, *plan) for at in crossing}


def crosses(start_N_2: NDArray[Any], end_N_2: NDArray[Any], walls: tuple[Segment, ...]) -> NDArray[np.bool_]:
    """Whether each straight line crosses a wall or touches the end of one; other points on a wall count for neither
    side. The axes before the last are broadcast."""
    first_W_2, last_W_2 = np.array(walls, np.float64).transpose(1, 0, 2)
    start, end = start_N_2[..., None, :], end_N_2[..., None, :]
    apart = _side(first_W_2, last_W_2, start) * _side(first_W_2, last_W_2, end) < 0.0
    between = _side(start, end, first_W_2) * _side(start, end, last_W_2) <= 0.0
    return np.asarray((apart & between).any(axis=-1))


def _side(start: Places, end: Places, place: Places) -> Places:
    """Positive to the left of a line, negative to its right, 0 on it."""
    way, off = end - start, place - start
    return way[..., 0] * off[..., 1] - way[..., 1] * off[..., 0]


@cache
def _closed(walls: tuple[Segment, ...], clearance: float) -> tuple[Segment, ...]:
    """Walls, and lines across the openings between them that are too narrow for an episode to pass."""
    wall_W_2_2, segments = np.array(walls, np.float64), list(walls)
    for x, y in wall_W_2_2.reshape(-1, 2).tolist():
        near_W_2 = _nearest(np.array([x, y]), wall_W_2_2).tolist()
        segments += [((x, y), (a, b)) for a, b in near_W_2 if 0.0 < math.hypot(a - x, b - y) < 2.0 * clearance]
    return tuple(segments)


def _way_round(
    start_2: Places, end_2: Places, longest: float, walls: tuple[Segment, ...], clearance: float, bounds: Bounds
) -> Places:
    """Places between two points on the shortest way that crosses no wall, [N, 2]; empty if there is none."""
    place_C_2, length_C_C, before_C_C = _ways_between_corners(walls, clearance, bounds)
    to_C, from_C = (
        np.where(crosses(point_2, place_C_2, walls), np.inf, np.linalg.norm(place_C_2 - point_2, axis=-1))
        for point_2 in (start_2, end_2)
    )
    whole_C_C = to_C[:, None] + length_C_C + from_C
    if whole_C_C.min(initial=np.inf) > longest:
        return np.zeros((0, 2))
    first, last = np.unravel_index(whole_C_C.argmin(), whole_C_C.shape)
    corners = [last]
    while corners[-1] != first:
        corners.append(before_C_C[first, corners[-1]])
    return place_C_2[corners[::-1]]


@cache
def _ways_between_corners(
    walls: tuple[Segment, ...], clearance: float, bounds: Bounds
) -> tuple[Places, Places, NDArray[np.int32]]:
    """Places at the corners of walls, two at each end, where an episode can be, [C, 2]; the lengths of the shortest
    ways between them [C, C]; and the last place before the second one on the way from the first [C, C]."""
    from scipy.sparse.csgraph import shortest_path  # takes 0.1 s, and most figures do not need it

    low_2, high_2 = np.array(bounds, np.float64).T
    wall_W_2_2 = np.array(walls, np.float64)
    margin = max(clearance, MARGIN * float((high_2 - low_2).max()))
    places = []
    for number, (first_2, last_2) in enumerate(wall_W_2_2):
        beyond_2 = margin * (last_2 - first_2) / np.linalg.norm(last_2 - first_2)
        aside_2 = beyond_2[::-1] * (-1.0, 1.0)
        others = np.delete(wall_W_2_2, number, axis=0)
        for end_2, side in product((first_2 - beyond_2, last_2 + beyond_2), (1.0, -1.0)):
            place_2 = end_2 + side * aside_2
            apart_W = np.linalg.norm(_nearest(place_2, others) - place_2, axis=1)
            if (low_2 <= place_2).all() and (place_2 <= high_2).all() and (apart_W >= clearance).all():
                places.append(place_2)
    if not places:
        return np.zeros((0, 2)), np.zeros((0, 0)), np.zeros((0, 0), np.int32)
    place_C_2 = np.array(places)
    straight_C_C = np.linalg.norm(place_C_2[:, None] - place_C_2, axis=-1)
    straight_C_C[crosses(place_C_2[:, None], place_C_2, walls)] = np.inf
    return place_C_2, *shortest_path(straight_C_C, return_predecessors=True)


def _nearest(place_2: Places, wall_W_2_2: Places) -> Places:
    """The nearest place of each wall, [W, 2]."""
    start_W_2, way_W_2 = wall_W_2_2[:, 0], wall_W_2_2[:, 1] - wall_W_2_2[:, 0]
    along_W = np.clip(((place_2 - start_W_2) * way_W_2).sum(axis=1) / (way_W_2**2).sum(axis=1), 0.0, 1.0)
    return start_W_2 + along_W[:, None] * way_W_2
