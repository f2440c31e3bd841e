"""Whether the arrays of a stored state are those that a run of these sizes writes; a stranger may have written others.

The axes at the end of an array's name are its shape: D policy parameters, O observation, B descriptor dimensions; other
letters are axes of any length, which arrays of a node share. What a search stores of its own is not looked at.
"""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Mapping
from typing import NamedTuple

import numpy as np

from es_service.loop.blocks import ARCHIVE, BEST, BLOCK, CENTRES, COUNTS, EXTRA, GEOMETRY, MAP, OBSERVATIONS, WEIGHT
from es_service.protocol.content import NO_NAME, OF_POLICY

INTEGER, REAL, BOOL, NAMES = "iu", "f", "b", "V"
"""Kinds of a `dtype`."""
_STEP = "step"
_KINDS: Mapping[str, Mapping[str, str]] = {
    COUNTS: {"env_steps": INTEGER, "episodes": INTEGER},
    OBSERVATIONS: {"count": REAL, "mean_O": REAL, "m2_O": REAL},
    WEIGHT: {"value": REAL, "record": REAL, "stagnant": INTEGER},
    BEST: {"generation": INTEGER, "fitness": REAL, "policy": NAMES},
    GEOMETRY: {},
    CENTRES: {"centre_D": REAL, "entry": INTEGER, "cell": INTEGER},
    _STEP: {},
    MAP: {
        **dict.fromkeys(("cell_N", "generation_N", "centre_N"), INTEGER),
        **dict.fromkeys(("fitness_N", "descriptor_N_B", "score_N"), REAL),
        **dict.fromkeys(("policy_N", "trace_N"), NAMES),
    },
    ARCHIVE: {"descriptor_N_B": REAL, "generation_N": INTEGER, "centre_N": INTEGER},
}
"""Kind of a node -> kinds of the arrays that it has."""
_MORE = {
    GEOMETRY: {
        **{"bounds": REAL, "shape": INTEGER, "centroid_C_B": REAL},
        **dict.fromkeys(("grid_shape", "slots", "neighbours"), INTEGER),
    },
    MAP: {"samples_N": INTEGER},
    CENTRES: {"own_mean_O": REAL, "own_std_O": REAL},
}
"""The same for arrays that it may have; a step has any others, such as those of a user's search."""
POLICY: Mapping[str, str] = dict.fromkeys(OF_POLICY, REAL)
"""Kinds of the arrays of a policy."""
_ALWAYS = (COUNTS, OBSERVATIONS, WEIGHT, BEST, ARCHIVE, f"{CENTRES}/0")
_ANY = "biuf"
_AXES = re.compile("(?<=_)[A-Z0-9](?=_|$)")
_FINITE = ("descriptor_N_B", "bounds", "centroid_C_B")


class Sizes(NamedTuple):
    """Sizes of a run, of which the shapes of its arrays follow."""

    parameters: int
    observation: int
    dimensions: int
    """Of the descriptor."""
    cells: tuple[int, ...] | None
    """Cells of the map, or of the grid of a dominated one, along each dimension, or of a cvt map; None without one."""
    bounds: tuple[tuple[float, float], ...]
    """(low, high) of each dimension of the map."""
    step: Mapping[str, str] = {}
    """Name of an array of a centre's step -> the kinds that it may have."""
    dominated: Mapping[str, int] = {}
    """`slots` and `neighbours` of a dominated map; empty for another."""

    @property
    def lengths(self) -> dict[str, int]:
        return {"D": self.parameters, "O": self.observation, "B": self.dimensions}


def problem(name: str, arrays: Mapping[str, np.ndarray], sizes: Sizes) -> str:
    """In which way the content of a node, or of a block of one, is none of a run of these sizes; empty if it is one."""
    path, is_block, number = name.partition(BLOCK)
    if is_block and not number.isdecimal():
        return f"{name} has no number at its end"
    kind = path
    if path.startswith(f"{CENTRES}/"):
        kind = _STEP if path.endswith(f"/{_STEP}") else CENTRES
    if kind not in _KINDS:
        return "" if path.partition("/")[0] == EXTRA else f"{name} is no part of a state"
    needed, more = _KINDS[kind], _MORE.get(kind, {})
    if kind == _STEP:
        needed, more = sizes.step, dict.fromkeys(arrays, _ANY)
    found = array_problem(arrays, needed, more, sizes.lengths) or _problem_of_values(kind, arrays, sizes)
    return f"{name} {found}" if found else ""


def policy_problem(arrays: Mapping[str, np.ndarray], sizes: Sizes) -> str:
    """In which way a content is neither a policy nor a trace of a run of these sizes; empty if it is one."""
    if arrays.keys() == {"trace_T_B"}:
        return array_problem(arrays, {"trace_T_B": REAL}, {}, sizes.lengths)
    policy = {name: array for name, array in arrays.items() if name != "spec"}
    return array_problem(policy, POLICY, {}, sizes.lengths)


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
        if array.dtype.kind not in kinds.get(name, "") or not (fits or name in _MORE[GEOMETRY]):
            return f"has an array {name!r} of {array.dtype} {array.shape}, which no run of these sizes has"
        if name in _FINITE and not np.isfinite(array).all():
            return f"has an array {name!r} with values that are not finite"
        if name == "descriptor_N_B" and _beyond_float32(array).any():
            return f"has an array {name!r} with values that float32 cannot hold"
    return ""


def _beyond_float32(values: np.ndarray) -> np.ndarray:
    """Where values are finite, but would not be as float32, which workers return."""
    return np.isfinite(values) & (np.abs(values) > np.finfo(np.float32).max)


def _fits(axis: str, length: int, lengths: dict[str, int]) -> bool:
    """Whether an axis has its length, which is that of its first array if the sizes do not say it."""
    return lengths.setdefault(axis, length) == length


def _problem_of_values(kind: str, arrays: Mapping[str, np.ndarray], sizes: Sizes) -> str:
    """As `problem`, for what the values must be."""
    count = sizes.dominated.get("slots", math.prod(sizes.cells or (0,)))
    if kind == MAP and not ((arrays["cell_N"] >= 0) & (arrays["cell_N"] < count)).all():
        return f"has a cell that is none of a map of {count} cells"
    if kind == GEOMETRY:
        return _problem_of_geometry(arrays, sizes)
    if kind == _STEP:
        counts = {name: arrays[name] for name, kinds in sizes.step.items() if kinds == INTEGER}
        for name, array in counts.items():
            if not ((array >= 0) & (array < 2**53)).all():
                return f"has an array {name!r} that counts {array}"
    if kind == BEST and arrays["policy"].tobytes() == NO_NAME:
        return "names no policy"
    if kind == OBSERVATIONS and _overflows(arrays["mean_O"], arrays["m2_O"], arrays["count"]):
        return "has statistics that float32 cannot hold"
    if kind == WEIGHT and not 0.0 <= arrays["value"] <= 1.0:
        return f"has the value {arrays['value']}; must be from 0 to 1"
    return ""


def _overflows(mean_O: np.ndarray, m2_O: np.ndarray, count: np.ndarray) -> bool:
    """Whether finite statistics of observations, which are float32, have a mean or a standard deviation that is not."""
    with np.errstate(all="ignore"):
        return bool(_beyond_float32(np.array([mean_O, np.sqrt(m2_O / np.maximum(count, 1.0))])).any())


def _problem_of_geometry(arrays: Mapping[str, np.ndarray], sizes: Sizes) -> str:
    """As `problem`, for the cells of a map; a block of centroids has some of them."""
    bounds, shape, centroid_C_B = (arrays.get(name) for name in ("bounds", "shape", "centroid_C_B"))
    if sizes.dominated:
        wanted = {**sizes.dominated, "grid_shape": list(sizes.cells or ())}
        found = {name: array.tolist() for name, array in arrays.items() if name != "bounds"}
    else:
        of_cvt = [] if centroid_C_B is None else [[len(centroid_C_B)]]
        wanted, found = [list(sizes.cells or ())], ([] if shape is None else [shape.tolist()]) + of_cvt
        if "slots" in arrays:
            return "has slots, but the map of the config has cells"
    if found != wanted or bounds is None or bounds.tolist() != [*map(list, sizes.bounds)]:
        return "has other cells or bounds than the config"
    if centroid_C_B is not None:
        low_B, high_B = bounds.T
        are_inside = ((low_B <= centroid_C_B) & (centroid_C_B <= high_B)).all()
        if not are_inside or len(np.unique(centroid_C_B, axis=0)) < len(centroid_C_B):
            return "has centroids outside of the bounds of the map, or twice the same"
    return ""


def missing(paths: Collection[str], sizes: Sizes, wanted: Collection[str] = ("",)) -> str:
    """The first node that a state of these sizes has, that is below one of the `wanted` paths, and that is not among
    some; empty if there is none."""
    needed = (*_ALWAYS, *([] if sizes.cells is None else [MAP, GEOMETRY]))
    return next((path for path in needed if path not in paths and path.startswith(tuple(wanted))), "")
