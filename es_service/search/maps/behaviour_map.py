"""The map's light half, which the driver keeps in memory: what is known of each cell's elite, but not its parameters.

An elite is the centre with the highest mean fitness over its evaluation episodes among all that ended, on average, in a
cell. Its parameters, its observation statistics and the trace of one of its episodes are written to the run store when
it enters and read again when it is wanted. N: filled cells, in the order of their discovery; B: descriptor dimensions.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from es_service.protocol.messages import Centre, FloatArray
from es_service.search.maps.geometry import Geometry


@dataclass(frozen=True)
class BehaviourMap:
    """The filled cells. Insertion gives a new map; the old one stays as it is."""

    geometry: Geometry
    cell_N: NDArray[np.int64]
    fitness_N: NDArray[np.float64]
    """Mean over the evaluation episodes, never estimated again."""
    descriptor_N_B: NDArray[np.float64]
    generation_N: NDArray[np.int64]
    """In which each elite was evaluated."""
    centre_N: NDArray[np.int64]
    score_N: NDArray[np.float64]
    """Highest fitness of a population member in the generation that made the elite, or in the latest one that started
    from it: a lucky number, by which `cell_sampling: score` chooses. NaN where there was no population."""

    @property
    def size(self) -> int:
        """Number of filled cells."""
        return self.cell_N.size

    def row_of(self, cell: int) -> int | None:
        """Where in the arrays a cell is; None if it is empty."""
        found = np.flatnonzero(self.cell_N == cell)
        return int(found[0]) if found.size else None

    def cell_of(self, generation: int, centre: int) -> int | None:
        """The cell whose elite a centre is as it was in a generation; None if it is none's."""
        found = np.flatnonzero((self.generation_N == generation) & (self.centre_N == centre))
        return int(self.cell_N[found[0]]) if found.size else None


@dataclass(frozen=True)
class Elite:
    """The map's heavy half: what a cell's elite is made of."""

    centre_D: FloatArray
    observation_mean_O: FloatArray
    observation_std_O: FloatArray
    """Statistics it was evaluated with."""
    trace_T_B: FloatArray
    """Descriptor along one evaluation episode, from its reset to its end in equal steps."""


def empty_map(geometry: Geometry) -> BehaviourMap:
    """A map without elites."""
    dimensions = len(geometry.bounds)
    integers, numbers = np.zeros(0, np.int64), np.zeros(0)
    return BehaviourMap(geometry, integers, numbers, np.zeros((0, dimensions)), integers, integers, numbers)


def insert(
    map_: BehaviourMap, descriptor_B: NDArray[np.float64], fitness: float, generation: int, centre: int, score: float
) -> tuple[BehaviourMap, int, bool]:
    """Offer an evaluated centre to its cell: (map, cell, whether it is the cell's elite now).

    It is if the cell was empty or its elite's fitness is less; an equal one stays.
    """
    cell = int(map_.geometry.cells_of(descriptor_B[None])[0])
    row = map_.row_of(cell)
    if row is None:
        return (
            BehaviourMap(
                map_.geometry,
                np.append(map_.cell_N, np.int64(cell)),
                np.append(map_.fitness_N, fitness),
                np.concatenate([map_.descriptor_N_B, descriptor_B[None]]),
                np.append(map_.generation_N, np.int64(generation)),
                np.append(map_.centre_N, np.int64(centre)),
                np.append(map_.score_N, score),
            ),
            cell,
            True,
        )
    if not fitness > map_.fitness_N[row]:
        return map_, cell, False
    columns = {
        "fitness_N": fitness,
        "descriptor_N_B": descriptor_B,
        "generation_N": generation,
        "centre_N": centre,
        "score_N": score,
    }
    return (
        replace(map_, **{name: _with(getattr(map_, name), row, value) for name, value in columns.items()}),
        cell,
        True,
    )


def with_score(map_: BehaviourMap, cell: int, centre: int, score: float) -> BehaviourMap:
    """The map with another score of the elite that a centre has in a cell; unchanged if it is another centre's now."""
    row = map_.row_of(cell)
    if row is None or map_.centre_N[row] != centre:
        return map_
    return replace(map_, score_N=_with(map_.score_N, row, score))


def map_statistics(
    map_: BehaviourMap, qd_offset: float, reachable: NDArray[np.bool_] | None
) -> dict[str, float | None]:
    """Coverage, best fitness and QD-score of a map: the sum over elites of fitness - qd_offset, exact before its last
    rounding, so that the order of the cells does not matter."""
    filled = map_.size
    return {
        "map_cells": filled,
        "coverage": filled / map_.geometry.size,
        "coverage_reachable": None if reachable is None else float(reachable[map_.cell_N].sum() / reachable.sum()),
        "map_fitness_max": float(map_.fitness_N.max()) if filled else None,
        "qd_score": math.fsum((map_.fitness_N - qd_offset).tolist()),
    }


def make_elite(centre: Centre, trace_T_B: FloatArray) -> Elite:
    """What is kept of a centre that has become an elite."""
    return Elite(centre.parameters_D, centre.observation_mean_O, centre.observation_std_O, trace_T_B)


def _with(values: np.ndarray, row: int, value: object) -> np.ndarray:
    changed = values.copy()
    changed[row] = value
    return changed
