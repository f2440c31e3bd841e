"""The floor plan under maps and clouds: the plane of a two-dimensional descriptor, its walls and its goal."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

from es_service.protocol.messages import Bounds, TaskSpec
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
