"""What a config leaves open of the behaviour map, and whether it fits the task's descriptor."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from es_service.config.fields import OPTIONS
from es_service.config.problems import not_allowed, unfit
from es_service.config.yaml_text import show
from es_service.errors import Problem
from es_service.protocol.messages import TaskSpec, with_options

MOST_AUTO_CELLS = 10_000
MOST_CELLS = 10_000_000
CVT_CELLS = 1024
MOST_CVT_CELLS = 4096
"""Placing them takes time that grows with their square: some 15 seconds for so many."""
MOST_GRID_DIMENSIONS = 6
"""Of a descriptor for which `kind: auto` is a grid."""
LARGEST = 1e30
"""Of bounds and offsets, so that sums and differences of them stay finite."""


def default_kind(dimensions: int) -> str:
    """grid for up to six dimensions, else cvt."""
    return "grid" if dimensions <= MOST_GRID_DIMENSIONS else "cvt"


def default_cells(kind: str, dimensions: int) -> tuple[int, ...]:
    """20 x 20 in the plane, 100 on a line; else as many alike, 2 at least, as make at most 10,000. Of a cvt 1,024."""
    if kind == "cvt":
        return (CVT_CELLS,)
    each = {1: 100, 2: 20}.get(dimensions) or max(2, int(MOST_AUTO_CELLS ** (1.0 / dimensions) + 1e-9))
    return (each,) * dimensions


def default_qd_offset(values: Mapping[str, Any], task: TaskSpec) -> float:
    """The least fitness of an episode, where the task names its least reward; else 0."""
    if task.least_reward is None:
        return 0.0
    counted = 1 if values.get("task.fitness") == "final" else values.get("task.episode_steps", task.episode_steps)
    return task.least_reward * counted


def map_problems(values: Mapping[str, Any], task: TaskSpec) -> list[Problem]:
    """Where the map does not fit the descriptor, or the algorithm needs one."""
    problems = []
    if values.get("search.algorithm") == "me_es" and values.get("map.enabled", True) is False:
        why = " for me_es, which draws its parents from the map"
        problems.append(not_allowed("map.enabled", False, "true", why=why))
    names = with_options(task, options_of(values)).descriptor_names
    bounds, cells, kind = values.get("map.bounds"), values.get("map.cells"), values.get("map.kind")
    qd_offset = values.get("map.qd_offset", 0.0)
    for key, numbers in (("map.bounds", [x for pair in bounds or () for x in pair]), ("map.qd_offset", [qd_offset])):
        if any(abs(number) > LARGEST for number in numbers):
            problems.append(not_allowed(key, values[key], f"within {LARGEST:g} of 0"))
    if bounds is not None:
        if len(bounds) != len(names):
            allowed = f"a list of {len(names)} pairs [low, high], or auto"
            what = f"{show(bounds)} has {len(bounds)} pairs; the descriptor has {len(names)} dimensions"
            problem = f"{what} ({', '.join(names)}), so must be {allowed}"
            problems.append(unfit("map.bounds", bounds, problem, allowed=allowed))
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
            problems.append(unfit("map.cells", cells, problem, allowed=allowed))
        elif math.prod(cells) > (most := MOST_CVT_CELLS if kind == "cvt" else MOST_CELLS):
            allowed = f"at most {most:,}"
            hint = " for a cvt" if kind == "cvt" else "; with many dimensions use map.kind = cvt"
            problem = f"{show(cells)} makes {math.prod(cells):,} cells; must be {allowed}{hint}"
            problems.append(unfit("map.cells", cells, problem, allowed=allowed))
    return problems


def options_of(values: Mapping[str, Any]) -> dict[str, str]:
    """The task options among flat values."""
    return {key.removeprefix(OPTIONS): value for key, value in values.items() if key.startswith(OPTIONS)}
