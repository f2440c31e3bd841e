"""The behaviour map as the driver keeps it in memory: fitness, descriptor and origin of each cell's elite.

An elite is the evaluated centre or policy with the highest fitness among all whose descriptor is in a cell. Its
parameters, its observation statistics and the trace of one of its episodes are in the run store, from which they are
read when they are needed; they follow an entry that moves to another cell, and leave with it. Most searches only
insert; one that measures its elites again may also change, move and remove entries. All functions are pure.

Axes: N filled cells, in the order in which they were filled; B descriptor dimensions; D policy parameters; O
observation; T points of a trace.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from es_service.protocol.messages import Centre, FloatArray
from es_service.search.maps.geometry import Geometry

COLUMNS = {"fitness_N": "f8", "descriptor_N_B": "f8", "generation_N": "i8", "centre_N": "i8", "score_N": "f8"}
"""Type of each array that every map has besides the numbers of its cells."""
EMPTY = -1
"""Stands for no cell in an array of cells."""


@dataclass(frozen=True)
class BehaviourMap:
    """The filled cells of a map. It is immutable: `insert` and the other functions return a new map."""

    geometry: Geometry
    cell_N: NDArray[np.int64]
    """Number of each filled cell, as `geometry` counts cells; each is different."""
    fitness_N: NDArray[np.float64]
    """Mean fitness over the evaluation episodes; of all samples, if the search measures elites again."""
    descriptor_N_B: NDArray[np.float64]
    generation_N: NDArray[np.int64]
    """Generation in which each elite was first evaluated; 0 for initial centres."""
    centre_N: NDArray[np.int64]
    """Index of the centre or policy that became the elite. With the generation it says which policy an entry has,
    wherever the entry moves."""
    score_N: NDArray[np.float64]
    """Highest fitness of a member of the population that led to the elite or, later, of the latest population around
    it; one noisy value, which `cell_sampling: score` uses. NaN where there was no population."""
    samples_N: NDArray[np.int64] | None = None
    """Number of episodes of which fitness and descriptor are the mean; None for a search that does not count them
    (`Algorithm.counts_samples`)."""
    order_N: NDArray[np.int64] | None = None
    """Increasing numbers that give the order in which the cells were filled; None: 0, 1, 2, ... They have gaps once an
    entry has left."""

    @property
    def size(self) -> int:
        """Number of filled cells."""
        return self.cell_N.size

    def row_of(self, cell: int) -> int | None:
        """Index of a cell on axis N; None if the cell is empty."""
        rows = np.flatnonzero(self.cell_N == cell)
        return int(rows[0]) if rows.size else None

    def cell_of(self, generation: int, centre: int) -> int | None:
        """The cell whose elite is the centre that was evaluated in a generation; None if there is none."""
        cell = int(self.cells_with(generation, np.array([centre]))[0])
        return None if cell == EMPTY else cell

    def cells_with(self, generation: int, centre_Q: NDArray[np.int64]) -> NDArray[np.int64]:
        """The cell whose elite is each of the centres that were evaluated in a generation, [Q]; EMPTY where none is."""
        rows = np.flatnonzero(self.generation_N == generation)
        rows = rows[np.argsort(self.centre_N[rows], kind="stable")]
        found_Q = np.searchsorted(self.centre_N[rows], centre_Q)
        is_there_Q = np.append(self.centre_N[rows], 0)[found_Q] == centre_Q
        is_there_Q &= found_Q < rows.size
        return np.where(is_there_Q, np.append(self.cell_N[rows], EMPTY)[found_Q], EMPTY)


@dataclass(frozen=True)
class Elite:
    """The elite of a cell as the run store keeps it: parameters, observation statistics and trace."""

    centre_D: FloatArray
    observation_mean_O: FloatArray
    observation_std_O: FloatArray
    """Mean and standard deviation of observations with which it was evaluated."""
    trace_T_B: FloatArray
    """Descriptor along one evaluation episode, from reset to end at equal intervals."""


def empty_map(geometry: Geometry, *, counts_samples: bool = False) -> BehaviourMap:
    """A map without elites."""
    dimensions = len(geometry.bounds)
    integers, numbers = np.zeros(0, np.int64), np.zeros(0)
    samples_N = integers if counts_samples else None
    return BehaviourMap(geometry, integers, numbers, np.zeros((0, dimensions)), integers, integers, numbers, samples_N)


def insert(
    map_: BehaviourMap,
    descriptor_B: NDArray[np.float64],
    fitness: float,
    generation: int,
    centre: int,
    score: float,
    samples: int = 1,
) -> tuple[BehaviourMap, int, bool]:
    """Insert an evaluated centre if it is better than its cell's elite: (new map, cell, whether it was inserted).

    It is inserted if the cell was empty or the fitness of the present elite is strictly lower; if they are equal, the
    present elite stays.

    Args:
        descriptor_B: mean descriptor, finite.
        fitness: mean fitness over the evaluation episodes.
        score: see `BehaviourMap.score_N`.
        samples: number of the evaluation episodes; not used by a map that does not count them.
    """
    cell = int(map_.geometry.cells_of(descriptor_B[None])[0])
    entry = {
        "fitness_N": fitness,
        "descriptor_N_B": descriptor_B,
        "generation_N": generation,
        "centre_N": centre,
        "score_N": score,
        **({} if map_.samples_N is None else {"samples_N": samples}),
    }
    return _offered(map_, cell, entry)


def changed(
    map_: BehaviourMap,
    cell: int,
    *,
    fitness: float | None = None,
    score: float | None = None,
    samples: int | None = None,
) -> BehaviourMap:
    """The map with other values for a cell's elite, None for those that stay; unchanged if the cell is empty.

    Args:
        samples: not used by a map that does not count them.
    """
    row = map_.row_of(cell)
    values = {"fitness_N": fitness, "score_N": score, "samples_N": samples if map_.samples_N is not None else None}
    return (
        map_ if row is None else _with(map_, row, {name: value for name, value in values.items() if value is not None})
    )


def removed(map_: BehaviourMap, cell: int) -> BehaviourMap:
    """The map without a cell's elite; unchanged if the cell is empty. The others keep their order."""
    row = map_.row_of(cell)
    if row is None:
        return map_
    columns = {name: np.delete(values, row, axis=0) for name, values in columns_of(map_).items()}
    order_N = np.delete(orders(map_), row)
    return replace(map_, **columns, order_N=None if np.array_equal(order_N, np.arange(order_N.size)) else order_N)


def moved(map_: BehaviourMap, cell: int, descriptor_B: NDArray[np.float64]) -> tuple[BehaviourMap, int, bool]:
    """Give a cell's elite a new descriptor: (new map, cell of the descriptor, whether the elite is in the map).

    If the descriptor is in another cell, the elite leaves its own and is offered there as by `insert`: it takes the
    place of an elite with a strictly lower fitness, and leaves the map where there is a better or an equal one. In an
    empty cell it is the newest entry of the map.

    Raises:
        KeyError: the cell is empty.
    """
    row, to = map_.row_of(cell), int(map_.geometry.cells_of(descriptor_B[None])[0])
    if row is None:
        raise KeyError(cell)
    if to == cell:
        return _with(map_, row, {"descriptor_N_B": descriptor_B}), cell, True
    entry = {name: values[row] for name, values in columns_of(map_).items() if name != "cell_N"}
    return _offered(removed(map_, cell), to, entry | {"descriptor_N_B": descriptor_B})


def resampled(
    map_: BehaviourMap, cell: int, descriptor_B: NDArray[np.float64], fitness: float, samples: int
) -> tuple[BehaviourMap, int, bool]:
    """Add samples to a cell's elite, whose fitness and descriptor become the means of all; returns as `moved`.

    Args:
        descriptor_B: mean over the new samples, finite.
        fitness: likewise.
        samples: number of the new samples.

    Raises:
        KeyError: the cell is empty.
        ValueError: the map does not count samples.
    """
    row = map_.row_of(cell)
    if map_.samples_N is None:
        raise ValueError("this map does not count samples; set Algorithm.counts_samples")
    if row is None:
        raise KeyError(cell)
    total = int(map_.samples_N[row]) + samples
    share = samples / total
    fitness = float((1.0 - share) * map_.fitness_N[row] + share * fitness)
    descriptor_B = (1.0 - share) * map_.descriptor_N_B[row] + share * descriptor_B
    return moved(changed(map_, cell, fitness=fitness, samples=total), cell, descriptor_B)


def orders(map_: BehaviourMap) -> NDArray[np.int64]:
    """Number of each entry in the order in which the cells were filled, [N], increasing.

    `BehaviourMap.order_N` counts if it is such numbers; otherwise a search has put the entries into another order.
    """
    order_N = map_.order_N
    if order_N is not None and order_N.shape == map_.cell_N.shape and (np.diff(order_N) > 0).all():
        return order_N
    return np.arange(map_.size)


def unchanged_entries(map_: BehaviourMap, before: BehaviourMap) -> NDArray[np.bool_]:
    """Whether each entry is the same, bit for bit, as that of its cell in an earlier map, with its order, [N]."""
    was_N, row_N = rows_in(map_, before)
    now, then = ({**columns_of(each_map), "order_N": orders(each_map)} for each_map in (map_, before))
    if now.keys() != then.keys():  # one map counts samples
        return np.zeros(map_.size, bool)
    same_N = was_N.copy()
    for name in now:
        if now[name] is not then[name] or map_.cell_N is not before.cell_N:
            same_N[was_N] &= (_bytes(now[name][was_N]) == _bytes(then[name][row_N[was_N]])).all(axis=1)
    return same_N


def rows_in(map_: BehaviourMap, other: BehaviourMap) -> tuple[NDArray[np.bool_], NDArray[np.int64]]:
    """Whether each cell is filled in another map, [N], and the index of its entry there, [N] (0 if it is not)."""
    first, row_N = min(map_.size, other.size), np.arange(map_.size)
    if np.array_equal(map_.cell_N[:first], other.cell_N[:first]):  # no entry has left, as in most searches
        return row_N < first, np.where(row_N < first, row_N, 0)
    sorted_rows = np.argsort(other.cell_N)
    found_N = np.searchsorted(other.cell_N, map_.cell_N, sorter=sorted_rows)
    row_N = np.append(sorted_rows, 0)[found_N]
    was_N = np.append(other.cell_N, -1)[np.append(sorted_rows, other.size)[found_N]] == map_.cell_N
    return was_N, np.where(was_N, row_N, 0)


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


def columns_of(map_: BehaviourMap) -> dict[str, np.ndarray]:
    """The arrays of a map by name, without the order."""
    samples = {} if map_.samples_N is None else {"samples_N": map_.samples_N}
    return {"cell_N": map_.cell_N, **{name: getattr(map_, name) for name in COLUMNS}, **samples}


def _offered(map_: BehaviourMap, cell: int, entry: dict[str, Any]) -> tuple[BehaviourMap, int, bool]:
    """Insert an entry into a cell unless the elite there is as fit; see `insert`."""
    row = map_.row_of(cell)
    if row is not None:
        enters = entry["fitness_N"] > map_.fitness_N[row]
        return (_with(map_, row, entry) if enters else map_), cell, bool(enters)
    columns = {
        name: np.concatenate([values, np.asarray(value, values.dtype)[None]])
        for name, values in columns_of(map_).items()
        for value in [cell if name == "cell_N" else entry[name]]
    }
    order_N = None if map_.order_N is None else np.append(order := orders(map_), order.max(initial=-1) + 1)
    return replace(map_, **columns, order_N=order_N), cell, True


def _with(map_: BehaviourMap, row: int, values: dict[str, Any]) -> BehaviourMap:
    """The map with other values in an entry."""
    columns = {name: getattr(map_, name).copy() for name in values}
    for name, value in values.items():
        columns[name][row] = value
    return replace(map_, **columns)
