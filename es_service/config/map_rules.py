"""Defaults of the section `map`, and checks of the behaviour map against the task's descriptor."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from es_service.config.fields import counts
from es_service.config.options import options_of
from es_service.config.problems import not_allowed, problem_of
from es_service.config.yaml_text import show
from es_service.errors import Problem
from es_service.protocol.messages import UNBOUNDED, Bounds, TaskSpec, with_options

MOST_AUTO_CELLS = 10_000
MOST_CELLS = 10_000_000
CVT_CELLS = 1024
MOST_CVT_CELLS = 4096
PLACES_PER_CENTROID = {"lloyd": 50, "kmeans": 10}
"""Random places by which centroids are placed, by `map.centroids`."""
LLOYD_STEPS = 20
MOST_PLACING_S = 600.0
"""Longest estimated time of that, in seconds."""
MOST_GRID_DIMENSIONS = 6
"""Largest number of descriptor dimensions for which `kind: auto` is a grid, else cvt."""
LARGEST = 1e30
"""Largest absolute value of bounds and offsets, so that their sums and differences stay finite."""


def default_bounds(values: Mapping[str, Any], task: TaskSpec) -> Bounds | None:
    """The bounds of the descriptor; None if a map needs them and the descriptor has none."""
    if UNBOUNDED in task.descriptor_bounds and values.get("map.enabled", True):
        return None
    return tuple((-1.0, 1.0) if pair == UNBOUNDED else pair for pair in task.descriptor_bounds)


def default_cells(kind: str, dimensions: int) -> tuple[int, ...]:
    """Default number of cells: 1,024 for a cvt; for a grid, the cells along each dimension.

    These are 100 for one dimension and 20 x 20 for two. For more, all dimensions have the same number: the largest that
    gives at most 10,000 cells in all, but at least 2.
    """
    if kind == "cvt":
        return (CVT_CELLS,)
    each = {1: 100, 2: 20}.get(dimensions) or max(2, int(MOST_AUTO_CELLS ** (1.0 / dimensions) + 1e-9))
    return (each,) * dimensions


def default_qd_offset(values: Mapping[str, Any], task: TaskSpec) -> float:
    """Lowest fitness of an episode, from the lowest reward that the task specifies; 0 if it specifies none."""
    if task.least_reward is None:
        return 0.0
    counted = 1 if values.get("task.fitness") == "final" else values.get("task.episode_steps", task.episode_steps)
    return task.least_reward * counted


def placing_seconds(cells: int, dimensions: int, centroids: str) -> float:
    """About how long it takes to place the centroids of a cvt, in seconds, as measured on one core of a Zen 4.

    Args:
        centroids: `map.centroids`; k-means is counted with as many steps as Lloyd's algorithm, which it rarely needs.
    """
    pairs = LLOYD_STEPS * PLACES_PER_CENTROID.get(centroids, 0) * cells**2
    return pairs * (
        1.4e-9 * min(dimensions, 7) + 1e-10 * dimensions
    )  # from five dimensions on as a product of matrices


def map_problems(values: Mapping[str, Any], task: TaskSpec) -> list[Problem]:
    """Problems of a map that does not fit the descriptor or is too large."""
    problems = []
    names = with_options(task, options_of(values)).descriptor_names
    bounds, cells, kind = values.get("map.bounds"), counts(values.get("map.cells")), values.get("map.kind")
    qd_offset, how = values.get("map.qd_offset", 0.0), values.get("map.centroids", "lloyd")
    if bounds is None and "map.bounds" in values:
        what = f"missing, since the descriptor of {task.name} has no bounds; give [low, high] for each of"
        problems.append(problem_of("map.bounds", None, f"{what} {', '.join(names)}, or set map.enabled = false"))
    for key, numbers in (("map.bounds", [x for pair in bounds or () for x in pair]), ("map.qd_offset", [qd_offset])):
        if any(abs(number) > LARGEST for number in numbers):
            problems.append(not_allowed(key, values[key], f"within {LARGEST:g} of 0"))
    if bounds is not None:
        if len(bounds) != len(names):
            allowed = f"a list of {len(names)} pairs [low, high], or auto"
            what = f"{show(bounds)} has {len(bounds)} pairs, but the descriptor has {len(names)} dimensions"
            problem = f"{what} ({', '.join(names)}); must be {allowed}"
            problems.append(problem_of("map.bounds", bounds, problem, allowed=allowed))
        else:
            problems += [
                Problem(
                    f"map.bounds: {show(pair)} for {name} is not allowed; must be [low, high] with low below high"
                    + (f"; did you mean {show(pair[::-1])}?" if pair[0] > pair[1] else ""),
                    "map.bounds",
                    pair,
                    "[low, high] with low below high",
                    pair[::-1] if pair[0] > pair[1] else None,
                )
                for name, pair in zip(names, bounds, strict=True)
                if not pair[0] < pair[1]
            ]
    if cells is not None and kind is not None:
        wanted = 1 if kind == "cvt" else len(names)
        if len(cells) != wanted:
            what = "one number for a cvt" if kind == "cvt" else f"{wanted} numbers, one for each of {', '.join(names)}"
            allowed = f"{what}, or auto"
            problem = f"{show(cells)} has {len(cells)} numbers; must be {allowed}"
            problems.append(problem_of("map.cells", cells, problem, allowed=allowed))
        elif math.prod(cells) > (most := MOST_CVT_CELLS if kind == "cvt" else MOST_CELLS):
            allowed = f"at most {most:,}"
            hint = " for a cvt" if kind == "cvt" else "; with many dimensions use map.kind = cvt"
            problem = f"{show(cells)} makes {math.prod(cells):,} cells; must be {allowed}{hint}"
            problems.append(problem_of("map.cells", cells, problem, allowed=allowed))
        elif kind == "cvt" and (seconds := placing_seconds(cells[0], len(names), how)) > MOST_PLACING_S:
            allowed = f"at most {int(cells[0] * math.sqrt(MOST_PLACING_S / seconds)):,}"
            what = f"placing {cells[0]:,} centroids in {len(names):,} dimensions would take about {seconds:.0f} s"
            hint = "" if how == "kmeans" else ", or map.centroids = kmeans, which is faster"
            problems.append(problem_of("map.cells", cells, f"{what}; must be {allowed}{hint}", allowed=allowed))
    if kind == "grid" and how != "lloyd":
        what = f"{show(how)} has no effect with map.kind = grid; leave it out (a key of kind cvt)"
        problems.append(problem_of("map.centroids", how, what, suggestion="lloyd"))
    return problems
