"""The behaviour map as the driver keeps it in memory: fitness, descriptor and origin of each cell's elite.

An elite is the evaluated centre with the highest mean fitness among all whose mean descriptor is in a cell. Its
parameters, its observation statistics and the trace of one of its episodes are written to the run store when it enters
the map and read when they are needed. Axes: N filled cells, in the order in which they were first filled; B descriptor
dimensions; D policy parameters; O observation; T points of a trace.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from es_service.protocol.messages import Centre, FloatArray
from es_service.search.maps.geometry import Geometry

COLUMNS = {"fitness_N": "f8", "descriptor_N_B": "f8", "generation_N": "i8", "centre_N": "i8", "score_N": "f8"}
"""Type of each array of a map besides the numbers of its cells."""


@dataclass(frozen=True)
class BehaviourMap:
    """The filled cells of a map. It is immutable: `insert` returns a new map."""

    geometry: Geometry
    cell_N: NDArray[np.int64]
    """Number of each filled cell, as `geometry` counts cells."""
    fitness_N: NDArray[np.float64]
    """Mean fitness over the evaluation episodes. Shipped searches never estimate it again."""
    descriptor_N_B: NDArray[np.float64]
    generation_N: NDArray[np.int64]
    """Generation in which each elite was evaluated; 0 for initial centres."""
    centre_N: NDArray[np.int64]
    """Index of the centre that became the elite."""
    score_N: NDArray[np.float64]
    """Highest fitness of a member of the population that led to the elite or, later, of the latest population around
    it; one noisy value, which `cell_sampling: score` uses. NaN where there was no population."""

    @property
    def size(self) -> int:
        """Number of filled cells."""
        return self.cell_N.size

    def row_of(self, cell: int) -> int | None:
        """Index of a cell on axis N; None if the cell is empty."""
        found = np.flatnonzero(self.cell_N == cell)
        return int(found[0]) if found.size else None

    def cell_of(self, generation: int, centre: int) -> int | None:
        """The cell whose elite is the centre that was evaluated in a generation; None if there is none."""
        found = np.flatnonzero((self.generation_N == generation) & (self.centre_N == centre))
        return int(self.cell_N[found[0]]) if found.size else None


@dataclass(frozen=True)
class Elite:
    """The elite of a cell as the run store keeps it: parameters, observation statistics and trace."""

    centre_D: FloatArray
    observation_mean_O: FloatArray
    observation_std_O: FloatArray
    """Mean and standard deviation of observations with which it was evaluated."""
    trace_T_B: FloatArray
    """Descriptor along one evaluation episode, from reset to end at equal intervals."""


def empty_map(geometry: Geometry) -> BehaviourMap:
    """A map without elites."""
    dimensions = len(geometry.bounds)
    integers, numbers = np.zeros(0, np.int64), np.zeros(0)
    return BehaviourMap(geometry, integers, numbers, np.zeros((0, dimensions)), integers, integers, numbers)


def insert(
    map_: BehaviourMap, descriptor_B: NDArray[np.float64], fitness: float, generation: int, centre: int, score: float
) -> tuple[BehaviourMap, int, bool]:
    """Insert an evaluated centre if it is better than its cell's elite: (new map, cell, whether it was inserted).

    It is inserted if the cell was empty or the fitness of the present elite is strictly lower; if they are equal, the
    present elite stays.

    Args:
        descriptor_B: mean descriptor, finite.
        fitness: mean fitness over the evaluation episodes.
        score: see `BehaviourMap.score_N`.
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


def with_score(map_: BehaviourMap, cell: int, score: float) -> BehaviourMap:
    """The map with a new score for a cell's elite; unchanged if the cell is empty."""
    row = map_.row_of(cell)
    if row is None:
        return map_
    return replace(map_, score_N=_with(map_.score_N, row, score))


def unchanged_entries(map_: BehaviourMap, before: BehaviourMap) -> NDArray[np.bool_]:
    """Whether each entry of an earlier map is still the same, bit for bit, in a map with the same first cells, [N]."""
    same_N = np.ones(before.size, bool)
    for name in COLUMNS:
        now, then = getattr(map_, name)[: before.size], getattr(before, name)
        if now is not then:
            same_N &= (_bytes(now) == _bytes(then)).all(axis=1)
    return same_N


def map_statistics(
    map_: BehaviourMap, qd_offset: float, reachable: NDArray[np.bool_] | None
) -> dict[str, float | None]:
    """Coverage, best fitness and QD-score of a map, by history column.

    The QD-score is the sum of fitness - qd_offset over all elites. It is summed exactly and rounded once, so that the
    order of the cells does not matter.

    Args:
        reachable: whether each cell can be reached, [cells]; None if this is unknown.
    """
    filled = map_.size
    return {
        "map_cells": filled,
        "coverage": filled / map_.geometry.size,
        "coverage_reachable": None if reachable is None else float(reachable[map_.cell_N].sum() / reachable.sum()),
        "map_fitness_max": float(map_.fitness_N.max()) if filled else None,
        "qd_score": math.fsum((map_.fitness_N - qd_offset).tolist()),
    }


def make_elite(centre: Centre, trace_T_B: FloatArray) -> Elite:
    """The elite made of a centre that has entered the map."""
    return Elite(centre.parameters_D, centre.observation_mean_O, centre.observation_std_O, trace_T_B)


def _bytes(values_N: np.ndarray) -> NDArray[np.uint8]:
    """The bytes of each entry, [N, bytes], so that NaN equals NaN, and 0 does not equal -0."""
    entry_bytes = values_N.dtype.itemsize * math.prod(values_N.shape[1:])
    return np.frombuffer(values_N.tobytes(), np.uint8).reshape(-1, entry_bytes)


def _with(values: np.ndarray, row: int, value: object) -> np.ndarray:
    changed = values.copy()
    changed[row] = value
    return changed
