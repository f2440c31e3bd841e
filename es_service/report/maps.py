"""The behaviour map as SVG: a heat map over the floor plan, or what shows the cells of other maps best.

- A grid of one dimension: a bar for each cell.
- A grid of two: a heat map. A cvt map of two: its Voronoi cells.
- A grid of more: a heat map of heat maps, in which the dimensions alternate between right and up; the first ones give
  the large blocks, the last ones the cells inside them.
- A cvt map of more: the elites as points, one figure for each pair of the first four dimensions.
- A dominated map: the elites as points, at their descriptors.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from es_service.report import floor
from es_service.report.curves import axis_lines
from es_service.report.data import RunData
from es_service.report.floor import Range, detours
from es_service.report.markup import LEVELS, SCALE, Frame, Markup, joined, level, packed, spread, tag, value_range
from es_service.report.summary import number
from es_service.search.maps.behaviour_map import BehaviourMap, empty_map, projected
from es_service.search.maps.geometry import Cvt, Dominated, Grid, intervals, tessellation

SMALL = 250
"""Width of a figure when several are shown side by side."""
PAIRED_DIMENSIONS = 4
PATH_HEIGHT = 160
TENTHS = 10.0
"""Paths are stored in tenths of a pixel."""


def draw_map(data: RunData, colours: Range | None = None) -> tuple[Markup, str, Frame | None]:
    """Figure, explanation, and for two dimensions the frame of the plane.

    Args:
        colours: fitness values of the first and last colour; None: those of this map.
    """
    map_ = data.map
    assert map_ is not None
    colours = colours or value_range(map_.fitness_N)
    level_N = level(map_.fitness_N, *colours)
    dimensions = len(map_.geometry.bounds)
    if dimensions == 2:
        frame = floor.plan_frame(map_.geometry.bounds, floor.WIDTH)
        parts = floor.beside_walls(map_, data.task)
        text = "Each cell shows the fitness of its elite."
        if isinstance(map_.geometry, Grid):
            shapes = _rectangles(map_, frame, level_N, parts)
            text += (
                " A strip at a wall is an elite that ended there, on the edge of a cell behind the wall."
                if parts
                else ""
            )
        elif isinstance(map_.geometry, Dominated):
            shapes = _points(map_, frame, level_N, *map_.descriptor_N_B.T)
            text = "Each point is an elite, at its descriptor; its colour is its fitness."
        else:
            shapes = _voronoi(map_, frame, level_N)
        path = tag("g", class_="path")  # of a chosen cell
        content = [floor.ground(frame, data.names), *shapes, floor.walls_and_goal(frame, data.task), path]
        return _svg(content, *floor.size(frame)), text, frame
    if dimensions == 1:
        text = "Each bar is a cell; its height is the fitness of its elite."
        if isinstance(map_.geometry, Dominated):
            text = "Each point is an elite, at its descriptor and its fitness."
        return _of_one_dimension(map_, data.names, level_N, colours), text, None
    if not isinstance(map_.geometry, Grid):
        text = (
            f"Each point is an elite, at its place in {min(dimensions, PAIRED_DIMENSIONS)} of {dimensions} dimensions."
        )
        return _pairs(map_, data.names, level_N), text, None
    return _stacked(map_, data.names, level_N)


def has_area(map_: BehaviourMap) -> bool:
    """Whether the figure of a map is covered by its cells, so that empty ones are seen."""
    dimensions, kind = len(map_.geometry.bounds), type(map_.geometry)
    return (dimensions == 2 and kind is not Dominated) or (dimensions > 2 and kind is Grid)


def empty_pattern() -> Markup:
    """Hatching of empty cells, which no colour of the scale is like, also in print; a page with maps needs it once."""
    lines = tag("path", d="M-1 1l2-2M0 6l6-6M5 7l2-2", class_="hatch")
    pattern = tag("pattern", tag("rect", width=6, height=6, class_="hatched"), lines, id="empty", width=6, height=6,
                  patternUnits="userSpaceOnUse")  # fmt: skip
    return tag("svg", tag("defs", pattern), class_="defined", aria_hidden="true")


def colour_bar(colours: Range, *, cells: bool = False) -> Markup:
    """Legend of the colours of fitness; `cells`: with the hatching of empty cells."""
    steps = [tag("rect", x=f"{100 * i / LEVELS:.3f}%", width="3.3%", height=12, fill=SCALE[i]) for i in range(LEVELS)]
    return tag(
        "div",
        tag("span", number(colours[0])),
        tag("svg", *steps, class_="scale", height=12, role="img", aria_label="Colours of fitness"),
        tag("span", number(colours[1])),
        tag("span", "fitness", class_="note"),
        tag("span", tag("svg", tag("rect", width=22, height=10, class_="ground"), class_="swatch cells"), "empty cell",
            class_="key") if cells else None,
        class_="legend",
    )  # fmt: skip


def _svg(content: list[Markup], width: float, height: float, class_: str = "map cells") -> Markup:
    outline = tag("g", class_="outline")  # of the chosen cell, above its neighbours
    return tag("svg", *content, outline, viewBox=f"0 0 {width:.0f} {height:.0f}", class_=class_, role="img",
               tabindex=0, aria_label="Behaviour map; arrow keys choose a cell")  # fmt: skip


def _rectangles(
    map_: BehaviourMap, frame: Frame, level_N: NDArray[np.int64], parts: Mapping[int, tuple[Range, Range]]
) -> list[Markup]:
    assert isinstance(map_.geometry, Grid)
    across, down = (place(edges) for place, edges in zip((frame.across, frame.down), map_.geometry.edges, strict=True))
    rectangles, above = [], []
    for cell, colour in zip(map_.cell_N.tolist(), level_N.tolist(), strict=True):
        i, j = map_.geometry.index_of(cell)
        if cell in parts:
            (left, right), (bottom, top) = frame.across(parts[cell][0]), frame.down(parts[cell][1])
            above.append(_rectangle(cell, colour, left, top, right, bottom))
        else:
            rectangles.append(_rectangle(cell, colour, across[i], down[j + 1], across[i + 1], down[j]))
    return rectangles + above


def _rectangle(cell: int, colour: int, left: float, top: float, right: float, bottom: float) -> Markup:
    return Markup(  # without `tag`, since there may be ten thousand
        f'<rect x="{left:.1f}" y="{top:.1f}" width="{right - left:.1f}" height="{bottom - top:.1f}" '
        f'fill="{SCALE[colour]}" data-c="{cell}"/>'
    )


def _voronoi(map_: BehaviourMap, frame: Frame, level_N: NDArray[np.int64]) -> list[Markup]:
    """Voronoi cells of the centroids inside the bounds, in units in which both dimensions are equally long."""
    from scipy.spatial import Voronoi

    assert isinstance(map_.geometry, Cvt)
    low_2, high_2 = np.array(map_.geometry.bounds).T
    place_C_2 = (map_.geometry.centroid_C_B - low_2) / (high_2 - low_2)
    # With a mirror image of all centroids beyond each side, the sides are edges of the cells inside.
    mirrored = [place_C_2]
    for axis in range(2):
        for side in (0.0, 1.0):
            image = place_C_2.copy()
            image[:, axis] = 2 * side - image[:, axis]
            mirrored.append(image)
    diagram = Voronoi(np.concatenate(mirrored))
    polygons = []
    for cell, colour in zip(map_.cell_N.tolist(), level_N.tolist(), strict=True):
        corners = low_2 + diagram.vertices[diagram.regions[diagram.point_region[cell]]] * (high_2 - low_2)
        points = " ".join(
            f"{x:.1f},{y:.1f}" for x, y in zip(frame.across(corners[:, 0]), frame.down(corners[:, 1]), strict=True)
        )
        polygons.append(Markup(f'<polygon points="{points}" fill="{SCALE[colour]}" data-c="{cell}"/>'))
    return polygons


def _of_one_dimension(map_: BehaviourMap, names: Sequence[str], level_N: NDArray[np.int64], colours: Range) -> Markup:
    low, high = spread([map_.fitness_N, np.array(colours)])
    frame = Frame(map_.geometry.bounds[0], (low, high), 64, 8, floor.WIDTH - 74, 220)
    bottom, height_N = frame.top + frame.height, np.maximum(map_.fitness_N, low)
    if isinstance(map_.geometry, Dominated):
        shapes = _points(map_, frame, level_N, map_.descriptor_N_B[:, 0], height_N)
    else:
        across = frame.across(intervals(map_.geometry)).tolist()
        shapes = [
            _rectangle(cell, colour, across[cell][0], top, across[cell][1], bottom)
            for cell, colour, top in zip(map_.cell_N, level_N, frame.down(height_N), strict=True)
        ]
    return _svg([axis_lines(frame, names[0]), *shapes], floor.WIDTH, bottom + 40)


def _points(
    map_: BehaviourMap, frame: Frame, level_N: NDArray[np.int64], x_N: NDArray[np.float64], y_N: NDArray[np.float64]
) -> list[Markup]:
    """The elites as points, those outside of the frame at its border."""
    return [
        Markup(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3.5" fill="{SCALE[colour]}" data-c="{cell}"/>')
        for cell, colour, x, y in zip(
            map_.cell_N.tolist(),
            level_N.tolist(),
            frame.across(np.clip(x_N, *frame.x)),
            frame.down(np.clip(y_N, *frame.y)),
            strict=True,
        )
    ]


def _stacked(map_: BehaviourMap, names: Sequence[str], level_N: NDArray[np.int64]) -> tuple[Markup, str, None]:
    shape = map_.geometry.shape
    right, up = range(0, len(shape), 2), range(1, len(shape), 2)
    columns, rows = (int(np.prod([shape[b] for b in axes])) for axes in (right, up))
    width, height = 500.0, min(500.0, max(120.0, 500.0 * rows / columns))
    frame = Frame((0.0, float(columns)), (0.0, float(rows)), 8, 8, width, height)
    content = [tag("rect", x=8, y=8, width=width, height=height, class_="ground")]
    for cell, colour in zip(map_.cell_N.tolist(), level_N.tolist(), strict=True):
        index = map_.geometry.index_of(cell)
        x, y = (int(np.ravel_multi_index([index[b] for b in axes], [shape[b] for b in axes])) for axes in (right, up))
        left, after = frame.across([x, x + 1])
        bottom, top = frame.down([y, y + 1])
        content.append(_rectangle(cell, colour, left, top, after, bottom))
    for i in range(1, shape[0]):
        x = f"{float(frame.across(i * columns / shape[0])):.1f}"
        content.append(tag("line", x1=x, x2=x, y1=8, y2=8 + height, class_="block"))
    for j in range(1, shape[1]):
        y = f"{float(frame.down(j * rows / shape[1])):.1f}"
        content.append(tag("line", x1=8, x2=8 + width, y1=y, y2=y, class_="block"))
    order = [" then ".join(names[b] for b in axes) for axes in (right, up)]
    text = (
        f"Each cell shows the fitness of its elite. To the right: {order[0]}; upwards: {order[1]}, from large to small."
    )
    return _svg(content, width + 16, height + 16), text, None


def _pairs(map_: BehaviourMap, names: Sequence[str], level_N: NDArray[np.int64]) -> Markup:
    bounds = map_.geometry.bounds
    figures = []
    for a, b in combinations(range(min(len(bounds), PAIRED_DIMENSIONS)), 2):
        frame = Frame(bounds[a], bounds[b], floor.LEFT, 8, SMALL - 62, SMALL - 62)
        points = _points(map_, frame, level_N, map_.descriptor_N_B[:, a], map_.descriptor_N_B[:, b])
        content = [floor.ground(frame, (names[a], names[b])), *points]
        figures.append(_svg(content, *floor.size(frame), class_="map small"))
    return tag("div", *figures, class_="pairs")


def cell_rows(data: RunData) -> dict[str, list[str]]:
    """Number of a cell -> its name and its values in words."""
    map_, rows = data.map, {}
    assert map_ is not None
    for row, cell in enumerate(map_.cell_N.tolist()):
        place = ", ".join(
            f"{name} {number(float(x))}" for name, x in zip(data.names, map_.descriptor_N_B[row], strict=True)
        )
        text = f"fitness {number(float(map_.fitness_N[row]))}; {place}; found in generation {map_.generation_N[row]:,}"
        rows[str(cell)] = [data.cell_name(cell), text]
    return rows


def path_lines(data: RunData) -> dict[str, Any]:
    """The paths of `data.paths` for the page's script.

    Returns:
        `order`: numbers of the cells; `paths`: their paths in base64; `points`: the length of each; `lines`: number of
        curves of a path, each with x and y; `detours`: number of a cell -> [number of a point, way from there to the
        next point as SVG] where no straight line is drawn.
    """
    map_ = data.map
    assert map_ is not None
    known = [cell for cell in map_.cell_N.tolist() if cell in data.paths]
    script_data: dict[str, Any] = {"order": known, "points": 0, "lines": 1, "detours": {}, "paths": ""}
    if not known:
        return script_data
    path_N_T_B = np.stack([data.paths[cell] for cell in known]).astype(np.float64)
    points = path_N_T_B.shape[1]
    if len(map_.geometry.bounds) == 2:
        frame = floor.plan_frame(map_.geometry.bounds)
        inside_N_T_B = np.clip(path_N_T_B, *np.array(map_.geometry.bounds).T)  # an episode may leave the map meanwhile
        lines = np.stack([frame.across(inside_N_T_B[..., 0]), frame.down(inside_N_T_B[..., 1])], axis=-1)
        script_data["detours"] = {
            str(cell): [[at, _way(frame, places)] for at, places in detours_at.items()]
            for cell, inside_T_B in zip(known, inside_N_T_B, strict=True)
            if (detours_at := detours(inside_T_B, data.task, map_.geometry.bounds))
        }
        return script_data | {"points": points, "paths": packed(TENTHS * lines, "int16")}
    steps, shown = float(data.constants["task.episode_steps"]), min(len(data.names), PAIRED_DIMENSIONS)
    time = Frame((0.0, steps), (0.0, 1.0), 40, 8, floor.WIDTH - 50, PATH_HEIGHT - 48)
    low_B, high_B = np.array(data.bounds).T
    share = np.clip((path_N_T_B - low_B) / (high_B - low_B), -0.02, 1.02)[..., :shown]
    x = np.broadcast_to(time.across(np.linspace(*time.x, points))[:, None], share.shape)
    lines = np.stack([x, time.down(share)], axis=-1).transpose(0, 2, 1, 3)
    return script_data | {"points": points, "lines": shown, "paths": packed(TENTHS * lines, "int16")}


def path_figure(data: RunData) -> Markup:
    """Empty figure for the path of a chosen cell where it cannot be drawn above the map."""
    shown = min(len(data.names), PAIRED_DIMENSIONS)
    legend = [tag("span", tag("i", class_=f"dot s{b}"), data.names[b], class_="key") for b in range(shown)]
    box = tag("rect", x=40, y=8, width=floor.WIDTH - 50, height=PATH_HEIGHT - 48, class_="ground")
    labels = joined(
        [
            tag("text", "step of the episode", x=floor.WIDTH / 2, y=PATH_HEIGHT - 8, class_="label middle"),
            tag("text", "low", x=2, y=PATH_HEIGHT - 42, class_="tick"),
            tag("text", "high", x=0, y=16, class_="tick"),
        ]
    )
    chart = tag("svg", box, labels, tag("g", class_="path"), viewBox=f"0 0 {floor.WIDTH} {PATH_HEIGHT}", class_="map")
    caption = tag("figcaption", "Descriptor in the course of the chosen elite's episode, between the map's bounds")
    return tag("figure", caption, chart, tag("div", *legend, class_="legend"))


def _way(frame: Frame, place_N_2: NDArray[np.float64]) -> str:
    """Lines to places of the plane, one after the other, for the `d` of a path."""
    across, down = frame.across(place_N_2[:, 0]), frame.down(place_N_2[:, 1])
    return "".join(f"L{x:.1f} {y:.1f}" for x, y in zip(across, down, strict=True))


# Maps that are made of several: over the seeds of a group, and of one run at earlier times.
#
# Each is returned as a run with that map in the place of its own, so that it is drawn as any map is.

Over = Literal["share", "median"]


def over_seeds(runs: Sequence[RunData], over: Over) -> RunData:
    """The first of several runs with a map that tells of all: in each cell that any of them has filled, the share of
    the runs that have filled it, or the median fitness of those that have. The cells of a dominated map are those of
    its grid.

    Raises ValueError if the runs have no maps, or maps with different cells.
    """
    if not have_same_cells(runs):
        raise ValueError("the maps of these runs do not have the same cells")
    maps = [projected(run.map) for run in runs if run.map is not None]
    cell_N = np.unique(np.concatenate([map_.cell_N for map_ in maps]))
    fitness_R_N = np.full((len(maps), cell_N.size), np.nan)
    for fitness_N, map_ in zip(fitness_R_N, maps, strict=True):
        fitness_N[np.searchsorted(cell_N, map_.cell_N)] = map_.fitness_N
    value_N = np.isfinite(fitness_R_N).mean(axis=0) if over == "share" else np.nanmedian(fitness_R_N, axis=0)
    owner_N = np.argmax(np.isfinite(fitness_R_N), axis=0)
    descriptor_N_B = np.empty((cell_N.size, len(runs[0].names)))
    for owner, map_ in enumerate(maps):
        rows = np.argsort(map_.cell_N)
        there_N = owner_N == owner
        found = rows[np.searchsorted(map_.cell_N[rows], cell_N[there_N])]
        descriptor_N_B[there_N] = map_.descriptor_N_B[found]
    return replace(runs[0], map=_with(maps[0], cell_N, value_N, descriptor_N_B))


def have_same_cells(runs: Sequence[RunData]) -> bool:
    """Whether all runs have maps, and these have the same cells; those of a dominated map are those of its grid."""
    cells = [tessellation(projected(run.map).geometry) for run in runs if run.map is not None]
    middles = [one.middles_of(np.arange(one.size)) for one in cells]
    return len(cells) == len(runs) and all(
        (one.bounds, one.shape) == (cells[0].bounds, cells[0].shape) and np.array_equal(middle_C_B, middles[0])
        for one, middle_C_B in zip(cells, middles, strict=True)
    )


def until(data: RunData, generation: int) -> RunData:
    """A run with the map that all evaluated centres until a generation make, each cell with the fittest.

    It is the run's own map at that time, unless the search measures elites again. Not for a dominated map.
    """
    assert data.map is not None
    order = np.lexsort((-data.centres["fitness_mean"], data.centres["generation"] > generation))
    order = order[: int((data.centres["generation"] <= generation).sum())]
    descriptor_N_B = np.stack([data.centres[name][order] for name in data.names], axis=1)
    fitness_N = data.centres["fitness_mean"][order]
    fine = np.isfinite(descriptor_N_B).all(axis=1) & np.isfinite(fitness_N)
    cell_N = tessellation(data.map.geometry).cells_of(descriptor_N_B[fine])
    cell_N, first_N = np.unique(cell_N, return_index=True)  # the first is the fittest
    return replace(data, map=_with(data.map, cell_N, fitness_N[fine][first_N], descriptor_N_B[fine][first_N]))


def profile(map_: BehaviourMap, fitness_K: NDArray[np.float64]) -> NDArray[np.float64]:
    """Share of all cells of a map whose elite has at least each fitness, [K]: its archive profile (Flageat et al.,
    ACM TELO 2022). Of a dominated map, the cells are those of its grid."""
    map_ = projected(map_)
    ordered = np.sort(map_.fitness_N)
    return (ordered.size - np.searchsorted(ordered, fitness_K, side="left")) / map_.geometry.size


def _with(
    like: BehaviourMap, cell_N: NDArray[np.int64], value_N: NDArray[np.float64], descriptor_N_B: NDArray[np.float64]
) -> BehaviourMap:
    unknown_N = np.full(cell_N.size, -1)
    return replace(
        empty_map(like.geometry),
        cell_N=cell_N,
        fitness_N=value_N,
        descriptor_N_B=descriptor_N_B,
        generation_N=unknown_N,
        centre_N=unknown_N,
        score_N=np.full(cell_N.size, np.nan),
    )
