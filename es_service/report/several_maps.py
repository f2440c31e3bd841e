"""Maps that are made of several: over the seeds of a group, and of one run at earlier times.

Each is returned as a run with that map in the place of its own, so that it is drawn as any map is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from es_service.report.data import RunData
from es_service.search.maps.behaviour_map import BehaviourMap, empty_map

Over = Literal["share", "median"]


def over_seeds(runs: Sequence[RunData], over: Over) -> RunData:
    """The first of several runs with a map that tells of all: in each cell that any of them has filled, the share of
    the runs that have filled it, or the median fitness of those that have.

    Raises ValueError if the runs have no maps, or maps with different cells.
    """
    maps = [run.map for run in runs if run.map is not None]
    first = maps[0].geometry if maps else None
    if len(maps) < len(runs) or any(
        map_.geometry.size != first.size or map_.geometry.bounds != first.bounds for map_ in maps if first is not None
    ):
        raise ValueError("the maps of these runs do not have the same cells")
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


def until(data: RunData, generation: int) -> RunData:
    """A run with the map that all evaluated centres until a generation make, each cell with the fittest.

    It is the run's own map at that time, unless the search measures elites again.
    """
    assert data.map is not None
    order = np.lexsort((-data.centres["fitness_mean"], data.centres["generation"] > generation))
    order = order[: int((data.centres["generation"] <= generation).sum())]
    descriptor_N_B = np.stack([data.centres[name][order] for name in data.names], axis=1)
    fitness_N = data.centres["fitness_mean"][order]
    fine = np.isfinite(descriptor_N_B).all(axis=1) & np.isfinite(fitness_N)
    cell_N = data.map.geometry.cells_of(descriptor_N_B[fine])
    cell_N, first_N = np.unique(cell_N, return_index=True)  # the first is the fittest
    return replace(data, map=_with(data.map, cell_N, fitness_N[fine][first_N], descriptor_N_B[fine][first_N]))


def profile(map_: BehaviourMap, fitness_K: NDArray[np.float64]) -> NDArray[np.float64]:
    """Share of all cells of a map whose elite has at least each fitness, [K]: its archive profile (Flageat et al.,
    ACM TELO 2022)."""
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
