"""Whether the parts of a stored state are those that a run of these sizes writes; a stranger may have written others.

The axes at the end of an array's name are its shape: D policy parameters, O observation, B descriptor dimensions; other
letters are axes of any length, which arrays of a part share. What a search stores of its own is not looked at.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Collection, Mapping
from typing import NamedTuple

import numpy as np

from es_service.loop.parts import (
    BEST,
    BLOCK_PREFIX,
    CELL_PREFIX,
    CENTRE_PREFIX,
    COUNTERS,
    ELITE_PREFIX,
    GEOMETRY_PART,
    OBSERVATIONS,
    WEIGHT,
    centre_part,
)
from es_service.search.state_parts import APPENDED_PREFIX, BY_CELL_PREFIX, PIECE

INTEGER, REAL, BOOL = "iu", "f", "b"
"""Kinds of a `dtype`."""
_POLICY = {"centre_D": REAL, "observation_mean_O": REAL, "observation_std_O": REAL}
_NUMBERED = (CENTRE_PREFIX, CELL_PREFIX, ELITE_PREFIX, BLOCK_PREFIX)
_KINDS: Mapping[str, Mapping[str, str]] = {
    COUNTERS: {"env_steps": INTEGER, "episodes": INTEGER},
    OBSERVATIONS: {"count": REAL, "mean_O": REAL, "m2_O": REAL},
    WEIGHT: {"value": REAL, "record": REAL, "stagnant": INTEGER},
    BEST: {"generation": INTEGER, "fitness": REAL, **_POLICY},
    GEOMETRY_PART: {"bounds_B_2": REAL},
    CENTRE_PREFIX: {"centre_D": REAL, "entry": INTEGER, "cell": INTEGER},
    CELL_PREFIX: {
        **dict.fromkeys(("order", "generation", "centre"), INTEGER),
        **dict.fromkeys(("fitness", "descriptor_B", "score"), REAL),
    },
    ELITE_PREFIX: {**_POLICY, "trace_T_B": REAL},
    BLOCK_PREFIX: {"descriptor_N_B": REAL, "generation_N": INTEGER, "centre_N": INTEGER},
}
"""Name of a part, or prefix of the names of numbered ones -> kinds of the arrays that it has."""
_MORE = {
    GEOMETRY_PART: {"shape_B": INTEGER, "centroid_C_B": REAL, "counts_samples": BOOL},
    CELL_PREFIX: {"samples": INTEGER},
}
"""The same for arrays that it may have; a centre has any others, such as those of a user's search."""
_ALWAYS = (COUNTERS, OBSERVATIONS, WEIGHT, BEST, centre_part(0))
_ANY = "biuf"
_AXES = re.compile("(?<=_)[A-Z0-9](?=_|$)")
_FINITE = ("descriptor_B", "descriptor_N_B", "bounds_B_2", "centroid_C_B")


class Sizes(NamedTuple):
    """Sizes of a run, of which the shapes of its arrays follow."""

    parameters: int
    observation: int
    dimensions: int
    """Of the descriptor."""
    cells: tuple[int, ...] | None
    """Cells of the map along each dimension, or of a cvt map; None without one."""
    bounds: tuple[tuple[float, float], ...]
    """(low, high) of each dimension of the map."""
    step: Mapping[str, str] = {}
    """Name of an array of a centre's step -> the kinds that it may have."""


def problem(part: str, arrays: Mapping[str, np.ndarray], sizes: Sizes) -> str:
    """In which way the content of a part is none of a run of these sizes; empty if it is one."""
    kind = next((prefix for prefix in _NUMBERED if part.startswith(prefix)), part)
    if kind not in _KINDS:
        number = part.partition(PIECE)[2] if part.startswith((APPENDED_PREFIX, BY_CELL_PREFIX)) else ""
        return "" if not number or number.isdecimal() else f"{part} has no number at its end"
    needed, more = _KINDS[kind], _MORE.get(kind, {})
    if kind == CENTRE_PREFIX:
        needed, more = {**needed, **sizes.step}, dict.fromkeys(arrays, _ANY)
    lengths = {"D": sizes.parameters, "O": sizes.observation, "B": sizes.dimensions, "2": 2}
    found = array_problem(arrays, needed, more, lengths) or _problem_of_values(part, kind, arrays, sizes)
    return f"{part} {found}" if found else ""


def array_problem(
    arrays: Mapping[str, np.ndarray], needed: Mapping[str, str], more: Mapping[str, str], lengths: dict[str, int]
) -> str:
    """In which way arrays are not those that there must be, as words that follow their owner; empty if they are.

    Args:
        needed, more: name of an array that there must be, or may be -> the kinds of `dtype.kind` that it may have.
        lengths: axis -> its length; gets those of axes whose lengths are free.
    """
    if absent := sorted(needed.keys() - arrays.keys()):
        return f"lacks the array {absent[0]}"
    kinds = {**more, **needed}
    for name, array in arrays.items():
        axes = _AXES.findall(name)
        fits = len(axes) == array.ndim and all(map(_fits, axes, array.shape, [lengths] * array.ndim))
        if array.dtype.kind not in kinds.get(name, "") or not fits:
            return f"has an array {name!r} of {array.dtype} {array.shape}, which no run of these sizes has"
        if name in _FINITE and not np.isfinite(array).all():
            return f"has an array {name!r} with values that are not finite"
    return ""


def _fits(axis: str, length: int, lengths: dict[str, int]) -> bool:
    """Whether an axis has its length, which is that of its first array if the sizes do not say it."""
    return lengths.setdefault(axis, length) == length


def _problem_of_values(part: str, kind: str, arrays: Mapping[str, np.ndarray], sizes: Sizes) -> str:
    """As `problem`, for what the values must be."""
    count = math.prod(sizes.cells or (0,))
    if kind in (CELL_PREFIX, ELITE_PREFIX):
        number = part.removeprefix(kind)
        return "" if number.isdecimal() and int(number) < count else f"is no cell of a map of {count} cells"
    if kind == GEOMETRY_PART:
        shape_B, centroid_C_B = arrays.get("shape_B"), arrays.get("centroid_C_B")
        of_grid = [] if shape_B is None else [shape_B.tolist()]
        of_cvt = [] if centroid_C_B is None else [[len(centroid_C_B)]]
        if of_grid + of_cvt != [list(sizes.cells or ())] or arrays["bounds_B_2"].tolist() != [*map(list, sizes.bounds)]:
            return "has other cells or bounds than the config"
        if centroid_C_B is not None:
            low_B, high_B = arrays["bounds_B_2"].T
            are_inside = ((low_B <= centroid_C_B) & (centroid_C_B <= high_B)).all()
            if not are_inside or len(np.unique(centroid_C_B, axis=0)) < len(centroid_C_B):
                return "has centroids outside of the bounds of the map, or twice the same"
    if kind == CENTRE_PREFIX:
        counts = {name: arrays[name] for name, kinds in sizes.step.items() if kinds == INTEGER}
        for name, array in counts.items():
            if not ((array >= 0) & (array < 2**53)).all():
                return f"has an array {name!r} that counts {array}"
    if kind == WEIGHT and not 0.0 <= arrays["value"] <= 1.0:
        return f"has the value {arrays['value']}; must be from 0 to 1"
    return ""


def missing(parts: Collection[str], sizes: Sizes, wanted: Callable[[str], bool]) -> str:
    """The first part that a state of these sizes has, that is `wanted`, and that is not among some; empty if there is
    none."""
    cells = (part.removeprefix(CELL_PREFIX) for part in parts if part.startswith(CELL_PREFIX))
    of_map = [] if sizes.cells is None else [GEOMETRY_PART, *(ELITE_PREFIX + cell for cell in cells)]
    return next((part for part in (*_ALWAYS, *of_map) if part not in parts and wanted(part)), "")
