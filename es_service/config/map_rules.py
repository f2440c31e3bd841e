"""Rules of the behaviour map (`rules.py` says what a rule is), and how long its centroids take to place."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import get_args

from es_service.config.keys import FIELDS, search_fields
from es_service.config.parts import LARGEST, counts
from es_service.config.resolution import Values
from es_service.config.text import not_allowed, one_of, problem_of, show
from es_service.errors import Problem
from es_service.protocol.messages import TaskSpec

Problems = Iterator[Problem]

MOST_CELLS = 10_000_000
MOST_CVT_CELLS = MOST_SLOTS = 4096
PLACES_PER_CENTROID = {"lloyd": 50, "kmeans": 10}
"""Random places by which centroids are placed, by `map.centroids`."""
LLOYD_STEPS = 20
MOST_PLACING_S = 600.0
"""Longest estimated time of that, in seconds."""


def bounds_fit(config: Values, task: TaskSpec) -> Problems:
    names, bounds = task.descriptor_names, config["map.bounds"]
    if bounds is None:
        what = f"missing, since the descriptor of {task.name} has no bounds; give [low, high] for each of"
        yield problem_of("map.bounds", None, f"{what} {', '.join(names)}, or set map.enabled = false")
        return
    if any(abs(number) > LARGEST for pair in bounds for number in pair):
        yield not_allowed("map.bounds", bounds, f"within {LARGEST:g} of 0")
    if len(bounds) != len(names):
        allowed = f"a list of {len(names)} pairs [low, high], or auto"
        what = f"{show(bounds)} has {len(bounds)} pairs, but the descriptor has {len(names)} dimensions"
        problem = f"{what} ({', '.join(names)}); must be {allowed}"
        yield problem_of("map.bounds", bounds, problem, allowed=allowed)
        return
    for name, pair in zip(names, bounds, strict=True):
        if not pair[0] < pair[1]:
            allowed, meant = "[low, high] with low below high", pair[::-1] if pair[0] > pair[1] else None
            hint = f"; did you mean {show(meant)}?" if meant else ""
            what = f"{show(pair)} for {name} is not allowed; must be {allowed}{hint}"
            yield problem_of("map.bounds", pair, what, allowed=allowed, suggestion=meant)


def qd_offset_is_finite(config: Values, task: TaskSpec) -> Problems:
    if abs(offset := config["map.qd_offset"]) > LARGEST:
        yield not_allowed("map.qd_offset", offset, f"within {LARGEST:g} of 0")


def cells_fit(config: Values, task: TaskSpec) -> Problems:
    names, cells, kind = task.descriptor_names, counts(config["map.cells"]), config["map.kind"]
    most = MOST_CVT_CELLS if kind == "cvt" else MOST_CELLS
    if len(cells) != (wanted := 1 if kind == "cvt" else len(names)):
        what = "one number for a cvt" if kind == "cvt" else f"{wanted} numbers, one for each of {', '.join(names)}"
        allowed, problem = f"{what}, or auto", f"{show(cells)} has {len(cells)} numbers; must be {what}, or auto"
    elif math.prod(cells) > most:
        allowed, hint = (
            f"at most {most:,}",
            {"cvt": " for a cvt", "grid": "; with many dimensions use map.kind = cvt"}.get(kind, ""),
        )
        problem = f"{show(cells)} makes {math.prod(cells):,} cells; must be {allowed}{hint}"
    elif kind == "cvt" and (seconds := placing_seconds(cells[0], len(names), config["map.centroids"])) > MOST_PLACING_S:
        allowed = f"at most {int(cells[0] * math.sqrt(MOST_PLACING_S / seconds)):,}"
        what = f"placing {cells[0]:,} centroids in {len(names):,} dimensions would take about {seconds:.0f} s"
        hint = "" if config["map.centroids"] == "kmeans" else ", or map.centroids = kmeans, which is faster"
        problem = f"{what}; must be {allowed}{hint}"
    else:
        return
    yield problem_of("map.cells", cells, problem, allowed=allowed)


def keys_are_for_their_kind(config: Values, task: TaskSpec) -> Problems:
    kind = config["map.kind"]
    for key, of in (("map.centroids", "cvt"), ("map.slots", "dominated"), ("map.neighbours", "dominated")):
        if kind != of and (value := config[key]) != (default := FIELDS[key].default):
            what = f"{show(value)} has no effect with map.kind = {kind}; leave it out (a key of kind {of})"
            yield problem_of(key, value, what, suggestion=default)
    if kind == "dominated" and (slots := config["map.slots"]) > MOST_SLOTS:
        yield not_allowed("map.slots", slots, f"at most {MOST_SLOTS:,}")


def slots_have_no_history(config: Values, task: TaskSpec) -> Problems:
    """What is counted for a cell, or kept in it, would be of another elite as soon as a slot has one."""
    if config["map.kind"] != "dominated" or "dominated" not in config.settings.map_kinds:
        return
    if (kind := config["search.elites.kind"]) != "once":
        why = " with map.kind = dominated, whose slots have no places between which elites could move"
        yield not_allowed("search.elites.kind", kind, "once", why=why)
    for key in ("search.starts", "search.cell_sampling"):
        if config.get(key) == "least_tried":
            why = " with map.kind = dominated, whose slots change their elites"
            others = [
                name for name in get_args(search_fields(config.settings)[key].annotation) if name != "least_tried"
            ]
            yield not_allowed(key, "least_tried", one_of(others), why=why)


def placing_seconds(cells: int, dimensions: int, centroids: str) -> float:
    """About how long it takes to place the centroids of a cvt, in seconds, as measured on one core of a Zen 4.

    Args:
        centroids: `map.centroids`; k-means is counted with as many steps as Lloyd's algorithm, which it rarely needs.
    """
    pairs = LLOYD_STEPS * PLACES_PER_CENTROID.get(centroids, 0) * cells**2
    return pairs * (
        1.4e-9 * min(dimensions, 7) + 1e-10 * dimensions
    )  # from five dimensions on as a product of matrices


MAP_RULES = (bounds_fit, qd_offset_is_finite, cells_fit, keys_are_for_their_kind, slots_have_no_history)
"""In the order in which problems are told."""
